"""Iterates of a step in which contact and friction lead to which nodes touch and stick."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import repeat

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import Contribution
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import anywhere, global_max, global_sum
from dolfinx_nts.types import FloatArray

#: Iterations in which nodes touch or stick otherwise than before until their laws are blurred: in a
#: heap most steps settle by the fifth, and those that do not hardly ever do later.
_CLEAR = 4
#: The first width, over the largest of the lengths by which nodes that do not settle miss their
#: laws, forces over the masses that they move.
_FIRST = 0.1
#: A blurred law counts as solved where rows miss less than this part of widths and bounds; ...
_NEAR = 0.8
#: ... the next one's width is this part of its width.
_SHARPER = 0.01
#: Iterations at a width until it is taken that many times larger.
_PATIENCE, _WIDER = 4, 10.0
#: Updates that make the residual that many times larger are halved, at most so often: most grow at
#: first, and shorter ones take longer.
_GROWS, _HALVINGS = 10.0, 4
#: Width over the first one from which on gaps are no more blurred: equations that repeat others
#: have the compliance of the blurred law alone, which is that of the square of the width.
_PARTED = 1e-3
#: The slip over the last width from which on nodes slide that blurred laws have brought to their
#: bounds. Those that stick slip by less than the width, or by half of what they did an iteration
#: before.
_APART = 1e4


class BlurredContacts:
    """Blurs contact and friction that do not settle by themselves, and sharpens them again.

    Where rigid bodies lie on several others, more nodes touch than are needed, and each one that
    leaves, sticks or slips pulls at the others: the laws alone let them change back and forth. In
    statics nodes with friction do so, too, where a round body begins to touch along a line. With
    forces that are smooth functions of gap and slip the equations are regular, also those that
    repeat each other, and one iteration a width suffices mostly, from anywhere (smoothing Newton
    methods: Chen and Harker 1993; Kanzow 1996). Slips that no motion of rigid bodies closes, as of
    a face that has come down on its edge, are second order in its turn and may be tiny: friction is
    sharpened up to slips that count as none. The laws have the last word, so that no solution
    changes but how forces divide that are not unique: as the blurred laws have divided them.

    Blurred friction of a node that slides by little misses its bound by half the square of width
    over slip, which is more than the return map adds for that slip. So nodes would stick that
    cannot all stick, and the iterates go through the same circle. With its scale steep, slips tell
    which nodes slide. One whose slip turns back may stick again.

    Attributes:
        blurs: Whether the laws are blurred.
    """

    def __init__(self, problem: StepProblem) -> None:
        self._problem = problem
        self._steep: list[FloatArray] = []
        self.try_again()

    def try_again(self) -> None:
        """Obey the laws no longer than need be, as an attempt at a step begins."""
        self._changes, self._tries, self.blurs = 0, 0, False
        self._width, self._sharp, self._last = 0.0, 0.0, 0.0
        self._problem.shared_weight.kept = False
        if self._steep:
            self._problem.couplings.steepen(repeat(0.0))
            self._steep = []

    def at(self, last: Evaluation, new: Evaluation, x: PETSc.Vec) -> tuple[Evaluation, bool]:
        """The new iterate by the laws or by what leads to it, and whether it is led. Collective.

        Args:
            last: The iterate before.
            new: The iterate by the laws.
            x: Its unknowns.
        """
        comm, count = self._problem.system.comm, self._problem.couplings.num_touching
        batches, parts = self._problem.elements[:count], new.parts[:count]
        if not self.blurs:
            both = list(zip(last.parts[:count], parts, strict=True))
            turned = new.turned
            if self._steep:
                new = self._turned(new, both, x)
                both = list(zip(last.parts[:count], new.parts[:count], strict=True))
                turned = anywhere(comm, any((a.status != b.status).any() for a, b in both))
            if not turned:
                return new, False
            self._changes += 1
            if self._changes <= _CLEAR or not self._begins(batches, both):
                return new, False
            return self._blurred(x), True
        found = self._blurred(x)
        missed = self._missed(batches, found.parts[:count])
        self._tries += 1
        if anywhere(comm, not missed < _NEAR):
            if self._tries < _PATIENCE:
                return found, True
            # Newton's method may go to and fro where steps turn bodies far.
            self._tries, self._width = 0, _WIDER * self._width
            return self._blurred(x), True
        self._tries = 0
        if self._width <= self._last:
            self.blurs, self._changes = False, -_CLEAR
            self._steep = [
                batch.law.coefficient * -part.end[:, 0].clip(max=0.0) / (_APART * self._width)
                for batch, part in zip(batches, found.parts[:count], strict=True)
            ]
            return self._steepened(x), False
        self._width *= _SHARPER
        return self._blurred(x), True

    def shorten(self, last: Evaluation, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Scale an update y that SNES subtracts from x; tells whether it did. Collective.

        Newton's method may run away from blurred laws where steps turn bodies far.

        Args:
            last: The iterate.
            x: Its unknowns.
            y: The update.
        """
        if not self.blurs:
            return False
        least, part, trial = _GROWS * self._norm(last), 1.0, x.duplicate()
        for _ in range(_HALVINGS):
            trial.waxpy(-part, y, x)
            if self._norm(self._blurred(trial)) < least:
                break
            part *= 0.5
        trial.destroy()
        if part == 1.0:
            return False
        y.scale(part)
        return True

    def _norm(self, e: Evaluation) -> float:
        """Of the residual. Collective."""
        with np.errstate(over="ignore", invalid="ignore"):
            square = np.square(self._problem.residual(e)).sum()
        return float(np.sqrt(global_sum(self._problem.system.comm, np.array([square]))[0]))

    def _begins(
        self, batches: Sequence[ContactElements], both: Sequence[tuple[Contribution, Contribution]]
    ) -> bool:
        """Choose the widths; whether there is anything to blur. Collective.

        How far it is to a solution is told by what nodes that change miss, and not by what they
        press or have slid: two that hold the same place may change by turns for next to nothing.
        """
        largest, least = 0.0, np.inf
        for batch, (last, part) in zip(batches, both, strict=True):
            law, changes = batch.law, (last.status != part.status).any(axis=0)
            rows = np.abs(batch.law_rows(part))
            rows[:, 0] /= np.where(part.active, law.scale, law.yielding)
            rows[:, 1:] /= np.where(part.stick, law.scale, law.yielding)[:, None]
            largest = max(largest, float(rows[changes].max(initial=0.0)))
            least = min(least, float(batch.law.still.min(initial=np.inf)))
        sizes = global_max(self._problem.system.comm, np.array([largest, -least]))
        self._width, self._last = _FIRST * float(sizes[0]), -float(sizes[1])
        self.blurs, self._tries = 0.0 < self._width < np.inf, 0
        self._sharp = _PARTED * self._width
        self._problem.shared_weight.kept |= self.blurs
        return self.blurs

    def _blurred(self, x: PETSc.Vec) -> Evaluation:
        """An iterate under blurred laws. Collective."""
        couplings = self._problem.couplings
        couplings.blur(self._width, self._width if self._width > self._sharp else 0.0)
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                return self._problem.evaluate(x)
        finally:
            couplings.blur(0.0, 0.0)

    def _steepened(self, x: PETSc.Vec) -> Evaluation:
        """An iterate by the laws, of which slips tell what sticks. Collective."""
        self._problem.couplings.steepen(self._steep)
        with np.errstate(over="ignore", invalid="ignore"):
            return self._problem.evaluate(x)

    def _turned(
        self, new: Evaluation, both: Sequence[tuple[Contribution, Contribution]], x: PETSc.Vec
    ) -> Evaluation:
        """The new iterate where nodes whose slips turn back may stick. Collective."""
        back = [np.einsum("ni,ni->n", a.slip, b.slip) < 0.0 for a, b in both]
        again = [(one & (scale > 0.0)).any() for one, scale in zip(back, self._steep, strict=True)]
        if not anywhere(self._problem.system.comm, any(again)):
            return new
        self._steep = [np.where(a, 0.0, b) for a, b in zip(back, self._steep, strict=True)]
        return self._steepened(x)

    def _missed(
        self, batches: Sequence[ContactElements], parts: Sequence[Contribution]
    ) -> float:
        """What gaps miss of the blurred laws over the width, friction over its bound, the most."""
        worst, wide = 0.0, self._width > self._sharp
        for batch, part in zip(batches, parts, strict=True):
            law, force = batch.law, -part.end[:, 0]
            with np.errstate(over="ignore", invalid="ignore"):
                rows = batch.law_rows(part) / law.scale[:, None]
            pull = law.yielding * rows[:, 0]
            on = np.full(len(force), True) if wide else part.active
            worst = max(worst, float(np.abs(rows[on, 0]).max(initial=0.0)) / self._width)
            if law.num_tangential:
                # The row of a blurred gap is the force less what the bound has, over the scale.
                press = (force - pull if wide else force.clip(min=0.0))[on]
                friction = np.linalg.norm(rows[on, -2:], axis=1) * law.scale[on]
                bound = law.coefficient * press
                parted = np.divide(friction, bound, out=np.zeros_like(bound), where=bound > 0.0)
                worst = max(worst, float(parted.max(initial=0.0)))
        return worst
