"""Which facets face which nodes: at rims that lie on each other a side may be as near as a face."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from dolfinx_nts.contact.convex_edges import ConvexEdges, middles
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


class _Around:
    """Facets of a body around the nodes of its surface, declared or not. Collective.

    Attributes:
        points: Points of the surface at facets, one facet after another.
        rows: The facets: declared ones, then those beyond open edges.
        of: Facets of the rank's slaves in a row.
        first: Where those of each begin.
        count: How many they are; 0 where an open edge ends the body, as of a shell: what is beyond
            it may face anything.
    """

    def __init__(self, slave: Surface) -> None:
        self._slave, at = slave, slave.facets
        facet, edge = np.nonzero(slave.boundary_edges)
        ends = np.stack([at[facet, edge], at[facet, (edge + 1) % at.shape[1]]], axis=1)
        normal = _beyond(slave, ends)
        known = normal.any(axis=1)
        self._facet, self._ends = facet[known], ends[known]
        # Its parts along the declared facet's normal, and out of that facet at the edge.
        axes = self._axes(slave.reference)
        self._parts = np.einsum("nai,ni->na", axes, normal[known])
        self.points = np.concatenate([at.ravel(), self._ends.ravel()])
        self.rows = np.concatenate([
            np.repeat(np.arange(len(at)), at.shape[1]),
            np.repeat(len(at) + np.arange(len(self._facet)), 2),
        ])  # fmt: skip
        order, self.first, number = at_points(self.points, slave.share)
        self.of = self.rows[order]
        self.count = np.where(np.isin(slave.share, ends[~known]), 0, number)

    def _axes(self, x: FloatArray) -> FloatArray:
        """Unit normals of facets at open edges, and out of these there, shape (n, 2, 3)."""
        _, normal = middles(x[self._slave.facets[self._facet]])
        way = np.cross(np.diff(x[self._ends], axis=1)[:, 0], normal)
        return np.stack([normal, way / np.linalg.norm(way, axis=1)[:, None]], axis=1)

    def beyond(self, x: FloatArray) -> FloatArray:
        """Normals of what is beyond open edges, shape (n, 3), of points x [m]."""
        normal: FloatArray = np.einsum("na,nai->ni", self._parts, self._axes(x))
        return normal


class Facing:
    """Which facets of a master face which of this rank's slaves.

    Only over sharp edges a node that no facet of its own brings against a side of the master may be
    near it, as at rims that lie on each other. Without these all that is near faces the nodes. A
    node faces what any facet of its body there does, also one that is not declared: that keeps the
    angle to the declared one beside it that it has in the reference.

    Args:
        slave: The slave.
        master: The master.
        edges: Edges of the master.
    """

    def __init__(self, slave: Surface, master: Surface, edges: ConvexEdges) -> None:
        self._slave, self._master, self._edges = slave, master, edges
        self._placed: tuple[FloatArray, FloatArray] | None = None

    def look(self, slaves: FloatArray, corners: FloatArray) -> None:
        """Note where the facets are.

        Args:
            slaves: Points of the slave [m].
            corners: Corners of the master's facets [m].
        """
        if len(self._slave.facets) and self._edges.sharp.any():
            self._placed = slaves, corners
            # All ranks make it, though few may ask.
            self._around  # noqa: B018
            vars(self).pop("_normals", None)

    @property
    def all(self) -> bool:
        """Whether all that is near faces the nodes."""
        return self._placed is None

    @cached_property
    def _normals(self) -> _Normals:
        """Normals where the facets are; most looks find nothing near, and none asks for them."""
        assert self._placed is not None
        (slaves, corners), around = self._placed, self._around
        other = middles(corners)[1]
        own = np.concatenate([middles(slaves[self._slave.facets])[1], around.beyond(slaves)])
        # The tip of a needle has facets that face nothing ahead of it, but their mean does.
        mean = np.zeros_like(slaves)
        np.add.at(mean, around.points, own[around.rows])
        mean = mean[self._slave.share]
        mean /= np.maximum(np.linalg.norm(mean, axis=1), np.finfo(float).tiny)[:, None]
        return _Normals(own, mean, other)

    def faces(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Which facets, -1 none, face the rank's slaves, shape (n,)."""
        found = np.ones(len(node), dtype=bool)
        if not self.all:
            some = np.flatnonzero(facet >= 0)
            found[some] = self._oppose(self._normals, node[some], facet[some])
        return found

    def _oppose(self, normals: _Normals, node: IntArray, facet: IntArray) -> BoolArray:
        around, (own, mean, other) = self._around, normals
        number = around.count[node]
        pair = np.repeat(np.arange(len(node)), number)
        start = np.cumsum(number) - number
        mine = around.of[around.first[node][pair] + np.arange(len(pair)) - start[pair]]
        found = (number == 0) | opposite(mean[node], other[facet])
        found[pair[opposite(own[mine], other[facet[pair]])]] = True
        return found

    @cached_property
    def _around(self) -> _Around:
        return _Around(self._slave)

    def beside(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Which sharp edges of facets end the surface for nodes, shape (n, nc).

        The facet beyond does not face the node.
        """
        ends = np.zeros((len(node), self._master.facets.shape[1]), dtype=bool)
        if self.all:
            return ends
        beside, joined = self._edges.beside[facet], self._edges.joined[facet]
        some, edge = np.nonzero((beside >= 0) & (joined < 0))
        ends[some, edge] = ~self.faces(node[some], beside[some, edge] // ends.shape[1])
        return ends


def _beyond(slave: Surface, ends: IntArray) -> FloatArray:
    """Normals of a body's facets beyond edges of its surface, 0 where it ends, (n, 3). Collective.

    Args:
        slave: The surface.
        ends: Edges that it ends at, shape (n, 2).
    """
    found = np.zeros((len(ends), 3))
    if not len(ends) or slave.body.mesh is None:
        return found
    whole = slave.body.boundary()
    at, own = whole.points[whole.facets], np.sort(slave.points[ends], axis=1)
    normal = middles(whole.reference[whole.facets])[1]
    both = np.stack([at, np.roll(at, -1, axis=1)], axis=-1).reshape(-1, 2)
    # An edge as one number, which is sought faster than two.
    number, wanted = (np.sort(e, axis=1) @ [whole.points[-1] + 1, 1] for e in (both, own))
    here = np.flatnonzero(np.isin(number, wanted))
    rows = {edge: k for k, edge in enumerate(wanted.tolist())}
    for side in here.tolist():
        facet = side // at.shape[1]
        if tuple(sorted(at[facet].tolist())) not in slave.facet_points:
            found[rows[int(number[side])]] = normal[facet]
    return found


def at_points(
    points: IntArray, share: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Order that brings equal points (n,) together, and where those of each of `share` are then.

    Returns:
        The order, shape (n,), the first of each of `share` in it, and their number.
    """
    order = np.argsort(points, kind="stable")
    first = np.searchsorted(points[order], share)
    return order, first, np.searchsorted(points[order], share, side="right") - first


def opposite(one: FloatArray, two: FloatArray) -> BoolArray:
    """Return which of unit normals (n, 3) face each other, shape (n,)."""
    facing: BoolArray = np.einsum("ni,ni->n", one, two) < -_FACING
    return facing
