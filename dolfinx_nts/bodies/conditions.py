"""Prescribed displacements of a body's boundary."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.nodal_values import at_nodes
from dolfinx_nts.contact.skins import locate_facets
from dolfinx_nts.parallel import global_max, raise_together
from dolfinx_nts.types import FloatArray, IntArray, Marker
from dolfinx_nts.validation import (
    UserFunctionError,
    at_points,
    is_whole,
    items,
    known_options,
    vector,
    vector_in_time,
)

logger = logging.getLogger(__name__)

Vector = Sequence[float] | FloatArray
VectorInTime = Vector | Callable[[float], Vector]
#: Of a body's nodes: one for all, or one for each.
NodalVectors: TypeAlias = (
    VectorInTime | Callable[[FloatArray, float], FloatArray] | fem.Constant | fem.Function
)
#: What the values of `Dirichlet` may be beside three numbers.
_ELSE = (
    "a function of time t -> (3,), a function of place and time x (3, n), t -> (3, n), or a "
    "Constant or Function of DOLFINx with three components"
)

#: Rounding of displacements over them and over the distance of the body from the origin.
_ROUNDING = 64 * float(np.finfo(float).eps)


@known_options
@dataclass(frozen=True)
class Dirichlet:
    """Prescribed displacement on a part of the boundary.

    Attributes:
        where: Function x (3, n) -> bool (n,), or a pair (facet meshtags, tag). Nodes inside a
            Continuum or FormBody at which the function is true stay free; a warning says so.
        value: Displacement [m], whose work is external work; the nodes start where and as fast as
            it says at the start. It is
            - a vector, or a function of time t -> (3,), the same for all nodes;
            - a function of two arguments, x (3, n) and time, -> (3, n), with x in the reference;
            - a Constant of three components, or a Function of vectors on the body's mesh, asked
              whenever the displacement is: who changes it between steps moves the nodes.
        components: Which of x, y, z are prescribed.

    Raises:
        TypeError: `value` is a UFL expression, or `where` is meshtags alone.
        ValueError: Unknown component, or `value` is none of these.
    """

    where: Marker
    value: NodalVectors = (0.0, 0.0, 0.0)
    components: tuple[int, ...] = (0, 1, 2)

    def __post_init__(self) -> None:
        check_where("Dirichlet", self.where)
        check_components(self.components)
        if isinstance(self.value, fem.Constant | fem.Function):
            if self.value.ufl_shape != (3,):
                raise ValueError(
                    f"Dirichlet.value={self.value!s}: has shape {self.value.ufl_shape}; pass "
                    f"{_ELSE}"
                )
        else:
            check_value("Dirichlet.value", self.value, "m", _ELSE)


def check_components(given: Any) -> None:
    """Raise a ValueError unless it names some of x, y, z."""
    listed = isinstance(given, Sequence) and all(is_whole(c) and 0 <= c <= 2 for c in given)
    if not listed or not given:
        raise ValueError(f"components={given!r}: pass a tuple of some of 0, 1, 2")


def check_where(name: str, where: Marker) -> None:
    """Raise if it is meshtags without a tag, as a pair with a star leaves them."""
    if hasattr(where, "find") and not isinstance(where, str):
        raise TypeError(
            f"{name}.where={where!r}: is meshtags alone; pass the pair of meshtags and tag, "
            f"without a star, e.g. {name}(part.where('bottom'), ...)"
        )


def check_value(name: str, value: Any, unit: str, or_else: str) -> None:
    """Raise unless it is a vector or may be a function."""
    refuse_ufl(name, value, f"three finite components [{unit}], or {or_else}")
    if not callable(value):
        vector(name, value, unit, or_else=or_else)


def refuse_ufl(name: str, value: Any, wanted: str) -> None:
    """Raise TypeError where it is of UFL, which can be called, but is no function."""
    if hasattr(value, "ufl_shape"):
        raise TypeError(f"{name}={value!s}: is of UFL ({type(value).__name__}); pass {wanted}")


def takes_place(value: Any) -> bool:
    """Return whether a function has two arguments that must be given: place and time."""
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):  # one that does not say
        return False
    places = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in places and p.default is p.empty for p in parameters) == 2


def facets_of(mesh: Mesh, where: Marker, what: str) -> IntArray:
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
        self, comm: MPI.Comm, name: str, values: Sequence[Any], dofs: Sequence[IntArray],
        x: FloatArray, width: int = 3,
    ) -> None:  # fmt: skip
        self._comm, self._name, self._dofs, self._x, self._width = comm, name, dofs, x, width
        times = np.zeros(width * len(x), dtype=int)
        for here in dofs:
            times[here] += 1
        local = [np.any(times[here] > 1) for here in dofs]
        meet = comm.allreduce(np.array(local, dtype=int)) > 0
        self._any = bool(meet.any())
        self._moving = any(m and callable(v) for m, v in zip(meet, values, strict=True))
        self._size = float(comm.allreduce(np.abs(x).max(initial=0.0), op=MPI.MAX))

    def check(self, now: Sequence[FloatArray], time: float, *, anew: bool = True) -> None:
        """Raise on every rank where two conditions prescribe different displacements.

        Args:
            now: Of each condition the displacements at its positions [m].
            time: When [s].
            anew: Whether those that do not depend on time were found to be of one mind.

        Raises:
            UserFunctionError: They do; not tried again in smaller steps.
        """
        if not self._any or (anew and not self._moving):
            return
        problem = None
        owner = np.full(self._width * len(self._x), -1)
        before = np.zeros(len(owner))
        for k, (dofs, new) in enumerate(zip(self._dofs, now, strict=True)):
            old = before[dofs]
            limit = _ROUNDING * np.maximum(self._size, np.maximum(np.abs(old), np.abs(new)))
            apart = np.flatnonzero((owner[dofs] >= 0) & (np.abs(old - new) > limit))
            if apart.size and problem is None:
                i = apart[0]
                problem = self._sentence(int(owner[dofs[i]]), k, int(dofs[i]), old[i], new[i], time)
            owner[dofs], before[dofs] = k, new
        raise_together(self._comm, problem, UserFunctionError)

    def _sentence(self, j: int, k: int, dof: int, one: float, other: float, time: float) -> str:
        near = _ROUNDING * self._size
        place = self._x[dof // self._width].tolist()
        where = ", ".join(f"{x if abs(x) > near else 0.0:.4g}" for x in place)
        return (
            f"bcs[{j}] and bcs[{k}] of {self._name!r}: at t={time:.6g} they prescribe {one:.6g} "
            f"and {other:.6g} along {'xyz'[dof % self._width % 3]} of the node at X = ({where}); "
            "leave that place or component out of one of them, or give both one value"
        )


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
        ValueError: A condition selects no facet, or has no values at t = 0, or two of them
            prescribe different values of one coordinate.
    """

    def __init__(
        self, comm: MPI.Comm, space: fem.FunctionSpace, bcs: Sequence[Dirichlet], name: str
    ) -> None:
        self._comm, self._name = comm, name
        self._num_owned = 3 * space.dofmap.index_map.size_local
        bcs = items("bcs", bcs, lambda b: isinstance(b, Dirichlet), "Dirichlet")
        self._space, self._nodes = space, space.tabulate_dof_coordinates()
        start = []
        self.masks: list[Any] = []
        self._parts: list[tuple[Any, IntArray, list[tuple[int, IntArray]]]] = []
        owner, dim = np.full(self._num_owned, -1), space.mesh.topology.dim
        for number, bc in enumerate(bcs):
            what = f"Dirichlet.where of bcs[{number}] of {name!r}"
            facets = facets_of(space.mesh, bc.where, what)
            blocks = np.sort(np.asarray(fem.locate_dofs_topological(space, dim - 1, facets)))
            self._tell_inside(what, bc.where)
            owned = blocks[3 * blocks < self._num_owned]
            self._parts.append((bc.value, owned, []))
            try:
                start.append(self._values(number, bc.value, owned, 0.0))
            except UserFunctionError as error:
                one = callable(bc.value) and not takes_place(bc.value)
                hint = "; it is called with the time: one that varies in space takes (x, t)"
                raise UserFunctionError(f"{error}{hint * one}") from error.__cause__
            for component in bc.components:
                self.masks.append(compat.subspace_component_bc(space, component, blocks))
                dofs = owned * 3 + component
                self._parts[-1][2].append((component, dofs))
                owner[dofs] = number
        self.fixed = np.flatnonzero(owner >= 0)
        # What UFL has can be called, too.
        self.driven = any(callable(value) for value, _, _ in self._parts)
        still = [d for value, _, parts in self._parts if not callable(value) for _, d in parts]
        self.still: IntArray = np.concatenate([np.empty(0, dtype=int), *still])
        # Where two conditions meet, the later one carries the force.
        self._condition = owner[self.fixed]
        x = self._nodes[: self._num_owned // 3]
        of_each = [np.concatenate([d for _, d in parts]) for _, _, parts in self._parts]
        self._meetings = Meetings(comm, name, [bc.value for bc in bcs], of_each, x)
        self._meetings.check([self._at_dofs(*both) for both in enumerate(start)], 0.0, anew=False)

    def _tell_inside(self, what: str, where: Marker) -> None:
        """Tell of nodes inside the body at which a function of x holds, too. Collective."""
        if not callable(where):
            return
        mesh = self._space.mesh
        outer = fem.locate_dofs_topological(
            self._space, mesh.topology.dim - 1, compat.exterior_facets(mesh)
        )
        inner = np.setdiff1d(np.arange(self._num_owned // 3), outer)
        chosen = at_points(self._comm, what, where, self._nodes[inner].T, (), "b")
        free = self._comm.allreduce(int(np.count_nonzero(chosen)))
        if free and self._comm.rank == 0:
            logger.warning(
                "%s: is true at %d nodes inside the body, too, which stay free: only nodes of the "
                "boundary are prescribed; let it hold there alone, or take a RigidBody for what "
                "moves as a whole", what, free,
            )  # fmt: skip

    @property
    def settings(self) -> list[Any]:
        """Of each condition value and components."""
        return [(value, [c for c, _ in parts]) for value, _, parts in self._parts]

    def _values(self, k: int, value: Any, nodes: IntArray, time: float) -> FloatArray:
        """Displacements of a condition at a time [m], shape (3,) or (nodes, 3). Collective."""
        what = f"Dirichlet.value of bcs[{k}] of {self._name!r}"
        if isinstance(value, fem.Constant):
            return np.array(value.value)
        if isinstance(value, fem.Function):
            return at_nodes(self._space, f"{what}={value!s}", value)[nodes]
        if callable(value) and takes_place(value):
            x, at = self._nodes[nodes].T, f"{what} at t={float(time)!r}, called with (x, t)"
            found: FloatArray = at_points(
                self._comm, at, lambda x: value(x, time), x, (3,), error=UserFunctionError
            )
            return found.T
        return vector_in_time(self._comm, what, value, time, "m")

    def _at_dofs(self, k: int, now: FloatArray) -> FloatArray:
        """Displacements of a condition, (3,) or (nodes, 3), at its positions [m]."""
        _, nodes, parts = self._parts[k]
        of_nodes = np.broadcast_to(now, (len(nodes), 3))
        return np.concatenate([of_nodes[:, component] for component, _ in parts])

    def prescribed(self, time: float) -> FloatArray:
        """Displacements at a time, in the order of `fixed` [m]. Collective."""
        values = np.zeros(self._num_owned)
        now = [self._values(k, v, n, time) for k, (v, n, _) in enumerate(self._parts)]
        self._meetings.check([self._at_dofs(*both) for both in enumerate(now)], time)
        for here, (_, _, parts) in zip(now, self._parts, strict=True):
            for component, dofs in parts:
                values[dofs] = here[..., component]
        return values[self.fixed]

    def reactions(self, residual: FloatArray) -> FloatArray:
        """Resultants on the coordinates of each condition, this rank's part [N], (conditions, 3).

        Args:
            residual: Force on all owned coordinates.
        """
        total = np.zeros((len(self._parts), 3))
        np.add.at(total, (self._condition, self.fixed % 3), residual[self.fixed])
        return total


#: Part of a body's size beyond which its supports count as moved at once.
_FAR = 1e-3


def jumps(bodies: Iterable[Body]) -> str:
    """Which supports move a part of their body at once, and what to do, or nothing. Collective.

    A constant value holds from the start on, so that no smaller step divides its motion.

    Args:
        bodies: In the order of all ranks. A body to whose nodes the user has given displacements
            starts as meant, and a rigid one moves as a whole.
    """
    found = []
    for body in bodies:
        if body.rigid or body.starts_moved:
            continue
        x = body.reference.reshape(-1, 3)[body.places]
        high, low = x.max(axis=0, initial=-np.inf), x.min(axis=0, initial=np.inf)
        # Directors follow their place.
        places = np.repeat(body.places, 3)[body.fixed]
        far = np.abs(body.prescribed(0.0)[places]).max(initial=0.0)
        *spread, jump = global_max(body.comm, np.concatenate([high, -low, [far]]))
        if jump > _FAR * float(np.max(np.add(spread[:3], spread[3:]))):
            found.append(
                f"supports of {body.name!r} move by {jump:.3g} at once, at the start: make that "
                "value a function of t that begins at 0, e.g. Dirichlet(where, lambda t: ...)"
            )
    return "; ".join(found)
