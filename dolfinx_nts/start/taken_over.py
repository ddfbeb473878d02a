"""The state in which a run begins that goes on from another system's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.interaction.coupling import Joint
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

#: Part of a body's coordinates by which a start may differ from prescribed displacements.
_ON_SUPPORT = 1e-9


def is_like(one: Joint, other: Joint) -> bool:
    """Return whether two joints are of one kind and name and join bodies of the same names.

    What the one remembers at the end of a run then fits the other.
    """
    names = [[body.name for body in joint.bodies] for joint in (one, other)]
    return type(one) is type(other) and one.name == other.name and names[0] == names[1]


def state_from(
    system: System, other: System, state: State, *, moving: bool, time: float | None = None
) -> State:
    """State of a system at the displacements of another one's state. Collective.

    Bodies and joints correspond by name.

    Args:
        system: The scene.
        other: System with bodies of the same names on the same meshes.
        state: Its state.
        moving: Whether bodies move on as there; else with their initial velocities.
        time: Of the result [s], if not that of the state.

    Raises:
        ValueError: A body has no counterpart, stands off its prescribed displacement, or lies
            in a master or around an obstacle, or an obstacle would jump.
    """
    time = state.time if time is None else time
    index = {b.name: k for k, b in enumerate(other.bodies)}
    missing = [b.name for b in system.bodies if b.name not in index]
    if missing:
        raise ValueError(
            f"start: has bodies {list(index)}, not {missing}; give both scenes the same bodies "
            "by the same names (what comes in later waits in the first, too, e.g. held by bcs)"
        )
    u = tuple(state.u[index[b.name]].copy() for b in system.bodies)
    for body, now in zip(system.bodies, u, strict=True):
        old = other.bodies[index[body.name]]
        _check_start(body, old, now, time)
    found = system.initial_state()
    contacts, edges = list(found.contacts), list(found.edges)
    for k, pair in enumerate(system.pairs):
        for j, known in enumerate(other.pairs):
            if pair.is_like(known):
                contacts[k] = state.contacts[j]
                edges[k : k + 1] = state.edges[j : j + 1]
                _check_jump(pair, known, state.time, time)
    joints = list(found.joints)
    for k, joint in enumerate(system.joints):
        for known, history in zip(other.joints, state.joints, strict=True):
            if is_like(joint, known):
                joints[k] = history
    start = replace(
        found, time=time, u=u, contacts=tuple(contacts), joints=tuple(joints), edges=tuple(edges)
    )
    start = replace(start, inner=system.inner_of(lambda k: system.bodies[k].inner_at_rest(u[k])))
    if moving:
        start = replace(start, inner=_moving(system, other, state, start))
        v = tuple(state.v[index[b.name]].copy() for b in system.bodies)
        a = tuple(state.a[index[b.name]].copy() for b in system.bodies) if state.a else ()
        start = replace(start, v=v, a=a)
    if not moving:
        system.check_apart(start)
    return start


def _moving(system: System, other: System, state: State, start: State) -> tuple[FloatArray, ...]:
    """`State.inner` of bodies that move on as they were, where they are of one kind. Collective."""
    known = {b.name: k for k, b in enumerate(other.bodies) if b.has_inner}
    names = [body.name for body in system.bodies]
    return system.inner_of(
        lambda k: state.inner[known[names[k]]] if names[k] in known else start.inner[k]
    )


def _check_start(body: Body, old: Body, u: FloatArray, time: float) -> None:
    """Raise on every rank unless u fits the body's mesh and conditions."""
    problem, there = None, body.prescribed(time)
    if not np.array_equal(body.reference, old.reference):
        other = "mesh there; use the same mesh object" if body.mesh is not None else (
            "reference there; give it the mass, centre, inertia and axes that it has there"
        )
        problem = f"start: body {body.name!r} has another {other}"
    else:
        off = np.abs(there - u[body.fixed]).max(initial=0.0)
        if off > _ON_SUPPORT * np.abs(body.reference).max(initial=0.0):
            problem = (
                f"start: the prescribed values of body {body.name!r} at t={time:.6g} are "
                f"off its displacement by {off:.3g}; let them go on from there"
            )
    raise_together(body.comm, problem)


def _check_jump(pair: ContactPair, old: ContactPair, end: float, begin: float) -> None:
    """Raise if what a pair presses on stands elsewhere than where the other run left it.

    Args:
        pair: Of this system.
        old: Its counterpart there.
        end: Time at which the other run ended [s].
        begin: Time at which this one begins [s].
    """
    left, found = old.path(end, end)[0], pair.path(begin, begin)[0]
    off = np.abs(found - left).max()
    size = max(np.abs(a).max() for a in (left, found, pair.slave.reference))
    if off > _ON_SUPPORT * size:
        raise ValueError(
            f"start: the motion of obstacle {pair.master.name!r} at t={begin:.6g} is "
            f"off its displacement at the end of what it starts from by {off:.3g}; let it go "
            "on from there, e.g. by leaving start_time out"
        )
