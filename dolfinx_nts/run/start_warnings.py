"""Warnings that the start of a run gives cause for."""

from __future__ import annotations

from dolfinx_nts.contact.hidden_facets import hidden_facets
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.run.solution import Solution
from dolfinx_nts.run.start import incomplete
from dolfinx_nts.start.massless_start import off_balance, thick_layer
from dolfinx_nts.start.unresolved import tell_unresolved
from dolfinx_nts.state import State


def tell_start(
    solution: Solution,
    problem: StepProblem,
    state: State,
    dt: float,
    begun: Solution | None,
    moved: tuple[float, str] | None,
) -> None:
    """Warn of what a start may not have been meant to be. Collective.

    Args:
        solution: The run.
        problem: Equations of the first step.
        state: The start.
        dt: First step [s].
        begun: Run that this one goes on from.
        moved: How far the start was projected onto its joints, and a sentence.
    """
    system = problem.system
    if moved is not None:
        solution.warn("start projected", state.time, *moved)
    doubt = incomplete(begun)
    if doubt:
        solution.warn("start", state.time, 1.0, doubt, grave=True)
    missing, text = off_balance(problem, state, dt)
    if text:
        solution.warn("massless nodes", state.time, missing, text)
    ratio, text = thick_layer(system)
    if text:
        solution.warn("thick layer", state.time, ratio, text)
    fast = tell_unresolved(problem, state, dt)
    if fast:
        solution.warn("unresolved", state.time, *fast)
    masters = [state.u[bodies[-1]] for bodies in system.contact_bodies]
    hidden = hidden_facets(system.contacts, masters)
    if hidden:
        solution.warn("hidden facets", state.time, *hidden)
