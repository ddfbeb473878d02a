"""One run of a scene with choices of its own, and its errors beside another run."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import math
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from mpi4py import MPI

import numpy as np

import dolfinx_nts as nts
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.solve.accuracy import ACCURACY
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import require_bool, require_positive

INTEGRATORS = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}
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
        tests, masses, squares = zip(*map(affine, bodies), strict=True)
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


def affine(body: Body) -> tuple[FloatArray, float, float]:
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
            check_value(name, value)


def check_value(name: str, value: Any) -> None:
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


def measure(scene: str, choices: Mapping[str, Any], comm: MPI.Comm) -> Run:
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
        # The script is executed anew, so that it may have imported `simulate` by name, too.
        with patch.object(nts, "simulate", partial(instead, nts.simulate)):
            main = load(scene).main
            taken = set(inspect.signature(main).parameters)
            rest = {k: v for k, v in choices.items() if k not in taken}
            main(**{k: v for k, v in choices.items() if k in taken})
    except _MeasuredError:
        pass
    except Exception as error:
        run.status = f"{type(error).__name__}: {error}"
    else:
        run.status = "main never called simulate"
    return run
