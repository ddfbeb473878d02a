"""A body and an obstacle that must not cross."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.crossings import Finding, Pause, belong, places, point
from dolfinx_nts.contact.intrusion import LEAST, Boundary, Placed
from dolfinx_nts.contact.obstacles import Obstacle
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.kernels.bounded_slope import highest
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: So many points of an obstacle are looked for in a body, each next to another of the body's.
_INNER = 8


class _Near(NamedTuple):
    """Facets that may be in an obstacle; axis 0 = facet.

    Attributes:
        facet: Their numbers, shape (n,).
        place: The deepest point relative to the obstacle's motion [m], shape (n, 3).
        depth: Its depth [m], shape (n,).
        limit: Depth that is told [m], shape (n,).
        corner: Depth of the deepest corner, negative outside [m], shape (n,).
        size: Mean edge length [m], shape (n,).
    """

    facet: IntArray
    place: FloatArray
    depth: FloatArray
    limit: FloatArray
    corner: FloatArray
    size: FloatArray

    @property
    def deep(self) -> BoolArray:
        """Which are in the obstacle, shape (n,)."""
        return self.depth > self.limit

    @property
    def between(self) -> BoolArray:
        """Which are as much deeper in it than their nodes, shape (n,)."""
        return self.depth - np.maximum(self.corner, 0.0) > self.limit

    def select(self, chosen: BoolArray) -> _Near:
        """Some of them."""
        return _Near._make(a[chosen] for a in self)


class _Watched(NamedTuple):
    """What is looked at of a body.

    Attributes:
        surface: The whole boundary; where another contact with the obstacle looks at that, the
            slave.
        facets: Facets of the slave, and those of the rest that are outside at the start, (m,).
        held: Whether each facet of the surface is the slave's.
        points: Points of the rest that are outside at the start, shape (n,).
        scale: Size of the largest facet of each, which counts up to the obstacle's width and the
            body's bulk [m], (n,).
        crossed: What the obstacle goes through between nodes at the start.
        least: Smallest depth of an obstacle in the body that is told [m].
    """

    surface: Surface
    facets: IntArray
    held: BoolArray
    points: IntArray
    scale: FloatArray
    crossed: list[Finding]
    least: float


class ObstacleContact:
    """The body of a contact and its obstacle, which may pass between nodes of the slave.

    Nodes and facets of the rest of the boundary, which no contact holds, are looked at, too, save
    those that are in the obstacle at the start of the scene: a floor or a bore is larger in a scene
    than what it stands for. If one of finite width starts between the nodes of a facet of the rest,
    it is told, but not as grave. An obstacle inside the body, without a facet in it, is told, too.

    Args:
        contact: The contact.
        body: Number of its body.
        slaves: All slaves of the same obstacle.
        boundary: The whole boundary of a body by its number. Collective.
        start: Owned displacements of all bodies at the start of the scene [m].
    """

    def __init__(
        self,
        contact: Any,
        body: int,
        slaves: Sequence[Surface],
        boundary: Callable[[int], Surface],
        start: Callable[[], Sequence[FloatArray]],
    ) -> None:
        self.contact, self._body, self._slaves = contact, body, slaves
        self._boundary, self._start = boundary, start
        #: Another contact with the same obstacle looks at the rest.
        self._sees_rest = slaves[0] is contact.slave and contact.slave.body.mesh is not None

    def where(self, u: Sequence[FloatArray], time: float) -> list[FloatArray]:
        """What moves, each a displacement of its points [m], shape (3 n,). Collective."""
        slave, obstacle = self.contact.slave, self.contact.master
        return [u[self._body], obstacle.displacement(time, slave.body.comm)]

    def look(self, where: list[FloatArray]) -> tuple[list[Finding], Pause]:
        """The deepest facet of the slave, node and facet of the rest, or the obstacle. Collective.

        Of the rest a facet is told only where its nodes are not as deep and the slave's facets are
        not in the obstacle, and the obstacle only where nothing else is.
        """
        u, moved = where
        watched = self._watched
        x = watched.surface.positions(u) - moved
        gap = self.contact.master.gap(x).value
        near, pause = self._facets(watched.surface, watched.facets, x, gap)
        held = watched.held[near.facet]
        found = self._of_slave(near.select(near.deep & held), moved)
        found = found or self._of_rest(near.select(near.between & ~held), moved)
        if watched.points.size:
            nodes, clear = self._nodes(x, gap, moved)
            found, pause = found + nodes, pause.shorter(clear)
        if self._sees_rest and not found:
            found = self._inside(x, gap, moved)
        return found + watched.crossed, pause

    def inside(self, where: list[FloatArray]) -> list[Finding]:
        """The obstacle, if it is inside the body. Collective."""
        u, moved = where
        if not self._sees_rest:
            return []
        x = self._watched.surface.positions(u) - moved
        return self._inside(x, self.contact.master.gap(x).value, moved)

    def passed(
        self, before: list[FloatArray], after: list[FloatArray], way: float, through: float
    ) -> list[Finding]:
        """What was in the obstacle on the straight way from one look to the next. Collective.

        Contact follows the paths of the slave's nodes itself, but not what is between them.

        Args:
            before: Of `where`.
            after: The same now.
            way: Relative motion between them [m].
            through: That which may take the obstacle through a facet [m].
        """
        # Where the ends are clear, so is as much of the way.
        first, last = (self.look(w)[1].clear / way for w in (before, after))
        part, findings = max(0.0, 1.0 - first - last), []
        for k in range(number := places(part * way, through)):
            s = first + part * k / (number - 1)
            between = [(1.0 - s) * b + s * a for b, a in zip(before, after, strict=True)]
            findings += self.look(between)[0]
        return findings

    @cached_property
    def _edges(self) -> Boundary:
        """The whole boundary with its edges. Collective."""
        return Boundary(self._watched.surface.facets)

    @cached_property
    def _watched(self) -> _Watched:
        """What to look at, gathered at the first look. Collective."""
        obstacle, slave = self.contact.master, self.contact.slave
        none = np.zeros(0, dtype=np.int64)
        if not self._sees_rest:
            every = np.arange(len(slave.facets))
            held = np.ones(len(every), dtype=bool)
            return _Watched(slave, every, held, none, np.zeros(0), [], np.inf)
        whole = self._boundary(self._body)
        x = whole.positions(self._start()[self._body])
        gap, size = obstacle.gap(x).value, np.zeros(len(x))
        for corner in whole.facets.T:
            np.maximum.at(size, corner, fc.size(x[whole.facets]))
        # A facet does not explain how deep a body lies in the obstacle that is thinner than it.
        thin = min(obstacle.width, Placed(Boundary(whole.facets), x).bulk)
        scale = np.minimum(size, thin)
        free = np.flatnonzero(~belong(whole, self._slaves) & (gap >= -LEAST * scale))
        rest = np.flatnonzero(~_shared(whole, self._slaves))
        begun, _ = self._facets(whole, rest, x, gap)
        begun = begun.select(begun.deep)
        held = _shared(whole, [slave])
        facets = np.append(np.flatnonzero(held), np.setdiff1d(rest, begun.facet))
        crossed = self._at_start(whole, begun)
        least = LEAST * float(scale.min())
        return _Watched(whole, facets, held, free, scale[free], crossed, least)

    def _nodes(
        self, x: FloatArray, gap: FloatArray, moved: FloatArray
    ) -> tuple[list[Finding], Pause]:
        """The deepest of the rest's points, and how long none may be as deep.

        Args:
            x: Points of the boundary relative to the obstacle's motion [m], shape (p, 3).
            gap: Their gaps [m], shape (p,).
            moved: That motion [m], shape (3,).
        """
        watched, points, scale = self._watched, self._watched.points, self._watched.scale
        gap = gap[points]
        far, smallest = max(0.0, float(gap.min())), float(scale.min())
        pause = Pause(far, smallest)
        i = int((gap / scale).argmin())
        depth, size = -float(gap[i]), -float(gap[i] / scale[i])
        if size <= LEAST:
            return [], pause
        name, other = watched.surface.body.name, self.contact.master.name
        node = int(watched.surface.original[points[i]])
        place = x[points[i]] + moved
        text = (
            f"node {node} of {name!r} lies inside {other!r}, by {depth:.3g}, or "
            f"{size:.2g} of a facet, at ({point(place)}); no contact is declared of it with "
            f"{other!r}: extend the marker of the slave to it"
        )
        bodies = name, other
        return [Finding("node in an obstacle", depth, size, place, bodies, (node,), text)], pause

    def _facets(
        self, surface: Surface, chosen: IntArray, x: FloatArray, gap: FloatArray
    ) -> tuple[_Near, Pause]:
        """Facets that are near, and how long none may be as deep as is told.

        Args:
            surface: Their surface.
            chosen: Facets to look at, shape (m,).
            x: Points of the surface relative to the obstacle's motion [m], shape (p, 3).
            gap: Gaps of the points [m], shape (p,).
        """
        obstacle, facets = self.contact.master, surface.facets[chosen]
        corners, lowest = x[facets], gap[facets].min(axis=1)
        size = fc.size(corners)
        # Nothing is deeper in a thin obstacle than half its width.
        scale = np.minimum(size, obstacle.width)
        # No point of a facet is farther from its next corner.
        near = np.flatnonzero(lowest < size)
        smallest = float(scale[near if near.size else slice(None)].min(initial=np.inf))
        clear, limit = 0.0, LEAST * scale[near]
        if near.size:
            place, depth = sunk(obstacle, corners[near], limit)
        else:
            clear = float((lowest - size).min(initial=np.inf))
            place, depth = np.zeros((0, 3)), np.zeros(0)
        found = _Near(chosen[near], place, depth, limit, -lowest[near], size[near])
        return found, Pause(clear, smallest, obstacle.width)

    def _of_slave(self, deep: _Near, moved: FloatArray) -> list[Finding]:
        """The deepest of the slave's facets, and what to do."""
        if not deep.facet.size:
            return []
        i = _worst(deep)
        if deep.corner[i] > deep.limit[i]:
            remedy = "contact did not hold its nodes: use a smaller dt"
        else:
            remedy = (
                "contact holds nodes of the slave, but not what is between them, out of an "
                "obstacle: use a finer mesh of the slave there"
            )
        return [self._told(self._watched.surface, deep, i, moved, remedy)]

    def _of_rest(self, deep: _Near, moved: FloatArray) -> list[Finding]:
        """The deepest of the rest's facets, and what to do."""
        if not deep.facet.size:
            return []
        remedy = (
            f"no contact is declared of it with {self.contact.master.name!r}: extend the marker "
            "of the slave to it, with a mesh fine enough there, as contact holds nodes only"
        )
        return [self._told(self._watched.surface, deep, _worst(deep), moved, remedy)]

    def _at_start(self, surface: Surface, deep: _Near) -> list[Finding]:
        """The deepest of the rest's facets at the start that has no node in the obstacle."""
        deep = deep.select(deep.corner <= 0.0)
        if not (deep.facet.size and np.isfinite(self.contact.master.width)):
            return []
        remedy = (
            "it starts there without a declared contact, so it is not looked at: unless the "
            "obstacle is longer than the thing that it stands for, move the two apart"
        )
        told = self._told(surface, deep, _worst(deep), np.zeros(3), remedy)
        return [told._replace(kind="facet starts in an obstacle", grave=False)]

    def _told(
        self, surface: Surface, some: _Near, i: int, moved: FloatArray, remedy: str
    ) -> Finding:
        """Number i of some facets in words."""
        name, other = surface.body.name, self.contact.master.name
        nodes = tuple(sorted(int(n) for n in surface.original[surface.facets[some.facet[i]]]))
        depth, size = float(some.depth[i]), float(some.depth[i] / some.size[i])
        place: FloatArray = some.place[i] + moved
        text = (
            f"the facet of nodes {list(nodes)} of {name!r} lies inside {other!r}, by up to "
            f"{depth:.3g}, or {size:.2g} of its size, at ({point(place)}); {remedy}"
        )
        return Finding("facet in an obstacle", depth, size, place, (name, other), nodes, text)

    def _inside(self, x: FloatArray, gap: FloatArray, moved: FloatArray) -> list[Finding]:
        """The obstacle, if a point of it is inside the body and no facet is in it.

        Args:
            x: Points of the boundary relative to the obstacle's motion [m], shape (p, 3).
            gap: Their gaps [m], shape (p,).
            moved: That motion [m], shape (3,).
        """
        obstacle, whole, least = self.contact.master, self._watched.surface, self._watched.least
        some = np.append(gap.argmin(), np.linspace(0, len(x) - 1, _INNER - 1).astype(int))
        inner = obstacle.inner_points(x[some])
        low, high = x.min(axis=0) + least, x.max(axis=0) - least
        inner = inner[((inner > low) & (inner < high)).all(axis=1)]
        if not len(inner):
            return []
        placed = Placed(self._edges, x)
        found = placed.depth(inner, np.inf)
        sizes = placed.sizes[found.facet]
        scale = np.minimum(sizes, obstacle.width)
        i = int((found.value / scale).argmax())
        if found.value[i] <= LEAST * scale[i]:
            return []
        # A ring is round a post, and what a wall goes through is in part behind it.
        if self._facets(whole, np.arange(len(whole.facets)), x, gap)[0].deep.any():
            return []
        name, other = whole.body.name, obstacle.name
        depth, size = float(found.value[i]), float(found.value[i] / sizes[i])
        place: FloatArray = inner[i] + moved
        text = (
            f"{other!r} lies inside {name!r} as a whole, at ({point(place)}), {depth:.3g}, or "
            f"{size:.2g} of a facet, from the boundary; contact holds nodes of the slave out of "
            "an obstacle, but not what is between them: use a smaller dt, or a finer mesh of the "
            "slave where it came in"
        )
        return [Finding("obstacle in a body", depth, size, place, (name, other), (), text)]


def _worst(some: _Near) -> int:
    """Number of the facet that lies deepest for its size."""
    return int((some.depth / some.size).argmax())


def _shared(surface: Surface, declared: Sequence[Surface]) -> BoolArray:
    """Which facets of a surface belong to one of those declared of its body, shape (m,)."""
    tables = [s.points[s.facets] for s in (*declared, surface) if s.body is surface.body]
    rows = np.sort(np.concatenate(tables), axis=1)
    number = np.unique(rows, axis=0, return_inverse=True)[1].ravel()
    own = len(surface.facets)
    return np.isin(number[-own:], number[:-own])


def sunk(
    obstacle: Obstacle, corners: FloatArray, limit: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Deepest points of facets in an obstacle.

    A facet is made of straight lines between two opposite sides, or from a corner of a triangle to
    the side opposite. How deep the deepest point of each lies changes by no more than the way of
    its ends.

    Args:
        obstacle: The obstacle.
        corners: Corners of the facets relative to its motion [m], shape (m, nc, 3).
        limit: Depth of interest [m], > 0, shape (m,).

    Returns:
        Points [m] (m, 3) and their depths [m] (m,), to one part in a hundred of the depth; where
        nothing is as deep as the limit, of some point.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    d = corners[:, -1] if corners.shape[1] == 4 else a
    length = np.linalg.norm([d - a, c - b], axis=2).max(axis=0)

    def line(facet: IntArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        one, two = (p[facet] + s[:, None] * (q - p)[facet] for p, q in ((a, d), (b, c)))
        return one, two

    # Bounds, because a line that is taken for less deep than it is hides those beside it.
    start = np.column_stack(
        [obstacle.depth_bound(a, b, limit), obstacle.depth_bound(d, c, limit)]
    )
    at, depth = highest(
        lambda facet, s, _: obstacle.depth_bound(*line(facet, s), limit[facet]),
        start, length, limit,
    )  # fmt: skip
    place: FloatArray = corners.mean(axis=1)
    deep = np.flatnonzero(depth > limit)
    if deep.size:
        one, two = line(deep, at[deep])
        span = two - one
        along, _ = highest(
            lambda k, s, _: -obstacle.gap(one[k] + s[:, None] * span[k]).value,
            -np.column_stack([obstacle.gap(one).value, obstacle.gap(two).value]),
            np.linalg.norm(span, axis=1),
            limit[deep],
        )
        place[deep] = one + along[:, None] * span
    return place, depth
