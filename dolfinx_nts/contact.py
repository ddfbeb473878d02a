"""Contact between two surfaces: which slave nodes may touch which facet in a step.

A `ContactPair` is part of the scene and holds no history; what its candidates contribute to the
equations of a step is in `contact_step`.
"""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts import facets, nts_element, patches, search
from dolfinx_nts.obstacles import Obstacle
from dolfinx_nts.surfaces import Surface
from dolfinx_nts.validation import known_options

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

#: Part of a facet's size by which a slave may penetrate at the start of a run.
INITIAL_PENETRATION = 0.01
#: A node may project this far (in convective coordinates) beyond an edge that the master surface
#: ends at ...
_OVERHANG = 0.05
#: ... and this far beyond an edge shared with another facet, between the normal cones of a convex
#: edge, and further by what the node may be away.
_WEDGE = 0.5
#: A node this part of a facet behind it, or less, is outside.
_OUTSIDE = 1e-6
#: Candidates are sought this part of a facet beyond the reach of the step's motion.
_MARGIN = 0.5


class Candidates(NamedTuple):
    """Slave nodes that may touch in a step, one facet each; axis 0 = pair.

    Attributes:
        node: Positions in the slave surface's `share`, shape (n,).
        facet: Facets of the master surface, shape (n,).
        xi: Orthogonal projection at t_n, shape (n, 2).
        normal: Outward unit normal of the master there, shape (n, 3).
        gap: g_0 [m], shape (n,).
        length: Size of the facet [m], shape (n,).
    """

    node: IntArray
    facet: IntArray
    xi: FloatArray
    normal: FloatArray
    gap: FloatArray
    length: FloatArray

    def part(self, chosen: IntArray | BoolArray) -> Candidates:
        """Some of them, by number or by a mask."""
        return Candidates._make(a[chosen] for a in self)


_NO_CANDIDATES = Candidates(
    np.empty(0, np.int64), np.empty(0, np.int64),
    np.empty((0, 2)), np.empty((0, 3)), np.empty(0), np.empty(0),
)  # fmt: skip


class Motion(NamedTuple):
    """How slaves and masters are expected to move in a step.

    Attributes:
        reach: Bound on the motion of slaves relative to the master [m].
        paths: Displacement of each of a pair's bodies over the step [m], owned coordinates.
        aimed: Facet that a path of an earlier attempt at the step met, or -1, of each of the rank's
            slave nodes.
    """

    reach: float
    paths: Sequence[FloatArray]
    aimed: IntArray


class Found(NamedTuple):
    """What a search found.

    Attributes:
        candidates: Slave nodes that may touch.
        followed: Which of the rank's slave nodes are known not to have passed by the surface's
            edge, shape (share,).
        cover: Relative motion [m] for which the search misses no contact, the same on all ranks.
        beside: How deep, in facet sizes, the deepest node that is let through lies behind its
            facet, and its input number; (0, -1) without one.
    """

    candidates: Candidates
    followed: BoolArray
    cover: float
    beside: tuple[float, int] = (0.0, -1)


@known_options
class ContactPair:
    """Slave nodes of one surface must not penetrate the facets of another (19)-(21).

    Args:
        slave: Surface whose nodes are kept outside.
        master: Surface whose facets keep them outside, or a `Plane`, `Sphere` or `Cylinder`.
        friction: Coulomb's coefficient mu [-], >= 0; infinite: nodes in contact stick, but for
            those that no step holds or lets go, which a warning tells.

    Attributes:
        origin: Point of space that positions are relative to [m], shape (3,).
        obstacle: The master relative to it, if it is an obstacle.
        extent: Largest of the reference positions' components, relative to it [m].
        given: Largest of the slave's as they were given, whose rounding they have [m].

    Raises:
        TypeError: `slave` is no Surface, or `master` neither that nor an obstacle.
        ValueError: friction is negative or no number, or the surfaces share nodes.
    """

    def __init__(
        self, slave: Surface, master: Surface | Obstacle, *, friction: float = 0.0
    ) -> None:
        _check_friction(friction)
        if not isinstance(slave, Surface):
            hint = "; an obstacle is a master" if isinstance(slave, Obstacle) else ""
            raise TypeError(f"slave={slave!r}: pass a Surface, e.g. body.surface(marker){hint}")
        self.slave, self.friction = slave, float(friction)
        self.master: Any = master
        self.obstacle: Any = None
        # What is near is small: gaps keep their digits wherever in space the bodies meet.
        self.origin, self.given = slave.reference[0], float(np.abs(slave.reference).max())
        if isinstance(master, Obstacle):
            self.obstacle = master.about(self.origin)
            self.extent = float(np.abs(slave.reference - self.origin).max())
            return
        if not isinstance(master, Surface):
            raise TypeError(
                f"master={master!r}: pass a Surface, e.g. body.surface(marker), or a Plane, Sphere "
                "or Cylinder"
            )
        if slave.body is master.body and np.intersect1d(slave.points, master.points).size:
            raise ValueError(
                f"slave, master: both surfaces of {slave.body.name!r} share nodes; "
                "choose disjoint markers"
            )
        self.extent = max(float(np.abs(s.reference - self.origin).max()) for s in (slave, master))
        self._free_edges = master.boundary_edges
        self._joined = patches.neighbours(master.facets, master.reference[master.facets])

    @property
    def rigid(self) -> bool:
        """Whether the master is an obstacle, which has neither facets nor unknowns."""
        return isinstance(self.master, Obstacle)

    @property
    def bodies(self) -> tuple[Any, ...]:
        """The slave's and the master's body; the slave's alone before an obstacle."""
        return (self.slave.body,) if self.rigid else (self.slave.body, self.master.body)

    @property
    def name(self) -> str:
        """Slave body and master, for messages and files."""
        master = self.master if self.rigid else self.master.body
        return f"{self.slave.body.name}-{master.name}"

    def is_like(self, other: ContactPair) -> bool:
        """Whether both hold the same nodes of bodies of the same names out of the same master."""
        if self.name != other.name or self.rigid != other.rigid:
            return False
        same_nodes = np.array_equal(self.slave.points, other.slave.points)
        if self.rigid:
            return same_nodes and bool(self.master == other.master)
        return same_nodes and np.array_equal(self.master.facets, other.master.facets)

    def positions(self, u: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Positions of all points of the slave and of a master surface [m], (p, 3). Collective.

        They are relative to `origin`.

        Args:
            u: Owned displacements of each of `bodies` [m].
        """
        surfaces = (self.slave,) if self.rigid else (self.slave, self.master)
        both = zip(surfaces, u, strict=True)
        return tuple(s.reference - self.origin + s.gather(each) for s, each in both)

    def points(self, positions: Sequence[FloatArray], found: Candidates) -> FloatArray:
        """Slave and control points of pairs [m], shape (n, nc + 1, 3)."""
        x = positions[0][self.slave.share[found.node]][:, None]
        if self.rigid:
            return x
        return np.concatenate([x, self.master.control_points(positions[1], found.facet)], axis=1)

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        moved: FloatArray | None,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Found:
        """Search for this rank's candidates; every rank must call it.

        A node is a candidate behind its facet only if it has come there through the surface. One
        that has passed by the surface's edge is let through, and followed again once it is outside.

        Args:
            positions: Of all points at t_n [m], as from `positions`.
            current: Facet of each of the rank's slave nodes in the last step or -1.
            moved: Displacement of an obstacle at t_n [m], shape (3,); None of a surface.
            motion: Expected in the step; None: only what touches already.
            followed: Which of the rank's nodes were followed in the last step; None: all.
        """
        reach = 0.0 if motion is None else motion.reach
        every = np.ones(len(self.slave.share), dtype=bool)
        if moved is not None:
            cover = reach + _MARGIN * float(np.sqrt(self.slave.area.min()))
            return Found(self._near_obstacle(positions[0], reach, moved), every, cover)
        known = every if followed is None else followed
        slaves, master = positions
        corners = master[self.master.facets]
        sizes = facets.size(corners)
        radius, cover = (reach + _MARGIN * float(s) for s in (sizes.max(), sizes.min()))
        # Positions of all points are known everywhere, so all ranks leave here or none.
        if search.apart(slaves, corners, radius):
            return Found(_NO_CANDIDATES, ~every, radius)
        x = slaves[self.slave.share]
        closest = search.closest_facets(x, corners, reach=radius, current=current)
        node = np.flatnonzero(closest.facet >= 0)
        found, lost = self._measure(x, master, node, closest.facet[node], closest.xi[node], reach)
        if motion is not None:
            found = self._along_paths(found, x, master, motion)
        beside = (found.gap < -_OUTSIDE * found.length) & ~known[found.node]
        # What was followed and is out of reach is sought anew from either side.
        stays = np.zeros_like(every)
        stays[np.setdiff1d(node, lost)] = known[np.setdiff1d(node, lost)]
        hidden, deepest = found.part(beside), (0.0, -1)
        if len(hidden.node):
            depth = -hidden.gap / hidden.length
            node = self.slave.share[hidden.node[depth.argmax()]]
            deepest = float(depth.max()), int(self.slave.original[node])
        found = found.part(~beside)
        stays[found.node] = True
        return Found(found, stays, cover, deepest)

    def _along_paths(
        self, found: Candidates, x: FloatArray, master: FloatArray, motion: Motion
    ) -> Candidates:
        """Candidates with the facets that their paths lead to in place of the closest. Collective.

        Args:
            found: Candidates of the closest facets.
            x: This rank's slaves at t_n [m], shape (share, 3).
            master: Points of the master at t_n [m].
            motion: Expected in the step.
        """
        slave_path, master_path = self._gather_paths(motion.paths)
        change, facet = self._crossings(found, master, 0.5 * slave_path, 0.5 * master_path)
        corners, node = master[self.master.facets], found.node[change]
        if len(node):
            start, _ = facets.closest_point(x[node], corners[facet])
            other, _ = self._measure(x, master, node, facet, start, motion.reach)
            found = _replace(found, other)
        aimed = motion.aimed
        if self.is_long(motion.reach):
            hit, _ = search.first_hits(
                x, slave_path, corners, master_path[self.master.facets]
            )
            aimed = np.where(hit >= 0, hit, aimed)
        node = np.flatnonzero(aimed >= 0)
        if len(node):
            start, _ = facets.closest_point(x[node], corners[aimed[node]])
            other, _ = self._measure(x, master, node, aimed[node], start, None)
            found = _replace(found, other)
        return found

    def _gather_paths(self, paths: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Displacements of this rank's slaves and of all points of the master [m]. Collective."""
        slave = self.slave.gather(paths[0])[self.slave.share]
        return slave, self.master.gather(paths[1])

    def is_long(self, reach: float) -> bool:
        """Whether a motion may carry a node through a facet that is not the closest."""
        return reach > _MARGIN * self._smallest

    @cached_property
    def _smallest(self) -> float:
        """Size of the master's smallest facet in the reference [m]."""
        return float(facets.size(self.master.reference[self.master.facets]).min())

    def missed(
        self, positions: Sequence[FloatArray], paths: Sequence[FloatArray], held: IntArray
    ) -> IntArray:
        """Facet that each of the rank's slaves has come through unseen, or -1. Collective.

        Args:
            positions: Of all points at t_n [m].
            paths: Displacement of each of `bodies` in the solved step [m], owned coordinates.
            held: Facet that each of the rank's slaves is held at in the end, or -1, shape (share,).
        """
        slaves, master = positions
        x, corners = slaves[self.slave.share], master[self.master.facets]
        slave_path, master_path = self._gather_paths(paths)
        hit, _ = search.first_hits(x, slave_path, corners, master_path[self.master.facets])
        node = np.flatnonzero((hit >= 0) & (hit != held))
        control = self.master.control_points(master + master_path, hit[node])
        end = (x + slave_path)[node]
        xi, converged = facets.project(end, control, np.zeros((len(node), 2)))
        foot, _, normal = facets.frame(control, xi)
        depth = np.einsum("ni,ni->n", normal, foot - end) / facets.size(control)
        # A node that is held at another facet may end a little behind this one.
        deep = depth > np.where(held[node] >= 0, _MARGIN, _OUTSIDE)
        hit[np.setdiff1d(np.arange(len(hit)), node[deep | ~converged])] = -1
        return hit

    def _measure(
        self,
        x: FloatArray,
        master: FloatArray,
        node: IntArray,
        facet: IntArray,
        start: FloatArray,
        reach: float | None,
    ) -> tuple[Candidates, IntArray]:
        """Those of the pairs (node, facet) that may touch, and nodes beyond the surface's edge.

        Projected from `start`; with reach None all may touch whose projection is found.
        """
        pair = self.master.control_points(master, facet)
        xi, converged = facets.project(x[node], pair, start)
        foot, _, normal = facets.frame(pair, xi)
        gap = np.einsum("ni,ni->n", normal, x[node] - foot)
        length = facets.size(pair)
        legal = converged & self._movable(node, facet)
        beyond = np.zeros_like(legal)
        if reach is not None:
            over, beyond = self._over_facet(facet, xi, reach / length)
            legal &= over & (gap > -_MARGIN * length) & (gap < reach + _MARGIN * length)
        found = Candidates(
            node[legal], facet[legal], xi[legal], normal[legal], gap[legal], length[legal]
        )
        return found, node[beyond]

    def _near_obstacle(self, slaves: FloatArray, reach: float, moved: FloatArray) -> Candidates:
        """Candidates of an obstacle. Nothing limits the depth: what is behind it is inside."""
        slave = self.slave
        x = slaves[slave.share] - moved
        gap, length = self.obstacle.gap(x), np.sqrt(slave.area[slave.share])
        movable = ~slave.fixed[slave.share].all(axis=1)
        node = np.flatnonzero(movable & (gap.value < reach + _MARGIN * length))
        only, xi = np.zeros(len(node), dtype=np.int64), np.zeros((len(node), 2))
        return Candidates(node, only, xi, gap.gradient[node, 0], gap.value[node], length[node])

    def _crossings(
        self, c: Candidates, master: FloatArray, slave_motion: FloatArray, master_motion: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Candidates that slide over an edge before the middle of the step, and their next facet.

        A facet that holds the longer part of the path makes g_0 as often positive as negative, so
        that what changes of facet cost and bring cancels in the long run.
        """
        nc = self.master.facets.shape[1]
        pair = self.master.control_points(master, c.facet)
        shape, _, _ = facets.shape(c.xi, pair.shape[1])
        _, tangents, _ = facets.frame(pair, c.xi)
        motion = slave_motion[c.node]
        carried = self.master.control_points(master_motion, c.facet)
        motion = motion - np.einsum("ni,nij->nj", shape, carried)
        metric = np.einsum("naj,nbj->nab", tangents, tangents)
        along = np.einsum("naj,nj->na", tangents, motion)
        slide = nts_element.solve(metric, along[:, :, None])[:, :, 0]
        before, after = (facets.edge_excess(xi, nc) for xi in (c.xi, c.xi + slide))
        edge = after.argmax(axis=1)
        pairs = np.arange(len(edge))
        joined = self._joined[c.facet, edge]
        over = (before.max(axis=1) <= 0.0) & (after[pairs, edge] > search.PREFERENCE)
        change = np.flatnonzero(over & (joined >= 0))
        return change, joined[change] // nc

    def _over_facet(
        self, facet: IntArray, xi: FloatArray, reach: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Whether pairs within `reach` (in facet sizes) may touch there; a facet is 2 xi wide.

        And whether they are beyond an edge that the surface ends at.
        """
        excess, free = facets.edge_excess(xi, self.master.facets.shape[1]), self._free_edges[facet]
        wedge = _WEDGE + 2.0 * (reach + _MARGIN)
        beyond: BoolArray = (free & (excess > _OVERHANG)).any(axis=1)
        inside: BoolArray = (free | (excess <= wedge[:, None])).all(axis=1) & ~beyond
        return inside, beyond

    def _movable(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Whether any coordinate of a pair is free; without one there is nothing to solve for."""
        slave = self.slave.fixed[self.slave.share[node]].all(axis=1)
        master = self.master.fixed[self.master.patches[facet]].all(axis=(1, 2))
        return ~(slave & master)


def _replace(found: Candidates, other: Candidates) -> Candidates:
    """Candidates with the others in place of those of the same nodes, in the order of the nodes."""
    stay = ~np.isin(found.node, other.node)
    order = np.argsort(np.concatenate([found.node[stay], other.node]))
    return Candidates(
        *(np.concatenate([a[stay], b])[order] for a, b in zip(found, other, strict=True))
    )


def _check_friction(friction: Any) -> None:
    number = isinstance(friction, numbers.Real) and not isinstance(friction, bool)
    if not number or not float(friction) >= 0.0:
        raise ValueError(f"friction={friction!r}: pass a number >= 0 (math.inf: never slips)")
