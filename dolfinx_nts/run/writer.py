"""What a run asks of a writer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from dolfinx_nts.run.stepper import Stepper


class Writer(Protocol):
    """What `simulate(output=[...])` and `equilibrium` call, on all ranks.

    A writer need not derive from this class. What it finds in the stepper is the same as after the
    run: `stepper.state`, `stepper.solution.balance`, and `body.u` and `body.v` of
    `stepper.system.bodies`. What it raises, on whatever rank, ends the run with an
    `OutputError`.
    """

    def start(self, stepper: Stepper) -> Any:
        """Called once before the first step, with the state at the start."""

    def write(self, stepper: Stepper, *, last: bool = False) -> Any:
        """Called after every accepted step.

        Args:
            stepper: Its state is the one at the end of the step.
            last: Whether the run ends here as it was meant to.
        """

    def close(self, stepper: Stepper) -> Any:
        """Called once at the end, also of a run that failed: see `stepper.solution.status`."""
