"""What an impact costs: the choices for impacts on problems with known answers, side by side.

    python -m dolfinx_nts.study.impacts [--only B2 B11] [--ways published redistributed]

Each problem is run with each way to treat an impact. What a way refuses is a row with the reason.

    lost        energy that neither work nor friction accounts for, over the largest there was
    deviation   rms of the contact force less the exact one, where known, over the largest
    rough       sum of the force's second differences over that of the force
    changes     nodes that come into contact or leave it, all told
    rebound     of the first body, or against the second, over its speed before
    largest     contact force [N]
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.study.scene_runs import load
from dolfinx_nts.types import BalanceRow, FloatArray, Rows

#: Way to treat impacts -> mass of slave nodes and options of `simulate`.
WAYS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "published": ("consistent", {}),
    "restored": ("consistent", {"impact": "restored"}),
    "plastic": ("consistent", {"impact": "restored", "restitution": 0.0}),
    "redistributed": ("redistributed", {}),
    "touch met": ("consistent", {"adapt": nts.Adapt(tolerance=1e-3)}),
    "redistributed, touch met": ("redistributed", {"adapt": nts.Adapt(tolerance=1e-3)}),
}
#: Steps next to the ends of a contact in which its exact force jumps.
_FRONT = 2.5
#: Part of a step after which the gap of `B6` closes.
_THETA = 0.25


class Problem(NamedTuple):
    """An impact.

    Attributes:
        system: The scene.
        dt: Step [s].
        t_end: End of the run [s].
        force: Exact contact force at times (n,) [N], 0 where there is none; None: not known.
        smooth: Whether that force has no jumps.
        parts: How many such bodies make the whole one.
        accuracy: As of `simulate`.
    """

    system: nts.System
    dt: float
    t_end: float
    force: Callable[[FloatArray], FloatArray] | None = None
    smooth: bool = False
    parts: int = 1
    accuracy: str = "exact"


def two_blocks(comm: MPI.Comm, mass: str) -> Problem:
    """B1: oblique impact of two cubes."""
    return Problem(load("two_blocks").scene(comm, mass=mass), 2e-3, 0.2)


def bar(comm: MPI.Comm, mass: str, *, gravity: bool = False, elements: int = 50) -> Problem:
    """B2, B3: an elastic bar is thrown or dropped onto a wall, Courant number 1."""
    demo = load("bar_impact")

    def force(t: FloatArray) -> FloatArray:
        return demo.AREA * demo.exact(t, gravity)[1]

    system = demo.scene(comm, elements, gravity, mass)
    return Problem(
        system, demo.LENGTH / elements / demo.WAVE, 16 / 3 if gravity else 1.5, force
    )


def block(comm: MPI.Comm, mass: str) -> Problem:
    """B6: a rigid block meets a plane, whose gap closes in a quarter of a step."""
    speed, dt = 2.0, 1e-3
    low = (3 + _THETA) * speed * dt
    mesh = create_box(comm, [[0, 0, low], [1, 1, 1 + low]], [1, 1, 1], CellType.hexahedron)
    body = nts.RigidBody(mesh, density=1e3, velocity=(0, 0, -speed), name="block")
    slave = body.surface(lambda x: x[2] < low + 1e-9, **_of(mass))
    pair = nts.ContactPair(slave=slave, master=nts.Plane((0, 0, 0), (0, 0, 1)))
    return Problem(nts.System([body], contacts=[pair]), dt, 10 * dt)


def _of(mass: str) -> dict[str, Any]:
    return {} if mass == "consistent" else {"mass": mass}


@dataclass(frozen=True)
class Hertz:
    """Impact of an elastic sphere on a rigid plane, quasi-static within the sphere.

    Attributes:
        young: [Pa].
        poisson: [-].
        radius: [m].
        density: [kg/m^3].
        speed: [m/s].
    """

    young: float = 1e4
    poisson: float = 0.3
    radius: float = 1.0
    density: float = 1.0
    speed: float = 0.1

    @property
    def mass(self) -> float:
        """[kg]."""
        return 4.0 / 3.0 * np.pi * self.density * self.radius**3

    @property
    def _stiffness(self) -> float:
        return 4.0 / 3.0 * self.young / (1.0 - self.poisson**2) * self.radius**0.5

    @property
    def approach(self) -> float:
        """Largest, of the centre [m]."""
        return float((1.25 * self.mass * self.speed**2 / self._stiffness) ** 0.4)

    @property
    def force(self) -> float:
        """Largest [N]."""
        return self._stiffness * self.approach**1.5

    def over_time(self, steps: int = 2000) -> tuple[FloatArray, FloatArray]:
        """Times from touch to separation [s] and forces [N], shape (2 steps + 1,) each."""
        # d = D sin(a)^(4/5), at which the speed is v cos(a): smooth in a up to the ends.
        a = np.linspace(0.0, np.pi / 2, steps + 1)
        middle = 0.5 * (a[1:] + a[:-1])
        rate = 0.8 * self.approach / self.speed * np.sin(middle) ** -0.2
        t = np.append(0.0, np.cumsum(rate * np.diff(a)))
        force = self.force * np.sin(a) ** 1.2
        return np.append(t, 2 * t[-1] - t[-2::-1]), np.append(force, force[-2::-1])


def ball_mesh(comm: MPI.Comm, cells: int, grading: float = 4.0) -> Any:
    """A quarter of the unit ball whose cells are small at the south pole.

    Args:
        comm: MPI communicator.
        cells: Hexahedra from the axis to the equator.
        grading: Of the cells' sizes along an edge; the larger, the smaller those at the pole.
    """
    mesh = create_box(
        comm, [[0, 0, 0], [1, 1, 1]], [cells, cells, 2 * cells], CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    x = mesh.geometry.x
    x[:] = np.sinh(grading * x) / np.sinh(grading)
    x[:, 2] = 2.0 * x[:, 2] - 1.0
    far, length = np.abs(x).max(axis=1), np.linalg.norm(x, axis=1)
    # Spherical outside, nearly a cube inside, where spheres would leave no room for a grid.
    x *= (0.8 * (1 - far) + far * far / np.where(length > 0, length, 1.0))[:, None]
    return mesh


def sphere(comm: MPI.Comm, mass: str, *, cells: int = 8, steps: int = 60) -> Problem:
    """B11: Hertz's impact; the gap closes after two and a half steps."""
    exact = Hertz()
    mesh, (times, forces) = ball_mesh(comm, cells), exact.over_time()
    dt = times[-1] / steps
    gap = 2.5 * dt * exact.speed
    volume = nts.RigidBody(mesh, density=1.0).mass
    across = [
        nts.Dirichlet(lambda x, i=i: np.abs(x[i]) < 1e-9, components=(i,)) for i in range(2)
    ]
    body = nts.Continuum(
        mesh, nts.NeoHookean(exact.young, exact.poisson), density=exact.mass / 4 / volume,
        velocity=(0, 0, -exact.speed), bcs=across, name="sphere",
    )  # fmt: skip
    reach = 3.0 * (exact.approach * exact.radius) ** 0.5
    slave = body.surface(
        lambda x: (np.linalg.norm(x, axis=0) > 1.0 - 1e-6) & (np.hypot(x[0], x[1]) < reach)
        & (x[2] < 0.0),
        mass=mass,
    )  # fmt: skip
    pair = nts.ContactPair(slave=slave, master=nts.Plane((0, 0, -1.0 - gap), (0, 0, 1)))

    def force(t: FloatArray) -> FloatArray:
        return np.interp(t - gap / exact.speed, times, forces, left=0.0, right=0.0)

    end = gap / exact.speed + 1.15 * times[-1]
    return Problem(nts.System([body], contacts=[pair]), dt, end, force, True, 4, "balanced")


def two_tori(comm: MPI.Comm, mass: str) -> Problem:
    """B13: hollow tori collide."""
    system = load("two_tori").scene(comm, mass=mass)
    return Problem(system, 0.1, 8.0, accuracy="balanced")


PROBLEMS: Mapping[str, Callable[[Any, str], Problem]] = {
    "B1": two_blocks,
    "B2": bar,
    "B3": lambda comm, mass: bar(comm, mass, gravity=True),
    "B6": block,
    "B11": sphere,
    "two_tori": two_tori,
}


class Recorder:
    """Writer: time, contact force, nodes that changed, and how fast bodies approach.

    Attributes:
        rows: Of each accepted step time [s], force of all nodes [N], changes of status in it.
    """

    def start(self, stepper: nts.Stepper) -> None:
        """Begin anew."""
        self.rows: list[tuple[float, float, int]] = []
        self._on: list[Any] = []
        self.before = self._approach(stepper)

    def write(self, stepper: nts.Stepper, *, last: bool = False) -> None:
        """Add an accepted state."""
        if self.rows and stepper.state.time == self.rows[-1][0]:
            return
        forces = [contact.force for contact in stepper.state.contacts]
        on = [force > 0.0 for force in forces]
        old = self._on or [np.zeros_like(a) for a in on]
        changes = sum(int((a != b).sum()) for a, b in zip(on, old, strict=True))
        local = np.array([sum(float(force.sum()) for force in forces), changes])
        force, changed = stepper.system.comm.allreduce(local)
        self._on = on
        self.rows.append((stepper.state.time, float(force), int(changed)))

    def close(self, stepper: nts.Stepper) -> None:
        """Note how bodies part."""
        self.after = self._approach(stepper)

    def _approach(self, stepper: nts.Stepper) -> FloatArray:
        """Velocity of the first body, against the second if there is one [m/s]."""
        v = [nts.motion_of(body).velocity for body in stepper.system.bodies]
        return v[0] - v[1] if len(v) > 1 else v[0]


def measure(problem: str, way: str, comm: MPI.Comm) -> dict[str, Any]:
    """A row of the table. Collective."""
    row: dict[str, Any] = {"problem": problem, "way": way}
    mass, options = WAYS[way]
    recorder, begin = Recorder(), time.process_time()
    try:
        made = PROBLEMS[problem](comm, mass)
        begin = time.process_time()
        run = nts.simulate(
            made.system, nts.EnergyMomentum(), dt=made.dt, t_end=made.t_end, output=[recorder],
            accuracy=made.accuracy, **options,
        )  # fmt: skip
    except ValueError as error:
        return row | {"status": f"refused: {error}"}
    cpu = comm.allreduce(time.process_time() - begin, op=MPI.MAX)
    return row | figures(run, recorder, made) | {"cpu": cpu, "status": run.status}


def figures(run: nts.Solution, seen: Recorder, made: Problem) -> dict[str, float]:
    """Return what a run kept and lost."""
    b = run.balance
    size = max(float(np.abs(b[name]).max()) for name in ("kinetic", "potential"))
    kept = b["energy"] - b["energy"][0] - b["external_work"] + b["friction_dissipation"]
    t, force, changes = np.array(seen.rows).T
    force *= made.parts
    speed = float(seen.before @ seen.before)
    found = {
        "lost": -float(kept[-1]) / size,
        "rough": float(np.abs(np.diff(force, 2)).sum() / force.sum()),
        "changes": float(changes.sum()),
        "largest": float(force.max()),
        "steps": float(len(t)),
        "iterations": float(b["newton_iterations"][1:].sum()),
    }
    if speed > 0.0:
        found["rebound"] = -float(seen.after @ seen.before) / speed
    if made.force is not None:
        found["deviation"] = _deviation(t, force, made)
    return found


def _deviation(t: FloatArray, force: FloatArray, made: Problem) -> float:
    """Rms of the force of a step less the exact one over the largest, away from jumps."""
    assert made.force is not None
    middle = t - 0.5 * np.diff(t, prepend=0.0)
    exact, near = made.force(middle), (-_FRONT * made.dt, _FRONT * made.dt)
    inside = exact > 0.0
    if not made.smooth:
        inside &= np.all([made.force(middle + way) > 0.0 for way in near], axis=0)
    weight = np.diff(t, prepend=0.0)[inside]
    square = weight @ (force[inside] - exact[inside]) ** 2 / weight.sum()
    return float(np.sqrt(square) / exact.max())


COLUMNS = (
    "lost", "deviation", "rough", "changes", "rebound", "largest", "steps", "iterations", "cpu",
)  # fmt: skip


def table(only: Sequence[str] = (), ways: Sequence[str] = (), comm: MPI.Comm = MPI.COMM_WORLD) -> (
    Rows
):  # fmt: skip
    """Rows of all runs.

    Args:
        only: Names in `PROBLEMS`; all if empty.
        ways: Names in `WAYS`; all if empty.
        comm: MPI communicator.

    Raises:
        ValueError: No such problem or way; before any run.
    """
    for what, names, known in (("problem", only, PROBLEMS), ("way", ways, WAYS)):
        for name in names:
            if name not in known:
                raise ValueError(f"{what} {name!r}: choose among {', '.join(known)}")
    rows = []
    for problem in only or PROBLEMS:
        for way in ways or WAYS:
            rows.append(measure(problem, way, comm))
            if comm.rank == 0:
                print(line(rows[-1]), flush=True)
    return rows


def line(row: BalanceRow) -> str:
    """A row of the table as text."""
    cells = [f"{row[name]:.3g}" if name in row else "" for name in COLUMNS]
    return f"| {row['problem']} | {row['way']} | {' | '.join(cells)} | {row['status'][:200]} |"


def main(arguments: Sequence[str] | None = None) -> Rows:
    """Run the program; returns the rows of its table."""
    parser = argparse.ArgumentParser(
        prog="python -m dolfinx_nts.study.impacts", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--only", nargs="+", default=[], help=f"among {', '.join(PROBLEMS)}")
    parser.add_argument("--ways", nargs="+", default=[], help=f"among {'; '.join(WAYS)}")
    parser.add_argument("--output", default="out/impacts", help="folder for the table")
    options = parser.parse_args(arguments)
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        print(f"| problem | way | {' | '.join(COLUMNS)} | status |", flush=True)
    rows = table(options.only, options.ways, comm)
    if comm.rank == 0:
        folder = Path(options.output)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "impacts.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, ["problem", "way", *COLUMNS, "status"])
            writer.writeheader()
            writer.writerows(rows)
    return rows


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"impacts: {error}" if MPI.COMM_WORLD.rank == 0 else 2)
