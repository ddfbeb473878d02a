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

from dolfinx_nts.kernels import library
from dolfinx_nts.kernels.discrete_gradient import resolved_mean
from dolfinx_nts.types import Array, FloatArray

#: Length [m] that keeps 0/0 away where a length is 0; far below any other.
_NO_LENGTH = 1e-100
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
        return _gradient(a, b, at_a, at_b)


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
        return _gradient(a, b, at_a, at_b)


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
        return _gradient(a, b, at_a, at_b)


def _gradient(a: FloatArray, b: FloatArray, at_a: FloatArray, at_b: FloatArray) -> Gradient:
    """Of the kind that has so many vectors, (n, v, 3), see `measures.c`."""
    n, size = len(a), 3 * a.shape[1]
    found = Gradient(np.empty((n, size)), np.empty((n, size, size)), np.empty((n, size)))
    library.run(library.load().gradients, a.shape[1], n, a, b, at_a, at_b, *found)
    return found


def _plane(p: FloatArray) -> FloatArray:
    """The invariants (m_1 . m, m_2 . m), shape (n, 2)."""
    return np.einsum("nki,ni->nk", p[:, :2], p[:, 2])


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
