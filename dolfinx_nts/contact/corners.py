"""Vertices and nodes of sharp edges of a master, which facets of its slave keep outside.

Slave nodes say nothing of what enters a facet of the slave between them. That is the contact of
nodes with facets once more, with the roles exchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.convex_edges import OUTSIDE
from dolfinx_nts.contact.edges import Edges
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.contact.pair import Candidates, Found, Motion
from dolfinx_nts.contact.rims import TILTED, facets_around
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import facets
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.parallel import global_sum
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: A corner nearer to an edge of the slave than this part of a facet is the edges' where these meet.
_AT_EDGE = 0.05


class Corners(FacetPair):
    """The master's corners of a pair against the facets of its slave.

    Those that something else holds are none of its candidates: where faces lie on each other the
    slave's nodes do, beside edges that meet these edges.

    Args:
        of: The pair, whose options it has.
    """

    def __init__(self, of: FacetPair) -> None:
        self.of = of
        super().__init__(
            _with_corners(of), of.slave, friction=of.friction, interference=of.interference,
            adjust=of.adjust,
        )  # fmt: skip
        self.leave_to(np.empty(0, dtype=np.int64), np.empty((0, 4), dtype=np.int64))
        self._around = facets_around(self.slave)
        self._rims = self._sharp_sides()
        self._level = 1.0 - TILTED[self.yields] ** 2

    @property
    def sharp_edges(self) -> tuple[Edges, Edges]:  # type: ignore[override]
        """As of `FacetPair`."""
        one, two = self.of.sharp_edges
        return two, one

    def history_at_start(self) -> ContactHistory:
        """As of `ContactPair`; corners that start inside are let through until they are out."""
        start = super().history_at_start()
        return start._replace(followed=~start.followed)

    def _told(self, hidden: Candidates, current: IntArray) -> Candidates:
        """None: what passes by a face is told where bodies are looked at as a whole."""
        return hidden.select(np.zeros(len(hidden.node), dtype=bool))

    def borne(self, history: ContactHistory) -> float:
        """Sum of the forces that they bear [N]. Collective."""
        return float(global_sum(self.slave.body.comm, history.force.sum(keepdims=True))[0])

    def leave_to(self, node: IntArray, meet: IntArray) -> None:
        """Note what else holds in a step, before `find`.

        Args:
            node: Candidates of the pair among this rank's slaves, shape (n,).
            meet: Ends of edges that may meet, two points of the master and two of the slave,
                shape (k, 4).
        """
        self._nodes, self._meet = node, meet
        self._near = np.zeros(len(self.master.points), dtype=bool)

    def _closest(
        self, slaves: FloatArray, corners: FloatArray, reach: float, current: IntArray
    ) -> search.Closest:
        """As of `FacetPair`, but for those that lie flat on what holds them. Collective."""
        near = np.zeros(len(self.master.share), dtype=bool)
        near[self._nodes] = True
        self._near = self.master.at_all(near)
        found = super()._closest(slaves, corners, reach, current)
        node = np.flatnonzero(found.facet >= 0)
        found.facet[node[self._lie_flat(node, found.facet[node], slaves, corners)]] = -1
        return found

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Found:
        """As of `ContactPair`, but for those that something else holds. Collective."""
        found = super().find(positions, current, path, motion, followed)
        c = found.candidates
        if not len(c.node):
            return found
        held = self._held(c.node, c.facet, positions)
        # What they enter meanwhile does not throw them out.
        found.followed[c.node[held & (c.gap < -OUTSIDE * c.length)]] = False
        return found._replace(candidates=c.select(~held))

    def missed(
        self,
        positions: Sequence[FloatArray],
        motions: Sequence[FloatArray],
        path: FloatArray,
        reach: float,
        held: IntArray,
        aimed: IntArray,
    ) -> IntArray | None:
        """Do as `ContactPair`, but for those that something else holds."""
        hit = super().missed(positions, motions, path, reach, held, aimed)
        if hit is not None:
            node = np.flatnonzero(hit >= 0)
            hit[node[self._held(node, hit[node], positions)]] = -1
        return hit

    def _held(self, node: IntArray, facet: IntArray, x: Sequence[FloatArray]) -> BoolArray:
        """Which of this rank's corners over facets something else holds, shape (n,).

        Args:
            node: The corners, shape (n,).
            facet: The facets, shape (n,).
            x: Points of slave and master at t_n [m].
        """
        corners = x[1][self.master.facets]
        held = self._lie_flat(node, facet, x[0], corners)
        point, meet = self.slave.share[node], self._meet
        one, k = np.nonzero((point[:, None, None] == meet[None, :, :2]).any(axis=2))
        start, way = x[1][meet[k, 2]], x[1][meet[k, 3]] - x[1][meet[k, 2]]
        off = x[0][point[one]] - start
        part = _dot(off, way) / _dot(way, way)
        off -= np.clip(part, 0.0, 1.0)[:, None] * way
        beside = np.linalg.norm(off, axis=1) < _AT_EDGE * facets.size(corners[facet[one]])
        held[one[beside]] = True
        return held if self.slave.body.rigid else held | self._at_rim(point, facet, x)

    def _at_rim(self, point: IntArray, facet: IntArray, x: Sequence[FloatArray]) -> BoolArray:
        """Which corners are over a sharp edge of their facets, shape (n,); arguments as of `_held`.

        Where the rims of two bodies lie on each other the slave's nodes hold one that deforms.
        """
        corners, found = x[1][self.master.facets[facet]], np.zeros(len(facet), dtype=bool)
        normal = _areas(corners)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        for side in range(corners.shape[1]):
            start, end = corners[:, side], corners[:, (side + 1) % corners.shape[1]]
            off, way = x[0][point] - start, end - start
            off -= _dot(off, normal)[:, None] * normal
            off -= np.clip(_dot(off, way) / _dot(way, way), 0.0, 1.0)[:, None] * way
            near = np.linalg.norm(off, axis=1) < _AT_EDGE * facets.size(corners)
            found |= near & self._rims[facet, side]
        return found

    def _sharp_sides(self) -> BoolArray:
        """Which sides of the master's facets are sharp edges of its body, shape (facets, nc)."""
        edges, at = self.sharp_edges[1], self.master.points[self.master.facets]
        sides = np.stack([at, np.roll(at, -1, axis=1)], axis=2)
        count = 1 + max(int(edges.surface.points.max(initial=0)), int(at.max(initial=0)))
        sharp, own = (
            np.sort(a, axis=-1) @ [count, 1] for a in (edges.surface.points[edges.ends], sides)
        )
        return np.isin(own, sharp)

    def _lie_flat(
        self, node: IntArray, facet: IntArray, x: FloatArray, corners: FloatArray
    ) -> BoolArray:
        """Whether facets around corners lie flat on those that they are over, shape (n,).

        As long as a node there is a candidate of the pair; of rigid bodies all have to be, as what
        reaches over a rim tips about it. A body that deforms lies on its nodes before the rim.

        Args:
            node: The corners, shape (n,).
            facet: The facets, shape (n,).
            x: Points of the slave at t_n [m].
            corners: Corners of the master's facets [m].
        """
        near = self._near[self.master.facets[facet]]
        flat: BoolArray = near.all(axis=1) if self.slave.body.rigid else near.any(axis=1)
        some = np.flatnonzero(flat)
        if not some.size:
            return flat
        around, first, count = self._around
        number = count[node[some]]
        pair = np.repeat(np.arange(len(some)), number)
        start = np.cumsum(number) - number
        own = around[first[node[some]][pair] + np.arange(len(pair)) - start[pair]]
        one, two = _areas(x[self.slave.facets[own]]), _areas(corners[facet[some]])[pair]
        along, square = _dot(one, two), _dot(one, one) * _dot(two, two)
        flat[some] = False
        flat[some[pair[(along < 0.0) & (along**2 > self._level * square)]]] = True
        return flat


def _areas(corners: FloatArray) -> FloatArray:
    """Twice the area vectors of facets (n, nc, 3) [m^2], shape (n, 3)."""
    one, two = corners[:, 1:-1] - corners[:, :1], corners[:, 2:] - corners[:, :1]
    return cross(one, two).sum(axis=1)


def _dot(one: FloatArray, two: FloatArray) -> FloatArray:
    product: FloatArray = np.einsum("ni,ni->n", one, two)
    return product


def corners_of(pair: Any) -> list[Corners]:
    """The corners of a pair, none if it knows no edges or its master has none. Collective.

    Facets of nodes without mass are no masters.
    """
    if not (isinstance(pair, FacetPair) and pair.has_edges) or pair.slave.massless.any():
        return []
    return [Corners(pair)] if pair.holds_nodes and len(pair.sharp_edges[1].ends) else []


def _with_corners(pair: FacetPair) -> Surface:
    """A pair's master as a slave of its corners."""
    edges, master = pair.sharp_edges[1], pair.master
    ends: IntArray = np.unique(edges.surface.points[edges.ends])
    found: Surface = master.part(np.isin(master.points, ends))
    return found
