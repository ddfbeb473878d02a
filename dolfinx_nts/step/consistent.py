"""Velocities and accelerations that fit the constraints at a start (theory section 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.evaluation import Moment
from dolfinx_nts.kinematics import Kinematics
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.step.assembly import StepMatrix
from dolfinx_nts.step.mass_solves import Saddle, solve_mass
from dolfinx_nts.step.problem import StepProblem
from dolfinx_nts.step.supports import rates_at
from dolfinx_nts.step.unknowns import Unknowns

FloatArray = npt.NDArray[np.float64]

#: Linear solves of a start; what prescribed values change in the first step slows them down.
_TIMES = 8


def violation(
    problem: StepProblem, state: State, dt: float, *, rates: bool, part: float = 0.0
) -> tuple[float, str] | None:
    """The worst violation of a constraint at a start, and its joint's name. Collective.

    Args:
        problem: Equations of the first step, after `begin`.
        state: At the start.
        dt: First step [s].
        rates: That of velocities; else of positions.
        part: Of the speed of a joint's bodies that it may be, beside its rounding.

    Returns:
        [m/s] or [m], or None where all constraints hold.
    """
    worst, name, system = 0.0, "", problem.system
    every = zip(system.joints, system.joint_bodies, problem.couplings.joints, strict=True)
    for joint, of, coupling in every:
        speed = max(float(np.abs(state.v[k]).max(initial=0.0)) for k in of)
        for found in filter(None, coupling.kinematics(state, dt)):
            local = np.array([found.size[int(rates)], found.limit[int(rates)], speed])
            off, limit, speed = global_max(system.comm, local).tolist()
            if off > max(limit, part * speed) and off > worst:
                worst, name = off, joint.name
    return (worst, name) if name else None


def accelerations(problem: StepProblem, state: State, dt: float) -> tuple[FloatArray, ...]:
    """M a + G^T lambda = f with the second derivative of the constraints zero [m/s^2]. Collective.

    Args:
        problem: Equations of the run.
        state: At the start; its own accelerations play no part.
        dt: First step [s]; in which prescribed coordinates are asked for their motion.
    """
    forces, held = zip(*accelerating_forces(problem, state, dt), strict=True)
    solved = _solve(problem, replace(state, a=held), forces, 1, dt)
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
    moments = [Moment(u, state.time, ramp, 0.0, v) for u, v in zip(state.u, state.v, strict=True)]
    problem.begin(replace(state, a=still), dt, moments=moments)
    problem.guess(flight=False, forces=True, carried=True)
    contact = [terms.coupling / problem.factor for terms in problem.evaluate(problem.x).bodies]
    gravity = ramp * problem.system.gravity
    out = []
    for body, u, force in zip(problem.system.bodies, state.u, contact, strict=True):
        right = body.external(u, gravity) - body.internal(u) - force
        a = np.zeros_like(u)
        a[body.fixed] = rates_at(body, state.time, -dt).acceleration
        right -= body.inertia(a)
        right[body.fixed] = 0.0
        out.append((right, a))
    return out


def projection(problem: StepProblem, state: State, dt: float) -> tuple[FloatArray, ...]:
    """The nearest velocities, in the kinetic energy, that fit the constraints. Collective."""
    none = [np.zeros_like(v) for v in state.v]
    change = _solve(problem, state, none, 0, dt)
    return tuple(v + dv for v, dv in zip(state.v, change, strict=True))


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
    with_, without = (_solve(problem, still, forces, 0, dt) for forces in (held, none))
    local = sum(float(f @ (a - b)) for f, a, b in zip(held, with_, without, strict=True))
    return float(problem.system.comm.allreduce(local))


def _constraints(
    problem: StepProblem, state: State, dt: float
) -> list[tuple[Any, tuple[int, ...], Kinematics]]:
    """Elements of joints with constraints that a start has to fit, and their bodies' numbers."""
    return [
        (batch, bodies, found)
        for c in problem.couplings.joints
        for batch, bodies, found in zip(
            c.elements, c.bodies, c.kinematics(state, dt), strict=True
        )
        if found is not None
    ]


def _solve(
    problem: StepProblem, state: State, forces: Sequence[FloatArray], order: int, dt: float
) -> tuple[FloatArray, ...]:
    """M x + G^T lambda = forces, G x = - the rate (0) or the second derivative (1)."""
    system = problem.system
    chosen = _constraints(problem, state, dt)
    if not chosen:
        return tuple(solve_mass(b, f) for b, f in zip(system.bodies, forces, strict=True))
    masses = [b.tangent(u, 1.0, 0.0) for b, u in zip(system.bodies, state.u, strict=True)]
    elements, of = [batch for batch, _, _ in chosen], [bodies for _, bodies, _ in chosen]
    laid = Unknowns(system.comm, {k: len(u) for k, u in enumerate(state.u)}, elements, of)
    tangents = [found.tangent for _, _, found in chosen]
    matrix = StepMatrix(laid.layout, masses, laid.blocks)
    matrix.assemble(tangents)
    saddle = Saddle(matrix.operator)
    total = [np.zeros_like(force) for force in forces]
    # Each time less is left of what the matrix lends to constraints, see `SHIFT`.
    for _ in range(_TIMES):
        known = state.a if order else state.v
        changed = tuple(x + dx for x, dx in zip(known, total, strict=True))
        now = replace(state, a=changed) if order else replace(state, v=changed)
        right = np.zeros(laid.layout.num_owned)
        for k, force in enumerate(forces):
            right[laid.of_body(k)] = force
        rows = [found.rows[1 + order].ravel() for _, _, found in _constraints(problem, now, dt)]
        right[laid.of_elements("constraints")] = -np.concatenate(rows)
        solution = saddle.solve(right)
        for k, body in enumerate(system.bodies):
            change = solution[laid.of_body(k)].copy()
            change[body.fixed] = 0.0
            total[k] = total[k] + change
        forces = [np.zeros_like(force) for force in forces]
    saddle.destroy()
    matrix.destroy()
    laid.destroy()
    return tuple(total)
