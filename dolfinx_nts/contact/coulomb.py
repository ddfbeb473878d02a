"""Coulomb's law of the candidates of a pair at an iterate: stick, slip, and what cannot slip."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.kernels import nts_element
from dolfinx_nts.kernels.friction import length, return_map

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Algorithmic scale c of the return map over the scale of the active set. No result depends on it;
#: Newton cycles between opposite slips once c exceeds the inertia that a node's slip moves, which
#: with a consistent mass matrix is a small part of the nodal mass.
TANGENTIAL_SCALE = 0.05
#: The same where all points share nodes, as of rigid bodies, whose mass is divided among them.
_OF_SHARED = 0.5
#: Largest coefficient of friction in numbers: larger ones are this one, but for infinite friction.
_LARGEST = 1e8
#: Coefficient of infinite friction where it has a bound: sticking by more would be rounding's.
_BOUND = 1e4
#: Pull over friction that counts as none.
_NO_PULL = 1e-8
#: Coefficient above which friction may hold a node that free motion lets go (Painleve's paradox).
STRONG = 1.0
#: Pull over friction up to which a node that sticks is let slip before it is let go.
_PULL = 0.01
#: Square of the part of a motion that counts as none.
_IMMOVABLE = 1e-12
#: Slip over the size of the facet that counts as none.
_STILL = 1e-10
#: Stiffness against sliding of pairs that hardly rub, over that of the nodes: next to nothing, but
#: the equations of a body that friction alone holds have a solution.
_HARDLY = 1e-9
#: Largest ratio of normal forces by which friction of a rigid body's nodes is divided.
UNEVEN = 100.0


class Rub(Enum):
    """What pairs obey that touch: Coulomb's law, or what leads Newton's method to it.

    Where nothing carries yet, all bounds are zero: nodes would stick, whatever pulls at them, and
    pass no force on to those whose normal forces it makes. So nodes slide first almost freely, till
    it is known which ones touch; then each slips where it has slid. What a state at rest resists is
    told with all that touch sticking: a node at Coulomb's bound would slip in the law's tangent.
    """

    LAW = "law"
    HARDLY = "hardly"
    SLIDES = "slides"
    STICKS = "sticks"


class Slip(NamedTuple):
    """Slip and metric in facet sizes with their derivatives by the unknowns of the element."""

    value: FloatArray
    gradient: FloatArray
    metric: FloatArray
    metric_gradient: FloatArray


class Together(NamedTuple):
    """What all pairs of a contact have in common where they share nodes, as of rigid bodies.

    The compliances are those that the matrix lends to what holds a pair, over that of the bodies;
    they vanish with what is missed, see `constraints.SHIFT`, and are 0 where pairs share nothing.

    Attributes:
        force: Mean normal force [kg m].
        normal: Compliance lent to gaps [-].
        tangential: Compliance lent to sticking [-].
    """

    force: float
    normal: float
    tangential: float


def no_pull(friction: FloatArray) -> FloatArray:
    """Contact force that counts as none beside these friction forces (n, 3), in their unit."""
    none: FloatArray = _NO_PULL * np.linalg.norm(friction, axis=1)
    return none


@dataclass(frozen=True, eq=False, kw_only=True)
class Coulomb:
    """Coulomb's law of the candidates of one pair in one step (theory section 6).

    Attributes:
        friction: Coefficient; `math.inf` sticks.
        yields: As of `ContactPair`.
        redundant: As of `ContactPair`.
        bounded: Whether infinite friction has a bound.
        x0: Slave, and what the master is interpolated from, at t_n [m], (n, control + 1, 3).
        foot: Weights of the control points in the foot at t_n, shape (n, nc).
        normal: Of the master at t_n, shape (n, 3).
        tangents: Of the master at t_n over their size [-], shape (n, 2, 3).
        size: Of the facets [m], shape (n,).
        free: Part of the square of a motion of slave and foot that is not prescribed, along the
            axes, shape (n, 3).
        scale: As of `ContactLaws`, shape (n,).
        yielding: The part of it that slave and foot move against each other, shape (n,).
        of_end: Derivative of the multipliers at t_{n+1} by those of the step, shape (n,).
        rubs: As of `ContactLaws`.
    """

    friction: float
    yields: bool
    redundant: bool
    bounded: bool
    x0: FloatArray
    foot: FloatArray
    normal: FloatArray
    tangents: FloatArray
    size: FloatArray
    free: FloatArray
    scale: FloatArray
    yielding: FloatArray
    of_end: FloatArray
    rubs: Rub = Rub.LAW

    @property
    def endless(self) -> bool:
        """Whether friction has no bound."""
        return self.rubs is Rub.STICKS or bool(np.isinf(self.friction)) and not self.bounded

    @property
    def still(self) -> FloatArray:
        """Slip that counts as none [m], shape (n,)."""
        return _STILL * self.size

    @property
    def coefficient(self) -> float:
        """That of the equations, which is a number."""
        return min(self.friction, _BOUND if np.isinf(self.friction) else _LARGEST)

    @property
    def let_slip(self) -> float:
        """Pull over friction up to which a node that sticks is let slip before it is let go."""
        # Without bound a node may stick by no normal force at all, whose rounding has any sign.
        return _NO_PULL if self.endless else _PULL

    @cached_property
    def tangential_scale(self) -> FloatArray:
        """Algorithmic scale of the return map, shape (n,)."""
        if self.rubs is Rub.SLIDES:
            # Whatever has slid is beyond the bound.
            return self.yielding / _HARDLY
        return (TANGENTIAL_SCALE if self.yields else _OF_SHARED) * self.yielding

    # ---- what cannot slip
    @cached_property
    def _prescribed(self) -> BoolArray:
        """Axes along which slave and foot move as prescribed, shape (n, 3)."""
        return self.free <= _IMMOVABLE

    @cached_property
    def _blocked(self) -> FloatArray:
        """Projector on the tangential parts of the prescribed axes, shape (n, 3, 3).

        Forces there act on prescribed coordinates or along the normal: where the gap is closed, the
        slip there is prescribed.
        """
        if not self.prescribes:
            return np.zeros((len(self.size), 3, 3))
        along = np.eye(3) - self.normal[:, :, None] * self.normal[:, None]
        part, vector = np.linalg.eigh(np.matmul(along * self._prescribed[:, None], along))
        vector *= (part > _IMMOVABLE)[:, None]
        projector: FloatArray = np.matmul(vector, vector.transpose(0, 2, 1))
        return projector

    @cached_property
    def prescribes(self) -> bool:
        """Whether anything is prescribed."""
        return bool(self._prescribed.any())

    @cached_property
    def unmoved(self) -> FloatArray:
        """Projector on the part of lambda_T that acts on prescribed coordinates only, (n, 2, 2).

        Sticking is no equation there, and lambda_T is set to zero.
        """
        if not self.prescribes:
            return np.zeros((len(self.size), 2, 2))
        metric = np.matmul(self.tangents, self.tangents.transpose(0, 2, 1))
        dual = nts_element.solve(metric, self.tangents)
        projector: FloatArray = np.matmul(
            np.matmul(self.tangents, self._blocked), dual.transpose(0, 2, 1)
        )
        return projector

    def held(self, x: FloatArray) -> FloatArray:
        """`unmoved` where the slip prescribed there is zero, else zero, shape (n, 2, 2).

        Nodes that slip leave this part of lambda_T out of the trial, too: Coulomb's law says
        nothing about it, and at the edge of sticking the rows would be singular in it.
        """
        if not self.prescribes:
            return self.unmoved
        motion = x - self.x0
        motion = motion[:, 0] - np.einsum("nk,nki->ni", self.foot, motion[:, 1:])
        slip = np.einsum("nij,nj->ni", self._blocked, motion * self._prescribed)
        held: FloatArray = self.unmoved.copy()
        held[np.abs(slip).max(axis=1) > self.still] = 0.0
        return held

    # ---- stick and slip
    def pull(self, slip: Slip, multiplier: FloatArray) -> FloatArray:
        """Pull [kg m] up to which a node that sticks is let slip before it is let go, shape (n,).

        By the law continued beyond zero force, since letting the node go would close its gap again.
        """
        t, s = multiplier[:, -2:], self.tangential_scale[:, None] * slip.value
        friction = length(slip.metric, t)
        resists = friction**2 + np.einsum("na,na->n", t, s) > 0.0
        resists &= ~self.unmoved.any(axis=(1, 2))
        return np.where(resists, self.let_slip * friction, 0.0)

    def _c(self, slip: Slip, bound: FloatArray, held: FloatArray) -> FloatArray:
        """Scale c of the return map; nodes that are made to slip cannot stick, shape (n,)."""
        c = self.tangential_scale
        if self.endless or not self.prescribes:
            return c
        c = c.copy()
        moved = self.unmoved.any(axis=(1, 2)) & ~held.any(axis=(1, 2))
        s = slip.value[moved]
        distance = np.sqrt(np.einsum("na,nab,nb->n", s, slip.metric[moved], s))
        # Where solved, trial and slip are parallel, whatever c: the tangent needs no slope of c.
        c[moved] = np.maximum(c[moved], 2.0 * bound[moved] / distance)
        return c

    def _lent_to_stick(
        self, together: Together, force: FloatArray, stick: BoolArray
    ) -> FloatArray:
        """Compliance lent to pairs that stick, so that friction divides as normal forces do.

        A brick at rest on a slope just below the limit needs that of all its nodes.
        """
        part = np.full(np.count_nonzero(stick), UNEVEN)
        np.divide(together.force, -force[stick], out=part, where=force[stick] < 0.0)
        part = np.clip(part, 1.0 / UNEVEN, UNEVEN)
        lent: FloatArray = together.tangential * part / self.scale[stick]
        return lent

    def rub_hardly(
        self, residual: FloatArray, tangent: FloatArray, slip: Slip, end: FloatArray, of: BoolArray
    ) -> None:
        """Write the rows of lambda_T [kg m] of pairs that touch as if they hardly rubbed.

        Args:
            residual: Of the pairs as of the step, shape (n, r).
            tangent: Shape (n, r, r).
            slip: At the iterate.
            end: h^2/2 lambda at t_{n+1} [kg m]: lambda_T last.
            of: Which pairs, shape (n,).
        """
        stiffness = _HARDLY * self.yielding[of, None]
        metric = slip.metric[of]
        residual[of, -2:] = end[of, -2:]
        residual[of, -2:] -= stiffness * np.einsum("nab,nb->na", metric, slip.value[of])
        rows = -stiffness[:, :, None] * np.matmul(metric, slip.gradient[of])
        rows[:, :, -2:] += (self.of_end * self.scale)[of, None, None] * np.eye(2)
        tangent[of, -2:] = rows

    def write(
        self,
        x: FloatArray,
        residual: FloatArray,
        tangent: FloatArray,
        slip: Slip,
        multiplier: FloatArray,
        active: BoolArray,
        together: Together,
    ) -> BoolArray:
        """Write the rows of lambda_T [m], the last two, behind that of the gap.

        For a pair without force yet under strong friction, and for rigid bodies, the bound is mu
        times the force that the gap asks for, as in the active set. With a bound of zero the pair
        would have to slip at first, by the slope of the bound, which is mu for all active pairs.
        Points of a rigid body that rest would go on so, by rounding and against each other.

        Args:
            x: Slave and control points at t_{n+1} [m], shape (n, control + 1, 3).
            residual: Of the pairs, shape (n, r).
            tangent: Shape (n, r, r).
            slip: At the iterate.
            multiplier: h^2/2 lambda at t_{n+1} [kg m]: that of the gap first, lambda_T last.
            active: Active set of the iterate, shape (n,).
            together: What the pairs have in common.

        Returns:
            Which pairs stick, shape (n,).
        """
        mu, t = self.coefficient, multiplier[:, -2:]
        force, scale = multiplier[:, 0], self.scale[:, None, None]
        normal = residual.shape[1] - multiplier.shape[1]
        new = active & (force >= 0.0) & (mu > STRONG or self.redundant)
        bound = mu * np.where(active, -force if mu > STRONG else np.maximum(-force, 0.0), 0.0)
        bound[new] -= mu * self.yielding[new] * residual[new, normal]
        bound[active & self.endless] = np.inf
        held = self.held(x)
        loose = np.eye(2) - held
        trial = np.einsum("nab,nb->na", loose, t)
        of_end = self.of_end[:, None, None]
        law = return_map(trial, slip.value, slip.metric, bound, self._c(slip, bound, held))
        stick: BoolArray = law.stick & active
        rows = np.einsum("nab,nbz->naz", law.d_slip, slip.gradient)
        rows += np.einsum("nabc,nbcz->naz", law.d_metric, slip.metric_gradient)
        rows[:, :, -2:] += of_end * np.matmul(law.d_multiplier, loose)
        rows[:, :, normal] -= mu * of_end[:, 0] * law.d_bound
        by_gap = law.d_bound[new, :, None] * tangent[new, normal][:, None]
        rows[new] -= mu * self.yielding[new, None, None] * by_gap
        value, slipping = law.residual, ~stick
        value[slipping] /= scale[slipping, 0]
        rows[slipping] /= scale[slipping]
        unsaid = np.where(stick[:, None, None], self.unmoved, held) / scale
        value += np.einsum("nab,nb->na", unsaid, t)
        rows[:, :, -2:] += of_end * unsaid
        if together.tangential:
            lent = self._lent_to_stick(together, force, stick)
            rows[stick, :, -2:] -= np.eye(2) * lent[:, None, None]
        value[~active], rows[~active] = t[~active] / scale[~active, 0], 0.0
        rows[~active, :, -2:] = of_end[~active] * np.eye(2) / scale[~active]
        residual[:, -2:], tangent[:, -2:] = value, rows
        return stick
