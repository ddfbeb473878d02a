"""Lengths of the scene and of its bodies in a step, which tolerances and guards are measured by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinx_nts.arrays import FloatArray
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_max
from dolfinx_nts.system import System


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
        self._batches = system.batches
        self.centre, self.radius, self.director = box_of(system)
        self.motion, self.extent, self.moved = np.zeros((3, len(system.bodies)))
        links = (*system.contact_bodies, *system.joint_bodies)
        self._linked = [list(bodies) for bodies in links if len(bodies) > 1]

    def begin(
        self,
        u: Sequence[FloatArray],
        rates: Sequence[Sequence[FloatArray]],
        first: Sequence[FloatArray],
    ) -> FloatArray:
        """Measure a step. Collective.

        Args:
            u: Displacements of each batch at t_n [m].
            rates: Velocities then and, of schemes that carry them, accelerations times the step
                [m/s].
            first: Displacements at t_{n+1} that are predicted [m].

        Returns:
            Largest speed of each body [m/s], shape (bodies,).
        """
        batches = self._batches
        du = [u1 - u0 for u1, u0 in zip(first, u, strict=True)]
        places = [b.reference + u1 for b, u1 in zip(batches.bodies, first, strict=True)]
        local = [batches.motions(du), *map(batches.largest, (places, u, *rates))]
        found = global_max(batches.comm, np.array(local))
        self.motion, self.extent, self.moved = found[:3]
        speed: FloatArray = found[3:].max(axis=0)
        return speed

    def displaced(self, fall: float) -> FloatArray:
        """Displacement of each body in the step, at most, shape (bodies,).

        Args:
            fall: What a body at rest may fall [m].
        """
        length: FloatArray = self.moved + self.motion + fall
        # A body at rest beside a moving one gets the rounding of the linear solve for both.
        linked = length.tolist()  # numbers one by one are faster outside of NumPy
        for bodies in self._linked:
            longest = max(linked[k] for k in bodies)
            for k in bodies:
                linked[k] = longest
        return np.array(linked)

    @property
    def span(self) -> float:
        """Distance of the bodies' farthest coordinate from `centre`, at most."""
        return self.radius + self.director + float((self.moved + self.motion).max())

    def motion_of(self, e: Evaluation) -> FloatArray:
        """Largest component of each body's motion in an evaluation, shape (bodies,). Collective."""
        return global_max(self._batches.comm, self._batches.motions([t.du for t in e.terms]))

    def displacement_of(self, e: Evaluation) -> FloatArray:
        """Largest displacement of each body in an evaluation, shape (bodies,). Collective.

        An iterate that runs off excuses no more than the positions would.
        """
        local = self._batches.largest([terms.u1 for terms in e.terms])
        return np.minimum(global_max(self._batches.comm, local), self.extent + self.moved)


def box_of(system: System) -> tuple[FloatArray, float, float]:
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
