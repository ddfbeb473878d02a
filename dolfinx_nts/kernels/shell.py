"""Shear-deformable shell elements of four nodes with one director each (theory section 15).

Nodal vectors of an element are (phi, D) of its nodes, which are cyclic, with directors d = D / l.
Strains are sums of products of vectors linear in them, in local Cartesian axes of the reference at
2 x 2 points. Transverse shear is that of MITC4 (Dvorkin and Bathe, Eng. Comput. 1, 1984).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dolfinx_nts.kernels import quadratic as energy
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.types import FloatArray

#: Corners in the plane of xi, eta.
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
#: Points of quadrature, whose weights are 1.
POINTS = _CORNERS / np.sqrt(3.0)
#: Where the transverse shear is sampled: along xi at the first two, along eta at the others.
_TIES = np.array([[0.0, -1.0], [0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]])
#: Strains of a point from seven products: eps_11, eps_22, 2 eps_12, kappa_11, kappa_22, 2 kappa_12.
_SUMS = np.zeros((6, 7))
_SUMS[[0, 1], [0, 1]] = 0.5
_SUMS[[2, 3, 4, 5, 5], [2, 3, 4, 5, 6]] = 1.0
#: Axes a and b of phi_,a . phi_,b, then of phi_,a . d_,b.
_PRODUCTS = ((0, 0), (1, 1), (0, 1), (0, 0), (1, 1), (0, 1), (1, 0))


class Stiffness(NamedTuple):
    """Of an isotropic shell per area; shear with the factor 5/6.

    Attributes:
        membrane: Plane stress times the thickness [N/m], shape (3, 3).
        bending: Plane stress times t^3/12 [N m], shape (3, 3).
        shear: 5/6 G t [N/m].
    """

    membrane: FloatArray
    bending: FloatArray
    shear: float


def stiffness(young: float, poisson: float, thickness: float) -> Stiffness:
    """Stiffness of a material [Pa], [-] and a thickness [m]."""
    nu = poisson
    plane = np.array([[1.0, nu, 0.0], [nu, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - nu)]])
    plane *= young / (1.0 - nu**2)
    shear = 5.0 / 6.0 * young / (2.0 * (1.0 + nu)) * thickness
    return Stiffness(thickness * plane, thickness**3 / 12.0 * plane, shear)


def shapes(at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """N_I (p, 4) and their derivatives (p, 2, 4) at points (p, 2) of the plane of xi, eta."""
    factors = 1.0 + at[:, None] * _CORNERS
    values: FloatArray = 0.25 * factors.prod(axis=2)
    slopes = 0.25 * _CORNERS.T * factors[:, :, ::-1].transpose(0, 2, 1)
    return values, slopes


def axes(x: FloatArray, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Local Cartesian axes at points of elements.

    Args:
        x: Corners in the reference [m], shape (n, 4, 3).
        at: Points in the plane of xi, eta, shape (p, 2).

    Returns:
        Axes e_1, e_2 and the normal, (n, p, 3, 3), and e_a . x_,alpha [m], (n, p, 2, 2).
    """
    along = np.einsum("pai,nic->npac", shapes(at)[1], x)
    normal = cross(along[:, :, 0], along[:, :, 1])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    first = along[:, :, 0] / np.linalg.norm(along[:, :, 0], axis=2, keepdims=True)
    triad = np.stack([first, cross(normal, first), normal], axis=2)
    return triad, np.einsum("npac,npbc->npab", triad[:, :, :2], along)


def _weights(x: FloatArray, half: float, at: FloatArray, inverse: FloatArray) -> FloatArray:
    """Weights of the products at points and of the sampled shear, (n, 7 p + 4, 2, 8)."""
    n, p = inverse.shape[:2]
    slopes = np.einsum("pbi,npba->npai", shapes(at)[1], inverse)
    found = np.zeros((n, 7 * p + 4, 2, 4, 2))
    of_points = found[:, : 7 * p].reshape(n, p, 7, 2, 4, 2)
    for k, (a, b) in enumerate(_PRODUCTS):
        director = int(k > 2)
        of_points[:, :, k, 0, :, 0] = slopes[:, :, a]
        of_points[:, :, k, 1, :, director] = slopes[:, :, b] / (half if director else 1.0)
    values, along = shapes(_TIES)
    for k in range(4):
        found[:, 7 * p + k, 0, :, 0] = along[k, k // 2]
        found[:, 7 * p + k, 1, :, 1] = values[k] / half
    return found.reshape(n, 7 * p + 4, 2, 8)


def _tied(at: FloatArray) -> FloatArray:
    """Covariant shear at points (p, 2) from the four samples, shape (p, 2, 4)."""
    found = np.zeros((len(at), 2, 4))
    found[:, 0, 0], found[:, 0, 1] = 0.5 * (1.0 - at[:, 1]), 0.5 * (1.0 + at[:, 1])
    found[:, 1, 2], found[:, 1, 3] = 0.5 * (1.0 - at[:, 0]), 0.5 * (1.0 + at[:, 0])
    return found


def shells(y: FloatArray, half: float, of: Stiffness) -> tuple[energy.Elements, FloatArray]:
    """Elements that are free of stress in the reference.

    Args:
        y: Nodal vectors of the reference [m], shape (n, 8, 3).
        half: Length l of the vectors D [m].
        of: Stiffness.

    Returns:
        The elements, and int N_I N_J dA [m^2], shape (n, 4, 4).
    """
    x = y[:, ::2]
    _, jacobian = axes(x, POINTS)
    area = np.linalg.det(jacobian)
    inverse = np.linalg.inv(jacobian)
    hessian = np.zeros((len(y), 32, 32))
    whole = np.zeros((6, 6))
    whole[:3, :3], whole[3:, 3:] = of.membrane, of.bending
    of_point = _SUMS.T @ whole @ _SUMS
    for p in range(4):
        rows = slice(7 * p, 7 * p + 7)
        hessian[:, rows, rows] = area[:, p, None, None] * of_point
    shear = np.einsum("npba,pbk->npak", inverse, _tied(POINTS))
    hessian[:, 28:, 28:] = of.shear * np.einsum("np,npak,npal->nkl", area, shear, shear)
    values, _ = shapes(POINTS)
    masses = np.einsum("np,pi,pj->nij", area, values, values)
    return energy.elements(_weights(x, half, POINTS, inverse), hessian, y), masses


def strains(y: FloatArray, rest: FloatArray, half: float, at: FloatArray) -> FloatArray:
    """Strains at points less those of the reference.

    Args:
        y: Nodal vectors [m], shape (n, 8, 3).
        rest: Those of the reference.
        half: Length l of the vectors D [m].
        at: Points in the plane of xi, eta, shape (p, 2).

    Returns:
        eps_11, eps_22, 2 eps_12 [-], kappa_11, kappa_22, 2 kappa_12 [1/m], gamma_1, gamma_2 [-] in
        the axes of `axes`, shape (n, p, 8).
    """
    inverse = np.linalg.inv(axes(rest[:, ::2], at)[1])
    weights = _weights(rest[:, ::2], half, at, inverse)
    n, p = inverse.shape[:2]
    none = np.zeros((n, 7 * p + 4, 7 * p + 4))
    change = energy.changes(energy.elements(weights, none, rest), y)
    found = np.empty((n, p, 8))
    found[:, :, :6] = change[:, : 7 * p].reshape(n, p, 7) @ _SUMS.T
    found[:, :, 6:] = np.einsum("npba,pbk,nk->npa", inverse, _tied(at), change[:, 7 * p :])
    return found
