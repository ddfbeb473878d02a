"""Contacts whose surfaces are too far from each other to meet in a step, by the boxes around them.

A heap declares a contact of every two bodies, and a step is to cost what its neighbours do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dolfinx_nts.contact.corners import Corners
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.contact.pair import MARGIN, ContactPair
from dolfinx_nts.contact.search import ROUNDING
from dolfinx_nts.contact.surfaces import Surface, gather_each
from dolfinx_nts.kernels import facets
from dolfinx_nts.kernels.vectors import range_of
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray


class Apart:
    """Distances of surfaces from each other, of contacts that hold nodes out of facets.

    Args:
        contacts: Those of a system, and corners, which go with their contacts.
        bodies: Numbers of the bodies of each.

    Attributes:
        far: Numbers of those that the last look found to be too far from each other, and for which
            motion relative to each other they miss nothing [m].
    """

    def __init__(self, contacts: Sequence[ContactPair], bodies: Sequence[tuple[int, ...]]) -> None:
        of: dict[int, int] = {}
        self._surfaces: list[Surface] = []
        self._bodies, pairs, lifts = [], [], []
        numbers_of = []
        for k, (pair, numbers) in enumerate(zip(contacts, bodies, strict=True)):
            corners = isinstance(pair, Corners)
            if corners or not (isinstance(pair, FacetPair) and pair.holds_nodes):
                continue
            for surface, body in zip(pair.surfaces, numbers, strict=True):
                if of.setdefault(id(surface), len(of)) == len(self._surfaces):
                    self._surfaces.append(surface)
                    self._bodies.append(body)
            pairs.append([of[id(surface)] for surface in pair.surfaces])
            lifts.append(pair.lift)
            numbers_of.append(k)
        self._pairs: IntArray = np.array(pairs, dtype=int).reshape(-1, 2)
        self._lifts = np.array(lifts, dtype=float)
        self._numbers: IntArray = np.array(numbers_of, dtype=int)
        # Those that had no candidates.
        self._asked = np.ones(len(pairs), dtype=bool)
        self.far: dict[int, float] = {}
        # What contacts remember without candidates.
        off = (np.zeros(len(pair.slave.share), dtype=bool) for pair in contacts)
        both = zip(contacts, off, strict=True)
        self._none = [pair.history_at_start()._replace(followed=none) for pair, none in both]
        self._rests: dict[int, ContactHistory] = {}

    def reach(self, motion: FloatArray) -> FloatArray:
        """Bound on the motion of the slaves of each relative to the master [m], shape (n,).

        Args:
            motion: Of each body [m].
        """
        return np.sqrt(3.0) * motion[np.array(self._bodies, dtype=int)[self._pairs]].sum(axis=1)

    def look(self, u: Sequence[FloatArray], motion: FloatArray) -> None:
        """Find the contacts that need not be sought in a step, `far`. Collective.

        Args:
            u: Owned displacements of all bodies [m].
            motion: As of `reach`, expected in the step.
        """
        self.far, asked = {}, self._asked
        if not asked.any():
            return
        pairs = self._pairs[asked]
        boxes = np.zeros((len(self._surfaces), 2, 3))
        sizes = np.zeros(len(boxes))
        chosen = np.unique(pairs).tolist()
        surfaces = [self._surfaces[i] for i in chosen]
        moved = gather_each(surfaces, [u[self._bodies[i]] for i in chosen])
        for i, surface, way in zip(chosen, surfaces, moved, strict=True):
            x = surface.reference + way
            boxes[i] = range_of(x)
            sizes[i] = facets.size(x[surface.facets]).max(initial=0.0)
        one, two = boxes[pairs].swapaxes(0, 1)
        outside = -(one + two[:, ::-1]).min(axis=(1, 2))
        magnitude = np.abs(boxes[pairs]).max(axis=(1, 2, 3))
        outside -= self._lifts[asked] + ROUNDING * (magnitude + np.abs(outside))
        far = outside > self.reach(motion)[asked] + MARGIN * sizes[pairs].max(axis=1)
        numbers = self._numbers[asked][far].tolist()
        self.far = dict(zip(numbers, outside[far].tolist(), strict=True))

    def misses(self, motion: FloatArray) -> bool:
        """Whether motion may have brought surfaces together that were far from each other [m]."""
        far = np.isin(self._numbers, list(self.far))
        covers: FloatArray = np.array(list(self.far.values()))
        return bool((self.reach(motion)[far] > covers).any())

    def histories(
        self, old: Sequence[ContactHistory], followed: Mapping[int, BoolArray]
    ) -> list[ContactHistory]:
        """What contacts remember of a step in which they have no candidates.

        Args:
            old: Of the step before, of each contact and corners.
            followed: As of `ContactHistory`, of those that were sought.
        """
        found = [
            before if k not in followed and self._rests.get(k) is before
            else none._replace(slip=before.slip, overlap=before.overlap)
            for k, (none, before) in enumerate(zip(self._none, old, strict=True))
        ]  # fmt: skip
        # Step after step the same.
        self._rests = {k: h for k, h in enumerate(found) if k not in followed}
        for k, nodes in followed.items():
            found[k] = found[k]._replace(followed=nodes)
        return found

    def found(self, numbers: Sequence[int]) -> None:
        """Note which contacts have candidates: they are sought anew."""
        self._asked = ~np.isin(self._numbers, numbers)
