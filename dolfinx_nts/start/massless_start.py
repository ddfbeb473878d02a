"""Checks of runs with massless slave nodes: integrator, balance at the start (theory 16)."""

from __future__ import annotations

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.parallel import anywhere, global_max
from dolfinx_nts.start.consistent import accelerating_forces
from dolfinx_nts.state import State
from dolfinx_nts.system import System

#: Force on massless nodes over the body's internal forces that counts as balanced.
_BALANCED = 1e-2
#: Rounding of a force over stiffness times the size of a body.
_ROUNDED = 1e3 * float(np.finfo(float).eps)
#: Time of a shear wave through the massless layer over that of a pressure wave through the body,
#: above which rebounds with friction, of nodes with and without mass, part: by 3 to 5 % of the
#: speed at 0.23 to 0.36, by 10 to 16 % at 0.41 to 0.47, by 30 to 44 % above (docs/impacts.md).
_SLOW = 0.4


def check_massless(system: System, integrator: Integrator, impact: str) -> None:
    """Raise a ValueError on every rank where massless nodes make no sense. Collective."""
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

    Returns:
        Force [N], and the text: empty where what is missing is small beside the internal forces.
    """
    bodies = problem.system.bodies
    worst, text = 0.0, ""
    chosen = [body.has_massless for body in bodies]
    both = zip(bodies, state.u, chosen, strict=True)
    moved = any(some and bool(u.any()) for _, u, some in both)
    if not anywhere(problem.system.comm, moved):
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
                "equilibrium(...), which leaves no more than their weight, or without displacement"
            )
    return worst, text


def thick_layer(system: System) -> tuple[float, str]:
    """The massless layer with friction that is too thick by most for an impact. Collective.

    Returns:
        Time of a shear wave through it over that of a pressure wave through the body, and a
        warning: empty where all are thin enough.
    """
    worst, text = _SLOW, ""
    pairs = [p for p in system.contacts if p.friction and p.slave.body.has_massless]
    for body, name in {p.slave.body: p.name for p in pairs}.items():
        thickness, speeds = body.waves_in_layer()
        if thickness * speeds > worst:
            worst = thickness * speeds
            text = (
                f"{body.name!r} is {1.0 / thickness:.2g} cells thick behind contact {name!r}, "
                "whose nodes have no mass; friction in an impact needs about "
                f"{speeds / _SLOW:.2g}, as its pressure waves are {speeds:.2g} times as fast as "
                "its shear waves. The rebound turns too little, and too much with "
                "mass='consistent': use thinner cells there, or compare both"
            )
    return worst, text
