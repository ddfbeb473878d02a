"""Bodies that end up inside each other, which contact of nodes with facets may not see.

Nodes of the slave are kept out of the master's facets; an edge of the one may still pass through
the other between its nodes, and what is not declared as a surface is not held at all. The first
part of this file is geometry, arrays in, arrays out: how deep the nodes and edges of a boundary lie
in a body. `OverlapWatch` looks at the bodies of a run as often as their motion asks for it.

The depth of a point inside a body is its distance from the boundary; it changes along an edge by at
most the way, which bounds it between two points and leaves few edges to look at closely.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import facets as fc
from dolfinx_nts import search
from dolfinx_nts.surfaces import Surface, winding

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

#: Depth in facet sizes that is reported. What contact of nodes leaves by its nature is a few
#: hundredths: a master that bulges between two slave nodes, a slave's edge over a convex master.
LEAST = 0.2
#: Bodies whose boxes meet are looked at again after a relative motion of this many facet sizes,
#: but only after so many steps, which resolve a crossing at all, unless they have moved by a facet.
_LOOK, _STEPS = 0.25, 4
#: Closest points this near to the border of a facet (in convective coordinates) are on it.
_ON_BORDER = 1e-9
#: The deepest point of an edge is sought by so many divisions into so many parts, until its depth
#: is known to this part of it.
_ROUNDS, _PARTS, _PRECISE = 7, 4, 0.01
#: A body is thin where its sides have normals with a cosine below this; an edge that sticks out on
#: both sides counts from this part of `LEAST` on.
_OPPOSITE, _THIN = -0.9, 0.01
#: Part of a body's box that its nearest points are left out of, at most.
_SHRINK = 0.25


class Depth(NamedTuple):
    """How deep points lie in a body.

    Attributes:
        value: Distance from the boundary [m], negative outside, shape (n,); -inf beyond reach.
        facet: Closest facet, shape (n,); -1 beyond reach.
        normal: Outward normal there, of any length, shape (n, 3).
        over: Whether the closest point is inside the facet, not on its border, shape (n,).
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
        size: The same in facet sizes, the larger of both bodies there [-], shape (n,).
        facet: Closest facet of the other body, shape (n,).
    """

    nodes: IntArray
    place: FloatArray
    depth: FloatArray
    size: FloatArray
    facet: IntArray

    def part(self, chosen: IntArray | BoolArray) -> Found:
        """Some of them, by number or by a mask."""
        return Found._make(a[chosen] for a in self)

    @property
    def is_node(self) -> BoolArray:
        """Whether each is a node, shape (n,)."""
        same: BoolArray = self.nodes[:, 0] == self.nodes[:, 1]
        return same


_NOTHING = Found(
    np.empty((0, 2), np.int64), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0, np.int64)
)


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
    """

    def __init__(self, boundary: Boundary, x: FloatArray) -> None:
        self.boundary, self.x = boundary, x

    @cached_property
    def box(self) -> FloatArray:
        """Smallest and largest coordinates [m], shape (2, 3)."""
        return np.array([self.x.min(axis=0), self.x.max(axis=0)])

    @cached_property
    def corners(self) -> FloatArray:
        """Corners of the facets [m], shape (m, nc, 3)."""
        corners: FloatArray = self.x[self.boundary.facets]
        return corners

    @cached_property
    def sizes(self) -> FloatArray:
        """Mean edge length of each facet [m], shape (m,)."""
        return fc.size(self.corners)

    def edge_sizes(self, edge: IntArray) -> FloatArray:
        """Size of the larger facet beside each of the edges [m], shape (n,)."""
        largest: FloatArray = self.sizes[self.boundary.beside[edge]].max(axis=1)
        return largest

    def facets_near(self, box: FloatArray) -> IntArray:
        """Facets whose boxes meet a box (2, 3)."""
        c = self.corners
        return np.flatnonzero(_meet(c.min(axis=1), c.max(axis=1), box))

    def depth(
        self, points: FloatArray, reach: FloatArray | float, chosen: IntArray | None = None
    ) -> Depth:
        """How deep points lie in the body, up to the reach.

        The sign is that of the normal at the closest point; on an edge the sum of those of both
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
        normal[edge] = self._normals(beside.ravel()).reshape(-1, 2, 3).sum(axis=1)
        rim = np.zeros(len(near), dtype=bool)
        rim[edge] = beside[:, 0] == beside[:, 1]
        first = (on & np.roll(on, 1, axis=1))[corner].argmax(axis=1)
        normal[corner], rim[corner] = self._around(b.facets[facet[corner], first])
        inward = foot - points[near]
        inside = (np.einsum("ni,ni->n", normal, inward) > 0.0) & ~rim
        result.value[near] = np.where(inside, 1.0, -1.0) * closest.distance[near]
        result.facet[near], result.normal[near], result.over[near] = facet, normal, count == 0
        return result

    def _normals(self, facet: IntArray) -> FloatArray:
        """Unit normals of facets, of a warped one its mean, shape (n, 3); 0 without an area."""
        c = self.corners[facet]
        if c.shape[1] == 4:
            normal = np.cross(c[:, 2] - c[:, 0], c[:, 3] - c[:, 1])
        else:
            normal = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        unit: FloatArray = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
        return unit

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
        np.add.at(normal, at, angle[:, None] * self._normals(facet))
        for side in (k, k - 1):
            one, two = b.beside[b.sides[facet, side]].T
            rim[at[one == two]] = True
        return normal[inverse], rim[inverse]


def _meet(low: FloatArray, high: FloatArray, box: FloatArray) -> BoolArray:
    """Which of the boxes low (n, 3) to high (n, 3) meet a box (2, 3)."""
    meet: BoolArray = ((low <= box[1]) & (high >= box[0])).all(axis=1)
    return meet


def box_gap(one: FloatArray, two: FloatArray) -> float:
    """Distance between two boxes (2, 3) [m]."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(one[0] - two[1], two[0] - one[1]))))


def intrusions(a: Placed, b: Placed, least: float = LEAST) -> Found:
    """Nodes and edges of one boundary that lie deeper in another body than facets explain.

    Edges are told where their ends are not as deep; also those that pass right through a body so
    thin that nothing is deep in it. A body whose whole boundary is inside is found, too.

    Args:
        a: Boundary whose nodes and edges are looked at.
        b: Boundary of the other body; of an open one, see `Placed.depth`.
        least: Depth to report, in facet sizes, > 0.
    """
    near = _edges_near(a, b, least)
    if not near.size:
        return _NOTHING
    ends, size = a.x[a.boundary.edges[near]], a.edge_sizes(near)
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    node, inverse = np.unique(a.boundary.edges[near], return_inverse=True)
    end = inverse.reshape(-1, 2)
    reach, around = np.zeros((2, len(node)))
    for k in range(2):
        np.maximum.at(reach, end[:, k], length)
        np.maximum.at(around, end[:, k], size)
    widest = float(reach.max())
    part = b.facets_near(np.array([ends.min(axis=(0, 1)) - widest, ends.max(axis=(0, 1)) + widest]))
    at = b.depth(a.x[node], reach, part)
    deep = at.value > least * np.maximum(around, b.sizes[at.facet])
    enclosed = b.boundary.closed and not (at.facet >= 0).any()
    if enclosed and winding(a.x[node[0]], b.corners) > 0.5 or b.boundary.closed and deep.any():
        part = np.arange(len(b.corners))
        at = b.depth(a.x[node], np.inf)
        deep = at.value > least * np.maximum(around, b.sizes[at.facet])
    i = np.flatnonzero(deep)
    depth, scale = at.value[i], np.maximum(around, b.sizes[at.facet])[i]
    nodes = np.column_stack([node[i], node[i]])
    inside = Found(nodes, a.x[node[i]], depth, depth / scale, at.facet[i])
    start, limit = at.value[end], least * np.maximum(size, b.sizes.min())
    through = _straddles(at, end) & (start < -limit[:, None]).all(axis=1)
    limit[through] *= _THIN
    kept = ~deep[end].any(axis=1) & (start.sum(axis=1) + length > 2.0 * limit)
    ends, size, start, limit, near = (v[kept] for v in (ends, size, start, limit, near))
    place, depth, facet = _deepest(ends, start, limit, b, part)
    size = np.maximum(size, b.sizes[facet])
    deep = depth > np.where(through[kept], limit, least * size)
    crossing = Found(a.boundary.edges[near], place, depth, depth / size, facet).part(deep)
    return Found._make(np.concatenate(pair) for pair in zip(inside, crossing, strict=True))


def _edges_near(a: Placed, b: Placed, least: float) -> IntArray:
    """Edges of `a` that may be as deep in `b`, by boxes."""
    ends = a.x[a.boundary.edges]
    if b.boundary.closed:
        floor = least * max(float(a.sizes.min()), float(b.sizes.min()))
        shrink = np.minimum(floor, _SHRINK * (b.box[1] - b.box[0]))
    else:  # what is inside need not be in the box
        shrink = np.full(3, -float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max()))
    inner = np.array([b.box[0] + shrink, b.box[1] - shrink])
    return np.flatnonzero(_meet(ends.min(axis=1), ends.max(axis=1), inner))


def _straddles(at: Depth, end: IntArray) -> BoolArray:
    """Whether the ends (n, 2) of edges are over facets that face opposite ways, shape (n,)."""
    normal = at.normal[end]
    cosine = np.einsum("ni,ni->n", normal[:, 0], normal[:, 1])
    opposite = cosine < _OPPOSITE * np.linalg.norm(normal, axis=2).prod(axis=1)
    both: BoolArray = opposite & at.over[end].all(axis=1)
    return both


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
    n = len(ends)
    span = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(span, axis=1)
    place, best, facet = ends[:, 0].copy(), np.full(n, -np.inf), np.full(n, -1)
    edge, s, d = np.arange(n), np.tile([0.0, 1.0], (n, 1)), start
    for _ in range(_ROUNDS):
        way = (s[:, 1] - s[:, 0]) * length[edge]
        known = np.maximum(limit, (1.0 + _PRECISE) * best)[edge]
        open_ = np.flatnonzero(d.sum(axis=1) + way > 2.0 * known)
        if not open_.size:
            break
        edge, s, d, way = edge[open_], s[open_], d[open_], way[open_]
        at = s[:, :1] + np.linspace(0.0, 1.0, _PARTS + 1) * (s[:, 1:] - s[:, :1])
        points = ends[edge, None, 0] + at[:, 1:-1, None] * span[edge, None]
        reach = np.maximum(d.max(axis=1), limit[edge]) + 0.5 * way
        found = b.depth(points.reshape(-1, 3), np.repeat(reach, _PARTS - 1), chosen)
        value = found.value.reshape(-1, _PARTS - 1)
        order = np.lexsort((-found.value, np.repeat(edge, _PARTS - 1)))
        of = np.repeat(edge, _PARTS - 1)[order]
        first = order[np.unique(of, return_index=True)[1]]
        better = first[found.value[first] > best[edge[first // (_PARTS - 1)]]]
        k = edge[better // (_PARTS - 1)]
        place[k], best[k] = points.reshape(-1, 3)[better], found.value[better]
        facet[k] = found.facet[better]
        known_at = np.column_stack([d[:, 0], value, d[:, 1]])
        s, d = (np.stack([v[:, :-1], v[:, 1:]], axis=-1).reshape(-1, 2) for v in (at, known_at))
        edge = np.repeat(edge, _PARTS)
    return place, best, facet


class Finding(NamedTuple):
    """The worst of what a look found of a kind.

    Attributes:
        kind: "edge through a body" or "node inside a body".
        depth: Of the deepest point [m].
        size: The same in facet sizes [-].
        place: Where it is [m], shape (3,).
        bodies: Name of the body it belongs to, and of the one it is in.
        nodes: Input numbers of the edge's ends, or of the node.
        text: Sentence with all this and a remedy.
    """

    kind: str
    depth: float
    size: float
    place: FloatArray
    bodies: tuple[str, str]
    nodes: tuple[int, ...]
    text: str


class Pause(NamedTuple):
    """How far two bodies may move relative to each other until the next look.

    Attributes:
        least: [m] At least; a look is due after it and `_STEPS` steps.
        most: [m] At most, in however few steps.
    """

    least: float
    most: float


class _Watched:
    """Two boundaries that must not cross.

    Args:
        surfaces: The whole boundaries of two bodies; of a contact of a body with itself its slave
            and its master.
        contacts: Those between them.
        whole: In a contact of a body with itself, its whole boundary.
    """

    def __init__(
        self, surfaces: tuple[Surface, Surface], contacts: Sequence[Any], whole: Surface | None
    ) -> None:
        self.surfaces, self._whole = surfaces, whole
        self.needed = [*surfaces, *([whole] if whole else [])]
        self._turn = 0
        self._boundaries = [Boundary(s.facets) for s in surfaces]
        self._roles = [
            {role: _belong(s, [getattr(c, role) for c in contacts]) for role in ("slave", "master")}
            for s in surfaces
        ]

    def look(self, positions: dict[int, FloatArray], both: bool) -> tuple[list[Finding], Pause]:
        """What is inside, and how long nothing else may be.

        Args:
            positions: Points of each of the surfaces `needed` [m], by its id.
            both: Look at the nodes and edges of both; else of one and the other in turn. Where
                edges cross, those of either show it.
        """
        sides = [
            Placed(b, positions[id(s)])
            for b, s in zip(self._boundaries, self.surfaces, strict=True)
        ]
        boxes = sides[0].box, sides[1].box
        gap = box_gap(*boxes)
        findings: list[Finding] = []
        # Boxes of open surfaces do not hold what is behind them.
        if gap > 0.0 and self._whole is None:
            far = gap + _LOOK * max(float(s.sizes.min()) for s in sides)
            return findings, Pause(far, far)
        self._turn = 1 - self._turn
        for k in (0, 1) if both else (self._turn,):
            found = intrusions(sides[k], sides[1 - k])
            if self._whole is not None:
                found = self._enclosed(found, k, positions[id(self._whole)])
            findings += self._worst(found, k)
        common = np.array([np.maximum(*(b[0] for b in boxes)), np.minimum(*(b[1] for b in boxes))])
        near = [s.sizes[s.facets_near(common)] for s in sides]
        smallest = [n.min() if n.size else s.sizes.min() for n, s in zip(near, sides, strict=True)]
        facet = float(max(smallest))
        return findings, Pause(_LOOK * facet, facet)

    def _enclosed(self, found: Found, k: int, x: FloatArray) -> Found:
        """Those that the body's whole boundary (p, 3) encloses beside the part they lie on.

        What is behind an open surface may as well be beyond the body. A point of the boundary sees
        less than a turn of it, and more than that where another part of the body encloses it.
        """
        assert self._whole is not None
        facets = self._whole.facets
        at = np.asarray(np.searchsorted(self._whole.points, self.surfaces[k].points))
        own = at[found.nodes]
        inside = np.zeros(len(own), dtype=bool)
        for i in range(len(own)):
            with_one, with_two = ((facets == own[i, end]).any(axis=1) for end in (0, 1))
            others = ~(with_one & with_two)
            inside[i] = winding(found.place[i], x[facets[others]]) > 1.0
        return found.part(inside)

    def _worst(self, found: Found, k: int) -> Iterator[Finding]:
        """The worst node and the worst edge of side k in the other one."""
        for is_node in (True, False):
            some = np.flatnonzero(found.is_node == is_node)
            if some.size:
                yield self._told(found, int(some[found.size[some].argmax()]), k)

    def _told(self, found: Found, i: int, k: int) -> Finding:
        """Number i of what was found of side k, in words."""
        (surface, mine), (other, its) = ((self.surfaces[j], self._roles[j]) for j in (k, 1 - k))
        one, two = surface.body.name, other.body.name
        ends, corners = found.nodes[i], other.facets[found.facet[i]]
        nodes = tuple(int(n) for n in surface.original[np.unique(ends)])
        facet = sorted(int(n) for n in other.original[corners])
        held = bool(mine["slave"][ends].all() and its["master"][corners].all())
        holds = bool(mine["master"][ends].all() and its["slave"][corners].all())
        if len(nodes) == 1:
            kind, what = "node inside a body", f"node {nodes[0]} of {one!r}"
        else:
            kind = "edge through a body"
            what = f"the edge between nodes {nodes[0]} and {nodes[1]} of {one!r}"
        if not (held or holds):
            remedy = (
                f"no contact is declared of it with the facet of nodes {facet} of {two!r}: extend "
                "the markers of the contact's surfaces to both"
            )
        elif len(nodes) == 1 and held:
            remedy = f"the facet of nodes {facet} of {two!r} did not hold it: use a smaller dt"
        else:
            remedy = (
                "contact holds nodes of the slave, but no edges, out of facets: use a finer mesh "
                "of the slave there, round the edges, or exchange slave and master"
            )
        place = ", ".join(f"{c:.4g}" for c in found.place[i])
        depth, size = float(found.depth[i]), float(found.size[i])
        text = (
            f"{what} lies up to {depth:.3g} m, or {size:.2g} of a facet, inside {two!r} at "
            f"({place}); {remedy}"
        )
        return Finding(kind, depth, size, found.place[i], (one, two), nodes, text)


def _belong(surface: Surface, declared: Sequence[Surface]) -> BoolArray:
    """Which points of a surface belong to one of those declared of its body, shape (p,)."""
    result = np.zeros(len(surface.points), dtype=bool)
    for s in declared:
        if s.body is surface.body:
            result |= np.isin(surface.points, s.points)
    return result


class OverlapWatch:
    """Looks whether bodies that are in a contact with each other end up inside each other.

    Bodies of which no contact is declared may pass through each other, and obstacles are not
    looked at. A look is due when the bodies have moved relative to each other so far that their
    boxes can touch; then by a quarter of a facet since the last one, and four steps or a facet.

    Args:
        system: The scene.
    """

    def __init__(self, system: Any) -> None:
        self._comm, self._bodies = system.comm, system.bodies
        self._contacts: dict[tuple[int, ...], list[Any]] = {}
        for contact, bodies in zip(system.contacts, system.contact_bodies, strict=True):
            if len(bodies) == 2 and all(hasattr(b, "mesh") for b in contact.bodies):
                self._contacts.setdefault(tuple(sorted(bodies)), []).append(contact)
        self._pause: dict[tuple[int, ...], Pause] = {}
        self._steps = dict.fromkeys(self._contacts, 0)
        self._last: dict[tuple[int, ...], list[FloatArray]] = {}
        self._watched: dict[tuple[int, ...], list[_Watched]] = {}
        self._surfaces: dict[int, Surface] = {}

    def look(self, u: Sequence[FloatArray], *, last: bool = False) -> list[Finding]:
        """The worst finding of each kind, if a look is due. Collective, the same on all ranks.

        Args:
            u: Owned displacements of all bodies [m]; kept until the next look, not to be changed.
            last: Look again wherever anything has moved.
        """
        findings: list[Finding] = []
        for key in self._due(u, last):
            both = last or key not in self._last
            self._last[key], self._steps[key] = [u[k] for k in key], 0
            watched = self._watched_of(key)
            of = {id(self._bodies[k]): u[k] for k in key}
            needed = {id(s): s for w in watched for s in w.needed}
            positions = {i: s.positions(of[id(s.body)]) for i, s in needed.items()}
            looks = [each.look(positions, both) for each in watched]
            findings += [f for found, _ in looks for f in found]
            self._pause[key] = min(pause for _, pause in looks)
        worst: dict[str, Finding] = {}
        for f in findings:
            if f.kind not in worst or f.size > worst[f.kind].size:
                worst[f.kind] = f
        return list(worst.values())

    def _due(self, u: Sequence[FloatArray], last: bool) -> list[tuple[int, ...]]:
        """Pairs that have moved enough. Collective."""
        fresh = [key for key in self._contacts if key not in self._last]
        known = list(self._last)
        if not known:
            return fresh
        # Largest motion in each direction; the opposite ones are the least.
        moved = np.full((len(known), 2, 2, 3), -np.inf)
        for i, key in enumerate(known):
            for j, (k, before) in enumerate(zip(key, self._last[key], strict=True)):
                d = (u[k] - before).reshape(-1, 3)
                moved[i, j] = d.max(axis=0, initial=-np.inf), (-d).max(axis=0, initial=-np.inf)
        self._comm.Allreduce(MPI.IN_PLACE, moved, op=MPI.MAX)
        apart = np.maximum(moved[:, 0, 0] + moved[:, 1, 1], moved[:, 1, 0] + moved[:, 0, 1])
        ways = np.linalg.norm(np.maximum(apart, 0.0), axis=1)
        due = []
        for key, way in zip(known, ways.tolist(), strict=True):
            self._steps[key] += 1
            least, most = self._pause[key]
            enough = way > (least if self._steps[key] >= _STEPS else most)
            if enough or (last and way > 0.0):
                due.append(key)
        return fresh + due

    def _watched_of(self, key: tuple[int, ...]) -> list[_Watched]:
        """What to look at of a pair, gathered at its first look. Collective."""
        if key not in self._watched:
            whole = [self._boundary(k) for k in key]
            contacts = self._contacts[key]
            if key[0] == key[1]:
                parts = [_Watched((c.slave, c.master), [c], whole[0]) for c in contacts]
            else:
                parts = [_Watched((whole[0], whole[1]), contacts, None)]
            self._watched[key] = parts
        return self._watched[key]

    def _boundary(self, k: int) -> Surface:
        """The whole boundary of a body. Collective."""
        if k not in self._surfaces:
            body = self._bodies[k]
            self._surfaces[k] = Surface(body, compat.exterior_facets(body.mesh))
        return self._surfaces[k]
