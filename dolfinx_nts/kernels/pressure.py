"""Pressure that follows the bilinear quadrilaterals it acts on: forces and tangents.

The force of a pressure p on node I is p int N_I x_,1 x x_,2 dxi. On a closed surface it is p times
the derivative of the volume, a cubic; its mean along the straight way of a step does the work
p (V_1 - V_0) exactly. As x_,1 x x_,2 is quadratic, the mean is B(x_m, x_m) + B(dx, dx)/12.
"""

from __future__ import annotations

import numpy as np

from dolfinx_nts.kernels.shell import POINTS, shapes
from dolfinx_nts.types import FloatArray


def _coefficients() -> FloatArray:
    """A_IJK of B(y, z)_I = A_IJK y_J x z_K, antisymmetric in J and K, shape (4, 4, 4)."""
    values, slopes = shapes(POINTS)
    whole = np.einsum("pi,pj,pk->ijk", values, slopes[:, 0], slopes[:, 1])
    return 0.5 * (whole - whole.transpose(0, 2, 1))


_A = _coefficients()
#: Of the components of a x b = e_ijk a_j b_k.
_CROSS = np.zeros((3, 3, 3))
_CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0


def _turned(y: FloatArray) -> FloatArray:
    """Matrix of z -> B(y, z) for y (n, 4, 3), shape (n, 4, 3, 4, 3)."""
    return np.einsum("ijk,njb,abc->niakc", _A, y, _CROSS, optimize=True)


def _product(y: FloatArray, z: FloatArray) -> FloatArray:
    """B(y, z), shape (n, 4, 3)."""
    return np.einsum("niakc,nkc->nia", _turned(y), z)


def force(x0: FloatArray, x1: FloatArray, theta: float | None) -> FloatArray:
    """Forces of a unit pressure along x_,1 x x_,2 between two states [N/Pa], shape (n, 4, 3).

    Args:
        x0: Corners at t_n [m], shape (n, 4, 3).
        x1: At t_{n+1}.
        theta: Where between them forces are those of the place; None: their mean on the way.
    """
    way = x1 - x0
    place = x0 + (0.5 if theta is None else theta) * way
    found = _product(place, place)
    return found + _product(way, way) / 12.0 if theta is None else found


def tangent(x0: FloatArray, x1: FloatArray, theta: float | None) -> FloatArray:
    """Derivative of `force` by x_1 [N/(Pa m)], shape (n, 4, 3, 4, 3)."""
    way = x1 - x0
    if theta is None:
        return _turned(x0 + 0.5 * way + way / 6.0)
    return 2.0 * theta * _turned(x0 + theta * way)
