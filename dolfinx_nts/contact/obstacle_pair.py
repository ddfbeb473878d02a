"""Contact of a surface's nodes with a rigid obstacle: which node may touch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinx_nts.contact.candidates import MARGIN, Candidates, Found, Motion
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.making import elements_of
from dolfinx_nts.contact.node_attachment import NodeAttachment
from dolfinx_nts.contact.obstacle_gap import ObstacleGap
from dolfinx_nts.contact.obstacles import Obstacle
from dolfinx_nts.contact.pair import INITIAL_PENETRATION, ContactPair
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.parallel import Asking, global_max, together
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import StepFailedError

#: A node passes through an obstacle if its path is longer than this part of the radius, and lies
#: this part of it deeper than both ends.
_PASSING = 0.1


class ObstaclePair(ContactPair, master=Obstacle):
    """A `ContactPair` whose master is an obstacle.

    Attributes:
        obstacle: The master relative to `origin`.
    """

    def _set_up(self) -> None:
        self.obstacle: Obstacle = self.master.about(self.origin)

    @property
    def driven(self) -> bool:
        """Whether the obstacle moves."""
        return self.master.driven

    def has_master_of(self, other: ContactPair) -> bool:
        """Return whether the obstacles of both are equal."""
        return bool(self.master == other.master)

    def shares_master(self, other: ContactPair) -> str | None:
        """The obstacle, if both have it."""
        same = isinstance(other, ObstaclePair) and self.has_master_of(other)
        return f"the same {self.master.name}" if same else None

    def path(self, start: float, end: float) -> FloatArray:
        """Displacements of the obstacle at two times [m], shape (2, 3). Collective."""
        comm = self.slave.body.comm
        return np.stack([self.master.displacement(t, comm) for t in (start, end)])

    def encloses(self, u: Sequence[FloatArray], time: float) -> bool:
        """Return whether no part of the slave's body starts outside. Collective."""
        body = self.slave.body
        if body.mesh is None:
            return False
        corners = body.boundary_now(u[0]).reshape(-1, 3) - self.origin - self.path(time, time)[0]
        gap = self.obstacle.gap(corners).value
        ends = np.array([gap.max(initial=-np.inf), -gap.min(initial=np.inf)])
        highest, depth = global_max(body.comm, ends).tolist()
        limit = INITIAL_PENETRATION * np.sqrt(self.slave.area.max())
        return bool(highest <= limit < depth)

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Asking[Found]:
        """Candidates, as of `ContactPair`. Nothing limits the depth: what is behind is inside."""
        yield from ()
        slave, reach = self.slave, 0.0 if motion is None else motion.reach
        reach += self.lift
        x = positions[0][slave.share] - path[0]
        gap, length = self.obstacle.gap(x), np.sqrt(slave.area[slave.share])
        movable = ~slave.fixed[slave.share].all(axis=1)
        node = np.flatnonzero(movable & (gap.value < reach + MARGIN * length))
        only, xi = np.zeros(len(node), dtype=np.int64), np.zeros((len(node), 2))
        normal = gap.gradient[node, 0]
        left = gap.value[node] - self.offset[node]
        found = Candidates(node, only, only, xi, normal, left, length[node])
        cover = reach - self.lift + MARGIN * float(np.sqrt(slave.area.min()))
        return Found(found, np.ones(len(slave.share), dtype=bool), cover)

    def _at_start(self, positions: Sequence[FloatArray], path: FloatArray) -> Candidates:
        """As of `ContactPair`."""
        still = Motion(self.adjust, (), np.empty(0, dtype=np.int64))
        (found,) = together(self.slave.body.comm, [self.find(positions, still.aimed, path, still)])
        return found.candidates

    def elements(
        self, found: Candidates, positions: Sequence[FloatArray], path: FloatArray, step: Step
    ) -> ContactElements:
        """Equations of candidates in a step. Collective."""
        attachment = NodeAttachment(
            slave=self.slave, node=self.slave.share[found.node], path=(path[0], path[1])
        )
        measure = ObstacleGap(
            obstacle=self.obstacle, start=self.points(positions, found) - path[0],
            normal=found.normal, length=found.length, rule=step.integrator.contact_gradient,
            theta=step.integrator.theta,
        )  # fmt: skip
        return elements_of(self, found, attachment, measure, step)

    def missed(
        self,
        positions: Sequence[FloatArray],
        motions: Sequence[FloatArray],
        path: FloatArray,
        reach: float,
        held: IntArray,
        aimed: IntArray,
    ) -> Asking[IntArray | None]:
        """None; raises if a node has gone through the obstacle and out of it again."""
        yield from ()
        obstacle = self.obstacle
        if reach <= _PASSING * obstacle.width:
            return None
        x0 = positions[0] - path[0]
        x1 = positions[0] + self.slave.gather(motions[0]) - path[1]
        ends = np.minimum(obstacle.gap(x0).value, obstacle.gap(x1).value)
        passed = obstacle.lowest_gap(x0, x1) < ends - _PASSING * obstacle.width
        if passed.any():
            node = int(self.slave.original[np.flatnonzero(passed)[0]])
            raise StepFailedError(
                f"contact {self.name!r}: node {node} passes through the obstacle within the step; "
                "use a smaller dt",
                advises=True,
            )
        return None
