"""Energies whose change of volume is the cells' means, so that cells do not lock (theory 19)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import ufl
from ufl.core.expr import Expr

from dolfinx_nts.kernels.precise import cofactor, invariants, log1p
from dolfinx_nts.kernels.strain_energy import DiscreteStress, StrainEnergy

#: Increments below this part are for the series of the logarithm.
_SMALL = 1e-3
#: Shear that tells the modulus, whose square is what it errs by.
_SHEAR = 1e-5


def shear_modulus(law: StrainEnergy) -> Expr:
    """Shear modulus of an energy without strain [Pa], the mean of three directions (UFL)."""
    shear = ufl.as_matrix([[0.0 if i == j else 0.5 * _SHEAR for i in range(3)] for j in range(3)])
    change = law.stress(shear) - law.stress(-shear)
    return (change[0, 1] + change[0, 2] + change[1, 2]) / (6 * _SHEAR)


class _Volume(NamedTuple):
    """Change of volume at a point and in its cell, of one strain (UFL).

    Attributes:
        cofactor: Of C.
        change: J - 1.
        mean: theta - 1, the cell's mean of J - 1.
        log: ln J.
        log_mean: ln theta.
        root: J^(1/3).
        mean_root: theta^(1/3).
        strain: Green's strain of C (theta/J)^(2/3), whose determinant is theta^2.
    """

    cofactor: Expr
    change: Expr
    mean: Expr
    log: Expr
    log_mean: Expr
    root: Expr
    mean_root: Expr
    strain: Expr

    @property
    def misfit(self) -> Expr:
        """How far the point's volume is from its cell's, ln J - ln theta."""
        return self.log - self.log_mean


class ProjectedVolume:
    """W((theta/J)^(2/3) C) + mu/3 (ln J - ln theta)^2, theta the mean of J in each cell.

    Cells of degree 1 have too few motions to keep the volume at each point. The second term keeps
    apart what a cell could do without any energy.

    Args:
        law: W of the strain at a point.
        shear: mu, the shear modulus without strain [Pa].
        mean: Makes of a function of the strain a symbol of its mean in each cell.

    Source: Simo, Taylor and Pister (1985), with theta and the pressure eliminated.
    """

    def __init__(self, law: StrainEnergy, shear: Expr, mean: Callable[[Expr], Expr]) -> None:
        self._law, self._shear, self._mean = law, shear, mean

    def __call__(self, e: Expr) -> Expr:
        """W(E) [J/m^3]."""
        at = self._volume(e)
        return self._law(at.strain) + self._shear / 3 * at.misfit**2

    def stress(self, e: Expr) -> Expr:
        """Derivative by E, symmetric: the second Piola-Kirchhoff stress [Pa]."""
        return self.between(e, e, lambda law, a, _: law.stress(a))

    def at_point(self, e: Expr) -> Expr:
        """Stress of the law at the strain with the cell's volume [Pa], without the pressure."""
        return self._law.stress(self._volume(e).strain)

    def between(self, e0: Expr, e1: Expr, discrete: DiscreteStress) -> Expr:
        """Discrete derivative of the energy of a cell between two strains [Pa] (theory 19.2).

        Args:
            e0: Strain at t_n.
            e1: Strain at t_{n+1}.
            discrete: The rule's discrete derivative of the law.
        """
        same = e0 is e1
        start = self._volume(e0)
        end = start if same else self._volume(e1)
        stress = discrete(self._law, start.strain, end.strain)
        c = ufl.Identity(3) + e0 + e1
        along = 0.5 * ufl.inner(stress, c)
        misfit = self._shear / 3 * (start.misfit + end.misfit)
        j0, j1, c0, c1 = start.root, end.root, start.mean_root, end.mean_root
        of_mean = (c0 + c1) / (c0**2 + c0 * c1 + c1**2)
        of_point = (j0 + j1) / (j0**2 * j1**2 * (j0**2 + j0 * j1 + j1**2))
        push = along * 0.5 * (1 / j0**2 + 1 / j1**2) * of_mean
        push -= misfit * _of_log(start.mean, end.mean, start.log_mean, end.log_mean)
        pull = misfit * _of_log(start.change, end.change, start.log, end.log)
        pull -= along * 0.5 * (c0**2 + c1**2) * of_point
        middle = start.cofactor if same else cofactor(c)
        whole = (start.cofactor + 4 * middle + end.cofactor) / 6
        volume = whole / (2 + start.change + end.change)
        factors = 0.5 * ((c0 / j0) ** 2 + (c1 / j1) ** 2)
        return factors * stress + 2 * (self._mean(push) + pull) * volume

    def _volume(self, e: Expr) -> _Volume:
        i1, i2, i3 = invariants(e)
        grown = i1 + i2 + i3  # det C - 1
        change = grown / (1 + ufl.sqrt(1 + grown))
        mean, log = self._mean(change), 0.5 * log1p(grown)
        log_mean = log1p(mean)
        root, mean_root = ufl.exp(log / 3), ufl.exp(log_mean / 3)
        # Differences from 1, of which the roots have lost digits.
        less, mean_less = (
            x / (r**2 + r + 1) for x, r in ((change, root), (mean, mean_root))
        )
        grows = (mean_less - less) * (mean_root + root) / root**2  # (theta/J)^(2/3) - 1
        strain = e + grows * (e + 0.5 * ufl.Identity(3))
        of_c = cofactor(ufl.Identity(3) + 2 * e)
        return _Volume(of_c, change, mean, log, log_mean, root, mean_root, strain)


def _of_log(a: Expr, b: Expr, log_a: Expr, log_b: Expr) -> Expr:
    """Difference of ln(1 + b) and ln(1 + a), which are known, over b - a, which may be zero."""
    y = (b - a) / (1 + a)
    series = 1 - y * (1 / 2 - y * (1 / 3 - y * (1 / 4 - y * (1 / 5 - y / 6))))
    # The addend is far below any increment that counts; it keeps 0/0 away at rest.
    quotient = (log_b - log_a) / (b - a + 1e-200)
    return ufl.conditional(ufl.lt(abs(y), _SMALL), series / (1 + a), quotient)
