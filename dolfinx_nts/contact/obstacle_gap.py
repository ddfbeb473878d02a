"""Gap of points to a rigid obstacle, and their slip along it: the element without a facet.

The points are relative to the obstacle's motion c(t), so that a moving obstacle is one at rest
here; only the balance learns of its work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact.contact_measure import Batch, Measured, Slip
from dolfinx_nts.contact.obstacles import Obstacle, inverse, joined
from dolfinx_nts.contact.surface_sums import Sums
from dolfinx_nts.kernels import compiled, compiled_law
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class ObstacleGap(Batch):
    """See `ContactMeasure`.

    lambda_N, and with friction lambda_T, are all its unknowns for any integrator: the discrete
    gradient is in closed form.

    Attributes:
        obstacle: The obstacle relative to the origin of the points.
        start: Slave at t_n relative to the obstacle's motion [m], shape (n, 1, 3).
        normal: Of the obstacle there, shape (n, 3).
        length: Size of what is about the slave [m], shape (n,).
        rule: `Integrator.contact_gradient`.
        theta: Where between t_n and t_{n+1} the direct rule takes the contact force.
    """

    obstacle: Obstacle
    start: FloatArray
    normal: FloatArray
    length: FloatArray
    rule: str
    theta: float
    num_augmented = 0
    num_normal = 1

    @classmethod
    def joined(cls, batches: Sequence[Any], counts: Sequence[int]) -> Any:
        """As of `Batch`, of one obstacle about the origins of several contacts."""
        obstacle = joined([batch.obstacle for batch in batches], counts)
        return replace(super().joined(batches, counts), obstacle=obstacle)

    @property
    def extent(self) -> float:
        """Size of the obstacle [m]."""
        return self.obstacle.extent

    @property
    def foot(self) -> FloatArray:
        """No weights."""
        return np.empty((len(self.start), 0))

    @cached_property
    def tangents(self) -> FloatArray:
        """Orthonormal directions along the surface at t_n, shape (n, 2, 3)."""
        first = cross(self.normal, np.eye(3)[np.abs(self.normal).argmin(axis=1)])
        first *= inverse(np.linalg.norm(first, axis=1))[:, None]
        return np.stack([first, cross(self.normal, first)], axis=1)

    def gap(self, x: FloatArray) -> FloatArray:
        """Gap [m] of slaves at t_{n+1}, shape (n, 1, 3)."""
        return self.obstacle.gap(x[:, 0]).value

    def augmented(self, x: FloatArray) -> FloatArray:
        """None."""
        return np.empty((len(x), 0))

    def normal_at(self, x: FloatArray) -> FloatArray:
        """Unit normals at points at t_{n+1}, shape (n, 3)."""
        normal = np.asarray(self.obstacle.gap(x[:, 0]).gradient[:, 0], dtype=np.float64)
        normal = normal * inverse(np.linalg.norm(normal, axis=1))[:, None]
        return np.broadcast_to(normal, (len(x), 3))

    def normal_between(self, x: FloatArray) -> FloatArray:
        """Unit normals where between t_n and t_{n+1} the contact force acts, shape (n, 3)."""
        return self.normal_at(self.start + self.theta * (x - self.start))

    def has_strayed(self, x: FloatArray, cut: FloatArray, limit: float) -> BoolArray:
        """Which points have been cut elsewhere, shape (n,): none is cut."""
        return np.zeros(len(x), dtype=bool)

    def summed(
        self, x: FloatArray, sums: Sums, multiplier: FloatArray, frame: FloatArray
    ) -> compiled.OverSurface:
        """What points contribute to slaves, whose law is about sums of gaps and slips.

        Args:
            x: Points at t_{n+1} [m], shape (n, 1, 3).
            sums: How.
            multiplier: Of the slaves [kg m], shape (slaves, constraints).
            frame: Directions of their slips, shape (slaves, 2, 3).
        """
        own = sums.carried(multiplier, frame, self.tangents)
        given, _ = self._elements(x, own)
        return compiled.over_obstacle(self.tangents, given, sums.how(multiplier, frame))

    def evaluate(self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray) -> Measured:
        """Residual and tangent of (x, lambda_N, lambda_T) in [kg m] and [m], gap and slip."""
        (residual, tangent, *slip), middle = self._elements(x, multiplier)
        gap = residual[:, 3].copy()
        if not slip:
            return Measured(residual, tangent, gap)
        normal = np.asarray(middle, dtype=np.float64)
        return Measured(residual, tangent, gap, Slip(*slip), np.broadcast_to(normal, (len(x), 3)))

    def _elements(
        self, x: FloatArray, multiplier: FloatArray
    ) -> tuple[list[FloatArray], FloatArray]:
        """What `compiled_law.obstacle` gives, and normals (n, 3) where friction acts."""
        master, end, direct = self.obstacle, self.obstacle.gap(x[:, 0]), self.rule == "direct"
        # Without friction nothing but the direct rule asks for the middle.
        middle = end
        if direct or multiplier.shape[1] > 1:
            middle = master.gap((self.start + self.theta * (x - self.start))[:, 0])
        if direct:
            rule = middle.gradient[:, 0], self.theta * middle.hessian
        else:
            rule = master.discrete_gradient(self.start[:, 0], x[:, 0])
        found: list[FloatArray] = compiled_law.obstacle(
            self.theta, rule, (end.value, end.gradient[:, 0]),
            (middle.gradient[:, 0], middle.hessian),
            self.normal, self.tangents, (x - self.start)[:, 0], multiplier,
        )  # fmt: skip
        return found, middle.gradient[:, 0]
