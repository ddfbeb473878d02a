"""Lengths, ways and angles, energies of springs, and their discrete gradients (theory section 14).

A measure xi, such as a length or an angle, is a function of v vectors that are linear in the
bodies' coordinates, such as r = p_A - p_B. Its discrete gradient D between two ends a and b
satisfies D . (p_b - p_a) = xi_b - xi_a exactly, and is the gradient where the ends are one; it is
the same if they change places. Axis 0 = element.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.kernels.discrete_gradient import resolved_mean
from dolfinx_nts.types import Array, FloatArray

#: Length [m] that keeps 0/0 away where a length is 0; far below any other.
_NO_LENGTH = 1e-100
#: Half a turn below which x/sin x is differentiated by its series.
_SMALL_TURN = 1e-3
#: Imaginary part of an argument over its size: its square is no number beside 1.
_IMAGINARY = 1e-30
#: Part of the argument by which forces are compared for their slope.
_APART = float(np.finfo(float).eps) ** (1 / 3)


class Gradient(NamedTuple):
    """A measure between two ends, by the components of its vectors.

    Attributes:
        mean: Its discrete gradient, shape (n, 3 v).
        change: Derivative of `mean` by the vectors at b, shape (n, 3 v, 3 v).
        end: Gradient at b, shape (n, 3 v).
    """

    mean: FloatArray
    change: FloatArray
    end: FloatArray


class Length:
    """The length l = |r| of one vector r [m].

    Attributes:
        unit: Size [m] below which a length's own size is not what counts: none.
    """

    unit = 0.0

    @staticmethod
    def value(p: FloatArray, near: FloatArray) -> FloatArray:
        """Its value [m], shape (n,), of vectors (n, 1, 3); `near` plays no part."""
        return np.maximum(np.linalg.norm(p[:, 0], axis=1), _NO_LENGTH)

    @staticmethod
    def gradient(a: FloatArray, b: FloatArray, at_a: FloatArray, at_b: FloatArray) -> Gradient:
        """(r_a + r_b)/(l_a + l_b), from r and l at both ends."""
        both = (at_a + at_b)[:, None]
        mean, end = (a + b)[:, 0] / both, b[:, 0] / at_b[:, None]
        change = (np.eye(3) - mean[:, :, None] * end[:, None]) / both[:, :, None]
        return Gradient(mean, change, end)


class Along:
    """The way n . r along a direction n of the difference r of two points [m], vectors n and r.

    Attributes:
        unit: As of `Length`.
    """

    unit = 0.0

    @staticmethod
    def value(p: FloatArray, near: FloatArray) -> FloatArray:
        """Its value [m], shape (n,), of vectors (n, 2, 3); `near` plays no part."""
        return np.einsum("ni,ni->n", p[:, 0], p[:, 1])

    @staticmethod
    def gradient(a: FloatArray, b: FloatArray, at_a: FloatArray, at_b: FloatArray) -> Gradient:
        """That in the middle: it is quadratic."""
        n = len(a)
        change = np.zeros((n, 2, 3, 2, 3))
        change[:, 0, :, 1] = change[:, 1, :, 0] = 0.5 * np.eye(3)
        mean, end = (p[:, ::-1].reshape(n, 6) for p in (0.5 * (a + b), b))
        return Gradient(mean, change.reshape(n, 6, 6), end)


class Angle:
    """The angle phi [rad] of z = (m_1 . m, m_2 . m) = rho (cos phi, sin phi), vectors m_1, m_2, m.

    On the circle rho = 1, where a revolute joint keeps z, its discrete gradient by z is Gonzalez's,
    which is parallel to z_b - z_a there. In this form nothing is 0/0, and it is as exact off the
    circle.

    Attributes:
        unit: Angle [rad] below which an angle's own size is not what counts.
    """

    unit = 1.0

    @staticmethod
    def value(p: FloatArray, near: FloatArray) -> FloatArray:
        """Its value [rad] on the turn nearest to `near`, shape (n,), of vectors (n, 3, 3)."""
        cos, sin = _plane(p).T
        off = np.arctan2(sin, cos) - near
        return near + off - 2.0 * np.pi * np.round(off / (2.0 * np.pi))

    @staticmethod
    def gradient(a: FloatArray, b: FloatArray, at_a: FloatArray, at_b: FloatArray) -> Gradient:
        """That of phi by z, with the gradient of z in the middle: z is quadratic."""
        mean, change, end = _on_circle(_plane(a), _plane(b), at_a, at_b)
        middle, last = _slopes(0.5 * (a + b)), _slopes(b)
        bent = np.zeros((len(a), 3, 3, 3, 3))
        for k in range(2):
            bent[:, k, :, 2] = bent[:, 2, :, k] = 0.5 * mean[:, k, None, None] * np.eye(3)
        return Gradient(
            np.einsum("nk,nkz->nz", mean, middle),
            bent.reshape(-1, 9, 9) + np.einsum("nkz,nkl,nly->nzy", middle, change, last),
            np.einsum("nk,nkz->nz", end, last),
        )


def _plane(p: FloatArray) -> FloatArray:
    """The invariants (m_1 . m, m_2 . m), shape (n, 2)."""
    return np.einsum("nki,ni->nk", p[:, :2], p[:, 2])


def _slopes(p: FloatArray) -> FloatArray:
    """Derivative of z by the vectors' components, shape (n, 2, 9)."""
    out = np.zeros((len(p), 2, 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = p[:, 2]
    out[:, :, 2] = p[:, :2]
    return out.reshape(-1, 2, 9)


def _on_circle(a: FloatArray, b: FloatArray, at_a: FloatArray, at_b: FloatArray) -> Gradient:
    """Discrete gradient of phi by z along the circle at half the turn, from z at both ends (n, 2).

    Half the turn over its sine and over the mean of rho: z_b - z_a has this component there.
    """
    half, middle = 0.5 * (at_b - at_a), 0.5 * (at_a + at_b)
    rho_a, rho_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    both = 0.5 * (rho_a + rho_b)
    factor = 1.0 / (np.sinc(half / np.pi) * both)
    along = np.column_stack([-np.sin(middle), np.cos(middle)])
    out = np.column_stack([np.cos(middle), np.sin(middle)])
    small = np.abs(half) < _SMALL_TURN
    x = np.where(small, 1.0, half)
    turn = np.where(small, half / 3.0 + half**3 / 45.0, 1.0 / x - 1.0 / np.tan(x))
    mean, radial = factor[:, None] * along, b / rho_b[:, None]
    end = np.column_stack([-radial[:, 1], radial[:, 0]]) / rho_b[:, None]
    by_angle = 0.5 * (turn[:, None] * mean - factor[:, None] * out)
    by_size = -0.5 / both[:, None] * mean
    change = by_angle[:, :, None] * end[:, None] + by_size[:, :, None] * radial[:, None]
    return Gradient(mean, change, end)


class Linear(NamedTuple):
    """V = k/2 (xi - rest)^2, of numbers or of those of each element, shape (n,).

    Attributes:
        stiffness: k [N/m] or [N m].
        rest: Where it is free [m] or [rad].
    """

    stiffness: Any
    rest: Any

    def value(self, x: FloatArray) -> FloatArray:
        """V [J]."""
        return 0.5 * self.stiffness * (x - self.rest) ** 2

    def quotient(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """[V(b) - V(a)]/(b - a) and its derivative by b."""
        mean = self.stiffness * (0.5 * (a + b) - self.rest)
        return mean, np.full_like(mean, 0.5 * self.stiffness)


class Stored:
    """A user's V(xi).

    Args:
        energy: V [J] of an array.
        force: V' [N] or [N m] of an array; None: by complex step, for which V takes complex arrays.
        unit: Size of the measure below which its own is not what counts.
    """

    def __init__(
        self, energy: Callable[[Any], Any], force: Callable[[Any], Any] | None, unit: float
    ) -> None:
        self._energy, self._given, self.unit = energy, force, unit

    def _size(self, x: FloatArray) -> FloatArray:
        return np.maximum(np.abs(x), self.unit)

    def value(self, x: Array) -> Array:
        """V [J]."""
        return _called(self._energy, x)

    def force(self, x: FloatArray) -> FloatArray:
        """V'."""
        if self._given is not None:
            return _called(self._given, x)
        step = _IMAGINARY * self._size(x)
        return np.imag(self.value(x + 1j * step)) / step

    def slope(self, x: FloatArray) -> FloatArray:
        """V'' by central differences of V'."""
        step = _APART * self._size(x)
        return (self.force(x + step) - self.force(x - step)) / (2.0 * step)

    def quotient(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """[V(b) - V(a)]/(b - a) and its derivative by b.

        It is the mean of V' between a and b: by quadrature wherever the samples say that this is
        exact to rounding. Elsewhere V changes so much that its difference cancels little.
        """
        mean, change, resolved = resolved_mean(a, b, self.force, self.slope)
        way = np.where(resolved, 1.0, b - a)
        plain = (self.value(b) - self.value(a)) / way
        steep = (self.force(b) - plain) / way
        return np.where(resolved, mean, plain), np.where(resolved, change, steep)


def _called(function: Callable[[Any], Any], x: Array) -> Array:
    """The user's function, which need not stand empty arrays."""
    return np.broadcast_to(function(x), x.shape) if x.size else np.zeros(0)
