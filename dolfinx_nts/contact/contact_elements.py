"""What contact of any kind has in common as elements of a step.

The elements of a step share them, whatever the master is: a node's gap, slip and contact force come
from `_element`, which facets and obstacles each have of their own, what they obey from
`contact_laws`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact.contact_laws import ContactLaws, Contribution
from dolfinx_nts.contact.coulomb import Slip
from dolfinx_nts.interaction.elements import over
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels import compiled_law
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Changes of one node's state in a step that are no search any more.
_CYCLE = 8
#: What messages say of such a node; what follows says what to do.
UNSETTLED = "settles in neither; "
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactElements(ContactLaws):
    """The candidates of one pair in one step, with the rule of the integrator; see `Elements`."""

    # ---- what a kind of master has of its own
    @property
    def master_nodes(self) -> Points | None:
        """Nodes of the master's body that each pair depends on, if it has a body."""
        raise NotImplementedError

    @property
    def immovable(self) -> BoolArray:
        """Whether all coordinates of the pairs' masters are prescribed, shape (n,)."""
        raise NotImplementedError

    @property
    def extent(self) -> float:
        """Length beside the displacements whose rounding enters the gaps [m]."""
        return self.pair.extent

    def gap(self, x: FloatArray) -> FloatArray:
        """Gap [m] of slaves and control points at t_{n+1}, (n, nc + 1, 3) -> (n,)."""
        raise NotImplementedError

    def external_work(self, part: Contribution) -> float:
        """h^2/2 times the work that enters the bodies through the contact [kg m^2]."""
        return 0.0

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """Augmented unknowns that fit predicted nodes (n, k, 3), as of `reference`."""
        return np.empty((self.num_elements, 0))

    @property
    def _control_weights(self) -> FloatArray | None:
        """Weights of the masters' nodes in the control points, (n, control, k); None if one."""
        return None

    def _element(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """Residual and tangent in [kg m] and [m], gap and slip, before the laws of contact."""
        raise NotImplementedError

    # ---- what they share
    @property
    def name(self) -> str:
        """Name for messages."""
        return self.pair.name

    @property
    def num_coordinates(self) -> int:
        """Coordinates of the nodes that slave and master of a pair depend on."""
        master = self.master_nodes
        slave_nodes: int = self.pair.slave.material.nodes.shape[1]
        return 3 * (slave_nodes + (0 if master is None else master.nodes.shape[1]))

    @property
    def widths(self) -> dict[str, int]:
        """Own unknowns of a pair by field."""
        return {"augmented": self.num_augmented, "constraints": self.num_constraints}

    @property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which, shape (m, m)."""
        pattern = np.zeros((self.num_constraints,) * 2, dtype=bool)
        pattern[0, 0] = True
        pattern[self._num_normal :, 0] = True
        pattern[self._num_normal :, self._num_normal :] = True
        return pattern

    @property
    def bilateral(self) -> bool:
        """Contact does not pull."""
        return False

    @property
    def force_scale(self) -> float:
        """Unknowns are forces."""
        return 1.0

    def part(self, chosen: BoolArray) -> ContactElements:
        """Return the pairs chosen by a mask of shape (n,), itself if that chooses all."""
        return self if chosen.all() else replace(self, **self._of_pairs(chosen))

    def _of_pairs(self, chosen: BoolArray) -> dict[str, Any]:
        """What some of the pairs are made of, by attribute."""
        return {
            "candidates": self.candidates.part(chosen),
            "x0": self.x0[chosen],
            "scale": self.scale[chosen],
            "before": self._before_of(chosen),
            "overlap": (
                self.overlap[chosen] if isinstance(self.overlap, np.ndarray) else self.overlap
            ),
        }

    @cached_property
    def _nodes(self) -> list[Points]:
        """Nodes that the slaves depend on, and those of the masters."""
        master = self.master_nodes
        slave = self.pair.slave.material.part(self._slave_points)
        return [slave] if master is None else [slave, master]

    def points(self) -> tuple[IntArray, ...]:
        """Global coordinates of the slaves' nodes (n, 3 k) and of the masters'."""
        return tuple(nodes.flat() for nodes in self._nodes)

    def dofs(self) -> tuple[IntArray, ...]:
        """The same with -1 where they are prescribed."""
        return tuple(nodes.flat(prescribed=-1) for nodes in self._nodes)

    def reference(self) -> FloatArray:
        """Reference values of these nodes [m], places in the pair's frame, shape (n, k, 3)."""
        return self._reference

    @cached_property
    def _reference(self) -> FloatArray:
        origin = self.pair.origin
        each = [n.reference - np.where(n.places[:, :, None], origin, 0.0) for n in self._nodes]
        return np.concatenate(each, axis=1)

    @cached_property
    def _map(self) -> FloatArray | None:
        """Weights of the nodes in slave and control points, (n, control + 1, k); None if one."""
        slave, control = self._nodes[0], self._control_weights
        if slave.are_nodes and control is None:
            return None
        if control is None:
            shape = (self.num_elements, self.num_control, self.num_control)
            control = np.broadcast_to(np.eye(self.num_control), shape)
        own = slave.nodes.shape[1]
        both = np.zeros((self.num_elements, self.num_control + 1, own + control.shape[2]))
        both[:, 0, :own], both[:, 1:, own:] = slave.weights, control
        return both

    def _control(self, y: FloatArray) -> FloatArray:
        """Slave and control points (n, control + 1, 3) from nodes (n, k, 3) [m]."""
        x: FloatArray = y if self._map is None else np.matmul(self._map, y)
        return x

    def _to_nodes(self, part: Contribution) -> Contribution:
        """The transpose of `_control`: forces and tangents of nodes from those of points."""
        if self._map is None:
            return part
        residual, tangent = compiled_law.to_nodes(self._map, part.residual, part.tangent)
        return part._replace(residual=residual, tangent=tangent)

    def input_node(self, i: int) -> int:
        """Number of a pair's slave node in the user's mesh."""
        return int(self.pair.slave.original[self._slave_points[i]])

    def multipliers(self, normal: FloatArray, tangential: FloatArray) -> FloatArray:
        """Multipliers of given contact forces on the slaves [N], shape (n, constraints).

        Args:
            normal: p_N, shape (n,).
            tangential: Friction, shape (n, 3).
        """
        out = np.zeros((self.num_elements, self.num_constraints))
        out[:, 0] = -normal
        if self.num_tangential:
            out[:, -2:] = -np.einsum("nai,ni->na", self._tangents, tangential)
        return out

    def rows(self, k: Contribution, name: str) -> FloatArray:
        """The residual's rows of "augmented" unknowns or "constraints", shape (n, width)."""
        start = self.num_coordinates
        middle = start + self.num_augmented
        return k.residual[:, start:middle] if name == "augmented" else k.residual[:, middle:]

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> Contribution:
        """Residual and tangent of the pairs. Collective, and reached by all if an obstacle raises.

        Args:
            x: Nodes of slave and master at t_{n+1} [m], shape (n, k, 3).
            own: "augmented": facet size times (d, f) [m], shape (n, 5) or (n, 0); "constraints":
                h^2/2 lambda of the scaled constraints, and of lambda_T over the facet size, over
                `scale` [m], shape (n, constraints).
        """
        none = np.empty(0), None, np.empty((0, 1))
        if not self.num_elements:
            self._together(*none)
            return self._nothing()
        multiplier = self.scale[:, None] * own["constraints"]
        x = self._control(x)
        try:
            residual, tangent, gap, slip = self._element(x, own["augmented"], multiplier)
        except Exception:  # any of an obstacle of the user's; the other ranks wait
            self._together(*none)
            raise
        gap = gap + self.overlap
        residual[:, self._num_places + self.num_augmented] = gap
        together = self._together(gap, slip, multiplier)
        part = self._laws(x, residual, tangent, gap, slip, multiplier, together)
        return self._to_nodes(part)

    def _nothing(self) -> Contribution:
        """Return the part of no pairs."""
        size = self.num_coordinates + self.num_augmented + self.num_constraints
        none, slip = np.zeros(0), np.zeros((0, self.num_tangential))
        off = none.astype(bool)
        return Contribution(
            np.zeros((0, size)), np.zeros((0, size, size)), np.zeros((0, self.num_constraints)),
            none, off, off, slip, none, np.zeros((0, 3)), np.zeros((0, 3)),
            np.zeros((0, self.num_control + 1, 3)), np.zeros((0, 3)),
            np.zeros((0, self.num_constraints)),
        )  # fmt: skip

    # ---- what a step asks of elements once it is solved, or is not
    def largest(self, part: Contribution) -> list[float]:
        """Sizes that `ratios` compares: augmented rows, gaps, multipliers and scale."""
        gaps = self.rows(part, "constraints") / self.scale[:, None]
        arrays = (self.rows(part, "augmented"), gaps, part.multiplier, self.scale)
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
            largest: `largest` over all ranks.
            motion: Largest motion of the step [m].
            rounded: Length whose rounding is in all positions [m].
            rtol: Tolerance of Newton's method.
        """
        augmented, gap, force, scale = largest.tolist()
        limit = rtol * motion + 8 * _EPS * (rounded + self.extent)
        found = {f"{self.name} constraints": over(gap, limit)}
        if self.num_augmented:
            limit = rtol * max(force, scale * motion)
            found[f"{self.name} (d, f)"] = over(augmented, limit)
        return found

    def sticks(self, part: Contribution) -> BoolArray:
        """Which pairs have stuck in a solved step, shape (n,).

        Rounding alone tells on which side of Coulomb's bound a node is that rests at it, so a slip
        counts from a part of the facet on, see `Coulomb.still`.
        """
        if not self.num_tangential:
            return part.stick
        still: BoolArray = part.active & (part.distance <= self.coulomb.still)
        return part.stick | still

    def ledger(self, part: Contribution, factor: float) -> dict[str, float]:
        """Works and counts of an accepted step on this rank.

        The contact defect is -sum lambda_N g_0: what activation loses and what a change of facet
        gains or loses. The massless defect is sum lambda_N g_1: what a massless node gains that
        leaves its facet within the step, with half the force of t_n, lambda_T . (f_1 - f_0)
        included. Friction dissipates the sum of lambda_T . (f_1 - f_0) over the others.

        Args:
            part: Solution of the step.
            factor: What the step equations multiply forces by [s^2].

        Returns:
            external_work, friction_dissipation, contact_defect, massless_defect [J], active, stick,
            slip.
        """
        slipping, gone = part.active & ~part.stick, ~part.active & self._massless
        dissipation, counts = 0.0, (0.0, 0.0)
        if self.num_tangential:
            dissipation = float((part.multiplier[:, -2:] * part.slip)[slipping].sum())
            sticking = self.sticks(part)
            counts = float(sticking.sum()), float((part.active & ~sticking).sum())
        defect = -float(part.multiplier[:, 0] @ self.candidates.gap)
        # Where it is closed, the gap is the solver's tolerance.
        left = float((part.multiplier[:, 0] * part.gap)[gone].sum())
        if self.num_tangential:
            left += float((part.multiplier[:, -2:] * part.slip)[gone].sum())
        return {
            "external_work": self.external_work(part) / factor,
            "friction_dissipation": dissipation / factor,
            "contact_defect": defect / factor,
            "massless_defect": left / factor,
            "active": float(part.active.sum()),
            "stick": counts[0],
            "slip": counts[1],
        }

    def moment(self, part: Contribution, theta: float) -> FloatArray:
        """Moment of the forces on the slaves about the origin [kg m^2], this rank's part, (3,).

        Args:
            part: Solution of the step.
            theta: Where between t_n and t_{n+1} the forces act.
        """
        start = self.x0[:, 0]
        x = self.pair.origin + start + theta * (part.place - start)
        total: FloatArray = cross(x, part.force).sum(axis=0)
        return total

    @property
    def gap_row(self) -> int:
        """Row of the gap in the residual of a pair."""
        return self.num_coordinates + self.num_augmented

    def wrenches(self, part: Contribution, x: FloatArray, on: IntArray) -> list[FloatArray]:
        """What unit forces that open gaps at t_{n+1} do to each body, if both are rigid.

        Args:
            part: Contribution at an iterate.
            x: Nodes at t_{n+1} [m], shape (n, k, 3).
            on: Numbers of the pairs.

        Returns:
            Of each body force [-] and moment about its places' middle [m], where these may move it,
            shape (len(on), 6).
        """
        rows = part.tangent[on, self.gap_row, : self.num_coordinates] / self.scale[on, None]
        y, start, found = x[on], 0, []
        force = rows.reshape(y.shape)
        for side in self._nodes:
            here = slice(start, start + side.nodes.shape[1])
            given = y[:, here], force[:, here], side.places[on], side.fixed[on]
            found.append(compiled_law.wrenches(*given))
            start = here.stop
        return found

    def gap_slopes(self, part: Contribution) -> tuple[FloatArray, FloatArray]:
        """Derivative of active gaps at t_{n+1} by the nodes (n, coordinates), and normals (n, 3).

        Where a gap is closed, a change of the foot or of the normal does not change it.
        """
        width = self.num_coordinates
        gradient: FloatArray = part.tangent[:, self.gap_row, :width] / self.scale[:, None]
        slave = self._nodes[0]
        own = gradient[:, : 3 * slave.nodes.shape[1]].reshape(*slave.nodes.shape, 3)
        normal: FloatArray = (own * slave.places[:, :, None]).sum(axis=1)
        return gradient, normal

    def nodal_forces(self, part: Contribution) -> list[FloatArray]:
        """Forces on the points of the slave and of the master's surface, if it has a body [kg m].

        Args:
            part: Solution of the step.

        Returns:
            Of each surface this rank's part, shape (p, 3).
        """
        slave, master = self.pair.slave, self.pair.master
        on_slave = np.zeros((len(slave.points), 3))
        on_slave[self._slave_points] = -part.coupling[:, 0]
        if self.master_nodes is None:
            return [on_slave]
        force, patch = -part.coupling[:, 1:], self.candidates.patch
        if master.weights is not None:
            force = np.matmul(master.weights[patch].transpose(0, 2, 1), force)
        on_master = np.zeros((len(master.points), 3))
        np.add.at(on_master, master.patches[patch], force)
        return [on_slave, on_master]

    def gains(self, part: Contribution, factor: float) -> FloatArray:
        """Energy that each pair brings in by starting behind its facet [J], shape (n,)."""
        gain: FloatArray = part.multiplier[:, 0] * self.candidates.gap / factor
        return gain

    def history(self, part: Contribution, factor: float, old: ContactHistory) -> ContactHistory:
        """Return what the contact remembers of an accepted step."""
        new = ContactHistory.of_start(len(old.force))
        node = self.candidates.node
        new.facet[node], new.gap[node] = self.candidates.facet, part.gap - self.overlap
        new.stick[node] = self.sticks(part)
        new.force[node] = -np.where(part.active, part.end[:, 0], 0.0) / factor
        new.tangential[node] = self._tangential_at_end(part, old.tangential[node], factor)
        new.slip[:] = old.slip
        new.slip[node] += part.distance
        return new._replace(overlap=old.overlap)

    def _tangential_at_end(
        self, part: Contribution, before: FloatArray, factor: float
    ) -> FloatArray:
        """Friction force at t_{n+1} [N], shape (n, 3), from that at t_n."""
        of_step: FloatArray = part.tangential / factor
        at_end = np.where(part.active[:, None], 2.0 * of_step - before, 0.0)
        return np.where(self._massless[:, None], at_end, of_step)

    def place(self, i: int) -> str:
        """Return where a pair is, for messages."""
        return f"node {self.input_node(i)}"

    def describe(self, part: Contribution, flips: IntArray) -> tuple[float, str]:
        """Weight and text of the pair that flipped most or is worst solved.

        Args:
            part: Last iterate.
            flips: How often `Contribution.status` changed, shape (2, n).
        """
        rows = np.abs(part.residual[:, self.num_coordinates :]).max(axis=1)
        weight = np.where(np.isnan(rows), np.inf, rows) * (1 + flips.sum(axis=0))
        i = int(np.argmax(weight))
        touch, slide = (int(n) for n in flips[:, i])
        text = f"contact {self.name!r}: {self.place(i)}, {touch} active-set flips"
        if slide:
            text += f" and {slide} between stick and slip"
        if touch + slide >= _CYCLE:
            states = "stick and slip" if slide > touch else "contact and none"
            remedy = "try steps of another length"
            if not self._free[i, 0].any():
                # Several such nodes on one facet share the little that its nodes can give way.
                remedy = "its motion is prescribed, so make its surface the master"
            elif np.isinf(self.pair.friction):
                remedy = "infinite friction may let it neither stick nor leave: try friction=1e4"
            text += f": it flips between {states} and {UNSETTLED}{remedy}"
        return float(weight[i]), text
