"""Bodies that end up inside each other, or in obstacles, which contact of nodes may not see.

Nodes of the slave are kept out of the master's facets and of obstacles; an edge of the one may
still pass through the other between its nodes, a small obstacle into a large facet, and what is not
declared as a surface is not held at all. `OverlapWatch` looks at the bodies of a run as often as
their motion asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
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


class Finding(NamedTuple):
    """The worst of what a look found of a kind.

    Attributes:
        kind: "edge through a body", "node inside a body" or "facet in an obstacle".
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
        least: [m] At least; a look is due after it and `_STEPS` steps.
        most: [m] At most, in however few steps.
    """

    least: float
    most: float


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
        depth, size = float(found.depth[i]), float(found.size[i])
        text = (
            f"{what} lies up to {depth:.3g} m, or {size:.2g} of a facet, inside {two!r} at "
            f"({_point(found.place[i])}); {remedy}"
        )
        return Finding(kind, depth, size, found.place[i], (one, two), nodes, text)


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
        of = {id(self._boundary(k).body): u for k, u in zip(self._bodies, where, strict=True)}
        needed = {id(s): s for part in self._parts for s in part.needed}
        positions = {i: s.positions(of[id(s.body)]) for i, s in needed.items()}
        looks = [part.look(positions, both) for part in self._parts]
        return [f for found, _ in looks for f in found], min(pause for _, pause in looks)


class _ObstacleContact:
    """The slave of a contact and its obstacle, between whose nodes the obstacle may pass.

    Args:
        contact: The contact.
        body: Number of its body.
    """

    def __init__(self, contact: Any, body: int) -> None:
        self._contact, self._body = contact, body

    def where(self, u: Sequence[FloatArray], time: float) -> list[FloatArray]:
        """What moves, each a displacement of its points [m], shape (3 n,). Collective."""
        slave, obstacle = self._contact.slave, self._contact.master
        return [u[self._body], obstacle.displacement(time, slave.body.comm)]

    def look(self, where: list[FloatArray], both: bool) -> tuple[list[Finding], Pause]:
        """The deepest facet of the slave, and how long none may be as deep. Collective."""
        slave, obstacle = self._contact.slave, self._contact.master
        u, moved = where
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
            far = float((gap - size).min()) + _LOOK * smallest
            return [], Pause(far, far)
        pause = Pause(_LOOK * smallest, smallest)
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

    Also whether obstacles end up inside facets of a slave that they are the master of. Bodies of
    which no contact is declared may pass through each other. A look is due when the two have moved
    relative to each other so far that they can touch; then by a quarter of a facet since the last
    one, and four steps or a facet. The radius of a small obstacle counts as a facet.

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
                self._pairs.append(_ObstacleContact(contact, *bodies))
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
        for k in self._due(now, last):
            found, pause = self._pairs[k].look(now[k], last or k not in self._looked)
            findings += found
            self._looked[k] = _Looked(now[k], pause)
        worst: dict[str, Finding] = {}
        for f in findings:
            if f.kind not in worst or f.size > worst[f.kind].size:
                worst[f.kind] = f
        return list(worst.values())

    def _due(self, now: list[list[FloatArray]], last: bool) -> list[int]:
        """Pairs that have moved enough. Collective."""
        fresh = [k for k in range(len(now)) if k not in self._looked]
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
            least, most = looked.pause
            enough = way > (least if looked.steps >= _STEPS else most)
            if enough or (last and way > 0.0):
                due.append(k)
        return fresh + due

    def _boundary(self, k: int) -> Surface:
        """The whole boundary of a body. Collective."""
        if k not in self._surfaces:
            body = self._bodies[k]
            self._surfaces[k] = Surface(body, compat.exterior_facets(body.mesh))
        return self._surfaces[k]
