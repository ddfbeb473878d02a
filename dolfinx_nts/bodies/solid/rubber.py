"""Rubbers whose energy is a polynomial of the first invariant: Yeoh, Arruda and Boyce."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any

import ufl
from ufl.core.expr import Expr

from dolfinx_nts.bodies.solid.materials import Elastic
from dolfinx_nts.bodies.solid.parameters import (
    Parameter,
    require_finite_parameter,
    require_parameter,
    require_positive_parameter,
)
from dolfinx_nts.kernels.precise import expm1, expm1_remainder, log1p, log1p_remainder
from dolfinx_nts.kernels.strain_energy import polynomial
from dolfinx_nts.validation import is_finite, known_options

#: Series of a chain's energy in I, from that of the inverse of coth x - 1/x.
_CHAIN = 1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750


@dataclass(frozen=True)
class OfFirstInvariant(Elastic):
    """W = sum_k b_k (J^(-2/3) tr C - 3)^k + bulk/4 (J^2 - 1 - 2 ln J), k = 1, 2, ...

    `moduli` are bulk, b_1, b_2, ... [Pa].
    """

    @property
    def small_strain(self) -> tuple[Any, Any]:
        """Bulk and shear modulus of the undeformed material [Pa]."""
        bulk, first, *_ = self.moduli
        return bulk, 2 * first

    def of_invariants(self, i1: Expr, i2: Expr, i3: Expr) -> Expr:
        """W [J/m^3]."""
        bulk, *factors = self.moduli
        d = i1 + i2 + i3
        log = -log1p(d) / 3
        # What is linear in the strain is gone from the sum.
        x = log1p_remainder(d) - i2 - i3 + 3 * expm1_remainder(log) + i1 * expm1(log)
        return x * polynomial(factors, x) + bulk / 4 * log1p_remainder(d)

    def slopes(self, i1: Expr, i2: Expr, i3: Expr) -> tuple[Expr, Expr, Expr]:
        """Derivatives of W [Pa]."""
        bulk, *factors = self.moduli
        d = i1 + i2 + i3
        shrunk = ufl.exp(-log1p(d) / 3)
        x = (3 + i1) * shrunk - 3
        slope = polynomial([k * b for k, b in enumerate(factors, 1)], x) * shrunk / (1 + d)
        volumetric = bulk / 4 * d / (1 + d)
        rest = volumetric - slope * (1 + i1 / 3)
        return volumetric + slope * (d - i1 / 3), rest, rest


@known_options
@dataclass(frozen=True)
class Yeoh(OfFirstInvariant):
    """W = c10 x + c20 x^2 + c30 x^3 + bulk/4 (J^2 - 1 - 2 ln J), x = J^(-2/3) tr C - 3.

    Attributes:
        c10: Half the shear modulus at small strain [Pa], > 0; a number, or a Constant or Function
            on the body's mesh.
        c20: Coefficient of the square [Pa], likewise; of most rubbers negative.
        c30: Coefficient of the cube [Pa], likewise; positive where the rubber stiffens.
        bulk: Bulk modulus at small strain [Pa], > 0, likewise.

    Raises:
        ValueError: An argument is out of range.

    Source: Yeoh (1993).
    """

    c10: Parameter
    c20: Parameter
    c30: Parameter
    bulk: Parameter

    def check(self) -> None:
        """Raise ValueError if a parameter is out of its range."""
        require_positive_parameter("c10", self.c10, "Pa")
        for name, value in (("c20", self.c20), ("c30", self.c30)):
            require_finite_parameter(name, value, "Pa")
        require_positive_parameter("bulk", self.bulk, "Pa")

    @cached_property
    def moduli(self) -> tuple[Any, ...]:
        """Bulk modulus and coefficients [Pa]."""
        return self.bulk, self.c10, self.c20, self.c30


@known_options
@dataclass(frozen=True)
class ArrudaBoyce(OfFirstInvariant):
    """Eight chains of limited length: the energy's series in I = J^(-2/3) tr C of five terms.

    W = mu sum_i c_i/stretch^(2i - 2) (I^i - 3^i) + bulk/4 (J^2 - 1 - 2 ln J) with c = 1/2, 1/20,
    11/1050, 19/7000, 519/673750.

    Attributes:
        mu: Modulus of the chains [Pa], > 0; a number, or a Constant or Function on the body's mesh.
            The shear modulus at small strain is mu (1 + 3/(5 l^2) + 99/(175 l^4) + 513/(875 l^6) +
            42039/(67375 l^8)) with l = stretch.
        stretch: Stretch of a chain [-], sqrt(I/3), at which it is straight, > 1, likewise. The
            series' force is 10 % too small at 0.8 of it, a third at 0.9.
        bulk: Bulk modulus at small strain [Pa], > 0, likewise.

    Raises:
        ValueError: An argument is out of range.

    Source: Arruda and Boyce (1993).
    """

    mu: Parameter
    stretch: Parameter
    bulk: Parameter

    def check(self) -> None:
        """Raise ValueError if a parameter is out of its range."""
        require_positive_parameter("mu", self.mu, "Pa")
        wanted = "must be greater than 1, the stretch of an undeformed chain, and finite [-]"
        require_parameter("stretch", self.stretch, lambda v: is_finite(v) and v > 1, wanted)
        require_positive_parameter("bulk", self.bulk, "Pa")

    @cached_property
    def moduli(self) -> tuple[Any, ...]:
        """Bulk modulus and coefficients of the powers of I - 3 [Pa]."""
        parts = [self.mu * c / self.stretch ** (2 * i) for i, c in enumerate(_CHAIN)]
        # I^i - 3^i by the powers of I - 3.
        powers = range(1, len(parts) + 1)
        factors = (
            sum(comb(i, k) * 3 ** (i - k) * parts[i - 1] for i in powers if i >= k) for k in powers
        )
        return self.bulk, *factors

