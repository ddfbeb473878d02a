"""Contact of nodes with a rigid obstacle in one step: the element without a facet.

Everything is in the pair's frame and relative to the obstacle's motion c(t), so that a moving
obstacle is one at rest to the element; only the balance learns of its work.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_laws import Contribution
from dolfinx_nts.contact.coulomb import Slip
from dolfinx_nts.contact.obstacles import Obstacle, inverse
from dolfinx_nts.kernels import compiled_law
from dolfinx_nts.kernels.nts_element import Gap
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.types import BoolArray, FloatArray


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
        residual, tangent, *slip = compiled_law.obstacle(
            self.theta, rule, (end.value, end.gradient[:, 0]),
            (middle.gradient[:, 0], middle.hessian),
            self.candidates.normal, self._tangents, (x - self.x0)[:, 0], multiplier,
        )  # fmt: skip
        return residual, tangent, residual[:, 3].copy(), Slip(*slip) if slip else None
