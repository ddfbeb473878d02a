"""SIGINT and SIGTERM end a run after the step that is being made, on whatever rank they arrive."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

from mpi4py import MPI


class Interrupted(Exception):
    """A signal came within a step, by its name."""


class Interrupts:
    """Notes the first signal while entered; a second one does what it did before.

    Outside of the main thread Python lets no one handle signals, and those that are ignored, as
    SIGINT in a job that a shell keeps in the background, stay so.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm, self._number, self._told = comm, 0, False
        self._old: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                # None: something other than Python handles it.
                if signal.getsignal(number) not in (None, signal.SIG_IGN):
                    self._old[number] = signal.signal(number, self._note)
        return self

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._number = number
        self._restore()
        if self._comm.size > 1 and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            # A rank that raises alone would wait for the others at its end.
            signal.signal(signal.SIGINT, signal.SIG_DFL)

    def _restore(self) -> None:
        for number, old in self._old.items():
            signal.signal(number, old)

    def seen(self) -> str | None:
        """Name of a signal that has come to any rank, on all ranks. Collective."""
        found = self._comm.allreduce(self._number, op=MPI.MAX)
        self._told = found > 0
        return signal.Signals(found).name if found else None

    def check(self) -> None:
        """Raise `Interrupted` where a signal has come to any rank. Collective."""
        name = self.seen()
        if name is not None:
            raise Interrupted(name)

    def __exit__(self, *_: object) -> None:
        self._restore()
        if self._number and not self._told:
            # It came after the last step: who started the run is to know.
            os.kill(os.getpid(), self._number)
