"""What holds bodies in the load steps of equilibrium while nothing else does."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.system import System

FloatArray = npt.NDArray[np.float64]


class Stabilization:
    """Springs that hold each free coordinate at t_n with a part of the stiffness around it.

    Args:
        system: The scene.
        span: Size of the scene [m].

    Attributes:
        share: That part [-], zero in dynamics.
    """

    def __init__(self, system: System, span: float) -> None:
        self._system, self._span = system, span
        self.share = 0.0

    def of(self, body: Any) -> FloatArray:
        """Stiffness of the springs of a body [N/m], shape (num_owned,)."""
        stiffness = self.share * self.stiffness(body)
        stiffness[body.fixed] = 0.0
        return stiffness

    def stiffness(self, body: Any) -> FloatArray:
        """Stiffness of each coordinate's surroundings [N/m]; where there is none, of the others."""
        own: FloatArray = body.nodal_stiffness()
        return np.where(own > 0.0, own, self._mean)

    @cached_property
    def _mean(self) -> float:
        """Of all flexible bodies [N/m], or weight over size where all are rigid. Collective."""
        local = np.zeros(3)
        for body in self._system.bodies:
            own = body.nodal_stiffness()
            local += own.sum(), np.count_nonzero(own), body.nodal_mass.max(initial=0.0)
        total, number, mass = self._system.comm.allreduce(local).tolist()
        if number:
            return float(total / number)
        weight = mass * float(np.linalg.norm(self._system.gravity))
        return weight / self._span if weight and self._span else 1.0
