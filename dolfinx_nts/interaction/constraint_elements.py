"""Elements of constraints at most quadratic in the coordinates: triads, joints, ties.

With y_m = (y_0 + y_1)/2, D g(y_m) (y_1 - y_0) = g(y_1) - g(y_0): at the middle of the step their
forces -D g(y_m)^T lambda do no work but that of a prescribed value (theory section 11).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.interaction.point_elements import PointElements
from dolfinx_nts.kernels import library
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

_EPS = float(np.finfo(float).eps)
#: What a limit of 0 counts as: a gap of 0 is below it, any other far above.
TINY = float(np.finfo(float).tiny)

#: Compliance that the matrix lends to constraints that may repeat others, over that of the bodies,
#: beside their gap times their curvature. Equations that repeat others agree at the solution;
#: before it they miss each other by the square of the gap, and multipliers change by that over the
#: compliance: a fixed one makes them huge. One that vanishes with the gap leaves Newton's method
#: its order (Levenberg-Marquardt: Yamashita and Fukushima 2001).
SHIFT = 1e-7


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


def largest_of_joints(count: int, joint: IntArray, values: FloatArray) -> FloatArray:
    """Largest of values >= 0 of elements (n, ...), by the number of their joint, shape (count,)."""
    largest, each = np.zeros(count), values.max(axis=tuple(range(1, values.ndim)), initial=0.0)
    if count == 1:
        largest[0] = each.max(initial=0.0)
    else:
        np.maximum.at(largest, joint, each)
    return largest


def extents_of(equations: Equations, rest: FloatArray) -> FloatArray:
    """Length whose rounding enters constraints of each element [m], shape (n,).

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
    return both.sum(axis=2).max(axis=1, initial=0.0)


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
        scale: Force per motion in the units of the step, (n,): a mass in dynamics.
        theta: Where between t_n and t_{n+1} the forces act.
        lent: Compliance over that of the bodies that the matrix lends them, see `SHIFT`, (n,).
        extents: As of `extents_of` [m], shape (n,).
        names: Of the joints that they are of.
        joint: Number of each element's joint among these, shape (n,).
        moves: Whether coefficients depend on time.
    """

    equations: Equations
    curvature: FloatArray
    rest: FloatArray
    prescribed: FloatArray
    y0: FloatArray
    scale: FloatArray
    theta: float
    lent: FloatArray
    extents: FloatArray
    names: Sequence[str]
    joint: IntArray
    moves: bool

    @property
    def widths(self) -> Mapping[str, int]:
        """One multiplier per constraint."""
        return {"augmented": 0, "constraints": self.equations.value.shape[1]}

    @property
    def force_scale(self) -> FloatArray:
        """Unknowns are lengths, forces over `scale`."""
        return self.scale

    def reference(self) -> FloatArray:
        """Reference values of the nodes [m], shape (n, k, 3)."""
        return self.rest

    @cached_property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which: each in its own."""
        return np.eye(self.widths["constraints"], dtype=bool)

    @property
    def entries(self) -> BoolArray:
        """Those that can follow from coefficients which do not change with time."""
        if self.moves:
            return super().entries
        entries = kernel.pattern(*self.equations[:2])
        first = self.num_coordinates
        entries[first:, first:] = self.pattern
        return entries

    @cached_property
    def extent(self) -> float:
        """Length whose rounding enters on this rank [m]."""
        return float(self.extents.max(initial=0.0))

    @cached_property
    def _start(self) -> FloatArray:
        """Factors of each constraint at t_n, shape (n, m, 2, 3)."""
        weights, constants, _ = self.equations
        return kernel.factors(weights, constants, self.y0)

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> ConstraintPart:
        """Residual and tangent; the multipliers' unknowns are lengths, factor lambda / scale."""
        weights, constants, _ = self.equations
        n, m, _, k = weights.shape
        size = 3 * k + m
        multiplier = self.scale[:, None] * own["constraints"]
        residual, tangent, gap = np.zeros((n, size)), np.zeros((n, size, size)), np.empty((n, m))
        library.run(
            library.load().constraints, k, m, self.theta, n, weights, constants, self.prescribed[1],
            self._start, self.curvature, x, multiplier, self.scale, self.lent,
            residual, tangent, gap,
        )  # fmt: skip
        return ConstraintPart(residual, tangent, multiplier, gap, self.y0, x)

    def ratios(
        self, part: Any, largest: Any, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """Of each joint the constraint that misses most of what counts as converged."""
        limit = rtol * motion + 8 * _EPS * (rounded + np.maximum(self.extents, largest[3]))
        size = np.abs(part.gap) / np.maximum(limit, TINY)[:, None]
        worst = largest_of_joints(len(self.names), self.joint, size)
        return dict(zip(self._labels, worst.tolist(), strict=True))

    @cached_property
    def _labels(self) -> list[str]:
        """Names of the joints' constraints for messages."""
        return [f"{name} constraints" for name in self.names]

    def largest(self, part: ConstraintPart) -> list[float]:
        """Nothing: each element has limits of its own."""
        return [0.0, 0.0, 0.0, 0.0]

    def ledger(self, part: ConstraintPart, factor: float) -> dict[str, float]:
        """Work of prescribed values, -lambda . (c_1 - c_0)."""
        return {"external_work": float(self.works(part, factor).sum())}

    def works(self, part: ConstraintPart, factor: float) -> FloatArray:
        """`ledger` of each element [J], shape (n,)."""
        change = self.prescribed[1] - self.prescribed[0]
        return -(part.multiplier * change).sum(axis=1) / factor

    def describe(self, part: ConstraintPart, flips: IntArray) -> tuple[float, str]:
        """The constraint that is off most."""
        size = np.nan_to_num(np.abs(part.gap), nan=np.inf).max(axis=1)
        k = int((size * self.scale).argmax())
        name = self.names[self.joint[k]]
        return float(size[k] * self.scale[k]), f"{name!r}: off by {size[k]:.3g}"
