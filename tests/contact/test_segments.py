"""Pieces of facets that lie over others, against hulls of all corners and crossings."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from dolfinx_nts.contact.segments import near, segments
from dolfinx_nts.kernels import facets

RNG = np.random.default_rng(5)


def grid(cells, height=0.0, jitter=0.0, triangles=False, down=False, shift=0.0):
    """Facets of the unit square at a height, inner corners moved by a part of a cell."""
    x, y = np.meshgrid(*[np.linspace(0, 1, n + 1) for n in cells], indexing="ij")
    place = np.stack([x, y, np.full_like(x, height)], axis=-1)
    inner = place[1:-1, 1:-1]
    inner[..., :2] += jitter / max(cells) * RNG.uniform(-1, 1, inner[..., :2].shape)
    place[..., 0] += shift
    corners = place[:-1, :-1], place[1:, :-1], place[1:, 1:], place[:-1, 1:]
    found = np.stack(corners, axis=2).reshape(-1, 4, 3)
    if down:
        found = found[:, ::-1]
    if triangles:
        found = np.concatenate([found[:, [0, 1, 2]], found[:, [0, 2, 3]]])
    return np.ascontiguousarray(found)


def over(own, other, reach=0.1):
    return segments(own, other, near(own, other, reach))


def places(own, points):
    """Where points are, and the area that each stands for."""
    shape, slopes, _ = facets.shape(points.xi, own.shape[1])
    x = np.einsum("nk,nki->ni", shape, own[points.own])
    sides = np.einsum("nka,nki->nai", slopes, own[points.own])
    return x, points.weight * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)


def crossing_area(one, two):
    """Area common to two convex polygons (k, 2): the hull of corners inside and of crossings."""

    def inside(p, polygon):
        edges = np.roll(polygon, -1, axis=0) - polygon
        away = p - polygon
        return (edges[:, 0] * away[:, 1] - edges[:, 1] * away[:, 0] >= 0).all()

    found = [p for p in one if inside(p, two)] + [p for p in two if inside(p, one)]
    for a, b in zip(one, np.roll(one, -1, axis=0), strict=True):
        for c, d in zip(two, np.roll(two, -1, axis=0), strict=True):
            matrix = np.column_stack([b - a, c - d])
            if abs(np.linalg.det(matrix)) > 1e-12:
                s, t = np.linalg.solve(matrix, c - a)
                if 0 <= s <= 1 and 0 <= t <= 1:
                    found.append(a + s * (b - a))
    if len(found) < 3 or np.linalg.matrix_rank(np.array(found) - found[0], tol=1e-9) < 2:
        return 0.0
    return ConvexHull(found).volume


@pytest.mark.parametrize(("own", "other"), [(4, 4), (4, 3), (3, 4), (3, 3)])
def test_areas_of_facets_that_lie_anyhow(own, other):
    n, angles = 200, RNG.uniform(0, 2 * np.pi, 200)

    def some(corners, shift, turn):
        at = np.sort(RNG.uniform(0, 2 * np.pi, (n, corners)), axis=1)
        x = np.stack([np.cos(at), np.sin(at)], axis=-1) + shift
        return np.concatenate([x, np.full((n, corners, 1), turn)], axis=-1)

    a, b = some(own, 0.0, 0.0)[:, ::-1].copy(), some(other, RNG.uniform(-1, 1, (n, 1, 2)), 0.1)
    if own == 4:  # only of parallelograms do the coordinates keep edges straight
        a[:, 3] = a[:, 0] + a[:, 2] - a[:, 1]
    c, s, none = np.cos(angles), np.sin(angles), np.zeros(n)
    turn = np.array([[c, none, s], [none, none + 1, none], [-s, none, c]]).transpose(2, 0, 1)
    flat = [x[..., :2] for x in (a, b)]
    a, b = (np.matmul(x, turn.transpose(0, 2, 1)) for x in (a, b))
    points = segments(a, b, (np.arange(n), np.arange(n)))
    assert np.array_equal(points.own, points.other)
    assert points.weight.min() > 0.0
    _, area = places(a, points)
    found = np.bincount(points.own, area, n)
    expected = np.array([crossing_area(p[::-1], q) for p, q in zip(*flat, strict=True)])
    assert (expected == 0.0).sum() > 5
    assert np.abs(found - expected).max() < 1e-12


@pytest.mark.parametrize("own", ["quadrilaterals", "triangles"])
@pytest.mark.parametrize("other", ["quadrilaterals", "triangles"])
def test_all_of_a_facet_is_covered_once(own, other):
    """With integrals of quadratics over parallelograms and triangles, exact piece by piece."""
    triangles = own == "triangles"
    a = grid((3, 3), jitter=0.4 * triangles, triangles=triangles, down=True)
    b = grid((4, 5), 0.02, jitter=0.4, triangles=other == "triangles")
    points = over(a, b)
    whole = {3: 0.5, 4: 4.0}[a.shape[1]]
    assert np.abs(np.bincount(points.own, points.weight) - whole).max() < 1e-14 * 4
    x, area = places(a, points)
    for power in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2)):
        expected = 1 / (power[0] + 1) / (power[1] + 1)
        assert abs(area @ (x[:, 0] ** power[0] * x[:, 1] ** power[1]) - expected) < 1e-14


@pytest.mark.parametrize("shift", [0.0, 1e-16, -1e-15, 1e-13, 1e-9, -1e-6, 1e-3])
def test_slivers(shift):
    """Meshes that match but for a shift: what is lost is rounding, and no weight is negative."""
    a, b = grid((3, 4), down=True), grid((3, 4), 0.01, shift=shift)
    points = over(a, b)
    assert points.weight.min() > 0.0
    x, area = places(a, points)
    assert abs(area.sum() - (1.0 - abs(shift))) < 1e-11
    assert abs(area @ x[:, 0] - 0.5 * (1.0 - shift * abs(shift) + shift - abs(shift))) < 1e-11
    if abs(shift) < 1e-13:
        assert len(points.own) == 4 * 12


def test_facets_that_warp():
    """Both sides of a fine warped surface cover each other as far as its facets are flat."""
    off = []
    for n in (4, 8):
        a, b = grid((n, n), down=True), grid((n + 1, n - 1), 0.0)
        for x in (a, b):
            x[..., 2] = 0.3 * x[..., 0] * x[..., 1] + 0.1 * np.sin(3 * x[..., 0])
        points = over(a, b)
        covered = np.bincount(points.own, points.weight, len(a)) / 4.0
        off.append(np.abs(covered - 1).max())
        assert points.weight.min() > 0.0
    assert off[0] < 2e-3 and off[1] < 0.5 * off[0]


def test_a_corner_that_points_inwards():
    a = grid((1, 1), down=True)
    b = np.array([[[0.0, 0, 0.1], [1, 0, 0.1], [0.3, 0.3, 0.1], [0, 1, 0.1]]])
    points = over(a, b, 0.2)
    _, area = places(a, points)
    assert abs(area.sum() - 0.3) < 1e-15 and points.weight.min() > 0.0


def test_facets_that_do_not_face_each_other():
    a, b = grid((2, 2), down=True), grid((2, 2), 0.01, down=True)
    assert not len(over(a, b).own)
    assert not len(over(a, grid((2, 2), 0.2)).own)
    assert not len(over(a[:0], b).own) and not len(over(a, b[:0]).own)


def test_pairs_are_those_of_boxes():
    a, b = (RNG.uniform(0, 1, (n, 4, 3)) * 0.2 + RNG.uniform(0, 1, (n, 1, 3)) for n in (40, 60))
    one, two = near(a, b, 0.05)
    low = np.maximum(a.min(axis=1)[:, None], b.min(axis=1)[None] - 0.05)
    high = np.minimum(a.max(axis=1)[:, None], b.max(axis=1)[None] + 0.05)
    expected = np.argwhere((low <= high).all(axis=2))
    assert np.array_equal(np.column_stack([one, two]), expected)
