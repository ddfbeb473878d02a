"""The six constraints that keep a rigid body's directors orthonormal (theory section 12)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.constraints import Constraints, Equations

if TYPE_CHECKING:
    from dolfinx_nts.bodies.rigid import RigidBody

FloatArray = npt.NDArray[np.float64]


class Triad:
    """Keeps the directors of a rigid body orthonormal: (D_i . D_j - l^2 delta_ij)/(2 l) = 0.

    Args:
        body: The body.
    """

    losses: tuple[str, ...] = ()

    def __init__(self, body: RigidBody) -> None:
        self.name, self.bodies = f"{body.name} directors", (body,)
        n, length = int(body.comm.rank == body.owner), body.length
        self._side = body.points(body.centre).part(slice(0, n))
        weights, target = np.zeros((n, 6, 2, 4)), np.zeros((n, 6))
        for m, (i, j) in enumerate([(1, 1), (2, 2), (3, 3), (1, 2), (2, 3), (3, 1)]):
            weights[:, m, 0, i] = 0.5 / length
            weights[:, m, 1, j] = 1.0
            target[:, m] = 0.5 * length * (i == j)
        self._equations = Equations(weights, np.zeros((n, 6, 2, 3)), target)

    def start(self) -> None:
        """Nothing to remember."""
        return None

    def potential(self, u: Sequence[FloatArray], history: Any) -> float:
        """None [J]."""
        return 0.0

    def coupling(self, bodies: tuple[int, ...]) -> Constraints:
        """Its constraints in a run."""
        return Constraints(self.name, bodies, [self._side], self._equations, redundant=False)
