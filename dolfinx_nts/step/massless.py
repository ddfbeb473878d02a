"""Checks of runs with massless slave nodes: integrator, balance at the start (theory 16)."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.step.consistent import accelerating_forces
from dolfinx_nts.step.problem import StepProblem
from dolfinx_nts.system import System

#: Force on massless nodes over the body's internal forces that counts as balanced.
_BALANCED = 1e-2
#: Rounding of a force over stiffness times the size of a body.
_ROUNDED = 1e3 * float(np.finfo(float).eps)


def check_massless(system: System, integrator: Any, impact: str) -> None:
    """Raise a ValueError on every rank where massless nodes make no sense. Collective.

    Args:
        system: The scene.
        integrator: Of the run.
        impact: As of `simulate`.
    """
    with_massless = [b.name for b in system.bodies if b.has_massless]
    if not with_massless:
        return
    what = f"mass='redistributed' of {', '.join(map(repr, with_massless))}"
    if not integrator.inertia:
        raise ValueError(
            f"{what}: equilibrium knows no mass, and contact forces of its load steps are those at "
            "their ends; make a body of the same mesh and name with mass='consistent' for it, and "
            "begin simulate(..., start=...) from there with this one"
        )
    if not integrator.keeps_energy:
        raise ValueError(
            f"{what}: contact forces of a step are the mean of its ends, which {integrator!r} does "
            "not take; choose EnergyMomentum() or Midpoint(), or mass='consistent'"
        )
    if impact != "published":
        raise ValueError(
            f"{what}: impact={impact!r} gives back what the mass of slave nodes loses, and they "
            "have none; leave one of the two out"
        )
    for pair in system.contacts:
        master = pair.bodies[1:] and pair.master
        if master and master.massless.any():
            raise ValueError(
                f"{what}: the master of contact {pair.name!r} has such nodes; only slaves may, so "
                "swap slave and master, or take the nodes out of the redistributed surface"
            )


def off_balance(problem: StepProblem, state: State, dt: float) -> tuple[float, str]:
    """The largest force that massless nodes start under, and a warning for it. Collective.

    A step balances the mean of its ends. A force missing at one end returns with the other sign at
    the next.

    Args:
        problem: Equations of the run.
        state: At the start.
        dt: First step [s].

    Returns:
        Force [N], and the text: empty where what is missing is small beside the internal forces.
    """
    bodies = problem.system.bodies
    worst, text = 0.0, ""
    chosen = [body.has_massless for body in bodies]
    both = zip(bodies, state.u, chosen, strict=True)
    moved = any(some and bool(u.any()) for _, u, some in both)
    if not problem.system.comm.allreduce(moved, op=MPI.LOR):
        return worst, text
    forces = accelerating_forces(problem, state, dt)
    for body, (force, _), u, some in zip(bodies, forces, state.u, chosen, strict=True):
        if not some:
            continue
        off = np.abs(force[body.massless])
        arrays = (off, body.internal(u), body.reference + u)
        sizes = [np.abs(a).max(initial=0.0) for a in arrays]
        sizes.append(body.nodal_stiffness().max(initial=0.0))
        top = global_max(problem.system.comm, np.array(sizes))
        missing, internal, length, stiffness = top.tolist()
        if missing > max(worst, _BALANCED * internal) and internal > _ROUNDED * stiffness * length:
            worst = missing
            text = (
                f"nodes of {body.name!r} without mass start off balance by a force of "
                f"{missing:.3g} and will move to and fro about it in every step; start from "
                "equilibrium(...), or without displacement"
            )
    return worst, text
