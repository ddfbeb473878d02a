"""Contact surfaces: oriented facets and their corner points, known on every rank.

Every point of a body is linear in its coordinates, x = X + B u; on a continuum of nodes B only
selects, so a surface keeps the node numbers of its corner points. Topology is gathered once;
positions are gathered when a search needs them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from types import MappingProxyType
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact import search
from dolfinx_nts.contact.convex_edges import ConvexEdges
from dolfinx_nts.contact.edges import Edges, sharp_edges
from dolfinx_nts.contact.faces import Faces
from dolfinx_nts.contact.skins import Skin
from dolfinx_nts.interaction.points import Points, nodal_of
from dolfinx_nts.kernels import facets as facet_math
from dolfinx_nts.kernels import patches, triangle_patches
from dolfinx_nts.parallel import Asking, gather_rows, together
from dolfinx_nts.types import Array, FloatArray, IntArray

logger = logging.getLogger(__name__)


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
        points: As of `Skin`, and so are facets, original, reference, rows, material and faces.
        patches: Points that each patch depends on: one patch a facet, (m, nc), of degree 2 all
            nodes of its face, (m, 9 or 6), or with smoothing (m, 16) over quadrilaterals, and three
            over each triangle, one after another, (3 m, q), the corners of the facet first.
        weights: With smoothing and of degree 2, the patches' control points from these points,
            shape (m, 16, q), (m, 15, q) or (3 m, 15, q); else None, as corners and control points
            are the same.
        smooth: Whether slaves touch the smooth patches.
        area: Tributary area of each point [m^2], shape (p,).
        share: Positions in `points` of the nodes whose contact this rank computes, wherever their
            coordinates are: all ranks have as much to do, however the mesh is divided.
        fixed: Which coordinates of the points are prescribed, shape (p, 3).
    """

    #: For surfaces of one's own that do not call `__init__`.
    _touching: Touching | None = None
    faces: Faces | None = None
    smooth = False
    #: What a restart compares beside the facets.
    settings: Mapping[str, Any] = MappingProxyType({})

    def __init__(
        self, body: Any, skin: Skin, smoothing: bool = False,
        touching: Touching | None = None,
    ) -> None:
        self.body = body
        (
            self.points, self.facets, self.original, self.reference, self.rows, self.material,
            self.faces,
        ) = skin  # fmt: skip
        x = self.reference[self.facets]
        self.area = facet_math.tributary_areas(self.facets, x, len(self.points))
        self.smooth, self.patches = smoothing, self.facets
        self.weights: FloatArray | None = None
        if smoothing:
            self._smooth(x)
        elif self.faces is not None:
            self.patches, self.weights = self.faces.nodes, self.faces.patches()
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

    def part(self, points: npt.NDArray[np.bool_]) -> Surface:
        """The same surface, with the contact of some of its points (p,) alone."""
        found = copy(self)
        found.share = self.share[points[self.share]]
        vars(found).pop("_dealt", None)
        return found

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

    @cached_property
    def face_nodes(self) -> IntArray:
        """Points that positions on each facet depend on, shape (m, k)."""
        return self.facets if self.faces is None else self.faces.nodes

    def shape(self, facet: IntArray, xi: FloatArray) -> FloatArray:
        """Weights of `face_nodes` in points of facets (n,) at xi (n, 2), shape (n, k)."""
        if self.faces is None:
            return facet_math.shape(xi, self.facets.shape[1])[0]
        return self.faces.shape(facet, xi)

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
        return np.matmul(self.weights[patch], x)

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

    @cached_property
    def convex(self) -> ConvexEdges:
        """Which facets meet at its edges, and at which the surface turns away from slaves."""
        return ConvexEdges(self.facets, self.reference[self.facets])

    @cached_property
    def sharp_edges(self) -> Edges:
        """Sharp edges of its body that one of its facets is at. Collective."""
        return sharp_edges(self.body.boundary(), self)

    @cached_property
    def boundary_edges(self) -> npt.NDArray[np.bool_]:
        """Whether edge k (corner k to k + 1) of a facet is no other facet's, shape (m, nc)."""
        edges = np.stack([self.facets, np.roll(self.facets, -1, axis=1)], axis=-1)
        key = np.sort(edges.reshape(-1, 2), axis=1)
        _, inverse, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        return (count[inverse.ravel()] == 1).reshape(self.facets.shape)

    def gather(self, values: FloatArray) -> FloatArray:
        """Values at all points, (p, 3), from this rank's owned body coordinates. Collective."""
        return self.material.at(values)

    @cached_property
    def mass(self) -> FloatArray:
        """Mass of the points' nodes [kg], shape (p,), a measure of it > 0. Collective."""
        # Rows of a tetrahedron of degree 2 have negative sums at its vertices.
        return self.material.divided(np.abs(self.body.nodal_mass))

    @property
    def massless(self) -> npt.NDArray[np.bool_]:
        """Whether the points are nodes without mass, shape (p,). Collective."""
        if not self.body.has_massless:
            return np.zeros(len(self.points), dtype=bool)
        return self.material.nodal(self.body.massless).all(axis=(1, 2))

    @cached_property
    def _dealt(self) -> IntArray:
        """Shares of all ranks one after another. Collective."""
        return gather_rows(self.body.comm, self.share)

    def at_all(self, values: Array) -> Array:
        """Values at all points from those at the points of `share`, else 0. Collective."""
        return together(self.body.comm, [self.spread(values)])[0]

    def spread(self, values: Array) -> Asking[Array]:
        """`at_all` as of `together`."""
        table = np.zeros((len(self.points), *values.shape[1:]), dtype=values.dtype)
        table[self._dealt] = yield values
        return table

    def at_own(self, values: Array) -> Array:
        """Values at the points of `rows` from those at the points of `share`. Collective."""
        return self.owned(self.at_all(values))

    def owned(self, table: Array) -> Array:
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
        return self.reference + self.gather(u)


def gather_each(surfaces: Sequence[Surface], values: Sequence[FloatArray]) -> list[FloatArray]:
    """`Surface.gather` of several surfaces, in one call. Collective.

    Args:
        surfaces: The surfaces.
        values: Of each this rank's owned coordinates of its body.
    """
    sides = [surface.material for surface in surfaces]
    found = nodal_of(sides, values)
    return [side.combine(own) for side, own in zip(sides, found, strict=True)]


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
    return ((x >> np.uint64(32)) * np.uint64(size) >> np.uint64(32)).astype(int)


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
