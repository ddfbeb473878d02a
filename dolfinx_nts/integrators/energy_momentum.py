"""The energy-momentum scheme."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import ufl
from ufl import Form
from ufl.core.expr import Expr

from dolfinx_nts.integrators.rule import MiddleOfStep
from dolfinx_nts.kernels.discrete_gradient import gonzalez_stress, mean_value_stress
from dolfinx_nts.kernels.potential import Potential
from dolfinx_nts.kernels.strain_energy import StrainEnergy, green_strain
from dolfinx_nts.validation import is_whole, known_options, require_one_of


@known_options
@dataclass(frozen=True, kw_only=True)
class EnergyMomentum(MiddleOfStep):
    """Energy-momentum scheme (61)-(66): keeps both momenta and closes the energy ledger.

    Attributes:
        stress: Discrete derivative of the strain energy, "gonzalez" (exact) or "mean-value"
            (Gauss points in time: exact for polynomial W such as StVenantKirchhoff, to quadrature
            error otherwise).
        contact_gradient: Discrete gradient of the contact constraints, "mean-value" (exact, unit
            independent) or "gonzalez" (the paper's (67), for comparison).
        quadrature_points: Gauss points in time, 1 to 7, of the mean-value stress and, whatever
            `stress` is, of the forces of a `FormBody`.

    Raises:
        ValueError: Unknown rule or number of points.
    """

    closes_ledger: ClassVar[bool] = True
    taken_at: ClassVar[None] = None  # type: ignore[assignment]

    stress: str = "gonzalez"
    contact_gradient: str = "mean-value"  # type: ignore[misc]
    quadrature_points: int = 3

    def __post_init__(self) -> None:
        require_one_of("stress", self.stress, ("gonzalez", "mean-value"))
        require_one_of("contact_gradient", self.contact_gradient, ("mean-value", "gonzalez"))
        if not (is_whole(self.quadrature_points) and 1 <= self.quadrature_points <= 7):
            raise ValueError(f"quadrature_points={self.quadrature_points!r}: choose 1 to 7")

    @property
    def ledger_remedy(self) -> str:  # type: ignore[override]
        """A discrete derivative that is exact for any W, unless it is this one."""
        if self.stress == "gonzalez":
            return ""
        return ', or stress="gonzalez": a mean-value stress is exact for some W only'

    def piola(self, energy: StrainEnergy, h0: Expr, h1: Expr) -> Expr:
        """First Piola-Kirchhoff stress P = F_m S(E_0, E_1) in UFL [Pa] of F = 1 + H."""
        rule = gonzalez_stress
        if self.stress == "mean-value":
            rule = partial(mean_value_stress, points=self.quadrature_points)
        stress = energy.between(green_strain(h0), green_strain(h1), rule)
        return (ufl.Identity(3) + 0.5 * (h0 + h1)) * stress

    def virtual_work(self, potential: Potential, u0: Expr, u1: Expr, w: Expr) -> Form:
        """Virtual work of a potential's forces in the mean over the step in UFL [J]."""
        return potential.mean_virtual_work(u0, u1, w, self.quadrature_points)
