"""Iterates of a step in which contact and friction lead to which nodes touch and stick."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import Contribution
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import anywhere, global_max

#: Iterations in which nodes touch or stick otherwise than before until their laws are blurred.
_CLEAR = 2
#: The first width, over the largest of the lengths by which nodes press, have slid or lie behind.
_FIRST = 0.1
#: A blurred law counts as solved where rows miss less than this part of widths and bounds; ...
_NEAR = 0.8
#: ... the next one's width is this part of its width.
_SHARPER = 0.01
#: Iterations at a width until it is taken that many times larger.
_PATIENCE, _WIDER = 4, 10.0
#: Width over the first one from which on gaps are no more blurred: equations that repeat others
#: have the compliance of the blurred law alone, which is that of the square of the width.
_PARTED = 1e-3


class BlurredContacts:
    """Blurs contact and friction that do not settle by themselves, and sharpens them again.

    Where rigid bodies lie on several others, more nodes touch than are needed, and each one that
    leaves, sticks or slips pulls at the others: the laws alone let them change back and forth. With
    forces that are smooth functions of gap and slip the equations are regular, also those that
    repeat each other, and one iteration a width suffices mostly, from anywhere (smoothing Newton
    methods: Chen and Harker 1993; Kanzow 1996). Slips that no motion of rigid bodies closes, as of
    a face that has come down on its edge, are second order in its turn and may be tiny: friction is
    sharpened up to slips that count as none. The laws have the last word, so that no solution
    changes but how forces divide that are not unique: as the blurred laws have divided them.
    """

    def __init__(self, problem: StepProblem) -> None:
        self._problem = problem
        self.try_again()

    def try_again(self) -> None:
        """Obey the laws no longer than need be, as an attempt at a step begins."""
        self._changes, self._tries, self._blurs = 0, 0, False
        self._width, self._sharp, self._last = 0.0, 0.0, 0.0
        self._problem.shared_weight.kept = False

    def at(self, last: Evaluation, new: Evaluation, x: PETSc.Vec) -> tuple[Evaluation, bool]:
        """The new iterate by the laws or by what leads to it, and whether it is led. Collective.

        Args:
            last: The iterate before.
            new: The iterate by the laws.
            x: Its unknowns.
        """
        comm, count = self._problem.system.comm, self._problem.couplings.num_touching
        batches, parts = self._problem.elements[:count], new.parts[:count]
        if not self._blurs:
            both = zip(last.parts[:count], parts, strict=True)
            if not anywhere(comm, any((a.status != b.status).any() for a, b in both)):
                return new, False
            self._changes += 1
            if self._changes <= _CLEAR or not self._begins(batches, parts):
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
            self._blurs, self._changes = False, 0
            return new, False
        self._width *= _SHARPER
        return self._blurred(x), True

    def _begins(
        self, batches: Sequence[ContactElements], parts: Sequence[Contribution]
    ) -> bool:
        """Choose the widths; whether there is anything to blur. Collective."""
        largest, least = 0.0, np.inf
        for batch, part in zip(batches, parts, strict=True):
            press = -part.multiplier[:, 0] / batch.law.yielding
            for length in (press, part.distance, -part.gap):
                largest = max(largest, float(length.max(initial=0.0)))
            least = min(least, float(batch.law.still.min(initial=np.inf)))
        both = global_max(self._problem.system.comm, np.array([largest, -least]))
        self._width, self._last = _FIRST * float(both[0]), -float(both[1])
        self._blurs, self._tries = 0.0 < self._width < np.inf, 0
        self._sharp = _PARTED * self._width
        self._problem.shared_weight.kept |= self._blurs
        return self._blurs

    def _blurred(self, x: PETSc.Vec) -> Evaluation:
        """An iterate under blurred laws. Collective."""
        couplings = self._problem.couplings
        couplings.blur(self._width, self._width if self._width > self._sharp else 0.0)
        with np.errstate(over="ignore", invalid="ignore"):
            found = self._problem.evaluate(x)
        couplings.blur(0.0, 0.0)
        return found

    def _missed(
        self, batches: Sequence[ContactElements], parts: Sequence[Contribution]
    ) -> float:
        """What gaps miss of the blurred laws over the width, friction over its bound, the most."""
        worst, wide = 0.0, self._width > self._sharp
        for batch, part in zip(batches, parts, strict=True):
            law, force = batch.law, -part.end[:, 0]
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
