"""Sharp rims of a master, beyond which edges hold what rises from it, and no facet's plane does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.candidates import Candidates
from dolfinx_nts.contact.edges import Edges
from dolfinx_nts.contact.normal_cones import LETS_IN
from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.parallel import Asking
from dolfinx_nts.types import BoolArray, FloatArray, IntArray


class Rims:
    """Sharp edges that a pair's master ends at. Collective.

    Args:
        pair: The pair.
        free: Which edges of its master's facets are no other facet's, shape (m, nc).
        edges: Sharp edges of the master's body.
    """

    def __init__(self, pair: Any, free: BoolArray, edges: Edges) -> None:
        self._master, self._slave = pair.master, pair.slave
        at = self._master.points[self._master.facets]
        sides = np.sort(np.stack([at, np.roll(at, -1, axis=1)], axis=-1), axis=2)
        sharp = {tuple(e) for e in np.sort(edges.surface.points[edges.ends], axis=1).tolist()}
        there = [tuple(ends) in sharp for ends in sides.reshape(-1, 2).tolist()]
        self._at: BoolArray = np.array(there, dtype=bool).reshape(at.shape) & free
        self._any: BoolArray = self._at.any(axis=1)
        self._cones = pair.cones

    def without_rising(
        self,
        found: Candidates,
        x: tuple[FloatArray, FloatArray],
        ways: Sequence[FloatArray],
    ) -> Asking[Candidates]:
        """Candidates but for those beyond such a rim where the slave does not lie inside it.

        What slides over a rim turns about it, and edges hold it there: the plane of the facet
        beyond it would throw the slave's nodes off. Where the slave lies on the master up to the
        rim, at the end of the step as is expected, or as a load step begins, its nodes beyond hold
        the rim outside.

        Args:
            found: Candidates.
            x: Points of the slave and of the master at t_n [m].
            ways: Their expected motion [m]; none in load steps.
        """
        if not self._any.any():
            return found
        gaps = np.full(len(self._slave.share), np.inf)
        gaps[found.node] = found.gap
        gaps, moved = (yield from self._slave.spread(gaps)), x[0] + ways[0]
        some = np.flatnonzero(self._any[found.facet])
        facet, corners = found.facet[some], x[1] + ways[1]
        node = self._slave.share[found.node[some]]
        over = self._at[facet] & self._beyond(moved[node], corners, facet, found.xi[some])
        out = np.flatnonzero(over.any(axis=1))
        if not out.size:
            return found
        c, over = found.select(some[out]), over[out]
        pair, ends = self._cones.beside(c.node)
        inside = over[pair] & ~self._beyond(moved[ends], corners, c.facet[pair], c.xi[pair])
        rises = self._rises(c, pair, ends, gaps, x[0])
        at, edge = np.nonzero(inside)
        lies, up = ~over, rises[at]
        lies[pair[at], edge] = True
        lies[pair[at[up]], edge[up]] = False
        stay = np.ones(len(found.node), dtype=bool)
        stay[some[out]] = lies.all(axis=1)
        return found if stay.all() else found.select(stay)

    def _beyond(
        self, x: FloatArray, master: FloatArray, facet: IntArray, xi: FloatArray
    ) -> BoolArray:
        """Which edges of facets (n,) of the master's points points (n, 3) are beyond, (n, nc)."""
        at = self._master.facets[facet]
        xi, _ = compiled.project(x, master[at], xi)
        beyond: BoolArray = facets.edge_excess(xi, at.shape[1]) > search.PREFERENCE
        return beyond

    def _rises(
        self, c: Candidates, pair: IntArray, other: IntArray, gaps: FloatArray, x: FloatArray
    ) -> BoolArray:
        """Which neighbours of candidates are farther above the master than these, shape (m,).

        Bodies that lie on each other bend together: what their nodes are away from each other
        counts, not how their facets are turned.

        Args:
            c: Candidates.
            pair: Their places, shape (m,).
            other: Points of the slave beside them, shape (m,).
            gaps: Of all points of the slave, infinite for what is no candidate [m].
            x: Points of the slave at t_n [m].
        """
        way = x[other] - x[self._slave.share[c.node]][pair]
        height = np.einsum("ni,ni->n", way, c.normal[pair])
        rise = np.where(np.isfinite(gaps[other]), gaps[other] - c.gap[pair], height)
        rises: BoolArray = rise > LETS_IN * np.linalg.norm(way, axis=1)
        return rises
