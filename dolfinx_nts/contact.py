"""Contact between two surfaces: which slave nodes may touch which facet in a step.

A `ContactPair` is part of the scene and holds no history; what its candidates contribute to the
equations of a step is in `contact_step`.
"""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts import facets, nts, patches, search
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


@known_options
class ContactPair:
    """Slave nodes of one surface must not penetrate the facets of another (19)-(21).

    Args:
        slave: Surface whose nodes are kept outside.
        master: Surface whose facets keep them outside, or a `Plane`, `Sphere` or `Cylinder`.
        friction: Coulomb's coefficient mu [-], >= 0; infinite: nodes in contact never slip.

    Attributes:
        origin: Point of space that positions of a pair of surfaces are relative to [m], shape (3,).
        extent: Largest of the reference positions' components, relative to it [m].

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
        self.origin, self.extent = np.zeros(3), float(np.abs(slave.reference).max())
        if isinstance(master, Obstacle):
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
        # What is near is small: gaps keep their digits wherever in space the bodies meet.
        self.origin = slave.reference[0]
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
        reach: float,
        moved: FloatArray | None,
        ahead: Sequence[FloatArray] | None = None,
    ) -> Candidates:
        """Search for this rank's candidates; every rank must call it.

        Args:
            positions: Of all points at t_n [m], as from `positions`.
            current: Facet of each of the rank's slave nodes in the last step or -1.
            reach: Bound on the relative motion of slave and master in the step [m].
            moved: Displacement of an obstacle at t_n [m], shape (3,); None of a surface.
            ahead: Displacements of each of `bodies` expected until the middle of the step [m].
        """
        if moved is not None:
            return self._near_obstacle(positions[0], reach, moved)
        slaves, master = positions
        corners = master[self.master.facets]
        radius = reach + _MARGIN * float(facets.size(corners).max())
        # Positions of all points are known everywhere, so all ranks leave here or none.
        if search.apart(slaves, corners, radius):
            return _NO_CANDIDATES
        x = slaves[self.slave.share]
        closest = search.closest_facets(x, corners, reach=radius, current=current)
        node = np.flatnonzero(closest.facet >= 0)
        found = self._measure(x, master, node, closest.facet[node], closest.xi[node], reach)
        if ahead is None:
            return found
        motion = self.slave.gather(ahead[0])[self.slave.share], self.master.gather(ahead[1])
        change, facet = self._crossings(found, master, *motion)
        if not len(change):
            return found
        start, _ = facets.closest_point(x[found.node[change]], corners[facet])
        other = self._measure(x, master, found.node[change], facet, start, reach)
        stay = ~np.isin(found.node, other.node)
        order = np.argsort(np.concatenate([found.node[stay], other.node]))
        return Candidates(
            *(np.concatenate([a[stay], b])[order] for a, b in zip(found, other, strict=True))
        )

    def _measure(
        self,
        x: FloatArray,
        master: FloatArray,
        node: IntArray,
        facet: IntArray,
        start: FloatArray,
        reach: float,
    ) -> Candidates:
        """Those of the pairs (node, facet) that may touch; projected from `start`."""
        pair = self.master.control_points(master, facet)
        xi, converged = facets.project(x[node], pair, start)
        foot, _, normal = facets.frame(pair, xi)
        gap = np.einsum("ni,ni->n", normal, x[node] - foot)
        length = facets.size(pair)
        legal = converged & self._over_facet(facet, xi, reach / length) & self._movable(node, facet)
        legal &= (gap > -_MARGIN * length) & (gap < reach + _MARGIN * length)
        return Candidates(
            node[legal], facet[legal], xi[legal], normal[legal], gap[legal], length[legal]
        )

    def _near_obstacle(self, slaves: FloatArray, reach: float, moved: FloatArray) -> Candidates:
        """Candidates of an obstacle. Nothing limits the depth: what is behind it is inside."""
        slave = self.slave
        x = slaves[slave.share] - moved
        gap, length = self.master.gap(x), np.sqrt(slave.area[slave.share])
        movable = ~slave.fixed[slave.share].all(axis=1)
        node = np.flatnonzero(movable & (gap.value < reach + _MARGIN * length))
        only, xi = np.zeros(len(node), dtype=np.int64), np.zeros((len(node), 2))
        return Candidates(node, only, xi, gap.gradient[node, 0], gap.value[node], length[node])

    def cover(self, u: Sequence[FloatArray], reach: float) -> float:
        """Relative motion [m] for which `find` with this reach misses no contact. Collective."""
        if self.rigid:
            return reach + _MARGIN * float(np.sqrt(self.slave.area.min()))
        corners = self.master.positions(u[1])[self.master.facets]
        return reach + _MARGIN * float(facets.size(corners).min())

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
        slide = nts.solve(metric, np.einsum("naj,nj->na", tangents, motion)[:, :, None])[:, :, 0]
        before, after = (facets.edge_excess(xi, nc) for xi in (c.xi, c.xi + slide))
        edge = after.argmax(axis=1)
        pairs = np.arange(len(edge))
        joined = self._joined[c.facet, edge]
        over = (before.max(axis=1) <= 0.0) & (after[pairs, edge] > search.PREFERENCE)
        change = np.flatnonzero(over & (joined >= 0))
        return change, joined[change] // nc

    def _over_facet(self, facet: IntArray, xi: FloatArray, reach: FloatArray) -> BoolArray:
        """Whether pairs within `reach` (in facet sizes) may touch there; a facet is 2 xi wide."""
        beyond = facets.edge_excess(xi, self.master.facets.shape[1])
        wedge = _WEDGE + 2.0 * (reach + _MARGIN)
        limit = np.where(self._free_edges[facet], _OVERHANG, wedge[:, None])
        inside: BoolArray = (beyond <= limit).all(axis=1)
        return inside

    def _movable(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Whether any coordinate of a pair is free; without one there is nothing to solve for."""
        slave = self.slave.fixed[self.slave.share[node]].all(axis=1)
        master = self.master.fixed[self.master.patches[facet]].all(axis=(1, 2))
        return ~(slave & master)


def _check_friction(friction: Any) -> None:
    number = isinstance(friction, numbers.Real) and not isinstance(friction, bool)
    if not number or not float(friction) >= 0.0:
        raise ValueError(f"friction={friction!r}: pass a number >= 0 (math.inf: never slips)")
