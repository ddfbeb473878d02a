"""Time integrators and the static rule: evaluation rules only; constraints hold at t_{n+1}."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import ufl

from dolfinx_nts.discrete_gradient import gonzalez_stress, mean_value_stress
from dolfinx_nts.strain_energy import StrainEnergy, green_strain
from dolfinx_nts.validation import is_whole, known_options

FloatArray = npt.NDArray[np.float64]


def _choose(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name}={value!r}: choose one of {', '.join(map(repr, known))}")


def _stress_of(energy: StrainEnergy, h: Any) -> Any:
    """P = F S of one displacement gradient in UFL [Pa]."""
    return (ufl.Identity(3) + h) * energy.stress(green_strain(h))


class _InTime:
    """What the integrators in time share; forces act at the midpoint.

    Attributes:
        inertia: Whether there are inertial forces.
        theta: Where between t_n and t_{n+1} loads and the direct rule's contact forces are taken.
        closes_ledger: Whether the ledger closes to the tolerance of the solver.
    """

    inertia: ClassVar[bool] = True
    closes_ledger: ClassVar[bool] = False
    theta: ClassVar[float] = 0.5

    def factor(self, dt: float) -> float:
        """What the step equations multiply forces by: h^2/2 [s^2]."""
        return 0.5 * dt**2

    def ramp(self, time: float) -> float:
        """Part of a constant load that acts at a time."""
        return 1.0

    def velocity(self, du: FloatArray, v0: FloatArray, dt: float) -> FloatArray:
        """v_1 = 2 (q_1 - q_0)/h - v_0 [m/s]."""
        return 2.0 / dt * du - v0


@known_options
@dataclass(frozen=True)
class Midpoint(_InTime):
    """Midpoint rule (58)-(60): keeps linear and angular momentum, not the energy."""

    #: Contact is described directly: the projection is eliminated, the gap multiplier is the only
    #: unknown.
    contact_gradient: ClassVar[str] = "direct"

    def piola(self, energy: StrainEnergy, h0: Any, h1: Any) -> Any:
        """First Piola-Kirchhoff stress P = F_m S(E(F_m)) in UFL [Pa] of F = 1 + H."""
        return _stress_of(energy, 0.5 * (h0 + h1))


@known_options
@dataclass(frozen=True, kw_only=True)
class EnergyMomentum(_InTime):
    """Energy-momentum scheme (61)-(66): keeps both momenta and closes the energy ledger.

    Attributes:
        stress: Discrete derivative of the strain energy, "gonzalez" (exact) or "mean-value"
            (Gauss points in time: exact for polynomial W such as StVenantKirchhoff, to quadrature
            error otherwise).
        contact_gradient: Discrete gradient of the contact constraints, "mean-value" (exact, unit
            independent) or "gonzalez" (the paper's (67), for comparison).
        quadrature_points: Gauss points in time of the mean-value stress, 1 to 7.

    Raises:
        ValueError: Unknown rule or number of points.
    """

    closes_ledger: ClassVar[bool] = True

    stress: str = "gonzalez"
    contact_gradient: str = "mean-value"
    quadrature_points: int = 3

    def __post_init__(self) -> None:
        _choose("stress", self.stress, ("gonzalez", "mean-value"))
        _choose("contact_gradient", self.contact_gradient, ("mean-value", "gonzalez"))
        if not (is_whole(self.quadrature_points) and 1 <= self.quadrature_points <= 7):
            raise ValueError(f"quadrature_points={self.quadrature_points!r}: choose 1 to 7")

    def piola(self, energy: StrainEnergy, h0: Any, h1: Any) -> Any:
        """First Piola-Kirchhoff stress P = F_m S(E_0, E_1) in UFL [Pa] of F = 1 + H."""
        e0, e1 = green_strain(h0), green_strain(h1)
        if self.stress == "gonzalez":
            stress = gonzalez_stress(energy, e0, e1)
        else:
            stress = mean_value_stress(energy, e0, e1, self.quadrature_points)
        return (ufl.Identity(3) + 0.5 * (h0 + h1)) * stress


@dataclass(frozen=True)
class Static:
    """Equilibrium at the end of a load step: no inertia, forces at t_{n+1}; t is pseudo time."""

    contact_gradient: ClassVar[str] = "direct"
    inertia: ClassVar[bool] = False
    closes_ledger: ClassVar[bool] = False
    theta: ClassVar[float] = 1.0

    def piola(self, energy: StrainEnergy, h0: Any, h1: Any) -> Any:
        """First Piola-Kirchhoff stress P = F_1 S(E_1) in UFL [Pa] of F = 1 + H."""
        return _stress_of(energy, h1)

    def factor(self, dt: float) -> float:
        """Nothing: the equations are forces [N]."""
        return 1.0

    def ramp(self, time: float) -> float:
        """Constant loads grow with pseudo time up to 1."""
        return min(time, 1.0)

    def velocity(self, du: FloatArray, v0: FloatArray, dt: float) -> FloatArray:
        """At rest."""
        return np.zeros_like(v0)
