"""Constraints at most quadratic in nodal vectors: values and gradients (theory section 11)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def value(quadratic: FloatArray, linear: FloatArray, y: FloatArray) -> FloatArray:
    """1/2 Q_ab y_a . y_b + L_a . y_a of each constraint.

    Args:
        quadratic: Q, symmetric, shape (n, m, k, k).
        linear: L, shape (n, m, k, 3).
        y: Nodal vectors [m], shape (n, k, 3).

    Returns:
        Shape (n, m).
    """
    products = np.matmul(y, y.transpose(0, 2, 1))
    found: FloatArray = 0.5 * np.einsum("nmab,nab->nm", quadratic, products)
    found += np.einsum("nmai,nai->nm", linear, y)
    return found


def gradient(quadratic: FloatArray, linear: FloatArray, y: FloatArray) -> FloatArray:
    """Q_ab y_b + L_a, the derivative of `value` by y_a, shape (n, m, k, 3)."""
    found: FloatArray = np.matmul(quadratic, y[:, None]) + linear
    return found
