"""Which sharp edges of two bodies may meet in a step, and their elements (theory section 18)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.candidates import MARGIN, Candidates
from dolfinx_nts.contact.edge_contact import EdgeAttachment, EdgeContact, EdgeElements
from dolfinx_nts.contact.edges import LEVEL, SHARES, Near, Pairs
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.making import elements_of
from dolfinx_nts.contact.surfaces import gather_each
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.kernels.vectors import relative_way
from dolfinx_nts.parallel import Asking, anywhere, global_max, together
from dolfinx_nts.state import EdgeHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

_EPS = float(np.finfo(float).eps)
#: A gap of so many roundings of positions counts as closed.
_TOUCH = 4.0
#: Edges that have passed each other by this part of a facet, beside the step's motion, touch.
_NEAR = 1e-6
#: Part of the step's motion by which edges that contact passes on to may have passed each other.
_OVERSHOT = 0.1
#: Parts of the shorter edge up to which edges that start inside each other are looked at, and
#: from which on they are told.
_STARTS, _TOLD = 0.2, 0.01
#: `Near.node` of a node that has the contact if it is a candidate, from here on.
_ASKED = 3
#: Of a cube of unit edges.
_DIAGONAL = 3.0**0.5
_NONE: IntArray = np.empty((0, 2), dtype=np.int64)


class EdgeCoupling:
    """Makes the elements of edges that may meet in a step; see `Coupling`.

    `ContactSearch` asks it for them once it has the nodes that may touch, as an edge beside a node
    that is held is the node's.

    Args:
        contact: The edges.

    Attributes:
        elements: Those of the step, one batch where any rank has some.
        bodies: As of `Coupling`.
    """

    def __init__(self, contact: EdgeContact) -> None:
        self.contact, self._of = contact, contact.bodies
        self._comm = contact.pair.slave.body.comm
        self.elements: list[Any] = []
        self.bodies: list[tuple[int, ...]] = []
        # Pairs that are near, where the bodies were when they were sought, how far they have moved
        # since then at most, and how far they may move before others are near.
        self._pairs: Pairs | None = None
        # Of these the ones with elements, on this rank, and of all ranks in the step so far.
        self._chosen, self._tried, self._any = _NONE, _NONE[:, 0], False
        self._looked: Sequence[FloatArray] = ()
        self._way, self._clear = 0.0, 0.0
        # Where the boundaries' points were at the end of the last solution.
        self._end: tuple[Sequence[FloatArray], Sequence[FloatArray]] | None = None
        # How deep edges start inside each other that nothing presses out, in lengths, and when.
        self._inside, self._start = 0.0, np.nan
        # Where they were last, and whether their motion from there is known.
        self._last: Sequence[FloatArray] = ()
        self._followed = False

    def touched(self) -> set[int]:
        """Bodies whose edges are near each other."""
        return set(self._of) if self.elements else set()

    # ---- which edges are near each other
    def _reach(self, motion: FloatArray) -> float:
        one, two = self._of
        return _DIAGONAL * float(motion[one] + motion[two])

    def _is_clear(self, u: Sequence[FloatArray]) -> bool:
        """Whether the pairs that were found to be near will do for a step. Collective."""
        same = len(self._last) and all(a is b for a, b in zip(u, self._last, strict=True))
        followed, self._last, self._followed = self._followed, u, False
        if not self._looked:
            return False
        room = self._clear - self._cover
        if (same or followed) and self._way <= room:
            return True
        # The bound counts all motion, also what both have in common or take back.
        both = zip(self.contact.pair.bodies, u, self._looked, strict=True)
        ranges = np.array([body.motion_range(now - before) for body, now, before in both])
        self._way = float(relative_way(global_max(self._comm, ranges)[None])[0])
        return self._way <= room

    def _look(self, u: Sequence[FloatArray], places: Sequence[FloatArray]) -> None:
        """Seek pairs of edges unless those that were found will do. Collective.

        Args:
            u: Owned displacements of both bodies [m].
            places: Positions of all points of the pair's surfaces [m].
        """
        if self._is_clear(u):
            return
        self._looked, self._way = u, 0.0
        self._clear, self._pairs = search.distance(*places), None
        if self._clear <= self._cover:
            self._clear = self._cover + MARGIN * self.contact.size
            found = self.contact.within(self.contact.positions(u), self._clear)
            self._pairs = Pairs(self.contact.edges, found) if len(found) else None

    def leave(self) -> None:
        """Forget where edges are as the surfaces are far from each other."""
        self._looked, self._last, self._followed, self._pairs = (), (), False, None
        self._chosen, self._tried, self._end, self._any = _NONE, _NONE[:, 0], None, False
        self.make()

    # ---- which of these may meet in a step
    def begin(
        self, step: Step, history: EdgeHistory, again: Evaluation | None, search: bool
    ) -> None:
        """Note a step, as of `Coupling.begin`; the search for nodes says whether `find` is due."""
        self._step, self._history = step, history
        if np.isnan(self._start):
            # A run that goes on knows its contacts.
            near = any(np.isfinite(c.gap).any() for c in step.state.contacts)
            known = anywhere(self.contact.pair.slave.body.comm, near)
            self._start = np.inf if known else step.state.time
        if again is None:
            self._carried, self._tried = history, _NONE[:, 0]

    def find(
        self, places: Sequence[FloatArray], nodes: Candidates, pressed: IntArray
    ) -> Asking[IntArray]:
        """Choose the pairs that may meet in a step, as of `together`.

        Args:
            places: Positions of all points of the pair's surfaces [m].
            nodes: This rank's slaves that may touch facets of the master.
            pressed: This rank's points of the slave that pressed in the last step.

        Returns:
            Points of the slave beyond the master's edges that these pairs hold in their place.
        """
        step, of = self._step, self._of
        reach, near = self._reach(step.motion), self._near
        self._cover, self._nodes = reach + MARGIN * self.contact.size, nodes
        u = [step.state.u[b] for b in of]
        self._look(u, places)
        self._chosen, self._any = _NONE, False
        if self._pairs is None:
            return _NONE[:, 0]
        self._x = yield from self._positions(u)
        # No motion bounds a load step.
        limit = near if step.integrator.inertia else self._cover
        boundaries = [edges.surface for edges in self.contact.edges]
        ways = gather_each(boundaries, [step.ahead[b] for b in of])
        found = self._pairs.closest(self._x, ways, reach + near, near, limit)
        gone = np.setdiff1d(pressed, self.contact.pair.slave.share[nodes.node])
        gone = np.column_stack([gone, np.full_like(gone, -1)])
        rows = yield np.concatenate([self._history.pair, gone])
        old, let_go = rows[rows[:, 1] >= 0], rows[rows[:, 1] < 0, 0]
        some = len(old) or len(let_go) or len(self._tried) or found.some[0]
        some = some or step.state.time == self._start
        if not some and self.contact.pair.holds_nodes:
            return _NONE[:, 0]
        pairs = self._pairs.numbers
        chosen = yield from self._choose(found, old, let_go, reach, limit)
        out = np.flatnonzero(chosen & (found.beyond > 0))
        mine = np.flatnonzero(chosen & self.contact.mine[pairs[:, 0]])
        self._chosen, self._gap = pairs[mine], found.gap[mine, 0]
        self._turned = found.turned[mine]
        self._any = yield len(mine) > 0
        beyond: IntArray = self.contact.ends[0][pairs[out, 0], found.beyond[out] - 1]
        return beyond

    def _choose(
        self, found: Near, old: IntArray, let_go: IntArray, reach: float, limit: float
    ) -> Asking[BoolArray]:
        """Which of the pairs that are near may press, shape (n,), as of `together`.

        Args:
            found: Where they meet.
            old: Pairs that pressed in the last step, or were followed, on all ranks, (k, 2).
            let_go: As of `find`, of all ranks.
            reach: Bound on the step's motion [m].
            limit: As of `Pairs.closest` [m].
        """
        assert self._pairs is not None
        pairs, gap, holds = self._pairs.numbers, found.gap[:, 0], self.contact.pair.holds_nodes
        carries = np.isin(self._key(pairs), self._key(old)) & (holds | (gap < reach))
        # Contact may pass along an edge, or from a node on to an edge there.
        follows = np.isin(pairs[:, 0], old[:, 0]) | np.isin(pairs[:, 1], old[:, 1])
        if len(let_go):
            follows |= np.isin(self.contact.ends[0][pairs[:, 0]], let_go).any(axis=1)
        near, meet = gap > -_OVERSHOT * reach, found.meet[:, :2].any(axis=1)
        follows &= near & (gap < (limit if holds else reach))
        chosen = found.touch | ((carries | follows) & meet)
        if self._step.state.time == self._start and not len(old):
            chosen |= self._pressed_out(found)
        if not holds:
            # A rim enters a little what is kept out of it in the mean.
            chosen |= near & (gap < limit) & meet & (found.node == 0)
        # What held in an attempt at the step passes nothing in that one's solution.
        chosen |= np.isin(self._key(pairs), self._tried) & np.isfinite(gap)
        # Where no node is held, edges that press pass a rim on, one after the other.
        passed = (carries & (found.node == 1)) if holds else chosen & (carries | follows)
        left = chosen & ((found.node == 0) | (found.node >= _ASKED)) & ~(passed & (not holds))
        yield from self._leave_to_nodes(found, left)
        chosen &= left | passed
        if not holds:
            self._take_one_at_nodes(found, chosen)
        self._take_once(found, chosen, carries)
        self._tried = self._key(pairs[chosen])
        return chosen

    def _pressed_out(self, found: Near) -> BoolArray:
        """Which of the pairs that start inside each other are pressed out.

        Those of load steps, if the contact resolves what starts inside, as chords of curves may do.
        Else they are let through until they are out, and told.
        """
        assert self._pairs is not None
        contact, rule = self.contact, self._step.integrator
        both = zip(contact.lengths, self._pairs.numbers.T, strict=True)
        depth = -found.gap[:, 0] / np.minimum(*(length[k] for length, k in both))
        inside = found.meet[:, 0] & (found.node == 0) & (depth > 0.0) & (depth < _STARTS)
        asked = contact.pair.interference == "resolve" and not rule.inertia
        self._inside = 0.0 if asked else float(depth[inside].max(initial=0.0))
        return inside & asked

    @cached_property
    def _near(self) -> float:
        """Distance that counts as none [m]."""
        return _NEAR * self.contact.size

    def _leave_to_nodes(self, found: Near, chosen: BoolArray) -> Asking[None]:
        """Take from chosen pairs those beside nodes that are candidates, as of `together`.

        These touch a facet that the slave's edge is level with, a little beyond its rim, as where
        flat faces lie on each other, or flight would press them in.
        """
        some = np.flatnonzero(chosen & (found.node >= _ASKED))
        # Pairs are the same on all ranks.
        if not some.size:
            return
        assert self._pairs is not None
        slave, own = self.contact.pair.slave, self._pairs.numbers[some, 0]
        normals = np.zeros((len(slave.share), 3))
        normals[self._nodes.node] = self._nodes.normal
        normals = yield from slave.spread(normals)
        normal = normals[self.contact.ends[0][own, found.node[some] - _ASKED]]
        start, end = self._x[0][self.contact.edges[0].ends[own]].transpose(1, 0, 2)
        rise = np.abs(np.einsum("ni,ni->n", normal, end - start))
        level = rise < LEVEL * np.linalg.norm(end - start, axis=1)
        chosen[some[level & normal.any(axis=1)]] = False

    def _take_one_at_nodes(self, found: Near, chosen: BoolArray) -> None:
        """Take from chosen pairs that meet at a node of the slave all but one of each rim there.

        One that meets at the end of the step stays.

        Args:
            found: Where they meet.
            chosen: Pairs, shape (n,).
        """
        some = np.flatnonzero(chosen & (found.node > 0))
        if some.size < 2:
            return
        assert self._pairs is not None
        some = some[np.argsort(~found.meet[some, 1], kind="stable")]
        own, other = self._pairs.numbers[some].T
        ends = self.contact.edges[0].ends[own]
        shared = (ends[:, None, :, None] == ends[None, :, None, :]).any(axis=(2, 3))
        shared &= other[:, None] == other
        for i in range(1, len(some)):
            chosen[some[i]] = not (shared[i, :i] & chosen[some[:i]]).any()

    def _take_once(self, found: Near, chosen: BoolArray, carries: BoolArray) -> None:
        """Take from chosen pairs that meet at a node of the master all but one of each edge there.

        Args:
            found: Where they meet.
            chosen: Pairs, shape (n,).
            carries: Which of them pressed in the last step, shape (n,).
        """
        some = np.flatnonzero(chosen & (found.corner > 0))
        if some.size < 2:
            return
        assert self._pairs is not None
        some = some[np.argsort(~carries[some], kind="stable")]
        own, other = self._pairs.numbers[some].T
        at = self.contact.edges[1].ends[other, found.corner[some] - 1]
        _, first = np.unique(np.column_stack([own, at]), axis=0, return_index=True)
        chosen[np.delete(some, first)] = False

    def _positions(self, u: Sequence[FloatArray]) -> Asking[Sequence[FloatArray]]:
        """Positions of all points of both boundaries at t_n [m], as of `together`.

        Mostly the last solution ends there.
        """
        end, self._end = self._end, None
        if end is not None:
            moved = not all(np.array_equal(a, b) for a, b in zip(u, end[0], strict=True))
            if not (yield moved):
                return end[1]
        return self.contact.positions(u)

    def _key(self, pairs: IntArray) -> IntArray:
        """One number for each pair (n, 2)."""
        key: IntArray = pairs[:, 0] * len(self.contact.edges[1].ends) + pairs[:, 1]
        return key

    @property
    def ends(self) -> IntArray:
        """Points of the master and of the slave at ends of edges that may meet, all ranks', (n, 4).

        Of the step so far.
        """
        if self._pairs is None:
            return np.empty((0, 4), dtype=np.int64)
        own, other = np.divmod(self._tried, len(self.contact.edges[1].ends))
        slave, master = self.contact.ends
        return np.column_stack([master[other], slave[own]])

    # ---- elements of a step
    def make(self) -> None:
        """Make the elements of the pairs that `find` has chosen. Collective."""
        self.elements = [self._made()] if self._any else []
        self.bodies = [self._of] * len(self.elements)

    def _made(self) -> EdgeElements:
        contact, pair, step = self.contact, self.contact.pair, self._step
        turned, (own, other) = self._turned, self._chosen.T
        ends = [at[k] for at, k in zip(contact.ends, (own, other), strict=True)]
        ends[0] = np.where(turned[:, None], ends[0][:, ::-1], ends[0])
        both = zip(self._x, contact.edges, (own, other), strict=True)
        y = np.concatenate([x[edges.ends[k]] for x, edges, k in both], axis=1)
        y[turned, :2] = y[turned, 1::-1]
        x = np.matmul(SHARES, y)
        xi, _ = compiled.project(x[:, 0], x[:, 1:], np.zeros((len(x), 2)))
        _, _, normal = facets.frame(x[:, 1:], xi)
        length = facets.size(x[:, 1:])
        candidates = Candidates(own, other, other, xi, normal, self._gap, length)
        rule = step.integrator
        measure = FacetGap(
            start=x, xi=xi, normal=normal, length=length, rule=rule.contact_gradient,
            theta=rule.theta, condense=step.condense,
        )  # fmt: skip
        slave, master = pair.surfaces
        attachment = EdgeAttachment(slave=slave, master=master, own=ends[0], other=ends[1])
        made = elements_of(pair, candidates, attachment, measure, step)
        gap = _EPS * (made.extent + float(max(step.length[b] for b in self._of)))
        force = step.force_rounding(self._of) if pair.friction else 0.0
        law = replace(made.law, rounding=_TOUCH * gap, force_rounding=_TOUCH * force)
        return EdgeElements(
            pair=pair, candidates=candidates, attachment=attachment, measure=measure, law=law
        )

    @property
    def pressed(self) -> BoolArray:
        """Which of the elements pressed at t_n."""
        old = self._history
        return np.isin(self._key(self._chosen), self._key(old.pair[old.force > 0.0]))

    # ---- a solution
    def wake(self, e: Evaluation, parts: Sequence[Any]) -> bool:
        """All have unknowns."""
        if self.elements:
            self._carried = self.history(parts)
        return False

    def forget_solution(self) -> None:
        """Guess forces of t_n again, where those of a solution of this step led nowhere."""
        self._carried = self._history

    def misses(self, e: Evaluation, parts: Sequence[Any], motion: FloatArray) -> bool:
        """Whether edges may have passed through each other that were not looked at. Collective."""
        reach = self._reach(motion)
        self._way, self._followed = self._way + reach, True
        if reach > self._cover:
            return True
        if self._pairs is None:
            return False
        u = [e.bodies[b].u1 for b in self._of]
        self._end, near = ([each.copy() for each in u], self.contact.positions(u)), self._near
        ways = [end - x for end, x in zip(self._end[1], self._x, strict=True)]
        found = self._pairs.closest(self._x, ways, reach + near, near)
        # So far the same on all ranks.
        if not found.some[1]:
            return False
        through = found.through & ((found.node == 0) | (found.node >= _ASKED))
        together(self._comm, [self._leave_to_nodes(found, through)])
        pairs = self._pairs.numbers
        through &= self.contact.mine[pairs[:, 0]]
        through &= ~np.isin(self._key(pairs), self._key(self._chosen))
        for i in np.flatnonzero(through & (found.corner > 0)):
            # What crosses a node of the master is held at one of the edges there.
            ends, (own, other) = self.contact.edges[1].ends, pairs[i]
            same = ends[self._chosen[:, 1]] == ends[other, found.corner[i] - 1]
            through[i] = not (same.any(axis=1) & (self._chosen[:, 0] == own)).any()
        return anywhere(self._comm, bool(through.any()))

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Multipliers of the forces of the last step, or of a solution that is gone on from."""
        c, old = self.elements[k], self._carried
        where = {int(i): n for n, i in enumerate(self._key(old.pair))}
        at = np.array([where.get(int(i), -1) for i in self._key(self._chosen)], dtype=int)
        force = np.append(old.force, 0.0)[at]
        tangential = np.vstack([old.tangential, np.zeros(3)])[at]
        if c.law.redundant and old is self._history:
            tangential = np.zeros_like(tangential)
        found = c.multipliers(force, tangential)
        guess: FloatArray = self._step.factor * found / c.law.scale[:, None]
        return guess

    def smallest(self, parts: Sequence[Any]) -> dict[str, float]:
        """The smallest gap."""
        return {"min_gap": min((float(p.gap.min(initial=np.inf)) for p in parts), default=np.inf)}

    def warnings(self, parts: Sequence[Any]) -> list[StepWarning]:
        """Edges that start inside each other and are let through."""
        inside, self._inside = self._inside, 0.0
        if inside <= _TOLD:
            return []
        name = self.contact.pair.name
        text = (
            f"edges of contact {name!r} start inside each other by up to {inside:.3g} of their "
            "length, as chords of curves do, and are let through until they are out: move the "
            "bodies apart, or pass interference='resolve' to the pair and let load steps of "
            "equilibrium press them out"
        )
        return [StepWarning("edges start inside", inside, text, (name,))]

    def history(self, parts: Sequence[Any]) -> EdgeHistory:
        """The pairs that carry, or are followed, and their forces."""
        if not parts:
            return EdgeHistory.of_start()
        (part,), factor = parts, self._step.factor
        # Where no node is held, what a rim passes is followed also while it does not press.
        on = part.active | (not self.contact.pair.holds_nodes)
        force = np.where(part.active, -part.multiplier[:, 0] / factor, 0.0)
        return EdgeHistory(self._chosen[on], force[on], part.tangential[on] / factor)
