"""Strain energies W per reference volume in UFL; any callable C -> UFL scalar serves, too.

C = 1 + 2 E is rounded at 1, so that at a strain of 1e-8 a W(C) knows half of its digits, and the
ledger of such a motion half of them. An isotropic W that is to keep all digits at any strain is an
`Isotropic` instead: a function of the invariants I_1, I_2, I_3 of C - 1, in which

    tr C - 3 = I_1,   tr cof C - 3 = 2 I_1 + I_2,   det C - 1 = I_1 + I_2 + I_3.

Terms that are linear in the strain must not be left to cancel each other. With d = det C - 1, what
cancels in tr C - 3 - ln det C is gone from (d - ln(1 + d)) - I_2 - I_3; `precise` has the functions
for this, here `log1p_remainder`. A rubber that stiffens exponentially:

    class Fung(nts.Isotropic):
        def of_invariants(self, i1, i2, i3):  # mu/2 ((exp(b (tr C - 3)) - 1)/b - ln det C)
            d = i1 + i2 + i3
            return mu / 2 * (expm1_remainder(b * i1) / b + log1p_remainder(d) - i2 - i3)
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from ufl.constantvalue import RealValue
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals

from dolfinx_nts.bodies.solid.parameters import (
    Parameter,
    is_number,
    require_finite_parameter,
    require_parameter,
    require_positive_parameter,
)
from dolfinx_nts.kernels.precise import log1p, log1p_remainder
from dolfinx_nts.kernels.strain_energy import Isotropic
from dolfinx_nts.validation import is_finite, known_options


def _lame(young: Any, poisson: Any) -> tuple[Any, Any]:
    """Lame's mu and lambda [Pa]."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def _check_elastic(young: Any, poisson: Any) -> None:
    require_positive_parameter("young", young, "Pa")
    wanted = "must lie in (-1, 0.5); use e.g. 0.49 for rubber"
    require_parameter("poisson", poisson, lambda v: is_finite(v) and -1 < v < 0.5, wanted)


def misfit(expressions: Iterable[Expr], domain: Any) -> str | None:
    """Return what keeps UFL expressions from being compiled on a mesh, in words, if anything does.

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


@dataclass(frozen=True)
class Elastic(Isotropic):
    """An isotropic material made of parameters, the fields of a dataclass.

    A field is a `Parameter` or a tuple of them. A subclass has `check`, `moduli`, `small_strain`
    and `of_invariants`, and `slopes` where they are cheap to write out.
    """

    def __post_init__(self) -> None:
        self.check()

    @cached_property
    def moduli(self) -> tuple[Any, ...]:
        """What W is made of, the same number of them for all of its kind, made of the fields."""
        raise NotImplementedError(f"{type(self).__name__} needs moduli")

    @property
    def small_strain(self) -> tuple[Any, Any]:
        """Bulk and shear modulus of the undeformed material [Pa]."""
        raise NotImplementedError(f"{type(self).__name__} needs small_strain")


@known_options
@dataclass(frozen=True)
class StVenantKirchhoff(Elastic):
    """W = lam/2 (tr E)^2 + mu E : E with E = (C - 1)/2; for moderate strains only.

    Attributes:
        young: Young's modulus [Pa], > 0; a number, or a Constant or Function on the body's mesh.
        poisson: Poisson's ratio [-], in (-1, 0.5), likewise.

    Raises:
        ValueError: An argument is out of range.
    """

    young: Parameter
    poisson: Parameter

    def check(self) -> None:
        """Raise ValueError if a parameter is out of its range."""
        _check_elastic(self.young, self.poisson)

    @cached_property
    def moduli(self) -> tuple[Expr, ...]:
        """Lame's mu and lambda [Pa]."""
        return _lame(self.young, self.poisson)

    @property
    def small_strain(self) -> tuple[Any, Any]:
        """Bulk and shear modulus of the undeformed material [Pa]."""
        mu, lam = self.moduli
        return lam + 2 * mu / 3, mu

    def of_invariants(self, i1: Expr, i2: Expr, i3: Expr) -> Expr:
        """W [J/m^3], with tr E = I_1/2 and E : E = (I_1^2 - 2 I_2)/4."""
        mu, lam = self.moduli
        return lam / 8 * i1**2 + mu / 4 * (i1**2 - 2 * i2)

    def slopes(self, i1: Expr, i2: Expr, i3: Expr) -> tuple[Expr, Expr, Expr]:
        """Derivatives of W [Pa]."""
        mu, lam = self.moduli
        return (lam / 4 + mu / 2) * i1, -mu / 2, ufl.as_ufl(0)


@known_options
@dataclass(frozen=True)
class NeoHookean(Elastic):
    """W = mu/2 (tr C - 3 - ln det C) + lam/8 (ln det C)^2.

    Attributes:
        young: Young's modulus at small strain [Pa], > 0; a number, or a Constant or Function on
            the body's mesh.
        poisson: Poisson's ratio at small strain [-], in (-1, 0.5), likewise.

    Raises:
        ValueError: An argument is out of range.
    """

    young: Parameter
    poisson: Parameter

    def check(self) -> None:
        """Raise ValueError if a parameter is out of its range."""
        _check_elastic(self.young, self.poisson)

    @cached_property
    def moduli(self) -> tuple[Expr, ...]:
        """Lame's mu and lambda [Pa]."""
        return _lame(self.young, self.poisson)

    @property
    def small_strain(self) -> tuple[Any, Any]:
        """Bulk and shear modulus of the undeformed material [Pa]."""
        mu, lam = self.moduli
        return lam + 2 * mu / 3, mu

    def of_invariants(self, i1: Expr, i2: Expr, i3: Expr) -> Expr:
        """W [J/m^3]."""
        mu, lam = self.moduli
        d = i1 + i2 + i3
        return mu / 2 * (log1p_remainder(d) - i2 - i3) + lam / 8 * log1p(d) ** 2

    def slopes(self, i1: Expr, i2: Expr, i3: Expr) -> tuple[Expr, Expr, Expr]:
        """Derivatives of W [Pa]."""
        mu, lam = self.moduli
        d = i1 + i2 + i3
        first = (mu / 2 * d + lam / 4 * log1p(d)) / (1 + d)
        return first, first - mu / 2, first - mu / 2


@known_options
@dataclass(frozen=True)
class MooneyRivlin(Elastic):
    """W = a (tr C - 3) + b (tr cof C - 3) + c/2 (J - 1)^2 - d ln J, d = 2 (a + 2 b).

    This d makes the undeformed body free of stress.

    Attributes:
        a: Coefficient of the first invariant [Pa], a + b > 0; a number, or a Constant or Function
            on the body's mesh.
        b: Coefficient of the second invariant [Pa], likewise.
        c: Volumetric stiffness [Pa], > 0, likewise.

    Raises:
        ValueError: An argument is out of range.

    Source: Simo and Tarnow (1992), the flying L-block.
    """

    a: Parameter
    b: Parameter
    c: Parameter

    def check(self) -> None:
        """Raise ValueError if a parameter is out of its range."""
        for name, value in (("a", self.a), ("b", self.b)):
            require_finite_parameter(name, value, "Pa")
        if is_number(self.a) and is_number(self.b) and not self.a + self.b > 0:
            shear = self.a + self.b
            raise ValueError(f"a + b={shear!r}: must be positive [Pa]: half the shear modulus")
        require_positive_parameter("c", self.c, "Pa")

    @cached_property
    def moduli(self) -> tuple[Expr, ...]:
        """The coefficients a, b and c [Pa]."""
        return self.a, self.b, self.c

    @property
    def small_strain(self) -> tuple[Any, Any]:
        """Bulk and shear modulus of the undeformed material [Pa]."""
        a, b, c = self.moduli
        return c + 4 * (a + 4 * b) / 3, 2 * (a + b)

    def of_invariants(self, i1: Expr, i2: Expr, i3: Expr) -> Expr:
        """W [J/m^3]."""
        a, b, c = self.moduli
        d = i1 + i2 + i3
        change = d / (1 + ufl.sqrt(1 + d))  # J - 1
        linear = a + 2 * b
        isochoric = linear * (log1p_remainder(d) - i3) - (a + b) * i2
        return isochoric + c / 2 * change**2

    def slopes(self, i1: Expr, i2: Expr, i3: Expr) -> tuple[Expr, Expr, Expr]:
        """Derivatives of W [Pa]."""
        a, b, c = self.moduli
        d = i1 + i2 + i3
        j, linear = ufl.sqrt(1 + d), a + 2 * b
        first = (linear + c / 2 * j / (1 + j)) * d / (1 + d)
        return first, first - (a + b), first - linear


def bulk_over_shear(material: Any) -> float:
    """Bulk over shear modulus of an undeformed material of this package; of any other one 0."""
    if not isinstance(material, Elastic) or not all(map(is_number, _each(material))):
        return 0.0
    bulk, shear = material.small_strain
    return float(bulk / shear)


def with_constants(material: Any, mesh: Mesh) -> Expr:
    """A material of this package with its numbers in a Constant: all moduli share compiled forms.

    Args:
        material: Any; others are returned as they are.
        mesh: DOLFINx mesh of the forms.
    """
    if not isinstance(material, Elastic):
        return material
    shared = copy.copy(material)
    if all(map(is_number, _each(material))):
        # Moduli are made of numbers once, and of others wherever a form asks for them.
        moduli = fem.Constant(mesh, np.array(material.moduli, dtype=np.float64))
        vars(shared)["moduli"] = tuple(moduli[k] for k in range(len(material.moduli)))
        return shared
    vars(shared).pop("moduli", None)
    given = {f.name: getattr(material, f.name) for f in fields(material)}
    # A tuple keeps its numbers, such as exponents.
    single = {name: value for name, value in given.items() if not isinstance(value, tuple)}
    numbers = [name for name, value in single.items() if is_number(value)]
    if numbers:
        constants = fem.Constant(mesh, np.array([given[n] for n in numbers], dtype=np.float64))
        vars(shared).update({name: constants[k] for k, name in enumerate(numbers)})
    return shared


def _each(material: Elastic) -> list[Any]:
    """Parameters of a material one by one."""
    given = (getattr(material, field.name) for field in fields(material))
    return [one for value in given for one in (value if isinstance(value, tuple) else (value,))]
