"""Contact that is integrated over the slave's surface: which parts of it lie over the master."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact import passages, search
from dolfinx_nts.contact.candidates import MARGIN, Found, Motion
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.facet_pair import OVERHANG, FacetPair
from dolfinx_nts.contact.segments import near, segments
from dolfinx_nts.contact.slave_points import (
    PRESCRIBED,
    OverMaster,
    SlavePoints,
    check_slave,
    moved,
    sums_of,
)
from dolfinx_nts.contact.surface_elements import SurfaceElements, surface_elements
from dolfinx_nts.contact.surface_sums import FacetAttachment
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.parallel import Asking, raise_together
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import StepFailedError

#: A point's foot may lie so far, in convective coordinates, beyond an edge of two facets.
_BEYOND = 0.5


class SurfacePair(FacetPair, master=Surface, integration="surface"):
    """A `FacetPair` that keeps the slave's surface out in the mean around each node."""

    holds_nodes = False
    #: Number of the master's faces that hold it, see `ConvexEdges.faces`.
    face = 0

    def _set_up(self) -> None:
        super()._set_up()
        check_slave(self)
        if self.slave.body.rigid and self.master.body.rigid:
            raise ValueError(
                f'integration="surface": both {self.slave.body.name!r} and '
                f"{self.master.body.name!r} are rigid, and nothing yields to a pressure; use "
                'integration="nodes"'
            )
        if self.master.smooth:
            raise ValueError(
                f'integration="surface": the master, {self.master.body.name!r}, is smoothed, and '
                "forces on smooth patches are those of no uniform pressure; leave smoothing out"
            )
        self._own = SlavePoints(self.slave)

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Asking[Found]:
        """Nodes of this rank with facets over the master, as of `ContactPair`."""
        yield from ()
        reach, at = 0.0 if motion is None else motion.reach, positions
        solved = motion is not None and motion.solved
        end = moved(self, positions, motion) if solved or self._supported else positions
        if solved:
            # An equilibrium is one of the pieces that it has itself.
            reach, at = 0.0, end
        sizes = facets.size(at[1][self.master.facets])
        points = self._over(at, reach, reach + MARGIN * float(sizes.max()))
        if solved:
            points = self._seen_from(points, positions)
        if self._supported:
            points = self._own.hand_over(points, *self._prescribed(end))
        cover = (0.0 if motion is None else motion.reach) + MARGIN * float(sizes.min())
        found: Any = self._own.nodes(points)
        return Found(found, np.ones(len(self.slave.share), dtype=bool), cover)

    @cached_property
    def _supported(self) -> bool:
        """Whether supports hold points of both surfaces, on all ranks alike."""
        return bool(len(self._own.supported) and self.master.fixed.all(axis=1).any())

    def _prescribed(self, positions: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """What `SlavePoints.hand_over` takes, at positions of all points [m]."""
        slaves, master = positions
        x, mine = slaves[self._own.supported], np.flatnonzero(self.convex.faces == self.face)
        facet = mine[search.closest_facets(x, master[self.master.facets[mine]], reach=np.inf).facet]
        xi, converged, normal, gap = self._measured(x, master, facet)
        still = converged & (self._foot_moves(facet, xi) <= PRESCRIBED)
        return np.where(still, gap, np.inf), normal

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
        own, other = slaves[self.slave.facets[self._own.facets]], master[self.master.facets]
        one, two = near(own, other, radius)
        mine = self.convex.faces[two] == self.face
        pairs = one[mine], two[mine]
        if not len(pairs[0]):
            return self._own.none
        found = segments(own, other, pairs)
        facet, over = self._own.facets[found.own], found.other
        shape, slot, hat, part = self._own.at(facet, found.xi, found.weight)
        x = np.einsum("nc,nci->ni", shape, slaves[self.slave.face_nodes[facet]])
        xi, converged, normal, gap = self._measured(x, master, over)
        length = facets.size(other)[over]
        excess = facets.edge_excess(xi, other.shape[1])
        rim = self._free_edges[over]
        legal = converged & (excess <= np.where(rim, OVERHANG, _BEYOND)).all(axis=1)
        legal &= (gap > -MARGIN * length) & (gap < reach + MARGIN * length)
        points = OverMaster(facet, over, shape, xi, normal, gap, length, xi, slot, hat, part)
        return points.select(legal)

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

    def stops(self, node: IntArray, master: FloatArray) -> passages.Stops | None:
        """As of `FacetPair`: those of its faces."""
        faces = self.convex.faces
        return (lambda _, facet: faces[facet] == self.face) if faces.any() else None

    def elements(
        self, found: Any, positions: Sequence[FloatArray], path: FloatArray, step: Step
    ) -> SurfaceElements:
        """Equations of candidates in a step. Collective."""
        points, element, new = self._own.numbered(found)
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
        sums = sums_of(found, points, element)
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
    ) -> Asking[IntArray | None]:
        """Raise where nodes without contact have come through a facet, as of `ContactPair`.

        No other facet is to hold a node: none does alone.
        """
        yield from ()
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


class OtherFaces(SurfacePair):
    """Faces of a pair's master beyond inner edges, with multipliers of their own.

    Around a node of the slave in such an edge no mean of the gaps to both faces keeps it out of
    either.

    Args:
        of: The pair, whose options it has.
        face: Number of the faces.
    """

    of: SurfacePair

    def __init__(self, of: SurfacePair, face: int) -> None:
        self.of, self.face, self.added = of, face, face - 1
        super().__init__(
            of.slave, of.master, friction=of.friction, interference=of.interference, name=of.name
        )


def other_faces(pair: Any) -> list[OtherFaces]:
    """What holds the slave of a pair out of faces beyond inner edges of its master."""
    if type(pair) is not SurfacePair:
        return []
    return [OtherFaces(pair, k) for k in range(1, 1 + int(pair.convex.faces.max(initial=0)))]
