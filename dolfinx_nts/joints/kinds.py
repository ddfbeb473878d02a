"""The joints of theory section 13, each a few products of vectors.

`a` is the first body A and `b` the second one B; None, of either, is the ground. Points and axes
are those of the start. What is prescribed is the motion of A relative to B; of a displacement or an
angle only the change since t = 0 counts. Its work is external work.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.joints.between import ROUNDED, Between, Product, Times, Vector
from dolfinx_nts.joints.directed_friction import Across, DirectedFriction, Turn
from dolfinx_nts.joints.laws import JointFriction, Motor, cone_limit, laws_on
from dolfinx_nts.kernels.vectors import triad
from dolfinx_nts.types import Places
from dolfinx_nts.validation import (
    StepFailedError,
    UserFunctionError,
    at_time,
    direction,
    floats,
    known_options,
    number_at,
    require_positive,
    require_same,
)

Number = Callable[[float], float]


@known_options
class Spherical(Between):
    """A ball joint: p_A - p_B = 0.

    Args:
        a: A body, or None.
        b: A body, or None.
        point: Of both at the start [m].
        displacement: Function of time whose change since t = 0 p_A - p_B [m] follows.
        cone: A direction at the start, of any length, and the largest angle [rad] between it in A
            and in B; None: none. Asks for bodies with directions, as those of `Revolute`.
        friction: `JointFriction` against any turn, with the ball's radius if by coefficient; or
            None. Asks for the same.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or the point lies outside a flexible body.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, point: Places,
        displacement: Callable[[float], Any] | None = None, cone: Any = None,
        friction: JointFriction | None = None, name: str | None = None,
    ) -> None:  # fmt: skip
        super().__init__(a, b, ("point", point, point), name)
        self.bearing = 3
        if displacement is not None:
            self.drive("displacement", displacement, "m", at_time)
        rubs: tuple[DirectedFriction, ...] = ()
        require_same(self.comm, friction=friction)
        if friction is not None:
            of_a, of_b = self.directions(np.eye(3))
            vectors = [*of_a, *of_b]
            rubs = (DirectedFriction(self, "friction", friction, Turn, vectors, self.length),)
        self.parts = (*cone_limit(self, cone), *rubs)

    def products(self, times: Times) -> Iterator[Product]:
        """p_A - p_B = c."""
        motion = self.motion
        yield from self.meet(*(motion.since_start(t) for t in times if motion))


class _WithAxis(Between):
    """A joint with an axis n, and directions m1 and m2 at right angles, at both ends.

    Its first `bearing` multipliers are the forces by which its friction may be given.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, point: Places, axis: Places,
        name: str | None = None,
    ) -> None:
        super().__init__(a, b, ("point", point, point), name)
        self.bearing = 2
        self.axis = direction(f"axis of {self.name!r}", axis)
        axes = triad(self.axis)
        (self.m1_a, self.m2_a, self.n_a), (self.m1_b, self.m2_b, self.n_b) = self.directions(axes)
        self.axes = (self.n_a,)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Its axis, too."""
        return super().settings | {"axis": self.axis.tolist()}

    def parallel(self) -> Iterator[Product]:
        """The axes of A and B: n_A . m1_B = 0, n_A . m2_B = 0."""
        yield self.square(self.n_a, self.m1_b)
        yield self.square(self.n_a, self.m2_b)

    def upright(self, times: Times) -> Iterator[Product]:
        """The axes: n_A . n_B."""
        yield Product(self.n_a, self.n_b)

    def on_axis(self) -> Iterator[Product]:
        """B's point on A's axis: m1_A . (p_B - p_A) = 0, m2_A . (p_B - p_A) = 0."""
        yield Product(self.m1_a, self.p_b - self.p_a)
        yield Product(self.m2_a, self.p_b - self.p_a)


@known_options
class Revolute(_WithAxis):
    """A hinge: the points stay together, and the axes parallel.

    Args:
        a: A rigid body, a beam or shell, which it takes at the node there, or None.
        b: Likewise.
        point: On the axis at the start [m].
        axis: n at the start, of any length.
        angle: Function of time, the angle about n by which A turns relative to B [rad]; None: free.
            A step in which it changes by half a turn or more is cut, or the run stops.
        friction: `JointFriction`, or None.
        limits: Smallest and largest angle from the start [rad], around 0, by which A turns relative
            to B about n; None: none.
        motor: Torque [N m] on A of time, angle and its rate, such as a controller's; None: none.
            Its work is external work.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is a continuum and so has no directions.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, point: Places, axis: Places,
        angle: Number | None = None, friction: JointFriction | None = None, limits: Any = None,
        motor: Motor | None = None, name: str | None = None,
    ) -> None:  # fmt: skip
        super().__init__(a, b, point=point, axis=axis, name=name)
        self.bearing = 3
        if angle is not None:
            self.drive("angle", angle, "rad", number_at)
        self.parts = laws_on(self, friction, limits, motor, turns=True)

    def products(self, times: Times) -> Iterator[Product]:
        """Spherical, parallel axes, and the angle.

        With the mean t of the first and the last of the angles t_k and b = cos t m2_B - sin t m1_B:
        m1_A . b = sin(t_k - t), which is as good at any angle.
        """
        yield from self.meet()
        yield from self.parallel()
        if self.motion is not None:
            angles = np.array([self.motion.since_start(t) for t in times])
            if np.ptp(angles) >= np.pi:
                # The products cannot tell such a turn from one the other way.
                raise StepFailedError(
                    f"step from t={times[0]:.6g}: the angle of {self.name!r} changes by "
                    f"{np.ptp(angles):.3g} rad, half a turn or more; use a smaller dt",
                    advises=True,
                )
            middle = 0.5 * (angles[0] + angles[-1])
            b = np.cos(middle) * self.m2_b - np.sin(middle) * self.m1_b
            value = self.length * np.sin(angles - middle)
            yield Product(self.length * self.m1_a, b, value.tolist())

    def upright(self, times: Times) -> Iterator[Product]:
        """Axes, and the cosine of the angle less t, whose sine has two angles."""
        yield from super().upright(times)
        if self.motion is not None:
            middle = np.mean([self.motion.since_start(t) for t in times])
            yield Product(self.m1_a, np.cos(middle) * self.m1_b + np.sin(middle) * self.m2_b)


@known_options
class Cylindrical(_WithAxis):
    """A slides along B's axis and turns about it.

    Args:
        a: A rigid body, a beam or shell, which it takes at the node there, or None.
        b: Likewise.
        point: On the axis at the start [m].
        axis: n at the start, of any length.
        sliding_friction: As `friction` of `Prismatic`.
        sliding_limits: As `limits` of `Prismatic`.
        sliding_motor: As `motor` of `Prismatic`.
        turning_friction: As `friction` of `Revolute`.
        turning_limits: As `limits` of `Revolute`.
        turning_motor: As `motor` of `Revolute`.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is a continuum and so has no directions.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, point: Places, axis: Places,
        sliding_friction: JointFriction | None = None, sliding_limits: Any = None,
        sliding_motor: Motor | None = None, turning_friction: JointFriction | None = None,
        turning_limits: Any = None, turning_motor: Motor | None = None, name: str | None = None,
    ) -> None:  # fmt: skip
        super().__init__(a, b, point=point, axis=axis, name=name)
        sliding = sliding_friction, sliding_limits, sliding_motor
        turning = turning_friction, turning_limits, turning_motor
        self.parts = (
            *laws_on(self, *sliding, turns=False, word="sliding_"),
            *laws_on(self, *turning, turns=True, word="turning_"),
        )

    def products(self, times: Times) -> Iterator[Product]:
        """Point on the axis, parallel axes."""
        yield from self.on_axis()
        yield from self.parallel()


@known_options
class Prismatic(_WithAxis):
    """A slides along B's axis without turning.

    Args:
        a: A rigid body, a beam or shell, which it takes at the node there, or None.
        b: Likewise.
        point: On the axis at the start [m].
        axis: n at the start, of any length.
        displacement: Function of time, that of A relative to B along n [m]; None: free.
        friction: `JointFriction`, or None.
        limits: Smallest and largest way from the start [m], around 0, of A relative to B along n;
            None: none. So if A is the ground, B moves the other way.
        motor: Force [N] on A of time, way and its rate, such as a controller's; None: none.
            Its work is external work.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is a continuum and so has no directions.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, point: Places, axis: Places,
        displacement: Number | None = None, friction: JointFriction | None = None,
        limits: Any = None, motor: Motor | None = None, name: str | None = None,
    ) -> None:  # fmt: skip
        super().__init__(a, b, point=point, axis=axis, name=name)
        if displacement is not None:
            self.drive("displacement", displacement, "m", number_at)
        self.parts = laws_on(self, friction, limits, motor, turns=False)

    def products(self, times: Times) -> Iterator[Product]:
        """Cylindrical, m1_A . m2_B = 0, and n_A . (p_A - p_B) = c where it is prescribed."""
        yield from self.on_axis()
        yield from self.parallel()
        yield self.square(self.m1_a, self.m2_b)
        if self.motion is not None:
            value = [self.motion.since_start(t) for t in times]
            yield Product(self.n_a, self.p_a - self.p_b, value)

    def upright(self, times: Times) -> Iterator[Product]:
        """Axes, and the directions at right angles to them."""
        yield from super().upright(times)
        yield Product(self.m1_a, self.m1_b)


@known_options
class Planar(_WithAxis):
    """B's point stays in A's plane through `point` with normal `axis`; the normals are parallel.

    Args:
        a: A rigid body, a beam or shell, which it takes at the node there, or None.
        b: Likewise.
        point: Of both at the start [m].
        axis: n at the start, of any length.
        sliding_friction: `JointFriction` against the way in the plane, or None.
        turning_friction: As `friction` of `Revolute`; its radius is that of a ring that carries.
        turning_limits: As `limits` of `Revolute`.
        turning_motor: As `motor` of `Revolute`.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is a continuum and so has no directions.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, point: Places, axis: Places,
        sliding_friction: JointFriction | None = None,
        turning_friction: JointFriction | None = None, turning_limits: Any = None,
        turning_motor: Motor | None = None, name: str | None = None,
    ) -> None:  # fmt: skip
        super().__init__(a, b, point=point, axis=axis, name=name)
        self.bearing = 1
        turning = turning_friction, turning_limits, turning_motor
        rubs: tuple[DirectedFriction, ...] = ()
        require_same(self.comm, sliding_friction=sliding_friction)
        if sliding_friction is not None:
            given, way = ("sliding_friction", sliding_friction, Across), self.p_b - self.p_a
            rubs = (DirectedFriction(self, *given, [self.m1_a, self.m2_a, way], 1.0),)
        self.parts = (*rubs, *laws_on(self, *turning, turns=True, word="turning_"))

    def products(self, times: Times) -> Iterator[Product]:
        """n_A . (p_B - p_A) = 0, parallel normals."""
        yield Product(self.n_a, self.p_b - self.p_a)
        yield from self.parallel()


@known_options
class Universal(Between):
    """A cross between two shafts, whose arms stay at right angles: spherical, n_A . n_B = 0.

    Args:
        a: A rigid body, a beam or shell, which it takes at the node there, or None.
        b: Likewise.
        point: Centre of the cross at the start [m].
        axes: Its arms at the start, that in A and that in B, at right angles, of any length.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is a continuum and so has no directions.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, point: Places, axes: Places,
        name: str | None = None,
    ) -> None:
        super().__init__(a, b, ("point", point, point), name)
        if floats(axes).shape != (2, 3):
            raise ValueError(f"axes={axes!r} of {self.name!r}: pass two vectors")
        arms = np.array([direction(f"axes[{k}] of {self.name!r}", n) for k, n in enumerate(axes)])
        if abs(arms[0] @ arms[1]) > ROUNDED:
            raise ValueError(
                f"axes={axes!r} of {self.name!r}: are not at right angles; the arms of a cross are"
            )
        (self.n_a, _), (_, self.n_b) = self.directions(arms)
        self.arms, self.axes = arms, (self.n_a, self.n_b)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Its arms, too."""
        return super().settings | {"axes": self.arms.tolist()}

    def products(self, times: Times) -> Iterator[Product]:
        """Spherical, n_A . n_B = 0."""
        yield from self.meet()
        yield self.square(self.n_a, self.n_b)


@known_options
class Fixed(Between):
    """A weld: the points stay together, and the axes parallel.

    Args:
        a: A rigid body, a beam or shell, which it takes at the node there, or None.
        b: Likewise.
        point: Of both at the start [m].
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is a continuum and so has no directions.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, point: Places, name: str | None = None
    ) -> None:
        super().__init__(a, b, ("point", point, point), name)
        self.m_a, self.m_b = self.directions(np.eye(3))

    def products(self, times: Times) -> Iterator[Product]:
        """Spherical; of x, y and z in A and B, three pairs at right angles."""
        yield from self.meet()
        for i, j in ((0, 1), (1, 2), (2, 0)):
            yield self.square(self.m_a[i], self.m_b[j])

    def upright(self, times: Times) -> Iterator[Product]:
        """X, y and z of A and B."""
        for a, b in zip(self.m_a, self.m_b, strict=True):
            yield Product(a, b)


@known_options
class Distance(Between):
    """A rod without mass between two points: (r . r - L^2)/(2 L_0) = 0, r = p_A - p_B.

    Args:
        a: A body, or None.
        b: A body, or None.
        points: That of A and that of B at the start [m].
        length: L [m]: None is the points' distance at the start; or a function of time that begins
            with it.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, a point lies outside a flexible body, the points
            coincide, or they have another distance.
    """

    def __init__(
        self, a: Body | None, b: Body | None, *, points: Places,
        length: float | Number | None = None, name: str | None = None,
    ) -> None:  # fmt: skip
        if floats(points).shape != (2, 3):
            raise ValueError(f"points={points!r}: pass two points [m], that of a and that of b")
        super().__init__(a, b, ("points", *points), name)
        p, q = np.asarray(points, dtype=float)
        self.rest = float(np.linalg.norm(p - q))
        if self.rest <= ROUNDED * max(np.linalg.norm(p), np.linalg.norm(q)):
            raise ValueError(
                f"points={points!r} of {self.name!r}: coincide; join them by Spherical(...)"
            )
        begins: Any = length
        if callable(length):
            self.drive("length", length, "m", number_at)
            begins = self.motion and self.motion.first
        if begins is not None:
            require_positive(f"length of {self.name!r}", begins, "m")
            if abs(begins - self.rest) > ROUNDED * self.rest:
                raise ValueError(
                    f"length={length!r} of {self.name!r}: the points are {self.rest!r} apart at "
                    "the start; leave length out, or move them"
                )

    def products(self, times: Times) -> Iterator[Product]:
        """With r = p_A - p_B: r . r/(2 L_0) = L^2/(2 L_0)."""
        r, rest = self.p_a - self.p_b, self.rest
        lengths = [rest if self.motion is None else self.motion.at(t) for t in times]
        if min(lengths) <= 0.0:
            raise UserFunctionError(
                f"length of {self.name!r} at t={times[int(np.argmin(lengths))]!r}: is "
                f"{min(lengths)!r}; return a positive length [m]"
            )
        yield Product(0.5 / rest * r, r, [length**2 / (2.0 * rest) for length in lengths])

    def arm(self) -> Vector:
        """From B to A: a mass at the end of a rod circles without a turn of its own."""
        return self.p_a - self.p_b
