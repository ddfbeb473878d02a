"""W of a material between two strains: what stresses are made of, in one form for all materials.

Everything is a function of Green's strain E = (C - 1)/2, which displacement gradients give without
cancellation. A material in the invariants of C - 1 (`Isotropic`) keeps that precision; a W(C) sees
C = 1 + 2 E, which is rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import ufl
from ufl.core.expr import Expr

from dolfinx_nts.kernels.precise import cofactor, determinant, invariants
from dolfinx_nts.types import OfTime


class Isotropic:
    """A material that is a function of the invariants I_1, I_2, I_3 of C - 1."""

    def check(self) -> None:
        """Raise ValueError if a parameter is out of its range; asked whenever one has changed."""

    def of_invariants(self, i1: Expr, i2: Expr, i3: Expr) -> Expr:
        """W [J/m^3]."""
        raise NotImplementedError(f"{type(self).__name__} needs a method of_invariants")

    def slopes(self, i1: Expr, i2: Expr, i3: Expr) -> tuple[Expr, Expr, Expr]:
        """Derivatives of W by the three [Pa]; written out they cost less."""
        variables = tuple(ufl.variable(i) for i in (i1, i2, i3))
        energy = self.of_invariants(*variables)
        first, second, third = (ufl.diff(energy, i) for i in variables)
        return first, second, third

    def __call__(self, c: Expr) -> Expr:
        """W(C) [J/m^3]."""
        return self.of_invariants(*invariants(0.5 * (c - ufl.Identity(3))))


def green_strain(h: Expr) -> Expr:
    """E = sym H + H^T H / 2 of a displacement gradient H, free of cancellation (UFL)."""
    return ufl.sym(h) + 0.5 * (h.T * h)


def strain_energy(material: Any) -> StrainEnergy:
    """The material as a function of E: an `Isotropic`, or any callable C -> W(C)."""
    return OfInvariants(material) if isinstance(material, Isotropic) else OfC(material)


class Path(NamedTuple):
    """W on the straight way E = E_0 + tau (E_1 - E_0) between two strains (UFL).

    Attributes:
        power: dW/dtau, a function of tau.
        middle: Stress dW/dE at tau = 1/2.
        difference: W(E_1) - W(E_0).
    """

    power: OfTime
    middle: Expr
    difference: Expr


class Plain:
    """An energy whose stress at a point depends on the strain there alone."""

    def between(self, e0: Expr, e1: Expr, discrete: DiscreteStress) -> Expr:
        """Discrete derivative of the energy between two strains by a rule (UFL)."""
        return discrete(self, e0, e1)

    def at_point(self, e: Expr) -> Expr:
        """Stress, which is that of the law at each point [Pa]."""
        return self.stress(e)

    def stress(self, e: Expr) -> Expr:
        """dW/dE, symmetric: the second Piola-Kirchhoff stress [Pa]."""
        raise NotImplementedError


class OfC(Plain):
    """W(C) at C = 1 + 2 E.

    Args:
        function: Any callable C -> UFL scalar.
    """

    def __init__(self, function: Callable[[Expr], Expr]) -> None:
        self._function = function

    def __call__(self, e: Expr) -> Expr:
        """W(E)."""
        return self._function(self.argument(e))

    def argument(self, e: Expr) -> Expr:
        """The tensor that W is rounded relative to."""
        return ufl.Identity(3) + 2 * e

    def stress(self, e: Expr) -> Expr:
        """dW/dE, symmetric: the second Piola-Kirchhoff stress."""
        c = ufl.variable(self.argument(e))
        return 2 * ufl.sym(ufl.diff(self._function(c), c))

    def along(self, e0: Expr, e1: Expr) -> Path:
        """W between two strains."""
        c0, c1 = self.argument(e0), self.argument(e1)

        def power(tau: float) -> Expr:
            t = ufl.variable(ufl.as_ufl(tau))  # dW : DC, without a derivative by a tensor
            return ufl.diff(self._function(c0 + t * (c1 - c0)), t)

        middle = self.stress(0.5 * (e0 + e1))
        return Path(power, middle, self._function(c1) - self._function(c0))


class OfInvariants(Plain):
    """W of an `Isotropic` material."""

    def __init__(self, material: Isotropic) -> None:
        self._material = material

    def __call__(self, e: Expr) -> Expr:
        """W(E)."""
        return self._material.of_invariants(*invariants(e))

    def argument(self, e: Expr) -> Expr:
        """The tensor that W is rounded relative to."""
        return e

    def stress(self, e: Expr) -> Expr:
        """dW/dE, symmetric: the second Piola-Kirchhoff stress."""
        i = invariants(e)
        return self._stress(e, i[0], self._material.slopes(*i))

    def along(self, e0: Expr, e1: Expr) -> Path:
        """W between two strains, where the invariants are polynomials of tau."""
        a, da = 2 * e0, 2 * (e1 - e0)
        cof, dcof = cofactor(a), cofactor(da)
        i1 = (ufl.tr(a), ufl.tr(da))
        i2 = (ufl.tr(cof), i1[0] * i1[1] - ufl.inner(a, da), ufl.tr(dcof))
        i3 = (
            determinant(a, cof),
            ufl.inner(cof, da),
            ufl.inner(a, dcof),
            determinant(da, dcof),
        )
        polynomials = (i1, i2, i3)

        def at(tau: float) -> list[Expr]:
            return [polynomial(i, tau) for i in polynomials]

        # What UFL is given twice it compares branch by branch.
        middle = self._material.slopes(*at(0.5))

        def power(tau: float) -> Expr:
            rates = [polynomial([k * c for k, c in enumerate(i)][1:], tau) for i in polynomials]
            slopes = middle if tau == 0.5 else self._material.slopes(*at(tau))
            first, *rest = (s * r for s, r in zip(slopes, rates, strict=True))
            return sum(rest, start=first)

        end, start = (self._material.of_invariants(*at(tau)) for tau in (1.0, 0.0))
        mean = 0.5 * (e0 + e1)
        return Path(power, self._stress(mean, at(0.5)[0], middle), end - start)

    def _stress(self, e: Expr, i1: Expr, slopes: Sequence[Expr]) -> Expr:
        """dW/dE where the first invariant and the slopes are known."""
        a = 2 * e
        first, second, third = slopes
        return 2 * ((first + second * i1) * ufl.Identity(3) - second * a + third * cofactor(a))


def polynomial(coefficients: Sequence[Any], x: Any) -> Any:
    """Sum of c_k x^k, k = 0, 1, ..."""
    value = coefficients[-1]
    for c in coefficients[-2::-1]:
        value = c + x * value
    return value


StrainEnergy = OfC | OfInvariants
#: A rule's discrete derivative of an energy between two strains.
DiscreteStress = Callable[[Any, Expr, Expr], Expr]
