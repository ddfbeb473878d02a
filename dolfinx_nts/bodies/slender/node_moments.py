"""Moments on nodes of beams and shells: they push the directors."""

from __future__ import annotations

import numpy as np

from dolfinx_nts.types import Array, FloatArray, IntArray


class NodeMoments:
    """Moments of a step on this rank's nodes.

    The force tau x D_i / l^2 does the work of tau in turns about what is across d_i; of three
    directors each turn is across two.

    Args:
        turned: This rank's nodes on which moments act, shape (m,).
        width: Coordinates of a node.
        length: Of the directors [m].
    """

    def __init__(self, turned: IntArray, width: int, length: float) -> None:
        self.turned, self._width = turned, width
        self._square = length**2 * (2.0 if width > 6 else 1.0)

    def begin(self, tau: FloatArray) -> None:
        """Set the moments of a step [N m], shape (m, 3)."""
        x, y, z = tau.T / self._square
        none = np.zeros(len(tau))
        rows = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1)
        self._turning = rows.reshape(-1, 3, 3)

    def at(self, values: Array) -> Array:
        """Values at the directors of these nodes, (m, directors, 3), from those of this rank."""
        rows = values.reshape(-1, self._width)[self.turned, 3:]
        return rows.reshape(len(self.turned), self._width // 3 - 1, 3)

    def push(self, y: FloatArray) -> FloatArray:
        """Forces on the directors [N], shape (m, 3 directors), from this rank's vectors [m]."""
        forces = np.matmul(self.at(y), -self._turning)
        return forces.reshape(len(self.turned), self._width - 3)

    def slopes(self) -> FloatArray:
        """Derivatives of the forces by their director, negative [N/m], shape (m, 1, 3, 3)."""
        return -self._turning[:, None]
