"""Strain energies W(C) per reference volume in UFL; any callable C -> UFL scalar serves, too."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import ufl
from ufl.constantvalue import RealValue
from ufl.corealg.traversal import traverse_unique_terminals

from dolfinx_nts.validation import is_finite, known_options, require_positive


def _lame(young: float, poisson: float) -> tuple[float, float]:
    """Lame's mu and lambda [Pa]."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def _check_elastic(young: float, poisson: float) -> None:
    require_positive("young", young, "Pa")
    if not (is_finite(poisson) and -1 < poisson < 0.5):
        raise ValueError(f"poisson={poisson!r}: must lie in (-1, 0.5); use e.g. 0.49 for rubber")


def misfit(expressions: Iterable[Any], domain: Any) -> str | None:
    """What keeps UFL expressions from being compiled on a mesh, in words, if anything does.

    Args:
        expressions: In UFL.
        domain: UFL domain of the mesh.
    """
    for expression in expressions:
        for t in traverse_unique_terminals(expression):
            if any(d != domain for d in t.ufl_domains()):
                return f"contains {t!s} of another mesh; make it on the mesh of the body"
            if isinstance(t, RealValue) and not math.isfinite(float(t)):
                return f"contains the number {float(t)!r}; check it for NaN"
    return None


@known_options
@dataclass(frozen=True)
class StVenantKirchhoff:
    """W = lam/2 (tr E)^2 + mu E : E with E = (C - 1)/2; for moderate strains only.

    Attributes:
        young: Young's modulus [Pa], > 0.
        poisson: Poisson's ratio [-], in (-1, 0.5).

    Raises:
        ValueError: An argument is out of range.
    """

    young: float
    poisson: float

    def __post_init__(self) -> None:
        _check_elastic(self.young, self.poisson)

    def __call__(self, c: Any) -> Any:
        """W(C) [J/m^3]."""
        mu, lam = _lame(self.young, self.poisson)
        e = 0.5 * (c - ufl.Identity(3))
        return lam / 2 * ufl.tr(e) ** 2 + mu * ufl.inner(e, e)


@known_options
@dataclass(frozen=True)
class NeoHookean:
    """W = mu/2 (tr C - 3 - ln det C) + lam/8 (ln det C)^2.

    Attributes:
        young: Young's modulus at small strain [Pa], > 0.
        poisson: Poisson's ratio at small strain [-], in (-1, 0.5).

    Raises:
        ValueError: An argument is out of range.
    """

    young: float
    poisson: float

    def __post_init__(self) -> None:
        _check_elastic(self.young, self.poisson)

    def __call__(self, c: Any) -> Any:
        """W(C) [J/m^3]."""
        mu, lam = _lame(self.young, self.poisson)
        log = ufl.ln(ufl.det(c))
        return mu / 2 * (ufl.tr(c) - 3 - log) + lam / 8 * log**2


@known_options
@dataclass(frozen=True)
class MooneyRivlin:
    """W = a (tr C - 3) + b (tr cof C - 3) + c/2 (J - 1)^2 - d ln J, d = 2 (a + 2 b).

    This d makes the undeformed body free of stress.

    Attributes:
        a: Coefficient of the first invariant [Pa], a + b > 0.
        b: Coefficient of the second invariant [Pa].
        c: Volumetric stiffness [Pa], > 0.

    Raises:
        ValueError: An argument is out of range.

    Source: Simo and Tarnow (1992), the flying L-block.
    """

    a: float
    b: float
    c: float

    def __post_init__(self) -> None:
        for name, value in (("a", self.a), ("b", self.b)):
            if not is_finite(value):
                raise ValueError(f"{name}={value!r}: pass a finite number [Pa]")
        if not self.a + self.b > 0:
            shear = self.a + self.b
            raise ValueError(f"a + b={shear!r}: must be positive [Pa]: half the shear modulus")
        require_positive("c", self.c, "Pa")

    def __call__(self, c: Any) -> Any:
        """W(C) [J/m^3]."""
        j2 = ufl.det(c)
        second = (ufl.tr(c) ** 2 - ufl.tr(c * c)) / 2
        volumetric = self.c / 2 * (ufl.sqrt(j2) - 1) ** 2 - (self.a + 2 * self.b) * ufl.ln(j2)
        return self.a * (ufl.tr(c) - 3) + self.b * (second - 3) + volumetric
