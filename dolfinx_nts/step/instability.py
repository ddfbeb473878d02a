"""Whether an equilibrium is stable: each small motion away from it must cost energy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from dolfinx_nts.evaluation import Evaluation
from dolfinx_nts.step.augmented import AugmentedMatrix
from dolfinx_nts.step.problem import StepProblem

FloatArray = npt.NDArray[np.float64]

#: Coordinates up to which the factors of one more matrix cost little beside the solution.
_MOST = 20_000
#: Closed contacts and joints count as so many times stiffer than what is around them.
_STIFF = 1e3
#: Skew part of a body's matrix, relative to it, up to which its forces have a potential.
_SKEW = 1e-3
#: Stiffness against a motion, relative to that of its coordinates, that counts as none: a body may
#: be free to move along a surface.
_NONE = 1e-8
#: The same of rigid bodies, relative to what forces that turn with the bodies give them. Where such
#: forces change as a body slides, springs in place of joints leave less than nothing of its
#: resistance: the square of that over their stiffness.
_NONE_OF_RIGID = 1e-3
#: Rounding of a stiffness, relative to the largest of the body.
_ROUNDING = 1e-13


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
    elements = [part.tangent for part in coupled]
    turning = augmented.turning(elements)
    augmented.assemble(elements, fresh=True)
    matrix = augmented.matrix.corner.convert("aij", PETSc.Mat())
    augmented.destroy()
    transpose = matrix.transpose(PETSc.Mat())
    matrix.axpy(1.0, transpose)
    transpose.destroy()
    negative = _negative_pivots(
        matrix, [problem.system.bodies[k] for k in problem.awake], turning
    )
    matrix.destroy()
    return negative


def _is_symmetric(matrix: Any) -> bool:
    """Whether forces have a potential, as those of loads that follow the body have not."""
    skew = matrix.transpose(PETSc.Mat())
    skew.axpy(-1.0, matrix)
    small: bool = skew.norm() <= _SKEW * matrix.norm()
    skew.destroy()
    return small


def _no_stiffness(body: Any, size: FloatArray, turning: FloatArray) -> FloatArray:
    """What counts as none at each coordinate of a body, shape (num_owned,).

    Args:
        body: The body.
        size: Its stiffness.
        turning: What turning forces give it, see `AugmentedMatrix.turning`.
    """
    if not body.rigid:
        return _NONE * size
    found, places = np.zeros_like(size), np.repeat(body.places, 3)
    for kind in (places, ~places):
        found[kind] = _NONE_OF_RIGID * turning[kind].max(initial=0.0)
        found[kind] += _ROUNDING * size[kind].max(initial=0.0)
    return found


def _negative_pivots(matrix: Any, bodies: Sequence[Any], turning: FloatArray) -> int:
    """Of a symmetric matrix, whose diagonal is raised by what counts as none. Collective."""
    diagonal = matrix.getDiagonal()
    ends = np.cumsum([body.num_owned for body in bodies])[:-1]
    parts = (np.split(each, ends) for each in (np.abs(diagonal.array_r), turning))
    none = [_no_stiffness(body, *both) for body, *both in zip(bodies, *parts, strict=True)]
    diagonal.array_w[:] += np.concatenate(none)
    matrix.setDiagonal(diagonal)
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    pc = PETSc.PC().create(matrix.comm)
    pc.setOperators(matrix)
    pc.setType("cholesky")
    pc.setFactorSolverType("mumps")
    pc.setFactorSetUpSolverType()
    # PETSc asks for these where pivots are counted: null pivots found, all ranks' counted.
    for option in (24, 13):
        pc.getFactorMatrix().setMumpsIcntl(option, 1)
    pc.setUp()
    negative = int(pc.getFactorMatrix().getInertia()[0])
    for each in (pc, diagonal):
        each.destroy()
    return negative
