"""The iterates of a step."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.contact.contact_law import Rub
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import anywhere, global_max, global_sum
from dolfinx_nts.solve.blurred_contacts import BlurredContacts
from dolfinx_nts.solve.rubbing_joints import RubbingJoints
from dolfinx_nts.types import IntArray

#: Iterations in a row without fewer changes of the active set before one changes at a time.
_PATIENCE = 4
#: Changes of an element's status from which on it goes to and fro.
_TO_AND_FRO = 4
#: Iterations at most in which nodes hardly rub.
_SLIDING = 12
#: Nodes that slip run away if they do so by more than this part of a facet and by so many times
#: what they have slid where they hardly rubbed.
_FAR, _FARTHER = 0.25, 2.0


class Iterates:
    """Evaluates the iterates of a step and counts how often elements change their status.

    Attributes:
        last: Evaluation of the last iterate.
        known: PETSc vectors that hold it on all ranks, and their states: PETSc counts changes of a
            vector, and the same ones on all ranks.
        flips: Of each batch of elements how often each has changed its status.
        led: How many iterates of the attempt blurred laws have led, see `RubbingJoints` and
            `BlurredContacts`.
        settled: Whether no element of this rank changed its status in the last iteration.
        imposed: Whether the last iterate was evaluated with contacts that its laws would change.
        runs_away: Whether nodes that hardly rub slid so far that friction must be what holds them.
    """

    def __init__(self, problem: StepProblem) -> None:
        self._problem, self._sliding = problem, 0
        self._joints = RubbingJoints(problem)
        self._contacts = BlurredContacts(problem)
        self.restart()

    def restart(self) -> None:
        """Forget all iterates, as a step begins."""
        self._forget()
        self.flips: list[IntArray] = []
        self.imposed, self.settled, self._pivots = False, True, False
        self._fewest, self._patience = np.inf, _PATIENCE
        self.runs_away, self._slid_by = False, 0.0
        self.led = 0
        self._joints.restart()
        self._contacts.try_again()
        self._rub_by_law()

    def slide_first(self) -> None:
        """Let nodes hardly rub until it is settled which ones touch, and slip from there on.

        See `Rub`. What friction alone holds runs away.
        """
        self._forget()
        self._sliding, self._slid_by = _SLIDING, 0.0
        self._problem.couplings.contacts.rub(Rub.HARDLY)

    def try_again(self, *, pivots: bool) -> None:
        """Forget the last iterate, as another attempt at the same step begins.

        Args:
            pivots: Whether contacts change one at a time in it where changing all at once leads
                nowhere. On a linear problem without friction this ends (block pivoting with single
                pivots, Judice and Pires 1994), where the plain active set may cycle. In statics it
                is the state that cycles, see `LentStiffness`.
        """
        self._rub_by_law()
        self._forget()
        self.imposed = False
        self.runs_away, self._slid_by = False, 0.0
        self._pivots = pivots and self._problem.integrator.inertia
        self._fewest, self._patience = np.inf, _PATIENCE
        self.led = 0
        self._joints.try_again()
        self._contacts.try_again()

    def shorten(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Scale an update y that leads away from blurred laws; tells whether it did. Collective."""
        return self._contacts.shorten(self.at(x), x, y)

    def _forget(self) -> None:
        self.last: Evaluation | None = None
        self.known: list[tuple[PETSc.Vec, int]] = []

    def at(self, x: PETSc.Vec) -> Evaluation:
        """Evaluation at an iterate, reused while SNES asks for the same one. Collective."""
        last, state = self.last, x.stateGet()
        if last is not None and (x, state) in self.known:
            return last
        # A diverging iterate may overflow; the convergence test sees it.
        with np.errstate(over="ignore", invalid="ignore"):
            new = self._problem.evaluate(x, last)
        if new is last:
            self.known.append((x, state))
            return new
        self.known = [(x, state)]
        self.imposed = False
        if last is not None and self._pivots:
            new = self._pivoted(last, new, x)
        if self._sliding:
            new = self._slid(last, new, x)
        elif self._slid_by:
            # Friction that has let go of what it alone holds.
            self._look_far(new, _FAR)
            self._slid_by = 0.0
        elif last is not None and not self.imposed and self._may_blur:
            new, led = self._contacts.at(last, new, x)
            self.led += led
            self.imposed |= led
        if last is not None and self._problem.couplings.rubbing:
            new, led = self._joints.at(last, new, x)
            self.led += led
            self.imposed |= led
        self.settled = not self.imposed
        if last is None or self._sliding:
            # Which nodes touch is sought first; whether they stick is not known yet.
            self.flips = [np.zeros(part.status.shape, dtype=int) for part in new.parts]
        else:
            for k, (a, b) in enumerate(zip(last.parts, new.parts, strict=True)):
                if self.flips[k].size:
                    changes = a.status != b.status
                    self.flips[k] += changes
                    self.settled &= not changes.any()
        self.last = new
        return new

    def _slid(self, last: Evaluation | None, new: Evaluation, x: PETSc.Vec) -> Evaluation:
        """The new iterate of nodes that hardly rub, or slip once it is settled which touch.

        Collective.
        """
        contacts, comm = self._problem.couplings.contacts, self._problem.system.comm
        parts = new.parts[: len(contacts.elements)]
        before = [] if last is None else last.parts[: len(parts)]
        changes = [(a.active != b.active).any() for a, b in zip(before, parts, strict=False)]
        left = self._sliding - 1
        self.imposed = True
        self._look_far(new, 1.0)
        if (last is not None and not anywhere(comm, any(changes))) or left == 0:
            slid = max((part.distance.max(initial=0.0) for part in parts), default=0.0)
            self._slid_by = float(global_max(comm, np.array([slid]))[0])
            contacts.rub(Rub.SLIDES)
            with np.errstate(over="ignore", invalid="ignore"):
                new = self._problem.evaluate(x)
            self._rub_by_law()
        else:
            self._sliding = left
        return new

    def _look_far(self, e: Evaluation, share: float) -> None:
        """Look whether nodes have slid farther than a share of a facet, so run away. Collective.

        Inertia holds what slides, and what is fast slides far.
        """
        contacts, comm = self._problem.couplings.contacts, self._problem.system.comm
        least, both = _FARTHER * self._slid_by, zip(contacts.elements, e.parts, strict=False)
        far = [
            (part.distance > np.maximum(share * c.candidates.length, least)).any()
            for c, part in both
        ]
        self.runs_away = anywhere(comm, any(far)) and not self._problem.integrator.inertia

    def _rub_by_law(self) -> None:
        if self._sliding:
            self._sliding = 0
            self._problem.couplings.contacts.rub(Rub.LAW)

    def _pivoted(self, last: Evaluation, new: Evaluation, x: PETSc.Vec) -> Evaluation:
        """The new iterate, with one change of the last one's active set if all do not settle.

        Collective.
        """
        contacts, comm = self._problem.couplings.contacts, self._problem.system.comm
        before, after = (
            [part.active for part in e.parts[: len(contacts.elements)]] for e in (last, new)
        )
        changes = [a != b for a, b in zip(before, after, strict=True)]
        count = float(global_sum(comm, np.array([float(c.sum()) for c in changes])).sum())
        if count < self._fewest:
            self._fewest, self._patience = count, _PATIENCE
        if count <= 1.0 or self._patience > 0:
            self._patience -= 1
            return new
        # The last one of the last batch and rank: an order that is the same in every iteration.
        own = [k * comm.size + comm.rank for k, c in enumerate(changes) if c.any()]
        k, rank = divmod(int(global_max(comm, np.array([max(own, default=-1.0)]))[0]), comm.size)
        if rank == comm.rank:
            only = np.flatnonzero(changes[k])[-1]
            before[k] = before[k].copy()
            before[k][only] = after[k][only]
        self.imposed = True
        with contacts.imposed(before), np.errstate(over="ignore", invalid="ignore"):
            return self._problem.evaluate(x)

    @property
    def _may_blur(self) -> bool:
        """Whether contacts may be blurred. Collective.

        Of rigid bodies more nodes touch than are needed. In statics the state may cycle by itself,
        so that only nodes with friction are blurred that go to and fro.
        """
        problem, contacts = self._problem, self._problem.couplings.contacts
        if not problem.couplings.num_touching:
            return False
        if problem.integrator.inertia:
            return problem.shared_weight.any_rigid
        return contacts.may_slip and (self._contacts.blurs or self.cycles)

    @property
    def cycles(self) -> bool:
        """Whether an element goes to and fro between two states. Collective."""
        often = any(bool((flips >= _TO_AND_FRO).any()) for flips in self.flips)
        return anywhere(self._problem.system.comm, often)
