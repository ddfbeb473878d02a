"""Which contacts a step may meet: candidates, those that need unknowns, what a solution missed."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.contact.apart import Apart
from dolfinx_nts.contact.candidates import Motion
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import Contribution, Rub, no_pull
from dolfinx_nts.contact.edge_coupling import EdgeCoupling
from dolfinx_nts.contact.held_slip import HeldSlip
from dolfinx_nts.contact.left_behind import unheld
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.contact.placed import Placed
from dolfinx_nts.contact.shared_nodes import drop_doubles, held_before, meeting
from dolfinx_nts.contact.valleys import Face, bound, tell_met
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import Asking, anywhere, global_max, together
from dolfinx_nts.state import ContactHistory, State
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import StepFailedError, UserFunctionError

_EPS = float(np.finfo(float).eps)
#: In statics a node nearer to its facet than this part of the facet's size starts as active.
_TOUCHING = 1e-6
#: A gap of at most this many roundings of positions, or of forces, counts as closed; without a
#: force it is no contact.
_TOUCH = 4.0
#: Depth from which on flight is a poor first guess, in the size of the facets on either side.
_DEEP = 0.03
#: Flight that closes a gap by this part of the step's motion, or more, makes a contact for sure.
_SURELY = 1e-3


class ContactSearch:
    """Makes the elements of all contacts of a system, step after step; see `Coupling`.

    Attributes:
        numbers: Of the contacts, and of corners, that have candidates in this step.
        elements: Candidates of each of these that have unknowns in this step.
        idle: The others, which the step's motion does not bring to their masters.
        idle_gaps: Gaps [m] of the idle candidates of each in the last solution.
        held: What else holds slaves in this step.
        edges: Those of contacts whose surfaces are near each other in this step, by their number.
    """

    def __init__(
        self, contacts: Sequence[ContactPair], bodies: Sequence[tuple[int, ...]], comm: MPI.Comm,
        edges: Mapping[int, EdgeCoupling] = MappingProxyType({}),
    ) -> None:  # fmt: skip
        self._pairs, self._of, self._comm = contacts, list(bodies), comm
        self.numbers, self.bodies = list[int](), list[tuple[int, ...]]()
        self.elements, self.idle = list[ContactElements](), list[ContactElements]()
        self.idle_gaps: list[FloatArray] = []
        self._declared = sum(pair.of is None for pair in contacts)
        self._places, self._edges = Placed(contacts, bodies), edges
        # What holds a contact's slave out of other faces.
        self._beside: dict[int, list[int]] = {}
        for k, pair in enumerate(contacts):
            if pair.of and not pair.exchanged:
                self._beside.setdefault(self._places.own[k], []).append(k)
        held = [(own, *beside) for own, beside in self._beside.items()]
        self._faces = [each for each in held if contacts[each[0]].holds_nodes]
        self.edges: dict[int, EdgeCoupling] = {}
        self._apart, self.held = Apart(contacts, bodies), HeldSlip(contacts, self._places)
        self._sought: list[int] = []
        self._cover, self._repeats = [0.0] * len(contacts), 0
        # Candidates that elements were made of.
        self._raw: dict[int, Any] = {}
        self._known: dict[int, tuple[list[FloatArray], float, ContactElements | None]] = {}
        self._placed: dict[int, Sequence[FloatArray]] = {}
        self._begun: State | None = None
        self._had: Sequence[BoolArray] | None = None
        self._massless = [pair.slave.massless[pair.slave.share] for pair in contacts]
        shares, before = [pair.slave.share for pair in contacts], held_before(contacts)
        self._none: list[BoolArray] = [np.zeros(len(share), dtype=bool) for share in shares]
        self._foreign = [held[here] for held, here in zip(before, shares, strict=True)]
        met = zip(meeting(contacts, before), shares, strict=True)
        self._meets = [meets[here] for meets, here in met]

    @property
    def had_unknowns(self) -> list[BoolArray]:
        """Which of this rank's slave nodes had unknowns in the last step, of each contact."""
        if self._had is not None:
            return list(self._had)
        found = list(self._none)
        for k, c in zip(self.numbers, self.elements, strict=True):
            found[k] = self._none[k].copy()
            found[k][c.candidates.node] = True
        return found

    def resume(self, had: Sequence[BoolArray]) -> None:
        """Go on from another run's `had_unknowns`, before the first step."""
        self._had = list(had)

    # ---- elements of a step
    def begin(
        self, step: Step, history: tuple[ContactHistory, ...], again: Evaluation | None,
        search: bool,
    ) -> None:  # fmt: skip
        """Make the elements of a step, and begin it for edges, as of `Coupling`. Collective."""
        # Their forces are the first guess: of t_n, or of the solution that is gone on from.
        n = len(self.elements)
        self._carried = history if again is None else self.history(again.parts[:n])
        self._step, self._old, self._placed = step, history, {}
        if step.dt or self._begun is None:
            self._begun = step.state
        self._repeats = 0 if again is None else self._repeats
        time = step.state.time
        if search:
            self._apart.look(step.state.u, step.motion)
            self._sought = [k for k in range(len(self._pairs)) if k not in self._apart.far]
        self._paths = {k: self._pairs[k].path(time, time + step.dt) for k in self._sought}
        if again is None:
            self._aimed: dict[int, IntArray] = {}
        for k in self._sought:
            self._aimed.setdefault(k, np.full(len(self._pairs[k].slave.share), -1))
        near = {k: self._edges[k] for k in self._sought if k in self._edges}
        for k in self.edges.keys() - near.keys():
            self._edges[k].leave()
        known, self.edges = self.edges, near
        for k, edges in near.items():
            # What comes near within the step has no solution of it to go on from.
            edges.begin(step, step.state.edges[k], again if k in known else None, search)
        if search:
            self._followed = {k: self._old[k].followed for k in self._sought}
            self._seek()
        self._choose()

    def _seek(self) -> None:
        """Find candidates, and which of them need unknowns. Collective."""
        had, declared = self.had_unknowns, [k for k in self._sought if k < self._declared]
        found: dict[int, Any] = self._search(declared)
        drop_doubles(found, self._old)
        added = self._sought[len(declared) :]
        for number in sorted({self._pairs[k].added for k in added}):
            slaves: dict[int, list[ContactElements]] = {}
            for c in found.values():
                slaves.setdefault(id(c.pair.slave.body), []).append(c)
            now = [k for k in added if self._pairs[k].added == number]
            together(self._comm, [
                self._pairs[k].leave_to(slaves, self._edges.get(self._places.own[k])) for k in now
            ])  # fmt: skip
            found |= self._search(now)
        self._bind(found)
        tell_met(found, self._places.own)
        self.numbers, self._found = list(found), list(found.values())
        self._apart.found(self.numbers)
        self.bodies = [self._of[k] for k in found]
        self._with_unknowns = [self._may_touch(k, c, had[k]) for k, c in found.items()]
        self._had = None

    def _bind(self, found: dict[int, Any]) -> None:
        """Let nodes in inner edges stay with what has held them out of a face. Collective."""
        numbers = [[k for k in each if k in found] for each in self._faces]
        groups = [
            {k: Face(self._pairs[k], self._raw[k], self._old[k].facet) for k in each}
            for each in numbers if len(each) > 1
        ]  # fmt: skip
        for k, candidates in bound(self._comm, groups).items():
            found[k] = self._made(k, candidates)

    def _choose(self) -> None:
        """Give unknowns to the candidates that are awake."""
        both = list(zip(self._found, self._with_unknowns, strict=True))
        self.elements, self.idle = [c.select(a) for c, a in both], [c.select(~a) for c, a in both]
        self.idle_gaps = [np.empty(0) for _ in self.idle]
        self.held.begin(self._step, self._begun or self._step.state, self.numbers, self.elements)

    def watch(self) -> Asking[None]:
        """Note whether any rank has idle candidates, after `begin` and `wake`, as of `together`."""
        self._watching = yield any(len(c.candidates.node) for c in self.idle)

    def dives(self) -> Asking[bool]:
        """Whether free flight presses nodes deep into their masters, as of `together`."""
        limits = [
            _DEEP * np.minimum(c.candidates.length, c.pair.slave.smallest) for c in self.elements
        ]
        far = [
            self._reach(k, self._step.motion) > limit.min(initial=np.inf)
            for k, limit in zip(self.numbers, limits, strict=True)
        ]
        if not (yield any(far)):
            return False
        both = zip(self.flight_gaps(), limits, strict=True)
        return (yield any((gap < -limit).any() for gap, limit in both))

    def forget_solution(self) -> None:
        """Guess forces of t_n again, where those of a solution of this step led nowhere."""
        self._carried = self._old

    def touched(self) -> set[int]:
        """Bodies of contacts that have unknowns, the same on all ranks. Collective."""
        on = global_max(self._comm, np.array([float(a.any()) for a in self._with_unknowns])) > 0.0
        return set().union(*itertools.compress(self.bodies, on))

    def _positions(self, k: int) -> Sequence[FloatArray]:
        """Positions of all points of a contact that is sought, at t_n [m]. Collective."""
        if not self._placed:
            self._placed = self._places.at(self._sought, self._step.state.u)
        return self._placed[k]

    def _reach(self, k: int, motion: FloatArray) -> float:
        """Bound on the motion of slaves relative to the master [m]."""
        reach = np.sqrt(3.0) * float(sum(motion[b] for b in self._of[k]))
        return reach + float(np.linalg.norm(np.diff(self._paths[k], axis=0)))

    def _search(self, numbers: Sequence[int]) -> dict[int, ContactElements]:
        """Candidates of contacts that have some, on all ranks. Collective."""
        found = together(self._comm, map(self._searched, numbers))
        return {k: c for k, c in zip(numbers, found, strict=True) if c is not None}

    def _searched(self, k: int) -> Asking[ContactElements | None]:
        """Candidates of a contact, found anew unless all its bodies slept and nothing moves.

        None: it has none.
        """
        u = [self._step.state.u[b] for b in self._of[k]]
        known, reach = self._known.pop(k, None), self._reach(k, self._step.motion)
        if reach > 0.0:
            return (yield from self._find(k, reach))
        # Overlap that is pressed out is another one in a load step of another length.
        ramp = self._step.integrator.ramp(self._step.state.time + self._step.dt)
        if known is None or known[1] != ramp or any(map(operator.is_not, known[0], u)):
            known = u, ramp, (yield from self._find(k, reach))
        self._known[k] = known
        return known[2]

    def _find(self, k: int, reach: float) -> Asking[ContactElements | None]:
        pair, path, bodies, step = self._pairs[k], self._paths[k], self._of[k], self._step
        positions, ahead = self._positions(k), [step.ahead[b] for b in bodies]
        rests, old = not step.integrator.inertia, self._old[k]
        motion = Motion(reach, ahead, self._aimed[k], self._repeats > 0, rests)
        # What load steps carry inside is looked for.
        followed = None if rests and k < self._declared else old.followed
        found, self._followed[k], self._cover[k] = yield from pair.find(
            positions, old.facet, path, motion, followed
        )
        mine, share = ~self._foreign[k][found.node], pair.slave.share
        if k in self._edges:
            each = [self._old[i].force > 0.0 for i in (k, *self._beside.get(k, ()))]
            carry = share[np.any(each, axis=0)]
            beyond = yield from self._edges[k].find(positions, found, carry)
            mine &= ~np.isin(share[found.node], beyond)
        found = found.select(mine)
        if not (yield len(found.node) > 0):
            return None
        self._raw[k] = found
        return self._made(k, found)

    def _made(self, k: int, found: Any) -> ContactElements:
        """Elements of candidates of a contact. Collective."""
        pair, path, bodies, step = self._pairs[k], self._paths[k], self._of[k], self._step
        positions, old = self._positions(k), self._old[k]
        overlap, start = old.overlap[found.node], step.state.time
        ramp = step.integrator.ramp
        found = found._replace(gap=found.gap + (1.0 - ramp(start)) * overlap)
        elements: ContactElements = pair.elements(found, positions, path, step)
        gap = _EPS * (elements.extent + float(max(step.length[b] for b in bodies)))
        if elements.law.strong:
            # Else nodes whose gap is the rounding of given coordinates would stick.
            gap += _EPS * pair.given
        # The sign of a force that is rounding must not decide on stick or slip.
        force = step.force_rounding(bodies) if pair.friction else 0.0
        law = replace(
            elements.law, overlap=(1.0 - ramp(start + step.dt)) * overlap, rounding=_TOUCH * gap,
            force_rounding=_TOUCH * force, meets=self._meets[k][found.node],
        )  # fmt: skip
        if pair.friction and not step.dt:
            # A load step is relaxed in several solutions, and friction knows of all of them.
            begun = self._begun or step.state
            since, start = pair.positions([begun.u[b] for b in bodies]), begun.time
            law = replace(law, slid=elements.slid_since(since, pair.path(start, start)[0]))
        massless = self._massless[k][found.node]
        if step.integrator.inertia and massless.any():
            before = step.factor * elements.carried(old)
            before[~massless] = np.nan
            law = replace(law, before=before)
        return replace(elements, law=law, offset=pair.offset[found.node] if pair.adjust else 0.0)

    def _may_touch(self, k: int, c: ContactElements, had: BoolArray) -> BoolArray:
        """Return which need unknowns: all within reach, and those that had them in the last step.

        In statics, where no motion bounds the next one, all do. Strong friction may hold nodes that
        free motion lets go (Painleve's paradox), and an iterate's errors would choose which: there
        only what carries, or what flight presses in, begins with unknowns.
        """
        if not self._step.integrator.inertia:
            return np.ones(len(c.candidates.node), dtype=bool)
        node, reach = c.candidates.node, self._reach(k, self._step.motion)
        force = self._old[k].force[node]
        if c.law.strong:
            first = self._places.at([k], self._step.first)[k]
            closes = c.gap_at(first, self._paths[k][1]) < -_SURELY * reach
            return closes | (force > no_pull(self._old[k].tangential[node]))
        # What goes to and fro at the limit would change the layout in every step, and rounding of
        # gaps must not decide which of the nodes that rest carry forces.
        near = reach + c.law.rounding if c.pair.redundant else reach
        return had[node] | (c.candidates.gap < near) | (force > 0.0)

    # ---- a solution
    def wake(self, e: Evaluation, parts: Sequence[Contribution]) -> bool:
        """Give unknowns to idle candidates whose gaps a solution closes, if any. Collective."""
        if not self._watching:
            return False
        self.idle_gaps = self._gaps(self.idle, [terms.u1 for terms in e.bodies])
        both = zip(self.idle, self.idle_gaps, strict=True)
        closed = [~(gap >= -c.law.gap_rounding) for c, gap in both]
        if not anywhere(self._comm, any(c.any() for c in closed)):
            return False
        for awake, late in zip(self._with_unknowns, closed, strict=True):
            awake[np.flatnonzero(~awake)[late]] = True
        self._carried = self.history(parts)
        self._choose()
        return True

    def misses(self, e: Evaluation, parts: Sequence[Contribution], motion: FloatArray) -> bool:
        """Return whether a step may have passed by a contact that was no candidate. Collective.

        Raises:
            StepFailedError: A node went through an obstacle and out of it again.
        """
        batches = dict(zip(self.numbers, range(len(parts)), strict=True))
        missed, passed = self._apart.misses(motion), list[Asking[bool]]()
        held = {k: np.full(len(self._pairs[k].slave.share), -1) for k in self._sought}
        for k, i in batches.items():
            c, active = self.elements[i].candidates, parts[i].active
            held[k][c.node[active]] = c.facet[active]
        for k in self._sought:
            for i in held.keys() & self._beside.get(k, ()):
                held[k] = np.where(held[k] < 0, held[i], held[k])
            reach = self._reach(k, motion)
            missed |= reach > self._cover[k]
            passed.append(self._passed(k, e, held[k], reach))
        missed |= any(together(self._comm, passed))
        stale = not missed and self._are_stale(e, parts)
        self._repeats = self._repeats + 1 if stale else 0
        return missed or stale

    def _are_stale(self, e: Evaluation, parts: Sequence[Contribution]) -> bool:
        """Return whether an equilibrium's elements are those of other places. Collective."""
        if self._step.integrator.inertia:
            return False
        stale = False
        for of, c, part in zip(self.bodies, self.elements, parts, strict=True):
            end = c.pair.positions([e.bodies[b].u1 for b in of])
            stale |= c.is_stale(end, part, self._repeats)
        return stale

    def strayed(self, e: Evaluation) -> float:
        """How far from the master's real surface carrying nodes ended, in facet sizes. Collective.

        They left their facets in a load step, over edges of a curved surface.
        """
        far = [0.0]
        for of, c, part in zip(self.bodies, self.elements, e.parts, strict=False):
            on, end = part.active, c.pair.positions([e.bodies[b].u1 for b in of])
            due = np.broadcast_to(c.offset - c.law.overlap, on.shape)[on]
            far.append(c.pair.strayed(end, c.candidates.select(on), due))
        return float(global_max(self._comm, np.array(far)).max())

    def _passed(self, k: int, e: Evaluation, held: IntArray, reach: float) -> Asking[bool]:
        """Return whether nodes have come through facets unseen, which are noted."""
        pair, bodies, path = self._pairs[k], self._of[k], self._paths[k]
        motions, positions = [e.bodies[b].du for b in bodies], self._positions(k)
        try:
            hit = yield from pair.missed(positions, motions, path, reach, held, self._aimed[k])
        except UserFunctionError:
            raise
        except StepFailedError as failure:
            time, dt = self._step.state.time, self._step.dt
            text = f"step from t={time:.6g} with dt={dt:.3g}: {failure}"
            raise StepFailedError(text, advises=failure.advises) from None
        if hit is None:
            return False
        new = (hit >= 0) & ~self._foreign[k]
        self._aimed[k] = np.where(new, hit, self._aimed[k])
        # What is held at a facet that its path led to is to be so again.
        at = np.where(self._aimed[k] >= 0, held, -1)
        self._aimed[k] = np.where(new | (at < 0), self._aimed[k], at)
        return (yield bool(new.any()))

    def history(self, parts: Sequence[Contribution]) -> tuple[ContactHistory, ...]:
        """Return what each contact remembers of an accepted step."""
        histories = self._apart.histories(self._old, self._followed)
        each = zip(self.numbers, self.elements, parts, self.idle, self.idle_gaps, strict=True)
        for k, c, part, idle, gaps in each:
            new, others = c.history(part, self._step.factor, self._old[k]), idle.candidates
            new.facet[others.node], new.gap[others.node] = others.facet, gaps
            histories[k] = new._replace(followed=self._followed[k])
        return tuple(histories)

    def smallest(self, parts: Sequence[Contribution]) -> dict[str, float]:
        """The smallest gap of an accepted step on this rank, infinite without candidates."""
        both = zip(self.elements, parts, strict=True)
        gaps = [part.gap - c.law.overlap for c, part in both] + self.idle_gaps
        return {"min_gap": min((float(g.min(initial=np.inf)) for g in gaps), default=np.inf)}

    def warnings(self, parts: Sequence[Contribution]) -> list[StepWarning]:
        """Nodes that an accepted step leaves behind a surface without contact."""
        return list(unheld(self._comm, self.elements, parts))

    # ---- first guesses, and what leads to a solution
    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Multipliers of the contact forces of the last step, shape (n, constraints).

        In statics nodes that touch at t_n start as active: without inertia a body may have nothing
        but its contacts to hold it. Where a solution of this step has missed contacts, and in the
        relaxations of a load step, they are its forces.
        """
        c, multipliers = self.elements[k], self.carried(k)
        if c.pair.redundant and self._carried is self._old:
            # Else rounding adds up over steps in forces that sticking nodes exert on each other.
            multipliers[:, 1:] = 0.0
        solved = self._carried is not self._old or (self._step.dt == 0.0 and self.carried_any())
        if not self._step.integrator.inertia and not solved:
            near = _TOUCHING * c.candidates.length
            carries = self._old[self.numbers[k]].force[c.candidates.node] > 0.0
            # Where nothing carries yet, bodies may touch at a point and have all means open.
            sag = 0.0 if anywhere(self._comm, bool(carries.any())) else c.sag
            touching = carries | (c.candidates.gap <= np.maximum(near, sag))
            multipliers[:, 0] -= np.where(touching, near + np.maximum(c.gap(x), 0.0), 0.0)
        return multipliers

    def carried(self, k: int) -> FloatArray:
        """Multipliers of the contact forces of the last step as they were, (n, constraints)."""
        c, old = self.elements[k], self._carried[self.numbers[k]]
        forces = c.multipliers(*(of[c.candidates.node] for of in (old.force, old.tangential)))
        return self._step.factor * forces / c.law.scale[:, None]

    @property
    def may_slip(self) -> bool:
        """Whether any contact has friction with a bound."""
        return any(0.0 < pair.friction < np.inf for pair in self._pairs)

    def carried_any(self) -> bool:
        """Whether any node presses where the step begins or goes on from. Collective."""
        return anywhere(self._comm, any((old.force > 0.0).any() for old in self._carried))

    @contextmanager
    def imposed(self, active: Sequence[BoolArray], *, stick: bool = False) -> Iterator[None]:
        """Hold candidates active or inactive for a while, whatever the laws say.

        Args:
            active: Of each of `elements`, shape (n,).
            stick: Let the active ones stick, too, but for those that hardly rub.
        """
        by_law, both = self.elements, zip(self.elements, active, strict=True)
        self.elements = [replace(c, law=c.law.held(on, stick=stick)) for c, on in both]
        try:
            yield
        finally:
            self.elements = by_law

    def rub(self, how: Rub) -> None:
        """What candidates with friction that touch obey from the next iterate on."""
        self.elements = [replace(c, law=replace(c.law, rubs=how)) for c in self.elements]

    def flight_gaps(self) -> list[FloatArray]:
        """Gaps of each contact's candidates after free flight over the step [m]. Collective."""
        return self._gaps(self.elements, self._step.first)

    def _gaps(
        self, elements: Sequence[ContactElements], u: Sequence[FloatArray]
    ) -> list[FloatArray]:
        """Gaps of candidates of each contact at displacements of all bodies [m]. Collective."""
        placed = self._places.at(self.numbers, u)
        both = zip(self.numbers, elements, strict=True)
        return [c.gap_at(placed[k], self._paths[k][1]) for k, c in both]
