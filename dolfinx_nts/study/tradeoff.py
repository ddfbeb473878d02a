"""Speed against accuracy, measured: a scene run with a grid of choices beside a reference.

    python -m dolfinx_nts.study.tradeoff two_blocks --vary accuracy=fast,exact dt_factor=4,2,1
    python -m dolfinx_nts.study.tradeoff my_scene.py --set cells=8 --vary reuse=False,True
    python -m dolfinx_nts.study.tradeoff economy --set cells=8

The scene is a Python file with a function `main`, or the name of one in `demos/`. Measured is the
first run that `main` starts with `simulate`; what a choice names is an argument of `main` if it has
one of that name, else an option of that run: `integrator` (energy-momentum or midpoint), `stress`,
`contact_gradient`, `dt`, `dt_factor` (of the script's own step), `accuracy`, `sleep`, `adapt` (a
tolerance, or None for equal steps), or a field of `Newton` (`rtol`, `condense`, `linear_solver`,
`reuse`, ...). Written are a table of all runs, a work-precision plot and what is cheapest for a
given error. A run that fails is a row with its reason. The scene `economy` is the cost table of the
features, see `dolfinx_nts.study.economy`.
"""

from __future__ import annotations

import argparse
import ast
import csv
import itertools
import platform
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.run.run_file import versions
from dolfinx_nts.study import economy
from dolfinx_nts.study.scene_runs import check, check_value, measure
from dolfinx_nts.types import BalanceRow, Rows

#: Choices a run is made with if none are given.
DEFAULT: Mapping[str, list[Any]] = {
    "accuracy": ["fast", "balanced", "exact"],
    "dt_factor": [4.0, 2.0, 1.0],
}
#: Errors of the trajectory that the cheapest run is named for.
TARGETS = (0.1, 0.01, 1e-3)


def grid(vary: Mapping[str, Sequence[Any]]) -> Rows:
    """All combinations of the choices."""
    return [dict(zip(vary, values, strict=True)) for values in itertools.product(*vary.values())]


def compare(
    scene: str, vary: Mapping[str, Sequence[Any]], fixed: BalanceRow, reference: BalanceRow,
    comm: MPI.Comm,
) -> Rows:  # fmt: skip
    """Rows of all runs, the reference first.

    Args:
        scene: As for `load`.
        vary: Name -> values.
        fixed: Name -> value, for all runs.
        reference: Choices of the reference run.
        comm: MPI communicator.

    Raises:
        ValueError: No such scene or choice.
        RuntimeError: The reference run fails.
    """
    given = [{name: [value] for name, value in group.items()} for group in (fixed, reference)]
    check(scene, {**given[0], **given[1], **vary})
    measure(scene, {**fixed, **grid(vary)[0]}, comm)  # compiles what the others use
    best = measure(scene, {**fixed, **reference}, comm)
    if best.status != "completed":
        raise RuntimeError(f"reference {dict(reference)}: {best.status}")
    rows = [{"run": "reference", **best.row(best)}]
    for choices in grid(vary):
        row = measure(scene, {**fixed, **choices}, comm).row(best)
        rows.append({"run": _label(choices), **row})
        if comm.rank == 0:
            text = f"{row['seconds']:.3g} s, trajectory off by {row['trajectory']:.2g}"
            print(f"{_label(choices)}: {text if row['status'] == 'completed' else row['status']}")
    return rows


def _label(choices: Mapping[str, Any]) -> str:
    return ", ".join(f"{k}={v}" for k, v in choices.items())


def recommend(rows: Sequence[BalanceRow]) -> list[tuple[float, Mapping[str, Any] | None]]:
    """The cheapest run for each of the `TARGETS`, if there is one."""
    picks = []
    for target in TARGETS:
        good = [r for r in rows[1:] if r["trajectory"] <= target]
        picks.append((target, min(good, key=lambda r: r["seconds"], default=None)))
    return picks


def recommendation(rows: Sequence[BalanceRow]) -> str:
    """Return what `recommend` picks, a line for each target."""
    return "\n".join(
        f"trajectory within {target:g}: "
        + (f"{row['run']}: {row['seconds']:.3g} s" if row else "none of these")
        for target, row in recommend(rows)
    )


def write(rows: Sequence[BalanceRow], folder: Path, title: str) -> None:
    """Write table, plot and recommendation; on one rank."""
    folder.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "tradeoff.csv").open("w", newline="", encoding="utf-8") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, names)
        table.writeheader()
        table.writerows(rows)
    text = f"{title}\n{recommendation(rows)}\n"
    (folder / "recommendation.txt").write_text(text, encoding="utf-8")
    plot(rows, folder / "tradeoff.png", title)


def plot(rows: Sequence[BalanceRow], path: Path, title: str) -> None:
    """Work-precision plot: error of the trajectory over seconds, a curve per choice."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    curves: dict[str, list[tuple[float, float]]] = {}
    for row in rows[1:]:
        if row["status"] == "completed":
            parts = [p for p in row["run"].split(", ") if not p.startswith(("dt=", "dt_factor="))]
            curves.setdefault(", ".join(parts), []).append((row["seconds"], row["trajectory"]))
    figure, axis = plt.subplots(figsize=(8, 5.5), layout="constrained")
    for label, points in curves.items():
        seconds, error = np.array(sorted(points)).T
        axis.loglog(seconds, error, "o-", label=label or "dt")
    axis.set(xlabel="wall time [s]", ylabel="error of the trajectory [-]")
    axis.set_title(title, fontsize="small", wrap=True)
    axis.grid(which="both", alpha=0.3)
    if curves:
        axis.legend(fontsize="small")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def provenance(scene: str, comm: MPI.Comm) -> str:
    """Scene, versions and ranks."""
    made_by = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"{scene}: {made_by}, {comm.size} rank(s), {platform.machine()}"


def _choice(text: str) -> tuple[str, list[Any]]:
    name, equals, values = text.partition("=")
    if not equals or not values:
        raise argparse.ArgumentTypeError(f"{text!r}: write name=value or name=value,value")
    try:
        parsed = ast.literal_eval(f"[{values}]")
    except (ValueError, SyntaxError):
        parsed = [_literal(v) for v in values.split(",")]
    return name, parsed


def _one(option: str, choices: Sequence[tuple[str, list[Any]]]) -> dict[str, Any]:
    """Name -> value of choices that have one value each."""
    for name, values in choices:
        if len(values) > 1:
            raise ValueError(
                f"{option} {name}={values!r}: has {len(values)} values; give one (a tuple in "
                f'brackets: "{name}=(8,7)"), or use --vary'
            )
    return {name: values[0] for name, values in choices}


def _literal(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def main(arguments: Sequence[str] | None = None) -> Rows:
    """Run the program; returns the rows of its table."""
    parser = argparse.ArgumentParser(
        prog="python -m dolfinx_nts.study.tradeoff",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", help="a file with a function main, or a demo's name")
    parser.add_argument(
        "--vary", nargs="+", action="extend", type=_choice, default=[], help="name=value,value ..."
    )
    parser.add_argument(
        "--set", nargs="+", action="extend", type=_choice, default=[], help="name=value for all"
    )
    parser.add_argument(
        "--reference", nargs="+", action="extend", type=_choice, default=[],
        help="name=value of the reference (default: exact, a quarter of the smallest step)",
    )  # fmt: skip
    parser.add_argument("--output", default="out/tradeoff", help="folder for table and plot")
    options = parser.parse_args(arguments)
    fixed, comm = _one("--set", options.set), MPI.COMM_WORLD
    names = [name for name, _ in options.vary]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"--vary {name}: is given twice; write {name}=value,value")
    if options.scene == "economy":
        if options.vary or options.reference:
            raise ValueError("economy: takes --set cells=, steps= and rounds= only")
        rows, title = economy.table(comm, **fixed), provenance(options.scene, comm)
        if comm.rank == 0:
            economy.write(rows, Path(options.output), title)
        return rows
    steps = fixed.keys() & {"dt", "dt_factor"}
    vary: dict[str, list[Any]] = dict(options.vary) or {
        k: v for k, v in DEFAULT.items() if k != "dt_factor" or not steps
    }
    reference: dict[str, Any] = {"accuracy": "exact"}
    for name in ("dt", "dt_factor"):
        if name in vary or name in fixed:
            steps_given = vary.get(name, [fixed.get(name)])
            for value in steps_given:
                check_value(name, value)
            reference[name] = min(steps_given) / 4
    if not reference.keys() & {"dt", "dt_factor"}:
        reference["dt_factor"] = 0.25
    reference |= _one("--reference", options.reference)
    rows = compare(options.scene, vary, fixed, reference, comm)
    title = provenance(options.scene, comm)
    if comm.rank == 0:
        write(rows, Path(options.output), title)
        print(title)
        print(recommendation(rows))
        print(f"table, plot and recommendation in {options.output}")
    return rows


if __name__ == "__main__":
    try:
        done = main()
    except (TypeError, ValueError) as error:
        sys.exit(f"tradeoff: {error}" if MPI.COMM_WORLD.rank == 0 else 2)
    if not any(row.get("status", "completed") == "completed" for row in done[1:]):
        sys.exit("tradeoff: no run completed" if MPI.COMM_WORLD.rank == 0 else 1)
