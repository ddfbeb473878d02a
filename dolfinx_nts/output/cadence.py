"""After which steps a writer writes."""

from __future__ import annotations

import numpy as np

from dolfinx_nts.output.running import Running
from dolfinx_nts.validation import is_whole, require_positive


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
