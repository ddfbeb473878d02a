"""Two bodies that must not cross: what of one lies inside the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.intrusion import Boundary, Found, Placed, box_gap, intrusions
from dolfinx_nts.contact.surfaces import Surface, winding
from dolfinx_nts.types import BoolArray, FloatArray

#: Bodies whose boxes meet are looked at again after a relative motion of this many facet sizes.
_LOOK = 0.25
#: A motion within which one may pass through the other is looked at after so many of the least of
#: such motions, but at no more places than this.
_BETWEEN, _MOST = 0.5, 64


class Finding(NamedTuple):
    """The worst of what a look found of a kind.

    Attributes:
        kind: "edge through a body", "node inside a body", "facet in an obstacle", "node in an
            obstacle", "obstacle in a body", "facet starts in an obstacle" or "contact inside a
            rim".
        depth: Of the deepest point, or of a contact the distance from the rim [m].
        size: The same in facet sizes, of a contact in widths of the slave's surface [-].
        place: Where it is [m], shape (3,).
        bodies: Name of the body it belongs to, and of the body or obstacle it is in or on.
        nodes: Input numbers of the edge's ends, of the node, or of the facet's corners.
        text: Sentence with all this and a remedy.
        grave: Whether the result may be wrong.
    """

    kind: str
    depth: float
    size: float
    place: FloatArray
    bodies: tuple[str, str]
    nodes: tuple[int, ...]
    text: str
    grave: bool = True

    @property
    def about(self) -> tuple[str, ...]:
        """The two names, whichever is inside the other."""
        return tuple(sorted(self.bodies))


class Pause(NamedTuple):
    """How far two bodies may move relative to each other until the next look.

    Attributes:
        clear: [m] As far they cannot touch.
        unit: [m] How far one may move in the other.
        through: [m] Less does not take one through the other.
    """

    clear: float
    unit: float
    through: float = np.inf

    @property
    def due(self) -> float:
        """A look is due after this motion [m]."""
        return self.clear + _LOOK * self.unit

    def shorter(self, other: Pause) -> Pause:
        """One that is no longer than both."""
        return Pause(*map(min, self, other))


class Watched:
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
        self._bulks: list[float] | None = None
        self._boundaries = [Boundary(s.facets) for s in surfaces]
        self._roles = [
            {role: belong(s, [getattr(c, role) for c in contacts]) for role in ("slave", "master")}
            for s in surfaces
        ]

    def passed(
        self,
        before: dict[int, FloatArray],
        after: dict[int, FloatArray],
        way: float,
        through: float,
    ) -> Iterator[Finding]:
        """Return what was inside on the way between two looks.

        Args:
            before: Points of each of the surfaces `needed` at the last look [m], by its id.
            after: The same now.
            way: Relative motion between them [m].
            through: That which may take one through the other [m].
        """
        boxes = [
            [Placed(b, x[id(s)]).box for x in (before, after)]
            for b, s in zip(self._boundaries, self.surfaces, strict=True)
        ]
        first, last = _meeting(*np.array(boxes))
        number = places((last - first) * way, through)
        for part in np.linspace(first, last, number) if first < last else ():
            x = {i: (1.0 - part) * before[i] + part * after[i] for i in after}
            yield from self.look(x)[0]

    def look(self, positions: dict[int, FloatArray]) -> tuple[list[Finding], Pause]:
        """Return what is inside, and how long nothing else may be.

        Args:
            positions: Points of each of the surfaces `needed` [m], by its id.
        """
        known = self._bulks or (None, None)
        sides = [
            Placed(b, positions[id(s)], bulk)
            for b, s, bulk in zip(self._boundaries, self.surfaces, known, strict=True)
        ]
        self._bulks = [s.bulk for s in sides]
        boxes = sides[0].box, sides[1].box
        gap = box_gap(*boxes)
        findings: list[Finding] = []
        # While one passes through the other, an edge of one of them is past the other's middle.
        thickness = max(s.thickness for s in sides) if self._whole is None else np.inf
        # Boxes of open surfaces do not hold what is behind them.
        if gap > 0.0 and self._whole is None:
            way = min(max(float(s.sizes.min()) for s in sides), thickness)
            return findings, Pause(gap, way, thickness)
        common = np.array([np.maximum(*(b[0] for b in boxes)), np.minimum(*(b[1] for b in boxes))])
        near = [s.sizes[s.facets_near(common)] for s in sides]
        smallest = [n.min() if n.size else s.sizes.min() for n, s in zip(near, sides, strict=True)]
        facet = float(max(smallest))
        way = min(facet, thickness)
        for k in (0, 1):
            found = intrusions(sides[k], sides[1 - k])
            if self._whole is not None:
                found = self._enclosed(found, k, positions[id(self._whole)])
            findings += self._worst(found, k)
        return findings, Pause(0.0, way, thickness)

    def _enclosed(self, found: Found, k: int, x: FloatArray) -> Found:
        """Choose what the body's whole boundary (p, 3) encloses beside the part it lies on.

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
        return found.select(inside)

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
                "contact holds nodes of the slave out of facets, and sharp edges out of edges: use "
                "a finer mesh of the slave there, or exchange slave and master"
            )
        depth, size = float(found.depth[i]), float(found.size[i])
        if found.middle[i]:
            where = f"past the middle of {two!r}, inside it by up to {depth:.3g},"
        else:
            where = f"inside {two!r}, by up to {depth:.3g}, or {size:.2g} of a facet,"
        text = f"{what} lies {where} at ({point(found.place[i])}); {remedy}"
        return Finding(kind, depth, size, found.place[i], (one, two), nodes, text)


def places(way: float, through: float) -> int:
    """Return at how many places a way is looked at.

    Args:
        way: Relative motion [m].
        through: That which may take one through the other [m].
    """
    return min(_MOST, int(way / (_BETWEEN * through)) + 2)


def _meeting(one: FloatArray, two: FloatArray) -> tuple[float, float]:
    """First and last part of a motion in which boxes may meet; the first is larger if they do not.

    Of each box the smallest and largest coordinates at the start and the end [m], (2, 2, 3).
    """
    # Points that move evenly stay within bounds that move evenly. All of these must be negative.
    apart = np.concatenate([one[:, 0] - two[:, 1], two[:, 0] - one[:, 1]], axis=1)
    start, change = apart[0], apart[1] - apart[0]
    if (apart > 0.0).all(axis=0).any():
        return 1.0, 0.0
    zero = np.divide(-start, change, out=np.zeros_like(start), where=change != 0.0)
    first = zero[(start > 0.0) & (change < 0.0)].max(initial=0.0)
    last = zero[(start <= 0.0) & (apart[1] > 0.0)].min(initial=1.0)
    return float(first), float(last)


def point(x: FloatArray) -> str:
    """Coordinates (3,) for a message."""
    return ", ".join(f"{c:.4g}" for c in x)


def belong(surface: Surface, declared: Sequence[Surface]) -> BoolArray:
    """Return which points of a surface belong to one of those declared of its body, shape (p,)."""
    result = np.zeros(len(surface.points), dtype=bool)
    for s in declared:
        if s.body is surface.body:
            result |= np.isin(surface.points, s.points)
    return result


class BodyPair:
    """Two bodies, or twice the same, of which contacts are declared with each other.

    Args:
        bodies: Their numbers.
        contacts: The contacts between them.
        boundary: The whole boundary of a body by its number. Collective.
    """

    def __init__(
        self,
        bodies: tuple[int, ...],
        contacts: Sequence[Any],
        boundary: Callable[[int], Surface],
    ) -> None:
        self._bodies, self.contacts, self._boundary = bodies, contacts, boundary

    def where(self, u: Sequence[FloatArray], time: float) -> list[FloatArray]:
        """Return what moves, each a displacement of its points [m], shape (3 n,)."""
        return [u[k] for k in self._bodies]

    @cached_property
    def _parts(self) -> Sequence[Any]:
        """What to look at, gathered at the first look. Collective."""
        one, two = (self._boundary(k) for k in self._bodies)
        if one is two:
            return [Watched((c.slave, c.master), [c], one) for c in self.contacts]
        return [Watched((one, two), self.contacts, None)]

    def look(self, where: list[FloatArray]) -> tuple[list[Finding], Pause]:
        """Return what is inside, and how long nothing else may be. Collective."""
        positions = self._positions(where)
        looks = [part.look(positions) for part in self._parts]
        pause = reduce(Pause.shorter, (pause for _, pause in looks))
        return [f for found, _ in looks for f in found], pause

    def passed(
        self, before: list[FloatArray], after: list[FloatArray], way: float, through: float
    ) -> list[Finding]:
        """Return what was inside on the way from one look to the next. Collective.

        Args:
            before: Of `where`.
            after: The same now.
            way: Relative motion between them [m].
            through: That which may take one through the other [m].
        """
        ends = self._positions(before), self._positions(after)
        return [f for part in self._parts for f in part.passed(*ends, way, through)]

    def _positions(self, where: list[FloatArray]) -> dict[int, FloatArray]:
        """Points of all surfaces to look at [m], by the surface's id. Collective."""
        of = {id(self._boundary(k).body): u for k, u in zip(self._bodies, where, strict=True)}
        needed = {id(s): s for part in self._parts for s in part.needed}
        return {i: s.positions(of[id(s.body)]) for i, s in needed.items()}
