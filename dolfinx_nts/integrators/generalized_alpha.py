"""The generalised alpha method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ufl import Form
from ufl.core.expr import Expr

from dolfinx_nts.integrators.rule import WithAccelerations, stress_of
from dolfinx_nts.kernels.potential import Potential
from dolfinx_nts.kernels.strain_energy import StrainEnergy
from dolfinx_nts.validation import is_finite, known_options


@known_options
@dataclass(frozen=True, kw_only=True)
class GeneralizedAlpha(WithAccelerations):
    """Generalised alpha method (Chung and Hulbert 1993): damps what the steps do not resolve.

    Newmark's formulas between

    (1 - alpha_m) M a_1 + alpha_m M a_0 + f(q) + G(q)^T lambda = f_ext,  q = u_0 + theta (u_1 - u_0)

    with theta = 1 - alpha_f; loads and contact forces are those of t_n + theta h, gaps close at
    t_{n+1}.

    Attributes:
        rho_inf: Part of the amplitude of infinitely fast vibrations that a step keeps, from 0 to 1;
            1 is the midpoint rule.

    Raises:
        ValueError: rho_inf is out of range.
    """

    order: ClassVar[int] = 2

    rho_inf: float = 0.8

    def __post_init__(self) -> None:
        if not (is_finite(self.rho_inf) and 0.0 <= self.rho_inf <= 1.0):
            raise ValueError(f"rho_inf={self.rho_inf!r}: must lie in [0, 1]")

    @property
    def theta(self) -> float:
        """Where between t_n and t_{n+1} forces are taken: 1 - alpha_f."""
        return 1.0 / (1.0 + self.rho_inf)

    @property
    def _parameters(self) -> tuple[float, float, float]:
        alpha_m = (2.0 * self.rho_inf - 1.0) / (self.rho_inf + 1.0)
        shift = 1.0 - self.theta - alpha_m
        return 0.25 * (1.0 + shift) ** 2, 0.5 + shift, alpha_m

    def piola(self, energy: StrainEnergy, h0: Expr, h1: Expr) -> Expr:
        """First Piola-Kirchhoff stress P = F S(E(F)) of F at t_n + theta h in UFL [Pa]."""
        return stress_of(energy, h0 + self.theta * (h1 - h0))

    def virtual_work(self, potential: Potential, u0: Expr, u1: Expr, w: Expr) -> Form:
        """Virtual work of a potential's forces at t_n + theta h in UFL [J]."""
        return potential.virtual_work(u0 + self.theta * (u1 - u0), w)
