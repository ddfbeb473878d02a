"""Dry friction of ball joints and of planes: what slips has a direction (theory section 13).

Unlike that of a hinge it acts on several measures c at once, such as the components of a turn. They
stick, c_1 = c_0, up to a bound of the size of their forces D, or these are the bound against the
slip c_1 - c_0. Each c is quadratic in the bodies' coordinates, and its gradient in the middle a
discrete one: momenta are kept, and the work is D . (c_1 - c_0).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dolfinx_nts.interaction.carried import Carried, no_memory
from dolfinx_nts.interaction.constraint_elements import SHIFT, TINY
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.kinematics import Kinematics
from dolfinx_nts.interaction.measures import Measure
from dolfinx_nts.interaction.point_elements import EveryStep, PointElements
from dolfinx_nts.joints.between import OfTwo
from dolfinx_nts.joints.laws import TIE, Bound, JointFriction
from dolfinx_nts.parallel import Asking
from dolfinx_nts.state import State
from dolfinx_nts.types import BoolArray, FloatArray

#: Signs of the components of a cross product.
_CROSS = np.zeros((3, 3, 3))
_CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]], _CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0, -1.0


class Turn:
    """How A has turned against B since a step began: sin(angle) times the axis.

    Of six vectors, three directions of each that coincide at the start. With B's turned to a_1,
    a_2, a_3 as the step begins, b_1, b_2, b_3, it is the sum of b_i x a_i over 2 in these.
    """

    groups: tuple[int, ...] = (3,)

    @staticmethod
    def forms(start: FloatArray) -> FloatArray:
        """Forms S of c_k = p . S_k p/2, (n, 3, 6, 6), from the vectors p at t_n, (n, 6, 3)."""
        turned = np.einsum("nix,njx->nij", start[:, :3], start[:, 3:])
        forms = np.zeros((len(start), 3, 6, 6))
        forms[:, :, :3, 3:] = 0.5 * np.einsum("kij,njm->nkim", _CROSS, turned)
        return forms + forms.swapaxes(2, 3)


class Across:
    """The way of a point in a plane, (m_1 . r, m_2 . r) [m], of the vectors m_1, m_2 and r."""

    groups = (2,)

    @staticmethod
    def forms(start: FloatArray) -> FloatArray:
        """As of `Turn`, shape (n, 2, 3, 3)."""
        forms = np.zeros((len(start), 2, 3, 3))
        forms[:, [0, 1], [0, 1], 2] = 1.0
        return forms + forms.swapaxes(2, 3)


class DirectedPart(NamedTuple):
    """What friction with a direction contributes, see `Part`.

    Attributes:
        residual: Rows of coordinates and of multipliers [kg m].
        tangent: Its derivative.
        status: What sticks of its groups, shape (groups, n).
        memory: D, and the vectors where the slip began, shape (n, m + 3 v), or (n, m + 3 v + c)
            with the memory of `Carried`.
        work: Of D against the motion of the step [J], shape (n,).
        spread: Of a law that depends on a contact, that of `PressingLoad`.
    """

    residual: FloatArray
    tangent: FloatArray
    status: BoolArray
    memory: FloatArray
    work: FloatArray
    spread: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class DirectedElements(PointElements):
    """Friction with a direction in a step, on the rank that has it.

    Attributes:
        measure: The vectors that the measures are of. Its kind has `groups`, how many measures at
            a time have a bound and a direction in common, and their `forms`.
        law: The bound of the size of their forces.
        step: The step.
        y0: Nodal vectors at t_n [m], shape (n, k, 3).
        since: The vectors where the slip began, shape (n, v, 3).
        before: D at t_n, shape (n, m).
        scale: Force per motion in the units of the step, shape (n,).
        carried: Of a law that depends on what its joint carries, the memory of `Carried`.
    """

    measure: Measure
    law: Any
    step: Step
    y0: FloatArray
    since: FloatArray
    before: FloatArray
    scale: FloatArray
    carried: FloatArray

    @property
    def bilateral(self) -> bool:
        """Its forces have a bound."""
        return False

    @cached_property
    def widths(self) -> Mapping[str, int]:
        """A multiplier for each measure."""
        return {"augmented": 0, "constraints": sum(self.measure.kind.groups)}

    @property
    def force_scale(self) -> FloatArray:
        """Unknowns are lengths: h^2/2 D, or D in statics, over this."""
        return self.scale * self.measure.length

    @cached_property
    def forms(self) -> FloatArray:
        """Of the measures in this step, see `Turn.forms`."""
        found: FloatArray = self.measure.kind.forms(self.since)
        return found

    def evaluate(
        self, x: FloatArray, own: Mapping[str, FloatArray]
    ) -> DirectedPart | Asking[DirectedPart]:
        """Residual and tangent."""
        law: Bound = self.law
        if not law.by_load:
            bound = np.broadcast_to(law.bound, (len(x), 1))
            return self._obeyed(x, own["constraints"], self.forms, bound)
        inertia, factor = self.step.integrator.inertia, self.step.factor
        carried = Carried.of(own["load"] / factor, self.carried, inertia=inertia)
        load = np.linalg.norm(carried.force, axis=1)[:, None]
        across = carried.share * carried.force / np.maximum(load, TINY) * own["by_unknowns"]
        bound, slopes = law.by_load * load, law.by_load * across[:, None]
        part = self._obeyed(x, own["constraints"], self.forms, bound, slopes)
        return part._replace(memory=np.hstack([part.memory, carried.memory]))

    def _obeyed(
        self, x: FloatArray, force: FloatArray, forms: FloatArray, bound: FloatArray,
        slopes: FloatArray | None = None,
    ) -> DirectedPart:  # fmt: skip
        """What `evaluate` returns.

        Args:
            x: As of `evaluate`.
            force: The multipliers [m], shape (n, m).
            forms: Of the measures, see `Turn.forms`.
            bound: Of each measure's group, shape (n, m) or (n, 1).
            slopes: Derivatives of the bound times the factor of the step by the unknowns of others,
                shape (n, m, columns) or (n, 1, columns).
        """
        measure, factor, unit = self.measure, self.step.factor, self.force_scale
        size, theta, (n, m) = self.num_coordinates, self.step.integrator.taken_at, force.shape
        start, end = measure.vectors(self.y0), measure.vectors(x)
        share = 0.5 if theta is None else theta
        mean, after = (
            measure.weights[:, None].swapaxes(2, 3) @ (forms @ p[:, None])
            for p in (start + share * (end - start), end)
        )
        moved, before = (
            0.5 * np.einsum("nvi,nkvw,nwi->nk", p, forms, p) for p in (end, self.since)
        )
        slip = measure.length[:, None] * (moved - before)
        most = bound / unit[:, None] * factor
        trial = force + slip
        of = np.repeat(np.arange(len(measure.kind.groups)), measure.kind.groups)
        alike = (of[:, None] == of).astype(float)
        reach = np.sqrt(np.square(trial) @ alike)
        stick = np.broadcast_to(reach <= (1.0 + TIE) * most, (n, m))
        way = trial / np.maximum(reach, TINY)
        # How the bound's force turns with the trial.
        turns = np.where(stick, 0.0, most / np.maximum(reach, TINY))[:, :, None] * (
            np.eye(m) - way[:, :, None] * way[:, None] * alike
        )
        value = np.where(stick, slip, force - most * way)
        by_slip = np.where(stick[:, :, None], np.eye(m), -turns)
        # What sticks may be held by another joint, too.
        by_force = np.where(stick[:, :, None], -SHIFT, 1.0) * np.eye(m) - turns
        residual = np.zeros((n, size + m))
        tangent = np.zeros((n, size + m, size + m))
        along = mean.reshape(n, m, size)
        residual[:, :size] = unit[:, None] * np.einsum("nk,nka->na", force, along)
        residual[:, size:] = self.scale[:, None] * value
        bend = share * np.einsum("nk,nkvw->nvw", force, forms)
        wide = 3 * end.shape[1]
        inner = np.einsum("nvw,ij->nviwj", bend, np.eye(3)).reshape(n, wide, wide)
        tangent[:, :size, :size] = unit[:, None, None] * measure.bent_at_nodes(inner)
        tangent[:, :size, size:] = unit[:, None, None] * along.swapaxes(1, 2)
        tangent[:, size:, :size] = unit[:, None, None] * (by_slip @ after.reshape(n, m, size))
        tangent[:, size:, size:] = self.scale[:, None, None] * by_force
        if slopes is not None:
            by_bound = np.where(stick, 0.0, -way) / measure.length[:, None]
            more = np.zeros((n, size + m, slopes.shape[2]))
            more[:, size:] = by_bound[:, :, None] * slopes
            tangent = np.concatenate([tangent, more], axis=2)
            tangent = np.pad(tangent, ((0, 0), (0, slopes.shape[2]), (0, 0)))
        pull = unit[:, None] / factor * force
        memory = np.concatenate([pull, self.since.reshape(n, wide)], axis=1)
        if theta is None or not self.step.integrator.inertia:
            moved = moved - before
        else:
            moved = np.einsum("nka,na->nk", along, (x - self.y0).reshape(n, size))
        work = np.einsum("nk,nk->n", pull, moved)
        _, first = np.unique(of, return_index=True)
        return DirectedPart(residual, tangent, stick[:, first].T, memory, work)

    def ledger(self, part: DirectedPart, factor: float) -> dict[str, float]:
        """What it takes [J]."""
        return {"friction_dissipation": float(part.work.sum())}

    def largest(self, part: DirectedPart) -> list[float]:
        """The largest row of its multipliers [m], and its extent."""
        rows = np.abs(self.rows(part, "constraints")) / self.scale[:, None]
        return [0.0, float(rows.max(initial=0.0)), 0.0, self.extent]

    def describe(self, part: Any, flips: Any) -> tuple[float, str]:
        """Its rows, and how often it stuck or slipped."""
        weight, _ = super().describe(part, flips)
        text = f"{self.name!r}"
        return weight, f"{text}, flips {int(flips.sum())} times" if flips.any() else text


class DirectedCoupling(EveryStep):
    """Makes `DirectedElements` in every step, and remembers forces and where the slip began.

    Args:
        bodies: Numbers of its bodies in the system.
        joint: Its scene's part: name, measure and law.
    """

    #: Class of its elements.
    _of: ClassVar[type[DirectedElements]] = DirectedElements

    def __init__(self, bodies: tuple[int, ...], joint: Any) -> None:
        super().__init__(bodies, self._elements, lambda part: part.memory)
        self._joint = joint

    def _elements(self, step: Step, history: FloatArray) -> DirectedElements:
        joint, measure = self._joint, self._joint.measure
        y0 = measure.reference() + measure.nodal([step.state.u[b] for b in self.bodies[0]])
        m, p0 = sum(measure.kind.groups), measure.vectors(y0)
        _, begun, carried = np.split(history, [m, m + 3 * p0.shape[1]], axis=1)
        since = p0 if step.dt else begun.reshape(p0.shape)
        scale = min(step.mean_scale(side.body) for side in measure.sides)
        return self._of(
            name=joint.name, sides=measure.sides, measure=measure, law=joint.law, step=step, y0=y0,
            since=since, before=history[:, :m], scale=np.full(len(y0), scale),
            carried=carried,
        )  # fmt: skip

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """The multipliers of the last step."""
        batch = self.elements[k]
        guess: FloatArray = batch.step.factor / batch.force_scale[:, None] * batch.before
        return guess

    def kinematics(self, state: State, dt: float) -> list[Kinematics | None]:
        """A start need not fit them."""
        return [None] * len(self.elements)


class DirectedFriction(OfTwo):
    """Friction of a joint on several of its measures, with a column of reactions of its own.

    Args:
        joint: The joint, whose first `bearing` multipliers are the force that it carries.
        argument: Name of what follows.
        friction: As given by the user.
        kind: `Turn` or `Across`.
        vectors: What its measures are of.
        length: What makes a length of a measure [m].

    Raises:
        TypeError: friction is no `JointFriction`.
        ValueError: Its radius is missing, or is given where nothing turns.
    """

    mid_step = True

    def __init__(
        self, joint: Any, argument: str, friction: Any, kind: type[Any], vectors: Sequence[Any],
        length: float,
    ) -> None:  # fmt: skip
        if not isinstance(friction, JointFriction):
            raise TypeError(
                f"{argument}={friction!r}: pass nts.JointFriction(bound=...), or "
                "nts.JointFriction(coefficient=..., radius=...)"
            )
        super().__init__(joint.ends, f"{joint.name} {argument.replace('_', ' ')}")
        self.of, self._here, self.numbers = joint, joint._here, joint.numbers
        self.law = friction.law(argument, kind is Turn)
        self.settings = {"bodies": self._names, **self.law.settings}
        n = self._here
        weights, constants = (
            np.array([[getattr(v, name) for v in vectors]])[:n] for name in ("weights", "constant")
        )
        sides = tuple(side.select(slice(n)) for side in joint.sides)
        self.measure = Measure(kind, sides, weights, constants, np.full(n, length))

    def start(self) -> FloatArray:
        """No force."""
        found = at_start(self.measure)
        if not self.law.by_load:
            return found
        return np.hstack([found, no_memory(len(found), self.of.bearing)])

    def coupling(self, bodies: tuple[int, ...]) -> DirectedCoupling:
        """What makes its elements in a run, and remembers its forces."""
        return DirectedCoupling(bodies, self)


def at_start(measure: Measure) -> FloatArray:
    """What `DirectedElements` remember before the first step."""
    p = measure.vectors(measure.reference())
    none = np.zeros((len(p), sum(measure.kind.groups)))
    return np.concatenate([none, p.reshape(len(p), 3 * p.shape[1])], axis=1)
