"""Sums over the principal values of C, smooth where some of them coincide (UFL).

Of J^(-2/3) C the principal values are e^v (1 + z) with z^3 = 3 p z + 2 q, where the three z have no
sum, and v = -ln(1 - 3 p + 2 q)/3. Formulas for z have no derivative where two coincide, as in
uniaxial tension; a sum of f(z) has all of them. So where all are near each other it is a series in
p and q. Elsewhere one of the three is apart from the others, a smooth root that Newton's method
finds; the sum over the other two, a - d and a + d, is an even function of d: of d^2, by a series
where d is small.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl
from ufl.core.expr import Expr

from dolfinx_nts.kernels.precise import log1p
from dolfinx_nts.kernels.strain_energy import polynomial
from dolfinx_nts.types import FloatArray

#: Largest z of the series in p and q, and its order in z: what is left out is rounding for powers
#: of C between -10 and 10.
_NEAR, _ORDER = 0.02, 10
#: The same of the series of two roots.
_PAIR, _TERMS = 0.01, 4
#: Powers i, j of p and q in the series.
POWERS = [(i, j) for j in range(_ORDER // 3 + 1) for i in range((_ORDER - 3 * j) // 2 + 1) if i + j]
#: Largest root of y^3 = 3 y + 2 c by c in [0, 1], to 1e-4; after two steps of Newton to rounding.
_ROOT, _STEPS = (1.73213266, 0.3306607, -0.08138239, 0.01863937), 2


def series(exponent: float) -> FloatArray:
    """Coefficients of p^i q^j, i, j of `POWERS`, of the sum of (e^v (1 + z))^exponent."""
    size = _ORDER // 2 + 1, _ORDER // 3 + 1
    p, q, one = np.zeros(size), np.zeros(size), np.zeros(size)
    one[0, 0], p[1, 0], q[0, 1] = 1.0, 1.0, 1.0
    # Sums of z^n, and what det C over the cube of a third of its trace makes of them.
    sums, scale, power = [3 * one, 0 * one, 6 * p], 0 * one, one
    while len(sums) <= _ORDER:
        sums.append(3 * _product(p, sums[-2]) + 2 * _product(q, sums[-3]))
    for n in range(_ORDER // 2 + 1):
        scale = scale + _binomial(-exponent / 3, n) * power
        power = _product(power, 2 * q - 3 * p)
    whole = sum(_binomial(exponent, n) * s for n, s in enumerate(sums))
    found = _product(scale, np.asarray(whole))
    return np.array([found[i, j] for i, j in POWERS])


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Product of two polynomials in p and q up to `_ORDER` in z."""
    found = np.zeros_like(a)
    for i, j in [(0, 0), *POWERS]:
        for k in range(i + 1):
            for m in range(j + 1):
                found[i, j] += a[k, m] * b[i - k, j - m]
    return found


def _binomial(x: Any, n: int) -> Any:
    """Binomial coefficient of any number x and n."""
    value = 1.0
    for k in range(n):
        value = value * (x - k) / (k + 1)
    return value


class PrincipalValues:
    """Sum of m (e^v (1 + z))^b over terms m, b and the principal values, less its value at rest.

    Args:
        p: Half the sum of z^2, over 3 (UFL).
        q: Half the product of all z.
        coefficients: Of the series, the sum of m times `series` of b.
        terms: m and b of each.
    """

    def __init__(
        self, p: Expr, q: Expr, coefficients: Sequence[Any], terms: Sequence[tuple[Any, Any]]
    ) -> None:
        self._p, self._q, self._terms = p, q, terms
        self._series = dict(zip(POWERS, coefficients, strict=True))
        self._near = ufl.le(4 * p, _NEAR**2)
        # What is not near: quotients and roots exist there alone, and so do their derivatives.
        self._far = ufl.conditional(self._near, 1.0, p)
        self._grown = 1 + ufl.conditional(self._near, 0.0, 2 * q - 3 * p)
        root = ufl.sqrt(self._far)
        # The root apart is the largest one or the least.
        sign = ufl.conditional(ufl.lt(q, 0.0), -1.0, 1.0)
        c = sign * ufl.conditional(self._near, 0.0, q) / (self._far * root)
        y = polynomial(_ROOT, c)
        for _ in range(_STEPS):
            y = 2 * (y**3 + c) / (3 * (y**2 - 1))
        self._y, self._apart = y, ufl.conditional(self._near, 0.0, sign * root * y)
        self._middle = 1 - 0.5 * self._apart
        square = ufl.conditional(self._near, 0.0, 3 * self._far * (1 - 0.5 * y) * (1 + 0.5 * y))
        self._square = square / self._middle**2
        self._two_near = ufl.le(self._square, _PAIR**2)
        self._half = ufl.sqrt(ufl.conditional(self._two_near, 0.25, self._square))
        log = -ufl.ln(self._grown) / 3
        logs = log + ufl.ln(1 + self._apart), log + ufl.ln(self._middle)
        self._ends = log1p(self._half), log1p(-self._half)
        #: Of each term its m (e^v (1 + z))^b for the root apart and for the middle of the others.
        self._powers = [tuple(m * ufl.exp(b * x) for x in logs) for m, b in terms]

    def sum(self) -> Expr:
        """The sum."""
        near = self._near_sum(lambda i, j: (1, i, j))
        far = sum(
            apart + pair - 3 * m
            for (apart, _), (pair, *_), (m, _) in zip(
                self._powers, self._pairs(), self._terms, strict=True
            )
        )
        return ufl.conditional(self._near, near, far)

    def slopes(self) -> tuple[Expr, Expr]:
        """Its derivatives by p and q."""
        z, middle, grown = self._apart, self._middle, self._grown
        by_apart, by_square, by_log = 0, 0, 0
        for (apart, _), (pair, by_middle, by_part), (_, b) in zip(
            self._powers, self._pairs(), self._terms, strict=True
        ):
            by_apart += b * (apart / (1 + z) - 0.5 * by_middle / middle)
            by_square += b * by_part / middle**2
            by_log += b * (apart + pair)
        # With z^2 - p of the root apart; d^2 = 3 p - 3 z^2/4.
        bend = self._far * (self._y**2 - 1)
        along = (by_apart - 1.5 * z * by_square) / bend
        by_p = z * along + 3 * by_square + by_log / grown
        by_q = (along - by_log / grown) * (2 / 3)
        near_p = self._near_sum(lambda i, j: (i, i - 1, j))
        near_q = self._near_sum(lambda i, j: (j, i, j - 1))
        return tuple(
            ufl.conditional(self._near, a, b) for a, b in ((near_p, by_p), (near_q, by_q))
        )

    def _near_sum(self, of: Any) -> Any:
        """Polynomial with terms of a factor and powers of p and q."""
        rows: dict[int, dict[int, Any]] = {}
        for (i, j), c in self._series.items():
            factor, k, m = of(i, j)
            if factor:
                rows.setdefault(m, {})[k] = factor * c
        in_p = [
            polynomial([row.get(k, 0) for k in range(max(row) + 1)], self._p)
            for _, row in sorted(rows.items())
        ]
        return polynomial(in_p, self._q)

    def _pairs(self) -> list[tuple[Expr, Expr, Expr]]:
        """Of each term what the two other roots make of it.

        Returns:
            Its sum, and its derivatives by the logarithms of a + 1 and by d^2/(a + 1)^2, over b:
            the former at a constant d, the latter times the middle's square.
        """
        found = []
        for (_, middle), (_, b) in zip(self._powers, self._terms, strict=True):
            t = self._square
            even = polynomial([_binomial(b, 2 * n) for n in range(_TERMS + 1)], t)
            less = polynomial([_binomial(b - 1, 2 * n) for n in range(_TERMS + 1)], t)
            odd = polynomial([_binomial(b - 1, 2 * n + 1) for n in range(_TERMS + 1)], t)
            up, down = (ufl.exp(b * log) for log in self._ends)
            more, fewer = up / (1 + self._half), down / (1 - self._half)
            chosen = (
                ufl.conditional(self._two_near, 2 * a, c)
                for a, c in (
                    (even, up + down), (less, more + fewer), (odd, (more - fewer) / self._half)
                )
            )  # fmt: skip
            one, two, three = (middle * x for x in chosen)
            found.append((one, two, 0.5 * three))
        return found
