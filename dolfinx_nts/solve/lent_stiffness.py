"""Stiffness that the matrix of a load step lends to bodies while they pass an instability."""

from __future__ import annotations

from dolfinx_nts.contact.contact_law import Rub
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import anywhere
from dolfinx_nts.solve.instability import releasing_motions

#: The first share that is lent, the largest, and one that counts as none.
_FIRST, _LARGEST, _NONE = 1e-3, 1e3, 1e-5
#: By how much a share that does not suffice grows, and one that did falls in each iteration.
_RATIO = 4.0


class LentStiffness:
    """Lends each node a share of the stiffness around it while motions would release energy.

    Where a state is unstable, Newton's method heads for a saddle of the energy; nodes that come or
    go hold it for an iteration and flip back for ever (theory section 23). With enough stiffness
    lent its updates lead downhill. It is in the matrix alone, never in the residual, so that no
    solution moves, and falls as soon as it is not needed. Nothing is lent where
    `releasing_motions` tells nothing: beyond 20,000 coordinates, where nodes slip, and under loads
    that follow a body.
    """

    def __init__(self, problem: StepProblem) -> None:
        self._problem = problem

    def begin(self) -> None:
        """Lend nothing, as a step begins or ends."""
        self._problem.tangents.lent = 0.0

    def at(self, e: Evaluation, *, wanders: bool) -> bool:
        """Lend what the matrix at an iterate needs; return whether that has changed. Collective.

        Args:
            e: The iterate.
            wanders: Whether contacts changed in the last iteration or the residual grew. Where
                neither happens, nothing is looked for, as that takes a factorisation.
        """
        problem = self._problem
        before = problem.tangents.lent
        if problem.integrator.inertia or not (wanders or before):
            return False
        problem.tangents.lent = before / _RATIO if before > _RATIO * _NONE else 0.0
        if wanders and not self._slips(e):
            while releasing_motions(problem, e):
                problem.tangents.lent = max(_RATIO * problem.tangents.lent, _FIRST)
                if problem.tangents.lent > _LARGEST:
                    problem.tangents.lent = 0.0
                    break
        return problem.tangents.lent != before

    def _slips(self, e: Evaluation) -> bool:
        """Whether nodes slip with friction, whose forces have no potential. Collective.

        What hardly rubs is held by springs, which have one.
        """
        contacts = self._problem.couplings.touching(e)
        slip = any(
            c.law.num_tangential
            and c.law.rubs is not Rub.HARDLY
            and bool((part.active & ~c.law.sticks(part)).any())
            for _, c, part, _ in contacts
        )
        return anywhere(self._problem.system.comm, slip)
