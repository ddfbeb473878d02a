"""What holds bodies in the load steps of equilibrium while nothing else does."""

from __future__ import annotations

from collections.abc import Callable
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
        largest_load: Asks for the largest load on a coordinate, all of its ramp [N]. Collective.

    Attributes:
        share: That part [-], zero in dynamics.
    """

    def __init__(self, system: System, span: float, largest_load: Callable[[], float]) -> None:
        self._system, self._span, self._largest_load = system, span, largest_load
        self._load = 0.0
        self.share = 0.0

    def of(self, body: Any) -> FloatArray:
        """Stiffness of the springs of a body [N/m], shape (num_owned,)."""
        stiffness = self.share * self.stiffness(body)
        stiffness[body.fixed] = 0.0
        return stiffness

    def stiffness(self, body: Any) -> FloatArray:
        """Stiffness of each coordinate's surroundings [N/m]; where there is none, of the others."""
        own: FloatArray = body.nodal_stiffness()
        # Nothing moves what nothing pushes: any number does there.
        return np.where(own > 0.0, own, self._of_others or self._of_loads() or 1.0)

    @cached_property
    def _of_others(self) -> float:
        """Of all flexible bodies in the mean, or of springs beside weight [N/m]. Collective."""
        system = self._system
        local = np.zeros(3)
        for body in system.bodies:
            own = body.nodal_stiffness()
            local += own.sum(), np.count_nonzero(own), body.nodal_mass.max(initial=0.0)
        total, number, mass = system.comm.allreduce(local).tolist()
        if number:
            return float(total / number)
        return self._of_springs() + self._over_span(mass * float(np.linalg.norm(system.gravity)))

    def _of_springs(self) -> float:
        """Of all springs in the mean, as they are in the reference [N/m]. Collective."""
        found, comm = [], self._system.comm
        for joint in self._system.joints:
            still = [np.zeros(body.num_owned) for body in joint.bodies]
            slopes = joint.slopes(still, joint.start())
            if slopes is not None:
                own = max(np.abs(g).max(initial=0.0) for g in slopes.gradients)
                found.append(abs(slopes.stiffness) * max(comm.allgather(own)) ** 2)
        found = [stiffness for stiffness in found if stiffness]
        return float(np.mean(found)) if found else 0.0

    def _of_loads(self) -> float:
        """Largest load over the size of the scene, the first that is any [N/m]. Collective."""
        # One number for all load steps, or the last relaxations would differ from the first.
        self._load = self._load or self._largest_load()
        return self._over_span(self._load)

    def _over_span(self, force: float) -> float:
        return force / self._span if force and self._span else 0.0
