"""What acts on a body's boundary: prescribed displacements and loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact.surfaces import locate_facets
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.validation import (
    UserFunctionError,
    is_whole,
    items,
    known_options,
    vector,
    vector_in_time,
)

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
Vector = Sequence[float] | FloatArray
VectorInTime = Vector | Callable[[float], Vector]

#: Rounding of displacements over them and over the distance of the body from the origin.
_ROUNDING = 64 * float(np.finfo(float).eps)


@known_options
@dataclass(frozen=True)
class Dirichlet:
    """Prescribed displacement on a part of the boundary.

    Attributes:
        where: Function x (3, n) -> bool (n,), or a pair (facet meshtags, tag).
        value: Displacement [m]: a vector, or a function of time; its work is external work. The
            nodes start where and as fast as the value says at the start.
        components: Which of x, y, z are prescribed.

    Raises:
        ValueError: Unknown component, or `value` is neither three finite numbers nor a function.
    """

    where: Any
    value: VectorInTime = (0.0, 0.0, 0.0)
    components: tuple[int, ...] = (0, 1, 2)

    def __post_init__(self) -> None:
        given = self.components
        listed = isinstance(given, Sequence) and all(is_whole(c) and 0 <= c <= 2 for c in given)
        if not listed or not given:
            raise ValueError(f"components={given!r}: pass a tuple of some of 0, 1, 2")
        _check_value("Dirichlet.value", self.value, "m")


@known_options
@dataclass(frozen=True)
class Traction:
    """Dead traction on a part of the boundary.

    Attributes:
        where: Function x (3, n) -> bool (n,), or a pair (facet meshtags, tag).
        value: Force per reference area [Pa]: a vector, or a function of time.

    Raises:
        ValueError: `value` is neither three finite numbers nor a function.
    """

    where: Any
    value: VectorInTime

    def __post_init__(self) -> None:
        _check_value("Traction.value", self.value, "Pa")


def _check_value(name: str, value: Any, unit: str) -> None:
    """Raise ValueError unless it is a vector or may be a function of time."""
    if not callable(value):
        vector(name, value, unit, or_else="a function of time that returns them")


def facets_of(mesh: Any, where: Any, what: str) -> IntArray:
    """This rank's facets that a `where` selects, as of `locate_facets`."""
    if isinstance(where, tuple) and len(where) == 2:
        return locate_facets(mesh, *where, what)
    return locate_facets(mesh, where, None, what)


class Meetings:
    """Coordinates that two conditions of a body prescribe, which must be of one mind. Collective.

    Args:
        comm: MPI communicator.
        name: Of the body, for messages.
        values: Of the conditions, as they were given.
        dofs: Positions that each of them prescribes among this rank's coordinates.
        x: Reference position of each node [m], shape (n, 3).
        width: Coordinates of a node, of which the first three are its place.
    """

    def __init__(
        self, comm: Any, name: str, values: Sequence[VectorInTime], dofs: Sequence[IntArray],
        x: FloatArray, width: int = 3,
    ) -> None:  # fmt: skip
        self._comm, self._name = comm, name
        owner = np.full(width * len(x), -1)
        found: dict[tuple[int, int, int], tuple[float, ...]] = {}
        for k, here in enumerate(dofs):
            # Three conditions at one coordinate are of one mind if neighbours in the list are.
            for dof in here[owner[here] >= 0].tolist():
                key = int(owner[dof]), k, dof % width
                place = tuple(x[dof // width].tolist())
                found[key] = min(found.get(key, place), place)
            owner[here] = k
        self._places: dict[tuple[int, int, int], tuple[float, ...]] = {}
        if len(dofs) > 1:
            for key, place in sorted(i for part in comm.allgather(found) for i in part.items()):
                self._places.setdefault(key, place)
            self._size = float(comm.allreduce(np.abs(x).max(initial=0.0), op=MPI.MAX))
        self._moving = any(
            callable(value) for j, k, _ in self._places for value in (values[j], values[k])
        )

    def check(
        self, now: Sequence[FloatArray] | FloatArray, time: float, *, anew: bool = True
    ) -> None:
        """Raise on every rank where two conditions prescribe different displacements.

        Args:
            now: Values of all conditions [m], shape (width,) each.
            time: When [s].
            anew: Whether those that do not depend on time were found to be of one mind.

        Raises:
            UserFunctionError: They do; not tried again in smaller steps.
        """
        if not self._places or (anew and not self._moving):
            return
        problem = None
        for (j, k, c), place in self._places.items():
            one, other = float(now[j][c]), float(now[k][c])
            if abs(one - other) > _ROUNDING * max(self._size, abs(one), abs(other)):
                near = _ROUNDING * self._size
                where = ", ".join(f"{x if abs(x) > near else 0.0:.4g}" for x in place)
                problem = (
                    f"bcs[{j}] and bcs[{k}] of {self._name!r}: at t={time:.6g} they prescribe "
                    f"{one:.6g} m and {other:.6g} m along {'xyz'[c % 3]} of the node at "
                    f"X = ({where}); leave that place or component out of one of them, or give "
                    "both one value"
                )
                break
        raise_together(self._comm, problem, UserFunctionError)


class Supports:
    """The `Dirichlet` conditions of a body. Collective.

    Args:
        comm: MPI communicator.
        space: The body's function space.
        bcs: The conditions.
        name: Of the body, for messages.

    Attributes:
        fixed: Positions of the prescribed coordinates among this rank's, ascending.
        driven: Whether a condition's value is a function of time.
        still: Those whose conditions do not depend on time.
        masks: DOLFINx conditions, for rows and columns of matrices.

    Raises:
        TypeError: An item is no condition.
        ValueError: A condition selects no facet, or has no vector at t = 0, or two of them
            prescribe different values of one coordinate.
    """

    def __init__(self, comm: Any, space: Any, bcs: Sequence[Dirichlet], name: str) -> None:
        self._comm, self._name = comm, name
        self._num_owned = 3 * space.dofmap.index_map.size_local
        bcs = items("bcs", bcs, lambda b: isinstance(b, Dirichlet), "Dirichlet")
        start = [self._value(k, bc.value, 0.0) for k, bc in enumerate(bcs)]
        self.masks: list[Any] = []
        self._parts: list[tuple[VectorInTime, list[tuple[int, IntArray]]]] = []
        owner, dim = np.full(self._num_owned, -1), space.mesh.topology.dim
        for number, bc in enumerate(bcs):
            what = f"Dirichlet.where of bcs[{number}] of {name!r}"
            facets = facets_of(space.mesh, bc.where, what)
            blocks = np.asarray(fem.locate_dofs_topological(space, dim - 1, facets))
            self._parts.append((bc.value, []))
            for component in bc.components:
                self.masks.append(compat.subspace_component_bc(space, component, blocks))
                dofs = np.sort(blocks * 3 + component)
                dofs = dofs[dofs < self._num_owned]
                self._parts[-1][1].append((component, dofs))
                owner[dofs] = number
        self.fixed = np.flatnonzero(owner >= 0)
        self.driven = any(callable(value) for value, _ in self._parts)
        still = [d for value, parts in self._parts if not callable(value) for _, d in parts]
        self.still: IntArray = np.concatenate([np.empty(0, dtype=int), *still])
        # Where two conditions meet, the later one carries the force.
        self._condition = owner[self.fixed]
        x = space.tabulate_dof_coordinates()[: self._num_owned // 3]
        of_each = [np.concatenate([d for _, d in parts]) for _, parts in self._parts]
        self._meetings = Meetings(comm, name, [bc.value for bc in bcs], of_each, x)
        self._meetings.check(start, 0.0, anew=False)

    @property
    def settings(self) -> list[Any]:
        """Of each condition value and components."""
        return [(value, [c for c, _ in parts]) for value, parts in self._parts]

    def _value(self, k: int, value: VectorInTime, time: float) -> FloatArray:
        what = f"Dirichlet.value of bcs[{k}] of {self._name!r}"
        return vector_in_time(self._comm, what, value, time, "m")

    def prescribed(self, time: float) -> FloatArray:
        """Displacements at a time, in the order of `fixed` [m]. Collective."""
        values = np.zeros(self._num_owned)
        now = [self._value(k, value, time) for k, (value, _) in enumerate(self._parts)]
        self._meetings.check(now, time)
        for here, (_, parts) in zip(now, self._parts, strict=True):
            for component, dofs in parts:
                values[dofs] = here[component]
        return values[self.fixed]

    def reactions(self, residual: FloatArray) -> FloatArray:
        """Resultants on the coordinates of each condition, this rank's part [N], (conditions, 3).

        Args:
            residual: Force on all owned coordinates.
        """
        total = np.zeros((len(self._parts), 3))
        np.add.at(total, (self._condition, self.fixed % 3), residual[self.fixed])
        return total
