"""What a run remembers of its last steps beside its state."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from dolfinx_nts.arrays import FloatArray
from dolfinx_nts.state import State


class LastSteps:
    """The last step, and contact forces of the last two.

    Attributes:
        last: Start and length of the last step [s], or None.
    """

    def __init__(self) -> None:
        self.last: tuple[float, float] | None = None
        self._recent: deque[tuple[float, tuple[FloatArray, ...]]] = deque(maxlen=2)

    def take(self, before: State, dt: float, after: State) -> None:
        """Remember an accepted step.

        Args:
            before: State at its start.
            dt: Its length, as its equations had it [s].
            after: State at its end.
        """
        self.last = before.time, dt
        self._recent.append((after.time - before.time, _forces(after)))

    def mean_force(self, k: int) -> FloatArray | None:
        """Contact force p_N [N] of contact k in the mean of the last two steps; None before any."""
        if not self._recent:
            return None
        steps, forces = zip(*self._recent, strict=True)
        mean: FloatArray = np.average([force[k] for force in forces], axis=0, weights=steps)
        return mean

    @property
    def lengths(self) -> list[float]:
        """Of the last two steps [s]."""
        return [dt for dt, _ in self._recent]

    @property
    def force_before(self) -> tuple[FloatArray, ...] | None:
        """p_N [N] of each contact in the step before the last; None without one."""
        return self._recent[0][1] if len(self._recent) > 1 else None

    def resume(
        self, memory: Mapping[str, Any], nodal: Mapping[str, Any], state: State
    ) -> None:
        """Remember what a checkpoint holds, see `Stepper.memory` and `Stepper.nodal_memory`."""
        forces = [tuple(nodal["force_before"])] if "force_before" in nodal else []
        forces.append(_forces(state))
        self._recent.extend(zip(memory["recent"], forces, strict=False))
        if memory["last"] is not None:
            start, length = memory["last"]
            self.last = start, length


def _forces(state: State) -> tuple[FloatArray, ...]:
    return tuple(contact.force for contact in state.contacts)
