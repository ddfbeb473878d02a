"""Time spent in methods of the package."""

from __future__ import annotations

import time
from typing import Any


class Clock:
    """Seconds spent in methods, while they are timed.

    Attributes:
        seconds: Wall time by label [s].
        cpu: The same of this process's processor time [s].
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu: dict[str, float] = {}
        self._restore: list[tuple[type, str, Any]] = []

    def time(self, label: str, owner: type, name: str) -> None:
        """Time a method of a class from now on."""
        method = getattr(owner, name)
        self._restore.append((owner, name, method))
        self.seconds[label] = self.cpu[label] = 0.0

        def timed(*arguments: Any, **options: Any) -> Any:
            begin, busy = time.perf_counter(), time.process_time()
            try:
                return method(*arguments, **options)
            finally:
                self.seconds[label] += time.perf_counter() - begin
                self.cpu[label] += time.process_time() - busy

        setattr(owner, name, timed)

    def close(self) -> None:
        """Leave the classes as they were."""
        for owner, name, method in self._restore:
            setattr(owner, name, method)
