"""Advances a system step by step, cut where a step fails."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from typing import Any, ClassVar

from dolfinx_nts.bodies.conditions import jumps
from dolfinx_nts.contact.overlap import OverlapWatch
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.ledger.contact_fields import ContactLoads
from dolfinx_nts.ledger.guards import check_momentum, pushes
from dolfinx_nts.ledger.impact import restored
from dolfinx_nts.parallel import together
from dolfinx_nts.petsc_compat import close_at_exit
from dolfinx_nts.run import step_warnings
from dolfinx_nts.run.arguments import check_arguments
from dolfinx_nts.run.balance_table import Ledger
from dolfinx_nts.run.between_steps import BetweenSteps, MaterialWatch
from dolfinx_nts.run.interrupts import Interrupts
from dolfinx_nts.run.ledger_check import LedgerCheck
from dolfinx_nts.run.locking_watch import LockingWatch
from dolfinx_nts.run.parts import Parts
from dolfinx_nts.run.run_file import Saved
from dolfinx_nts.run.run_memory import RunMemory
from dolfinx_nts.run.solution import Restart, Solution
from dolfinx_nts.run.start import (
    accept,
    check_restart,
    first_state,
    fitting,
    kind_of,
    of_file,
    refuse_overwritten,
)
from dolfinx_nts.run.trial import LastSteps, Trial, solved, state_after
from dolfinx_nts.solve.accuracy import Newton
from dolfinx_nts.solve.newton import StepSolver
from dolfinx_nts.start import consistent
from dolfinx_nts.start.unresolved import DamperWatch
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import BeforeStep, FloatArray, Options
from dolfinx_nts.validation import (
    StepFailedError,
    UserFunctionError,
    known_options,
    require_positive,
)

logger = logging.getLogger(__name__)

#: First steps whose failure may come from how the run starts.
_FIRST = 2
#: Part of the energies by which a restart may differ from its checkpoint, as sums of other ranks
#: do.
_SAME = 1e-10


@known_options
class Stepper:
    """Advances a system step by step.

    Args:
        system: The scene.
        integrator: `EnergyMomentum()`, `Midpoint()`, `Newmark()`, `GeneralizedAlpha()`, or one of
            the user's own with the `Integrator` protocol.
        newton: Tolerances and retries.
        petsc_options: PETSc options of the step's SNES, without prefix.
        start: Result of `equilibrium` (see there), of another run, or of `restart`, to start from;
            or `load` of a saved equilibrium.
        start_time: Time at the start [s]; see `simulate`.
        sleep: Leave bodies that nothing moves out of the steps; see `simulate`.
        watch_overlap: Look whether bodies end up inside each other; see `simulate`.
        before_step: Called before every attempt at a step; see `simulate`.
        project_start: Project velocities that joints do not allow; see `simulate`.
        ledger: Keep the ledger; see `simulate`.
        impact: "published" or "restored"; see `simulate`.
        restitution: Coefficient of restitution of "restored"; see `simulate`.

    Attributes:
        state: Last accepted state.
        solution: Balance table so far.
        problem: Equations of the step, for those who want their parts.
        solver: The SNES that solves them.
        restart: What it goes on from, if that is a `Restart`.
        memory: What a checkpoint keeps beside state and solution.
        note: Called with what goes on within a step, for those who show it.
    """

    #: What it computes.
    makes: ClassVar[type[Solution]] = Solution

    def __init__(
        self,
        system: System,
        integrator: Any,
        *,
        newton: Newton | None = None,
        petsc_options: Options | None = None,
        start: Solution | Saved | None = None,
        start_time: float | None = None,
        sleep: bool = False,
        watch_overlap: bool = True,
        before_step: BeforeStep | None = None,
        project_start: bool = False,
        ledger: bool = True,
        impact: str = "published",
        restitution: float = 1.0,
    ) -> None:
        check_arguments(
            system, integrator, newton, petsc_options, before_step, impact, restitution,
            sleep=sleep, watch_overlap=watch_overlap, project_start=project_start, ledger=ledger,
            start=kind_of(start), start_time=start_time,
        )  # fmt: skip
        begun: Solution | None = of_file(start, system)
        self.system, given = system, petsc_options or {}
        self._restitution = float(restitution) if impact == "restored" else None
        self._project_start, self.newton = project_start, newton or Newton()
        materials, self.interrupts = MaterialWatch(system), Interrupts(system.comm)
        self._locking = LockingWatch(system, in_time=integrator.inertia)
        preset = self.newton.preset(system, integrator.inertia, given)
        self.problem = StepProblem(
            system, integrator, rtol=self.newton.rtol, condense=self.newton.condense, sleep=sleep
        )
        self.solver, self._given = StepSolver(self.problem, self.newton, preset, given), given
        close_at_exit(self)
        self.note: Callable[[str], Any] = bool
        self._overlap = OverlapWatch(system) if watch_overlap else None
        self._last_steps, self._dampers = LastSteps(), DamperWatch(self.problem)
        self.restart = begun if isinstance(begun, Restart) else None
        check_restart(self.restart, system, start_time, ledger)
        self.solution = self.restart.go_on() if self.restart else self.makes(system)
        self.solution.settings = {
            "integrator": repr(integrator), "newton": repr(self.newton), "sleep": sleep,
            "petsc_options": {name: str(value) for name, value in given.items()},
            "impact": impact, "restitution": float(restitution), "ranks": system.comm.size,
        }  # fmt: skip
        promises = LedgerCheck(self.solution, integrator, self.newton.rtol)
        self._ledger = Ledger(self.solution, promises, kept=ledger)
        self._between = BetweenSteps(materials, before_step, self._ledger, self.problem.sleepers)
        self.memory = RunMemory(
            self.problem, self.solver, self._last_steps, promises, self._locking
        )
        self._set_out(begun, start_time)

    def _set_out(self, start: Solution | None, start_time: float | None) -> None:
        """Accept the state that the run begins with; arguments are those of the class."""
        refuse_overwritten(self.system)
        state = first_state(self.system, start, start_time)
        if self.problem.integrator.inertia and not (start is not None and start.moving):
            self.system.refuse_overlap(state)
        if not self.problem.integrator.accelerations:
            state = replace(state, a=())
        self._accept(state)
        self._start, self._started = start, False
        if self.restart is None:
            self._ledger.open(state, start)
            step_warnings.tell_pieces(self.solution, state.time)
            step_warnings.tell_straight(self.solution, state.time)

    def _resume(self, restart: Restart, dt: float) -> None:
        """Begin where a checkpoint was written, with the materials of its last step."""
        self.memory.resume(restart.memory, restart.nodal_memory, self.state)
        if self._last_steps.last is not None:
            self._between.begin(*self._last_steps.last)
        what = "what the restart was given in place of the checkpoint's materials"
        self._ledger.restate(self.state, what, beyond=_SAME)
        if self.problem.integrator.accelerations and not self.state.a:
            # The run had another integrator.
            a = consistent.accelerations(self.problem, self.state, dt)
            self._accept(replace(self.state, a=a))
        self._started = True
        self.look()

    def advance(self, dt: float, *, end: float | None = None) -> State:
        """Advance by dt; a step that is not solved is cut, up to `newton.max_retries` times.

        Where n parts are left, they become 2 n + 1, and half as many again after four that are
        solved, or twice as many each time when that fails.

        Args:
            dt: Time to advance [s], > 0.
            end: Time there [s], for those who count steps: sums of dt would be rounded.

        Returns:
            The accepted state at the end.

        Raises:
            ValueError: dt is not positive.
            StepFailedError: Not solved even with the smallest step; everything accepted so far is
                kept.
            UserFunctionError: A function of time raised or returned no vector on some rank, or
                `before_step` raised; not tried again, everything is kept.
        """
        for _ in self.in_parts(dt, end=end):
            pass
        return self.state

    def in_parts(self, dt: float, *, end: float | None = None) -> Iterator[bool]:
        """`advance`, stopping after every accepted step: dt, or the parts that it is cut into.

        Yields:
            Whether this was the last part.
        """
        require_positive("dt", dt, "s")
        dt = float(dt)
        self.system.check_alive()
        self.start(dt)
        end, parts = self.state.time + dt if end is None else end, Parts(self.newton.max_retries)
        asked = dt
        while parts.left:
            try:
                self._step(dt, end - (parts.left - 1) * dt)
            except UserFunctionError:
                raise
            except StepFailedError as failure:
                if not parts.cut():
                    failure.part = dt / asked
                    raise
                self.solution.retries += 1
                dt = (end - self.state.time) / parts.left
                logger.info("%s; retrying with dt=%.3g", failure, dt)
            else:
                if parts.take():
                    dt = (end - self.state.time) / parts.left
                yield not parts.left

    def start(self, dt: float) -> None:
        """Give prescribed coordinates the rate of their motion; later calls do nothing.

        In a run that goes on from another one they keep their velocities unless the motion is
        another one.

        Args:
            dt: First step [s].
        """
        if self._started:
            return
        if self.restart is not None:
            self._resume(self.restart, dt)
            return
        for retry in count():
            try:
                # What the first call sets is what the run begins with.
                self._between.begin(self.state.time, dt)
                state, moved = fitting(
                    self.problem, self.state, dt, begun=self._start, project=self._project_start,
                    resting=(self.newton, self._given),
                )  # fmt: skip
                break
            except UserFunctionError:
                raise
            except StepFailedError as failure:
                if retry == self.newton.max_retries:
                    raise
                # The first step will be cut for the same reason.
                dt /= 3.0
                logger.info("%s; starting with dt=%.3g", failure, dt)
        self._accept(state)
        self._started = True
        step_warnings.tell_start(self.solution, self.problem, state, dt, self._start, moved)
        self._ledger.open(state, self._start)
        # Where bodies were before the first step, for one that carries them through each other.
        self.look()

    def look(self, *, last: bool = False) -> None:
        """Warn if what is in contact is inside each other; only as often as it has moved.

        Args:
            last: Look wherever anything has moved since the last look.
        """
        step_warnings.tell_stressed(self.solution, self.state.time)
        self._look_inside(last)
        if last:
            self._locking.tell(self.solution, self.state.time)

    def _look_inside(self, last: bool) -> None:
        """`look` at bodies inside each other."""
        if self._overlap is not None:
            step_warnings.tell_overlap(self.solution, self._overlap, self.state, last=last)

    def _accept(self, state: State) -> None:
        accept(self.system, state)
        self.state = self.solution.state = state

    def _step(self, dt: float, time: float) -> None:
        self.begin(dt)
        self.take(self.attempt(time))

    def begin(self, dt: float) -> None:
        """Fix the equations of a step from the last accepted state."""
        self._between.prepare(self.state, dt)
        self.problem.begin(self.state, dt)

    def attempt(self, time: float) -> Trial:
        """Solution of the step that `begin` fixed, if it may be accepted.

        Args:
            time: At its end [s].

        Raises:
            StepFailedError: Not solved, or what came out cannot be.
        """
        problem, ledger, impact = self.problem, self._ledger, None
        step = solved(problem, self.solver)
        state = state_after(problem, step, time)
        before = ledger.before(self.state)
        works: list[Any] = [ledger.measuring(state), pushes(problem, step, state)]
        measured, pushed = together(self.system.comm, works)
        impulses = check_momentum(problem, pushed, before, measured)
        if self._restitution is not None:
            impact = restored(problem, step, state, self._restitution)
        state = state if impact is None else impact.state
        drives = consistent.fitted(problem, state)
        state = state if drives is None else drives.state
        if impact or drives:
            (measured,) = together(self.system.comm, [ledger.measuring(state)])
        return Trial(step, state, measured, impulses, impact, drives)

    def take(self, trial: Trial) -> None:
        """Accept a step: a row of the ledger, and the new state."""
        step, state, impact = trial.step, trial.state, trial.impact
        self._ledger.enter(self.problem, trial)
        self.solution.contact_loads = ContactLoads.of_step(self.problem, step)
        self._last_steps.take(self.state, self.problem.dt, state)
        self._accept(state)
        step_warnings.tell_step(self.solution, self.problem, step, state)
        alternates = self._dampers.look(state)
        if alternates:
            self.solution.warn("unresolved", state.time, *alternates)
        if impact is not None:
            step_warnings.tell_frictionless(self.solution, impact.impulses[0], state.time)
        self._locking.look()
        self.look()

    def mean_force(self, k: int) -> FloatArray:
        """Contact force p_N of the last two steps in the mean over their time [N].

        That of a single step alternates about it; after one step, or a load step of `equilibrium`,
        it is that step's.

        Args:
            k: Number of the contact.

        Returns:
            At this rank's slave nodes, as in `state.contacts`.
        """
        first, *others = (self._mean_force(n) for n in self.system.holding[k])
        return sum(others, start=first)

    def _mean_force(self, n: int) -> FloatArray:
        """As `mean_force`, of one of `System.pairs`."""
        mean = self._last_steps.mean_force(n)
        return self.state.contacts[n].force if mean is None else mean

    def jumps_at_start(self, dt: float) -> str:
        """What a failure in the first steps, of dt [s], may come of, see `jumps`. Collective."""
        late = self.state.time > self.solution.rows[0]["time"] + _FIRST * dt
        return "" if late or self._start is not None else jumps(self.system.bodies)

    def close(self) -> None:
        """Free the PETSc objects of the last step."""
        self.solver.destroy()
        self.problem.destroy()
