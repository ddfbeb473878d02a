"""Load steps: states at rest, one after the other, each relaxed from the last."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np

from dolfinx_nts.integrators import Static
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.ledger import balance, resultants
from dolfinx_nts.ledger.contact_fields import ContactLoads
from dolfinx_nts.parallel import anywhere, global_max, together
from dolfinx_nts.run import step_warnings
from dolfinx_nts.run.ledger_check import NOT_FINITE
from dolfinx_nts.run.solution import Equilibrium
from dolfinx_nts.run.stepper import Stepper
from dolfinx_nts.run.trial import solved, state_after
from dolfinx_nts.solve.convergence import unrest
from dolfinx_nts.solve.failure import used_up
from dolfinx_nts.start.free_motion import free_motion
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import StepFailedError, UserFunctionError

logger = logging.getLogger(__name__)

#: A load step is dropped if a slave ends this part of a facet behind one of which it was no
#: candidate.
_MISSED = 0.1
#: Relaxations of one load step before it counts as without equilibrium, and the fewest of a part of
#: it: the next attempt has half of those of one that has run out of them.
_RELAXATIONS, _FEWEST = 100, 25
#: Below this part of the forces the stabilization no longer moves nodes to other facets.
_NEARLY_AT_REST = 1e-2
#: A failed relaxation is repeated with a stiffer stabilization, up to this.
_STIFFEST = 10.0
#: A relaxation that leaves less than this part of the stabilization's force ...
_RELIEVED = 0.5
#: ... lowers the next one's stiffness by this. So does one of few iterations whose force stays, as
#: that of a body that swings or falls far, ...
_RELIEF, _EASY = 0.1, 10
#: ... as far as the next one then moves by less than this part of the scene.
_FAR = 0.3
#: A stiffness below which a relaxation has failed is tried again after so many more.
_FORGOTTEN = 4
#: Contacts are sought anew once bodies have moved by this part of the scene, or while more than
#: `_NEARLY_AT_REST` is left.
_NEAR = 0.05
#: Distance from the master's surface, in facet sizes, that carrying nodes may have which have left
#: their facets, by how often a load step at rest is sought again; in the valley between two facets
#: a node comes and goes.
_STRAYS = 1e-3, 1e-2, 1e-1
#: Part of the stored energy that the work of load steps may miss without a word.
_OPEN = 0.1
#: Rounding of work over that of forces times the size of the scene.
_ROUNDING = 16 * float(np.finfo(float).eps)

class _Relaxed:
    """What the relaxations of a load step took.

    Args:
        system: The scene.

    Attributes:
        of_joints: Columns of the balance table for energy that leaves through joints, and those
            of each of them.
        lost: By column, what left in all relaxations but the last one [J].
        driven: External work that the ledgers of each joint's elements name in all of them, this
            rank's part [J], shape (joints,).
    """

    def __init__(self, system: System) -> None:
        own = {name for joint in system.joints for name in joint.losses}
        self.of_joints = own | {name + balance.OF_JOINTS for name in own if system.declared_joints}
        self.lost: dict[str, Any] = dict.fromkeys(self.of_joints, 0.0)
        self.driven = np.zeros(len(system.joints))


class LoadStepper(Stepper):
    """Stepper in pseudo time; a step is relaxed until nothing of the stabilization is left."""

    makes = Equilibrium
    solution: Equilibrium

    def __init__(
        self, system: System, stabilization: float, end: float, **options: Any
    ) -> None:
        super().__init__(system, Static(), **options)
        self._stabilization, self._end = stabilization, end
        still = tuple(np.zeros_like(u) for u in self.state.u)
        self.solution.rates = self._of_start("rates") or still
        self.solution.forces = self._of_start("forces") or still
        self._solved: Evaluation | None = None
        self._relaxations = _RELAXATIONS
        #: Work of each load, support, joint and obstacle and of overlap [J]; the largest energy.
        self._worked: FloatArray | float = 0.0
        self._largest = 0.0
        resting = replace(self.state, v=still)
        self._accept(system.with_overlap(resting, self._left(self.state.time)))
        self._ledger.open(self.state, self._start)

    def _of_start(self, name: str) -> tuple[FloatArray, ...]:
        """`rates` or `forces` of the bodies in the equilibrium that this one goes on from."""
        values = getattr(self._start, name, ())
        if self._start is None or not values:
            return ()
        index = {body.name: k for k, body in enumerate(self._start.system.bodies)}
        return tuple(values[index[body.name]] for body in self.system.bodies)

    def start(self, dt: float) -> None:
        """Nothing moves at the start, but the user may change a material; later calls do nothing.

        Args:
            dt: First load step, in pseudo time.
        """
        if self._started:
            return
        self._between.begin(self.state.time, dt)
        self._ledger.open(self.state, self._start)
        step_warnings.tell_cut_off(self.solution, self.state)
        step_warnings.tell_units(self.solution, self.state.time, in_time=False)
        self._started = True

    def _step(self, dt: float, time: float) -> None:
        # The problem is about to begin another step, which may fail.
        self._solved = None
        self._between.prepare(self.state, dt)
        old = self.state
        step, state, iterations, relaxed = self._relax(dt, time)
        self._relaxations = _RELAXATIONS
        rates = tuple((a - b) / dt for a, b in zip(state.u, old.u, strict=True))
        forces = [t.external.copy() for t in step.bodies]
        local = []
        for k, (body, t) in enumerate(zip(self.system.bodies, step.bodies, strict=True)):
            forces[k][body.fixed] += t.residual[body.fixed]
            mean = 0.5 * (forces[k] + self.solution.forces[k])
            local.append(float(mean @ (state.u[k] - old.u[k])))
        self.solution.rates, self.solution.forces = rates, tuple(forces)
        local += self._joints_works(old, state, relaxed.driven)
        local.append(self._interference_work(old, state))
        *works, pressed = self.system.comm.allreduce(np.array(local)).tolist()
        before, both = self.solution.rows[-1], (resultants.of_step, balance.step_terms)
        asked: list[Any] = [of(self.problem, step) for of in both]
        forces_now, terms = together(self.system.comm, asked)
        for name, lost in relaxed.lost.items():
            terms[name] = terms[name] + lost
        if declared := len(self.system.declared_joints):
            of_joints = np.array(works[len(self.system.bodies) :])
            terms |= {
                f"external_work{balance.OF_JOINTS}": of_joints[:declared],
                f"contact_defect{balance.OF_JOINTS}": np.zeros(declared),
            }
        for k, pair in enumerate(self.system.contacts):
            mean = 0.5 * (before["contact_forces"][k] + forces_now["contact_forces"][k])
            start, end = pair.path(old.time, time)
            works.append(float(mean @ (end - start)))
        terms |= {"external_work": sum(works), "interference_work": pressed}
        terms |= {"time": time, "newton_iterations": iterations}
        terms |= {"contact_defect": 0.0, "material_change": self._ledger.take_change()}
        rows, measured = self.solution.rows, balance.measure(self.system, state)
        row = balance.next_row(float(rows.column("energy")[0]), before, measured, terms)
        rows.append(row | forces_now)
        self.solution.contact_loads = ContactLoads.of_step(self.problem, step)
        # A drive that lifts a weight does the work that the weight takes.
        self._worked = self._worked + np.array([*works, pressed])
        worked = float(np.abs(self._worked).sum())
        self._largest = max(self._largest, abs(row["potential"]), worked)
        missing, size = abs(row["ledger_residual"]), self._largest
        loads = sum(float(np.abs(t.external).sum()) for t in step.bodies)
        pressed = float(np.abs(forces_now[resultants.CONTACT_FORCES]).sum())
        pressed += self.system.comm.allreduce(loads)
        if not missing <= _OPEN * size:
            pressed += self._rounded_force(step)
        rounding = _ROUNDING * self.problem.rounded_length * pressed
        if not missing <= _OPEN * size + rounding:
            text = (
                f"work and stored energy differ by {missing:.3g} of {size:.3g}: "
                f"{self._remedy_of_ledger()}"
            )
            endless = not np.isfinite(missing)
            text = NOT_FINITE if endless else text
            self.solution.warn("ledger", time, missing, text, grave=endless)
        self._accept(state)
        step_warnings.tell_inversion(self.solution, self.problem, step, state)
        step_warnings.tell_couplings(self.solution, self.problem, step, state)
        step_warnings.tell_doubts(self.solution, state)
        self._solved = step
        self._locking.look()
        self.look()

    def _rounded_force(self, step: Evaluation) -> float:
        """What bodies that only move resist by rounding, over that of lengths [N]. Collective."""
        stiff = [body.nodal_stiffness().max(initial=0.0) for body in self.system.bodies]
        motion = self.problem.lengths.motion_of(step)
        return float((global_max(self.system.comm, np.array(stiff)) * motion).max())

    def _remedy_of_ledger(self) -> str:
        """Why the ledger is open, and what closes it."""
        if self._start is None and self.solution.rows[0]["potential"] > self._largest * _OPEN:
            return (
                "the first load step starts from a displacement with that much energy, such as "
                "Dirichlet values other than 0 at t=0, which act at once; let them be functions "
                "of the pseudo time, e.g. value=lambda t: (0, 0, 0.1 * t)"
            )
        return "work is that of the mean forces of each load step; use more load steps"

    def _joints_works(self, old: State, new: State, told: FloatArray) -> list[float]:
        """External work of what each joint prescribes in a load step on this rank [J]. Collective.

        Args:
            old: At its start.
            new: At its end.
            told: What the ledgers of each joint's elements say, shape (joints,).
        """
        works = np.zeros(len(told))
        for coupling, (k, *_) in self.problem.couplings.joints:
            # Several that are evaluated together prescribe nothing.
            found = coupling.load_step_work(old.joints[k], new.joints[k], old.time, new.time)
            works[k] = told[k] if found is None else found
        return works.tolist()

    def _left(self, time: float) -> float:
        """Part of the overlap at the start that is left at a pseudo time."""
        return 1.0 - self.problem.integrator.ramp(time)

    def _interference_work(self, old: State, new: State) -> float:
        """Work on this rank of overlap that a load step presses out [J], of the mean forces."""
        pressed = self._left(old.time) - self._left(new.time)
        both = zip(old.contacts, new.contacts, strict=True)
        return pressed * sum(float(b.overlap @ (a.force + b.force)) / 2.0 for a, b in both)

    def _look_inside(self, last: bool) -> None:
        """Look, unless overlap is left that a contact is to resolve. Collective."""
        both = zip(self.system.pairs, self.state.contacts, strict=True)
        asked = any(p.interference == "resolve" and bool(c.overlap.any()) for p, c in both)
        if not (self._left(self.state.time) and anywhere(self.system.comm, asked)):
            super()._look_inside(last)

    def look(self, *, last: bool = False) -> None:
        """Look as `Stepper` does, and at the end for motions that nothing resists and for loads."""
        super().look(last=last)
        if last and not self._stabilization and self._solved is not None:
            step_warnings.tell_at_rest(self.solution, self.solver, self._solved, self.state)
        if last:
            step_warnings.tell_part_of_loads(self.solution, self.problem, self.state, self._end)

    def _relax(self, dt: float, time: float) -> tuple[Evaluation, State, int, _Relaxed]:
        """Solution of a load step, its state, Newton iterations, what the relaxations took.

        Each relaxation starts where the last one ended and is held there a little by the
        stabilization: a proximal-point iteration, whose limit knows nothing of it. Where something
        else resists all motions as the step begins, it is tried without before.
        """
        problem, kept, iterations, last = self.problem, self.state, 0, np.inf
        search, lowest, since, way, moved, tried = True, 0.0, 0, 0.0, 0.0, False
        size = problem.lengths.radius + problem.lengths.director
        relaxed, strays = _Relaxed(self.system), iter(_STRAYS)
        problem.stabilization.share = self._stabilization
        state = replace(kept, v=self.solution.rates)
        try:
            for number in range(1, self._relaxations + 1):
                self.interrupts.check()
                try:
                    if self._stabilization and not tried:
                        tried, problem.stabilization.share = True, 0.0
                        if self._unheld(state, dt):
                            problem.stabilization.share = self._stabilization
                    step = self._solve(state, dt, search)
                    reached = state_after(problem, step, time)
                    # What each slipped is that of the whole load step.
                    contacts = tuple(
                        new._replace(slip=start.slip + new.slip - old.slip)
                        for start, old, new in zip(
                            kept.contacts, state.contacts, reached.contacts, strict=True
                        )
                    )
                    reached = replace(reached, contacts=contacts)
                    self._check_missed(reached)
                    moved = float(problem.lengths.motion_of(step).max()) / size
                    if moved > _FAR and self._stabilization and not problem.stabilization.share:
                        raise StepFailedError("without stabilization bodies move far")
                except UserFunctionError:
                    raise
                except StepFailedError as failure:
                    if self._stabilization and not problem.stabilization.share:
                        problem.stabilization.share = self._stabilization
                        continue
                    # Bodies in search of each other move by load over stabilization, whatever dt.
                    if not 0.0 < problem.stabilization.share < _STIFFEST:
                        unheld = self._unheld(state, dt)
                        advises = bool(unheld) or failure.advises
                        raise StepFailedError(f"{unheld}{failure}", advises=advises) from failure
                    problem.stabilization.share /= _RELIEF
                    lowest, since = problem.stabilization.share, 0
                    continue
                iterations += step.iterations
                told = balance.told_by_joints(problem, step)
                relaxed.driven += told.get("external_work", 0.0)
                state, dt = reached, 0.0
                left, restless = unrest(problem, step)
                self._tell_relaxed(time, number, step.iterations, restless, moved * size)
                if left <= 1.0:
                    allowed = next(strays, np.inf)
                    if problem.couplings.contacts.strayed(step) <= allowed:
                        return step, state, iterations, relaxed
                (terms,) = together(self.system.comm, [balance.step_terms(problem, step)])
                for name in relaxed.of_joints:
                    relaxed.lost[name] = relaxed.lost[name] + terms[name]
                if left <= 1.0:
                    # On the facets that its nodes have come to, the rest is another one.
                    search, last = True, np.inf
                    continue
                share, since = problem.stabilization.share, since + 1
                if forgotten := since >= _FORGOTTEN:
                    lowest, since = 0.0, 0
                if left < _RELIEVED * last:
                    # As far as Newton's method takes it, or the last digits took most repeats.
                    fell = max(left / last, _RELIEF**3) if last < np.inf else _RELIEF
                    problem.stabilization.share *= min(_RELIEF, fell)
                elif step.iterations <= _EASY or forgotten:
                    lower = share * min(max(_RELIEF, moved / _FAR), 1.0)
                    problem.stabilization.share = max(lower, min(lowest, share))
                last, way = left, moved if search else way + moved
                # A node on an edge could change its facet for ever, and its place with it.
                search = left * self.newton.rtol > _NEARLY_AT_REST or way > _NEAR
        finally:
            problem.stabilization.share = 0.0
        slides = used_up(problem, step)
        without_rest = self.solver.with_flat(
            f"{slides}step from t={kept.time:.6g}: body {restless!r} is not at rest after "
            f"{self._relaxations} relaxations, the last of which moves it by {moved * size:.3g}, "
            f"{moved:.2g} of the scene; nothing holds it, or it hops from facet to facet",
            step, advises=bool(slides),
        )  # fmt: skip
        self._relaxations = max(self._relaxations // 2, min(self._relaxations, _FEWEST))
        raise without_rest

    def _tell_relaxed(
        self, time: float, number: int, iterations: int, restless: str, moved: float
    ) -> None:
        """Tell of a relaxation under stabilization, which a load step may take many of."""
        if self.problem.stabilization.share:
            text = f"t={time:.6g}, repeat {number} of at most {self._relaxations}"
            self.note(text)
            logger.info(
                "%s: %d iterations, body %r moves by %.3g", text, iterations, restless, moved
            )

    def _unheld(self, state: State, dt: float) -> str:
        """What nothing resists where a failed load step starts, or nothing. Collective."""
        if self.problem.stabilization.share:
            return ""
        self.problem.begin(state, dt)
        self.solver.prepare()
        start = self.problem.evaluate(self.problem.x)
        found = free_motion(self.problem, self.solver, start)
        if not found:
            return ""
        return (
            f"{found}, where the step starts: hold it by a Dirichlet condition, a joint or contact "
            "that touches there, or pass stabilization=0.1; "
        )

    def _solve(self, state: State, dt: float, search: bool) -> Evaluation:
        """Solution from a state; contact is sought as far as the bodies turn out to move."""
        self.problem.begin(state, dt, search=search)
        return solved(self.problem, self.solver) if search else self.solver.solve()

    def _check_missed(self, state: State) -> None:
        """Raise if a slave went through a facet whose candidate it was not."""
        depths = self.system.penetration(state, self._left(state.time))
        for pair, depth in zip(self.system.contacts, depths, strict=True):
            if depth.max(initial=0.0) > _MISSED:
                node = int(pair.slave.original[depth.argmax()])
                raise StepFailedError(
                    f"step from t={self.state.time:.6g}: contact {pair.name!r}: node {node} passed "
                    f"by its facet and ended {depth.max():.3g} of a facet inside the master"
                )
