"""Bodies whose cells are too stiff for what they do."""

from __future__ import annotations

import numpy as np

from dolfinx_nts.run.solution import Solution
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

#: Part of the squared stress that jumps between cells from which on a body is called too stiff.
_LOCKED = 0.1
#: Steps in time after which it looks for the first time.
_FIRST = 64


class LockingWatch:
    """Looks after 64, 128, ... steps and in the end; at an equilibrium in the end.

    What counts is the sum over all looks: at the front of a wave the stress jumps from cell to
    cell, too, but that is little of the stress that a body is under in the course of a run. Of runs
    of fewer steps in time, in which a front may be all there is, nothing is told.

    Args:
        system: The scene.
        in_time: Whether steps are in time, not those of a load.

    Attributes:
        KINDS: Of the warnings.
    """

    KINDS = ("locking", "one cell thick")

    def __init__(self, system: System, *, in_time: bool) -> None:
        self._bodies, self._steps, self._in_time = system.bodies, 0, in_time
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
        if self._is_due and self._in_time:
            self._sums += self._now()

    @property
    def _is_due(self) -> bool:
        return self._steps >= _FIRST and self._steps & (self._steps - 1) == 0

    def _now(self) -> FloatArray:
        found = np.zeros_like(self._sums)
        for of_body, body in zip(found, self._bodies, strict=True):
            if body.locking is not None:
                of_body[:] = body.locking.stress_jumps()
        found[~np.isfinite(found).all(axis=1)] = 0.0
        return found

    def tell(self, solution: Solution, time: float) -> None:
        """Warn of what was seen until now, where the run ends. Collective."""
        if self._in_time and self._steps < _FIRST:
            return
        # Those of a run that this one goes on from are of its first part.
        solution.warnings.withdraw(self.KINDS)
        seen = self._is_due and self._in_time
        sums = (self._sums if seen else self._sums + self._now()).tolist()
        for body, (jumps, whole) in zip(self._bodies, sums, strict=True):
            locking = body.locking
            if locking is None or not whole > 0.0:
                continue
            share = jumps / whole
            if locking.keeps_volume:
                solution.warn(
                    "locking", time, max(share, 1.0),
                    f"cells of body {body.name!r} are of degree 1 and can hardly move, as its "
                    "material hardly changes its volume: it may be many times too stiff; "
                    f"{locking.remedy}",
                    about=(body.name,),
                )  # fmt: skip
            elif share > _LOCKED:
                solution.warn(
                    "locking", time, share,
                    f"cells of body {body.name!r} may be too stiff for its motion: the squares "
                    f"of its stress's jumps from cell to cell are {share:.2g} of those of the "
                    f"stress; more than {_LOCKED} means errors of several per cent, in stress "
                    f"and pressure above all; {locking.remedy}",
                    about=(body.name,),
                )  # fmt: skip
            elif locking.is_thin:
                solution.warn(
                    "one cell thick", time, 1.0,
                    f"body {body.name!r} has no node inside: where it bends, one cell of degree 1 "
                    "over its thickness is too stiff by 10 to 70 %, or too soft with "
                    "volume='projected'; use two or more",
                    about=(body.name,),
                )  # fmt: skip
