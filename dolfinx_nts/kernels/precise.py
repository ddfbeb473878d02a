"""Functions that strain energies are made of, without cancellation near the undeformed state.

At a strain of 1e-8 tr C - 3 - ln det C is of size 1e-16: written like that it holds nothing but
rounding. These functions keep their digits, and so do their derivatives.
"""

from __future__ import annotations

import ufl
from ufl.core.expr import Expr

#: Arguments below this are for the series; above, a difference costs three digits at most.
_SMALL = 1e-3


def cofactor(a: Expr) -> Expr:
    """Cofactor of a symmetric tensor, shape (3, 3), symmetric."""
    x, y, z = (a[1, 1] * a[2, 2] - a[1, 2] ** 2, a[0, 0] * a[2, 2] - a[0, 2] ** 2,
               a[0, 0] * a[1, 1] - a[0, 1] ** 2)  # fmt: skip
    yz, xz, xy = (a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2], a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1],
                  a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2])  # fmt: skip
    return ufl.as_matrix([[x, xy, xz], [xy, y, yz], [xz, yz, z]])


def determinant(a: Expr, cof: Expr) -> Expr:
    """Determinant of a tensor of which the cofactor is known."""
    return a[0, 0] * cof[0, 0] + a[0, 1] * cof[0, 1] + a[0, 2] * cof[0, 2]


def invariants(e: Expr) -> tuple[Expr, Expr, Expr]:
    """Principal invariants of C - 1 = 2 E at Green's strain E, shape (3, 3), symmetric."""
    a, cof = 2 * e, cofactor(2 * e)
    return ufl.tr(a), ufl.tr(cof), determinant(a, cof)


def log1p(x: Expr) -> Expr:
    """ln(1 + x), to two units in the last place for x < 3 and to x/ln x of them beyond."""
    one_plus = 1 + x
    # What 1 + x lost by rounding; that over 1 + x would be the same to rounding, for a division.
    return ufl.ln(one_plus) + (x - (one_plus - 1))


def log1p_remainder(x: Expr) -> Expr:
    """Rest x - ln(1 + x), which is x^2/2 for small x."""
    # ln(1 + x) = 2 artanh s
    s = x / (2 + x)
    series = x * s - 2 * s**3 * (1 / 3 + s**2 / 5)
    return ufl.conditional(ufl.lt(abs(x), _SMALL), series, x - log1p(x))


def expm1(x: Expr) -> Expr:
    """exp(x) - 1."""
    power = ufl.exp(x)
    # As in `log1p`; far from zero nothing is lost, and the logarithm of a power may not exist.
    lost = power * (x - ufl.ln(power))
    return power - 1 + ufl.conditional(ufl.lt(abs(x), 1.0), lost, 0.0)


def expm1_remainder(x: Expr) -> Expr:
    """Rest exp(x) - 1 - x, which is x^2/2 for small x."""
    series = x**2 * (1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x / 720))))
    return ufl.conditional(ufl.lt(abs(x), _SMALL), series, expm1(x) - x)
