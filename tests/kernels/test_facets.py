"""Shape functions, projections and closest points of single facets."""

import numpy as np
import pytest
from facet_kinds import FLAT
from rotations import random_rotation
from scipy.optimize import minimize

from dolfinx_nts.kernels import compiled
from dolfinx_nts.kernels import facets as fc

KINDS = (3, 4)


def random_facets(rng, n, nc, warp):
    return FLAT[nc] + warp * rng.uniform(-1.0, 1.0, (n, nc, 3))


def inside(rng, n, nc):
    xi = rng.uniform(-1.0, 1.0, (n, 2))
    if nc == 4:
        return xi
    xi = np.abs(xi)
    return np.where(xi.sum(axis=1, keepdims=True) > 1.0, 1.0 - xi, xi)


def samples(nc, m):
    """A dense grid over the closed reference facet."""
    line = np.linspace(-1.0, 1.0, m) if nc == 4 else np.linspace(0.0, 1.0, m)
    grid = np.stack(np.meshgrid(line, line), axis=2).reshape(-1, 2)
    return grid if nc == 4 else grid[grid.sum(axis=1) <= 1.0 + 1e-14]


def surface_point(corners, xi):
    return np.einsum("ni,nij->nj", fc.shape(xi, corners.shape[1])[0], corners)


@pytest.mark.parametrize("nc", KINDS)
def test_shape_is_one_at_its_corner_and_sums_to_one(nc):
    reference = {3: [[0, 0], [1, 0], [0, 1]], 4: [[-1, -1], [1, -1], [1, 1], [-1, 1]]}[nc]
    assert np.array_equal(fc.shape(np.array(reference, dtype=float), nc)[0], np.eye(nc))
    xi = np.random.default_rng(2).uniform(-2, 2, (20, 2))
    values, first, second = fc.shape(xi, nc)
    assert np.allclose(values.sum(axis=1), 1.0, rtol=0, atol=1e-14)
    assert np.allclose(first.sum(axis=1), 0.0, atol=1e-14)
    assert np.allclose(second.sum(axis=1), 0.0, atol=1e-14)


def test_other_facets_are_refused():
    for call in (
        lambda: fc.shape(np.zeros((1, 2)), 8),
        lambda: fc.edge_excess(np.zeros((1, 2)), 6),
        lambda: fc.areas(np.zeros((1, 2, 3))),
        lambda: compiled.closest_point(np.zeros((1, 3)), np.zeros((1, 5, 3))),
    ):
        with pytest.raises(ValueError, match="3 .triangle. or 4 .quadrilateral."):
            call()


@pytest.mark.parametrize("nc", KINDS)
def test_frame(nc):
    rng = np.random.default_rng(3)
    corners, xi, step = random_facets(rng, 30, nc, 0.2), inside(rng, 30, nc), 1e-6
    point, tangents, normal = fc.frame(corners, xi)
    assert np.allclose(point, surface_point(corners, xi), rtol=0, atol=1e-15)
    for a in range(2):
        shift = step * np.eye(2)[a]
        change = surface_point(corners, xi + shift) - surface_point(corners, xi - shift)
        assert np.allclose(change / (2 * step), tangents[:, a], rtol=0, atol=1e-9)
    assert np.allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=0, atol=1e-15)
    assert np.allclose(np.einsum("naj,nj->na", tangents, normal), 0.0, atol=1e-15)
    assert (normal[:, 2] > 0.0).all()


@pytest.mark.parametrize("nc", KINDS)
def test_size_is_invariant_and_homogeneous(nc):
    rng = np.random.default_rng(4)
    corners = random_facets(rng, 10, nc, 0.3)
    moved = corners @ random_rotation(rng).T + rng.normal(size=3)
    assert np.allclose(fc.size(moved), fc.size(corners), rtol=1e-14)
    assert np.allclose(fc.size(1e6 * corners), 1e6 * fc.size(corners), rtol=1e-14)
    assert np.allclose(fc.size(np.roll(corners, 1, axis=1)), fc.size(corners), rtol=1e-14)


def excess(xi, nc):
    """How far coordinates lie outside the reference facet; 0 inside."""
    return np.maximum(fc.edge_excess(xi, nc).max(axis=1), 0.0)


def test_excess():
    xi = np.array([[0.0, 0.0], [1.0, -1.0], [1.5, 0.0], [-1.2, -1.1]])
    assert np.allclose(excess(xi, 4), [0.0, 0.0, 0.5, 0.2], rtol=0, atol=1e-15)
    xi = np.array([[0.2, 0.3], [0.0, 1.0], [-0.25, 0.5], [0.75, 0.5]])
    assert np.allclose(excess(xi, 3), [0.0, 0.0, 0.5, 0.5], rtol=0, atol=1e-15)


def test_areas_of_flat_facets():
    rotation = random_rotation(np.random.default_rng(5))
    trapezoid = np.array([[0.0, 0, 0], [3, 0, 0], [2, 2, 0], [1, 2, 0]]) @ rotation.T
    assert np.allclose(fc.areas(trapezoid[None]), 4.0, rtol=1e-14)
    assert np.allclose(fc.areas(trapezoid[None, :3]), 3.0, rtol=1e-14)


def test_area_of_warped_facet_against_fine_quadrature():
    corners = random_facets(np.random.default_rng(6), 5, 4, 0.1)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    exact = np.zeros(5)
    for s, weight_s in zip(nodes, weights, strict=True):
        for t, weight_t in zip(nodes, weights, strict=True):
            _, a, _ = fc.frame(corners, np.tile([s, t], (5, 1)))
            exact += weight_s * weight_t * np.linalg.norm(np.cross(a[:, 0], a[:, 1]), axis=1)
    assert np.allclose(fc.areas(corners), exact, rtol=1e-4)


def test_tributary_areas():
    x, y = np.meshgrid(np.arange(4.0), np.arange(3.0), indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(12)])
    first = np.array([3 * i + j for i in range(3) for j in range(2)])
    quads = first[:, None] + np.array([0, 3, 4, 1])
    expected = np.outer([0.5, 1, 1, 0.5], [0.5, 1, 0.5]).ravel()
    area = fc.tributary_areas(quads, points[quads], 13)
    assert np.allclose(area, np.append(expected, 0.0), rtol=0, atol=1e-14)
    triangles = np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    area = fc.tributary_areas(triangles, points[triangles], 12)
    assert np.isclose(area.sum(), 6.0, rtol=1e-14) and np.isclose(area[0], 2 * 0.5 / 3)
    trapezoid = np.array([[0.0, 0, 0], [3, 0, 0], [2, 2, 0], [1, 2, 0]])
    area = fc.tributary_areas(np.array([[0, 1, 2, 3]]), trapezoid[None], 4)
    assert np.allclose(area, [7 / 6, 7 / 6, 5 / 6, 5 / 6], rtol=1e-14)


@pytest.mark.parametrize("nc", KINDS)
@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_projection_is_orthogonal_to_round_off(nc, unit):
    rng = np.random.default_rng(7)
    n = 500
    corners = unit * random_facets(rng, n, nc, 0.15)
    points = unit * rng.uniform([-0.5, -0.5, -0.3], [1.5, 1.5, 0.3], (n, 3))
    xi, converged = fc.project(points, corners, np.zeros((n, 2)))
    point, tangents, _ = fc.frame(corners, xi)
    residual = np.einsum("nj,naj->na", points - point, tangents)
    assert converged.all()
    assert np.abs(residual).max() <= 5e-15 * unit**2 * (1.0 + np.abs(xi).max())
    assert excess(xi, nc).max() > 0.5


def test_projection_never_moves_away_from_the_point():
    rng = np.random.default_rng(10)
    corners, points = random_facets(rng, 2000, 4, 1.0), rng.uniform(-2, 3, (2000, 3))
    start = inside(rng, 2000, 4)
    xi, converged = fc.project(points, corners, start)
    before = np.linalg.norm(surface_point(corners, start) - points, axis=1)
    after = np.linalg.norm(surface_point(corners, xi) - points, axis=1)
    assert np.isfinite(xi).all() and (after <= before * (1 + 1e-14)).all()
    assert converged.mean() > 0.99


def test_projection_onto_facet_without_area_reports_failure():
    corners = np.zeros((1, 4, 3))
    xi, converged = fc.project(np.ones((1, 3)), corners, np.full((1, 2), 0.25))
    assert not converged[0] and np.array_equal(xi, [[0.25, 0.25]])


@pytest.mark.parametrize("nc", KINDS)
@pytest.mark.parametrize("warp", [0.0, 0.1, 0.3, 1.0])
def test_closest_point_against_dense_sampling(nc, warp):
    rng = np.random.default_rng(11)
    n = 400
    corners, points = random_facets(rng, n, nc, warp), rng.uniform(-1, 2, (n, 3))
    xi, distance = compiled.closest_point(points, corners)
    grid = fc.shape(samples(nc, 41), nc)[0]
    sampled = np.linalg.norm(np.einsum("gi,nij->ngj", grid, corners) - points[:, None], axis=2)
    assert (distance <= sampled.min(axis=1) + 1e-14).all()
    assert (sampled.min(axis=1) <= distance + 0.15).all()
    assert (excess(xi, nc) <= 1e-15).all()
    foot = surface_point(corners, xi)
    assert np.allclose(np.linalg.norm(foot - points, axis=1), distance, rtol=1e-14)


@pytest.mark.parametrize("warp", [0.1, 0.5, 1.0])
@pytest.mark.fast("1.0")
def test_closest_point_against_bounded_minimisation(warp):
    rng = np.random.default_rng(12)
    corners, points = random_facets(rng, 25, 4, warp), rng.uniform(-0.5, 1.5, (25, 3))
    _, distance = compiled.closest_point(points, corners)
    for x, facet, found in zip(points, corners, distance, strict=True):

        def square(xi, x=x, facet=facet):
            offset = surface_point(facet[None], xi[None])[0] - x
            return offset @ offset

        starts = samples(4, 4)
        best = min(
            minimize(square, start, bounds=[(-1, 1)] * 2, method="L-BFGS-B").fun for start in starts
        )
        assert np.isclose(found**2, best, rtol=1e-6, atol=1e-9)
        assert found**2 <= best * (1 + 1e-12) + 1e-15


@pytest.mark.parametrize("nc", KINDS)
def test_closest_point_on_edges_and_corners(nc):
    facet = FLAT[nc]
    outward = facet - facet.mean(axis=0)
    beyond_corners = facet + outward + [0.0, 0.0, 0.3]
    xi, _ = compiled.closest_point(beyond_corners, np.tile(facet, (nc, 1, 1)))
    assert np.allclose(fc.shape(xi, nc)[0], np.eye(nc), rtol=0, atol=1e-15)
    middle = 0.5 * (facet + np.roll(facet, -1, axis=0))
    edge = np.roll(facet, -1, axis=0) - facet
    normal = np.cross(edge, [0.0, 0.0, 1.0]) / np.linalg.norm(edge, axis=1, keepdims=True)
    xi, distance = compiled.closest_point(middle + 0.7 * normal, np.tile(facet, (nc, 1, 1)))
    expected = 0.5 * (np.eye(nc) + np.roll(np.eye(nc), -1, axis=0))
    assert np.allclose(fc.shape(xi, nc)[0], expected, rtol=0, atol=1e-15)
    assert np.allclose(distance, 0.7, rtol=1e-14)


def test_closest_point_of_a_saddle_seen_from_its_axis():
    corners = np.array([[[-1.0, -1, 1], [1, -1, -1], [1, 1, 1], [-1, 1, -1]]])
    for height in (-3.0, -1.5, 1.5, 3.0):
        points = np.array([[0.0, 0.0, height]])
        _, distance = compiled.closest_point(points, corners)
        grid = surface_point(np.repeat(corners, 161**2, 0), samples(4, 161))
        sampled = np.linalg.norm(grid - points, axis=1).min()
        assert distance[0] < abs(height) and np.isclose(distance[0], sampled, rtol=1e-3)


def test_closest_point_of_triangles_without_area():
    """Three corners on a line: the closest point of the longest edge."""
    rng = np.random.default_rng(21)
    start, along = rng.normal(size=(2, 1000, 3))
    at = np.sort(rng.uniform(size=(1000, 3)), axis=1)
    corners = start[:, None] + at[:, rng.permutation(3), None] * along[:, None]
    points = rng.normal(size=(1000, 3))
    t = np.einsum("ni,ni->n", points - start, along) / np.einsum("ni,ni->n", along, along)
    foot = start + t.clip(at[:, 0], at[:, 2])[:, None] * along
    _, distance = compiled.closest_point(points, corners)
    assert np.allclose(distance, np.linalg.norm(points - foot, axis=1), rtol=1e-9, atol=0)


@pytest.mark.parametrize("nc", KINDS)
@pytest.mark.parametrize("warp", [0.1, 0.5])
def test_closest_point_does_not_depend_on_units_or_motion(nc, warp):
    rng = np.random.default_rng(15)
    corners, points = random_facets(rng, 300, nc, warp), rng.uniform(-1, 2, (300, 3))
    xi, distance = compiled.closest_point(points, corners)
    for unit in (1e-9, 1e6):
        scaled, scaled_distance = compiled.closest_point(unit * points, unit * corners)
        assert np.allclose(scaled, xi, rtol=0, atol=1e-10)
        assert np.allclose(scaled_distance, unit * distance, rtol=1e-12)
    rotation, shift = random_rotation(rng).T, rng.normal(size=3)
    turned = points @ rotation + shift, corners @ rotation + shift
    moved, moved_distance = compiled.closest_point(*turned)
    assert np.allclose(moved, xi, rtol=0, atol=1e-10)
    assert np.allclose(moved_distance, distance, rtol=1e-12)


def test_far_points_keep_their_digits():
    corners = random_facets(np.random.default_rng(16), 1, 4, 0.0)
    for height in (1e3, 1e6):
        xi, distance = compiled.closest_point(np.array([[0.3, 0.6, height]]), corners)
        assert np.allclose(xi, [[-0.4, 0.2]], rtol=0, atol=1e-14)
        assert np.isclose(distance[0], height, rtol=1e-15)


def test_collapsed_facets():
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 0]])
    line = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
    dot = np.zeros((4, 3))
    points = np.array([[0.7, 0.2, 0.5], [0.5, 0.0, 2.0], [0.0, 3.0, 4.0]])
    xi, distance = compiled.closest_point(points, np.stack([triangle, line, dot]))
    assert np.isfinite(xi).all()
    assert np.allclose(distance, [0.5, 2.0, 5.0], rtol=1e-14)
    xi, distance = compiled.closest_point(points[1:], np.stack([line, dot])[:, :3])
    assert np.isfinite(xi).all()
    assert np.allclose(distance, [2.0, 5.0], rtol=1e-14)
