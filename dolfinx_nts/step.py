"""The equations of one step: unknowns, residual, contact tangents, convergence of each block.

The momentum equation is multiplied by h/2 and the multipliers are h^2/2 lambda (theory section 8),
which makes the condition number independent of h. Equilibrium has a factor 1 for h^2/2 and no
inertia: its equations are in [N] where [kg m] stands here, its matrix in [N/m]. Evaluations are
pure: nothing here changes a State, and history changes only when a step is accepted.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from dolfinx_nts.assembly import ElementBlocks, Layout, solve_mass
from dolfinx_nts.body import Moment
from dolfinx_nts.contact import Motion
from dolfinx_nts.contact_step import ContactStep, Contribution
from dolfinx_nts.obstacle_contact import ObstacleStep
from dolfinx_nts.parallel import global_max
from dolfinx_nts.sleep import Sleepers
from dolfinx_nts.system import State, System
from dolfinx_nts.validation import StepFailedError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

_EPS = float(np.finfo(float).eps)
#: In statics a node nearer to its facet than this part of the facet's size starts as active.
_TOUCHING = 1e-6
#: A gap of this many roundings of positions, or of forces, that is closed without force is no
#: contact.
_TOUCH = 4.0
#: Relative difference of the factors of two equal steps, which differ by rounding.
EQUAL = 1e-6
#: A node passes through an obstacle if its path is longer than this part of the radius, and lies
#: this part of it deeper than both ends.
_PASSING = 0.1
#: Factor by which h^2/2 may change before the rounding of a body's forces is measured again.
_ANOTHER_STEP = 4.0
#: Flight that closes a gap by this part of the step's motion, or more, makes a contact for sure.
_SURELY = 1e-3
#: Difference of two normals, or of two gaps over the facet's size, that counts as none.
_ONE = 1e-6


@dataclass(frozen=True, eq=False)
class BodyTerms:
    """Parts of a body's equation at an iterate, owned coordinates, [kg m] except u1 and du [m].

    Attributes:
        u1: Displacement at t_{n+1}.
        du: u_1 - u_0.
        internal: h^2/2 internal forces.
        external: h^2/2 external forces.
        contact: h^2/2 contact forces G^T lambda.
        residual: Complete equation, also at prescribed coordinates, where it is h^2/2 times the
            reaction.
    """

    u1: FloatArray
    du: FloatArray
    internal: FloatArray
    external: FloatArray
    contact: FloatArray
    residual: FloatArray


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The step equations at an iterate.

    Attributes:
        x: Iterate it belongs to, this rank's part.
        bodies: Terms of each body.
        contacts: Contribution of each contact.
        multipliers: Multipliers of each contact [kg m], shape (n, multipliers).
        iterations: Newton iterations it took.
        idle_gaps: Gaps [m] of the idle candidates of each contact, once solved.
        min_det: Smallest det F of all bodies, once solved.
    """

    x: FloatArray
    bodies: tuple[BodyTerms, ...]
    contacts: tuple[Contribution, ...]
    multipliers: tuple[FloatArray, ...]
    iterations: int = 0
    idle_gaps: tuple[FloatArray, ...] = ()
    min_det: float = np.inf


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
        contacts: Candidates of each contact that have unknowns in this step.
        idle: The others, which the step's motion does not bring to their facets.
        layout: Fields of the unknowns.
        elements: Unknowns of the contact elements; empty without candidates.
        x: PETSc vector of the unknowns, holding the first guess after `begin`.
        version: Changes whenever layout and elements do.
        factor: What the equations multiply forces by, h^2/2 [s^2] or 1.
        rtol: As given.
        centre: Middle of all bodies in the reference [m], shape (3,).
        stabilization: In statics, the stiffness that holds each node at t_n over its own stiffness.
        bounded: Whether infinite friction has a bound, where nothing else solves a step.
    """

    def __init__(
        self, system: System, integrator: Any, *, rtol: float, condense: bool, sleep: bool = False
    ) -> None:
        self.system, self.integrator = system, integrator
        self.rtol, self.condense = rtol, condense
        self._sleepers = Sleepers(system.bodies, system.comm) if sleep else None
        self._asleep: dict[int, BodyTerms] = {}
        self.awake: tuple[int, ...] = ()
        self._searched: dict[int, tuple[list[FloatArray], ContactStep]] = {}
        self._numbers: tuple[Any, ...] | None = None
        self.contacts: list[ContactStep] = []
        self._petsc: list[Any] = []
        self.version = 0
        self.stabilization = 0.0
        self.bounded = False
        self._cover = [0.0] * len(system.contacts)
        self._beside = [(0.0, -1)] * len(system.contacts)
        self.centre, self._span = _box(system)
        self._diagonal, self._diagonal_factor = np.zeros((2, len(system.bodies)))

    # ---- set-up of a step
    def begin(
        self, state: State, dt: float, again: Evaluation | None = None, *, search: bool = True
    ) -> None:
        """Fix the state at t_n and the step: loads, candidates, layout, first guess.

        Args:
            state: State at t_n.
            dt: Step [s].
            again: Solution of this step whose motion the candidates did not cover, see `misses`:
                contact is sought along that motion in place of the one that velocities predict.
            search: Seek candidates; False keeps those of the last step, for statics only.
        """
        system = self.system
        self.state, self.dt, self.factor = state, dt, self.integrator.factor(dt)
        for k, body in enumerate(system.bodies):
            body.begin_step(self.integrator, self._moment(k))
        self._gravity = self.integrator.ramp(self._when) * system.gravity
        self._paths = {k: self._path(c) for k, c in enumerate(system.contacts) if c.rigid}
        flight = [self.integrator.ahead(v, self.acceleration(k), dt) for k, v in enumerate(state.v)]
        self.first = [u + ahead for u, ahead in zip(state.u, flight, strict=True)]
        for body, u1 in zip(system.bodies, self.first, strict=True):
            u1[body.fixed] = body.prescribed(state.time + dt)
        local = [
            [np.abs(x).max(initial=0.0) for x in (u1 - u, b.reference + u1, v, u)]
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
        self._ahead = [u1 - u for u1, u in zip(self.first, state.u, strict=True)]
        if again is None:
            self._aimed = [np.full(len(c.slave.share), -1) for c in system.contacts]
        else:
            self._motion = np.maximum(self._motion, self.motion(again))
            self._ahead = [terms.du for terms in again.bodies]
        # Bodies at rest may fall.
        self._length = self._moved + self._motion + dt**2 * float(np.linalg.norm(self._gravity))
        # A body at rest beside a moving one gets the rounding of the linear solve for both.
        for bodies in map(list, system.contact_bodies):
            self._length[bodies] = self._length[bodies].max()
        # Of steps of other sizes the diagonal differs; until rounding matters none is needed.
        old = self._diagonal_factor
        other = (self.factor > _ANOTHER_STEP * old) | (old > _ANOTHER_STEP * self.factor)
        self._diagonal[other] = 0.0
        if search:
            self._followed = list(state.followed)
            self._found = [self._search(k) for k in range(len(system.contacts))]
            self._drop_doubles()
            self._with_unknowns = [self._may_touch(k, c) for k, c in enumerate(self._found)]
        self._asleep = self._find_asleep(np.maximum(self._motion, speed) == 0.0)
        self._choose()

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

    def accelerations(self, state: State, dt: float) -> tuple[FloatArray, ...]:
        """Accelerations at a state [m/s^2], under the contact forces of its last step. Collective.

        Args:
            state: Its own accelerations play no part.
            dt: First step [s]; prescribed coordinates accelerate as in the mean over it.
        """
        still = tuple(np.zeros_like(v) for v in state.v)
        self.begin(replace(state, a=still), dt)
        self.guess(flight=False, forces=True)
        contact = [terms.contact / self.factor for terms in self.evaluate(self.x).bodies]
        gravity = self.integrator.ramp(state.time) * self.system.gravity
        out = []
        for body, u, v, force in zip(
            self.system.bodies, state.u, state.v, contact, strict=True
        ):
            moment = Moment(u, state.time, self.integrator.ramp(state.time), 0.0, v)
            body.begin_step(self.integrator, moment)
            right = body.external(u, gravity) - body.internal(u) - force
            p0, p1, p2 = (body.prescribed(state.time + s * dt) for s in (0.0, 0.5, 1.0))
            a = np.zeros_like(u)
            a[body.fixed] = 4.0 * (p0 - 2.0 * p1 + p2) / dt**2
            right -= body.inertia(a)
            right[body.fixed] = 0.0
            solved = solve_mass(body.tangent(u, 1.0, 0.0), right)
            solved[body.fixed] = a[body.fixed]
            out.append(solved)
        return tuple(out)

    def _find_asleep(self, rest: BoolArray) -> dict[int, BodyTerms]:
        """Those of the bodies at rest, shape (bodies,), that neither force nor contact may move."""
        if self._sleepers is None:
            return {}
        chosen = sorted(set(np.flatnonzero(rest).tolist()) - self._touched())
        u, f = self.state.u, self.factor
        found = self._sleepers.find(chosen, u, self._gravity, self._force_rounding)
        none = {k: np.zeros_like(u[k]) for k in found}
        return {
            k: BodyTerms(u[k], none[k], f * a, f * b, none[k], f * (a - b))
            for k, (a, b) in found.items()
        }

    def _touched(self) -> set[int]:
        """Bodies of contacts that have unknowns, the same on all ranks."""
        local = np.array([float(awake.any()) for awake in self._with_unknowns])
        on = global_max(self.system.comm, local) > 0.0
        return set().union(*itertools.compress(self.system.contact_bodies, on))

    def _force_rounding(self, k: int) -> float:
        """Norm of the forces on a body at rest [N] that is rounding, as in `ratios`.

        A diagonal of another step hardly allows more: it grows with the factor, but less than that.
        """
        if not self._diagonal[k]:
            self._measure_rounding(k)
        rounding = self._rounding_of(self._moved)[k]
        return float(rounding / max(self.factor, self._diagonal_factor[k]))

    def _may_touch(self, index: int, c: ContactStep) -> BoolArray:
        """Which candidates need unknowns: all within reach, and who had them in the last step.

        In statics, where no motion bounds the next one, all do. Strong friction may hold nodes that
        free motion lets go (Painleve's paradox), and an iterate's errors would choose which: there
        only what carries, or what flight presses in, begins with unknowns.
        """
        if not self.integrator.inertia:
            return np.ones(c.num_pairs, dtype=bool)
        node, reach = c.candidates.node, self._reach(index, self._motion)
        force = self.state.force[index][node]
        if c.strong:
            closes = self._gap(index, c, self.first) < -_SURELY * reach
            return closes | (force > c.no_pull(self.state.tangential[index][node]))
        # What goes to and fro at the limit would change the layout in every step.
        had = np.isin(node, self.contacts[index].candidates.node) if self.contacts else False
        awake: BoolArray = had | (c.candidates.gap < reach) | (force > 0.0)
        return awake

    def wake(self, e: Evaluation) -> Evaluation | None:
        """A solved step with the gaps of the idle candidates, if none of them is closed.

        Else these get unknowns, and the step is to be solved again. Every rank must call it.

        Args:
            e: Solution of the step without them.
        """
        if not self._watching:
            return replace(e, idle_gaps=tuple(np.empty(0) for _ in self.idle))
        u = [b.u1 for b in e.bodies]
        gaps = tuple(self._gaps(self.idle, u))
        closed = [~(gap >= -c.gap_rounding) for c, gap in zip(self.idle, gaps, strict=True)]
        if not self.system.comm.allreduce(any(c.any() for c in closed), op=MPI.LOR):
            return replace(e, idle_gaps=gaps)
        for awake, late in zip(self._with_unknowns, closed, strict=True):
            awake[np.flatnonzero(~awake)[late]] = True
        for k in self._asleep.keys() & self._touched():
            del self._asleep[k]
        self._choose()
        return None

    def _choose(self) -> None:
        """Give unknowns to the candidates that are awake."""
        both = list(zip(self._found, self._with_unknowns, strict=True))
        self.contacts, self.idle = [c.part(a) for c, a in both], [c.part(~a) for c, a in both]
        if self.bounded:
            self.contacts = [replace(c, bounded=True) for c in self.contacts]
        system, watching = self.system, any(c.num_pairs for c in self.idle)
        self._watching = system.comm.allreduce(watching, op=MPI.LOR)
        if len(self._asleep) == len(system.bodies):
            # SNES needs an unknown; at rest it takes no iteration.
            del self._asleep[0]
        self.awake = tuple(k for k in range(len(system.bodies)) if k not in self._asleep)
        numbers = (np.array(self.awake), *(a for c in self.contacts for a in c.points()))
        if not system.comm.allreduce(_equal(numbers, self._numbers), op=MPI.LAND):
            self._lay_out()
            self._numbers = numbers
        self.guess(flight=True)

    def _inertial(self, body: Any, du: FloatArray) -> FloatArray:
        """M du of a motion [kg m]; in statics the force of the stabilization [N]."""
        if self.integrator.inertia:
            force: FloatArray = body.inertia(du)
            return force
        return self._stabilization(body) * du

    def _stabilization(self, body: Any) -> FloatArray:
        """Stiffness that holds each free coordinate at t_n [N/m]."""
        stiffness: FloatArray = self.stabilization * body.nodal_stiffness(self.integrator)
        stiffness[body.fixed] = 0.0
        return stiffness

    def _path(self, pair: Any) -> FloatArray:
        """Displacements of the obstacle of a contact at t_n and t_{n+1} [m], shape (2, 3)."""
        times = (self.state.time, self.state.time + self.dt)
        return np.stack([pair.master.displacement(t, self.system.comm) for t in times])

    def _reach(self, index: int, motion: FloatArray) -> float:
        reach = np.sqrt(3.0) * float(sum(motion[b] for b in self.system.contact_bodies[index]))
        if self.system.contacts[index].rigid:
            reach += float(np.linalg.norm(np.diff(self._paths[index], axis=0)))
        return reach

    def _search(self, index: int) -> ContactStep:
        """Candidates of a contact, found anew unless all its bodies slept and nothing moves."""
        u = [self.state.u[b] for b in self.system.contact_bodies[index]]
        known, reach = self._searched.pop(index, None), self._reach(index, self._motion)
        if reach > 0.0:
            return self._contact_step(index, u, reach)
        if known is None or any(a is not b for a, b in zip(known[0], u, strict=True)):
            known = u, self._contact_step(index, u, reach)
        self._searched[index] = known
        return known[1]

    def _contact_step(self, index: int, u: list[FloatArray], reach: float) -> ContactStep:
        pair, state = self.system.contacts[index], self.state
        paths = [self._ahead[b] for b in self.system.contact_bodies[index]]
        moved = self._paths[index][0] if pair.rigid else None
        positions = pair.positions(u)
        found, self._followed[index], self._cover[index], self._beside[index] = pair.find(
            positions,
            state.facets[index],
            moved,
            Motion(reach, paths, self._aimed[index]),
            # In statics steps may be of any length, and what they carry inside is looked for.
            state.followed[index] if self.integrator.inertia else None,
        )
        slave, x0, theta = pair.slave, pair.points(positions, found), self.integrator.theta
        scale = self._scale(slave)[slave.share[found.node]]
        rule, condense = self.integrator.contact_gradient, self.condense
        step: ContactStep
        if pair.rigid:
            path, none = self._paths[index], np.empty((len(scale), 0))
            step = ObstacleStep(
                pair, found, rule, condense, x0 - path[0], scale, theta, path, master_scale=none
            )
        else:
            master = self._scale(pair.master)[pair.master.patches[found.facet]]
            step = ContactStep(pair, found, rule, condense, x0, scale, theta, master_scale=master)
        bodies = self.system.contact_bodies[index]
        gap, force = _EPS * (step.extent + float(max(self._length[b] for b in bodies))), 0.0
        if step.strong:
            # What touches as far as its coordinates tell would stick by their rounding.
            gap += _EPS * pair.given
        if pair.friction:
            # A force that is rounding of the bodies' own would stick or slip by its sign.
            for b in bodies:
                if not self._diagonal[b]:
                    self._measure_rounding(b)
            force = float(self.rounding[list(bodies)].sum())
        return replace(step, rounding=_TOUCH * gap, force_rounding=_TOUCH * force)

    def _scale(self, surface: Any) -> FloatArray:
        """Force per motion of a surface's points, shape (p,), see `ContactStep`. Collective."""
        if self.integrator.inertia:
            mass: FloatArray = surface.mass
            return mass
        stiffness: FloatArray = surface.nodal(surface.body.nodal_stiffness(self.integrator))
        return stiffness

    def _drop_doubles(self) -> None:
        """Of two pairs that keep a node out of the same fixed surface, leave one.

        Two constraints on one gap are one too many where no master can yield, as over the seam of
        two plates. A node stays with the one that carried it.
        """
        for i, j in itertools.combinations(range(len(self._found)), 2):
            a, b = self._found[i], self._found[j]
            if a.pair.slave.body is not b.pair.slave.body:
                continue
            one, two = (c.pair.slave.points[c.pair.slave.share[c.candidates.node]] for c in (a, b))
            _, ia, ib = np.intersect1d(one, two, return_indices=True)
            ca, cb = a.candidates.part(ia), b.candidates.part(ib)
            double = np.einsum("ni,ni->n", ca.normal, cb.normal) > 1.0 - _ONE
            double &= np.abs(ca.gap - cb.gap) < _ONE * np.minimum(ca.length, cb.length)
            double &= a.immovable[ia] & b.immovable[ib]
            stay = self.state.force[i][ca.node] >= self.state.force[j][cb.node]
            for k, c, there in ((i, a, ia[double & ~stay]), (j, b, ib[double & stay])):
                if len(there):
                    self._found[k] = c.part(~np.isin(np.arange(c.num_pairs), there))

    def _lay_out(self) -> None:
        """Layout, vectors and scatter; kept from step to step while no rank's candidates change."""
        self.destroy()
        system, contacts, num_bodies = self.system, self.contacts, len(self.awake)
        self._body_field = {k: f for f, k in enumerate(self.awake)}
        sizes = [system.bodies[k].num_owned for k in self.awake]
        multipliers = sum(c.num_pairs * c.num_multipliers for c in contacts)
        self._fields: dict[str, int] = {}
        if system.comm.allreduce(multipliers) > 0:
            if any(c.num_augmented for c in contacts):
                self._fields["augmented"] = num_bodies
                sizes.append(sum(c.num_pairs * c.num_augmented for c in contacts))
            self._fields["multipliers"] = len(sizes)
            sizes.append(multipliers)
        self.layout = Layout(system.comm, sizes)
        self.elements = self._element_blocks() if self._fields else []
        index = [np.empty(0, np.int64)]
        for c, bodies in zip(contacts, system.contact_bodies, strict=True):
            if c.num_pairs:
                fields = [self._body_field[b] for b in bodies]
                points = zip(fields, c.points(), strict=True)
                parts = [self.layout.to_system(f, p) for f, p in points]
                index.append(np.concatenate(parts, axis=1).ravel())
        needed = np.concatenate(index).astype(PETSc.IntType)
        self.x = PETSc.Vec().createMPI((self.layout.num_owned, None), comm=system.comm)
        self._forces = self.x.duplicate()
        self._local = PETSc.Vec().createSeq(len(needed), comm=PETSc.COMM_SELF)
        source = PETSc.IS().createGeneral(needed, comm=PETSc.COMM_SELF)
        self._scatter = PETSc.Scatter().create(self.x, source, self._local, None)
        source.destroy()
        self._petsc = [self.x, self._forces, self._local, self._scatter]
        self.version += 1

    def _element_blocks(self) -> list[ElementBlocks]:
        """Numbers of the contact elements' unknowns in their fields."""
        blocks = []
        offset = {name: self.layout.start(f) for name, f in self._fields.items()}
        for c, bodies in zip(self.contacts, self.system.contact_bodies, strict=True):
            if not all(b in self._body_field for b in bodies):
                blocks.append(ElementBlocks((), (), (), np.empty((0, 0), dtype=bool)))
                continue
            own = {"augmented": c.num_augmented, "multipliers": c.num_multipliers}
            numbers = list(c.dofs())
            widths = [n.shape[1] for n in numbers] + [own[name] for name in self._fields]
            for name in self._fields:
                count = c.num_pairs * own[name]
                new = offset[name] + np.arange(count)
                numbers.append(new.reshape(c.num_pairs, own[name]))
                offset[name] += count
            stops = np.cumsum(widths)
            pattern = np.ones((stops[-1], stops[-1]), dtype=bool)
            pattern[stops[-2] :, stops[-2] :] = c.multiplier_pattern
            columns = tuple(slice(int(b - w), int(b)) for w, b in zip(widths, stops, strict=True))
            fields = (*(self._body_field[b] for b in bodies), *self._fields.values())
            blocks.append(ElementBlocks(fields, columns, tuple(numbers), pattern))
        return blocks

    @property
    def may_slip(self) -> bool:
        """Whether any contact has friction with a bound."""
        coefficients = [pair.friction for pair in self.system.contacts]
        return any(mu > 0.0 and (self.bounded or np.isfinite(mu)) for mu in coefficients)

    def let_slip(self) -> None:
        """Solve this step with nodes that slip rather than leave, see `ContactStep`."""
        self.contacts = [replace(c, lets_slip=True) for c in self.contacts]

    def guess(self, *, flight: bool, forces: bool | None = None) -> None:
        """Write a first guess into `x`: motion, contact forces, d and f that fit the positions.

        Args:
            flight: Free flight from t_n under the contact forces of the last step; else the
                positions of t_n, which free flight of a fast turning or vibrating body may invert,
                and no forces. Prescribed coordinates are at t_{n+1}.
            forces: Whether to start with the contact forces of the last step; None: as `flight`.
        """
        with self.x as x:
            x[:] = 0.0
            for f, k in enumerate(self.awake):
                fixed, u1 = self.system.bodies[k].fixed, self.first[k]
                start = u1 if flight else self.state.u[k].copy()
                start[fixed] = u1[fixed]
                x[self.layout.owned(f)] = start
        forces = flight if forces is None else forces
        if self._fields and (forces or not self.integrator.inertia):
            guess = [
                self._forces_as_before(k, p).ravel() for k, p in enumerate(self._positions(self.x))
            ]
            with self.x as x:
                x[self.layout.owned(self._fields["multipliers"])] = np.concatenate(guess)
        if "augmented" in self._fields:
            positions = self._positions(self.x)
            guess = [
                c.initial_guess(p).ravel() for c, p in zip(self.contacts, positions, strict=True)
            ]
            with self.x as x:
                x[self.layout.owned(self._fields["augmented"])] = np.concatenate(guess)

    def _forces_as_before(self, index: int, x: FloatArray) -> FloatArray:
        """Multipliers of the contact forces of the last step, shape (n, multipliers).

        In statics nodes that touch at t_n start as active: without inertia a body may have nothing
        but its contacts to hold it.
        """
        c, state = self.contacts[index], self.state
        node = c.candidates.node
        force, tangential = state.force[index][node], state.tangential[index][node]
        multipliers = self.factor * c.multipliers(force, tangential) / c.scale[:, None]
        if not self.integrator.inertia:
            near = _TOUCHING * c.candidates.length
            touching = (force > 0.0) | (c.candidates.gap <= near)
            nothing = np.zeros_like(multipliers)
            gap = c.evaluate(x, np.empty((c.num_pairs, 0)), nothing).gap
            multipliers[:, 0] -= np.where(touching, near + np.maximum(gap, 0.0), 0.0)
        return multipliers

    def flight_gaps(self) -> list[FloatArray]:
        """Gaps of each contact's candidates after free flight over the step [m]."""
        return self._gaps(self.contacts, self.first)

    def _gaps(self, contacts: list[ContactStep], u: Sequence[FloatArray]) -> list[FloatArray]:
        """Gaps of some candidates of all contacts at displacements of all bodies [m]."""
        return [self._gap(k, c, u) for k, c in enumerate(contacts)]

    def _gap(self, index: int, c: ContactStep, u: Sequence[FloatArray]) -> FloatArray:
        """Gaps of some candidates of a contact at displacements of all bodies [m]. Collective."""
        moved = c.pair.positions([u[k] for k in self.system.contact_bodies[index]])
        return c.gap(c.pair.points(moved, c.candidates))

    # ---- iterates
    def _positions(self, x: Any) -> list[FloatArray]:
        """Slave and corners of each contact's pairs at an iterate [m], shape (n, nc + 1, 3)."""
        self._scatter.scatter(x, self._local, mode=PETSc.ScatterMode.FORWARD)
        u, start, out = self._local.array_r, 0, []
        for c in self.contacts:
            reference = c.reference()
            out.append(reference + u[start : start + reference.size].reshape(reference.shape))
            start += reference.size
        return out

    def _unknowns(self, x: FloatArray, name: str) -> list[FloatArray]:
        """This rank's "augmented" unknowns or "multipliers" of each contact, shape (n, width)."""
        widths = [getattr(c, f"num_{name}") for c in self.contacts]
        shapes = [(c.num_pairs, w) for c, w in zip(self.contacts, widths, strict=True)]
        if name not in self._fields:
            return [np.zeros(s) for s in shapes]
        stops = np.cumsum([n * w for n, w in shapes])
        parts = np.split(x[self.layout.owned(self._fields[name])], stops[:-1])
        return [p.reshape(s) for p, s in zip(parts, shapes, strict=True)]

    def evaluate(self, x: Any) -> Evaluation:
        """The step equations at an iterate; pure. Every rank must call it.

        Args:
            x: PETSc vector of the unknowns.
        """
        values = x.array_r.copy()
        multipliers = self._unknowns(values, "multipliers")
        augmented = self._unknowns(values, "augmented")
        positions = self._positions(x) if self._fields else [np.empty(0)] * len(self.contacts)
        contacts = tuple(
            c.evaluate(*arguments)
            for c, *arguments in zip(self.contacts, positions, augmented, multipliers, strict=True)
        )
        none = np.zeros(len(values))
        force = self._contact_forces(contacts) if self._fields else none
        bodies = dict(self._asleep)
        for f, k in enumerate(self.awake):
            body, u0, here = self.system.bodies[k], self.state.u[k], self.layout.owned(f)
            u1 = values[here]
            internal = self.factor * body.internal(u1)
            external = self.factor * body.external(u1, self._gravity)
            du, contact = u1 - u0, force[here]
            residual = self._inertial(body, du) - self._inertia[k] + internal - external + contact
            bodies[k] = BodyTerms(u1, du, internal, external, contact, residual)
        forces = tuple(
            c.scale[:, None] * m for c, m in zip(self.contacts, multipliers, strict=True)
        )
        return Evaluation(values, tuple(bodies[k] for k in sorted(bodies)), contacts, forces)

    def _contact_forces(self, contacts: tuple[Contribution, ...]) -> FloatArray:
        """G^T lambda of all contacts in this rank's coordinates [kg m]."""
        parts = [
            k.residual[:, : c.num_coordinates].ravel()
            for c, k in zip(self.contacts, contacts, strict=True)
        ]
        self._local.array_w[:] = np.concatenate([np.empty(0), *parts])
        self._forces.set(0.0)
        add, reverse = PETSc.InsertMode.ADD_VALUES, PETSc.ScatterMode.REVERSE
        self._scatter.scatter(self._local, self._forces, addv=add, mode=reverse)
        force: FloatArray = self._forces.array_r.copy()
        return force

    def residual(self, e: Evaluation) -> FloatArray:
        """This rank's part of the residual, zero at prescribed coordinates."""
        out = np.zeros(self.layout.num_owned)
        for f, k in enumerate(self.awake):
            out[self.layout.owned(f)] = _free(self.system.bodies[k], e.bodies[k].residual)
        for name, f in self._fields.items():
            rows = [c.rows(k, name).ravel() for c, k in zip(self.contacts, e.contacts, strict=True)]
            out[self.layout.owned(f)] = np.concatenate(rows)
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

    @property
    def knows_rounding(self) -> bool:
        """Whether the rounding of the forces on all bodies in the step has been measured."""
        return bool((self._diagonal[list(self.awake)] > 0.0).all())

    def measure_rounding(self, e: Evaluation) -> None:
        """Measure the rounding of the forces anew, for bodies that have stiffened. Collective.

        The bodies' matrices are not those of an iterate any more.

        Args:
            e: Iterate whose motion is longer than the one that was predicted, at most the extent.
        """
        self._length = np.maximum(self._length, self._lengths(e))
        for k in self.awake:
            self._measure_rounding(k)

    def _measure_rounding(self, k: int) -> None:
        """Note the diagonal of a body's matrix in the accepted state, never in an iterate.

        An iterate that runs off may be stiffer by any factor; its rounding excuses no residual.
        """
        diagonal = self.body_tangent(k, self.state.u[k]).getDiagonal()
        self._diagonal[k], self._diagonal_factor[k] = diagonal.norm(), self.factor
        diagonal.destroy()

    # ---- convergence
    @property
    def rounding(self) -> FloatArray:
        """Of the forces on each body [kg m]: stiffness times length times machine precision.

        Forces come from displacement gradients, so the length is that of the displacement, wherever
        the body lies and however large it is.
        """
        return self._rounding_of(self._length)

    def _rounding_of(self, length: FloatArray) -> FloatArray:
        """`rounding` at displacements of these lengths [m], shape (bodies,)."""
        bodies = zip(self.system.bodies, self._extent, strict=True)
        beside = np.array([getattr(body, "rounded", extent) for body, extent in bodies])
        rounding: FloatArray = _EPS * self._diagonal * (length + beside)
        return rounding

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
        return float(self.rounding.sum() * np.sqrt(self.system.size) * rate)

    @property
    def span(self) -> float:
        """Distance of the bodies' farthest coordinate from `centre` [m], at most."""
        return self._span + float((self._moved + self._motion).max())

    @property
    def rounded_length(self) -> float:
        """Largest length whose rounding enters forces and gaps [m]."""
        return max(self.span, *(c.extent for c in self.contacts), 0.0)

    @property
    def beside(self) -> list[tuple[float, int]]:
        """How deep in facet sizes nodes that passed a surface's edge lie behind it, and the node.

        Of each contact this rank's deepest at t_n, in input numbers; see `ContactPair.find`.
        """
        return self._beside

    def motion(self, e: Evaluation) -> FloatArray:
        """Largest component of each body's motion in the step [m], the same on all ranks."""
        local = [np.abs(b.du).max(initial=0.0) for b in e.bodies]
        return global_max(self.system.comm, np.array(local))

    @property
    def followed(self) -> tuple[BoolArray, ...]:
        """Of each contact, which of the rank's slave nodes have not passed by the surface."""
        return tuple(self._followed)

    def misses(self, e: Evaluation) -> bool:
        """Whether a solved step may have passed by a contact that was no candidate. Collective.

        If so, `begin` is to be called again with it.

        Raises:
            StepFailedError: A node went through an obstacle and out of it again.
        """
        motion, missed = self.motion(e), False
        for k, pair in enumerate(self.system.contacts):
            reach = self._reach(k, motion)
            missed |= reach > self._cover[k]
            if pair.rigid and reach > _PASSING * pair.master.width:
                self._check_passed(k, e)
            elif not pair.rigid and pair.is_long(reach):
                missed |= self._met(k, e)
        return missed

    def _met(self, index: int, e: Evaluation) -> bool:
        """Whether nodes have come through facets unseen, which are noted. Collective."""
        pair, bodies = self.system.contacts[index], self.system.contact_bodies[index]
        positions = pair.positions([self.state.u[b] for b in bodies])
        held = np.full(len(pair.slave.share), -1)
        c, active = self.contacts[index].candidates, e.contacts[index].active
        held[c.node[active]] = c.facet[active]
        hit = pair.missed(positions, [e.bodies[b].du for b in bodies], held)
        new = hit >= 0
        self._aimed[index] = np.where(new, hit, self._aimed[index])
        # What is held at a facet that its path led to is to be so again.
        at = np.where(self._aimed[index] >= 0, held, -1)
        self._aimed[index] = np.where(new | (at < 0), self._aimed[index], at)
        return bool(self.system.comm.allreduce(bool(new.any()), op=MPI.LOR))

    def _check_passed(self, index: int, e: Evaluation) -> None:
        """Raise on every rank if a node has gone through an obstacle and out of it again."""
        pair, (body,) = self.system.contacts[index], self.system.contact_bodies[index]
        start, end = self._paths[index]
        u0 = self.state.u[body]
        x0, x1 = (pair.positions([u])[0] for u in (u0, u0 + e.bodies[body].du))
        x0, x1 = x0 - start, x1 - end
        ends = np.minimum(pair.obstacle.gap(x0).value, pair.obstacle.gap(x1).value)
        passed = pair.obstacle.lowest_gap(x0, x1) < ends - _PASSING * pair.obstacle.width
        if passed.any():
            node = int(pair.slave.original[np.flatnonzero(passed)[0]])
            raise StepFailedError(
                f"step from t={self.state.time:.6g} with dt={self.dt:.3g}: contact {pair.name!r}: "
                f"node {node} passes through the obstacle within the step; use a smaller dt"
            )

    def unrest(self, e: Evaluation) -> float:
        """Force of the stabilization over what counts as converged, the largest of the bodies."""
        squares = []
        for body, t in zip(self.system.bodies, e.bodies, strict=True):
            parts = (self._stabilization(body) * t.du, t.internal, t.external, t.contact)
            squares.append([float(p @ p) for p in parts])
        norms = np.sqrt(self.system.comm.allreduce(np.array(squares)))
        limits = self.rtol * norms[:, 1:].max(axis=1) + self._rounding_of(self._lengths(e))
        return max(_over(a, b) for a, b in zip(norms[:, 0], limits, strict=True))

    def ratios(self, e: Evaluation) -> dict[str, float]:
        """Residual of each block over what counts as converged there; solved when all are <= 1."""
        squares = np.zeros((len(e.bodies), 5))
        for k in self.awake:
            t, free = e.bodies[k], _free(self.system.bodies[k], e.bodies[k].residual)
            parts = (free, self._inertia[k], t.internal, t.external, t.contact)
            squares[k] = [float(p @ p) for p in parts]
        norms = np.sqrt(self.system.comm.allreduce(squares))
        ratio, rounding = {}, self.rounding
        for k, body in enumerate(self.system.bodies):
            limit = self.rtol * norms[k, 1:].max() + rounding[k]
            ratio[body.name] = _over(norms[k, 0], limit)
        if self._fields:
            ratio |= self._contact_ratios(e)
        return ratio

    def _contact_ratios(self, e: Evaluation) -> dict[str, float]:
        moved = max(float(np.abs(b.du).max(initial=0.0)) for b in e.bodies)
        # MPI's maximum may swallow a NaN, so it travels as a flag.
        local = [moved, float(any(np.isnan(k.residual).any() for k in e.contacts))]
        for c, k, m in zip(self.contacts, e.contacts, e.multipliers, strict=True):
            gaps = c.rows(k, "multipliers") / c.scale[:, None]
            arrays = (c.rows(k, "augmented"), gaps, m, c.scale)
            local += [float(np.abs(a).max(initial=0.0)) for a in arrays]
        top = global_max(self.system.comm, np.array(local))
        motion = max(top[0], float(self._motion.max()))
        length = self.rtol * motion + 8 * _EPS * (motion + float(self._moved.max()))
        ratio: dict[str, float] = {}
        for c, (a, g, force, scale) in zip(self.contacts, top[2:].reshape(-1, 4), strict=True):
            broken = np.inf if top[1] else 0.0
            parts = {"constraints": _over(g, length + 8 * _EPS * c.extent)}
            if c.num_augmented:
                parts["(d, f)"] = _over(a, self.rtol * max(force, scale * motion))
            for part, value in parts.items():  # several contacts of two bodies have one name
                name = f"{c.pair.name} {part}"
                ratio[name] = max(value, broken, ratio.get(name, 0.0))
        return ratio

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        for a in self._petsc:
            a.destroy()
        self._petsc, self._numbers = [], None


def _free(body: Any, residual: FloatArray) -> FloatArray:
    """Residual with zeros at the prescribed coordinates, whose equation is the prescription."""
    free = residual.copy()
    free[body.fixed] = 0.0
    return free


def _box(system: System) -> tuple[FloatArray, float]:
    """Middle of the box around all bodies' reference and half its diagonal [m]. Collective."""
    ends = np.full((2, 3), -np.inf)
    for body in system.bodies:
        x = body.reference.reshape(-1, 3)
        np.maximum(ends, [x.max(axis=0, initial=-np.inf), (-x).max(axis=0, initial=-np.inf)], ends)
    high, low = global_max(system.comm, ends) * [[1.0], [-1.0]]
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))


def _over(value: float, limit: float) -> float:
    if value == 0.0:
        return 0.0
    return float(value / limit) if limit > 0 else np.inf


def _equal(a: tuple[Any, ...], b: tuple[Any, ...] | None) -> bool:
    return b is not None and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
