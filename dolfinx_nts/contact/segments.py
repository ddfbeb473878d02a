"""Where facets of a slave lie over facets of a master, and points to integrate over there.

A slave's facet is clipped by each facet of the master near it, in the plane of the slave's facet,
so that no edge of the master passes between the points of a piece (theory section 17.2). Axis 0 is
the pair of facets, the piece or the point.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.types import FloatArray, IntArray

#: Cosine of the angle between the normals of two facets from which on they do not face each other.
_FACING = -0.1
#: Distance from an edge over the size of the facet that is on it.
_ON = 1e-12
#: Part of a facet that is no piece of it.
_NOTHING = 1e-12
_GAUSS = np.sqrt(1.0 / 3.0)
#: Points and weights of pieces of three and of four corners, exact for polynomials of degree 2 and
#: for those of degree 3 in each coordinate; shape functions and their derivatives there.
_RULES = {
    3: (np.array([[4.0, 1.0], [1.0, 4.0], [1.0, 1.0]]) / 6.0, np.full(3, 1.0 / 6.0)),
    4: (_GAUSS * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]), np.ones(4)),
}


class SurfacePoints(NamedTuple):
    """Points of a slave's facets that lie over facets of a master.

    Attributes:
        own: Facets of the slave, shape (n,).
        other: Facets of the master, shape (n,).
        xi: Where they are in the slave's facets, shape (n, 2).
        weight: Part of the area of the facet's coordinates that each stands for, shape (n,).
    """

    own: IntArray
    other: IntArray
    xi: FloatArray
    weight: FloatArray


def near(own: FloatArray, other: FloatArray, reach: float) -> tuple[IntArray, IntArray]:
    """Pairs of facets whose boxes are within reach, in the order of the first ones.

    Args:
        own: Corners of facets [m], shape (m, nc, 3).
        other: Those of others.
        reach: Distance of the boxes along each axis [m].
    """
    if not (len(own) and len(other)):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    low, high = other.min(axis=1) - reach, other.max(axis=1) + reach
    middle, half = 0.5 * (low + high), 0.5 * (high - low).max()
    start, stop = own.min(axis=1), own.max(axis=1)
    radius = half + 0.5 * (stop - start).max(axis=1)
    found = cKDTree(middle).query_ball_point(0.5 * (start + stop), radius, p=np.inf)
    one = np.repeat(np.arange(len(own)), [len(each) for each in found])
    two = np.concatenate([np.sort(np.asarray(each, dtype=np.int64)) for each in found])
    close = ((start[one] <= high[two]) & (stop[one] >= low[two])).all(axis=1)
    return one[close], two[close]


def segments(own: FloatArray, other: FloatArray, pairs: tuple[IntArray, IntArray]) -> SurfacePoints:
    """Points of the pieces of facets that lie over others, see `SurfacePoints`.

    Args:
        own: Corners of the slave's facets [m], shape (m, nc, 3).
        other: Those of the master's.
        pairs: Numbers of the facets of each pair.
    """
    one, two = pairs
    a, b = own[one], other[two]
    middle, axes = _plane(a)
    window, flat = (_in_plane(x, middle, axes) for x in (a, b))
    ways = _normal(b)
    against = np.einsum("ni,ni->n", ways, axes[:, 2]) < _FACING * np.linalg.norm(ways, axis=1)
    which, flat = _convex(flat[against, ::-1])
    which = np.flatnonzero(against)[which]
    polygon, count = _clip(flat, window[which])
    whole = _area(window, np.full(len(window), window.shape[1]))[which]
    there = _area(polygon, count) > _NOTHING * whole
    which = which[there]
    return _points(one[which], two[which], window[which], polygon[there], count[there])


def _normal(corners: FloatArray) -> FloatArray:
    """Normals of facets, as long as twice their area, shape (n, 3): products of the diagonals."""
    last = corners.shape[1] - 1
    return cross(corners[:, 2] - corners[:, 0], corners[:, last] - corners[:, 1])


def _plane(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean of the corners and axes of a plane through it, the last one its normal, (n, 3, 3)."""
    normal = _normal(corners)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    along = corners[:, 1] - corners[:, 0]
    along = along - np.einsum("ni,ni->n", along, normal)[:, None] * normal
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return corners.mean(axis=1), np.stack([along, cross(normal, along), normal], axis=1)


def _in_plane(x: FloatArray, middle: FloatArray, axes: FloatArray) -> FloatArray:
    """Corners (n, k, 3) in the plane of others [m], shape (n, k, 2)."""
    return np.matmul(x - middle[:, None], axes[:, :2].transpose(0, 2, 1))


def _turns(polygon: FloatArray) -> FloatArray:
    """Twice the area of the triangle at each corner of polygons (n, k, 2), > 0 if convex there."""
    before, after = (polygon - np.roll(polygon, k, axis=1) for k in (1, -1))
    return -(before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0])


def _convex(polygon: FloatArray) -> tuple[IntArray, FloatArray]:
    """Quadrilaterals (n, 4, 2), or two triangles for one with a corner that points inwards.

    Returns:
        Which each is of, and the polygons, whose corners may repeat each other.
    """
    every = np.arange(len(polygon))
    if polygon.shape[1] == 3:
        return every, polygon
    turns = _turns(polygon)
    bad = np.flatnonzero((turns < 0.0).any(axis=1))
    if not bad.size:
        return every, polygon
    # Both triangles have the corner that points inwards.
    order = (turns[bad].argmin(axis=1)[:, None] + np.arange(4)) % 4
    turned, out = polygon[bad[:, None], order], polygon.copy()
    out[bad] = turned[:, [0, 1, 2, 2]]
    return np.append(every, bad), np.concatenate([out, turned[:, [0, 2, 3, 3]]])


def _clip(polygon: FloatArray, window: FloatArray) -> tuple[FloatArray, IntArray]:
    """Polygons (n, k, 2) within convex windows (n, w, 2), both counter-clockwise.

    The windows' edges cut them one after another (Sutherland and Hodgman 1974).

    Returns:
        Polygons, shape (n, most, 2), and the number of corners of each, the first ones.
    """
    n = len(polygon)
    count = np.full(n, polygon.shape[1])
    size = np.abs(window - window[:, :1]).max(axis=(1, 2), initial=0.0)
    for start, stop in zip(np.roll(window, 1, axis=1).swapaxes(0, 1), window.swapaxes(0, 1),
                           strict=True):  # fmt: skip
        k = np.arange(polygon.shape[1])
        there, after = k < count[:, None], (k + 1) % np.maximum(count, 1)[:, None]
        edge, away = stop - start, polygon - start[:, None]
        length = np.linalg.norm(edge, axis=1)
        height = edge[:, None, 0] * away[..., 1] - edge[:, None, 1] * away[..., 0]
        height /= np.where(length > 0.0, length, 1.0)[:, None]
        # What is on the edge does not cross it by rounding.
        height[np.abs(height) < _ON * size[:, None]] = 0.0
        ahead = np.take_along_axis(height, after, axis=1)
        end = np.take_along_axis(polygon, after[..., None], axis=1)
        crosses = there & (height * ahead < 0.0)
        part = height / np.where(crosses, height - ahead, 1.0)
        cut = polygon + part[..., None] * (end - polygon)
        keep = np.stack([there & (height >= 0.0), crosses], axis=2).reshape(n, 2 * len(k))
        both = np.stack([polygon, cut], axis=2).reshape(n, 2 * len(k), 2)
        order = np.argsort(~keep, axis=1, kind="stable")
        count = keep.sum(axis=1)
        most = max(int(count.max(initial=0)), 3)
        polygon = np.take_along_axis(both, order[:, :most, None], axis=1)
    return polygon, count


def _area(polygon: FloatArray, count: IntArray) -> FloatArray:
    """Areas of polygons (n, k, 2) with so many corners (n,) [m^2], shape (n,)."""
    spans = polygon - polygon[:, :1]
    one, two = spans[:, 1:-1], spans[:, 2:]
    doubled = one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]
    doubled[np.arange(2, polygon.shape[1]) >= count[:, None]] = 0.0
    return np.where(count < 3, 0.0, 0.5 * doubled.sum(axis=1))


def _points(
    one: IntArray, two: IntArray, window: FloatArray, polygon: FloatArray, count: IntArray
) -> SurfacePoints:
    """Points of polygons in their slaves' facets, both in these facets' planes."""
    n, most, _ = polygon.shape
    place, corners = np.zeros((n, most, 3)), np.zeros((*window.shape[:2], 3))
    place[..., :2], corners[..., :2] = polygon, window
    of = np.repeat(np.arange(n), most)
    xi, _ = compiled.project(place.reshape(-1, 3), corners[of], np.zeros((len(of), 2)))
    xi = xi.reshape(n, most, 2)
    found: list[tuple[Any, ...]] = []
    for number in range(3, most + 1):
        some = np.flatnonzero(count == number)
        at, weight = (_rule if number < 5 else _fan)(xi[some, :number])
        found.append((np.repeat(some, at.shape[1]), at.reshape(-1, 2), weight.ravel()))
    which, at, weight = (np.concatenate(x) for x in zip(*found, strict=True))
    order = np.argsort(which, kind="stable")
    which = which[order]
    return SurfacePoints(one[which], two[which], at[order], weight[order])


def _fan(piece: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same of polygons (n, k, 2), wherever their corners are counted from.

    Middles of the sides of the triangles around the mean of the corners are exact for degree 2.
    """
    spokes = piece - piece.mean(axis=1, keepdims=True)
    after = np.roll(spokes, -1, axis=1)
    area = (spokes[..., 0] * after[..., 1] - spokes[..., 1] * after[..., 0]) / 6.0
    at = np.concatenate([piece + 0.5 * (after - spokes), piece - 0.5 * spokes], axis=1)
    return at, np.concatenate([area, area + np.roll(area, 1, axis=1)], axis=1)


def _rule(piece: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, p, 2) and weights (n, p) of triangles or quadrilaterals (n, 3 or 4, 2)."""
    at, weight = _RULES[piece.shape[1]]
    values, first, _ = facets.shape(at, piece.shape[1])
    slopes = np.einsum("pka,nki->npai", first, piece)
    areas = slopes[..., 0, 0] * slopes[..., 1, 1] - slopes[..., 0, 1] * slopes[..., 1, 0]
    return np.einsum("pk,nki->npi", values, piece), areas * weight
