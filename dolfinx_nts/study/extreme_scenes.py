"""Scenes that `stability` carries to extremes: an impact of two cubes, rows of them, and others."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.types import FloatArray

#: Young's modulus [Pa], density [kg/m^3] and edge [m] of the cubes.
_YOUNG, _DENSITY, _EDGE = 1e6, 1e3, 1.0
#: How long the cubes touch, about: there and back of a wave [s].
CONTACT = 2.0 * _EDGE * math.sqrt(_DENSITY / _YOUNG)
_GRAVITY = 9.81
#: Speed [m/s] and step over the duration of contact of `strips`.
_GENTLE, _COARSE = 0.1, 0.1
#: Steps of `long_run`.
_LONG = 20_000


def _stiffening(c: Any) -> Any:
    """A W(C) of a user's own: exponential in the strain, compressible."""
    j2 = ufl.det(c)
    mu, lam = _YOUNG / 2.6, _YOUNG * 0.3 / (1.3 * 0.4)
    strain = ufl.tr(c) - 3.0 - ufl.ln(j2)
    return mu / 2.0 * (ufl.exp(5.0 * strain) - 1.0) / 5.0 + lam / 8.0 * ufl.ln(j2) ** 2


MATERIALS: Mapping[str, Any] = {
    "neo-Hookean": lambda young, nu: nts.NeoHookean(young, nu),
    "St. Venant-Kirchhoff": lambda young, nu: nts.StVenantKirchhoff(young, nu),
    "Mooney-Rivlin": lambda young, nu: nts.MooneyRivlin(young / 8, young / 24, young / 2),
    "own": lambda young, nu: _stiffening,
}


class Case(NamedTuple):
    """A scene to run, and what is known of it without a solver.

    Attributes:
        system: The scene.
        dt: Step [s].
        steps: Their number.
        free: Whether nothing from outside acts, so that momenta are kept.
        apart: Of a run, whether no body has passed through another at its end. Collective.
    """

    system: nts.System
    dt: float
    steps: int
    free: bool
    apart: Callable[[nts.Solution], bool]


def _in_order(run: nts.Solution) -> bool:
    """Return whether the bodies' centres stand along x in the order of the bodies."""
    centres = [nts.motion_of(body).centre[0] for body in run.system.bodies]
    return all(a < b for a, b in zip(centres, centres[1:], strict=False))


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A cube meets a wider one; all numbers of a usual impact unless an axis changes them.

    Attributes:
        dt: Step over the duration of contact.
        speed: Of the first cube [m/s].
        spin: Of the first cube [rad a step].
        stiffness: Young's modulus of the first over that of the second.
        density: Likewise.
        cells: Along an edge of the first cube and of the others, in turn.
        strip: Cells in the other two directions, where `cells` are along y only; 0: as along y.
        height: Of the second's cells over their length.
        poisson: Of all.
        material: Of all, a name in `MATERIALS`.
        friction: Coefficient.
        unit: Length [m] of what is an edge of 1 m else; speeds and moduli go with it.
        offset: Of all from the origin, in edges.
        gap: At the start in steps of flight; 0: touching.
        bodies: Number of cubes in a row; all but the first are at rest.
        place: Of the first cube's nodes on the second's facets: "across", or exactly on "nodes",
            on "edges", on "corners" of its outline.
        facets: Of the second cube: "even", "warped" (every other node is a fifth of a facet lower)
            or "slivers" (up to 300 times as long as wide).
        held: Slave nodes have prescribed positions.
    """

    dt: float = 0.03
    speed: float = 2.0
    spin: float = 1e-3
    stiffness: float = 1.0
    density: float = 1.0
    cells: tuple[int, int] = (3, 2)
    strip: int = 0
    height: float = 1.0
    poisson: float = 0.3
    material: str = "neo-Hookean"
    friction: float = 0.2
    unit: float = 1.0
    offset: float = 0.0
    gap: float = 3.5
    bodies: int = 2
    place: str = "across"
    facets: str = "even"
    held: bool = False

    def case(self, comm: MPI.Comm) -> Case:
        """The scene to run."""
        dt = self.dt * CONTACT
        edge, far = self.unit, self.offset * self.unit
        gap = self.gap * dt * self.speed * edge
        low = np.array([far, far, far])
        middle, omega = low[:, None] + 0.5 * edge, self.spin / dt
        # Moduli as the square of lengths keep all times as they are.
        young, law = _YOUNG * edge**2, MATERIALS[self.material]
        small = 1e-9 * edge * (1.0 + self.offset)

        def throw(x: FloatArray) -> FloatArray:
            arm, zero = x - middle, 0.0 * x[0]
            if self.held:
                return np.array([zero - self.speed * edge, zero, zero])
            return np.array([self.speed * edge + omega * arm[2], zero, -omega * arm[0]])

        bodies: list[nts.Continuum] = []
        for k in range(self.bodies):
            start, size = low.copy(), np.full(3, edge)
            if k % 2:
                start[1:], size[1:] = self._beside(edge)
                start[1:] += far
            start[0] += k * (edge + gap)
            number = self.cells[k % 2]
            mesh = create_box(
                comm, [start, start + size], [self.strip or number, number, self.strip or number],
                CellType.hexahedron, ghost_mode=GhostMode.shared_facet,
            )  # fmt: skip
            if k == 1:
                self._distort(mesh.geometry.x, start, size)
            ratio = self.stiffness if k == 0 else 1.0
            face = start[0] + edge - small
            held = [nts.Dirichlet(lambda x, face=face: x[0] > face)] if k == 0 and self.held else []
            bodies.append(nts.Continuum(
                mesh, law(young * ratio, self.poisson), bcs=held,
                density=_DENSITY * (self.density if k == 0 else 1.0),
                velocity=throw if k == int(self.held) else (0.0, 0.0, 0.0),
                name=("first", "second")[k] if k < 2 else f"body {k + 1}",
            ))  # fmt: skip
        pairs = []
        for k, (left, right) in enumerate(zip(bodies, bodies[1:], strict=False)):
            face = low[0] + k * (edge + gap) + edge
            to = face + gap + (0.25 * edge if self.facets == "warped" else small)
            pairs.append(nts.ContactPair(
                slave=left.surface(lambda x, face=face: x[0] > face - small),
                master=right.surface(lambda x, to=to: x[0] < to),
                friction=self.friction,
            ))  # fmt: skip
        touches = self.bodies - 1
        steps = max(10, min(300, math.ceil(touches * (self.gap + 2.0 / self.dt))))
        return Case(nts.System(bodies, contacts=pairs), dt, steps, not self.held, _in_order)

    def _beside(self, edge: float) -> tuple[FloatArray, FloatArray]:
        """Start and size of the second cube along y and z [m]."""
        wide = 1.2 * edge
        if self.place == "across":
            tall = wide * self.height
            return np.array([-0.09 * edge, -0.08 * tall]), np.array([wide, tall])
        part = {"nodes": 0.0, "edges": 0.5, "corners": 1.0}[self.place] / self.cells[1]
        return np.array([part * edge, 0.0 if part < 0.4 else part * edge]), np.full(2, edge)

    def _distort(self, x: FloatArray, start: FloatArray, size: FloatArray) -> None:
        """Move the nodes of the second cube's mesh as `facets` says; in place."""
        relative = (x - start) / size
        if self.facets == "slivers":
            # Widths from 1 to 1/300 of an even cell.
            power = 1.0 + math.log(300.0) / math.log(self.cells[1])
            x[:, 1] = start[1] + size[1] * relative[:, 1] ** power
        elif self.facets == "warped":
            number = np.rint(relative * self.cells[1]).astype(int)
            odd = (number[:, 0] == 0) & ((number[:, 1] + number[:, 2]) % 2 == 1)
            x[odd, 0] += 0.2 * size[0] / self.cells[1]


def strips(comm: MPI.Comm, cells: tuple[int, int]) -> Case:
    """Surfaces of very different meshes, at a speed that forces on single nodes allow.

    Args:
        comm: MPI communicator.
        cells: Along y of both bodies; two in the other directions.
    """
    return Scene(cells=cells, strip=2, speed=_GENTLE, dt=_COARSE).case(comm)


def closing(comm: MPI.Comm, dt: float) -> Case:
    """An open ring whose ends meet: both surfaces belong to one body.

    Args:
        comm: MPI communicator.
        dt: Step over the duration of contact.
    """
    mesh = create_box(
        comm, [np.zeros(3), np.ones(3)], [16, 1, 2], CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    x, wide = mesh.geometry.x, math.radians(168.0)
    angle, radius = (2.0 * x[:, 0] - 1.0) * wide, 1.0 + 0.3 * x[:, 2]
    x[:, 0], x[:, 2] = radius * np.cos(angle), radius * np.sin(angle)

    def close(x: FloatArray) -> FloatArray:
        part = 0.5 * (1.0 - x[0] / np.hypot(x[0], x[2]))
        # It flies and spins, so that momenta have a size.
        return np.array([2.0 - x[1], 1.0 + x[0], -3.0 * np.sign(x[2]) * part**2])

    body = nts.Continuum(
        mesh, nts.NeoHookean(_YOUNG, 0.3), density=_DENSITY, velocity=close, name="ring"
    )
    low = math.tan(math.pi - wide)

    def end(x: FloatArray, side: float) -> Any:
        return (x[0] < 0.0) & (np.abs(side * x[2] + x[0] * low) < 1e-6)

    upper, lower = (body.surface(lambda x, s=s: end(x, s)) for s in (1.0, -1.0))
    pair = nts.ContactPair(slave=upper, master=lower, friction=0.2)

    def apart(run: nts.Solution) -> bool:
        assert run.state is not None
        heights = [s.positions(run.state.u[0])[:, 2] for s in (upper, lower)]
        sums = comm.allreduce(np.array([[h.sum(), len(h)] for h in heights]))
        return bool(sums[0, 0] / sums[0, 1] > sums[1, 0] / sums[1, 1])

    step = dt * CONTACT
    return Case(nts.System([body], contacts=[pair]), step, math.ceil(6.0 / dt), True, apart)


def _shaking(time: float) -> tuple[float, float, float]:
    return 0.05 * math.sin(7.0 * time), 0.0, 0.0


def long_run(comm: MPI.Comm, kind: str) -> Case:
    """20,000 steps of a cube of one cell on a plane.

    Args:
        comm: MPI communicator.
        kind: "bouncing", or "rubbing" on a plane that shakes sideways.
    """
    bounces = kind == "bouncing"
    gap, friction, motion = (0.2, 0.1, None) if bounces else (0.0, 0.3, _shaking)
    mesh = create_box(
        comm, [np.array([0.0, 0.0, gap]), np.array([1.0, 1.0, 1.0 + gap])], [1, 1, 1],
        CellType.hexahedron, ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    body = nts.Continuum(mesh, nts.NeoHookean(_YOUNG, 0.3), density=_DENSITY, name="cube")
    pair = nts.ContactPair(
        slave=body.surface(lambda x: x[2] < gap + 1e-9),
        master=nts.Plane((0, 0, 0), (0, 0, 1), motion=motion), friction=friction,
    )  # fmt: skip
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -_GRAVITY))

    def apart(run: nts.Solution) -> bool:
        return bool(nts.motion_of(run.system.bodies[0]).centre[2] > 0.3)

    return Case(system, 0.05 * CONTACT, _LONG, False, apart)
