"""A body in contact with itself that must not cross itself: what of its surface lies inside it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact.crossings import BodyPair, Finding, Pause, places, point
from dolfinx_nts.contact.intrusion import LEAST
from dolfinx_nts.contact.surfaces import Surface, winding
from dolfinx_nts.kernels import facets
from dolfinx_nts.types import FloatArray

#: Of so many nodes, the deepest ones, it is asked whether the body encloses them.
_MOST = 32
#: They are looked at this part of their depth inside their own part.
_INSIDE = 0.05


class SelfWatched:
    """A surface in contact with itself, whose nodes must not lie inside its body.

    Args:
        contact: The contact.
        whole: The whole boundary of its body.
    """

    def __init__(self, contact: Any, whole: Surface) -> None:
        self._contact, self._whole = contact, whole
        self.needed = [contact.slave, whole]

    def passed(
        self,
        before: dict[int, FloatArray],
        after: dict[int, FloatArray],
        way: float,
        through: float,
    ) -> Iterator[Finding]:
        """Return what was inside on the way between two looks, as of `Watched`."""
        for part in np.linspace(0.0, 1.0, places(way, through)):
            yield from self.look({i: (1.0 - part) * before[i] + part * after[i] for i in after})[0]

    def look(self, positions: dict[int, FloatArray]) -> tuple[list[Finding], Pause]:
        """Return what is inside, and how long nothing else may be, as of `Watched`."""
        surface, whole = self._contact.slave, self._whole
        x, corners = positions[id(surface)], positions[id(whole)][whole.facets]
        smallest = float(facets.size(x[surface.facets]).min())
        node, facet, depth, inward = self._contact.sunk(x, LEAST)
        order = np.argsort(-depth)[:_MOST]
        for i in order.tolist():
            # A little inside its own part the body encloses it once, and twice where it is in two.
            if winding(x[node[i]] + _INSIDE * depth[i] * inward[i], corners) > 1.5:
                return [self._told(x, node[i], facet[i], depth[i])], Pause(0.0, smallest)
        return [], Pause(0.0, smallest)

    def _told(self, x: FloatArray, node: int, facet: int, depth: float) -> Finding:
        """A node inside, in words."""
        surface = self._contact.slave
        name, number = surface.body.name, int(surface.original[node])
        corners = surface.facets[facet]
        size = float(depth / facets.size(x[corners][None])[0])
        text = (
            f"node {number} of {name!r} lies inside {name!r} itself, by up to {depth:.3g}, or "
            f"{size:.2g} of a facet, at ({point(x[node])}); the facet of nodes "
            f"{sorted(surface.original[corners].tolist())} did not hold it: use a smaller dt, or a "
            "finer mesh there"
        )
        return Finding("node inside a body", float(depth), size, x[node], (name, name), (number,),
                       text)  # fmt: skip


class SelfPair(BodyPair):
    """A body of which contacts of surfaces with themselves are declared; see `BodyPair`."""

    @cached_property
    def _parts(self) -> list[SelfWatched]:
        whole = self._boundary(self._bodies[0])
        return [SelfWatched(contact, whole) for contact in self.contacts]
