"""Measures of points under a law: springs, dampers, limits, friction, motors (section 22).

The work against the bodies is D (c_1 - c_0) whatever the law, and momenta are kept. Where an
integrator has no discrete gradients, the gradient is that of the place where it takes its forces.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from dolfinx_nts.interaction.carried import Carried
from dolfinx_nts.interaction.constraint_elements import SHIFT, TINY, largest_of_joints
from dolfinx_nts.interaction.elements import Step, Stopped
from dolfinx_nts.interaction.kinematics import Kinematics
from dolfinx_nts.interaction.measures import HoldingLaw, Measure, Move, holds
from dolfinx_nts.interaction.point_elements import EveryStep, PointElements
from dolfinx_nts.interaction.points import nodal
from dolfinx_nts.kernels import library
from dolfinx_nts.state import State
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

_EPS = float(np.finfo(float).eps)


class MeasuredPart(NamedTuple):
    """What a measure under a law contributes, see `Part`.

    Attributes:
        residual: Rows of coordinates and of the multiplier [kg m].
        tangent: Its derivative.
        status: What may flip, shape (1, n); (0, n) without multiplier.
        memory: The measure at t_{n+1}, and with a multiplier D and where the measure began, shape
            (n, 1) or (n, 3), or (n, 3 + c) with the memory of `Carried`.
        work: Of the force against the motion of the step [J], shape (n,).
        law: As it was obeyed.
    """

    residual: FloatArray
    tangent: FloatArray
    status: BoolArray
    memory: FloatArray
    work: FloatArray
    law: Any


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredElements(PointElements):
    """Measures of one kind under one law in a step, on the ranks that have them.

    Attributes:
        measure: The measures.
        law: A `Law`, or a `HoldingLaw`.
        step: The step.
        y0: Nodal vectors at t_n [m], shape (n, k, 3).
        drift: Their velocities where forces are taken without motion [m/s], shape (n, k, 3); of
            those without multiplier only.
        near: The measure at t_n, shape (n,).
        since: The measure where the step began, which a load step does in several solutions.
        before: D at t_n, shape (n,); none without multiplier.
        entry: Column of the ledger for the work that it takes, and its sign; "": none.
        scale: Force per motion in the units of the step, shape (n,); 0 without multiplier.
        rest: Reference values of the nodes [m], shape (n, k, 3).
        names: Of the joints that they are of.
        joint: Number of each element's joint among these, shape (n,).
        carried: Of a law that depends on what its joint carries, the memory of `Carried`.
    """

    measure: Measure
    law: Any
    step: Step
    y0: FloatArray
    drift: FloatArray
    near: FloatArray
    since: FloatArray
    before: FloatArray
    entry: tuple[str, float]
    scale: FloatArray
    rest: FloatArray
    names: Sequence[str]
    joint: IntArray
    carried: FloatArray

    @property
    def widths(self) -> Mapping[str, int]:
        """A multiplier where the law holds."""
        return {"augmented": 0, "constraints": int(holds(self.law))}

    @property
    def bilateral(self) -> bool:
        """A multiplier's law may let go."""
        return not holds(self.law)

    @property
    def force_scale(self) -> FloatArray:
        """Unknowns are lengths: h^2/2 D, or D in statics, over this."""
        return self.scale * self.measure.length

    def reference(self) -> FloatArray:
        """Reference values of the nodes [m], shape (n, k, 3)."""
        return self.rest

    @cached_property
    def extents(self) -> FloatArray:
        """Length beside the displacements whose rounding enters each [m], shape (n,)."""
        return np.abs(self.rest).max(axis=(1, 2), initial=0.0)

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> MeasuredPart:
        """Residual and tangent."""
        measure, theta, n = self.measure, self.step.integrator.taken_at, len(x)
        rate, factor = self.step.moments[0].rate, self.step.factor
        du, held, law = x - self.y0, holds(self.law), self.law
        leaning = leans(law)
        if leaning:
            inertia = self.step.integrator.inertia
            carried = Carried.of(own["load"] / factor, self.carried, inertia=inertia)
            load = np.linalg.norm(carried.force, axis=1)
            law = law.under(load)
        end = measure.vectors(x)
        if theta is None:
            (a, b), at_a = (self._start, end), self.near
            at_b = at_end = measure.kind.value(b, at_a)
        else:
            a = b = measure.vectors(self.y0 + theta * du)
            at_a = at_b = measure.kind.value(a, self.near)
            at_end = measure.kind.value(end, at_b)
        gradient = measure.kind.gradient(a, b, at_a, at_b)
        share = 1.0 if theta is None else 2.0 * theta
        size, none = self.num_coordinates, np.zeros(0)
        width = size + int(held)
        residual, tangent = np.zeros((n, width)), np.zeros((n, width, width))
        work = np.zeros(n)
        if not held:
            start = self.step.state.time
            move = Move(
                ends=(at_a, at_b),
                gradient=gradient,
                share=share,
                speed=measure.directed(self.drift + rate * du).reshape(gradient.mean.shape),
                rate=rate,
                time=self.step.dt if theta is None else None,
                when=start + (0.5 if theta is None else theta) * self.step.dt,
            )
            both = zip(law.pull(move), (n, gradient.mean.shape), strict=True)
            pull, slope = (np.broadcast_to(np.asarray(f, dtype=float), form) for f, form in both)
            status, memory = np.empty((0, n), dtype=bool), at_end[:, None]
            ends, of_row = none, (none,) * 4
        else:
            length, unit = measure.length, self.force_scale
            force = own["constraints"][:, 0]
            pull, slope = unit / factor * force, np.zeros_like(gradient.mean)
            row = law.row(length * self.since, length * at_end, force, unit / factor)
            ends = gradient.end
            if theta is not None:
                ends = measure.kind.gradient(end, end, at_end, at_end).end
            # What sticks at a limit is held twice.
            lent = np.where(row.by_force == 0.0, -SHIFT * row.by_end, row.by_force)
            of_row = unit, self.scale * row.value, unit * row.by_end, self.scale * lent
            # Of a force that is to vanish rounding is left.
            kept = np.where(row.value == force, 0.0, pull)
            status, memory = row.status[None], np.column_stack([at_end, kept, self.since])
        library.run(
            library.load().forces_along, size // 3, a.shape[1], held, share, factor, n,
            measure.weights, *gradient[:2], ends, pull, slope, *of_row, du, residual, tangent, work,
        )  # fmt: skip
        if leaning:
            way = carried.share * carried.force / np.maximum(load, TINY)[:, None]
            across = way * own["by_unknowns"]
            memory = np.hstack([memory, carried.memory])
            slope = self.scale * row.by_bound * law.by_load / self.force_scale
            tangent = _widened(tangent, slope[:, None] * across)
        if held and not self.step.integrator.inertia:
            work = pull * (at_end - self.since)
        return MeasuredPart(residual, tangent, status, memory, work, law)

    @cached_property
    def _start(self) -> FloatArray:
        """Vectors at t_n, shape (n, v, 3)."""
        return self.measure.vectors(self.y0)

    def slip(self, part: MeasuredPart) -> FloatArray:
        """Change of the measure in the step as a length [m], shape (n,)."""
        slip: FloatArray = self.measure.length * (part.memory[:, 0] - self.since)
        return slip

    def stopped(self, part: MeasuredPart, rate: float) -> Stopped | None:
        """What reached a limit; None of other laws, which take energy as they are meant to."""
        if self.entry[0] != "contact_defect" or not holds(self.law):
            return None
        pull, size = part.memory[:, 1], self.num_coordinates
        new = (self.before == 0.0) & (pull != 0.0)
        push = np.where(new, -rate * self.step.factor * pull / self.force_scale, 0.0)
        return Stopped(push[:, None] * part.tangent[:, size, :size], np.where(new, part.work, 0.0))

    def largest(self, part: MeasuredPart) -> list[float]:
        """Nothing: each element has limits of its own."""
        return [0.0, 0.0, 0.0, 0.0]

    def ratios(
        self, part: Any, largest: Any, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """Of each joint its row over what counts as converged, if it has one."""
        if not self.widths["constraints"]:
            return {}
        limit = rtol * motion + 8 * _EPS * (rounded + np.maximum(self.extents, largest[3]))
        rows = np.abs(self.rows(part, "constraints")[:, 0]) / self.scale
        size = rows / np.maximum(limit, TINY)
        worst = largest_of_joints(len(self.names), self.joint, size[:, None])
        labels = (f"{name} constraints" for name in self.names)
        return dict(zip(labels, worst.tolist(), strict=True))

    def ledger(self, part: MeasuredPart, factor: float) -> dict[str, float]:
        """What leaves through it [J]."""
        column, _ = self.entry
        return {column: float(self.works(part, factor).sum())} if column else {}

    def works(self, part: MeasuredPart, factor: float) -> FloatArray:
        """`ledger` of each element [J], shape (n,)."""
        return self.entry[1] * part.work

    def describe(self, part: Any, flips: Any) -> tuple[float, str]:
        """The joint whose rows are largest."""
        size = np.nan_to_num(np.abs(part.residual).max(axis=1), nan=np.inf)
        k = int(size.argmax())
        text, times = f"{self.names[self.joint[k]]!r}", int(flips[:, k].sum())
        return float(size[k]), f"{text}, flips {times} times" if times else text


def leans(law: Any) -> bool:
    """Whether a law depends on what its joint carries."""
    return bool(getattr(law, "by_load", 0.0))


def rubs(coupling: Any) -> TypeGuard[Measured]:
    """Whether a coupling is of a law that sticks and slips, see `Rubs`."""
    return isinstance(coupling, Measured) and hasattr(coupling.law, "blurred")


def _widened(tangent: FloatArray, across: FloatArray) -> FloatArray:
    """A tangent (n, r, r) with more columns, (n, c) of which are those of its last row."""
    (n, size, _), more = tangent.shape, across.shape[1]
    wide = np.zeros((n, size + more, size + more))
    wide[:, :size, :size], wide[:, size - 1, size:] = tangent, across
    return wide


class Measured(EveryStep):
    """Makes `MeasuredElements` in every step, and remembers the measure and the multiplier.

    Args:
        bodies: Numbers of its bodies in the system.
        joint: Its scene's part: name, measure, law and `entry`.

    Attributes:
        law: Of all its elements.
    """

    def __init__(self, bodies: tuple[int, ...], joint: Any) -> None:
        self._set_up([joint], bodies, joint.measure, joint.law)
        self._touched = set(bodies)

    def _set_up(
        self, joints: Sequence[Any], bodies: tuple[int, ...], measure: Measure, law: Any
    ) -> None:
        super().__init__(bodies, self._elements)
        self._of, self._joints, self._measure, self.law = bodies, joints, measure, law
        counts = [len(joint.measure.length) for joint in joints]
        self._joint = np.repeat(np.arange(len(joints)), counts)
        self._ends = np.cumsum([0, *counts]).tolist()
        self._names = tuple(joint.name for joint in joints)
        others = f" and {len(joints) - 1} others" if len(joints) > 1 else ""
        self._name = f"{self._names[0]}{others}"
        self._rest = measure.reference()
        self._scale: FloatArray | None = None

    # ---- many joints as one
    @property
    def alike(self) -> Hashable | None:
        """What joints within a batch have in common that `together` takes; None: none does."""
        (joint,), measure, law = self._joints, self._measure, self.law
        shared = getattr(law, "alike", None)
        if shared is None:
            return None
        widths = (side.nodes.shape[1] for side in measure.sides)
        return (*widths, measure.kind, measure.weights.shape[1], type(law), shared, joint.entry)

    @classmethod
    def together(cls, each: Sequence[Measured], batch: Any, number: int) -> Measured:
        """One for joints that are `alike`, as of `Constraints.together`."""
        joints, of = [one._joints[0] for one in each], [one._of for one in each]
        measure = Measure.joined([joint.measure for joint in joints], of, batch)
        counts = [len(joint.measure.length) for joint in joints]
        law = type(joints[0].law).together([joint.law for joint in joints], counts)
        new = cls.__new__(cls)
        new._set_up(joints, (number,) * len(measure.sides), measure, law)
        new._touched = set().union(*of)
        return new

    # ---- in a step
    def _elements(self, step: Step, history: Any) -> MeasuredElements:
        measure, of = self._measure, self._of
        for joint in self._joints:
            joint.check_step(step)
        memory = np.concatenate(history) if len(self._joints) > 1 else history
        y0 = self._rest + nodal(measure.sides, of, step.state.u)
        near = measure.kind.value(measure.vectors(y0), memory[:, 0])
        drift, scale, since, before = np.empty(0), np.zeros(len(near)), near, np.empty(0)
        if holds(self.law):
            since = near if step.dt else memory[:, 2]
            scale, before = self._scales(step), memory[:, 1]
        else:
            moved = zip(step.moments, step.state.v, strict=True)
            drift = nodal(measure.sides, of, [
                np.zeros_like(v) if m.drift is None else m.drift for m, v in moved
            ])  # fmt: skip
        return MeasuredElements(
            name=self._name, sides=measure.sides, measure=measure, law=self.law, step=step, y0=y0,
            drift=drift, near=near, since=since, before=before, entry=self._joints[0].entry,
            scale=scale, rest=self._rest, names=self._names, joint=self._joint,
            carried=memory[:, 3:],
        )  # fmt: skip

    def _scales(self, step: Step) -> FloatArray:
        """As of `MeasuredElements`, in dynamics asked for once. Collective."""
        if self._scale is None or not step.integrator.inertia:
            each = [[side.body for side in joint.measure.sides] for joint in self._joints]
            self._scale = step.least_scales(each)[self._joint]
        return self._scale

    def history(self, parts: Sequence[MeasuredPart]) -> Any:
        """The memory of an accepted step: of a joint alone an array, of many one of each."""
        (part,) = parts
        if len(self._joints) == 1:
            return part.memory
        return [part.memory[a:b] for a, b in pairwise(self._ends)]

    def touched(self) -> set[int]:
        """All bodies."""
        return self._touched

    def kinematics(self, state: State, dt: float) -> list[Kinematics | None]:
        """A start need not fit them."""
        return [None] * len(self.elements)

    def motions(self, state: State) -> FloatArray:
        """Rates of the joints' measures on this rank, (2, joints), and their sizes. Collective.

        Sizes are those of what rates are sums of, whose rounding they have.
        """
        measure, of = self._measure, self._of
        y, v = self._rest + nodal(measure.sides, of, state.u), nodal(measure.sides, of, state.v)
        p = measure.vectors(y)
        at = measure.kind.value(p, np.zeros(len(p)))
        to_vectors = measure.kind.gradient(p, p, at, at).end.reshape(p.shape)
        along = measure.to_nodes(to_vectors)
        sizes = np.abs(along).sum(axis=(1, 2)) * np.abs(y).max(axis=(1, 2), initial=0.0)
        each = np.einsum("nai,nai->n", along, v), sizes
        count = len(self._joints)
        return np.array([np.bincount(self._joint, one, minlength=count) for one in each])

    def obey(self, law: HoldingLaw) -> None:
        """Let the elements of the step obey another law."""
        self.elements = [replace(batch, law=law) for batch in self.elements]

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """The multiplier of the last step."""
        batch = self.elements[k]
        if not holds(batch.law):
            return super().guess(k, x)
        guess: FloatArray = batch.step.factor / batch.force_scale * batch.before
        return guess[:, None]
