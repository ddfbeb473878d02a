"""Where facets of a slave lie over facets of a master, and points to integrate over there.

A slave's facet is clipped by each facet of the master near it, in the plane of the slave's facet,
so that no edge of the master passes between the points of a piece (theory section 17.2). Axis 0 is
the pair of facets, the piece or the point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.kernels import library
from dolfinx_nts.types import FloatArray, IntArray

#: Cosine of the angle between the normals of two facets from which on they do not face each other.
FACING = -0.1
#: Distance from an edge over the size of the facet that is on it.
_ON = 1e-12
#: Part of a facet that is no piece of it.
_NOTHING = 1e-12
#: Points for which there is room at first, of each pair of facets.
_PER_PAIR = 8


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
    none = np.empty(0, dtype=np.int64)
    if not (len(own) and len(other)):
        return none, none
    low, high = other.min(axis=1) - reach, other.max(axis=1) + reach
    start, stop = own.min(axis=1), own.max(axis=1)
    if (low.min(axis=0) > stop.max(axis=0)).any() or (high.max(axis=0) < start.min(axis=0)).any():
        return none, none
    middle, half = 0.5 * (low + high), 0.5 * (high - low).max()
    radius = half + 0.5 * (stop - start).max(axis=1)
    found = cKDTree(middle).query_ball_point(0.5 * (start + stop), radius, p=np.inf)
    one = np.repeat(np.arange(len(own)), [len(each) for each in found])
    two = np.concatenate([np.sort(np.asarray(each, dtype=np.int64)) for each in found])
    close = ((start[one] <= high[two]) & (stop[one] >= low[two])).all(axis=1)
    return one[close], two[close]


def segments(own: FloatArray, other: FloatArray, pairs: tuple[IntArray, IntArray]) -> SurfacePoints:
    """Points of the pieces of facets that lie over others, see `SurfacePoints`.

    Triangles have three each and quadrilaterals two by two; others are cut around their middle.

    Args:
        own: Corners of the slave's facets [m], shape (m, nc, 3).
        other: Those of the master's.
        pairs: Numbers of the facets of each pair.
    """
    one, two = (number.astype(np.int64, copy=False) for number in pairs)
    kernel, cuts = library.load().segments, library.Cuts(FACING, _ON, _NOTHING)
    given = own.shape[1], other.shape[1], len(one), own, other, one, two
    most = _PER_PAIR * len(one)
    while True:
        pair, xi, weight = np.empty(most, dtype=np.int64), np.empty((most, 2)), np.empty(most)
        number = library.run(kernel, cuts, *given, most, pair, xi, weight)
        if number <= most:
            break
        most = number
    pair = pair[:number]
    return SurfacePoints(one[pair], two[pair], xi[:number], weight[:number])
