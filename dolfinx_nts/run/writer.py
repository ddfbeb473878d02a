"""What a run asks of writers, and how it does on all ranks alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

from dolfinx_nts.parallel import first_problem
from dolfinx_nts.validation import items

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


def call_here(
    stepper: Stepper, output: Sequence[Writer], name: str, **options: Any
) -> tuple[str | None, Exception | None]:
    """Call a method of all writers, also when one raises: what the first raised here, and it."""
    problem, cause = None, None
    for k, writer in enumerate(output):
        try:
            getattr(writer, name)(stepper, **options)
        except Exception as error:  # any: a rank that raises alone would leave the others waiting
            if cause is None:
                what = f"output[{k}] ({type(writer).__name__}): {name}"
                what += f" at t={stepper.state.time!r} raised {error!r}"
                problem, cause = f"{what}; correct it, or leave this writer out", error
    return problem, cause


def call_writers(
    stepper: Stepper, output: Sequence[Writer], name: str, **options: Any
) -> tuple[str | None, Exception | None]:
    """`call_here` with the first problem of any rank, on all ranks alike. Collective."""
    problem, cause = call_here(stepper, output, name, **options)
    return first_problem(stepper.system.comm, problem), cause


def writers(output: Any) -> tuple[Writer, ...]:
    """The argument `output`, checked."""
    wanted = "writers of dolfinx_nts.output, or others with the Writer protocol"
    asked = "start", "write", "close"
    return items(
        "output", output, lambda w: all(callable(getattr(w, name, None)) for name in asked), wanted
    )
