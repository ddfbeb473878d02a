"""Velocities and accelerations that fit constraints: at a start, and where drives stop.

See sections 11 and 21 of the theory. A rule such as v_1 = 2 (y_1 - y_0)/h - v_0 lets velocities
alternate about those that a drive prescribes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.mass_solves import Saddle, solve_mass
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.equations.supports import rates_at_start
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.interaction.kinematics import Kinematics
from dolfinx_nts.interaction.point_elements import PointPart
from dolfinx_nts.ledger import resultants
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray

#: Linear solves of a start; what prescribed values change in the first step slows them down.
_TIMES = 8
#: Part of its drive's velocity by which a joint may miss it; steps that resolve a drive miss it by
#: their second order.
_MISSED = 0.01


class Fitted(NamedTuple):
    """What makes the velocities at the end of a step those of its drives.

    Attributes:
        state: With the new ones.
        work: Of the drives [J].
        reactions: Impulses of the joints [N s] and their moments [N m s], by column of the balance
            table as of `resultants.of_step`.
    """

    state: State
    work: float
    reactions: dict[str, FloatArray]


def violation(
    problem: StepProblem, state: State, dt: float, *, rates: bool, part: float = 0.0,
    driven: bool = False,
) -> tuple[float, str] | None:  # fmt: skip
    """The worst violation of a constraint, and its joint's name. Collective.

    Args:
        problem: Equations of the first step, after `begin`; of the last one with dt < 0.
        state: At the start.
        dt: First step [s]; less the last one, to take rates of what is prescribed in it.
        rates: That of velocities; else of positions.
        part: Of the speed of a joint's bodies that it may be, beside its rounding.
        driven: Whether to look at joints alone that prescribe a motion; `part` is then of the speed
            along their constraints, which is the same wherever the whole scene flies or turns.

    Returns:
        [m/s] or [m], or None where all constraints hold.
    """
    worst, name, system = 0.0, "", problem.system
    speeds = problem.batches.largest(problem.batches.join(state.v))
    for coupling, numbers in problem.couplings.joints:
        if driven and not any(_drives(system.joints[k]) for k in numbers):
            continue
        fastest = [max(speeds[b] for b in system.joint_bodies[k]) for k in numbers]
        for found in filter(None, coupling.kinematics(state, dt)):
            both = (np.atleast_1d(values[int(rates)]) for values in (found.size, found.limit))
            scale = np.atleast_1d(found.along) if driven else fastest
            off, limit, scale = global_max(system.comm, np.array([*both, scale]))
            off = np.where(off > np.maximum(limit, part * scale), off, 0.0)
            if off.max() > worst:
                worst, name = float(off.max()), system.joints[numbers[off.argmax()]].name
    return (worst, name) if name else None


def accelerations(problem: StepProblem, state: State, dt: float) -> tuple[FloatArray, ...]:
    """M a + G^T lambda = f with the second derivative of the constraints zero [m/s^2]. Collective.

    Args:
        problem: Equations of the run.
        state: At the start; its own accelerations play no part.
        dt: First step [s]; in which prescribed coordinates are asked for their motion.
    """
    forces, held = zip(*accelerating_forces(problem, state, dt), strict=True)
    solved, _ = _solve(problem, replace(state, a=held), forces, 1, dt)
    return tuple(a + given for a, given in zip(solved, held, strict=True))


def accelerating_forces(
    problem: StepProblem, state: State, dt: float
) -> list[tuple[FloatArray, FloatArray]]:
    """Forces that accelerate bodies at a state, with contact's of its last step. Collective.

    Args:
        problem: Equations of the run.
        state: The state; its own accelerations play no part.
        dt: First step [s]; in which prescribed coordinates are asked for their motion.

    Returns:
        Of each body the forces [N], less the inertia of its prescribed coordinates, and
        accelerations [m/s^2], zero except at prescribed coordinates.
    """
    still = tuple(np.zeros_like(v) for v in state.v)
    ramp = problem.integrator.ramp(state.time)
    both = enumerate(zip(state.u, state.v, strict=True))
    moments = [
        EvaluationPoint(u, state.time, ramp, 0.0, v, state.inner_of(k)) for k, (u, v) in both
    ]
    problem.begin(replace(state, a=still), dt, moments=moments)
    problem.guess(flight=False, forces=True, carried=True)
    contact = [terms.coupling / problem.factor for terms in problem.evaluate(problem.x).bodies]
    gravity, batches = ramp * problem.system.gravity, problem.batches
    each = zip(batches.bodies, batches.join(state.u), strict=True)
    pushes = batches.split([body.external(u, gravity) - body.internal(u) for body, u in each])
    out = []
    for body, u, push, force in zip(problem.system.bodies, state.u, pushes, contact, strict=True):
        right = push - force
        a = np.zeros_like(u)
        a[body.fixed] = rates_at_start(body, state.time, dt).acceleration
        right -= body.inertia(a)
        right[body.fixed] = 0.0
        out.append((right, a))
    return out


def projection(problem: StepProblem, state: State, dt: float) -> tuple[FloatArray, ...]:
    """The nearest velocities, in the kinetic energy, that fit the constraints. Collective."""
    none = [np.zeros_like(v) for v in state.v]
    change, _ = _solve(problem, state, none, 0, dt)
    return tuple(v + dv for v, dv in zip(state.v, change, strict=True))


def _drives(joint: Any) -> bool:
    """Whether a joint prescribes a motion in time."""
    return bool(getattr(joint, "driven", False))


def fitted(problem: StepProblem, state: State) -> Fitted | None:
    """The end of a step with the velocities of its drives. Collective.

    Returns:
        None where no drive is missed.
    """
    back, system = -problem.dt, problem.system
    if not any(map(_drives, system.joints)) or not violation(
        problem, state, back, rates=True, part=_MISSED, driven=True
    ):
        return None
    none = [np.zeros_like(v) for v in state.v]
    change, pulls = _solve(problem, state, none, 0, back)
    local = 0.0
    for body, v, dv in zip(system.bodies, state.v, change, strict=True):
        local += float(body.inertia(dv) @ (v + 0.5 * dv))
    work = float(system.comm.allreduce(local))
    state = replace(state, v=tuple(v + dv for v, dv in zip(state.v, change, strict=True)))
    if state.a:
        more, _ = _solve(problem, state, none, 1, back)
        state = replace(state, a=tuple(a + da for a, da in zip(state.a, more, strict=True)))
    return Fitted(state, work, resultants.of_joints(problem, pulls, state.u))


def mobility(
    problem: StepProblem, state: State, force: Sequence[FloatArray], dt: float
) -> float:
    """One over the mass that a unit force along a coordinate moves [1/kg]. Collective.

    Args:
        problem: Equations of the first step, after `begin`.
        state: At the start.
        force: Gradient of the coordinate by each body's coordinates, (num_owned,) each.
        dt: First step [s].
    """
    none = [np.zeros_like(v) for v in state.v]
    still = replace(state, v=tuple(none))
    held = []
    for body, f in zip(problem.system.bodies, force, strict=True):
        held.append(f.copy())
        held[-1][body.fixed] = 0.0
    # What joints prescribe moves bodies without the force, too.
    with_, without = (_solve(problem, still, forces, 0, dt)[0] for forces in (held, none))
    local = sum(float(f @ (a - b)) for f, a, b in zip(held, with_, without, strict=True))
    return float(problem.system.comm.allreduce(local))


def _constraints(
    problem: StepProblem, state: State, dt: float
) -> list[tuple[Any, tuple[int, ...], Kinematics]]:
    """Elements of joints with constraints that a start has to fit, and their bodies' numbers."""
    return [
        (batch, bodies, found)
        for c, _ in problem.couplings.joints
        for batch, bodies, found in zip(
            c.elements, c.bodies, c.kinematics(state, dt), strict=True
        )
        if found is not None
    ]


def _solve(
    problem: StepProblem, state: State, forces: Sequence[FloatArray], order: int, dt: float
) -> tuple[tuple[FloatArray, ...], dict[int, PointPart]]:
    """M x + G^T lambda = forces, G x = - the rate (0) or the second derivative (1).

    Returns:
        x of each body, and G^T lambda by the id of the elements.
    """
    batches = problem.batches
    chosen, pushes = _constraints(problem, state, dt), batches.join(forces)
    if not chosen:
        both = zip(batches.bodies, pushes, strict=True)
        return batches.split([solve_mass(body, push) for body, push in both]), {}
    each = zip(batches.bodies, batches.join(state.u), strict=True)
    masses = [body.tangent(u, 1.0, 0.0) for body, u in each]
    elements, of = [batch for batch, _, _ in chosen], [bodies for _, bodies, _ in chosen]
    laid = Unknowns(batches, range(batches.count), elements, of)
    tangents = [_symmetric(found) for _, _, found in chosen]
    matrix = StepMatrix(laid.layout, masses, laid.blocks)
    matrix.assemble(tangents)
    saddle = Saddle(matrix.operator)
    unknown, held = np.zeros(laid.layout.num_owned), laid.of_elements("constraints")
    right, total = np.zeros_like(unknown), batches.split([np.zeros_like(push) for push in pushes])
    laid.write(pushes, right)
    # Each time less is left of what the matrix lends to constraints, see `SHIFT`.
    for _ in range(_TIMES):
        known = state.a if order else state.v
        changed = tuple(x + dx for x, dx in zip(known, total, strict=True))
        now = replace(state, a=changed) if order else replace(state, v=changed)
        rows = [found.rows[1 + order] for _, _, found in _constraints(problem, now, dt)]
        right[held] = -laid.own_rows("constraints", elements, rows)
        unknown = unknown + saddle.solve(right)
        unknown[laid.held] = 0.0
        total = batches.split(laid.read(unknown, pushes))
        right[:] = 0.0
    multipliers = laid.own_values(unknown, elements)
    saddle.destroy()
    matrix.destroy()
    laid.destroy()
    pulls = {}
    for batch, tangent, values in zip(elements, tangents, multipliers, strict=True):
        own = values["constraints"]
        width = own.shape[1]
        force = np.einsum("nma,nm->na", tangent[:, -width:, :-width], own)
        pulls[id(batch)] = PointPart(force, tangent)
    return total, pulls


def _symmetric(found: Kinematics) -> FloatArray:
    """Tangent of elements whose forces act at the state, as their constraints do."""
    tangent, width = found.tangent.copy(), found.rows.shape[2]
    tangent[:, :-width, -width:] = tangent[:, -width:, :-width].transpose(0, 2, 1)
    return tangent
