"""Warnings that an accepted step gives cause for, beside those of the ledger."""

from __future__ import annotations

import numpy as np

from dolfinx_nts.bodies.inversion import describe, smallest_dets
from dolfinx_nts.evaluation import Evaluation
from dolfinx_nts.parallel import global_max
from dolfinx_nts.run.solution import Solution
from dolfinx_nts.state import State
from dolfinx_nts.step.problem import StepProblem
from dolfinx_nts.system import System

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
    tell_couplings(solution, problem, step, state)


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


def tell_couplings(
    solution: Solution, problem: StepProblem, step: Evaluation, state: State
) -> None:
    """Warn of what contacts and joints tell. Collective; arguments as of `tell_step`."""
    for coupling, parts in problem.each(step):
        for kind, size, text in coupling.warnings(parts):
            solution.warn(kind, state.time, size, text)


def _tell_turns(solution: Solution, system: System, old: State, new: State) -> None:
    """Warn where directors of a body have turned too far in an accepted step. Collective."""
    turning = [k for k, body in enumerate(system.bodies) if body.oriented]
    if not turning:
        return
    bodies = [system.bodies[k] for k in turning]
    driven = [body.prescribed_turn(old.time, new.time) for body in bodies]
    seen = [body.turn(old.u[k], new.u[k]) for k, body in zip(turning, bodies, strict=True)]
    turns = global_max(system.comm, np.maximum(seen, driven))
    worst = int(turns.argmax())
    if turns[worst] > _FAR:
        name, turn = bodies[worst].name, float(turns[worst])
        by = "by" if turn < np.pi else "by at least"
        solution.warn(
            "turns", new.time, turn,
            f"body {name!r} turns {by} {turn:.2g} rad in a step, too far for how it turns to be "
            "right, though energy and momenta may be kept; use a smaller dt",
        )  # fmt: skip
