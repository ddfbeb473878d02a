"""A solved step before it is accepted: whether it has found all contacts, and where it ends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.ledger.impact import Impact
from dolfinx_nts.parallel import global_max
from dolfinx_nts.solve.newton import StepSolver
from dolfinx_nts.start.consistent import Fitted
from dolfinx_nts.state import State
from dolfinx_nts.validation import StepFailedError

FloatArray = npt.NDArray[np.float64]

#: Searches for contact, each along the motion that came of the one before.
_SEARCHES = 4


class Trial(NamedTuple):
    """A solved step that may be accepted.

    Attributes:
        step: Solution of its equations.
        state: State at its end.
        measured: `Ledger.measure` of that state.
        impulses: Of all forces in the step, see `check_momentum` [kg m/s].
        impact: What restoring did to its velocities.
        fitted: What made them those of its drives.
    """

    step: Evaluation
    state: State
    measured: Mapping[str, Any]
    impulses: float
    impact: Impact | None
    fitted: Fitted | None


def solved(problem: StepProblem, solver: StepSolver) -> Evaluation:
    """Solution of a step, sought again for as long as its motion may have passed by a contact.

    Args:
        problem: Equations of the step, which has begun.
        solver: Solves them.

    Raises:
        StepFailedError: Not solved, or no search found all contacts.
    """
    step = solver.solve()
    iterations = step.iterations
    for k in range(_SEARCHES + 1):
        if not problem.misses(step):
            return replace(step, iterations=iterations)
        if k < _SEARCHES:
            problem.begin(problem.state, problem.dt, step)
            step = solver.solve()
            iterations += step.iterations
    far = float(problem.lengths.motion_of(step).max())
    raise StepFailedError(
        f"step from t={problem.state.time:.6g} with dt={problem.dt:.3g}: bodies move by "
        f"{far:.3g}, and no search found all contacts on the way of their nodes; use a "
        "smaller dt",
        advises=True,
    )


def state_after(problem: StepProblem, step: Evaluation, time: float) -> State:
    """State at t_{n+1}. Collective.

    Args:
        problem: Equations of the step.
        step: Their solution.
        time: t_{n+1} [s].
    """
    old, dt = problem.state, problem.dt
    u, v, a = list(old.u), list(old.v), list(old.a)
    for k in problem.awake:
        u[k] = step.bodies[k].u1.copy()
        v[k], a1 = problem.supports.advance(k, step.bodies[k].du)
        if a1 is not None:
            a[k] = a1
        body = problem.system.bodies[k]
        if body.has_massless:
            # What has no momentum has no velocity of its own either.
            v[k][body.massless] = step.bodies[k].du[body.massless] / dt
    _keep_unchanged(problem, u, v)
    both = problem.couplings.each(step)
    contacts, *joints = (coupling.history(parts) for coupling, parts in both)
    return State(time, tuple(u), tuple(v), tuple(a), contacts, tuple(joints))


def _keep_unchanged(problem: StepProblem, u: list[FloatArray], v: list[FloatArray]) -> None:
    """Take bodies' arrays at t_n where all ranks find them unchanged. Collective.

    What is known of a body holds while its arrays are the same objects, on all ranks alike.
    """
    both = (u, problem.state.u), (v, problem.state.v)
    moved = [
        [float(not np.array_equal(now[k], before[k])) for k in range(len(u))]
        for now, before in both
    ]
    anywhere = global_max(problem.system.comm, np.array(moved))
    for (now, before), moves in zip(both, anywhere, strict=True):
        for k in np.flatnonzero(moves == 0.0):
            now[k] = before[k]
