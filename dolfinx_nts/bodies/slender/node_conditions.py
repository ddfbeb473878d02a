"""Conditions and loads on the nodes of beams and shells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from mpi4py import MPI

import numpy as np

from dolfinx_nts.bodies.conditions import Dirichlet, Meetings, VectorInTime, takes_place
from dolfinx_nts.bodies.loads import Pressure, load_at
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh
from dolfinx_nts.types import BoolArray, FloatArray, IntArray, Marker, Settings
from dolfinx_nts.validation import at_points, is_whole, items, known_options, vector_in_time

#: Nodes that a message names.
_SHOWN = 6


class NodeConditions:
    """What holds and loads the nodes of a body with directors. Collective.

    Args:
        comm: MPI communicator.
        director_mesh: Its nodes.
        here: Those of this rank.
        bcs: `Clamp` and `Dirichlet` conditions.
        forces: Loads.
        kind: Of the body, for messages.
        name: Of the body.

    Attributes:
        fixed: Positions of the prescribed coordinates among this rank's, ascending.
        still: Those whose conditions do not depend on time.
        driven: Whether one's value is a function of time.
        loads_in_time: Whether a load's is.
        free_directors: This rank's nodes whose directors are not all prescribed.
        turned: This rank's nodes on which moments act.
        pressures: Loads on cells by their position among all.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        director_mesh: DirectorMesh,
        here: slice,
        bcs: Sequence[Clamp | Dirichlet],
        forces: Sequence[Load | Pressure],
        kind: str,
        name: str,
    ) -> None:
        self._comm, self._director_mesh, self._here, self._name = comm, director_mesh, here, name
        self._width = 3 * (1 + director_mesh.directors.shape[1])
        bcs = items("bcs", bcs, lambda b: isinstance(b, Clamp | Dirichlet), "Clamp or Dirichlet")
        shell = kind == "shell"
        forces = items(
            "forces", forces, lambda f: isinstance(f, Load | Pressure if shell else Load),
            f"{'Pressure, ' * shell}PointForce, PointMoment, LineForce or LineMoment",
        )  # fmt: skip
        self._values_of_loads = [load.value for load in forces]
        self._hold(bcs, kind)
        self._loads = [
            self._load(k, load) for k, load in enumerate(forces) if isinstance(load, Load)
        ]
        self.pressures = {k: load for k, load in enumerate(forces) if isinstance(load, Pressure)}
        self.loads_in_time = any(callable(load.value) for load in forces)
        turning = [weights != 0.0 for load, weights, _ in self._loads if load.turns]
        self.turned: IntArray = np.flatnonzero(np.any(turning, axis=0) if turning else [])
        x = director_mesh.x[here]
        self._meetings = Meetings(comm, name, self._values, self._dofs, x, self._width)
        self._meetings.check(self._at_dofs(0.0), 0.0, anew=False)
        self.loads(0.0, 1.0)

    @property
    def none(self) -> bool:
        """Whether nothing is prescribed and nothing loads the body, at any time."""
        return not self._values and not self._values_of_loads

    @property
    def settings(self) -> Settings:
        """What ranks must have in common, see `Body`."""
        return {"bcs": self._values, "forces": self._values_of_loads}

    def _hold(self, bcs: Sequence[Clamp | Dirichlet], kind: str) -> None:
        owner = np.full((self._here.stop - self._here.start, self._width), -1)
        self._values: list[Any] = []
        self._dofs: list[IntArray] = []
        for k, bc in enumerate(bcs):
            what = f"{type(bc).__name__}.where of bcs[{k}] of {self._name!r}"
            chosen = np.flatnonzero(self._chosen(what, bc.where)[self._here])
            columns = np.array(bc.components)
            if isinstance(bc, Clamp):
                if len({*bc.components}) < 3 and self._width > 6:
                    raise ValueError(
                        f"components={bc.components!r} of bcs[{k}] of {self._name!r}: the three "
                        f"directors of a {kind} are held as a whole; leave components out"
                    )
                columns = (columns[:, None] + np.arange(0, self._width, 3)).ravel()
            elif hasattr(bc.value, "ufl_shape") or takes_place(bc.value):
                raise ValueError(
                    f"Dirichlet.value of bcs[{k}] of {self._name!r}: no function of place, "
                    f"Constant or Function for a {kind}; pass a vector, or a function of time "
                    "t -> (3,), and give nodes that move otherwise conditions of their own"
                )
            owner[np.ix_(chosen, columns)] = k
            self._dofs.append((self._width * chosen[:, None] + columns).ravel())
            self._values.append((0.0,) * 3 if isinstance(bc, Clamp) else bc.value)
        self.driven = any(callable(value) for value in self._values)
        self.fixed: IntArray = np.flatnonzero(owner >= 0)
        self._condition = owner.ravel()[self.fixed]
        still = [k for k, value in enumerate(self._values) if not callable(value)]
        self.still: IntArray = self.fixed[np.isin(self._condition, still)]
        self.free_directors: IntArray = np.flatnonzero((owner[:, 3:] < 0).any(axis=1))

    def _chosen(self, what: str, where: Marker) -> BoolArray:
        """Nodes of all ranks where a condition holds; it must hold somewhere. Collective."""
        if not callable(where):
            raise TypeError(f"{what}={where!r}: pass a function x (3, n) -> bool (n,)")
        x = self._director_mesh.x
        chosen: BoolArray = at_points(self._comm, what, where, x.T, (), "b")
        if not chosen.any():
            low, high = x.min(axis=0).tolist(), x.max(axis=0).tolist()
            here = ", ".join(str(place.tolist()) for place in x[self._director_mesh.order[:_SHOWN]])
            raise ValueError(
                f"{what}: selects no node between {low} and {high}; the nodes are {here}"
                + (", ...; " if len(x) > _SHOWN else "; ")
                + "compare with a tolerance, or place a node there"
            )
        return chosen

    def _load(self, k: int, load: Load) -> tuple[Load, FloatArray, str]:
        """A load, what of it acts on this rank's nodes, and its name. Collective."""
        kind = type(load).__name__
        what = f"{kind}.where of forces[{k}] of {self._name!r}"
        x, edges = self._director_mesh.x, self._director_mesh.edges
        chosen = np.ones(len(x), dtype=bool)
        if load.where is not None or not load.per_length:
            chosen = self._chosen(what, load.where)
        weights = chosen.astype(float)
        if load.per_length:
            along = chosen[edges].all(axis=1)
            if not along.any():
                raise ValueError(
                    f"{what}={load.where!r}: selects no two neighbours; select both ends of the "
                    "elements it acts on"
                )
            borne = self._director_mesh.lengths[along].ravel()
            weights = np.bincount(edges[along].ravel(), borne, len(x))
        elif chosen.sum() != 1:
            raise ValueError(f"{what}: selects {chosen.sum()} nodes; select one")
        return load, weights[self._here], f"{kind}.value of forces[{k}] of {self._name!r}"

    def loads(self, time: float, ramp: float) -> tuple[FloatArray, FloatArray]:
        """Forces on this rank's nodes [N], (n, 3), and moments on `turned` ones [N m]. Collective.

        Args:
            time: [s].
            ramp: Part of constant loads that acts.
        """
        both = np.zeros((2, self._here.stop - self._here.start, 3))
        for load, weights, what in self._loads:
            value = load_at(self._comm, what, load.value, load.unit, time, ramp)
            both[int(load.turns)] += weights[:, None] * value
        return both[0], both[1][self.turned]

    def _at_dofs(self, time: float) -> list[FloatArray]:
        """Displacements of each condition at its positions [m]. Collective."""
        found = []
        for k, (value, dofs) in enumerate(zip(self._values, self._dofs, strict=True)):
            now = np.zeros(self._width)
            what = f"Dirichlet.value of bcs[{k}] of {self._name!r}"
            now[:3] = vector_in_time(self._comm, what, value, time, "m")
            found.append(now[dofs % self._width])
        return found

    def prescribed(self, time: float) -> FloatArray:
        """Displacements of the prescribed coordinates [m]. Collective."""
        now = self._at_dofs(time)
        self._meetings.check(now, time)
        values = np.zeros(self._width * (self._here.stop - self._here.start))
        for dofs, here in zip(self._dofs, now, strict=True):
            values[dofs] = here
        return values[self.fixed]

    def reactions(self, residual: FloatArray) -> FloatArray:
        """Resultants on the places of each condition, this rank's part [N], (conditions, 3)."""
        total = np.zeros((len(self._values), 3))
        place = self.fixed % self._width < 3
        dofs = self.fixed[place]
        np.add.at(total, (self._condition[place], dofs % self._width), residual[dofs])
        return total


@known_options
@dataclass(frozen=True)
class Clamp:
    """Nodes of a beam or shell that neither move nor turn.

    Attributes:
        where: Function x (3, n) -> bool (n,).
        components: Which of x, y, z of places and directors are held. Fewer than three are for
            shells: (0,) makes a plane x = const one of symmetry.

    Raises:
        ValueError: Unknown component.
    """

    where: Marker
    components: tuple[int, ...] = (0, 1, 2)

    def __post_init__(self) -> None:
        given = self.components
        listed = isinstance(given, Sequence) and all(is_whole(c) and 0 <= c <= 2 for c in given)
        if not listed or not given:
            raise ValueError(f"components={given!r}: pass a tuple of some of 0, 1, 2")


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
