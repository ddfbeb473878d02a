"""Friction, limits and motors of joints: laws on the angle or the way of a joint (section 22).

A joint knows none of them. Each is a joint of its own beside it, with its own column of reactions.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.interaction.carried import no_memory
from dolfinx_nts.interaction.measured import leans
from dolfinx_nts.interaction.measures import Asked, Move, Row, columns
from dolfinx_nts.joints.forces import AlongMeasure
from dolfinx_nts.kernels import measures as kernel
from dolfinx_nts.types import BoolArray, FloatArray
from dolfinx_nts.validation import (
    UserFunctionError,
    call_together,
    direction,
    is_finite,
    known_options,
    require_positive,
    require_same,
)

#: Torque [N m] or force [N] on a of time, angle or way, and its rate.
Motor = Callable[[float, float, float], float]

#: Angle [rad] of a cone, the least: its cosine hardly knows smaller ones.
_NARROW = 5e-3
#: A force may exceed its bound by this part and stick: rounding must not decide where they are
#: equal, as at the end of a load step that just reaches the bound.
TIE = 1e-9
#: Part of a measure or a rate by which a motor is asked for its slopes.
_APART = float(np.finfo(float).eps) ** (1 / 3)
#: Part of a slope by which two such may differ of a function that is smooth there.
_SMOOTH = 0.1


@known_options
@dataclass(frozen=True, kw_only=True)
class JointFriction:
    """Dry friction in a joint: up to a bound whatever the joint carries, or by what it carries.

    Attributes:
        bound: Torque [N m], or force [N] along an axis, up to which it sticks.
        coefficient: Of friction mu [-], in place of `bound`: it sticks up to mu R, or the torque
            mu r R, with R the force of the joint's bearing in the step: of a revolute
            or spherical joint on its point, of what slides along an axis that at right angles to
            this, of a plane that along its normal. It is a mean of three steps, which does not
            alternate. Moments that a bearing carries add nothing.
        radius: Of the pin, the ball or the ring that carries, r [m]; of what turns.

    Raises:
        ValueError: A number is not positive, or neither or both of bound and coefficient are given,
            or a radius without coefficient.
    """

    bound: float | None = None
    coefficient: float | None = None
    radius: float | None = None

    def __post_init__(self) -> None:
        for name, unit in (("bound", "N m or N"), ("coefficient", "-"), ("radius", "m")):
            if getattr(self, name) is not None:
                require_positive(name, getattr(self, name), unit)
        if (self.bound is None) == (self.coefficient is None):
            raise ValueError(
                f"bound={self.bound!r}, coefficient={self.coefficient!r}: pass exactly one"
            )
        if self.bound is not None and self.radius is not None:
            raise ValueError(f"radius={self.radius!r}: goes with coefficient=, not with bound=")

    def law(self, name: str, turns: bool) -> Bound:
        """The law of an argument of this name, on an angle or a way.

        Raises:
            ValueError: The radius is missing, or is given where nothing turns.
        """
        if self.bound is not None:
            return Bound(float(self.bound))
        assert self.coefficient is not None
        if turns != (self.radius is not None):
            what = "pass its radius=, too" if turns else "what slides has no radius; drop it"
            raise ValueError(f"{name}={self!r}: {what}")
        return Bound(0.0, float(self.coefficient * (self.radius or 1.0)))


class Bound(NamedTuple):
    """The measure rests while |D| <= bound, else D = bound against its motion.

    Attributes:
        bound: Of D, a number or of each element, shape (n,).
        by_load: Its derivative by the force that the bearing carries.
        width: As of `Rubs.blurred`; 0: the law itself.
        held: As of `Rubs.parted`; None: as the law says.
    """

    bound: Any
    by_load: float = 0.0
    width: float = 0.0
    held: BoolArray | None = None

    @property
    def alike(self) -> Hashable | None:
        """All are whose bounds are given."""
        return None if self.by_load else ()

    def under(self, load: FloatArray) -> Bound:
        """With the bound that a load (n,) [N] gives."""
        return self._replace(bound=self.by_load * load)

    @classmethod
    def together(cls, laws: Sequence[Bound], counts: Sequence[int]) -> Bound:
        """One with an array of bounds."""
        (bound,) = columns([law[:1] for law in laws], counts)
        return cls(bound)

    @property
    def settings(self) -> Mapping[str, Any]:
        """The bound."""
        return {"by_load": self.by_load} if self.by_load else {"bound": self.bound}

    def row(self, start: FloatArray, end: FloatArray, force: FloatArray, unit: FloatArray) -> Row:
        """Stick c_1 = c_0, or D = bound sign(c_1 - c_0), by the trial D + c_1 - c_0."""
        slip, most = end - start, self.bound / unit
        trial = slip if self.held is not None else force + slip
        stick = np.abs(trial) <= (1.0 + TIE) * most if self.held is None else self.held
        if self.width:
            # D times the root is bound times the slip: linear in D, which counts as within its
            # bound in the slope.
            size = np.hypot(slip, self.width)
            slope = (np.clip(force, -most, most) * slip / size - most) / size
            return Row(
                force - most * slip / size, slope, np.ones_like(slip), stick, -slip / size
            )
        slides = force - most * np.sign(trial)
        on, off = stick.astype(float), (~stick).astype(float)
        return Row(np.where(stick, slip, slides), on, off, stick, -off * np.sign(trial))

    def blurred(self, width: float) -> Bound:
        """D = bound s/sqrt(s^2 + width^2) of the slip s."""
        return self._replace(width=width)

    def parted(self, held: BoolArray) -> Bound:
        """What sticks is told."""
        return self._replace(held=held)

    def unlike(self, slip: FloatArray, pull: FloatArray, width: float) -> FloatArray:
        """What D misses of the blurred law, over its bound."""
        bound = np.broadcast_to(self.bound, pull.shape)
        part = np.divide(pull, bound, out=np.zeros_like(pull), where=bound > 0.0)
        return np.where(bound > 0.0, part - slip / np.hypot(slip, width), 0.0)


class Limits(NamedTuple):
    """low <= c <= high, by a force that pushes only [m]; numbers or of each element, shape (n,)."""

    low: Any
    high: Any

    @property
    def alike(self) -> Hashable:
        """All are."""
        return ()

    @classmethod
    def together(cls, laws: Sequence[Limits], counts: Sequence[int]) -> Limits:
        """One with arrays of limits."""
        return cls(*columns(laws, counts))

    @property
    def settings(self) -> Mapping[str, Any]:
        """Both."""
        return self._asdict()

    def row(self, start: FloatArray, end: FloatArray, force: FloatArray, unit: FloatArray) -> Row:
        """c_1 = high where D + c_1 - high > 0, c_1 = low where D + c_1 - low < 0, else D = 0."""
        high, low = force + end - self.high > 0.0, force + end - self.low < 0.0
        held = high | low
        value = np.where(high, end - self.high, np.where(low, end - self.low, force))
        return Row(value, held.astype(float), (~held).astype(float), held)


class Driven:
    """D = -T(t, c, dc/dt) of a user's function T, such as a controller's.

    Args:
        ask: Calls T with arrays of measures and rates. Collective.
        unit: Size of the measure below which its own is not what counts.
    """

    settings: Mapping[str, Any] = {}

    def __init__(self, ask: Callable[..., FloatArray], unit: float) -> None:
        self._ask, self._unit = ask, unit

    def pull(self, move: Move) -> tuple[FloatArray, FloatArray]:
        """At the middle and with the mean rate of the step, or where forces are taken."""
        gradient, (start, end) = move.gradient, move.ends
        if move.time is not None:
            at, rate = 0.5 * (start + end), (end - start) / move.time
            to_at, to_rate = 0.5 * gradient.end, gradient.end / move.time
        else:
            at, rate = end, np.einsum("nz,nz->n", gradient.mean, move.speed)
            to_at = 0.5 * move.share * gradient.mean
            bend = move.share * np.einsum("nz,nzy->ny", move.speed, gradient.change)
            to_rate = bend + move.rate * gradient.mean
        torque, by_at, by_rate = self._asked(
            move.when, at, rate, self._unit * (move.rate or 1.0 / (move.time or 1.0))
        )
        by_end: Any = by_at[:, None] * to_at + by_rate[:, None] * to_rate
        return -torque, -by_end

    def slopes(self, at: FloatArray, asked: Asked | None) -> tuple[float, float]:
        """Of a function that is smooth there; else, or where it raises, none. Collective."""
        if asked is None:
            return 0.0, 0.0
        least = self._unit / asked.dt
        try:
            (_, *one), (_, *two) = (
                self._asked(asked.time, at, asked.rate, least, apart)
                for apart in (_APART, 2.0 * _APART)
            )
        except UserFunctionError:
            return 0.0, 0.0
        # That of a jump falls with the distance at which it is asked.
        same = [np.abs(a - b) <= _SMOOTH * np.abs(a) for a, b in zip(one, two, strict=True)]
        stiffness, damping = (-float(a[k].sum()) for a, k in zip(one, same, strict=True))
        return stiffness, damping

    def _asked(
        self, when: float, at: FloatArray, rate: FloatArray, least: float, apart: float = _APART
    ) -> tuple[FloatArray, ...]:
        """T and its derivatives, of rates that count from `least` on. Collective."""
        step, fast = apart * (np.abs(at) + self._unit), apart * (np.abs(rate) + least)
        torque, more, less, ahead, behind = self._ask(
            when, np.array([at, at + step, at - step, at, at]),
            np.array([rate, rate, rate, rate + fast, rate - fast]),
        )  # fmt: skip
        return torque, (more - less) / (2.0 * step), (ahead - behind) / (2.0 * fast)


class OnJoint(AlongMeasure):
    """A law on a measure of a joint.

    Args:
        joint: The joint; of one with an axis and friction by its load the first constraints are
            those whose multipliers are the components of this, `bearing` of them.
        word: What it is, for its name.
        law: The law.
        entry: As of `AlongMeasure`.
        kind: Of the measure.
        vectors: That it is of, of the joint.
        length: What makes a length of it [m].
    """

    def __init__(
        self, joint: Any, word: str, law: Any, entry: tuple[str, float],
        kind: Any, vectors: Iterable[Any], length: float,
    ) -> None:  # fmt: skip
        super().__init__(joint.ends, f"{joint.name} {word}")
        # Where the joint is, whose forces it may depend on.
        self.of, self._here, self.numbers = joint, joint._here, joint.numbers
        self._lay(kind, joint.sides, [(v.weights, v.constant) for v in vectors], length)
        self.law, self.entry = law, entry
        self.stops = ", which stopped a joint" if isinstance(law, Limits) else ""

    def start(self) -> FloatArray:
        """With the memory of what its joint carries, if it depends on that."""
        found = super().start()
        if not leans(self.law):
            return found
        return np.hstack([found, no_memory(self._here, self.of.bearing)])


def laws_on(
    joint: Any, friction: Any, limits: Any, motor: Motor | None, *, turns: bool, word: str = ""
) -> tuple[OnJoint, ...]:
    """Friction, limits and motor of a joint, those that are given. Collective.

    Args:
        joint: A joint with an axis.
        friction: `JointFriction`, or None.
        limits: Smallest and largest angle [rad] or way [m] from the start, or None.
        motor: Torque [N m] or force [N] on A of time, angle or way, and rate, or None.
        turns: Whether they act on the angle by which A turns relative to B about the axis; else on
            its way along.
        word: What the arguments' names begin with.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: limits are not two numbers around 0 in this order, or the joint's motion is
            prescribed, too.
    """
    given = {f"{word}friction": friction, f"{word}limits": limits}
    require_same(joint.comm, **given)
    names = [*given, f"{word}motor"]
    measure = _measure(joint, turns)
    found: list[tuple[str, Any, tuple[str, float]]] = []
    if friction is not None:
        if not isinstance(friction, JointFriction):
            raise TypeError(
                f"{names[0]}={friction!r}: pass nts.JointFriction(bound=...), or "
                "nts.JointFriction(coefficient=..., radius=...)"
            )
        law = friction.law(names[0], turns)
        found.append((names[0], law, ("friction_dissipation", 1.0)))
    if limits is not None:
        if joint.motion is not None:
            raise ValueError(
                f"{names[1]}={limits!r} of {joint.name!r}: its motion is prescribed, which no "
                "limit stops; drop one of them"
            )
        both = measure[2] * np.array(_both(names[1], limits))
        found.append((names[1], Limits(*both.tolist()), ("contact_defect", 1.0)))
    if motor is not None:
        if joint.motion is not None:
            raise ValueError(
                f"{names[2]}={motor!r} of {joint.name!r}: its motion is prescribed, which no motor "
                "changes; drop one of them"
            )
        driven = driven_by(joint, names[2], motor, 1.0 if turns else joint.length)
        found.append((names[2], driven, ("external_work", -1.0)))
    return tuple(
        OnJoint(joint, name.replace("_", " "), law, entry, *measure)
        for name, law, entry in found
    )


def on_joint(joint: Any, *, turns: bool) -> OnJoint:
    """The angle or the way of a joint with an axis, on which nothing acts."""
    return OnJoint(joint, "motion", Bound(0.0), ("", 1.0), *_measure(joint, turns))


def _measure(joint: Any, turns: bool) -> tuple[Any, tuple[Any, ...], float]:
    """Kind, vectors and length of what `laws_on` acts on."""
    if turns:
        return kernel.Angle, (joint.m1_b, joint.m2_b, joint.m1_a), joint.length
    return kernel.Along, (joint.n_a, joint.p_a - joint.p_b), 1.0


def cone_limit(joint: Any, given: Any) -> tuple[OnJoint, ...]:
    """The limit of the angle between one direction in A and in B, if it is given. Collective.

    Args:
        joint: A joint that lets A turn.
        given: The direction at the start, of any length, and the angle [rad]; or None.

    Raises:
        ValueError: It is no direction, or the angle is out of range.
    """
    if given is None:
        return ()
    require_same(joint.comm, cone=given)
    try:
        axis, angle = given
        most = float(angle)
    except (TypeError, ValueError):
        axis, most = None, np.nan
    if not _NARROW <= most <= np.pi - _NARROW:
        raise ValueError(
            f"cone={given!r} of {joint.name!r}: pass a direction and the largest angle from it, "
            f"{_NARROW} rad at least and pi - {_NARROW} at most, e.g. ((0, 0, 1), 0.5); a "
            "Revolute or Universal joint holds the direction itself"
        )
    (a,), (b,) = joint.directions(direction(f"cone of {joint.name!r}", axis)[None])
    law = Limits(joint.length * float(np.cos(most)), np.inf)
    entry = "contact_defect", 1.0
    return (OnJoint(joint, "cone", law, entry, kernel.Along, (a, b), joint.length),)


def driven_by(joint: Any, argument: str, function: Any, unit: float) -> Driven:
    """A user's function of time, measure and rate as a law.

    Args:
        joint: What it acts in.
        argument: Its name.
        function: The user's.
        unit: As of `Driven`.

    Raises:
        TypeError: It is no function.
    """
    if not callable(function):
        raise TypeError(f"{argument}={function!r}: pass a function of time, angle or way, and rate")
    return Driven(_asking(joint, argument, function), unit)


def _both(name: str, limits: Any) -> tuple[float, float]:
    try:
        low, high = (float(limit) for limit in limits)
    except (TypeError, ValueError):
        low = high = np.nan
    if not (low <= 0.0 <= high and (is_finite(low) or is_finite(high))):
        raise ValueError(
            f"{name}={limits!r}: pass the smallest and the largest angle [rad] or way [m], e.g. "
            "(-1.0, 0.5), -math.inf or math.inf where there is none; they count from the start, "
            "where each joint is at 0, so that 0 has to be between them"
        )
    return low, high


def _asking(joint: Any, argument: str, motor: Motor) -> Callable[..., FloatArray]:
    """Calls a function for arrays of measures and rates. Collective."""

    def of(time: float, at: FloatArray, rate: FloatArray) -> FloatArray:
        found = np.full(at.shape, np.nan)
        # An iterate that runs off has no motion to ask about: the step is cut.
        for k in zip(*np.nonzero(np.isfinite(at) & np.isfinite(rate)), strict=True):
            value = motor(time, float(at[k]), float(rate[k]))
            if not is_finite(value):
                raise ValueError(f"returned {value!r}, which is no finite number [N m] or [N]")
            found[k] = value
        return found

    def ask(time: float, at: FloatArray, rate: FloatArray) -> FloatArray:
        return call_together(
            joint.comm, f"{argument} of {joint.name!r} at t={time:.6g}", of, time, at, rate,
            shown=motor,
        )  # fmt: skip

    return ask
