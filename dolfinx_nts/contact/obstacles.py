"""Rigid planes, spheres and cylinders without a mesh: their gap and its discrete gradient.

All are radial: with the part y = P (x - c) of a point's position that counts (P = n n^T for a
plane, 1 for a sphere, 1 - a a^T for a cylinder) the gap is n . y, or |y| - R up to the sign of the
side. Axis 0 of every array is the point. Points are relative to the obstacle's motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import KW_ONLY, dataclass, field, fields, is_dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.kernels.bounded_slope import highest
from dolfinx_nts.kernels.nts_element import Gap
from dolfinx_nts.types import FloatArray, Settings
from dolfinx_nts.validation import (
    at_time,
    direction,
    known_options,
    require_name,
    require_positive,
    vector,
)

Vector = Sequence[float] | FloatArray
Motion = Callable[[float], Vector]

#: Depth that matters on a path, as part of its length and of the obstacle's width.
_OF_PATH = 0.05
#: How deep points are taken in an obstacle: part of its width, or of the distance from it.
_BELOW, _BEHIND = 0.5, 1e-6


class Obstacle:
    """What contact asks of a rigid master that is no body.

    Attributes:
        name: For messages and files.
        motion: Displacement [m], shape (3,), as a function of time [s], or None at rest.
    """

    name: str
    motion: Motion | None

    @property
    def driven(self) -> bool:
        """Whether it moves; one with a `displacement` of its own says so."""
        return self.motion is not None

    @property
    def settings(self) -> Settings:
        """What a restart compares: the fields of a dataclass, of a motion whether there is one."""
        given: dict[str, Any] = {}
        if is_dataclass(self):
            given = {f.name: getattr(self, f.name) for f in fields(self)}
        return given | {"name": self.name, "motion": self.driven}

    def displacement(self, time: float, comm: MPI.Comm) -> FloatArray:
        """Displacement at a time [m], shape (3,). Collective if there is a motion.

        Raises:
            ValueError: `motion` raises, or returns anything but three finite numbers.
        """
        if self.motion is None:
            return np.zeros(3)
        return at_time(comm, f"motion of {self.name!r}", self.motion, time, "m")

    @property
    def extent(self) -> float:
        """Largest length that enters the gap [m]; its rounding is the gap's."""
        raise NotImplementedError

    def about(self, origin: FloatArray) -> Obstacle:
        """The same obstacle in coordinates relative to a point of space [m], shape (3,)."""
        raise NotImplementedError

    def gap(self, x: FloatArray) -> Gap:
        """Signed distance of points (n, 3) with its derivatives, an element without corners.

        Like every distance it changes by no more than the way from one point to another.
        """
        raise NotImplementedError

    @property
    def width(self) -> float:
        """Radius of what a node could pass within a step [m]; infinite where it cannot."""
        return np.inf

    def inner_points(self, x: FloatArray) -> FloatArray:
        """Points inside the obstacle [m], (m, 3), each behind its surface next to one of x (n, 3).

        They are half the width behind it, or only just without a finite one. Where the gap is not
        negative there, which only that of no true distance is, there is none: m <= n.
        """
        gap = self.gap(x)
        finite = np.isfinite(self.width)
        below = _BELOW * self.width if finite else _BEHIND * np.abs(gap.value)
        inner: FloatArray = x - (gap.value + below)[:, None] * gap.gradient[:, 0]
        return inner[self.gap(inner).value < 0.0]

    def lowest_gap(self, x0: FloatArray, x1: FloatArray) -> FloatArray:
        """Smallest gap on straight paths from x0 to x1 [m], (n, 3) each -> (n,).

        Without a formula of its own an obstacle is sampled, which costs more: the depth of a path
        is right to one part in a hundred where it is above a twentieth of its length or of the
        width.
        """
        length = np.linalg.norm(x1 - x0, axis=1)
        return -self._sampled(x0, x1, _OF_PATH * np.minimum(length, self.width))

    def depth_bound(self, x0: FloatArray, x1: FloatArray, limit: FloatArray) -> FloatArray:
        """What no point of straight paths is deeper than [m], (n, 3) each -> (n,).

        Above the limit (n,) it is the depth of the deepest point. An obstacle that is sampled is
        not known better below it.
        """
        if type(self).lowest_gap is not Obstacle.lowest_gap:
            return -self.lowest_gap(x0, x1)
        length = np.linalg.norm(x1 - x0, axis=1)
        between = 0.5 * (length - self.gap(x0).value - self.gap(x1).value)
        return np.maximum(self._sampled(x0, x1, limit), np.minimum(between, limit))

    def _sampled(self, x0: FloatArray, x1: FloatArray, limit: FloatArray) -> FloatArray:
        """Largest depth on straight paths [m], (n,), to one part in a hundred above the limit."""
        path = x1 - x0
        _, depth = highest(
            lambda k, s, _: -self.gap(x0[k] + s[:, None] * path[k]).value,
            -np.column_stack([self.gap(x0).value, self.gap(x1).value]),
            np.linalg.norm(path, axis=1),
            limit,
        )
        return depth

    def discrete_gradient(self, x0: FloatArray, x1: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Discrete gradient of the gap in the invariant y . y, and its derivative by x1.

        Args:
            x0: Points at t_n [m], shape (n, 3).
            x1: Points at t_{n+1} [m], shape (n, 3).

        Returns:
            D with D . (x1 - x0) = g_1 - g_0 exactly, shape (n, 3), and dD/dx1 [1/m], (n, 3, 3).
        """
        raise NotImplementedError

    def _check(self) -> None:
        require_name("name", self.name)
        if self.motion is None:
            return
        if not callable(self.motion):
            raise TypeError(
                f"motion={self.motion!r}: pass a function of time [s] that returns a displacement "
                "[m], e.g. lambda t: (0, 0, -0.1 * t)"
            )
        start = self.displacement(0.0, MPI.COMM_SELF)
        if start.any():
            raise ValueError(
                f"motion={self.motion!r}: is {start.tolist()} at t=0; it must start at zero, so "
                "move the obstacle itself there"
            )


def _place(name: str, value: Vector) -> tuple[float, ...]:
    return tuple(vector(name, value, "m").tolist())


@known_options
@dataclass(frozen=True)
class Plane(Obstacle):
    """A rigid half-space, e.g. a floor.

    Args:
        point: Any point of its surface [m].
        normal: Towards the side where bodies may be, of any length.
        motion: Displacement [m] as a function of time [s], zero at t = 0; its work is external.
        name: Name in messages and files.

    Raises:
        TypeError: `motion` is not callable.
        ValueError: An argument is not three finite numbers, `normal` is zero, or `motion` does not
            start at zero.
    """

    point: Vector
    normal: Vector
    _: KW_ONLY
    # Two functions of one motion are not equal, and where obstacles stand tells them apart.
    motion: Motion | None = field(default=None, compare=False)
    name: str = field(default="plane", compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", _place("point", self.point))
        object.__setattr__(self, "normal", tuple(direction("normal", self.normal).tolist()))
        self._check()

    @property
    def _height(self) -> Any:
        """Height of the surface above the origin [m]; of each point's, see `joined`."""
        return np.dot(self.point, self.normal)

    @property
    def extent(self) -> float:
        """Height above the origin [m]."""
        return abs(float(self._height))

    def about(self, origin: FloatArray) -> Plane:
        """The same plane in coordinates relative to a point of space [m], shape (3,)."""
        return _placed(self, "point", np.subtract(self.point, origin))

    def gap(self, x: FloatArray) -> Gap:
        """Distance of points (n, 3) above the plane."""
        normal, n = np.asarray(self.normal), len(x)
        # Not (x - point) @ normal, whose rounding would grow with the distance of `point`.
        value = x @ normal - self._height
        return Gap(value, np.full((n, 1, 3), normal), np.zeros((n, 3, 3)))

    def lowest_gap(self, x0: FloatArray, x1: FloatArray) -> FloatArray:
        """That of one of the ends: the gap is linear."""
        return np.minimum(self.gap(x0).value, self.gap(x1).value)

    def discrete_gradient(self, x0: FloatArray, x1: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The normal: the gap is linear."""
        n = len(x0)
        return np.full((n, 3), self.normal), np.zeros((n, 3, 3))


def _placed(obstacle: Any, name: str, place: FloatArray) -> Any:
    """A copy of a checked obstacle at another place [m], shape (3,)."""
    other = copy(obstacle)
    object.__setattr__(other, name, tuple(place.tolist()))
    return other


class _Round(Obstacle):
    """Sphere and cylinder: points of equal |y| = |P (x - c)|."""

    radius: float
    inside: bool

    def _frame(self) -> tuple[FloatArray, FloatArray]:
        """Centre c (3,) and projection P (3, 3)."""
        raise NotImplementedError

    @property
    def extent(self) -> float:
        """Radius and distance of the centre from the origin [m]."""
        return float(self.radius + np.linalg.norm(self._frame()[0]))

    def _check(self) -> None:
        require_positive("radius", self.radius, "m")
        if not isinstance(self.inside, bool | np.bool_):
            raise TypeError(f"inside={self.inside!r}: pass True for a hollow, else False")
        super()._check()

    def _radial(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Relative y (n, 3), |y| (n,), P and the side: +1 outside, -1 inside."""
        centre, projection = self._frame()
        y = (x - centre) @ projection
        return y, np.linalg.norm(y, axis=1), projection, -1.0 if self.inside else 1.0

    def gap(self, x: FloatArray) -> Gap:
        """Distance of points (n, 3) from the surface."""
        y, r, projection, side = self._radial(x)
        per_r = inverse(r)
        unit = y * per_r[:, None]
        bend = projection - unit[:, :, None] * unit[:, None]
        hessian = side * per_r[:, None, None] * bend
        return Gap(side * (r - self.radius), side * unit[:, None], hessian)

    @property
    def width(self) -> float:
        """The radius; a hollow is left on no straight path that ends inside."""
        return np.inf if self.inside else self.radius

    def lowest_gap(self, x0: FloatArray, x1: FloatArray) -> FloatArray:
        """Smallest gap on straight paths [m]: of a hollow at an end, else next to the centre."""
        y0, r0, _, side = self._radial(x0)
        y1, r1, _, _ = self._radial(x1)
        if side < 0.0:
            return self.radius - np.maximum(r0, r1)
        path = y1 - y0
        square = np.einsum("ni,ni->n", path, path)
        part = -np.einsum("ni,ni->n", y0, path) * inverse(square)
        nearest = y0 + part.clip(0.0, 1.0)[:, None] * path
        return np.linalg.norm(nearest, axis=1) - self.radius

    def discrete_gradient(self, x0: FloatArray, x1: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(y_0 + y_1) / (r_0 + r_1): the discrete gradient of r, the root of y . y."""
        y0, r0, projection, side = self._radial(x0)
        y1, r1, _, _ = self._radial(x1)
        per_sum = inverse(r0 + r1)[:, None]
        gradient = side * (y0 + y1) * per_sum
        slope = y1 * inverse(r1)[:, None]
        tangent = side * projection - gradient[:, :, None] * slope[:, None]
        return gradient, tangent * per_sum[:, :, None]


def inverse(r: FloatArray) -> FloatArray:
    """1/r, and 0 for 0: the centre of a ball has no direction and touches nothing."""
    return np.divide(1.0, r, out=np.zeros_like(r), where=r != 0.0)


@known_options
@dataclass(frozen=True)
class Sphere(_Round):
    """A rigid ball, or a hollow in the shape of one.

    Args:
        centre: Its centre [m].
        radius: Its radius [m], > 0.
        inside: Whether bodies are inside.
        motion: Displacement [m] as a function of time [s], zero at t = 0; its work is external.
        name: Name in messages and files.

    Raises:
        TypeError: `motion` is not callable or `inside` no truth value.
        ValueError: An argument is out of range, or `motion` does not start at zero.
    """

    centre: Vector
    radius: float
    _: KW_ONLY
    inside: bool = False
    # Two functions of one motion are not equal, and where obstacles stand tells them apart.
    motion: Motion | None = field(default=None, compare=False)
    name: str = field(default="sphere", compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", _place("centre", self.centre))
        self._check()

    def about(self, origin: FloatArray) -> Sphere:
        """The same sphere in coordinates relative to a point of space [m], shape (3,)."""
        return _placed(self, "centre", np.subtract(self.centre, origin))

    def _frame(self) -> tuple[FloatArray, FloatArray]:
        return np.asarray(self.centre), np.eye(3)


@known_options
@dataclass(frozen=True)
class Cylinder(_Round):
    """A rigid circular cylinder without ends, or a bore.

    Args:
        point: Any point of its axis [m].
        axis: Direction of the axis, of any length.
        radius: Its radius [m], > 0.
        inside: Whether bodies are inside.
        motion: Displacement [m] as a function of time [s], zero at t = 0; its work is external.
        name: Name in messages and files.

    Raises:
        TypeError: `motion` is not callable or `inside` no truth value.
        ValueError: An argument is out of range, or `motion` does not start at zero.
    """

    point: Vector
    axis: Vector
    radius: float
    _: KW_ONLY
    inside: bool = False
    # Two functions of one motion are not equal, and where obstacles stand tells them apart.
    motion: Motion | None = field(default=None, compare=False)
    name: str = field(default="cylinder", compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", _place("point", self.point))
        object.__setattr__(self, "axis", tuple(direction("axis", self.axis).tolist()))
        self._check()

    def about(self, origin: FloatArray) -> Cylinder:
        """The same cylinder in coordinates relative to a point of space [m], shape (3,)."""
        # The point of the axis next to the origin: one far along it would cost digits.
        return _placed(self, "point", self._frame()[1] @ np.subtract(self.point, origin))

    def _frame(self) -> tuple[FloatArray, FloatArray]:
        axis = np.asarray(self.axis)
        return np.asarray(self.point), np.eye(3) - np.outer(axis, axis)


#: Field that says where an obstacle is, of those that `joined` knows.
_PLACES = {Plane: "point", Sphere: "centre", Cylinder: "point"}


def can_join(obstacle: Any) -> bool:
    """Whether `joined` knows such obstacles; a class of the user's may be anything."""
    return type(obstacle) in _PLACES


def joined(each: Sequence[Any], counts: Sequence[int]) -> Any:
    """One obstacle about several origins as one, of points that are relative to any of them.

    Args:
        each: As of `Obstacle.about`.
        counts: How many points are relative to each of these origins, one after the other.
    """
    name, other = _PLACES[type(each[0])], copy(each[0])
    places = np.array([getattr(obstacle, name) for obstacle in each])
    object.__setattr__(other, name, np.repeat(places, counts, axis=0))
    return other
