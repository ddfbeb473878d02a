"""Ogden's rubber, an energy of the principal stretches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ufl.core.expr import Expr

from dolfinx_nts.bodies.solid.materials import Elastic
from dolfinx_nts.bodies.solid.parameters import (
    Parameter,
    is_number,
    require_finite_parameter,
    require_positive_parameter,
)
from dolfinx_nts.kernels.precise import log1p_remainder
from dolfinx_nts.kernels.principal import POWERS, PrincipalValues, series
from dolfinx_nts.validation import is_finite, known_options


@known_options
@dataclass(frozen=True)
class Ogden(Elastic):
    """W = sum_p mu_p/alpha_p (a^alpha_p + b^alpha_p + c^alpha_p - 3) + bulk/4 (J^2 - 1 - 2 ln J).

    a, b, c are J^(-1/3) times the principal stretches. W and all of its derivatives are smooth
    where some of them coincide.

    Attributes:
        mu: Moduli [Pa], a tuple of numbers, or of Constants or Functions on the body's mesh. The
            shear modulus at small strain, sum mu_p alpha_p/2, must be > 0; other authors write
            2 mu_p/alpha_p for this mu_p, so that theirs is the sum of mu_p.
        alpha: Exponents [-], as many numbers from 0.1 to 20 or from -20 to -0.1: with smaller ones
            what is left of the sum is rounding.
        bulk: Bulk modulus at small strain [Pa], > 0; a number, Constant or Function.

    Raises:
        TypeError: `mu` or `alpha` is no tuple or list.
        ValueError: An argument is out of range.

    Source: Ogden (1972).
    """

    mu: tuple[Parameter, ...]
    alpha: tuple[float, ...]
    bulk: Parameter

    def __post_init__(self) -> None:
        for name in ("mu", "alpha"):
            value = getattr(self, name)
            if not isinstance(value, tuple | list):
                raise TypeError(f"{name}={value!r}: pass a tuple, one number for each term of W")
            object.__setattr__(self, name, tuple(value))
        super().__post_init__()

    def check(self) -> None:
        """Raise ValueError if a parameter is out of its range."""
        mu, alpha = self.mu, self.alpha
        if not mu or len(mu) != len(alpha):
            raise ValueError(f"mu={mu!r}, alpha={alpha!r}: pass as many of each, at least one")
        for k, (modulus, exponent) in enumerate(zip(mu, alpha, strict=True)):
            require_finite_parameter(f"mu[{k}]", modulus, "Pa")
            if not (is_finite(exponent) and 0.1 <= abs(exponent) <= 20):
                raise ValueError(
                    f"alpha[{k}]={exponent!r}: pass one from 0.1 to 20, or from -20 to -0.1 [-]"
                )
        require_positive_parameter("bulk", self.bulk, "Pa")
        if all(map(is_number, mu)) and not self.small_strain[1] > 0:
            raise ValueError(
                f"mu={mu!r}, alpha={alpha!r}: sum mu_p alpha_p / 2 = {self.small_strain[1]!r} must "
                "be positive [Pa]: the shear modulus; where 2 mu_p/alpha_p^2 stands in W, pass "
                "2 mu_p/alpha_p"
            )

    @cached_property
    def moduli(self) -> tuple[Any, ...]:
        """Bulk modulus, coefficients of the series [Pa]; mu_p/alpha_p [Pa] and alpha_p/2 of all."""
        factors = [m / a for m, a in zip(self.mu, self.alpha, strict=True)]
        halves = [0.5 * a for a in self.alpha]
        of_terms = zip(*(series(half).tolist() for half in halves), strict=True)
        coefficients = (sum(m * c for m, c in zip(factors, of, strict=True)) for of in of_terms)
        return self.bulk, *coefficients, *factors, *halves

    @property
    def small_strain(self) -> tuple[Any, Any]:
        """Bulk and shear modulus of the undeformed material [Pa]."""
        return self.bulk, sum(m * a for m, a in zip(self.mu, self.alpha, strict=True)) / 2

    def of_invariants(self, i1: Expr, i2: Expr, i3: Expr) -> Expr:
        """W [J/m^3]."""
        _, p, q = _deviator(i1, i2, i3)
        d = i1 + i2 + i3
        return self._values(p, q).sum() + self.moduli[0] / 4 * log1p_remainder(d)

    def slopes(self, i1: Expr, i2: Expr, i3: Expr) -> tuple[Expr, Expr, Expr]:
        """Derivatives of W [Pa]."""
        third, p, q = _deviator(i1, i2, i3)
        by_p, by_q = self._values(p, q).slopes()
        d = i1 + i2 + i3
        volumetric = self.moduli[0] / 4 * d / (1 + d)
        first = by_p * (2 * i1 / (9 * third) - 2 * p / 3) / third
        first += by_q * ((i1**2 / 9 - i2 / 6) / third**2 - q) / third
        second = -(by_p / 3 + by_q * i1 / (6 * third)) / third**2
        return volumetric + first, volumetric + second, volumetric + by_q / (2 * third**3)

    def _values(self, p: Expr, q: Expr) -> PrincipalValues:
        """The isochoric part of W."""
        _, *rest = self.moduli
        coefficients, terms = rest[: len(POWERS)], rest[len(POWERS) :]
        count = len(self.mu)
        both = list(zip(terms[:count], terms[count:], strict=True))
        return PrincipalValues(p, q, coefficients, both)


def _deviator(i1: Expr, i2: Expr, i3: Expr) -> tuple[Expr, Expr, Expr]:
    """A third of tr C, and p and q of C as of `PrincipalValues`."""
    third = 1 + i1 / 3
    p = (i1**2 / 9 - i2 / 3) / third**2
    return third, p, (i1**3 / 27 - i1 * i2 / 6 + i3 / 2) / third**3
