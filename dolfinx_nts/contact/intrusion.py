"""How deep nodes and edges lie in another body: arrays in, arrays out.

The depth of a point inside a body is its distance from the boundary; it changes along an edge by at
most the way, which bounds it between two points and leaves few edges to look at closely.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.surfaces import winding
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.kernels.bounded_slope import highest
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Depth in facet sizes that is reported. What contact of nodes leaves by its nature is a few
#: hundredths: a master that bulges between two slave nodes, a slave's edge over a convex master.
LEAST = 0.2
#: Closest points this near to the border of a facet (in convective coordinates) are on it.
_ON_BORDER = 1e-9
#: A body is thin where its sides have normals with a cosine below this; an edge that passes its
#: middle counts from this part of `LEAST` on.
_OPPOSITE, _THIN = -0.9, 0.01
#: The facets around an edge or a corner are one plane where their mean normal is at least so long.
_FLAT = 0.95
#: Part of a body's thickness that its box is taken smaller by, at most.
_SHRINK = 0.25


class Depth(NamedTuple):
    """How deep points lie in a body.

    Attributes:
        value: Distance from the boundary [m], negative outside, shape (n,); -inf beyond reach.
        facet: Closest facet, shape (n,); -1 beyond reach.
        normal: Outward normal there, of any length, shape (n, 3).
        over: Whether the closest point is inside a side of the body, not on its border, shape (n,).
    """

    value: FloatArray
    facet: IntArray
    normal: FloatArray
    over: BoolArray


class Found(NamedTuple):
    """Points of one boundary inside the other body; axis 0 = node or edge.

    Attributes:
        nodes: Both ends of the edge, twice the same for a node; points of the boundary, (n, 2).
        place: The deepest point of the edge, or the node [m], shape (n, 3).
        depth: Its distance from the other body's boundary [m], shape (n,).
        size: The same in facet sizes, the larger of both bodies there, of which one counts up to
            the other body's width; past the middle of a thin body at least 0.5 [-], shape (n,).
        facet: Closest facet of the other body, shape (n,).
        middle: Whether it passes the middle of a thin body, shape (n,).
    """

    nodes: IntArray
    place: FloatArray
    depth: FloatArray
    size: FloatArray
    facet: IntArray
    middle: BoolArray

    def select(self, chosen: IntArray | BoolArray) -> Found:
        """Some of them, by number or by a mask."""
        return Found._make(a[chosen] for a in self)

    @property
    def is_node(self) -> BoolArray:
        """Whether each is a node, shape (n,)."""
        return self.nodes[:, 0] == self.nodes[:, 1]


_NOTHING = Found(
    np.empty((0, 2), np.int64), np.empty((0, 3)), np.empty(0), np.empty(0),
    np.empty(0, np.int64), np.empty(0, bool),
)  # fmt: skip


class Boundary:
    """Facets of a body's boundary and their edges.

    Args:
        facets: Points of the facets, cyclic, counter-clockwise seen from outside, shape (m, nc).

    Attributes:
        facets: These.
        edges: Points of each edge, shape (e, 2).
        sides: Edge of each side k of a facet (corner k to k + 1), shape (m, nc).
        beside: The two facets of each edge, the same twice where only one has it, shape (e, 2).
        closed: Whether every edge has two facets.
    """

    def __init__(self, facets: IntArray) -> None:
        self.facets = facets
        ends = np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1).reshape(-1, 2)
        self.edges, at, inverse = np.unique(
            np.sort(ends, axis=1), axis=0, return_index=True, return_inverse=True
        )
        side = inverse.ravel()
        nc, number = facets.shape[1], np.arange(len(side))
        last = np.empty(len(self.edges), dtype=np.int64)
        last[side] = number
        self.sides = side.reshape(facets.shape)
        self.beside = np.column_stack([at, last]) // nc
        self.closed = bool((self.beside[:, 0] != self.beside[:, 1]).all())


class Placed:
    """A boundary at one instant.

    Args:
        boundary: Its facets and edges.
        x: Positions of its points [m], shape (p, 3).
        bulk: As of `bulk` at another instant, which hardly differs; None: of this one.
    """

    def __init__(self, boundary: Boundary, x: FloatArray, bulk: float | None = None) -> None:
        self.boundary, self.x = boundary, x
        if bulk is not None:
            self.bulk = bulk

    @cached_property
    def box(self) -> FloatArray:
        """Smallest and largest coordinates [m], shape (2, 3)."""
        return np.array([self.x.min(axis=0), self.x.max(axis=0)])

    @cached_property
    def extents(self) -> FloatArray:
        """Lengths along the principal axes of the points, sorted [m], shape (3,).

        Of a square or a cube all axes are principal, and lengths may be those of diagonals.
        """
        x = self.x - self.x.mean(axis=0)
        along = x @ np.linalg.eigh(x.T @ x)[1]
        return np.sort(np.ptp(along, axis=0))

    @cached_property
    def bulk(self) -> float:
        """Six times its volume by its area [m]; infinite where the boundary is open.

        That is the diameter of a ball, the edge of a cube, one and a half diameters of a rod and
        three times the thickness of a plate or of a ring's wall, however these are bent.
        """
        if not self.boundary.closed:
            return np.inf
        corners = self.corners - self.box.mean(axis=0)
        volume = area = 0.0
        for k in range(1, corners.shape[1] - 1):
            a, b, c = corners[:, [0, k, k + 1]].transpose(1, 0, 2)
            volume += float(np.einsum("ni,ni->", a, np.cross(b, c))) / 6.0
            area += float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2.0
        return 6.0 * abs(volume) / area

    @property
    def width(self) -> float:
        """Shorter side of the smallest hole that it fits through flat, at most its bulk [m]."""
        return min(float(self.extents[1]), self.bulk)

    @property
    def thickness(self) -> float:
        """Its least extent, at most its bulk [m]."""
        return min(float(self.extents[0]), self.bulk)

    @cached_property
    def corners(self) -> FloatArray:
        """Corners of the facets [m], shape (m, nc, 3)."""
        return self.x[self.boundary.facets]

    @cached_property
    def sizes(self) -> FloatArray:
        """Mean edge length of each facet, at most the body's bulk [m], shape (m,).

        A long facet of a slender body does not explain how deep all of the body lies in another.
        """
        return np.minimum(fc.size(self.corners), self.bulk)

    def edge_sizes(self, edge: IntArray) -> FloatArray:
        """Size of the larger facet beside each of the edges [m], shape (n,)."""
        return self.sizes[self.boundary.beside[edge]].max(axis=1)

    @cached_property
    def facet_boxes(self) -> tuple[FloatArray, FloatArray]:
        """Smallest and largest coordinates of each facet [m], shape (m, 3) each."""
        return self.corners.min(axis=1), self.corners.max(axis=1)

    def facets_near(self, box: FloatArray) -> IntArray:
        """Facets whose boxes meet a box (2, 3)."""
        return np.flatnonzero(_meet(*self.facet_boxes, box))

    def depth(
        self, points: FloatArray, reach: FloatArray | float, chosen: IntArray | None = None
    ) -> Depth:
        """How deep points lie in the body, up to the reach.

        The sign is that of the normal at the closest point; on an edge the mean of those of both
        facets, at a corner weighted by the angles (Baerentzen and Aanaes 2005), without which
        rounding would decide about points in the plane of a facet beside them. Nothing is known
        of points over the rim of an open boundary, which count as outside.

        Args:
            points: Points [m], shape (n, 3).
            reach: Largest distance of interest [m], one value or shape (n,).
            chosen: Facets that alone can be so near; all without it.
        """
        b, n = self.boundary, len(points)
        corners = self.corners if chosen is None else self.corners[chosen]
        result = Depth(np.full(n, -np.inf), np.full(n, -1), np.zeros((n, 3)), np.zeros(n, bool))
        closest = search.closest_facets(points, corners, reach=reach)
        near = np.flatnonzero(closest.facet >= 0)
        facet, xi = closest.facet[near], closest.xi[near]
        foot, _, normal = fc.frame(corners[facet], xi)
        facet = facet if chosen is None else chosen[facet]
        on = fc.edge_excess(xi, b.facets.shape[1]) > -_ON_BORDER
        count = on.sum(axis=1)
        edge, corner = np.flatnonzero(count == 1), np.flatnonzero(count > 1)
        beside = b.beside[b.sides[facet[edge], on[edge].argmax(axis=1)]]
        normal[edge] = self.normals(beside.ravel()).reshape(-1, 2, 3).mean(axis=1)
        rim = np.zeros(len(near), dtype=bool)
        rim[edge] = beside[:, 0] == beside[:, 1]
        first = (on & np.roll(on, 1, axis=1))[corner].argmax(axis=1)
        normal[corner], rim[corner] = self._around(b.facets[facet[corner], first])
        inward = foot - points[near]
        inside = (np.einsum("ni,ni->n", normal, inward) > 0.0) & ~rim
        result.value[near] = np.where(inside, 1.0, -1.0) * closest.distance[near]
        flat = ~rim & (np.linalg.norm(normal, axis=1) > _FLAT)
        result.facet[near], result.normal[near] = facet, normal
        result.over[near] = (count == 0) | flat
        return result

    def normals(self, facet: IntArray) -> FloatArray:
        """Unit normals of facets, of a warped one its mean, shape (n, 3); 0 without an area."""
        c = self.corners[facet]
        if c.shape[1] == 4:
            normal = np.cross(c[:, 2] - c[:, 0], c[:, 3] - c[:, 1])
        else:
            normal = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)

    def _around(self, point: IntArray) -> tuple[FloatArray, BoolArray]:
        """Normals at points, weighted by the facets' angles, (n, 3); which are on a rim, (n,)."""
        b, (used, inverse) = self.boundary, np.unique(point, return_inverse=True)
        facet, k = np.nonzero(np.isin(b.facets, used))
        nc, at = b.facets.shape[1], np.searchsorted(used, b.facets[facet, k])
        corner = self.corners[facet, k]
        arms = [self.corners[facet, (k + s) % nc] - corner for s in (1, -1)]
        area = np.linalg.norm(np.cross(*arms), axis=1)
        angle = np.arctan2(area, np.einsum("ni,ni->n", *arms))
        normal, rim = np.zeros((len(used), 3)), np.zeros(len(used), dtype=bool)
        turn = np.bincount(at, angle, len(used))[at]
        np.add.at(normal, at, (angle / turn)[:, None] * self.normals(facet))
        for side in (k, k - 1):
            one, two = b.beside[b.sides[facet, side]].T
            rim[at[one == two]] = True
        return normal[inverse], rim[inverse]


def _meet(low: FloatArray, high: FloatArray, box: FloatArray) -> BoolArray:
    """Which of the boxes low (n, 3) to high (n, 3) meet a box (2, 3)."""
    return ((low <= box[1]) & (high >= box[0])).all(axis=1)


def box_gap(one: FloatArray, two: FloatArray) -> float:
    """Distance between two boxes (2, 3) [m]."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(one[0] - two[1], two[0] - one[1]))))


def intrusions(a: Placed, b: Placed, least: float = LEAST) -> Found:
    """Nodes and edges of one boundary that lie deeper in another body than facets explain.

    Edges are told where their ends are not as deep; also those that pass the middle of a body so
    thin that nothing is deep in it. A body whose whole boundary is inside is found, too.

    Args:
        a: Boundary whose nodes and edges are looked at.
        b: Boundary of the other body; of an open one, see `Placed.depth`.
        least: Depth to report, in facet sizes as in `Found.size`, > 0.
    """
    # Facets do not explain how deep a body lies in them that is smaller than they are.
    sizes, floor = np.minimum(b.sizes, a.width), _least_size(a, b)
    near = _edges_near(a, b, least * floor)
    if not near.size:
        return _NOTHING
    ends = a.x[a.boundary.edges[near]]
    size = np.minimum(a.edge_sizes(near), b.width)
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    node, inverse = np.unique(a.boundary.edges[near], return_inverse=True)
    end = inverse.reshape(-1, 2)
    reach, around = np.zeros((2, len(node)))
    for k in range(2):
        np.maximum.at(reach, end[:, k], length)
        np.maximum.at(around, end[:, k], size)
    # No deeper than this is a node beside one that is not deep.
    reach += least * np.maximum(around, sizes.max())
    widest = float(reach.max())
    part = b.facets_near(np.array([ends.min(axis=(0, 1)) - widest, ends.max(axis=(0, 1)) + widest]))
    at = b.depth(a.x[node], reach, part)
    deep = at.value > least * np.maximum(around, sizes[at.facet])
    enclosed = b.boundary.closed and not (at.facet >= 0).any()
    if enclosed and winding(a.x[node[0]], b.corners) > 0.5 or b.boundary.closed and deep.any():
        part = np.arange(len(b.corners))
        at = b.depth(a.x[node], np.inf)
        deep = at.value > least * np.maximum(around, sizes[at.facet])
    i = np.flatnonzero(deep)
    depth, scale = at.value[i], np.maximum(around, sizes[at.facet])[i]
    nodes = np.column_stack([node[i], node[i]])
    inside = Found(nodes, a.x[node[i]], depth, depth / scale, at.facet[i], np.zeros(len(i), bool))
    start, limit = at.value[end], least * np.maximum(size, floor)
    middle = _through(ends, at, end, b, part)
    limit[middle] *= _THIN
    kept = ~deep[end].any(axis=1) & (start.sum(axis=1) + length > 2.0 * limit)
    ends, size, start, limit, near, middle = (
        v[kept] for v in (ends, size, start, limit, near, middle)
    )
    place, depth, facet = _deepest(ends, start, limit, b, part)
    size = np.maximum(size, sizes[facet])
    deep = depth > np.where(middle, limit, least * size)
    # Where the middle of a body is passed, half its thickness is the depth.
    size = np.where(middle, np.maximum(depth / size, 0.5), depth / size)
    crossing = Found(a.boundary.edges[near], place, depth, size, facet, middle).select(deep)
    return Found._make(np.concatenate(pair) for pair in zip(inside, crossing, strict=True))


def _least_size(a: Placed, b: Placed) -> float:
    """Least facet size that depths of two bodies in each other are compared with [m]."""
    return max(min(float(a.sizes.min()), b.width), min(float(b.sizes.min()), a.width))


def _edges_near(a: Placed, b: Placed, least: float) -> IntArray:
    """Edges of `a` that may be that deep [m] in `b`, by boxes."""
    ends = a.x[a.boundary.edges]
    if b.boundary.closed:
        shrink = np.full(3, min(least, _SHRINK * b.thickness))
    else:  # what is inside need not be in the box
        shrink = np.full(3, -float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max()))
    inner = np.array([b.box[0] + shrink, b.box[1] - shrink])
    return np.flatnonzero(_meet(ends.min(axis=1), ends.max(axis=1), inner))


def _through(
    ends: FloatArray, at: Depth, end: IntArray, b: Placed, chosen: IntArray
) -> BoolArray:
    """Which edges have ends over two opposite sides of a body, of which one is nearest halfway.

    What comes a little into the narrow side of a plate is nearest to that all the way.

    Args:
        ends: Of the edges [m], shape (n, 2, 3).
        at: Depths of nodes.
        end: Which of these are the ends, shape (n, 2).
        b: The body.
        chosen: Its facets that are near.
    """
    one, two = at.normal[end].transpose(1, 0, 2)
    found = (_cosine(one, two) < _OPPOSITE) & at.over[end].all(axis=1)
    start, normal = at.value[end[found]], one[found]
    span = ends[found, 1] - ends[found, 0]
    across = np.abs(np.einsum("ni,ni->n", span, normal)) / np.linalg.norm(normal, axis=1)
    part = np.divide(start[:, 1] - start[:, 0], across, np.zeros_like(across), where=across > 0.0)
    halfway = ends[found, 0] + (0.5 + 0.5 * np.clip(part, -1.0, 1.0))[:, None] * span
    there = b.depth(halfway, np.linalg.norm(span, axis=1), chosen)
    side = np.abs(_cosine(b.normals(there.facet), normal)) > -_OPPOSITE
    found[found] = side & (there.value > 0.0)
    return found


def _cosine(one: FloatArray, two: FloatArray) -> FloatArray:
    """Cosine of the angles between vectors (n, 3) each, shape (n,); 0 where one is zero."""
    length = np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    product = np.einsum("ni,ni->n", one, two)
    return np.divide(product, length, out=np.zeros_like(length), where=length > 0.0)


def _deepest(
    ends: FloatArray, start: FloatArray, limit: FloatArray, b: Placed, chosen: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Deepest points of edges in a body, by dividing what may hold a deeper one.

    Args:
        ends: Ends of the edges [m], shape (n, 2, 3).
        start: Their depth [m], shape (n, 2).
        limit: Depth of interest of each edge [m], shape (n,).
        b: The body.
        chosen: Its facets that are near.

    Returns:
        Points [m] (n, 3), depths [m] (n,), and closest facets (n,); where nothing is as deep as
        the limit, of some point of the edge or with a depth of -inf.
    """
    span = ends[:, 1] - ends[:, 0]

    def depth(edge: IntArray, s: FloatArray, reach: FloatArray) -> Depth:
        return b.depth(ends[edge, 0] + s[:, None] * span[edge], reach, chosen)

    at, value = highest(
        lambda edge, s, reach: depth(edge, s, reach).value,
        start, np.linalg.norm(span, axis=1), limit,
    )  # fmt: skip
    facet, deep = np.full(len(ends), -1), np.flatnonzero(value > limit)
    if deep.size:
        found = depth(deep, at[deep], 2.0 * value[deep])
        value[deep], facet[deep] = found.value, found.facet
    return ends[:, 0] + at[:, None] * span, value, facet
