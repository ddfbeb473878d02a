"""Warnings that an accepted step gives cause for, beside those of the ledger."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinx_nts.bodies.inversion import describe, smallest_dets
from dolfinx_nts.parallel import global_max
from dolfinx_nts.run.solution import Solution
from dolfinx_nts.step.evaluation import Evaluation
from dolfinx_nts.step.problem import StepProblem
from dolfinx_nts.system import State, System

#: Depth in facet sizes from which on a node behind a surface that it passed by is told.
_BESIDE = 1e-3
#: Smallest det F below which cells count as crushed.
_CRUSHED = 0.05
#: Turn in a step [rad] that is told: a steady one comes out short by a twelfth of its cube.
_FAR = 1.0


def tell_step(solution: Solution, problem: StepProblem, step: Evaluation, state: State) -> None:
    """Warn of what an accepted step did that its user may not have meant. Collective.

    Args:
        solution: The run.
        problem: Equations of the step.
        step: Their solution.
        state: At the end of the step.
    """
    _tell_turns(solution, problem.system, problem.state, state)
    tell_inversion(solution, problem, step, state)
    _tell_beside(solution, problem, state)
    tell_slip(solution, problem, step, state)


def tell_inversion(
    solution: Solution, problem: StepProblem, step: Evaluation, state: State
) -> None:
    """Warn of cells that are inside out, or nearly so. Collective; arguments as of `tell_step`."""
    if step.min_det >= _CRUSHED:
        return
    text = describe(problem.system, state.u, smallest_dets(problem.system, state.u))
    if step.min_det <= 0.0:
        text += "; what comes after it may be wrong"
        solution.warn("inversion", state.time, -step.min_det, text, grave=True)
    else:
        text += "; so near to that the result depends on the mesh"
        solution.warn("crushed cells", state.time, 1.0 - step.min_det, text)


def _tell_beside(solution: Solution, problem: StepProblem, state: State) -> None:
    """Warn of nodes that have passed by a surface's edge and lie behind it."""
    found: list[Any] = problem.contacts.beside
    comm, contacts = problem.system.comm, problem.system.contacts
    deepest = np.array([depth for depth, _ in found])
    comm.Allreduce(MPI.IN_PLACE, deepest, op=MPI.MAX)
    if deepest.max(initial=0.0) <= _BESIDE:
        return
    k = int(deepest.argmax())
    depth, node = max(comm.allgather(found[k]))
    solution.warn(
        "node beside a surface", state.time, depth,
        f"node {node} of contact {contacts[k].name!r} has passed the master's edge "
        f"and lies {depth:.3g} of a facet behind its surface, where nothing holds it; let the "
        "master's surface reach farther",
    )  # fmt: skip


def tell_slip(solution: Solution, problem: StepProblem, step: Evaluation, state: State) -> None:
    """Warn of nodes that slip in spite of infinite friction. Collective.

    They may slip in the next step, too, if any does. Arguments as of `tell_step`.
    """
    contacts = problem.contacts
    both = zip(contacts.elements, problem.contact_parts(step), strict=True)
    endless = [(c, k) for c, k in both if np.isinf(c.pair.friction)]
    if not (endless and contacts.bounded):
        return
    slips = [k.distance[k.active & ~k.stick].max(initial=0.0) for _, k in endless]
    farthest = float(problem.system.comm.allreduce(max(slips), op=MPI.MAX))
    contacts.bounded = farthest > 0.0
    if farthest > 0.0:
        solution.warn(
            "slip", state.time, farthest,
            "nodes would pull if they stuck and would enter the master if they left: in spite "
            f"of infinite friction they slip, by up to {farthest:.3g} m in a step; a finite "
            "coefficient may be meant",
        )  # fmt: skip


def _tell_turns(solution: Solution, system: System, old: State, new: State) -> None:
    """Warn where directors of a body have turned too far in an accepted step. Collective."""
    turning = [k for k, body in enumerate(system.bodies) if body.oriented]
    if not turning:
        return
    turns = np.array([system.bodies[k].turn(old.u[k], new.u[k]) for k in turning])
    turns = global_max(system.comm, turns)
    worst = int(turns.argmax())
    if turns[worst] > _FAR:
        name, turn = system.bodies[turning[worst]].name, float(turns[worst])
        solution.warn(
            "turns", new.time, turn,
            f"body {name!r} turns by {turn:.2g} rad in a step, too far for how it turns to be "
            "right, though energy and momenta may be kept; use a smaller dt",
        )  # fmt: skip
