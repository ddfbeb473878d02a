"""The rule of equilibrium."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from ufl import Form
from ufl.core.expr import Expr

from dolfinx_nts.integrators.rule import stress_of
from dolfinx_nts.kernels.potential import Potential
from dolfinx_nts.kernels.strain_energy import StrainEnergy
from dolfinx_nts.types import FloatArray


@dataclass(frozen=True)
class Static:
    """Equilibrium at the end of a load step: no inertia, forces at t_{n+1}; t is pseudo time."""

    inertia: ClassVar[bool] = False
    accelerations: ClassVar[bool] = False
    closes_ledger: ClassVar[bool] = False
    keeps_angular_momentum: ClassVar[bool] = True
    keeps_energy: ClassVar[bool] = False
    ledger_remedy: ClassVar[str] = ""
    order: ClassVar[int] = 1
    theta: ClassVar[float] = 1.0
    taken_at: ClassVar[float] = 1.0
    contact_gradient: ClassVar[str] = "direct"

    def factor(self, dt: float) -> float:
        """Nothing: the equations are forces [N]."""
        return 1.0

    def ramp(self, time: float) -> float:
        """Constant loads grow with pseudo time up to 1."""
        return min(time, 1.0)

    def ahead(self, v0: FloatArray, a0: FloatArray | None, dt: float) -> FloatArray:
        """Motion at the rate of the last load step [m], a first guess."""
        return dt * v0

    def rate(self, dt: float) -> float:
        """None."""
        return 0.0

    def advance(
        self, du: FloatArray, v0: FloatArray, a0: FloatArray | None, dt: float
    ) -> tuple[FloatArray, None]:
        """At rest."""
        return np.zeros_like(v0), None

    def piola(self, energy: StrainEnergy, h0: Expr, h1: Expr) -> Expr:
        """First Piola-Kirchhoff stress P = F_1 S(E_1) in UFL [Pa] of F = 1 + H."""
        return stress_of(energy, h1)

    def virtual_work(self, potential: Potential, u0: Expr, u1: Expr, w: Expr) -> Form:
        """Virtual work of a potential's forces at t_{n+1} in UFL [J]."""
        return potential.virtual_work(u1, w)


#: What every body can be asked for without a scheme in time.
EQUILIBRIUM: Any = Static()
