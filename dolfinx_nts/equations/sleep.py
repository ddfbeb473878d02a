"""Bodies that no force moves: a step can leave them out while they rest beyond every contact."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from mpi4py import MPI

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.parallel import everywhere
from dolfinx_nts.types import FloatArray


class Sleepers:
    """Finds the bodies at rest whose forces balance, at the price of their loads in each step.

    Internal forces are evaluated once for all steps in which a body rests at the same place.
    """

    def __init__(self, bodies: Sequence[Body], comm: MPI.Comm) -> None:
        self._bodies, self._comm = bodies, comm
        self._known: dict[int, tuple[FloatArray, FloatArray]] = {}

    def find(
        self,
        chosen: Iterable[int],
        u: Sequence[FloatArray],
        gravity: FloatArray,
        rounding: Callable[[int], float],
    ) -> dict[int, tuple[FloatArray, FloatArray]]:
        """Those of the bodies whose forces balance. Collective; `begin_step` comes before.

        Args:
            chosen: Numbers of bodies at rest, the same on all ranks.
            u: Owned displacements of all bodies [m].
            gravity: Acceleration [m/s^2], shape (3,).
            rounding: Of a body, the norm of forces that is none [N].

        Returns:
            Number of the body -> its internal and external forces [N].
        """
        found = {}
        for k in chosen:
            body, internal = self._bodies[k], self._internal(k, u[k])
            external = body.external(u[k], gravity)
            force = internal - external
            force[body.fixed] = 0.0
            if np.sqrt(self._comm.allreduce(float(force @ force))) <= rounding(k):
                found[k] = internal, external
        return found

    def forget(self) -> None:
        """Evaluate internal forces anew: what they depend on beside u has changed."""
        self._known.clear()

    def _internal(self, k: int, u: FloatArray) -> FloatArray:
        known = k in self._known and np.array_equal(self._known[k][0], u)
        if not everywhere(self._comm, known):
            self._known[k] = u, self._bodies[k].internal(u)
        return self._known[k][1]
