"""PETSc SNES for a step, and attempts at it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.contact.contact_elements import UNSETTLED
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.elements import NO_DIRECTION
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.solve.accuracy import Newton
from dolfinx_nts.solve.convergence_test import ConvergenceTest
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
        self._test = ConvergenceTest(
            problem, newton, self._presets, self._tangents, self.iterates, self._upright
        )
        self._lent = LentStiffness(problem)
        self._laid: Unknowns | None = None
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
                found = self._repeats.of_least_norm(last, self._test.worst)
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
            self._test.patient = moves or not may_slip or retry != 0 or first < 0
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
            last = self._test.passed or self.iterates.at(self.problem.x)
            iterations += self.snes.getIterationNumber()
            # A solver of the user's may stop SNES by its own tests; ours decide.
            solved = last is self._test.passed or self._test.worst(last) <= 1.0
            reason = self.snes.getConvergedReason()
            if solved and reason > 0:
                dets = self._upright.smallest(last.x)
                if self._upright.accepts(dets):
                    return replace(last, iterations=iterations, min_det=float(dets.min()))
                reason = PETSc.SNES.ConvergedReason.DIVERGED_FUNCTION_DOMAIN
            unsolved = reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE
            if unsolved and (preset := self._presets.alternative(self.snes)) is not None:
                return self._attempt_otherwise(preset, iterations)
            # What has run off to infinity fails like that from then on, too.
            unsolved |= reason == petsc_compat.DIVERGED_NOT_FINITE
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
            unsolved: Whether the linear solver failed in that, or it ended at infinity.
        """
        self._upright.begin(careful=careful or self.problem.dives)
        if again:
            self._tangents.due, self._test.passed = True, None
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
        self._test.begin()
        self._lent.begin()
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
        return self._jacobian.assemble(e, self.snes, solved=self._test.solved)

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
        self.snes.setConvergenceTest(self._test)
        self.snes.setLineSearchPreCheck(self._check_update)
        self.snes.setTolerances(max_it=2 * self.newton.max_iterations)
        self._test.solved = False
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
            if self._lent.at(e, wanders=self._test.wanders):
                self._tangents.due = True
            self.assemble(e)

    def _check_update(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Hold prescribed coordinates, which a multigrid moves a little, and shorten updates."""
        y.array_w[self.problem.laid.held] = 0.0
        shortened = self._upright.shorten(x, y)
        return self.iterates.shorten(x, y) or shortened

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
