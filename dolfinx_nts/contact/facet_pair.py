"""Contact of a surface's nodes with the facets of another surface: which node may touch which."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact import passages, search
from dolfinx_nts.contact.candidates import MARGIN, NO_CANDIDATES, Candidates, Found, Motion
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.convex_edges import OUTSIDE, middles
from dolfinx_nts.contact.edges import Edges
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.facing import Facing
from dolfinx_nts.contact.making import elements_of
from dolfinx_nts.contact.node_attachment import NodeAttachment
from dolfinx_nts.contact.normal_cones import NormalCones
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.contact.rims import Rims
from dolfinx_nts.contact.slave_paths import SlavePaths
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.parallel import Asking
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: A node may project this far (in convective coordinates) beyond an edge that the master surface
#: ends at ...
OVERHANG = 0.05
#: ... and this far beyond an edge shared with another facet, between the normal cones of a convex
#: edge, and further by what the node may be away.
_WEDGE = 0.5
#: A foot is followed from piece to piece of the surface over a facet so often; then the last will
#: do, as neighbours go on alike beyond their border.
_MOST_PATCHES = 3
#: Weights of a foot that are rounding.
_STILL = 1e-9


class FacetPair(ContactPair, master=Surface):
    """A `ContactPair` whose master is a surface of a body.

    Attributes:
        convex: Edges of the master at which it turns away from the slave.
        facing: Which of its facets face which nodes.
        slave_paths: Where these go over it.
    """

    def _set_up(self) -> None:
        master = self.master
        self._check_surfaces()
        self.extent = max(self.extent, master.material.extent(self.origin))
        self._free_edges = master.boundary_edges
        self.convex = master.convex
        self.facing = Facing(self.slave, master, self.convex)
        self.cones = NormalCones(self)
        self.slave_paths = SlavePaths(self)

    def _check_surfaces(self) -> None:
        """Raise a ValueError unless slave and master are apart."""
        slave, master = self.slave, self.master
        nodes = slave.material.nodes, master.material.nodes
        if slave.body is master.body and np.intersect1d(*nodes).size:
            raise ValueError(
                f"slave, master: both surfaces of {slave.body.name!r} share nodes; "
                "choose disjoint markers, or pass one surface to SelfContact"
            )

    @property
    def has_edges(self) -> bool:
        """As of `ContactPair`: those of bodies with cells in space."""
        meshes = [body.mesh for body in self.bodies]
        return self.edges and all(m is not None and m.topology.dim == 3 for m in meshes)

    @property
    def sharp_edges(self) -> tuple[Edges, Edges]:
        """Sharp edges of the slave's and of the master's body in the surfaces. Collective."""
        return self.slave.sharp_edges, self.master.sharp_edges

    @cached_property
    def rims(self) -> Rims:
        """Sharp edges that the master ends at. Collective."""
        return Rims(self, self._free_edges, self.sharp_edges[1])

    def sag(self, points: BoolArray) -> float:
        """As of `ContactPair`: s^2/(8 r) of facets that turn by s/r from one to the next."""
        at = self.master.facets
        if self.master.weights is not None or not len(at) or not points.any():
            return 0.0
        corners = self.master.reference[at]
        (place, normal), (one, two, _) = middles(corners), self.convex.smooth
        cosine = np.einsum("ni,ni->n", normal[one], normal[two])
        way = np.linalg.norm(place[one] - place[two], axis=1) / facets.size(corners)[one]
        sags = np.zeros(len(at))
        np.maximum.at(sags, one, way * np.arccos(np.clip(cosine, -1.0, 1.0)) / 8.0)
        found = search.closest_facets(self.slave.reference[points], corners, reach=np.inf)
        return float(sags[found.facet].max())

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """The slave and the master."""
        return self.slave, self.master

    @property
    def bodies(self) -> tuple[Any, ...]:
        """The slave's and the master's body."""
        return self.slave.body, self.master.body

    @property
    def redundant(self) -> bool:
        """Whether more points may touch than their bodies have freedom for, as of rigid ones."""
        return super().redundant or self.master.redundant

    @property
    def yields(self) -> bool:
        """Whether points of a surface can move against each other, as of `ContactPair`."""
        return super().yields or not self.master.body.rigid

    @property
    def master_name(self) -> str:
        """Name of the master's body."""
        name: str = self.master.body.name
        return name

    def has_master_of(self, other: ContactPair) -> bool:
        """Return whether the masters of both have the same facets."""
        return np.array_equal(self.master.facets, other.master.facets)

    def shares_master(self, other: ContactPair) -> str | None:
        """Return what both have for a master, if they share facets."""
        if not isinstance(other, FacetPair) or other.master.body is not self.master.body:
            return None
        common = self.master.facet_points & other.master.facet_points
        return f"the same facets of {self.master.body.name!r}" if common else None

    def depth(self, u: Sequence[FloatArray]) -> FloatArray | float:
        """Return how deep slaves start inside the master's body, in facet sizes. Collective."""
        if self.slave.body is self.master.body:
            return 0.0
        depth: FloatArray = self.master.depth(self.slave.positions(u[0]), u[1])
        return depth

    def points(self, positions: Sequence[FloatArray], found: Candidates) -> FloatArray:
        """Slave and control points of pairs [m], shape (n, nc + 1, 3)."""
        control = self.master.control_points(positions[1], found.patch)
        return np.concatenate([super().points(positions, found), control], axis=1)

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Asking[Found]:
        """Search for this rank's candidates, as of `ContactPair`."""
        self.slave_paths.forget()
        reach = self.lift + (0.0 if motion is None else motion.reach)
        every = np.ones(len(self.slave.share), dtype=bool)
        known = every if followed is None else followed
        slaves, master = positions
        corners = master[self.master.facets]
        sizes = facets.size(corners)
        radius, cover = (reach + MARGIN * float(s) for s in (sizes.max(), sizes.min()))
        cover -= self.lift
        # Positions of all points are known everywhere, so all ranks leave here or none.
        if search.apart(slaves, corners, radius):
            return Found(NO_CANDIDATES, ~every, radius - self.lift)
        x = slaves[self.slave.share]
        self.facing.look(slaves, corners)
        closest = self._closest(slaves, corners, radius, current)
        node = np.flatnonzero(closest.facet >= 0)
        if not (self.is_long(reach) or (yield node.size > 0)):
            return Found(NO_CANDIDATES, ~every, cover)
        found, lost = self.measure(x, master, node, closest.facet[node], closest.xi[node], reach)
        let_go = lost
        if motion is not None:
            near = found.node
            near_by = motion._replace(reach=reach)
            found = yield from self.slave_paths.lead(found, slaves, master, near_by)
            let_go = np.concatenate([lost, np.setdiff1d(near, found.node)])
        beside = (found.gap < -OUTSIDE * found.length) & ~known[found.node]
        # What was followed and is out of reach is sought anew from either side.
        stays = np.zeros_like(every)
        stays[node], stays[let_go] = known[node], False
        found = found.select(~beside)
        stays[found.node] = True
        found = found._replace(gap=found.gap - self.offset[found.node])
        return Found(found, stays, cover)

    def _closest(
        self, slaves: FloatArray, corners: FloatArray, reach: float, current: IntArray
    ) -> search.Closest:
        """The closest facets of this rank's slaves. Collective.

        Args:
            slaves: Points of the slave at t_n [m].
            corners: Of the master's facets [m].
            reach: Largest distance of interest [m].
            current: As of `find`.
        """
        x, facing = slaves[self.slave.share], self.facing
        found = search.closest_facets(x, corners, reach=reach, current=current)
        near = np.flatnonzero(found.facet >= 0)
        if facing.all or not near.size:
            return found
        again = near[~facing.faces(near, found.facet[near])]
        if again.size:
            admits = search.Admits(lambda point, facet: facing.faces(again[point], facet))
            other = search.closest_facets(x[again], corners, reach=reach, admits=admits)
            # Over an edge of the one that is near, not through the body.
            at = self.master.facets
            one, two = at[found.facet[again]], at[other.facet]
            meet = (other.facet >= 0) & (one[:, :, None] == two[:, None]).any(axis=(1, 2))
            for values, better in zip(found, other, strict=True):
                values[again[meet]] = better[meet]
        return found

    def stops(self, node: IntArray, master: FloatArray) -> passages.Stops | None:
        """Which facets may stop these of the rank's slaves on their paths; None: all.

        Args:
            node: The slaves, shape (n,).
            master: Points of the master at t_n [m].
        """
        return None

    def elements(
        self, found: Candidates, positions: Sequence[FloatArray], path: FloatArray, step: Step
    ) -> ContactElements:
        """Equations of candidates in a step. Collective."""
        attachment = NodeAttachment(
            slave=self.slave, node=self.slave.share[found.node], master=self.master,
            facet=found.facet, patch=found.patch,
        )  # fmt: skip
        measure = FacetGap(
            start=self.points(positions, found), xi=found.xi, normal=found.normal,
            length=found.length, rule=step.integrator.contact_gradient,
            theta=step.integrator.theta, condense=step.condense,
        )  # fmt: skip
        return elements_of(self, found, attachment, measure, step)

    def _at_start(self, positions: Sequence[FloatArray], path: FloatArray) -> Candidates:
        """As of `ContactPair`: over their closest facets, or as near to an edge of these."""
        x, master = positions[0][self.slave.share], positions[1]
        corners = master[self.master.facets]
        reach = self.adjust + MARGIN * float(facets.size(corners).max(initial=0.0))
        closest = search.closest_facets(x, corners, reach=reach)
        node = np.flatnonzero(closest.facet >= 0)
        found, _ = self.measure(
            x, master, node, closest.facet[node], closest.xi[node], self.adjust
        )
        excess = facets.edge_excess(found.xi, corners.shape[1]).max(axis=1)
        over = excess <= search.PREFERENCE
        return found.select(over | (closest.distance[found.node] <= self.adjust))

    def is_long(self, reach: float) -> bool:
        """Return whether a motion may carry a node through a facet that is not the closest."""
        return reach > MARGIN * self.master.smallest

    def missed(
        self,
        positions: Sequence[FloatArray],
        motions: Sequence[FloatArray],
        path: FloatArray,
        reach: float,
        held: IntArray,
        aimed: IntArray,
    ) -> Asking[IntArray | None]:
        """Do as `ContactPair`."""
        return self.slave_paths.missed(positions, motions, reach, held, aimed)

    def strayed(
        self, positions: Sequence[FloatArray], found: Candidates, due: FloatArray
    ) -> float:
        """Do as `ContactPair`."""
        return self.slave_paths.strayed(positions, found, due)

    def measure(
        self,
        x: FloatArray,
        master: FloatArray,
        node: IntArray,
        facet: IntArray,
        start: FloatArray,
        reach: float | None,
    ) -> tuple[Candidates, IntArray]:
        """Choose the pairs (node, facet) that may touch, and nodes beyond the surface's edge.

        Projected from `start`; with reach None all may touch whose projection is found.
        """
        patch, control, xi, converged = self.projected(x[node], master, facet, start)
        foot, _, normal = facets.frame(control, xi)
        gap = np.einsum("ni,ni->n", normal, x[node] - foot)
        length = facets.size(master[self.master.facets[facet]])
        legal = converged & ~facets.turned_over(control, xi)
        legal &= self._movable(node, patch, xi, -gap / length)
        beyond = np.zeros_like(legal)
        if reach is not None:
            over, beyond = self._over_facet(node, facet, xi, reach / length)
            legal &= over & (gap > -MARGIN * length) & (gap < reach + MARGIN * length)
        found = Candidates(node, facet, patch, xi, normal, gap, length).select(legal)
        return found, node[beyond]

    def projected(
        self, points: FloatArray, master: FloatArray, facet: IntArray, start: FloatArray
    ) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
        """Projection of points (n, 3) onto what lies over their facets (n,), from `start` (n, 2).

        Returns:
            Patches, shape (n,), their control points [m], coordinates and which converged.
        """
        patch = self.master.patch_at(facet, start)
        control = self.master.control_points(master, patch)
        xi, converged = compiled.project(points, control, start)
        for _ in range(_MOST_PATCHES):
            other = self.master.patch_at(facet, xi)
            change = np.flatnonzero(converged & (other != patch))
            if not change.size:
                break
            patch[change] = other[change]
            control[change] = self.master.control_points(master, patch[change])
            xi[change], converged[change] = compiled.project(
                points[change], control[change], xi[change]
            )
        return patch, control, xi, converged

    def _over_facet(
        self, node: IntArray, facet: IntArray, xi: FloatArray, reach: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Return whether pairs within `reach` (facet sizes) may touch there; a facet is 2 xi wide.

        And whether they are beyond an edge that the surface ends at.
        """
        excess = facets.edge_excess(xi, self.master.facets.shape[1])
        free = self._free_edges[facet] | self.facing.beside(node, facet)
        wedge = _WEDGE + 2.0 * (reach + MARGIN)
        beyond: BoolArray = (free & (excess > OVERHANG)).any(axis=1)
        inside: BoolArray = (free | (excess <= wedge[:, None])).all(axis=1) & ~beyond
        return inside, beyond

    def _movable(
        self, node: IntArray, patch: IntArray, xi: FloatArray, depth: FloatArray
    ) -> BoolArray:
        """Return whether slave or foot of a pair may move; else there is nothing to solve for.

        Over a prescribed point of a facet that bends, the derivative of the gap is rounding, which
        a factorisation may take for a pivot: any force, and any motion from it. Where the node lies
        a little deep (in facet sizes), its foot moves off that point as the facet tilts, but to
        open the gap by that takes a motion of a whole facet.
        """
        movable = ~self.slave.fixed[self.slave.share[node]].all(axis=1)
        held = np.flatnonzero(~movable)
        moves = self._foot_moves(patch[held], xi[held])
        movable[held] = moves > np.maximum(_STILL, depth[held])
        return movable

    def _foot_moves(self, patch: IntArray, xi: FloatArray) -> FloatArray:
        """Largest part (n,) that a point of the master which may move has in feet (n, 2)."""
        points, weights = self.master.patches[patch], self.master.weights
        foot, _, _ = facets.shape(xi, (points if weights is None else weights).shape[1])
        if weights is not None:
            foot = np.einsum("nk,nkp->np", foot, weights[patch])
        free = ~self.master.fixed[points].all(axis=2)
        moves: FloatArray = (np.abs(foot) * free).max(axis=1)
        return moves
