"""What contact of any kind has in common in a step: the laws of the gap and of friction.

The elements of a step share them, whatever the master is: a node's gap, slip and contact force come
from `_element`, which facets and obstacles each have of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.bodies.points import Points
from dolfinx_nts.constraints import SHIFT
from dolfinx_nts.contact.pair import Candidates, ContactPair
from dolfinx_nts.elements import over
from dolfinx_nts.kernels import nts_element
from dolfinx_nts.kernels.friction import length, return_map

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
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
#: Coefficient from which on friction counts as strong.
_STRONG = 1.0
#: Pull over friction up to which a node that sticks is let slip before it is let go.
_PULL = 0.01
#: Square of the part of a motion that counts as none.
_IMMOVABLE = 1e-12
#: Prescribed slip over the size of the facet that counts as none.
_STILL = 1e-10


#: Largest ratio of normal forces by which friction of a rigid body's nodes is divided.
_UNEVEN = 100.0
#: Changes of one node's state in a step that are no search any more.
_CYCLE = 8
_EPS = float(np.finfo(float).eps)


class Contribution(NamedTuple):
    """Step equations of the pairs at an iterate, all rows [kg m] for unknowns in [m].

    Attributes:
        residual: Shape (n, r), r = coordinates + augmented + constraints.
        tangent: Shape (n, r, r).
        multiplier: h^2/2 lambda of the constraints [kg m], shape (n, constraints).
        gap: g_N at t_{n+1} [m], shape (n,).
        active: Active set of the iterate, shape (n,).
        stick: Active pairs that stick, shape (n,).
        slip: Facet size times f_1 - f_0 [m], shape (n, 2); (n, 0) without friction.
        distance: Length of the slip in the metric [m], shape (n,); 0 where not active.
        force: Contact force on the slave [kg m], shape (n, 3).
        tangential: The same less its part along the normal.
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

    @property
    def status(self) -> BoolArray:
        """What Newton's method may flip: active and stick, shape (2, n)."""
        return np.stack([self.active, self.stick])


class ContactHistory(NamedTuple):
    """What a contact remembers from step to step, of each slave node in this rank's share.

    Attributes:
        facet: Facet in the last step, or -1, shape (n,).
        force: Contact force p_N [N], >= 0.
        gap: Gap [m], infinite where a node was no candidate.
        tangential: Friction force [N], shape (n, 3).
        stick: Whether it sticks.
        slip: Distance that it has slipped since the start [m].
        followed: Whether it is not known to have passed by the surface's edge.
    """

    facet: IntArray
    force: FloatArray
    gap: FloatArray
    tangential: FloatArray
    stick: BoolArray
    slip: FloatArray
    followed: BoolArray

    @classmethod
    def of_start(cls, n: int) -> ContactHistory:
        """Of n nodes that have not touched yet."""
        off, none = np.zeros(n, dtype=bool), np.zeros(n)
        return cls(
            np.full(n, -1), none, np.full(n, np.inf), np.zeros((n, 3)), off, none.copy(), ~off
        )


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


class Slip(NamedTuple):
    """Slip and metric in facet sizes with their derivatives by the unknowns of the element."""

    value: FloatArray
    gradient: FloatArray
    metric: FloatArray
    metric_gradient: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactElements:
    """The candidates of one pair in one step, with the rule of the integrator.

    Attributes:
        pair: Its surfaces.
        candidates: This rank's slave nodes and their facets.
        rule: "direct" for the midpoint rule, else the discrete gradient.
        condense: Whether (d, f) and their multipliers are eliminated pair by pair.
        x0: Slave, and what the master is interpolated from, at t_n [m], (n, control + 1, 3).
        scale: Force per motion of the slaves in the units of the step equations, shape (n,): the
            nodal mass [kg] in dynamics; scales multipliers.
        theta: Where between t_n and t_{n+1} the direct rule takes the contact force.
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
    rounding: float = 0.0
    force_rounding: float = 0.0
    bounded: bool = False
    lets_slip: bool = False

    # ---- what a kind of master has of its own
    @property
    def num_control(self) -> int:
        """Points that the master is interpolated from."""
        raise NotImplementedError

    @property
    def num_augmented(self) -> int:
        """Unknowns d and f per pair."""
        return 0

    @property
    def _num_normal(self) -> int:
        """Constraints per pair but those of friction; that of the gap comes first."""
        return 1

    @property
    def master_nodes(self) -> Points | None:
        """Nodes of the master's body that each pair depends on, if it has a body."""
        raise NotImplementedError

    @property
    def _master_fixed(self) -> BoolArray:
        """Which coordinates of the masters' points are prescribed, shape (n, points, 3)."""
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
    def foot(self) -> FloatArray:
        """Weights of the control points in the foot at t_n, shape (n, nc)."""
        raise NotImplementedError

    @property
    def point_foot(self) -> FloatArray:
        """Weights of the masters' points in the foot at t_n, shape (n, points)."""
        return self.foot

    @property
    def _ease(self) -> FloatArray:
        """Motion of the foot per force on it [1/kg], shape (n,)."""
        raise NotImplementedError

    @property
    def _tangents(self) -> FloatArray:
        """Tangents of the master at t_n over their size [-], shape (n, 2, 3)."""
        raise NotImplementedError

    @property
    def _control_weights(self) -> FloatArray | None:
        """Weights of the masters' nodes in the control points, (n, control, k); None if one."""
        return None


    def _normal(self, x: FloatArray) -> FloatArray:
        """Normal where the contact force acts, shape (n, 3)."""
        raise NotImplementedError

    def _element(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, Slip | None]:
        """Residual and tangent in [kg m] and [m], gap and slip, before the laws of contact."""
        raise NotImplementedError

    # ---- what they share
    @property
    def name(self) -> str:
        """Of the contact, for messages."""
        return self.pair.name

    @property
    def num_elements(self) -> int:
        """Candidates on this rank."""
        return len(self.candidates.node)

    @property
    def num_coordinates(self) -> int:
        """Coordinates of the nodes that slave and master of a pair depend on."""
        master = self.master_nodes
        slave_nodes: int = self.pair.slave.material.nodes.shape[1]
        return 3 * (slave_nodes + (0 if master is None else master.nodes.shape[1]))

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

    def part(self, chosen: BoolArray) -> ContactElements:
        """Some of the pairs, shape (n,)."""
        found = self.candidates.part(chosen)
        return replace(
            self, candidates=found, x0=self.x0[chosen], scale=self.scale[chosen]
        )

    @cached_property
    def _slave_points(self) -> IntArray:
        """Positions of the slaves in their surface, shape (n,)."""
        points: IntArray = self.pair.slave.share[self.candidates.node]
        return points

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
        n, size = part.residual.shape
        points, turned = slice(self._num_places), self._map.transpose(0, 2, 1)
        places, width = (self.num_control + 1, 3), self.num_coordinates
        force = np.matmul(turned, part.residual[:, points].reshape(n, *places)).reshape(n, width)
        residual = np.concatenate([force, part.residual[:, self._num_places :]], axis=1)
        columns = part.tangent[:, :, points].reshape(n, size, *places)
        columns = np.matmul(turned[:, None], columns).reshape(n, size, width)
        tangent = np.concatenate([columns, part.tangent[:, :, self._num_places :]], axis=2)
        wide = tangent.shape[2]
        rows = np.matmul(turned, tangent[:, points].reshape(n, places[0], 3 * wide))
        tangent = np.concatenate(
            [rows.reshape(n, width, wide), tangent[:, self._num_places :]], axis=1
        )
        return part._replace(residual=residual, tangent=tangent)

    def input_node(self, i: int) -> int:
        """Number of a pair's slave node in the user's mesh."""
        return int(self.pair.slave.original[self._slave_points[i]])

    @property
    def gap_rounding(self) -> FloatArray:
        """Gap [m] that counts as none, or that a force which does would open, shape (n,)."""
        gap: FloatArray = np.maximum(self.rounding, self.force_rounding / self._yielding)
        return gap

    @property
    def _tangential_scale(self) -> float:
        return TANGENTIAL_SCALE if self.pair.yields else _OF_SHARED

    def _together(
        self, gap: FloatArray, slip: Slip | None, multiplier: FloatArray
    ) -> Together:
        """What pairs that share nodes need to know of each other. Collective."""
        if not self.pair.redundant:
            return Together(0.0, 0.0, 0.0)
        force = multiplier[:, 0]
        on = (force < 0.0) | (gap < 0.0)
        local = np.array([
            -force[on].clip(max=0.0).sum(), np.count_nonzero(force[on] < 0.0),
            np.abs(gap[on]).max(initial=0.0),
            0.0 if slip is None else np.abs(slip.value[on]).max(initial=0.0),
        ])  # fmt: skip
        ranks = np.array(self.pair.slave.body.comm.allgather(local))
        total, number = ranks[:, :2].sum(axis=0)
        extent = self.pair.extent
        return Together(total / max(number, 1.0), *(SHIFT + ranks[:, 2:].max(axis=0) / extent))

    def _lent_to_stick(
        self, together: Together, force: FloatArray, stick: BoolArray
    ) -> FloatArray:
        """Compliance lent to pairs that stick, so that friction divides as normal forces do.

        A brick at rest on a slope just below the limit needs that of all its nodes.
        """
        part = np.full(np.count_nonzero(stick), _UNEVEN)
        np.divide(together.force, -force[stick], out=part, where=force[stick] < 0.0)
        part = np.clip(part, 1.0 / _UNEVEN, _UNEVEN)
        lent: FloatArray = together.tangential * part / self.scale[stick]
        return lent

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

    @cached_property
    def _prescribed(self) -> BoolArray:
        """Axes along which slave and foot move as prescribed, shape (n, 3)."""
        square = np.column_stack([np.ones(self.num_elements), self.point_foot]) ** 2
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
            return np.zeros((self.num_elements, 3, 3))
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
        tangents = self._tangents
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
        motion = motion[:, 0] - np.einsum("nk,nki->ni", self.foot, motion[:, 1:])
        slip = np.einsum("nij,nj->ni", self._blocked, motion * self._prescribed)
        held: FloatArray = self.blocked.copy()
        held[np.abs(slip).max(axis=1) > _STILL * self.candidates.length] = 0.0
        return held

    def _c(self, slip: Slip, bound: FloatArray, held: FloatArray) -> FloatArray:
        """Scale c of the return map; nodes that are made to slip cannot stick, shape (n,)."""
        c = self._tangential_scale * self._yielding
        if self._endless:
            return c
        moved = self.blocked.any(axis=(1, 2)) & ~held.any(axis=(1, 2))
        s = slip.value[moved]
        distance = np.sqrt(np.einsum("na,nab,nb->n", s, slip.metric[moved], s))
        # Where solved, trial and slip are parallel, whatever c: the tangent needs no slope of c.
        c[moved] = np.maximum(c[moved], 2.0 * bound[moved] / distance)
        return c

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
        """Residual and tangent of the pairs; pure. Collective.

        Args:
            x: Nodes of slave and master at t_{n+1} [m], shape (n, k, 3).
            own: "augmented": facet size times (d, f) [m], shape (n, 5) or (n, 0); "constraints":
                h^2/2 lambda of the scaled constraints, and of lambda_T over the facet size, over
                `scale` [m], shape (n, constraints).
        """
        if not self.num_elements:
            self._together(np.empty(0), None, np.empty((0, 1)))
            return self._nothing()
        scale = self.scale[:, None]
        multiplier = scale * own["constraints"]
        x = self._control(x)
        residual, tangent, gap, slip = self._element(x, own["augmented"], multiplier)
        together = self._together(gap, slip, multiplier)
        part = self._laws(x, residual, tangent, gap, slip, multiplier, together)
        if slip is not None:
            normal = self._normal(x)
            along = np.einsum("ni,ni->n", part.force, normal)
            part.tangential[:] = part.force - along[:, None] * normal
        part = self._to_nodes(part)
        # With mass in rows and columns the whole matrix is in kg, whatever the size of the scene.
        rows = slice(part.residual.shape[1] - self.num_constraints, None)
        part.residual[:, rows] *= scale
        part.tangent[:, rows] *= scale[:, None]
        part.tangent[:, :, rows] *= scale[:, None]
        return part

    def _nothing(self) -> Contribution:
        """Of no pairs."""
        size = self.num_coordinates + self.num_augmented + self.num_constraints
        none, slip = np.zeros(0), np.zeros((0, self.num_tangential))
        off = none.astype(bool)
        return Contribution(
            np.zeros((0, size)), np.zeros((0, size, size)), np.zeros((0, self.num_constraints)),
            none, off, off, slip, none, np.zeros((0, 3)), np.zeros((0, 3)),
        )  # fmt: skip

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

        g_N = 0 where active, else lambda_N = 0; there Coulomb's law, else lambda_T = 0.
        """
        gap, force, scale = gap.copy(), multiplier[:, 0], self.scale
        active = -force - self._yielding * gap > self._none(slip, multiplier)
        off = ~active
        row = residual.shape[1] - self.num_constraints
        residual[off, row] = force[off] / scale[off]
        tangent[off, row] = 0.0
        tangent[off, row, row] = 1.0 / scale[off]
        tangent[active, row, row] -= together.normal / scale[active]
        part = Contribution(
            residual,
            tangent,
            multiplier,
            gap,
            active,
            stick=np.zeros_like(active),
            slip=np.empty((self.num_elements, 0)) if slip is None else slip.value,
            distance=np.zeros(self.num_elements),
            force=-residual[:, :3],
            tangential=np.zeros((self.num_elements, 3)),
        )
        if slip is not None:
            part.stick[:] = self._coulomb(x, residual, tangent, slip, multiplier, active, together)
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
        t, s = multiplier[:, -2:], self._tangential_scale * self._yielding[:, None] * slip.value
        friction = length(slip.metric, t)
        resists = friction**2 + np.einsum("na,na->n", t, s) > 0.0
        resists &= ~self.blocked.any(axis=(1, 2))
        # Without bound a node may stick by no normal force at all, whose rounding has any sign.
        return none - np.where(resists, (_NO_PULL if endless else _PULL) * friction, 0.0)

    def _coulomb(
        self,
        x: FloatArray,
        residual: FloatArray,
        tangent: FloatArray,
        slip: Slip,
        multiplier: FloatArray,
        active: BoolArray,
        together: Together,
    ) -> BoolArray:
        """Write the rows of lambda_T [m]; returns which pairs stick.

        Of a pair that carries nothing yet, the bound of strong friction, and that of a rigid body,
        is mu times the force that its depth asks for, as in the active set: with none it would have
        to slip at first, by the slope of the bound, which is mu for all active pairs. Points of a
        rigid body that rest would go on so, by rounding and against each other.
        """
        endless = self._endless
        largest = _BOUND if np.isinf(self.pair.friction) else _LARGEST
        mu, t = min(self.pair.friction, largest), multiplier[:, -2:]
        force, scale = multiplier[:, 0], self.scale[:, None, None]
        normal = residual.shape[1] - self.num_constraints
        new = active & (force >= 0.0) & (mu > _STRONG or self.pair.redundant)
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
        if together.tangential:
            lent = self._lent_to_stick(together, force, stick)
            rows[stick, :, -2:] -= np.eye(2) * lent[:, None, None]
        value[~active], rows[~active] = t[~active] / scale[~active, 0], 0.0
        rows[~active, :, -2:] = np.eye(2) / scale[~active]
        residual[:, -2:], tangent[:, -2:] = value, rows
        return stick

    # ---- what a step asks of elements once it is solved, or is not
    def largest(self, part: Contribution) -> list[float]:
        """Sizes that `ratios` compares: augmented rows, gaps, multipliers and scale."""
        gaps = self.rows(part, "constraints") / self.scale[:, None]
        arrays = (self.rows(part, "augmented"), gaps, part.multiplier, self.scale)
        return [float(np.abs(a).max(initial=0.0)) for a in arrays]

    def ratios(
        self, largest: FloatArray, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """Residuals of the pairs' own rows over what counts as converged.

        Args:
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

    def ledger(self, part: Contribution, factor: float) -> dict[str, float]:
        """Works and counts of an accepted step on this rank.

        The contact defect is -sum lambda_N g_0: what activation loses and what a change of facet
        gains or loses. Friction dissipates sum lambda_T . (f_1 - f_0).

        Args:
            part: Solution of the step.
            factor: What the step equations multiply forces by [s^2].

        Returns:
            external_work, friction_dissipation, contact_defect [J], active, stick, slip.
        """
        slipping = part.active & ~part.stick
        dissipation, counts = 0.0, (0.0, 0.0)
        if self.num_tangential:
            dissipation = float((part.multiplier[:, -2:] * part.slip)[slipping].sum())
            counts = float(part.stick.sum()), float(slipping.sum())
        defect = -float(part.multiplier[:, 0] @ self.candidates.gap)
        return {
            "external_work": self.external_work(part) / factor,
            "friction_dissipation": dissipation / factor,
            "contact_defect": defect / factor,
            "active": float(part.active.sum()),
            "stick": counts[0],
            "slip": counts[1],
        }

    def gains(self, part: Contribution, factor: float) -> FloatArray:
        """Energy that each pair brings in by starting behind its facet [J], shape (n,)."""
        gain: FloatArray = part.multiplier[:, 0] * self.candidates.gap / factor
        return gain

    def history(self, part: Contribution, factor: float, old: ContactHistory) -> ContactHistory:
        """What the contact remembers of an accepted step."""
        new = ContactHistory.of_start(len(old.force))
        node = self.candidates.node
        new.facet[node], new.gap[node] = self.candidates.facet, part.gap
        new.stick[node] = part.stick
        new.force[node] = -np.where(part.active, part.multiplier[:, 0], 0.0) / factor
        new.tangential[node] = part.tangential / factor
        new.slip[:] = old.slip
        new.slip[node] += part.distance
        return new

    def place(self, i: int) -> str:
        """Where a pair is, for messages."""
        return f"node {self.input_node(i)}"

    def describe(self, part: Contribution, flips: IntArray) -> tuple[float, str]:
        """Weight and text of the pair that flipped most or is worst solved.

        Args:
            part: Last iterate.
            flips: How often `Contribution.status` changed, shape (2, n).
        """
        rows = np.abs(part.residual[:, self.num_coordinates :]).max(axis=1)
        weight = np.nan_to_num(rows, nan=np.inf) * (1 + flips.sum(axis=0))
        i = int(np.argmax(weight))
        touch, slide = (int(n) for n in flips[:, i])
        text = f"contact {self.name!r}: {self.place(i)}, {touch} active-set flips"
        if slide:
            text += f" and {slide} between stick and slip"
        if max(touch, slide) >= _CYCLE:
            states = "stick and slip" if slide > touch else "contact and none"
            text += (
                f": it flips between {states} and settles in neither; try another dt"
                f"{', a smaller coefficient of friction' if self.pair.friction else ''} or a finer "
                "surface"
            )
        return float(weight[i]), text
