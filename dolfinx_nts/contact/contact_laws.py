"""The laws of contact at an iterate: gap, active set, and friction by `coulomb`.

Whatever the master is, a pair's gap, slip and contact force are known here, and what they must
satisfy is written into its rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.coulomb import (
    HARDLY,
    NO_PULL,
    STRONG,
    UNEVEN,
    Coulomb,
    Rub,
    Slip,
    Together,
)
from dolfinx_nts.contact.pair import Candidates, ContactPair
from dolfinx_nts.interaction.constraint_elements import SHIFT
from dolfinx_nts.kernels import compiled_law
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Part of the slave's mass by which an open gap counts against a force. In each solution one of the
#: two is zero, and any part will do; in a first guess forces of the last step go with gaps of free
#: flight, which half of the steps of lasting contact open by a bounce that does not come.
_OPENING = 0.1


class Contribution(NamedTuple):
    """Step equations of the pairs at an iterate, all rows [kg m] for unknowns in [m].

    Attributes:
        residual: Shape (n, r), r = coordinates + augmented + constraints.
        tangent: Shape (n, r, r).
        multiplier: h^2/2 lambda of the constraints [kg m], shape (n, constraints).
        gap: g_N at t_{n+1} beyond the overlap that is left there [m], shape (n,).
        active: Active set of the iterate, shape (n,).
        stick: Active pairs that stick, shape (n,).
        slip: Facet size times f_1 - f_0 [m], shape (n, 2); (n, 0) without friction.
        distance: Length of the slip in the metric [m], shape (n,); 0 where not active.
        force: Contact force on the slave [kg m], shape (n, 3).
        tangential: The same less its part along the normal.
        coupling: h^2/2 G^T lambda of slave and control points [kg m], shape (n, control + 1, 3).
        place: Slave at t_{n+1} in the pair's frame [m], shape (n, 3).
        end: The multipliers at t_{n+1}: those of the step, but for massless nodes.
    """

    residual: FloatArray
    tangent: FloatArray
    multiplier: FloatArray
    gap: FloatArray
    active: BoolArray
    stick: BoolArray
    slip: FloatArray
    distance: FloatArray
    force: FloatArray
    tangential: FloatArray
    coupling: FloatArray
    place: FloatArray
    end: FloatArray

    @property
    def status(self) -> BoolArray:
        """What Newton's method may flip: active and stick, shape (2, n)."""
        return np.array([self.active, self.stick])


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactLaws:
    """The candidates of one pair in one step, and the laws that they obey.

    Attributes:
        pair: Its surfaces.
        candidates: This rank's slave nodes and their facets.
        contact_gradient: As of `Integrator`.
        condense: Whether (d, f) and their multipliers are eliminated pair by pair.
        x0: Slave, and what the master is interpolated from, at t_n [m], (n, control + 1, 3).
        scale: Force per motion of the slaves in the units of the step equations, shape (n,): the
            nodal mass [kg] in dynamics; scales multipliers.
        theta: Where between t_n and t_{n+1} the direct rule takes the contact force.
        rounding: Gap [m] that counts as none.
        force_rounding: Contact force [kg m] that counts as none.
        imposed: Which pairs are active, whatever their forces and gaps say, shape (n,); None: those
            that the law says.
        overlap: How deep the slaves may lie behind their facets at t_{n+1} [m], shape (n,).
        rubs: What pairs with friction that touch obey instead of Coulomb's law.
        before: h^2/2 lambda_N and lambda_T at t_n of massless nodes [kg m], NaN of the others,
            shape (n, 3); None: there are none.
    """

    pair: ContactPair
    candidates: Candidates
    contact_gradient: str
    condense: bool
    x0: FloatArray
    scale: FloatArray
    theta: float
    overlap: FloatArray | float = 0.0
    rounding: float = 0.0
    force_rounding: float = 0.0
    imposed: BoolArray | None = None
    rubs: Rub = Rub.LAW
    before: FloatArray | None = None

    @property
    def direct(self) -> bool:
        """Whether contact forces are those of one state, at theta, without a discrete gradient."""
        return self.contact_gradient == "direct"

    # ---- what a kind of master has of its own
    @property
    def num_control(self) -> int:
        """Points that the master is interpolated from."""
        raise NotImplementedError

    @property
    def _num_normal(self) -> int:
        """Constraints per pair but those of friction; that of the gap comes first."""
        return 1

    @property
    def _master_fixed(self) -> BoolArray:
        """Which coordinates of the masters' points are prescribed, shape (n, points, 3)."""
        raise NotImplementedError

    @property
    def foot(self) -> FloatArray:
        """Weights of the control points in the foot at t_n, shape (n, nc)."""
        raise NotImplementedError

    @property
    def point_foot(self) -> FloatArray:
        """Weights of the masters' points in the foot at t_n, shape (n, points)."""
        return self.foot

    @property
    def num_augmented(self) -> int:
        """Unknowns d and f per pair."""
        return 0

    def _normal(self, x: FloatArray) -> FloatArray:
        """Normal where the contact force acts, shape (n, 3)."""
        raise NotImplementedError

    @property
    def _ease(self) -> FloatArray:
        """Motion of the foot per force on it [1/kg], shape (n,)."""
        raise NotImplementedError

    @property
    def _tangents(self) -> FloatArray:
        """Tangents of the master at t_n over their size [-], shape (n, 2, 3)."""
        raise NotImplementedError

    # ---- sizes
    @property
    def num_elements(self) -> int:
        """Candidates on this rank."""
        return len(self.candidates.node)

    @property
    def _num_places(self) -> int:
        """Coordinates of the slave and the control points, in which pairs are evaluated."""
        return 3 * (self.num_control + 1)

    @property
    def num_tangential(self) -> int:
        """Tangential multipliers per pair, the last ones."""
        return 2 if self.pair.friction else 0

    @property
    def num_constraints(self) -> int:
        """Multipliers per pair."""
        return self._num_normal + self.num_tangential

    def _before_of(self, chosen: BoolArray) -> FloatArray | None:
        """`before` of some of the pairs, shape (n,)."""
        return None if self.before is None else self.before[chosen]

    @cached_property
    def _slave_points(self) -> IntArray:
        """Positions of the slaves in their surface, shape (n,)."""
        points: IntArray = self.pair.slave.share[self.candidates.node]
        return points

    # ---- laws
    @property
    def gap_rounding(self) -> FloatArray:
        """Gap [m] that is rounding, or that a force of the size of rounding opens, shape (n,)."""
        gap: FloatArray = np.maximum(self.rounding, self.force_rounding / self._yielding)
        return gap

    def _together(
        self, gap: FloatArray, slip: Slip | None, multiplier: FloatArray
    ) -> Together:
        """Return what pairs that share nodes need to know of each other. Collective."""
        if not self.pair.redundant:
            return Together(0.0, 0.0, 0.0)
        force = multiplier[:, 0]
        on = (force < 0.0) | (gap < 0.0)
        local = np.array([
            -force[on].clip(max=0.0).sum(), np.count_nonzero(force[on] < 0.0),
            np.abs(gap[on]).max(initial=0.0),
            0.0 if slip is None else np.abs(slip.value[on]).max(initial=0.0),
        ])  # fmt: skip
        ranks = gather_rows(self.pair.slave.body.comm, local[None])
        total, number = ranks[:, :2].sum(axis=0)
        extent = self.pair.extent
        return Together(total / max(number, 1.0), *(SHIFT + ranks[:, 2:].max(axis=0) / extent))

    @cached_property
    def _free(self) -> BoolArray:
        """Coordinates of slaves and points that are not prescribed, shape (n, points + 1, 3)."""
        slave = self.pair.slave.fixed[self._slave_points][:, None]
        free: BoolArray = ~np.concatenate([slave, self._master_fixed], axis=1)
        return free

    @cached_property
    def _yielding(self) -> FloatArray:
        """The part of `scale` that a slave and its foot move against each other, shape (n,).

        A master that is much lighter than the slave gives way in its place.
        """
        together: FloatArray = self.scale / (1.0 + self.scale * self._ease)
        return together

    @property
    def strong(self) -> bool:
        """Whether friction may hold a node that free motion lets go."""
        return self.pair.friction > STRONG

    @cached_property
    def coulomb(self) -> Coulomb:
        """Coulomb's law of the pairs."""
        square = np.column_stack([np.ones(self.num_elements), self.point_foot]) ** 2
        free: FloatArray = np.einsum("nk,nki->ni", square, self._free)
        return Coulomb(
            friction=self.pair.friction,
            yields=self.pair.yields,
            redundant=self.pair.redundant,
            x0=self.x0,
            foot=self.foot,
            normal=self.candidates.normal,
            tangents=self._tangents,
            size=self.candidates.length,
            free=free / square.sum(axis=1)[:, None],
            yielding=self._yielding,
            rubs=self.rubs,
        )

    @cached_property
    def _law(self) -> tuple[Any, list[Any]]:
        """What the compiled kernel is to know of the pairs in this step."""
        row = self._num_places + self.num_augmented
        size = row + self.num_constraints
        law = compiled_law.Law(
            self.scale, self._yielding, self._no_force, self.before, size, row, opening=_OPENING
        )
        if self.num_tangential:
            coulomb = self.coulomb
            law = law._replace(
                friction=True,
                endless=coulomb.endless,
                strong=self.strong,
                redundant=coulomb.redundant,
                coefficient=coulomb.coefficient,
                pull=NO_PULL if coulomb.endless else 0.0,
                hardly=HARDLY if self.rubs is Rub.HARDLY and not coulomb.endless else 0.0,
                uneven=UNEVEN,
                tangential_scale=coulomb.tangential_scale,
                unmoved=coulomb.unmoved if coulomb.prescribes else None,
            )
        return law.structure()

    def _laws(
        self,
        x: FloatArray,
        residual: FloatArray,
        tangent: FloatArray,
        gap: FloatArray,
        slip: Slip | None,
        multiplier: FloatArray,
        together: Together,
    ) -> Contribution:
        """Semi-smooth laws of contact (theory section 9) and friction (section 6).

        g_N = 0 where active, else lambda_N = 0; there Coulomb's law, else lambda_T = 0. These are
        the forces of the step, but at massless nodes those of its end: theirs of the step are the
        mean of both ends (theory section 16).
        """
        normal = held = None
        if slip is not None:
            normal = self._normal(x)
            held = self.coulomb.held(x) if self.coulomb.prescribes else None
        found = compiled_law.laws(
            self._law, together, residual, tangent, gap, slip, multiplier, held, normal
        )
        return Contribution(
            found.residual,
            found.tangent,
            multiplier,
            gap.copy(),
            found.active,
            found.stick,
            slip=np.empty((self.num_elements, 0)) if slip is None else slip.value,
            distance=found.distance,
            force=found.force,
            tangential=found.tangential,
            coupling=found.residual[:, : self._num_places].reshape(x.shape),
            place=x[:, 0],
            end=found.end,
        )

    @cached_property
    def _massless(self) -> BoolArray:
        """Which slaves are massless nodes, shape (n,)."""
        if self.before is None:
            return np.zeros(self.num_elements, dtype=bool)
        massless: BoolArray = ~np.isnan(self.before[:, 0])
        return massless

    @property
    def _no_force(self) -> FloatArray:
        """Contact force that counts as none before friction has a say [kg m], shape (n,).

        A touch without force has rounding in both, and with strong friction more than one solution
        (Painleve's paradox): so nodes carry where free motion would close their gaps, or did so in
        the last step.
        """
        if self.imposed is not None:
            return np.where(self.imposed, -np.inf, np.inf)
        return self._yielding * self.gap_rounding
