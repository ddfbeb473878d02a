"""Contact of a surface's nodes with the facets of another surface: which node may touch which."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact import passages, search
from dolfinx_nts.contact.contact_elements import ContactElements, elements_of
from dolfinx_nts.contact.convex_edges import ASIDE, OUTSIDE, ConvexEdges, middles
from dolfinx_nts.contact.edges import Edges, sharp_edges
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.node_attachment import NodeAttachment
from dolfinx_nts.contact.pair import (
    MARGIN,
    NO_CANDIDATES,
    Candidates,
    ContactPair,
    Found,
    Motion,
)
from dolfinx_nts.contact.rims import Rims, facets_around
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.kernels import compiled, facets, nts_element
from dolfinx_nts.parallel import anywhere, raise_together
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import StepFailedError

#: A node may project this far (in convective coordinates) beyond an edge that the master surface
#: ends at ...
OVERHANG = 0.05
#: ... and this far beyond an edge shared with another facet, between the normal cones of a convex
#: edge, and further by what the node may be away.
_WEDGE = 0.5
#: A foot is followed from piece to piece of the surface over a facet so often; then the last will
#: do, as neighbours go on alike beyond their border.
_MOST_PATCHES = 3
#: Least cosine between one normal and the opposite of the other of what faces each other; sides of
#: a right angle do not, also where bodies that are pressed have turned them by 17 degrees.
_FACING = 0.3
#: Weights of a foot that are rounding.
_STILL = 1e-9

#: Numbers of slaves and of facets -> which of these pairs face each other.
Faces = Callable[[IntArray, IntArray], BoolArray]


class FacetPair(ContactPair, master=Surface):
    """A `ContactPair` whose master is a surface of a body."""

    def _set_up(self) -> None:
        master = self.master
        self._check_surfaces()
        self.extent = max(self.extent, master.material.extent(self.origin))
        self._free_edges = master.boundary_edges
        self._edges = ConvexEdges(master.facets, master.reference[master.facets])
        self._facing: Faces | None = None

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

    @cached_property
    def sharp_edges(self) -> tuple[Edges, Edges]:
        """Sharp edges of the slave's and of the master's body in the surfaces. Collective."""
        slave, master = (sharp_edges(s.body.boundary(), s) for s in self.surfaces)
        return slave, master

    @cached_property
    def _rims(self) -> Rims:
        return Rims(self, self._free_edges, self.sharp_edges[1])

    @cached_property
    def sag(self) -> float:
        """As of `ContactPair`: s^2/(8 r) of facets that turn by s/r from one to the next."""
        if self.master.weights is not None or not len(self.master.facets):
            return 0.0
        corners = self.master.reference[self.master.facets]
        (place, normal), (one, two, _) = middles(corners), self._edges.smooth
        cosine = np.einsum("ni,ni->n", normal[one], normal[two])
        way = np.linalg.norm(place[one] - place[two], axis=1) / facets.size(corners)[one]
        sags: FloatArray = way * np.arccos(np.clip(cosine, -1.0, 1.0)) / 8.0
        return float(sags.max(initial=0.0))

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

    def positions(self, u: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Positions of all points of both surfaces [m], (p, 3) each, as of `ContactPair`."""
        both = zip((self.slave, self.master), u, strict=True)
        return tuple(self._moved(surface, each) for surface, each in both)

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
    ) -> Found:
        """Search for this rank's candidates, as of `ContactPair`. Collective."""
        reach = self._lift + (0.0 if motion is None else motion.reach)
        every = np.ones(len(self.slave.share), dtype=bool)
        known = every if followed is None else followed
        slaves, master = positions
        corners = master[self.master.facets]
        sizes = facets.size(corners)
        radius, cover = (reach + MARGIN * float(s) for s in (sizes.max(), sizes.min()))
        cover -= self._lift
        # Positions of all points are known everywhere, so all ranks leave here or none.
        if search.apart(slaves, corners, radius):
            return Found(NO_CANDIDATES, ~every, radius - self._lift)
        x = slaves[self.slave.share]
        self._facing = self._what_faces(slaves, corners)
        closest = self._closest(slaves, corners, radius, current)
        node = np.flatnonzero(closest.facet >= 0)
        found, lost = self._measure(x, master, node, closest.facet[node], closest.xi[node], reach)
        if motion is not None:
            found = self._along_paths(found, slaves, master, motion._replace(reach=reach))
        beside = (found.gap < -OUTSIDE * found.length) & ~known[found.node]
        # What was followed and is out of reach is sought anew from either side.
        stays = np.zeros_like(every)
        stays[node], stays[lost] = known[node], False
        hidden, deepest = self._told(found.select(beside), current), (0.0, -1)
        if len(hidden.node):
            depth = -hidden.gap / hidden.length
            node = self.slave.share[hidden.node[depth.argmax()]]
            deepest = float(depth.max()), int(self.slave.original[node])
        found = found.select(~beside)
        stays[found.node] = True
        found = found._replace(gap=found.gap - self.offset[found.node])
        return Found(found, stays, cover, deepest)

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
        x, faces = slaves[self.slave.share], self._facing
        found = search.closest_facets(x, corners, reach=reach, current=current)
        near = np.flatnonzero(found.facet >= 0)
        if faces is None or not near.size:
            return found
        again = near[~faces(near, found.facet[near])]
        if again.size:
            admits = search.Admits(lambda point, facet: faces(again[point], facet))
            other = search.closest_facets(x[again], corners, reach=reach, admits=admits)
            for values, better in zip(found, other, strict=True):
                values[again] = better
        return found

    def _what_faces(self, slaves: FloatArray, corners: FloatArray) -> Faces | None:
        """Which facets face which of this rank's slaves, or None if all that is near does.

        Only over sharp edges a node that no facet of its own brings against a side of the master
        may be near it, as at rims that lie on each other.
        """
        if not len(self.slave.facets) or not self._edges.sharp.any():
            return None
        of, first, count = self._own_facets
        own, other = middles(slaves[self.slave.facets])[1], middles(corners)[1]
        # The tip of a needle has facets that face nothing ahead of it, but their mean does.
        mean = np.zeros_like(slaves)
        np.add.at(mean, self.slave.facets, own[:, None])
        mean = mean[self.slave.share]
        mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]

        def faces(node: IntArray, facet: IntArray) -> BoolArray:
            number = count[node]
            pair = np.repeat(np.arange(len(node)), number)
            start = np.cumsum(number) - number
            mine = of[first[node][pair] + np.arange(len(pair)) - start[pair]]
            found = (number == 0) | opposite(mean[node], other[facet])
            found[pair[opposite(own[mine], other[facet[pair]])]] = True
            return found

        return faces

    @cached_property
    def _own_facets(self) -> tuple[IntArray, IntArray, IntArray]:
        """Facets of the rank's slaves in a row, where those of each begin, and how many they are.

        None of nodes where the declared surface ends, as what is beyond there may face anything.
        """
        at = self.slave.facets
        facet, edge = np.nonzero(self.slave.boundary_edges)
        ends = [at[facet, edge], at[facet, (edge + 1) % at.shape[1]]]
        of, first, count = facets_around(self.slave)
        return of, first, np.where(np.isin(self.slave.share, np.concatenate(ends)), 0, count)

    def _beside(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Which sharp edges of facets end the surface for nodes, shape (n, nc).

        The facet beyond does not face the node.
        """
        ends = np.zeros((len(node), self.master.facets.shape[1]), dtype=bool)
        if self._facing is None:
            return ends
        beside, joined = self._edges.beside[facet], self._edges.joined[facet]
        some, edge = np.nonzero((beside >= 0) & (joined < 0))
        ends[some, edge] = ~self._facing(node[some], beside[some, edge] // ends.shape[1])
        return ends

    def _told(self, hidden: Candidates, current: IntArray) -> Candidates:
        """Those of nodes behind the surface that nothing else keeps from sinking in. Collective."""
        return hidden

    def _stops(self, node: IntArray, master: FloatArray) -> passages.Stops | None:
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
        found, _ = self._measure(
            x, master, node, closest.facet[node], closest.xi[node], self.adjust
        )
        excess = facets.edge_excess(found.xi, corners.shape[1]).max(axis=1)
        over = excess <= search.PREFERENCE
        return found.select(over | (closest.distance[found.node] <= self.adjust))

    def _along_paths(
        self,
        found: Candidates,
        slave: FloatArray,
        master: FloatArray,
        motion: Motion,
    ) -> Candidates:
        """Candidates with the facets that their paths lead to in place of the closest. Collective.

        Args:
            found: Candidates of the closest facets.
            slave: Points of the slave at t_n [m].
            master: Points of the master at t_n [m].
            motion: Expected in the step.
        """
        x = slave[self.slave.share]
        slave_path, master_path = self._gather_paths(motion.paths)
        found = self._round_edges(found, x, master, slave_path, master_path)
        found = self._past_edges(found, x, master, slave_path, master_path, motion.reach)
        change, facet = self._crossings(found, master, 0.5 * slave_path, 0.5 * master_path)
        corners, node = master[self.master.facets], found.node[change]
        if len(node):
            start, _ = compiled.closest_point(x[node], corners[facet])
            other, _ = self._measure(x, master, node, facet, start, motion.reach)
            found = _replace(found, other)
        if self.has_edges:
            ways = slave_path, master_path
            found = self._rims.without_tilted(found, (slave, master), ways)
        aimed = motion.aimed
        if self.is_long(motion.reach):
            stops = self._stops(np.arange(len(x)), master)
            hit, _ = passages.first_hits(
                x, slave_path, corners, master_path[self.master.facets], stops
            )
            aimed = np.where(hit >= 0, hit, aimed)
        node = np.flatnonzero(aimed >= 0)
        if len(node):
            start, _ = compiled.closest_point(x[node], corners[aimed[node]])
            other, _ = self._measure(x, master, node, aimed[node], start, None)
            found = _replace(found, other)
        return found

    def _round_edges(
        self,
        found: Candidates,
        x: FloatArray,
        master: FloatArray,
        slave_path: FloatArray,
        master_path: FloatArray,
    ) -> Candidates:
        """Candidates closest to an edge of two facets, with the one that they will be outside of.

        Both facets of a convex edge are as near, but a node is outside the body where it is outside
        one of them: the plane of the other one would hold what passes beside the body.

        Args:
            found: Candidates of the closest facets.
            x: This rank's slaves at t_n [m], shape (share, 3).
            master: Points of the master at t_n [m].
            slave_path: Expected motion of these slaves in the step [m], shape (share, 3).
            master_path: That of the points of the master [m].
        """
        nc = self.master.facets.shape[1]
        excess = facets.edge_excess(found.xi, nc)
        beyond = np.flatnonzero(excess.max(axis=1) > search.PREFERENCE)
        if not beyond.size:
            return found
        near, excess, moved = found.select(beyond), excess[beyond], master + master_path
        end = (x + slave_path)[near.node]
        far, best = self._gap_at(near.facet, near.xi, end, moved), near.facet.copy()
        for edge in range(nc):
            other = self._edges.beside[near.facet, edge] // nc
            some = np.flatnonzero((excess[:, edge] > search.PREFERENCE) & (other >= 0))
            some = some[self._does_face(near.node[some], other[some])]
            if not some.size:
                continue
            start, _ = compiled.closest_point(end[some], moved[self.master.facets[other[some]]])
            gap = self._gap_at(other[some], start, end[some], moved)
            outer = gap > far[some] + search.PREFERENCE * near.length[some]
            best[some[outer]], far[some[outer]] = other[some[outer]], gap[outer]
        change = np.flatnonzero(best != near.facet)
        if not change.size:
            return found
        return self._moved_to(found, near.node[change], best[change], x, master)

    def _moved_to(
        self,
        found: Candidates,
        node: IntArray,
        facet: IntArray,
        x: FloatArray,
        master: FloatArray,
    ) -> Candidates:
        """Candidates with other facets for some nodes, shape (n,) each."""
        start, _ = compiled.closest_point(x[node], master[self.master.facets[facet]])
        other, _ = self._measure(x, master, node, facet, start, None)
        return _replace(found, other)

    def _past_edges(
        self,
        found: Candidates,
        x: FloatArray,
        master: FloatArray,
        slave_path: FloatArray,
        master_path: FloatArray,
        reach: float,
    ) -> Candidates:
        """Candidates that will cross a facet's plane beyond its edge, with the facet beyond that.

        Arguments as of `_round_edges` and `Motion`.
        """
        # A facet is 2 xi wide, and less along its heights; most nodes come to no edge of theirs.
        beyond = facets.edge_excess(found.xi, self.master.facets.shape[1]).max(axis=1, initial=-1.0)
        near = self._edges.sharp[found.facet] & (beyond + 4.0 * reach / found.length > ASIDE)
        if not near.any():
            return found
        some = found.select(near)
        end, moved = (x + slave_path)[some.node], master + master_path
        some = some.select(self._gap_at(some.facet, some.xi, end, moved) < 0.0)
        if not some.node.size:
            return found
        node = some.node
        facet = self._passed(x[node], slave_path[node], some.facet, master, master_path)
        change = (facet >= 0) & self._does_face(node, facet)
        if not change.any():
            return found
        return self._moved_to(found, node[change], facet[change], x, master)

    def _passed(
        self,
        x: FloatArray,
        way: FloatArray,
        facet: IntArray,
        master: FloatArray,
        master_path: FloatArray,
    ) -> IntArray:
        """Facets that nodes pass when they cross the planes of others, or -1, shape (n,).

        The plane of a facet goes on beyond its edges, the body does not: what crosses it beyond a
        sharp convex edge passes the facet on the other side of that edge.

        Args:
            x: Nodes at t_n [m], shape (n, 3).
            way: Their motion [m], shape (n, 3).
            facet: Facets, shape (n,).
            master: Points of the master at t_n [m].
            master_path: Their motion [m].
        """
        patch, control, xi, good = self._projected(x, master, facet, np.zeros((len(x), 2)))
        carried, gaps = self.master.control_points(master_path, patch), []
        for place, points in ((x, control), (x + way, control + carried)):
            xi, _ = compiled.project(place, points, xi)
            foot, _, normal = facets.frame(points, xi)
            gaps.append(np.einsum("ni,ni->n", normal, place - foot))
        above, below = gaps
        length = facets.size(master[self.master.facets[facet]])
        sinks = np.flatnonzero(good & (below < -OUTSIDE * length) & (below < above))
        part = np.clip(above[sinks] / (above - below)[sinks], 0.0, 1.0)
        at, found = x[sinks] + part[:, None] * way[sinks], np.full(len(x), -1)
        found[sinks] = self._edges.across(at, facet[sinks], master, master_path, part)
        return found

    def _gap_at(
        self, facet: IntArray, xi: FloatArray, points: FloatArray, master: FloatArray
    ) -> FloatArray:
        """Distance of points (n, 3) from their facets' tangent planes at `xi` (n, 2) [m], (n,)."""
        foot, _, normal = facets.frame(master[self.master.facets[facet]], xi)
        gap: FloatArray = np.einsum("ni,ni->n", normal, points - foot)
        return gap

    def _gather_paths(self, paths: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Displacements of this rank's slaves and of all points of the master [m]. Collective."""
        slave = self.slave.gather(paths[0])[self.slave.share]
        return slave, self.master.gather(paths[1])

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
    ) -> IntArray | None:
        """Do as `ContactPair`. Collective."""
        comm = self.slave.body.comm
        by_edges = np.flatnonzero((held >= 0) & self._edges.sharp[held])
        let_go = np.flatnonzero((held < 0) & (aimed >= 0) & self._edges.sharp[aimed])
        aside = self._edges.sharp.any() and anywhere(comm, bool(by_edges.size or let_go.size))
        if not (aside or self.is_long(reach)):
            return None
        x, paths = positions[0][self.slave.share], self._gather_paths(motions)
        if aside:
            self._refuse_cut_corners(x, positions[1], *paths, let_go)
        hit = np.full(len(held), -1)
        if self.is_long(reach):
            hit = self._came_through(x, positions[1], *paths, held)
        if by_edges.size:
            beyond = self._held_beyond(x + paths[0], positions[1], paths[1], held, by_edges)
            hit[by_edges] = np.where(beyond >= 0, beyond, hit[by_edges])
        return hit

    def _held_beyond(
        self,
        end: FloatArray,
        master: FloatArray,
        master_path: FloatArray,
        held: IntArray,
        some: IntArray,
    ) -> IntArray:
        """Facet across the edge that some slaves are held beyond at the end, or -1, shape (n,).

        Args:
            end: This rank's slaves there [m], shape (share, 3).
            master: Points of the master at t_n [m].
            master_path: Their motion [m].
            held: Facets that hold the slaves, shape (share,).
            some: Numbers of slaves, shape (n,).
        """
        moved, found, start = master + master_path, np.full(len(some), -1), np.zeros((len(some), 2))
        _, _, xi, converged = self._projected(end[some], moved, held[some], start)
        excess = facets.edge_excess(xi, self.master.facets.shape[1]).max(axis=1)
        out = np.flatnonzero(converged & (excess > ASIDE))
        node, whole = some[out], np.ones(len(out))
        other = self._edges.across(end[node], held[node], master, master_path, whole)
        found[out] = np.where(self._does_face(node, other), other, -1)
        return found

    def _does_face(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Which facets, -1 none, face the rank's slaves, shape (n,)."""
        found = np.ones(len(node), dtype=bool)
        if self._facing is not None:
            some = np.flatnonzero(facet >= 0)
            found[some] = self._facing(node[some], facet[some])
        return found

    def _refuse_cut_corners(
        self,
        x: FloatArray,
        master: FloatArray,
        slave_path: FloatArray,
        master_path: FloatArray,
        some: IntArray,
    ) -> None:
        """Raise where slaves that are let go cut a corner of the master. Collective.

        Arguments as of `_round_edges`, of the solved step, and numbers of these slaves.
        """
        cut = self._edges.cut_corners(
            x[some], slave_path[some], master, master_path, self._stops(some, master)
        )
        node = self.slave.original[self.slave.share[some[cut]]]
        text = None
        if node.size:
            text = (
                f"contact {self.name!r}: node {node[0]} hits {self.master_name!r} and slides over "
                "its edge within the step; use a smaller dt"
            )
        comm = self.slave.body.comm
        raise_together(comm, text, lambda told: StepFailedError(told, advises=True))

    def _came_through(
        self,
        x: FloatArray,
        master: FloatArray,
        slave_path: FloatArray,
        master_path: FloatArray,
        held: IntArray,
    ) -> IntArray:
        """`missed` of nodes that have passed a facet, with arguments as of `_round_edges`."""
        at = self.master.facets
        stops = self._stops(np.arange(len(x)), master)
        hit, _ = passages.first_hits(x, slave_path, master[at], master_path[at], stops)
        node = np.flatnonzero((hit >= 0) & (hit != held))
        end, moved = (x + slave_path)[node], master + master_path
        start = np.zeros((len(node), 2))
        _, control, xi, converged = self._projected(end, moved, hit[node], start)
        foot, _, normal = facets.frame(control, xi)
        length = facets.size(moved[at[hit[node]]])
        depth = (np.einsum("ni,ni->n", normal, foot - end) + self.offset[node]) / length
        # A node that is held at another facet may end a little behind this one.
        deep = depth > np.where(held[node] >= 0, MARGIN, OUTSIDE)
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
        """Choose the pairs (node, facet) that may touch, and nodes beyond the surface's edge.

        Projected from `start`; with reach None all may touch whose projection is found.
        """
        patch, control, xi, converged = self._projected(x[node], master, facet, start)
        foot, _, normal = facets.frame(control, xi)
        gap = np.einsum("ni,ni->n", normal, x[node] - foot)
        length = facets.size(master[self.master.facets[facet]])
        legal = converged & self._movable(node, patch, xi, -gap / length)
        beyond = np.zeros_like(legal)
        if reach is not None:
            over, beyond = self._over_facet(node, facet, xi, reach / length)
            legal &= over & (gap > -MARGIN * length) & (gap < reach + MARGIN * length)
        found = Candidates(node, facet, patch, xi, normal, gap, length).select(legal)
        return found, node[beyond]

    def _projected(
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

    def _crossings(
        self, c: Candidates, master: FloatArray, slave_motion: FloatArray, master_motion: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Candidates that slide over an edge before the middle of the step, and their next facet.

        A facet that holds the longer part of the path makes g_0 as often positive as negative, so
        that what changes of facet cost and bring cancels in the long run.
        """
        nc = self.master.facets.shape[1]
        pair = self.master.control_points(master, c.patch)
        shape, _, _ = facets.shape(c.xi, pair.shape[1])
        _, tangents, _ = facets.frame(pair, c.xi)
        motion = slave_motion[c.node]
        carried = self.master.control_points(master_motion, c.patch)
        motion = motion - np.einsum("ni,nij->nj", shape, carried)
        metric = np.einsum("naj,nbj->nab", tangents, tangents)
        along = np.einsum("naj,nj->na", tangents, motion)
        slide = nts_element.solve(metric, along[:, :, None])[:, :, 0]
        before, after = (facets.edge_excess(xi, nc) for xi in (c.xi, c.xi + slide))
        edge = after.argmax(axis=1)
        pairs = np.arange(len(edge))
        joined = self._edges.joined[c.facet, edge]
        # On an edge rounding must not decide: a node that stays at its facet there is within it.
        within = before.max(axis=1) <= search.PREFERENCE
        over = within & (after[pairs, edge] > search.PREFERENCE)
        change = np.flatnonzero(over & (joined >= 0))
        return change, joined[change] // nc

    def _over_facet(
        self, node: IntArray, facet: IntArray, xi: FloatArray, reach: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Return whether pairs within `reach` (facet sizes) may touch there; a facet is 2 xi wide.

        And whether they are beyond an edge that the surface ends at.
        """
        excess = facets.edge_excess(xi, self.master.facets.shape[1])
        free = self._free_edges[facet] | self._beside(node, facet)
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
        points = self.master.patches[patch[held]]
        if self.master.weights is None:
            foot, _, _ = facets.shape(xi[held], points.shape[1])
        else:
            weights = self.master.weights[patch[held]]
            foot, _, _ = facets.shape(xi[held], weights.shape[1])
            foot = np.einsum("nk,nkp->np", foot, weights)
        free = ~self.master.fixed[points].all(axis=2)
        moves = (np.abs(foot) * free).max(axis=1)
        movable[held] = moves > np.maximum(_STILL, depth[held])
        return movable


def opposite(one: FloatArray, two: FloatArray) -> BoolArray:
    """Return which of unit normals (n, 3) face each other, shape (n,)."""
    facing: BoolArray = np.einsum("ni,ni->n", one, two) < -_FACING
    return facing


def _replace(found: Candidates, other: Candidates) -> Candidates:
    """Candidates with the others in place of those of the same nodes, in the order of the nodes."""
    stay = ~np.isin(found.node, other.node)
    order = np.argsort(np.concatenate([found.node[stay], other.node]))
    return Candidates(
        *(np.concatenate([a[stay], b])[order] for a, b in zip(found, other, strict=True))
    )
