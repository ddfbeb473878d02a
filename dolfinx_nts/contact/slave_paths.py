"""Which facets the paths of a slave's nodes lead to in a step, and which they have passed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.contact import passages, search
from dolfinx_nts.contact.candidates import MARGIN, Candidates, Motion
from dolfinx_nts.contact.convex_edges import ASIDE, OUTSIDE
from dolfinx_nts.contact.normal_cones import LETS_IN
from dolfinx_nts.contact.surfaces import gather_each
from dolfinx_nts.kernels import compiled, facets, nts_element
from dolfinx_nts.parallel import Asking, raise_together
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import StepFailedError

#: Patches of a smooth surface part by less than this part of the way beyond their borders.
_APART = 0.1
#: Beyond an edge, in convective coordinates, where a facet is 2 wide: what may slide on it.
_BY_EDGE = -8.0 * LETS_IN


class SlavePaths:
    """Where the nodes of a pair's slave go over its master.

    Args:
        pair: The `FacetPair`.
    """

    def __init__(self, pair: Any) -> None:
        self._pair, self._slave, self._master = pair, pair.slave, pair.master
        self._convex = pair.convex
        self._cones = pair.cones
        # Slaves that slide over edges in the step, and the facets before these.
        self._sliding: IntArray = np.empty((0, 2), dtype=np.int64)

    def forget(self) -> None:
        """Forget who slides over an edge, before a search."""
        self._sliding = self._sliding[:0]

    def lead(
        self,
        found: Candidates,
        slave: FloatArray,
        master: FloatArray,
        motion: Motion,
    ) -> Asking[Candidates]:
        """Candidates with the facets that their paths lead to in place of the closest.

        Args:
            found: Candidates of the closest facets.
            slave: Points of the slave at t_n [m].
            master: Points of the master at t_n [m].
            motion: Expected in the step.
        """
        x, ways = slave[self._slave.share], gather_each(self._pair.surfaces, motion.paths)
        slave_path, master_path = ways[0][self._slave.share], ways[1]
        found = self._round_edges(found, x, master, slave_path, master_path)
        found = self._past_edges(found, slave, master, slave_path, master_path, motion.reach)
        change, facet = self._crossings(found, master, 0.5 * slave_path, 0.5 * master_path)
        corners, node = master[self._master.facets], found.node[change]
        if len(node):
            start, _ = compiled.closest_point(x[node], corners[facet])
            other, _ = self._pair.measure(x, master, node, facet, start, motion.reach)
            found = _replace(found, other)
        if self._pair.has_edges:
            along = [0.0 * way if motion.at_rest else way for way in ways]
            found = yield from self._pair.rims.without_rising(found, (slave, master), along)
        aimed = motion.aimed
        if self._pair.is_long(motion.reach):
            stops = self._pair.stops(np.arange(len(x)), master)
            hit, part = passages.first_hits(
                x, slave_path, corners, master_path[self._master.facets], stops
            )
            over = self._over_edges(hit, part, slave, slave_path, (master, master_path))
            passed = np.flatnonzero(over >= 0)
            self._sliding = np.unique(
                np.concatenate([self._sliding, np.column_stack([passed, hit[passed]])]), axis=0
            )
            hit[passed] = -1
            aimed = np.where(hit >= 0, hit, aimed)
        node = np.flatnonzero(aimed >= 0)
        if len(node):
            start, _ = compiled.closest_point(x[node], corners[aimed[node]])
            other, _ = self._pair.measure(x, master, node, aimed[node], start, None)
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
        nc = self._master.facets.shape[1]
        excess = facets.edge_excess(found.xi, nc)
        beyond = np.flatnonzero(excess.max(axis=1) > search.PREFERENCE)
        if not beyond.size:
            return found
        near, excess, moved = found.select(beyond), excess[beyond], master + master_path
        end = (x + slave_path)[near.node]
        far, best = self._gap_at(near.facet, near.xi, end, moved), near.facet.copy()
        for edge in range(nc):
            other = self._convex.beside[near.facet, edge] // nc
            some = np.flatnonzero((excess[:, edge] > search.PREFERENCE) & (other >= 0))
            some = some[self._pair.facing.faces(near.node[some], other[some])]
            if not some.size:
                continue
            start, _ = compiled.closest_point(end[some], moved[self._master.facets[other[some]]])
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
        start, _ = compiled.closest_point(x[node], master[self._master.facets[facet]])
        other, _ = self._pair.measure(x, master, node, facet, start, None)
        return _replace(found, other)

    def _past_edges(
        self,
        found: Candidates,
        slave: FloatArray,
        master: FloatArray,
        slave_path: FloatArray,
        master_path: FloatArray,
        reach: float,
    ) -> Candidates:
        """Candidates that will cross a facet's plane beyond its edge, with the facet beyond that.

        Without those that slide over an edge, which no facet holds unless they come deeper than it.
        Arguments as of `lead`, `_round_edges` and `Motion`.
        """
        x = slave[self._slave.share]
        # A facet is 2 xi wide, and less along its heights; most nodes come to no edge of theirs.
        nc = self._master.facets.shape[1]
        beyond = facets.edge_excess(found.xi, nc).max(axis=1, initial=-1.0)
        near = self._convex.sharp[found.facet] & (beyond + 4.0 * reach / found.length > ASIDE)
        if not near.any():
            return found
        some = found.select(near)
        end, moved = (x + slave_path)[some.node], master + master_path
        gap = self._gap_at(some.facet, some.xi, end, moved)
        some = some.select(gap < LETS_IN * some.length)
        if not some.node.size:
            return found
        node = some.node
        facet, slides = self._passed(
            node, slave, slave_path[node], some.facet, master, master_path
        )
        self._sliding = np.column_stack([node, some.facet])[slides]
        found = found.select(~np.isin(found.node, node[slides]))
        change = (facet >= 0) & ~slides & self._pair.facing.faces(node, facet)
        if not change.any():
            return found
        return self._moved_to(found, node[change], facet[change], x, master)

    def _passed(
        self,
        node: IntArray,
        slave: FloatArray,
        way: FloatArray,
        facet: IntArray,
        master: FloatArray,
        master_path: FloatArray,
    ) -> tuple[IntArray, BoolArray]:
        """Facets that nodes pass when they cross the planes of others, or -1, shape (n,).

        And which of the nodes slide over an edge of theirs.

        The plane of a facet goes on beyond its edges, the body does not: what crosses it beyond a
        sharp convex edge passes the facet on the other side of that edge.

        Args:
            node: Slaves, shape (n,).
            slave: Points of the slave at t_n [m].
            way: Motion of the nodes [m], shape (n, 3).
            facet: Facets, shape (n,).
            master: Points of the master at t_n [m].
            master_path: Their motion [m].
        """
        x = slave[self._slave.share[node]]
        patch, control, xi, good = self._pair.projected(x, master, facet, np.zeros((len(x), 2)))
        carried, gaps = self._master.control_points(master_path, patch), []
        edge = np.full(len(x), -np.inf)
        for place, points in ((x, control), (x + way, control + carried)):
            xi, _ = compiled.project(place, points, xi)
            edge = np.maximum(edge, self._excess(xi))
            foot, _, normal = facets.frame(points, xi)
            gaps.append(np.einsum("ni,ni->n", normal, place - foot))
        above, below = gaps
        length = facets.size(master[self._master.facets[facet]])
        sinks = good & (below < -OUTSIDE * length) & (below < above)
        part = np.ones(len(x))
        part[sinks] = np.clip(above[sinks] / (above - below)[sinks], 0.0, 1.0)
        at, found = x + part[:, None] * way, np.full(len(x), -1)
        slides, near = np.zeros(len(x), dtype=bool), edge > _BY_EDGE
        if near.any():
            over = self._cones.across(
                node[near], facet[near], at[near], slave, (master, master_path), part[near]
            )
            slides[near] = over >= 0
        found[sinks] = self._convex.across(
            at[sinks], facet[sinks], master, master_path, part[sinks]
        )
        return found, slides

    def _over_edges(
        self, hit: IntArray, part: FloatArray, slave: FloatArray, way: FloatArray,
        master: tuple[FloatArray, FloatArray],
    ) -> IntArray:  # fmt: skip
        """Facets across sharp edges over which slaves go, in place of those hit, or -1, (share,).

        Args:
            hit: First facets on the ways of this rank's slaves, or -1, shape (share,).
            part: How much of their ways they have behind them there, shape (share,).
            slave: Points of the slave at t_n [m].
            way: Motion of these slaves [m], shape (share, 3).
            master: Points of the master at t_n, and their motion [m].
        """
        over = np.full(len(hit), -1)
        some = np.flatnonzero((hit >= 0) & self._convex.sharp[hit])
        at = slave[self._slave.share[some]] + part[some, None] * way[some]
        over[some] = self._cones.across(some, hit[some], at, slave, master, part[some])
        return over

    def _excess(self, xi: FloatArray) -> FloatArray:
        """How far beyond the nearest edge coordinates (n, 2) lie, as of `edge_excess`, (n,)."""
        excess: FloatArray = facets.edge_excess(xi, self._master.facets.shape[1]).max(axis=1)
        return excess

    def _gap_at(
        self, facet: IntArray, xi: FloatArray, points: FloatArray, master: FloatArray
    ) -> FloatArray:
        """Distance of points (n, 3) from their facets' tangent planes at `xi` (n, 2) [m], (n,)."""
        foot, _, normal = facets.frame(master[self._master.facets[facet]], xi)
        gap: FloatArray = np.einsum("ni,ni->n", normal, points - foot)
        return gap

    def _crossings(
        self, c: Candidates, master: FloatArray, slave_motion: FloatArray, master_motion: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Candidates that slide over an edge before the middle of the step, and their next facet.

        A facet that holds the longer part of the path makes g_0 as often positive as negative, so
        that what changes of facet cost and bring cancels in the long run.
        """
        nc = self._master.facets.shape[1]
        pair = self._master.control_points(master, c.patch)
        shape, _, _ = facets.shape(c.xi, pair.shape[1])
        _, tangents, _ = facets.frame(pair, c.xi)
        motion = slave_motion[c.node]
        carried = self._master.control_points(master_motion, c.patch)
        motion = motion - np.einsum("ni,nij->nj", shape, carried)
        metric = np.einsum("naj,nbj->nab", tangents, tangents)
        along = np.einsum("naj,nj->na", tangents, motion)
        slide = nts_element.solve(metric, along[:, :, None])[:, :, 0]
        before, after = (facets.edge_excess(xi, nc) for xi in (c.xi, c.xi + slide))
        edge = after.argmax(axis=1)
        pairs = np.arange(len(edge))
        joined = self._convex.joined[c.facet, edge]
        # On an edge rounding must not decide: a node that stays at its facet there is within it.
        within = before.max(axis=1) <= search.PREFERENCE
        over = within & (after[pairs, edge] > search.PREFERENCE)
        change = np.flatnonzero(over & (joined >= 0))
        return change, joined[change] // nc

    def missed(
        self,
        positions: Sequence[FloatArray],
        motions: Sequence[FloatArray],
        reach: float,
        held: IntArray,
        aimed: IntArray,
    ) -> Asking[IntArray | None]:
        """What `ContactPair.missed` returns."""
        by_edges = np.flatnonzero((held >= 0) & self._convex.sharp[held])
        let_go = np.flatnonzero((held < 0) & (aimed >= 0) & self._convex.sharp[aimed])
        some = by_edges.size or let_go.size or len(self._sliding)
        aside = self._convex.sharp.any() and (yield bool(some))
        if not (aside or self._pair.is_long(reach)):
            return None
        share, ways = self._slave.share, gather_each((self._slave, self._master), motions)
        x, paths = positions[0][share], (ways[0][share], ways[1])
        if aside:
            self._refuse_cut_corners(x, positions[1], *paths, let_go)
        hit = np.full(len(held), -1)
        if self._pair.is_long(reach):
            hit = self.came_through(positions, *paths, held)
        if by_edges.size:
            beyond, near = self._held_beyond(x + paths[0], positions[1], paths[1], held, by_edges)
            hit[by_edges] = np.where(beyond >= 0, beyond, hit[by_edges])
            by_edges = by_edges[near]
        node, facet = np.concatenate(
            [np.column_stack([by_edges, held[by_edges]]), self._sliding]
        ).T
        if node.size:
            end, whole = positions[0] + ways[0], np.ones(len(node))
            master = positions[1], ways[1]
            over = self._cones.across(node, facet, end[share[node]], end, master, whole)
            new = (over >= 0) & (over != aimed[node])
            new &= (held[node] >= 0) | self._cones.behind(
                facet, end[share[node]], positions[1] + ways[1]
            )
            hit[node[new]] = over[new]
        return hit

    def _held_beyond(
        self,
        end: FloatArray,
        master: FloatArray,
        master_path: FloatArray,
        held: IntArray,
        some: IntArray,
    ) -> tuple[IntArray, BoolArray]:
        """Facet across the edge that some slaves are held beyond at the end, or -1, shape (n,).

        And which of them are by an edge.

        Args:
            end: This rank's slaves there [m], shape (share, 3).
            master: Points of the master at t_n [m].
            master_path: Their motion [m].
            held: Facets that hold the slaves, shape (share,).
            some: Numbers of slaves, shape (n,).
        """
        moved, found, start = master + master_path, np.full(len(some), -1), np.zeros((len(some), 2))
        _, _, xi, converged = self._pair.projected(end[some], moved, held[some], start)
        excess = self._excess(xi)
        out = np.flatnonzero(converged & (excess > ASIDE))
        node, whole = some[out], np.ones(len(out))
        other = self._convex.across(end[node], held[node], master, master_path, whole)
        found[out] = np.where(self._pair.facing.faces(node, other), other, -1)
        return found, excess > _BY_EDGE

    def strayed(
        self, positions: Sequence[FloatArray], found: Candidates, due: FloatArray
    ) -> float:
        """As of `ContactPair`, over edges of curved surfaces."""
        x, master = positions[0][self._slave.share][found.node], positions[1]
        _, _, xi, converged = self._pair.projected(x, master, found.facet, found.xi)
        excess = facets.edge_excess(xi, self._master.facets.shape[1])
        joined = self._convex.joined[found.facet, excess.argmax(axis=1)]
        out = np.flatnonzero(converged & (excess.max(axis=1) > ASIDE) & (joined >= 0))
        if self._master.weights is not None:
            return float((_APART * excess[out].max(axis=1)).max(initial=0.0))
        other, corners = joined[out] // excess.shape[1], master[self._master.facets]
        foot, _ = compiled.closest_point(x[out], corners[other])
        off = self._gap_at(other, foot, x[out], master) - due[out]
        return float((np.abs(off) / facets.size(corners[other])).max(initial=0.0))

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
        cut = self._convex.cut_corners(
            x[some], slave_path[some], master, master_path, self._pair.stops(some, master)
        )
        node = self._slave.original[self._slave.share[some[cut]]]
        text = None
        if node.size:
            text = (
                f"contact {self._pair.name!r}: node {node[0]} hits {self._pair.master_name!r} and "
                "slides over its edge within the step; use a smaller dt"
            )
        comm = self._slave.body.comm
        raise_together(comm, text, lambda told: StepFailedError(told, advises=True))

    def came_through(
        self,
        positions: Sequence[FloatArray],
        slave_path: FloatArray,
        master_path: FloatArray,
        held: IntArray,
    ) -> IntArray:
        """`missed` of nodes that have passed a facet, with other arguments of `_round_edges`."""
        at, (slave, master) = self._master.facets, positions[:2]
        x = slave[self._slave.share]
        stops = self._pair.stops(np.arange(len(x)), master)
        hit, part = passages.first_hits(x, slave_path, master[at], master_path[at], stops)
        node = np.flatnonzero((hit >= 0) & (hit != held))
        end, moved = (x + slave_path)[node], master + master_path
        start = np.zeros((len(node), 2))
        _, control, xi, converged = self._pair.projected(end, moved, hit[node], start)
        foot, _, normal = facets.frame(control, xi)
        length = facets.size(moved[at[hit[node]]])
        depth = (np.einsum("ni,ni->n", normal, foot - end) + self._pair.offset[node]) / length
        # A node that is held at another facet may end a little behind this one.
        deep = depth > np.where(held[node] >= 0, MARGIN, OUTSIDE)
        over = self._over_edges(hit, part, slave, slave_path, (master, master_path))
        hit[np.setdiff1d(np.arange(len(hit)), node[deep | ~converged])] = -1
        return np.where((hit >= 0) & (over >= 0), over, hit)

    def gather(self, paths: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Displacements of this rank's slaves and of all points of the master [m]. Collective."""
        slave, master = gather_each((self._slave, self._master), paths)
        return slave[self._slave.share], master


def _replace(found: Candidates, other: Candidates) -> Candidates:
    """Candidates with the others in place of those of the same nodes, in the order of the nodes."""
    stay = ~np.isin(found.node, other.node)
    order = np.argsort(np.concatenate([found.node[stay], other.node]))
    return Candidates(
        *(np.concatenate([a[stay], b])[order] for a, b in zip(found, other, strict=True))
    )
