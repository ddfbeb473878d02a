"""Contact whose law holds for sums of the gaps of points: one multiplier, several elements.

The points of a slave's facets have the elements of `FacetGap` or `ObstacleGap`; what the law is
about, and has a multiplier, is g_A = sum_q C_qA g_q of a node, with constant C (theory section 17).
Forces go back by the same C, so that energy and momenta are those of the points. The elements that
bodies see are pairs of facets of slave and master, or the slave's alone: sums of all points there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact.candidates import Candidates
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import ContactLaw, Contribution
from dolfinx_nts.contact.contact_measure import Measured, Slip
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.obstacle_gap import ObstacleGap
from dolfinx_nts.contact.prescribed_slip import PrescribedSlip
from dolfinx_nts.contact.surface_sums import FacetAttachment, Sums
from dolfinx_nts.interaction.combination import Combination
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.kernels import compiled, compiled_law
from dolfinx_nts.kernels.vectors import cross, resultant
from dolfinx_nts.parallel import Asking, anywhere
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Convective coordinates by which points of an equilibrium may lie beside where they were cut, by
#: how often it was sought again. Mostly one time leaves a hundredth; where points come and go at
#: the limit of what is looked at, it ends in turns between two states that differ by little.
_STALE = (1e-5, 1e-4, 1e-3)
#: Mean gap over the size of the facets around a node where curved bodies may touch.
_SAG = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceElements(ContactElements):
    """Elements of a pair that is integrated over the slave's surface; see `Elements`.

    Arrays of `Contribution` but residual and tangent have slaves as axis 0; coupling and place, the
    measure's points at t_{n+1}, have points of the surface.

    Attributes:
        attachment: Facets of the elements.
        measure: Gap and slip of the points.
        sums: What they contribute to.
        frame: Directions of the slaves' slips at t_n, shape (slaves, 2, 3).
    """

    attachment: FacetAttachment
    measure: FacetGap | ObstacleGap
    sums: Sums
    frame: FloatArray

    def select(self, chosen: BoolArray) -> SurfaceElements:
        """What serves some of the slaves, chosen by a mask."""
        if chosen.all():
            return self
        sums, number = self.sums, np.where(chosen, np.cumsum(chosen) - 1, -1)
        slot = np.append(number, -1)[sums.slot]
        serves = (slot >= 0).any(axis=1)
        share = np.where(slot >= 0, sums.share, 0.0)
        there, element = np.unique(sums.element[serves], return_inverse=True)
        chosen_sums = replace(sums, slaves=int(chosen.sum()), slot=slot, share=share).select(serves)
        return replace(
            self, candidates=self.candidates.select(chosen), law=self.law.select(chosen),
            frame=self.frame[chosen], measure=self.measure.select(serves),
            attachment=self.attachment.select(np.isin(np.arange(self.num_elements), there)),
            sums=replace(chosen_sums, element=element),
        )  # fmt: skip

    # ---- sizes
    @property
    def num_elements(self) -> int:
        """Pairs of facets on this rank."""
        return len(self.attachment.own)

    @cached_property
    def _corners(self) -> int:
        return self.sums.slot.shape[1]

    @cached_property
    def widths(self) -> dict[str, int]:
        """Multipliers of the slaves at a facet's corners."""
        return {"augmented": 0, "constraints": self._corners * self.law.num_constraints}

    @property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which: those of one slave."""
        return np.kron(np.eye(self._corners, dtype=bool), self.law.pattern)

    @cached_property
    def _slot(self) -> IntArray:
        """Slaves at the corners of each element, shape (elements, corners); -1: none."""
        first = np.flatnonzero(np.diff(self.sums.element, prepend=-1))
        return self.sums.slot[first]

    @cached_property
    def combination(self) -> Combination:  # type: ignore[override]
        """Multipliers are those of the slaves, each in several elements."""
        slot, width = self._slot, self.law.num_constraints
        shape = self.num_elements, self.widths["constraints"]
        number = (np.maximum(slot, 0)[:, :, None] * width + np.arange(width)).reshape(*shape, 1)
        weight = np.repeat(slot >= 0, width, axis=1).astype(float).reshape(*shape, 1)
        return Combination(number, weight, len(self.frame) * width)

    @cached_property
    def _first(self) -> tuple[IntArray, IntArray]:
        """Of each slave the element that has its equation, and its corner there."""
        where = np.flatnonzero(self._slot.ravel() >= 0)
        slot, at = np.unique(self._slot.ravel()[where], return_index=True)
        assert len(slot) == len(self.frame)
        element, corner = np.unravel_index(where[at], self._slot.shape)
        return element, corner

    @cached_property
    def _elements_of(self) -> IntArray:
        """How many elements each slave has, shape (slaves,)."""
        # Each has a part of a slave's equations, or it would say nothing of its own multiplier.
        return np.bincount(self._slot[self._slot >= 0], minlength=len(self.frame))

    @property
    def immovable(self) -> BoolArray:
        """None is dropped beside another contact's."""
        return np.zeros(len(self.frame), dtype=bool)

    @property
    def sag(self) -> FloatArray:
        """A part of the facets: where curved bodies touch at a point, means are off."""
        return _SAG * self.candidates.length

    @property
    def tangents(self) -> FloatArray:  # type: ignore[override]
        """The slaves' directions."""
        return self.frame

    @property
    def _held(self) -> BoolArray:  # type: ignore[override]
        slave = self.pair.slave
        return slave.fixed[slave.share[self.candidates.node]].all(axis=1)

    def place(self, i: int) -> str:
        """The slave's number in the user's mesh."""
        return f"node {self.input_node(i)}"

    # ---- places
    def _measured(self, y: FloatArray) -> FloatArray:
        """The measure's points (n, points, 3) from the nodes of elements [m]."""
        weights = self.attachment.weights
        corners = y if weights is None else np.matmul(weights, y)
        points = compiled.points_of(self.sums.element, self.sums.shape, corners)
        return points - self.attachment.path[1]

    def gap(self, x: FloatArray) -> FloatArray:
        """Gaps of the slaves beyond the overlap that is left [m]."""
        return self._gaps(self._measured(x)) + self.law.overlap

    def gap_at(self, positions: Sequence[FloatArray], path: FloatArray) -> FloatArray:
        """Gaps of the slaves [m] by positions of all points."""
        return self._gaps(self._placed(positions) - path)

    def _placed(self, positions: Sequence[FloatArray]) -> FloatArray:
        """The measure's points (n, points, 3) from positions of all points [m]."""
        own, *others = (
            side[number[self.sums.element]]
            for side, number in zip(positions, self.attachment.numbers, strict=True)
        )
        points = np.einsum("nc,nci->ni", self.sums.shape, own)[:, None]
        for control in others:
            other = self.attachment.other[self.sums.element]
            control = self.pair.master.combine(control, other)
            points = np.concatenate([points, control], axis=1)
        return points

    def _gaps(self, x: FloatArray) -> FloatArray:
        return self.sums.to_slaves(self.measure.gap(x))

    def is_stale(
        self, positions: Sequence[FloatArray], part: Contribution, repeats: int
    ) -> bool:
        """Whether points lie elsewhere over the master than where pieces were cut. Collective."""
        limit = _STALE[min(repeats, len(_STALE) - 1)]
        strayed = self.measure.has_strayed(self._placed(positions), self.sums.cut, limit)
        carries = np.append(part.active, False)[self.sums.slot].any(axis=1)
        return anywhere(self.pair.slave.body.comm, bool(strayed[carries].any()))

    def way_since(self, positions: Sequence[FloatArray], path: FloatArray) -> FloatArray:
        """As of `ContactElements`, in the mean."""
        way = self.measure.start - self._placed(positions) + path
        return self._along_feet(way)

    def _along_feet(self, motion: FloatArray) -> FloatArray:
        """How slaves move against their feet in the mean [m], by points (n, points, 3)."""
        foot = np.einsum("nk,nki->ni", self.measure.foot, motion[:, 1:])
        return self.sums.to_slaves(motion[:, 0] - foot)

    def carries(self, own: Mapping[str, FloatArray]) -> FloatArray:
        """Those of slaves, from the corners of elements."""
        width = self.law.num_constraints
        of_corners = own["constraints"].reshape(self.num_elements, self._corners, width)
        return self.law.scale[:, None] * of_corners[self._first]

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """No augmented unknowns: those of points follow from their places."""
        return np.empty((self.num_elements, 0))

    # ---- an iterate
    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> Asking[Contribution]:
        """As of `ContactElements`, by multipliers of the slaves at the corners.

        "held" in own projects on directions of their slips that they are held in, in their frames,
        shape (slaves, 2, 2); None are, if it is left out.
        """
        multiplier = self.carries(own)
        y = self._measured(x)
        try:
            points = self.measure.summed(y, self.sums, multiplier, self.frame)
        except Exception:  # as of `ContactElements`
            yield from self._together(np.empty(0), None, np.empty((0, 1)))
            raise
        held = own.get("held")
        found = self._of_slaves(points, y, multiplier, held)
        together = yield from self._together(found.gap, found.slip, multiplier)
        # What moves as prescribed is asked for with friction alone.
        motion = np.empty((len(multiplier), 1, 3))
        if self.law.prescribed:
            motion = self._along_feet(y - self.measure.start)[:, None]
        obeyed = self.law.obey(motion, found, multiplier, together, held)
        residual, tangent = points.residual, points.tangent
        if self.attachment.weights is not None:
            residual, tangent = compiled_law.to_nodes(self.attachment.weights, residual, tangent)
        self._write_law(residual, tangent, obeyed.residual[:, 3:], obeyed.tangent[:, 3:])
        return Contribution(
            **obeyed._replace(residual=residual, tangent=tangent)._asdict(),
            multiplier=multiplier,
            gap=found.gap,
            slip=found.slip.value if found.slip else np.empty((len(multiplier), 0)),
            coupling=points.force,
            place=y + self.attachment.path[1],
        )

    def _of_slaves(
        self, points: compiled.OverSurface, y: FloatArray, multiplier: FloatArray,
        held: FloatArray | None,
    ) -> Measured:  # fmt: skip
        """What the law takes for elements, whose coordinates are gap and slip of the slaves.

        Their rows of coordinates are minus the forces on the slaves.
        """
        n, width = multiplier.shape
        residual, tangent = np.zeros((n, 3 + width)), np.zeros((n, 3 + width, 3 + width))
        gap = points.gap + self.law.overlap
        residual[:, :3] = points.pulls
        residual[:, 3], tangent[:, 3, 0] = gap, 1.0
        let_go = self._pulled(multiplier[:, 0])
        if width == 1:
            return Measured(residual, tangent, gap, let_go=let_go)
        gradient = np.zeros((n, 2, 3 + width))
        gradient[:, [0, 1], [1, 2]] = 1.0
        metric = np.tile(np.eye(2), (n, 1, 1))
        value = np.einsum("nki,ni->nk", self.frame, points.slip) + self.law.slid
        if held is not None:
            value -= np.einsum("nkl,nl->nk", held, value)
            gradient[:, :, 1:3] -= held
        slip = Slip(value, gradient, metric, np.zeros((n, 2, 2, 3 + width)))
        normal = self.sums.to_slaves(self.measure.normal_between(y))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return Measured(residual, tangent, gap, slip, normal, let_go)

    def _pulled(self, force: FloatArray) -> BoolArray | None:
        """Which slaves press, though the pressure around them pulls at their nodes.

        Multipliers of nodes that must leave alternate, ring by ring, and one ring would leave in
        each iteration. No solution has such slaves: where no multiplier pulls, no pressure does.

        Args:
            force: lambda_A [kg m], shape (slaves,).
        """
        if self.law.imposed is not None:
            return None
        sums = self.sums
        there = sums.hat * sums.to_points(force)[:, None]
        pull: FloatArray = sums.by_slave(there[:, :, None])[:, 0]
        return (force < 0.0) & (pull > 0.0)

    def _write_law(
        self, residual: FloatArray, tangent: FloatArray, rows: FloatArray, slopes: FloatArray
    ) -> None:
        """Write the equations of slaves into the elements'.

        Args:
            residual: Of elements, shape (n, r).
            tangent: Shape (n, r, r).
            rows: Of the slaves [kg m], shape (slaves, constraints).
            slopes: Derivatives of these by gap, two slips and multipliers.
        """
        width, size = rows.shape[1], self.num_coordinates
        compiled.law_of_sums(self._slot, self.law.scale, slopes, self._elements_of, tangent)
        element, corner = self._first
        residual[element[:, None], size + corner[:, None] * width + np.arange(width)] = rows

    # ---- a solution
    def _pushed(self, part: Contribution) -> tuple[FloatArray, FloatArray]:
        """As of `ContactElements`."""
        return part.place[:, 0], -part.coupling[:, 0]

    def pressing(self, part: Contribution) -> FloatArray:
        """As of `ContactElements`, of the pressure between the nodes, sum of C_qA lambda_A.

        Multipliers alternate from node to node where it does not (theory 17).
        """
        total = np.zeros(len(self.pair.slave.points))
        corners = self.attachment.numbers[0][self.sums.element]
        force = -self.sums.to_points(part.multiplier[:, 0])
        np.add.at(total, corners, self.sums.shape * force[:, None])
        return total

    def impulse(self, part: Contribution, push: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As of `ContactElements`."""
        size, width = self.num_coordinates, self.law.num_constraints
        y = part.place - self.attachment.path[1]
        gaps = part.tangent[:, size::width, :size]
        each = np.append(push / self.law.scale, 0.0)[self._slot]
        pulls = self.sums.to_points(push)[:, None] * self.measure.normal_at(y)
        place = self.pair.origin + part.place[:, 0]
        return np.einsum("ec,ecz->ez", each, gaps), resultant(place, pulls)

    def _pushes(self, part: Contribution) -> list[tuple[IntArray, FloatArray]]:
        """As of `ContactElements`."""
        own, *others = (number[self.sums.element] for number in self.attachment.numbers)
        found = [(own, np.einsum("nc,ni->nci", self.sums.shape, -part.coupling[:, 0]))]
        for number in others:
            of_master, weights = -part.coupling[:, 1:], self.pair.master.weights
            if weights is not None:
                of = weights[self.attachment.other[self.sums.element]]
                of_master = np.einsum("nkp,nki->npi", of, of_master)
            found.append((number, of_master))
        return found


def surface_elements(
    pair: Any,
    found: Candidates,
    attachment: FacetAttachment,
    measure: FacetGap | ObstacleGap,
    sums: Sums,
    step: Step,
) -> SurfaceElements:
    """Elements of a step, with the law of a pair for their slaves. Collective.

    Args:
        pair: The pair.
        found: The slaves, with sums of what their points have.
        attachment: Facets of the elements.
        measure: Gap and slip of the points.
        sums: What these contribute to.
        step: The step.
    """
    ease, square, free = np.zeros((2, sums.slaves)), 0.0, 0.0
    each = sums.moves(attachment, measure.foot)
    for side, (surface, moves) in enumerate(zip(attachment.surfaces, each, strict=True)):
        squares, scale = moves.power(2), step.scale(surface, pair.bodies)
        ease[side] = squares @ ((1.0 if side == 0 else ~surface.fixed.all(axis=1)) / scale)
        square = square + squares.sum(axis=1)
        free = free + squares @ (~surface.fixed).astype(float)
    scale, frame = 1.0 / ease[0], _frame(found.normal)
    prescribed = None
    if pair.friction:
        prescribed = PrescribedSlip(
            start=np.zeros((sums.slaves, 1, 3)), foot=np.empty((sums.slaves, 0)),
            normal=found.normal, tangents=frame, free=free / np.reshape(square, (-1, 1)),
        )  # fmt: skip
    law = ContactLaw(
        friction=pair.friction, yields=pair.yields, redundant=pair.redundant, row=3, num_normal=1,
        scale=scale, yielding=scale / (1.0 + scale * ease[1]), size=found.length,
        prescribed=prescribed,
    )  # fmt: skip
    return SurfaceElements(
        pair=pair, candidates=found, attachment=attachment, measure=measure, law=law, sums=sums,
        frame=frame,
    )  # fmt: skip


def _frame(normal: FloatArray) -> FloatArray:
    """Two directions across each normal (n, 3), orthonormal, shape (n, 2, 3)."""
    first = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = first - np.einsum("ni,ni->n", first, normal)[:, None] * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, cross(normal, first)], axis=1)
