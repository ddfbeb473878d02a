"""Bodies whose cells are too stiff for what they do."""

from __future__ import annotations

import numpy as np

from dolfinx_nts.run.solution import Solution
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

#: Part of the squared stress that jumps between cells from which on a body is called too stiff.
_LOCKED = 0.1


class LockingWatch:
    """Looks after 1, 2, 4, 8, ... steps and in the end, for less than 1 % of a run.

    What counts is the sum over all looks: a front of a wave jumps from cell to cell, too, but holds
    little of the stress that a body is under in the course of a run.

    Args:
        system: The scene.

    Attributes:
        KINDS: Of the warnings.
    """

    KINDS = ("locking", "one cell thick")

    def __init__(self, system: System) -> None:
        self._bodies, self._steps = system.bodies, 0
        self._sums = np.zeros((len(system.bodies), 2))

    @property
    def memory(self) -> tuple[int, tuple[float, ...]]:
        """What a checkpoint keeps: number of steps, and the sums of all bodies."""
        return self._steps, tuple(self._sums.ravel().tolist())

    def resume(self, memory: tuple[int, tuple[float, ...]]) -> None:
        """Go on from what another run kept."""
        self._steps, self._sums[:] = memory[0], np.reshape(memory[1], self._sums.shape)

    def look(self) -> None:
        """Look after an accepted step, if it is time for it. Collective."""
        self._steps += 1
        if self._steps & (self._steps - 1) == 0:
            self._sums += self._now()

    def _now(self) -> FloatArray:
        found = np.zeros_like(self._sums)
        for of_body, body in zip(found, self._bodies, strict=True):
            jumps = body.stress_jumps()
            if jumps is not None:
                of_body[:] = jumps
        return found

    def tell(self, solution: Solution, time: float) -> None:
        """Warn of what was seen until now, where the run ends. Collective."""
        sums = (self._sums + self._now()).tolist()
        for body, (jumps, whole) in zip(self._bodies, sums, strict=True):
            if not whole > 0.0:
                continue
            share = jumps / whole
            if share > _LOCKED:
                solution.warn(
                    "locking", time, share,
                    f"cells of body {body.name!r} may be too stiff for its motion: {share:.2g} of "
                    f"its squared stress jumps from cell to cell, and more than {_LOCKED} tells "
                    f"of errors of several per cent; {body.remedy_of_locking}",
                    about=(body.name,),
                )  # fmt: skip
            elif body.is_thin:
                solution.warn(
                    "one cell thick", time, 1.0,
                    f"body {body.name!r} has no node inside: where it bends, one cell of degree 1 "
                    "over its thickness errs by 10 to 40 %; use two or more",
                    about=(body.name,),
                )  # fmt: skip
