"""Constraints of joints that may repeat each other, and solutions whose multipliers are least."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from dolfinx_nts.equations.least_norm import NullSpace, form_tree
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation


class Redundancy:
    """Whether the joints of a run repeat each other.

    Attributes:
        independent: Whether they do not; None before a step has shown it.
    """

    def __init__(self, problem: StepProblem) -> None:
        self._problem = problem
        joints = problem.system.joint_bodies[: len(problem.system.declared_joints)]
        self.independent: bool | None = True if form_tree(joints) else None

    def of_least_norm(self, solved: Evaluation, worst: Callable[[Evaluation], float]) -> Evaluation:
        """A solution with multipliers of least norm. Collective.

        Args:
            solved: Of the step.
            worst: Largest residual of an iterate over its tolerance.
        """
        problem = self._problem
        if self.independent:
            return solved
        bodies = problem.couplings.bodies
        space = NullSpace(
            problem.laid, problem.system.comm, problem.elements, bodies, solved.parts
        )
        if self.independent is None:
            self.independent = space.is_empty()
            if self.independent:
                return solved
        here = problem.laid.of_elements("constraints")
        with problem.x as x:
            x[here] = solved.x[here] - space.part(solved.x[here])
        e = problem.evaluate(problem.x)
        # An element of the user's own may have a compliance.
        return replace(e, min_det=solved.min_det) if worst(e) <= 1.0 else solved
