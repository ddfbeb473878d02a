"""Lets another program take over a script's calls of `simulate`, so that studies run any scene."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_waiting: list[Callable[..., Any]] = []


@contextmanager
def intercept(run: Callable[..., Any]) -> Iterator[None]:
    """Let `run` take the place of `simulate` within, however a script has imported it.

    Args:
        run: Called with `simulate` and the arguments that this was called with; what it
            returns is the result. The `simulate` that it is given, and calls within, are the real
            ones.
    """
    _waiting.append(run)
    try:
        yield
    finally:
        _waiting.remove(run)


def interceptable(function: F) -> F:
    """Decorate a function so that `intercept` may take its calls."""

    @functools.wraps(function)
    def called(*args: Any, **options: Any) -> Any:
        if not _waiting:
            return function(*args, **options)
        run = _waiting.pop()
        try:
            return run(function, *args, **options)
        finally:
            _waiting.append(run)

    made: Any = called
    return made
