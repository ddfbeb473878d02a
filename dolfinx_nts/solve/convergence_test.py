"""Whether SNES goes on: when an iterate is the solution, and when going on is in vain."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.petsc_compat import DIVERGED_NOT_FINITE
from dolfinx_nts.solve.accuracy import EXACT, Newton
from dolfinx_nts.solve.convergence import leaves_work, worst
from dolfinx_nts.solve.inversion_guard import InversionGuard
from dolfinx_nts.solve.iterates import Iterates
from dolfinx_nts.solve.jacobian_reuse import KeptTangents
from dolfinx_nts.solve.presets import Presets

#: Part of the residual that may be left after an iteration with matrices of an earlier iterate.
_SLOW = 0.05
#: A residual that keeps more than this part of itself in an iteration ...
_STALLED = 0.5
#: ... and is at most this many tolerances large may be the rounding of forces that have grown since
#: rounding was measured.
_NEAR = 1e4
#: In every so many-th iteration an iterate that is inside out ends the attempt: Newton's method
#: hardly ever comes back, and most steps never get there.
_INSIDE_OUT = 8
#: Iterations before an attempt whose contacts go to and fro ends, where another way is left.
_CYCLING = 8
#: Where residuals add up over steps, one above this part of its tolerance gets one more iteration.
_SURE = 0.05
#: The part of the tolerance by which work may be left where it has either sign.
_EITHER_SIGN = 0.02


class ConvergenceTest:
    """Called by SNES after each iteration; `begin` comes before each attempt at a step.

    Args:
        problem: Equations.
        newton: Tolerances.
        presets: Linear solvers, which learn from iterations.
        tangents: Of bodies, which are due where iterations are slow.
        iterates: Iterates of the step.
        upright: Watches cells.

    Attributes:
        passed: Iterate that satisfies all tolerances; None: none does yet.
        solved: Whether an iteration was made since this was last set to False.
        wanders: Whether the last iteration led no nearer.
        patient: Whether contacts may go to and fro for long.
    """

    def __init__(
        self, problem: StepProblem, newton: Newton, presets: Presets, tangents: KeptTangents,
        iterates: Iterates, upright: InversionGuard,
    ) -> None:  # fmt: skip
        self._problem, self._newton, self._presets = problem, newton, presets
        self._tangents, self._iterates, self._upright = tangents, iterates, upright
        self.passed: Evaluation | None = None
        self.solved, self.patient = False, True

    def begin(self) -> None:
        """Begin an attempt."""
        self.passed, self._measured, self._before = None, False, np.inf
        self.wanders = False

    def worst(self, e: Evaluation) -> float:
        """The worst part of an iterate over its tolerance. Collective."""
        return self._look(e)[0]

    def _look(self, e: Evaluation, *flags: bool) -> tuple[float, list[bool]]:
        """What `worst` finds. Collective."""
        with np.errstate(over="ignore", invalid="ignore"):
            found, flagged = worst(self._problem, e, *flags)
        # What contacts satisfy that are held as they are not is no solution.
        imposed = e is self._iterates.last and self._iterates.imposed
        return max(found, 2.0) if imposed else found, flagged

    def __call__(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int:
        """PETSc's reason to stop, or 0; every rank must call it."""
        last, x = self._iterates.last, snes.getSolution()
        assert last is not None
        reasons, elsewhere = PETSc.SNES.ConvergedReason, not np.array_equal(x.array_r, last.x)
        acts = any(bool(part.status.any()) for part in last.parts)
        found = self._look(last, not self._iterates.settled, elsewhere, acts)
        worst, (changed, elsewhere, acts) = found
        unchanged = not changed
        if not elsewhere:
            # Here SNES asks for the Jacobian next.
            self._iterates.known.append((x, x.stateGet()))
        if not np.isfinite(norms[2]) or not np.isfinite(worst):
            return DIVERGED_NOT_FINITE
        stalls = iteration > 0 and worst > max(1.0, _STALLED * self._before)
        if stalls and not self._measured:
            # An active set that still changes stalls by itself, not by rounding.
            if worst < _NEAR or (unchanged and not self._problem.rounding_is_known):
                longest = self._problem.lengths.displacement_of(last)
                self._problem.rounding.renew(self._problem.awake, longest)
                self._measured = True
                worst = self.worst(last)
        self.solved |= iteration > 0
        self._tangents.due |= unchanged and worst > max(1.0, _SLOW * self._before)
        if iteration > 0 and unchanged:
            self._presets.learn(worst, self._before)
        self.wanders = iteration > 0 and (not unchanged or worst > self._before)
        self._before = worst
        # Where friction of joints is blurred, iterates lead to a first guess, and have as many.
        allowed = self._newton.max_iterations
        allowed += min(self._iterates.led, allowed)
        if worst <= 1.0:
            enough = self.passed is not None or iteration >= allowed
            self.passed = last
            if enough or worst <= _SURE or not self._adds_up(last, acts):
                return reasons.CONVERGED_FNORM_RELATIVE
        elif self.passed is not None:
            # One more iteration left rounding only: what it started from is the solution.
            return reasons.CONVERGED_FNORM_RELATIVE
        late = iteration > 0 and iteration % _INSIDE_OUT == 0
        in_vain = self._iterates.runs_away or self._upright.gives_up
        # In statics what slides first hardly ever fails.
        # What has settled late converges.
        impatient = changed and not self.patient and iteration >= _CYCLING
        in_vain |= impatient and self._iterates.cycles
        if in_vain or (late and self._is_inside_out(last)):
            return reasons.DIVERGED_FUNCTION_DOMAIN
        if iteration >= allowed:
            return reasons.DIVERGED_MAX_IT
        self._presets.aim(snes, worst)
        return reasons.ITERATING

    def _is_inside_out(self, e: Evaluation) -> bool:
        return not self._upright.accepts(self._upright.smallest(e.x))

    def _adds_up(self, e: Evaluation, acts: bool) -> bool:
        """Whether what an iteration leaves adds up over steps; every rank must call it.

        Kept matrices leave the same part of a smooth motion in each step, whose work has one sign;
        where contact acts, the parts differ, and only what is much in one step counts.

        Args:
            e: Iterate that may be the solution.
            acts: Whether any contact acts in it.
        """
        problem, rtol = self._problem, self._newton.rtol
        if self._presets.keeps and (rtol <= EXACT or not acts):
            return True
        # Where nothing has inertia there is no ledger.
        return problem.integrator.inertia and leaves_work(problem, e, _EITHER_SIGN * rtol)
