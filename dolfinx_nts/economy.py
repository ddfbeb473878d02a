"""What each feature of a scene costs per step, measured in one run beside a plain DOLFINx loop.

    python -m dolfinx_nts.tradeoff economy [--set cells=8 steps=10 rounds=9]

Two cubes of n^3 and (n + 1)^3 hexahedra that spin, so that both deform, without contact, far apart,
near each other and touching. Each row adds a feature to the row it is compared with.
"""

from __future__ import annotations

import contextlib
import csv
import io
import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, GhostMode, create_box
from mpi4py import MPI
from petsc4py import PETSc

import dolfinx_nts as nts
from dolfinx_nts import balance, output
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.linear_solver import SolverOptions
from dolfinx_nts.validation import known_options, require_positive

FloatArray = npt.NDArray[np.float64]

#: Of a residual, relative to the forces of the step.
RTOL = 1e-8
#: Of the linear solver, of all rows: one ordering, as MUMPS would choose another for one body than
#: for two of the same size, and with it another fill.
_ORDERING = {"mat_mumps_icntl_7": 4}
#: Steps that are not timed: the first ones set up what later ones keep.
_WARM = 2
_SPEED, _SPIN = 2.0, 20.0
#: Gap between the cubes in facets, speed of the first one towards the second [m/s], and whether
#: the second one spins, too.
PLACES: Mapping[str, tuple[float, float, bool]] = {
    "far": (10.0, 0.0, True),
    "near": (0.25, 0.0, True),
    "touching": (0.0, _SPEED, True),
    "one at rest": (10.0, 0.0, False),
}


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A row of the table.

    Attributes:
        name: What is on.
        against: Row it is compared with.
        place: Of the cubes, one of `PLACES`.
        contact: Whether a contact is declared.
        friction: Coulomb's coefficient [-].
        sleep: Whether the second cube may sleep.
        ledger: Whether energies, momenta and works are computed.
        every: Cadence of a `Fields` writer, 0 for none.
        progress: Whether there is a progress line.
    """

    name: str
    against: str
    place: str = "far"
    contact: bool = False
    friction: float = 0.0
    sleep: bool = False
    ledger: bool = True
    every: int = 0
    progress: bool = False


PLAIN = "plain DOLFINx + SNES"
_BARE = "no contact, no ledger"
_NONE = "contact not declared"
FEATURES = (
    Feature(name=_BARE, against=PLAIN, ledger=False),
    Feature(name=_NONE, against=_BARE),
    Feature(name="declared, far", against=_NONE, contact=True),
    Feature(name="candidates, inactive", against=_NONE, contact=True, place="near"),
    Feature(name="active", against=_NONE, contact=True, place="touching"),
    Feature(
        name="friction, far", against="declared, far", contact=True, friction=0.3
    ),
    Feature(
        name="friction, inactive", against="candidates, inactive",
        contact=True, place="near", friction=0.3,
    ),
    Feature(
        name="friction, active", against="active", contact=True, place="touching", friction=0.3
    ),
    Feature(name="one at rest", against="declared, far", contact=True, place="one at rest"),
    Feature(
        name="one asleep", against="one at rest", contact=True, place="one at rest", sleep=True
    ),
    Feature(name="output every 10 steps", against=_NONE, every=10),
    Feature(name="output every step", against=_NONE, every=1),
    Feature(name="progress", against=_NONE, progress=True),
)  # fmt: skip


class Stopwatch:
    """Writer, and clock of any loop: CPU and wall time between its calls, the slowest rank's.

    Attributes:
        laps: CPU and wall time [s] of each, shape (laps, 2).
    """

    def __init__(self, comm: Any) -> None:
        self._comm, self._times = comm, [self._now()]

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.process_time(), time.perf_counter()

    @property
    def laps(self) -> FloatArray:  # noqa: D102
        laps: FloatArray = np.diff(np.array(self._times), axis=0)
        self._comm.Allreduce(MPI.IN_PLACE, laps, op=MPI.MAX)
        return laps

    def start(self, stepper: nts.Stepper | None = None) -> None:
        """Start."""
        self._times = [self._now()]

    def write(self, stepper: nts.Stepper | None = None, *, last: bool = False) -> None:
        """Take the time."""
        self._times.append(self._now())

    def close(self, stepper: nts.Stepper) -> None:
        """Nothing is open."""


class PlainBody:
    """One body in free motion as a user writes it without this package: two forms and one SNES.

    The same equations, quadrature, compiler options, tolerance and MUMPS as here, and what costs a
    user nothing to save is saved: the constant mass matrix is assembled once, and bodies that do
    not touch are solved one by one, without the copies of a block matrix. All bodies of the scene
    need the same number of iterations, so that none waits for another in this package's system.

    Args:
        mesh: Its mesh.
        material: W(C).
        density: [kg/m^3].
        v: Velocity at the start [m/s], owned coordinates.
        dt: Step [s].
    """

    def __init__(self, mesh: Any, material: Any, density: float, v: FloatArray, dt: float) -> None:
        space = compat.vector_space(mesh, 1)
        self._u0, self._u1 = fem.Function(space), fem.Function(space)
        self.u, self.v, self._dt = np.zeros_like(v), v.copy(), dt
        dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 2})
        f0, f1 = (ufl.Identity(3) + ufl.grad(a) for a in (self._u0, self._u1))
        rho, factor = fem.Constant(mesh, float(density)), fem.Constant(mesh, 0.5 * dt**2)
        du, w = ufl.TrialFunction(space), ufl.TestFunction(space)
        stress = nts.EnergyMomentum().piola(material, f0, f1)
        work = ufl.inner(stress, ufl.grad(w)) * dx
        inertia = rho * ufl.inner(du, w) * dx
        tangent = factor * ufl.derivative(work, self._u1, du) + inertia
        self._work, self._tangent, mass = compat.compile_forms([work, tangent, inertia])
        self._mass, self._a = compat.create_matrix(mass), compat.create_matrix(self._tangent)
        compat.assemble_matrix(self._mass, mass, (), 0.0)
        self._force = compat.create_vector(space)
        self._x, self._f = self._a.createVecs()
        self._first, self._change = self._x.duplicate(), self._x.duplicate()
        self.snes = PETSc.SNES().create(mesh.comm)
        self.snes.setFunction(self._residual, self._f)
        self.snes.setJacobian(self._jacobian, self._a, self._a)
        self._options = SolverOptions(mesh.comm, "direct", False, _ORDERING)
        self._options.configure(self.snes, None, 1)

    def step(self) -> int:
        """Advance by dt; returns the Newton iterations."""
        self._u0.x.array[: len(self.u)] = self.u
        self._u0.x.scatter_forward()
        self._first.array_w[:] = self.u + self._dt * self.v
        self._change.array_w[:] = self._dt * self.v
        self._mass.mult(self._change, self._f)
        # In free motion the inertia is the largest of the forces that this package compares with.
        self.snes.setTolerances(rtol=1e-50, atol=RTOL * self._f.norm(), stol=0.0)
        self._first.copy(self._x)
        self.snes.solve(None, self._x)
        if self.snes.getConvergedReason() <= 0:
            raise RuntimeError(f"plain loop: SNES stopped with {self.snes.getConvergedReason()}")
        u1 = self._x.array_r
        self.v = 2.0 / self._dt * (u1 - self.u) - self.v
        self.u = u1.copy()
        return self.snes.getIterationNumber()

    def _fill(self, x: Any) -> None:
        self._u1.x.array[: len(self.u)] = x.array_r
        self._u1.x.scatter_forward()

    def _residual(self, _snes: Any, x: Any, f: Any) -> None:
        self._fill(x)
        compat.assemble_vector(self._force, self._work)
        self._change.waxpy(-1.0, self._first, x)
        self._mass.mult(self._change, f)
        f.axpy(0.5 * self._dt**2, self._force)

    def _jacobian(self, _snes: Any, x: Any, a: Any, _p: Any) -> None:
        self._fill(x)
        compat.assemble_matrix(a, self._tangent, (), 0.0)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        self._options.remove()
        vectors = (self._x, self._f, self._first, self._change, self._force)
        for a in (self.snes, self._a, self._mass, *vectors):
            a.destroy()


class Economy:
    """The scenes of the table.

    Args:
        comm: MPI communicator.
        cells: Cells n across the first cube.
        dt: Step [s].
    """

    def __init__(self, comm: Any, cells: int, dt: float = 5e-4) -> None:
        self.comm, self.cells, self.dt = comm, cells, dt
        self._bodies = {place: self._cubes(*numbers) for place, numbers in PLACES.items()}

    def _cubes(self, gap: float, speed: float, both: bool) -> tuple[list[nts.Continuum], Any]:
        """Two cubes and the surfaces between which there may be contact."""
        rubber, n = nts.NeoHookean(young=1e6, poisson=0.3), self.cells
        start = 1.0 + gap / n
        box = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
        left, right = (
            nts.Continuum(
                create_box(self.comm, [[x, 0, 0], [x + 1, 1, 1]], [count] * 3, **box),
                rubber, density=1e3, velocity=velocity, name=name,
            )
            for x, count, velocity, name in (
                (0.0, n, _spinning(speed), "left"),
                (start, n + 1, _spinning(0.0) if both else (0.0, 0.0, 0.0), "right"),
            )
        )  # fmt: skip
        slave = left.surface(lambda x: x[0] > 1 - 1e-9)
        return [left, right], (slave, right.surface(lambda x: x[0] < start + 1e-9))

    def system(self, feature: Feature) -> nts.System:
        """Scene of a row."""
        bodies, (slave, master) = self._bodies[feature.place]
        pair = nts.ContactPair(slave, master, friction=feature.friction)
        return nts.System(bodies, contacts=[pair] if feature.contact else [])

    def plain(self) -> list[PlainBody]:
        """The far cubes in the plain loop."""
        return [
            PlainBody(b.mesh, b.material, b.density, b.initial_velocity, self.dt)
            for b in self._bodies["far"][0]
        ]

    def run_plain(self, steps: int) -> tuple[FloatArray, float]:
        """Mean CPU and wall time of a step [s], and its Newton iterations."""
        bodies, watch, iterations = self.plain(), Stopwatch(self.comm), 0
        for k in range(_WARM + steps):
            if k == _WARM:
                watch.start()
            done = max([body.step() for body in bodies])
            iterations += done if k >= _WARM else 0
            watch.write()
        for body in bodies:
            body.destroy()
        return watch.laps[-steps:].mean(axis=0), iterations / steps

    def run(self, feature: Feature, steps: int, folder: str) -> tuple[FloatArray, float]:
        """As `run_plain`, with this package; `folder` is for its output."""
        watch = Stopwatch(self.comm)
        writers = [output.Fields(folder, every=feature.every)] if feature.every else []
        count = _WARM + steps + 1  # the last one, which is always written, is not timed
        with _ledger(feature.ledger), contextlib.redirect_stderr(io.StringIO()):
            run = nts.simulate(
                self.system(feature), nts.EnergyMomentum(), dt=self.dt, t_end=count * self.dt,
                newton=nts.Newton(rtol=RTOL), petsc_options=_ORDERING, output=[*writers, watch],
                progress=feature.progress, sleep=feature.sleep,
            )  # fmt: skip
        if run.status != "completed":
            raise RuntimeError(f"{feature.name}: {run.status}")
        timed = slice(_WARM, _WARM + steps)
        iterations = run.balance["newton_iterations"][1:][timed]
        return watch.laps[timed].mean(axis=0), float(iterations.mean())


def _spinning(speed: float) -> Any:
    """Velocity along x and a spin about x, which strains a body at rest otherwise."""
    return lambda x: np.array([speed + 0 * x[0], -_SPIN * (x[2] - 0.5), _SPIN * (x[1] - 0.5)])


@contextlib.contextmanager
def _ledger(on: bool) -> Iterator[None]:
    """Run without the ledger unless it is on; no option of the package leaves it out."""
    zero, three = 0.0, np.zeros(3)
    measured: dict[str, Any] = {"kinetic": zero, "potential": zero}
    measured |= {"linear_momentum": three, "angular_momentum": three}
    names = ("external_work", "friction_dissipation", "contact_defect", "active", "min_gap")
    instead = {
        "measure": lambda *_: measured,
        "step_terms": lambda *_: dict.fromkeys((*names, "stick", "slip"), zero),
        "switches": lambda *_: [],
    }
    kept = {name: getattr(balance, name) for name in instead}
    for name, function in ({} if on else instead).items():
        setattr(balance, name, function)
    try:
        yield
    finally:
        for name, function in kept.items():
            setattr(balance, name, function)


@known_options
def table(comm: Any, *, cells: int = 8, steps: int = 10, rounds: int = 9) -> list[dict[str, Any]]:
    """Rows of the cost table, the same on all ranks.

    All rows are run once in each round, and compared within it, as the machine may be shared.

    Args:
        comm: MPI communicator.
        cells: Cells across the first cube.
        steps: Steps that are timed.
        rounds: Repetitions of which the median counts.

    Raises:
        ValueError: A number is not positive.
    """
    for name, value in (("cells", cells), ("steps", steps), ("rounds", rounds)):
        require_positive(name, value, "-")
    scenes = Economy(comm, cells)
    seconds: dict[str, list[FloatArray]] = {PLAIN: []}
    seconds |= {f.name: [] for f in FEATURES}
    iterations: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        where = comm.bcast(folder)
        for k in range(rounds):
            for feature in (FEATURES, FEATURES[::-1])[k % 2]:
                mean, iterations[feature.name] = scenes.run(feature, steps, where)
                seconds[feature.name].append(mean)
            mean, iterations[PLAIN] = scenes.run_plain(steps)
            seconds[PLAIN].append(mean)
        comm.Barrier()
    against = {PLAIN: PLAIN} | {f.name: f.against for f in FEATURES}
    return [_row(name, base, seconds, iterations[name]) for name, base in against.items()]


def _row(
    name: str, base: str, seconds: Mapping[str, Sequence[FloatArray]], iterations: float
) -> dict[str, Any]:
    """Medians over the rounds: of times, and of ratios and differences within each.

    The fastest rounds are compared, too: other programs only ever make a run slower.
    """
    own, other, plain = (np.array(seconds[key]) for key in (name, base, PLAIN))
    middle = [1e3 * statistics.median(column) for column in own.T.tolist()]
    return {
        "row": name,
        "cpu [ms/step]": middle[0],
        "wall [ms/step]": middle[1],
        "iterations": iterations,
        "cpu / plain": float(np.median(own[:, 0] / plain[:, 0])),
        "fastest [ms/step]": float(1e3 * own[:, 0].min()),
        "fastest / plain": float(own[:, 0].min() / plain[:, 0].min()),
        "against": base,
        "cpu price [ms/step]": float(1e3 * np.median(own[:, 0] - other[:, 0])),
        "cpu ratio": float(np.median(own[:, 0] / other[:, 0])),
        "wall ratio": float(np.median(own[:, 1] / other[:, 1])),
    }


def write(rows: Sequence[Mapping[str, Any]], folder: Path, title: str) -> None:
    """Print the table and write it as CSV; on one rank."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "economy.csv").open("w", newline="", encoding="utf-8") as file:
        file.write(f"# {title}\n")
        lines = csv.DictWriter(file, list(rows[0]))
        lines.writeheader()
        lines.writerows(rows)
    print(
        f"{title}\n{'':24} {'cpu':>8} {'wall':>8} {'Newton':>7} {'/ plain':>8} "
        f"{'fastest':>8} {'/ plain':>8} {'price':>9}"
    )
    for r in rows:
        print(
            f"{r['row']:24} {r['cpu [ms/step]']:6.1f}ms {r['wall [ms/step]']:6.1f}ms "
            f"{r['iterations']:7.2f} {r['cpu / plain']:8.3f} "
            f"{r['fastest [ms/step]']:6.1f}ms {r['fastest / plain']:8.3f} "
            f"{r['cpu price [ms/step]']:+7.2f}ms = x {r['cpu ratio']:.3f} "
            f"(wall {r['wall ratio']:.3f}) of {r['against']!r}"
        )
