"""Warnings that load steps give cause for, beside those of any accepted step."""

from __future__ import annotations

from dolfinx_nts.contact.pair import INITIAL_PENETRATION
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import anywhere
from dolfinx_nts.run.solution import Solution
from dolfinx_nts.solve.instability import releasing_motions
from dolfinx_nts.solve.newton import StepSolver
from dolfinx_nts.start.free_motion import free_motion
from dolfinx_nts.state import State
from dolfinx_nts.system import cut_off

#: Part of an overlap from which on what flat facets cut off a curve is told.
_SAG_TOLD = 0.05
#: Part of that which an overlap has to be, not to be rounding.
_SAG_LEAST = 1e-3


def tell_at_rest(
    solution: Solution, solver: StepSolver, step: Evaluation, state: State
) -> None:
    """Warn of motions that nothing resists, and of those that lead away. Collective.

    Args:
        solution: Load steps without stabilization, which would leave such motions at rest.
        solver: Of their equations.
        step: Solution of the last one.
        state: At its end.
    """
    problem, time = solver.problem, state.time
    found = free_motion(problem, solver, step)
    if found:
        solution.warn(
            "free motion", time, 1.0,
            f"{found}: how far it has moved so is chance; hold it by a Dirichlet condition, "
            "a joint or prescribed motion, or pass "
            "stabilization=0.1, which leaves it where it is",
            grave=True,
        )  # fmt: skip
    number = 0 if _slips(solution, state) else releasing_motions(problem, step)
    if number:
        solution.warn(
            "unstable equilibrium", time, float(number),
            f"{number} independent motion{'s' if number > 1 else ''} away from this state "
            f"release{'' if number > 1 else 's'} energy: it is an equilibrium, but not a "
            "stable one, and a small disturbance leads elsewhere, as in buckling or tipping; "
            "to find where, begin with a small displacement= in that direction, or disturb the "
            "loads",
        )  # fmt: skip


def _slips(solution: Solution, state: State) -> bool:
    """Whether nodes slip with friction, whose forces have no potential. Collective."""
    both = zip(solution.system.contacts, state.contacts, strict=True)
    slip = any(p.friction and bool(((c.force > 0.0) & ~c.stick).any()) for p, c in both)
    return anywhere(solution.system.comm, slip)


def tell_cut_off(solution: Solution, state: State) -> None:
    """Warn if an overlap at the start may be that of flat facets, or is partly. Collective."""
    system = solution.system
    for pair, depth in zip(system.contacts, system.penetration(state), strict=True):
        deep, text = float(depth.max(initial=0.0)), cut_off(pair, depth)
        sag = pair.sag(depth > 0.0)
        if not text and sag > _SAG_TOLD * deep > 0.0:
            part = 100.0 * sag / deep
            text = (
                f"flat facets cut {part:.2g} % of that off a curve, by which the pressure may "
                "be wrong: take a finer mesh, or smoothing=True for the master"
            )
        if text and deep > _SAG_LEAST * sag:
            solution.warn(
                "flat facets", state.time, deep,
                f"contact {pair.name!r}: nodes start inside by up to {deep:.3g} of a facet; "
                + text,
                about=(pair.name,),
            )  # fmt: skip


def tell_part_of_loads(
    solution: Solution, problem: StepProblem, state: State, end: float
) -> None:
    """Warn if load steps were asked to end before all of the constant loads act. Collective.

    Args:
        solution: The load steps.
        problem: Their equations.
        state: At their end.
        end: Pseudo time at which they were asked to end.
    """
    now = state.time
    if not now == end < 1.0:
        return
    if problem.loads.grow():
        solution.warn(
            "part of the loads", now, 1.0 - now,
            f"load_steps end at t={now:.6g}, with {100 * now:.3g} % of the constant loads "
            "(gravity and loads that are no functions of time); all of them act at t=1",
        )  # fmt: skip
    depths = solution.system.penetration(state)
    deep = max((float(d.max(initial=0.0)) for d in depths), default=0.0)
    if deep > INITIAL_PENETRATION:
        solution.warn(
            "part of the interference", now, deep,
            f"load_steps end at t={now:.6g}, where {100 * (1.0 - now):.3g} % of the overlap "
            f"at the start is left, up to {deep:.3g} of a facet; none is at t=1",
        )  # fmt: skip
