"""PETSc SNES for a step: attempts at it, and when it counts as solved."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.contact.contact_elements import UNSETTLED
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.elements import NO_DIRECTION
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.solve.accuracy import EXACT, Newton
from dolfinx_nts.solve.convergence import leaves_work, worst
from dolfinx_nts.solve.failure import contact_on, diagnosis, used_up
from dolfinx_nts.solve.inversion_guard import InversionGuard
from dolfinx_nts.solve.iterates import Iterates
from dolfinx_nts.solve.lent_stiffness import LentStiffness
from dolfinx_nts.solve.presets import Presets
from dolfinx_nts.solve.redundancy import Redundancy
from dolfinx_nts.solve.step_jacobian import StepJacobian
from dolfinx_nts.types import Options
from dolfinx_nts.validation import StepFailedError

logger = logging.getLogger(__name__)


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


class StepSolver:
    """SNES for a `StepProblem`; PETSc objects live as long as the layout of the unknowns.

    Args:
        problem: Equations; `problem.begin` comes before each `solve`.
        newton: Tolerances.
        preset: Of the linear solver, to begin with.
        petsc_options: PETSc options of the SNES without prefix; they override the preset.

    Attributes:
        iterates: Iterates of the step.
        snes: The PETSc SNES, after `prepare`.
    """

    def __init__(
        self, problem: StepProblem, newton: Newton, preset: str, petsc_options: Options
    ) -> None:
        self.problem, self.newton = problem, newton
        self._presets = Presets(
            problem.system, newton, preset, petsc_options, problem.condense,
            problem.integrator.inertia,
        )  # fmt: skip
        self._jacobian = StepJacobian(problem, self._presets)
        self._tangents = self._jacobian.tangents
        self.iterates, self._upright = Iterates(problem), InversionGuard(problem)
        self._lent, self._wanders = LentStiffness(problem), False
        self._passed: Evaluation | None = None
        self._laid: Unknowns | None = None
        self._solved, self._patient = False, True
        self._raised: StepFailedError | None = None
        self._repeats = Redundancy(problem)
        self.snes: PETSc.SNES = None

    @property
    def memory(self) -> tuple[Any, ...]:
        """What the next step takes from those before it, for a run that goes on.

        Of `Presets`, and whether constraints of joints repeat each other, as the first step found.
        """
        return *self._presets.memory, self._repeats.independent

    def resume(self, memory: Sequence[Any]) -> None:
        """Go on from another run's memory, before the first step."""
        *of_presets, self._repeats.independent = memory
        self._presets.resume(of_presets)

    def forget(self) -> None:
        """Make all matrices anew in the next step, as a run does that goes on from here."""
        self._tangents.due = True
        self._presets.forget()

    def solve(self) -> Evaluation:
        """Solve the step that `problem.begin` fixed.

        Raises:
            StepFailedError: Not converged; names the worst block, node, facet and flips.
            ValueError: PETSc does not know an option or its value.
        """
        iterations = 0
        if self._presets.first_is_due():
            self.destroy()
            self._presets.use(0)
        while True:
            last = self._attempt()
            iterations += last.iterations
            if not self.problem.wake(last):
                found = self._repeats.of_least_norm(last, self._worst)
                return replace(found, iterations=iterations)

    def _attempt(self) -> Evaluation:
        """Solve the step with the candidates that have unknowns."""
        self.prepare()
        iterations, unsolved = 0, False
        contacts, moves = self.problem.couplings.contacts, self.problem.integrator.inertia
        may_slip = contacts.may_slip
        starts = not moves and bool(contacts.elements) and not contacts.carried_any()
        # Inertia passes on the forces that sticking nodes keep from each other in statics.
        first = -1 if may_slip and starts else 0
        for retry in range(first, 2):
            if first < 0 == retry and not self.iterates.runs_away:
                continue
            slides = may_slip and retry == (-1 if first < 0 else 1)
            self._patient = moves or not may_slip or retry != 0 or first < 0
            # Where nothing carries yet, too many nodes touch at first and press cells flat.
            careful = retry != first + 1 if starts else retry > 0
            self._begin(retry, careful, slides=slides, again=retry > first, unsolved=unsolved)
            try:
                self._raised = None
                self._presets.options.check(self.snes, *self._jacobian.operators)
                self.snes.solve(None, self.problem.x)
            except PETSc.Error as error:
                # E.g. a factorisation of redundant constraints; what it leaves is not to be used.
                self._tangents.due = True
                iterations += self.snes.getIterationNumber()
                self.destroy()
                if self._raised is not None:
                    # Newer versions of petsc4py put an error of their own in its place.
                    raise self._raised from error
                if (preset := self._presets.alternative()) is not None:
                    return self._attempt_otherwise(preset, iterations)
                state = self.problem.state
                raise StepFailedError(
                    f"step from t={state.time:.6g} with dt={self.problem.dt:.3g}: PETSc stopped "
                    f"with error {error.ierr}{self._presets.with_options}; two contacts, or a "
                    "contact and a support, may hold the same nodes"
                ) from error
            self._lent.begin()
            last = self._passed or self.iterates.at(self.problem.x)
            iterations += self.snes.getIterationNumber()
            # A solver of the user's may stop SNES by its own tests; ours decide.
            solved = last is self._passed or self._worst(last) <= 1.0
            reason = self.snes.getConvergedReason()
            if solved and reason > 0:
                dets = self._upright.smallest(last.x)
                if self._upright.accepts(dets):
                    return replace(last, iterations=iterations, min_det=float(dets.min()))
                reason = PETSc.SNES.ConvergedReason.DIVERGED_FUNCTION_DOMAIN
            unsolved = reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE
            if unsolved and (preset := self._presets.alternative(self.snes)) is not None:
                return self._attempt_otherwise(preset, iterations)
        self._tangents.due = True
        failure = self._failure(last, reason, iterations)
        if unsolved:
            self.destroy()
        raise failure

    def _begin(
        self, retry: int, careful: bool, *, slides: bool, again: bool, unsolved: bool
    ) -> None:
        """Begin an attempt at the step; every rank must call it.

        Args:
            retry: Number of the attempt; -1 comes before 0 where statics with friction begin.
            careful: Whether updates are shortened that would turn cells inside out.
            slides: Whether nodes slide in it before they rub.
            again: Whether there was another one before.
            unsolved: Whether the linear solver failed in that.
        """
        self._upright.begin(careful=careful or self.problem.dives)
        if again:
            self._tangents.due, self._passed = True, None
            if retry == 0:
                self.problem.first_guess()
            else:
                self.problem.couplings.forget_solution()
                self.problem.guess(flight=False, forces=False)
            if unsolved:
                # What failed to factorise once fails from then on.
                self.destroy()
                self.prepare()
            self.iterates.try_again(pivots=retry > 0)
        if slides:
            self.iterates.slide_first()

    def _attempt_otherwise(self, preset: int, iterations: int) -> Evaluation:
        """Solve the step anew, after the linear solver failed or took too long.

        Args:
            preset: Number of what is to solve it, see `Presets.alternative`.
            iterations: Iterations that were in vain.
        """
        self._tangents.due = True
        self.destroy()
        before = self._presets.name
        self._presets.use(preset)
        if self._presets.name != before:
            name, time = self._presets.name, self.problem.state.time
            logger.info("t=%.6g: linear solver %r for the next steps", time, name)
        self.problem.first_guess()
        last = self._attempt()
        return replace(last, iterations=iterations + last.iterations)

    def prepare(self) -> None:
        """Make SNES and matrices ready for the current step."""
        self.iterates.restart()
        self._passed, self._measured, self._before = None, False, np.inf
        self._lent.begin()
        self._wanders = False
        self._tangents.begin()
        if self._laid is not self.problem.laid:
            self.destroy()
            self.assemble(self.iterates.at(self.problem.x))
            self._configure()
            self._laid = self.problem.laid

    def assemble(self, e: Evaluation) -> StepMatrix:
        """Jacobian at an iterate, as SNES sees it. Every rank must call it.

        The bodies' parts may be of an earlier iterate, see `Newton.reuse`.
        """
        return self._jacobian.assemble(e, self.snes, solved=self._solved)

    @property
    def matrix(self) -> StepMatrix | None:
        """Jacobian as SNES sees it, after `assemble`."""
        return self._jacobian.matrix

    def _configure(self) -> None:
        petsc_compat.free_dropped(self.problem.system.comm)  # what earlier runs left
        self.snes = PETSc.SNES().create(self.problem.system.comm)
        self._f = self.problem.x.duplicate()
        self.snes.setFunction(self._function, self._f)
        self.snes.setJacobian(self._at_iterate, *self._jacobian.operators)
        self.snes.setConvergenceTest(self._converged)
        self.snes.setLineSearchPreCheck(self._check_update)
        self.snes.setTolerances(max_it=2 * self.newton.max_iterations)
        self._solved = False
        self._jacobian.configure(self.snes)

    # ---- SNES callbacks
    def _function(self, _snes: Any, x: PETSc.Vec, f: PETSc.Vec) -> None:
        try:
            f.array_w[:] = self.problem.residual(self.iterates.at(x))
        except StepFailedError as error:
            self._raised = error
            raise

    def _at_iterate(self, _snes: Any, x: PETSc.Vec, _j: Any, _p: Any) -> None:
        e = self.iterates.at(x)
        if e is not self._jacobian.assembled:
            if self._lent.at(e, wanders=self._wanders):
                self._tangents.due = True
            self.assemble(e)

    def _check_update(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Hold prescribed coordinates, which a multigrid moves a little, and shorten updates."""
        y.array_w[self.problem.laid.held] = 0.0
        return self._upright.shorten(x, y)

    def _worst(self, e: Evaluation) -> float:
        return self._look(e)[0]

    def _look(self, e: Evaluation, *flags: bool) -> tuple[float, list[bool]]:
        """What `worst` finds. Collective."""
        with np.errstate(over="ignore", invalid="ignore"):
            found, flagged = worst(self.problem, e, *flags)
        # What contacts satisfy that are held as they are not is no solution.
        imposed = e is self.iterates.last and self.iterates.imposed
        return max(found, 2.0) if imposed else found, flagged

    def _converged(self, snes: Any, iteration: int, norms: tuple[float, float, float]) -> Any:
        last, x = self.iterates.last, snes.getSolution()
        assert last is not None
        reasons, elsewhere = PETSc.SNES.ConvergedReason, not np.array_equal(x.array_r, last.x)
        acts = any(bool(part.status.any()) for part in last.parts)
        found = self._look(last, not self.iterates.settled, elsewhere, acts)
        worst, (changed, elsewhere, acts) = found
        unchanged = not changed
        if not elsewhere:
            # Here SNES asks for the Jacobian next.
            self.iterates.known.append((x, x.stateGet()))
        if not np.isfinite(norms[2]) or not np.isfinite(worst):
            return reasons.DIVERGED_FNORM_NAN
        stalls = iteration > 0 and worst > max(1.0, _STALLED * self._before)
        if stalls and not self._measured:
            # An active set that still changes stalls by itself, not by rounding.
            if worst < _NEAR or (unchanged and not self.problem.rounding_is_known):
                longest = self.problem.lengths.displacement_of(last)
                self.problem.rounding.renew(self.problem.awake, longest)
                self._measured = True
                worst = self._worst(last)
        self._solved |= iteration > 0
        self._tangents.due |= unchanged and worst > max(1.0, _SLOW * self._before)
        if iteration > 0 and unchanged:
            self._presets.learn(worst, self._before)
        self._wanders = iteration > 0 and (not unchanged or worst > self._before)
        self._before = worst
        # Where friction of joints is blurred, iterates lead to a first guess, and have as many.
        allowed = self.newton.max_iterations
        allowed += min(self.iterates.led, allowed)
        if worst <= 1.0:
            enough = self._passed is not None or iteration >= allowed
            self._passed = last
            if enough or worst <= _SURE or not self._adds_up(last, acts):
                return reasons.CONVERGED_FNORM_RELATIVE
        elif self._passed is not None:
            # One more iteration left rounding only: what it started from is the solution.
            return reasons.CONVERGED_FNORM_RELATIVE
        late = iteration > 0 and iteration % _INSIDE_OUT == 0
        in_vain = self.iterates.runs_away or self._upright.gives_up
        # In statics what slides first hardly ever fails.
        in_vain |= not self._patient and iteration >= _CYCLING and self.iterates.cycles
        if in_vain or (late and self._is_inside_out(last)):
            return reasons.DIVERGED_FUNCTION_DOMAIN
        if iteration >= allowed:
            return reasons.DIVERGED_MAX_IT
        self._presets.aim(self.snes, worst)
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
        problem, rtol = self.problem, self.newton.rtol
        if self._presets.keeps and (rtol <= EXACT or not acts):
            return True
        # Where nothing has inertia there is no ledger.
        return problem.integrator.inertia and leaves_work(problem, e, _EITHER_SIGN * rtol)

    # ---- failure
    def _failure(self, e: Evaluation, reason: int, iterations: int) -> StepFailedError:
        """What failed, and where a body is inside out or nearly so; every rank must call it."""
        problem, slides = self.problem, used_up(self.problem, e)
        refused = reason == PETSc.SNES.ConvergedReason.DIVERGED_FUNCTION_DOMAIN
        if refused and not self._upright.is_sound(e.x):
            worst, text = self._upright.describe_inverted(e.x)
            text = contact_on(problem, e, self.iterates.flips, worst) + text
            return StepFailedError(
                f"{slides}step from t={problem.state.time:.6g} with dt={problem.dt:.3g} not solved "
                f"after {iterations} iterations: {text}",
                advises=True,
            )
        why, advises = self._presets.why_failed(self.snes, reason)
        if refused:
            # Its cells are sound: what ended the attempt is what its updates were about to do.
            why = "nodes slide away that friction does not hold"
            if self._upright.gives_up:
                why = self._upright.describe_shortened()
        message = slides + diagnosis(problem, e, self.iterates.flips, why, iterations)
        advises |= bool(slides) or any(word in message for word in (UNSETTLED, NO_DIRECTION))
        return self.with_flat(message, e, advises=advises)

    def with_flat(self, message: str, e: Evaluation, *, advises: bool = False) -> StepFailedError:
        """A failure that also names the cell that is nearly inside out, if one is. Collective.

        Args:
            message: What failed.
            e: Where.
            advises: Whether that tells what to do.
        """
        flat = self._upright.describe_flat(e.x)
        if flat:
            worst, text, sure = flat
            text = contact_on(self.problem, e, self.iterates.flips, worst) + text
            return StepFailedError(f"{message}; {text}", advises=advises or sure)
        return StepFailedError(message, advises=advises)

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        self._presets.options.remove()
        self._jacobian.destroy()
        if self.snes is not None:
            self.snes.destroy()
            self._f.destroy()
            self.snes = None
        self._laid = None
