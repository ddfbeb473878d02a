"""Loads on beams and shells: forces and moments on nodes, pressures on cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from mpi4py import MPI

import numpy as np

from dolfinx_nts.bodies.conditions import VectorInTime
from dolfinx_nts.bodies.loads import Pressure, load_at
from dolfinx_nts.bodies.slender.director_elements import DirectorElements
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh
from dolfinx_nts.bodies.slender.node_conditions import nodes_where
from dolfinx_nts.bodies.slender.node_moments import NodeMoments
from dolfinx_nts.bodies.slender.pressure import Pressures
from dolfinx_nts.types import FloatArray, Marker
from dolfinx_nts.validation import items, known_options


class Load:
    """Dead load at nodes.

    Attributes:
        where: Function x (3, n) -> bool (n,).
        value: A vector, or a function of time.
        unit: Of the value.
        per_length: Whether it acts along edges between nodes; else on one node.
        turns: Whether it is a moment.
    """

    where: Marker
    value: VectorInTime
    unit: ClassVar[str]
    per_length: ClassVar[bool]
    turns: ClassVar[bool]


@known_options
@dataclass(frozen=True)
class PointForce(Load):
    """Dead force on a node of a beam or shell.

    Attributes:
        where: Function x (3, n) -> bool (n,) that is true at one node.
        value: [N]: a vector, or a function of time.
    """

    where: Marker
    value: VectorInTime
    unit, per_length, turns = "N", False, False


@known_options
@dataclass(frozen=True)
class PointMoment(Load):
    """Dead moment on a node of a beam or shell; shells do not feel what is along their director.

    Attributes:
        where: Function x (3, n) -> bool (n,) that is true at one node.
        value: [N m]: a vector, or a function of time.
    """

    where: Marker
    value: VectorInTime
    unit, per_length, turns = "N m", False, True


@known_options
@dataclass(frozen=True)
class LineForce(Load):
    """Dead force per length of a beam's reference, or of the edge of a shell's.

    Attributes:
        value: [N/m]: a vector, or a function of time.
        where: Function x (3, n) -> bool (n,): it acts between neighbours for which it is true;
            None: everywhere, of a shell on its whole edge.
    """

    value: VectorInTime
    where: Marker = None
    unit, per_length, turns = "N/m", True, False


@known_options
@dataclass(frozen=True)
class LineMoment(Load):
    """Dead moment per length of a beam's reference, or of the edge of a shell's.

    Attributes:
        value: [N m/m]: a vector, or a function of time.
        where: As of `LineForce`.
    """

    value: VectorInTime
    where: Marker = None
    unit, per_length, turns = "N m/m", True, True


class DirectorLoads:
    """What loads a body with directors; `begin` fixes the step. Collective.

    Args:
        comm: MPI communicator.
        director_mesh: Its nodes.
        elements: Those of this rank.
        length: Of the directors [m].
        forces: As of the body.
        kind: Of the body, for messages.
        name: Of the body.

    Attributes:
        settings: Values of all loads.
        moments: Those on nodes.
    """

    def __init__(
        self, comm: MPI.Comm, director_mesh: DirectorMesh, elements: DirectorElements,
        length: float, forces: Sequence[Load | Pressure], kind: str, name: str,
    ) -> None:  # fmt: skip
        shell = kind == "shell"
        forces = items(
            "forces", forces, lambda f: isinstance(f, Load | Pressure if shell else Load),
            f"{'Pressure, ' * shell}PointForce, PointMoment, LineForce or LineMoment",
        )  # fmt: skip
        self._comm, self._mesh, self._elements, self._name = comm, director_mesh, elements, name
        self._here, values = elements.values.here, elements.values
        self.settings = [load.value for load in forces]
        self._on_nodes = [
            self._load(k, load) for k, load in enumerate(forces) if isinstance(load, Load)
        ]
        turning = [weights != 0.0 for load, weights, _ in self._on_nodes if load.turns]
        turned = np.flatnonzero(np.any(turning, axis=0) if turning else [])
        self._width = 3 * (1 + director_mesh.directors.shape[1])
        self.moments = NodeMoments(turned, self._width, length)
        pressures = {k: load for k, load in enumerate(forces) if isinstance(load, Pressure)}
        self._pressures = Pressures(comm, director_mesh, values.cells, pressures, name)
        self.begin(0.0, 1.0)

    def _load(self, k: int, load: Load) -> tuple[Load, FloatArray, str]:
        """A load, what of it acts on this rank's nodes, and its name. Collective."""
        kind = type(load).__name__
        what = f"{kind}.where of forces[{k}] of {self._name!r}"
        x, edges = self._mesh.x, self._mesh.edges
        chosen = np.ones(len(x), dtype=bool)
        if load.where is not None or not load.per_length:
            chosen = nodes_where(self._comm, self._mesh, what, load.where)
        weights = chosen.astype(float)
        if load.per_length:
            along = chosen[edges].all(axis=1)
            if not along.any():
                raise ValueError(
                    f"{what}={load.where!r}: selects no two neighbours; select both ends of the "
                    "elements it acts on"
                )
            borne = self._mesh.lengths[along].ravel()
            weights = np.bincount(edges[along].ravel(), borne, len(x))
        elif chosen.sum() != 1:
            raise ValueError(f"{what}: selects {chosen.sum()} nodes; select one")
        return load, weights[self._here], f"{kind}.value of forces[{k}] of {self._name!r}"

    def begin(self, time: float, ramp: float) -> None:
        """Set the loads of a step. Collective.

        Args:
            time: [s].
            ramp: Part of constant loads that acts.
        """
        both = np.zeros((2, self._here.stop - self._here.start, 3))
        for load, weights, what in self._on_nodes:
            value = load_at(self._comm, what, load.value, load.unit, time, ramp)
            both[int(load.turns)] += weights[:, None] * value
        self._force = both[0]
        self.moments.begin(both[1][self.moments.turned])
        self._pressures.begin(time, ramp)

    def add_to(self, f: FloatArray, u1: FloatArray) -> None:
        """Add all but moments to forces on nodal vectors (nodes, width) [N]. Collective.

        Args:
            f: They are changed.
            u1: Displacement at t_{n+1} [m], (num_owned,).
        """
        f[:, :3] += self._force
        if self._pressures:
            elements = self._elements
            on_cells = np.zeros(elements.rest.shape)
            x0, x1 = elements.y0[:, ::2], elements.vectors(u1)[:, ::2]
            on_cells[:, ::2] = self._pressures.forces(x0, x1, elements.theta)
            f += elements.values.sums(on_cells).reshape(f.shape)

    def subtract_slopes(self, values: FloatArray, u1: FloatArray, stiffness: float) -> None:
        """Take those of pressures, times a stiffness, off the elements' tangents. Collective."""
        if stiffness and self._pressures:
            elements = self._elements
            (n, k, _), y1 = elements.rest.shape, elements.vectors(u1)
            pushed = self._pressures.tangent(elements.y0[:, ::2], y1[:, ::2], elements.theta)
            values.reshape(n, k, 3, k, 3)[:, ::2, :, ::2] -= stiffness * pushed
