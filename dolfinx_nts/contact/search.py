"""Which master facet is closest to which slave point: broad phase and exact choice.

Pure geometry on the facets this process holds; their exchange between processes is done elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.kernels import compiled
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.kernels.vectors import range_of
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

# Two distances that differ by less than this part of the lengths they come from are a tie: a
# point over a shared edge must not choose its facet by rounding noise.
ROUNDING = 1e-12

# Advantage of the current facet in facet sizes.
PREFERENCE = 1e-6

# Facets of one tree differ by less than this factor in size, or large ones would widen the search
# among small ones.
_SIZE_RATIO = 4.0
_MAX_SIZES = 12
_MAX_PAIRS = 1 << 18

TRIANGLES = {3: [[0, 1, 2]], 4: [[0, 1, 2], [0, 2, 3]]}


class Closest(NamedTuple):
    """Closest facet of each point.

    Attributes:
        facet: Facet number, shape (n,); -1 where none is within reach.
        xi: Convective coordinates of the closest point, inside the facet [-], shape (n, 2);
            nan where there is no facet.
        distance: Distance from it [m], shape (n,); inf where there is no facet.
    """

    facet: IntArray
    xi: FloatArray
    distance: FloatArray


class Admits(NamedTuple):
    """Which facets may count as the closest of which points.

    Attributes:
        faces: By points (n,) and facets (n,), wherever these are, shape (n,).
        apart: By these and their distances [m], shape (n,); asked of what `faces` lets through;
            None: all do.
    """

    faces: Callable[[IntArray, IntArray], BoolArray]
    apart: Callable[[IntArray, IntArray, FloatArray], BoolArray] | None = None


class _SizeClass(NamedTuple):
    """Facets of similar size: numbers, tree of their centres, largest bounding radius [m]."""

    members: IntArray
    tree: cKDTree
    radius: float


class _Scene(NamedTuple):
    """Points [m] (n, 3), corners [m] (m, nc, 3) and facet sizes [m] (m,)."""

    points: FloatArray
    corners: FloatArray
    sizes: FloatArray

    def closest(self, point: IntArray, facet: IntArray) -> tuple[FloatArray, FloatArray]:
        """Closest points of pairs: coordinates [-], shape (p, 2), and distances [m], shape (p,)."""
        return compiled.closest_point(self.points[point], self.corners[facet])

    def rounding(self, point: IntArray, facet: IntArray, distance: FloatArray) -> FloatArray:
        """Difference of distances that means nothing [m], shape (p,)."""
        magnitude = np.abs(self.points[point]).max(axis=1)
        return ROUNDING * (magnitude + self.sizes[facet] + distance)


def closest_facets(
    points: FloatArray,
    corners: FloatArray,
    *,
    reach: float | FloatArray,
    current: IntArray | None = None,
    preference: float = PREFERENCE,
    admits: Admits | None = None,
) -> Closest:
    """Closest facet of each point: exactly what a search through all facets would give.

    The lowest facet number wins among facets at the same distance (up to `ROUNDING`). A point
    keeps its current facet while that is within reach and farther than the closest one by at most
    `preference` facet sizes, so that persistent contact does not flicker on a shared edge.

    Args:
        points: Points [m], shape (n, 3).
        corners: Facet corners [m], shape (m, nc, 3), ordered as in `facets`.
        reach: Largest distance of interest [m], one value or shape (n,); may be inf.
        current: Facet of each point so far, shape (n,), negative for none.
        preference: Advantage of the current facet in facet sizes [-].
        admits: Which facets may count for which points; None: all.

    Returns:
        The closest facets, closest points and distances.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    corners = np.asarray(corners, dtype=np.float64)
    n = len(points)
    limit = np.broadcast_to(np.asarray(reach, dtype=np.float64), (n,))
    _validate(points, corners, limit, preference)
    result = _nothing(n)
    if n == 0 or len(corners) == 0:
        return result
    scene = _Scene(points, corners, fc.size(corners))
    kept = _current(scene, limit, current)
    if admits is not None:
        near, classes = _near_box(scene, limit), _size_classes(scene.corners)
        for point, facet in _candidates(scene, near, classes, limit[near], admits):
            _choose(scene, limit, point, facet, result, admits)
    elif not compiled.closest_facets(points, corners, scene.sizes, limit, ROUNDING, result):
        _by_trees(scene, limit, kept, result)
    _prefer(scene, kept, preference, result)
    return result


def _by_trees(scene: _Scene, limit: FloatArray, kept: Closest, result: Closest) -> None:
    """Enter the closest facets of all points into the result."""
    near = _near_box(scene, limit)
    classes = _size_classes(scene.corners)
    new = near[kept.facet[near] < 0]
    bound = kept.distance.copy()
    bound[new] = _upper_bounds(scene, new, classes, limit[new])
    for point, facet in _candidates(scene, near, classes, bound[near]):
        _choose(scene, limit, point, facet, result)


def apart(points: FloatArray, corners: FloatArray, reach: float) -> bool:
    """Return whether the boxes around points and facets are farther apart than the reach.

    Then `closest_facets` would find nothing.

    Args:
        points: Points [m], shape (n, 3).
        corners: Facet corners [m], shape (m, nc, 3).
        reach: Largest distance of interest [m].
    """
    one, two = range_of(points), range_of(corners)
    outside = max(0.0, -float((one + two[::-1]).min()))
    magnitude = max(float(np.abs(a).max()) for a in (one, two))
    return outside > reach + ROUNDING * (magnitude + outside)


def distance(points: FloatArray, others: FloatArray) -> float:
    """Distance between the boxes around two sets of points [m], shape (..., 3) each; 0 inside."""
    one, two = range_of(points), range_of(others)
    return float(np.linalg.norm(np.maximum(0.0, -(one + two[::-1]))))


def _nothing(n: int) -> Closest:
    """The result for n points without a facet."""
    return Closest(np.full(n, -1), np.full((n, 2), np.nan), np.full(n, np.inf))


def _validate(
    points: FloatArray, corners: FloatArray, limit: FloatArray, preference: float
) -> None:
    """Raise ValueError for input that would give a quiet nonsense."""
    if corners.ndim != 3 or corners.shape[2] != 3:
        raise ValueError(f"corners must have shape (m, nc, 3), not {corners.shape}.")
    for name, array in (("Point", points), ("Facet", corners)):
        finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        bad = np.flatnonzero(~finite)
        if bad.size:
            raise ValueError(f"{name} {bad[0]} has coordinates that are not finite.")
    if not (limit >= 0.0).all():
        raise ValueError("reach must not be negative or nan.")
    if not preference >= 0.0:
        raise ValueError(f"preference must not be negative, but is {preference}.")


def _current(scene: _Scene, limit: FloatArray, current: IntArray | None) -> Closest:
    """The current facets within reach, in the form of a result."""
    n, m = len(scene.points), len(scene.corners)
    kept = _nothing(n)
    if current is None:
        return kept
    facet = np.broadcast_to(np.asarray(current, dtype=np.int_), (n,))
    if facet.max() >= m:
        raise ValueError(f"current names facet {facet.max()}, but there are only {m} facets.")
    point = np.flatnonzero(facet >= 0)
    xi, distance = scene.closest(point, facet[point])
    within = distance <= limit[point]
    point = point[within]
    kept.facet[point], kept.xi[point], kept.distance[point] = (
        facet[point],
        xi[within],
        distance[within],
    )
    return kept


def _near_box(scene: _Scene, limit: FloatArray) -> IntArray:
    """Numbers of the points within reach of the box around all facets, shape (k,)."""
    low, high = scene.corners.min(axis=(0, 1)), scene.corners.max(axis=(0, 1))
    outside = np.maximum(0.0, np.maximum(low - scene.points, scene.points - high)).max(axis=1)
    magnitude = max(np.abs(low).max(), np.abs(high).max())
    return np.flatnonzero(outside <= limit + ROUNDING * (magnitude + outside))


def _size_classes(corners: FloatArray) -> list[_SizeClass]:
    """Facets grouped by their bounding radius, largest first."""
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.floor(np.log(radii.max() / radii) / np.log(_SIZE_RATIO))
    level = np.nan_to_num(level, posinf=_MAX_SIZES).clip(0, _MAX_SIZES)
    classes = []
    for value in np.unique(level):
        members = np.flatnonzero(level == value)
        classes.append(_SizeClass(members, cKDTree(centres[members]), radii[members].max()))
    return classes


def _upper_bounds(
    scene: _Scene, near: IntArray, classes: list[_SizeClass], bound: FloatArray
) -> FloatArray:
    """Distance within which the closest facet lies [m], shape (k,).

    One exact distance per size class tightens the given bounds; the result is -1 where no
    facet can be within reach.

    Args:
        scene: Points and facets.
        near: Point numbers, shape (k,).
        classes: Facets by size.
        bound: Bounds known so far, the reach at most [m], shape (k,).
    """
    bound = bound.copy()
    possible = np.zeros(len(near), dtype=bool)
    for members, tree, radius in classes:
        if not near.size:
            break
        slack = radius + _slack(scene, near, radius, bound)
        gap, index = tree.query(
            scene.points[near], distance_upper_bound=float((bound + slack).max()) * (1.0 + 1e-9)
        )
        hit = np.flatnonzero(gap <= bound + slack)
        possible[hit] = True
        _, distance = scene.closest(near[hit], members[np.asarray(index)[hit]])
        bound[hit] = np.minimum(bound[hit], distance)
    return np.where(possible, bound, -1.0)


def _slack(scene: _Scene, point: IntArray, radius: float, bound: FloatArray) -> FloatArray:
    """Return what a bound must grow by so that no tie is lost to rounding [m], shape (k,)."""
    finite = np.where(np.isfinite(bound), bound, 0.0)
    return 8.0 * ROUNDING * (np.abs(scene.points[point]).max(axis=1) + radius + finite)


def _candidates(
    scene: _Scene, near: IntArray, classes: list[_SizeClass], bound: FloatArray,
    admits: Admits | None = None,
) -> Iterator[tuple[IntArray, IntArray]]:  # fmt: skip
    """Pairs (point, facet) that may be closest, in portions with all pairs of their points."""
    alive = bound >= 0.0
    near, bound = near[alive], bound[alive]
    if not near.size:
        return
    radii = [
        bound + members.radius + _slack(scene, near, members.radius, bound) for members in classes
    ]
    count = np.zeros(len(near), dtype=np.int_)
    for members, radius in zip(classes, radii, strict=True):
        count += members.tree.query_ball_point(scene.points[near], radius, return_length=True)
    portion = (np.cumsum(count) - count) // _MAX_PAIRS
    starts = np.flatnonzero(np.diff(portion, prepend=-1))
    for first, last in zip(starts, np.append(starts[1:], len(near)), strict=True):
        part = near[first:last]
        pairs = [
            _in_balls(scene, part, members, radius[first:last])
            for members, radius in zip(classes, radii, strict=True)
        ]
        point = np.concatenate([pair[0] for pair in pairs])
        facet = np.concatenate([pair[1] for pair in pairs])
        limit = np.concatenate([pair[2] for pair in pairs])
        if admits is not None:
            faces = admits.faces(point, facet)
            point, facet, limit = point[faces], facet[faces], limit[faces]
        keep = _box_distance(scene, point, facet) <= limit
        yield point[keep], facet[keep]


def _in_balls(
    scene: _Scene, point: IntArray, size_class: _SizeClass, radius: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs whose centre lies in the point's ball, and the distance allowed [m], shape (p,)."""
    balls = size_class.tree.query_ball_point(scene.points[point], radius)
    length = np.fromiter(map(len, balls), np.int_, len(balls))
    index = np.fromiter(chain.from_iterable(balls), np.int_, length.sum())
    allowed = np.repeat(radius - size_class.radius, length)
    return np.repeat(point, length), size_class.members[index], allowed


def _box_distance(scene: _Scene, point: IntArray, facet: IntArray) -> FloatArray:
    """Distance from the facets' bounding boxes, a lower bound of the distance [m], shape (p,)."""
    x, corners = scene.points[point], scene.corners[facet]
    outside = np.maximum(corners.min(axis=1) - x, x - corners.max(axis=1))
    return np.linalg.norm(np.maximum(outside, 0.0), axis=1)


def _choose(
    scene: _Scene, limit: FloatArray, point: IntArray, facet: IntArray, result: Closest,
    admits: Admits | None = None,
) -> None:  # fmt: skip
    """Enter the best of all pairs of each point into the result."""
    xi, distance = scene.closest(point, facet)
    order = np.lexsort((facet, point))
    order = order[distance[order] <= limit[point[order]]]
    if admits is not None and admits.apart is not None:
        order = order[admits.apart(point[order], facet[order], distance[order])]
    if not order.size:
        return
    point, facet, xi, distance = point[order], facet[order], xi[order], distance[order]
    first = np.flatnonzero(np.diff(point, prepend=-1))
    least = np.minimum.reduceat(distance, first)
    least = np.repeat(least, np.diff(first, append=len(point)))
    tie = np.flatnonzero(distance <= least + scene.rounding(point, facet, distance))
    winner = tie[np.unique(point[tie], return_index=True)[1]]
    target = point[winner]
    result.facet[target] = facet[winner]
    result.xi[target] = xi[winner]
    result.distance[target] = distance[winner]


def _prefer(scene: _Scene, kept: Closest, preference: float, result: Closest) -> None:
    """Return to the current facet where it is about as close as the closest."""
    point = np.flatnonzero(kept.facet >= 0)
    facet, distance = kept.facet[point], kept.distance[point]
    margin = preference * scene.sizes[facet] + scene.rounding(point, facet, distance)
    keep = point[distance <= result.distance[point] + margin]
    result.facet[keep] = kept.facet[keep]
    result.xi[keep] = kept.xi[keep]
    result.distance[keep] = kept.distance[keep]
