"""Whether an equilibrium is stable: each small motion away from it must cost energy."""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc
from scipy import sparse

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation, free
from dolfinx_nts.parallel import global_max
from dolfinx_nts.solve.augmented import AugmentedMatrix
from dolfinx_nts.types import FloatArray

#: Coordinates up to which the factors of one more matrix cost little beside the solution.
_MOST = 20_000
#: Closed contacts and joints count as so many times stiffer than what is around them.
_STIFF = 1e3
#: Skew part of a body's matrix, relative to it, up to which its forces have a potential.
_SKEW = 1e-3
#: Stiffness against a motion, relative to that of its coordinates, that counts as none, as a body
#: may be free to move along a surface: rounding alone. Against bending a solid column of L/h = 1000
#: has 1e-12 of it.
_NONE = 1e-15
#: How many times the forces that the solution leaves unbalanced, over the size of the body, which
#: they turn: a free body turns against no more.
_LEFT = 10.0
#: The same of rigid bodies, relative to what forces that turn with the bodies give them. Where such
#: forces change as a body slides, springs in place of joints leave less than nothing of its
#: resistance: the square of that over their stiffness.
_NONE_OF_RIGID = 1e-3
#: Rounding of a stiffness, relative to the largest of the body.
_ROUNDING = 1e-13


def releasing_motions(problem: StepProblem, step: Evaluation) -> int:
    """Return how many independent motions away from an equilibrium release energy. Collective.

    They are the negative pivots of L D L^T (Sylvester's law of inertia) of the stiffness, in which
    closed contacts and joints are stiff springs; directors turn, and do nothing else. Nothing is
    known, and 0 returned, of bodies under loads that have no potential, and of more than 20,000
    coordinates. Nodes are not to slip with friction, which has none; those that rest at Coulomb's
    bound count as sticking.

    Args:
        problem: Equations of a load step.
        step: Its solution.
    """
    if problem.system.size > _MOST:
        return 0
    stabilization, tangents = problem.stabilization, problem.tangents.at(step)
    if not all(map(_is_symmetric, tangents)):
        return 0
    augmented = AugmentedMatrix(
        problem, tangents,
        lambda body: _STIFF * stabilization.stiffness(body, (body,)),
    )  # fmt: skip
    coupled = _sticking(problem, step) if problem.laid.blocks else []
    elements = [part.tangent for part in coupled]
    turning = augmented.turning(elements)
    augmented.assemble(elements, fresh=True)
    matrix = augmented.matrix.corner.convert("aij", PETSc.Mat())
    augmented.destroy()
    transpose = matrix.transpose(PETSc.Mat())
    matrix.axpy(1.0, transpose)
    transpose.destroy()
    turns = _turns(problem, step)
    none = turns.power(2).T @ _no_stiffness(problem, step, matrix, turning)
    motions = _distributed(turns, matrix)
    reduced = matrix.PtAP(motions)
    negative = _negative_pivots(reduced, none)
    for each in (reduced, motions, matrix):
        each.destroy()
    return negative


def _turns(problem: StepProblem, step: Evaluation) -> Any:
    """Motions that keep directors orthonormal, orthonormal columns of this rank's coordinates.

    Springs in place of these constraints would leave less than nothing of the resistance to motions
    along which the constraints' forces turn, such as the spin of a string.
    """
    parts = []
    for k in sorted(problem.awake, key=lambda k: problem.laid.of_body(k).start):
        body = problem.system.bodies[k]
        x = (body.reference + step.bodies[k].u1).reshape(-1, 3)
        nodes = int(body.places.sum())
        if not nodes or nodes == len(body.places):
            parts.append(sparse.identity(len(body.places) * 3, format="csr"))
            continue
        directors = x.reshape(nodes, -1, 3)[:, 1:]
        # A turn about an axis moves a director by their cross product.
        moves = np.cross(np.eye(3), directors[:, :, None]).transpose(0, 1, 3, 2)
        ways, _, _ = np.linalg.svd(moves.reshape(nodes, -1, 3), full_matrices=False)
        free = 3 if directors.shape[1] > 1 else 2
        blocks = np.zeros((nodes, x.size // nodes, 3 + free))
        blocks[:, :3, :3], blocks[:, 3:, 3:] = np.eye(3), ways[:, :, :free]
        parts.append(sparse.bsr_array((blocks, np.arange(nodes), np.arange(nodes + 1))))
    return sparse.csr_matrix(sparse.block_diag(parts, format="csr"))


def _distributed(local: Any, matrix: PETSc.Mat) -> PETSc.Mat:
    """A block diagonal matrix of one block (rows, columns) on each rank. Collective."""
    comm, (rows, columns) = matrix.comm.tompi4py(), local.shape
    first = comm.exscan(columns) or 0
    numbers = (a.astype(PETSc.IntType) for a in (local.indptr, local.indices + first))
    found = PETSc.Mat().createAIJ(
        ((rows, None), (columns, None)), csr=(*numbers, local.data), comm=comm
    )
    found.assemble()
    return found


def _sticking(problem: StepProblem, step: Evaluation) -> tuple[Any, ...]:
    """Contributions of elements to a solution, of nodes in contact as they stick. Collective.

    One that has come to rest at Coulomb's bound is held there, as by a smaller load.
    """
    contacts = problem.couplings.contacts
    active = [part.active for part in step.parts[: len(contacts.elements)]]
    x = problem.x.duplicate()
    x.array_w[:] = step.x
    with contacts.imposed(active, stick=True):
        parts = problem.evaluate(x).parts
    x.destroy()
    return parts


def _is_symmetric(matrix: PETSc.Mat) -> bool:
    """Whether forces have a potential, as those of loads that follow the body have not."""
    skew = matrix.transpose(PETSc.Mat())
    skew.axpy(-1.0, matrix)
    small: bool = skew.norm() <= _SKEW * matrix.norm()
    skew.destroy()
    return small


def _no_stiffness(
    problem: StepProblem, step: Evaluation, matrix: PETSc.Mat, turning: FloatArray
) -> FloatArray:
    """What counts as none at each coordinate of all bodies, as `matrix` has them. Collective.

    Args:
        problem: Equations of a load step.
        step: Its solution.
        matrix: Stiffness.
        turning: What turning forces add to it, see `AugmentedMatrix.turning`.
    """
    left, diagonal = _unbalanced(problem, step), matrix.getDiagonal()
    size, found = np.abs(diagonal.array_r), np.zeros(len(turning))
    diagonal.destroy()
    for row, k in enumerate(problem.awake):
        body, here = problem.system.bodies[k], problem.laid.of_body(k)
        found[here] = (
            _of_rigid(body, size[here], turning[here]) if body.rigid
            else _NONE * size[here] + left[row]
        )  # fmt: skip
    return found


def _unbalanced(problem: StepProblem, step: Evaluation) -> FloatArray:
    """Forces that the solution leaves on each body awake over its size [N/m], `_LEFT` times."""
    local = np.full((len(problem.awake), 7), -np.inf)
    for row, k in zip(local, problem.awake, strict=True):
        body = problem.system.bodies[k]
        x = body.reference.reshape(-1, 3)[body.places]
        row[0] = np.abs(free(body, step.bodies[k].residual)).max(initial=0.0)
        row[1:4], row[4:] = (way.max(axis=0, initial=-np.inf) for way in (x, -x))
    found = global_max(problem.system.comm, local)
    sizes = 0.5 * np.linalg.norm(found[:, 1:4] + found[:, 4:], axis=1)
    # A rigid body has a single place, and what counts as none there is told otherwise.
    left: FloatArray = _LEFT * found[:, 0] / np.where(sizes > 0.0, sizes, np.inf)
    return left


def _of_rigid(body: Body, size: FloatArray, turning: FloatArray) -> FloatArray:
    """The same of a rigid body, shape (num_owned,)."""
    found, places = np.zeros_like(size), np.repeat(body.places, 3)
    for kind in (places, ~places):
        found[kind] = _NONE_OF_RIGID * turning[kind].max(initial=0.0)
        found[kind] += _ROUNDING * size[kind].max(initial=0.0)
    return found


def _negative_pivots(matrix: PETSc.Mat, none: FloatArray) -> int:
    """Of a symmetric matrix, whose diagonal is raised by what counts as none. Collective."""
    diagonal = matrix.getDiagonal()
    diagonal.array_w[:] += none
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
