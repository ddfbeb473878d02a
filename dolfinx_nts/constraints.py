"""Elements of constraints at most quadratic in the coordinates: triads, joints, ties.

With y_m = (y_0 + y_1)/2, D g(y_m) (y_1 - y_0) = g(y_1) - g(y_0): at the middle of the step their
forces -D g(y_m)^T lambda do no work but that of a prescribed value (theory section 11).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.bodies.points import Points
from dolfinx_nts.elements import EveryStep, PointElements, Step
from dolfinx_nts.kernels import quadratic as kernel

if TYPE_CHECKING:
    from dolfinx_nts.system import State

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

#: Compliance that the matrix lends to constraints that may repeat others, over that of the bodies,
#: beside their gap times their curvature. Equations that repeat others agree at the solution;
#: before it they miss each other by the square of the gap, and multipliers change by that over the
#: compliance: a fixed one makes them huge. One that vanishes with the gap leaves Newton's method
#: its order (Levenberg-Marquardt: Yamashita and Fukushima 2001).
SHIFT = 1e-7
#: Part of the velocities by which a start may violate a constraint.
_OFF = 1e-9


def rank_of(name: str, comm: Any) -> int:
    """Rank that has what is of one rank alone, evenly for many names, the same in every run."""
    return zlib.crc32(name.encode()) % int(comm.size)


class Equations(NamedTuple):
    """Constraints v . w = c [m], v = V_a y_a + v_0 and w alike; axis 0 = element.

    Attributes:
        weights: V and W, whose products are [1/m] or, with a constant, [-], shape (n, m, 2, k).
        constants: v_0 and w_0, shape (n, m, 2, 3).
        value: c where nothing prescribes it otherwise [m], shape (n, m).
    """

    weights: FloatArray
    constants: FloatArray
    value: FloatArray


class ConstraintPart(NamedTuple):
    """What constraints contribute, see `Part`.

    Attributes:
        residual: Rows of coordinates [kg m], then of multipliers.
        tangent: Its derivative.
        multiplier: Factor of the step times lambda [kg m], shape (n, m).
        gap: g - c at t_{n+1} [m], shape (n, m).
    """

    residual: FloatArray
    tangent: FloatArray
    multiplier: FloatArray
    gap: FloatArray

    @property
    def status(self) -> BoolArray:
        """Nothing flips."""
        return np.empty((0, len(self.residual)), dtype=bool)


@dataclass(frozen=True, eq=False, kw_only=True)
class ConstraintElements(PointElements):
    """Constraints of a step.

    Attributes:
        equations: Their coefficients.
        curvature: Second derivative of the constraints, see `kernels.quadratic`, (n, m, k, k).
        rest: Reference values of the nodes [m], shape (n, k, 3).
        prescribed: c at t_n and t_{n+1} [m], shape (2, n, m).
        y0: Nodal vectors at t_n [m], shape (n, k, 3).
        scale: Force per motion in the units of the step: a mass in dynamics.
        theta: Where between t_n and t_{n+1} the forces act.
        lent: Compliance over that of the bodies that the matrix lends them, see `SHIFT`.
    """

    equations: Equations
    curvature: FloatArray
    rest: FloatArray
    prescribed: FloatArray
    y0: FloatArray
    scale: float
    theta: float
    lent: float

    @property
    def widths(self) -> Mapping[str, int]:
        """One multiplier per constraint."""
        return {"augmented": 0, "constraints": self.equations.value.shape[1]}

    def reference(self) -> FloatArray:
        """Reference values of the nodes [m], shape (n, k, 3)."""
        return self.rest

    @cached_property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which: each in its own."""
        return np.eye(self.widths["constraints"], dtype=bool)

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> ConstraintPart:
        """Residual and tangent; the multipliers' unknowns are lengths, factor lambda / scale."""
        weights, constants, _ = self.equations
        n, m, _, k = weights.shape
        scale = self.scale
        multiplier = scale * own["constraints"]
        middle, end = (
            kernel.factors(weights, constants, y)
            for y in (self.y0 + self.theta * (x - self.y0), x)
        )
        force, slope = (
            kernel.gradient(weights, vectors).reshape(n, m, 3 * k) for vectors in (middle, end)
        )
        gap = kernel.value(end) - self.prescribed[1]
        size = 3 * k + m
        residual, tangent = np.zeros((n, size)), np.zeros((n, size, size))
        residual[:, : 3 * k] = np.matmul(multiplier[:, None], force)[:, 0]
        residual[:, 3 * k :] = scale * gap
        stiffness = self.theta * np.einsum("nm,nmab->nab", multiplier, self.curvature)
        for i in range(3):
            tangent[:, i : 3 * k : 3, i : 3 * k : 3] = stiffness
        tangent[:, : 3 * k, 3 * k :] = (scale * force).transpose(0, 2, 1)
        tangent[:, 3 * k :, : 3 * k] = scale * slope
        if self.lent:
            bent = np.abs(self.curvature).max(axis=(2, 3), initial=0.0)
            rows = np.arange(3 * k, size)
            tangent[:, rows, rows] = -scale * (self.lent + np.abs(gap) * bent)
        return ConstraintPart(residual, tangent, multiplier, gap)

    def largest(self, part: ConstraintPart) -> list[float]:
        """The largest row of its constraints [m], and its extent."""
        return [0.0, float(np.abs(part.gap).max(initial=0.0)), 0.0, self.extent]

    def ledger(self, part: ConstraintPart, factor: float) -> dict[str, float]:
        """Work of prescribed values, -lambda . (c_1 - c_0)."""
        change = self.prescribed[1] - self.prescribed[0]
        return {"external_work": -float((part.multiplier * change).sum()) / factor}

    def describe(self, part: ConstraintPart, flips: IntArray) -> tuple[float, str]:
        """The constraint that is off most."""
        size = np.nan_to_num(np.abs(part.gap), nan=np.inf)
        worst = float(size.max())
        return worst * self.scale, f"{self.name!r}: off by {worst:.3g} m"


class Constraints(EveryStep):
    """Makes `ConstraintElements` in every step, and remembers their multipliers.

    Args:
        name: For messages.
        bodies: Numbers of their bodies in the system.
        sides: Of each body, the nodes of the elements, here those of this rank.
        equations: Of this rank's elements.
        driven: Equations for some times, and c at each of them [m], shape (times, n, m); None:
            nothing is prescribed. Collective.
        redundant: Whether they may repeat others.
    """

    def __init__(
        self,
        name: str,
        bodies: tuple[int, ...],
        sides: Sequence[Points],
        equations: Equations,
        driven: Callable[[tuple[float, ...]], tuple[Equations, FloatArray]] | None = None,
        *,
        redundant: bool = True,
    ) -> None:
        super().__init__(bodies, self._elements, lambda part: part.multiplier / self._factor)
        self._name, self._sides, self._equations = name, tuple(sides), equations
        self._lent = SHIFT if redundant else 0.0
        self._scale: float | None = None
        self._rest = np.concatenate([s.reference for s in self._sides], axis=1)
        self._curvature = kernel.curvature(equations.weights)
        self._driven, self._force = driven, np.zeros_like(equations.value)

    def _elements(self, step: Step, history: Any) -> ConstraintElements:
        self._factor = step.factor
        if history is not None:
            self._force = history
        u = [step.state.u[b] for b in self.bodies[0]]
        moved = [s.nodal(v) for s, v in zip(self._sides, u, strict=True)]
        equations, prescribed = self._at(step.state.time, step.state.time + step.dt)
        driven = equations is not self._equations
        if self._scale is None or not step.integrator.inertia:
            self._scale = min(step.mean_scale(side.body) for side in self._sides)
        return ConstraintElements(
            name=self._name,
            sides=self._sides,
            equations=equations,
            curvature=kernel.curvature(equations.weights) if driven else self._curvature,
            rest=self._rest,
            prescribed=prescribed,
            y0=self._rest + np.concatenate(moved, axis=1),
            scale=self._scale,
            theta=step.integrator.theta,
            lent=self._lent,
        )

    def _at(self, *times: float) -> tuple[Equations, FloatArray]:
        """Equations that hold at these times, and c at each of them."""
        if self._driven is not None:
            return self._driven(times)
        return self._equations, np.array([self._equations.value] * len(times))

    @property
    def no_forces(self) -> FloatArray:
        """Multipliers that are zero, shape (n, m)."""
        return np.zeros_like(self._equations.value)

    def gap(self, state: State) -> tuple[FloatArray, float]:
        """G - c at a state [m], shape (n, m), and what it may be by rounding [m]. Collective."""
        u = [state.u[k] for k in self.bodies[0]]
        y = [s.reference + s.nodal(w) for s, w in zip(self._sides, u, strict=True)]
        (weights, constants, _), (c, *_) = self._at(state.time, state.time)
        both = np.concatenate(y, axis=1)
        found = kernel.value(kernel.factors(weights, constants, both)) - c
        return found, _OFF * float(np.abs(both).max(initial=0.0))

    def kinematics(self, state: State, dt: float) -> tuple[FloatArray, FloatArray, float]:
        """First and second derivative in time of g - c at a state. Collective.

        Args:
            state: The state; without accelerations they count as zero.
            dt: Time in which prescribed values are told [s].

        Returns:
            [m/s] and [m/s^2], both (n, m), and what the first may err by [m/s]: by rounding, and
            by what prescribed values leave open within `dt`.
        """
        u, v = ([values[k] for k in self.bodies[0]] for values in (state.u, state.v))
        y = [s.reference + s.nodal(w) for s, w in zip(self._sides, u, strict=True)]
        speed = np.concatenate(
            [s.nodal(w) for s, w in zip(self._sides, v, strict=True)], axis=1
        )
        times = (state.time + part * dt for part in (0.0, 0.25, 0.5, 1.0))
        (weights, constants, _), (c0, c_in, c1, c2) = self._at(*times)
        rate = (4.0 * (c1 - c0) - (c2 - c0)) / dt
        finer = 2.0 * (4.0 * (c_in - c0) - (c1 - c0)) / dt
        vectors = kernel.factors(weights, constants, np.concatenate(y, axis=1))
        rates = kernel.factors(weights, np.zeros_like(constants), speed)
        gradient = kernel.gradient(weights, vectors)
        first = np.einsum("nmai,nai->nm", gradient, speed) - rate
        second = 2.0 * kernel.value(rates) - 4.0 * (c0 - 2.0 * c1 + c2) / dt**2
        if state.a:
            a = [s.nodal(state.a[k]) for s, k in zip(self._sides, self.bodies[0], strict=True)]
            second += np.einsum("nmai,nai->nm", gradient, np.concatenate(a, axis=1))
        size = max(float(np.abs(a).max(initial=0.0)) for a in (speed, rate))
        # Both formulas are at least of second order, so the coarse one errs by 4/3 of what they
        # differ by.
        doubt = 2.0 * float(np.abs(finer - rate).max(initial=0.0))
        return first, second, _OFF * size + doubt

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Multipliers of the last step."""
        batch = self.elements[k]
        guess: FloatArray = self._factor * self._force / batch.scale
        return guess
