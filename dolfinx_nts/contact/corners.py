"""Vertices and nodes of sharp edges of a master, which facets of its slave keep outside.

Slave nodes say nothing of what enters a facet of the slave between them. That is the contact of
nodes with facets once more, with the roles exchanged.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dolfinx_nts.contact.convex_edges import middles
from dolfinx_nts.contact.edges import Edges
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.contact.pair import Candidates
from dolfinx_nts.contact.rims import TILTED, facets_around
from dolfinx_nts.contact.surfaces import Surface
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
        self._around = facets_around(self.slave)
        self._level = -float(np.sqrt(1.0 - TILTED[self.yields] ** 2))

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

    def nodal_forces(self, history: ContactHistory) -> FloatArray:
        """Forces at the points of its master, equal at all of a facet [N], (p,). Collective."""
        force, on = np.zeros(len(self.master.points)), history.force > 0.0
        at = self.master.facets[history.facet[on]]
        np.add.at(force, at, history.force[on, None] / at.shape[1])
        return global_sum(self.master.body.comm, force)

    def held_otherwise(
        self, found: Candidates, x: tuple[FloatArray, ...], near: BoolArray, meet: IntArray
    ) -> BoolArray:
        """Which candidates something else holds, shape (n,).

        Args:
            found: Candidates.
            x: Points of its slave and master at t_n [m].
            near: Which points of its master are candidates of the pair, shape (p,).
            meet: Ends of edges that may meet in the step, of the master's and of the slave's each
                two points, shape (k, 4).
        """
        facet = self.master.facets[found.facet]
        held = near[facet].any(axis=1)
        held[held] = self._lies_flat(found.select(held), x[0])
        point = self.slave.share[found.node]
        one, k = np.nonzero((point[:, None, None] == meet[None, :, :2]).any(axis=2))
        start, end = x[1][meet[k, 2]], x[1][meet[k, 3]]
        way, place = end - start, x[0][point[one]]
        part = np.einsum("ni,ni->n", place - start, way) / np.einsum("ni,ni->n", way, way)
        foot = start + np.clip(part, 0.0, 1.0)[:, None] * way
        at = np.linalg.norm(place - foot, axis=1) < _AT_EDGE * found.length[one]
        held[one[at]] = True
        return held

    def _lies_flat(self, found: Candidates, x: FloatArray) -> BoolArray:
        """Whether a facet around the corners lies flat on the ones that they are over, (n,)."""
        facet, first, count = self._around
        pair = np.repeat(np.arange(len(found.node)), count[found.node])
        start = np.cumsum(count[found.node]) - count[found.node]
        own = facet[first[found.node][pair] + np.arange(len(pair)) - start[pair]]
        _, normal = middles(x[self.slave.facets[own]])
        flat = np.zeros(len(found.node), dtype=bool)
        flat[pair[np.einsum("ni,ni->n", normal, found.normal[pair]) < self._level]] = True
        return flat


def corners_of(pair: Any) -> list[Corners]:
    """The corners of a pair, none if it knows no edges or its master has none. Collective.

    Facets of nodes without mass are no masters.
    """
    if not (isinstance(pair, FacetPair) and pair.has_edges) or pair.slave.massless.any():
        return []
    return [Corners(pair)] if len(pair.sharp_edges[1].ends) else []


def _with_corners(pair: FacetPair) -> Surface:
    """A pair's master as a slave of its corners."""
    edges, master = pair.sharp_edges[1], pair.master
    ends: IntArray = np.unique(edges.surface.points[edges.ends])
    found: Surface = master.part(np.isin(master.points, ends))
    return found
