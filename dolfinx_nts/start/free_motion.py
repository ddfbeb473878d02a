"""Motions of bodies as rigid ones that nothing resists: equilibrium leaves them undetermined."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import scipy.linalg

from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_max

if TYPE_CHECKING:
    from dolfinx_nts.equations.problem import StepProblem
    from dolfinx_nts.solve.newton import StepSolver

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Force against a motion over stiffness times motion that counts as none.
_NONE = 1e-12


def free_motion(problem: StepProblem, solver: StepSolver, step: Evaluation) -> str | None:
    """How bodies may move as rigid ones without any force, if they may. Collective.

    The matrix of the equations is applied to three translations and three rotations of each body,
    each over the body's stiffness, so that soft bodies count beside stiff ones.

    Args:
        problem: Equations of a load step.
        solver: Its solver.
        step: Its solution.
    """
    operator = solver.assemble(step).operator
    comm, bodies = problem.system.comm, problem.system.bodies
    direction, result = problem.x.duplicate(), problem.x.duplicate()
    diagonal = operator.getDiagonal()
    local = [np.abs(diagonal.array_r[problem.of_body(k)]).max(initial=0.0)
             for k in range(len(bodies))]  # fmt: skip
    stiffness = global_max(comm, np.array(local))
    stiffness[stiffness == 0.0] = stiffness.max() or 1.0
    modes, images = [], []
    for k, body in enumerate(bodies):
        y = (body.reference + step.bodies[k].u1).reshape(-1, 3)
        for shape in _rigid(y, body.places, comm):
            mode = shape / stiffness[k]
            direction.set(0.0)
            direction.array_w[problem.of_body(k)] = mode
            operator.mult(direction, result)
            modes.append((k, shape))
            images.append(result.array_r.copy())
    a = np.array(images)
    sizes = np.zeros((2, len(modes), len(modes)))
    sizes[0] = a @ a.T
    for i, (k, x) in enumerate(modes):
        for j, (m, y) in enumerate(modes):
            sizes[1, i, j] = x @ y if k == m else 0.0
    comm.Allreduce(MPI.IN_PLACE, sizes, op=MPI.SUM)
    if not np.isfinite(sizes).all():  # what is not defined there is told by who solves the step
        for vector in (direction, result, diagonal):
            vector.destroy()
        return None
    resistance, forces = np.sqrt(sizes.diagonal(axis1=1, axis2=2))
    alone = np.flatnonzero(resistance <= _NONE * forces)
    if alone.size:  # eigenvectors would mix the motions that are free as rounding has it
        combination = np.eye(len(modes))[alone[0]]
    else:
        combination = scipy.linalg.eigh(sizes[0], sizes[1])[1][:, 0]
    # The matrix has the squares of resistances, which keep half the digits of these.
    direction.set(0.0)
    for part, (k, mode) in zip(combination, modes, strict=True):
        direction.array_w[problem.of_body(k)] += part / stiffness[k] * mode
    operator.mult(direction, result)
    resistance = result.norm()
    for k, value in enumerate(stiffness):
        direction.array_w[problem.of_body(k)] *= value
    forces = direction.norm()
    for vector in (direction, result, diagonal):
        vector.destroy()
    if resistance > _NONE * forces:
        return None
    return _describe(bodies, combination.reshape(-1, 2, 3) / stiffness[:, None, None])


def _rigid(y: FloatArray, places: BoolArray, comm: Any) -> list[FloatArray]:
    """Three translations and three rotations about the middle of the places. Collective.

    Args:
        y: Nodal vectors [m], shape (n, 3).
        places: Which of them are places; directors only turn.
        comm: MPI communicator.
    """
    total = comm.allreduce(np.array([*y[places].sum(axis=0), places.sum()]))
    arm = y - np.where(places[:, None], total[:3] / total[3], 0.0)
    size = np.sqrt(comm.allreduce(float((arm**2).sum())) / total[3])
    axes = np.eye(3)
    translations = [(places[:, None] * axis).ravel() for axis in axes]
    return translations + [np.cross(axis, arm / size).ravel() for axis in axes]


def _describe(bodies: Any, parts: FloatArray) -> str:
    """The largest motion; of each body translations and rotations, shape (bodies, 2, 3)."""
    k, kind = np.unravel_index(np.linalg.norm(parts, axis=2).argmax(), parts.shape[:2])
    vector = parts[k, kind] / np.linalg.norm(parts[k, kind])
    vector *= np.sign(vector[np.abs(vector).argmax()])
    way = ", ".join(f"{c:.2g}" for c in vector.round(3) + 0.0)
    moves = "turning about" if kind else "moving along"
    return f"nothing resists body {bodies[k].name!r} {moves} ({way})"
