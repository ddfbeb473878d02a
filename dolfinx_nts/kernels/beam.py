"""Geometrically exact beam elements of two nodes with a point in their middle (theory section 15).

Nodal vectors of an element are (phi, D_1, D_2, D_3) of its first node, then of its second, with
directors d_i = D_i / l. Strains are sums of products of vectors linear in them, see `quadratic`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.kernels import quadratic

FloatArray = npt.NDArray[np.float64]

#: d_3 and d_2 of K_1, and cyclic.
_CYCLES = ((3, 2), (1, 3), (2, 1))


class Beams(NamedTuple):
    """Elements; axis 0 = element.

    Attributes:
        weights: Of the nodal vectors in the factors of nine products, shape (n, 9, 2, 8).
        rest: Strains in the reference, shape (n, 6).
        length: [m], shape (n,).
        stiffness: GA_1, GA_2, EA [N], EI_1, EI_2, GJ [N m^2], shape (6,).
    """

    weights: FloatArray
    rest: FloatArray
    length: FloatArray
    stiffness: FloatArray


#: Strains from products: Gamma_i is one, K_i the difference of two.
_SUMS = np.zeros((6, 9))
_SUMS[range(3), range(3)] = 1.0
_SUMS[range(3, 6), range(3, 9, 2)] = 1.0
_SUMS[range(3, 6), range(4, 9, 2)] = -1.0


def beams(y: FloatArray, length: FloatArray, radius: float, stiffness: FloatArray) -> Beams:
    """Elements that are free of stress in the reference.

    Gamma_i = d_i . phi', K_1 = (d_3 . d_2' - d_2 . d_3')/2 and cyclic, in the middle.

    Args:
        y: Nodal vectors of the reference [m], shape (n, 8, 3).
        length: [m], shape (n,).
        radius: Length l of the vectors D_i [m].
        stiffness: As of `Beams`.
    """
    mean, slope = np.zeros((4, 8)), np.zeros((4, 8))
    for i in range(4):
        mean[i, [i, 4 + i]] = 0.5
        slope[i, [i, 4 + i]] = -1.0, 1.0
    weights = np.zeros((len(y), 9, 2, 8))
    for i in range(3):
        weights[:, i] = mean[i + 1] / radius, slope[0]
        for k, (a, b) in enumerate((_CYCLES[i], _CYCLES[i][::-1])):
            weights[:, 3 + 2 * i + k] = 0.5 * mean[a] / radius, slope[b] / radius
    weights[:, :, 1] /= length[:, None, None]
    found = Beams(weights, np.zeros((len(y), 6)), length, stiffness)
    return found._replace(rest=strains(found, y))


def strains(of: Beams, y: FloatArray) -> FloatArray:
    """Gamma [-] and K [1/m] less those of the reference, shape (n, 6)."""
    found: FloatArray = quadratic.value(_factors(of, y)) @ _SUMS.T - of.rest
    return found


def _factors(of: Beams, y: FloatArray) -> FloatArray:
    return quadratic.factors(of.weights, np.zeros((len(y), 9, 2, 3)), y)


def _gradient(of: Beams, y: FloatArray) -> FloatArray:
    """Derivative of the strains by the nodal vectors, shape (n, 6, 24)."""
    products = quadratic.gradient(of.weights, _factors(of, y)).reshape(len(y), 9, 24)
    found: FloatArray = np.matmul(_SUMS, products)
    return found


def energy(of: Beams, y: FloatArray) -> FloatArray:
    """L/2 e^T C e [J], shape (n,)."""
    found: FloatArray = 0.5 * of.length * (strains(of, y) ** 2 @ of.stiffness)
    return found


def _stress(of: Beams, y0: FloatArray, y1: FloatArray, theta: float | None) -> FloatArray:
    """L C e, shape (n, 6), of the mean of both strains, or of those at a place, see `force`."""
    if theta is None:
        e = 0.5 * (strains(of, y0) + strains(of, y1))
    else:
        e = strains(of, y0 + theta * (y1 - y0))
    found: FloatArray = of.length[:, None] * of.stiffness * e
    return found


def force(of: Beams, y0: FloatArray, y1: FloatArray, theta: float | None) -> FloatArray:
    """Forces between two states [N], shape (n, 24).

    Args:
        of: The elements.
        y0: Nodal vectors at t_n [m], shape (n, 8, 3).
        y1: At t_{n+1}.
        theta: Where between them forces are those of the place, De^T C e; None: the discrete
            gradient De(y_m)^T C (e_0 + e_1)/2, whose work is the change of the energy.
    """
    place = y0 + (0.5 if theta is None else theta) * (y1 - y0)
    found: FloatArray = np.einsum(
        "nk,nki->ni", _stress(of, y0, y1, theta), _gradient(of, place)
    )
    return found


def tangent(of: Beams, y0: FloatArray, y1: FloatArray, theta: float | None) -> FloatArray:
    """Derivative of `force` by y_1 [N/m], shape (n, 24, 24)."""
    part = 0.5 if theta is None else theta
    change = _gradient(of, y0 + part * (y1 - y0))
    moved = change if theta is not None else _gradient(of, y1)
    scaled = part * of.length[:, None, None] * of.stiffness[:, None] * moved
    found: FloatArray = np.matmul(change.transpose(0, 2, 1), scaled)
    stress = part * _stress(of, y0, y1, theta) @ _SUMS
    bend = np.einsum("nm,nmab->nab", stress, quadratic.curvature(of.weights))
    for i in range(3):
        found[:, i::3, i::3] += bend
    return found
