"""Whether an equilibrium is stable: each small motion away from it must cost energy."""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

from dolfinx_nts.evaluation import Evaluation
from dolfinx_nts.step.augmented import AugmentedMatrix
from dolfinx_nts.step.problem import StepProblem

#: Coordinates up to which the factors of one more matrix cost little beside the solution.
_MOST = 20_000
#: Closed contacts and joints count as so many times stiffer than what is around them.
_STIFF = 1e3
#: Skew part of a body's matrix, relative to it, up to which its forces have a potential.
_SKEW = 1e-3
#: Stiffness against a motion, relative to that of its coordinates, that counts as none: a body may
#: be free to move along a surface.
_NONE = 1e-8


def releasing_motions(problem: StepProblem, step: Evaluation) -> int:
    """Return how many independent motions away from an equilibrium release energy. Collective.

    They are the negative pivots of L D L^T (Sylvester's law of inertia) of the stiffness, in which
    closed contacts and joints are stiff springs. Nothing is known, and 0 returned, of bodies under
    loads that have no potential, and of more than 20,000 coordinates. Nodes are not to slip with
    friction, which has none.

    Args:
        problem: Equations of a load step.
        step: Its solution.
    """
    if problem.system.size > _MOST:
        return 0
    stabilization, tangents = problem.stabilization, problem.body_tangents(step)
    if not all(map(_is_symmetric, tangents)):
        return 0
    augmented = AugmentedMatrix(
        problem, tangents,
        lambda body: _STIFF * stabilization.stiffness(body, (body,)),
    )  # fmt: skip
    coupled = step.parts if problem.laid.blocks else []
    augmented.assemble([part.tangent for part in coupled], fresh=True)
    matrix = augmented.matrix.corner.convert("aij", PETSc.Mat())
    augmented.destroy()
    transpose = matrix.transpose(PETSc.Mat())
    matrix.axpy(1.0, transpose)
    transpose.destroy()
    negative = _negative_pivots(matrix)
    matrix.destroy()
    return negative


def _is_symmetric(matrix: Any) -> bool:
    """Whether forces have a potential, as those of loads that follow the body have not."""
    skew = matrix.transpose(PETSc.Mat())
    skew.axpy(-1.0, matrix)
    small: bool = skew.norm() <= _SKEW * matrix.norm()
    skew.destroy()
    return small


def _negative_pivots(matrix: Any) -> int:
    """Of a symmetric matrix, which is changed by `_NONE`. Collective."""
    diagonal = matrix.getDiagonal()
    size = diagonal.copy()
    size.abs()
    diagonal.axpy(_NONE, size)
    matrix.setDiagonal(diagonal)
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    pc = PETSc.PC().create(matrix.comm)
    pc.setOperators(matrix)
    pc.setType("cholesky")
    pc.setFactorSolverType("mumps")
    pc.setFactorSetUpSolverType()
    pc.getFactorMatrix().setMumpsIcntl(24, 1)  # PETSc asks for it where pivots are counted
    pc.setUp()
    negative = int(pc.getFactorMatrix().getInertia()[0])
    for each in (pc, diagonal, size):
        each.destroy()
    return negative
