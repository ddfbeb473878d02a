"""Where the schemes hold: one impact, carried to extremes along one axis after another.

    python -m dolfinx_nts.study.stability [--only friction spin] [--integrators midpoint]
        [--accuracy exact fast]

A cube meets a wider one off centre. Along each axis one number of the scene goes to its extremes,
with each integrator, and with the energy-momentum scheme at each level of accuracy; some axes have
scenes of their own, among them two of 20,000 steps. A run is judged by what does not depend on the
solver: momenta, the energy beside all that is accounted for, and whether a body has come out on the
other side of the other.
Written are tables of all runs, as CSV and as Markdown, and a picture. Each run ends as one of

    completed   right, and no step was cut
    cut back    right, after steps were cut
    told        a check failed, or a result is doubtful, and a warning of the run says so
    stopped     a step was not solved; the sentence is in the table
    wrong       a check failed without a word
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

import dolfinx_nts as nts
from dolfinx_nts.run.locking_watch import LockingWatch
from dolfinx_nts.solve.accuracy import ACCURACY
from dolfinx_nts.study.extreme_scenes import MATERIALS, Case, Scene, closing, long_run, strips
from dolfinx_nts.types import BalanceRow, Rows

INTEGRATORS: Mapping[str, Any] = {
    "energy-momentum": nts.EnergyMomentum(),
    "midpoint": nts.Midpoint(),
    "newmark": nts.Newmark(),
    "generalized-alpha": nts.GeneralizedAlpha(),
}
#: The integrator that is run at each level of accuracy if none is asked for.
_EACH_LEVEL = "energy-momentum"
#: Outcomes, the best first, with their colours in the picture.
OUTCOMES: Mapping[str, str] = {
    "completed": "#1a9850",
    "cut back": "#a6d96a",
    "told": "#fee08b",
    "stopped": "#f46d43",
    "wrong": "#7b3294",
}
#: Relative drift of momenta that is wrong at each level of accuracy, ...
_MOMENTUM: Mapping[str, float] = {"exact": 1e-8, "balanced": 1e-6, "fast": 1e-4}
#: ... part of the energy unaccounted for that is wrong where the integrator promises none, ...
_LEDGER: Mapping[str, float] = {"exact": 1e-6, "balanced": 1e-6, "fast": 1e-4}
#: ... and that which is wrong with any.
_ENERGY = 0.1
#: Axis -> its values, and how a value makes a case: a field of `Scene`, or a function.
AXES: Mapping[str, tuple[str | Callable[[Any, Any], Case], tuple[Any, ...]]] = {
    "step": ("dt", (1e-3, 1e-2, 0.1, 0.3, 1.0, 3.0, 10.0)),
    "speed": ("speed", (1e-6, 1e-3, 0.1, 5.0, 10.0, 30.0, 100.0)),
    "spin": ("spin", (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)),
    "stiffness": ("stiffness", (1e-6, 1e-3, 0.1, 10.0, 1e3, 1e6)),
    "density": ("density", (1e-6, 1e-3, 0.1, 10.0, 1e3, 1e6)),
    "mesh": ("cells", ((1, 12), (1, 6), (2, 3), (3, 1), (6, 1), (12, 1))),
    "strips": (strips, ((1, 50), (1, 25), (25, 1), (50, 1))),
    "aspect": ("height", (1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3)),
    "facets": ("facets", ("even", "warped", "slivers")),
    "place": ("place", ("across", "nodes", "edges", "corners")),
    "held": ("held", (False, True)),
    "bodies": ("bodies", (2, 3, 5, 10)),
    "closing": (closing, (0.01, 0.03, 0.1)),
    "poisson": ("poisson", (0.0, 0.45, 0.49, 0.499, 0.4999)),
    "material": ("material", tuple(MATERIALS)),
    "friction": ("friction", (0.0, 1e-12, 1e-3, 1.0, 10.0, 1e3, 1e6, math.inf)),
    "unit": ("unit", (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9)),
    "offset": ("offset", (1.0, 1e3, 1e6)),
    "touch": ("gap", (0.0, 1e-12, 1.0, 3.0)),
    "long": (long_run, ("bouncing", "rubbing")),
}


def case(axis: str, value: Any, comm: MPI.Comm) -> Case:
    """The scene at a value of an axis."""
    what = AXES[axis][0]
    if callable(what):
        return what(comm, value)
    return replace(Scene(), **{what: value}).case(comm)


def judge(
    run: nts.Solution, integrator: Any, case: Case, accuracy: str = "exact"
) -> tuple[str, str]:
    """Outcome of a run and what speaks for it; checks need nothing of the solver. Collective."""
    # Cells that lock say nothing of a balance.
    told = "; ".join(
        f"{w.kind}: {w.text}" for w in run.warnings.values() if w.kind not in LockingWatch.KINDS
    )
    if not run.status.startswith("completed"):
        return "stopped", run.status
    failed, b, energy = [], run.balance, _energy(run)
    checks = ["linear_momentum"] if case.free else []
    if case.free and integrator.keeps_angular_momentum:
        checks.append("angular_momentum")
    for name in checks:
        drift, size = np.ptp(b[name], axis=0).max(), np.abs(b[name]).max()
        if drift > _MOMENTUM[accuracy] * size:
            failed.append(f"{name} drifts by {drift / size:.2g}")
    missing = float(np.abs(b["ledger_residual"]).max())
    if missing > (_LEDGER[accuracy] if integrator.closes_ledger else _ENERGY) * energy:
        failed.append(f"{missing / energy:.2g} of the energy is unaccounted for")
    if not case.apart(run):
        failed.append("the bodies have passed through each other")
    if failed:
        return ("told" if told else "wrong"), "; ".join([*failed, told])
    if run.status != "completed":
        return "told", told
    return ("cut back" if run.retries else "completed"), told


def _energy(run: nts.Solution) -> float:
    """Largest kinetic or stored energy [J]; that at the start may be zero."""
    b = run.balance
    return max(float(np.abs(b[name]).max()) for name in ("kinetic", "potential"))


def measure(
    axis: str, value: Any, name: str, comm: MPI.Comm, accuracy: str = "exact"
) -> dict[str, Any]:
    """A row of the table."""
    integrator, begin, scene = INTEGRATORS[name], time.perf_counter(), case(axis, value, comm)
    run = nts.simulate(
        scene.system, integrator, dt=scene.dt, t_end=scene.steps * scene.dt, accuracy=accuracy
    )
    outcome, why = judge(run, integrator, scene, accuracy)
    b, energy = run.balance, _energy(run)
    row = {
        "axis": axis, "value": value, "integrator": name, "accuracy": accuracy, "outcome": outcome,
        "steps": len(b["time"]) - 1, "retries": run.retries,
        "iterations": float(b["newton_iterations"][1:].mean()) if len(b["time"]) > 1 else 0.0,
        "energy": float(b["energy"][-1] - b["energy"][0]) / energy,
        "ledger": float(np.abs(b["ledger_residual"]).max()) / energy,
        "seconds": time.perf_counter() - begin, "why": why,
    }  # fmt: skip
    return row


def chart(
    only: Sequence[str] = (), integrators: Sequence[str] = (), accuracy: Sequence[str] = (),
    comm: MPI.Comm = MPI.COMM_WORLD, told: Callable[[Rows], None] = lambda _: None,
) -> Rows:  # fmt: skip
    """Rows of all runs of some axes.

    Args:
        only: Names in `AXES`; all if empty.
        integrators: Names in `INTEGRATORS`; all if empty.
        accuracy: Levels of each; if empty, all of the energy-momentum scheme and "exact" of others.
        comm: MPI communicator.
        told: What is called after each run with the rows so far.

    Raises:
        ValueError: No such axis, integrator or level; before any run.
    """
    for what, names, known in (
        ("axis", only, AXES), ("integrator", integrators, INTEGRATORS),
        ("accuracy", accuracy, ACCURACY),
    ):  # fmt: skip
        for name in names:
            if name not in known:
                raise ValueError(f"{what} {name!r}: choose among {', '.join(known)}")
    schemes = [
        (name, level)
        for name in integrators or INTEGRATORS
        for level in accuracy or (ACCURACY if name == _EACH_LEVEL else ("exact",))
    ]
    rows = []
    for axis in only or AXES:
        for value in AXES[axis][1]:
            for name, level in schemes:
                rows.append(measure(axis, value, name, comm, level))
                told(rows)
    return rows


def _scheme(row: BalanceRow) -> str:
    """Integrator of a row, and its level of accuracy if that is not "exact"."""
    level = row["accuracy"]
    return str(row["integrator"]) + ("" if level == "exact" else f", {level}")


def summary(rows: Sequence[BalanceRow]) -> str:
    """Markdown: how many runs ended how, and all runs with a column for each integrator.

    A run's number in brackets is the largest part of the energy that nothing accounts for, or the
    step at which it stopped; those of several levels of accuracy stand one after another.
    """
    names = list(dict.fromkeys(row["integrator"] for row in rows))
    schemes = list(dict.fromkeys(map(_scheme, rows)))
    lines = ["| outcome | " + " | ".join(schemes) + " |", "|---" * (len(schemes) + 1) + "|"]
    for outcome in OUTCOMES:
        ended = [row for row in rows if row["outcome"] == outcome]
        counts = [sum(_scheme(row) == scheme for row in ended) for scheme in schemes]
        lines.append(f"| {outcome} | " + " | ".join(map(str, counts)) + " |")
    lines += ["", "| axis | value | " + " | ".join(names) + " |", "|---" * (len(names) + 2) + "|"]
    for axis, value in dict.fromkeys((row["axis"], row["value"]) for row in rows):
        here = [row for row in rows if (row["axis"], row["value"]) == (axis, value)]
        cells = [_in_words([row for row in here if row["integrator"] == n]) for n in names]
        lines.append(f"| {axis} | {value} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _in_words(rows: Sequence[BalanceRow]) -> str:
    """Outcomes of one scheme's levels, e.g. "completed (2e-14, 1e-10)"."""
    told: dict[str, list[str]] = {}
    for row in rows:
        stopped = row["outcome"] == "stopped"
        number = f"step {row['steps']}" if stopped else f"{row['ledger']:.0e}"
        told.setdefault(row["outcome"], []).append(number)
    return "; ".join(f"{outcome} ({', '.join(numbers)})" for outcome, numbers in told.items())


def picture(rows: Sequence[BalanceRow], path: Path) -> None:
    """A field for each axis: values across, schemes down, outcomes as colours."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch

    axes = list(dict.fromkeys(row["axis"] for row in rows))
    names = list(dict.fromkeys(map(_scheme, rows)))
    rows_of_fields, height = len(axes) // 2 + 1, 0.8 + 0.18 * len(names)
    figure, fields = plt.subplots(
        rows_of_fields, 2, figsize=(12, height * rows_of_fields), squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for field in fields.ravel()[len(axes) :]:
        field.axis("off")
    for axis, field in zip(axes, fields.ravel(), strict=False):
        values = AXES[axis][1]
        for row in (row for row in rows if row["axis"] == axis):
            x, y = values.index(row["value"]), names.index(_scheme(row))
            field.add_patch(plt.Rectangle((x, y), 0.95, 0.95, color=OUTCOMES[row["outcome"]]))
        labels = [
            ":".join(map(str, v)) if isinstance(v, tuple) else str(v)
            for v in values
        ]
        field.set(xlim=(0, len(values)), ylim=(len(names), 0), title=axis)
        field.set_xticks(np.arange(len(values)) + 0.5, labels, fontsize=7)
        field.set_yticks(np.arange(len(names)) + 0.5, names, fontsize=7)
    handles = [Patch(color=colour, label=name) for name, colour in OUTCOMES.items()]
    fields.ravel()[-1].legend(handles=handles, loc="center", ncol=3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> Rows:
    """Run the program; returns the rows of its table."""
    parser = argparse.ArgumentParser(
        prog="python -m dolfinx_nts.study.stability",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", default=[], help=f"axes among {', '.join(AXES)}")
    parser.add_argument(
        "--integrators", nargs="+", default=[], help=f"among {', '.join(INTEGRATORS)}"
    )
    parser.add_argument("--accuracy", nargs="+", default=[], help=f"among {', '.join(ACCURACY)}")
    parser.add_argument("--output", default="out/stability", help="folder for tables and picture")
    options = parser.parse_args(arguments)
    comm = MPI.COMM_WORLD
    folder = Path(options.output)

    def told(rows: Rows) -> None:
        # A map takes half an hour: what is known of it stays if a later run ends the program.
        if comm.rank > 0:
            return
        row = rows[-1]
        print(f"{row['axis']} = {row['value']}, {_scheme(row)}: {row['outcome']}", flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        with Path(folder, "stability.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)

    rows = chart(options.only, options.integrators, options.accuracy, comm, told)
    if comm.rank == 0:
        picture(rows, folder / "stability.png")
        Path(folder, "stability.md").write_text(summary(rows), encoding="utf-8")
        counts = {name: sum(row["outcome"] == name for row in rows) for name in OUTCOMES}
        print(", ".join(f"{number} {name}" for name, number in counts.items()))
        print(f"tables and picture in {folder}")
    return rows


if __name__ == "__main__":
    try:
        done = main()
    except ValueError as error:
        sys.exit(f"stability: {error}" if MPI.COMM_WORLD.rank == 0 else 2)
