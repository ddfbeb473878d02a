"""Contact of nodes with facets in one step: the node-to-surface element (theory sections 3 to 5).

The midpoint rule has one unknown per candidate (lambda_N), the energy-momentum scheme eleven (d, f
and six multipliers). Friction adds two (lambda_T).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.coulomb import Slip
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels import compiled, facets, nts_element
from dolfinx_nts.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class FacetElements(ContactElements):
    """Candidates of a pair of surfaces.

    Attributes:
        master_scale: `scale` of the points of the masters, shape (n, points).
    """

    master_scale: FloatArray

    def _of_pairs(self, chosen: BoolArray) -> dict[str, Any]:
        """What some of the pairs are made of, by attribute."""
        return super()._of_pairs(chosen) | {"master_scale": self.master_scale[chosen]}

    @property
    def num_control(self) -> int:
        """Corners of a facet, or control points of its patch."""
        return self.x0.shape[1] - 1

    @property
    def _only_normal(self) -> bool:
        """Whether lambda_N is the only multiplier of a constraint."""
        return self.condense or self.direct

    @property
    def num_augmented(self) -> int:
        """Unknowns d and f per pair."""
        return 0 if self._only_normal else nts_element.NUM_AUGMENTED

    @property
    def _num_normal(self) -> int:
        return 1 if self._only_normal else nts_element.NUM_CONSTRAINTS

    @cached_property
    def master_nodes(self) -> Points:
        """Nodes that the facets depend on."""
        nodes: Points = self.pair.master.facet_nodes.part(self.candidates.patch)
        return nodes

    @cached_property
    def _master_fixed(self) -> BoolArray:
        """Which coordinates of the facets' points are prescribed, shape (n, points, 3)."""
        master = self.pair.master
        fixed: BoolArray = master.fixed[master.patches[self.candidates.patch]]
        return fixed

    @property
    def immovable(self) -> BoolArray:
        """Whether all coordinates of the pairs' masters are prescribed, shape (n,)."""
        fixed: BoolArray = self._master_fixed.all(axis=(1, 2))
        return fixed

    @property
    def _ease(self) -> FloatArray:
        """Motion of the foot per force on it [1/kg], shape (n,)."""
        ease = self._free[:, 1:].any(axis=2) * self.point_foot**2 / self.master_scale
        total: FloatArray = ease.sum(axis=1)
        return total

    @cached_property
    def foot(self) -> FloatArray:
        """Weights of the control points in the foot at t_n, shape (n, nc)."""
        return facets.shape(self.candidates.xi, self.num_control)[0]

    @property
    def point_foot(self) -> FloatArray:
        """Weights of the masters' points in the foot at t_n, shape (n, points)."""
        weights = self.pair.master.weights
        if weights is None:
            return self.foot
        foot: FloatArray = np.einsum("nk,nkp->np", self.foot, weights[self.candidates.patch])
        return foot

    def gap(self, x: FloatArray) -> FloatArray:
        """Gap [m] of slaves and control points at t_{n+1}, (n, nc + 1, 3) -> (n,)."""
        foot, _, normal = facets.frame(x[:, 1:], self._projection(x))
        value: FloatArray = np.einsum("ni,ni->n", x[:, 0] - foot, normal)
        return value

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """Scaled d and f that fit predicted nodes x (n, k, 3), shape (n, augmented)."""
        if not self.num_augmented:
            return np.empty((self.num_elements, 0))
        return self._augmented(self._control(x))

    @property
    def _control_weights(self) -> FloatArray | None:
        """Weights of the nodes in the control points, (n, nc, k), if they differ."""
        weights = self.pair.master.facet_weights
        return None if weights is None else weights[self.candidates.patch]

    @cached_property
    def _tangents(self) -> FloatArray:
        """Tangents a_a of the facets at t_n over their size [-], shape (n, 2, 3)."""
        _, tangents, _ = facets.frame(self.x0[:, 1:], self.candidates.xi)
        scaled: FloatArray = tangents / self.candidates.length[:, None, None]
        return scaled

    def _normal(self, x: FloatArray) -> FloatArray:
        """Normal where the contact force acts, shape (n, 3)."""
        middle = self.x0 + self.theta * (x - self.x0)
        return facets.frame(middle[:, 1:], self._projection(middle))[2]

    def place(self, i: int) -> str:
        """Return where a pair is, for messages."""
        return f"{super().place(i)} on facet {int(self.candidates.facet[i])}"

    def _augmented(self, x: FloatArray) -> FloatArray:
        xi = self._projection(x)
        _, _, normal = facets.frame(x[:, 1:], xi)
        return np.column_stack([normal, xi]) * self.candidates.length[:, None]

    def _element(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """Residual and tangent in [kg m] and [m], gap and slip, before the laws of contact."""
        if self.direct:
            return self._direct(x, multiplier)
        if self.condense:
            mean = self.contact_gradient == "mean-value"
            return (self._compiled if mean else self._condensed)(x, multiplier)
        return self._invariants(x, augmented, multiplier)

    def _direct(
        self, x: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """`_element` of (x, multipliers)."""
        n, size, theta = self.num_elements, self._num_places, self.theta
        middle = self.x0 + theta * (x - self.x0)
        xi_middle, xi_end = self._projection(middle), self._projection(x)
        force, end = nts_element.gap(middle, xi_middle), nts_element.gap(x, xi_end)
        gradient = force.gradient.reshape(n, size)
        residual = np.zeros((n, size + self.num_constraints))
        tangent = np.zeros((*residual.shape, residual.shape[1]))
        residual[:, :size] = multiplier[:, :1] * gradient
        residual[:, size] = end.value
        tangent[:, :size, :size] = theta * multiplier[:, :1, None] * force.hessian
        tangent[:, :size, size] = gradient
        tangent[:, size, :size] = end.gradient.reshape(n, size)
        if not self.num_tangential:
            return residual, tangent, end.value, None

        length, t = self.candidates.length, multiplier[:, -2:]
        middle_xi = nts_element.projection(middle, xi_middle, t)
        end_xi = nts_element.projection(x, xi_end, np.zeros_like(t))
        along = length[:, None, None] * middle_xi.gradient
        residual[:, :size] += np.einsum("na,naz->nz", t, along)
        tangent[:, :size, :size] += theta * length[:, None, None] * middle_xi.hessian
        tangent[:, :size, -2:] = along.transpose(0, 2, 1)
        value = length[:, None] * (xi_end - self.candidates.xi)
        gradient = np.zeros((n, 2, residual.shape[1]))
        gradient[..., :size] = length[:, None, None] * end_xi.gradient
        metric_gradient = np.zeros((n, 2, 2, residual.shape[1]))
        metric_gradient[..., :size] = theta * middle_xi.metric_gradient
        return (
            residual,
            tangent,
            end.value,
            self._slip(value, gradient, middle_xi.metric, metric_gradient),
        )

    def _slip(
        self,
        value: FloatArray,
        gradient: FloatArray,
        metric: FloatArray,
        metric_gradient: FloatArray,
    ) -> Slip:
        """Slip [m] and its gradient as given, the metric per square of the facet size."""
        area = self.candidates.length[:, None, None] ** 2
        return Slip(value, gradient, metric / area, metric_gradient / area[..., None])

    def _projection(self, x: FloatArray) -> FloatArray:
        """Convective coordinates (n, 2); NaN, which no step survives, where there is none."""
        xi, converged = compiled.project(x[:, 0], x[:, 1:], self.candidates.xi)
        xi[~converged] = np.nan
        return xi

    def _invariants(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """Scaled residual and tangent of (x, d, f, all multipliers), gap and slip.

        Condensed, the multipliers of the augmented constraints are those that hold the rows of d
        and f, in which they are linear.
        """
        c, n = self.candidates, self.num_elements
        length = c.length[:, None]
        positions = (n, self._num_places)
        z0 = np.concatenate([self.x0.reshape(positions), c.normal, c.xi], axis=1)
        z1 = np.concatenate([x.reshape(positions), augmented / length], axis=1)
        # One length per pair makes every unknown a length or a force, so blocks compare across
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
            load[:, -2:] += multiplier[:, 1:] if self.num_tangential else 0.0
            others = nts_element.solve(rows[:, 1:].transpose(0, 2, 1), -load[:, :, None])[:, :, 0]
            return np.concatenate([multiplier[:, :1], others], axis=1)

        given = hold
        if not self.condense:
            given = multiplier[:, : nts_element.NUM_CONSTRAINTS] * scale_g
        e = nts_element.element(z0, z1, given, self.contact_gradient)
        residual = np.zeros((n, stop + self.num_tangential))
        residual[:, :size], residual[:, size:stop] = e.force * scale_z, e.constraint * scale_g
        tangent = np.zeros((*residual.shape, residual.shape[1]))
        tangent[:, :size, :size] = e.stiffness * scale_z[:, :, None] * scale_z[:, None]
        mixed = scale_g[:, :, None] * scale_z[:, None]
        tangent[:, :size, size:stop] = (e.force_gradient * mixed).transpose(0, 2, 1)
        tangent[:, size:stop, :size] = e.constraint_gradient * mixed
        if not self.num_tangential:
            return residual, tangent, e.constraint[:, 0], None

        f = slice(size - 2, size)
        residual[:, f] += multiplier[:, -2:]
        tangent[:, f, -2:] = np.eye(2)
        gradient = np.zeros((n, 2, residual.shape[1]))
        gradient[:, :, f] = np.eye(2)
        metric, by_pi = nts_element.metric(e.invariants, self.num_control)
        metric_gradient = np.zeros((n, 2, 2, residual.shape[1]))
        by_z = np.matmul(by_pi.reshape(n, 4, by_pi.shape[-1]), e.invariant_gradient)
        metric_gradient[..., :size] = by_z.reshape(n, 2, 2, size) * scale_z[:, None, None]
        slip = self._slip(augmented[:, 3:] - length * c.xi, gradient, metric, metric_gradient)
        return residual, tangent, e.constraint[:, 0], slip

    def _compiled(
        self, x: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """`_condensed` of the mean value."""
        c, xi = self.candidates, self._projection(x)
        k = compiled.condensed(self.x0, x, c.normal, c.xi, xi, c.length, multiplier)
        slip = None
        if self.num_tangential:
            value = c.length[:, None] * (xi - c.xi)
            slip = Slip(value, k.slip_gradient, k.metric, k.metric_gradient)
        return k.residual, k.tangent, k.gap, slip

    def _condensed(
        self, x: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """The element in (x, lambda_N, lambda_T): constraints fix d and f, whose rows fix the rest.

        At the projection of t_{n+1} the augmented constraints hold, so that the Schur complement
        is the exact tangent.
        """
        residual, tangent, gap, slip = self._invariants(x, self._augmented(x), multiplier)
        stop = self._num_places + nts_element.NUM_AUGMENTED
        middle = stop + nts_element.NUM_CONSTRAINTS
        inner = np.r_[self._num_places : stop, stop + 1 : middle]
        outer = np.r_[: self._num_places, stop, middle : tangent.shape[1]]
        among, by_outer = (tangent[:, inner[:, None], columns] for columns in (inner, outer))
        inside = nts_element.solve(among, by_outer)

        def reduce(a: FloatArray) -> FloatArray:
            """Derivatives by the outer unknowns from those by all."""
            reduced: FloatArray = a[..., outer] - np.matmul(a[..., inner], inside)
            return reduced

        tangent = reduce(tangent[:, outer])
        if slip is not None:
            n = self.num_elements
            by_metric = reduce(slip.metric_gradient.reshape(n, 4, slip.gradient.shape[-1]))
            by_metric = by_metric.reshape(n, 2, 2, len(outer))
            slip = slip._replace(gradient=reduce(slip.gradient), metric_gradient=by_metric)
        return residual[:, outer], tangent, gap, slip
