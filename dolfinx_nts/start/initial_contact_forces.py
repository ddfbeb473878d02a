"""Forces of contacts that bodies rest or slide on at the start of a run."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.integrators import Newmark
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import anywhere
from dolfinx_nts.solve.accuracy import Newton
from dolfinx_nts.solve.newton import StepSolver
from dolfinx_nts.state import State
from dolfinx_nts.types import BoolArray, Options
from dolfinx_nts.validation import StepFailedError, UserFunctionError

logger = logging.getLogger(__name__)


#: Length of the step that the forces are taken from over that of the run's first one: forces that
#: change are those of the start. Less would leave them to the rounding of positions.
_SHORT = 0.1
#: A gap over the size of its facet that counts as closed at the start.
_CLOSED = 1e-9
#: Velocities that close a gap by more than this part of the way that its force pushes back make an
#: impact.
_RESTS = 0.5


def with_resting_forces(
    problem: StepProblem, state: State, dt: float, newton: Newton, options: Options
) -> State:
    """The state with the forces of contacts that carry from the start on. Collective.

    Accelerations at the start that leave them out would let forces alternate between zero and
    twice their value for ever: the trapezoidal rule does not damp what its start is off. The forces
    are those of a short step that does not depend on the accelerations at its start. Nodes that
    meet with a velocity have no forces before the impact.

    Args:
        problem: Equations of the run.
        state: At the start.
        dt: First step [s].
        newton: Tolerances.
        options: PETSc options.

    Returns:
        The state as it is where nothing touches, or that step is not solved.

    Raises:
        UserFunctionError: A function of the user's failed.
    """
    system = problem.system
    known = any(contact.force.any() for contact in state.contacts)
    if not system.contacts or anywhere(system.comm, known):
        return state
    start = replace(state, a=tuple(np.zeros_like(v) for v in state.v))
    problem.begin(start, _SHORT * dt)
    batches = (*problem.couplings.contacts.elements, *problem.couplings.contacts.idle)
    touches = any(_closed(c).any() for c in batches)
    if not anywhere(system.comm, touches):
        return state
    # With beta = 1/2 a step moves by h v_0 + h^2/2 a_1: a_0, which is sought, plays no part.
    rule = Newmark(beta=0.5, gamma=1.0)
    short = StepProblem(system, rule, rtol=newton.rtol, condense=newton.condense)
    solver = StepSolver(short, newton, newton.preset(system, True, options), options)
    try:
        short.begin(start, _SHORT * dt)
        return _with_forces(short, solver.solve(), state)
    except UserFunctionError:
        raise
    except StepFailedError as failure:
        logger.info("no contact forces at the start: %s", failure)
        return state
    finally:
        solver.destroy()
        short.destroy()


def _with_forces(problem: StepProblem, step: Evaluation, state: State) -> State:
    """The state with the forces of a first step at nodes that rest or slide. Collective."""
    found = list(state.contacts)
    flight = problem.couplings.contacts.flight_gaps()
    for after, (k, c, part, old) in zip(flight, problem.couplings.touching(step), strict=True):
        new, node = c.history(part, problem.factor, old), c.candidates.node
        push = problem.factor * new.force[node] / c.law.scale
        rests = np.zeros(len(new.force), dtype=bool)
        rests[node] = _closed(c) & (c.candidates.gap - after <= _RESTS * push)
        force = np.where(rests, new.force, 0.0)
        tangential = np.where(rests[:, None], new.tangential, 0.0)
        found[k] = old._replace(force=force, tangential=tangential)
    return replace(state, contacts=tuple(found))


def _closed(c: ContactElements) -> BoolArray:
    """Which candidates touch at the start."""
    return np.abs(c.candidates.gap) <= _CLOSED * c.candidates.length
