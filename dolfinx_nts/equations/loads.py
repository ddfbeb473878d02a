"""When a step takes the loads on the bodies, and what they are worth at its ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.interaction.evaluation import Evaluation, Moment, free
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.system import System

FloatArray = npt.NDArray[np.float64]


class Loads:
    """Loads on the bodies in a step; `begin` fixes the step and tells the bodies.

    Args:
        system: The scene.
        integrator: Rules of the step.

    Attributes:
        moments: Where the forces on each body are taken.
        gravity: What acts of it in the step [m/s^2], shape (3,).
    """

    def __init__(self, system: System, integrator: Any) -> None:
        self._system, self._integrator = system, integrator
        self.moments: list[Moment] = []
        self.gravity: FloatArray = system.gravity

    def begin(self, state: State, dt: float, moments: Sequence[Moment] | None) -> None:
        """Fix the step.

        Args:
            state: State at t_n.
            dt: Step [s].
            moments: Where the forces on each body are taken; None: as the integrator's step has it.
        """
        rule, bodies = self._integrator, self._system.bodies
        self._state, self._dt = state, dt
        when = state.time + rule.theta * dt
        if moments is None:
            moments = [self._moment(k, when) for k in range(len(bodies))]
        self.moments = list(moments)
        for body, moment in zip(bodies, moments, strict=True):
            body.begin_step(rule, moment)
        self.gravity = rule.ramp(when) * self._system.gravity

    def _moment(self, k: int, when: float) -> Moment:
        """What a body is told of a step whose loads act at a time [s]."""
        rule, state, dt, drift = self._integrator, self._state, self._dt, None
        if rule.accelerations:
            v0 = state.v[k]
            end, _ = rule.advance(np.zeros_like(v0), v0, state.acceleration(k), dt)
            drift = (1.0 - rule.theta) * v0 + rule.theta * end
        # Load steps of equilibrium end with some of no length.
        rate = rule.theta * rule.rate(dt) if rule.inertia else 0.0
        return Moment(state.u[k], when, rule.ramp(when), rate, drift)

    def work_at_ends(self, e: Evaluation) -> list[float]:
        """What work of loads at both ends adds on this rank, by body, times `factor`. Collective.

        v_0 + v_1 = 2 (u_1 - u_0)/h makes the mean of the forces at both ends do the work in the
        methods that carry accelerations, not those where the step takes them. Loads that are
        functions of time differ; of others, and of other methods, it is 0. What loads push at
        prescribed coordinates goes into the supports: their reactions hold it.

        Args:
            e: Solution of the step.
        """
        rule, state, dt = self._integrator, self._state, self._dt
        works = [0.0] * len(e.bodies)
        if not rule.accelerations:
            return works
        factor, ends = rule.factor(dt), (state.time, state.time + dt)
        for k, (body, terms) in enumerate(zip(self._system.bodies, e.bodies, strict=True)):
            # Loads that do not change have the same mean, and users' functions are not asked.
            if not body.loads_in_time:
                continue
            mean = np.zeros_like(terms.du)
            for time in ends:
                body.begin_step(rule, self.moments[k]._replace(time=time))
                mean += 0.5 * factor * body.external(terms.u1, self.gravity)
            body.begin_step(rule, self.moments[k])
            here = factor * body.external(terms.u1, self.gravity)
            works[k] = float(free(body, mean - here) @ terms.du)
        return works

    def largest(self) -> float:
        """Largest load but gravity on a coordinate, all of its ramp [N]. Collective."""
        largest, none = 0.0, np.zeros(3)
        for body, moment in zip(self._system.bodies, self.moments, strict=True):
            body.begin_step(self._integrator, moment._replace(ramp=1.0))
            load = np.abs(body.external(np.zeros(body.num_owned), none))
            largest = max(largest, float(load.max(initial=0.0)))
            body.begin_step(self._integrator, moment)
        return float(global_max(self._system.comm, np.array([largest]))[0])

    def grow(self) -> bool:
        """Whether constant loads push what is free, which grow with pseudo time. Collective."""
        found, gravity = False, self._system.gravity
        for body, moment in zip(self._system.bodies, self.moments, strict=True):
            loads = []
            for part in (0.0, 1.0):
                body.begin_step(self._integrator, moment._replace(ramp=part))
                loads.append(body.external(moment.u0, part * gravity).copy())
            body.begin_step(self._integrator, moment)
            found = found or bool(free(body, loads[1] - loads[0]).any())
        return bool(global_max(self._system.comm, np.array([float(found)]))[0])
