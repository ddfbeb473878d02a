"""Resultants of supports, joints and contacts, columns of the balance table beside the ledger's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.system import System

if TYPE_CHECKING:
    from dolfinx_nts.step.problem import Evaluation, StepProblem

FloatArray = npt.NDArray[np.float64]

#: Column of the resultants of all contacts.
CONTACT_FORCES = "contact_forces"


def reactions_of(item: Any) -> str:
    """Column of the reactions of a body or a joint."""
    return f"reactions of {item.name}"


def at_start(system: System) -> dict[str, FloatArray]:
    """Zeros of the right shapes, for the row of the start."""
    row = {reactions_of(b): np.zeros_like(_reactions(b, np.zeros(b.num_owned)))
           for b in system.bodies}  # fmt: skip
    row |= {reactions_of(joint): np.zeros((2, 3)) for joint in system.declared_joints}
    return row | {CONTACT_FORCES: np.zeros((len(system.contacts), 3))}


def of_step(problem: StepProblem, step: Evaluation) -> dict[str, FloatArray]:
    """Forces of a step [N], where its integrator takes them, the same on all ranks. Collective.

    Args:
        problem: Equations of the step.
        step: Their solution.

    Returns:
        By column: of each body's conditions, shape (conditions, 3), of each joint on the first of
        its bodies, force [N] and moment about its point [N m], shape (2, 3), and of each contact on
        its slave body, shape (contacts, 3).
    """
    bodies, contacts = problem.system.bodies, problem.contact_parts(step)
    joints = problem.system.declared_joints
    parts = [_reactions(b, t.residual) for b, t in zip(bodies, step.bodies, strict=True)]
    forces = [part.force.sum(axis=0) for part in contacts]
    parts.append(np.reshape(forces, (len(contacts), 3)))
    held = list(problem.each(step))[1 : 1 + len(joints)]
    parts += [_of_joint(problem, step, *each) for each in held]
    total = np.concatenate(parts)
    problem.system.comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    split = np.split(total, np.cumsum([len(part) for part in parts])[:-1])
    names = [*map(reactions_of, bodies), CONTACT_FORCES]
    found = {name: value / problem.factor for name, value in zip(names, split, strict=False)}
    for joint, (force, moment, places, count) in zip(joints, split[len(names) :], strict=True):
        point = places / max(count[0], 1.0)
        both = np.array([force, moment - cross(point, force)])
        found[reactions_of(joint)] = both / problem.factor
    return found


def _of_joint(
    problem: StepProblem, step: Evaluation, coupling: Any, parts: tuple[Any, ...]
) -> FloatArray:
    """Of a joint on its first body on this rank. Collective.

    Returns:
        Factor of the step times force and moment about the origin, the sum of its points [m], and
        their number, shape (4, 3); zeros if its elements are not between points.
    """
    out = np.zeros((4, 3))
    if len(parts) != 1 or not hasattr(coupling.elements[0], "sides"):
        return out
    side, k = coupling.elements[0].sides[0], coupling.bodies[0][0]
    u = problem.state.u[k] + problem.integrator.theta * step.bodies[k].du
    y = side.reference + side.nodal(u)
    force = -parts[0].residual[:, : y[0].size if len(y) else 0].reshape(y.shape)
    out[0] = force[side.places].sum(axis=0)
    out[1] = cross(y, force).sum(axis=(0, 1))
    out[2], out[3] = side.combine(y).sum(axis=0), len(y)
    return out


def _reactions(body: Any, residual: FloatArray) -> FloatArray:
    """A body of the user's own may have no conditions."""
    if not hasattr(body, "reactions"):
        return np.zeros((0, 3))
    forces: FloatArray = body.reactions(residual)
    return forces
