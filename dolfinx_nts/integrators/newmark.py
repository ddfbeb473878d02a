"""Newmark's family."""

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
class Newmark(WithAccelerations):
    """Newmark's method (1959), with forces and contact at t_{n+1}: keeps linear momentum alone.

    u_1 = u_0 + h v_0 + h^2 ((1/2 - beta) a_0 + beta a_1),
    v_1 = v_0 + h ((1 - gamma) a_0 + gamma a_1),
    M a_1 + f(u_1) + G(u_1)^T lambda_1 = f_ext(t_1).

    With gamma = 1/2 it is of second order, and the trapezoidal rule with beta = 1/4, which keeps
    J + h^2/4 sum v x M a in place of the angular momentum J. Linear problems are stable for
    2 beta >= gamma >= 1/2. A larger gamma damps, and is of first order. So is friction, whose force
    at t_{n+1} opposes the slip of the whole step, and the work of supports in the ledger, while
    that of loads is of the mean of both ends. Impacts bring energy in, the more the smaller the
    step: the method is here to compare with.

    Attributes:
        beta: > 0, up to 1/2.
        gamma: From 1/2 to 1.

    Raises:
        ValueError: A parameter is out of range.
    """

    theta: ClassVar[float] = 1.0

    beta: float = 0.25
    gamma: float = 0.5

    def __post_init__(self) -> None:
        if not (is_finite(self.beta) and 0.0 < self.beta <= 0.5):
            raise ValueError(f"beta={self.beta!r}: must lie in (0, 0.5]")
        if not (is_finite(self.gamma) and 0.5 <= self.gamma <= 1.0):
            raise ValueError(f"gamma={self.gamma!r}: must lie in [0.5, 1]; less is unstable")

    @property
    def order(self) -> int:
        """Of the global error."""
        return 2 if self.gamma == 0.5 else 1

    @property
    def _parameters(self) -> tuple[float, float, float]:
        return self.beta, self.gamma, 0.0

    def piola(self, energy: StrainEnergy, h0: Expr, h1: Expr) -> Expr:
        """First Piola-Kirchhoff stress P = F_1 S(E_1) in UFL [Pa] of F = 1 + H."""
        return stress_of(energy, h1)

    def virtual_work(self, potential: Potential, u0: Expr, u1: Expr, w: Expr) -> Form:
        """Virtual work of a potential's forces at t_{n+1} in UFL [J]."""
        return potential.virtual_work(u1, w)
