"""The time loop: `simulate` for a whole run, `Stepper` for those who keep the loop."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from dolfinx_nts.bodies.inversion import describe, smallest_dets
from dolfinx_nts.contact.overlap import OverlapWatch
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.parallel import first_problem, global_max, write_on_root
from dolfinx_nts.run.run_warnings import RunWarnings
from dolfinx_nts.run.step_size import Adapt, Pace
from dolfinx_nts.run.table import Table
from dolfinx_nts.run.writer import Writer
from dolfinx_nts.step import balance, consistent, resultants
from dolfinx_nts.step.guards import check_momentum
from dolfinx_nts.step.newton import ACCURACY, Newton, StepSolver
from dolfinx_nts.step.problem import Evaluation, StepProblem
from dolfinx_nts.step.promises import MaterialWatch, Promises
from dolfinx_nts.system import State, System
from dolfinx_nts.validation import (
    StepFailedError,
    UserFunctionError,
    as_path,
    call_together,
    is_finite,
    items,
    known_options,
    require_bool,
    require_positive,
)

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float64]

#: Depth in facet sizes from which on a node behind a surface that it passed by is told.
_BESIDE = 1e-3
#: What a step chosen by its error is cut to: halves would soon end where it has failed.
_CUT = 0.4
#: Smallest det F below which cells count as crushed.
_CRUSHED = 0.05
#: Part of the speed of supports by which a run that goes on may differ from their motion, as it
#: does by the error of its steps.
_JUMP = 0.1
#: Cuts of a step before nodes that infinite friction holds may slip.
_CUTS = 3
#: Searches for contact, each along the motion that came of the one before.
_SEARCHES = 4
#: Order of the integrators whose error `Adapt` knows.
_ADAPTED = 2
#: PETSc's own tests of convergence, in whose place `StepSolver` has one of its own.
_WITHOUT_EFFECT = {"snes_rtol", "snes_atol", "snes_stol", "snes_convergence_test"}


@dataclass(eq=False)
class Solution:
    """What a run computed, complete up to where it ended.

    Attributes:
        system: The scene; its bodies hold the last accepted state.
        status: "completed"; "completed, but ..." with what may be wrong in it; or why the run
            stopped and what to do.
        rows: Balance table, one row for the start and one per accepted step; some 150 B each.
        retries: How often a step was dropped and cut.
        rejected: How often a step was dropped for its error and shortened, see `Adapt`.
        exceeded: Steps taken though their motion errs more than `Adapt` asks for: the shortest it
            may take, and those that move nodes out from behind their facets.
        switches: Changes of facet of nodes in contact: the newest 10,000, and sums over all.
        state: Last accepted state, from which another run may start.
        warnings: What the run has to say against its result, by kind; see `RunWarning`.
    """

    system: System
    status: str = "running"
    rows: Table = field(default_factory=Table)
    retries: int = 0
    rejected: int = 0
    exceeded: int = 0
    switches: balance.Switches = field(default_factory=balance.Switches)
    warnings: RunWarnings = field(default_factory=RunWarnings)
    state: State | None = None
    #: Whether its state moves, or a run from it begins with the bodies' initial velocities.
    moving: ClassVar[bool] = True

    @property
    def balance(self) -> dict[str, npt.NDArray[np.float64]]:
        """Columns of the balance table, shape (rows,) or (rows, 3), identical on all ranks.

        They are read-only and hold the rows up to now.
        """
        return {name: self.rows.column(name) for name in balance.columns(self.system)}

    @property
    def reactions(self) -> dict[str, FloatArray]:
        """Of each body, force of each `Dirichlet` condition on it [N], shape (rows, conditions, 3).

        Of a rigid body those of its prescribed motion: force, then moment of rotation [N m].

        Of each joint, by its name, force [N] and moment about its point [N m] on the first of its
        bodies, shape (rows, 2, 3).

        In dynamics that of each step, with inertia, where the integrator takes its forces. A
        coordinate that two conditions prescribe counts with the later one.
        """
        return {
            item.name: self.rows.column(resultants.reactions_of(item))
            for item in (*self.system.bodies, *self.system.declared_joints)
        }

    @property
    def contact_forces(self) -> FloatArray:
        """Resultant of each contact on its slave body [N], shape (rows, contacts, 3).

        In dynamics that of each step; with a consistent mass the forces of single steps alternate.
        """
        return self.rows.column(resultants.CONTACT_FORCES)

    @property
    def summary(self) -> str:
        """How the run went in a few lines: steps, energy, changes of facet; equal on all ranks."""
        first, last = self.rows[0], self.rows[-1]
        steps = len(self.rows) - 1
        iterations = self.balance["newton_iterations"].sum() / max(steps, 1)
        lines = [
            f"{self.status}: {steps} steps to t = {last['time']:.6g} s, {self.retries} retries, "
            f"{self.rejected} rejected, {iterations:.2f} Newton iterations per step",
            f"energy {first['energy']:.6g} J + external work {last['external_work']:.6g} J - "
            f"friction {last['friction_dissipation']:.6g} J - contact "
            f"{last['contact_defect']:.6g} J = {last['energy']:.6g} J, "
            f"but for {last['ledger_residual']:.2g} J",
        ]
        if self.exceeded:
            lines.append(f"{self.exceeded} steps taken though they err more than their tolerance")
        found, worst = self.switches, self.switches.worst
        if worst is not None:
            lines.append(
                f"{found.number} changes of facet: contact defect {found.defect:.3g} J in all, "
                f"mean of absolute values {found.size / found.number:.3g} J; most "
                f"{worst.defect:.3g} J at t = {worst.time:.6g} s ({worst.contact}, node "
                f"{worst.node}, facet {worst.facets[0]} to {worst.facets[1]})"
            )
        return "\n".join([*lines, *self.warnings.lines])

    def warn(self, kind: str, time: float, size: float, text: str, *, grave: bool = False) -> None:
        """Add a warning; every rank must make the same call, see `RunWarnings.add`."""
        root = self.system.comm.rank == 0
        self.warnings.add(kind, time, size, text, grave=grave, speak=root)

    def finish(self) -> None:
        """Say in the status that the run is complete, and what may be wrong in it."""
        grave = "; ".join(w.text for w in self.warnings.grave)
        self.status = f"completed, but {grave}" if grave else "completed"

    def plot(self, path: str) -> None:
        """Write a picture of energies, ledger and momenta over time. Every rank must call it.

        Args:
            path: Picture file; its ending chooses the format.
        """
        from dolfinx_nts.output.plots import plot_balance

        as_path("path", path)
        write_on_root(self.system.comm, f"path={path!r}", lambda: plot_balance(self.balance, path))


class Trial(NamedTuple):
    """A solved step that may be accepted.

    Attributes:
        step: Solution of its equations.
        state: State at its end.
        measured: `balance.measure` of that state.
        impulses: Of all forces in the step, see `check_momentum` [kg m/s].
    """

    step: Evaluation
    state: State
    measured: dict[str, Any]
    impulses: float


@known_options
class Stepper:
    """Advances a system step by step.

    Args:
        system: The scene.
        integrator: `EnergyMomentum()`, `Midpoint()`, `Newmark()`, `GeneralizedAlpha()`, or one of
            the user's own with the `Integrator` protocol.
        newton: Tolerances and retries.
        petsc_options: PETSc options of the step's SNES, without prefix.
        start: Result of `equilibrium` (see there) or of another run to start from.
        start_time: Time at the start [s]; see `simulate`.
        sleep: Leave bodies that nothing moves out of the steps; see `simulate`.
        watch_overlap: Look whether bodies end up inside each other; see `simulate`.
        before_step: Called before every attempt at a step; see `simulate`.
        project_start: Project velocities that joints do not allow; see `simulate`.

    Attributes:
        state: Last accepted state.
        solution: Balance table so far.
        problem: Equations of the step, for those who want their parts.
        solver: The SNES that solves them.
    """

    def __init__(
        self,
        system: System,
        integrator: Any,
        *,
        newton: Newton | None = None,
        petsc_options: Mapping[str, Any] | None = None,
        start: Solution | None = None,
        start_time: float | None = None,
        sleep: bool = False,
        watch_overlap: bool = True,
        before_step: Callable[[float, float], Any] | None = None,
        project_start: bool = False,
    ) -> None:
        if not isinstance(system, System):
            raise TypeError(f"system={system!r}: pass a System([body, ...])")
        if not isinstance(integrator, Integrator) or isinstance(integrator, type):
            raise TypeError(
                f"integrator={integrator!r}: pass EnergyMomentum(), Midpoint() or another one with "
                "the Integrator protocol"
            )
        if not isinstance(newton, Newton | None):
            raise TypeError(f"newton={newton!r}: pass Newton(rtol=...)")
        given = {} if petsc_options is None else petsc_options
        if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
            raise TypeError(
                f"petsc_options={petsc_options!r}: pass a dict of names and values, e.g. "
                "{'pc_type': 'lu'}"
            )
        for name in sorted(name for name in given if name.lower() in _WITHOUT_EFFECT):
            raise ValueError(
                f"petsc_options[{name!r}]={given[name]!r}: each block of the residual is tested by "
                "itself, not by PETSc; pass newton=Newton(rtol=...)"
            )
        require_bool("sleep", sleep)
        require_bool("watch_overlap", watch_overlap)
        require_bool("project_start", project_start)
        self._project_start = project_start
        if not callable(before_step) and before_step is not None:
            raise TypeError(f"before_step={before_step!r}: pass a callable (time, dt)")
        self._before_step = before_step
        self.newton = newton or Newton()
        preset = self.newton.preset(system, integrator.inertia, given)
        self.problem = StepProblem(
            system,
            integrator,
            rtol=self.newton.rtol,
            condense=self.newton.condense,
            sleep=sleep,
        )
        self.solver = StepSolver(self.problem, self.newton, preset, given)
        self.system = system
        self._overlap = OverlapWatch(system) if watch_overlap else None
        self._measured: dict[str, balance.Measured] = {}
        self._recent: deque[tuple[float, tuple[FloatArray, ...]]] = deque(maxlen=2)
        self.solution = Solution(system)
        state = _first_state(system, start, start_time)
        if not integrator.accelerations:
            state = replace(state, a=())
        self._accept(state)
        self._started, self._goes_on = False, start is not None and start.moving
        self._start = start
        self.solution.rows = Table([self._first_row()])
        self._promises = Promises(self.solution, integrator, self.newton.rtol)
        self._materials, self._material_change = MaterialWatch(system), 0.0

    def advance(self, dt: float) -> State:
        """Advance by dt; a step that is not solved is cut, up to `newton.max_retries` times.

        What is left is then cut into one part more than twice as many.

        Args:
            dt: Time to advance [s], > 0.

        Returns:
            The accepted state at the end.

        Raises:
            ValueError: dt is not positive.
            StepFailedError: Not solved even with the smallest step; everything accepted so far is
                kept.
            UserFunctionError: A function of time raised or returned no vector on some rank, or
                `before_step` raised; not tried again, everything is kept.
        """
        require_positive("dt", dt, "s")
        dt = float(dt)
        self.start(dt)
        end, parts, retries = self.state.time + dt, 1, 0
        while parts:
            target = end - (end - self.state.time) * (parts - 1) / parts
            try:
                self._step(target - self.state.time, target)
            except UserFunctionError:
                raise
            except StepFailedError as failure:
                if retries == self.newton.max_retries:
                    raise
                retries += 1
                self.solution.retries += 1
                # An odd number: halves of halves would end where one of them has failed.
                parts = 1 if self._bind(retries) else 2 * parts + 1
                smaller = (end - self.state.time) / parts
                logger.info("%s; retrying with dt=%.3g", failure, smaller)
            else:
                parts -= 1
        return self.state

    def _bind(self, retries: int) -> bool:
        """Let infinite friction have a bound once cuts are of no use; tells whether that is new."""
        endless = any(np.isinf(pair.friction) for pair in self.system.contacts)
        if not endless or self.problem.contacts.bounded or retries < _CUTS:
            return False
        self.problem.contacts.bounded = True
        return True

    def paced(self, pace: Pace, end: float) -> Iterator[None]:
        """Advance in steps of a pace, stopping after each.

        Args:
            pace: Sizes of the steps.
            end: Where to stop [s].

        Raises:
            StepFailedError: Not solved even after `newton.max_retries` cuts in a row, or as in
                `advance`.
        """
        self.start(pace.dt)
        retries = 0
        while self.state.time < end:
            now = self.state.time
            left = end - now
            dt = pace.propose(left)
            self._begin(dt)
            part = pace.first_touch(self.problem)
            if part < 1.0:
                dt *= part
                self._begin(dt)
            try:
                trial = self._attempt(dt, end if dt == left else now + dt)
            except StepFailedError as failure:
                if retries == self.newton.max_retries:
                    raise
                retries += 1
                self.solution.retries += 1
                pace.dt = dt if self._bind(retries) else _CUT * dt
                logger.info("%s; retrying with dt=%.3g", failure, pace.dt)
                continue
            if not pace.accepts(self.problem, trial.step):
                self.solution.rejected += 1
                continue
            # Steps shorter than any that is asked for end a run that only they keep alive.
            retries = 0 if dt >= pace.shortest else retries
            self._take(trial)
            if pace.exceeds:
                self.solution.exceeded += 1
                self.solution.warn(
                    "step error", self.state.time, dt,
                    f"a step of {dt:.3g} s errs more than Adapt asks for: it is the shortest one, "
                    "or it moves a node out from behind its facet; pass a smaller `shortest` or a "
                    "larger `tolerance`",
                )  # fmt: skip
            yield

    def start(self, dt: float) -> None:
        """Give prescribed coordinates the rate of their motion; later calls do nothing.

        In a run that goes on from another one they keep their velocities unless the motion is
        another one.

        As v_1 = 2 (u_1 - u_0)/h - v_0, another start would make their velocities alternate for
        ever. The rate is a one-sided difference of second order, as accurate as the integrators.

        Args:
            dt: First step [s].
        """
        if self._started:
            return
        self._call_before(dt)
        # What the first call sets is what the run begins with.
        self._materials.changed()
        v = [v.copy() for v in self.state.v]
        for body, values in zip(self.system.bodies, v, strict=True):
            p0, p1, p2 = (body.prescribed(self.state.time + s * dt) for s in (0.0, 0.5, 1.0))
            # So written, what does not move has the rate 0, not that of rounding.
            rate = (4.0 * (p1 - p0) - (p2 - p0)) / dt
            old = values[body.fixed]
            sizes = [np.abs(a).max(initial=0.0) for a in (rate - old, rate, old)]
            off, *size = global_max(self.system.comm, np.array(sizes)).tolist()
            # A run that goes on moves on as it did, unless its supports do not.
            if not self._goes_on or off > _JUMP * max(size):
                values[body.fixed] = rate
        state = replace(self.state, v=tuple(v))
        state = self._consistent(state, dt)
        if self.problem.integrator.accelerations and not state.a:
            state = replace(state, a=consistent.accelerations(self.problem, state, dt))
        self._accept(state)
        self._started = True
        self.solution.rows = Table([self._first_row()])
        # Where bodies were before the first step, for one that carries them through each other.
        self.look()

    def _consistent(self, state: State, dt: float) -> State:
        """A start that fits the joints.

        Velocities at the end of another run's step need not: they only do in the mean of two steps.

        Raises:
            ValueError: It does not, and its velocities are not to be projected, or cannot be.
        """
        if not self.system.joints:
            return state
        still = tuple(np.zeros_like(v) for v in state.v)
        self.problem.begin(replace(state, a=state.a or still), dt)
        found = consistent.violation(self.problem, state, dt, rates=False)
        if found is not None:
            raise ValueError(
                f"joints: at the start {found[1]!r} is off by {found[0]:.3g} m; let the bodies' "
                "displacements and prescribed motion, and what the joint prescribes, begin where "
                "it holds"
            )
        if self._continues:
            return state
        found = consistent.violation(self.problem, state, dt, rates=True)
        if found is not None and not self._project_start:
            raise ValueError(
                f"velocity: at the start joint {found[1]!r} is violated at {found[0]:.3g} m/s; "
                "give its bodies velocities, and what is prescribed rates, that fit, or pass "
                "project_start=True"
            )
        if found is not None:
            state = replace(state, v=consistent.projection(self.problem, state, dt))
            found = consistent.violation(self.problem, state, dt, rates=True)
        if found is not None:
            raise ValueError(
                f"project_start=True: no velocities fit joint {found[1]!r}, which stays violated "
                f"at {found[0]:.3g} m/s; prescribed motion, or another joint, contradicts it"
            )
        return state

    @property
    def _continues(self) -> bool:
        """Whether the run goes on from another one with the same joints."""
        if not self._goes_on or self._start is None:
            return False
        known = {joint.name for joint in self._start.system.joints}
        return all(joint.name in known for joint in self.system.joints)

    def look(self, *, last: bool = False) -> None:
        """Warn if what is in contact is inside each other; only as often as it has moved.

        Args:
            last: Look wherever anything has moved since the last look.
        """
        if self._overlap is not None:
            for found in self._overlap.look(self.state.u, self.state.time, last=last):
                self.solution.warn(
                    found.kind, self.state.time, found.depth, found.text, grave=True
                )

    def _first_row(self) -> dict[str, Any]:
        return balance.first_row(self.system, self.state) | resultants.at_start(self.system)

    def _accept(self, state: State) -> None:
        for body, u, v in zip(self.system.bodies, state.u, state.v, strict=True):
            body.accept(u, v)
        self.state = self.solution.state = state

    def _step(self, dt: float, time: float) -> None:
        self._begin(dt)
        self._take(self._attempt(dt, time))

    def _begin(self, dt: float) -> None:
        """Fix the equations of a step from the last accepted state."""
        self._prepare(dt)
        self.problem.begin(self.state, dt)

    def _prepare(self, dt: float) -> None:
        """Let the user change what the forms of the step hold, and account for it."""
        self._call_before(dt)
        self._note_materials()

    def _call_before(self, dt: float) -> None:
        if self._before_step is not None:
            time = self.state.time
            name = f"before_step at t={time!r} with dt={dt!r}"
            call_together(self.system.comm, name, self._before_step, time, dt)

    def _note_materials(self) -> None:
        """Name in the ledger what changed parameters of materials do to the stored energy."""
        names = self._materials.changed()
        if not names:
            return
        self._measured.clear()
        stored = balance.measure(self.system, self.state, self._measured)["potential"]
        change = stored - self.solution.rows[-1]["potential"] - self._material_change
        self._material_change += change
        self.solution.warn(
            "material changed", self.state.time, abs(change),
            f"a changed parameter of the material of {', '.join(map(repr, names))} adds "
            f"{change:.3g} J to the stored energy without work; see material_change in the balance",
        )  # fmt: skip

    def _attempt(self, dt: float, time: float) -> Trial:
        """Solution of the step that `problem.begin` fixed, if it may be accepted.

        Raises:
            StepFailedError: Not solved, or what came out cannot be.
        """
        step = self._covered(self.solver.solve())
        state = self._accepted(step, dt, time)
        measured = balance.measure(self.system, state, self._measured)
        last = self.solution.rows[-1]
        impulses = check_momentum(self.problem, step, state, last, measured)
        return Trial(step, state, measured, impulses)

    def _covered(self, step: Evaluation) -> Evaluation:
        """The step itself, or solved again for as long as its motion may have passed by a contact.

        Raises:
            StepFailedError: No search found all contacts.
        """
        problem, iterations = self.problem, step.iterations
        for k in range(_SEARCHES + 1):
            if not problem.misses(step):
                return replace(step, iterations=iterations)
            if k < _SEARCHES:
                problem.begin(problem.state, problem.dt, step)
                step = self.solver.solve()
                iterations += step.iterations
        far = float(problem.motion(step).max())
        raise StepFailedError(
            f"step from t={problem.state.time:.6g} with dt={problem.dt:.3g}: bodies move by "
            f"{far:.3g} m, and no search found all contacts on the way of their nodes; use a "
            "smaller dt"
        )

    def _take(self, trial: Trial) -> None:
        """Accept a step: a row of the ledger, and the new state."""
        step, state, rows = trial.step, trial.state, self.solution.rows
        time = state.time
        terms = balance.step_terms(self.problem, step)
        terms |= {"time": time, "newton_iterations": step.iterations}
        terms["material_change"], self._material_change = self._material_change, 0.0
        row = balance.next_row(rows[0], rows[-1], trial.measured, terms)
        rows.append(row | resultants.of_step(self.problem, step))
        self._promises.hold(self.problem, step, trial.impulses)
        self.solution.switches.extend(balance.switches(self.problem, step, time))
        forces = tuple(contact.force for contact in state.contacts)
        self._recent.append((time - self.state.time, forces))
        self._accept(state)
        self._tell_inversion(step)
        self._tell_beside()
        self._tell_slip(step)
        self.look()

    def _tell_slip(self, step: Evaluation) -> None:
        """Say where nodes slip in spite of infinite friction, which they may in the next step."""
        contacts = self.problem.contacts
        both = zip(contacts.elements, self.problem.contact_parts(step), strict=True)
        endless = [(c, k) for c, k in both if np.isinf(c.pair.friction)]
        if not (endless and self.problem.contacts.bounded):
            return
        slips = [k.distance[k.active & ~k.stick].max(initial=0.0) for _, k in endless]
        farthest = float(self.system.comm.allreduce(max(slips), op=MPI.MAX))
        self.problem.contacts.bounded = farthest > 0.0
        if farthest > 0.0:
            self.solution.warn(
                "slip", self.state.time, farthest,
                "nodes would pull if they stuck and would enter the master if they left: in spite "
                f"of infinite friction they slip, by up to {farthest:.3g} m in a step; a finite "
                "coefficient may be meant",
            )  # fmt: skip

    def _tell_beside(self) -> None:
        """Warn of nodes that have passed by a surface's edge and lie behind it."""
        found = self.problem.contacts.beside
        deepest = np.array([depth for depth, _ in found])
        self.system.comm.Allreduce(MPI.IN_PLACE, deepest, op=MPI.MAX)
        if deepest.max(initial=0.0) <= _BESIDE:
            return
        k = int(deepest.argmax())
        nodes = self.system.comm.allgather(found[k])
        depth, node = max(nodes)
        self.solution.warn(
            "node beside a surface", self.state.time, depth,
            f"node {node} of contact {self.system.contacts[k].name!r} has passed the master's edge "
            f"and lies {depth:.3g} of a facet behind its surface, where nothing holds it; let the "
            "master's surface reach farther",
        )  # fmt: skip

    def _tell_inversion(self, step: Evaluation) -> None:
        if step.min_det <= 0.0:
            u, time = self.state.u, self.state.time
            text = describe(self.system, u, smallest_dets(self.system, u))
            text += "; what comes after it may be wrong"
            self.solution.warn("inversion", time, -step.min_det, text, grave=True)
        elif step.min_det < _CRUSHED:
            text = describe(self.system, self.state.u, smallest_dets(self.system, self.state.u))
            text += "; so near to that the result depends on the mesh"
            self.solution.warn("crushed cells", self.state.time, 1.0 - step.min_det, text)

    def _accepted(self, step: Evaluation, dt: float, time: float) -> State:
        """State at t_{n+1}."""
        old = self.state
        u, v, a = list(old.u), list(old.v), list(old.a)
        for k in self.problem.awake:
            u[k], a0 = step.bodies[k].u1.copy(), self.problem.acceleration(k)
            v[k], a1 = self.problem.integrator.advance(step.bodies[k].du, old.v[k], a0, dt)
            if a1 is not None:
                a[k] = a1
        histories = [coupling.history(parts) for coupling, parts in self.problem.each(step)]
        return State(time, tuple(u), tuple(v), tuple(a), tuple(histories))

    def mean_force(self, k: int) -> FloatArray:
        """Contact force p_N of the last two steps in the mean over their time [N].

        That of a single step alternates about it; after one step, or a load step of `equilibrium`,
        it is that step's.

        Args:
            k: Number of the contact.

        Returns:
            At this rank's slave nodes, as in `state.contacts`.
        """
        if not self._recent:
            return self.state.contacts[k].force
        steps, forces = zip(*self._recent, strict=True)
        mean: FloatArray = np.average([force[k] for force in forces], axis=0, weights=steps)
        return mean

    def close(self) -> None:
        """Free the PETSc objects of the last step."""
        self.solver.destroy()
        self.problem.destroy()


def _first_state(system: System, start: Any, time: Any) -> State:
    if time is not None and not is_finite(time):
        raise ValueError(f"start_time={time!r}: must be finite [s]")
    if start is None:
        if time is not None:
            raise ValueError(f"start_time={time!r}: pass start=, too, or leave it out")
        return system.initial_state()
    if not (isinstance(start, Solution) and start.state is not None):
        raise TypeError(
            f"start of type {type(start).__name__}: pass the result of equilibrium(...) or of "
            "simulate(...)"
        )
    state = start.state if time is None else replace(start.state, time=float(time))
    return system.state_from(start.system, state, moving=start.moving)


def _is_writer(item: Any) -> bool:
    return all(callable(getattr(item, name, None)) for name in ("start", "write", "close"))


@known_options
def simulate(
    system: System,
    integrator: Any,
    *,
    dt: float,
    t_end: float,
    newton: Newton | None = None,
    petsc_options: Mapping[str, Any] | None = None,
    output: Sequence[Writer] = (),
    progress: bool = False,
    start: Solution | None = None,
    start_time: float | None = None,
    accuracy: str | None = None,
    sleep: bool = False,
    adapt: Adapt | None = None,
    watch_overlap: bool = True,
    before_step: Callable[[float, float], Any] | None = None,
    project_start: bool = False,
) -> Solution:
    """Run a system from t = 0, or from an equilibrium, to t_end.

    Args:
        system: The scene.
        integrator: `EnergyMomentum()`, `Midpoint()`, `Newmark()`, `GeneralizedAlpha()`, or one of
            the user's own with the `Integrator` protocol.
        dt: Largest step [s], > 0; t_end is reached in equal steps unless `adapt` is given.
        t_end: End of the run [s], > 0.
        newton: Tolerances and retries.
        petsc_options: PETSc options of the step's SNES, without prefix, e.g. {"pc_type":
            "fieldsplit"}.
        output: Writers of `dolfinx_nts.output`, or of one's own with the `Writer` protocol, which
            all ranks call before the first step, after every accepted step and at the end:

                class Heights:
                    def start(self, stepper):
                        self.rows = []
                    def write(self, stepper, *, last=False):
                        centre = nts.motion_of(stepper.system.bodies[0]).centre
                        self.rows.append((stepper.state.time, centre[2]))
                    def close(self, stepper):
                        print(len(self.rows), "steps;", stepper.solution.status)

                heights = Heights()
                run = nts.simulate(system, integrator, dt=1e-3, t_end=0.2, output=[heights])

        progress: Show a progress line on rank 0.
        start: Result of `equilibrium` (see there) or of another run to start from.
        start_time: Time at which a run from `start` begins [s], from which functions of time and
            `t_end` count; default: the pseudo time of `start`.
        accuracy: In place of `newton`: "exact" closes the ledger to rounding; "balanced" to about
            1e-8 and "fast" to about 1e-5 of the energy, with matrices kept over many steps.
        sleep: Leave a body out of a step while its velocity is exactly zero, its forces balance to
            rounding and no contact may reach it; it wakes in the first step in which that ends. The
            solution is the same; a body that has moved hardly ever comes to rest exactly. What a
            caller changes in a material during the run wakes nothing.
        adapt: Choose the steps by their error and by closing gaps.
        watch_overlap: Look whether bodies of a contact end up inside each other, with all of their
            boundaries, or an obstacle in the facets that it is the master of, and warn. It costs
            less than one part in fifty of the steps unless the bodies move by a quarter of a facet
            in few of them.
        before_step: Callable (time, dt) that all ranks call before every attempt at a step, also
            when it is cut or its length chosen anew, with the time at its start [s] and its length
            [s]; the last call before a step is with the step's own. It may change the Constants and
            Functions in a material and in an `extra_form`, here from an old load to a new one in
            0.1 s:

                load = fem.Constant(mesh, 0.0)
                body = nts.Continuum(
                    mesh, rubber, density=1e3, extra_form=lambda u, v, w, t: -load * w[2] * ufl.ds
                )

                def ramp(time, dt):
                    load.value = 2e3 * min((time + dt / 2) / 0.1, 1.0)

                run = nts.simulate(system, nts.EnergyMomentum(), ..., before_step=ramp)

            It should depend on its arguments alone, as steps may be tried again. The first call
            comes before the row of the start. What changes a material's energy later is
            "material_change" in the balance.

        project_start: Start with the nearest velocities, in the kinetic energy, that the joints
            allow; else a start that violates a joint is refused with its name.

    Returns:
        The Solution. A run that fails says so in `status` and keeps everything computed until then,
        also where a function of time, `before_step` or a writer raises, or returns what it must
        not, on any rank: the run ends there, and all writers are closed. Only one that raises
        between collective calls of its own on some ranks alone makes the others wait for ever.

    Raises:
        TypeError: An argument is of another type.
        ValueError: An argument is out of range; before any work.
        Exception: Before any step, what the `start` of a writer raises.
    """
    require_positive("dt", dt, "s")
    require_positive("t_end", t_end, "s")
    require_bool("progress", progress)
    output = writers(output)
    if not isinstance(adapt, Adapt | None):
        raise TypeError(f"adapt={adapt!r}: pass Adapt(tolerance=...)")
    if adapt is not None and getattr(integrator, "order", _ADAPTED) != _ADAPTED:
        raise ValueError(
            f"adapt={adapt!r}: {integrator!r} is not of second order; leave adapt out, or choose "
            "another integrator"
        )
    newton = _newton(newton, accuracy)
    stepper = Stepper(
        system, integrator, newton=newton, petsc_options=petsc_options, start=start,
        start_time=start_time, sleep=sleep, watch_overlap=watch_overlap, before_step=before_step,
        project_start=project_start,
    )  # fmt: skip
    begin = stepper.state.time
    if not t_end > begin:
        raise ValueError(f"t_end={t_end!r}: must lie after the start's time {begin!r} [s]")
    remedy = "Try a smaller dt, a softer start, or inspect the nodes named here"
    if adapt is not None:
        end, dt = [float(t_end)], float(dt)
        return run(stepper, end, output, dt=dt, progress=progress, remedy=remedy, adapt=adapt)
    # Equal steps: a last step much shorter than the others would expel a node that the one before
    # left behind a facet with a speed of gap / dt.
    steps = max(1, math.ceil((t_end - begin) / dt * (1 - 1e-9)))
    dt = (float(t_end) - begin) / steps
    times = [begin + (k + 1) * dt for k in range(steps)]
    return run(stepper, times, output, dt=dt, progress=progress, remedy=remedy)


def _newton(newton: Newton | None, accuracy: str | None) -> Newton | None:
    if accuracy is None:
        return newton
    if newton is not None:
        raise ValueError(f"accuracy={accuracy!r}, newton={newton!r}: pass one of them")
    if not (isinstance(accuracy, str) and accuracy in ACCURACY):
        known = ", ".join(map(repr, ACCURACY))
        raise ValueError(f"accuracy={accuracy!r}: choose one of {known}")
    return ACCURACY[accuracy]


def run(
    stepper: Stepper,
    times: Sequence[float],
    output: Sequence[Writer],
    *,
    dt: float,
    progress: bool,
    remedy: str,
    adapt: Adapt | None = None,
) -> Solution:
    """Advance to each of the times, write, say how it ended, and free the stepper.

    Args:
        stepper: Stepper that has made no step.
        times: Where to go, increasing.
        output: Writers.
        dt: First step [s], the largest with `adapt`.
        progress: Show a progress line on rank 0.
        remedy: What to do if a step fails, for `status`.
        adapt: How to choose the steps between, each of which is written.
    """
    solution, root = stepper.solution, stepper.system.comm.rank == 0
    bar = _progress_bar(None if adapt else len(times), progress and root)
    started: list[Writer] = []
    try:
        try:
            _march(stepper, times, output, started, dt, adapt, bar)
            stepper.look(last=True)
            solution.finish()
        except UserFunctionError as failure:
            _stop(stepper, str(failure), failure.__cause__)
        except StepFailedError as failure:
            _stop(stepper, f"{failure}. {remedy}")
        except BaseException:
            # Where one rank alone comes here, no other answers.
            _call(stepper, started, "close")
            raise
        problem, cause = _call_together(stepper, started, "close")
        if problem is not None:
            _stop(stepper, problem, cause)
    finally:
        stepper.close()
        if bar is not None:
            bar.close()
    return solution


def _march(
    stepper: Stepper,
    times: Sequence[float],
    output: Sequence[Writer],
    started: list[Writer],
    dt: float,
    adapt: Adapt | None,
    bar: Any,
) -> None:
    """Make the steps and write them; arguments as of `run`, and the writers it has started."""
    pace = None
    if adapt is None:
        stepper.start(dt)
    else:
        stepper.start(adapt.shortest * dt)
        state = stepper.state
        pace = Pace(adapt, stepper.system, state, dt, times[-1] - state.time)
    started.extend(output)
    problem, cause = _call_together(stepper, output, "start")
    if problem is not None:
        raise cause or RuntimeError(problem)
    for last in _moves(stepper, times, pace):
        problem, cause = _call_together(stepper, output, "write", last=last)
        if problem is not None:
            raise UserFunctionError(problem) from cause
        if bar is not None:
            row = stepper.solution.rows[-1]
            active, newton = int(row["active"]), int(row["newton_iterations"])
            bar.set_postfix(active=active, newton=newton, refresh=False)
            bar.update()


def _stop(stepper: Stepper, reason: str, cause: BaseException | None = None) -> None:
    """Keep in the status why a run ended, and log it where it is known best."""
    solution = stepper.solution
    ended = not solution.status.startswith(("running", "completed"))
    solution.status = f"{solution.status}; {reason}" if ended else reason
    if stepper.system.comm.rank == 0 or cause is not None:
        logger.warning("%s", reason, exc_info=cause)


def _call(
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


def _call_together(
    stepper: Stepper, output: Sequence[Writer], name: str, **options: Any
) -> tuple[str | None, Exception | None]:
    """`_call` with the first problem of any rank, on all ranks alike. Every rank must call it."""
    problem, cause = _call(stepper, output, name, **options)
    return first_problem(stepper.system.comm, problem), cause


def _moves(stepper: Stepper, times: Sequence[float], pace: Pace | None) -> Iterator[bool]:
    """Advance from one state to be written to the next; tells whether it is the last."""
    for k, time in enumerate(times):
        final = k == len(times) - 1
        if pace is None:
            stepper.advance(time - stepper.state.time)
            yield final
        else:
            for _ in stepper.paced(pace, time):
                yield final and stepper.state.time == time


def writers(output: Any) -> tuple[Writer, ...]:
    """The argument `output`, checked."""
    wanted = "writers of dolfinx_nts.output, or others with the Writer protocol"
    return items("output", output, _is_writer, wanted)


def _progress_bar(steps: int | None, wanted: bool) -> Any:
    if not wanted:
        return None
    from tqdm import tqdm

    return tqdm(total=steps, unit="step")
