"""Nodes in inner edges of a master, where two of its faces meet, held out of the second face too.

A contact holds a node out of one facet. That is the contact of nodes with facets once more, with
the facet across the edge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.candidates import MARGIN, NO_CANDIDATES, Found, Motion
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.convex_edges import INNER, middles
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.kernels import facets
from dolfinx_nts.parallel import Asking
from dolfinx_nts.types import BoolArray, FloatArray, IntArray


class Valleys(FacetPair):
    """The slave's nodes of a pair against facets across inner edges from those that hold them.

    Args:
        of: The pair, whose options it has.
        before: Those across which it is, too, where three faces meet.
    """

    of: FacetPair

    def __init__(self, of: FacetPair, before: Sequence[FacetPair] = ()) -> None:
        self.of, self._before = of, (of, *before)
        super().__init__(
            of.slave, of.master, friction=of.friction_function or of.friction,
            interference=of.interference, name=of.name,
        )  # fmt: skip
        # Points are where they are for the pair.
        self.origin, self.extent = of.origin, of.extent
        self.late = bool(before)
        self._first: IntArray = np.full((len(self._before), len(self.slave.share)), -1)

    @cached_property
    def _inner(self) -> IntArray:
        """Facets that have a point of an inner edge."""
        at = self.master.facets
        return np.flatnonzero(np.isin(at, self.convex.inner).any(axis=1))

    def leave_to(self, slaves: Mapping[int, Sequence[ContactElements]], edges: Any) -> Asking[None]:
        """As of `ContactPair`: the facets that hold nodes."""
        self._first[:] = -1
        for elements in slaves.get(id(self.slave.body), []):
            for first, pair in zip(self._first, self._before, strict=True):
                if elements.pair is pair:
                    first[elements.candidates.node] = elements.candidates.facet
        yield from ()

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Asking[Found]:
        """As of `ContactPair`: at the nearest facet across from the others."""
        slaves, master = positions
        corners, inner = master[self.master.facets], self._inner
        reach = 0.0 if motion is None else motion.reach
        every, sizes = np.ones(len(self.slave.share), dtype=bool), facets.size(corners[inner])
        cover = reach + MARGIN * float(sizes.min())
        node = np.flatnonzero((self._first >= 0).all(axis=0))
        if not (yield node.size > 0):
            return Found(NO_CANDIDATES, every, cover)
        x, (place, normal) = slaves[self.slave.share], middles(corners)

        def across(point: IntArray, facet: IntArray) -> BoolArray:
            one, two = self._first[:, node[point]], inner[facet]
            way = place[two] - place[one]
            seen = np.einsum("bni,bni->bn", way, normal[one]) > 0.0
            seen &= np.einsum("bni,ni->bn", way, normal[two]) < 0.0
            seen &= np.einsum("bni,ni->bn", normal[one], normal[two]) < INNER
            there: BoolArray = seen.all(axis=0)
            return there

        number = np.full(len(corners) + 1, -1)
        number[inner] = np.arange(len(inner))
        stays = number[current[node]]
        stays[~across(np.arange(len(node)), stays)] = -1
        found = search.closest_facets(
            x[node], corners[inner], reach=reach + MARGIN * float(sizes.max()),
            current=stays, admits=search.Admits(across),
        )  # fmt: skip
        near = found.facet >= 0
        candidates, _ = self.measure(
            x, master, node[near], inner[found.facet[near]], found.xi[near], reach
        )
        return Found(candidates, every, cover)

    def missed(
        self,
        positions: Sequence[FloatArray],
        motions: Sequence[FloatArray],
        path: FloatArray,
        reach: float,
        held: IntArray,
        aimed: IntArray,
    ) -> Asking[IntArray | None]:
        """None: the pair notes what comes through a facet."""
        yield from ()
        return None

    def settle(self, u: Sequence[FloatArray]) -> None:
        """Nothing is adjusted but the gap to the facet that holds a node in its pair."""


def tell_met(found: dict[int, ContactElements], own: Sequence[int]) -> None:
    """Tell the laws of friction which nodes two faces hold, see `shared_nodes.meeting`.

    Args:
        found: Candidates of contacts by their number, which are replaced.
        own: Of each contact its number, or that of the one that it is added to.
    """
    for k, more in list(found.items()):
        pair = more.pair
        if pair.of is None or pair.exchanged or pair.redundant or own[k] not in found:
            continue
        both = np.intersect1d(found[own[k]].candidates.node, more.candidates.node)
        for i in (own[k], k):
            meets, law = np.isin(found[i].candidates.node, both), found[i].law
            found[i] = replace(found[i], law=replace(law, meets=law.meets | meets))


def valleys_of(pair: Any) -> list[Valleys]:
    """What holds nodes in inner edges of a pair's master: twice where three faces meet."""
    if type(pair) is not FacetPair or not len(pair.convex.inner):
        return []
    first = Valleys(pair)
    several = np.bincount(pair.convex.inner.ravel()).max() > 2
    return [first, Valleys(pair, [first])] if several else [first]
