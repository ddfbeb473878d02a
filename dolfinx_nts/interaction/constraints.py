"""Elements of constraints at most quadratic in the coordinates: triads, joints, ties.

With y_m = (y_0 + y_1)/2, D g(y_m) (y_1 - y_0) = g(y_1) - g(y_0): at the middle of the step their
forces -D g(y_m)^T lambda do no work but that of a prescribed value (theory section 11).
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.interaction.kinematics import FAR_TURN, OFF, ROUNDED, Kinematics
from dolfinx_nts.interaction.point_elements import EveryStep, PointElements
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.interaction.prescribed import times, told
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.parallel import global_max, raise_together
from dolfinx_nts.state import State
from dolfinx_nts.validation import StepFailedError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]
#: From nodal vectors at the end of a step (n, k, 3) and the times of both its ends [s].
Upright = Callable[[FloatArray, tuple[float, ...]], FloatArray]

#: Compliance that the matrix lends to constraints that may repeat others, over that of the bodies,
#: beside their gap times their curvature. Equations that repeat others agree at the solution;
#: before it they miss each other by the square of the gap, and multipliers change by that over the
#: compliance: a fixed one makes them huge. One that vanishes with the gap leaves Newton's method
#: its order (Levenberg-Marquardt: Yamashita and Fukushima 2001).
SHIFT = 1e-7


def rank_of(name: str, comm: Any) -> int:
    """Rank that holds an item that lives on one rank, the same in every run.

    Names that differ in their last number are dealt one by one, others by chance.
    """
    numbers = re.findall(r"\d+", name)
    stem = zlib.crc32(re.sub(r"\d+", "", name).encode())
    return (stem + int(numbers[-1] if numbers else 0)) % int(comm.size)


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


def _extent(equations: Equations, rest: FloatArray) -> float:
    """Length whose rounding enters constraints on this rank [m].

    That of what each vector is made of, times the other vector: nothing of nodes with weight 0,
    such as the directors of a point, whose length is no length of the scene.

    Args:
        equations: Their coefficients.
        rest: Reference values of the nodes [m], shape (n, k, 3).
    """
    weights, constants, _ = equations
    made_of = np.abs(weights) @ np.abs(rest)[:, None] + np.abs(constants)
    vectors = np.linalg.norm(kernel.factors(weights, constants, rest), axis=3)
    both = made_of.max(axis=3) * vectors[:, :, ::-1]
    return float(both.sum(axis=2).max(initial=0.0))


class ConstraintPart(NamedTuple):
    """What constraints contribute, see `Part`.

    Attributes:
        residual: Rows of coordinates [kg m], then of multipliers.
        tangent: Its derivative.
        multiplier: Factor of the step times lambda [kg m], shape (n, m).
        gap: g - c at t_{n+1} [m], shape (n, m).
        start: Nodal vectors at t_n [m], shape (n, k, 3).
        end: The same at t_{n+1}.
    """

    residual: FloatArray
    tangent: FloatArray
    multiplier: FloatArray
    gap: FloatArray
    start: FloatArray
    end: FloatArray

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
        size: As of `_extent` [m].
    """

    equations: Equations
    curvature: FloatArray
    rest: FloatArray
    prescribed: FloatArray
    y0: FloatArray
    scale: float
    theta: float
    lent: float
    size: float

    @property
    def widths(self) -> Mapping[str, int]:
        """One multiplier per constraint."""
        return {"augmented": 0, "constraints": self.equations.value.shape[1]}

    @property
    def force_scale(self) -> float:
        """Unknowns are lengths, forces over `scale`."""
        return self.scale

    def reference(self) -> FloatArray:
        """Reference values of the nodes [m], shape (n, k, 3)."""
        return self.rest

    @cached_property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which: each in its own."""
        return np.eye(self.widths["constraints"], dtype=bool)

    @cached_property
    def extent(self) -> float:
        """Length whose rounding enters on this rank [m]."""
        return self.size

    @cached_property
    def _start(self) -> FloatArray:
        """Factors of each constraint at t_n, shape (n, m, 2, 3)."""
        weights, constants, _ = self.equations
        return kernel.factors(weights, constants, self.y0)

    @cached_property
    def _bent(self) -> FloatArray:
        """Largest curvature of each constraint [1/m], shape (n, m)."""
        return _bent(self.curvature)

    @property
    def alike(self) -> tuple[Any, ...]:
        """What batches have in common that are evaluated as one, see `evaluate_together`."""
        return (self.theta, *self.equations.weights.shape[1:])

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> ConstraintPart:
        """Residual and tangent; the multipliers' unknowns are lengths, factor lambda / scale."""
        (part,) = self.evaluate_alike([self], [x], [own])
        return part

    @staticmethod
    def evaluate_alike(
        batches: Sequence[ConstraintElements],
        places: Sequence[FloatArray],
        own: Sequence[Mapping[str, FloatArray]],
    ) -> list[ConstraintPart]:
        """`evaluate` of batches that are `alike`, at once: most have a single element."""
        first, counts = batches[0], [batch.num_elements for batch in batches]
        each = [
            _Iterate(*b.equations[:2], b.curvature, b.prescribed[1], b.y0, x, y["constraints"])
            for b, x, y in zip(batches, places, own, strict=True)
        ]
        several = len(each) > 1
        known = (None, None) if several else (first._start, first._bent)
        joined = _Iterate(*map(np.concatenate, zip(*each, strict=True))) if several else each[0]
        scale, lent = (
            np.repeat([getattr(b, name) for b in batches], counts) for name in ("scale", "lent")
        )
        whole = _evaluate(first.theta, scale, lent, joined, *known)
        stops = np.cumsum(counts)
        return [
            ConstraintPart(*(array[stop - n : stop] for array in whole))
            for n, stop in zip(counts, stops, strict=True)
        ]

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
        return worst * self.scale, f"{self.name!r}: off by {worst:.3g}"


def _bent(curvature: FloatArray) -> FloatArray:
    """Largest entry of each constraint's curvature [1/m], shape (n, m)."""
    bent: FloatArray = np.abs(curvature).max(axis=(2, 3), initial=0.0)
    return bent


class _Iterate(NamedTuple):
    """What constraints are evaluated of; names as of `ConstraintElements`, axis 0 = element.

    Attributes:
        x: Nodal vectors at t_{n+1} [m], shape (n, k, 3).
        unknowns: Multipliers as lengths, shape (n, m).
        prescribed: c at t_{n+1} [m], shape (n, m).
    """

    weights: FloatArray
    constants: FloatArray
    curvature: FloatArray
    prescribed: FloatArray
    y0: FloatArray
    x: FloatArray
    unknowns: FloatArray


def _evaluate(
    theta: float,
    scale: FloatArray,
    lent: FloatArray,
    at: _Iterate,
    start: FloatArray | None,
    bent: FloatArray | None,
) -> ConstraintPart:
    """Residual and tangent of constraints.

    Args:
        theta: As of `ConstraintElements`.
        scale: The same of each element, shape (n,).
        lent: Alike.
        at: The iterate.
        start: Factors at t_n, if they are known.
        bent: Curvature of each constraint, if it is known.
    """
    weights, constants, curvature, prescribed, y0, x, unknowns = at
    n, m, _, k = weights.shape
    start = kernel.factors(weights, constants, y0) if start is None else start
    bent = _bent(curvature) if bent is None else bent
    last, scale = 3 * k, scale[:, None]
    multiplier = scale * unknowns
    end = kernel.factors(weights, constants, x)
    middle = start + theta * (end - start)
    force = kernel.gradient(weights, middle).reshape(n, m, last)
    gap = kernel.value(end) - prescribed
    residual = np.empty((n, last + m))
    residual[:, :last] = np.matmul(multiplier[:, None], force)[:, 0]
    residual[:, last:] = scale * gap
    tangent = np.zeros((n, last + m, last + m))
    if bent.any():
        bend = np.matmul(theta * multiplier[:, None], curvature.reshape(n, m, k * k))
        stiffness = bend.reshape(n, k, k)
        for i in range(3):
            tangent[:, i:last:3, i:last:3] = stiffness
    tangent[:, :last, last:] = (scale[:, :, None] * force).transpose(0, 2, 1)
    gradient = kernel.gradient(weights, end).reshape(n, m, last)
    tangent[:, last:, :last] = scale[:, :, None] * gradient
    rows, lends = np.arange(last, last + m), lent > 0.0
    tangent[:, rows, rows] = -scale * np.where(
        lends[:, None], lent[:, None] + np.abs(gap) * bent, 0.0
    )
    return ConstraintPart(residual, tangent, multiplier, gap, y0, x)


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
        upright: Numbers that are positive unless directions have turned over, which solves the
            equations, too. Collective.
        arm: Vectors (n, 3) [m] whose turn in a step is looked at, from nodal vectors (n, k, 3).
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
        upright: Upright | None = None,
        arm: Callable[[FloatArray], FloatArray] | None = None,
    ) -> None:
        super().__init__(bodies, self._elements, lambda part: part.multiplier / self._factor)
        self._of = bodies
        self._name, self._sides, self._equations = name, tuple(sides), equations
        self._lent = SHIFT if redundant else 0.0
        self._scale: float | None = None
        self._rest = np.concatenate([s.reference for s in self._sides], axis=1)
        self._curvature = kernel.curvature(equations.weights)
        self._extent = _extent(equations, self._rest)
        self._driven, self._force = driven, np.zeros_like(equations.value)
        self._upright, self._arm = upright, arm
        # What is prescribed may move its bodies in any step.
        self.rests = driven is None

    def begin(self, step: Step, history: Any, again: Evaluation | None, search: bool) -> None:
        """Make the elements of a step."""
        self.bodies = [self._of]
        super().begin(step, history, again, search)

    def rest(self) -> None:
        """Leave the step."""
        self.elements, self.bodies = [], []

    def rouse(self) -> None:
        """Be in the step again."""
        assert self.step is not None
        self.begin(self.step, self._history, None, False)

    def history(self, parts: Sequence[Any]) -> Any:
        """Multipliers of an accepted step."""
        return super().history(parts) if parts else self._force

    def hold_alone(self) -> None:
        """They repeat no others: nothing is lent to them, which light bodies would feel."""
        self._lent = 0.0

    def _elements(self, step: Step, history: Any) -> ConstraintElements:
        self._factor = step.factor
        # A guess alone: a run may go on from one whose joint of this name had other equations.
        if history is not None and history.shape == self._force.shape:
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
            size=_extent(equations, self._rest) if driven else self._extent,
        )

    def _at(self, *times: float) -> tuple[Equations, FloatArray]:
        """Equations that hold at these times, and c at each of them."""
        if self._driven is not None:
            return self._driven(times)
        return self._equations, np.array([self._equations.value] * len(times))

    def misses(
        self, e: Evaluation, parts: Sequence[ConstraintPart], motion: FloatArray
    ) -> bool:
        """Nothing is missed. Collective.

        Raises:
            StepFailedError: Directions have turned over.
        """
        step = self.step
        if self._upright is None or step is None or not parts:
            return False
        (part,) = parts
        along = self._upright(part.end, (step.state.time, step.state.time + step.dt))
        raise_together(
            self._sides[0].body.comm,
            None if (along > 0.0).all() else (
                f"step from t={step.state.time:.6g} with dt={step.dt:.3g}: {self._name!r} ends "
                "with directions turned over, which solves its equations, too; use a smaller dt"
            ),
            partial(StepFailedError, advises=True),
        )  # fmt: skip
        return False

    def warnings(self, parts: Sequence[ConstraintPart]) -> list[StepWarning]:
        """Whether the arm has turned too far in the step. Collective."""
        if not parts or self._arm is None or self.step is None or not self.step.integrator.inertia:
            return []
        (part,) = parts
        one, two = self._arm(part.start), self._arm(part.end)
        sine = np.linalg.norm(np.cross(one, two), axis=1)
        angle = np.arctan2(sine, np.einsum("ni,ni->n", one, two)).max(initial=0.0)
        turn = float(global_max(self._sides[0].body.comm, np.array([angle]))[0])
        if turn <= FAR_TURN:
            return []
        text = (
            f"joint {self._name!r} turns by {turn:.2g} rad in a step, too far for how it turns to "
            "be right, though energy and momenta may be kept; use a smaller dt"
        )
        return [StepWarning("turns", turn, text, (self._name,), False)]

    def kinematics(self, state: State, dt: float) -> list[Kinematics | None]:
        """Do as `JointCoupling`, in closed form but for what is prescribed."""
        if not self.elements:
            return []
        (batch,) = self.elements
        gap, off = self._gap(state)
        first, second, doubt, along = self._rates(state, dt)
        own = {"constraints": np.zeros_like(self._equations.value)}
        return [
            Kinematics(
                batch.scale * np.array([gap, first, second]),
                np.array([np.abs(values).max(initial=0.0) for values in (gap, first)]),
                np.array([off, doubt]),
                along,
                batch.evaluate(self._places(state), own).tangent,
            )
        ]

    def _places(self, state: State) -> FloatArray:
        """Nodal vectors at a state [m], shape (n, k, 3)."""
        u = [state.u[k] for k in self.bodies[0]]
        y = [s.reference + s.nodal(w) for s, w in zip(self._sides, u, strict=True)]
        return np.concatenate(y, axis=1)

    def _gap(self, state: State) -> tuple[FloatArray, float]:
        """G - c at a state [m], shape (n, m), and what it may be by rounding [m]. Collective."""
        both = self._places(state)
        (weights, constants, _), (c, *_) = self._at(state.time, state.time)
        found = kernel.value(kernel.factors(weights, constants, both)) - c
        return found, OFF * float(np.abs(both).max(initial=0.0))

    def _rates(self, state: State, dt: float) -> tuple[FloatArray, FloatArray, float, float]:
        """First and second derivative in time of g - c at a state. Collective.

        Args:
            state: The state; without accelerations they count as zero.
            dt: Time in which prescribed values are told [s]; less the last step at its end.

        Returns:
            [m/s] and [m/s^2], both (n, m), and what the first may err by [m/s]: by rounding, by
            what prescribed values leave open within `dt`, and at the end of a step by its rule for
            velocities; and `Kinematics.along`.
        """
        step = self.step if dt < 0.0 else None
        if step is None:
            at, other = state.time, state.time + dt
        else:
            at, other = step.state.time + step.dt, step.state.time
        equations, c = self._at(*times(at, other))
        gradient, flow, bend = self._flow(state, equations)
        before = None if step is None else self._flow(step.state, equations)
        rate, doubt, faster = told(c, at - other, None if before is None else before[1])
        second = bend - faster
        if state.a:
            a = [s.nodal(state.a[k]) for s, k in zip(self._sides, self.bodies[0], strict=True)]
            second += np.einsum("nmai,nai->nm", gradient, np.concatenate(a, axis=1))
        v = [s.nodal(state.v[k]) for s, k in zip(self._sides, self.bodies[0], strict=True)]
        size, along, off = (
            max(float(np.abs(a).max(initial=0.0)) for a in arrays)
            for arrays in ((*v, rate), (flow, rate), (doubt,))
        )
        off += OFF * size
        if before is not None:
            # With v_0 + v_1 = 2 (y_1 - y_0)/h the sum of both ends' G v is 2 (c_1 - c_0)/h and a
            # quarter of h times the change of (G v)' v.
            off -= 0.5 * dt * float(np.abs(bend - before[2]).max(initial=0.0))
            off -= ROUNDED * float(np.abs(self._places(state)).max(initial=0.0)) / dt
        return flow - rate, second, off, along

    def _flow(
        self, state: State, equations: Equations
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """G (n, m, k, 3), G v [m/s] and (G v)' v [m/s^2], both (n, m), at a state."""
        weights, constants, _ = equations
        v = [s.nodal(state.v[k]) for s, k in zip(self._sides, self.bodies[0], strict=True)]
        speed = np.concatenate(v, axis=1)
        gradient = kernel.gradient(
            weights, kernel.factors(weights, constants, self._places(state))
        )
        rates = kernel.factors(weights, np.zeros_like(constants), speed)
        return (
            gradient, np.einsum("nmai,nai->nm", gradient, speed), 2.0 * kernel.value(rates)
        )  # fmt: skip

    def load_step_work(
        self, before: Any, after: FloatArray, start: float, end: float
    ) -> float:
        """Work of prescribed values, -lambda . (c_1 - c_0) with the mean of both lambda [J]."""
        _, (c0, c1) = self._at(start, end)
        # Nothing acts before the first load step.
        force = after if before is None else before + after
        return -0.5 * float((force * (c1 - c0)).sum())

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Multipliers of the last step."""
        batch = self.elements[k]
        guess: FloatArray = self._factor * self._force / batch.scale
        return guess
