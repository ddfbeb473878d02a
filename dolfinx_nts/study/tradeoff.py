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
import dataclasses
import importlib.util
import inspect
import itertools
import math
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

import dolfinx_nts as nts
from dolfinx_nts.run.saved import versions
from dolfinx_nts.step.accuracy import ACCURACY
from dolfinx_nts.study import economy
from dolfinx_nts.validation import require_bool, require_positive

FloatArray = npt.NDArray[np.float64]

INTEGRATORS = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}
#: Choices a run is made with if none are given.
DEFAULT: Mapping[str, list[Any]] = {
    "accuracy": ["fast", "balanced", "exact"],
    "dt_factor": [4.0, 2.0, 1.0],
}
#: Measures of error, each relative to what the reference run has of it.
ERRORS = (
    "trajectory",
    "impulse",
    "energy",
    "linear momentum",
    "angular momentum",
    "dissipation",
    "ledger",
)
#: Errors of the trajectory that the cheapest run is named for.
TARGETS = (0.1, 0.01, 1e-3)


class _MeasuredError(BaseException):
    """Ends a script once its first run is measured; scripts catch Exception at most."""


class Motion:
    """Writer: the affine part of each body's motion, and the contact impulse, over time.

    The means over the mass of u, and of u times X over the size of the body, say how it moves,
    turns and stretches as a whole, whatever its mesh.

    Attributes:
        times: [s].
        motion: The means at each time [m], shape (12 bodies,).
        impulse: Of all normal contact forces [N s].
        mass: Of all bodies [kg].
        arm: Root of the mean square over the mass of the distance from the origin [m].
    """

    def start(self, stepper: nts.Stepper) -> None:
        """Note the state at the start."""
        self.times: list[float] = []
        self.motion: list[FloatArray] = []
        self.impulse = 0.0
        bodies = stepper.system.bodies
        tests, masses, squares = zip(*map(_affine, bodies), strict=True)
        self._tests, self.mass = tests, sum(masses)
        self.arm = math.sqrt(sum(squares) / self.mass)
        self.write(stepper)

    def write(self, stepper: nts.Stepper, *, last: bool = False) -> None:
        """Note an accepted state."""
        state, comm = stepper.state, stepper.system.comm
        local = [
            body.inertia(u) @ test
            for body, u, test in zip(stepper.system.bodies, state.u, self._tests, strict=True)
        ]
        force = sum(float(contact.force.sum()) for contact in state.contacts)
        total = comm.allreduce(np.append(np.concatenate(local), force))
        self.impulse += float(total[-1]) * (state.time - self.times[-1] if self.times else 0.0)
        self.times.append(state.time)
        self.motion.append(total[:-1])

    def close(self, stepper: nts.Stepper) -> None:
        """Nothing is open."""


def _affine(body: Any) -> tuple[FloatArray, float, float]:
    """Return the factors of u . M for the means of a body, (num_owned, 12); M; X . M X."""
    place = body.places.astype(float)[:, None]
    x, one = body.reference.reshape(-1, 3), np.kron(place, np.eye(3))
    nodal = body.inertia(one[:, 0].copy())[::3]
    square = body.reference @ body.inertia(body.reference)
    moments = body.comm.allreduce(np.array([nodal.sum(), *(nodal @ x), square]))
    mass, centre = moments[0], moments[1:4] / moments[0]
    size = np.sqrt(moments[4] / mass - centre @ centre)
    arms = (x - place * centre) / size
    tests = np.hstack([one, *(np.kron(arms[:, k : k + 1], np.eye(3)) for k in range(3))]) / mass
    return tests, float(mass), float(moments[4])


@dataclasses.dataclass
class Run:
    """One run of the scene.

    Attributes:
        choices: What it was made with.
        status: "completed", or why not.
        seconds: Wall time of `simulate`, the slowest rank.
        cpu: Processor time of `simulate` [s], the busiest rank.
        dt: Largest step [s].
        solution: Its Solution, if it got that far.
        path: Motion and impulse.
    """

    choices: dict[str, Any]
    status: str = "not started"
    seconds: float = math.nan
    cpu: float = math.nan
    dt: float = math.nan
    solution: nts.Solution | None = None
    path: Motion | None = None

    def errors(self, reference: Run) -> dict[str, float]:
        """`ERRORS` of this run against a reference."""
        if self.solution is None or self.path is None or self.status != "completed":
            return dict.fromkeys(ERRORS, math.nan)
        assert reference.solution is not None and reference.path is not None
        mine, other = self.solution.balance, reference.solution.balance
        exact = np.array(reference.path.motion)
        at = np.column_stack(
            [np.interp(self.path.times, reference.path.times, column) for column in exact.T]
        )
        step = np.diff(self.path.times, append=np.nan, prepend=np.nan)
        weight = np.nansum([step[1:], step[:-1]], axis=0)
        square = ((np.array(self.path.motion) - at) ** 2).mean(axis=1)
        scale = np.abs(exact - exact[0]).max() or np.finfo(float).tiny
        energy = max(np.abs(other[k]).max() for k in ("energy", "external_work"))
        momentum = np.sqrt(2.0 * reference.path.mass * energy)
        momenta = {
            f"{name} momentum": float(np.abs(mine[key][-1] - other[key][-1]).max() / scale)
            for name, key, scale in (
                ("linear", "linear_momentum", momentum),
                ("angular", "angular_momentum", momentum * reference.path.arm),
            )
        }
        lost = [t["friction_dissipation"][-1] + t["contact_defect"][-1] for t in (mine, other)]
        return {
            "trajectory": float(np.sqrt(weight @ square / weight.sum()) / scale),
            "impulse": _relative(self.path.impulse, reference.path.impulse),
            "energy": float(abs(mine["energy"][-1] - other["energy"][-1]) / energy),
            **momenta,
            "dissipation": float(abs(lost[0] - lost[1]) / energy),
            "ledger": float(np.abs(mine["ledger_residual"]).max() / energy),
        }

    def row(self, reference: Run) -> dict[str, Any]:
        """Line of the table."""
        done = self.solution is not None
        table = self.solution.balance if self.solution else {}
        return {
            **self.choices,
            "dt [s]": self.dt,
            "seconds": self.seconds,
            "cpu [s]": self.cpu,
            "steps": len(table["time"]) - 1 if done else 0,
            "iterations": int(table["newton_iterations"].sum()) if done else 0,
            "retries": self.solution.retries if self.solution else 0,
            "rejected": self.solution.rejected if self.solution else 0,
            "exceeded": self.solution.exceeded if self.solution else 0,
            **self.errors(reference),
            "status": self.status,
        }


def _relative(a: float, b: float) -> float:
    return abs(a - b) / abs(b) if b else float(a != b)


def load(scene: str) -> Any:
    """Module of a scene: a file, or a name in `demos/` here or beside the package.

    It is executed anew each time; what it imports from its folder is imported once.

    Raises:
        ValueError: There is no such file, or it has no `main`.
    """
    beside = Path(nts.__file__).resolve().parents[1] / "demos"
    file = f"{scene.removesuffix('.py')}.py"
    places = [Path(scene), Path("demos") / file, beside / file]
    found = next((p for p in places if p.is_file()), None)
    if found is None:
        raise ValueError(f"scene={scene!r}: no such file; looked for {', '.join(map(str, places))}")
    spec = importlib.util.spec_from_file_location(f"scene_{found.stem}", found)
    assert spec is not None and spec.loader is not None
    folder = found.resolve().parent
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(folder))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
    if not callable(getattr(module, "main", None)):
        raise ValueError(f"scene={scene!r}: {found} has no function main")
    return module


def _options(given: dict[str, Any], choices: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `simulate` from the script's and the choices."""
    options, newton, rule = dict(given), {}, {}
    for name, value in choices.items():
        if name == "integrator":
            options["integrator"] = INTEGRATORS[value]
        elif name == "dt_factor":
            options["dt"] = given["dt"] * value
        elif name in ("dt", "accuracy", "sleep"):
            options[name] = value
        elif name == "adapt":
            options[name] = None if value is None else nts.Adapt(tolerance=value)
        elif name in ("stress", "contact_gradient"):
            rule[name] = value
        else:
            newton[name] = value
    if "accuracy" in choices:
        options.pop("newton", None)
    if newton:
        level = options.pop("accuracy", None)
        base = ACCURACY[level] if level else options.get("newton") or nts.Newton()
        options["newton"] = dataclasses.replace(base, **newton)
    if rule and isinstance(options["integrator"], nts.EnergyMomentum):
        options["integrator"] = dataclasses.replace(options["integrator"], **rule)
    return options


def check(scene: str, choices: Mapping[str, Sequence[Any]]) -> None:
    """Check that there is such a scene and that it has such choices.

    Raises:
        TypeError, ValueError: No.
    """
    known = {"integrator", "stress", "contact_gradient", "dt", "dt_factor", "accuracy"}
    known |= {"adapt", "sleep"}
    known |= {f.name for f in dataclasses.fields(nts.Newton)}
    taken = set(inspect.signature(load(scene).main).parameters)
    if {"dt", "dt_factor"} <= choices.keys():
        raise ValueError("dt, dt_factor: choose one of them")
    for name, values in choices.items():
        if name not in taken | known:
            raise ValueError(
                f"{name}={values!r}: neither an argument of main ({', '.join(sorted(taken))}) nor "
                f"one of {', '.join(sorted(known))}"
            )
        for value in values if name not in taken else ():
            _check_value(name, value)


def _check_value(name: str, value: Any) -> None:
    """Raise ValueError unless a choice that is no argument of main may have the value."""
    known = {"integrator": INTEGRATORS, "accuracy": ACCURACY}.get(name)
    if known is not None and not (isinstance(value, str) and value in known):
        raise ValueError(f"{name}={value!r}: choose one of {', '.join(known)}")
    if name in ("dt", "dt_factor"):
        require_positive(name, value, "s" if name == "dt" else "-")
    elif name == "sleep":
        require_bool(name, value)
    else:
        _options({"dt": 1.0, "integrator": nts.EnergyMomentum()}, {name: value})


def measure(scene: str, choices: Mapping[str, Any], comm: Any) -> Run:
    """Run a scene with some choices.

    Args:
        scene: As for `load`.
        choices: Name -> value.
        comm: MPI communicator of the script's bodies.
    """
    run = Run(dict(choices))

    def instead(simulate: Any, system: Any, integrator: Any, **given: Any) -> nts.Solution:
        options = _options({**given, "integrator": integrator}, rest)
        run.path, run.dt = Motion(), options["dt"]
        output = (*options.pop("output", ()), run.path)
        comm.Barrier()
        begin, cpu = time.perf_counter(), time.process_time()
        run.solution = simulate(system, output=output, **options)
        run.cpu = comm.allreduce(time.process_time() - cpu, op=MPI.MAX)
        run.seconds = comm.allreduce(time.perf_counter() - begin, op=MPI.MAX)
        run.status = run.solution.status
        raise _MeasuredError

    try:
        main = load(scene).main
        taken = set(inspect.signature(main).parameters)
        rest = {k: v for k, v in choices.items() if k not in taken}
        with nts.intercept(instead):
            main(**{k: v for k, v in choices.items() if k in taken})
    except _MeasuredError:
        pass
    except Exception as error:
        run.status = f"{type(error).__name__}: {error}"
    else:
        run.status = "main never called simulate"
    return run


def grid(vary: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """All combinations of the choices."""
    return [dict(zip(vary, values, strict=True)) for values in itertools.product(*vary.values())]


def compare(
    scene: str,
    vary: Mapping[str, Sequence[Any]],
    fixed: Mapping[str, Any],
    reference: Mapping[str, Any],
    comm: Any,
) -> list[dict[str, Any]]:
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


def recommend(rows: Sequence[Mapping[str, Any]]) -> list[tuple[float, Mapping[str, Any] | None]]:
    """The cheapest run for each of the `TARGETS`, if there is one."""
    picks = []
    for target in TARGETS:
        good = [r for r in rows[1:] if r["trajectory"] <= target]
        picks.append((target, min(good, key=lambda r: r["seconds"], default=None)))
    return picks


def recommendation(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return what `recommend` picks, a line for each target."""
    return "\n".join(
        f"trajectory within {target:g}: "
        + (f"{row['run']}: {row['seconds']:.3g} s" if row else "none of these")
        for target, row in recommend(rows)
    )


def write(rows: Sequence[Mapping[str, Any]], folder: Path, title: str) -> None:
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


def plot(rows: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
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


def provenance(scene: str, comm: Any) -> str:
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


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
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
                _check_value(name, value)
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
