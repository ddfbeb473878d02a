"""The equations of one step: residual, tangents of bodies, convergence of each block.

What couples bodies comes as `Elements`, of whatever kind they are.

The momentum equation is multiplied by h/2 and the multipliers are h^2/2 lambda (theory section 8),
which makes the condition number independent of h. Equilibrium has a factor 1 for h^2/2 and no
inertia: its equations are in [N] where [kg m] stands here, its matrix in [N/m]. Evaluations are
pure: nothing here changes a State, and history changes only when a step is accepted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from dolfinx_nts.bodies.body import Moment
from dolfinx_nts.contact.contact_elements import ContactElements, ContactHistory
from dolfinx_nts.contact.contact_laws import Contribution
from dolfinx_nts.contact.contact_search import ContactSearch
from dolfinx_nts.elements import Coupling, JointCoupling, Step, over
from dolfinx_nts.parallel import global_max
from dolfinx_nts.step.evaluation import BodyTerms, Evaluation
from dolfinx_nts.step.rounding import Rounding
from dolfinx_nts.step.sleep import Sleepers
from dolfinx_nts.step.unknowns import Unknowns
from dolfinx_nts.system import State, System

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

#: Rounding of a sum of elements' forces over the norm of all of them: their own rounding and that
#: of the solution, which the elements' stiffness passes on.
_CANCELLED = 32 * float(np.finfo(float).eps)


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
        contacts: What makes the elements of contacts. Asked by itself where contact is meant: by
            `touching`, for when gaps close, and for what a checkpoint keeps of slave nodes.
        joints: What makes those of each joint.
        couplings: All that makes elements.
        unknowns: Their layout; made anew whenever the elements' coordinates change.
        version: Changes whenever `unknowns` does.
        factor: What the equations multiply forces by, h^2/2 [s^2] or 1.
        rtol: As given.
        rounding: What part of the forces on bodies is rounding.
        centre: Middle of all bodies in the reference [m], shape (3,).
        stabilization: In statics, the stiffness that holds each node at t_n over its own stiffness.
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
        both = zip(system.joints, system.joint_bodies, strict=True)
        self.joints: list[JointCoupling] = [joint.coupling(bodies) for joint, bodies in both]
        self.couplings: list[Coupling] = [self.contacts, *self.joints]
        self.unknowns: Unknowns | None = None
        self.version = 0
        self.stabilization = 0.0
        self.centre, self._span = _box(system)
        self.rounding = Rounding(
            system.bodies, lambda k: self.body_tangent(k, self.state.u[k])
        )

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
        for body, moment in zip(system.bodies, moments, strict=True):
            body.begin_step(self.integrator, moment)
        self._gravity = self.integrator.ramp(self._when) * system.gravity
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
        top = global_max(system.comm, np.array(local)).T
        self._motion, self._extent, speed, self._moved = top
        if state.a:
            local = [np.abs(dt * a).max(initial=0.0) for a in state.a]
            speed = np.maximum(speed, global_max(system.comm, np.array(local)))
        # In statics v only predicts the first guess.
        moves = (speed > 0.0) & self.integrator.inertia
        self._inertia = [
            self._inertial(b, ahead) if top else np.zeros_like(ahead)
            for b, ahead, top in zip(system.bodies, flight, moves, strict=True)
        ]
        way = [u1 - u for u1, u in zip(self.first, state.u, strict=True)]
        if again is not None:
            self._motion = np.maximum(self._motion, self.motion(again))
            way = [terms.du for terms in again.bodies]
        # Bodies at rest may fall.
        length = self._moved + self._motion + dt**2 * float(np.linalg.norm(self._gravity))
        # A body at rest beside a moving one gets the rounding of the linear solve for both.
        for bodies in map(list, (*system.contact_bodies, *system.joint_bodies)):
            length[bodies] = length[bodies].max()
        self.rounding.begin(self.factor, length, self._moved, self._extent)
        step = Step(
            state, dt, self.factor, self.integrator, self.condense, self.first, way,
            self._motion, length, self._stiffness, moments, self.rounding.of,
        )  # fmt: skip
        for coupling, history in zip(self.couplings, state.histories, strict=True):
            coupling.begin(step, history, again, search)
        self._asleep = self._find_asleep(np.maximum(self._motion, speed) == 0.0)
        self._lay_out()

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
        start = 0
        for coupling in self.couplings:
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
        """Limit forces that had no limit from the next step on; tells whether one had none."""
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
        return self._laid.x

    def of_body(self, k: int) -> slice:
        """Where a body that is awake stands among this rank's unknowns."""
        return self._laid.of_body(k)

    @property
    def of_constraints(self) -> slice:
        """Where the elements' multipliers stand among this rank's unknowns."""
        return self._laid.of_elements("constraints")

    @property
    def _laid(self) -> Unknowns:
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

    def forces(self, state: State, dt: float) -> list[tuple[FloatArray, FloatArray]]:
        """Forces that accelerate bodies at a state, with contact's of its last step. Collective.

        Args:
            state: Its own accelerations play no part.
            dt: First step [s]; prescribed coordinates accelerate as in the mean over it.

        Returns:
            Of each body the forces [N], less the inertia of its prescribed coordinates, and
            accelerations that hold but those [m/s^2].
        """
        still = tuple(np.zeros_like(v) for v in state.v)
        ramp = self.integrator.ramp(state.time)
        moments = [
            Moment(u, state.time, ramp, 0.0, v) for u, v in zip(state.u, state.v, strict=True)
        ]
        self.begin(replace(state, a=still), dt, moments=moments)
        self.guess(flight=False, forces=True)
        contact = [terms.coupling / self.factor for terms in self.evaluate(self.x).bodies]
        gravity = ramp * self.system.gravity
        out = []
        for body, u, force in zip(self.system.bodies, state.u, contact, strict=True):
            right = body.external(u, gravity) - body.internal(u) - force
            p0, p1, p2 = (body.prescribed(state.time + s * dt) for s in (0.0, 0.5, 1.0))
            a = np.zeros_like(u)
            a[body.fixed] = 4.0 * (p0 - 2.0 * p1 + p2) / dt**2
            right -= body.inertia(a)
            right[body.fixed] = 0.0
            out.append((right, a))
        return out

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
        return self._stabilization(body) * du

    def _stiffness(self, body: Any) -> FloatArray:
        """Stiffness of each coordinate's surroundings [N/m]; where there is none, of the others."""
        own: FloatArray = body.nodal_stiffness(self.integrator)
        return np.where(own > 0.0, own, self._mean_stiffness)

    @cached_property
    def _mean_stiffness(self) -> float:
        """Of all flexible bodies [N/m], or weight over size where all are rigid. Collective."""
        local = np.zeros(3)
        for body in self.system.bodies:
            own = body.nodal_stiffness(self.integrator)
            local += own.sum(), np.count_nonzero(own), body.nodal_mass.max(initial=0.0)
        total, number, mass = self.system.comm.allreduce(local).tolist()
        if number:
            return float(total / number)
        weight = mass * float(np.linalg.norm(self.system.gravity))
        return weight / self._span if weight and self._span else 1.0

    def _stabilization(self, body: Any) -> FloatArray:
        """Stiffness that holds each free coordinate at t_n [N/m]."""
        stiffness = self.stabilization * self._stiffness(body)
        stiffness[body.fixed] = 0.0
        return stiffness

    def guess(self, *, flight: bool, forces: bool | None = None) -> None:
        """Write a first guess into `x`: motion, contact forces, d and f that fit the positions.

        Args:
            flight: Free flight from t_n under the contact forces of the last step; else the
                positions of t_n, which free flight of a fast turning or vibrating body may invert,
                and no forces. Prescribed coordinates are at t_{n+1}.
            forces: Whether to start with the contact forces of the last step; None: as `flight`.
        """
        laid, elements = self._laid, self.elements
        with self.x as x:
            x[:] = 0.0
            for k in self.awake:
                fixed, u1 = self.system.bodies[k].fixed, self.first[k]
                start = u1 if flight else self.state.u[k].copy()
                start[fixed] = u1[fixed]
                x[laid.of_body(k)] = start
        forces = flight if forces is None else forces
        if "constraints" in laid.own and (forces or not self.integrator.inertia):
            places = iter(laid.positions(self.x, elements))
            guess = [
                coupling.guess(k, next(places)).ravel()
                for coupling in self.couplings
                for k in range(len(coupling.elements))
            ]
            with self.x as x:
                x[laid.of_elements("constraints")] = np.concatenate(guess)
        if "augmented" in laid.own:
            positions = laid.positions(self.x, elements)
            guess = [c.initial_guess(p).ravel() for c, p in zip(elements, positions, strict=True)]
            with self.x as x:
                x[laid.of_elements("augmented")] = np.concatenate(guess)

    # ---- iterates
    def evaluate(self, x: Any) -> Evaluation:
        """The step equations at an iterate; pure. Every rank must call it.

        Args:
            x: PETSc vector of the unknowns.
        """
        values, laid, elements = x.array_r.copy(), self._laid, self.elements
        positions = laid.positions(x, elements) if laid.blocks else [np.empty(0)] * len(elements)
        parts = tuple(
            c.evaluate(y, own)
            for c, y, own in zip(
                elements, positions, laid.own_values(values, elements), strict=True
            )
        )
        force = laid.forces(elements, parts) if laid.blocks else np.zeros(len(values))
        bodies = dict(self._asleep)
        for k in self.awake:
            body, u0, here = self.system.bodies[k], self.state.u[k], laid.of_body(k)
            u1 = values[here]
            internal = self.factor * body.internal(u1)
            external = self.factor * body.external(u1, self._gravity)
            du, coupling = u1 - u0, force[here]
            residual = self._inertial(body, du) - self._inertia[k] + internal - external + coupling
            bodies[k] = BodyTerms(u1, du, internal, external, coupling, residual)
        return Evaluation(values, tuple(bodies[k] for k in sorted(bodies)), parts)

    def residual(self, e: Evaluation) -> FloatArray:
        """This rank's part of the residual, zero at prescribed coordinates."""
        laid = self._laid
        out = np.zeros(len(e.x))
        for k in self.awake:
            out[laid.of_body(k)] = _free(self.system.bodies[k], e.bodies[k].residual)
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
        if self.stabilization:
            held = a.createVecLeft()
            held.array_w[:] = self._stabilization(self.system.bodies[k])
            a.setDiagonal(held, addv=PETSc.InsertMode.ADD_VALUES)
            held.destroy()
        return a

    def measure_rounding(self, e: Evaluation) -> None:
        """Measure the rounding of the forces anew, at an iterate's motion. Collective.

        Args:
            e: Iterate whose motion is longer than the one that was predicted, at most the extent.
        """
        self.rounding.length = np.maximum(self.rounding.length, self._lengths(e))
        self.rounding.measure(self.awake)

    # ---- convergence
    def _lengths(self, e: Evaluation) -> FloatArray:
        """Largest displacement of each body in an evaluation [m]. Collective.

        An iterate that runs off excuses no more than the positions would.
        """
        local = np.array([np.abs(terms.u1).max(initial=0.0) for terms in e.bodies])
        return np.minimum(global_max(self.system.comm, local), self._extent + self._moved)

    @property
    def momentum_rounding(self) -> float:
        """Change of momentum in the step that is rounding [kg m/s]."""
        rate = self.integrator.rate(self.dt)
        return float(self.rounding.forces.sum() * np.sqrt(self.system.size) * rate)

    @property
    def span(self) -> float:
        """Distance of the bodies' farthest coordinate from `centre` [m], at most."""
        return self._span + float((self._moved + self._motion).max())

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

    def unrest(self, e: Evaluation) -> tuple[float, str]:
        """Force of the stabilization over what counts as zero, the largest; and its body's name."""
        both = zip(self.system.bodies, e.bodies, strict=True)
        held = [self._stabilization(body) * t.du for body, t in both]
        ratios = self._over_limits(e, held, self.rounding.at(self._lengths(e)))
        k = int(np.argmax(ratios))
        return ratios[k], self.system.bodies[k].name

    def ratios(self, e: Evaluation) -> dict[str, float]:
        """Residual of each block over what counts as converged there; solved when all are <= 1."""
        both = zip(self.system.bodies, e.bodies, strict=True)
        free = [_free(body, t.residual) for body, t in both]
        ratios = self._over_limits(e, free, self.rounding.forces)
        ratio = dict(zip((b.name for b in self.system.bodies), ratios, strict=True))
        if self._laid.own:
            ratio |= self._element_ratios(e)
        return ratio

    def _over_limits(
        self, e: Evaluation, forces: Sequence[FloatArray], rounding: FloatArray
    ) -> list[float]:
        """A force on each body over that which counts as zero there. Collective.

        It is measured by the largest of its inertial, internal, external and coupling forces. Of
        elements' forces that cancel each other, as on a body without mass of note between two
        springs, only the rounding counts, so that strong joints loosen no tolerance.
        """
        squares = np.zeros((len(e.bodies), 6))
        for k in self.awake:
            t = e.bodies[k]
            parts = (forces[k], self._inertia[k], t.internal, t.external, t.coupling)
            squares[k, :5] = [float(p @ p) for p in parts]
        squares[:, 5] = self._laid.gross_forces(e.parts, len(e.bodies))
        norms = np.sqrt(self.system.comm.allreduce(squares))
        limits = self.rtol * norms[:, 1:5].max(axis=1) + _CANCELLED * norms[:, 5] + rounding
        return [over(a, b) for a, b in zip(norms[:, 0], limits, strict=True)]

    def _element_ratios(self, e: Evaluation) -> dict[str, float]:
        """`ratios` of the elements' own unknowns."""
        moved = max(float(np.abs(b.du).max(initial=0.0)) for b in e.bodies)
        # MPI's maximum may swallow a NaN, so it travels as a flag.
        local = [moved, float(any(np.isnan(p.residual).any() for p in e.parts))]
        for c, part in zip(self.elements, e.parts, strict=True):
            local += c.largest(part)
        top = global_max(self.system.comm, np.array(local))
        motion = max(top[0], float(self._motion.max()))
        rounded = motion + float(self._moved.max())
        ratio: dict[str, float] = {}
        for c, largest in zip(self.elements, top[2:].reshape(-1, 4), strict=True):
            broken = np.inf if top[1] else 0.0
            # Several contacts of two bodies have one name.
            for name, value in c.ratios(largest, motion, rounded, self.rtol).items():
                ratio[name] = max(value, broken, ratio.get(name, 0.0))
        return ratio

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        if self.unknowns is not None:
            self.unknowns.destroy()
        self.unknowns, self._numbers = None, None


def _free(body: Any, residual: FloatArray) -> FloatArray:
    """Residual with zeros at the prescribed coordinates, whose equation is the prescription."""
    free = residual.copy()
    free[body.fixed] = 0.0
    return free


def _box(system: System) -> tuple[FloatArray, float]:
    """Middle of the box around all bodies' reference and half its diagonal [m]. Collective."""
    ends = np.full((2, 3), -np.inf)
    for body in system.bodies:
        x = body.reference.reshape(-1, 3)[body.places]
        np.maximum(ends, [x.max(axis=0, initial=-np.inf), (-x).max(axis=0, initial=-np.inf)], ends)
    high, low = global_max(system.comm, ends) * [[1.0], [-1.0]]
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))


def _equal(a: tuple[Any, ...], b: tuple[Any, ...] | None) -> bool:
    if b is None or len(a) != len(b):
        return False
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
