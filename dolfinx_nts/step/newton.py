"""PETSc SNES for a step: nested Jacobian, convergence per block."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from dolfinx_nts.bodies.inversion import describe, forbidden, smallest_dets
from dolfinx_nts.step.accuracy import Newton
from dolfinx_nts.step.assembly import StepMatrix
from dolfinx_nts.step.diagnosis import diagnosis
from dolfinx_nts.step.evaluation import Evaluation
from dolfinx_nts.step.least_norm import NullSpace, form_tree
from dolfinx_nts.step.linear_solver import (
    SolverOptions,
    keep_bodies,
    most_iterations,
    set_schur,
    take_bodies,
)
from dolfinx_nts.step.problem import StepProblem
from dolfinx_nts.step.unknowns import Unknowns
from dolfinx_nts.validation import StepFailedError, UserFunctionError

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]

#: Relative difference of the factors of two equal steps of a caller whose lengths are rounded.
_EQUAL = 1e-6
#: Part of the residual that may be left after an iteration with matrices of an earlier iterate.
_SLOW = 0.05
#: A residual that keeps more than this part of itself in an iteration ...
_STALLED = 0.5
#: ... and is at most this many tolerances large may be the rounding of forces that have grown since
#: rounding was measured.
_NEAR = 1e4
#: Part of the tolerance that an iteration aims at if it may be the last: a step that only just
#: converges would leave its whole tolerance to the ledger, where factors leave rounding.
_AIM = 1e-3
#: Range of the linear solver's tolerance that is worth it.
_FINE, _COARSE = 1e-12, 1e-5
#: Its tolerance with kept matrices, with which an iteration gains two or three digits anyway.
_KEPT = 1e-3
#: An update that would leave less than this part of the smallest det F of a body is halved, ...
_KEPT_DET = 0.1
#: ... so often at most, ...
_HALVINGS = 10
#: ... and in so many iterations in a row before the step is dropped.
_SHORTENED = 5
_AGAINST_INVERSION = "smaller loads, a finer mesh or another energy may prevent it"
#: In every so many-th iteration an iterate that is inside out ends the attempt: Newton's method
#: hardly ever comes back, and most steps never get there.
_INSIDE_OUT = 8
#: An iteration from a residual of this many tolerances, or less, may be the last.
_LAST = 1e5
#: Where residuals add up over steps, one above this part of its tolerance gets one more iteration.
_SURE = 0.05
#: Steps before the first linear solver is tried again, at the price of about one of them.
_PATIENCE = 10


class StepSolver:
    """SNES for a `StepProblem`; PETSc objects live as long as the layout of the unknowns.

    Args:
        problem: Equations; `problem.begin` comes before each `solve`.
        newton: Tolerances.
        preset: Of the linear solver, to begin with.
        petsc_options: PETSc options of the SNES without prefix; they override the preset.

    Attributes:
        matrix: Nested Jacobian and the form of it that SNES sees, after `assemble`.
        snes: The PETSc SNES, after `prepare`.
    """

    def __init__(
        self, problem: StepProblem, newton: Newton, preset: str, petsc_options: Mapping[str, Any]
    ) -> None:
        self.problem, self.newton, self._given = problem, newton, petsc_options
        # What takes over where a linear solve fails: in turn MUMPS, and MUMPS without what repeats.
        mumps: tuple[str, ...] = ("direct", "null-pivots")
        if any(pair.redundant for pair in problem.system.contacts):
            mumps = ("redundant", "null-pivots")
        own = petsc_options.keys() & {"ksp_type", "pc_type", "pc_factor_mat_solver_type"}
        self._presets: tuple[str, ...] = ("krylov",)
        if preset == "direct":
            self._presets = mumps[:1] if own else mumps
        elif newton.linear_solver == "auto":
            self._presets += mumps
        self._chosen, self._patience = 0, 0
        self._options = self._solver_options()
        self._version, self._factor = -1, 0.0
        self._matrices_due, self._solved = True, False
        self._bodies: dict[int, Any] = {}
        self._assembled: Evaluation | None = None
        self._last: Evaluation | None = None
        self._passed: Evaluation | None = None
        self._careful, self._shortened = False, 0
        self._raised: UserFunctionError | None = None
        self._dets: dict[int, tuple[FloatArray, float]] = {}
        joints = problem.system.joint_bodies[: len(problem.system.declared_joints)]
        self._independent: bool | None = True if form_tree(joints) else None
        self.matrix: StepMatrix | None = None
        self.snes: Any = None

    def _solver_options(self) -> SolverOptions:
        system, preset = self.problem.system, self._presets[self._chosen]
        weighed = preset == "krylov" and self.newton.linear_solver == "auto"
        limit = most_iterations(system.size) if weighed else None
        return SolverOptions(system.comm, preset, self.problem.condense, self._given, limit)

    def _use(self, chosen: int) -> None:
        """Solve with another preset from now on."""
        self.destroy()
        self._chosen = chosen
        self._options = self._solver_options()

    def solve(self) -> Evaluation:
        """Solve the step that `problem.begin` fixed.

        Raises:
            StepFailedError: Not converged; names the worst block, node, facet and flips.
            ValueError: PETSc does not know an option or its value.
        """
        iterations = 0
        if self._chosen > 0:
            self._patience -= 1
            if self._patience < 0:
                self._use(0)
        while True:
            last = self._attempt()
            iterations += last.iterations
            if not self.problem.wake(last):
                return replace(self._of_least_norm(last), iterations=iterations)

    def _attempt(self) -> Evaluation:
        """Solve the step with the candidates that have unknowns."""
        self.prepare()
        assert self.matrix is not None
        iterations, unsolved = 0, False
        # Without friction there is nothing to let slip.
        for retry in range(3 if self.problem.may_slip else 2):
            self._careful, self._shortened = retry > 0, 0
            if retry:
                self._matrices_due, self._passed = True, None
                if retry == 2:
                    self.problem.let_slip()
                self.problem.guess(flight=False)
                self._last = None
                if unsolved:
                    # What failed to factorise once fails from then on.
                    self.destroy()
                    self.prepare()
            try:
                self._options.check(self.snes, self.matrix.operator)
                self.snes.solve(None, self.problem.x)
            except PETSc.Error as error:
                # E.g. a factorisation of redundant constraints; what it leaves is not to be used.
                self._matrices_due = True
                iterations += self.snes.getIterationNumber()
                self.destroy()
                if self._raised is not None:
                    # Newer versions of petsc4py put an error of their own in its place.
                    raise self._raised from error
                if self._chosen < len(self._presets) - 1:
                    return self._attempt_otherwise(iterations)
                state = self.problem.state
                raise StepFailedError(
                    f"step from t={state.time:.6g} with dt={self.problem.dt:.3g}: PETSc stopped "
                    f"with error {error.ierr}{self._with_options()}; two contacts, or a contact "
                    "and a support, may hold the same nodes"
                ) from error
            last = self._passed or self._at(self.problem.x)
            iterations += self.snes.getIterationNumber()
            # A solver of the user's may stop SNES by its own tests; ours decide.
            solved = last is self._passed or self._worst(last) <= 1.0
            reason = self.snes.getConvergedReason()
            if solved and reason > 0:
                dets = self._smallest_dets(self._displacements(last.x))
                if (forbidden(self.problem.system, dets) > 0.0).all():
                    return replace(last, iterations=iterations, min_det=float(dets.min()))
                reason = PETSc.SNES.ConvergedReason.DIVERGED_FUNCTION_DOMAIN
            unsolved = reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE
            if unsolved and self._chosen < len(self._presets) - 1:
                return self._attempt_otherwise(iterations)
        self._matrices_due = True
        message = self._failure(last, reason, iterations)
        if unsolved:
            self.destroy()
        raise StepFailedError(message)

    def _of_least_norm(self, solved: Evaluation) -> Evaluation:
        """The solution with multipliers of least norm, where constraints repeat each other."""
        problem = self.problem
        if self._independent:
            return solved
        space = NullSpace(problem.system.comm, problem.elements, problem.bodies, solved.parts)
        if self._independent is None:
            self._independent = space.is_empty()
            if self._independent:
                return solved
        here = problem.of_constraints
        with problem.x as x:
            x[here] = solved.x[here] - space.part(solved.x[here])
        e = problem.evaluate(problem.x)
        # An element of the user's own may have a compliance.
        return replace(e, min_det=solved.min_det) if self._worst(e) <= 1.0 else solved

    def _attempt_otherwise(self, iterations: int) -> Evaluation:
        """Solve the step with the next preset, after the linear solver failed or took too long."""
        self._matrices_due, self._patience = True, _PATIENCE
        self._use(self._chosen + 1)
        name, time = self._presets[self._chosen], self.problem.state.time
        logger.info("t=%.6g: linear solver %r for the next %d steps", time, name, _PATIENCE)
        self.problem.guess(flight=True)
        last = self._attempt()
        return replace(last, iterations=iterations + last.iterations)

    def renew(self) -> None:
        """Make the bodies' matrices anew, after others have used them."""
        self._matrices_due = True

    def prepare(self) -> None:
        """Make SNES and matrices ready for the current step."""
        self._last = self._passed = None
        self._measured = False
        self._flips: list[IntArray] = []
        self._before = np.inf
        changed = abs(self.problem.factor / self._factor - 1.0) if self._factor else np.inf
        self._matrices_due |= not self.newton.reuse or changed > _EQUAL
        self._factor = self.problem.factor
        if self._version != self.problem.version:
            self.destroy()
            self._version = self.problem.version
            self.assemble(self._at(self.problem.x))
            self._configure()

    def assemble(self, e: Evaluation) -> StepMatrix:
        """Nested Jacobian at an iterate, and what SNES sees of it. Every rank must call it.

        The bodies' parts may be of an earlier iterate, see `Newton.reuse`.
        """
        fresh, new, awake = self._matrices_due, self.matrix is None, self.problem.awake
        if fresh:
            self._bodies = dict(zip(awake, self.problem.body_tangents(e), strict=True))
            self._matrices_due = not self.newton.reuse
        for k in awake:
            if k not in self._bodies:
                self._bodies[k] = self.problem.body_tangent(k, e.bodies[k].u1)
        if self.matrix is None:
            self.matrix = StepMatrix(
                self._laid.layout,
                [self._bodies[k] for k in awake],
                self._laid.blocks,
                split=self._options.split,
                blocked=self._options.blocked,
            )
        elif self._solved and self.newton.reuse and self._laid.own:
            keep_bodies(self.snes, not fresh)
        if fresh or new or self._laid.blocks:
            tangents = [part.tangent for part in e.parts] if self._laid.blocks else []
            self.matrix.assemble(tangents, fresh=fresh)
        if self.snes is not None:
            self._refresh_schur()
        self._assembled = e
        return self.matrix

    def _configure(self) -> None:
        assert self.matrix is not None
        self.snes = PETSc.SNES().create(self.problem.system.comm)
        self._f = self.problem.x.duplicate()
        self.snes.setFunction(self._function, self._f)
        self.snes.setJacobian(self._jacobian, self.matrix.operator, self.matrix.operator)
        self.snes.setConvergenceTest(self._converged)
        self.snes.setLineSearchPreCheck(self._shorten)
        self.snes.setTolerances(max_it=self.newton.max_iterations)
        contact = self.matrix if self._laid.own else None
        self._solved = False
        ours = self._options.blocked and self.problem.system.comm.size > 1
        bodies = self.matrix.whole_bodies() if ours else None
        whole = bodies is not None
        self._options.configure(self.snes, contact, len(self.problem.awake), whole=whole)
        self._refresh_schur()
        if bodies is not None:
            take_bodies(self.snes, self.matrix.operator, bodies, contact is not None)

    def _refresh_schur(self) -> None:
        """Give the preset's field split the Schur complement of the matrix as it is now."""
        if self._laid.own and self._options.schur:
            assert self.matrix is not None
            set_schur(self.snes, self.matrix.schur())

    # ---- SNES callbacks
    @property
    def _laid(self) -> Unknowns:
        assert self.problem.unknowns is not None
        return self.problem.unknowns

    def _at(self, x: Any) -> Evaluation:
        """Evaluation at an iterate, reused while SNES asks for the same one."""
        same = self._last is not None and np.array_equal(self._last.x, x.array_r)
        if not self.problem.system.comm.allreduce(same, op=MPI.LAND):
            # A diverging iterate may overflow; the convergence test sees it.
            with np.errstate(over="ignore", invalid="ignore"):
                new = self.problem.evaluate(x)
            self._rests = True
            if self._last is not None:
                for k, (a, b) in enumerate(zip(self._last.parts, new.parts, strict=True)):
                    changes = a.status != b.status
                    self._flips[k] += changes
                    self._rests &= not changes.any()
            else:
                self._flips = [np.zeros(part.status.shape, dtype=int) for part in new.parts]
            self._last = new
        assert self._last is not None
        return self._last

    def _function(self, _snes: Any, x: Any, f: Any) -> None:
        try:
            f.array_w[:] = self.problem.residual(self._at(x))
        except UserFunctionError as error:
            self._raised = error
            raise

    def _jacobian(self, _snes: Any, x: Any, _j: Any, _p: Any) -> None:
        e = self._at(x)
        if e is not self._assembled:
            self.assemble(e)

    def _worst(self, e: Evaluation) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            return max(self.problem.ratios(e).values())

    def _converged(self, _snes: Any, iteration: int, norms: tuple[float, float, float]) -> Any:
        assert self._last is not None
        reasons = PETSc.SNES.ConvergedReason
        worst = self._worst(self._last)
        if not np.isfinite(norms[2]) or not np.isfinite(worst):
            return reasons.DIVERGED_FNORM_NAN
        unchanged = self.problem.system.comm.allreduce(self._rests, op=MPI.LAND)
        stalls = iteration > 0 and worst > max(1.0, _STALLED * self._before)
        # An active set that still changes stalls by itself, not by rounding.
        known = self.problem.rounding.is_known(self.problem.awake)
        near = worst < _NEAR or (unchanged and not known)
        if stalls and near and not self._measured:
            self.problem.measure_rounding(self._last)
            self._measured = self._matrices_due = True
            worst = self._worst(self._last)
        self._solved |= iteration > 0
        self._matrices_due |= unchanged and worst > max(1.0, _SLOW * self._before)
        self._before = worst
        if worst <= 1.0:
            enough = self._passed is not None or iteration >= self.newton.max_iterations
            self._passed = self._last
            if enough or worst <= _SURE or not self._adds_up():
                return reasons.CONVERGED_FNORM_RELATIVE
        elif self._passed is not None:
            # One more iteration left rounding only: what it started from is the solution.
            return reasons.CONVERGED_FNORM_RELATIVE
        late = iteration > 0 and iteration % _INSIDE_OUT == 0
        if self._shortened >= _SHORTENED or (late and self._is_inside_out()):
            return reasons.DIVERGED_FUNCTION_DOMAIN
        if iteration >= self.newton.max_iterations:
            return reasons.DIVERGED_MAX_IT
        if self._presets[self._chosen] == "krylov":
            self._aim(worst)
        return reasons.ITERATING

    # ---- cells inside out
    def _displacements(self, x: FloatArray) -> list[FloatArray]:
        """Of each body at an iterate [m]."""
        u = list(self.problem.state.u)
        for k in self.problem.awake:
            u[k] = x[self._laid.of_body(k)]
        return u

    def _smallest_dets(self, u: list[FloatArray]) -> FloatArray:
        return smallest_dets(self.problem.system, u, self._dets)

    def _is_inside_out(self) -> bool:
        assert self._last is not None
        dets = self._smallest_dets(self._displacements(self._last.x))
        return not (forbidden(self.problem.system, dets) > 0.0).all()

    def _shorten(self, x: Any, y: Any) -> bool:
        """Keep an update, which SNES subtracts from x, from turning cells inside out.

        The first attempt at a step does without: where it ends well, Newton's path is of no matter.
        """
        if not self._careful:
            return False
        system, start, update = self.problem.system, x.array_r, y.array_r
        dets = forbidden(system, self._smallest_dets(self._displacements(start)))
        least = np.where(dets > 0.0, _KEPT_DET * dets, -np.inf)
        part = 1.0
        for _ in range(_HALVINGS):
            dets = self._smallest_dets(self._displacements(start - part * update))
            if (forbidden(system, dets) >= least).all():
                break
            part *= 0.5
        if part == 1.0:
            self._shortened = 0
            return False
        self._shortened += 1
        y.scale(part)
        return True

    def _adds_up(self) -> bool:
        """Whether what an iteration leaves adds up over steps; every rank must call it.

        Kept matrices leave the same part of a smooth motion in each step, whose work has one sign;
        where contact acts, the parts differ.
        """
        assert self._last is not None
        acts = any(bool(part.status.any()) for part in self._last.parts)
        return self.newton.reuse and not self.problem.system.comm.allreduce(acts, op=MPI.LOR)

    def _aim(self, worst: float) -> None:
        """Let the linear solver of Krylov's preset go as far as is worth it at an iterate."""
        if self._given.keys() & {"ksp_rtol", "ksp_max_it"}:
            return
        aim, limit = _AIM / worst, self._options.most_iterations
        if self.newton.reuse:
            rtol = aim if worst <= _LAST and self._adds_up() else _KEPT
        else:
            rtol = aim if _FINE <= aim <= _COARSE else _COARSE
            limit = int(limit * math.log(rtol) / math.log(_COARSE))
        self.snes.getKSP().setTolerances(rtol=rtol, max_it=limit)

    # ---- failure
    def _failure(self, e: Evaluation, reason: int, iterations: int) -> str:
        """What failed, and where a body is inside out or nearly so; every rank must call it."""
        problem, u = self.problem, self._displacements(e.x)
        dets = forbidden(problem.system, self._smallest_dets(u))
        if reason == PETSc.SNES.ConvergedReason.DIVERGED_FUNCTION_DOMAIN:
            kind = type(problem.system.bodies[int(dets.argmin())]).__name__
            return (
                f"step from t={problem.state.time:.6g} with dt={problem.dt:.3g} not solved after "
                f"{iterations} iterations: {describe(problem.system, u, dets)}; "
                f"{_AGAINST_INVERSION}, {kind}(..., allow_inversion=True) accepts it"
            )
        message = diagnosis(problem, e, self._flips, self._reason(reason), iterations)
        if not dets.min() <= _KEPT_DET:
            return message
        return f"{message}; {describe(problem.system, u, dets)}; {_AGAINST_INVERSION}"

    def _reason(self, reason: int) -> str:
        """What PETSc gives as the reason of a failure."""
        if reason != PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            return f"SNES reason {reason}"
        ksp = self.snes.getKSP().getConvergedReason()
        why = f"the linear solver {self._presets[self._chosen]!r} failed, KSP reason {ksp}"
        why += self._with_options()
        if self._presets == ("krylov",):
            why += "; linear_solver='auto' goes on with MUMPS where that happens"
        return why

    def _with_options(self) -> str:
        return f", with petsc_options={dict(self._given)!r}" if self._given else ""

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        self._options.remove()
        if self.matrix is not None:
            self.matrix.destroy()
            self.matrix = None
        if self.snes is not None:
            self.snes.destroy()
            self._f.destroy()
            self.snes = None
        self._version = -1
