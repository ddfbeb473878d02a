"""The constraints that keep directors orthonormal (theory sections 12 and 15)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinx_nts.interaction.constraint_elements import Equations
from dolfinx_nts.interaction.constraints import Constraints
from dolfinx_nts.interaction.coupling import Joint
from dolfinx_nts.types import FloatArray, IntArray

if TYPE_CHECKING:
    from dolfinx_nts.interaction.points import Points


#: Directors whose products are held, of a triad and of one alone.
_PAIRS = {3: ((1, 1), (2, 2), (3, 3), (1, 2), (2, 3), (3, 1)), 1: ((1, 1),)}


class Directors(Joint):
    """Keep three directors, or one, of each node orthonormal.

    (D_i . D_j - l^2 delta_ij)/(2 l) = 0.

    Args:
        body: The body.
        nodes: Its nodal vectors, a place and directors of each node on this rank.
        length: l [m].
        numbers: Of each node in the body, whatever the ranks, shape (n,).
    """

    def __init__(self, body: Any, nodes: Points, length: float, numbers: IntArray) -> None:
        self.name, self.bodies, self._side = f"{body.name} directors", (body,), nodes
        n, width = nodes.nodes.shape
        self.numbers, self._count = numbers, width - 1
        pairs = _PAIRS[self._count]
        m = len(pairs)
        weights, target = np.zeros((n, m, 2, width)), np.zeros((n, m))
        for k, (i, j) in enumerate(pairs):
            weights[:, k, 0, i] = 0.5 / length
            weights[:, k, 1, j] = 1.0
            target[:, k] = 0.5 * length * (i == j)
        self._equations = Equations(weights, np.zeros((n, m, 2, 3)), target)

    def coupling(self, bodies: tuple[int, ...]) -> Constraints:
        """Its constraints in a run; a triad may be solved by its mirror image, one vector not."""
        triads = self._count == 3
        return Constraints(
            self.name, bodies, [self._side], self._equations, redundant=False,
            upright=_handedness if triads else None,
        )  # fmt: skip

    def largest_turn(self, y0: FloatArray, y1: FloatArray) -> float:
        """Largest of `turns_of` between two places of the body on this rank [rad]."""
        return float(turns_of(y0, y1, self._count).max(initial=0.0))


def _handedness(y: FloatArray, _: tuple[float, ...]) -> FloatArray:
    """Determinants of triads, which turn over to negative ones, shape (n,)."""
    return np.linalg.det(y[:, 1:])


def turns_of(y0: FloatArray, y1: FloatArray, count: int) -> FloatArray:
    """Angles [rad], up to half a turn, by which directors turn between two places, shape (n,).

    Args:
        y0: Nodal vectors, a place and `count` directors of each node [m], shape (3 k n,).
        y1: The same of the other place.
        count: 3, or 1.
    """
    a, b = (y.reshape(-1, 1 + count, 3)[:, 1:] for y in (y0, y1))
    # D_i . D_i' = l^2 (1 + 2 cos) in the sum of three, without a turn 3 l^2.
    cosine = np.einsum("nij,nij->n", a, b) / np.einsum("nij,nij->n", a, a)
    if count == 3:
        cosine = 1.5 * cosine - 0.5
    return np.arccos(np.clip(cosine, -1.0, 1.0))
