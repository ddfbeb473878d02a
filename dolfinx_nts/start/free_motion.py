"""Motions of bodies as rigid ones that nothing resists: equilibrium leaves them undetermined."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import scipy.linalg

from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_max
from dolfinx_nts.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from dolfinx_nts.equations.problem import StepProblem
    from dolfinx_nts.solve.newton import StepSolver


#: Force against a motion over stiffness times motion that counts as none.
_NONE = 1e-12
#: Places that are off a line by less than this part of their distances are on it.
_STRAIGHT = 1e-4
#: Part of a motion that counts as none.
_LITTLE = 1e-3


def free_motion(problem: StepProblem, solver: StepSolver, step: Evaluation) -> str | None:
    """How bodies may move as rigid ones without any force, if they may. Collective.

    The matrix of the equations is applied to three translations and three rotations of each body,
    each over the body's stiffness, so that soft bodies count beside stiff ones. A turn of a
    straight beam about its own axis is none: it moves nothing, and how straight it is, which
    decides whether anything resists it, is chance.
    """
    operator = solver.assemble(step).operator
    comm, bodies = problem.system.comm, problem.system.bodies
    direction, result = problem.x.duplicate(), problem.x.duplicate()
    diagonal = operator.getDiagonal()
    local = [np.abs(diagonal.array_r[problem.laid.of_body(k)]).max(initial=0.0)
             for k in range(len(bodies))]  # fmt: skip
    stiffness = global_max(comm, np.array(local))
    stiffness[stiffness == 0.0] = stiffness.max() or 1.0
    modes, images, axes, spins = [], [], [], list[bool]()
    for k, body in enumerate(bodies):
        y = (body.reference + step.bodies[k].u1).reshape(-1, 3)
        shapes, about, straight = _rigid(y, body.places, comm)
        axes.append(about)
        spins += [False] * 5 + [straight]
        for shape in shapes:
            direction.set(0.0)
            direction.array_w[problem.laid.of_body(k)] = shape / stiffness[k]
            operator.mult(direction, result)
            modes.append((k, shape))
            images.append(result.array_r.copy())
    a = np.array(images)
    sizes = np.zeros((2, len(modes), len(modes)))
    with np.errstate(over="ignore", invalid="ignore"):
        sizes[0] = a @ a.T
    for i, (k, x) in enumerate(modes):
        for j, (m, y) in enumerate(modes):
            sizes[1, i, j] = x @ y if k == m else 0.0
    comm.Allreduce(MPI.IN_PLACE, sizes, op=MPI.SUM)

    def resisted(combination: FloatArray) -> bool:
        # The matrix has the squares of resistances, which keep half the digits of these.
        direction.set(0.0)
        for part, (k, mode) in zip(combination, modes, strict=True):
            direction.array_w[problem.laid.of_body(k)] += part / stiffness[k] * mode
        operator.mult(direction, result)
        resistance: float = result.norm()
        for k, value in enumerate(stiffness):
            direction.array_w[problem.laid.of_body(k)] *= value
        return resistance > _NONE * direction.norm()

    spin, found = np.array(spins), None
    # What is not defined there is told by who solves the step.
    if np.isfinite(sizes).all():
        found = _least(sizes, ~spin)
        if resisted(found):
            found = _least(sizes, np.ones_like(spin)) if spin.any() else None
            if found is not None and (_is_spin(found, sizes[1], spin) or resisted(found)):
                found = None
    for vector in (direction, result, diagonal):
        vector.destroy()
    if found is None:
        return None
    parts = found.reshape(-1, 2, 3) / stiffness[:, None, None]
    parts[:, 1] = np.einsum("ka,kai->ki", parts[:, 1], np.array(axes))
    return _describe(bodies, parts)


def _least(sizes: FloatArray, among: BoolArray) -> FloatArray:
    """The combination (modes,) of some modes that is resisted least.

    By products of the modes' images, and of the modes, shape (2, modes, modes).
    """
    found = np.zeros(len(among))
    resistance, forces = np.sqrt(sizes.diagonal(axis1=1, axis2=2))
    alone = np.flatnonzero(among & (resistance <= _NONE * forces))
    if alone.size:  # eigenvectors would mix the motions that are free as rounding has it
        found[alone[0]] = 1.0
    else:
        found[among] = scipy.linalg.eigh(*sizes[:, among][:, :, among])[1][:, 0]
    return found


def _is_spin(combination: FloatArray, products: FloatArray, spin: BoolArray) -> bool:
    """Whether all but a little of it is turns of straight bodies about their own axes."""
    size = np.abs(combination) * np.sqrt(products.diagonal())
    return bool(np.linalg.norm(size[~spin]) <= _LITTLE * np.linalg.norm(size))


def _rigid(
    y: FloatArray, places: BoolArray, comm: MPI.Comm
) -> tuple[list[FloatArray], FloatArray, bool]:
    """Three translations and three rotations about the middle of the places. Collective.

    Of nodal vectors y [m], (n, 3), some of them places. With the axes of the rotations, (3, 3), and
    whether all places are on the last one.
    """
    total = comm.allreduce(np.array([*y[places].sum(axis=0), places.sum()]))
    arm = y - np.where(places[:, None], total[:3] / total[3], 0.0)
    squares, vectors = np.linalg.eigh(comm.allreduce(arm[places].T @ arm[places]))
    straight = bool(0.0 < squares[2] and squares[1] <= _STRAIGHT**2 * squares[2])
    size = np.sqrt(comm.allreduce(float((arm**2).sum())) / total[3])
    axes = np.eye(3)
    translations = [(places[:, None] * axis).ravel() for axis in axes]
    about: FloatArray = vectors.T if straight else axes
    return translations + [np.cross(axis, arm / size).ravel() for axis in about], about, straight


def _describe(bodies: Any, parts: FloatArray) -> str:
    """The largest motion; of each body translations and rotations, shape (bodies, 2, 3)."""
    k, kind = np.unravel_index(np.linalg.norm(parts, axis=2).argmax(), parts.shape[:2])
    vector = parts[k, kind] / np.linalg.norm(parts[k, kind])
    vector *= np.sign(vector[np.abs(vector).argmax()])
    way = ", ".join(f"{c:.2g}" for c in vector.round(3) + 0.0)
    moves = "turning about" if kind else "moving along"
    return f"nothing resists body {bodies[k].name!r} {moves} ({way})"
