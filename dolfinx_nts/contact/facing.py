"""Which facets face which nodes: at rims that lie on each other a side may be as near as a face."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from dolfinx_nts.contact.convex_edges import ConvexEdges, middles
from dolfinx_nts.contact.rims import facets_around
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Least cosine between one normal and the opposite of the other of what faces each other; sides of
#: a right angle do not, also where bodies that are pressed have turned them by 17 degrees.
_FACING = 0.3


class _Normals(NamedTuple):
    """Unit normals of the slave's facets, in the mean at this rank's slaves, of the master's."""

    own: FloatArray
    mean: FloatArray
    other: FloatArray


class Facing:
    """Which facets of a master face which of this rank's slaves.

    Only over sharp edges a node that no facet of its own brings against a side of the master may be
    near it, as at rims that lie on each other. Without these all that is near faces the nodes.

    Args:
        slave: The slave.
        master: The master.
        edges: Edges of the master.
    """

    def __init__(self, slave: Surface, master: Surface, edges: ConvexEdges) -> None:
        self._slave, self._master, self._edges = slave, master, edges
        self._normals: _Normals | None = None

    def look(self, slaves: FloatArray, corners: FloatArray) -> None:
        """Note where the facets are.

        Args:
            slaves: Points of the slave [m].
            corners: Corners of the master's facets [m].
        """
        if not len(self._slave.facets) or not self._edges.sharp.any():
            return
        own, other = middles(slaves[self._slave.facets])[1], middles(corners)[1]
        # The tip of a needle has facets that face nothing ahead of it, but their mean does.
        mean = np.zeros_like(slaves)
        np.add.at(mean, self._slave.facets, own[:, None])
        mean = mean[self._slave.share]
        mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]
        self._normals = _Normals(own, mean, other)

    @property
    def all(self) -> bool:
        """Whether all that is near faces the nodes."""
        return self._normals is None

    def faces(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Which facets, -1 none, face the rank's slaves, shape (n,)."""
        found = np.ones(len(node), dtype=bool)
        if self._normals is not None:
            some = np.flatnonzero(facet >= 0)
            found[some] = self._oppose(self._normals, node[some], facet[some])
        return found

    def _oppose(self, normals: _Normals, node: IntArray, facet: IntArray) -> BoolArray:
        (of, first, count), (own, mean, other) = self._own_facets, normals
        number = count[node]
        pair = np.repeat(np.arange(len(node)), number)
        start = np.cumsum(number) - number
        mine = of[first[node][pair] + np.arange(len(pair)) - start[pair]]
        found = (number == 0) | opposite(mean[node], other[facet])
        found[pair[opposite(own[mine], other[facet[pair]])]] = True
        return found

    @cached_property
    def _own_facets(self) -> tuple[IntArray, IntArray, IntArray]:
        """Facets of the rank's slaves in a row, where those of each begin, and how many they are.

        None of nodes where the declared surface ends, as what is beyond there may face anything.
        """
        at = self._slave.facets
        facet, edge = np.nonzero(self._slave.boundary_edges)
        ends = [at[facet, edge], at[facet, (edge + 1) % at.shape[1]]]
        of, first, count = facets_around(self._slave)
        return of, first, np.where(np.isin(self._slave.share, np.concatenate(ends)), 0, count)

    def beside(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Which sharp edges of facets end the surface for nodes, shape (n, nc).

        The facet beyond does not face the node.
        """
        ends = np.zeros((len(node), self._master.facets.shape[1]), dtype=bool)
        if self._normals is None:
            return ends
        beside, joined = self._edges.beside[facet], self._edges.joined[facet]
        some, edge = np.nonzero((beside >= 0) & (joined < 0))
        ends[some, edge] = ~self.faces(node[some], beside[some, edge] // ends.shape[1])
        return ends


def opposite(one: FloatArray, two: FloatArray) -> BoolArray:
    """Return which of unit normals (n, 3) face each other, shape (n,)."""
    facing: BoolArray = np.einsum("ni,ni->n", one, two) < -_FACING
    return facing
