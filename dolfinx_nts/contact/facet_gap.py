"""Gap of points to facets, and their slip along them: the element of theory sections 3 to 5.

The midpoint rule has one unknown per element (lambda_N), the energy-momentum scheme eleven (d, f
and six multipliers). Friction adds two (lambda_T).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinx_nts.contact.contact_measure import Batch, Measured, Slip
from dolfinx_nts.contact.surface_sums import Sums
from dolfinx_nts.kernels import compiled, facets, nts_element
from dolfinx_nts.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class FacetGap(Batch):
    """See `ContactMeasure`; the points are the slave and a facet's corners or control points.

    Attributes:
        start: Slave and control points at t_n [m], shape (n, nc + 1, 3).
        xi: Orthogonal projection at t_n, shape (n, 2).
        normal: Of the facet there, shape (n, 3).
        length: Size of the facet [m], shape (n,).
        rule: `Integrator.contact_gradient`.
        theta: Where between t_n and t_{n+1} the direct rule takes the contact force.
        condense: Whether (d, f) and their multipliers are eliminated element by element.
    """

    start: FloatArray
    xi: FloatArray
    normal: FloatArray
    length: FloatArray
    rule: str
    theta: float
    condense: bool
    extent = 0.0

    @property
    def _only_normal(self) -> bool:
        """Whether lambda_N is the only multiplier of a constraint."""
        return self.condense or self.rule == "direct"

    @property
    def num_augmented(self) -> int:
        """Unknowns d and f."""
        return 0 if self._only_normal else nts_element.NUM_AUGMENTED

    @property
    def num_normal(self) -> int:
        """The gap, and with d and f what these satisfy."""
        return 1 if self._only_normal else nts_element.NUM_CONSTRAINTS

    @cached_property
    def foot(self) -> FloatArray:
        """Weights of the control points in the foot at t_n, shape (n, nc)."""
        return facets.shape(self.xi, self.start.shape[1] - 1)[0]

    @cached_property
    def tangents(self) -> FloatArray:
        """Tangents a_a of the facets at t_n over their size [-], shape (n, 2, 3)."""
        _, tangents, _ = facets.frame(self.start[:, 1:], self.xi)
        return tangents / self.length[:, None, None]

    def gap(self, x: FloatArray) -> FloatArray:
        """Gap [m] of points at t_{n+1}, shape (n,)."""
        xi = self.projection(x)
        foot, _, normal = facets.frame(x[:, 1:], xi)
        gap = np.einsum("ni,ni->n", x[:, 0] - foot, normal)
        return np.where(facets.turned_over(x[:, 1:], xi), np.abs(gap), gap)

    def projection(self, x: FloatArray) -> FloatArray:
        """Convective coordinates (n, 2); NaN, which no step survives, where there is none."""
        xi, converged = compiled.project(x[:, 0], x[:, 1:], self.xi)
        xi[~converged] = np.nan
        return xi

    def normal_at(self, x: FloatArray) -> FloatArray:
        """Unit normals at the feet of points at t_{n+1}, shape (n, 3)."""
        return facets.frame(x[:, 1:], self.projection(x))[2]

    def augmented(self, x: FloatArray) -> FloatArray:
        """Facet size times the d and f that fit points at t_{n+1} [m]."""
        return self._fitting(x) if self.num_augmented else np.empty((len(x), 0))

    def _fitting(self, x: FloatArray) -> FloatArray:
        xi = self.projection(x)
        _, _, normal = facets.frame(x[:, 1:], xi)
        return np.column_stack([normal, xi]) * self.length[:, None]

    def evaluate(self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray) -> Measured:
        """Residual and tangent; `augmented` as of `augmented`."""
        xi = self.projection(x)
        if self.rule == "direct":
            found = self._direct(x, xi, multiplier)
        elif not self.condense:
            found = self._invariants(x, augmented, multiplier)
        elif self.rule == "mean-value":
            found = self._compiled(x, xi, multiplier)
        else:
            found = self._condensed(x, multiplier)
        away = facets.turned_over(x[:, 1:], xi)
        if away.any():
            gap = np.where(away, np.abs(found.gap), found.gap)
            found = found._replace(gap=gap, let_go=away)
        if found.slip is None:
            return found
        return found._replace(normal=self.normal_between(x))

    def summed(
        self, x: FloatArray, sums: Sums, multiplier: FloatArray, frame: FloatArray
    ) -> compiled.OverSurface:
        """What points contribute to slaves that carry so much, as of `ObstacleGap`."""
        xi, given = self.projection(x), None
        if self.rule != "mean-value":
            own = sums.carried(multiplier, frame, self.middle_tangents(x, xi))
            found = self.evaluate(x, np.empty((len(x), 0)), own)
            slip = found.slip.gradient if found.slip else np.empty(0)
            given = found.residual, found.tangent, slip
        start = self.start, self.normal, self.xi, self.length
        how = sums.how(multiplier, frame)
        return compiled.over_surface(start, (x, xi), self.theta, how, given)

    def has_strayed(self, x: FloatArray, cut: FloatArray, limit: float) -> BoolArray:
        """Which points lie elsewhere over their facets than at coordinates (n, 2), by a limit."""
        far: BoolArray = np.abs(self.projection(x) - cut).max(axis=1) > limit
        return far

    def middle_tangents(self, x: FloatArray, xi: FloatArray) -> FloatArray:
        """Tangents a_a over the facet's size, where between t_n and t_{n+1} friction acts [-].

        Args:
            x: Points at t_{n+1} [m].
            xi: Their projection.

        Returns:
            Shape (n, 2, 3).
        """
        control = (self.start + self.theta * (x - self.start))[:, 1:]
        _, first, _ = facets.shape(self.xi + self.theta * (xi - self.xi), control.shape[1])
        tangents = np.einsum("nia,nij->naj", first, control)
        return np.asarray(tangents / self.length[:, None, None])

    def normal_between(self, x: FloatArray) -> FloatArray:
        """Unit normals where between t_n and t_{n+1} the contact force acts, shape (n, 3)."""
        return self.normal_at(self.start + self.theta * (x - self.start))

    def _has_friction(self, multiplier: FloatArray) -> bool:
        return multiplier.shape[1] > self.num_normal

    def _direct(self, x: FloatArray, xi_end: FloatArray, multiplier: FloatArray) -> Measured:
        """`evaluate` of (x, multipliers), with the projection."""
        n, size, theta = len(x), 3 * x.shape[1], self.theta
        middle = self.start + theta * (x - self.start)
        xi_middle = self.projection(middle)
        force, end = nts_element.gap(middle, xi_middle), nts_element.gap(x, xi_end)
        gradient = force.gradient.reshape(n, size)
        residual = np.zeros((n, size + multiplier.shape[1]))
        tangent = np.zeros((*residual.shape, residual.shape[1]))
        residual[:, :size] = multiplier[:, :1] * gradient
        residual[:, size] = end.value
        tangent[:, :size, :size] = theta * multiplier[:, :1, None] * force.hessian
        tangent[:, :size, size] = gradient
        tangent[:, size, :size] = end.gradient.reshape(n, size)
        if not self._has_friction(multiplier):
            return Measured(residual, tangent, end.value)

        length, t = self.length, multiplier[:, -2:]
        middle_xi = nts_element.projection(middle, xi_middle, t)
        end_xi = nts_element.projection(x, xi_end, np.zeros_like(t))
        along = length[:, None, None] * middle_xi.gradient
        residual[:, :size] += np.einsum("na,naz->nz", t, along)
        tangent[:, :size, :size] += theta * length[:, None, None] * middle_xi.hessian
        tangent[:, :size, -2:] = along.transpose(0, 2, 1)
        value = length[:, None] * (xi_end - self.xi)
        gradient = np.zeros((n, 2, residual.shape[1]))
        gradient[..., :size] = length[:, None, None] * end_xi.gradient
        metric_gradient = np.zeros((n, 2, 2, residual.shape[1]))
        metric_gradient[..., :size] = theta * middle_xi.metric_gradient
        slip = self._slip(value, gradient, middle_xi.metric, metric_gradient)
        return Measured(residual, tangent, end.value, slip)

    def _slip(
        self, value: FloatArray, gradient: FloatArray, metric: FloatArray, by_unknowns: FloatArray
    ) -> Slip:
        """Slip [m] and its gradient as given, the metric per square of the facet size."""
        area = self.length[:, None, None] ** 2
        return Slip(value, gradient, metric / area, by_unknowns / area[..., None])

    def _invariants(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> Measured:
        """Scaled residual and tangent of (x, d, f, all multipliers), gap and slip.

        Condensed, the multipliers of the augmented constraints are those that hold the rows of d
        and f, in which they are linear.
        """
        n, friction, length = len(x), self._has_friction(multiplier), self.length[:, None]
        positions = (n, 3 * x.shape[1])
        z0 = np.concatenate([self.start.reshape(positions), self.normal, self.xi], axis=1)
        z1 = np.concatenate([x.reshape(positions), augmented / length], axis=1)
        # One length per element makes every unknown a length or a force, so blocks compare across
        # units and scales.
        row, one = 1.0 / length, np.ones_like(length)
        rows = np.tile(row, nts_element.NUM_AUGMENTED)
        scale_z = np.concatenate([np.ones(positions), rows], axis=1)
        scale_g = np.concatenate([one, one, one, length, row, row], axis=1)
        size = z1.shape[1]
        stop = size + nts_element.NUM_CONSTRAINTS
        hidden = slice(size - nts_element.NUM_AUGMENTED, size)

        def hold(gradient: FloatArray) -> FloatArray:
            """All six multipliers from lambda_N and lambda_T."""
            rows = gradient[:, :, hidden] * scale_z[:, None, hidden]
            load = multiplier[:, :1] * rows[:, 0]
            load[:, -2:] += multiplier[:, 1:] if friction else 0.0
            others = nts_element.solve(rows[:, 1:].transpose(0, 2, 1), -load[:, :, None])[:, :, 0]
            return np.concatenate([multiplier[:, :1], others], axis=1)

        given = hold
        if not self.condense:
            given = multiplier[:, : nts_element.NUM_CONSTRAINTS] * scale_g
        e = nts_element.element(z0, z1, given, self.rule)
        residual = np.zeros((n, stop + 2 * friction))
        residual[:, :size], residual[:, size:stop] = e.force * scale_z, e.constraint * scale_g
        tangent = np.zeros((*residual.shape, residual.shape[1]))
        tangent[:, :size, :size] = e.stiffness * scale_z[:, :, None] * scale_z[:, None]
        mixed = scale_g[:, :, None] * scale_z[:, None]
        tangent[:, :size, size:stop] = (e.force_gradient * mixed).transpose(0, 2, 1)
        tangent[:, size:stop, :size] = e.constraint_gradient * mixed
        if not friction:
            return Measured(residual, tangent, e.constraint[:, 0])

        f = slice(size - 2, size)
        residual[:, f] += multiplier[:, -2:]
        tangent[:, f, -2:] = np.eye(2)
        gradient = np.zeros((n, 2, residual.shape[1]))
        gradient[:, :, f] = np.eye(2)
        metric, by_pi = nts_element.metric(e.invariants, x.shape[1] - 1)
        metric_gradient = np.zeros((n, 2, 2, residual.shape[1]))
        by_z = np.matmul(by_pi.reshape(n, 4, by_pi.shape[-1]), e.invariant_gradient)
        metric_gradient[..., :size] = by_z.reshape(n, 2, 2, size) * scale_z[:, None, None]
        slip = self._slip(augmented[:, 3:] - length * self.xi, gradient, metric, metric_gradient)
        return Measured(residual, tangent, e.constraint[:, 0], slip)

    def _compiled(self, x: FloatArray, xi: FloatArray, multiplier: FloatArray) -> Measured:
        """`_condensed` of the mean value, with the projection."""
        k = compiled.condensed(
            self.start, x, self.normal, self.xi, xi, self.length, multiplier
        )
        slip = None
        if self._has_friction(multiplier):
            value = self.length[:, None] * (xi - self.xi)
            slip = Slip(value, k.slip_gradient, k.metric, k.metric_gradient)
        return Measured(k.residual, k.tangent, k.gap, slip)

    def _condensed(self, x: FloatArray, multiplier: FloatArray) -> Measured:
        """The element in (x, lambda_N, lambda_T): constraints fix d and f, whose rows fix the rest.

        At the projection of t_{n+1} the augmented constraints hold, so that the Schur complement
        is the exact tangent.
        """
        residual, tangent, gap, slip, *_ = self._invariants(x, self._fitting(x), multiplier)
        places = 3 * x.shape[1]
        stop = places + nts_element.NUM_AUGMENTED
        middle = stop + nts_element.NUM_CONSTRAINTS
        inner = np.r_[places:stop, stop + 1 : middle]
        outer = np.r_[:places, stop, middle : tangent.shape[1]]
        among, by_outer = (tangent[:, inner[:, None], columns] for columns in (inner, outer))
        inside = nts_element.solve(among, by_outer)

        def reduce(a: FloatArray) -> FloatArray:
            """Derivatives by the outer unknowns from those by all."""
            return a[..., outer] - np.matmul(a[..., inner], inside)

        tangent = reduce(tangent[:, outer])
        if slip is not None:
            n = len(x)
            by_metric = reduce(slip.metric_gradient.reshape(n, 4, slip.gradient.shape[-1]))
            by_metric = by_metric.reshape(n, 2, 2, len(outer))
            slip = slip._replace(gradient=reduce(slip.gradient), metric_gradient=by_metric)
        return Measured(residual[:, outer], tangent, gap, slip)
