"""The kernels of `facets.c`, `nts_element.c` and `surface_points.c`.

For the few pairs of a small scene the calls of NumPy cost more than what they compute, for many
pairs its arrays go through memory again and again.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.kernels import (
    discrete_gradient,
    facets,
    library,
    nts_element,
    patches,
    triangle_patches,
)
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Squared sine of an angle between two edges that is rounding only.
COLLINEAR = 1e-14
#: Points times facets up to which all pairs' boxes are compared.
_MOST_PAIRS = 1 << 20


class Condensed(NamedTuple):
    """Contribution of pairs by (x, lambda_N, lambda_T); r = 3 (nc + 1) + 1, or + 3 with friction.

    Attributes:
        residual: [kg m], of lambda_N the gap [m], of lambda_T zero, shape (n, r).
        tangent: Its derivative, shape (n, r, r).
        gap: g_N at t_{n+1} [m], shape (n,).
        slip_gradient: Derivative of the slip times the facet size, shape (n, 2, r).
        metric: m_ab over the squared facet size, shape (n, 2, 2).
        metric_gradient: Its derivative, shape (n, 2, 2, r).
    """

    residual: FloatArray
    tangent: FloatArray
    gap: FloatArray
    slip_gradient: FloatArray
    metric: FloatArray
    metric_gradient: FloatArray


def _coefficients(nc: int, degree: int) -> FloatArray:
    """Shape functions and their derivatives as polynomials of a degree in each coordinate.

    Returns:
        Coefficients by order, how many derivatives by the second coordinate, powers of the first
        and of the second, and control point, shape (4, 4, degree + 1, degree + 1, nc).
    """
    k = degree + 1
    nodes = np.linspace(-degree, degree, k)
    grid = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=2).reshape(-1, 2)
    inverse = np.linalg.inv(nodes[:, None] ** np.arange(k))
    values = facets.shape(grid, nc)[0].reshape(k, k, nc)
    plain = np.einsum("ik,jl,kln->ijn", inverse, inverse, values)
    if nc == triangle_patches.NUM_POINTS:
        plain = triangle_patches.COEFFICIENTS
    out = np.zeros((4, 4, k, k, nc))
    for order in range(4):
        for second in range(order + 1):
            found = plain
            for axis, times in enumerate((order - second, second)):
                found = np.polynomial.polynomial.polyder(found, times, axis=axis)
            out[order, second, : found.shape[0], : found.shape[1]] = found
    return out


@lru_cache
def _facet(nc: int) -> tuple[Any, FloatArray]:
    """A kind of facet, and the array that it points to."""
    degree = {patches.NUM_POINTS: 3, triangle_patches.NUM_POINTS: 4}.get(nc, 1)
    coefficients = _coefficients(nc, degree)
    together = nc in (3, triangle_patches.NUM_POINTS)
    return library.Facet(nc, degree, together, coefficients.ctypes.data), coefficients


@lru_cache
def _limits() -> Any:
    """Where projections end."""
    return library.Limits(facets.LAST_STEP, 1e3 * facets.EPS, COLLINEAR)


def project(
    points: FloatArray, corners: FloatArray, xi: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """`facets.project`, which takes the pairs for which plain Newton steps do not do."""
    kernels, (n, nc) = library.load(), corners.shape[:2]
    found, done = np.array(xi, dtype=np.float64), np.empty(n, dtype=bool)
    if not n:
        return found, done
    library.run(kernels.project, _facet(nc)[0], _limits(), n, points, corners, found, done)
    rest = ~done
    if rest.any():
        found[rest], done[rest] = facets.project(points[rest], corners[rest], found[rest])
    return found, done


def closest_point(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Global closest point of each bounded facet, edges and corners included.

    Triangles are solved directly. A quadrilateral whose squared distance is convex over the
    reference square (proved per pair by exact bounds of its Hessian) has one minimum, found by a
    bracketed Newton method; for all others every stationary point is enumerated.

    Args:
        points: Points x [m], shape (n, 3).
        corners: Facet corners [m], shape (n, nc, 3).

    Returns:
        Coordinates in the closed reference facet [-], shape (n, 2), and distances [m], shape (n,).
    """
    kernels, (n, nc) = library.load(), corners.shape[:2]
    xi, distance = np.empty((n, 2)), np.empty(n)
    if not n:
        return xi, distance
    library.run(kernels.closest_point, _facet(nc)[0], _limits(), n, points, corners, xi, distance)
    return xi, distance


def closest_facets(
    points: FloatArray,
    corners: FloatArray,
    sizes: FloatArray,
    limit: FloatArray,
    rounding: float,
    out: tuple[IntArray, FloatArray, FloatArray],
) -> bool:
    """Return what `search.closest_facets` finds before it prefers any, by the boxes of all pairs.

    Args:
        points: Points [m], shape (n, 3).
        corners: Facet corners [m], shape (m, nc, 3).
        sizes: Facet sizes [m], shape (m,).
        limit: Largest distances of interest [m], shape (n,).
        rounding: Distances that differ by less than this part of the lengths they come from tie.
        out: Facet, coordinates and distance as of `search.Closest`, written where there is one.

    Returns:
        Whether it was done: there are not too many.
    """
    kernels, (n, m, nc) = library.load(), (len(points), *corners.shape[:2])
    if n * m > _MOST_PAIRS:
        return False
    pairs = n, points, limit, m, corners, sizes, rounding
    return bool(library.run(kernels.closest_facets, _facet(nc)[0], _limits(), *pairs, *out))


def condensed(
    x0: FloatArray,
    x1: FloatArray,
    normal0: FloatArray,
    xi0: FloatArray,
    xi1: FloatArray,
    length: FloatArray,
    multiplier: FloatArray,
) -> Condensed:
    """The mean-value element where (d, f) and the multipliers that hold them are eliminated.

    Args:
        x0: Slave and control points at t_n [m], shape (n, nc + 1, 3).
        x1: The same at t_{n+1}.
        normal0: d at t_n [-], shape (n, 3).
        xi0: f at t_n [-], shape (n, 2).
        xi1: The projection at t_{n+1}.
        length: Facet sizes [m], shape (n,).
        multiplier: lambda_N, or lambda_N and lambda_T, [kg m], shape (n, 1) or (n, 3).
    """
    n, nc = len(x0), x0.shape[1] - 1
    size = 3 * nc + 3 + multiplier.shape[1]
    shapes = (size,), (size, size), (), (2, size), (2, 2), (2, 2, size)
    out = Condensed(*(np.zeros((n, *shape)) for shape in shapes))
    points = nts_element.GAUSS_POINTS[nc]
    rule = points, *discrete_gradient.gauss(points)
    tangential = multiplier.shape[1] - 1
    pairs = x0, x1, normal0, xi0, xi1, length, multiplier
    library.run(library.load().condensed, _facet(nc)[0], *rule, tangential, n, *pairs, *out)
    return out


class OverSurface(NamedTuple):
    """What points of a slave's facets give; axis 0 = element, a pair of facets, or slave.

    Attributes:
        residual: Rows of corners of slave and master, and zeros of the multipliers at the slave's
            corners, shape (elements, r).
        tangent: Its derivative; rows of multipliers are those of the slaves' gap and slips.
        force: Rows of the points and of the master's corners, if any, shape (n, nc + 1, 3).
        gap: Of the slaves [m], shape (slaves,).
        slip: As vectors [m], shape (slaves, 3).
        pulls: Minus the forces on them, shape (slaves, 3).
    """

    residual: FloatArray
    tangent: FloatArray
    force: FloatArray
    gap: FloatArray
    slip: FloatArray
    pulls: FloatArray


def points_of(element: IntArray, shape: FloatArray, y: FloatArray) -> FloatArray:
    """Points on slaves' facets and the corners of masters' facets, shape (n, nc + 1, 3).

    Args:
        element: That of each point, shape (n,).
        shape: Weights of the corners of the slave's facet, shape (n, corners).
        y: Corners of slave and master of elements, shape (elements, corners + nc, 3).
    """
    n, corners = shape.shape
    nc = y.shape[1] - corners
    out = np.empty((n, nc + 1, 3))
    given = element.astype(np.int64, copy=False), shape, y
    library.run(library.load().points_of, corners, nc, n, *given, out)
    return out


class Summed(NamedTuple):
    """How points of a slave's facets are summed up.

    Attributes:
        element: That of each point, in ascending order, shape (n,).
        slot: Slaves at the corners of its facet, or -1, shape (n, corners).
        shape: Weights of the corners in the point, shape (n, corners).
        share: Its parts in these slaves' gaps, shape (n, corners).
        multiplier: Of the slaves, lambda_N, with friction forces along two directions, (slaves, m).
        directions: These, shape (slaves, 2, 3).
        number: Of elements.
    """

    element: IntArray
    slot: IntArray
    shape: FloatArray
    share: FloatArray
    multiplier: FloatArray
    directions: FloatArray
    number: int

    def room(self, nc: int) -> OverSurface:
        """Zeros of what sums have over masters of so many corners."""
        (slaves, width), (n, corners) = self.multiplier.shape, self.slot.shape
        size = 3 * (corners + nc) + corners * width
        shapes = (self.number, size), (self.number, size, size), (n, nc + 1, 3), (slaves,)
        return OverSurface(*map(np.zeros, (*shapes, (slaves, 3), (slaves, 3))))

    def of_points(self) -> tuple[Any, ...]:
        """The arrays of points."""
        numbers = (a.astype(np.int64, copy=False) for a in (self.element, self.slot))
        return *numbers, self.shape, self.share


def over_surface(
    start: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    end: tuple[FloatArray, FloatArray],
    theta: float,
    summed: Summed,
    given: tuple[FloatArray, FloatArray, FloatArray] | None = None,
) -> OverSurface:
    """Elements of points of a slave's facets, summed up in pairs of facets and in slaves.

    Args:
        start: x0, normal0, xi0 and length as of `condensed`.
        end: x1 and xi1 as of `condensed`.
        theta: Where between t_n and t_{n+1} friction acts.
        summed: How.
        given: Residual, tangent and gradient of the slip of each point, where its rule is not the
            mean value.
    """
    nc, (n, corners) = end[0].shape[1] - 1, summed.slot.shape
    out = summed.room(nc)
    points = nts_element.GAUSS_POINTS[nc]
    tangential = summed.multiplier.shape[1] - 1
    rule = points, *discrete_gradient.gauss(points), tangential, theta, corners, n
    x0, normal0, xi0, length = start
    of_points = *summed.of_points(), x0, end[0], normal0, xi0, end[1], length
    own = given or (None,) * 3
    kernel, carried = library.load().over_surface, (summed.multiplier, summed.directions)
    library.run(kernel, _facet(nc)[0], *rule, *of_points, *carried, *own, *out)
    return out


def over_obstacle(along: FloatArray, given: Sequence[Any], summed: Summed) -> OverSurface:
    """The same of points and an obstacle.

    Args:
        along: Directions of the points' slips, shape (n, 2, 3).
        given: Residual, tangent, and with friction value and gradient of the slip, of each point,
            as of `compiled_law.obstacle`.
        summed: How.
    """
    out, (n, corners) = summed.room(0), summed.slot.shape
    kernel, tangential = library.load().over_obstacle, summed.multiplier.shape[1] - 1
    own = [*given[:4], None, None][:4]
    carried = summed.multiplier, summed.directions, along
    library.run(kernel, tangential, corners, n, *summed.of_points(), *carried, *own, *out)
    return out


def law_of_sums(
    slot: IntArray, scale: FloatArray, slopes: FloatArray, elements: IntArray, tangent: FloatArray
) -> None:
    """Write laws of slaves into elements whose rows of multipliers are the slaves' gap and slips.

    Args:
        slot: Slaves at the elements' corners, or -1, shape (n, corners).
        scale: What the slaves' multipliers are over, shape (slaves,).
        slopes: By gap, two slips and multipliers, of the slaves' rows, (slaves, m, 3 + m).
        elements: How many of them each slave has, which have equal parts of its own derivatives.
        tangent: Of the elements, contiguous, shape (n, r, r).
    """
    (n, corners), each = slot.shape, slopes.shape[1]
    size = tangent.shape[1] - corners * each
    slots, number = (a.astype(np.int64, copy=False) for a in (slot, elements))
    kernel = library.load().law_of_sums
    library.run(kernel, corners, each, size, n, slots, scale, slopes, number, tangent)
