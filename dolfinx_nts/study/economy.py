"""What each feature of a scene costs per step, measured in one run beside a plain DOLFINx loop.

    python -m dolfinx_nts.study.tradeoff economy [--set cells=8 steps=10 rounds=9]

Two cubes of n^3 and (n + 1)^3 hexahedra that spin, so that both deform, without contact, far apart,
near each other and touching. Each row adds a feature to the row it is compared with.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import io
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, GhostMode, Mesh, create_box
from petsc4py import PETSc

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import output, petsc_compat
from dolfinx_nts.forms import CellForm, assemble_vector
from dolfinx_nts.kernels.strain_energy import strain_energy
from dolfinx_nts.solve.linear_solver import SolverOptions
from dolfinx_nts.types import BalanceRow, FloatArray, Rows
from dolfinx_nts.validation import known_options, require_positive

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
        against: BalanceRow it is compared with.
        place: Of the cubes, one of `PLACES`.
        contact: Whether a contact is declared.
        friction: Coulomb's coefficient [-].
        sleep: Whether the second cube may sleep.
        ledger: Whether energies, momenta and works are computed.
        every: Cadence of a `Fields` writer, 0 for none.
        progress: Whether there is a progress line.
        watch: Whether bodies inside each other are looked for.
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
    watch: bool = True


PLAIN = "plain DOLFINx + SNES"
_BARE = "no contact, no ledger"
_NONE = "contact not declared"
_BLIND = "active, not watched"
FEATURES = (
    Feature(name=_BARE, against=PLAIN, ledger=False),
    Feature(name=_NONE, against=_BARE),
    Feature(name="declared, far", against=_NONE, contact=True),
    Feature(name="candidates, inactive", against=_NONE, contact=True, place="near"),
    Feature(name=_BLIND, against=_NONE, contact=True, place="touching", watch=False),
    Feature(name="active", against=_BLIND, contact=True, place="touching"),
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


class Turn:
    """A run in a thread that makes a step when it is told to; as a writer, it ends each step.

    What else the machine does falls on all runs alike if their steps take turns. One thread only
    ever runs.

    Args:
        run: Is called with this, and calls `start` before its first step, `write` after each.

    Attributes:
        laps: CPU and wall time of each step [s].
    """

    def __init__(self, run: Callable[[Turn], float]) -> None:
        self._go, self._rest = threading.Semaphore(0), threading.Semaphore(0)
        self._error: BaseException | None = None
        self.laps: list[FloatArray] = []
        self.iterations = 0.0
        self._thread = threading.Thread(target=self._whole, args=(run,), daemon=True)
        self._thread.start()

    def _whole(self, run: Callable[[Turn], float]) -> None:
        self._go.acquire()
        try:
            self.iterations = run(self)
        except BaseException as error:  # for the thread that takes turns
            self._error = error
        self._rest.release()

    def take(self) -> None:
        """Let the run go on to the end of its next step; raises what it raises."""
        self._go.release()
        self._rest.acquire()
        if self._error is not None:
            raise self._error

    def _pause(self) -> None:
        self._rest.release()
        self._go.acquire()
        self._begin = self._now()

    @staticmethod
    def _now() -> FloatArray:
        return np.array([time.process_time(), time.perf_counter()])

    def start(self, stepper: nts.Stepper | None = None) -> None:
        """Wait for the first step's turn."""
        self._pause()

    def write(self, stepper: nts.Stepper | None = None, *, last: bool = False) -> None:
        """Take the time of a step, and wait for the next one's turn."""
        self.laps.append(self._now() - self._begin)
        self._pause()

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

    def __init__(self, mesh: Mesh, material: Any, density: float, v: FloatArray, dt: float) -> None:
        space = compat.vector_space(mesh, 1)
        self._u0, self._u1 = fem.Function(space), fem.Function(space)
        self.u, self.v, self._dt = np.zeros_like(v), v.copy(), dt
        dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 2})
        h0, h1 = ufl.grad(self._u0), ufl.grad(self._u1)
        rho, factor = fem.Constant(mesh, float(density)), fem.Constant(mesh, 0.5 * dt**2)
        du, w = ufl.TrialFunction(space), ufl.TestFunction(space)
        stress = nts.EnergyMomentum().piola(strain_energy(material), h0, h1)
        work = ufl.inner(stress, ufl.grad(w)) * dx
        inertia = rho * ufl.inner(du, w) * dx
        tangent = factor * ufl.derivative(work, self._u1, du) + inertia
        forms = list(compat.compile_forms([work, tangent, inertia]))
        # As a plain loop has it: DOLFINx evaluates it.
        self._work = CellForm(*forms[0], None)
        self._tangent, mass = (form for form, _ in forms[1:])
        self._mass = petsc_compat.create_matrix(mass)
        self._a = petsc_compat.create_matrix(self._tangent)
        petsc_compat.assemble_matrix(self._mass, mass, (), 0.0)
        self._force = petsc_compat.create_vector(space)
        self._x, self._f = self._a.createVecs()
        self._first, self._change = self._x.duplicate(), self._x.duplicate()
        self.snes = PETSc.SNES().create(self._a.comm)
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
        assemble_vector(self._force, self._work)
        self._change.waxpy(-1.0, self._first, x)
        self._mass.mult(self._change, f)
        f.axpy(0.5 * self._dt**2, self._force)

    def _jacobian(self, _snes: Any, x: Any, a: Any, _p: Any) -> None:
        self._fill(x)
        petsc_compat.assemble_matrix(a, self._tangent, (), 0.0)

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

    def __init__(self, comm: MPI.Comm, cells: int, dt: float = 5e-4) -> None:
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

    def run_plain(self, count: int, turn: Turn) -> float:
        """Make the steps of the plain loop; returns the Newton iterations of a timed one."""
        bodies = self.plain()
        turn.start()
        iterations = []
        for _ in range(count):
            iterations.append(max([body.step() for body in bodies]))
            turn.write()
        for body in bodies:
            body.destroy()
        return float(np.mean(iterations[_WARM:-1]))

    def run(self, feature: Feature, count: int, folder: str, turn: Turn) -> float:
        """Do as `run_plain`, with this package; `folder` is for its output."""
        where = Path(folder) / feature.name
        writers = [output.Fields(where, every=feature.every)] if feature.every else []
        run = nts.simulate(
            self.system(feature), nts.EnergyMomentum(), dt=self.dt, t_end=count * self.dt,
            newton=nts.Newton(rtol=RTOL), petsc_options=_ORDERING, output=[*writers, turn],
            progress=feature.progress, sleep=feature.sleep, ledger=feature.ledger,
            watch_overlap=feature.watch,
        )  # fmt: skip
        if run.status != "completed":
            raise RuntimeError(f"{feature.name}: {run.status}")
        return float(run.balance["newton_iterations"][1 + _WARM : -1].mean())

    def round(self, steps: int, folder: str, order: Any) -> dict[str, tuple[FloatArray, float]]:
        """Return CPU and wall time of each row's steps [s], (steps, 2), and a step's iterations.

        Args:
            steps: Steps that are timed.
            folder: For output.
            order: Random numbers, the same on all ranks: whose turn is next.
        """
        count = _WARM + steps + 1  # the last one, which is always written, is not timed
        turns = {PLAIN: Turn(functools.partial(self.run_plain, count))}
        turns |= {f.name: Turn(functools.partial(self.run, f, count, folder)) for f in FEATURES}
        names = list(turns)
        with contextlib.redirect_stderr(io.StringIO()):
            for _ in range(count + 2):  # set-up, steps, end
                for k in order.permutation(len(names)):
                    turns[names[k]].take()
        result = {}
        for name, turn in turns.items():
            laps = np.array(turn.laps[_WARM : _WARM + steps])
            self.comm.Allreduce(MPI.IN_PLACE, laps, op=MPI.MAX)
            result[name] = laps, turn.iterations
        return result


def _spinning(speed: float) -> Any:
    """Velocity along x and a spin about x, which strains a body at rest otherwise."""
    return lambda x: np.array([speed + 0 * x[0], -_SPIN * (x[2] - 0.5), _SPIN * (x[1] - 0.5)])


@known_options
def table(
    comm: MPI.Comm, *, cells: int = 8, steps: int = 10, rounds: int = 9
) -> Rows:
    """Rows of the cost table, the same on all ranks.

    All rows are run once in each round, step by step in turn, and compared within it, as the
    machine may be shared.

    Args:
        comm: MPI communicator.
        cells: Cells across the first cube.
        steps: Steps that are timed.
        rounds: Repetitions, of which the median and the fastest count.

    Raises:
        ValueError: A number is not positive.
    """
    for name, value in (("cells", cells), ("steps", steps), ("rounds", rounds)):
        require_positive(name, value, "-")
    scenes = Economy(comm, cells)
    seconds: dict[str, list[FloatArray]] = {PLAIN: []}
    seconds |= {f.name: [] for f in FEATURES}
    iterations: dict[str, float] = {}
    order = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        where = comm.bcast(folder)
        for _ in range(rounds):
            for name, (laps, needed) in scenes.round(steps, where, order).items():
                seconds[name].append(laps)
                iterations[name] = needed
        comm.Barrier()
    against = {PLAIN: PLAIN} | {f.name: f.against for f in FEATURES}
    return [_row(name, base, seconds, iterations[name]) for name, base in against.items()]


def _row(
    name: str, base: str, seconds: Mapping[str, Sequence[FloatArray]], iterations: float
) -> dict[str, Any]:
    """Row of the table: the median time over the rounds, averaged over the steps; so the fastest.

    The fastest counts, too, as other programs only ever make a step slower. Ratios and differences
    are medians over steps of the same turn.
    """
    own, other, plain = (np.array(seconds[key]) for key in (name, base, PLAIN))
    middle = 1e3 * np.median(own, axis=0).mean(axis=0)
    fastest, least = (1e3 * a[..., 0].min(axis=0).mean() for a in (own, plain))
    ratio = np.median(own / other, axis=(0, 1))
    return {
        "row": name,
        "cpu [ms/step]": float(middle[0]),
        "wall [ms/step]": float(middle[1]),
        "iterations": iterations,
        "cpu / plain": float(np.median(own[..., 0] / plain[..., 0])),
        "fastest [ms/step]": float(fastest),
        "fastest / plain": float(fastest / least),
        "against": base,
        "cpu price [ms/step]": float(1e3 * np.median(own[..., 0] - other[..., 0])),
        "cpu ratio": float(ratio[0]),
        "wall ratio": float(ratio[1]),
    }


def write(rows: Sequence[BalanceRow], folder: Path, title: str) -> None:
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
