"""Lengths of the scene and of its bodies in a step, which tolerances and guards are measured by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.system import System

FloatArray = npt.NDArray[np.float64]


class Lengths:
    """Lengths of a scene [m], the same on all ranks; `begin` measures a step.

    Args:
        system: The scene.

    Attributes:
        centre: Middle of all bodies in the reference, shape (3,).
        radius: Half the diagonal of the box around them.
        director: The longest one of all bodies, about the size of the largest rigid one.
        motion: Largest motion of a point of each body that is predicted, shape (bodies,).
        extent: Largest coordinate, likewise.
        moved: Largest displacement at t_n, likewise.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self.centre, self.radius, self.director = _box(system)
        self.motion, self.extent, self.moved = np.zeros((3, len(system.bodies)))

    def begin(self, state: State, first: Sequence[FloatArray], dt: float) -> FloatArray:
        """Measure a step. Collective.

        Args:
            state: State at t_n.
            first: Owned displacements of each body at t_{n+1} that are predicted [m].
            dt: Step [s].

        Returns:
            Largest speed of each body [m/s], shape (bodies,).
        """
        system = self._system
        local = [
            [
                b.motion_of_points(u1 - u),
                *(np.abs(x).max(initial=0.0) for x in (b.reference + u1, v, u)),
            ]
            for b, u1, u, v in zip(system.bodies, first, state.u, state.v, strict=True)
        ]
        found = global_max(system.comm, np.array(local)).T
        self.motion, self.extent, speed, self.moved = found
        if state.a:
            local = [np.abs(dt * a).max(initial=0.0) for a in state.a]
            speed = np.maximum(speed, global_max(system.comm, np.array(local)))
        return speed

    def displaced(self, fall: float) -> FloatArray:
        """Displacement of each body in the step, at most, shape (bodies,).

        Args:
            fall: What a body at rest may fall [m].
        """
        length: FloatArray = self.moved + self.motion + fall
        # A body at rest beside a moving one gets the rounding of the linear solve for both.
        for bodies in map(list, (*self._system.contact_bodies, *self._system.joint_bodies)):
            length[bodies] = length[bodies].max()
        return length

    @property
    def span(self) -> float:
        """Distance of the bodies' farthest coordinate from `centre`, at most."""
        return self.radius + self.director + float((self.moved + self.motion).max())

    def motion_of(self, e: Evaluation) -> FloatArray:
        """Largest component of each body's motion in an evaluation, shape (bodies,). Collective."""
        both = zip(self._system.bodies, e.bodies, strict=True)
        local = [body.motion_of_points(terms.du) for body, terms in both]
        return global_max(self._system.comm, np.array(local))

    def displacement_of(self, e: Evaluation) -> FloatArray:
        """Largest displacement of each body in an evaluation, shape (bodies,). Collective.

        An iterate that runs off excuses no more than the positions would.
        """
        local = np.array([np.abs(terms.u1).max(initial=0.0) for terms in e.bodies])
        return np.minimum(global_max(self._system.comm, local), self.extent + self.moved)


def _box(system: System) -> tuple[FloatArray, float, float]:
    """Middle of the box around all bodies' places, half its diagonal, longest director [m].

    All in the reference. Collective.
    """
    ends = np.full((3, 3), -np.inf)
    ends[2] = 0.0
    for body in system.bodies:
        x = body.reference.reshape(-1, 3)
        directors, x = x[~body.places], x[body.places]
        np.maximum(ends[0], x.max(axis=0, initial=-np.inf), out=ends[0])
        np.maximum(ends[1], (-x).max(axis=0, initial=-np.inf), out=ends[1])
        ends[2, 0] = max(ends[2, 0], np.linalg.norm(directors, axis=1).max(initial=0.0))
    high, low, (directors, *_) = global_max(system.comm, ends) * [[1.0], [-1.0], [1.0]]
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)), float(directors)
