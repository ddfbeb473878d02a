"""Contact that is integrated over the slave's surface: which parts of it lie over the master."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.facet_pair import OVERHANG, FacetPair
from dolfinx_nts.contact.pair import MARGIN, Found, Motion
from dolfinx_nts.contact.segments import near, segments
from dolfinx_nts.contact.surface_elements import SurfaceElements, surface_elements
from dolfinx_nts.contact.surface_sums import FacetAttachment, Sums
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import StepFailedError

#: Part of a node's area that has to lie over the master for it to be a candidate: rows of less
#: would be nearly those of its neighbours.
_COVERED = 1e-3
#: A point's foot may lie so far, in convective coordinates, beyond an edge of two facets.
_BEYOND = 0.5


class SurfaceCandidates(NamedTuple):
    """Slave nodes that may touch in a step, and the points whose gaps theirs are the means of.

    Attributes:
        node: As of `Candidates`, and so are normal, gap and length, means of the points'.
        facet: Zeros, of no meaning.
        patch: Zeros.
        xi: Zeros.
        normal: Unit normals, shape (n, 3).
        gap: g_A0 [m], shape (n,).
        length: Size of the facets [m], shape (n,).
        points: Those of the rank's facets.
    """

    node: IntArray
    facet: IntArray
    patch: IntArray
    xi: FloatArray
    normal: FloatArray
    gap: FloatArray
    length: FloatArray
    points: OverMaster

    def select(self, chosen: IntArray | BoolArray) -> SurfaceCandidates:
        """Some of the nodes, by number or by a mask; points stay."""
        nodal: Any = [*(a[chosen] for a in self[:-1]), self.points]
        return SurfaceCandidates(*nodal)


class OverMaster(NamedTuple):
    """Points of a slave's facets over a master; axis 0 = point.

    Attributes:
        own: Facets of the slave, shape (n,).
        other: Facets of the master, shape (n,).
        shape: Weights of the nodes of the facets' faces, shape (n, nodes).
        xi: Their feet on the master's facets at t_n, shape (n, 2).
        normal: Outward normals of the master there, shape (n, 3).
        gap: g_q [m], shape (n,).
        length: Size of the master's facet [m], shape (n,).
        cut: As of `Sums`, shape (n, 2).
        slot: Positions in the slave's `share` of those that are corners of the facet, or -1.
        part: w_q Phi_A, the reference area that these have there [m^2], shape (n, nodes).
    """

    own: IntArray
    other: IntArray
    shape: FloatArray
    xi: FloatArray
    normal: FloatArray
    gap: FloatArray
    length: FloatArray
    cut: FloatArray
    slot: IntArray
    part: FloatArray

    def select(self, chosen: IntArray | BoolArray) -> OverMaster:
        """Some of the points, by number or by a mask."""
        return OverMaster._make(a[chosen] for a in self)


class SurfacePair(FacetPair, master=Surface, integration="surface"):
    """A `FacetPair` that keeps the slave's surface out in the mean around each node."""

    holds_nodes = False

    def _set_up(self) -> None:
        super()._set_up()
        if not len(self.slave.facets):
            raise ValueError(
                f'integration="surface": the slave, of {self.slave.body.name!r}, has points alone; '
                'use integration="nodes"'
            )
        if self.slave.body.rigid and self.master.body.rigid:
            raise ValueError(
                f'integration="surface": both {self.slave.body.name!r} and '
                f"{self.master.body.name!r} are rigid, and nothing yields to a pressure; use "
                'integration="nodes"'
            )
        if self.adjust:
            raise ValueError(
                f'adjust={self.adjust!r}: closes the gaps of nodes, and integration="surface" '
                "takes its gaps at points between them; leave one of them out"
            )
        if self.master.smooth:
            raise ValueError(
                f'integration="surface": the master, {self.master.body.name!r}, is smoothed, and '
                "forces on smooth patches are those of no uniform pressure; leave smoothing out"
            )
        for surface in self.surfaces:
            if surface.massless.any():
                raise ValueError(
                    f'integration="surface": nodes of {surface.body.name!r} have no mass; use '
                    'mass="consistent" for its surface, or integration="nodes"'
                )
        slave = self.slave
        self._position = np.full(len(slave.points), -1)
        self._position[slave.share] = np.arange(len(slave.share))
        self._facets = np.flatnonzero((self._position[slave.facets] >= 0).any(axis=1))

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Found:
        """Nodes of this rank with facets over the master, as of `ContactPair`."""
        reach, at = 0.0 if motion is None else motion.reach, tuple(positions)
        if motion is not None and motion.solved:
            # An equilibrium is one of the pieces that it has itself.
            reach, ways = 0.0, zip(self.surfaces, motion.paths, strict=True)
            at = tuple(x + s.gather(way) for x, (s, way) in zip(positions, ways, strict=True))
        sizes = facets.size(at[1][self.master.facets])
        points = self._over(at, reach, reach + MARGIN * float(sizes.max()))
        if at[0] is not positions[0]:
            points = self._seen_from(points, positions)
        cover = (0.0 if motion is None else motion.reach) + MARGIN * float(sizes.min())
        found: Any = self._nodes(points)
        return Found(found, np.ones(len(self.slave.share), dtype=bool), cover)

    def _over(
        self, positions: Sequence[FloatArray], reach: float, radius: float
    ) -> OverMaster:
        """Points of this rank's facets that have a partner within reach.

        Args:
            positions: Of all points [m].
            reach: Bound on the motion of slaves relative to the master [m].
            radius: Distance up to which facets are near each other [m].
        """
        slaves, master = positions
        own, other = slaves[self.slave.facets[self._facets]], master[self.master.facets]
        pairs = near(own, other, radius)
        if not len(pairs[0]):
            return self._none
        found = segments(own, other, pairs)
        facet, over = self._facets[found.own], found.other
        corners, nodes = self.slave.facets[facet], self.slave.face_nodes[facet]
        hats, slopes, _ = facets.shape(found.xi, corners.shape[1])
        shape = self.slave.shape(facet, found.xi)
        x = np.einsum("nc,nci->ni", shape, slaves[nodes])
        xi, converged, normal, gap = self._measured(x, master, over)
        length = facets.size(other)[over]
        excess = facets.edge_excess(xi, other.shape[1])
        rim = self._free_edges[over]
        legal = converged & (excess <= np.where(rim, OVERHANG, _BEYOND)).all(axis=1)
        legal &= (gap > -MARGIN * length) & (gap < reach + MARGIN * length)
        sides = np.matmul(slopes.transpose(0, 2, 1), self.slave.reference[corners])
        area = found.weight * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        # A multiplier at each node of the face, though those of its other facets have no part.
        own_nodes = nodes[:, :, None] == corners[:, None]
        slot = np.where(own_nodes.any(axis=2), self._position[nodes], -1)
        part = area[:, None] * np.einsum("nkc,nc->nk", own_nodes, hats)
        points = OverMaster(facet, over, shape, xi, normal, gap, length, xi, slot, part)
        return points.select(legal)

    @cached_property
    def _none(self) -> OverMaster:
        """No points."""
        number, flat = np.empty(0, dtype=np.int64), np.empty((0, 2))
        shape = np.empty((0, self.slave.face_nodes.shape[1]))
        return OverMaster(
            number, number, shape, flat, np.empty((0, 3)), np.empty(0), np.empty(0), flat,
            shape.astype(np.int64), shape,
        )  # fmt: skip

    def _measured(
        self, x: FloatArray, master: FloatArray, facet: IntArray
    ) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
        """Feet of points (n, 3) on facets (n,), which were found, normals and gaps [m]."""
        start, _ = compiled.closest_point(x, master[self.master.facets[facet]])
        control = self.master.control_points(master, facet)
        xi, converged = compiled.project(x, control, start)
        foot, _, normal = facets.frame(control, xi)
        gap: FloatArray = np.einsum("ni,ni->n", normal, x - foot)
        return xi, converged, normal, gap

    def _seen_from(self, points: OverMaster, positions: Sequence[FloatArray]) -> OverMaster:
        """The same points and facets where they were at other positions."""
        slaves, master = positions
        x = np.einsum("nc,nci->ni", points.shape, slaves[self.slave.face_nodes[points.own]])
        xi, converged, normal, gap = self._measured(x, master, points.other)
        length = facets.size(master[self.master.facets])[points.other]
        found = points._replace(xi=xi, normal=normal, gap=gap, length=length)
        return found.select(converged)

    def _nodes(self, points: OverMaster) -> SurfaceCandidates:
        """The nodes of the rank that points make candidates of."""
        number, on = len(self.slave.share), points.slot >= 0
        slot, part = points.slot[on], points.part[on]

        def sums(values: FloatArray) -> FloatArray:
            """Sums over the points of a node, shape (share,)."""
            each = np.broadcast_to(values[:, None], on.shape)[on]
            return np.asarray(np.bincount(slot, part * each, number), dtype=float)

        covered = np.bincount(slot, part, number)
        node = np.flatnonzero(covered > _COVERED * self.slave.area[self.slave.share])
        means = [points.gap, points.length, *points.normal.T]
        gap, length, *normal = (sums(values)[node] / covered[node] for values in means)
        directions = np.stack(normal, axis=1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        chosen = np.append(np.isin(np.arange(number), node), False)[points.slot]
        area = np.where(chosen, np.append(covered, 1.0)[points.slot], 1.0)
        points = points._replace(part=np.where(chosen, points.part, 0.0) / area)
        none = np.zeros(len(node), dtype=np.int64)
        return SurfaceCandidates(
            node, none, none, np.zeros((len(node), 2)), directions, gap, length, points
        )

    def elements(
        self, found: Any, positions: Sequence[FloatArray], path: FloatArray, step: Step
    ) -> SurfaceElements:
        """Equations of candidates in a step. Collective."""
        number = np.full(len(self.slave.share) + 1, -1)
        number[found.node] = np.arange(len(found.node))
        points = found.points
        slot = number[points.slot]
        points = points._replace(slot=slot).select((slot >= 0).any(axis=1))
        points = points.select(np.lexsort((points.other, points.own)))
        both = np.column_stack([points.own, points.other])
        new = np.diff(both, axis=0, prepend=-1).any(axis=1)
        attachment = FacetAttachment(
            slave=self.slave, master=self.master, own=points.own[new], other=points.other[new]
        )
        slaves, master = positions
        x = np.einsum("nc,nci->ni", points.shape, slaves[self.slave.face_nodes[points.own]])
        corners = self.master.control_points(master, points.other)
        measure = FacetGap(
            start=np.concatenate([x[:, None], corners], axis=1), xi=points.xi,
            normal=points.normal, length=points.length, rule=step.integrator.contact_gradient,
            theta=step.integrator.theta, condense=True,
        )  # fmt: skip
        sums = Sums(
            slaves=len(found.node), element=np.cumsum(new) - 1, slot=points.slot,
            share=np.where(points.slot >= 0, points.part, 0.0), shape=points.shape,
            cut=points.cut,
        )  # fmt: skip
        return surface_elements(self, found, attachment, measure, sums, step)

    def strayed(self, positions: Sequence[FloatArray], found: Any, due: FloatArray) -> float:
        """None: where pieces are cut is looked at elsewhere, see `SurfaceElements.is_stale`."""
        return 0.0

    def missed(
        self,
        positions: Sequence[FloatArray],
        motions: Sequence[FloatArray],
        path: FloatArray,
        reach: float,
        held: IntArray,
        aimed: IntArray,
    ) -> IntArray | None:
        """Raise where nodes without contact have come through a facet, as of `ContactPair`.

        No other facet is to hold a node: none does alone.
        """
        if not self.is_long(reach):
            return None
        paths = self.slave_paths.gather(motions)
        through = np.flatnonzero(self.slave_paths.came_through(positions, *paths, held) >= 0)
        text = None
        if through.size:
            text = (
                f"contact {self.name!r}: node {self.slave.original[self.slave.share[through[0]]]} "
                f"has come through {self.master_name!r} beside the points that were looked at; use "
                "a smaller dt"
            )
        comm = self.slave.body.comm
        raise_together(comm, text, lambda told: StepFailedError(told, advises=True))
        return None
