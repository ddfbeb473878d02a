"""Contact of a surface with a rigid obstacle that is integrated over the surface."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact.candidates import MARGIN, Found, Motion
from dolfinx_nts.contact.edges import LEVEL
from dolfinx_nts.contact.obstacle_gap import ObstacleGap
from dolfinx_nts.contact.obstacle_pair import ObstaclePair
from dolfinx_nts.contact.obstacles import Obstacle, inverse
from dolfinx_nts.contact.segments import FACING
from dolfinx_nts.contact.slave_points import OverMaster, SlavePoints, check_slave, moved, sums_of
from dolfinx_nts.contact.surface_elements import SurfaceElements, surface_elements
from dolfinx_nts.contact.surface_sums import FacetAttachment
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.kernels import facets
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.parallel import Asking
from dolfinx_nts.types import BoolArray, FloatArray, IntArray


class ObstacleSurfacePair(ObstaclePair, master=Obstacle, integration="surface"):
    """An `ObstaclePair` that keeps the slave's surface out in the mean around each node.

    A node of a sharp edge has in its mean what lies level with the obstacle. On an edge nothing
    does, and it stays out itself.
    """

    holds_nodes = False

    def _set_up(self) -> None:
        super()._set_up()
        check_slave(self)
        if self.slave.body.rigid:
            raise ValueError(
                f'integration="surface": {self.slave.body.name!r} is rigid, and nothing yields to '
                'a pressure; use integration="nodes"'
            )
        self._own = SlavePoints(self.slave)

    @cached_property
    def _points(self) -> OverMaster:
        """Points of this rank's facets, without what depends on their places."""
        own, slave = self._own.facets, self.slave
        at, weights = facets.QUADRATURE[slave.facets.shape[1]]
        facet = np.repeat(own, len(at))
        at, weights = np.tile(at, (len(own), 1)), np.tile(weights, len(own))
        return self._still(facet, *self._own.at(facet, at, weights))

    @cached_property
    def _sharp(self) -> BoolArray:
        """Which points of the slave are of sharp edges of its body, shape (p,). Collective."""
        mesh = self.slave.body.mesh
        if mesh is None or mesh.topology.dim < 3:
            return np.zeros(len(self.slave.points), dtype=bool)
        edges = self.slave.sharp_edges
        return np.isin(self.slave.points, edges.surface.points[edges.ends])

    @cached_property
    def _edge_nodes(self) -> OverMaster:
        """Points at this rank's nodes of sharp edges, each for itself. Collective."""
        slave = self.slave
        node = np.flatnonzero(self._sharp[slave.share])
        corner = np.full(len(slave.points), -1)
        corner[slave.facets.ravel()] = np.arange(slave.facets.size)
        facet, at = np.divmod(corner[slave.share[node]], slave.facets.shape[1])
        shape = slave.shape(facet, facets.CORNERS[slave.facets.shape[1]][at])
        here = slave.face_nodes[facet] == slave.share[node][:, None]
        slot = np.where(here, node[:, None], -1)
        hat = here.astype(float)
        return self._still(facet, shape, slot, hat, slave.area[slave.share[node]][:, None] * hat)

    def _still(
        self, facet: IntArray, shape: FloatArray, slot: IntArray, hat: FloatArray, part: FloatArray
    ) -> OverMaster:
        """Points but for gaps and normals, those without any that is free to move left out."""
        n, slave = len(facet), self.slave
        found = OverMaster(
            facet, np.zeros(n, dtype=np.int64), shape, np.zeros((n, 2)), np.zeros((n, 3)),
            np.zeros(n), facets.size(slave.reference[slave.facets[facet]]), np.zeros((n, 2)),
            slot, hat, part,
        )  # fmt: skip
        free = ~slave.fixed.all(axis=1)[slave.face_nodes[facet]]
        return found.select((free & (shape != 0.0)).any(axis=1))

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Asking[Found]:
        """Candidates, as of `ObstaclePair`. Collective."""
        yield from ()
        slave, reach = self.slave, 0.0 if motion is None else motion.reach
        at = positions[0] - path[0]
        points = self._measured(self._points, at)
        points = self._facing(points, at)
        if len(self._own.supported):
            points = self._own.hand_over(points, *self._prescribed(positions, path, motion))
        found: Any = self._own.nodes(points)
        found = found.select(found.gap < reach + MARGIN * found.length)
        sizes = facets.size(slave.reference[slave.facets])
        cover = reach + MARGIN * float(sizes.min(initial=np.inf))
        return Found(found, np.ones(len(slave.share), dtype=bool), cover)

    def _prescribed(
        self, positions: Sequence[FloatArray], path: FloatArray, motion: Motion | None
    ) -> tuple[FloatArray, FloatArray]:
        """What `SlavePoints.hand_over` takes. Collective."""
        (x,) = moved(self, positions, motion)
        found = self.obstacle.gap(x[self._own.supported] - path[1])
        return found.value, found.gradient[:, 0]

    def _measured(self, points: OverMaster, at: FloatArray) -> OverMaster:
        """Points with gaps and normals by positions relative to the obstacle's motion [m]."""
        found = self.obstacle.gap(self._places(points, at))
        return points._replace(gap=found.value, normal=found.gradient[:, 0])

    def _places(self, points: OverMaster, at: FloatArray) -> FloatArray:
        """Places of points [m], shape (n, 3), by those of the surface's."""
        return np.einsum("nc,nci->ni", points.shape, at[self.slave.face_nodes[points.own]])

    def _facing(self, points: OverMaster, at: FloatArray) -> OverMaster:
        """Those of facets that face the obstacle, and edges' nodes where nothing is level."""
        slave, number = self.slave, len(self.slave.facets)
        turn = np.stack([np.bincount(points.own, n, number) for n in points.normal.T], axis=1)
        corners = at[slave.facets]
        # Of quadrilaterals the diagonals, of triangles two sides.
        across = cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])
        lengths = np.linalg.norm(turn, axis=1) * np.linalg.norm(across, axis=1)
        cosine = np.einsum("ni,ni->n", turn, across) * inverse(lengths)
        level = cosine < -np.sqrt(1.0 - LEVEL**2)
        chosen = points.select((cosine < FACING)[points.own])
        out = self._sharp[slave.face_nodes[chosen.own]] & ~level[chosen.own][:, None]
        chosen = chosen._replace(
            slot=np.where(out, -1, chosen.slot), part=np.where(out, 0.0, chosen.part)
        )
        lies = np.zeros(len(slave.share) + 1, dtype=bool)
        lies[chosen.slot] = True
        nodes = self._edge_nodes
        alone = nodes.select(~lies[nodes.slot.max(axis=1)])
        alone = self._measured(alone, at)
        # Each is an element of its own.
        alone = alone._replace(other=1 + np.arange(len(alone.own)))
        return OverMaster._make(np.concatenate(both) for both in zip(chosen, alone, strict=True))

    def elements(
        self, found: Any, positions: Sequence[FloatArray], path: FloatArray, step: Step
    ) -> SurfaceElements:
        """Equations of candidates in a step. Collective."""
        points, element, new = self._own.numbered(found)
        attachment = FacetAttachment(
            slave=self.slave, own=points.own[new], master=None, other=points.other[new],
            path=(path[0], path[1]),
        )  # fmt: skip
        measure = ObstacleGap(
            obstacle=self.obstacle, start=self._places(points, positions[0] - path[0])[:, None],
            normal=points.normal, length=points.length, rule=step.integrator.contact_gradient,
            theta=step.integrator.theta,
        )  # fmt: skip
        sums = sums_of(found, points, element)
        return surface_elements(self, found, attachment, measure, sums, step)
