"""What writers and pictures read of a run, whoever steps it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import is_whole, require_positive


class Results(Protocol):
    """Results up to now; a `Solution` has them."""

    @property
    def rows(self) -> Any:
        """Balance table, see `Table`."""

    @property
    def contact_loads(self) -> Any:
        """Of the last step, see `ContactLoads`; None before."""

    @property
    def status(self) -> str:
        """How the run goes, or has ended."""

    @property
    def moving(self) -> bool:
        """Whether it is one in time; else time is the part of the loads."""

    @property
    def warnings(self) -> Any:
        """What was warned of, see `RunWarnings`."""


class Running(Protocol):
    """A run; a `Stepper` is one."""

    @property
    def system(self) -> System:
        """The scene."""

    @property
    def state(self) -> State:
        """Last accepted state."""

    @property
    def solution(self) -> Results:
        """Results up to now."""

    @property
    def restart(self) -> Any:
        """The checkpoint that it goes on from; None without."""

    def mean_force(self, k: int) -> FloatArray:
        """Contact force p_N [N] of contact k at this rank's slave nodes, as writers give it."""


class Cadence:
    """Tells after each accepted step whether to write.

    Args:
        every: Write after every `every`-th step, >= 1.
        interval: Instead of `every`: write after the first step that reaches each multiple of this
            time [s].

    Raises:
        ValueError: An argument is out of range, or both are given.
    """

    def __init__(self, every: int, interval: float | None) -> None:
        if not is_whole(every) or every < 1:
            raise ValueError(f"every={every!r}: pass a whole number of steps >= 1")
        if interval is not None:
            require_positive("interval", interval, "s")
            if every != 1:
                raise ValueError(f"every={every!r}, interval={interval!r}: pass one of the two")
        self.every, self.interval = every, interval

    def start(self, stepper: Running) -> bool:
        """Count from the start of a run, or from where one goes on; tells as `due`."""
        self._seen = len(stepper.solution.rows) - 1
        return self.due(stepper)

    def due(self, stepper: Running) -> bool:
        """Return whether the last accepted state is to be written; the first one of a run is."""
        times = stepper.solution.rows.column("time")
        before, self._seen = self._seen, len(times)
        if not before:
            return True
        if self.interval is None:
            return (len(times) - 1) // self.every > (before - 1) // self.every
        multiples = times[[before - 1, -1]] / self.interval
        then, now = np.floor(multiples + 1e-12 * np.abs(multiples))
        return bool(now > then)
