"""Resultants of supports, joints and contacts, columns of the balance table beside the ledger's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.ledger.balance import OF_JOINTS, told_by
from dolfinx_nts.parallel import Asking
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

if TYPE_CHECKING:
    from dolfinx_nts.equations.problem import StepProblem


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
    """Whether a column is one of these, or of single joints, not of the ledger."""
    return column in CONTACTS or column.startswith(REACTIONS) or column.endswith(OF_JOINTS)


def at_start(system: System) -> dict[str, FloatArray]:
    """Zeros of the right shapes, for the row of the start."""
    row = {reactions_of(b): np.zeros((len(b.reaction_labels), 3)) for b in system.bodies}
    joints = system.declared_joints
    row |= {reactions_of(joint): np.zeros((2, 3)) for joint in joints}
    row |= {f"{name}{OF_JOINTS}": np.zeros(len(joints)) for name in told_by(system)}
    none = np.zeros((len(system.contacts), 3))
    return row | {CONTACT_FORCES: none, CONTACT_MOMENTS: none}


def of_step(problem: StepProblem, step: Evaluation) -> Asking[dict[str, FloatArray]]:
    """Forces of a step [N], where its integrator takes them, the same on all ranks.

    As of `parallel.together`. Collective.

    Returns:
        By column:
            - of each body: forces of its conditions [N], or their moments [N m], (conditions, 3);
            - of each joint: force [N] and moment about its point [N m] on the first of its bodies,
              shape (2, 3), NaN where its elements do not say them;
            - of all contacts: forces [N] on the slaves, and their moments about the origin [N m],
              shape (contacts, 3) each.
    """
    batches, contacts = problem.batches, problem.couplings.touching(step)
    joints = problem.system.declared_joints
    # Nothing holds bodies that are evaluated together.
    alone = slice(len(batches.several), None)
    held = dict(zip(batches.bodies[alone], step.terms[alone], strict=True))
    parts = [body.reactions(terms.residual, terms.u1) for body, terms in held.items()]
    theta, system = problem.integrator.theta, problem.system
    pushes = np.zeros((len(system.pairs), 2, 3))
    for k, c, part, _ in contacts:
        pushes[k] = part.force.sum(axis=0), c.moment(part, theta)
    parts.extend(system.on_slaves(pushes).swapaxes(0, 1))
    both = zip(batches.join(problem.state.u), step.terms, strict=True)
    u = batches.split([u0 + problem.integrator.theta * terms.du for u0, terms in both])
    for k, edges, part in problem.couplings.of_edges(step):
        first = problem.system.contact_bodies[k][0]
        force, moment, *_ = edges.resultant(part, 0, u[first])
        parts[-2][k] += force
        parts[-1][k] += moment
    coupled = {id(batch): part for batch, part in zip(problem.elements, step.parts, strict=True)}
    of_joints = _of_joints(problem, coupled, u)
    parts.append(of_joints.reshape(-1, 3))
    total, _ = yield np.concatenate(parts), np.empty(0)
    total = total.reshape(-1, 3)
    stops = accumulate(map(len, parts))
    split = [total[stop - len(part) : stop] for part, stop in zip(parts, stops, strict=True)]
    found = {reactions_of(body): np.zeros((0, 3)) for body in problem.system.bodies}
    names = [*map(reactions_of, held), CONTACT_FORCES, CONTACT_MOMENTS]
    found |= {name: value / problem.factor for name, value in zip(names, split, strict=False)}
    about = _about_point(split[-1].reshape(of_joints.shape)) / problem.factor
    return found | dict(zip(map(reactions_of, joints), about, strict=True))


def of_joints(
    problem: StepProblem, parts: Mapping[int, Any], u: Sequence[FloatArray]
) -> dict[str, FloatArray]:
    """Resultants of joints alone, as of `of_step` times the factor of the step. Collective.

    Args:
        problem: Equations of the step.
        parts: What elements contribute, by their id; of others nothing.
        u: Owned displacements of each body where they act [m].
    """
    total = _of_joints(problem, parts, u)
    problem.system.comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    names = map(reactions_of, problem.system.declared_joints)
    return dict(zip(names, _about_point(total), strict=True))


def _of_joints(
    problem: StepProblem, parts: Mapping[int, Any], u: Sequence[FloatArray]
) -> FloatArray:
    """Of each declared joint on its first body, as of `Elements.resultant`, on this rank."""
    system, batches = problem.system, problem.batches
    declared = len(system.declared_joints)
    out = np.zeros((declared, 4, 3))
    for coupling, numbers in problem.couplings.joints:
        k, first = numbers[0], system.joint_bodies[numbers[0]][0]
        if k >= declared:  # others hold bodies in shape
            continue
        for batch, of in zip(coupling.elements, coupling.bodies, strict=True):
            part = parts.get(id(batch))
            if part is not None and len(numbers) > 1:
                found = batch.resultants(part, 0, batches.bodies[batches.batch_of(first)].joined(u))
                np.add.at(out, np.array(numbers)[batch.joint], found)
            elif part is not None and first in of:
                out[k] += batch.resultant(part, of.index(first), u[first])
    return out


def _about_point(total: FloatArray) -> FloatArray:
    """Force, and moment about the mean of the points where a joint holds its body, (n, 2, 3)."""
    force, moment, places, count = total.swapaxes(0, 1)
    return np.stack([force, moment - cross(places / np.maximum(count, 1.0), force)], axis=1)


def mean_of_two_steps(time: FloatArray, values: FloatArray) -> FloatArray:
    """Means of each step and the one before it over their time.

    Args:
        time: Of the rows [s], shape (rows,).
        values: Of each row, shape (rows, ...).

    Returns:
        The same shape. The row of the start and that of the first step are as given.
    """
    means, steps = values.copy(), np.diff(time)
    impulses = values[1:] * steps.reshape(-1, *(1,) * (values.ndim - 1))
    over = (steps[1:] + steps[:-1]).reshape(-1, *(1,) * (values.ndim - 1))
    means[2:] = (impulses[1:] + impulses[:-1]) / over
    return means
