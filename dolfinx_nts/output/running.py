"""What writers and pictures read of a run, whoever steps it."""

from __future__ import annotations

from typing import Any, Protocol

from dolfinx_nts.arrays import FloatArray
from dolfinx_nts.state import State
from dolfinx_nts.system import System


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
