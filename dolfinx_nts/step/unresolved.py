"""Springs and dampers too fast for the steps of a run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.joints.forces import AboutAxis, Between
from dolfinx_nts.state import State
from dolfinx_nts.step import consistent
from dolfinx_nts.step.problem import StepProblem
from dolfinx_nts.system import System

FloatArray = npt.NDArray[np.float64]

#: Largest omega h that counts as resolved: its phase comes out short by 7 %.
_PHASE = 1.0
#: Largest c h/m: a velocity that decays faster changes its sign in each step.
_DECAY = 2.0


class _Fast(NamedTuple):
    """A spring or damper that may be too fast.

    Attributes:
        limit: Largest of what it can be times the step, over what counts as resolved.
        joint: The spring or damper.
        gradient: Of its coordinate, by the owned coordinates of each body of the system.
        stiffness: [N/m] or [N m].
        damping: [N s/m] or [N m s].
    """

    limit: float
    joint: Between
    gradient: list[FloatArray]
    stiffness: float
    damping: float


def tell_unresolved(problem: StepProblem, state: State, dt: float) -> tuple[float, str] | None:
    """The spring or damper that is too fast by most for a step, if there is any. Collective.

    It is judged alone, by its stiffness at the start and by the mass that it moves along its
    coordinate in bodies and joints. On flexible bodies, also behind joints, none is: the mass that
    moves depends on how fast it moves.

    Args:
        problem: Equations of the run.
        state: At the start.
        dt: First step [s].

    Returns:
        How many times it is too fast, and a sentence with a remedy.
    """
    worst, text = 1.0, ""
    begun = False
    for fast in sorted(_suspects(problem.system, state, dt), key=lambda f: f.limit, reverse=True):
        # Joints hold bodies, so that the mass is at least that of the limit.
        if fast.limit <= worst:
            break
        if not begun:
            still = tuple(np.zeros_like(v) for v in state.v)
            problem.begin(replace(state, a=state.a or still), dt)
            begun = True
        mobility = consistent.mobility(problem, state, fast.gradient, dt)
        size = _size(fast.stiffness, fast.damping, mobility, dt)
        if size > worst:
            worst, text = size, _sentence(fast, mobility, dt, dt / size)
    return (worst, text) if text else None


def _suspects(system: System, state: State, dt: float) -> list[_Fast]:
    """Springs and dampers that would be too fast if no constraint held the bodies. Collective."""
    found = []
    joints = zip(system.joints, system.joint_bodies, state.histories[1:], strict=True)
    for joint, bodies, history in joints:
        if not isinstance(joint, Between):
            continue
        if not all(system.bodies[k].rigid for k in _joined(system, bodies)):
            continue
        of_bodies, stiffness, damping = joint.slopes([state.u[k] for k in bodies], history)
        gradient = [np.zeros_like(u) for u in state.u]
        mobility = 0.0
        for k, g in zip(bodies, of_bodies, strict=True):
            gradient[k] = g
            free = np.flatnonzero(g)
            with np.errstate(divide="ignore"):
                mobility += float((g[free] ** 2 / system.bodies[k].nodal_mass[free]).sum())
        limit = _size(stiffness, damping, system.comm.allreduce(mobility), dt)
        found.append(_Fast(limit, joint, gradient, stiffness, damping))
    return found


def _joined(system: System, bodies: Iterable[int]) -> set[int]:
    """Bodies that joints other than springs and dampers hold to some bodies, with these."""
    both = zip(system.joints, system.joint_bodies, strict=True)
    held = [set(of) for joint, of in both if not isinstance(joint, Between)]
    reached, more = set(bodies), set(bodies)
    while more:
        more = set().union(*(of for of in held if of & reached)) - reached
        reached |= more
    return reached


def _size(stiffness: float, damping: float, mobility: float, dt: float) -> float:
    """How many times a spring or damper is too fast for a step."""
    # A mobility without mass is infinite, and nothing times that no number.
    phase = float(np.sqrt(stiffness * mobility)) * dt if stiffness > 0.0 else 0.0
    decay = damping * mobility * dt if damping > 0.0 else 0.0
    return max(phase / _PHASE, decay / _DECAY)


def _sentence(fast: _Fast, mobility: float, dt: float, most: float) -> str:
    about = isinstance(fast.joint, AboutAxis)
    mass = f"{1.0 / mobility:.3g} kg{' m^2' if about else ''}"
    if fast.damping:
        unit = "N m s" if about else "N s/m"
        return (
            f"damper {fast.joint.name!r} of {fast.damping:.3g} {unit} on {mass} is not resolved, "
            f"c h/m = {fast.damping * mobility * dt:.3g}: the velocity changes its sign in each "
            f"step where it should be gone; use a dt below {most:.2g} s"
        )
    unit = "N m" if about else "N/m"
    phase = float(np.sqrt(fast.stiffness * mobility)) * dt
    return (
        f"spring {fast.joint.name!r} of {fast.stiffness:.3g} {unit} on {mass} is not resolved, "
        f"omega h = {phase:.3g}: where it vibrates, it does so too slowly, though energy may be "
        f"kept; use a dt below {most:.2g} s if that matters"
    )
