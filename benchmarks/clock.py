"""Wall time spent in methods of the package."""

from __future__ import annotations

import time
from typing import Any


class Clock:
    """Seconds spent in methods, while they are timed."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._restore: list[tuple[type, str, Any]] = []

    def time(self, label: str, owner: type, name: str) -> None:
        """Time a method of a class from now on."""
        method = getattr(owner, name)
        self._restore.append((owner, name, method))
        self.seconds[label] = 0.0

        def timed(*arguments: Any, **options: Any) -> Any:
            begin = time.perf_counter()
            try:
                return method(*arguments, **options)
            finally:
                self.seconds[label] += time.perf_counter() - begin

        setattr(owner, name, timed)

    def close(self) -> None:
        """Leave the classes as they were."""
        for owner, name, method in self._restore:
            setattr(owner, name, method)
