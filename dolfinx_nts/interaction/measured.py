"""One measure of points under one law: springs, dampers, limits, friction, motors (section 22).

A measure c, a length or an angle, is a function of vectors that are linear in the bodies'
coordinates, with a discrete gradient whose product with their motion is c_1 - c_0. A law says which
force D acts along it, or holds the force as a multiplier and says which equation that satisfies.
The work against the bodies is D (c_1 - c_0) whatever the law, and momenta are kept. Where an
integrator has no discrete gradients, the gradient is that of the place where it takes its forces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, TypeGuard

import numpy as np

from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.point_elements import EveryStep, PointElements
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels.measures import Gradient
from dolfinx_nts.types import BoolArray, FloatArray, Settings


@dataclass(frozen=True, eq=False)
class Measure:
    """A measure between two bodies, or a body and the ground.

    Attributes:
        kind: How it follows from vectors, such as `kernels.measures.Length`.
        sides: Nodes that these depend on, of each body.
        weights: Of the nodes in the vectors, shape (v, k).
        constants: What is added, shape (v, 3).
        length: What makes a length of it [m]: 1 of a length, that of the bodies of an angle.
    """

    kind: type[Any]
    sides: tuple[Points, ...]
    weights: FloatArray
    constants: FloatArray
    length: float = 1.0

    def vectors(self, y: FloatArray) -> FloatArray:
        """From nodal vectors (n, k, 3), shape (n, v, 3)."""
        return self.directed(y) + self.constants

    def directed(self, y: FloatArray) -> FloatArray:
        """The same without constants, as of velocities."""
        return np.einsum("va,nai->nvi", self.weights, y)

    def nodal(self, values: Sequence[FloatArray]) -> FloatArray:
        """Values at the nodes, (n, k, 3), from those of the bodies' coordinates. Collective."""
        parts = [side.nodal(v) for side, v in zip(self.sides, values, strict=True)]
        return np.concatenate(parts, axis=1)

    def reference(self) -> FloatArray:
        """Nodal vectors in the reference [m], shape (n, k, 3)."""
        return np.concatenate([side.reference for side in self.sides], axis=1)


class Move(NamedTuple):
    """A measure in a step, as laws need it.

    Attributes:
        ends: Between which its gradient is taken, two of shape (n,).
        gradient: Its gradient.
        share: Derivative by the vectors at t_{n+1} over that by the second end, of what is
            symmetric in both ends.
        speed: Of the vectors where forces are taken, shape (n, 3 v).
        rate: Its change with the vectors at t_{n+1} [1/s].
        time: Length of the step [s] if the ends are those of the step; else None.
        when: Time at which forces are taken [s].
    """

    ends: tuple[FloatArray, FloatArray]
    gradient: Gradient
    share: float
    speed: FloatArray
    rate: float
    time: float | None
    when: float


class Law(Protocol):
    """Which force D acts along a measure; it has no multiplier.

    One that stores energy has `stored(at)`, too, the energy on this rank [J], and a D whose product
    with the change of the measure is that of the energy. Collective.
    """

    @property
    def settings(self) -> Settings:
        """What it was made of, for restarts."""

    def pull(self, move: Move) -> tuple[FloatArray, FloatArray]:
        """D, shape (n,), and its derivative by the vectors at t_{n+1}, shape (n, 3 v)."""

    def slopes(self, at: FloatArray) -> tuple[float, float]:
        """Derivatives of D by the measure and by its rate on this rank. Collective."""


class Row(NamedTuple):
    """The equation of a multiplier, whose force and measure are lengths here; shape (n,) each.

    Attributes:
        value: [m].
        by_end: Its derivative by the measure at t_{n+1}.
        by_force: Its derivative by the force.
        status: What Newton's iterations may flip.
    """

    value: FloatArray
    by_end: FloatArray
    by_force: FloatArray
    status: BoolArray


class HoldingLaw(Protocol):
    """Which equation the multiplier of a measure satisfies."""

    @property
    def settings(self) -> Settings:
        """What it was made of, for restarts."""

    def row(self, start: FloatArray, end: FloatArray, force: FloatArray, unit: float) -> Row:
        """Its equation. One solution, whatever the unit of forces.

        Args:
            start: The measure at t_n [m], shape (n,).
            end: At t_{n+1}.
            force: D over `unit` [m].
            unit: Force or torque per length of `force`.
        """


class Rubs(HoldingLaw, Protocol):
    """A law that sticks and slips, with what leads Newton's method to it."""

    def blurred(self, width: float) -> HoldingLaw:
        """A law close to it, without a step between stick and slip below a width of slip [m]."""

    def parted(self, held: BoolArray) -> HoldingLaw:
        """The law of what sticks where told so, shape (n,), and slips on elsewhere."""

    def unlike(self, slip: FloatArray, pull: FloatArray, width: float) -> FloatArray:
        """What a force D misses of the blurred law, over the largest one, shape (n,).

        Args:
            slip: Change of the measure as a length [m], shape (n,).
            pull: D, shape (n,).
            width: Of the blurred law [m].
        """


class MeasuredPart(NamedTuple):
    """What a measure under a law contributes, see `Part`.

    Attributes:
        residual: Rows of coordinates and of the multiplier [kg m].
        tangent: Its derivative.
        status: What may flip, shape (1, n); (0, n) without multiplier.
        memory: The measure at t_{n+1}, and with a multiplier D and where the measure began, shape
            (n, 1) or (n, 3).
        work: Of the force against the motion of the step [J], shape (n,).
    """

    residual: FloatArray
    tangent: FloatArray
    status: BoolArray
    memory: FloatArray
    work: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredElements(PointElements):
    """One measure under one law in a step, on the rank that has it.

    Attributes:
        measure: The measure.
        law: A `Law`, or a `HoldingLaw`.
        step: The step.
        y0: Nodal vectors at t_n [m], shape (n, k, 3).
        drift: Their velocities where forces are taken without motion [m/s], shape (n, k, 3).
        near: The measure at t_n, shape (n,).
        since: The measure where the step began, which a load step does in several solutions.
        entry: Column of the ledger for the work that it takes, and its sign; "": none.
        scale: Force per motion in the units of the step; 0 without multiplier.
    """

    measure: Measure
    law: Any
    step: Step
    y0: FloatArray
    drift: FloatArray
    near: FloatArray
    since: FloatArray
    entry: tuple[str, float]
    scale: float = 0.0

    @property
    def widths(self) -> Mapping[str, int]:
        """A multiplier where the law holds."""
        return {"augmented": 0, "constraints": int(holds(self.law))}

    @property
    def bilateral(self) -> bool:
        """A multiplier's law may let go."""
        return not holds(self.law)

    @property
    def force_scale(self) -> float:
        """Unknowns are lengths: h^2/2 D, or D in statics, over this."""
        return self.scale * self.measure.length

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> MeasuredPart:
        """Residual and tangent."""
        measure, theta, n = self.measure, self.step.integrator.taken_at, len(x)
        rate = self.step.moments[0].rate
        du = x - self.y0
        first, last = (self.y0, x) if theta is None else (self.y0 + theta * du,) * 2
        a, b = measure.vectors(first), measure.vectors(last)
        at_a = measure.kind.value(a, self.near)
        at_b = measure.kind.value(b, at_a) if theta is None else at_a
        gradient = measure.kind.gradient(a, b, at_a, at_b)
        end = measure.vectors(x)
        at_end = measure.kind.value(end, at_b)
        size, factor = self.num_coordinates, self.step.factor
        width = size + self.widths["constraints"]
        residual, tangent = np.zeros((n, width)), np.zeros((n, width, width))
        along = np.einsum("va,nvi->nai", measure.weights, gradient.mean.reshape(a.shape))
        share = 1.0 if theta is None else 2.0 * theta
        status = np.empty((0, n), dtype=bool)
        if width == size:
            start = self.step.state.time
            move = Move(
                ends=(at_a, at_b),
                gradient=gradient,
                share=share,
                speed=measure.directed(self.drift + rate * du).reshape(n, 3 * len(measure.weights)),
                rate=rate,
                time=self.step.dt if theta is None else None,
                when=start + (0.5 if theta is None else theta) * self.step.dt,
            )
            pull, slope = self.law.pull(move)
            memory = at_end[:, None]
        else:
            length, unit = measure.length, self.force_scale
            force = own["constraints"][:, 0]
            pull, slope = unit / factor * force, np.zeros_like(gradient.mean)
            row = self.law.row(length * self.since, length * at_end, force, unit / factor)
            ends = measure.kind.gradient(end, end, at_end, at_end).end.reshape(end.shape)
            to_end = np.einsum("va,nvi->nai", measure.weights, ends).reshape(n, size)
            residual[:, size] = self.scale * row.value
            tangent[:, :size, size] = unit * along.reshape(n, size)
            tangent[:, size, :size] = unit * row.by_end[:, None] * to_end
            tangent[:, size, size] = self.scale * row.by_force
            status, memory = row.status[None], np.column_stack([at_end, pull, self.since])
        residual[:, :size] = factor * (pull[:, None, None] * along).reshape(n, size)
        bend = share * pull[:, None, None] * gradient.change
        inner = (bend + gradient.mean[:, :, None] * slope[:, None]).reshape(n, *a.shape[1:] * 2)
        weights = measure.weights
        tangent[:, :size, :size] = factor * np.einsum(
            "va,nviwj,wb->naibj", weights, inner, weights
        ).reshape(n, size, size)
        work = pull * np.einsum("nai,nai->n", along, du)
        if width > size and not self.step.integrator.inertia:
            work = pull * (at_end - self.since)
        return MeasuredPart(residual, tangent, status, memory, work)

    def slip(self, part: MeasuredPart) -> FloatArray:
        """Change of the measure in the step as a length [m], shape (n,)."""
        slip: FloatArray = self.measure.length * (part.memory[:, 0] - self.since)
        return slip

    def largest(self, part: MeasuredPart) -> list[float]:
        """The largest row of its multiplier [m], and its extent."""
        rows = np.abs(self.rows(part, "constraints")).max(initial=0.0)
        return [0.0, float(rows) / (self.scale or 1.0), 0.0, self.extent]

    def ledger(self, part: MeasuredPart, factor: float) -> dict[str, float]:
        """What leaves through it [J]."""
        column, sign = self.entry
        return {column: sign * float(part.work.sum())} if column else {}

    def describe(self, part: Any, flips: Any) -> tuple[float, str]:
        """The measure's row, if it has one."""
        weight, text = super().describe(part, flips)
        return weight, f"{text}, flips {int(flips.sum())} times" if flips.any() else text


def holds(law: Any) -> bool:
    """Whether a law holds its force as a multiplier."""
    return hasattr(law, "row")


def rubs(coupling: Any) -> TypeGuard[Measured]:
    """Whether a coupling is of a law that sticks and slips, see `Rubs`."""
    return isinstance(coupling, Measured) and hasattr(coupling.law, "blurred")


class Measured(EveryStep):
    """Makes `MeasuredElements` in every step, and remembers the measure and the multiplier.

    Args:
        bodies: Numbers of its bodies in the system.
        joint: Its scene's part: name, measure, law and `entry`.
    """

    def __init__(self, bodies: tuple[int, ...], joint: Any) -> None:
        super().__init__(bodies, self._elements, lambda part: part.memory)
        self._joint = joint
        self._still = [np.zeros(body.num_owned) for body in joint.bodies]

    def _elements(self, step: Step, history: FloatArray) -> MeasuredElements:
        joint, measure, of = self._joint, self._joint.measure, self.bodies[0]
        joint.check_step(step)
        u = [step.state.u[b] for b in of]
        y0 = measure.reference() + measure.nodal(u)
        near = measure.kind.value(measure.vectors(y0), history[:, 0])
        drift = [step.moments[b].drift for b in of]
        velocity = [none if v is None else v for v, none in zip(drift, self._still, strict=True)]
        scale, since = 0.0, near
        if holds(joint.law):
            since = near if step.dt else history[:, 2]
            scale = min(step.mean_scale(side.body) for side in measure.sides)
            self._force = history[:, 1]
        return MeasuredElements(
            name=joint.name, sides=measure.sides, measure=measure, law=joint.law, step=step, y0=y0,
            drift=measure.nodal(velocity), near=near, since=since, entry=joint.entry,
            scale=scale,
        )  # fmt: skip

    @property
    def law(self) -> Any:
        """That of the joint."""
        return self._joint.law

    def obey(self, law: HoldingLaw) -> None:
        """Let the elements of the step obey another law."""
        self.elements = [replace(batch, law=law) for batch in self.elements]

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """The multiplier of the last step."""
        batch = self.elements[k]
        if not holds(batch.law):
            return super().guess(k, x)
        guess: FloatArray = batch.step.factor / batch.force_scale * self._force
        return guess[:, None]
