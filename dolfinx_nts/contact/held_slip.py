"""Slips of contacts over surfaces that a support, or another contact, holds already.

Where a node of the slave is held along its surface, its mean slip is that of its neighbours alone,
which their own rows of friction tell, too: rows nearly repeat each other, as at the cross points of
mortar methods. So nothing is asked of its slip in that direction, and friction is that of the
neighbours; what holds the node bears the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import LEAST_OWN
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.contact.placed import Placed
from dolfinx_nts.contact.surface_elements import SurfaceElements
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.kernels.vectors import projector
from dolfinx_nts.state import State
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Gap over the size of the facets up to which another contact holds a node where it is.
_CLOSED = 1e-6
#: Part of a direction that has to lie along the surface, or gaps of both would be nearly one.
_ALONG = 0.1


@dataclass(frozen=True, eq=False)
class _Contact:
    """A contact in a step.

    Attributes:
        elements: Its elements.
        begun: Positions of its points as the step begins, or the load step that is relaxed [m].
        now: The same at t_n.
        then: The same at t_{n+1}, as far as they are prescribed.
        paths: Displacements of a master that is no body at these three times, shape (3, 3).
    """

    elements: ContactElements
    begun: Sequence[FloatArray]
    now: Sequence[FloatArray]
    then: Sequence[FloatArray]
    paths: FloatArray

    @property
    def points(self) -> IntArray:
        """The slaves, by their positions in their surface, shape (n,)."""
        return self.elements.pair.slave.share[self.elements.candidates.node]

    @cached_property
    def way(self) -> FloatArray | None:
        """Prescribed motion of the master since `begun` [m], shape (3,); None: it has none."""
        way: FloatArray = self.paths[2] - self.paths[0]
        for surface, one, two in zip(
            self.elements.pair.surfaces[1:], self.begun[1:], self.then[1:], strict=True
        ):
            each = two - one
            turns = np.ptp(each, axis=0).max() > self.elements.law.still.min(initial=np.inf)
            if turns or not surface.fixed.all():
                return None
            way = way + each[0]
        return way

    @cached_property
    def closed(self) -> BoolArray:
        """Which slaves have had no gap since `begun`, shape (n,)."""
        c = self.elements
        # Overlap that is pressed out in the step moves the slaves.
        gap = c.gap_at(self.now, self.paths[1]) + c.law.overlap
        since = c.way_since(self.begun, self.paths[0])
        before = gap - np.einsum("ni,ni->n", c.candidates.normal, since)
        closed: BoolArray = np.maximum(np.abs(gap), np.abs(before)) <= _CLOSED * c.law.size
        return closed


class _Wall(NamedTuple):
    """Another contact that may hold slaves of a batch.

    Attributes:
        by: Number of its batch.
        here: The slaves, shape (m,).
        there: What they are in that batch, shape (m,).
        along: Unit vectors in their frames, shape (m, 2).
    """

    by: int
    here: IntArray
    there: IntArray
    along: FloatArray


class _Holds(NamedTuple):
    """What holds slaves of a batch.

    Attributes:
        supports: Sums of the squares of directions in which supports do, shape (n, 2, 2).
        walls: Other contacts that may.
    """

    supports: FloatArray
    walls: list[_Wall]


class HeldSlip:
    """What holds slaves of contacts over surfaces along these.

    A support does where it does not move against the master in the step; so does another contact
    that was closed when the step began, where it presses in the iterate by more than friction does
    against it. What moves makes slip, and friction is that of the motion. Of masters that are free
    to move nothing is known.

    Args:
        pairs: Contacts of a system, and what is added to them.
        places: Of their points.
    """

    def __init__(self, pairs: Sequence[ContactPair], places: Placed) -> None:
        self._pairs, self._places = pairs, places
        self._holds: dict[int, _Holds] = {}

    def begin(
        self, step: Step, begun: State, numbers: Sequence[int], elements: Sequence[ContactElements]
    ) -> None:
        """Find what may hold slaves in a step. Collective.

        Args:
            step: The step.
            begun: State as it begins, or the load step that it relaxes.
            numbers: Of the contacts that have elements.
            elements: Theirs.
        """
        self._holds = {}
        rubs = [i for i, c in enumerate(elements) if _rubs_over_surface(c)]
        if not rubs:
            return
        bodies = {id(elements[i].pair.slave.body) for i in rubs}
        beside = [i for i, c in enumerate(elements) if id(c.pair.slave.body) in bodies]
        here = [numbers[i] for i in beside]
        each = [self._places.at(here, u) for u in (begun.u, step.state.u, step.first)]
        of_body: dict[int, list[tuple[int, _Contact]]] = {}
        for i, k in zip(beside, here, strict=True):
            first, now, then = (at[k] for at in each)
            contact = _Contact(elements[i], first, now, then, self._paths(k, step, begun))
            of_body.setdefault(id(elements[i].pair.slave.body), []).append((i, contact))
        for contacts in of_body.values():
            for i, one in contacts:
                if i not in rubs or one.way is None:
                    continue
                walls = [
                    _wall(one, one.way, wall, wall.way, k)
                    for k, wall in contacts if k != i and wall.way is not None
                ]  # fmt: skip
                walls = [wall for wall in walls if len(wall.here)]
                supports = _supports(one, one.way)
                if walls or supports.any():
                    self._holds[i] = _Holds(supports, walls)

    def _paths(self, k: int, step: Step, begun: State) -> FloatArray:
        """`_Contact.paths` of a contact by its number. Collective."""
        now, path = step.state.time, self._pairs[k].path
        return np.concatenate([path(begun.time, now)[:1], path(now, now + step.dt)])

    def tell(
        self, elements: Sequence[ContactElements], own: Sequence[dict[str, FloatArray]]
    ) -> None:
        """Add to the unknowns of contacts at an iterate what is held, see `SurfaceElements`.

        Args:
            elements: Those of all contacts, as of `begin` but for their laws.
            own: Of each its own unknowns.
        """
        for i, (supports, walls) in self._holds.items():
            total = supports.copy()
            for by, here, there, along in walls:
                # What friction itself presses against a wall ends as soon as that holds.
                rubs = elements[i].carries(own[i])[here, 1:]
                pressed = -elements[by].carries(own[by])[there, 0]
                pressed -= np.einsum("na,na->n", rubs, along).clip(min=0.0)
                _add(total, here, along, pressed > elements[by].law.no_force[there])
            if total.any():
                own[i]["held"] = projector(total, LEAST_OWN)


def _add(total: FloatArray, here: IntArray, along: FloatArray, on: BoolArray) -> None:
    """Add squares of directions (m, 2) of slaves (m,) that are chosen (m,) to sums (n, 2, 2)."""
    np.add.at(total, here[on], along[on, :, None] * along[on, None])


def _rubs_over_surface(c: ContactElements) -> bool:
    return isinstance(c, SurfaceElements) and c.law.num_tangential > 0


def _supports(one: _Contact, master: FloatArray) -> FloatArray:
    """`_Holds.supports` of a contact whose master moves so [m]."""
    fixed = one.elements.pair.slave.fixed[one.points]
    way, total = (one.then[0] - one.begun[0])[one.points] - master, np.zeros((len(fixed), 2, 2))
    for axis in range(3):
        here = np.flatnonzero(fixed[:, axis])
        normal = np.tile(np.eye(3)[axis], (len(here), 1))
        _add(total, here, *_along(one, here, normal, way[here, axis]))
    return total


def _wall(
    one: _Contact, master: FloatArray, wall: _Contact, way: FloatArray, number: int
) -> _Wall:
    """Directions in which another contact may hold slaves of one.

    Args:
        one: The contact.
        master: Motion of its master [m], shape (3,).
        wall: The other one.
        way: Motion of its master [m], shape (3,).
        number: Of its batch.
    """
    slave, other = one.elements.pair.slave, wall.elements.pair.slave
    _, here, there = np.intersect1d(
        slave.points[one.points], other.points[wall.points], return_indices=True
    )
    closed = wall.closed[there]
    here, there = here[closed], there[closed]
    normal = wall.elements.candidates.normal[there]
    along, on = _along(one, here, normal, normal @ (way - master))
    return _Wall(number, here[on], there[on], along[on])


def _along(
    one: _Contact, here: IntArray, normal: FloatArray, slide: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Directions in which something holds slaves, and whether they do not slide there.

    Args:
        one: Their contact.
        here: The slaves, shape (m,).
        normal: Directions in space, shape (m, 3).
        slide: How they move there against the master [m], shape (m,).

    Returns:
        Unit vectors in their frames, shape (m, 2), and a mask (m,).
    """
    c: Any = one.elements
    along = np.einsum("nai,ni->na", c.frame[here], normal)
    part = np.linalg.norm(along, axis=1)
    # What closes a gap slides along a wall that is oblique.
    upright = np.abs(np.einsum("ni,ni->n", c.candidates.normal[here], normal)) <= _CLOSED
    on = (np.abs(slide) <= c.law.still[here]) & (part > _ALONG)
    on &= upright | one.closed[here]
    return along / np.maximum(part, _ALONG)[:, None], on
