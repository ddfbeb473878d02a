"""Bodies that end up inside each other, or in obstacles, which contact of nodes may not see.

Nodes of the slave are kept out of the master's facets and of obstacles; an edge of the one may
still pass through the other between its nodes, a small obstacle into a large facet, and what is not
declared as a surface is not held at all. `OverlapWatch` looks at the bodies of a run as often as
their motion asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact.intrusion import LEAST, Boundary, Found, Placed, box_gap, intrusions, sunk
from dolfinx_nts.contact.surfaces import Surface, winding
from dolfinx_nts.kernels import facets as fc

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

#: Bodies whose boxes meet are looked at again after a relative motion of this many facet sizes,
#: but only after so many steps, which resolve a crossing at all, unless they have moved by a facet.
_LOOK, _STEPS = 0.25, 4
#: A motion within which one may pass through the other is looked at after so many of the least of
#: such motions, but at no more places than this.
_BETWEEN, _MOST = 0.5, 64


class Finding(NamedTuple):
    """The worst of what a look found of a kind.

    Attributes:
        kind: "edge through a body", "node inside a body", "facet in an obstacle" or "node in an
            obstacle".
        depth: Of the deepest point [m].
        size: The same in facet sizes [-].
        place: Where it is [m], shape (3,).
        bodies: Name of the body it belongs to, and of the body or obstacle it is in.
        nodes: Input numbers of the edge's ends, of the node, or of the facet's corners.
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
        clear: [m] As far they cannot touch.
        unit: [m] How far one may move in the other.
        through: [m] Less does not take one through the other.
    """

    clear: float
    unit: float
    through: float = np.inf

    @property
    def least(self) -> float:
        """A look is due after this motion [m] and `_STEPS` steps."""
        return self.clear + _LOOK * self.unit

    @property
    def most(self) -> float:
        """A look is due after this motion [m], in however few steps."""
        return self.clear + self.unit

    def shorter(self, other: Pause) -> Pause:
        """One that is no longer than both."""
        return Pause(*map(min, self, other))


@dataclass
class _Looked:
    """The last look at a pair.

    Attributes:
        where: What was where, as of `where`.
        pause: Until the next look.
        steps: Since then.
    """

    where: list[FloatArray]
    pause: Pause
    steps: int = 0


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

    def passed(
        self,
        before: dict[int, FloatArray],
        after: dict[int, FloatArray],
        way: float,
        through: float,
    ) -> Iterator[Finding]:
        """What was inside on the way between two looks.

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
        number = min(_MOST, int((last - first) * way / (_BETWEEN * through)) + 2)
        for part in np.linspace(first, last, number) if first < last else ():
            x = {i: (1.0 - part) * before[i] + part * after[i] for i in after}
            yield from self.look(x, True)[0]

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
        # While one passes through the other, an edge of one of them is past the other's middle.
        thickness = max(float(s.extents[0]) for s in sides) if self._whole is None else np.inf
        # Boxes of open surfaces do not hold what is behind them.
        if gap > 0.0 and self._whole is None:
            way = min(max(float(s.sizes.min()) for s in sides), thickness)
            return findings, Pause(gap, way, thickness)
        self._turn = 1 - self._turn
        common = np.array([np.maximum(*(b[0] for b in boxes)), np.minimum(*(b[1] for b in boxes))])
        near = [s.sizes[s.facets_near(common)] for s in sides]
        smallest = [n.min() if n.size else s.sizes.min() for n, s in zip(near, sides, strict=True)]
        facet = float(max(smallest))
        way = min(facet, thickness)
        # Of a body smaller than a facet no edge of the other one tells anything.
        for k in (0, 1) if both or way < facet else (self._turn,):
            found = intrusions(sides[k], sides[1 - k])
            if self._whole is not None:
                found = self._enclosed(found, k, positions[id(self._whole)])
            findings += self._worst(found, k)
        return findings, Pause(0.0, way, thickness)

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
        depth, size = float(found.depth[i]), float(found.size[i])
        if found.middle[i]:
            where = f"past the middle of {two!r}, up to {depth:.3g} m inside,"
        else:
            where = f"up to {depth:.3g} m, or {size:.2g} of a facet, inside {two!r}"
        text = f"{what} lies {where} at ({_point(found.place[i])}); {remedy}"
        return Finding(kind, depth, size, found.place[i], (one, two), nodes, text)


def _meeting(one: FloatArray, two: FloatArray) -> tuple[float, float]:
    """First and last part of a motion in which boxes may meet; the first is larger if they do not.

    Args:
        one: Smallest and largest coordinates at the start and at the end [m], shape (2, 2, 3).
        two: Those of the other box.
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


def _point(x: FloatArray) -> str:
    """Coordinates (3,) for a message."""
    return ", ".join(f"{c:.4g}" for c in x)


def _belong(surface: Surface, declared: Sequence[Surface]) -> BoolArray:
    """Which points of a surface belong to one of those declared of its body, shape (p,)."""
    result = np.zeros(len(surface.points), dtype=bool)
    for s in declared:
        if s.body is surface.body:
            result |= np.isin(surface.points, s.points)
    return result


def _same_obstacle(one: Any, two: Any) -> bool:
    """Whether two contacts are of the same body with the same obstacle."""
    same = one.slave.body is two.slave.body and one.shares_master(two) is not None
    return same and one.master.motion is two.master.motion


class _BodyPair:
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
        self._bodies, self._contacts, self._boundary = bodies, contacts, boundary

    def where(self, u: Sequence[FloatArray], time: float) -> list[FloatArray]:
        """What moves, each a displacement of its points [m], shape (3 n,)."""
        return [u[k] for k in self._bodies]

    @cached_property
    def _parts(self) -> list[_Watched]:
        """What to look at, gathered at the first look. Collective."""
        one, two = (self._boundary(k) for k in self._bodies)
        if one is two:
            return [_Watched((c.slave, c.master), [c], one) for c in self._contacts]
        return [_Watched((one, two), self._contacts, None)]

    def look(self, where: list[FloatArray], both: bool) -> tuple[list[Finding], Pause]:
        """What is inside, and how long nothing else may be. Collective.

        Args:
            where: Of `where`.
            both: Look at the nodes and edges of both bodies; else of one and the other in turn.
        """
        positions = self._positions(where)
        looks = [part.look(positions, both) for part in self._parts]
        pause = reduce(Pause.shorter, (pause for _, pause in looks))
        return [f for found, _ in looks for f in found], pause

    def passed(
        self, before: list[FloatArray], after: list[FloatArray], way: float, through: float
    ) -> list[Finding]:
        """What was inside on the way from one look to the next. Collective.

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


class _ObstacleContact:
    """The body of a contact and its obstacle, which may pass between nodes of the slave.

    Nodes of the rest of the boundary, which no contact holds, are looked at, too, save those that
    are in the obstacle from the start: a floor or a bore is larger in a scene than what it stands
    for.

    Args:
        contact: The contact.
        body: Number of its body.
        slaves: All slaves of the same obstacle.
        boundary: The whole boundary of a body by its number. Collective.
    """

    def __init__(
        self,
        contact: Any,
        body: int,
        slaves: Sequence[Surface],
        boundary: Callable[[int], Surface],
    ) -> None:
        self._contact, self._body, self._slaves = contact, body, slaves
        self._boundary = boundary

    def where(self, u: Sequence[FloatArray], time: float) -> list[FloatArray]:
        """What moves, each a displacement of its points [m], shape (3 n,). Collective."""
        slave, obstacle = self._contact.slave, self._contact.master
        return [u[self._body], obstacle.displacement(time, slave.body.comm)]

    def look(self, where: list[FloatArray], both: bool) -> tuple[list[Finding], Pause]:
        """The deepest facet of the slave and the deepest node of the rest. Collective."""
        u, moved = where
        found, pause = self._facets(u, moved)
        if self._rest is None:
            return found, pause
        nodes, rest = self._nodes(*self._rest, u, moved)
        return found + nodes, pause.shorter(rest)

    def passed(
        self, before: list[FloatArray], after: list[FloatArray], way: float, through: float
    ) -> list[Finding]:
        """Nothing: contact with obstacles looks at the paths of the slave's nodes itself."""
        return []

    @cached_property
    def _rest(self) -> tuple[Surface, IntArray, FloatArray] | None:
        """Boundary, its points that no contact holds, and their facets' size [m]. Collective."""
        slave, obstacle = self._contact.slave, self._contact.master
        if self._slaves[0] is not slave or not hasattr(slave.body, "mesh"):
            return None  # another contact with the same obstacle looks at them
        boundary = self._boundary(self._body)
        x = boundary.reference
        size = np.zeros(len(x))
        for corner in boundary.facets.T:
            np.maximum.at(size, corner, fc.size(x[boundary.facets]))
        scale = np.minimum(size, obstacle.width)
        free = ~_belong(boundary, self._slaves) & (obstacle.gap(x).value >= -LEAST * scale)
        return (boundary, np.flatnonzero(free), scale[free]) if free.any() else None

    def _nodes(
        self,
        boundary: Surface,
        points: IntArray,
        scale: FloatArray,
        u: FloatArray,
        moved: FloatArray,
    ) -> tuple[list[Finding], Pause]:
        """The deepest of the points `_rest`, and how long none may be as deep. Collective."""
        obstacle = self._contact.master
        x = boundary.positions(u)[points]
        gap = obstacle.gap(x - moved).value
        far, smallest = max(0.0, float(gap.min())), float(scale.min())
        pause = Pause(far, smallest)
        i = int((gap / scale).argmin())
        depth, size = -float(gap[i]), -float(gap[i] / scale[i])
        if size <= LEAST:
            return [], pause
        node, name = int(boundary.original[points[i]]), boundary.body.name
        text = (
            f"node {node} of {name!r} lies {depth:.3g} m, or {size:.2g} of a facet, inside "
            f"{obstacle.name!r} at ({_point(x[i])}); no contact is declared of it with "
            f"{obstacle.name!r}: extend the marker of the slave to it"
        )
        bodies = name, obstacle.name
        return [Finding("node in an obstacle", depth, size, x[i], bodies, (node,), text)], pause

    def _facets(self, u: FloatArray, moved: FloatArray) -> tuple[list[Finding], Pause]:
        """The deepest facet of the slave, and how long none may be as deep. Collective."""
        slave, obstacle = self._contact.slave, self._contact.master
        x = slave.positions(u) - moved
        corners = x[slave.facets]
        size = fc.size(corners)
        # Nothing is deeper in a thin obstacle than half its width.
        scale = np.minimum(size, obstacle.width)
        gap = obstacle.gap(x).value[slave.facets].min(axis=1)
        # No point of a facet is farther from its next corner.
        near = np.flatnonzero(gap < size)
        smallest = float(scale[near if near.size else slice(None)].min())
        if not near.size:
            return [], Pause(float((gap - size).min()), smallest)
        pause = Pause(0.0, smallest)
        limit = LEAST * scale[near]
        place, depth = sunk(obstacle, corners[near], limit)
        deep = depth > limit
        if not deep.any():
            return [], pause
        i = int(np.where(deep, depth / size[near], 0.0).argmax())
        facet, at_corner = near[i], bool(-gap[near[i]] > limit[i])
        return [self._told(facet, at_corner, place[i] + moved, depth[i], size[facet])], pause

    def _told(
        self, facet: int, at_corner: bool, place: FloatArray, depth: float, size: float
    ) -> Finding:
        """A facet in words, and whether one of its nodes is inside, too."""
        slave, other = self._contact.slave, self._contact.master.name
        name = slave.body.name
        nodes = tuple(sorted(int(n) for n in slave.original[slave.facets[facet]]))
        if at_corner:
            remedy = "contact did not hold its nodes: use a smaller dt"
        else:
            remedy = (
                "contact holds nodes of the slave, but not what is between them, out of an "
                "obstacle: use a finer mesh of the slave there"
            )
        text = (
            f"the facet of nodes {list(nodes)} of {name!r} lies up to {depth:.3g} m, or "
            f"{depth / size:.2g} of its size, inside {other!r} at ({_point(place)}); {remedy}"
        )
        kind = "facet in an obstacle"
        return Finding(kind, float(depth), float(depth / size), place, (name, other), nodes, text)


class OverlapWatch:
    """Looks whether bodies that are in a contact with each other end up inside each other.

    Also whether obstacles end up inside facets of a slave that they are the master of, or nodes of
    its body's remaining boundary in them. Bodies of which no contact is declared may pass through
    each other. A look is due when the two have moved relative to each other so far that they can
    touch; then by a quarter of a facet since the last one, and four steps or a facet. The radius of
    a small obstacle counts as a facet, and so does the thickness of the thicker one of two bodies.
    Where they have moved by more than that thickness between two looks, the straight way is looked
    at, too.

    Args:
        system: The scene.
    """

    def __init__(self, system: Any) -> None:
        self._comm, self._bodies = system.comm, system.bodies
        self._surfaces: dict[int, Surface] = {}
        between: dict[tuple[int, ...], list[Any]] = {}
        self._pairs: list[_BodyPair | _ObstacleContact] = []
        for contact, bodies in zip(system.contacts, system.contact_bodies, strict=True):
            if len(contact.bodies) == 1 and len(contact.slave.facets):
                alike = [c.slave for c in system.contacts if _same_obstacle(contact, c)]
                slaves = [s for s in alike if len(s.facets)]
                self._pairs.append(_ObstacleContact(contact, bodies[0], slaves, self._boundary))
            elif len(contact.bodies) == 2 and all(hasattr(b, "mesh") for b in contact.bodies):
                between.setdefault(tuple(sorted(bodies)), []).append(contact)
        self._pairs += [_BodyPair(k, c, self._boundary) for k, c in between.items()]
        self._looked: dict[int, _Looked] = {}

    def look(
        self, u: Sequence[FloatArray], time: float = 0.0, *, last: bool = False
    ) -> list[Finding]:
        """The worst finding of each kind, if a look is due. Collective, the same on all ranks.

        Args:
            u: Owned displacements of all bodies [m]; kept until the next look, not to be changed.
            time: At which they are so [s].
            last: Look again wherever anything has moved.
        """
        now = [pair.where(u, time) for pair in self._pairs]
        findings: list[Finding] = []
        for k, way in self._due(now, last):
            before = self._looked.get(k)
            if before and way > before.pause.clear + before.pause.through:
                findings += self._pairs[k].passed(before.where, now[k], way, before.pause.through)
            found, pause = self._pairs[k].look(now[k], last or k not in self._looked)
            findings += found
            self._looked[k] = _Looked(now[k], pause)
        worst: dict[str, Finding] = {}
        for f in findings:
            if f.kind not in worst or f.size > worst[f.kind].size:
                worst[f.kind] = f
        return list(worst.values())

    def _due(self, now: list[list[FloatArray]], last: bool) -> list[tuple[int, float]]:
        """Pairs that have moved enough, and how far [m]. Collective."""
        fresh = [(k, 0.0) for k in range(len(now)) if k not in self._looked]
        if not self._looked:
            return fresh
        # Largest motion in each direction; the opposite ones are the least.
        moved = np.full((len(self._looked), 2, 2, 3), -np.inf)
        for i, (k, looked) in enumerate(self._looked.items()):
            for j, (after, before) in enumerate(zip(now[k], looked.where, strict=True)):
                d = (after - before).reshape(-1, 3)
                moved[i, j] = d.max(axis=0, initial=-np.inf), (-d).max(axis=0, initial=-np.inf)
        self._comm.Allreduce(MPI.IN_PLACE, moved, op=MPI.MAX)
        apart = np.maximum(moved[:, 0, 0] + moved[:, 1, 1], moved[:, 1, 0] + moved[:, 0, 1])
        ways = np.linalg.norm(np.maximum(apart, 0.0), axis=1)
        due = []
        for (k, looked), way in zip(self._looked.items(), ways.tolist(), strict=True):
            looked.steps += 1
            enough = way > (looked.pause.least if looked.steps >= _STEPS else looked.pause.most)
            if enough or (last and way > 0.0):
                due.append((k, way))
        return fresh + due

    def _boundary(self, k: int) -> Surface:
        """The whole boundary of a body with a mesh. Collective."""
        if k not in self._surfaces:
            body = self._bodies[k]
            self._surfaces[k] = Surface(body, compat.exterior_facets(body.mesh))
        return self._surfaces[k]
