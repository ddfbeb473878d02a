"""A step that is tried, and what the last ones leave behind."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.ledger.impact import Impact
from dolfinx_nts.parallel import global_max
from dolfinx_nts.solve.newton import StepSolver
from dolfinx_nts.start.consistent import Fitted
from dolfinx_nts.state import State
from dolfinx_nts.types import BalanceRow, FloatArray
from dolfinx_nts.validation import StepFailedError

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
    measured: BalanceRow
    impulses: float
    impact: Impact | None
    fitted: Fitted | None


def solved(problem: StepProblem, solver: StepSolver) -> Evaluation:
    """Solution of a step, sought again for as long as its motion may have passed by a contact.

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
    """State at t_{n+1}. Collective."""
    old, dt, batches = problem.state, problem.dt, problem.batches
    ends = [
        problem.supports.advance(of[0], terms.du, v0, a0)
        for of, terms, v0, a0 in zip(batches.numbers, step.terms, *batches.rates(old), strict=True)
    ]
    for body, terms, (v1, _) in zip(batches.bodies, step.terms, ends, strict=True):
        if body.has_massless:
            # What has no momentum has no velocity of its own either.
            v1[body.massless] = terms.du[body.massless] / dt
    places = [terms.u1.copy() for terms in step.terms]
    speeds = [v1 for v1, _ in ends]
    moved, sped = _moves(problem, places, speeds)
    moved[[body.has_inner for body in problem.system.bodies]] = 1.0
    u = _renewed(old.u, batches.split(places), moved)
    v, a = _renewed(old.v, batches.split(speeds), sped), old.a
    if a:
        found = batches.split([a1 for _, a1 in ends if a1 is not None])
        a = _renewed(a, found, problem.is_awake)
    system, awake = problem.system, problem.is_awake
    inner = system.inner_of(
        lambda k: system.bodies[k].inner(u[k]) if awake[k] else old.inner[k]
    )
    return State(time, u, v, a, *problem.couplings.history(step), inner=inner)


def _renewed(
    old: tuple[FloatArray, ...], new: tuple[FloatArray, ...], chosen: Any
) -> tuple[FloatArray, ...]:
    """Values of bodies, new ones of those chosen, (bodies,)."""
    if chosen.all():
        return new
    both = zip(old, new, chosen.tolist(), strict=True)
    return tuple(after if renew else before for before, after, renew in both)


def _moves(problem: StepProblem, *ends: Sequence[FloatArray]) -> FloatArray:
    """Of u and v of batches at t_{n+1} which bodies' differ on any rank, (2, bodies). Collective.

    What is known of a body holds while its arrays are the same objects, on all ranks alike.
    """
    batches, out = problem.batches, np.zeros((2, problem.batches.count))
    for row, before, now in zip(out, (problem.state.u, problem.state.v), ends, strict=True):
        both = zip(batches.join(before), now, strict=True)
        row[:] = batches.largest([(a != b).astype(float) for a, b in both])
    return global_max(batches.comm, out * problem.is_awake)


class LastSteps:
    """The last step, and contact forces of the last two.

    Attributes:
        last: Start and length of the last step [s], or None.
    """

    def __init__(self) -> None:
        self.last: tuple[float, float] | None = None
        self._recent: deque[tuple[float, tuple[FloatArray, ...]]] = deque(maxlen=2)

    def take(self, before: State, dt: float, after: State) -> None:
        """Remember an accepted step.

        Args:
            before: State at its start.
            dt: Its length, as its equations had it [s].
            after: State at its end.
        """
        self.last = before.time, dt
        self._recent.append((after.time - before.time, _forces(after)))

    def mean_force(self, k: int) -> FloatArray | None:
        """Contact force p_N [N] of contact k in the mean of the last two steps; None before any."""
        if not self._recent:
            return None
        steps, forces = zip(*self._recent, strict=True)
        return np.average([force[k] for force in forces], axis=0, weights=steps)

    @property
    def lengths(self) -> list[float]:
        """Of the last two steps [s]."""
        return [dt for dt, _ in self._recent]

    @property
    def force_before(self) -> tuple[FloatArray, ...] | None:
        """p_N [N] of each contact in the step before the last; None without one."""
        return self._recent[0][1] if len(self._recent) > 1 else None

    def resume(
        self, memory: Mapping[str, Any], nodal: Mapping[str, Any], state: State
    ) -> None:
        """Remember what a checkpoint holds, see `RunMemory`."""
        forces = [tuple(nodal["force_before"])] if "force_before" in nodal else []
        forces.append(_forces(state))
        self._recent.extend(zip(memory["recent"], forces, strict=False))
        if memory["last"] is not None:
            start, length = memory["last"]
            self.last = start, length


def _forces(state: State) -> tuple[FloatArray, ...]:
    return tuple(contact.force for contact in state.contacts)
