"""The equations of one step: residual and tangents of bodies.

What couples bodies comes as `Elements`, of whatever kind they are.

The momentum equation is multiplied by h/2 and the multipliers are h^2/2 lambda (theory section 8),
which makes the condition number independent of h. Equilibrium has a factor 1 for h^2/2 and no
inertia: its equations are in [N] where [kg m] stands here, its matrix in [N/m]. Evaluations are
pure: nothing here changes a State, and history changes only when a step is accepted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import compress
from operator import is_not
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.contact.alike import Alike
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.equations.body_tangents import BodyTangents
from dolfinx_nts.equations.couplings import Couplings
from dolfinx_nts.equations.flight import Flight
from dolfinx_nts.equations.loads import Loads
from dolfinx_nts.equations.mass_solves import Saddle
from dolfinx_nts.equations.scales import Lengths, Rounding, stiffness_between
from dolfinx_nts.equations.shared_weight import ActiveRows, SharedWeight
from dolfinx_nts.equations.sleep import Sleepers
from dolfinx_nts.equations.stabilization import Stabilization
from dolfinx_nts.equations.supports import StepSupports
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.elements import Raised, Step, evaluate_here, raise_of_all
from dolfinx_nts.interaction.evaluation import BodyTerms, Evaluation, EvaluationPoint
from dolfinx_nts.parallel import Asking, global_max, sums_and_largest, together
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

#: A motion of supports goes on as before if it differs by less than this part.
_STEADY = 1e-6
#: Motion of supports, over the scene, that tells which forces they make.
_TRIED = 1e-7
#: How much farther than its supports a body may come, as the end of a beam whose other end turns.
_FARTHEST = 1e3
#: What elements contribute on this rank, or raise there, and rows of weight that is shared.
_Parts = tuple[tuple[Any, ...], Raised | None, ActiveRows]


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
        couplings: All that makes elements.
        unknowns: Their layout; made anew whenever the elements' coordinates change.
        version: Changes whenever `unknowns` does.
        dives: Whether free flight presses bodies deep into each other, after `begin`.
        factor: What the equations multiply forces by, h^2/2 [s^2] or 1.
        rtol: As given.
        rounding: What part of the forces on bodies is rounding.
        stabilization: In statics, what holds each node at t_n.
        lengths: Lengths of the scene, and of the step after `begin`.
        extents: Largest `Elements.extent` of each of `Couplings.mechanisms`, on all ranks [m].
        loads: When the step takes which loads.
        is_awake: Whether each body is in the step, shape (bodies,).
        sleepers: Bodies that the step leaves out.
        supports: Prescribed coordinates in the step.
        batches: Which bodies it evaluates together.
        flight: The step without forces, after `begin`.
        tangents: Matrices of the bodies.
    """

    def __init__(
        self, system: System, integrator: Any, *, rtol: float, condense: bool, sleep: bool = False
    ) -> None:
        self.system, self.integrator = system, integrator
        self.rtol, self.condense = rtol, condense
        self.batches = system.batches
        self._evaluated: dict[int, tuple[FloatArray, ...]] = {}
        # What batches contribute that have no element on any rank: nothing, at every iterate.
        self._of_none: _Parts | None = None
        self._alike = Alike(())
        self.awake: tuple[int, ...] = ()
        self.is_awake = np.zeros(self.batches.count, dtype=bool)
        self._numbers: tuple[Any, ...] | None = None
        self.couplings = Couplings(system)
        self.shared_weight = SharedWeight(system.comm, system.contacts)
        self.unknowns: Unknowns | None = None
        self.version, self.dives = 0, False
        self._again: Evaluation | None = None
        self.lengths, self.loads = Lengths(system), Loads(system, integrator)
        self.sleepers, self._sleep = Sleepers(system, self.couplings, self.loads), sleep
        self.supports = StepSupports(system, integrator)
        self.flight = Flight(
            self.batches, integrator, self.supports, self.lengths, self._inertial
        )
        lengths = self.lengths
        self.stabilization = Stabilization(
            system, lengths.radius or lengths.director, lengths.director or lengths.radius,
            self.loads.largest,
        )  # fmt: skip
        self.tangents = BodyTangents(
            self.batches, integrator.inertia, self.stabilization, lambda: self.laid
        )
        self.rounding = Rounding(
            self.batches, lambda j: self.tangents.of_all(j, self._u0[j]), self.stiffness_between
        )

    # ---- set-up of a step
    def begin(
        self,
        state: State,
        dt: float,
        again: Evaluation | None = None,
        *,
        search: bool = True,
        sleep: bool = True,
        moments: Sequence[EvaluationPoint] | None = None,
    ) -> None:
        """Fix the state at t_n and the step: loads, candidates, layout, first guess.

        Args:
            state: State at t_n.
            dt: Step [s].
            again: Solution of this step whose motion the elements did not cover, see `misses`:
                contact is sought along that motion in place of the one that velocities predict.
            search: Seek contacts; False keeps the candidates of the last step, for statics only.
            sleep: Leave out bodies at rest, if the run does; else all constraints are in the step.
            moments: Where the forces on each body are taken; None: as the integrator's step has it.
        """
        self.state, self.dt, self.factor = state, dt, self.integrator.factor(dt)
        self.tangents.factor = self.factor
        self._evaluated, self._u0 = {}, self.batches.join(state.u)
        self.loads.begin(state, dt, moments)
        at_rest = self.flight.begin(state, self._u0, dt)
        if not self.integrator.inertia and again is None:
            self._follow_supports()
        lengths, first = self.lengths, self.flight.ends
        way = [a - b for a, b in zip(first, self._u0, strict=True)]
        if again is not None:
            lengths.motion = np.maximum(lengths.motion, lengths.motion_of(again))
            way = [terms.du for terms in again.terms]
        fall = dt**2 if self.integrator.inertia else 0.0
        length = lengths.displaced(fall * float(np.linalg.norm(self.loads.gravity)))
        self.rounding.begin(self.factor, length, lengths.moved, lengths.extent)
        step = Step(
            state, dt, self.factor, self.integrator, self.condense,
            self.batches.split(first), self.batches.split(way), lengths.motion, length,
            self.stabilization.stiffness, self.loads.moments, self.rounding.of,
        )  # fmt: skip
        self.batches.share(state.u, step.ahead, step.first)
        self.couplings.begin(step, again, search)
        self.sleepers.forces = {}
        if self._sleep and sleep:
            self.sleepers.find(at_rest & (lengths.motion == 0.0), state.u, self.rounding)
        self._lay_out(again)

    def _follow_supports(self) -> None:
        """Let bodies follow what supports do beside their motion, in the first guess. Collective.

        Else the cells at the supports would take all of it: those of a material that hardly changes
        its volume have no way back from there. Bodies that may touch stay where they are: what
        stands in their way is not known yet.
        """
        touching = set().union(*self.system.pair_bodies)
        for j, body in enumerate(self.batches.bodies):
            if body.rigid or not body.driven or touching.intersection(self.batches.numbers[j]):
                continue
            u0, end, jump = self._u0[j], self.flight.ends[j], np.zeros(body.num_owned)
            jump[body.fixed] = self.flight.jumps[j]
            sizes = np.array([np.abs(a).max(initial=0.0) for a in (jump, end - u0)])
            largest, moved = global_max(self.system.comm, sizes)
            if not largest > _STEADY * moved:
                continue
            part = _TRIED * self.lengths.radius / largest
            pull = (body.internal(u0 + part * jump) - body.internal(u0)) / part
            pull[body.fixed] = 0.0
            saddle = Saddle(self.tangents.of_all(j, u0))
            way = saddle.solve(-pull)
            saddle.destroy()
            way[body.fixed] = 0.0
            far = global_max(self.system.comm, np.abs(way).max(initial=0.0, keepdims=True))[0]
            if far <= _FARTHEST * largest:
                end += way

    @property
    def elements(self) -> list[Any]:
        """Batches of elements in the step."""
        return self.couplings.elements

    def wake(self, e: Evaluation) -> bool:
        """Whether a solved step asks for more elements, and is to be solved again. Collective.

        Args:
            e: Solution of the step without them.
        """
        self._share(e)
        if not self.couplings.wake(e):
            return False
        self.sleepers.rouse(self.sleepers.forces.keys() & self.couplings.touched())
        self._lay_out(e)
        return True

    def misses(self, e: Evaluation) -> bool:
        """Whether a solved step may have passed by something. Collective.

        If so, `begin` is to be called again with it.

        Raises:
            StepFailedError: Only a shorter step helps.
        """
        self._share(e)
        return self.couplings.misses(e, self.lengths.motion_of(e))

    def _share(self, e: Evaluation) -> None:
        """Let all ranks know where a solution has rigid bodies. Collective."""
        if self.system.comm.size > 1:
            self.batches.share([terms.u1 for terms in e.bodies], [terms.du for terms in e.bodies])

    def _lay_out(self, again: Evaluation | None) -> None:
        """Layout of the unknowns, kept while no rank's elements change, and a first guess.

        Args:
            again: Solution of this step with fewer elements, which the next one goes on from.
        """
        system = self.system
        self.awake = self.sleepers.awake()
        self.is_awake[:] = False
        self.is_awake[list(self.awake)] = True
        elements = self.elements
        widths = np.array([list(c.widths.values()) for c in elements])
        combined = [a for c in elements if c.combination is not None for a in c.combination]
        places = [a for c in elements for a in c.points()]
        numbers = (np.array(self.awake), widths, *places, *combined)
        self._bearing = self.couplings.loads()
        contacts = self.couplings.contacts
        # From bodies that free flight has pressed deep into each other iterates may not find back.
        dives = [contacts.dives()] if self.integrator.inertia else []
        changed, _, *deep = together(
            system.comm, [self._changes(numbers), contacts.watch(), *dives]
        )
        self.dives = any(deep)
        if changed:
            self.destroy()
            of = self.couplings.bodies
            self.unknowns = Unknowns(self.batches, self.awake, elements, of, self._bearing)
            self.version += 1
            self._numbers = numbers
        self._of_none = None
        self._again = again
        self.first_guess()

    def _changes(self, numbers: tuple[Any, ...]) -> Asking[bool]:
        """Whether any rank's elements have other numbers than before, as of `together`.

        Notes the extents of all elements.
        """
        own = [float(not _equal(numbers, self._numbers)), *self.couplings.extents()]
        _, (changed, self._extent, *linked) = yield np.empty(0), np.array(own)
        self.extents = np.array(linked)
        return bool(changed)

    def first_guess(self) -> None:
        """Write into `x` what the iterations of the step begin with."""
        self.guess(flight=not self.dives, forces=True, again=self._again)

    @property
    def x(self) -> PETSc.Vec:
        """PETSc vector of the unknowns, holding the first guess after `begin`."""
        return self.laid.x

    def of_body(self, k: int) -> slice:
        """Where a body that is awake stands among this rank's unknowns."""
        return self.laid.of_body(k)

    @property
    def laid(self) -> Unknowns:
        """The layout, after `begin`."""
        assert self.unknowns is not None, "begin comes first"
        return self.unknowns

    def _inertial(self, body: Body, du: FloatArray) -> FloatArray:
        """M du of a motion [kg m]; in statics the force of the stabilization [N]."""
        if self.integrator.inertia:
            return body.inertia(du)
        return self.stabilization.of(body) * du

    def guess(
        self,
        *,
        flight: bool,
        forces: bool,
        carried: bool = False,
        again: Evaluation | None = None,
    ) -> None:
        """Write a first guess into `x`: motion, contact forces, d and f that fit the positions.

        Args:
            flight: Free flight from t_n; else the positions of t_n, which free flight of a fast
                turning or vibrating body may invert. Prescribed coordinates are at t_{n+1}.
            forces: The contact forces of the last step; else none, but in statics.
            carried: Take these forces unchanged, even where they are a poor guess.
            again: Solution of this step with fewer elements: its motion and contact forces are
                taken in place of these.
        """
        places = self.flight.ends if flight else self._u0
        if again is not None:
            places = [terms.u1 for terms in again.terms]
        wanted = forces or not self.integrator.inertia
        multipliers = partial(self.couplings.guess, carried=carried) if wanted else None
        self.laid.guess(places, self.flight.ends, self.elements, multipliers)

    # ---- iterates
    def evaluate(self, x: PETSc.Vec, last: Evaluation | None = None) -> Evaluation:
        """The step equations at an iterate; no state changes. Every rank must call it.

        What ranks have to agree on travels in one reduction.

        Args:
            x: The iterate.
            last: The one before, which is returned if its unknowns are the same on all ranks.
        """
        values, laid, comm = x.array_r.copy(), self.laid, self.system.comm
        new = last is None or not np.array_equal(last.x, values)
        if last is not None and not new and comm.size == 1:
            return last
        # Most often bodies at rest before something hits them stay where the last iterate had them.
        places = laid.read(values, self._u0)
        moves = self._moves(places, {j: terms[0] for j, terms in self._evaluated.items()})
        ways = [np.abs(places[j] - self._u0[j]).max(initial=0.0) for j in laid.awake]
        moved = float(max(ways, default=0.0))
        parts, raised, active = self._of_none or self._parts_of_elements(x, values)
        turned = last is not None and self._turned(last, parts)
        own = [float(raised is not None), float(new), float(turned), moved, *moves]
        measures = self._measures(parts)
        counts, found = sums_and_largest(comm, active.counts, np.append(own, measures))
        if found[0]:
            raise_of_all(comm, raised)
        if last is not None and not found[1]:
            return last
        self.shared_weight.divide(active, counts)
        force = laid.forces(self.elements, parts) if laid.blocks else np.zeros(len(values))
        for j in compress(laid.awake, found[4:]):
            self._evaluated[j] = self._without_elements(j, places[j])
        none = [np.zeros_like(u) for u in self._u0]
        coupling, terms = laid.read(force, none), []
        for j, of in enumerate(self.batches.numbers):
            if j in laid.awake:
                u1, du, internal, external, total = self._evaluated[j]
            else:
                internal, external = (self.factor * own for own in self.sleepers.forces_on(of))
                u1, du, total = self._u0[j], none[j], internal - external
            pull = coupling[j]
            terms.append(BodyTerms(u1, du, internal, external, pull, total + pull))
        return Evaluation(
            values, tuple(terms), self.batches.split, parts, moved=float(found[3]),
            measures=found[4 + len(moves) :].reshape(measures.shape), turned=bool(found[2]),
        )  # fmt: skip

    def _parts_of_elements(self, x: PETSc.Vec, values: FloatArray) -> _Parts:
        """What elements contribute at an iterate, or raise here; rows of weight that is shared.

        Collective.

        Args:
            x: The iterate.
            values: Its part here.
        """
        laid, elements = self.laid, self.elements
        positions = laid.positions(x, elements)
        own = laid.own_values(values, elements)
        self.couplings.tell_loads(own, self._bearing)
        alike = self._alike
        if len(elements) != len(alike.of) or any(map(is_not, elements, alike.of)):
            self._alike = alike = Alike(elements, alike)
        parts, raised = evaluate_here(
            self.system.comm, alike.elements, alike.places(positions), alike.own(own)
        )
        if raised is not None:
            return (), raised, self.shared_weight.none
        parts, touching = alike.apart(parts), self.couplings.num_touching
        found = parts, None, self.shared_weight.active(
            elements[:touching], self.couplings.bodies, parts[:touching], positions[:touching],
            self._closed,
        )  # fmt: skip
        self._of_none = None if laid.blocks else found
        return found

    def _turned(self, last: Evaluation, parts: tuple[Any, ...]) -> bool:
        """Whether contacts have another status on this rank than in the last iterate."""
        both = zip(last.parts, parts[: self.couplings.num_touching], strict=False)
        return any(bool((a.status != b.status).any()) for a, b in both)

    def _measures(self, parts: tuple[Any, ...]) -> FloatArray:
        """`Evaluation.measures` on this rank; zeros where elements raised."""
        found = np.zeros((len(self.elements) if "augmented" in self.laid.own else 0, 2))
        for row, batch, part in zip(found, self.elements, parts, strict=False):
            row[:] = batch.largest(part)[2:]
        return found

    def _without_elements(self, j: int, u1: FloatArray) -> tuple[FloatArray, ...]:
        """A batch's u1, du, internal and external force and equation, no elements. Collective."""
        body, du = self.batches.bodies[j], u1 - self._u0[j]
        internal = self.factor * body.internal(u1)
        external = self.factor * body.external(u1, self.loads.gravity)
        total = self._inertial(body, du) - self.flight.momentum[j] + internal - external
        return u1, du, internal, external, total

    def elsewhere(
        self, places: Sequence[FloatArray], known: Mapping[int, FloatArray]
    ) -> list[int]:
        """Batches with bodies awake that are not where they are known to have been. Collective.

        Args:
            places: Displacements of each batch [m].
            known: Those there by the batch's number; one without is elsewhere.
        """
        moves = global_max(self.system.comm, np.array(self._moves(places, known)))
        return list(compress(self.laid.awake, moves))

    def _moves(
        self, places: Sequence[FloatArray], known: Mapping[int, FloatArray]
    ) -> list[float]:
        """1 for each batch awake that is `elsewhere` on this rank, else 0."""
        awake = self.laid.awake
        return [float(j not in known or not np.array_equal(places[j], known[j])) for j in awake]

    def displacements(self, x: FloatArray) -> list[FloatArray]:
        """Those of each batch at an iterate [m]: this rank's part of both."""
        return self.laid.read(x, self._u0)

    def _closed(self, batch: ContactElements) -> float:
        """Gap of a batch that surely counts as closed [m], see `ContactElements.ratios`."""
        motion = float(self.lengths.motion.max())
        gap = [0.0, 1.0, 0.0, 0.0]
        rounded = motion + self.lengths.rounded
        limits = batch.ratios(None, gap, motion, rounded, self.rtol)
        return 1.0 / limits[f"{batch.name} constraints"]

    def residual(self, e: Evaluation) -> FloatArray:
        """This rank's part of the residual, zero at prescribed coordinates."""
        laid = self.laid
        out = np.zeros(len(e.x))
        laid.write([terms.residual for terms in e.terms], out)
        out[laid.held] = 0.0
        for name in laid.own:
            rows = [c.rows(p, name) for c, p in zip(self.elements, e.parts, strict=True)]
            out[laid.of_elements(name)] = laid.own_rows(name, self.elements, rows)
        return out

    @property
    def rounding_is_known(self) -> bool:
        """Whether the rounding of all forces has been measured, of springs in this step."""
        springs = any(not any(batch.widths.values()) for batch in self.elements)
        return self.rounding.is_known(self.awake, springs=springs)

    def measure_rounding(self, e: Evaluation) -> None:
        """Measure the rounding of the forces anew, at an iterate's motion. Collective.

        Args:
            e: Iterate whose motion is longer than the one that was predicted, at most the extent.
        """
        self.rounding.length = np.maximum(self.rounding.length, self.lengths.displacement_of(e))
        self.rounding.measure(self.awake)
        self.rounding.measure_springs()

    def stiffness_between(self) -> FloatArray:
        """Norm of the stiffness at t_n of elements without unknowns, of each body. Collective."""
        of = self.couplings.bodies
        return stiffness_between(self.batches, self.laid, self.elements, of, self._u0)

    @property
    def momentum_rounding(self) -> float:
        """Change of momentum in the step that is rounding [kg m/s]."""
        rate = self.integrator.rate(self.dt)
        return float(self.rounding.forces.sum() * np.sqrt(self.system.size) * rate)

    @property
    def rounded_length(self) -> float:
        """Largest length whose rounding enters forces and gaps [m]."""
        return max(self.lengths.span, self._extent)

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        if self.unknowns is not None:
            self.unknowns.destroy()
        self.unknowns, self._numbers = None, None


def _equal(a: tuple[Any, ...], b: tuple[Any, ...] | None) -> bool:
    if b is None or len(a) != len(b):
        return False
    return all(x is y or np.array_equal(x, y) for x, y in zip(a, b, strict=True))
