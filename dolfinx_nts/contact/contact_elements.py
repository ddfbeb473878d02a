"""Elements of contact: a measure of points of bodies under the law of contact, in one step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from dolfinx_nts.contact.candidates import Candidates
from dolfinx_nts.contact.contact_law import ContactLaw, Contribution, Together
from dolfinx_nts.contact.contact_measure import Attachment, Batch, ContactMeasure, Slip, fixed_of
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.interaction.combination import Combination, of_multipliers
from dolfinx_nts.interaction.constraint_elements import SHIFT
from dolfinx_nts.interaction.elements import entries_of, over
from dolfinx_nts.kernels import compiled_law, nts_element
from dolfinx_nts.kernels.vectors import resultant
from dolfinx_nts.parallel import Asking
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Changes of one node's state in a step that are no search any more.
_CYCLE = 8
#: What messages say of such a node; what follows says what to do.
UNSETTLED = "settles in neither; "
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactElements(Batch):
    """The candidates of one pair in one step; see `Elements`.

    Attributes:
        pair: Its surfaces.
        candidates: This rank's slave nodes and their facets.
        attachment: Which points of bodies these are.
        measure: Their gap and slip.
        law: What these obey.
        offset: Gap that counts as none [m], shape (n,), see `ContactPair`.
        contacts: Extents [m] of several contacts whose elements these are, and number of that of
            each element, shape (n,); None: they are of one.
    """

    pair: ContactPair
    candidates: Candidates
    attachment: Attachment
    measure: ContactMeasure
    law: ContactLaw
    offset: FloatArray | float = 0.0
    contacts: tuple[FloatArray, IntArray] | None = None
    combination: ClassVar[Combination | None] = None

    def select(self, chosen: BoolArray) -> ContactElements:
        """The pairs chosen by a mask of shape (n,), itself if that chooses all."""
        return self if chosen.all() else super().select(chosen)

    # ---- sizes
    @property
    def name(self) -> str:
        """Name for messages."""
        return self.pair.name

    @property
    def num_elements(self) -> int:
        """Candidates on this rank."""
        return len(self.candidates.node)

    @cached_property
    def num_coordinates(self) -> int:
        """Coordinates of the nodes that slave and master of a pair depend on."""
        return sum(3 * side.nodes.shape[1] for side in self.attachment.sides)

    @cached_property
    def widths(self) -> dict[str, int]:
        """Own unknowns of a pair by field."""
        augmented, constraints = self.measure.num_augmented, self.law.num_constraints
        return {"augmented": augmented, "constraints": constraints}

    @property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which, shape (m, m)."""
        return self.law.pattern

    @property
    def entries(self) -> BoolArray:
        """All but what `pattern` leaves out."""
        return entries_of(self.num_coordinates, self.pattern)

    @property
    def bilateral(self) -> bool:
        """Contact does not pull."""
        return False

    @property
    def force_scale(self) -> float:
        """Unknowns are forces."""
        return 1.0

    @cached_property
    def extent(self) -> float:
        """Length beside the displacements whose rounding enters the gaps [m]."""
        path = float(np.abs(self.attachment.path).max())
        return self.pair.extent + self.measure.extent + path

    @property
    def gap_row(self) -> int:
        """Row of the gap in the residual of a pair."""
        return self.num_coordinates + self.measure.num_augmented

    @property
    def immovable(self) -> BoolArray:
        """Whether all coordinates of the pairs' masters are prescribed, shape (n,)."""
        return fixed_of(self.attachment)[:, self._own :].all(axis=(1, 2))

    @property
    def sag(self) -> FloatArray | float:
        """Gap that slaves of curved bodies may have which just touch [m], shape (n,)."""
        return 0.0

    @property
    def _own(self) -> int:
        """Points of the slave's surface that an element depends on."""
        return self.attachment.numbers[0].shape[1]

    # ---- places
    def points(self) -> tuple[IntArray, ...]:
        """Global coordinates of the slaves' nodes (n, 3 k) and of the masters'."""
        return tuple(side.flat() for side in self.attachment.sides)

    def dofs(self) -> tuple[IntArray, ...]:
        """The same with -1 where they are prescribed."""
        return tuple(side.flat(prescribed=-1) for side in self.attachment.sides)

    def reference(self) -> FloatArray:
        """Reference values of these nodes [m], places in the pair's frame, shape (n, k, 3)."""
        return self._reference

    @cached_property
    def _reference(self) -> FloatArray:
        origin = self.pair.origin
        sides = self.attachment.sides
        each = [n.reference - np.where(n.places[:, :, None], origin, 0.0) for n in sides]
        return np.concatenate(each, axis=1)

    def _measured(self, y: FloatArray) -> FloatArray:
        """The measure's points (n, points, 3) from nodes (n, k, 3) [m]."""
        weights = self.attachment.weights
        return (y if weights is None else np.matmul(weights, y)) - self.attachment.path[1]

    def gap(self, x: FloatArray) -> FloatArray:
        """Gaps beyond the overlap that is left [m], shape (n,), of nodes as of `evaluate`."""
        return self.measure.gap(self._measured(x)) - self.offset + self.law.overlap

    def gap_at(self, positions: Sequence[FloatArray], path: FloatArray) -> FloatArray:
        """Gaps [m], shape (n,), by positions of all points.

        Args:
            positions: As of `ContactPair.positions`.
            path: Displacement of a master that is no body then [m], shape (3,).
        """
        return self.measure.gap(self.pair.points(positions, self.candidates) - path) - self.offset

    def is_stale(
        self, positions: Sequence[FloatArray], part: Contribution, repeats: int
    ) -> bool:
        """Whether an equilibrium is none of the elements that its places have. Collective.

        Args:
            positions: Of all points in it, as of `ContactPair.positions`.
            part: Solution.
            repeats: How often it has been sought again for that.
        """
        return False

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """Augmented unknowns that fit predicted nodes (n, k, 3), as of `reference`."""
        return self.measure.augmented(self._measured(x))

    def input_node(self, i: int) -> int:
        """Number of a pair's slave node in the user's mesh."""
        return int(self.pair.slave.original[self.pair.slave.share[self.candidates.node[i]]])

    def place(self, i: int) -> str:
        """Where a slave is, for messages."""
        return self.attachment.place(i)

    @cached_property
    def tangents(self) -> FloatArray:
        """Directions of the slip's components, as of `ContactMeasure`."""
        return self.measure.tangents

    @cached_property
    def _held(self) -> BoolArray:
        """Which slaves move as prescribed, shape (n,)."""
        return fixed_of(self.attachment)[:, : self._own].all(axis=(1, 2))

    def multipliers(self, normal: FloatArray, tangential: FloatArray) -> FloatArray:
        """Multipliers of given contact forces on the slaves [N], shape (n, constraints).

        Args:
            normal: p_N, shape (n,).
            tangential: Friction, shape (n, 3).
        """
        out = np.zeros((len(normal), self.law.num_constraints))
        out[:, 0] = -normal
        if self.law.num_tangential:
            out[:, -2:] = -np.einsum("nai,ni->na", self.tangents, tangential)
        return out

    def slid_since(self, positions: Sequence[FloatArray], path: FloatArray) -> FloatArray:
        """Slip from earlier positions to those at t_n, as of `Contribution.slip`, shape (n, 2).

        Args:
            positions: As of `ContactPair.positions`.
            path: Displacement of a master that is no body then [m], shape (3,).
        """
        metric = np.matmul(self.tangents, self.tangents.transpose(0, 2, 1))
        along = np.matmul(self.tangents, self.way_since(positions, path)[:, :, None])
        return nts_element.solve(metric, along)[:, :, 0]

    def carries(self, own: Mapping[str, FloatArray]) -> FloatArray:
        """Multipliers of the slaves [kg m] by own unknowns of `evaluate`, (n, constraints)."""
        return self.law.scale[:, None] * own["constraints"]

    def way_since(self, positions: Sequence[FloatArray], path: FloatArray) -> FloatArray:
        """How slaves have moved against their feet of t_n since then [m], shape (n, 3)."""
        way = self.measure.start - self.pair.points(positions, self.candidates) + path
        found: FloatArray = way[:, 0] - np.einsum("nk,nki->ni", self.measure.foot, way[:, 1:])
        return found

    def rows(self, k: Contribution, name: str) -> FloatArray:
        """The residual's rows of "augmented" unknowns or "constraints", shape (n, width)."""
        start = self.num_coordinates
        middle = start + self.measure.num_augmented
        return k.residual[:, start:middle] if name == "augmented" else k.residual[:, middle:]

    def law_rows(self, k: Contribution) -> FloatArray:
        """What is left of the constraints of each slave [kg m], shape (n, constraints)."""
        return of_multipliers(self, self.rows(k, "constraints")).reshape(k.multiplier.shape)

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> Asking[Contribution]:
        """Residual and tangent of the pairs, as of `together`; it asks, too, if an obstacle raises.

        Args:
            x: Nodes of slave and master at t_{n+1} [m], shape (n, k, 3).
            own: "augmented": facet size times (d, f) [m], shape (n, 5) or (n, 0); "constraints":
                h^2/2 lambda of the scaled constraints, and of lambda_T over the facet size, over
                `ContactLaw.scale` [m], shape (n, constraints).
        """
        law, x = self.law, self._measured(x)
        multiplier = self.carries(own)
        try:
            found = self.measure.evaluate(x, own["augmented"], multiplier)
        except Exception:  # any of an obstacle of the user's; the other ranks wait
            yield from self._together(np.empty(0), None, np.empty((0, 1)))
            raise
        gap = found.gap - self.offset + law.overlap
        found.residual[:, law.row], found = gap, found._replace(gap=gap)
        slip = found.slip
        if slip:
            slip = slip._replace(value=slip.value + law.slid)
            found = found._replace(slip=slip)
        together = yield from self._together(gap, slip, multiplier)
        obeyed = law.obey(x, found, multiplier, together)
        residual, tangent, weights = obeyed.residual, obeyed.tangent, self.attachment.weights
        if weights is not None:
            residual, tangent = compiled_law.to_nodes(weights, residual, tangent)
        return Contribution(
            **obeyed._replace(residual=residual, tangent=tangent)._asdict(),
            multiplier=multiplier,
            gap=gap,
            slip=slip.value if slip else np.empty((len(x), 0)),
            coupling=obeyed.residual[:, : 3 * x.shape[1]].reshape(x.shape),
            place=x[:, 0] + self.attachment.path[1],
        )

    def _together(
        self, gap: FloatArray, slip: Slip | None, multiplier: FloatArray
    ) -> Asking[Together]:
        """Return what pairs that share nodes need to know of each other."""
        if not self.law.redundant:
            # Between two walls the gap to one says already that a node sticks to the other.
            return Together(-multiplier[:, 0], 0.0, SHIFT * self.law.meets)
        extents, of = self.contacts or (
            np.array([self.pair.extent]), np.zeros(len(gap), dtype=np.int64)
        )
        of = of[: len(gap)]
        local = self.law.misses(gap, slip, multiplier, of, len(extents))
        sums, largest = yield local[:, :2], local[:, 2:]
        total, number = sums.reshape(-1, 2).T
        lent = SHIFT + largest.reshape(-1, 2).T / extents
        return Together(*np.array([total / np.maximum(number, 1.0), *lent])[:, of])

    # ---- what a step asks of elements once it is solved, or is not
    def largest(self, part: Contribution) -> list[float]:
        """Sizes that `ratios` compares: augmented rows, gaps, multipliers and scale."""
        gaps = self.law_rows(part) / self.law.scale[:, None]
        if self.law.num_tangential:
            friction = np.abs(gaps[:, -2:]) - self.law.unsure(part, _EPS * self.extent)[:, None]
            gaps[:, -2:] = friction.clip(min=0.0)
        arrays = (self.rows(part, "augmented"), gaps, part.multiplier, self.law.scale)
        found = [float(np.abs(a).max(initial=0.0)) for a in arrays]
        # Rows of gaps that repeat each other miss what no motion closes, see `shared_weight`.
        found[1] = max(found[1], float(np.abs(part.gap[part.active]).max(initial=0.0)))
        return found

    def ratios(
        self, part: Any, largest: Any, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """Residuals of the pairs' own rows over what counts as converged.

        Args:
            part: Plays no part.
            largest: `largest`; multipliers and scale over all ranks if there are augmented rows.
            motion: Largest motion of the step [m].
            rounded: Length whose rounding is in all positions [m].
            rtol: Tolerance of Newton's method.
        """
        augmented, gap, force, scale = largest
        limit = rtol * motion + 8 * _EPS * (rounded + self.extent)
        found = {f"{self.name} constraints": over(gap, limit)}
        if self.measure.num_augmented:
            limit = rtol * max(force, scale * motion)
            found[f"{self.name} (d, f)"] = over(augmented, limit)
        return found

    def ledger(self, part: Contribution, factor: float) -> dict[str, float]:
        """Works and counts of an accepted step on this rank, see `ContactLaw.ledger`."""
        start, end = self.attachment.path
        work = float((part.force @ (end - start)).sum()) / factor
        return self.law.ledger(part, self.candidates.gap, factor) | {"external_work": work}

    def moment(self, part: Contribution, theta: float) -> FloatArray:
        """Moment of the forces on the slaves about the origin [kg m^2], this rank's part, (3,).

        Args:
            part: Solution of the step.
            theta: Where between t_n and t_{n+1} the forces act.
        """
        start = self.measure.start[:, 0] + self.attachment.path[0]
        place, force = self._pushed(part)
        return resultant(self.pair.origin + start + theta * (place - start), force)[1]

    def _pushed(self, part: Contribution) -> tuple[FloatArray, FloatArray]:
        """The measure's slaves at t_{n+1} [m], and forces on them [kg m], shape (n, 3) each."""
        return part.place, part.force

    def nodal_forces(self, part: Contribution) -> list[FloatArray]:
        """Forces on the points of the slave and of the master's surface, if it has a body [kg m].

        Returns:
            Of each surface this rank's part, shape (p, 3).
        """
        found = []
        for surface, each in zip(self.attachment.surfaces, self._pushes(part), strict=True):
            found.append(np.zeros((len(surface.points), 3)))
            np.add.at(found[-1], *each)
        return found

    def _pushes(self, part: Contribution) -> list[tuple[IntArray, FloatArray]]:
        """Of each surface, numbers of points (n, p) and forces on them [kg m], (n, p, 3)."""
        force, shares, numbers = -part.coupling, self.attachment.shares, self.attachment.numbers
        if shares is not None:
            force = np.matmul(shares.transpose(0, 2, 1), force)
        each = np.split(force, np.cumsum([number.shape[1] for number in numbers]), axis=1)
        return list(zip(numbers, each, strict=False))

    def impulse(self, part: Contribution, push: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What impulses along the normals at t_{n+1} do, of slaves that are active.

        Args:
            part: Solution of the step.
            push: On the slaves [N s], shape (n,).

        Returns:
            Impulses on the elements' coordinates [N s], shape (n, coordinates); the sum of those on
            slaves, and of their moments about the origin [N m s], on this rank, shape (2, 3).
        """
        # Where a gap is closed, a change of the foot or of the normal does not change it.
        rows = part.tangent[:, self.gap_row, : self.num_coordinates] / self.law.scale[:, None]
        slave = self.attachment.sides[0]
        own = rows[:, : 3 * slave.nodes.shape[1]].reshape(*slave.nodes.shape, 3)
        pulls = push[:, None] * (own * slave.places[:, :, None]).sum(axis=1)
        return push[:, None] * rows, resultant(self.pair.origin + part.place, pulls)

    def pressing(self, part: Contribution) -> FloatArray | None:
        """This rank's part of the contact forces at all points of the slave [kg m], shape (p,).

        None: they are those of the law.
        """
        return None

    def gains(self, part: Contribution, factor: float) -> FloatArray:
        """Energy that each pair brings in by starting behind its facet [J], shape (n,)."""
        return part.multiplier[:, 0] * self.candidates.gap / factor

    def carried(self, old: ContactHistory) -> FloatArray:
        """Normal and tangential multipliers of the forces of the last step [N], shape (n, 3)."""
        node = self.candidates.node
        found, both = np.zeros((len(node), 3)), self.multipliers(
            old.force[node], old.tangential[node]
        )
        found[:, 0] = both[:, 0]
        if self.pair.friction:
            found[:, 1:] = both[:, -2:]
        return found

    def history(self, part: Contribution, factor: float, old: ContactHistory) -> ContactHistory:
        """Return what the contact remembers of an accepted step."""
        new = ContactHistory.of_start(len(old.force))
        node = self.candidates.node
        new.facet[node], new.gap[node] = self.candidates.facet, part.gap - self.law.overlap
        new.stick[node] = self.law.sticks(part)
        new.force[node] = -np.where(part.active, part.end[:, 0], 0.0) / factor
        new.tangential[node] = self.law.tangential_at_end(part, old.tangential[node], factor)
        new.slip[:] = old.slip
        new.slip[node] += part.distance
        return new._replace(overlap=old.overlap)

    def describe(self, part: Contribution, flips: IntArray) -> tuple[float, str]:
        """Weight and text of the pair that flipped most or is worst solved.

        Args:
            part: Last iterate.
            flips: How often `Contribution.status` changed, shape (2, n).
        """
        rows = np.abs(self.law_rows(part)).max(axis=1)
        weight = np.where(np.isnan(rows), np.inf, rows) * (1 + flips.sum(axis=0))
        i = int(np.argmax(weight))
        touch, slide = (int(n) for n in flips[:, i])
        text = f"contact {self.name!r}: {self.place(i)}, {touch} active-set flips"
        if slide:
            text += f" and {slide} between stick and slip"
        if touch + slide >= _CYCLE:
            states = "stick and slip" if slide > touch else "contact and none"
            remedy = "try steps of another length"
            if self._held[i]:
                # Several such nodes on one facet share the little that its nodes can give way.
                remedy = "its motion is prescribed, so make its surface the master"
            elif np.isinf(self.pair.friction):
                remedy = "infinite friction may let it neither stick nor leave: try friction=1e4"
            text += f": it flips between {states} and {UNSETTLED}{remedy}"
        return float(weight[i]), text
