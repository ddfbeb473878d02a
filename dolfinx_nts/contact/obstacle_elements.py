"""Contact of nodes with a rigid obstacle in one step: the element without a facet.

Everything is in the pair's frame and relative to the obstacle's motion c(t), so that a moving
obstacle is one at rest to the element; only the balance learns of its work.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_laws import Contribution
from dolfinx_nts.contact.coulomb import Slip
from dolfinx_nts.contact.obstacles import Obstacle, inverse
from dolfinx_nts.kernels import compiled_law
from dolfinx_nts.kernels.nts_element import Gap
from dolfinx_nts.kernels.vectors import cross

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False, kw_only=True)
class ObstacleElements(ContactElements):
    """Candidates of a surface and an obstacle.

    lambda_N, and with friction lambda_T, are all its unknowns for any integrator: the discrete
    gradient is in closed form.

    Attributes:
        obstacle: The master relative to the pair's origin.
        x0: Slave at t_n relative to the obstacle's motion [m], shape (n, 1, 3).
        displacement: c(t_n) and c(t_{n+1}) [m], shape (2, 3).
    """

    obstacle: Obstacle
    displacement: FloatArray

    @property
    def num_control(self) -> int:
        """None."""
        return 0

    @property
    def master_nodes(self) -> None:
        """None."""
        return None

    @property
    def _master_fixed(self) -> BoolArray:
        return np.empty((self.num_elements, 0, 3), dtype=bool)

    @property
    def immovable(self) -> BoolArray:
        """All are."""
        return np.ones(self.num_elements, dtype=bool)

    @property
    def _ease(self) -> FloatArray:
        return np.zeros(self.num_elements)

    @property
    def foot(self) -> FloatArray:
        """No weights."""
        return np.empty((self.num_elements, 0))

    def gap(self, x: FloatArray) -> FloatArray:
        """Gap [m] of slaves at t_{n+1}, shape (n, 1, 3)."""
        value: FloatArray = self.obstacle.gap(x[:, 0] - self.displacement[1]).value
        return value

    def _control(self, y: FloatArray) -> FloatArray:
        """Slave relative to the obstacle's motion, shape (n, 1, 3)."""
        return super()._control(y) - self.displacement[1]

    @property
    def extent(self) -> float:
        """Size of the slave, the obstacle and its path [m]."""
        extent: float = self.pair.extent + self.obstacle.extent
        return extent + float(np.abs(self.displacement).max())

    def external_work(self, part: Contribution) -> float:
        """h^2/2 times the work of the contact forces on the obstacle's path [kg m^2]."""
        path = self.displacement[1] - self.displacement[0]
        return float((part.force @ path).sum())

    @cached_property
    def _tangents(self) -> FloatArray:
        """Orthonormal directions along the surface at t_n, shape (n, 2, 3)."""
        normal = self.candidates.normal
        first = cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
        first *= inverse(np.linalg.norm(first, axis=1))[:, None]
        return np.stack([first, cross(normal, first)], axis=1)

    def _middle(self, x: FloatArray) -> Gap:
        """Gap and normal where the contact force acts."""
        gap: Gap = self.obstacle.gap((self.x0 + self.theta * (x - self.x0))[:, 0])
        return gap

    def _normal(self, x: FloatArray) -> FloatArray:
        normal = np.asarray(self._middle(x).gradient[:, 0], dtype=np.float64)
        return np.broadcast_to(normal, (len(x), 3))

    def _element(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """Residual and tangent of (x, lambda_N, lambda_T) in [kg m] and [m], gap and slip."""
        master, end = self.obstacle, self.obstacle.gap(x[:, 0])
        # Without friction nothing but the direct rule asks for the middle.
        middle = self._middle(x) if self.direct or self.num_tangential else end
        if self.direct:
            rule = middle.gradient[:, 0], self.theta * middle.hessian
        else:
            rule = master.discrete_gradient(self.x0[:, 0], x[:, 0])
        found = compiled_law.obstacle(
            self.theta, rule, (end.value, end.gradient[:, 0]),
            (middle.gradient[:, 0], middle.hessian),
            self.candidates.normal, self._tangents, (x - self.x0)[:, 0], multiplier,
        )  # fmt: skip
        if found is None:
            return self._assembled(rule, end, middle, x, multiplier)
        residual, tangent, *slip = found
        return residual, tangent, residual[:, 3].copy(), Slip(*slip) if slip else None

    def _assembled(
        self,
        rule: tuple[FloatArray, FloatArray],
        end: Gap,
        middle: Gap,
        x: FloatArray,
        multiplier: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """`_element` of the gap and its derivatives, as `compiled_law.obstacle` does it."""
        normal, (gradient, slope) = multiplier[:, :1], rule
        residual = np.zeros((self.num_elements, 3 + self.num_constraints))
        tangent = np.zeros((*residual.shape, residual.shape[1]))
        residual[:, :3], residual[:, 3] = normal * gradient, end.value
        tangent[:, :3, :3] = normal[:, :, None] * slope
        tangent[:, :3, 3], tangent[:, 3, :3] = gradient, end.gradient[:, 0]
        slip = None
        if self.num_tangential:
            slip = self._add_friction(residual, tangent, middle, x, multiplier)
        return residual, tangent, end.value, slip

    def _add_friction(
        self,
        residual: FloatArray,
        tangent: FloatArray,
        middle: Gap,
        x: FloatArray,
        multiplier: FloatArray,
    ) -> Slip:
        """Add lambda_T t^a to the rows of x; returns the slip Df^a = t^a . (x_1 - x_0).

        t_a are the directions e_a of `_tangents` less their part along the normal n where the force
        acts. Dual to them are t^a = e_a - n_0 (n . e_a) / (n . n_0), which lie along the surface,
        too, and t^a . t_b = t^a . e_b = 1 or 0, because n_0 . e_b = 0.
        """
        motion, e = (x - self.x0)[:, 0], self._tangents
        normal, n0, t = middle.gradient[:, 0], self.candidates.normal, multiplier[:, -2:]
        part, turn = np.einsum("nai,ni->na", e, normal), self.theta * np.matmul(e, middle.hessian)
        per_height = inverse(np.einsum("ni,ni->n", normal, n0))[:, None]
        tilt = part * per_height
        n0_turn = self.theta * np.einsum("ni,nij->nj", n0, middle.hessian)
        tilt_gradient = (turn - tilt[:, :, None] * n0_turn[:, None]) * per_height[:, :, None]
        dual = e - tilt[:, :, None] * n0[:, None]

        residual[:, :3] += np.einsum("na,nai->ni", t, dual)
        tangent[:, :3, :3] -= n0[:, :, None] * np.einsum("na,naj->nj", t, tilt_gradient)[:, None]
        tangent[:, :3, -2:] = dual.transpose(0, 2, 1)
        gradient = np.zeros((self.num_elements, 2, residual.shape[1]))
        rise = np.einsum("ni,ni->n", n0, motion)[:, None, None]
        gradient[..., :3] = dual - rise * tilt_gradient
        metric_gradient = np.zeros((self.num_elements, 2, 2, residual.shape[1]))
        half = -part[:, :, None, None] * turn[:, None]
        metric_gradient[..., :3] = half + half.transpose(0, 2, 1, 3)
        metric = np.eye(2) - part[:, :, None] * part[:, None]
        return Slip(np.einsum("nai,ni->na", dual, motion), gradient, metric, metric_gradient)
