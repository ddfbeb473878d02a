"""Nodes in inner edges of a master, where two of its faces meet, held out of the second face too.

A contact holds a node out of one facet. That is the contact of nodes with facets once more, with
the facet across the edge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.candidates import MARGIN, NO_CANDIDATES, Candidates, Found, Motion
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.convex_edges import INNER, middles
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.kernels import facets
from dolfinx_nts.parallel import Asking, global_max
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
            interference=of.interference, adjust=of.adjust, name=of.name,
        )  # fmt: skip
        self.added = len(before)
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
        reach = self.lift + (0.0 if motion is None else motion.reach)
        sizes = facets.size(positions[1][self.master.facets[self._inner]])
        every = np.ones(len(self.slave.share), dtype=bool)
        cover = reach - self.lift + MARGIN * float(sizes.min())
        if not (yield bool((self._first >= 0).all(axis=0).any())):
            return Found(NO_CANDIDATES, every, cover)
        c, _ = self._across(positions, current, reach, MARGIN * float(sizes.max()))
        return Found(c._replace(gap=c.gap - self.offset[c.node]), every, cover)

    def _across(
        self, positions: Sequence[FloatArray], current: IntArray, reach: float, margin: float
    ) -> tuple[Candidates, FloatArray]:
        """Nodes at the nearest facets across from those of `_first`, and their distances [m].

        Args:
            positions: As of `find`.
            current: As of `find`.
            reach: Largest gap [m], ...
            margin: ... and how far beyond it facets are looked at.
        """
        (slaves, master), inner = positions, self._inner
        corners, node = master[self.master.facets], np.flatnonzero((self._first >= 0).all(axis=0))
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
        closest = search.closest_facets(
            x[node], corners[inner], reach=reach + margin, current=stays,
            admits=search.Admits(across),
        )  # fmt: skip
        near = closest.facet >= 0
        facet, xi = inner[closest.facet[near]], closest.xi[near]
        found, _ = self.measure(x, master, node[near], facet, xi, reach)
        away = np.full(len(x), np.inf)
        away[node[near]] = closest.distance[near]
        return found, away[found.node]

    def _at_start(self, positions: Sequence[FloatArray], path: FloatArray) -> Candidates:
        """As of `ContactPair`."""
        self._first[:] = -1
        for first, pair in zip(self._first, self._before, strict=True):
            c = pair._at_start(positions, path)
            first[c.node] = c.facet
        none = np.full(len(self.slave.share), -1)
        found, away = self._across(positions, none, self.adjust, 0.0)
        return found.select(away <= self.adjust)

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


class Face(NamedTuple):
    """What holds nodes out of some faces of a master: a contact, or what is added to it.

    Attributes:
        pair: The contact, or what is added.
        found: Its candidates.
        before: Facets of the nodes in the last step, or -1, shape (share,).
    """

    pair: Any
    found: Candidates
    before: IntArray


def bound(comm: MPI.Comm, groups: Sequence[Mapping[int, Face]]) -> dict[int, Candidates]:
    """Candidates that change where nodes stay with what has held them out of a face. Collective.

    Which face is nearer changes from step to step; what is remembered of a face is of its pair.

    Args:
        comm: MPI communicator.
        groups: Of contacts that have several, by number.
    """
    if not groups:
        return {}
    new = [_bound(list(group.values())) for group in groups]
    changes = global_max(comm, np.array([float(c is not None) for c in new]))
    found: dict[int, Candidates] = {}
    for group, own, change in zip(groups, new, changes, strict=True):
        if change:
            found |= zip(group, own or [face.found for face in group.values()], strict=True)
    return found


def _bound(faces: Sequence[Face]) -> list[Candidates] | None:
    """`bound` of one group on this rank; None if nothing changes."""
    number, shape = faces[0].pair.convex.faces, (len(faces), len(faces[0].before))
    row, have, had = np.full(shape, -1), np.full(shape, -1), np.full(shape, -2)
    start = np.cumsum([0, *(len(face.found.node) for face in faces)])
    for k, (pair, c, before) in enumerate(faces):
        row[k, c.node], have[k, c.node] = start[k] + np.arange(len(c.node)), number[c.facet]
        last = np.where(before < 0, pair.adjusted, before)
        had[k, last >= 0] = number[last[last >= 0]]
    order = row.copy()
    for i, j in combinations(range(len(faces)), 2):
        stay = (have[i] == had[i]) + 1 * (have[j] == had[j])
        swap = (have[j] == had[i]) + 1 * (have[i] == had[j]) > stay
        for both in (order, have):
            both[i, swap], both[j, swap] = both[j, swap], both[i, swap]
    if (order == row).all():
        return None
    # Of each the gap that counts as none is that of its own face.
    gaps = [c._replace(gap=c.gap + pair.offset[c.node]) for pair, c, _ in faces]
    every = Candidates._make(np.concatenate(parts) for parts in zip(*gaps, strict=True))
    own = [every.select(rows[rows >= 0]) for rows in order]
    return [
        c._replace(gap=c.gap - face.pair.offset[c.node])
        for face, c in zip(faces, own, strict=True)
    ]


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
