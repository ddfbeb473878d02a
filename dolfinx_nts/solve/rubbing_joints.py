"""Iterates of a step in which dry friction of joints leads to which of them stick."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import anywhere, global_max
from dolfinx_nts.types import FloatArray

#: Iterations in which joints stick or slip otherwise than before until their friction is blurred.
_CLEAR = 3
#: A blurred law counts as solved where forces miss less than this part of their bounds; ...
_NEAR = 0.8
#: ... the next one's width is this part of its width.
_SHARPER = 0.03
#: Slip over the extent of the bodies that is rounding: none slips, and a width of it leads nowhere.
_ROUNDED = 16 * float(np.finfo(float).eps)
#: A joint slips that slips by more widths than this, and keeps this part of its slip as the width
#: falls.
_WIDTHS, _KEPT = 3.0, 0.5


class RubbingJoints:
    """Blurs friction of joints that does not settle by itself, and sharpens it again.

    In a chain of hinges each one that goes or sticks pulls at the next ones against each other: the
    law alone lets a few of them change in each iteration, back and forth, whatever scale it weighs
    slip by. With friction that is a smooth function of slip, its force an unknown of its own,
    Newton's method converges from afar (Chan, Golub and Mulet 1999); the smaller the width, the
    more the slips of joints that stick fall with it, and those of the others stay. The law itself
    has the last word, so that no solution changes.
    """

    def __init__(self, problem: StepProblem) -> None:
        self._problem, self._changes = problem, 0
        self.try_again()

    def restart(self) -> None:
        """Obey the law, as a step begins."""
        self._changes = 0
        self.try_again()

    def try_again(self) -> None:
        """Obey the law no longer than need be, as another attempt begins."""
        self._width, self._blurs = 0.0, False
        self._slip: FloatArray | None = None
        self._ways: FloatArray | None = None

    def at(self, last: Evaluation, new: Evaluation, x: PETSc.Vec) -> tuple[Evaluation, bool]:
        """The new iterate by the law or by what leads to it, and whether it is led. Collective.

        Args:
            last: The iterate before.
            new: The iterate by the law.
            x: Its unknowns.
        """
        couplings, comm = self._problem.couplings, self._problem.system.comm
        batches = [coupling.elements[0] for coupling in couplings.rubbing]
        before, parts = couplings.of_rubbing(last), couplings.of_rubbing(new)
        slips = [batch.slip(part) for batch, part in zip(batches, parts, strict=True)]
        slip = np.concatenate(slips)
        if self._blurs:
            missed = [
                np.abs(part.law.unlike(own, part.memory[:, 1], self._width)).max(initial=0.0)
                for own, part in zip(slips, parts, strict=True)
            ]
            if not anywhere(comm, max(missed) > _NEAR):
                if self._has_parted(slip):
                    self._blurs = False
                    return self._led(x, self._ways), True
                self._width *= _SHARPER
        else:
            changes = [(a.status != b.status).any() for a, b in zip(before, parts, strict=True)]
            if not anywhere(comm, any(changes)):
                return new, False
            extents = np.concatenate([batch.extents for batch in batches])
            local = [np.abs(a).max(initial=0.0) for a in (slip, extents)]
            largest, extent = global_max(comm, np.array(local)).tolist()
            self._changes += 1
            if self._changes <= _CLEAR or not _ROUNDED * extent < largest < np.inf:
                return new, False
            self._width = _SHARPER * self._width or largest
            self._blurs, self._slip, self._ways = True, None, None
        return self._led(x, None), True

    def _has_parted(self, slip: FloatArray) -> bool:
        """Whether the same joints slip as with a larger width; keeps which ones. Collective."""
        before, ways = self._slip, self._ways
        self._slip = slip
        if before is None:
            return False
        moves = np.abs(slip) > np.maximum(_WIDTHS * self._width, _KEPT * np.abs(before))
        now = np.where(moves, np.sign(slip), 0.0)
        self._ways = now
        return ways is not None and not anywhere(
            self._problem.system.comm, not np.array_equal(ways, now)
        )

    def _led(self, x: PETSc.Vec, ways: FloatArray | None) -> Evaluation:
        """An iterate whose joints stick as told, or with blurred friction. Collective.

        Args:
            x: The unknowns.
            ways: 0 where a joint of this rank sticks; None: friction is blurred.
        """
        rubbing, first = self._problem.couplings.rubbing, 0
        for coupling in rubbing:
            here = slice(first, first := first + len(coupling.elements[0].since))
            coupling.obey(
                coupling.law.blurred(self._width) if ways is None
                else coupling.law.parted(ways[here] == 0.0)
            )  # fmt: skip
        with np.errstate(over="ignore", invalid="ignore"):
            found = self._problem.evaluate(x)
        for coupling in rubbing:
            coupling.obey(coupling.law)
        return found
