"""Contacts whose surfaces are too far from each other or from an obstacle to meet in a step.

A heap declares a contact of every two bodies, and a step is to cost what its neighbours do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dolfinx_nts.contact.candidates import MARGIN
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.contact.obstacle_pair import ObstaclePair
from dolfinx_nts.contact.obstacles import Obstacle
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.contact.search import ROUNDING
from dolfinx_nts.contact.surfaces import Surface, gather_each
from dolfinx_nts.kernels import facets
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray


class Apart:
    """Distances of surfaces from each other and from obstacles, of contacts that hold nodes out.

    Args:
        contacts: Those of a system, and what is added to them.
        bodies: Numbers of the bodies of each.

    Attributes:
        far: Numbers of those that the last look found to be too far from each other, and for which
            motion relative to each other they miss nothing [m].
    """

    def __init__(self, contacts: Sequence[ContactPair], bodies: Sequence[tuple[int, ...]]) -> None:
        of: dict[int, int] = {}
        self._surfaces: list[Surface] = []
        self._obstacles: list[Obstacle] = []
        of_obstacles: dict[int, int] = {}
        self._bodies, pairs, movers, masters, lifts = [], [], [], [], []
        numbers_of, least = [], []
        for k, (pair, numbers) in enumerate(zip(contacts, bodies, strict=True)):
            # Corners are on the surfaces of their contact, with the roles exchanged.
            surfaces = pair.of.surfaces[::-1] if pair.of and pair.exchanged else pair.surfaces
            obstacle = isinstance(pair, ObstaclePair) and not pair.driven
            known = (isinstance(pair, FacetPair) or obstacle) and pair.holds_nodes
            if not (known and all(len(surface.points) for surface in surfaces)):
                continue
            for surface, body in zip(surfaces, numbers, strict=True):
                if of.setdefault(id(surface), len(of)) == len(self._surfaces):
                    self._surfaces.append(surface)
                    self._bodies.append(body)
            number = -1
            if obstacle:
                number = of_obstacles.setdefault(id(pair.master), len(of_obstacles))
                if number == len(self._obstacles):
                    self._obstacles.append(pair.master)
            # The slave for the second time where there is no second surface; no body moves then.
            pairs.append((of[id(surfaces[0])], of[id(surfaces[-1])]))
            movers.append((numbers[0], -1 if obstacle else numbers[-1]))
            masters.append(number)
            lifts.append(pair.lift)
            # Edges are sought this far.
            least.append(0.0 if obstacle else min(surface.smallest for surface in surfaces))
            numbers_of.append(k)
        self._pairs: IntArray = np.array(pairs, dtype=int).reshape(-1, 2)
        self._movers: IntArray = np.array(movers, dtype=int).reshape(-1, 2)
        self._masters: IntArray = np.array(masters, dtype=int)
        self._lifts, self._least = np.array(lifts, dtype=float), np.array(least, dtype=float)
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
        return np.sqrt(3.0) * np.append(motion, 0.0)[self._movers].sum(axis=1)

    def look(self, u: Sequence[FloatArray], motion: FloatArray) -> None:
        """Find the contacts that need not be sought in a step, `far`. Collective.

        Args:
            u: Owned displacements of all bodies [m].
            motion: As of `reach`, expected in the step.
        """
        self.far, asked = {}, self._asked
        if not asked.any():
            return
        chosen, pairs = np.unique(self._pairs[asked], return_inverse=True)
        pairs, masters = pairs.reshape(-1, 2), self._masters[asked]
        surfaces = [self._surfaces[i] for i in chosen]
        moved = gather_each(surfaces, [u[self._bodies[i]] for i in chosen])
        x = np.concatenate([surface.reference for surface in surfaces]) + np.concatenate(moved)
        starts = np.cumsum([0, *(len(surface.points) for surface in surfaces)])[:-1]
        boxes = np.stack([_largest(x, starts), _largest(-x, starts)], axis=1)
        one, two = boxes[pairs].swapaxes(0, 1)
        outside = -(one + two[:, ::-1]).min(axis=(1, 2))
        sizes = np.maximum(_sizes(surfaces, x, starts)[pairs[:, 1]], self._least[asked])
        magnitude = np.abs(boxes[pairs]).max(axis=(1, 2, 3))
        wide = np.sqrt([surface.area.max(initial=0.0) for surface in surfaces])
        for k, obstacle in enumerate(self._obstacles):
            here = masters == k
            if here.any():
                gaps, slaves = -_largest(-obstacle.gap(x).value, starts), pairs[here, 0]
                outside[here], sizes[here] = gaps[slaves], wide[slaves]
                magnitude[here] += obstacle.extent
        outside -= self._lifts[asked] + ROUNDING * (magnitude + np.abs(outside))
        far = outside > self.reach(motion)[asked] + MARGIN * sizes
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
            old: Of the step before, of each contact and of what is added.
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


def _largest(values: FloatArray, starts: IntArray) -> FloatArray:
    """The largest of the rows from each start to the next, which are one at least."""
    found: FloatArray = np.maximum.reduceat(values, starts, axis=0)
    return found


def _sizes(surfaces: Sequence[Surface], x: FloatArray, starts: IntArray) -> FloatArray:
    """Size of the largest facet of each surface [m], shape (n,).

    Args:
        surfaces: The surfaces.
        x: Positions of the points of all [m], one after the other.
        starts: Numbers of the first of each.
    """
    found = np.zeros(len(surfaces))
    for corners in {surface.facets.shape[1] for surface in surfaces}:
        some = [k for k, s in enumerate(surfaces) if s.facets.shape[1] == corners]
        at = np.concatenate([surfaces[k].facets + starts[k] for k in some])
        of = np.repeat(some, [len(surfaces[k].facets) for k in some])
        np.maximum.at(found, of, facets.size(x[at]))
    return found
