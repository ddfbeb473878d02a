"""Springs, dampers and motors too fast for the steps of a run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.coupling import Moment, Slopes
from dolfinx_nts.interaction.kinematics import has_constraints
from dolfinx_nts.interaction.measured import Measured
from dolfinx_nts.parallel import global_sum
from dolfinx_nts.start import consistent
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray

#: Largest omega h that counts as resolved: its phase comes out short by 7 %.
_PHASE = 1.0
#: Largest c h/m: a velocity that decays faster changes its sign in each step.
_DECAY = 2.0
#: Rates that turn round in each step: the smallest of three over the largest. What is pulled from
#: rest by a stiff damper has every second one near zero, with right places.
_TURNS = 0.1
#: Ways in a step over the size of what moves that are more than rounding.
_NOISE = 1e-10


class _Fast(NamedTuple):
    """A spring, or a motor that acts as one, that may be too fast.

    Attributes:
        limit: Largest of what it can be times the step, over what counts as resolved.
        joint: The spring.
        gradient: Of its coordinate, by the owned coordinates of each body of the system.
        slopes: Of its force.
    """

    limit: float
    joint: Any
    gradient: list[FloatArray]
    slopes: Slopes


def tell_unresolved(problem: StepProblem, state: State, dt: float) -> tuple[float, str] | None:
    """The spring or motor that is too fast by most for a step, if there is any. Collective.

    It is judged alone, by its `slopes` at the start and by the mass that it moves along its
    coordinate in bodies and joints. On flexible bodies, also behind joints, none is: the mass that
    moves depends on how fast it moves.

    Returns:
        How many times it is too fast, and a sentence with a remedy.
    """
    slopes = [_slopes(problem, k, state, dt) for k in range(len(problem.system.joints))]
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
        size = _sizes(fast.slopes, mobility, dt)[0]
        if size > worst:
            worst, text = size, _of_spring(fast, mobility, size, dt)
    return (worst, text) if text else None


def _slopes(problem: StepProblem, k: int, state: State, dt: float) -> Slopes | None:
    """Of joint k; None: it holds. Collective."""
    of = problem.system.joint_bodies[k]
    u, v = ([values[b] for b in of] for values in (state.u, state.v))
    return problem.system.joints[k].slopes(u, state.joints[k], Moment(state.time, dt, v))


def _suspects(
    problem: StepProblem, of_joints: Iterable[Slopes | None], dt: float
) -> list[_Fast]:
    """Springs that would be too fast if no constraint held the bodies. Collective."""
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
        limit = _sizes(slopes, system.comm.allreduce(mobility), dt)[0]
        found.append(_Fast(limit, joint, gradient, slopes))
    return found


def _joined(problem: StepProblem, bodies: Iterable[int]) -> set[int]:
    """Bodies that constraints of joints hold to some bodies, with these; after `begin`."""
    held = [
        set(problem.system.joint_bodies[k])
        for coupling, numbers in problem.couplings.joints
        if any(has_constraints(batch) for batch in coupling.elements)
        for k in numbers
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


def _of_spring(fast: _Fast, mobility: float, size: float, dt: float) -> str:
    return (
        f"{fast.joint.name!r} of stiffness {fast.slopes.stiffness:.3g} on "
        f"{_mass(fast.slopes, mobility)} is not resolved, omega h = {_PHASE * size:.3g}: where it "
        "vibrates, it does so too slowly, though energy may be kept; use a dt below "
        f"{dt / size:.2g} if that matters"
    )


def _mass(slopes: Slopes, mobility: float) -> str:
    return f"{'an inertia' if slopes.about else 'a mass'} of {1.0 / mobility:.3g}"


class DamperWatch:
    """Looks for dampers that turn a velocity round in each step, where it should be gone.

    What they hold back from rest, or only slowly drag along, has the right places and forces
    however stiff they are, so that only what happens tells.
    """

    def __init__(self, problem: StepProblem) -> None:
        self._problem = problem
        self._rates: dict[int, list[float]] | None = None

    def look(self, state: State) -> tuple[float, str] | None:
        """Look at a solved step, before the next one begins. Collective.

        Returns:
            As of `tell_unresolved`.
        """
        problem, found = self._problem, None
        if not problem.integrator.inertia:
            return None
        if self._rates is None:
            self._rates = self._begin()
        if not self._rates:
            return None
        ways, sizes = self._motions(state)
        for k, rates in self._rates.items():
            rates[:] = [*rates[-2:], ways[k]]
            if not (_alternate(rates) and max(map(abs, rates)) * problem.dt > _NOISE * sizes[k]):
                continue
            slopes: Any = _slopes(problem, k, state, problem.dt)
            gradient = [np.zeros(body.num_owned) for body in problem.system.bodies]
            for body, g in zip(problem.system.joint_bodies[k], slopes.gradients, strict=True):
                gradient[body] = g
            mobility = consistent.mobility(problem, state, gradient, problem.dt)
            decay = _sizes(slopes, mobility, problem.dt)[1]
            if decay > (found[0] if found else 1.0):
                name = problem.system.joints[k].name
                found = decay, (
                    f"{name!r} of damping {slopes.damping:.3g} on {_mass(slopes, mobility)} is not "
                    f"resolved, c h/m = {_DECAY * decay:.3g}: the velocity changes its sign in "
                    f"each step where it should be gone; use a dt below {problem.dt / decay:.2g}"
                )
        return found

    def _begin(self) -> dict[int, list[float]]:
        """Rates at t_n of the dampers between rigid bodies, by their numbers. Collective."""
        problem, found = self._problem, []
        system, state = problem.system, problem.state
        for k, of in enumerate(system.joint_bodies):
            slopes = _slopes(problem, k, state, problem.dt)
            if slopes is None or not slopes.damping > 0.0:
                continue
            if all(system.bodies[b].rigid for b in _joined(problem, of)):
                found.append(k)
        self._rates = {k: [] for k in found}
        ways, _ = self._motions(state)
        return {k: [ways[k]] for k in found}

    def _motions(self, state: State) -> list[list[float]]:
        """Rates of dampers' coordinates, and what these may be at most, by joint. Collective."""
        system, watched = self._problem.system, self._rates or {}
        local = np.zeros((2, len(system.joints)))
        for coupling, numbers in self._problem.couplings.joints:
            if watched.keys().isdisjoint(numbers):
                continue
            if isinstance(coupling, Measured):
                local[:, numbers] = coupling.motions(state)
                continue
            for k in sorted(watched.keys() & set(numbers)):
                slopes: Any = _slopes(self._problem, k, state, self._problem.dt)
                for b, g in zip(system.joint_bodies[k], slopes.gradients, strict=True):
                    place = np.abs(system.bodies[b].reference + state.u[b]).max(initial=0.0)
                    local[:, k] += [g @ state.v[b], np.abs(g).sum() * place]
        return global_sum(system.comm, local).tolist()


def _alternate(rates: list[float]) -> bool:
    """Whether three rates in a row have turned round twice, each as large as the others."""
    if len(rates) < 3:
        return False
    a, b, c = rates
    sizes = [abs(r) for r in rates]
    return a * b < 0.0 and b * c < 0.0 and min(sizes) > _TURNS * max(sizes)
