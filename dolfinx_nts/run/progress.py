"""What a run shows while it goes on: a bar of its steps, and that forms are being compiled."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from dolfinx_nts import dolfinx_compat


class _Lines(logging.Handler):
    """Writes messages above a bar, equal ones once."""

    def __init__(self, bar: Any) -> None:
        super().__init__()
        self._bar, self._written = bar, set[str]()

    def emit(self, record: logging.LogRecord) -> None:
        """Write one of them."""
        text = record.getMessage()
        if text not in self._written:
            self._bar.write(text)
        self._written.add(text)


@contextmanager
def progress_bar(steps: int | None, wanted: bool) -> Iterator[Any]:
    """A bar of tqdm, which tells of what is compiled meanwhile, too; None where it is not wanted.

    Args:
        steps: Their number, if it is known.
        wanted: Whether there is to be one on this rank.
    """
    if not wanted:
        yield None
        return
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    logger = dolfinx_compat.logger
    level, propagate = logger.level, logger.propagate
    with logging_redirect_tqdm(), tqdm(total=steps, unit="step") as bar:
        lines = _Lines(bar)
        if not logger.isEnabledFor(logging.INFO):  # else the user's own handler tells it
            logger.addHandler(lines)
            logger.setLevel(logging.INFO)
            logger.propagate = False
        try:
            yield bar
        finally:
            logger.removeHandler(lines)
            logger.setLevel(level)
            logger.propagate = propagate
