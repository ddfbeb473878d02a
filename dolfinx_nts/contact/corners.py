"""Vertices and nodes of sharp edges of a master, which facets of its slave keep outside.

Slave nodes say nothing of what enters a facet of the slave between them. That is the contact of
nodes with facets once more, with the roles exchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.candidates import Found, Motion
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.convex_edges import OUTSIDE
from dolfinx_nts.contact.edges import Edges
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.parallel import Asking, global_sum
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: What cannot enter a facet by this part of its size is outside, as facets that bend sag by it; ...
_OUTSIDE = 0.05
#: ... between rigid bodies by this one.
_FLUSH = 1e-6


class Corners(FacetPair):
    """The master's corners of a pair against the facets of its slave.

    Those that something else holds are none of its candidates: where faces lie on each other the
    slave's nodes do, and of bodies that bend edges that meet these edges beside them.

    Args:
        of: The pair, whose options it has.
    """

    of: FacetPair
    exchanged = True

    def __init__(self, of: FacetPair) -> None:
        self.of = of
        super().__init__(
            _with_corners(of), of.slave, friction=of.friction_function or of.friction,
            interference=of.interference, adjust=of.adjust,
        )  # fmt: skip
        # Points are where they are for the pair.
        self.origin, self.extent = of.origin, of.extent
        self._asked: IntArray = np.empty(0, dtype=np.int64)

    @property
    def sharp_edges(self) -> tuple[Edges, Edges]:  # type: ignore[override]
        """As of `FacetPair`."""
        one, two = self.of.sharp_edges
        return two, one

    def history_at_start(self) -> ContactHistory:
        """As of `ContactPair`; corners that start inside are let through until they are out."""
        start = super().history_at_start()
        return start._replace(followed=~start.followed)

    def borne(self, history: ContactHistory) -> float:
        """Sum of the forces that they bear [N]. Collective."""
        return float(global_sum(self.slave.body.comm, history.force.sum(keepdims=True))[0])

    def leave_to(
        self, slaves: Mapping[int, Sequence[ContactElements]], edges: Any
    ) -> Asking[None]:
        """As of `ContactPair`; what holds nodes of rigid bodies elsewhere may leave with them."""
        # Ends of edges that may meet: two points of the master and two of the slave.
        self._meet = edges.ends if edges else np.empty((0, 4), dtype=np.int64)
        at, nodes = self.master.points, slaves.get(id(self.master.body), [])
        # From all points of the body that is the slave to where they touch what may hold them.
        self._ways, self._near = np.zeros((len(at), 3)), np.zeros(len(at), dtype=bool)
        for elements in nodes:
            if not self.yields and self.slave.body not in elements.pair.bodies:
                continue
            surface, c = elements.pair.slave, elements.candidates
            ways = np.zeros((len(surface.share), 4))
            ways[c.node, :3], ways[c.node, 3] = -c.gap[:, None] * c.normal, 1.0
            ways, points = (yield from surface.spread(ways)), surface.points
            if points is not at:
                _, own, other = np.intersect1d(at, points, return_indices=True)
                found, ways = ways[other], np.zeros((len(at), 4))
                ways[own] = found
            # What is nearest to a node holds it.
            far = np.square(self._ways).sum(axis=1) > np.square(ways[:, :3]).sum(axis=1)
            near = (ways[:, 3] > 0.0) & (far | ~self._near)
            self._ways[near], self._near = ways[near, :3], self._near | near

    def _closest(
        self, slaves: FloatArray, corners: FloatArray, reach: float, current: IntArray
    ) -> search.Closest:
        """As of `FacetPair`, but for those that something else holds. Collective."""
        found = super()._closest(slaves, corners, reach, current)
        node = np.flatnonzero(found.facet >= 0)
        found.facet[node[self._held(node, found.facet[node], slaves, corners)]] = -1
        self._asked = found.facet
        return found

    def _heights(
        self, point: IntArray, k: IntArray, x: FloatArray, normal: FloatArray
    ) -> FloatArray:
        """How high over corners (n,) edges that end there meet edges of facets [m], shape (n,).

        Args:
            point: The corners, shape (n,).
            k: Numbers of edges' ends that may meet, shape (n,).
            x: Points of the slave [m].
            normal: Of the facets, shape (n, 3).
        """
        ends = self._meet[k]
        far = np.where(ends[:, 0] == point, ends[:, 1], ends[:, 0])
        along, (start, end) = x[far] - x[point], self._masters[ends[:, 2:]].transpose(1, 0, 2)
        across, way = end - start, x[point] - start
        (aa, bb, ab), (left, right) = (
            [np.einsum("ni,ni->n", a, b) for a, b in both]
            for both in (((along, along), (across, across), (along, across)),
                         ((along, way), (across, way)))
        )  # fmt: skip
        square = aa * bb - ab**2
        part = np.divide(ab * right - bb * left, square, out=np.ones_like(aa), where=square > 0.0)
        height: FloatArray = np.clip(part, 0.0, 1.0) * np.einsum("ni,ni->n", normal, along)
        return height

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Asking[Found]:
        """As of `ContactPair`, but for those that something else holds."""
        self._masters = positions[1]
        found = yield from super().find(positions, current, path, motion, followed)
        c = found.candidates
        if not len(c.node):
            return found
        # Their ways may have led them to other facets.
        held, led = np.zeros(len(c.node), dtype=bool), c.facet != self._asked[c.node]
        if not led.any():
            return found
        corners = positions[1][self.master.facets]
        held[led] = self._held(c.node[led], c.facet[led], positions[0], corners)
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
    ) -> Asking[IntArray | None]:
        """Do as `ContactPair`, but for those that something else holds."""
        hit = yield from super().missed(positions, motions, path, reach, held, aimed)
        if hit is not None:
            node, corners = np.flatnonzero(hit >= 0), positions[1][self.master.facets]
            hit[node[self._held(node, hit[node], positions[0], corners)]] = -1
        return hit

    def _held(
        self, node: IntArray, facet: IntArray, x: FloatArray, corners: FloatArray
    ) -> BoolArray:
        """Which of this rank's corners over facets something else holds, shape (n,).

        Those that stay as good as outside while corners of their facets are where the slave's nodes
        hold them, on what these may touch, or, of bodies that bend, where their edges meet those of
        the corner, and the others anywhere within a facet's size. A corner that points at a facet
        is ahead of these edges, and they do not hold it. Nor do they hold one that is rigid: that
        turns about the line between two of them.

        Args:
            node: The corners, shape (n,).
            facet: The facets, shape (n,).
            x: Points of the slave at t_n [m].
            corners: Corners of the master's facets [m].
        """
        if not len(node):
            return np.zeros(0, dtype=bool)
        point, at, corners = self.slave.share[node], self.master.facets[facet], corners[facet]
        xi, _ = compiled.closest_point(x[point], corners)
        weights, _, _ = facets.shape(xi, at.shape[1])
        _, _, normal = facets.frame(corners, xi)
        rise = np.einsum("ni,nki->nk", normal, corners + self._ways[at] - x[point][:, None])
        size = facets.size(corners)
        rise /= size[:, None]
        depth = np.where(self._near[at], np.clip(rise, 0.0, 1.0), 1.0)
        if self.yields and len(self._meet):
            own, k = np.nonzero((point[:, None, None] == self._meet[None, :, :2]).any(axis=2))
            meets = (at[own][:, :, None] == self._meet[k, None, 2:]).any(axis=2)
            if own.size:
                height = self._heights(point[own], k, x, normal[own]) / size[own]
                np.minimum.at(depth, own, np.where(meets, np.clip(height, 0.0, 1.0)[:, None], 1.0))
        outside = _OUTSIDE if self.yields else _FLUSH
        held: BoolArray = np.einsum("nk,nk->n", weights, depth) < outside
        return held


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
