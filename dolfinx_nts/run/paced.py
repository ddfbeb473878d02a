"""Advances a run in steps that are chosen by their error."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from dolfinx_nts.run.step_size import Pace
from dolfinx_nts.run.stepper import Stepper
from dolfinx_nts.validation import StepFailedError, UserFunctionError

logger = logging.getLogger(__name__)

#: What a step chosen by its error is cut to: halves would soon end where it has failed.
_CUT = 0.4


def paced(stepper: Stepper, pace: Pace, end: float) -> Iterator[None]:
    """Advance in steps of a pace, stopping after each.

    Args:
        stepper: What advances.
        pace: Sizes of the steps.
        end: Where to stop [s].

    Raises:
        StepFailedError: Not solved even after `newton.max_retries` cuts in a row, or as in
            `advance`.
    """
    stepper.system.check_alive()
    stepper.start(pace.dt)
    retries = 0
    while stepper.state.time < end:
        now = stepper.state.time
        left = end - now
        dt = pace.propose(left)
        try:
            stepper.begin(dt)
            part = pace.first_touch(stepper.problem)
            if part < 1.0:
                dt *= part
                stepper.begin(dt)
            trial = stepper.attempt(end if dt == left else now + dt)
        except UserFunctionError:
            raise
        except StepFailedError as failure:
            if retries == stepper.newton.max_retries:
                failure.part = dt / pace.longest
                raise
            retries += 1
            stepper.solution.retries += 1
            pace.dt = _CUT * dt
            logger.info("%s; retrying with dt=%.3g", failure, pace.dt)
            continue
        if not pace.accepts(stepper.problem, trial.step):
            stepper.solution.rejected += 1
            continue
        # Steps below the shortest do not reset the retries, else a run might go on with them.
        retries = 0 if dt >= pace.shortest else retries
        stepper.take(trial)
        if pace.exceeds:
            stepper.solution.exceeded += 1
            stepper.solution.warn(
                "step error", stepper.state.time, dt,
                f"a step of {dt:.3g} errs more than Adapt asks for: it is the shortest one, "
                "or it moves a node out from behind its facet; pass a smaller `shortest` or a "
                "larger `tolerance`",
            )  # fmt: skip
        yield
