"""Resultants of supports, joints and contacts, columns of the balance table beside the ledger's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.system import System

if TYPE_CHECKING:
    from dolfinx_nts.equations.problem import StepProblem

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
    each, theta = zip(problem.state.u, step.bodies, strict=True), problem.integrator.theta
    u = [u0 + theta * terms.du for u0, terms in each]
    held = {id(batch): part for batch, part in zip(problem.elements, step.parts, strict=True)}
    parts += _of_joints(problem, held, u)
    total = np.concatenate(parts)
    problem.system.comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    stops = accumulate(map(len, parts))
    split = [total[stop - len(part) : stop] for part, stop in zip(parts, stops, strict=True)]
    names = [*map(reactions_of, bodies), CONTACT_FORCES, CONTACT_MOMENTS]
    found = {name: value / problem.factor for name, value in zip(names, split, strict=False)}
    for joint, total in zip(joints, split[len(names) :], strict=True):
        found[reactions_of(joint)] = _about_point(total) / problem.factor
    return found


def of_joints(
    problem: StepProblem, parts: Mapping[int, Any], u: Sequence[FloatArray]
) -> dict[str, FloatArray]:
    """Resultants of joints alone, as of `of_step` times the factor of the step. Collective.

    Args:
        problem: Equations of the step.
        parts: What elements contribute, by their id; of others nothing.
        u: Owned displacements of each body where they act [m].
    """
    total = np.array(_of_joints(problem, parts, u)).reshape(-1, 4, 3)
    problem.system.comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    both = zip(problem.system.declared_joints, total, strict=True)
    return {reactions_of(joint): _about_point(of) for joint, of in both}


def _of_joints(
    problem: StepProblem, parts: Mapping[int, Any], u: Sequence[FloatArray]
) -> list[FloatArray]:
    """Of each declared joint on its first body, as of `Elements.resultant`, on this rank."""
    out, system = [], problem.system
    # Others, which come last, hold bodies in shape.
    each = zip(system.declared_joints, system.joint_bodies, problem.couplings.joints, strict=False)
    for _, bodies, coupling in each:
        first, total = bodies[0], np.zeros((4, 3))
        for batch, of in zip(coupling.elements, coupling.bodies, strict=True):
            if first in of and id(batch) in parts:
                total += batch.resultant(parts[id(batch)], of.index(first), u[first])
        out.append(total)
    return out


def _about_point(total: FloatArray) -> FloatArray:
    """Force, and moment about the mean of the points where a joint holds its body, (2, 3)."""
    force, moment, places, count = total
    return np.array([force, moment - cross(places / max(count[0], 1.0), force)])
