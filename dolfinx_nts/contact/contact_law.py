"""The law of contact: a gap that does not close beyond zero, and Coulomb's friction.

Whatever the gap is of, its slip and forces are known here, and what they must satisfy is written
into the elements' rows (theory sections 6 and 9); `contact_law.c` does that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.contact_measure import Batch, Measured, Slip
from dolfinx_nts.contact.prescribed_slip import PrescribedSlip
from dolfinx_nts.contact.slip_friction import SlipFriction
from dolfinx_nts.kernels import compiled_law
from dolfinx_nts.kernels.vectors import projector
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Part of the slave's mass by which an open gap counts against a force. In each solution one of the
#: two is zero, and any part will do; in a first guess forces of the last step go with gaps of free
#: flight, which half of the steps of lasting contact open by a bounce that does not come.
OPENING = 0.1
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
#: Slip over the size of the facet that counts as none.
_STILL = 1e-10
#: Stiffness against sliding of pairs that hardly rub, over that of the nodes: next to nothing, but
#: the equations of a body that friction alone holds have a solution.
HARDLY = 1e-9
#: Square of the part of a direction that is none of its own beside another one.
LEAST_OWN = 1e-2
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


class Together(NamedTuple):
    """What all pairs of a contact have in common where they share nodes, as of rigid bodies.

    Of several contacts the values of each pair are those of its contact, shape (n,). The
    compliances are those that the matrix lends to what holds a pair, over that of the bodies;
    they vanish with what is missed, see `constraints.SHIFT`, and are 0 where pairs share nothing;
    that of sticking nodes that `meets` names is fixed.

    Attributes:
        force: Mean normal force [kg m].
        normal: Compliance lent to gaps [-].
        tangential: Compliance lent to sticking [-].
    """

    force: FloatArray | float
    normal: FloatArray | float
    tangential: FloatArray | float


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
        coupling: h^2/2 G^T lambda of the measure's points [kg m], shape (n, points, 3).
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


def no_pull(friction: FloatArray) -> FloatArray:
    """Contact force that counts as none beside these friction forces (n, 3), in their unit."""
    none: FloatArray = NO_PULL * np.linalg.norm(friction, axis=1)
    return none


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactLaw(Batch):
    """What the elements of one pair obey in one step.

    Attributes:
        friction: Coefficient; `math.inf` sticks.
        yields: As of `ContactPair`.
        redundant: As of `ContactPair`.
        row: That of the gap in what is measured.
        num_normal: As of `ContactMeasure`.
        scale: Force per motion of the slaves in the units of the step equations, shape (n,): the
            nodal mass [kg] in dynamics; scales multipliers.
        yielding: The part of it that a slave and its foot move against each other, shape (n,): a
            master that is much lighter than the slave gives way in its place.
        size: Of the facets [m], shape (n,).
        prescribed: What of the slip is prescribed; None without friction.
        rounding: Gap [m] that counts as none.
        force_rounding: Contact force [kg m] that counts as none.
        imposed: Which pairs are active, whatever their forces and gaps say, shape (n,); None: those
            that the law says.
        slid: What had slipped in the step before the state that the elements start from, components
            as of `Contribution.slip` [m], shape (n, 2).
        overlap: How deep the slaves may lie behind their facets at t_{n+1} [m], shape (n,).
        rubs: What pairs with friction that touch obey instead of Coulomb's law.
        before: h^2/2 lambda_N and lambda_T at t_n of massless nodes [kg m], NaN of the others,
            shape (n, 3); None: there are none.
        varies: What the coefficient depends on; `friction` is that at rest then.
        width: Slip [m] by which friction is blurred, see `blur_slip` in contact_law.c; 0: it is
            not.
        gap_width: The same of gaps, see `blur_gap`.
        steep: Least algorithmic scale of the return map, shape (n,): the bound over the slip from
            which on a pair slides.
        meets: Which slaves another contact holds, too, shape (n,).
    """

    friction: float
    yields: bool
    redundant: bool
    row: int
    num_normal: int
    scale: FloatArray
    yielding: FloatArray
    size: FloatArray
    prescribed: PrescribedSlip | None = None
    rounding: float = 0.0
    force_rounding: float = 0.0
    imposed: BoolArray | None = None
    slid: FloatArray | float = 0.0
    overlap: FloatArray | float = 0.0
    rubs: Rub = Rub.LAW
    before: FloatArray | None = None
    varies: SlipFriction | None = None
    width: float = 0.0
    gap_width: float = 0.0
    steep: FloatArray | float = 0.0
    meets: BoolArray | bool = False

    # ---- multipliers
    @property
    def num_tangential(self) -> int:
        """Tangential multipliers per pair, the last ones."""
        return 2 if self.friction else 0

    @property
    def num_constraints(self) -> int:
        """Multipliers per pair."""
        return self.num_normal + self.num_tangential

    @property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which, shape (m, m)."""
        pattern = np.zeros((self.num_constraints,) * 2, dtype=bool)
        pattern[0, 0] = True
        pattern[self.num_normal :, 0] = True
        pattern[self.num_normal :, self.num_normal :] = True
        return pattern

    # ---- sizes
    @property
    def gap_rounding(self) -> FloatArray:
        """Gap [m] that is rounding, or that a force of the size of rounding opens, shape (n,)."""
        gap: FloatArray = np.maximum(self.rounding, self.force_rounding / self.yielding)
        return gap

    @property
    def no_force(self) -> FloatArray:
        """Contact force that counts as none before friction has a say [kg m], shape (n,).

        A touch without force has rounding in both, and with strong friction more than one solution
        (Painleve's paradox): so nodes carry where free motion would close their gaps, or did so in
        the last step.
        """
        if self.imposed is not None:
            return np.where(self.imposed, -np.inf, np.inf)
        return self.yielding * self.gap_rounding

    @property
    def strong(self) -> bool:
        """Whether friction may hold a node that free motion lets go."""
        return self.friction > STRONG

    @property
    def endless(self) -> bool:
        """Whether friction has no bound."""
        return self.rubs is Rub.STICKS or bool(np.isinf(self.friction))

    @property
    def coefficient(self) -> float:
        """That of the equations, which is a number."""
        return min(self.friction, _LARGEST)

    @property
    def still(self) -> FloatArray:
        """Slip that counts as none [m], shape (n,)."""
        return _STILL * self.size

    @cached_property
    def tangential_scale(self) -> FloatArray:
        """Algorithmic scale of the return map, shape (n,)."""
        if self.rubs is Rub.SLIDES:
            # Whatever has slid is beyond the bound.
            return self.yielding / HARDLY
        scale = (TANGENTIAL_SCALE if self.yields else _OF_SHARED) * self.yielding
        return np.maximum(scale, self.steep)

    def held(self, active: BoolArray, *, stick: bool) -> ContactLaw:
        """The same of pairs that are active as given, and stick, but for those that hardly rub."""
        rubs = Rub.STICKS if stick and self.rubs is not Rub.HARDLY else self.rubs
        return replace(self, imposed=active, rubs=rubs)

    @cached_property
    def massless(self) -> BoolArray:
        """Which slaves are massless nodes, shape (n,)."""
        if self.before is None:
            return np.zeros(len(self.scale), dtype=bool)
        massless: BoolArray = ~np.isnan(self.before[:, 0])
        return massless

    # ---- an iterate
    def misses(
        self, gap: FloatArray, slip: Slip | None, multiplier: FloatArray, of: IntArray, number: int
    ) -> FloatArray:
        """Sum and number of the forces that press [kg m], largest gap of these and slip [m].

        The slip is that of pairs that are to stick: what others slip is not missed, and does not
        vanish in the solution.

        Args:
            gap: As of `Measured`.
            slip: As of `Measured`.
            multiplier: As of `obey`.
            of: Contact of each pair, shape (n,).
            number: Of contacts.

        Returns:
            Of each contact, shape (number, 4).
        """
        force, found = multiplier[:, 0], np.zeros((number, 4))
        on = (force < 0.0) | (gap < 0.0)
        np.add.at(found[:, 0], of, -force.clip(max=0.0))
        np.add.at(found[:, 1], of, force < 0.0)
        np.maximum.at(found[:, 2], of[on], np.abs(gap[on]))
        if slip is not None:
            stick = on & ~self._slides(gap, slip, multiplier)
            np.maximum.at(found[:, 3], of[stick], np.abs(slip.value[stick]).max(axis=1))
        return found

    def _slides(self, gap: FloatArray, slip: Slip, multiplier: FloatArray) -> BoolArray:
        """Which pairs that share nodes are beyond Coulomb's bound, as the kernel has it."""
        if self.endless:
            return np.zeros(len(gap), dtype=bool)
        force = np.where(multiplier[:, 0] < 0.0, -multiplier[:, 0], -self.yielding * gap)
        pushed = np.matmul(slip.metric, slip.value[:, :, None])[:, :, 0]
        trial = multiplier[:, -2:] + self.tangential_scale[:, None] * pushed
        (a, b), (_, c) = slip.metric.transpose(1, 2, 0)
        square = c * trial[:, 0] ** 2 - 2.0 * b * trial[:, 0] * trial[:, 1] + a * trial[:, 1] ** 2
        slides: BoolArray = square > (a * c - b**2) * (self.coefficient * force.clip(min=0.0)) ** 2
        return slides

    @cached_property
    def _law(self) -> compiled_law.Law:
        """What the compiled kernel is to know of the pairs in this step."""
        law = compiled_law.Law(
            self.scale, self.yielding, self.no_force, self.before,
            self.row + self.num_constraints, self.row, opening=OPENING, width=self.width,
            gap_width=self.gap_width,
        )  # fmt: skip
        if self.num_tangential:
            prescribed = self.prescribed
            law = law._replace(
                friction=True,
                endless=self.endless,
                strong=self.strong,
                redundant=self.redundant,
                coefficient=self.coefficient,
                pull=NO_PULL if self.endless else 0.0,
                hardly=HARDLY if self.rubs is Rub.HARDLY and not self.endless else 0.0,
                uneven=UNEVEN,
                tangential_scale=self.tangential_scale,
                unmoved=prescribed.unmoved if prescribed and prescribed.any else None,
            )
        return law

    @cached_property
    def _kernel(self) -> tuple[Any, list[Any]]:
        """The same as the kernel takes it."""
        return self._law.structure()

    def _at(self, slip: Slip | None, multiplier: FloatArray) -> tuple[Any, list[Any]]:
        """`_kernel` with coefficients at an iterate, where these depend on it."""
        if self.varies is None or slip is None:
            return self._kernel
        square = np.einsum("na,nab,nb->n", slip.value, slip.metric, slip.value)
        found = self.varies.of(np.sqrt(square.clip(min=0.0)), -multiplier[:, 0])
        mu, by_slip, by_force = found
        law = self._law._replace(coefficients=mu, by_slip=by_slip, by_force=by_force)
        return law.structure()

    def obey(
        self, x: FloatArray, found: Measured, multiplier: FloatArray, together: Together,
        beside: FloatArray | None = None,
    ) -> compiled_law.Obeyed:  # fmt: skip
        """Semi-smooth laws of contact (theory section 9) and friction (section 6).

        g_N = 0 where active, else lambda_N = 0; there Coulomb's law, else lambda_T = 0. These are
        the forces of the step, but at massless nodes those of its end: theirs of the step are the
        mean of both ends (theory section 16).

        Args:
            x: Points at t_{n+1} [m], shape (n, points, 3).
            found: What they measure; its rows may be overwritten.
            multiplier: h^2/2 lambda of the constraints [kg m], shape (n, constraints).
            together: What pairs that share nodes know of each other.
            beside: Projector on the part of lambda_T that something else bears in the iterate,
                shape (n, 2, 2): it is zero, and the slip has none there. None: there is none.
        """
        held, prescribed, law = None, self.prescribed, self._at(found.slip, multiplier)
        if prescribed and prescribed.any:
            held = prescribed.held(x, self.still, self.slid)
        if beside is not None:
            unmoved, held = (
                beside if own is None else projector(own + beside, LEAST_OWN)
                for own in (self._law.unmoved, held)
            )
            law = self._law._replace(unmoved=unmoved).structure()
        return compiled_law.laws(
            law, together, found.residual, found.tangent, found.gap,
            found.slip, multiplier, held, found.normal, found.let_go,
        )  # fmt: skip

    # ---- a solution
    def unsure(self, part: Contribution, rounding: float) -> FloatArray:
        """What the rounding [m] of slips leaves unsure in the rows of friction [m], shape (n,).

        Friction has the direction of the slip, however small that is: of a rigid body's nodes that
        rub against each other by 1e-10 m rounding tells 1e-6 of it.
        """
        bound, scale = self.coefficient * -part.end[:, 0], self.tangential_scale
        trial = bound + scale * part.distance
        slides = part.active & ~part.stick & (trial > 0.0)
        share = np.divide(scale * rounding, trial, out=np.zeros_like(bound), where=slides)
        return np.asarray(bound * share / self.scale)

    def sticks(self, part: Contribution) -> BoolArray:
        """Which pairs have stuck in a solved step, shape (n,).

        Rounding alone tells on which side of Coulomb's bound a node is that rests at it, so a slip
        counts from a part of the facet on, see `still`.
        """
        if not self.num_tangential:
            return part.stick
        still: BoolArray = part.active & (part.distance <= self.still)
        return part.stick | still

    def ledger(self, part: Contribution, start: FloatArray, factor: float) -> dict[str, float]:
        """Works and counts of an accepted step on this rank.

        The contact defect is -sum lambda_N g_0: what activation loses and what a change of facet
        gains or loses. The massless defect is sum lambda_N g_1: what a massless node gains that
        leaves its facet within the step, with half the force of t_n, lambda_T . (f_1 - f_0)
        included. Friction dissipates the sum of lambda_T . (f_1 - f_0) over the others.

        Args:
            part: Solution of the step.
            start: Gaps at t_n [m], shape (n,).
            factor: What the step equations multiply forces by [s^2].

        Returns:
            friction_dissipation, contact_defect, massless_defect [J], active, stick, slip.
        """
        # Slips of rigid bodies that no motion closes count as sticking, and their work counts.
        rubbing = part.active if self.redundant else part.active & ~part.stick
        gone = ~part.active & self.massless
        dissipation, counts = 0.0, (0.0, 0.0)
        # Where it is closed, the gap is the solver's tolerance.
        left = float((part.multiplier[:, 0] * part.gap)[gone].sum())
        if self.num_tangential:
            work = part.multiplier[:, -2:] * part.slip
            dissipation, left = float(work[rubbing].sum()), left + float(work[gone].sum())
            sticking = self.sticks(part)
            counts = float(sticking.sum()), float((part.active & ~sticking).sum())
        return {
            "friction_dissipation": dissipation / factor,
            "contact_defect": -float(part.multiplier[:, 0] @ start) / factor,
            "massless_defect": left / factor,
            "active": float(part.active.sum()),
            "stick": counts[0],
            "slip": counts[1],
        }

    def tangential_at_end(
        self, part: Contribution, before: FloatArray, factor: float
    ) -> FloatArray:
        """Friction force at t_{n+1} [N], shape (n, 3), from that at t_n."""
        of_step: FloatArray = part.tangential / factor
        at_end = np.where(part.active[:, None], 2.0 * of_step - before, 0.0)
        return np.where(self.massless[:, None], at_end, of_step)
