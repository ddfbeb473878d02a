"""A cable over eyelets: its length, the angles by which it turns, its energy (theory section 22).

It runs along v vectors, one from each of its points to the next. Axis 0 = cable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dolfinx_nts.kernels.measures import Gradient, Length
from dolfinx_nts.types import FloatArray


class Lengths:
    """The sum of the lengths of v vectors [m].

    Attributes:
        unit: As of `Length`.
    """

    unit = 0.0

    @staticmethod
    def each(p: FloatArray) -> FloatArray:
        """Length of each vector [m], shape (n, v), of vectors (n, v, 3)."""
        return Length.value(p.reshape(-1, 1, 3), np.empty(0)).reshape(p.shape[:2])

    @staticmethod
    def value(p: FloatArray, near: FloatArray) -> FloatArray:
        """Its value [m], shape (n,), of vectors (n, v, 3); `near` plays no part."""
        return Lengths.each(p).sum(axis=1)

    @staticmethod
    def gradient(a: FloatArray, b: FloatArray, at_a: FloatArray, at_b: FloatArray) -> Gradient:
        """Those of the lengths, one after another; the values at both ends play no part."""
        n, v = a.shape[:2]
        first, last = (p.reshape(-1, 1, 3) for p in (a, b))
        one = Length.gradient(first, last, *(Lengths.each(p).ravel() for p in (a, b)))
        change, k = np.zeros((n, v, 3, v, 3)), np.arange(v)
        change[:, k, :, k] = one.change.reshape(n, v, 3, 3).swapaxes(0, 1)
        size = 3 * v
        return Gradient(
            one.mean.reshape(n, size), change.reshape(n, size, size), one.end.reshape(n, size)
        )


def turns(p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles between each vector and the next [rad], from 0 to pi.

    Args:
        p: Vectors, shape (n, v, 3).

    Returns:
        The angles, shape (n, v - 1), and their derivatives by the vectors, (n, v - 1, v, 3), 0
        where the angle has none, at 0 and at pi.
    """
    length = Lengths.each(p)[:, :, None]
    along = p / length
    u, w = along[:, :-1], along[:, 1:]
    cos = np.einsum("nki,nki->nk", u, w)
    sin = np.linalg.norm(np.cross(u, w), axis=2)
    over = np.divide(-1.0, sin, out=np.zeros_like(sin), where=sin > 0.0)[:, :, None]
    slope, k = np.zeros((*sin.shape, *p.shape[1:])), np.arange(sin.shape[1])
    slope[:, k, k] = over * (w - cos[:, :, None] * u) / length[:, :-1]
    slope[:, k, k + 1] = over * (u - cos[:, :, None] * w) / length[:, 1:]
    return np.arctan2(sin, cos), slope


class Stretched(NamedTuple):
    """V = EA (c - L)^2/(2 L) of a cable of the free length L while c > L, else 0.

    Attributes:
        stiffness: EA [N].
        free: L [m].
    """

    stiffness: float
    free: FloatArray | float

    def value(self, c: FloatArray) -> FloatArray:
        """V [J]."""
        return 0.5 * self.stiffness / self.free * np.maximum(c - self.free, 0.0) ** 2

    def quotient(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Tension [V(b) - V(a)]/(b - a) [N] and its derivative by b."""
        p, q = (np.maximum(c - self.free, 0.0) for c in (a, b))
        taut_a, taut_b = a >= self.free, b >= self.free
        way = np.where(taut_a == taut_b, 1.0, b - a)
        part = np.where(taut_a == taut_b, taut_b, (q - p) / way)
        mean = 0.5 * (p + q) * part
        crossing = (np.where(taut_b, q, 0.0) - mean) / way
        change = np.where(taut_a == taut_b, 0.5 * taut_b, crossing)
        steep = self.stiffness / self.free
        return steep * mean, steep * change
