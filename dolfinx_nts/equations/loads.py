"""When a step takes the loads on the bodies, and what they are worth at its ends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import Evaluation, EvaluationPoint, free
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray


class Loads:
    """Loads on the bodies in a step; `begin` fixes the step and tells the bodies.

    Attributes:
        moments: Where the forces on each body are taken.
        gravity: What acts of it in the step [m/s^2], shape (3,).
    """

    def __init__(self, system: System, integrator: Integrator) -> None:
        self._system, self._integrator = system, integrator
        self.moments: list[EvaluationPoint] = []
        self.gravity: FloatArray = system.gravity

    def begin(self, state: State, dt: float, moments: Sequence[EvaluationPoint] | None) -> None:
        """Fix the step.

        Args:
            state: State at t_n.
            dt: Step [s].
            moments: Where the forces on each body are taken; None: as the integrator's step has it.
        """
        rule, batches = self._integrator, self._system.batches
        self._state, self._dt = state, dt
        when = state.time + rule.theta * dt
        self.moments = list(self._moments(when) if moments is None else moments)
        u0 = batches.join([moment.u0 for moment in self.moments])
        for body, (k, *_), place in zip(batches.bodies, batches.numbers, u0, strict=True):
            body.begin_step(rule, self.moments[k]._replace(u0=place))
        self.gravity = rule.ramp(when) * self._system.gravity

    def tell(self, k: int) -> None:
        """Begin the step of a body that is a member of a batch, to be asked alone. Collective."""
        self._system.bodies[k].begin_step(self._integrator, self.moments[k])

    def _moments(self, when: float) -> list[EvaluationPoint]:
        """What bodies are told of a step whose loads act at a time [s]."""
        rule, state, dt, batches = self._integrator, self._state, self._dt, self._system.batches
        drifts: Sequence[FloatArray | None] = [None] * len(state.u)
        if rule.accelerations:
            found = []
            for v0, a0 in zip(*batches.rates(state), strict=True):
                end, _ = rule.advance(np.zeros_like(v0), v0, a0, dt)
                found.append((1.0 - rule.theta) * v0 + rule.theta * end)
            drifts = batches.split(found)
        # Load steps of equilibrium end with some of no length.
        rate, ramp = rule.theta * rule.rate(dt) if rule.inertia else 0.0, rule.ramp(when)
        both = enumerate(zip(state.u, drifts, strict=True))
        return [
            EvaluationPoint(u, when, ramp, rate, drift, state.inner_of(k))
            for k, (u, drift) in both
        ]

    def work_at_ends(self, e: Evaluation) -> float:
        """What work of loads at both ends adds on this rank, times `factor`. Collective.

        v_0 + v_1 = 2 (u_1 - u_0)/h makes the mean of the forces at both ends do the work in the
        methods that carry accelerations, not those where the step takes them. Loads that are
        functions of time differ; of others, and of other methods, it is 0. What loads push at
        prescribed coordinates goes into the supports: their reactions hold it.
        """
        rule, state, dt = self._integrator, self._state, self._dt
        work, batches = 0.0, self._system.batches
        factor, ends = rule.factor(dt), (state.time, state.time + dt)
        for body, (k, *_), terms in zip(batches.bodies, batches.numbers, e.terms, strict=True):
            # Loads that do not change have the same mean, and users' functions are not asked.
            if not (rule.accelerations and body.loads_in_time):
                continue
            mean = np.zeros_like(terms.du)
            for time in ends:
                body.begin_step(rule, self.moments[k]._replace(time=time))
                mean += 0.5 * factor * body.external(terms.u1, self.gravity)
            body.begin_step(rule, self.moments[k])
            here = factor * body.external(terms.u1, self.gravity)
            work += float(free(body, mean - here) @ terms.du)
        return work

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
