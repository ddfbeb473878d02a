"""The equations of one step: residual and tangents of bodies.

What couples bodies comes as `Elements`, of whatever kind they are.

The momentum equation is multiplied by h/2 and the multipliers are h^2/2 lambda (theory section 8),
which makes the condition number independent of h. Equilibrium has a factor 1 for h^2/2 and no
inertia: its equations are in [N] where [kg m] stands here, its matrix in [N/m]. Evaluations are
pure: nothing here changes a State, and history changes only when a step is accepted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_laws import Contribution
from dolfinx_nts.contact.contact_search import ContactSearch
from dolfinx_nts.coupling import Coupling, JointCoupling
from dolfinx_nts.elements import Step, evaluate_together
from dolfinx_nts.evaluation import BodyTerms, Evaluation, Moment, free
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import ContactHistory, State
from dolfinx_nts.step.least_norm import hanging
from dolfinx_nts.step.rounding import Rounding
from dolfinx_nts.step.shared_weight import SharedWeight
from dolfinx_nts.step.sleep import Sleepers
from dolfinx_nts.step.stabilization import Stabilization
from dolfinx_nts.step.unknowns import Unknowns
from dolfinx_nts.system import System

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

class Lengths(NamedTuple):
    """Lengths of each body in a step [m], shape (bodies,).

    Attributes:
        motion: Largest motion of a point that is predicted.
        extent: Largest coordinate.
        moved: Largest displacement at t_n.
    """

    motion: FloatArray
    extent: FloatArray
    moved: FloatArray


class StepProblem:
    """Equations of one step of a system; `begin` fixes the step.

    Args:
        system: The scene.
        integrator: Rules of the step, or `Static()`.
        rtol: Residual of a block that counts as solved, relative to the forces or motions of the
            step.
        condense: Eliminate (d, f) and their multipliers pair by pair.
        sleep: Leave out bodies that nothing moves.

    Attributes:
        awake: Numbers of the bodies that are in the step; the others stay exactly where they are.
        contacts: What makes the elements of contacts. Used directly only for what contacts alone
            have: `touching`, closing gaps, checkpoints.
        joints: What makes those of each joint.
        couplings: All that makes elements.
        unknowns: Their layout; made anew whenever the elements' coordinates change.
        version: Changes whenever `unknowns` does.
        factor: What the equations multiply forces by, h^2/2 [s^2] or 1.
        rtol: As given.
        rounding: What part of the forces on bodies is rounding.
        centre: Middle of all bodies in the reference [m], shape (3,).
        stabilization: In statics, what holds each node at t_n.
        lengths: Lengths of the step, after `begin`.
        flight: M (u_1 - u_0) of each body in free flight [kg m], after `begin`; zero in statics.
    """

    def __init__(
        self, system: System, integrator: Any, *, rtol: float, condense: bool, sleep: bool = False
    ) -> None:
        self.system, self.integrator = system, integrator
        self.rtol, self.condense = rtol, condense
        self._sleepers = Sleepers(system.bodies, system.comm) if sleep else None
        self._asleep: dict[int, BodyTerms] = {}
        self.awake: tuple[int, ...] = ()
        self._numbers: tuple[Any, ...] | None = None
        self.contacts = ContactSearch(system.contacts, system.contact_bodies, system.comm)
        self._shared = SharedWeight(system.comm, system.contacts)
        both = zip(system.joints, system.joint_bodies, strict=True)
        self.joints: list[JointCoupling] = [joint.coupling(bodies) for joint, bodies in both]
        self._lend_less()
        self.couplings: list[Coupling] = [self.contacts, *self.joints]
        self.unknowns: Unknowns | None = None
        self.version = 0
        self.centre, span, directors = _box(system)
        self._span = span + directors
        self.stabilization = Stabilization(system, span, self._largest_load)
        self.rounding = Rounding(
            system.bodies, lambda k: self.body_tangent(k, self.state.u[k]), self._springs
        )

    def _lend_less(self) -> None:
        """Lend no compliance to joints of rigid bodies that form no loop. Collective."""
        system = self.system
        found: list[tuple[JointCoupling | None, tuple[int, ...]]] = []
        of = zip(system.declared_joints, self.joints, system.joint_bodies, strict=False)
        for joint, coupling, bodies in of:
            still = [np.zeros(body.num_owned) for body in joint.bodies]
            if joint.slopes(still, joint.start()) is not None:  # a spring holds nothing
                continue
            rigid = all(body.rigid for body in joint.bodies)
            found.append((coupling if rigid else None, bodies))
        moved = system.comm.allreduce(np.array([b.fixed.size for b in system.bodies]))
        free = {k for k, b in enumerate(system.bodies) if b.rigid and not moved[k]}
        alone = hanging([bodies for _, bodies in found], free)
        for (rigid_ones, _), hangs in zip(found, alone, strict=True):
            if rigid_ones is not None and hangs:
                rigid_ones.hold_alone()

    # ---- set-up of a step
    def begin(
        self,
        state: State,
        dt: float,
        again: Evaluation | None = None,
        *,
        search: bool = True,
        moments: Sequence[Moment] | None = None,
    ) -> None:
        """Fix the state at t_n and the step: loads, candidates, layout, first guess.

        Args:
            state: State at t_n.
            dt: Step [s].
            again: Solution of this step whose motion the elements did not cover, see `misses`:
                contact is sought along that motion in place of the one that velocities predict.
            search: Seek contacts; False keeps the candidates of the last step, for statics only.
            moments: Where the forces on each body are taken; None: as the integrator's step has it.
        """
        system = self.system
        self.state, self.dt, self.factor = state, dt, self.integrator.factor(dt)
        if moments is None:
            moments = [self._moment(k) for k in range(len(system.bodies))]
        self._moments = list(moments)
        for body, moment in zip(system.bodies, moments, strict=True):
            body.begin_step(self.integrator, moment)
        self._gravity = self.integrator.ramp(self._when) * system.gravity
        self.lengths, speed = self._fly()
        way = [u1 - u for u1, u in zip(self.first, state.u, strict=True)]
        if again is not None:
            motion = np.maximum(self.lengths.motion, self.motion(again))
            self.lengths = self.lengths._replace(motion=motion)
            way = [terms.du for terms in again.bodies]
        motion, extent, moved = self.lengths
        # Bodies at rest may fall.
        length = moved + motion + dt**2 * float(np.linalg.norm(self._gravity))
        # A body at rest beside a moving one gets the rounding of the linear solve for both.
        for bodies in map(list, (*system.contact_bodies, *system.joint_bodies)):
            length[bodies] = length[bodies].max()
        self.rounding.begin(self.factor, length, moved, extent)
        step = Step(
            state, dt, self.factor, self.integrator, self.condense, self.first, way,
            motion, length, self.stabilization.stiffness, moments, self.rounding.of,
        )  # fmt: skip
        histories: tuple[Any, ...] = (state.contacts, *state.joints)
        for coupling, history in zip(self.couplings, histories, strict=True):
            coupling.begin(step, history, again, search)
        self._asleep = self._find_asleep(np.maximum(motion, speed) == 0.0)
        self._lay_out()

    def _fly(self) -> tuple[Lengths, FloatArray]:
        """Set `first` and `flight`, the step without forces. Collective.

        Returns:
            Its lengths, and the largest speed of each body [m/s], shape (bodies,).
        """
        system, state, dt = self.system, self.state, self.dt
        flight = [self.integrator.ahead(v, self.acceleration(k), dt) for k, v in enumerate(state.v)]
        self.first = [u + ahead for u, ahead in zip(state.u, flight, strict=True)]
        for body, u1 in zip(system.bodies, self.first, strict=True):
            u1[body.fixed] = body.prescribed(state.time + dt)
        local = [
            [
                b.motion_of_points(u1 - u),
                *(np.abs(x).max(initial=0.0) for x in (b.reference + u1, v, u)),
            ]
            for b, u1, u, v in zip(system.bodies, self.first, state.u, state.v, strict=True)
        ]
        motion, extent, speed, moved = global_max(system.comm, np.array(local)).T
        if state.a:
            local = [np.abs(dt * a).max(initial=0.0) for a in state.a]
            speed = np.maximum(speed, global_max(system.comm, np.array(local)))
        # In statics v only predicts the first guess.
        moves = (speed > 0.0) & self.integrator.inertia
        self.flight = [
            self._inertial(b, ahead) if top else np.zeros_like(ahead)
            for b, ahead, top in zip(system.bodies, flight, moves, strict=True)
        ]
        return Lengths(motion, extent, moved), speed

    @property
    def elements(self) -> list[Any]:
        """Batches of elements in the step."""
        return [batch for coupling in self.couplings for batch in coupling.elements]

    @property
    def bodies(self) -> list[tuple[int, ...]]:
        """Numbers of the bodies of each batch."""
        return [of for coupling in self.couplings for of in coupling.bodies]

    def each(self, e: Evaluation) -> Iterator[tuple[Coupling, tuple[Any, ...]]]:
        """Couplings with their parts of an evaluation."""
        yield self.contacts, e.parts[: len(self.contacts.elements)]
        yield from self.of_joints(e)

    def of_joints(self, e: Evaluation) -> Iterator[tuple[JointCoupling, tuple[Any, ...]]]:
        """Those of `System.joints`."""
        start = len(self.contacts.elements)
        for coupling in self.joints:
            stop = start + len(coupling.elements)
            yield coupling, e.parts[start:stop]
            start = stop

    def touching(
        self, e: Evaluation
    ) -> list[tuple[ContactElements, Contribution, ContactHistory]]:
        """Of each contact its elements, their part of an evaluation, and its memory of t_n.

        For results that only contacts have: pressures, impacts, changes of facet.
        """
        elements = self.contacts.elements
        parts: Any = e.parts[: len(elements)]
        return list(zip(elements, parts, self.state.contacts, strict=True))

    def forget_forces(self) -> None:
        """Take no body's forces from an earlier step: parameters of materials have changed."""
        if self._sleepers is not None:
            self._sleepers.forget()

    def wake(self, e: Evaluation) -> bool:
        """Whether a solved step asks for more elements, and is to be solved again. Collective.

        Args:
            e: Solution of the step without them.
        """
        u1 = [terms.u1 for terms in e.bodies]
        if not any([coupling.wake(u1) for coupling in self.couplings]):
            return False
        for k in self._asleep.keys() & self._touched():
            del self._asleep[k]
        self._lay_out()
        return True

    def misses(self, e: Evaluation) -> bool:
        """Whether a solved step may have passed by something. Collective.

        If so, `begin` is to be called again with it.

        Raises:
            StepFailedError: Only a shorter step helps.
        """
        motion = self.motion(e)
        return any([coupling.misses(e, parts, motion) for coupling, parts in self.each(e)])

    @property
    def may_slip(self) -> bool:
        """Whether `let_slip` changes anything."""
        return any(coupling.may_slip for coupling in self.couplings)

    def let_slip(self) -> None:
        """Let sticking nodes slip under a slight pull in the iterations; no solution changes."""
        for coupling in self.couplings:
            coupling.let_slip()

    def give_way(self) -> bool:
        """From the next step on, limit forces that had no limit; return whether there was one."""
        return any([coupling.give_way() for coupling in self.couplings])

    def _touched(self) -> set[int]:
        """Bodies that elements move, the same on all ranks. Collective."""
        return set().union(*(coupling.touched() for coupling in self.couplings))

    def _lay_out(self) -> None:
        """Layout of the unknowns, kept while no rank's elements change, and a first guess."""
        system = self.system
        if len(self._asleep) == len(system.bodies):
            # SNES needs an unknown; at rest it takes no iteration.
            del self._asleep[0]
        self.awake = tuple(k for k in range(len(system.bodies)) if k not in self._asleep)
        elements = self.elements
        widths = np.array([list(c.widths.values()) for c in elements])
        numbers = (np.array(self.awake), widths, *(a for c in elements for a in c.points()))
        if not system.comm.allreduce(_equal(numbers, self._numbers), op=MPI.LAND):
            self.destroy()
            sizes = {k: system.bodies[k].num_owned for k in self.awake}
            self.unknowns = Unknowns(system.comm, sizes, elements, self.bodies)
            self.version += 1
            self._numbers = numbers
        self.guess(flight=True)

    @property
    def x(self) -> Any:
        """PETSc vector of the unknowns, holding the first guess after `begin`."""
        return self.laid.x

    def of_body(self, k: int) -> slice:
        """Where a body that is awake stands among this rank's unknowns."""
        return self.laid.of_body(k)

    @property
    def of_constraints(self) -> slice:
        """Where the elements' multipliers stand among this rank's unknowns."""
        return self.laid.of_elements("constraints")

    @property
    def laid(self) -> Unknowns:
        """The layout, after `begin`."""
        assert self.unknowns is not None, "begin comes first"
        return self.unknowns

    @property
    def _when(self) -> float:
        """When the step takes its loads [s]."""
        return self.state.time + self.integrator.theta * self.dt

    def acceleration(self, k: int) -> FloatArray | None:
        """Of a body at t_n [m/s^2], if the integrator carries it."""
        return self.state.a[k] if self.state.a else None

    def _moment(self, k: int) -> Moment:
        """What a body is told of the step."""
        rule, state, drift = self.integrator, self.state, None
        if rule.accelerations:
            v0 = state.v[k]
            end, _ = rule.advance(np.zeros_like(v0), v0, self.acceleration(k), self.dt)
            drift = (1.0 - rule.theta) * v0 + rule.theta * end
        # Load steps of equilibrium end with some of no length.
        rate = rule.theta * rule.rate(self.dt) if rule.inertia else 0.0
        return Moment(state.u[k], self._when, rule.ramp(self._when), rate, drift)

    def work_at_ends(self, e: Evaluation) -> list[float]:
        """What work of loads at both ends adds on this rank, by body, times `factor`. Collective.

        v_0 + v_1 = 2 (u_1 - u_0)/h makes the mean of the forces at both ends do the work in the
        methods that carry accelerations, not those where the step takes them. Loads that are
        functions of time differ; of others, and of other methods, it is 0. What loads push at
        prescribed coordinates goes into the supports: their reactions hold it.

        Args:
            e: Solution of the step.
        """
        works = [0.0] * len(e.bodies)
        if not self.integrator.accelerations:
            return works
        ends = self.state.time, self.state.time + self.dt
        for k, (body, terms) in enumerate(zip(self.system.bodies, e.bodies, strict=True)):
            # Loads that do not change have the same mean, and users' functions are not asked.
            if not body.loads_in_time:
                continue
            mean = np.zeros_like(terms.du)
            for time in ends:
                body.begin_step(self.integrator, self._moments[k]._replace(time=time))
                mean += 0.5 * self.factor * body.external(terms.u1, self._gravity)
            body.begin_step(self.integrator, self._moments[k])
            here = self.factor * body.external(terms.u1, self._gravity)
            works[k] = float(free(body, mean - here) @ terms.du)
        return works

    def _largest_load(self) -> float:
        """Largest load but gravity on a coordinate, all of its ramp [N]. Collective."""
        largest, none = 0.0, np.zeros(3)
        for body, moment in zip(self.system.bodies, self._moments, strict=True):
            body.begin_step(self.integrator, moment._replace(ramp=1.0))
            load = np.abs(body.external(np.zeros(body.num_owned), none))
            largest = max(largest, float(load.max(initial=0.0)))
            body.begin_step(self.integrator, moment)
        return float(global_max(self.system.comm, np.array([largest]))[0])

    def _find_asleep(self, rest: BoolArray) -> dict[int, BodyTerms]:
        """Those of the bodies at rest, shape (bodies,), that neither force nor contact may move."""
        if self._sleepers is None:
            return {}
        chosen = sorted(set(np.flatnonzero(rest).tolist()) - self._touched())
        u, f = self.state.u, self.factor
        found = self._sleepers.find(chosen, u, self._gravity, self.rounding.at_rest)
        none = {k: np.zeros_like(u[k]) for k in found}
        return {
            k: BodyTerms(u[k], none[k], f * a, f * b, none[k], f * (a - b))
            for k, (a, b) in found.items()
        }

    def _inertial(self, body: Any, du: FloatArray) -> FloatArray:
        """M du of a motion [kg m]; in statics the force of the stabilization [N]."""
        if self.integrator.inertia:
            force: FloatArray = body.inertia(du)
            return force
        return self.stabilization.of(body) * du

    def guess(self, *, flight: bool, carried: bool = False) -> None:
        """Write a first guess into `x`: motion, contact forces, d and f that fit the positions.

        Args:
            flight: Free flight from t_n under the contact forces of the last step; else the
                positions of t_n, which free flight of a fast turning or vibrating body may invert,
                and no forces. Prescribed coordinates are at t_{n+1}.
            carried: Take the contact forces of the last step unchanged, whatever `flight` is, even
                where they are a poor guess.
        """
        laid, elements = self.laid, self.elements
        with self.x as x:
            x[:] = 0.0
            for k in self.awake:
                fixed, u1 = self.system.bodies[k].fixed, self.first[k]
                start = u1 if flight else self.state.u[k].copy()
                start[fixed] = u1[fixed]
                x[laid.of_body(k)] = start
        if "constraints" in laid.own and (flight or carried or not self.integrator.inertia):
            places = iter(laid.positions(self.x, elements))
            guess = [
                coupling.guess(k, next(places)).ravel()
                for coupling in self.couplings
                for k in range(len(coupling.elements))
            ]
            if carried:
                of_contacts = range(len(self.contacts.elements))
                guess[: len(of_contacts)] = [self.contacts.carried(k).ravel() for k in of_contacts]
            with self.x as x:
                x[laid.of_elements("constraints")] = np.concatenate(guess)
        if "augmented" in laid.own:
            positions = laid.positions(self.x, elements)
            guess = [c.initial_guess(p).ravel() for c, p in zip(elements, positions, strict=True)]
            with self.x as x:
                x[laid.of_elements("augmented")] = np.concatenate(guess)

    # ---- iterates
    def evaluate(self, x: Any) -> Evaluation:
        """The step equations at an iterate; no state changes. Every rank must call it.

        Args:
            x: PETSc vector of the unknowns.
        """
        values, laid, elements = x.array_r.copy(), self.laid, self.elements
        positions = laid.positions(x, elements) if laid.blocks else [np.empty(0)] * len(elements)
        own = laid.own_values(values, elements)
        parts = evaluate_together(self.system.comm, elements, positions, own)
        touching = len(self.contacts.elements)
        self._shared.divide(
            self.contacts.elements, self.contacts.bodies, parts[:touching], positions[:touching],
            self._closed,
        )  # fmt: skip
        force = laid.forces(elements, parts) if laid.blocks else np.zeros(len(values))
        bodies = dict(self._asleep)
        for k in self.awake:
            body, u0, here = self.system.bodies[k], self.state.u[k], laid.of_body(k)
            u1 = values[here]
            internal = self.factor * body.internal(u1)
            external = self.factor * body.external(u1, self._gravity)
            du, coupling = u1 - u0, force[here]
            residual = self._inertial(body, du) - self.flight[k] + internal - external + coupling
            bodies[k] = BodyTerms(u1, du, internal, external, coupling, residual)
        return Evaluation(values, tuple(bodies[k] for k in sorted(bodies)), parts)

    def _closed(self, batch: ContactElements) -> float:
        """Gap of a batch that surely counts as closed [m], see `ContactElements.ratios`."""
        motion, moved = (float(a.max()) for a in (self.lengths.motion, self.lengths.moved))
        limits = batch.ratios(np.array([0.0, 1.0, 0.0, 0.0]), motion, motion + moved, self.rtol)
        return 1.0 / limits[f"{batch.name} constraints"]

    def residual(self, e: Evaluation) -> FloatArray:
        """This rank's part of the residual, zero at prescribed coordinates."""
        laid = self.laid
        out = np.zeros(len(e.x))
        for k in self.awake:
            out[laid.of_body(k)] = free(self.system.bodies[k], e.bodies[k].residual)
        for name in laid.own:
            rows = [c.rows(p, name).ravel() for c, p in zip(self.elements, e.parts, strict=True)]
            out[laid.of_elements(name)] = np.concatenate(rows)
        return out

    def body_tangents(self, e: Evaluation) -> list[Any]:
        """PETSc matrices of the bodies that are awake at an iterate, without contact."""
        return [self.body_tangent(k, e.bodies[k].u1) for k in self.awake]

    def body_tangent(self, k: int, u1: FloatArray) -> Any:
        """PETSc matrix of a body at a displacement, without contact."""
        mass = 1.0 if self.integrator.inertia else 0.0
        a = self.system.bodies[k].tangent(u1, mass, self.factor)
        if self.stabilization.share:
            held = a.createVecLeft()
            held.array_w[:] = self.stabilization.of(self.system.bodies[k])
            a.setDiagonal(held, addv=PETSc.InsertMode.ADD_VALUES)
            held.destroy()
        return a

    def measure_rounding(self, e: Evaluation) -> None:
        """Measure the rounding of the forces anew, at an iterate's motion. Collective.

        Args:
            e: Iterate whose motion is longer than the one that was predicted, at most the extent.
        """
        self.rounding.length = np.maximum(self.rounding.length, self.displacement(e))
        self.rounding.measure(self.awake)
        self.rounding.measure_springs()

    def _springs(self) -> FloatArray:
        """Norm of the stiffness at t_n of elements without unknowns, of each body. Collective."""
        laid, elements, start = self.laid, self.elements, self.x.duplicate()
        local = np.zeros(len(self.system.bodies))
        start.set(0.0)
        for k in self.awake:
            start.array_w[laid.of_body(k)] = self.state.u[k]
        positions = laid.positions(start, elements)
        own = laid.own_values(start.array_r, elements)
        start.destroy()
        chosen = [i for i, batch in enumerate(elements) if not any(batch.widths.values())]
        parts = evaluate_together(
            self.system.comm,
            [elements[i] for i in chosen],
            [positions[i] for i in chosen],
            [own[i] for i in chosen],
        )
        for i, part in zip(chosen, parts, strict=True):
            first = 0
            for k, dofs in zip(self.bodies[i], elements[i].dofs(), strict=True):
                stop = first + dofs.shape[1]
                along = part.tangent[:, first:stop, first:stop].diagonal(axis1=1, axis2=2)
                local[k] += float(np.square(along[dofs >= 0]).sum())
                first = stop
        found: FloatArray = np.sqrt(self.system.comm.allreduce(local))
        return found

    # ---- lengths and rounding
    def displacement(self, e: Evaluation) -> FloatArray:
        """Largest displacement of each body in an evaluation [m]. Collective.

        An iterate that runs off excuses no more than the positions would.
        """
        local = np.array([np.abs(terms.u1).max(initial=0.0) for terms in e.bodies])
        there = self.lengths.extent + self.lengths.moved
        return np.minimum(global_max(self.system.comm, local), there)

    @property
    def momentum_rounding(self) -> float:
        """Change of momentum in the step that is rounding [kg m/s]."""
        rate = self.integrator.rate(self.dt)
        return float(self.rounding.forces.sum() * np.sqrt(self.system.size) * rate)

    @property
    def span(self) -> float:
        """Distance of the bodies' farthest coordinate from `centre` [m], at most."""
        return self._span + float((self.lengths.moved + self.lengths.motion).max())

    @property
    def rounded_length(self) -> float:
        """Largest length whose rounding enters forces and gaps [m]. Collective."""
        local = max([self.span, *(c.extent for c in self.elements)])
        return float(global_max(self.system.comm, np.array([local]))[0])

    def motion(self, e: Evaluation) -> FloatArray:
        """Largest component of each body's motion in the step [m], the same on all ranks."""
        both = zip(self.system.bodies, e.bodies, strict=True)
        local = [body.motion_of_points(terms.du) for body, terms in both]
        return global_max(self.system.comm, np.array(local))

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        if self.unknowns is not None:
            self.unknowns.destroy()
        self.unknowns, self._numbers = None, None


def _box(system: System) -> tuple[FloatArray, float, float]:
    """Middle of the box around all bodies' places, half its diagonal, longest director [m].

    All in the reference. Collective.
    """
    ends = np.full((3, 3), -np.inf)
    ends[2] = 0.0
    for body in system.bodies:
        x = body.reference.reshape(-1, 3)
        directors, x = x[~body.places], x[body.places]
        np.maximum(ends[0], x.max(axis=0, initial=-np.inf), ends[0])
        np.maximum(ends[1], (-x).max(axis=0, initial=-np.inf), ends[1])
        ends[2, 0] = max(ends[2, 0], np.linalg.norm(directors, axis=1).max(initial=0.0))
    high, low, (directors, *_) = global_max(system.comm, ends) * [[1.0], [-1.0], [1.0]]
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)), float(directors)


def _equal(a: tuple[Any, ...], b: tuple[Any, ...] | None) -> bool:
    if b is None or len(a) != len(b):
        return False
    return all(x is y or np.array_equal(x, y) for x, y in zip(a, b, strict=True))
