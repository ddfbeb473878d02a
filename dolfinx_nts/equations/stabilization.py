"""What holds bodies in the load steps of equilibrium while nothing else does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

#: Where all bodies are rigid, contact takes them to give way under their loads by this part of
#: their size. Of gaps that repeat each other an iteration leaves the change of the forces over this
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

    def of(self, body: Body) -> FloatArray:
        """Stiffness of the springs of a body [N/m], shape (num_owned,). Collective."""
        # Bodies in search of each other cross the scene.
        stiffness = self.share * self._around(body, self._span)
        stiffness[body.fixed] = 0.0
        return stiffness

    def stiffness(self, body: Body, among: Sequence[Any] = ()) -> FloatArray:
        """Stiffness of each coordinate's surroundings [N/m], what contact is scaled by. Collective.

        Where there is none, of the others. Between rigid bodies it is no less than what holds
        these: a soft body elsewhere in the scene does not make their contact soft.
        """
        rigid = bool(among) and all(b.rigid for b in among)
        return self._around(body, _YIELD * self._size, rigid)

    def _around(self, body: Body, way: float, rigid: bool = False) -> FloatArray:
        """Of each coordinate's surroundings [N/m]; rigid ones give way by `way` [m]. Collective."""
        own: FloatArray = body.nodal_stiffness()
        others = self._of_flexible
        if rigid or not others:
            held = self._of_springs + _over(self._weight, way) or _over(self._of_loads(), way)
            # Nothing moves what nothing pushes: any number does there.
            others = max(others, held) or 1.0
        return np.where(own > 0.0, own, others)

    @cached_property
    def _of_flexible(self) -> float:
        """Of all flexible bodies in the mean [N/m]. Collective."""
        local = np.zeros(2)
        for body in self._system.bodies:
            own = body.nodal_stiffness()
            local += own.sum(), np.count_nonzero(own)
        total, number = self._system.comm.allreduce(local).tolist()
        return float(total / number) if number else 0.0

    @cached_property
    def _weight(self) -> float:
        """Of all bodies [N]. Collective."""
        masses = sum(float(body.nodal_mass.max(initial=0.0)) for body in self._system.bodies)
        gravity = float(np.linalg.norm(self._system.gravity))
        return float(self._system.comm.allreduce(masses)) * gravity

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


def _over(force: float, way: float) -> float:
    return force / way if force and way else 0.0
