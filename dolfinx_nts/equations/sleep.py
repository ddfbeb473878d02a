"""Bodies that no force moves: a step can leave them out while they rest beyond every contact."""

from __future__ import annotations

from collections.abc import Sequence, Set

import numpy as np

from dolfinx_nts.equations.couplings import Couplings
from dolfinx_nts.equations.loads import Loads
from dolfinx_nts.equations.scales import Rounding
from dolfinx_nts.parallel import everywhere
from dolfinx_nts.system import System
from dolfinx_nts.types import BoolArray, FloatArray


class Sleepers:
    """The bodies that a step leaves out, at the price of the loads on those at rest in each step.

    Internal forces are evaluated once for all steps in which a body rests at the same place.

    Args:
        system: The scene.
        couplings: All that makes elements.
        loads: When a step takes which loads.

    Attributes:
        forces: Of each by its number, the internal and external forces [N], which balance.
    """

    def __init__(self, system: System, couplings: Couplings, loads: Loads) -> None:
        self._bodies, self._comm, self._batches = system.bodies, system.comm, system.batches
        self._couplings, self._loads = couplings, loads
        self._known: dict[int, tuple[FloatArray, FloatArray]] = {}
        self.forces: dict[int, tuple[FloatArray, FloatArray]] = {}

    def find(self, rest: BoolArray, u: Sequence[FloatArray], rounding: Rounding) -> None:
        """Leave out the bodies at rest that neither force nor contact may move. Collective.

        Args:
            rest: Which bodies rest, shape (bodies,), the same on all ranks.
            u: Owned displacements of all bodies [m].
            rounding: Of forces, which are none.
        """
        for k in sorted(set(np.flatnonzero(rest).tolist()) - self._couplings.touched()):
            if self._batches.batch_of(k) < len(self._batches.several):
                self._loads.tell(k)
            body, internal = self._bodies[k], self._internal(k, u[k])
            external = body.external(u[k], self._loads.gravity)
            force = internal - external
            force[body.fixed] = 0.0
            size = np.sqrt(self._comm.allreduce(float(force @ force)))
            if size <= rounding.at_rest(k):
                self.forces[k] = internal, external
        self._couplings.rest(self.forces)

    def rouse(self, bodies: Set[int]) -> None:
        """Take bodies into the step that were left out. Collective."""
        for k in bodies:
            del self.forces[k]
        self._couplings.rouse(bodies)

    def awake(self) -> tuple[int, ...]:
        """Numbers of the bodies in the step, one at least. Collective."""
        if len(self.forces) == len(self._bodies):
            # SNES needs an unknown; at rest it takes no iteration.
            self.rouse({0})
        return tuple(k for k in range(len(self._bodies)) if k not in self.forces)

    def forces_on(self, bodies: Sequence[int]) -> list[FloatArray]:
        """Internal and external forces on several that sleep [N], one after the other."""
        both = zip(*(self.forces[k] for k in bodies), strict=True)
        return [np.concatenate(own) for own in both]

    def forget(self) -> None:
        """Evaluate internal forces anew: what they depend on beside u has changed."""
        self._known.clear()

    def _internal(self, k: int, u: FloatArray) -> FloatArray:
        known = k in self._known and np.array_equal(self._known[k][0], u)
        if not everywhere(self._comm, known):
            self._known[k] = u, self._bodies[k].internal(u)
        return self._known[k][1]
