"""Equations of a contact in one step: what its candidates contribute to residual and tangent.

Both integrators share them: the midpoint rule has one unknown per candidate (lambda_N), the
energy-momentum scheme eleven (d, f and six multipliers). Friction adds two (lambda_T).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts import facets, nts_element
from dolfinx_nts.contact import Candidates, ContactPair
from dolfinx_nts.friction import length, return_map

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

#: Algorithmic scale c of the return map over the scale of the active set. No result depends on it;
#: Newton cycles between opposite slips once c exceeds the inertia that a node's slip moves, which
#: with a consistent mass matrix is a small part of the nodal mass.
TANGENTIAL_SCALE = 0.05
#: Largest coefficient of friction in numbers: larger ones are this one, but for infinite friction.
_LARGEST = 1e8
#: Coefficient of infinite friction where it has a bound: sticking by more would be rounding's.
_BOUND = 1e4
#: Pull over friction that counts as none.
_NO_PULL = 1e-8
#: Coefficient from which on friction counts as strong.
_STRONG = 1.0
#: Pull over friction up to which a node that sticks is let slip before it is let go.
_PULL = 0.01
#: Square of the part of a motion that counts as none.
_IMMOVABLE = 1e-12
#: Prescribed slip over the size of the facet that counts as none.
_STILL = 1e-10


class Contribution(NamedTuple):
    """Step equations of the pairs at an iterate, all rows [kg m] for unknowns in [m].

    Attributes:
        residual: Shape (n, r), r = 3 (nc + 1) + augmented + multipliers.
        tangent: Shape (n, r, r).
        gap: g_N at t_{n+1} [m], shape (n,).
        active: Active set of the iterate, shape (n,).
        stick: Active pairs that stick, shape (n,).
        slip: Facet size times f_1 - f_0 [m], shape (n, 2); (n, 0) without friction.
        distance: Length of the slip in the metric [m], shape (n,); 0 where not active.
        tangential: Contact force on the slave less its part along the normal [kg m], shape (n, 3).
    """

    residual: FloatArray
    tangent: FloatArray
    gap: FloatArray
    active: BoolArray
    stick: BoolArray
    slip: FloatArray
    distance: FloatArray
    tangential: FloatArray


class Slip(NamedTuple):
    """Slip and metric in facet sizes with their derivatives by the unknowns of the element."""

    value: FloatArray
    gradient: FloatArray
    metric: FloatArray
    metric_gradient: FloatArray


@dataclass(frozen=True, eq=False)
class ContactStep:
    """The candidates of one pair of surfaces in one step, with the rule of the integrator.

    Attributes:
        pair: Its surfaces.
        candidates: This rank's slave nodes and their facets.
        rule: "direct" for the midpoint rule, else the discrete gradient.
        condense: Whether (d, f) and their multipliers are eliminated pair by pair.
        x0: Slave and corners, or control points of the patch, at t_n [m], shape (n, nc + 1, 3).
        scale: Force per motion of the slaves in the units of the step equations, shape (n,): the
            nodal mass [kg] in dynamics; scales multipliers.
        theta: Where between t_n and t_{n+1} the direct rule takes the contact force.
        master_scale: `scale` of the points of the masters, shape (n, np); empty without.
        rounding: Gap [m] that counts as none.
        force_rounding: Contact force [kg m] that counts as none.
        bounded: Whether infinite friction has a bound.
        lets_slip: Whether a node that sticks and pulls a little is let slip before it is let go.
    """

    pair: ContactPair
    candidates: Candidates
    rule: str
    condense: bool
    x0: FloatArray
    scale: FloatArray
    theta: float
    master_scale: FloatArray = field(kw_only=True)
    rounding: float = field(default=0.0, kw_only=True)
    force_rounding: float = field(default=0.0, kw_only=True)
    bounded: bool = field(default=False, kw_only=True)
    lets_slip: bool = field(default=False, kw_only=True)

    @property
    def num_pairs(self) -> int:
        """Candidates on this rank."""
        return len(self.candidates.node)

    def part(self, chosen: BoolArray) -> ContactStep:
        """Some of the pairs, shape (n,)."""
        found = self.candidates.part(chosen)
        return replace(
            self,
            candidates=found,
            x0=self.x0[chosen],
            scale=self.scale[chosen],
            master_scale=self.master_scale[chosen],
        )

    @property
    def gap_rounding(self) -> FloatArray:
        """Gap [m] that counts as none, or that a force which does would open, shape (n,)."""
        gap: FloatArray = np.maximum(self.rounding, self.force_rounding / self._yielding)
        return gap

    @property
    def strong(self) -> bool:
        """Whether friction may hold a node that free motion lets go (Painleve's paradox)."""
        return self.pair.friction > _STRONG

    @staticmethod
    def no_pull(friction: FloatArray) -> FloatArray:
        """Contact force that counts as none beside these friction forces (n, 3), in their unit."""
        none: FloatArray = _NO_PULL * np.linalg.norm(friction, axis=1)
        return none

    @property
    def _endless(self) -> bool:
        """Whether friction has no bound."""
        return bool(np.isinf(self.pair.friction)) and not self.bounded

    @property
    def immovable(self) -> BoolArray:
        """Whether all coordinates of the pairs' masters are prescribed, shape (n,)."""
        fixed: BoolArray = (np.concatenate([*self.dofs()[1:]], axis=1) < 0).all(axis=1)
        return fixed

    def input_node(self, i: int) -> int:
        """Number of a pair's slave node in the user's mesh."""
        slave = self.pair.slave
        return int(slave.original[slave.share[self.candidates.node[i]]])

    @property
    def num_corners(self) -> int:
        """Points that the master surface over a facet depends on: its corners, or its patch's."""
        return self.pair.master.patches.shape[1]

    @property
    def num_coordinates(self) -> int:
        """Coordinates of the slave and the corners of a pair."""
        return 3 * (self.num_corners + 1)

    @property
    def _only_normal(self) -> bool:
        """Whether lambda_N is the only multiplier of a constraint."""
        return self.condense or self.rule == "direct"

    @property
    def num_augmented(self) -> int:
        """Unknowns d and f per pair."""
        return 0 if self._only_normal else nts_element.NUM_AUGMENTED

    @property
    def num_tangential(self) -> int:
        """Tangential multipliers per pair, the last ones."""
        return 2 if self.pair.friction else 0

    @property
    def _num_constraints(self) -> int:
        return 1 if self._only_normal else nts_element.NUM_CONSTRAINTS

    @property
    def num_multipliers(self) -> int:
        """Multipliers per pair."""
        return self._num_constraints + self.num_tangential

    @property
    def multiplier_pattern(self) -> BoolArray:
        """Which multipliers stand in the rows of which multipliers, shape (m, m)."""
        pattern = np.zeros((self.num_multipliers,) * 2, dtype=bool)
        pattern[0, 0] = True
        pattern[self._num_constraints :, 0] = True
        pattern[self._num_constraints :, self._num_constraints :] = True
        return pattern

    def dofs(self) -> tuple[IntArray, ...]:
        """Global coordinates of slaves (n, 3) and facets (n, 3 nc); -1 where prescribed."""
        c, slave, master = self.candidates, self.pair.slave, self.pair.master
        points, corners = slave.share[c.node], master.patches[c.facet]
        s = np.where(slave.fixed, -1, slave.dofs)[points]
        m = np.where(master.fixed, -1, master.dofs)[corners].reshape(-1, 3 * self.num_corners)
        return s, m

    def points(self) -> tuple[IntArray, ...]:
        """Global coordinates as in `dofs`, prescribed ones included."""
        c, slave, master = self.candidates, self.pair.slave, self.pair.master
        corners = master.patches[c.facet]
        return slave.dofs[slave.share[c.node]], master.dofs[corners].reshape(
            -1, 3 * self.num_corners
        )

    @cached_property
    def _free(self) -> BoolArray:
        """Coordinates of slaves and masters that are not prescribed, shape (n, np + 1, 3)."""
        numbers = np.concatenate(self.dofs(), axis=1)
        free: BoolArray = numbers.reshape(self.num_pairs, self.num_corners + 1, 3) >= 0
        return free

    @cached_property
    def _yielding(self) -> FloatArray:
        """The part of `scale` that a slave and its foot move against each other, shape (n,).

        A master that is much lighter than the slave gives way in its place.
        """
        ease = self._free[:, 1:].any(axis=2) * self._point_shape**2 / self.master_scale
        together: FloatArray = self.scale / (1.0 + self.scale * ease.sum(axis=1))
        return together

    @cached_property
    def _prescribed(self) -> BoolArray:
        """Axes along which slave and foot move as prescribed, shape (n, 3)."""
        square = np.column_stack([np.ones(self.num_pairs), self._point_shape]) ** 2
        part = np.einsum("nk,nki->ni", square, self._free)
        still: BoolArray = part <= _IMMOVABLE * square.sum(axis=1)[:, None]
        return still

    @cached_property
    def _blocked(self) -> FloatArray:
        """Projector on the tangential parts of the prescribed axes, shape (n, 3, 3).

        Forces there act on prescribed coordinates or along the normal: where the gap is closed, the
        slip there is prescribed.
        """
        if not self._prescribed.any():
            return np.zeros((self.num_pairs, 3, 3))
        normal = self.candidates.normal
        along = np.eye(3) - normal[:, :, None] * normal[:, None]
        part, vector = np.linalg.eigh(np.matmul(along * self._prescribed[:, None], along))
        vector *= (part > _IMMOVABLE)[:, None]
        projector: FloatArray = np.matmul(vector, vector.transpose(0, 2, 1))
        return projector

    @cached_property
    def blocked(self) -> FloatArray:
        """Projector on the lambda_T that no free coordinate can tell from zero, shape (n, 2, 2).

        Sticking is no equation there, and lambda_T is set to zero.
        """
        tangents = self._tangents()
        metric = np.matmul(tangents, tangents.transpose(0, 2, 1))
        dual = nts_element.solve(metric, tangents)
        projector: FloatArray = np.matmul(
            np.matmul(tangents, self._blocked), dual.transpose(0, 2, 1)
        )
        return projector

    def _held(self, x: FloatArray) -> FloatArray:
        """`blocked` where the slip prescribed there is zero, else zero, shape (n, 2, 2).

        Nodes that slip leave this part of lambda_T out of the trial, too: Coulomb's law says
        nothing about it, and at the edge of sticking the rows would be singular in it.
        """
        if not self._prescribed.any():
            return self.blocked
        motion = x - self.x0
        motion = motion[:, 0] - np.einsum("nk,nki->ni", self._shape, motion[:, 1:])
        slip = np.einsum("nij,nj->ni", self._blocked, motion * self._prescribed)
        held: FloatArray = self.blocked.copy()
        held[np.abs(slip).max(axis=1) > _STILL * self.candidates.length] = 0.0
        return held

    def _c(self, slip: Slip, bound: FloatArray, held: FloatArray) -> FloatArray:
        """Scale c of the return map; nodes that are made to slip cannot stick, shape (n,)."""
        c = TANGENTIAL_SCALE * self._yielding
        if self._endless:
            return c
        moved = self.blocked.any(axis=(1, 2)) & ~held.any(axis=(1, 2))
        s = slip.value[moved]
        distance = np.sqrt(np.einsum("na,nab,nb->n", s, slip.metric[moved], s))
        # Where solved, trial and slip are parallel, whatever c: the tangent needs no slope of c.
        c[moved] = np.maximum(c[moved], 2.0 * bound[moved] / distance)
        return c

    @cached_property
    def _shape(self) -> FloatArray:
        """Weights of the control points in the foot at t_n, shape (n, nc)."""
        return facets.shape(self.candidates.xi, self.num_corners)[0]

    @property
    def _point_shape(self) -> FloatArray:
        """Weights of the masters' points in the foot at t_n, shape (n, np)."""
        if self._weights is None:
            return self._shape
        shape: FloatArray = np.einsum("nk,nkp->np", self._shape, self._weights)
        return shape

    def gap(self, x: FloatArray) -> FloatArray:
        """Gap [m] of slaves and control points at t_{n+1}, (n, nc + 1, 3) -> (n,)."""
        return nts_element.gap(x, self._projection(x)).value

    def reference(self) -> FloatArray:
        """Reference positions of slaves and corners in the pair's frame [m], (n, nc + 1, 3)."""
        c, slave, master = self.candidates, self.pair.slave, self.pair.master
        nodes = slave.reference[slave.share[c.node]]
        both = np.concatenate([nodes[:, None], master.reference[master.patches[c.facet]]], axis=1)
        return both - self.pair.origin

    def rows(self, k: Contribution, name: str) -> FloatArray:
        """The residual's rows of "augmented" unknowns or "multipliers", shape (n, width)."""
        start = self.num_coordinates
        middle = start + self.num_augmented
        return k.residual[:, start:middle] if name == "augmented" else k.residual[:, middle:]

    @property
    def extent(self) -> float:
        """Length beside the displacements whose rounding enters the gaps [m]."""
        return self.pair.extent

    def external_work(self, part: Contribution) -> float:
        """Work that enters the bodies through the contact: none, as the master is one of them."""
        return 0.0

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """Scaled d and f that fit predicted positions x (n, nc + 1, 3), shape (n, augmented)."""
        if not self.num_augmented:
            return np.empty((self.num_pairs, 0))
        return self._augmented(self._control(x))

    def _control(self, x: FloatArray) -> FloatArray:
        """Slave and control points from slave and points of the patch, both (n, nc + 1, 3)."""
        control = self.pair.master.combine(x[:, 1:], self.candidates.facet)
        return np.concatenate([x[:, :1], control], axis=1)

    @cached_property
    def _weights(self) -> FloatArray | None:
        """Weights of the points in the control points, shape (n, nc, nc), if they differ."""
        weights = self.pair.master.weights
        return None if weights is None else weights[self.candidates.facet]

    def _to_points(self, part: Contribution) -> None:
        """The transpose of `_control`: forces and tangents of control points to their points."""
        if self._weights is None:
            return
        n, size = part.residual.shape
        width, middle = self.num_coordinates - 3, (self.num_corners, 3)
        rows = slice(3, self.num_coordinates)
        w = self._weights.transpose(0, 2, 1)
        force = np.matmul(w, part.residual[:, rows].reshape(n, *middle))
        part.residual[:, rows] = force.reshape(n, width)
        columns = part.tangent[:, :, rows].reshape(n, size, *middle)
        part.tangent[:, :, rows] = np.matmul(w[:, None], columns).reshape(n, size, width)
        lines = part.tangent[:, rows].reshape(n, self.num_corners, 3 * size)
        part.tangent[:, rows] = np.matmul(w, lines).reshape(n, width, size)

    def multipliers(self, normal: FloatArray, tangential: FloatArray) -> FloatArray:
        """Multipliers of given contact forces on the slaves [N], shape (n, multipliers).

        Args:
            normal: p_N, shape (n,).
            tangential: Friction, shape (n, 3).
        """
        out = np.zeros((self.num_pairs, self.num_multipliers))
        out[:, 0] = -normal
        if self.num_tangential:
            out[:, -2:] = -np.einsum("nai,ni->na", self._tangents(), tangential)
        return out

    def _tangents(self) -> FloatArray:
        """Tangents a_a of the facets at t_n over their size [-], shape (n, 2, 3)."""
        _, tangents, _ = facets.frame(self.x0[:, 1:], self.candidates.xi)
        scaled: FloatArray = tangents / self.candidates.length[:, None, None]
        return scaled

    def _augmented(self, x: FloatArray) -> FloatArray:
        xi = self._projection(x)
        _, _, normal = facets.frame(x[:, 1:], xi)
        return np.column_stack([normal, xi]) * self.candidates.length[:, None]

    def evaluate(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> Contribution:
        """Residual and tangent of the pairs; pure.

        Args:
            x: Slave and corners at t_{n+1} [m], shape (n, nc + 1, 3).
            augmented: Facet size times (d, f) [m], shape (n, 5) or (n, 0).
            multiplier: h^2/2 lambda of the scaled constraints, and of lambda_T over the facet
                size, over `scale` [m], shape (n, multipliers).
        """
        if not self.num_pairs:
            return self._nothing()
        scale = self.scale[:, None]
        multiplier = scale * multiplier
        x = self._control(x)
        residual, tangent, gap, slip = self._element(x, augmented, multiplier)
        part = self._laws(x, residual, tangent, gap, slip, multiplier)
        if slip is not None:
            part.tangential[:] = self._tangential(x, -residual[:, :3])
        self._to_points(part)
        # With mass in rows and columns the whole matrix is in kg, whatever the size of the scene.
        rows = slice(part.residual.shape[1] - self.num_multipliers, None)
        part.residual[:, rows] *= scale
        part.tangent[:, rows] *= scale[:, None]
        part.tangent[:, :, rows] *= scale[:, None]
        return part

    def _nothing(self) -> Contribution:
        """Of no pairs."""
        size = self.num_coordinates + self.num_augmented + self.num_multipliers
        none, slip = np.zeros(0), np.zeros((0, self.num_tangential))
        off = none.astype(bool)
        return Contribution(
            np.zeros((0, size)), np.zeros((0, size, size)), none, off, off, slip, none,
            tangential=np.zeros((0, 3)),
        )  # fmt: skip

    def _element(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """Residual and tangent in [kg m] and [m], gap and slip, before the laws of contact."""
        if self.rule == "direct":
            return self._direct(x, multiplier)
        if self.condense:
            return self._condensed(x, multiplier)
        return self._invariants(x, augmented, multiplier)

    def _direct(
        self, x: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """`_element` of (x, multipliers)."""
        n, size, theta = self.num_pairs, self.num_coordinates, self.theta
        middle = self.x0 + theta * (x - self.x0)
        xi_middle, xi_end = self._projection(middle), self._projection(x)
        force, end = nts_element.gap(middle, xi_middle), nts_element.gap(x, xi_end)
        gradient = force.gradient.reshape(n, size)
        residual = np.zeros((n, size + self.num_multipliers))
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
        xi, converged = facets.project(x[:, 0], x[:, 1:], self.candidates.xi)
        xi[~converged] = np.nan
        return xi

    def _invariants(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """Scaled residual and tangent of (x, d, f, all multipliers), gap and slip.

        Condensed, the multipliers of the augmented constraints are those that hold the rows of d
        and f, in which they are linear.
        """
        c, n = self.candidates, self.num_pairs
        length = c.length[:, None]
        positions = (n, self.num_coordinates)
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
        e = nts_element.element(z0, z1, given, self.rule)
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
        metric, by_pi = nts_element.metric(e.invariants, self.num_corners)
        metric_gradient = np.zeros((n, 2, 2, residual.shape[1]))
        by_z = np.matmul(by_pi.reshape(n, 4, by_pi.shape[-1]), e.invariant_gradient)
        metric_gradient[..., :size] = by_z.reshape(n, 2, 2, size) * scale_z[:, None, None]
        slip = self._slip(augmented[:, 3:] - length * c.xi, gradient, metric, metric_gradient)
        return residual, tangent, e.constraint[:, 0], slip

    def _condensed(
        self, x: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """The element in (x, lambda_N, lambda_T): constraints fix d and f, whose rows fix the rest.

        At the projection of t_{n+1} the augmented constraints hold, so that the Schur complement
        is the exact tangent.
        """
        residual, tangent, gap, slip = self._invariants(x, self._augmented(x), multiplier)
        stop = self.num_coordinates + nts_element.NUM_AUGMENTED
        middle = stop + nts_element.NUM_CONSTRAINTS
        inner = np.r_[self.num_coordinates : stop, stop + 1 : middle]
        outer = np.r_[: self.num_coordinates, stop, middle : tangent.shape[1]]
        among, by_outer = (tangent[:, inner[:, None], columns] for columns in (inner, outer))
        inside = nts_element.solve(among, by_outer)

        def reduce(a: FloatArray) -> FloatArray:
            """Derivatives by the outer unknowns from those by all."""
            reduced: FloatArray = a[..., outer] - np.matmul(a[..., inner], inside)
            return reduced

        tangent = reduce(tangent[:, outer])
        if slip is not None:
            n = self.num_pairs
            by_metric = reduce(slip.metric_gradient.reshape(n, 4, slip.gradient.shape[-1]))
            by_metric = by_metric.reshape(n, 2, 2, len(outer))
            slip = slip._replace(gradient=reduce(slip.gradient), metric_gradient=by_metric)
        return residual[:, outer], tangent, gap, slip

    def _laws(
        self,
        x: FloatArray,
        residual: FloatArray,
        tangent: FloatArray,
        gap: FloatArray,
        slip: Slip | None,
        multiplier: FloatArray,
    ) -> Contribution:
        """Semi-smooth laws of contact (theory section 9) and friction (section 6).

        g_N = 0 where active, else lambda_N = 0; there Coulomb's law, else lambda_T = 0.
        """
        gap, force, scale = gap.copy(), multiplier[:, 0], self.scale
        active = -force - self._yielding * gap > self._none(slip, multiplier)
        off = ~active
        row = residual.shape[1] - self.num_multipliers
        residual[off, row] = force[off] / scale[off]
        tangent[off, row] = 0.0
        tangent[off, row, row] = 1.0 / scale[off]
        part = Contribution(
            residual,
            tangent,
            gap,
            active,
            stick=np.zeros_like(active),
            slip=np.empty((self.num_pairs, 0)) if slip is None else slip.value,
            distance=np.zeros(self.num_pairs),
            tangential=np.zeros((self.num_pairs, 3)),
        )
        if slip is not None:
            part.stick[:] = self._coulomb(x, residual, tangent, slip, multiplier, active)
            square = np.einsum("na,nab,nb->n", slip.value, slip.metric, slip.value)
            part.distance[active] = np.sqrt(square[active])
        return part

    def _none(self, slip: Slip | None, multiplier: FloatArray) -> FloatArray:
        """Contact force that counts as none [kg m], shape (n,).

        A touch without force has rounding in both, and with strong friction more than one solution
        (Painleve's paradox): so nodes carry where free motion would close their gaps, or did so in
        the last step. If no step comes of that (`lets_slip`), a small pull on a node that sticks
        lets it slip, by the law continued beyond zero force: to let it go would close its gap
        again. As the law drives such a node along its slip where solved, which is excluded, this
        adds no solution.
        """
        none = self._yielding * self.gap_rounding
        endless = self._endless
        if slip is None or not (self.lets_slip or endless):
            return none
        t, s = multiplier[:, -2:], TANGENTIAL_SCALE * self._yielding[:, None] * slip.value
        friction = length(slip.metric, t)
        resists = friction**2 + np.einsum("na,na->n", t, s) > 0.0
        resists &= ~self.blocked.any(axis=(1, 2))
        # Without bound a node may stick by no normal force at all, whose rounding has any sign.
        return none - np.where(resists, (_NO_PULL if endless else _PULL) * friction, 0.0)

    def _tangential(self, x: FloatArray, force: FloatArray) -> FloatArray:
        """Force (n, 3) less its part along the normal where the contact force acts."""
        middle = self.x0 + self.theta * (x - self.x0)
        _, _, normal = facets.frame(middle[:, 1:], self._projection(middle))
        along: FloatArray = np.einsum("ni,ni->n", force, normal)
        return force - along[:, None] * normal

    def _coulomb(
        self,
        x: FloatArray,
        residual: FloatArray,
        tangent: FloatArray,
        slip: Slip,
        multiplier: FloatArray,
        active: BoolArray,
    ) -> BoolArray:
        """Write the rows of lambda_T [m]; returns which pairs stick.

        Of a pair that carries nothing yet, strong friction's bound is mu times the force that its
        depth asks for, as in the active set: with none it would have to slip at first, by the slope
        of the bound, which is mu for all active pairs.
        """
        endless = self._endless
        largest = _BOUND if np.isinf(self.pair.friction) else _LARGEST
        mu, t = min(self.pair.friction, largest), multiplier[:, -2:]
        force, scale = multiplier[:, 0], self.scale[:, None, None]
        normal = residual.shape[1] - self.num_multipliers
        new = active & (force >= 0.0) & (mu > _STRONG)
        bound = mu * np.where(active, -force if mu > _STRONG else np.maximum(-force, 0.0), 0.0)
        bound[new] -= mu * self._yielding[new] * residual[new, normal]
        bound[active & endless] = np.inf
        held = self._held(x)
        loose = np.eye(2) - held
        trial = np.einsum("nab,nb->na", loose, t)
        law = return_map(trial, slip.value, slip.metric, bound, self._c(slip, bound, held))
        stick = law.stick & active
        rows = np.einsum("nab,nbz->naz", law.d_slip, slip.gradient)
        rows += np.einsum("nabc,nbcz->naz", law.d_metric, slip.metric_gradient)
        rows[:, :, -2:] += np.matmul(law.d_multiplier, loose)
        rows[:, :, normal] -= mu * law.d_bound
        by_gap = law.d_bound[new, :, None] * tangent[new, normal][:, None]
        rows[new] -= mu * self._yielding[new, None, None] * by_gap
        value, slipping = law.residual, ~stick
        value[slipping] /= scale[slipping, 0]
        rows[slipping] /= scale[slipping]
        unsaid = np.where(stick[:, None, None], self.blocked, held) / scale
        value += np.einsum("nab,nb->na", unsaid, t)
        rows[:, :, -2:] += unsaid
        value[~active], rows[~active] = t[~active] / scale[~active, 0], 0.0
        rows[~active, :, -2:] = np.eye(2) / scale[~active]
        residual[:, -2:], tangent[:, -2:] = value, rows
        return stick
