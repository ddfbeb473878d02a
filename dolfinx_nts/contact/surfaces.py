"""Contact surfaces: oriented facets and their corner points, known on every rank.

Every point of a body is linear in its coordinates, x = X + B u; on a continuum of nodes B only
selects, so a surface keeps the node numbers of its corner points. Topology is gathered once;
positions are gathered when a search needs them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact import search
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels import facets as facet_math
from dolfinx_nts.kernels import patches, triangle_patches
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import FloatArray, IntArray, Marker
from dolfinx_nts.validation import at_points, is_whole

logger = logging.getLogger(__name__)


_CYCLIC = {3: [0, 1, 2], 4: [0, 1, 3, 2]}


def locate_facets(mesh: Mesh, marker: Marker, tag: int | None, what: str) -> IntArray:
    """This rank's owned exterior facets selected by a marker function or by a tag.

    Args:
        mesh: dolfinx mesh.
        marker: Callable x (3, n) -> bool (n,) that must hold at all corners of a facet, or dolfinx
            meshtags.
        tag: Value to look for when `marker` is meshtags.
        what: Name of the argument for messages.

    Raises:
        TypeError: `marker` is neither callable nor meshtags with a tag.
        ValueError: The marker raises or returns no truth values, the tags are not facet tags or of
            another mesh, or no exterior facet is selected, or an interior facet is.
    """
    exterior, dim = compat.exterior_facets(mesh), mesh.topology.dim - 1
    if tag is None:
        if not callable(marker):
            advice = ""
            if isinstance(marker, tuple):
                advice = " as two arguments, e.g. surface(*part.where('top'))"
            elif isinstance(marker, str):
                advice = f", which part.where({marker!r}) has of a surface with this name"
            raise TypeError(
                f"{what}={marker!r}: pass a function of x with shape (3, n), or meshtags and a tag"
                f"{advice}"
            )
        nodes = compat.entities_to_geometry(mesh, dim, exterior)
        used, chosen = np.unique(nodes), np.zeros(len(mesh.geometry.x), dtype=bool)
        chosen[used] = at_points(mesh.comm, what, marker, mesh.geometry.x[used].T, (), "b")
        found = exterior[chosen[nodes].all(axis=1)]
        wrong = foreign = 0
    else:
        if callable(marker):
            raise TypeError(f"{what}: a function of x takes no tag, but {tag!r} is given")
        if not hasattr(marker, "find") or marker.dim != dim:
            raise ValueError(
                f"{what}={marker!r}: pass facet meshtags (dimension {dim}), not cell or edge tags"
            )
        if not is_whole(tag):
            raise TypeError(f"{what} (tag {tag!r}): pass a whole number as the tag")
        tagged = marker.find(tag)
        found = np.intersect1d(tagged, exterior).astype(np.int32)
        owned = tagged < mesh.topology.index_map(dim).size_local
        wrong = int(np.count_nonzero(owned) - len(found))
        foreign = int(not compat.is_tagging(marker, mesh))
    every = mesh.comm.allgather((len(found), wrong, foreign))
    total, wrong, foreign = (int(n) for n in np.sum(every, axis=0))
    name = what if tag is None else f"{what} (tag {tag})"
    if foreign:
        raise ValueError(f"{name}: these meshtags are of another mesh; pass those of this body's")
    if wrong:
        raise ValueError(
            f"{name}: {wrong} interior facets selected; a contact surface must lie on the boundary"
        )
    if not total:
        raise ValueError(
            f"{name}: selects no exterior facet; check the marker's tolerance or the tag"
        )
    return found


class Skin(NamedTuple):
    """Oriented facets and the points at their corners, which every rank knows.

    Attributes:
        points: Numbers of the points in the body, ascending, those of a rank's nodes together,
            shape (p,).
        facets: Corners as positions in `points`, cyclic and counter-clockwise seen from outside, in
            an order that does not depend on the partition, shape (m, nc).
        original: Numbers that do not depend on the partition, shape (p,).
        reference: Reference positions [m], shape (p, 3).
        rows: Of the points at nodes of the mesh that this rank owns, in order, those nodes'
            positions among the owned ones, shape (n,).
        material: The points as functions of the body's coordinates.
    """

    points: IntArray
    facets: IntArray
    original: IntArray
    reference: FloatArray
    rows: IntArray
    material: Points


def skin_of_mesh(body: Any, local_facets: IntArray) -> Skin:
    """Facets of a body's mesh, whose corners are nodes. Collective.

    Args:
        body: The body.
        local_facets: This rank's owned facets.
    """
    mesh, space = body.mesh, body.space
    nodes = oriented_nodes(mesh, local_facets)
    local = compat.node_blocks(mesh, space)[nodes]
    index_map = space.dofmap.index_map
    corners = index_map.local_to_global(local.ravel().astype(np.int32)).reshape(local.shape)
    # An empty rank's list would become an array of floats.
    ids = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)[nodes]
    table = gather_rows(mesh.comm, np.stack([corners, ids], axis=-1))
    x = gather_rows(mesh.comm, mesh.geometry.x[nodes])
    roll, order = in_order(table[..., 1])
    table = np.take_along_axis(table, roll[..., None], axis=1)[order]
    x = np.take_along_axis(x, roll[..., None], axis=1)[order]
    points, at, inverse = np.unique(table[..., 0], return_index=True, return_inverse=True)
    reference = x.reshape(-1, 3)[at]
    low, high = index_map.local_range
    rows = points[(points >= low) & (points < high)] - low
    return Skin(
        points, inverse.reshape(table.shape[:2]), table[..., 1].ravel()[at], reference, rows,
        body.at_nodes(points, reference),
    )  # fmt: skip


def in_order(ids: IntArray) -> tuple[IntArray, IntArray]:
    """How to order facets whatever the partition, by numbers (m, nc) of their corners.

    Returns:
        Order of the corners of each facet, (m, nc), the lowest first, and of the facets, (m,).
    """
    first = ids.argmin(axis=1)
    roll = (first[:, None] + np.arange(ids.shape[1])) % ids.shape[1]
    return roll, np.lexsort(np.sort(ids, axis=1).T[::-1])


class Touching:
    """Which points of a skin contacts use, where the points of a node share its coordinates.

    Two of them may touch at once and ask more of a node than it has freedom for, as those of a
    shell between two planes.

    Args:
        node: Node of each point, shape (p,).

    Attributes:
        points: Whether a contact uses a point, shape (p,).
    """

    def __init__(self, node: IntArray) -> None:
        self._node, self.points = node, np.zeros(len(node), dtype=bool)

    @property
    def redundant(self) -> bool:
        """Whether contacts use several points of a node."""
        return bool(np.bincount(self._node[self.points], minlength=1).max() > 1)


class Surface:
    """Oriented facets of a body's boundary. Create with `body.surface`.

    Args:
        body: Its body.
        skin: The facets.
        smoothing: Whether slaves touch the smooth patches over the facets.
        touching: Which points contacts use, of a body whose nodes have several; None: it has none
            such, or all points share their nodes, as of rigid bodies.

    Attributes:
        body: The body it belongs to.
        points: As of `Skin`, and so are facets, original, reference, rows and material.
        patches: Points that each patch depends on, the corners of its facet first: one patch a
            facet, (m, nc), or with smoothing (m, 16) over quadrilaterals, and three over each
            triangle, one after another, (3 m, q).
        weights: With smoothing, the patches' control points from these points, shape (m, 16, 16) or
            (3 m, 15, q); else None, as corners and control points are the same.
        area: Tributary area of each point [m^2], shape (p,).
        share: Positions in `points` of the nodes whose contact this rank computes, wherever their
            coordinates are: all ranks have as much to do, however the mesh is divided.
        fixed: Which coordinates of the points are prescribed, shape (p, 3).
    """

    #: For surfaces of one's own that do not call `__init__`.
    _touching: Touching | None = None
    #: What a restart compares beside the facets.
    settings: Mapping[str, Any] = MappingProxyType({})

    def __init__(
        self, body: Any, skin: Skin, smoothing: bool = False,
        touching: Touching | None = None,
    ) -> None:
        self.body = body
        (
            self.points, self.facets, self.original, self.reference, self.rows, self.material
        ) = skin  # fmt: skip
        x = self.reference[self.facets]
        self.area = facet_math.tributary_areas(self.facets, x, len(self.points))
        self.patches: IntArray = self.facets
        self.weights: FloatArray | None = None
        if smoothing:
            self._smooth(x)
        self._touching = touching
        self.share = np.flatnonzero(_rank_of(self.original, body.comm.size) == body.comm.rank)
        free = ~self.material.fixed & (self.material.weights != 0.0)[:, :, None]
        self.fixed = ~free.any(axis=1)

    @property
    def redundant(self) -> bool:
        """Whether more points may touch at once than the body has freedom for."""
        if self._touching is None:
            return not self.material.are_nodes
        return self._touching.redundant

    @cached_property
    def facet_points(self) -> set[tuple[int, ...]]:
        """Of each facet the numbers of its corners in the body, ascending."""
        return {tuple(sorted(corners)) for corners in self.points[self.facets].tolist()}

    def leave(self) -> None:
        """Forget what contacts use of the body."""
        if self._touching is not None:
            self._touching.points[:] = False

    def touch(self) -> None:
        """Note that a contact of the system uses the surface."""
        if self._touching is not None:
            self._touching.points[self.points] = True

    def _smooth(self, corners: FloatArray) -> None:
        """Lay patches over the facets with reference corners (m, nc, 3)."""
        if self.facets.shape[1] == 4:
            self.patches, self.weights, irregular = patches.control_net(self.facets, corners)
            where = "where other than four facets meet"
        else:
            points, weights, irregular = triangle_patches.control_net(self.facets, self.reference)
            self.patches = np.repeat(points, triangle_patches.PIECES, axis=0)
            self.weights = weights.reshape(-1, *weights.shape[2:])
            where = "around which facets have no tangent plane in common"
        if irregular.any() and self.body.comm.rank == 0:
            logger.warning(
                "surface of %r: %d of %d facets have a corner %s; there smoothing leaves edges",
                self.body.name, irregular.sum(), len(irregular), where,
            )  # fmt: skip

    def patch_at(self, facet: IntArray, xi: FloatArray) -> IntArray:
        """Number in `patches` of what lies over facets (n,) at xi (n, 2), shape (n,)."""
        if len(self.patches) == len(self.facets):
            return facet.copy()
        return triangle_patches.PIECES * facet + triangle_patches.piece(xi)

    def control_points(self, x: FloatArray, patch: IntArray) -> FloatArray:
        """Return what the surface in given patches is interpolated from [m], shape (n, nc, 3).

        Args:
            x: Positions of all points [m], shape (p, 3).
            patch: Patches, shape (n,).
        """
        return self.combine(x[self.patches[patch]], patch)

    def combine(self, x: FloatArray, patch: IntArray) -> FloatArray:
        """Control points (n, nc, 3) from the patches' points (n, q, 3) [m]."""
        if self.weights is None:
            return x
        result: FloatArray = np.matmul(self.weights[patch], x)
        return result

    @cached_property
    def smallest(self) -> float:
        """Size of the smallest facet in the reference [m], inf without any; alike on all ranks."""
        return float(facet_math.size(self.reference[self.facets]).min(initial=np.inf))

    @cached_property
    def facet_nodes(self) -> Points:
        """Nodes of the body that each patch depends on; their weights are 0."""
        m = self.material
        used, at = np.unique(m.nodes, return_index=True)
        nodes = m.nodes[self.patches]
        nodes = nodes.reshape(len(nodes), nodes.shape[1] * nodes.shape[2])
        if m.nodes.shape[1] > 1:
            nodes = _distinct(nodes)
        i = at[np.searchsorted(used, nodes)]
        reference, fixed = (a.reshape(-1, 3)[i] for a in (m.reference, m.fixed))
        none = np.zeros(nodes.shape)
        return Points(self.body, nodes, none, reference, fixed, m.places.ravel()[i])

    @cached_property
    def facet_weights(self) -> FloatArray | None:
        """Weights of `facet_nodes` in the control points, (patches, nc, k); None if they are one.

        If a node occurs twice, its first entry counts.
        """
        m = self.material
        if m.are_nodes:
            return self.weights
        nodes = self.facet_nodes.nodes
        first = np.ones(nodes.shape, dtype=bool)
        first[:, 1:] = nodes[:, 1:] != nodes[:, :1]
        same = m.nodes[self.patches][..., None] == nodes[:, None, None]
        of_points = np.einsum("mpk,mpka->mpa", m.weights[self.patches], same & first[:, None, None])
        return self.combine(of_points, np.arange(len(nodes)))

    @property
    def boundary_edges(self) -> npt.NDArray[np.bool_]:
        """Whether edge k (corner k to k + 1) of a facet is no other facet's, shape (m, nc)."""
        edges = np.stack([self.facets, np.roll(self.facets, -1, axis=1)], axis=-1)
        key = np.sort(edges.reshape(-1, 2), axis=1)
        _, inverse, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        free: npt.NDArray[np.bool_] = (count[inverse.ravel()] == 1).reshape(self.facets.shape)
        return free

    def gather(self, values: FloatArray) -> FloatArray:
        """Values at all points, (p, 3), from this rank's owned body coordinates. Collective."""
        return self.material.at(values)

    @cached_property
    def mass(self) -> FloatArray:
        """Mass of the points' nodes [kg], shape (p,). Collective."""
        return self.material.divided(self.body.nodal_mass)

    @property
    def massless(self) -> npt.NDArray[np.bool_]:
        """Whether the points are nodes without mass, shape (p,). Collective."""
        if not self.body.has_massless:
            return np.zeros(len(self.points), dtype=bool)
        found: npt.NDArray[np.bool_] = self.material.nodal(self.body.massless).all(axis=(1, 2))
        return found

    @cached_property
    def _dealt(self) -> IntArray:
        """Shares of all ranks one after another. Collective."""
        return gather_rows(self.body.comm, self.share)

    def at_all(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values at all points from those at the points of `share`. Collective."""
        table = np.empty((len(self.points), *values.shape[1:]), dtype=values.dtype)
        table[self._dealt] = gather_rows(self.body.comm, values)
        return table

    def at_own(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values at the points of `rows` from those at the points of `share`. Collective."""
        return self.owned(self.at_all(values))

    def owned(self, table: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values at the points of `rows` from those at all points. Collective."""
        start = self.body.comm.exscan(len(self.rows)) or 0
        return table[start : start + len(self.rows)]

    def depth(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return how deep points lie inside the whole body, in facet sizes. Collective.

        Outside, and less than a thousandth of a facet deep, the depth is 0.

        Args:
            x: Points [m], shape (n, 3), the same on all ranks.
            u: Owned displacements of the body [m].

        Returns:
            Shape (n,), the same on all ranks.
        """
        comm, corners = self.body.comm, self.body.boundary_now(u)
        box = np.array(
            [corners.min(axis=(0, 1), initial=np.inf), -corners.max(axis=(0, 1), initial=-np.inf)]
        )
        comm.Allreduce(MPI.IN_PLACE, box, op=MPI.MIN)
        near = np.flatnonzero(((x >= box[0]) & (x <= -box[1])).all(axis=1))
        closest = search.closest_facets(x[near], corners, reach=np.inf)
        distance = closest.distance / np.append(facet_math.size(corners), 1.0)[closest.facet]
        nearest = distance.copy()
        comm.Allreduce(MPI.IN_PLACE, distance, op=MPI.MIN)
        # Only a point behind its nearest facet can be inside, and few are; a winding number costs
        # all facets.
        behind = np.zeros(len(near), dtype=np.int32)
        mine = np.flatnonzero((nearest <= distance) & (closest.facet >= 0))
        foot, _, normal = facet_math.frame(corners[closest.facet[mine]], closest.xi[mine])
        side = np.einsum("ni,ni->n", normal, x[near][mine] - foot)
        behind[mine] = (side < 0.0) & (distance[mine] > 1e-3)
        comm.Allreduce(MPI.IN_PLACE, behind, op=MPI.MAX)
        near, distance = near[behind > 0], distance[behind > 0]
        turns = np.array([winding(p, corners) for p in x[near]])
        comm.Allreduce(MPI.IN_PLACE, turns, op=MPI.SUM)
        depth = np.zeros(len(x))
        depth[near] = np.where(turns > 0.5, distance, 0.0)
        return depth

    def positions(self, u: FloatArray) -> FloatArray:
        """Positions of all points [m], shape (p, 3), from this rank's owned displacements."""
        x: FloatArray = self.reference + self.gather(u)
        return x


def boundary_of_mesh(body: Any, u: FloatArray) -> FloatArray:
    """Corners of the exterior facets of a body's mesh that this rank has [m], (m, nc, 3).

    Collective.

    Args:
        body: The body.
        u: Its owned displacements [m].
    """
    mesh = body.mesh
    nodes = oriented_nodes(mesh, compat.exterior_facets(mesh))
    moved = fem.Function(body.space)
    here = body.at_mesh(u)
    moved.x.array[: len(here)] = here
    moved.x.scatter_forward()
    blocks = compat.node_blocks(mesh, body.space)[nodes]
    corners: FloatArray = mesh.geometry.x[nodes] + moved.x.array.reshape(-1, 3)[blocks]
    return corners


def _distinct(rows: IntArray) -> IntArray:
    """Different numbers of each row, filled up with its first where it has fewer than others."""
    rows = np.sort(rows, axis=1)
    new = np.ones(rows.shape, dtype=bool)
    new[:, 1:] = rows[:, 1:] != rows[:, :-1]
    width = int(new.sum(axis=1).max(initial=0))
    out = np.repeat(rows[:, :1], width, axis=1)
    out[np.nonzero(new)[0], (new.cumsum(axis=1) - 1)[new]] = rows[new]
    return out


def _rank_of(nodes: IntArray, size: int) -> IntArray:
    """Rank that computes the contact of each node (input number), shape (n,).

    A hash of the number spreads each part of a surface over the ranks, alike for all surfaces of a
    body. Its mixing is that of Steele, Lea and Flood's SplitMix64.
    """
    x = np.asarray(nodes).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
    rank: IntArray = ((x >> np.uint64(32)) * np.uint64(size) >> np.uint64(32)).astype(int)
    return rank


def flux(corners: FloatArray) -> FloatArray:
    """Volume of the cone from the origin over oriented facets [m^3], (..., nc, 3) -> (...)."""
    # Under a bilinear facet lies the mean of its two triangulations.
    triangles = {3: [[0, 1, 2]], 4: [[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3]]}
    nc = corners.shape[-2]
    a, b, c = np.moveaxis(corners[..., np.array(triangles[nc]), :], -2, 0)
    volume: FloatArray = np.einsum("...i,...i->...", a, np.cross(b, c)).sum(axis=-1) / 6
    return volume if nc == 3 else 0.5 * volume


def winding(x: FloatArray, corners: FloatArray) -> float:
    """Return how often facets (m, nc, 3) enclose a point: 1 inside a closed surface, 0 outside."""
    total = 0.0
    for k in range(1, corners.shape[1] - 1):
        a, b, c = (corners[:, [0, k, k + 1]] - x).transpose(1, 0, 2)
        la, lb, lc = (np.linalg.norm(e, axis=1) for e in (a, b, c))
        ab, bc, ca = ((e * f).sum(axis=1) for e, f in ((a, b), (b, c), (c, a)))
        volume = (a * np.cross(b, c)).sum(axis=1)
        total += float(np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum())
    return total / (2 * np.pi)


def oriented_nodes(mesh: Mesh, local_facets: IntArray) -> IntArray:
    """Geometry nodes of facets, cyclic and counter-clockwise seen from outside the cell."""
    nodes = compat.entities_to_geometry(mesh, 2, local_facets)
    nodes = nodes[:, _CYCLIC[nodes.shape[1]]]
    if not len(nodes):
        return nodes
    to_cell = mesh.topology.connectivity(2, 3)
    cells = np.array([to_cell.links(f)[0] for f in local_facets], dtype=np.int32)
    x, centre = mesh.geometry.x, mesh.geometry.x[compat.geometry_dofmap(mesh)[cells]].mean(axis=1)
    corner = x[nodes]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, -1] - corner[:, 0])
    inward = np.einsum("ni,ni->n", normal, corner.mean(axis=1) - centre) < 0
    nodes[inward] = nodes[inward][:, ::-1]
    return nodes
