"""Cones of normals at the nodes of a slave, and which slide over edges: what planes they meet."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.convex_edges import ASIDE, OUTSIDE, middles
from dolfinx_nts.contact.edges import LEVEL
from dolfinx_nts.contact.facing import at_points
from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Part of a facet by which flat facets may let an edge in between nodes.
LETS_IN = 0.01


class _Neighbours(NamedTuple):
    """Ends of all edges around this rank's slaves, in a row; where those of each begin; number."""

    other: IntArray
    first: IntArray
    number: IntArray


class NormalCones:
    """Which planes may touch which of this rank's slaves.

    A plane touches a node whose neighbours are all in front of it: then its normal is in the cone
    of normals there. Where one is behind it, the surface crosses the plane beside the node, and
    what holds the node is something else.

    Args:
        pair: The `FacetPair` of slave and master.
    """

    def __init__(self, pair: Any) -> None:
        self._slave, self._master, self._edges = pair.slave, pair.master, pair.convex

    @cached_property
    def _neighbours(self) -> _Neighbours:
        at = self._slave.facets
        ends = np.concatenate([np.column_stack([at.ravel(), np.roll(at, way, axis=1).ravel()])
                               for way in (-1, 1)])  # fmt: skip
        order, first, count = at_points(ends[:, 0], self._slave.share)
        return _Neighbours(ends[order, 1], first, count)

    def beside(self, node: IntArray) -> tuple[IntArray, IntArray]:
        """Points that edges of the slave join with nodes (n,): each with the place of its node."""
        other, first, every = self._neighbours
        number = every[node]
        pair = np.repeat(np.arange(len(node)), number)
        start = np.cumsum(number) - number
        return pair, other[first[node][pair] + np.arange(len(pair)) - start[pair]]

    def crossing(self, node: IntArray, normal: FloatArray, x: FloatArray) -> FloatArray:
        """Sine of the angle by which the surface at nodes crosses planes there, shape (n,).

        Zero where it does not: then the plane may touch the node.

        Args:
            node: Of this rank's slaves, shape (n,).
            normal: Unit normals of the planes, shape (n, 3).
            x: Points of the slave [m].
        """
        pair, ends = self.beside(node)
        way = x[ends] - x[self._slave.share[node]][pair]
        rise = np.einsum("ni,ni->n", way, normal[pair])
        far, found = np.linalg.norm(way, axis=1), np.zeros(len(node))
        behind = rise < -LEVEL * far
        np.maximum.at(found, pair[behind], -rise[behind] / far[behind])
        return found

    def across(
        self, node: IntArray, facet: IntArray, x: FloatArray, slave: FloatArray,
        master: tuple[FloatArray, FloatArray], part: FloatArray,
    ) -> IntArray:  # fmt: skip
        """Facets across sharp edges that hold slaves in place of those they come to, or -1, (n,).

        Where the surface of the slave crosses the plane of the facet that the node comes to, it
        slides on the edge, and the node goes over the edge with it, also if it comes there a little
        deeper, by what flat facets let an edge in between nodes. Where it crosses the planes of
        both facets, as flat surfaces do, that which it crosses less holds the node.

        Args:
            node: Slaves, shape (n,).
            facet: Those that they come to, shape (n,).
            x: Where they come to these [m], shape (n, 3).
            slave: Points of the slave, which may lie elsewhere [m].
            master: Those of the master at t_n, and their motion [m].
            part: How much of that they have behind them, shape (n,).
        """
        at, found = self._master.facets, np.full(len(node), -1)

        def corners(some: IntArray, of: IntArray) -> FloatArray:
            now: FloatArray = master[0][at[of]] + part[some, None, None] * master[1][at[of]]
            return now

        place, normal = middles(corners(np.arange(len(node)), facet))
        crossing = self.crossing(node, normal, slave)
        some = np.flatnonzero(crossing)
        for edge in range(at.shape[1] if some.size else 0):
            beside = self._edges.beside[facet[some], edge]
            sharp = (beside >= 0) & (self._edges.joined[facet[some], edge] < 0)
            own, other = some[sharp], beside[sharp] // at.shape[1]
            across = corners(own, other)
            over, outward = middles(across)
            depth, convex = (-_rise(p, over, outward) for p in (x[own], place[own]))
            _, distance = compiled.closest_point(x[own], across)
            size = facets.size(across)
            near = (convex > 0.0) & (depth > -ASIDE * size) & (distance < LETS_IN * size)
            less = self.crossing(node[own[near]], outward[near], slave) < crossing[own[near]]
            near[near] = less
            found[own[near]] = other[near]
        return found

    def behind(self, facet: IntArray, x: FloatArray, master: FloatArray) -> BoolArray:
        """Which points (n, 3) are behind their facets (n,), of the master's points [m], (n,)."""
        corners = master[self._master.facets[facet]]
        found: BoolArray = _rise(x, *middles(corners)) < -OUTSIDE * facets.size(corners)
        return found


def _rise(x: FloatArray, place: FloatArray, normal: FloatArray) -> FloatArray:
    """Distance of points over planes [m], shape (n,)."""
    rise: FloatArray = np.einsum("ni,ni->n", x - place, normal)
    return rise
