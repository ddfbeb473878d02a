"""Resultants of supports, joints and contacts, columns of the balance table beside the ledger's."""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from dolfinx_nts.evaluation import Evaluation
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.system import System

if TYPE_CHECKING:
    from dolfinx_nts.step.problem import StepProblem

FloatArray = npt.NDArray[np.float64]

#: Column of the resultants of all contacts.
CONTACT_FORCES = "contact_forces"
#: Column of their moments about the origin.
CONTACT_MOMENTS = "contact_moments"
CONTACTS = (CONTACT_FORCES, CONTACT_MOMENTS)
#: Begin of the columns of reactions.
REACTIONS = "reactions of "


def reactions_of(item: Any) -> str:
    """Column of the reactions of a body or a joint."""
    return f"{REACTIONS}{item.name}"


def is_resultant(column: str) -> bool:
    """Whether a column is one of these, not of the ledger."""
    return column in CONTACTS or column.startswith(REACTIONS)


def at_start(system: System) -> dict[str, FloatArray]:
    """Zeros of the right shapes, for the row of the start."""
    row = {reactions_of(b): np.zeros((len(b.reaction_labels), 3)) for b in system.bodies}
    row |= {reactions_of(joint): np.zeros((2, 3)) for joint in system.declared_joints}
    none = np.zeros((len(system.contacts), 3))
    return row | {CONTACT_FORCES: none, CONTACT_MOMENTS: none}


def of_step(problem: StepProblem, step: Evaluation) -> dict[str, FloatArray]:
    """Forces of a step [N], where its integrator takes them, the same on all ranks. Collective.

    Args:
        problem: Equations of the step.
        step: Their solution.

    Returns:
        By column:
            - of each body: forces of its conditions [N], or their moments [N m], (conditions, 3);
            - of each joint: force [N] and moment about its point [N m] on the first of its bodies,
              shape (2, 3), NaN where its elements do not say them;
            - of all contacts: forces [N] on the slaves, and their moments about the origin [N m],
              shape (contacts, 3) each.
    """
    bodies, contacts = problem.system.bodies, problem.couplings.touching(step)
    joints = problem.system.declared_joints
    parts = [b.reactions(t.residual, t.u1) for b, t in zip(bodies, step.bodies, strict=True)]
    forces = [part.force.sum(axis=0) for _, part, _ in contacts]
    parts.append(np.reshape(forces, (len(contacts), 3)))
    moments = [c.moment(part, problem.integrator.theta) for c, part, _ in contacts]
    parts.append(np.reshape(moments, (len(contacts), 3)))
    first = [bodies[0] for bodies in problem.system.joint_bodies]
    held = list(zip(first, problem.couplings.of_joints(step), strict=True))[: len(joints)]
    parts += [_of_joint(problem, step, k, *each) for k, each in held]
    total = np.concatenate(parts)
    problem.system.comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    stops = accumulate(map(len, parts))
    split = [total[stop - len(part) : stop] for part, stop in zip(parts, stops, strict=True)]
    names = [*map(reactions_of, bodies), CONTACT_FORCES, CONTACT_MOMENTS]
    found = {name: value / problem.factor for name, value in zip(names, split, strict=False)}
    for joint, (force, moment, places, count) in zip(joints, split[len(names) :], strict=True):
        point = places / max(count[0], 1.0)
        both = np.array([force, moment - cross(point, force)])
        found[reactions_of(joint)] = both / problem.factor
    return found


def _of_joint(
    problem: StepProblem, step: Evaluation, first: int, coupling: Any, parts: tuple[Any, ...]
) -> FloatArray:
    """Of a joint on its first body, whose number is given, on this rank. Collective.

    Returns:
        As of `Elements.resultant`, shape (4, 3).
    """
    out = np.zeros((4, 3))
    u = problem.state.u[first] + problem.integrator.theta * step.bodies[first].du
    for batch, of, part in zip(coupling.elements, coupling.bodies, parts, strict=True):
        if first in of:
            out += batch.resultant(part, of.index(first), u)
    return out
