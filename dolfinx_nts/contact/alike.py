"""Contacts of rigid bodies that are alike, whose elements are evaluated as those of one.

A heap has many contacts of few elements each, whose calls cost more than what they compute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import ContactLaw, Contribution
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.obstacle_gap import ObstacleGap
from dolfinx_nts.contact.obstacles import can_join
from dolfinx_nts.types import FloatArray


class _Placed(NamedTuple):
    """What an evaluation asks of an `Attachment`."""

    weights: FloatArray | None
    path: tuple[FloatArray, FloatArray]


class _Group(NamedTuple):
    """Batches, their numbers, how many elements each has, and what these are together."""

    batches: list[Any]
    numbers: list[int]
    counts: list[int]
    together: Any


class Alike:
    """Batches of elements, those of contacts that are alike as one.

    Args:
        elements: Batches of a step.
        before: Of earlier batches: what has not changed since is not joined again.

    Attributes:
        of: The batches.
        elements: Fewer batches.
    """

    def __init__(self, elements: Sequence[Any], before: Alike | None = None) -> None:
        kinds: dict[Any, list[int]] = {}
        for k, batch in enumerate(elements):
            kinds.setdefault(_kind(batch) or k, []).append(k)
        self.of = list(elements)
        known = {} if before is None else {tuple(g.numbers): g for g in before._groups}
        self._groups: list[_Group] = [
            _group(numbers, [elements[k] for k in numbers], known.get(tuple(numbers)))
            for numbers in kinds.values()
        ]
        self.elements = [group.together for group in self._groups]

    def places(self, each: Sequence[FloatArray]) -> list[FloatArray]:
        """Places of all batches as those of `elements`."""
        return [_rows([each[k] for k in group.numbers]) for group in self._groups]

    def own(self, each: Sequence[Mapping[str, FloatArray]]) -> list[Mapping[str, FloatArray]]:
        """Own unknowns of all batches as those of `elements`."""
        found: list[Mapping[str, FloatArray]] = []
        for _, numbers, *_ in self._groups:
            first = each[numbers[0]]
            same = {name: _rows([each[k][name] for k in numbers]) for name in first}
            found.append(first if len(numbers) == 1 else same)
        return found

    def apart(self, parts: Sequence[Any]) -> tuple[Any, ...]:
        """What all batches contribute, from what `elements` do."""
        found: list[Any] = [None] * len(self.of)
        for (_, numbers, counts, _), part in zip(self._groups, parts, strict=True):
            if len(numbers) == 1:
                found[numbers[0]] = part
                continue
            ends = pairwise(np.cumsum([0, *counts]).tolist())
            for k, (start, stop) in zip(numbers, ends, strict=True):
                found[k] = Contribution(*(a[start:stop] for a in part))
        return tuple(found)


def _rows(arrays: Sequence[FloatArray]) -> FloatArray:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _kind(batch: Any) -> Any:
    """What contacts of rigid bodies have in common that are alike, on all ranks; None: nothing."""
    if getattr(type(batch), "evaluate", None) is not ContactElements.evaluate:
        return None
    law, measure = batch.law, batch.measure
    if type(measure) not in (FacetGap, ObstacleGap) or law.varies is not None:
        return None
    # Obstacles move by themselves: only contacts with the same one may be alike.
    master = None
    if type(measure) is ObstacleGap:
        master = id(batch.pair.master)
        if not can_join(measure.obstacle):
            return None
    if not all(body.rigid for body in batch.pair.bodies):
        return None
    return (
        law.friction, law.row, law.num_normal, law.rubs, law.imposed is None,
        batch.num_coordinates, batch.attachment.weights is None, master,
    )  # fmt: skip


def _group(numbers: list[int], batches: list[Any], known: _Group | None) -> _Group:
    """Batches as one, by what is known of others with the same numbers."""
    first, counts = batches[0], [batch.num_elements for batch in batches]
    if len(numbers) == 1:
        return _Group(batches, numbers, counts, first)
    law = ContactLaw.joined([batch.law for batch in batches], counts)
    if known and all(
        a.measure is b.measure and a.offset is b.offset
        for a, b in zip(batches, known.batches, strict=True)
    ):
        return _Group(batches, numbers, counts, replace(known.together, law=law))
    weights: Any = [batch.attachment.weights for batch in batches]
    placed: Any = _Placed(
        None if weights[0] is None else np.concatenate(weights), first.attachment.path
    )
    offsets = [np.broadcast_to(b.offset, n) for b, n in zip(batches, counts, strict=True)]
    extents = np.array([batch.pair.extent for batch in batches])
    together = replace(
        first, attachment=placed, law=law, offset=np.concatenate(offsets),
        measure=first.measure.joined([batch.measure for batch in batches], counts),
        contacts=(extents, np.repeat(np.arange(len(counts)), counts)),
    )  # fmt: skip
    return _Group(batches, numbers, counts, together)
