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
#: The same of rigid bodies, relative to that of all their places or directors. They have none but
#: that of contacts and joints, as stiff as other bodies of the scene, or as the heaviest, need it.
#: In 1e7 weights over the size, forces that a joint turns as a body slides count as 1e-14 of it.
_NONE_OF_RIGID = 1e-12


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
    negative = _negative_pivots(matrix, [problem.system.bodies[k] for k in problem.awake])
    matrix.destroy()
    return negative


def _is_symmetric(matrix: Any) -> bool:
    """Whether forces have a potential, as those of loads that follow the body have not."""
    skew = matrix.transpose(PETSc.Mat())
    skew.axpy(-1.0, matrix)
    small: bool = skew.norm() <= _SKEW * matrix.norm()
    skew.destroy()
    return small


def _no_stiffness(body: Any, size: FloatArray) -> FloatArray:
    """What counts as none at each coordinate of a body, of these stiffnesses, (num_owned,)."""
    if not body.rigid:
        return _NONE * size
    found, places = np.zeros_like(size), np.repeat(body.places, 3)
    for kind in (places, ~places):
        found[kind] = _NONE_OF_RIGID * size[kind].max(initial=0.0)
    return found


def _negative_pivots(matrix: Any, bodies: Sequence[Any]) -> int:
    """Of a symmetric matrix, whose diagonal is raised by what counts as none. Collective."""
    diagonal = matrix.getDiagonal()
    ends = np.cumsum([body.num_owned for body in bodies])[:-1]
    parts = np.split(np.abs(diagonal.array_r), ends)
    none = [_no_stiffness(body, size) for body, size in zip(bodies, parts, strict=True)]
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
