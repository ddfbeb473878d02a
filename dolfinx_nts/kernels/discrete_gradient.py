"""Discrete gradients, one formula each: stored energies (UFL), contact constraints (arrays).

A discrete gradient D of f between a and b satisfies D . (b - a) = f(b) - f(a) exactly, which is
what makes the energy balance of the energy-momentum scheme exact (theory sections 2 and 5).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import ufl
from ufl.core.expr import Expr

from dolfinx_nts.kernels.strain_energy import StrainEnergy
from dolfinx_nts.types import BoolArray, FloatArray

_EPS = float(np.finfo(float).eps)


def _legendre(degree: int, points: int) -> FloatArray:
    """Legendre's polynomial at the Gauss points, shape (points,)."""
    x = np.polynomial.legendre.leggauss(points)[0]
    return np.polynomial.legendre.legval(x, np.eye(degree + 1)[degree])


#: Gauss points and weights on [0, 1].
_GAUSS = {
    n: tuple(
        0.5 * (x + s) for x, s in zip(np.polynomial.legendre.leggauss(n), (1.0, 0.0), strict=True)
    )
    for n in (*range(1, 8), 10)
}
#: Points of the stored energies in UFL, and of functions of arrays.
_POINTS, _MANY = 5, 10
#: By the number of points n: Legendre coefficients of an integrand from its values there, (2, n).
#: Where coefficients fall like r^k the rule's error falls like r^2n, so the last two tell it ...
_LAST = {
    n: {k: (2 * k + 1) * _GAUSS[n][1] * _legendre(k, n) for k in (n - 2, n - 1)}
    for n in (_POINTS, _MANY)
}
#: ... and these parts of the integrand's size stand for an error of machine precision.
_RESOLVED = {n: {k: _EPS ** (k / (2 * n)) for k in last} for n, last in _LAST.items()}
#: Relative increment (of strain) below which the coefficients may hold nothing but rounding.
_SMALL_STRAIN = 1e-7


def gauss(points: int) -> tuple[FloatArray, FloatArray]:
    """Gauss points and weights on [0, 1]."""
    tau, weight = _GAUSS[points]
    return tau, weight


def mean_value_stress(energy: StrainEnergy, e0: Expr, e1: Expr, points: int) -> Expr:
    """S = int_0^1 dW/dE(E_0 + tau (E_1 - E_0)) dtau by Gauss points (UFL)."""
    tau, weight = _GAUSS[points]
    return combine(weight, [energy.stress(e0 + t * (e1 - e0)) for t in tau.tolist()])


def gonzalez_stress(energy: StrainEnergy, e0: Expr, e1: Expr) -> Expr:
    """Discrete derivative of W between E_0 and E_1 after Gonzalez (2000) (UFL).

    S = dW(Em) + [W(E_1) - W(E_0) - dW(Em) : DE] / (DE : DE) DE. The bracket is O(DE^3). It is taken
    from five-point quadrature, which is free of the cancellation that makes the plain form 0/0 at
    rest, wherever the samples say that the quadrature is exact to rounding. Elsewhere W changes so
    much within DE that the plain form cancels little.
    """
    em, de = 0.5 * (e0 + e1), e1 - e0
    path = energy.along(e0, e1)
    tau, weight = _GAUSS[_POINTS]
    samples = [path.power(t) for t in tau.tolist()]
    middle = samples[_POINTS // 2]
    size, argument = ufl.inner(de, de), energy.argument(em)
    scale = ufl.inner(argument, argument)
    left = -combine(weight, [f**2 for f in samples])
    for k, last in _LAST[_POINTS].items():
        left += (combine(last, samples) / _RESOLVED[_POINTS][k]) ** 2
    left *= ufl.conditional(ufl.lt(size, _SMALL_STRAIN**2 * scale), 0.0, 1.0)
    by_quadrature = combine(weight, samples) - middle
    bracket = ufl.conditional(ufl.le(left, 0.0), by_quadrature, path.difference - middle)
    # Next to rest the term is below rounding, but its derivative would be rounding noise over DE.
    bracket = ufl.conditional(ufl.lt(size**2, _EPS**2 * scale), 0.0, bracket)
    # The addend is far below any increment that counts; it keeps 0/0 away at rest.
    return path.middle + bracket / (size + 1e-200) * de


def combine(weights: FloatArray, values: list[Expr]) -> Expr:
    """Weighted sum of UFL expressions or forms."""
    first, *rest = (w * v for w, v in zip(weights.tolist(), values, strict=True))
    return sum(rest, start=first)


def resolved_mean(
    a: FloatArray,
    b: FloatArray,
    function: Callable[[FloatArray], FloatArray],
    slope: Callable[[FloatArray], FloatArray],
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Mean of a function of one variable between a and b, its derivative by b, whether it is exact.

    As in `gonzalez_stress`, quadrature is where the samples say so, to rounding, and where a and b
    are so near that the samples' differences hold nothing but rounding. Many points let it be so
    next to a zero of the function, too, where its integral is small beside what is differentiated.

    Args:
        a: One end, shape (n,).
        b: The other end, shape (n,).
        function: Of an array of any length.
        slope: Its derivative.
    """
    tau, weight = _GAUSS[_MANY]
    x = a + tau[:, None] * (b - a)
    samples, slopes = (f(x.ravel()).reshape(x.shape) for f in (function, slope))
    left = -weight @ samples**2
    for k, last in _LAST[_MANY].items():
        left += (last @ samples / _RESOLVED[_MANY][k]) ** 2
    near = np.abs(b - a) < _SMALL_STRAIN * np.maximum(np.abs(a), np.abs(b))
    return weight @ samples, (weight * tau) @ slopes, (left <= 0.0) | near


def mean_value(
    pi0: FloatArray, pi1: FloatArray, gradient: Callable[[FloatArray], FloatArray], points: int
) -> FloatArray:
    """Mean value of dg/dpi by Gauss points: unit independent, exact up to degree 2 points.

    Args:
        pi0: Invariants at t_n, shape (n, p).
        pi1: Invariants at t_{n+1}, shape (n, p).
        gradient: dg/dpi.
        points: Gauss points; n of them are exact for constraints of degree <= 2 n in pi.
    """
    tau, weight = _GAUSS[points]
    return _between(pi0, pi1, tau, weight, gradient)


def mean_value_tangent(
    pi0: FloatArray, pi1: FloatArray, curvature: Callable[[FloatArray], FloatArray], points: int
) -> FloatArray:
    """d(mean value^T lambda)/dpi_1 in whatever (linear) storage the caller uses.

    Args:
        pi0: Invariants at t_n, shape (n, p).
        pi1: Invariants at t_{n+1}, shape (n, p).
        curvature: d2(lambda . g)/dpi2 of m n invariants, n for each of m points.
        points: Gauss points.
    """
    tau, weight = _GAUSS[points]
    return _between(pi0, pi1, tau, weight * tau, curvature)


def _between(
    pi0: FloatArray,
    pi1: FloatArray,
    tau: FloatArray,
    weight: FloatArray,
    function: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Weighted sum of a function at points between; all in one batch, for few pairs cost calls."""
    pi = pi0 + tau[:, None, None] * (pi1 - pi0)
    values = function(pi.reshape(-1, pi.shape[2]))
    return np.tensordot(weight, values.reshape(*pi.shape[:2], *values.shape[1:]), 1)


def _gonzalez_increment(pi0: FloatArray, pi1: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Dpi, shape (n, p), and 1 / |Dpi|^2, shape (n, 1), zero at rest."""
    dpi, pm = pi1 - pi0, 0.5 * (pi0 + pi1)
    size = np.einsum("np,np->n", dpi, dpi)
    at_rest = size <= (64 * np.finfo(float).eps) ** 2 * np.einsum("np,np->n", pm, pm)
    return dpi, np.where(at_rest, 0.0, 1.0 / np.where(at_rest, 1.0, size))[:, None]


def gonzalez(
    pi0: FloatArray, pi1: FloatArray, gradient: Callable[[FloatArray], FloatArray], points: int
) -> FloatArray:
    """Gonzalez's discrete gradient (67) with the sign corrected, row by row, shape (n, m, p).

    Mixes the units of the invariants and is 0/0 at rest, which is why the mean value is the
    default.

    Args:
        pi0: Invariants at t_n, shape (n, p).
        pi1: Invariants at t_{n+1}, shape (n, p).
        gradient: dg/dpi, shape (n, m, p).
        points: Gauss points that make `mean_value` exact.
    """
    dpi, inverse = _gonzalez_increment(pi0, pi1)
    middle = gradient(0.5 * (pi0 + pi1))
    # g(pi_1) - g(pi_0) by the exact mean value: the difference of values would leave rounding noise
    # ~ eps / |Dpi|^2 in the tangent.
    defect = np.einsum("nmp,np->nm", mean_value(pi0, pi1, gradient, points) - middle, dpi)
    return middle + (defect * inverse)[:, :, None] * dpi[:, None]


def gonzalez_tangent(
    pi0: FloatArray,
    pi1: FloatArray,
    multiplier: FloatArray,
    gradient: Callable[[FloatArray], FloatArray],
    curvature: Callable[[FloatArray], FloatArray],
    points: int,
) -> FloatArray:
    """d(Gonzalez's discrete gradient^T lambda)/dpi_1, shape (n, p, p).

    Args:
        pi0: Invariants at t_n, shape (n, p).
        pi1: Invariants at t_{n+1}, shape (n, p).
        multiplier: lambda, shape (n, m).
        gradient: dg/dpi, shape (n, m, p).
        curvature: d2(lambda . g)/dpi2, shape (n, p, p).
        points: Gauss points that make `mean_value` exact.
    """
    dpi, inverse = _gonzalez_increment(pi0, pi1)
    pm = 0.5 * (pi0 + pi1)
    middle, hessian = gradient(pm), curvature(pm)
    excess = mean_value(pi0, pi1, gradient, points) - middle
    rest = np.einsum("nm,nmp,np->n", multiplier, excess, dpi)[:, None] * inverse
    change = np.einsum("nm,nmp->np", multiplier, gradient(pi1) - middle)
    change -= 0.5 * np.einsum("npq,nq->np", hessian, dpi)
    row = change * inverse - 2.0 * rest * inverse * dpi
    tangent: FloatArray = 0.5 * hessian + dpi[:, :, None] * row[:, None]
    tangent += rest[:, :, None] * np.eye(dpi.shape[1])
    return tangent
