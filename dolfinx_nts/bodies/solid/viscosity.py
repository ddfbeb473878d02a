"""Viscosity of solids, beside their elasticity (Kelvin and Voigt), theory section 2."""

from __future__ import annotations

import ufl
from ufl.core.expr import Expr

from dolfinx_nts.bodies.solid.parameters import Parameter, is_number, require_parameter
from dolfinx_nts.validation import is_finite


def check_viscosity(viscosity: Parameter) -> None:
    """Raise ValueError if it is negative anywhere."""
    wanted = "must be finite and not negative [Pa s]"
    require_parameter("viscosity", viscosity, lambda v: is_finite(v) and v >= 0, wanted)


def is_viscous(viscosity: Parameter) -> bool:
    """Whether there is any, now or later; the number 0 stays what it is."""
    return not (is_number(viscosity) and viscosity == 0)


def viscous_work(viscosity: Expr, u: Expr, v: Expr, w: Expr) -> Expr:
    """Virtual power 2 eta dE/dt : DE w per volume in UFL, linear in v and w.

    With w = v it is what the viscosity takes, which is a square. E is Green's strain: with the mean
    u of both ends and v = (u_1 - u_0)/h, dE/dt is (E_1 - E_0)/h.

    Args:
        viscosity: eta [Pa s].
        u: Displacement [m].
        v: Velocity [m/s].
        w: Test function, or a velocity.
    """
    f = ufl.Identity(3) + ufl.grad(u)
    rate, virtual = (ufl.sym(f.T * ufl.grad(x)) for x in (v, w))
    return 2 * viscosity * ufl.inner(rate, virtual)
