"""Constraints at most quadratic in nodal vectors: values and gradients (theory section 11).

Each is a product v . w of two vectors that are linear in the nodal vectors, v = V_a y_a + v_0. They
are formed before they are multiplied: a difference of points far from the origin keeps its digits.
"""

from __future__ import annotations

import numpy as np

from dolfinx_nts.arrays import FloatArray


def factors(weights: FloatArray, constants: FloatArray, y: FloatArray) -> FloatArray:
    """Both factors of each constraint.

    Args:
        weights: V and W, shape (n, m, 2, k).
        constants: v_0 and w_0, shape (n, m, 2, 3).
        y: Nodal vectors [m], shape (n, k, 3).

    Returns:
        v and w, shape (n, m, 2, 3).
    """
    n, m, _, k = weights.shape
    # One product for all constraints of an element: numpy takes as long for each small one.
    products = np.matmul(weights.reshape(n, 2 * m, k), y)
    found: FloatArray = products.reshape(len(products), m, 2, 3) + constants
    return found


def value(vectors: FloatArray) -> FloatArray:
    """Their products v . w, shape (n, m)."""
    found: FloatArray = (vectors[:, :, 0] * vectors[:, :, 1]).sum(axis=2)
    return found


def gradient(weights: FloatArray, vectors: FloatArray) -> FloatArray:
    """V_a w + W_a v, the derivative of `value` by y_a, shape (n, m, k, 3)."""
    found: FloatArray = np.matmul(weights.transpose(0, 1, 3, 2), vectors[:, :, ::-1])
    return found


def curvature(weights: FloatArray) -> FloatArray:
    """V_a W_b + W_a V_b, the derivative of `gradient` by y_b times the identity, (n, m, k, k)."""
    one_way: FloatArray = weights[:, :, 0, :, None] * weights[:, :, 1, None, :]
    return one_way + one_way.transpose(0, 1, 3, 2)
