"""Sharp rims of a master, beyond which edges hold what is tilted, and no facet's plane does."""

from __future__ import annotations

from typing import Any

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.edges import Edges
from dolfinx_nts.contact.facing import at_points
from dolfinx_nts.contact.pair import Candidates
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import compiled, facets, library
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Sine of the angle between the slave and the master from which on nodes of the slave beyond a
#: sharp rim are not held, of rigid bodies and of others, which bend where they lie on each other.
TILTED = 1e-3, 0.1


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
        self._around = self._slave.facets, *facets_around(self._slave)
        self._addresses = [a.ctypes.data for a in self._around]
        self._least = TILTED[pair.yields]

    def without_tilted(
        self,
        found: Candidates,
        x: tuple[FloatArray, FloatArray],
        ways: tuple[FloatArray, FloatArray],
    ) -> Candidates:
        """Candidates but for those beyond such a rim where the slave is tilted.

        What slides over a rim turns about it, and edges hold it there: the plane of the facet
        beyond it would throw the slave's nodes off.

        Args:
            found: Candidates.
            x: Points of the slave and of the master at t_n [m].
            ways: Expected motion of this rank's slaves and of the master's points [m].
        """
        some = np.flatnonzero(self._any[found.facet])
        if not some.size:
            return found
        some = some[self._tilts(found.node[some], found.normal[some], x[0])]
        if not some.size:
            return found
        node, at = found.node[some], self._master.facets[found.facet[some]]
        end = x[0][self._slave.share[node]] + ways[0][node]
        xi, _ = compiled.project(end, (x[1] + ways[1])[at], found.xi[some])
        beyond = facets.edge_excess(xi, at.shape[1]) > search.PREFERENCE
        out = some[(self._at[found.facet[some]] & beyond).any(axis=1)]
        return found.select(~np.isin(np.arange(len(found.node)), out))

    def _tilts(self, node: IntArray, normal: FloatArray, x: FloatArray) -> BoolArray:
        """At which of this rank's slaves (n,) the slave is tilted against unit normals (n, 3).

        Args:
            node: Their numbers.
            normal: Of the master.
            x: All points of the slave [m].
        """
        nc, tilts = self._slave.facets.shape[1], np.empty(len(node), dtype=bool)
        kernel, given = library.load().tilted, (len(node), node, normal, tilts)
        library.run(kernel, nc, x, *self._addresses, self._least, *given)
        return tilts


def facets_around(surface: Surface) -> tuple[IntArray, IntArray, IntArray]:
    """Facets of this rank's slaves in a row, where those of each begin, and how many they are."""
    at = surface.facets
    order, first, count = at_points(at.ravel(), surface.share)
    return order // at.shape[1], first, count
