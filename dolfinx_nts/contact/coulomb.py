"""What Coulomb's law is told of the candidates of a pair: its numbers, and what cannot slip."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np

from dolfinx_nts.kernels import nts_element
from dolfinx_nts.types import BoolArray, FloatArray

#: Algorithmic scale c of the return map over the scale of the active set. No result depends on it;
#: Newton cycles between opposite slips once c exceeds the inertia that a node's slip moves, which
#: with a consistent mass matrix is a small part of the nodal mass.
TANGENTIAL_SCALE = 0.05
#: The same where all points share nodes, as of rigid bodies, whose mass is divided among them.
_OF_SHARED = 0.5
#: Largest coefficient of friction in numbers: larger ones are this one, but for infinite friction.
#: Sticking by more would be rounding's.
_LARGEST = 1e6
#: Pull over friction that counts as none: without bound a node may stick by no normal force at all,
#: whose rounding has any sign.
NO_PULL = 1e-8
#: Coefficient above which friction may hold a node that free motion lets go (Painleve's paradox).
STRONG = 1.0
#: Square of the part of a motion that counts as none.
_IMMOVABLE = 1e-12
#: Slip over the size of the facet that counts as none.
_STILL = 1e-10
#: Stiffness against sliding of pairs that hardly rub, over that of the nodes: next to nothing, but
#: the equations of a body that friction alone holds have a solution.
HARDLY = 1e-9
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
    none: FloatArray = NO_PULL * np.linalg.norm(friction, axis=1)
    return none


@dataclass(frozen=True, eq=False, kw_only=True)
class Coulomb:
    """Coulomb's law of the candidates of one pair in one step (theory section 6).

    `contact_law.c` has the law itself.

    Attributes:
        friction: Coefficient; `math.inf` sticks.
        yields: As of `ContactPair`.
        redundant: As of `ContactPair`.
        x0: Slave, and what the master is interpolated from, at t_n [m], (n, control + 1, 3).
        foot: Weights of the control points in the foot at t_n, shape (n, nc).
        normal: Of the master at t_n, shape (n, 3).
        tangents: Of the master at t_n over their size [-], shape (n, 2, 3).
        size: Of the facets [m], shape (n,).
        free: Part of the square of a motion of slave and foot that is not prescribed, along the
            axes, shape (n, 3).
        yielding: The part of `ContactLaws.scale` that slave and foot move against each other,
            shape (n,).
        rubs: As of `ContactLaws`.
    """

    friction: float
    yields: bool
    redundant: bool
    x0: FloatArray
    foot: FloatArray
    normal: FloatArray
    tangents: FloatArray
    size: FloatArray
    free: FloatArray
    yielding: FloatArray
    rubs: Rub = Rub.LAW

    @property
    def endless(self) -> bool:
        """Whether friction has no bound."""
        return self.rubs is Rub.STICKS or bool(np.isinf(self.friction))

    @property
    def still(self) -> FloatArray:
        """Slip that counts as none [m], shape (n,)."""
        return _STILL * self.size

    @property
    def coefficient(self) -> float:
        """That of the equations, which is a number."""
        return min(self.friction, _LARGEST)

    @cached_property
    def tangential_scale(self) -> FloatArray:
        """Algorithmic scale of the return map, shape (n,)."""
        if self.rubs is Rub.SLIDES:
            # Whatever has slid is beyond the bound.
            return self.yielding / HARDLY
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
