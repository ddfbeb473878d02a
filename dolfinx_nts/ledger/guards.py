"""What a solved step must satisfy before it is accepted, whatever its residual says."""

from __future__ import annotations

import math

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.parallel import Asking
from dolfinx_nts.state import State
from dolfinx_nts.types import BalanceRow, FloatArray
from dolfinx_nts.validation import StepFailedError

#: Part of the momenta and impulses of a step by which momentum may change without an impulse ...
_MOMENTUM = 1e-6
#: ... and how many times the tolerance of Newton's method, where that is larger.
_TOLERANCES = 1e3
#: Rounding of an angular momentum about the origin over that of the distance times the momentum,
#: and of sums of forces that cancel each other over those forces.
_FAR = 1e3 * float(np.finfo(float).eps)
#: Residuals whose norms, which square them, are rounded to nothing: they count as solved.
_SQUARED_AWAY = math.sqrt(float(np.finfo(float).tiny))


def check_momentum(
    problem: StepProblem, pushed: FloatArray, before: BalanceRow, after: BalanceRow
) -> float:
    """Refuse a step whose momentum changes by more than its impulses.

    Linear momentum changes by the impulses of loads, supports and obstacles alone, angular
    momentum, where the integrator keeps it, by their moments at the middle of the step. The
    momenta are those of the states, so that the check depends neither on the residual nor on its
    tolerances.

    Args:
        problem: Equations of the step.
        pushed: `pushes` of their solution.
        before: `balance.measure` of the state at t_n.
        after: `balance.measure` of the state it leads to.

    Returns:
        Impulses of all forces in the step, the sum of their absolute values [kg m/s].

    Raises:
        StepFailedError: The step is wrong.
    """
    total, rule, dt = pushed.copy(), problem.integrator, problem.dt
    arm = problem.lengths.span + math.sqrt(total[8])
    total[:7] *= rule.rate(dt)
    activity = total[6] + total[7]
    allowed = max(_MOMENTUM, _TOLERANCES * problem.rtol) * activity
    allowed += problem.rounding.forces.sum() * math.sqrt(problem.system.size) * rule.rate(dt)
    allowed += (_FAR * total[12] + problem.system.size * _SQUARED_AWAY) * rule.rate(dt)
    off = after["linear_momentum"] - before["linear_momentum"] - total[:3] - total[9:12]
    # About the middle of the bodies: about a far origin every error of P would look like one of J.
    turn = after["angular_momentum"] - before["angular_momentum"] - total[3:6] - total[13:]
    turn -= cross(problem.lengths.centre, off)
    far = _FAR * float(np.linalg.norm(problem.lengths.centre)) * activity
    checks = [("linear", off, allowed)]
    if rule.keeps_angular_momentum:
        checks.append(("angular", turn, arm * allowed + far))
    for name, error, limit in checks:
        size = float(np.abs(error).max())
        if not size <= limit:
            raise StepFailedError(
                f"step from t={problem.state.time:.6g} with dt={problem.dt:.3g}: {name} momentum "
                f"changes by {size:.3g} more than the impulses of the step; its equations are not "
                "solved, whatever their residual says"
            )
    return float(total[6])


def pushes(problem: StepProblem, step: Evaluation, state: State) -> Asking[FloatArray]:
    """Sums of a step's forces, moments and sizes for `check_momentum`, as of `parallel.together`.

    Args:
        problem: Equations of the step.
        step: Their solution.
        state: The state it leads to.
    """
    local, rule, batches = np.zeros(16), problem.integrator, problem.batches
    old = zip(batches.join(problem.state.u), *batches.rates(problem.state), strict=True)
    each = zip(batches.bodies, batches.numbers, step.terms, old, batches.join(state.v), strict=True)
    for body, (k, *_), terms, (u0, v0, a0), v1 in each:
        force = terms.external - terms.internal - terms.coupling
        force[body.fixed] += terms.residual[body.fixed]
        local[:3] += body.linear_momentum(force)
        local[3:6] += body.angular_momentum(u0 + 0.5 * terms.du, force)
        parts = (terms.internal, terms.external, terms.coupling)
        local[6] += sum(float(np.abs(p).sum()) for p in parts)
        speed = np.abs(v0) + np.abs(v1)
        if rule.accelerations:
            # What the velocity would be without the forces of this step.
            free = problem.supports.coast(k, v0, a0)
            local[9:12] += body.linear_momentum(body.inertia(free - v0))
            speed += np.abs(free)
        local[13:] += problem.supports.bend(k, terms.du)
        local[7] += float(np.abs(body.nodal_mass) @ speed)
        local[8] += float(terms.du @ terms.du)
    for batch, part in zip(problem.elements, step.parts, strict=True):
        # Of forces that cancel each other within a body only the rounding counts.
        local[12] += float(np.abs(part.residual[:, : batch.num_coordinates]).sum())
    return (yield local, np.empty(0))[0]
