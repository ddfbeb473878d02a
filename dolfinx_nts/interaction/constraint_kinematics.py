"""How constraints of joints change in time, in closed form but for what is prescribed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dolfinx_nts.interaction.constraint_elements import ConstraintElements, Equations
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.kinematics import OFF, ROUNDED, Kinematics
from dolfinx_nts.interaction.prescribed import times, told
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray


@dataclass(frozen=True, eq=False)
class Moving:
    """Constraints wherever their bodies are.

    Attributes:
        rest: Reference values of their nodes [m], shape (n, k, 3).
        nodal: Values there from those of each body of the system. Collective.
        at: Equations that hold at some times, and c at each of them. Collective.
        by_joint: Largest of values >= 0 of elements (n, ...), of each joint.
        step: The last one that began; None before.
    """

    rest: FloatArray
    nodal: Callable[[Sequence[FloatArray]], FloatArray]
    at: Callable[..., tuple[Equations, FloatArray]]
    by_joint: Callable[[FloatArray], FloatArray]
    step: Step | None

    def kinematics(self, batch: ConstraintElements, state: State, dt: float) -> Kinematics:
        """As of `JointCoupling`, of a batch of elements. Collective."""
        y = self.rest + self.nodal(state.u)
        gap = self._gap(state, y)
        first, second, limit, along = self._rates(state, y, dt)
        own = {"constraints": np.zeros_like(gap)}
        return Kinematics(
            batch.scale[:, None] * np.array([gap, first, second]),
            np.array([self.by_joint(np.abs(values)) for values in (gap, first)]),
            np.array([OFF * self.by_joint(np.abs(y)), limit]),
            along,
            batch.evaluate(y, own).tangent,
        )

    def _gap(self, state: State, y: FloatArray) -> FloatArray:
        """G - c at a state with these nodal vectors [m], shape (n, m). Collective."""
        (weights, constants, _), (c, *_) = self.at(state.time, state.time)
        return kernel.value(kernel.factors(weights, constants, y)) - c

    def _rates(
        self, state: State, y: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """First and second derivative in time of g - c at a state. Collective.

        Args:
            state: The state.
            y: Its nodal vectors [m], shape (n, k, 3).
            dt: Time in which prescribed values are told [s]; less the last step at its end.

        Returns:
            [m/s] and [m/s^2], both (n, m), and of each joint what the first may err by [m/s]: by
            rounding, by what prescribed values leave open within `dt`, and at the end of a step by
            its rule for velocities; and `Kinematics.along`.
        """
        step = self.step if dt < 0.0 else None
        if step is None:
            at, other = state.time, state.time + dt
        else:
            at, other = step.state.time + step.dt, step.state.time
        equations, c = self.at(*times(at, other))
        gradient, flow, bend = self._flow(state, equations)
        before = None if step is None else self._flow(step.state, equations)
        rate, doubt, faster = told(c, at - other, None if before is None else before[1])
        second = bend - faster
        if state.a:
            second += np.einsum("nmai,nai->nm", gradient, self.nodal(state.a))
        speed, flows, rates, off = (
            self.by_joint(np.abs(a)) for a in (self.nodal(state.v), flow, rate, doubt)
        )
        off = off + OFF * np.maximum(speed, rates)
        if before is not None:
            # With v_0 + v_1 = 2 (y_1 - y_0)/h the sum of both ends' G v is 2 (c_1 - c_0)/h and a
            # quarter of h times the change of (G v)' v.
            off -= 0.5 * dt * self.by_joint(np.abs(bend - before[2]))
            off -= ROUNDED * self.by_joint(np.abs(y)) / dt
        return flow - rate, second, off, np.maximum(flows, rates)

    def _flow(
        self, state: State, equations: Equations
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """G (n, m, k, 3), G v [m/s] and (G v)' v [m/s^2], both (n, m), at a state."""
        weights, constants, _ = equations
        speed, y = self.nodal(state.v), self.rest + self.nodal(state.u)
        gradient = kernel.gradient(weights, kernel.factors(weights, constants, y))
        rates = kernel.factors(weights, np.zeros_like(constants), speed)
        return (
            gradient, np.einsum("nmai,nai->nm", gradient, speed), 2.0 * kernel.value(rates)
        )  # fmt: skip
