"""What holds bodies in the load steps of equilibrium while nothing else does."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.system import System

FloatArray = npt.NDArray[np.float64]

#: Contact takes rigid bodies to give way under their loads by no more than this part of their
#: size. Of gaps that repeat each other an iteration leaves the change of the forces over this
#: stiffness, in their sizes (`constraints.SHIFT`). With the weight over the size for it, gaps did
#: not shrink once a node had been let go: a block came to rest on its edge instead of its face.
_YIELD = 1e-4


class Stabilization:
    """Springs that hold each free coordinate at t_n with a part of the stiffness around it.

    Args:
        system: The scene.
        span: Size of the scene [m].
        size: Of its largest rigid body, or of the scene [m].
        largest_load: Asks for the largest load on a coordinate, all of its ramp [N]. Collective.

    Attributes:
        share: That part [-], zero in dynamics.
    """

    def __init__(
        self, system: System, span: float, size: float, largest_load: Callable[[], float]
    ) -> None:
        self._system, self._span, self._size = system, span, size
        self._largest_load = largest_load
        self._load = 0.0
        self.share = 0.0

    def of(self, body: Any) -> FloatArray:
        """Stiffness of the springs of a body [N/m], shape (num_owned,). Collective."""
        # Bodies in search of each other cross the scene.
        others = self._of_flexible or self._of_rigid(self._span)
        stiffness = self.share * _around(body, others)
        stiffness[body.fixed] = 0.0
        return stiffness

    def stiffness(self, body: Any) -> FloatArray:
        """Stiffness of each coordinate's surroundings [N/m], what contact is scaled by. Collective.

        Where there is none, of the others, but no less than what holds rigid bodies in their place.
        """
        return _around(body, max(self._of_flexible, self._of_rigid(_YIELD * self._size)))

    @cached_property
    def _of_flexible(self) -> float:
        """Of all flexible bodies in the mean [N/m]. Collective."""
        local = np.zeros(2)
        for body in self._system.bodies:
            own = body.nodal_stiffness()
            local += own.sum(), np.count_nonzero(own)
        total, number = self._system.comm.allreduce(local).tolist()
        return float(total / number) if number else 0.0

    def _of_rigid(self, way: float) -> float:
        """Of springs and of what gives way by `way` [m] under rigid bodies [N/m]. Collective."""
        number, weight = self._rigid
        if not number:
            return 0.0
        return self._of_springs + _over(weight, way) or _over(self._of_loads(), way)

    @cached_property
    def _rigid(self) -> tuple[float, float]:
        """Number of rigid bodies and their weight [N]. Collective."""
        local = np.zeros(2)
        for body in self._system.bodies:
            if body.num_owned and not body.nodal_stiffness().any():
                local += 1.0, float(body.nodal_mass.max(initial=0.0))
        number, mass = self._system.comm.allreduce(local).tolist()
        return float(number), float(mass) * float(np.linalg.norm(self._system.gravity))

    @cached_property
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
        """Largest load, the first that is any [N]. Collective."""
        # One number for all load steps, or the last relaxations would differ from the first.
        self._load = self._load or self._largest_load()
        return self._load


def _around(body: Any, others: float) -> FloatArray:
    own: FloatArray = body.nodal_stiffness()
    # Nothing moves what nothing pushes: any number does there.
    return np.where(own > 0.0, own, others or 1.0)


def _over(force: float, way: float) -> float:
    return force / way if force and way else 0.0
