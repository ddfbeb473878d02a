"""The equations of one step: residual and tangents of bodies.

What couples bodies comes as `Elements`, of whatever kind they are.

The momentum equation is multiplied by h/2 and the multipliers are h^2/2 lambda (theory section 8),
which makes the condition number independent of h. Equilibrium has a factor 1 for h^2/2 and no
inertia: its equations are in [N] where [kg m] stands here, its matrix in [N/m]. Evaluations are
pure: nothing here changes a State, and history changes only when a step is accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import compress
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.equations.body_tangents import BodyTangents
from dolfinx_nts.equations.couplings import Couplings
from dolfinx_nts.equations.element_terms import ElementTerms
from dolfinx_nts.equations.flight import Flight
from dolfinx_nts.equations.kept_unknowns import KeptUnknowns
from dolfinx_nts.equations.loads import Loads
from dolfinx_nts.equations.scales import Lengths, Rounding, stiffness_between
from dolfinx_nts.equations.shared_weight import SharedWeight
from dolfinx_nts.equations.sleep import Sleepers
from dolfinx_nts.equations.stabilization import Stabilization
from dolfinx_nts.equations.supports import StepSupports
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.elements import Step, raise_of_all
from dolfinx_nts.interaction.evaluation import BodyTerms, Evaluation, EvaluationPoint
from dolfinx_nts.parallel import sums_and_largest
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray


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
        dives: Whether free flight presses bodies deep into each other, after `begin`.
        factor: What the equations multiply forces by, h^2/2 [s^2] or 1.
        rtol: As given.
        rounding: What part of the forces on bodies is rounding.
        stabilization: In statics, what holds each node at t_n.
        lengths: Lengths of the scene, and of the step after `begin`.
        loads: When the step takes which loads.
        is_awake: Whether each body is in the step, shape (bodies,).
        sleepers: Bodies that the step leaves out.
        supports: Prescribed coordinates in the step.
        batches: Which bodies it evaluates together.
        flight: The step without forces, after `begin`.
        tangents: Matrices of the bodies.
    """

    def __init__(
        self, system: System, integrator: Any, *, rtol: float, condense: bool,
        sleep: bool = False,
    ) -> None:  # fmt: skip
        self.system, self.integrator = system, integrator
        self.rtol, self.condense = rtol, condense
        self.batches = system.batches
        self.awake: tuple[int, ...] = ()
        self.is_awake = np.zeros(self.batches.count, dtype=bool)
        self.couplings = Couplings(system)
        self.shared_weight = SharedWeight(system.comm, system.contacts)
        self._kept, self.dives = KeptUnknowns(self.batches, self.couplings), False
        self._again: Evaluation | None = None
        self.lengths, self.loads = (lengths := Lengths(system)), Loads(system, integrator)
        self.sleepers, self._sleep = Sleepers(system, self.couplings, self.loads), sleep
        self.supports = StepSupports(system, integrator)
        self.flight = Flight(self.batches, integrator, self.supports, lengths, self._inertial)
        self._terms = ElementTerms(self.couplings, self.shared_weight, lengths, rtol)
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
        self, state: State, dt: float, again: Evaluation | None = None, *, search: bool = True,
        sleep: bool = True, moments: Sequence[EvaluationPoint] | None = None,
    ) -> None:  # fmt: skip
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
        self._evaluated = dict[int, tuple[FloatArray, ...]]()
        self._u0 = self.batches.join(state.u)
        self.loads.begin(state, dt, moments)
        at_rest = self.flight.begin(state, self._u0, dt)
        if not self.integrator.inertia and again is None:
            touching = set().union(*self.system.pair_bodies)
            self.flight.follow_supports(self._u0, touching, self.tangents)
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
        self.awake = self.sleepers.awake()
        self.is_awake[:] = False
        self.is_awake[list(self.awake)] = True
        contacts, bearing = self.couplings.contacts, self.couplings.loads()
        # From bodies that free flight has pressed deep into each other iterates may not find back.
        dives = [contacts.dives()] if self.integrator.inertia else []
        _, *deep = self._kept.lay_out(self.awake, bearing, [contacts.watch(), *dives])
        self.dives = any(deep)
        self._terms.begin(self.laid, bearing)
        self._again = again
        self.first_guess()

    def first_guess(self) -> None:
        """Write into `x` what the iterations of the step begin with."""
        self.guess(flight=not self.dives, forces=True, again=self._again)

    @property
    def x(self) -> PETSc.Vec:
        """PETSc vector of the unknowns, holding the first guess after `begin`."""
        return self.laid.x

    @property
    def laid(self) -> Unknowns:
        """The layout, after `begin`; another one whenever the elements' coordinates change."""
        assert self._kept.now is not None, "begin comes first"
        return self._kept.now

    @property
    def extents(self) -> FloatArray:
        """Largest `Elements.extent` of each of `Couplings.mechanisms`, on all ranks [m]."""
        return self._kept.extents

    def _inertial(self, body: Body, du: FloatArray) -> FloatArray:
        """M du of a motion [kg m]; in statics the force of the stabilization [N]."""
        if self.integrator.inertia:
            return body.inertia(du)
        return self.stabilization.of(body) * du

    def guess(
        self, *, flight: bool, forces: bool, carried: bool = False, again: Evaluation | None = None
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
        moves = laid.moves(places, {j: terms[0] for j, terms in self._evaluated.items()})
        ways = [np.abs(places[j] - self._u0[j]).max(initial=0.0) for j in laid.awake]
        moved = float(max(ways, default=0.0))
        parts, raised, active = self._terms.at(x, values)
        turned, measures = self._terms.turned(last, parts), self._terms.measures(parts)
        own = [float(raised is not None), float(new), float(turned), moved, *moves]
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

    def _without_elements(self, j: int, u1: FloatArray) -> tuple[FloatArray, ...]:
        """A batch's u1, du, internal and external force and equation, no elements. Collective."""
        body, du = self.batches.bodies[j], u1 - self._u0[j]
        internal = self.factor * body.internal(u1)
        external = self.factor * body.external(u1, self.loads.gravity)
        total = self._inertial(body, du) - self.flight.momentum[j] + internal - external
        return u1, du, internal, external, total

    def displacements(self, x: FloatArray) -> list[FloatArray]:
        """Those of each batch at an iterate [m]: this rank's part of both."""
        return self.laid.read(x, self._u0)

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

    def stiffness_between(self) -> FloatArray:
        """Norm of the stiffness at t_n of elements without unknowns, of each body. Collective."""
        of = self.couplings.bodies
        return stiffness_between(self.batches, self.laid, self.elements, of, self._u0)

    @property
    def rounded_length(self) -> float:
        """Largest length whose rounding enters forces and gaps [m]."""
        return max(self.lengths.span, self._kept.extent)

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        self._kept.destroy()
