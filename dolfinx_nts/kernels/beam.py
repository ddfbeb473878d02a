"""Geometrically exact beam elements of two nodes or three (theory section 15).

Nodal vectors of an element are (phi, D_1, D_2, D_3) of its nodes as they follow each other, with
directors d_i = D_i / l. Strains are sums of products of vectors linear in them, at one point fewer
than nodes: more would lock in shear. Stretch is that of the axis alone: along the mean of the
nodes' directors it would be less where neighbouring sections turn against each other, so that a
pull would turn them.
"""

from __future__ import annotations

import numpy as np

from dolfinx_nts.kernels import quadratic as energy
from dolfinx_nts.types import FloatArray

#: d_3 and d_2 of K_1, and cyclic.
_CYCLES = ((3, 2), (1, 3), (2, 1))
#: Strains of a point from its products: Gamma_1 and Gamma_2 are one, E_33 half a one, K_i the
#: difference of two.
_SUMS = np.zeros((6, 9))
_SUMS[range(3), range(3)] = 1.0, 1.0, 0.5
_SUMS[range(3, 6), range(3, 9, 2)] = 1.0
_SUMS[range(3, 6), range(4, 9, 2)] = -1.0


def shapes(nodes: int, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """N_a (p, nodes) and their derivatives at points (p,) between -1 and 1, two nodes or three."""
    if nodes == 2:
        values = 0.5 * np.stack([1.0 - at, 1.0 + at], axis=1)
        return values, np.broadcast_to([-0.5, 0.5], values.shape)
    values = np.stack([0.5 * at * (at - 1.0), 1.0 - at**2, 0.5 * at * (at + 1.0)], axis=1)
    return values, np.stack([at - 0.5, -2.0 * at, at + 0.5], axis=1)


def stretches(x: FloatArray, at: FloatArray) -> FloatArray:
    """|dX/dxi| of elements at points [m], shape (n, p), by their nodes x (n, nodes, 3) [m]."""
    _, slopes = shapes(x.shape[1], at)
    return np.linalg.norm(np.einsum("pa,nai->npi", slopes, x), axis=2)


def points(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Points and weights of the strains, shape (nodes - 1,) each."""
    at, weights = np.polynomial.legendre.leggauss(nodes - 1)
    return at, weights


def beams(
    y: FloatArray, radius: float, stiffness: FloatArray
) -> tuple[energy.Elements, FloatArray]:
    """Elements that are free of stress in the reference.

    Gamma_i = d_i . phi' (i = 1, 2), E_33 = phi' . phi'/2, K_1 = (d_3 . d_2' - d_2 . d_3')/2 and
    cyclic.

    Args:
        y: Nodal vectors of the reference [m], shape (n, 4 nodes, 3).
        radius: Length l of the vectors D_i [m].
        stiffness: GA_1, GA_2, EA [N], EI_1, EI_2, GJ [N m^2], shape (6,).

    Returns:
        The elements, and int N_a N_b dS [m], shape (n, nodes, nodes).
    """
    nodes = y.shape[1] // 4
    at, parts = points(nodes)
    length = stretches(y[:, ::4], at)
    values, slopes = shapes(nodes, at)
    slope = slopes / length[:, :, None]
    # Points, products, factors, nodes, their vectors.
    weights = np.zeros((*length.shape, 9, 2, nodes, 4))
    weights[:, :, 2, :, :, 0] = slope[:, :, None]
    for i in range(3):
        if i < 2:
            weights[:, :, i, 0, :, i + 1], weights[:, :, i, 1, :, 0] = values / radius, slope
        for k, (a, b) in enumerate((_CYCLES[i], _CYCLES[i][::-1])):
            weights[:, :, 3 + 2 * i + k, 0, :, a] = 0.5 * values / radius
            weights[:, :, 3 + 2 * i + k, 1, :, b] = slope / radius
    n, p = length.shape
    hessian = np.zeros((n, p, 9, p, 9))
    of_point = _SUMS.T @ (stiffness[:, None] * _SUMS)
    for k in range(p):
        hessian[:, k, :, k] = (parts[k] * length[:, k])[:, None, None] * of_point
    found = energy.elements(
        weights.reshape(n, 9 * p, 2, 4 * nodes), hessian.reshape(n, 9 * p, 9 * p), y
    )
    return found, shares(y[:, ::4])


def shares(x: FloatArray) -> FloatArray:
    """The integrals int N_a N_b dS [m] by nodes x (n, nodes, 3) [m], shape (n, nodes, nodes)."""
    nodes = x.shape[1]
    at, parts = np.polynomial.legendre.leggauss(nodes)
    values, _ = shapes(nodes, at)
    return np.einsum("p,np,pa,pb->nab", parts, stretches(x, at), values, values)


def strains(of: energy.Elements, y: FloatArray) -> FloatArray:
    """Gamma_1, Gamma_2, E_33 [-], K [1/m] less those of the reference, shape (n, points, 6)."""
    changes = energy.changes(of, y)
    points = changes.shape[1] // 9  # told, as a rank may have no element
    return changes.reshape(len(y), points, 9) @ _SUMS.T


def resultants(
    stress: FloatArray, y: FloatArray, rest: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray]:
    """Force [N] and moment [N m] in elements, means of their points, vectors in space, (n, 3) each.

    Args:
        stress: What belongs to the strains [N], [N m], shape (n, points, 6).
        y: Nodal vectors [m], shape (n, 4 nodes, 3).
        rest: Those of the reference.
        radius: Length l of the vectors D_i [m].
    """
    nodes = y.shape[1] // 4
    at, _ = points(nodes)
    values, slopes = shapes(nodes, at)
    vectors = y.reshape(len(y), nodes, 4, 3)
    axes = np.einsum("pa,naij->npij", values, vectors[:, :, 1:]) / radius
    moment = np.einsum("npi,npij->nj", stress[:, :, 3:], axes) / len(at)
    # Stretch is resisted along the axis, whichever way the section looks.
    along = np.einsum("pa,nai->npi", slopes, vectors[:, :, 0])
    axes[:, :, 2] = along / stretches(rest[:, ::4], at)[:, :, None]
    return np.einsum("npi,npij->nj", stress[:, :, :3], axes) / len(at), moment
