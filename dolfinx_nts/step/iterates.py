"""The iterates of a step."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.evaluation import Evaluation
from dolfinx_nts.parallel import everywhere
from dolfinx_nts.step.problem import StepProblem

IntArray = npt.NDArray[np.signedinteger[Any]]


class Iterates:
    """Evaluates the iterates of a step and counts how often elements change their status.

    Args:
        problem: Equations of the step.

    Attributes:
        last: Evaluation of the last iterate.
        flips: Of each batch of elements how often each has changed its status.
    """

    def __init__(self, problem: StepProblem) -> None:
        self._problem = problem
        self.restart()

    def restart(self) -> None:
        """Forget all iterates, as a step begins."""
        self.last: Evaluation | None = None
        self.flips: list[IntArray] = []
        self._settled = True

    def forget_last(self) -> None:
        """Forget the last iterate, as another attempt at the same step begins."""
        self.last = None

    def at(self, x: Any) -> Evaluation:
        """Evaluation at an iterate, reused while SNES asks for the same one. Collective.

        Args:
            x: PETSc vector of the unknowns.
        """
        last = self.last
        same = last is not None and np.array_equal(last.x, x.array_r)
        if everywhere(self._problem.system.comm, same):
            assert last is not None
            return last
        # A diverging iterate may overflow; the convergence test sees it.
        with np.errstate(over="ignore", invalid="ignore"):
            new = self._problem.evaluate(x)
        self._settled = True
        if last is None:
            self.flips = [np.zeros(part.status.shape, dtype=int) for part in new.parts]
        else:
            for k, (a, b) in enumerate(zip(last.parts, new.parts, strict=True)):
                if self.flips[k].size:
                    changes = a.status != b.status
                    self.flips[k] += changes
                    self._settled &= not changes.any()
        self.last = new
        return new

    @property
    def settled(self) -> bool:
        """Whether no element changed its status in the last iteration. Collective."""
        return everywhere(self._problem.system.comm, self._settled)
