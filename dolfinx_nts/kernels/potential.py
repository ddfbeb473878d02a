"""Forces of any stored energy in UFL, at a state and in the mean between two."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import ufl
from ufl.algorithms import expand_derivatives
from ufl.core.expr import Expr

from dolfinx_nts.kernels.discrete_gradient import combine, gauss


class Potential(NamedTuple):
    """A stored energy Pi = energy(s) as a function of strains s = strains(u) (UFL).

    Attributes:
        energy: Callable of the strains -> form [J].
        strains: Callable u -> strains, a tuple of expressions.
    """

    energy: Callable[..., Any]
    strains: Callable[[Expr], tuple[Expr, ...]]

    def __call__(self, u: Expr) -> ufl.Form:
        """Pi(u)."""
        return self.energy(*self.strains(u))

    def virtual_work(self, u: Expr, w: Expr) -> ufl.Form:
        """dPi(u)/du in the direction of the test function w."""
        p = ufl.Coefficient(w.ufl_function_space())
        return _at_zero(ufl.derivative(self(u + p), p, w), p)

    def mean_virtual_work(self, u0: Expr, u1: Expr, w: Expr, points: int) -> ufl.Form:
        """Discrete gradient of Pi in the direction of the test function w.

        int_0^1 dPi/ds(s_0 + tau (s_1 - s_0)) dtau : Ds(u_m)[w] by Gauss points. Strains of degree
        <= 2 in u have s_1 - s_0 = Ds(u_m)[u_1 - u_0], so the work is Pi(u_1) - Pi(u_0) up to the
        quadrature: exactly for Pi of degree <= 2 points in s. Rotations, which change no strain,
        have Ds(u_m)[w] = 0 in any u_m, so that the angular momentum is kept, too.
        """
        space = w.ufl_function_space()
        p, place = ufl.Coefficient(space), ufl.Coefficient(space)
        change = [
            ufl.replace(expand_derivatives(ufl.derivative(s, place, p)), {place: 0.5 * (u0 + u1)})
            for s in self.strains(place)
        ]
        ends = list(zip(self.strains(u0), self.strains(u1), change, strict=True))
        tau, weight = gauss(points)
        energies = [self.energy(*(a + t * (b - a) + c for a, b, c in ends)) for t in tau.tolist()]
        return _at_zero(ufl.derivative(combine(weight, energies), p, w), p)


def _at_zero(form: ufl.Form, p: Expr) -> ufl.Form:
    """A form, with its derivatives carried out, where the Coefficient p is zero."""
    return ufl.replace(expand_derivatives(form), {p: ufl.zero(p.ufl_shape)})
