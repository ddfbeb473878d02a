"""Where points pass through moving facets within a step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.contact.search import ROUNDING, TRIANGLES
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Points (n,) and facets (n,) -> which facets may stop which points (n,).
Stops: TypeAlias = Callable[[IntArray, IntArray], BoolArray]

# Paths that start on a facet, up to rounding, come through it at the start: this part of the motion
# before it.
_START = ROUNDING
# Weights of corners this far below zero are on the edge, or rounding would leave a gap between two
# facets. Where a path grazes a facet, it is the root of rounding.
_EDGE = 1e-7
# Bernstein's coefficients of a cubic on [0, 1] from those of its powers; they enclose its values.
_HULL = np.array([[1, 1, 1, 1], [0, 1 / 3, 2 / 3, 1], [0, 0, 1 / 3, 1], [0, 0, 0, 1]])
_MAX_ROOT = 100
# Paths that are compared with the facets around them at a time.
_PORTION = 4096


def first_hits(
    points: FloatArray, motion: FloatArray, corners: FloatArray, corner_motion: FloatArray,
    stops: Stops | None = None,
) -> tuple[IntArray, FloatArray]:  # fmt: skip
    """The facet whose front each point's path meets first, and where.

    Points and corners move evenly, so that facets may turn and stretch. A path meets a facet, a
    quadrilateral being two triangles, where it comes through it from the side that the normal
    points to at that instant. No path slips through between two facets of a common edge.

    Args:
        points: Points at the start [m], shape (n, 3).
        motion: Their motion [m], shape (n, 3).
        corners: Facet corners at the start [m], shape (m, nc, 3).
        corner_motion: Their motion [m], shape (m, nc, 3).
        stops: Which facets may stop which points; None: all.

    Returns:
        Facet of each point or -1, shape (n,), and the part of the motion after which it is met [-],
        inf where there is none, shape (n,).
    """
    hit, when = np.full(len(points), -1), np.full(len(points), np.inf)
    if not (len(points) and len(corners)):
        return hit, when
    # What all facets share of their motion makes no path longer.
    common = corner_motion.mean(axis=(0, 1))
    motion, corner_motion = motion - common, corner_motion - common
    parts = TRIANGLES[corners.shape[1]]
    for point, facet in _near_paths(points, motion, corners, corner_motion):
        if stops is not None:
            meets = stops(point, facet)
            point, facet = point[meets], facet[meets]
        # Seen from the point, which stays where it is.
        start = corners[facet] - points[point, None]
        moved = corner_motion[facet] - motion[point, None]
        pair, part = _passages(*(x[:, parts].reshape(-1, 3, 3) for x in (start, moved)))
        pair //= len(parts)
        order = np.lexsort((facet[pair], part, point[pair]))
        who, first = np.unique(point[pair[order]], return_index=True)
        hit[who], when[who] = facet[pair[order[first]]], part[order[first]]
    return hit, when


def _passages(start: FloatArray, moved: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return where triangles pass over the origin with their fronts ahead, and when.

    For corners at the start and their motion [m], (p, 3, 3) each: triangles, (k,), one of which may
    occur twice, and the part of the motion after which each meets the origin [-], (k,).
    """
    height = _height(start, moved)
    hull = height @ _HULL
    largest = np.abs(hull).max(axis=1, initial=0.0)
    some = np.flatnonzero((hull.max(axis=1) >= 0.0) & (hull.min(axis=1) <= _START * largest))
    if not some.size:
        return some, np.empty(0)
    which, part = _rises(height[some])
    pair = some[which]
    corner = start[pair] + part[:, None, None] * moved[pair]
    opposite = np.cross(corner[:, [1, 2, 0]], corner[:, [2, 0, 1]])
    normal = opposite.sum(axis=1)
    square = np.einsum("ki,ki->k", normal, normal)
    weight = np.einsum("kci,ki->kc", opposite, normal)
    met = (weight >= -_EDGE * square[:, None]).all(axis=1) & (square > 0.0)
    return pair[met], part[met]


def _height(start: FloatArray, moved: FloatArray) -> FloatArray:
    """Height of the planes of triangles over the origin times twice their area, a cubic of time.

    For corners at the start and their motion [m], (p, 3, 3) each: coefficients of the powers of
    time, lowest first [m^3], (p, 4); negative where the origin is in front of the triangle.
    """
    (a, one, two), (b, turn_one, turn_two) = (
        (x[:, 0], x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) for x in (start, moved)
    )
    # One call, because cross products are slow for few pairs.
    first = np.stack([one, one, turn_one, turn_one])
    normal = np.cross(first, np.stack([two, turn_two, two, turn_two]))
    normal = np.stack([normal[0], normal[1] + normal[2], normal[3]])
    height = np.zeros((len(a), 4))
    height[:, :3] = np.einsum("kpi,pi->pk", normal, a)
    height[:, 1:] += np.einsum("kpi,pi->pk", normal, b)
    return height


def _rises(cubic: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return where cubics rise through zero between `-_START` and 1.

    Args:
        cubic: Coefficients, lowest power first, shape (n, 4).

    Returns:
        Cubics, shape (k,), and arguments [-], shape (k,).
    """
    c0, c1, c2, c3 = cubic.T
    # Between its extremes a cubic is monotone. This form of the roots cancels nowhere.
    root = -(c2 + np.copysign(np.sqrt(np.maximum(c2 * c2 - 3.0 * c1 * c3, 0.0)), c2))
    with np.errstate(divide="ignore", invalid="ignore"):
        extremes = np.stack([root / (3.0 * c3), c1 / root], axis=1)
    inner = np.sort(np.nan_to_num(extremes, nan=1.0).clip(-_START, 1.0), axis=1)
    at = np.column_stack([np.full(len(cubic), -_START), inner, np.ones(len(cubic))])
    value = c0[:, None] + at * (c1[:, None] + at * (c2[:, None] + at * c3[:, None]))
    which, k = np.nonzero((value[:, :-1] < 0.0) & (value[:, 1:] >= 0.0))
    low, high, below = at[which, k], at[which, k + 1], -value[which, k]
    t = low + (high - low) * (below / (below + value[which, k + 1]))
    c0, c1, c2, c3 = cubic[which].T
    for _ in range(_MAX_ROOT):
        f, slope = c0 + t * (c1 + t * (c2 + t * c3)), c1 + t * (2.0 * c2 + 3.0 * t * c3)
        low, high = np.where(f < 0.0, t, low), np.where(f < 0.0, high, t)
        with np.errstate(divide="ignore", invalid="ignore"):
            new = t - f / slope
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        step, t = np.abs(new - t), new
        if (step <= 4.0 * fc.EPS).all():
            break
    return which, t


def _near_paths(
    points: FloatArray, motion: FloatArray, corners: FloatArray, corner_motion: FloatArray
) -> Iterator[tuple[IntArray, IntArray]]:
    """Pairs (point, facet) whose boxes over the motion overlap, in portions."""
    low = np.minimum(points, points + motion)
    high = np.maximum(points, points + motion)
    ends = np.concatenate([corners, corners + corner_motion], axis=1)
    facet_low, facet_high = ends.min(axis=1), ends.max(axis=1)
    centre, radius = 0.5 * (facet_low + facet_high), 0.5 * (facet_high - facet_low)
    tree = cKDTree(centre)
    reach = np.linalg.norm(0.5 * (high - low), axis=1) + np.linalg.norm(radius, axis=1).max()
    inside = (high >= facet_low.min(axis=0)).all(axis=1)
    inside &= (low <= facet_high.max(axis=0)).all(axis=1)
    who = np.flatnonzero(inside)
    for part in np.array_split(who, 1 + len(who) // _PORTION):
        balls = tree.query_ball_point(0.5 * (low + high)[part], reach[part])
        point = np.repeat(part, [len(b) for b in balls])
        facet = np.fromiter(chain.from_iterable(balls), np.int_, len(point))
        meets = (low[point] <= facet_high[facet]) & (high[point] >= facet_low[facet])
        meets = meets.all(axis=1)
        yield point[meets], facet[meets]
