"""Where the points of contacts are, gathered of all of them in one call."""

from __future__ import annotations

from collections.abc import Sequence

from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.contact.surfaces import Surface, gather_each
from dolfinx_nts.types import FloatArray


class Placed:
    """Positions of the points of a system's contacts, and of what is added to them.

    Args:
        contacts: The contacts, and after them what is added to them.
        bodies: Numbers of the bodies of each.

    Attributes:
        own: Of each its number, of what is added that of its contact.
    """

    def __init__(self, contacts: Sequence[ContactPair], bodies: Sequence[tuple[int, ...]]) -> None:
        number = {id(pair): k for k, pair in enumerate(contacts)}
        # What they touch lies where their contact's surfaces do.
        self.own = [number[id(c.of or c)] for c in contacts]
        self._pairs, self._bodies = contacts, bodies

    def at(
        self, numbers: Sequence[int], u: Sequence[FloatArray]
    ) -> dict[int, Sequence[FloatArray]]:
        """Positions of all points [m], see `ContactPair.positions`. Collective.

        Args:
            numbers: Of the contacts.
            u: Owned displacements of all bodies [m].
        """
        of: dict[int, tuple[Surface, FloatArray]] = {}
        for k in {self.own[k] for k in numbers}:
            both = zip(self._pairs[k].surfaces, self._bodies[k], strict=True)
            of.update((id(surface), (surface, u[b])) for surface, b in both)
        moved = gather_each(*zip(*of.values(), strict=True)) if of else []
        ways, found = dict(zip(of, moved, strict=True)), dict[int, Sequence[FloatArray]]()
        for k in numbers:
            own = self.own[k]
            if own not in found:
                pair = self._pairs[own]
                found[own] = pair.placed([ways[id(surface)] for surface in pair.surfaces])
            if own != k:
                found[k] = found[own][:: -1 if self._pairs[k].exchanged else 1]
        return found
