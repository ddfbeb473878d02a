"""Constraints and energies that are quadratic in nodal vectors (theory sections 11 and 15).

Each is a product v . w of two vectors that are linear in the nodal vectors, v = V_a y_a + v_0. They
are formed before they are multiplied: a difference of points far from the origin keeps its digits.

V = 1/2 (p - p_ref)^T H (p - p_ref) with products p, and H = sum S^T C S of strains
e = S (p - p_ref): 1/2 e^T C e of all points. D p(y_m)(y_1 - y_0) = p_1 - p_0 exactly, so that the
discrete gradient of V needs no quotient.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dolfinx_nts.types import BoolArray, FloatArray


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
    return products.reshape(len(products), m, 2, 3) + constants


def value(vectors: FloatArray) -> FloatArray:
    """Their products v . w, shape (n, m)."""
    return (vectors[:, :, 0] * vectors[:, :, 1]).sum(axis=2)


def gradient(weights: FloatArray, vectors: FloatArray) -> FloatArray:
    """V_a w + W_a v, the derivative of `value` by y_a, shape (n, m, k, 3)."""
    return np.matmul(weights.transpose(0, 1, 3, 2), vectors[:, :, ::-1])


def curvature(weights: FloatArray) -> FloatArray:
    """V_a W_b + W_a V_b, the derivative of `gradient` by y_b times the identity, (n, m, k, k)."""
    one_way: FloatArray = weights[:, :, 0, :, None] * weights[:, :, 1, None, :]
    return one_way + one_way.transpose(0, 1, 3, 2)


def pattern(weights: FloatArray, constants: FloatArray) -> BoolArray:
    """What can be non-zero in the second derivatives of sum lambda_i g_i by y and lambda.

    Args:
        weights: As of `factors`.
        constants: Likewise.

    Returns:
        Of all elements together, rows and columns of y, then of lambda, shape (3 k + m, 3 k + m).
    """
    m, k, taken = weights.shape[1], weights.shape[3], weights != 0.0
    # A factor without weights is a constant, which may have few components.
    other = (taken.any(axis=3)[..., None] | (constants != 0.0))[:, :, ::-1]
    gradients = (taken[..., None] & other[:, :, :, None]).any(axis=(0, 2)).reshape(m, 3 * k)
    bends = (curvature(weights) != 0.0).any(axis=(0, 1))
    corner = np.kron(bends, np.eye(3, dtype=bool))
    return np.block([[corner, gradients.T], [gradients, np.zeros((m, m), dtype=bool)]])


class Elements(NamedTuple):
    """Elements that are free of stress in the reference; axis 0 = element.

    Attributes:
        weights: Of the k nodal vectors in the factors of m products, shape (n, m, 2, k).
        rest: Products in the reference, shape (n, m).
        hessian: H, shape (n, m, m).
    """

    weights: FloatArray
    rest: FloatArray
    hessian: FloatArray


def elements(weights: FloatArray, hessian: FloatArray, y: FloatArray) -> Elements:
    """Elements with nodal vectors y (n, k, 3) in the reference [m]."""
    return Elements(weights, value(_factors(weights, y)), hessian)


def changes(of: Elements, y: FloatArray) -> FloatArray:
    """Products less those of the reference, shape (n, m)."""
    return value(_factors(of.weights, y)) - of.rest


def _factors(weights: FloatArray, y: FloatArray) -> FloatArray:
    return factors(weights, np.zeros((*weights.shape[:3], 3)), y)


def _gradient(of: Elements, y: FloatArray) -> FloatArray:
    """Derivative of the products by the nodal vectors, shape (n, m, 3 k)."""
    found = gradient(of.weights, _factors(of.weights, y))
    return found.reshape(*found.shape[:2], 3 * found.shape[2])


def energy(of: Elements, y: FloatArray) -> FloatArray:
    """V [J], shape (n,)."""
    change = changes(of, y)
    return 0.5 * np.einsum("ni,nij,nj->n", change, of.hessian, change)


def _stress(of: Elements, y0: FloatArray, y1: FloatArray, theta: float | None) -> FloatArray:
    """H (p - p_ref), shape (n, m), of the mean of both states, or of a place, see `force`."""
    if theta is None:
        change = 0.5 * (changes(of, y0) + changes(of, y1))
    else:
        change = changes(of, y0 + theta * (y1 - y0))
    return np.matmul(of.hessian, change[:, :, None])[:, :, 0]


def force(of: Elements, y0: FloatArray, y1: FloatArray, theta: float | None) -> FloatArray:
    """Forces between two states [N], shape (n, 3 k).

    Args:
        of: The elements.
        y0: Nodal vectors at t_n [m], shape (n, k, 3).
        y1: At t_{n+1}.
        theta: Where between them forces are those of the place; None: the discrete gradient
            De(y_m)^T C (e_0 + e_1)/2, whose work is the change of the energy.
    """
    place = y0 + (0.5 if theta is None else theta) * (y1 - y0)
    stress = _stress(of, y0, y1, theta)
    return np.matmul(stress[:, None], _gradient(of, place))[:, 0]


def tangent(of: Elements, y0: FloatArray, y1: FloatArray, theta: float | None) -> FloatArray:
    """Derivative of `force` by y_1 [N/m], shape (n, 3 k, 3 k)."""
    part = 0.5 if theta is None else theta
    change = _gradient(of, y0 + part * (y1 - y0))
    moved = change if theta is not None else _gradient(of, y1)
    found: FloatArray = np.matmul(change.transpose(0, 2, 1), np.matmul(part * of.hessian, moved))
    stress = part * _stress(of, y0, y1, theta)
    v, w = of.weights[:, :, 0], of.weights[:, :, 1]
    one_way = np.matmul((stress[:, :, None] * v).transpose(0, 2, 1), w)
    bend = one_way + one_way.transpose(0, 2, 1)
    for i in range(3):
        found[:, i::3, i::3] += bend
    return found
