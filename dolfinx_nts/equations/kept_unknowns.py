"""The layout of the unknowns, kept from step to step while no rank's elements change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.equations.couplings import Couplings
from dolfinx_nts.equations.leaning import Load
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.parallel import Asking, together
from dolfinx_nts.types import FloatArray


class KeptUnknowns:
    """Keeps the layout of a system's unknowns.

    Args:
        batches: Of its bodies.
        couplings: What makes the elements.

    Attributes:
        now: The layout, once there is one.
        extent: Largest `Elements.extent` on all ranks [m].
        extents: The same of each of `Couplings.mechanisms`.
    """

    def __init__(self, batches: Batches, couplings: Couplings) -> None:
        self._batches, self._couplings = batches, couplings
        self.now: Unknowns | None = None
        self._numbers: list[Any] = []

    def lay_out(
        self, awake: Sequence[int], bearing: Mapping[int, Load], works: Sequence[Asking[Any]]
    ) -> list[Any]:
        """Make the layout anew if it has changed. Collective.

        Args:
            awake: Numbers of the bodies in the step.
            bearing: As of `Couplings.loads`.
            works: What else asks all ranks, as of `together`, whose results are returned.
        """
        elements = self._couplings.elements
        widths = np.array([list(c.widths.values()) for c in elements])
        combined = [a for c in elements if c.combination is not None for a in c.combination]
        places = [a for c in elements for a in c.points()]
        numbers = [np.array(awake), widths, *places, *combined]
        changed, *found = together(self._batches.comm, [self._changes(numbers), *works])
        if changed:
            self.destroy()
            of = self._couplings.bodies
            self.now = Unknowns(self._batches, awake, elements, of, bearing)
            self._numbers = numbers
        return found

    def _changes(self, numbers: list[Any]) -> Asking[bool]:
        """Whether any rank's elements have other numbers than before; notes their extents."""
        known = self._numbers
        same = len(numbers) == len(known) and all(
            a is b or np.array_equal(a, b) for a, b in zip(numbers, known, strict=True)
        )
        own = np.array([float(not same), *self._couplings.extents()])
        largest: FloatArray
        _, largest = yield np.empty(0), own
        self.extent, self.extents = float(largest[1]), np.array(largest[2:])
        return bool(largest[0])

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        if self.now is not None:
            self.now.destroy()
        self.now, self._numbers = None, []
