"""Geometrically exact beam elements of two nodes with a point in their middle (theory section 15).

Nodal vectors of an element are (phi, D_1, D_2, D_3) of its first node, then of its second, with
directors d_i = D_i / l. Strains are sums of products of vectors linear in them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dolfinx_nts.kernels import quadratic_energy as energy

FloatArray = npt.NDArray[np.float64]

#: d_3 and d_2 of K_1, and cyclic.
_CYCLES = ((3, 2), (1, 3), (2, 1))
#: Strains from products: Gamma_i is one, K_i the difference of two.
_SUMS = np.zeros((6, 9))
_SUMS[range(3), range(3)] = 1.0
_SUMS[range(3, 6), range(3, 9, 2)] = 1.0
_SUMS[range(3, 6), range(4, 9, 2)] = -1.0


def beams(
    y: FloatArray, length: FloatArray, radius: float, stiffness: FloatArray
) -> energy.Elements:
    """Elements that are free of stress in the reference.

    Gamma_i = d_i . phi', K_1 = (d_3 . d_2' - d_2 . d_3')/2 and cyclic, in the middle.

    Args:
        y: Nodal vectors of the reference [m], shape (n, 8, 3).
        length: [m], shape (n,).
        radius: Length l of the vectors D_i [m].
        stiffness: GA_1, GA_2, EA [N], EI_1, EI_2, GJ [N m^2], shape (6,).
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
    hessian = length[:, None, None] * (_SUMS.T @ (stiffness[:, None] * _SUMS))
    return energy.elements(weights, hessian, y)


def strains(of: energy.Elements, y: FloatArray) -> FloatArray:
    """Gamma [-] and K [1/m] less those of the reference, shape (n, 6)."""
    found: FloatArray = energy.changes(of, y) @ _SUMS.T
    return found
