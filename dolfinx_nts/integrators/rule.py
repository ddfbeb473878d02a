"""What a step asks of an integrator, and what most integrators share."""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

import ufl
from ufl import Form
from ufl.core.expr import Expr

from dolfinx_nts.kernels.potential import Potential
from dolfinx_nts.kernels.strain_energy import StrainEnergy, green_strain
from dolfinx_nts.types import FloatArray


@runtime_checkable
class Integrator(Protocol):
    """Rules of a scheme whose step solves M (du - ahead) + factor (forces) = 0 for du = u_1 - u_0.

    Constraints hold at t_{n+1}. All rules are hashable by what they are made of, so that forms are
    compiled once for equal ones.

    Attributes:
        inertia: Whether there are inertial forces.
        accelerations: Whether the scheme carries accelerations from step to step.
        closes_ledger: Whether the ledger closes to the tolerance of the solver.
        keeps_angular_momentum: Whether it changes by the moments of the step's forces at the middle
            of the step and nothing else.
        keeps_energy: Whether kinetic energy changes by the work of the step's forces and nothing
            else, as v_0 + v_1 = 2 (u_1 - u_0)/h makes it. Impacts can then give back what they
            lose, and nodes may have no mass.
        ledger_remedy: What else closes an open ledger, for messages; begins with a comma.
        order: Local error of the motion is of order + 1.
        theta: Where between t_n and t_{n+1} loads, and the direct rule's contact forces, are taken.
        taken_at: The same of forces that come as arrays, such as those of springs and beams; None:
            their discrete gradients between both ends. Forms have `piola` and `virtual_work`.
        contact_gradient: Rule of contact alone: "direct", or a discrete gradient's name.
    """

    inertia: bool
    accelerations: bool
    closes_ledger: bool
    keeps_angular_momentum: bool
    keeps_energy: bool
    ledger_remedy: str
    order: int
    theta: float
    taken_at: float | None
    contact_gradient: str

    def factor(self, dt: float) -> float:
        """What the step equations multiply forces by [s^2]."""

    def ramp(self, time: float) -> float:
        """Part of a constant load that acts at a time."""

    def ahead(self, v0: FloatArray, a0: FloatArray | None, dt: float) -> FloatArray:
        """Motion of a body without forces over the step [m]."""

    def rate(self, dt: float) -> float:
        """Change of v_1 with u_1 [1/s]."""

    def advance(
        self, du: FloatArray, v0: FloatArray, a0: FloatArray | None, dt: float
    ) -> tuple[FloatArray, FloatArray | None]:
        """Velocity [m/s] and acceleration [m/s^2], if there is one, at t_{n+1}."""

    def piola(self, energy: StrainEnergy, h0: Expr, h1: Expr) -> Expr:
        """First Piola-Kirchhoff stress in UFL [Pa] from displacement gradients at both ends."""

    def virtual_work(self, potential: Potential, u0: Expr, u1: Expr, w: Expr) -> Form:
        """Virtual work of a potential's forces in UFL [J] from displacements at both ends."""


class InTime:
    """What the integrators in time share; attributes as of `Integrator`."""

    inertia: ClassVar[bool] = True
    accelerations: ClassVar[bool] = False
    closes_ledger: ClassVar[bool] = False
    keeps_angular_momentum: ClassVar[bool] = False
    keeps_energy: ClassVar[bool] = False
    ledger_remedy: ClassVar[str] = ""
    contact_gradient: ClassVar[str] = "direct"

    @property
    def taken_at(self: Integrator) -> float | None:
        """Where forces that come as arrays are taken: where loads are."""
        return self.theta

    def ramp(self, time: float) -> float:
        """Part of a constant load that acts at a time: all of it."""
        return 1.0


class MiddleOfStep(InTime):
    """Motion whose velocity is linear over the step, under forces of its middle: (58), (61)."""

    keeps_angular_momentum: ClassVar[bool] = True
    keeps_energy: ClassVar[bool] = True
    order: ClassVar[int] = 2
    theta: ClassVar[float] = 0.5

    def factor(self, dt: float) -> float:
        """What the step equations multiply forces by: h^2/2 [s^2]."""
        return 0.5 * dt**2

    def ahead(self, v0: FloatArray, a0: FloatArray | None, dt: float) -> FloatArray:
        """Motion without forces h v_0 [m]."""
        return dt * v0

    def rate(self, dt: float) -> float:
        """Change of v_1 with u_1 [1/s]."""
        return 2.0 / dt

    def advance(
        self, du: FloatArray, v0: FloatArray, a0: FloatArray | None, dt: float
    ) -> tuple[FloatArray, None]:
        """v_1 = 2 (q_1 - q_0)/h - v_0 [m/s]."""
        return 2.0 / dt * du - v0, None


class WithAccelerations(InTime):
    """Newmark's formulas, with (1 - alpha_m) a_1 + alpha_m a_0 in the equation of motion.

    u_1 = u_0 + h v_0 + h^2 ((1/2 - beta) a_0 + beta a_1),
    v_1 = v_0 + h ((1 - gamma) a_0 + gamma a_1).
    """

    accelerations: ClassVar[bool] = True

    @property
    def _parameters(self) -> tuple[float, float, float]:
        """beta, gamma, alpha_m."""
        raise NotImplementedError

    def factor(self, dt: float) -> float:
        """What the step equations multiply forces by: beta h^2/(1 - alpha_m) [s^2]."""
        beta, _, alpha = self._parameters
        return beta * dt**2 / (1.0 - alpha)

    def ahead(self, v0: FloatArray, a0: FloatArray | None, dt: float) -> FloatArray:
        """Motion without forces [m]."""
        assert a0 is not None
        beta, _, alpha = self._parameters
        return dt * v0 + (0.5 - beta / (1.0 - alpha)) * dt**2 * a0

    def rate(self, dt: float) -> float:
        """Change of v_1 with u_1 [1/s]."""
        beta, gamma, _ = self._parameters
        return gamma / (beta * dt)

    def advance(
        self, du: FloatArray, v0: FloatArray, a0: FloatArray | None, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """v_1 [m/s] and a_1 [m/s^2]."""
        assert a0 is not None
        beta, gamma, _ = self._parameters
        a1 = (du - dt * v0) / (beta * dt**2) - (0.5 / beta - 1.0) * a0
        return v0 + dt * ((1.0 - gamma) * a0 + gamma * a1), a1


def stress_of(energy: StrainEnergy, h: Expr) -> Expr:
    """P = F S of one displacement gradient in UFL [Pa]."""
    return (ufl.Identity(3) + h) * energy.stress(green_strain(h))
