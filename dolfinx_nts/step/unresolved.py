"""Springs and dampers too fast for the steps of a run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.coupling import Slopes
from dolfinx_nts.kinematics import has_constraints
from dolfinx_nts.state import State
from dolfinx_nts.step import consistent
from dolfinx_nts.step.problem import StepProblem

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
        slopes: Of its force.
    """

    limit: float
    joint: Any
    gradient: list[FloatArray]
    slopes: Slopes


def tell_unresolved(problem: StepProblem, state: State, dt: float) -> tuple[float, str] | None:
    """The spring or damper that is too fast by most for a step, if there is any. Collective.

    It is judged alone, by its `slopes` at the start and by the mass that it moves along its
    coordinate in bodies and joints. On flexible bodies, also behind joints, none is: the mass that
    moves depends on how fast it moves.

    Args:
        problem: Equations of the run.
        state: At the start.
        dt: First step [s].

    Returns:
        How many times it is too fast, and a sentence with a remedy.
    """
    each = zip(problem.system.joints, problem.system.joint_bodies, state.joints, strict=True)
    slopes = [joint.slopes([state.u[k] for k in of], history) for joint, of, history in each]
    if not any(slopes):
        return None
    still = tuple(np.zeros_like(v) for v in state.v)
    problem.begin(replace(state, a=state.a or still), dt)
    worst, text = 1.0, ""
    for fast in sorted(_suspects(problem, slopes, dt), key=lambda f: f.limit, reverse=True):
        # Joints hold bodies, so that the mass is at least that of the limit.
        if fast.limit <= worst:
            break
        mobility = consistent.mobility(problem, state, fast.gradient, dt)
        size = max(_sizes(fast.slopes, mobility, dt))
        if size > worst:
            worst, text = size, _sentence(fast, mobility, dt, dt / size)
    return (worst, text) if text else None


def _suspects(
    problem: StepProblem, of_joints: Iterable[Slopes | None], dt: float
) -> list[_Fast]:
    """Springs and dampers that would be too fast if no constraint held the bodies. Collective."""
    found, system = [], problem.system
    for joint, bodies, slopes in zip(
        system.joints, system.joint_bodies, of_joints, strict=True
    ):
        if slopes is None or not all(system.bodies[k].rigid for k in _joined(problem, bodies)):
            continue
        gradient = [np.zeros(body.num_owned) for body in system.bodies]
        mobility = 0.0
        for k, g in zip(bodies, slopes.gradients, strict=True):
            gradient[k] = g
            free = np.flatnonzero(g)
            with np.errstate(divide="ignore"):
                mobility += float((g[free] ** 2 / system.bodies[k].nodal_mass[free]).sum())
        limit = max(_sizes(slopes, system.comm.allreduce(mobility), dt))
        found.append(_Fast(limit, joint, gradient, slopes))
    return found


def _joined(problem: StepProblem, bodies: Iterable[int]) -> set[int]:
    """Bodies that constraints of joints hold to some bodies, with these; after `begin`."""
    held = [
        set(of)
        for coupling in problem.couplings.joints
        for batch, of in zip(coupling.elements, coupling.bodies, strict=True)
        if has_constraints(batch)
    ]
    reached, more = set(bodies), set(bodies)
    while more:
        more = set().union(*(of for of in held if of & reached)) - reached
        reached |= more
    return reached


def _sizes(slopes: Slopes, mobility: float, dt: float) -> tuple[float, float]:
    """How many times a spring and a damper are too fast for a step."""
    stiffness, damping = slopes.stiffness, slopes.damping
    # A mobility without mass is infinite, and nothing times that no number.
    phase = float(np.sqrt(stiffness * mobility)) * dt if stiffness > 0.0 else 0.0
    decay = damping * mobility * dt if damping > 0.0 else 0.0
    return phase / _PHASE, decay / _DECAY


def _sentence(fast: _Fast, mobility: float, dt: float, most: float) -> str:
    _, stiffness, damping, about = fast.slopes
    mass = f"{1.0 / mobility:.3g} kg{' m^2' if about else ''}"
    phase, decay = _sizes(fast.slopes, mobility, dt)
    if decay > phase:
        unit = "N m s" if about else "N s/m"
        return (
            f"damper {fast.joint.name!r} of {damping:.3g} {unit} on {mass} is not resolved, "
            f"c h/m = {_DECAY * decay:.3g}: the velocity changes its sign in each step where it "
            f"should be gone; use a dt below {most:.2g} s"
        )
    unit = "N m" if about else "N/m"
    return (
        f"spring {fast.joint.name!r} of {stiffness:.3g} {unit} on {mass} is not resolved, "
        f"omega h = {_PHASE * phase:.3g}: where it vibrates, it does so too slowly, though energy "
        f"may be kept; use a dt below {most:.2g} s if that matters"
    )
