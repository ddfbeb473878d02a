"""The six constraints that keep three directors orthonormal (theory section 12)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.constraints import Constraints, Equations

if TYPE_CHECKING:
    from dolfinx_nts.bodies.points import Points

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]


class Triads:
    """Keep directors of a body orthonormal: (D_i . D_j - l^2 delta_ij)/(2 l) = 0.

    Args:
        body: The body.
        nodes: Its nodal vectors phi and D_1, D_2, D_3 of each triad on this rank.
        length: l [m].
        numbers: Of each triad in the body, whatever the ranks, shape (n,).
    """

    losses: tuple[str, ...] = ()

    def __init__(self, body: Any, nodes: Points, length: float, numbers: IntArray) -> None:
        self.name, self.bodies, self._side = f"{body.name} directors", (body,), nodes
        n, self.numbers = len(nodes), numbers
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
        return Constraints(
            self.name, bodies, [self._side], self._equations, redundant=False,
            upright=lambda y, _: np.linalg.det(y[:, 1:]),
        )  # fmt: skip


def largest_turn(y0: FloatArray, y1: FloatArray) -> float:
    """Largest angle [rad], up to half a turn, between two places of triads on this rank.

    Args:
        y0: Nodal vectors phi and D_1, D_2, D_3 of each triad [m], shape (12 n,).
        y1: The same of the other place.
    """
    a, b = (y.reshape(-1, 4, 3)[:, 1:] for y in (y0, y1))
    if not len(a):
        return 0.0
    # D_i . D_i' = l^2 (1 + 2 cos) in the sum, without a turn 3 l^2.
    along = np.einsum("nij,nij->n", a, b) / np.einsum("nij,nij->n", a, a)
    return float(np.arccos(np.clip(1.5 * along - 0.5, -1.0, 1.0)).max())
