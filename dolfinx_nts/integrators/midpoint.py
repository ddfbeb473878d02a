"""The midpoint rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ufl import Form
from ufl.core.expr import Expr

from dolfinx_nts.integrators.rule import MiddleOfStep, stress_of
from dolfinx_nts.kernels.potential import Potential
from dolfinx_nts.kernels.strain_energy import StrainEnergy
from dolfinx_nts.validation import known_options


@known_options
@dataclass(frozen=True)
class Midpoint(MiddleOfStep):
    """Midpoint rule (58)-(60): keeps linear and angular momentum, not the energy.

    Contact is described directly: the projection is eliminated, the gap multiplier is the only
    unknown.
    """

    ledger_remedy: ClassVar[str] = ", or a smaller dt"

    def piola(self, energy: StrainEnergy, h0: Expr, h1: Expr) -> Expr:
        """First Piola-Kirchhoff stress P = F_m S(E(F_m)) in UFL [Pa] of F = 1 + H."""
        return stress_of(energy, 0.5 * (h0 + h1))

    def virtual_work(self, potential: Potential, u0: Expr, u1: Expr, w: Expr) -> Form:
        """Virtual work of a potential's forces in the middle in UFL [J]."""
        return potential.virtual_work(0.5 * (u0 + u1), w)
