"""Prescribed coordinates in a step: their rates, and the work that moves them (theory section 21).

A rule such as v_1 = 2 (u_1 - u_0)/h - v_0 is for coordinates that forces move: of a support that
stops it would make velocities that alternate for ever. Prescribed ones have those of their function
of time, told by its values within the step alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.interaction.evaluation import BodyTerms
from dolfinx_nts.interaction.prescribed import times, told
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

#: Part of its motion in a step by which what is prescribed may be off the state at t_n, as by
#: rounding of the time; more is a jump.
_JUMP = 0.1


class Rates(NamedTuple):
    """Velocity [m/s] and acceleration [m/s^2] of prescribed coordinates, shape (fixed,) each."""

    velocity: FloatArray
    acceleration: FloatArray


def rates_at_start(body: Body, time: float, dt: float) -> Rates:
    """Rates of what is prescribed at the start of a step. Collective.

    Args:
        body: Whose `prescribed` is asked.
        time: When it starts [s].
        dt: Step [s].
    """
    found = told(_values(body, time, time + dt), -dt)
    return Rates(found.velocity, found.acceleration)


def _values(body: Any, at: float, other: float) -> FloatArray:
    """What is prescribed at `times`, shape (6, fixed). Collective."""
    return np.array([body.prescribed(time) for time in times(at, other)])


class _Ends(NamedTuple):
    """Of a body's prescribed coordinates, shape (fixed,) each.

    Attributes:
        rates: At t_{n+1}.
        flown: Motion [m] from which the integrator's rule would make them.
    """

    rates: Rates
    flown: FloatArray


class StepSupports:
    """Prescribed coordinates of a system in a step; `begin` fixes it.

    Attributes:
        moving: Numbers of the bodies whose prescribed coordinates move, before, in or after it.
    """

    def __init__(self, system: System, integrator: Any) -> None:
        self._system, self._rule = system, integrator
        any_fixed = np.array([float(body.fixed.size) for body in system.bodies])
        held = global_max(system.comm, any_fixed) > 0.0
        self._held = np.flatnonzero(held & integrator.inertia).tolist()
        self.moving: frozenset[int] = frozenset()
        self._ends: dict[int, _Ends] = {}

    def begin(self, state: State, first: Sequence[FloatArray], dt: float) -> None:
        """Fix a step. Collective.

        Args:
            state: State at t_n.
            first: Owned displacements of each body at t_{n+1}, right where they are prescribed [m].
            dt: Step [s].
        """
        self._state, self._dt, self._ends, moves = state, dt, {}, []
        for k in self._held:
            fixed, a0 = self._system.bodies[k].fixed, state.acceleration(k)
            du, v0 = (first[k] - state.u[k])[fixed], state.v[k][fixed]
            a0 = None if a0 is None else a0[fixed]
            rates = self._rates(k, du, v0)
            self._ends[k] = _Ends(rates, self._flown(rates, du, v0, a0))
            parts = (du, v0, *rates, *([] if a0 is None else [a0]))
            moves.append(float(any(part.any() for part in parts)))
        if moves:
            anywhere = global_max(self._system.comm, np.array(moves))
            self.moving = frozenset(k for k, m in zip(self._held, anywhere, strict=True) if m)

    def _rates(self, k: int, du: FloatArray, v0: FloatArray) -> Rates:
        """Rates at t_{n+1} of a body's prescribed coordinates. Collective."""
        body, state, dt = self._system.bodies[k], self._state, self._dt
        mean = du / dt
        held = Rates(mean, (mean - v0) / dt)
        if not body.driven:
            return held
        values = _values(body, state.time + dt, state.time)
        velocity, _, acceleration = told(values, dt, v0)
        off = np.abs(values[-1] - state.u[k][body.fixed])
        jumps = off > _JUMP * np.maximum(np.abs(du), dt * np.abs(velocity))
        both = zip(held, (velocity, acceleration), strict=True)
        return Rates(*(np.where(jumps, *each) for each in both))

    def _flown(
        self, rates: Rates, du: FloatArray, v0: FloatArray, a0: FloatArray | None
    ) -> FloatArray:
        """Motion [m] after which the rule has the rates: it is affine in the motion."""
        none, advance = np.zeros(1), self._rule.advance
        # The acceleration where there is one, else the velocity.
        which = int(self._rule.accelerations)
        slope = (
            advance(np.ones(1), none, none, self._dt)[which]
            - advance(none, none, none, self._dt)[which]
        )
        return du + (rates[which] - advance(du, v0, a0, self._dt)[which]) / slope

    def ahead(self, k: int, ahead: FloatArray, first: FloatArray) -> FloatArray:
        """Motion of a body without forces [m], so that M (du - ahead) has the right rates.

        Args:
            k: Number of the body.
            ahead: By the integrator's rule [m], shape (num_owned,).
            first: Displacement of which the prescribed coordinates are right [m].
        """
        if k not in self.moving:
            return ahead
        out, fixed = ahead.copy(), self._system.bodies[k].fixed
        out[fixed] += first[fixed] - self._state.u[k][fixed] - self._ends[k].flown
        return out

    def advance(
        self, k: int, du: FloatArray, v0: FloatArray, a0: FloatArray | None
    ) -> tuple[FloatArray, FloatArray | None]:
        """Velocity [m/s] and acceleration [m/s^2], if there is one, at t_{n+1}.

        Args:
            k: Number of a body alone, or the first one of a batch.
            du: Its motion in the step [m], shape (num_owned,).
            v0: Its velocity at t_n [m/s].
            a0: Its acceleration then [m/s^2], if there is one.
        """
        v1, a1 = self._rule.advance(du, v0, a0, self._dt)
        if k in self._ends:
            fixed = self._system.bodies[k].fixed
            v1[fixed] = self._ends[k].rates.velocity
            if a1 is not None:
                a1[fixed] = self._ends[k].rates.acceleration
        return v1, a1

    def coast(self, k: int, v0: FloatArray, a0: FloatArray | None) -> FloatArray:
        """Velocity at t_{n+1} but for the forces of the step [m/s]; arguments as of `advance`."""
        rule = self._rule
        ahead = rule.ahead(v0, a0, self._dt)
        velocity, _ = rule.advance(ahead, v0, a0, self._dt)
        if k in self._ends:
            fixed, (rates, flown) = self._system.bodies[k].fixed, self._ends[k]
            velocity[fixed] = rates.velocity - rule.rate(self._dt) * (flown - ahead[fixed])
        return velocity

    def work(self, k: int, terms: BodyTerms, factor: float) -> float:
        """Work of supports on a body on this rank, less that of loads there [J]. Collective.

        sum_a [M (v_1 - v_0)]_a . (v_0 + v_1)_a/2 + f_a . (y_1 - y_0)_a, f but for inertia, and what
        a jump of a velocity that no acceleration makes does to its neighbours through the mass.

        Args:
            k: Its number.
            terms: Of the body in the solved step.
            factor: What its equation multiplies forces by.
        """
        if k not in self.moving:
            return 0.0
        body, v0, fixed = self._system.bodies[k], self._state.v[k], self._system.bodies[k].fixed
        v1, _ = self.advance(k, terms.du, v0, self._state.acceleration(k))
        force = (terms.internal + terms.coupling - terms.external)[fixed] / factor
        impulse = np.zeros_like(v1)
        if self._rule.accelerations:
            flown = terms.du.copy()
            flown[fixed] = self._ends[k].flown
            a0 = self._state.acceleration(k)
            impulse = body.inertia(v1 - self._rule.advance(flown, v0, a0, self._dt)[0])
        impulse[fixed] = body.inertia(v1 - v0)[fixed]
        return float(force @ terms.du[fixed] + 0.5 * impulse @ (v0 + v1))

    def bend(self, k: int, du: FloatArray) -> FloatArray:
        """Angular momentum from (y_1 - y_0) x M (v_0 + v_1)/2 on this rank [kg m^2/s], (3,).

        It is zero where (v_0 + v_1)/2 is the mean velocity. Collective.
        """
        if k not in self.moving:
            return np.zeros(3)
        body, v0 = self._system.bodies[k], self._state.v[k]
        v1, _ = self.advance(k, du, v0, self._state.acceleration(k))
        momentum = body.inertia(0.5 * (v0 + v1))
        return np.cross(du.reshape(-1, 3), momentum.reshape(-1, 3)).sum(axis=0)
