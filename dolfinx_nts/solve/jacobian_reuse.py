"""Matrices of the bodies, which a run keeps over iterations and steps while that pays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.evaluation import Evaluation

#: Relative difference of the factors of two equal steps of a caller whose lengths are rounded.
_EQUAL = 1e-6


class KeptTangents:
    """Assembles the matrices of a step's bodies when they are due, see `Newton.reuse`.

    All runs of a body share its matrix. If another run has changed it, which PETSc counts, this run
    assembles it again: two runs in turns differ by what reuse leaves, without reuse by nothing.

    Args:
        problem: Equations of the step.
        reuse: Tells whether iterations may use matrices of an earlier iterate now.

    Attributes:
        due: Whether the matrices are to be made anew at the next iterate.
    """

    def __init__(self, problem: StepProblem, reuse: Callable[[], bool]) -> None:
        self._problem, self._reuse = problem, reuse
        self.due, self._factor = True, 0.0
        self._matrices: dict[int, Any] = {}
        self._states: dict[int, int] = {}
        self._laid: Unknowns | None = None

    def begin(self) -> None:
        """Begin a step: matrices of another step size are of no use."""
        factor = self._problem.factor
        changed = abs(factor / self._factor - 1.0) > _EQUAL if self._factor else True
        self.due |= changed or not self._reuse()
        self._factor = factor

    def at(self, e: Evaluation) -> tuple[list[Any], bool]:
        """Matrices of the batches of bodies that are awake, and whether they are of an iterate.

        Collective.
        """
        problem = self._problem
        awake = problem.laid.awake
        if self._laid is not problem.laid:
            # Which bodies of a batch are awake may have changed.
            for j in range(len(problem.batches.several)):
                self._matrices.pop(j, None)
            self._laid = problem.laid
        # PETSc counts the same on all ranks, as it relies on that itself.
        changed = any(a.stateGet() != self._states[k] for k, a in self._matrices.items())
        fresh = self.due or changed
        if fresh:
            self._matrices = dict(zip(awake, problem.tangents.at(e), strict=True))
            self.due = not self._reuse()
        for j in awake:
            if j not in self._matrices:
                self._matrices[j] = problem.tangents.of(j, e.terms[j].u1)
        return [self._matrices[j] for j in awake], fresh

    def remember(self) -> None:
        """Take the matrices as they are for those of this run."""
        self._states = {k: a.stateGet() for k, a in self._matrices.items()}
