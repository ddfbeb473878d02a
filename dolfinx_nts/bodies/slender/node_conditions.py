"""Conditions on the nodes of beams and shells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.bodies.conditions import Dirichlet, Meetings, check_components, takes_place
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh
from dolfinx_nts.types import BoolArray, FloatArray, IntArray, Marker
from dolfinx_nts.validation import at_points, items, known_options, vector_in_time

#: Nodes that a message names.
_SHOWN = 6


class NodeConditions:
    """What holds the nodes of a body with directors. Collective.

    Args:
        comm: MPI communicator.
        director_mesh: Its nodes.
        here: Those of this rank.
        bcs: `Clamp` and `Dirichlet` conditions.
        kind: Of the body, for messages.
        name: Of the body.

    Attributes:
        fixed: Positions of the prescribed coordinates among this rank's, ascending.
        still: Those whose conditions do not depend on time.
        driven: Whether one's value is a function of time.
        free_directors: This rank's nodes whose directors are not all prescribed.
        values: Of the conditions.
    """

    def __init__(
        self, comm: MPI.Comm, director_mesh: DirectorMesh, here: slice,
        bcs: Sequence[Clamp | Dirichlet], kind: str, name: str,
    ) -> None:  # fmt: skip
        self._comm, self._here, self._name = comm, here, name
        self._width = 3 * (1 + director_mesh.directors.shape[1])
        bcs = items("bcs", bcs, lambda b: isinstance(b, Clamp | Dirichlet), "Clamp or Dirichlet")
        self._hold(bcs, director_mesh, kind)
        x = director_mesh.x[here]
        self._meetings = Meetings(comm, name, self.values, self._dofs, x, self._width)
        self._meetings.check(self._at_dofs(0.0), 0.0, anew=False)

    def _hold(
        self, bcs: Sequence[Clamp | Dirichlet], director_mesh: DirectorMesh, kind: str
    ) -> None:
        owner = np.full((self._here.stop - self._here.start, self._width), -1)
        self.values: list[Any] = []
        self._dofs: list[IntArray] = []
        for k, bc in enumerate(bcs):
            what = f"{type(bc).__name__}.where of bcs[{k}] of {self._name!r}"
            nodes = nodes_where(self._comm, director_mesh, what, bc.where)
            chosen = np.flatnonzero(nodes[self._here])
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
            self.values.append((0.0,) * 3 if isinstance(bc, Clamp) else bc.value)
        self.driven = any(callable(value) for value in self.values)
        self.fixed: IntArray = np.flatnonzero(owner >= 0)
        self._condition = owner.ravel()[self.fixed]
        still = [k for k, value in enumerate(self.values) if not callable(value)]
        self.still: IntArray = self.fixed[np.isin(self._condition, still)]
        self.free_directors: IntArray = np.flatnonzero((owner[:, 3:] < 0).any(axis=1))

    def _at_dofs(self, time: float) -> list[FloatArray]:
        """Displacements of each condition at its positions [m]. Collective."""
        found = []
        for k, (value, dofs) in enumerate(zip(self.values, self._dofs, strict=True)):
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
        total = np.zeros((len(self.values), 3))
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
        check_components(self.components)


def nodes_where(
    comm: MPI.Comm, director_mesh: DirectorMesh, what: str, where: Marker
) -> BoolArray:
    """Nodes of all ranks at which a condition or load is; there must be one. Collective."""
    if not callable(where):
        raise TypeError(f"{what}={where!r}: pass a function x (3, n) -> bool (n,)")
    x = director_mesh.x
    chosen: BoolArray = at_points(comm, what, where, x.T, (), "b")
    if not chosen.any():
        low, high = x.min(axis=0).tolist(), x.max(axis=0).tolist()
        here = ", ".join(str(place.tolist()) for place in x[director_mesh.order[:_SHOWN]])
        raise ValueError(
            f"{what}: selects no node between {low} and {high}; the nodes are {here}"
            + (", ...; " if len(x) > _SHOWN else "; ")
            + "compare with a tolerance, or place a node there"
        )
    return chosen
