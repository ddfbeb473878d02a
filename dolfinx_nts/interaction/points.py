"""Material points of a body, x = sum of w_a y_a with constant weights w_a (theory section 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import basix
import numpy as np
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.parallel import gather_rows, raise_together
from dolfinx_nts.types import Array, BoolArray, FloatArray, IntArray

#: Part of a cell by which a point may lie beside it, and of coordinates that their rounding is.
_ON_CELL, _ROUNDING = 1e-9, 4 * np.finfo(np.float64).eps


def of_nodes(nodes: IntArray) -> IntArray:
    """Numbers of the coordinates of nodes, shape (*nodes.shape, 3)."""
    return 3 * nodes[..., None] + np.arange(3, dtype=nodes.dtype)


@dataclass(frozen=True, eq=False)
class Points:
    """Material points of a body, or directions in it, the same on all ranks; axis 0 = point.

    Attributes:
        body: The body.
        nodes: Global numbers of the nodes y_a that a point depends on, shape (n, k); their
            coordinates are 3 node, 3 node + 1, 3 node + 2.
        weights: w_a, shape (n, k).
        reference: Reference values of the nodes [m], shape (n, k, 3).
        fixed: Which coordinates of the nodes are prescribed, shape (n, k, 3).
        places: Whether the nodes are places, t_a = 1, or directors, shape (n, k).
    """

    body: Any
    nodes: IntArray
    weights: FloatArray
    reference: FloatArray
    fixed: BoolArray
    places: BoolArray

    def __len__(self) -> int:
        return len(self.nodes)

    @cached_property
    def dofs(self) -> IntArray:
        """Global coordinates of the nodes, shape (n, k, 3)."""
        return of_nodes(self.nodes)

    def flat(self, prescribed: int | None = None) -> IntArray:
        """`dofs` as (n, 3 k), with `prescribed` in place of coordinates that are."""
        if prescribed is None:
            return self._flat
        return np.where(self.fixed, prescribed, self.dofs).reshape(self._flat.shape)

    @cached_property
    def _flat(self) -> IntArray:
        return self.dofs.reshape(len(self), 3 * self.nodes.shape[1])

    def select(self, chosen: Any) -> Points:
        """Return some of the points, chosen by numbers, a slice or a mask; ranks may differ."""
        arrays = (self.nodes, self.weights, self.reference, self.fixed, self.places)
        return Points(self.body, *(a[chosen] for a in arrays))

    def joined(self, numbers: IntArray) -> Points:
        """Several points each, by numbers (n, p), as one of all their nodes, one after another."""
        n, p = numbers.shape
        arrays: tuple[Any, ...] = (
            self.nodes, self.weights, self.reference, self.fixed, self.places
        )  # fmt: skip
        each = (a[numbers].reshape(n, p * a.shape[1], *a.shape[2:]) for a in arrays)
        return Points(self.body, *each)

    def columns(self, chosen: IntArray) -> Points:
        """Return the points by some of the nodes each depends on; the others have no weight."""
        return self.select((slice(None), chosen))

    @cached_property
    def _table(self) -> tuple[IntArray, IntArray, IntArray]:
        """Rows of this rank's nodes among its owned ones, where each node is, counts of rows.

        The counts are those of all ranks. Collective.
        """
        used, index = np.unique(self.nodes, return_inverse=True)
        used = np.unique(gather_rows(self.body.comm, used))
        index = np.searchsorted(used, self.nodes)
        count = self.body.num_owned // 3
        first = self.body.comm.exscan(count) or 0
        own = used[(used >= first) & (used < first + count)]
        return own - first, index, np.array(self.body.comm.allgather(len(own)))

    def nodal(self, values: Array) -> Array:
        """Values at the nodes of all points, (n, k, 3), from this rank's coordinates. Collective.

        Args:
            values: At this rank's owned coordinates, shape (num_owned,).
        """
        return nodal_of([self], [values])[0]

    def gathered(self, values: FloatArray) -> FloatArray:
        """Sums at this rank's owned coordinates, (num_owned,), of values at nodes. Collective.

        For few points of small bodies: the whole body travels.

        Args:
            values: At the nodes of all points, shape (n, k, 3).
        """
        comm, owned = self.body.comm, self.body.num_owned
        first, total = comm.scan(owned) - owned, comm.allreduce(owned)
        whole = np.zeros(total)
        np.add.at(whole, self.flat().ravel(), values.ravel())
        return comm.allreduce(whole)[first : first + owned]

    def extent(self, origin: FloatArray) -> float:
        """Largest length whose rounding is in a point's position relative to an origin (3,) [m]."""
        arms = self.reference - np.where(self.places[:, :, None], origin, 0.0)
        sizes = np.einsum("na,nai->ni", np.abs(self.weights), np.abs(arms))
        return float(sizes.max(initial=0.0))

    def divided(self, values: FloatArray) -> FloatArray:
        """Divide what the nodes' places have, such as mass, among the points, (n,). Collective.

        Args:
            values: At this rank's owned coordinates, alike in all three directions.
        """
        share = np.where(self.places, self.weights, 0.0)
        total = np.zeros(int(self.nodes.max(initial=-1)) + 1)
        np.add.at(total, self.nodes, share)
        per_node = self.nodal(values)[:, :, 0] / np.where(self.places, total[self.nodes], 1.0)
        return (share * per_node).sum(axis=1)

    def at(self, values: FloatArray) -> FloatArray:
        """Values at the points, (n, 3), from this rank's coordinates. Collective.

        Args:
            values: At this rank's owned coordinates, shape (num_owned,).
        """
        return self.combine(self.nodal(values))

    def combine(self, values: FloatArray) -> FloatArray:
        """Values at the points, (n, 3), from those at their nodes (n, k, 3)."""
        if self.are_nodes:
            return values[:, 0]
        return np.einsum("na,nai->ni", self.weights, values)

    @cached_property
    def are_nodes(self) -> bool:
        """Whether each point is one node."""
        return self.weights.shape[1] == 1 and bool((self.weights == 1.0).all())


def nodal_of(sides: Sequence[Points], values: Sequence[Array]) -> list[Array]:
    """`Points.nodal` of several, what ranks have of all of them in one call. Collective.

    Args:
        sides: The points.
        values: Of each at this rank's owned coordinates of its body.
    """
    found, asked = list[Array](), list[tuple[int, Array, IntArray]]()
    for k, (side, own) in enumerate(zip(sides, values, strict=True)):
        known = next((table for given, table in side.body.known if given is own), None)
        if known is None:
            rows, index, counts = side._table
            asked.append((k, own.reshape(-1, 3)[rows], counts))
            found.append(index)
        else:
            found.append(known[side.nodes])
    if asked:
        numbers, local, each = zip(*asked, strict=True)
        counts = np.array(each)
        table = gather_rows(sides[0].body.comm, np.concatenate(local), counts.sum(axis=0))
        # Rank by rank those of all points; then in each rank those of one after another.
        of = np.repeat(np.tile(np.arange(len(each)), counts.shape[1]), counts.T.ravel())
        for i, k in enumerate(numbers):
            found[k] = table[of == i][found[k]] if len(each) > 1 else table[found[k]]
    return found


def nodal(
    sides: Sequence[Points], of: Sequence[int], values: Sequence[FloatArray]
) -> FloatArray:
    """Values at the nodes of all sides, (n, k, 3), from those of each body. Collective.

    Args:
        sides: Of bodies, or of batches of bodies.
        of: Numbers of these in the system, see `Batches.batch_of`.
        values: At this rank's owned coordinates of each body of the system.
    """
    own = [
        values[k] if k < len(values) else side.body.joined(values)
        for k, side in zip(of, sides, strict=True)
    ]
    return np.concatenate(nodal_of(sides, own), axis=1)


def joined_sides(
    each: Sequence[Sequence[Points]], of: Sequence[tuple[int, ...]], batch: Any
) -> tuple[Points, ...]:
    """The sides of several elements as those of one batch that has their bodies.

    Args:
        each: Sides of some elements.
        of: Numbers of their bodies.
        batch: A `BodyBatch`.
    """
    sides = []
    for k, here in enumerate(zip(*each, strict=True)):
        both_of = zip(here, of, strict=True)
        nodes = [batch.numbered(bodies[k], 3 * s.nodes) // 3 for s, bodies in both_of]
        values = [
            np.concatenate([getattr(s, name) for s in here])
            for name in ("weights", "reference", "fixed", "places")
        ]
        sides.append(Points(batch, np.concatenate(nodes).astype(here[0].nodes.dtype), *values))
    return tuple(sides)


def in_mesh(body: Any, x: FloatArray, name: str) -> Points:
    """Points of a body with a Lagrange space on a mesh. Collective.

    Args:
        body: The body; it has `mesh`, `space`, `degree` and `fixed`.
        x: Reference positions [m], shape (n, 3), the same on all ranks.
        name: Of the argument, for messages.

    Raises:
        ValueError: A point lies in no cell.
    """
    mesh, space, comm = body.mesh, body.space, body.comm
    mine, cells, inside = _cells_of(mesh, x)
    dofs, index_map = compat.cell_dofs(space)[cells], space.dofmap.index_map
    kind = getattr(basix.CellType, compat.cell_name(mesh))
    variant = basix.LagrangeVariant.gll_warped
    element = basix.create_element(basix.ElementFamily.P, kind, body.degree, variant)
    weights = np.empty(dofs.shape)
    if len(mine):  # Basix aborts without points
        weights = element.tabulate(0, inside)[0, :, :, 0]
    nodes = index_map.local_to_global(dofs.ravel().astype(np.int32)).reshape(dofs.shape)
    reference = space.tabulate_dof_coordinates()[dofs]
    fixed = compat.with_ghosts(space, body.fixed)[dofs]
    # Of several ranks that hold a point, the first one tells.
    found: dict[int, Any] = {}
    local = list(zip(mine.tolist(), nodes, weights, reference, fixed, strict=True))
    for part in comm.allgather(local):
        for i, *values in part:
            found.setdefault(i, values)
    outside = [i for i in range(len(x)) if i not in found]
    raise_together(
        comm,
        f"{name}={x[outside[0]].tolist()}: lies in no cell of body {body.name!r}; choose a point "
        "of its reference configuration"
        if outside
        else None,
    )
    columns = zip(*(found[i] for i in range(len(x))), strict=True)
    nodes, weights, reference, fixed = (np.array(values) for values in columns)
    return Points(body, nodes, weights, reference, fixed, np.ones(nodes.shape, dtype=bool))


def _cells_of(mesh: Mesh, x: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return which points (n, 3) this rank's own cells hold, of which one each, and where in it.

    DOLFINx's own search has a tolerance in metres, so that cells of 10 um hold nothing.
    """
    nodes = mesh.geometry.x[compat.geometry_dofmap(mesh)]
    sizes = np.ptp(nodes, axis=1).max(axis=1)
    rounding = _ROUNDING * float(np.abs(x).max(initial=0.0))
    padding = float(_ON_CELL * sizes.max(initial=0.0) + rounding)
    near = compat.cells_near(mesh, x, padding)
    dim, cmap = mesh.topology.dim, compat.coordinate_map(mesh)
    simplex = compat.cell_name(mesh) in ("triangle", "tetrahedron")
    which, held, inside = [], [], []
    for i, cells in enumerate(near):
        for c in cells:
            try:
                at = cmap.pull_back(x[i : i + 1], nodes[c])
            except RuntimeError:  # Newton's method does not converge, as far outside
                continue
            off = max(-at.min(), (at.sum() if simplex else at.max()) - 1.0)
            # A cell of a surface or line says nothing of what is beside it.
            aside = np.linalg.norm(cmap.push_forward(at, nodes[c]) - x[i]) / sizes[c]
            if max(off, aside) <= _ON_CELL + rounding / sizes[c]:
                which.append(i)
                held.append(c)
                inside.append(at)
                break
    return (
        np.array(which, dtype=np.int64), np.array(held, dtype=np.int64),
        np.array(inside).reshape(-1, dim),
    )  # fmt: skip
