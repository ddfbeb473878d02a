"""The closest-facet search against a search through all facets."""

import numpy as np
import pytest
from rotations import random_rotation

from dolfinx_nts.contact.search import ROUNDING, apart, closest_facets
from dolfinx_nts.kernels import compiled
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.kernels.vectors import range_of


@pytest.fixture(autouse=True, params=["all pairs", "trees"])
def way(request, monkeypatch):
    """Few points and facets are compared by all pairs, many by trees."""
    if request.param == "trees":
        monkeypatch.setattr(compiled, "_MOST_PAIRS", 0)


def brute_force(points, corners, reach, current=None, preference=1e-6):
    """All pairs, then the rules of `closest_facets` one point at a time, in plain words."""
    m = len(corners)
    reach = np.broadcast_to(reach, len(points))
    sizes = fc.size(corners)
    facet = np.full(len(points), -1)
    xi, distance = np.full((len(points), 2), np.nan), np.full(len(points), np.inf)
    pairs_xi, pairs_distance = compiled.closest_point(
        np.repeat(points, m, axis=0), np.tile(corners, (len(points), 1, 1))
    )
    for i, x in enumerate(points):
        all_xi, all_distance = (a[i * m : (i + 1) * m] for a in (pairs_xi, pairs_distance))
        allowed = all_distance <= reach[i]
        if not allowed.any():
            continue
        least = all_distance[allowed].min()
        noise = ROUNDING * (np.abs(x).max() + sizes + all_distance)
        best = np.flatnonzero(allowed & (all_distance <= least + noise))[0]
        if current is not None and current[i] >= 0 and allowed[current[i]]:
            c = current[i]
            if all_distance[c] <= least + noise[c] + preference * sizes[c]:
                best = c
        facet[i], xi[i], distance[i] = best, all_xi[best], all_distance[best]
    return facet, xi, distance


def assert_same(found, expected):
    assert np.array_equal(found.facet, expected[0])
    assert np.array_equal(found.xi, expected[1], equal_nan=True)
    assert np.array_equal(found.distance, expected[2])


def patch(cells, nc=4, wave=0.0, stretch=1.0):
    """A (wavy) sheet of cells^2 quadrilaterals, or twice as many triangles, edges about 1."""
    line = np.arange(cells + 1.0) if stretch == 1.0 else stretch ** np.arange(cells + 1.0)
    x, y = np.meshgrid(line, line, indexing="ij")
    grid = np.stack([x, y, wave * np.sin(1.3 * x) * np.cos(0.9 * y)], axis=2)
    quads = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
    quads = quads.reshape(-1, 4, 3)
    return quads if nc == 4 else np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def special_points(rng, corners, n):
    """Points over interiors, edge midpoints and corners, on the surface and off it, and far."""
    chosen = corners[rng.integers(len(corners), size=n)]
    nc = corners.shape[1]
    weights = rng.dirichlet(np.ones(nc), n)
    side = rng.integers(nc, size=n)
    rows = np.arange(n)
    kind = rng.integers(4, size=n)
    weights[kind > 0] = 0.0
    weights[rows[kind == 1], side[kind == 1]] = 0.5
    weights[rows[kind == 1], (side[kind == 1] + 1) % nc] = 0.5
    weights[rows[kind >= 2], side[kind >= 2]] = 1.0
    points = np.einsum("ni,nij->nj", weights, chosen)
    points[:, 2] += rng.choice([0.0, 0.1, -0.3, 2.0], n)
    points[kind == 3] += rng.normal(scale=3.0, size=(np.count_nonzero(kind == 3), 3))
    return points


@pytest.mark.parametrize("nc", [3, 4])
@pytest.mark.parametrize("wave", [0.0, 0.4])
def test_against_brute_force_on_sheets(nc, wave):
    rng = np.random.default_rng(1)
    corners = patch(5, nc, wave)
    points = special_points(rng, corners, 1500)
    current = rng.integers(-1, len(corners), 1500)
    reach = rng.choice([0.05, 0.5, 3.0, np.inf], 1500)
    found = closest_facets(points, corners, reach=reach)
    assert_same(found, brute_force(points, corners, reach))
    found = closest_facets(points, corners, reach=reach, current=current, preference=0.1)
    expected = brute_force(points, corners, reach, current, 0.1)
    assert_same(found, expected)
    assert -1 in expected[0] and (expected[0] == current)[current >= 0].any()


@pytest.mark.parametrize("nc", [3, 4])
def test_against_brute_force_on_soups(nc):
    rng = np.random.default_rng(2)
    for trial in range(50):
        m = rng.integers(1, 30)
        scale = np.exp(rng.uniform(-4.0, 1.0, (m, 1, 1)) * (trial % 2))
        corners = rng.uniform(-2, 2, (m, 1, 3)) + scale * rng.normal(size=(m, nc, 3))
        points = rng.uniform(-3, 3, (20, 3))
        reach = rng.choice([0.3, np.inf])
        current = rng.integers(-1, m, 20)
        found = closest_facets(points, corners, reach=reach, current=current)
        assert_same(found, brute_force(points, corners, reach, current))


def test_against_brute_force_on_strongly_graded_sheet():
    rng = np.random.default_rng(3)
    corners = patch(8, stretch=3.0)
    points = np.exp(rng.uniform(-1.0, 9.0, (400, 3))) * [1.0, 1.0, 0.01]
    assert_same(closest_facets(points, corners, reach=50.0), brute_force(points, corners, 50.0))


@pytest.mark.parametrize("nc", [3, 4])
@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_ties_go_to_the_lowest_facet(nc, offset):
    rng = np.random.default_rng(4)
    flat = patch(6, nc)
    low, high = flat.min(axis=1), flat.max(axis=1)
    grid = np.stack(np.meshgrid(*[np.arange(0.0, 6.5, 0.5)] * 2), axis=2).reshape(-1, 2)
    touching = ((low[:, None, :2] <= grid) & (grid <= high[:, None, :2])).all(axis=2)
    on_diagonal = np.isclose(grid[:, 0] - grid[:, 1] - low[:, None, 0] + low[:, None, 1], 0.0)
    lower = (grid[:, 0] - low[:, None, 0]) > (grid[:, 1] - low[:, None, 1])
    if nc == 3:
        first_half = (np.arange(len(flat)) < len(flat) // 2)[:, None]
        touching &= on_diagonal | (lower == first_half)
    expected = touching.argmax(axis=0)
    for height in (0.0, 0.3, -2.0):
        points = np.column_stack([grid, np.full(len(grid), height)])
        for _ in range(5):
            turn, shift = random_rotation(rng), offset * rng.normal(size=3)
            found = closest_facets(points @ turn.T + shift, flat @ turn.T + shift, reach=5.0)
            assert np.array_equal(found.facet, expected)


def test_ridge_seen_from_outside_is_a_tie():
    ridge = np.array(
        [
            [[0.0, 0, 0], [0, 1, 0], [-1, 1, -1], [-1, 0, -1]],
            [[0.0, 0, 0], [1, 0, -1], [1, 1, -1], [0, 1, 0]],
        ]
    )
    points = np.column_stack([np.zeros(50), np.linspace(0, 1, 50), np.linspace(0.01, 2, 50)])
    for order in ([0, 1], [1, 0]):
        found = closest_facets(points, ridge[order], reach=5.0)
        assert (found.facet == 0).all()
        assert np.allclose(found.distance, points[:, 2], rtol=1e-14)


@pytest.mark.parametrize("n, m", [(0, 5), (5, 0), (0, 0)])
def test_empty_input(n, m):
    current = np.full(n, -1)
    found = closest_facets(np.zeros((n, 3)), np.zeros((m, 4, 3)), reach=1.0, current=current)
    assert found.facet.shape == found.distance.shape == (n,) and found.xi.shape == (n, 2)
    assert (found.facet == -1).all()
    assert np.isnan(found.xi).all() and np.isinf(found.distance).all()


def test_reach_is_inclusive_and_per_point():
    corners = patch(2)
    points = np.array([[0.5, 0.5, 0.25], [0.5, 0.5, 0.25], [0.5, 0.5, -0.25], [0.5, 0.5, 50.0]])
    found = closest_facets(points, corners, reach=np.array([0.25, 0.2, 0.3, np.inf]))
    assert np.array_equal(found.facet, [0, -1, 0, 0])
    assert (closest_facets(points[3:], corners, reach=1.0).facet == -1).all()
    on_surface = points * [1.0, 1.0, 0.0]
    assert (closest_facets(on_surface, corners, reach=0.0).facet == 0).all()


def test_current_facet_is_kept_near_the_shared_edge_only():
    corners = patch(2)
    x = 1.0 + np.array([-1e-3, -1e-9, 0.0, 1e-9, 1e-3])
    points = np.column_stack([x, np.full(5, 0.5), np.zeros(5)])
    assert np.array_equal(closest_facets(points, corners, reach=1.0).facet, [0, 0, 0, 2, 2])
    keep = closest_facets(points, corners, reach=1.0, current=np.full(5, 2))
    assert np.array_equal(keep.facet, [0, 2, 2, 2, 2])
    assert np.allclose(keep.xi[1:3], [[-1.0, 0.0]] * 2, rtol=0, atol=1e-14)
    keep = closest_facets(points, corners, reach=1.0, current=np.full(5, 0))
    assert np.array_equal(keep.facet, [0, 0, 0, 0, 2])
    wide = closest_facets(points, corners, reach=1.0, current=np.full(5, 2), preference=0.01)
    assert (wide.facet == 2).all()
    none = closest_facets(points, corners, reach=1.0, current=np.full(5, 2), preference=0.0)
    assert np.array_equal(none.facet, [0, 0, 2, 2, 2])


def test_current_facet_out_of_reach_is_dropped():
    corners = patch(2)
    points = np.array([[0.5, 0.5, 0.5]])
    assert closest_facets(points, corners, reach=0.4, current=np.array([0])).facet[0] == -1


def test_many_ties_come_in_several_portions(monkeypatch):
    rng = np.random.default_rng(6)
    directions = rng.normal(size=(200, 1, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    corners = directions + 0.01 * rng.normal(size=(200, 3, 3))
    points = 0.01 * rng.normal(size=(50, 3))
    monkeypatch.setattr("dolfinx_nts.contact.search._MAX_PAIRS", 700)
    assert_same(closest_facets(points, corners, reach=5.0), brute_force(points, corners, 5.0))


def test_input_is_not_changed():
    rng = np.random.default_rng(7)
    corners, points, current = patch(3), rng.uniform(0, 3, (20, 3)), np.zeros(20, dtype=int)
    copies = corners.copy(), points.copy(), current.copy()
    closest_facets(points, corners, reach=1.0, current=current)
    assert all(
        np.array_equal(a, b) for a, b in zip(copies, (corners, points, current), strict=True)
    )


def test_bad_input_is_named():
    corners, points = patch(2), np.zeros((3, 3))
    broken = points.copy()
    broken[1, 2] = np.nan
    with pytest.raises(ValueError, match="Point 1 has coordinates"):
        closest_facets(broken, corners, reach=1.0)
    with pytest.raises(ValueError, match="Facet 2 has coordinates"):
        closest_facets(points, np.where(np.arange(4)[:, None, None] == 2, np.inf, corners), reach=1)
    with pytest.raises(ValueError, match="reach"):
        closest_facets(points, corners, reach=-1.0)
    with pytest.raises(ValueError, match="preference"):
        closest_facets(points, corners, reach=1.0, preference=-1.0)
    with pytest.raises(ValueError, match="names facet 4"):
        closest_facets(points, corners, reach=1.0, current=np.full(3, 4))
    with pytest.raises(ValueError, match="corners must have shape"):
        closest_facets(points, corners[0], reach=1.0)


def test_boxes_are_apart_by_their_largest_gap():
    """Along one axis, in either order; a reach of that gap, up to rounding, is not enough."""
    facet = np.array([[[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
    for axis in range(3):
        for way in (-1.0, 1.0):
            points = np.full((2, 3), 0.5 * (np.arange(3) < 2))
            points[:, axis] += way * (3.0 + 0.5 * (axis < 2))
            gap = 3.0
            assert apart(points, facet, gap - 1e-9) and not apart(points, facet, gap)
    assert not apart(facet[0], facet, 0.0)


@pytest.mark.parametrize("n", [0, 1, 7])
def test_range_of_vectors(n):
    rng = np.random.default_rng(n)
    moved, around = rng.normal(size=(n, 3)), rng.random((n, 3))
    for width in (0.0, around):
        high, low = (
            [max((side[:, i]).tolist(), default=-np.inf) for i in range(3)]
            for side in (moved + width, -moved + width)
        )
        assert range_of(moved.ravel(), width).tolist() == [high, low]
