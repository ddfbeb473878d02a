"""Products of vectors and systems of two equations, for which numpy's own take longer."""

from __future__ import annotations

import numpy as np

from dolfinx_nts.types import FloatArray

_ONE, _TWO = [1, 2, 0], [2, 0, 1]


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """A x b of vectors (..., 3)."""
    return a[..., _ONE] * b[..., _TWO] - a[..., _TWO] * b[..., _ONE]


def resultant(x: FloatArray, force: FloatArray) -> FloatArray:
    """Sum of forces (n, 3) at points (n, 3), and of their moments about the origin, (2, 3)."""
    return np.array([force.sum(axis=0), cross(x, force).sum(axis=0)])


def projector(squares: FloatArray, least: float) -> FloatArray:
    """Projectors on the directions whose squares sum up to matrices (n, k, k), in which is more."""
    part, vector = np.linalg.eigh(squares)
    vector *= (part > least)[:, None]
    found: FloatArray = np.matmul(vector, vector.transpose(0, 2, 1))
    return found


def range_of(moved: FloatArray, around: FloatArray | float = 0.0) -> FloatArray:
    """Largest components of vectors along the axes and against them, shape (2, 3).

    Args:
        moved: The vectors, shape (3 n,) or (n, 3); of none it is -inf.
        around: What each component may be larger or smaller by, shape (n, 3).
    """
    # Components one after the other are compared ten times as fast.
    moved = np.ascontiguousarray(moved.reshape(-1, 3).T)
    around = np.transpose(around)
    ends = (around + moved, around - moved)
    return np.array([end.max(axis=1, initial=-np.inf) for end in ends])


def relative_way(moved: FloatArray) -> FloatArray:
    """Bounds on motions relative to each other, shape (n,).

    Args:
        moved: Largest motion of two sets of points along the axes and against, as of `range_of`,
            shape (n, 2, 2, 3).
    """
    apart = np.maximum(moved[:, 0, 0] + moved[:, 1, 1], moved[:, 1, 0] + moved[:, 0, 1])
    way: FloatArray = np.linalg.norm(np.maximum(apart, 0.0), axis=1)
    return way


def triad(axis: FloatArray) -> FloatArray:
    """Right-handed orthonormal m1, m2, n as rows, n along the axis."""
    least = np.eye(3)[np.abs(axis).argmin()]
    m1 = np.cross(least, axis)
    m1 /= np.linalg.norm(m1)
    return np.array([m1, np.cross(axis, m1), axis])


def solve_2x2(
    a: tuple[FloatArray, FloatArray, FloatArray, FloatArray], b: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Solutions (2, ...) of the systems a_11, a_12, a_21, a_22 for b_1, b_2, of shapes that fit.

    Not finite where singular, of which numpy warns.
    """
    a11, a12, a21, a22 = a
    first, second = b
    solution = np.array([a22 * first - a12 * second, a11 * second - a21 * first])
    solution /= a11 * a22 - a12 * a21
    return solution
