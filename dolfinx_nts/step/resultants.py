"""Resultant forces of supports and contacts, columns of the balance table beside the ledger's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from dolfinx_nts.system import System

if TYPE_CHECKING:
    from dolfinx_nts.step.problem import Evaluation, StepProblem

FloatArray = npt.NDArray[np.float64]

#: Column of the resultants of all contacts.
CONTACT_FORCES = "contact_forces"


def reactions_of(body: Any) -> str:
    """Column of the reactions of a body."""
    return f"reactions of {body.name}"


def at_start(system: System) -> dict[str, FloatArray]:
    """Zeros of the right shapes, for the row of the start."""
    row = {reactions_of(b): np.zeros_like(_reactions(b, np.zeros(b.num_owned)))
           for b in system.bodies}  # fmt: skip
    return row | {CONTACT_FORCES: np.zeros((len(system.contacts), 3))}


def of_step(problem: StepProblem, step: Evaluation) -> dict[str, FloatArray]:
    """Forces of a step [N], where its integrator takes them, the same on all ranks. Collective.

    Args:
        problem: Equations of the step.
        step: Their solution.

    Returns:
        By column: of each body's conditions, shape (conditions, 3), and of each contact on its
        slave body, shape (contacts, 3).
    """
    bodies, contacts = problem.system.bodies, problem.contact_parts(step)
    parts = [_reactions(b, t.residual) for b, t in zip(bodies, step.bodies, strict=True)]
    forces = [part.force.sum(axis=0) for part in contacts]
    parts.append(np.reshape(forces, (len(contacts), 3)))
    total = np.concatenate(parts) / problem.factor
    problem.system.comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    names = [*map(reactions_of, bodies), CONTACT_FORCES]
    split = np.split(total, np.cumsum([len(part) for part in parts])[:-1])
    return dict(zip(names, split, strict=True))


def _reactions(body: Any, residual: FloatArray) -> FloatArray:
    """A body of the user's own may have no conditions."""
    if not hasattr(body, "reactions"):
        return np.zeros((0, 3))
    forces: FloatArray = body.reactions(residual)
    return forces
