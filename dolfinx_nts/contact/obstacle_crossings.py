"""A body and an obstacle that must not cross."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact.crossings import Finding, Pause, belong, places, point
from dolfinx_nts.contact.intrusion import LEAST, sunk
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import facets as fc

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]


class ObstacleContact:
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
        """What was in the obstacle on the straight way from one look to the next. Collective.

        Contact follows the paths of the slave's nodes itself, but not what is between them.

        Args:
            before: Of `where`.
            after: The same now.
            way: Relative motion between them [m].
            through: That which may take the obstacle through a facet [m].
        """
        # Where the ends are clear, so is as much of the way.
        first, last = (self.look(w, True)[1].clear / way for w in (before, after))
        part, findings = max(0.0, 1.0 - first - last), []
        for k in range(number := places(part * way, through)):
            s = first + part * k / (number - 1)
            between = [(1.0 - s) * b + s * a for b, a in zip(before, after, strict=True)]
            findings += self.look(between, True)[0]
        return findings

    @cached_property
    def _rest(self) -> tuple[Surface, IntArray, FloatArray] | None:
        """Boundary, its points that no contact holds, and their facets' size [m]. Collective."""
        slave, obstacle = self._contact.slave, self._contact.master
        if self._slaves[0] is not slave or slave.body.mesh is None:
            return None  # another contact with the same obstacle looks at them
        boundary = self._boundary(self._body)
        x = boundary.reference
        size = np.zeros(len(x))
        for corner in boundary.facets.T:
            np.maximum.at(size, corner, fc.size(x[boundary.facets]))
        scale = np.minimum(size, obstacle.width)
        free = ~belong(boundary, self._slaves) & (obstacle.gap(x).value >= -LEAST * scale)
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
            f"{obstacle.name!r} at ({point(x[i])}); no contact is declared of it with "
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
            return [], Pause(float((gap - size).min()), smallest, obstacle.width)
        pause = Pause(0.0, smallest, obstacle.width)
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
            f"{depth / size:.2g} of its size, inside {other!r} at ({point(place)}); {remedy}"
        )
        kind = "facet in an obstacle"
        return Finding(kind, float(depth), float(depth / size), place, (name, other), nodes, text)
