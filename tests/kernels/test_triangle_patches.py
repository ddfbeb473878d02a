"""Smooth patches over triangles: tangent planes along edges, rims, sharp edges, precision."""

import numpy as np
import pytest
from facet_kinds import LINE
from rotations import random_rotation
from scipy.spatial import ConvexHull, Delaunay

from dolfinx_nts.kernels import compiled
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.kernels import triangle_patches as tp

CORNER = np.array([[0.0, 0], [1, 0], [0, 1]])


def disc(rng, inner=40, rim=16):
    """Triangles of random points in a circle."""
    turn = 2 * np.pi / rim * np.arange(rim)
    radius, angle = 0.9 * np.sqrt(rng.uniform(size=inner)), rng.uniform(0, 7, inner)
    radius, angle = np.r_[np.ones(rim), radius], np.r_[turn, angle]
    x = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    for _ in range(20):
        t = Delaunay(x).simplices
        mean = np.array([x[np.unique(t[(t == i).any(axis=1)])].mean(axis=0) for i in range(len(x))])
        x[rim:] = mean[rim:]
    t = Delaunay(x).simplices
    a, b = x[t[:, 1]] - x[t[:, 0]], x[t[:, 2]] - x[t[:, 0]]
    turned = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
    t[turned] = t[turned][:, ::-1]
    return np.column_stack([x, np.zeros(len(x))]), t


def sphere(rng, n):
    """Triangles of n points that are spread over a unit sphere."""
    x = rng.normal(size=(n, 3))
    for _ in range(8):
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        t = ConvexHull(x).simplices
        total = x.copy()
        for i, j in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2)):
            np.add.at(total, t[:, i], x[t[:, j]])
        x = total
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    t = ConvexHull(x).simplices
    normal = np.cross(x[t[:, 1]] - x[t[:, 0]], x[t[:, 2]] - x[t[:, 0]])
    inward = (normal * x[t].mean(axis=1)).sum(axis=1) < 0
    t[inward] = t[inward][:, ::-1]
    return x, t


def cube(n=2):
    """The surface of a cube, n^2 squares a side, each cut along a diagonal; edges are sharp."""
    x = np.stack(np.meshgrid(*[np.arange(n + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    number, t = np.arange(len(x)).reshape([n + 1] * 3), []
    for axis in range(3):
        for end in (0, n):
            side = np.take(number, end, axis=axis)
            a, b, c, d = side[:-1, :-1], side[1:, :-1], side[1:, 1:], side[:-1, 1:]
            t += [np.stack(k, axis=-1).reshape(-1, 3) for k in ((a, b, c), (a, c, d))]
    t = np.concatenate(t)
    centre = x[t].mean(axis=1) - n / 2
    normal = np.cross(x[t[:, 1]] - x[t[:, 0]], x[t[:, 2]] - x[t[:, 0]])
    inward = (normal * centre).sum(axis=1) < 0
    t[inward] = t[inward][:, ::-1]
    return x.astype(float), t


def bent(x, height=0.3):
    """A flat mesh bent to waves."""
    return x + np.column_stack(
        [0 * x[:, 0], 0 * x[:, 0], height * np.sin(2 * x[:, 0] + 1) * np.cos(1.5 * x[:, 1])]
    )


def shuffled(rng, facets):
    """The same facets in another order, each starting at another corner."""
    start = rng.integers(3, size=len(facets))[:, None]
    facets = np.take_along_axis(facets, (start + np.arange(3)) % 3, axis=1)
    return facets[rng.permutation(len(facets))]


SURFACES = {
    "disc": lambda rng: disc(rng),
    "waves": lambda rng: (lambda x, t: (bent(x), t))(*disc(rng)),
    "sphere": lambda rng: sphere(rng, 60),
    "cube": lambda rng: cube(),
}


def made(name, seed=1):
    rng = np.random.default_rng(seed)
    x, t = SURFACES[name](rng)
    return rng, x, shuffled(rng, t)


def net(x, facets, reference):
    """Control points (m, 3, 15, 3) at x (p, 3), and which facets are irregular."""
    points, weights, irregular = tp.control_net(facets, reference)
    assert np.array_equal(points[:, :3], facets)
    assert np.abs(weights.sum(axis=3) - 1).max() < 2e-15 * np.abs(weights).max()
    return np.einsum("mkap,mpi->mkai", weights, x[points]), irregular


def at(control, xi):
    """Points and normals of patches (n, 15, 3), one after another, at xi (n, 2)."""
    point, _, normal = fc.frame(control, xi)
    return point, normal


def edges(facets):
    """Pairs of (facet, edge) that share an edge; the second runs against the first."""
    place, pairs = {}, []
    for f, corners in enumerate(facets):
        for k in range(3):
            ends = (corners[k], corners[(k + 1) % 3])
            if ends[::-1] in place:
                pairs.append((place[ends[::-1]], (f, k)))
            place[ends] = (f, k)
    return pairs


def beside(control, pairs):
    """Points and normals along the edges of pairs, seen from both sides: (pairs, 9, 3) each."""
    sides = []
    for side, share in enumerate(((1 + LINE) / 2, (1 - LINE) / 2)):
        where = np.array([p[side] for p in pairs])
        f, k = where.T
        xi = CORNER[k][:, None] + share[:, None] * (CORNER[(k + 1) % 3] - CORNER[k])[:, None]
        own = np.repeat(control[f, k], len(LINE), axis=0)
        point, normal = at(own, xi.reshape(-1, 2))
        sides.append((point.reshape(-1, len(LINE), 3), normal.reshape(-1, len(LINE), 3)))
    return sides


# ---- how patches meet
@pytest.mark.parametrize("name", SURFACES)
def test_patches_interpolate_and_leave_no_gaps(name):
    rng, reference, facets = made(name)
    x = reference + 0.02 * rng.normal(size=reference.shape)
    control, _ = net(x, facets, reference)
    for k in range(3):
        for corner in (k, (k + 1) % 3):
            point = at(control[:, k], np.tile(CORNER[corner], (len(facets), 1)))[0]
            assert np.allclose(point, x[facets[:, corner]], rtol=0, atol=1e-14)
    pairs = edges(facets)
    assert len(pairs) > 30
    (here, _), (there, _) = beside(control, pairs)
    assert np.allclose(here, there, rtol=0, atol=2e-15)


@pytest.mark.parametrize("name", ["disc", "waves", "sphere"])
def test_one_tangent_plane_along_every_edge(name):
    """At any positions of the nodes, with three to nine triangles around a node."""
    rng, reference, facets = made(name)
    x = reference + 0.02 * rng.normal(size=reference.shape)
    control, irregular = net(x, facets, reference)
    assert not irregular.any()
    valence = np.bincount(facets.ravel())
    assert len(np.unique(valence)) >= 4
    (_, here), (_, there) = beside(control, edges(facets))
    assert np.allclose(here, there, rtol=0, atol=2e-13)
    flat = np.cross(x[facets[:, 1]] - x[facets[:, 0]], x[facets[:, 2]] - x[facets[:, 0]])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    jumps = [np.linalg.norm(flat[f] - flat[g]) for (f, _), (g, _) in edges(facets)]
    assert max(jumps) > 0.1


@pytest.mark.parametrize("name", SURFACES)
def test_pieces_of_a_facet_have_one_tangent_plane(name):
    rng, reference, facets = made(name)
    x = reference + 0.02 * rng.normal(size=reference.shape)
    control, _ = net(x, facets, reference)
    for k in range(3):
        share = (1 + LINE)[:, None] / 2
        xi = np.tile((1 - share) * CORNER[k] + share / 3, (len(facets), 1))
        here, there = (
            at(np.repeat(control[:, piece], len(LINE), axis=0), xi) for piece in (k, k - 1)
        )
        for one, two in zip(here, there, strict=True):
            assert np.allclose(one, two, rtol=0, atol=1e-12)


def test_a_sharp_edge_stays_an_edge():
    """Each side of a cube stays flat to its rim."""
    x, facets = cube()
    control, irregular = net(x, facets, x)
    assert not irregular.any()
    normal = np.cross(x[facets[:, 1]] - x[facets[:, 0]], x[facets[:, 2]] - x[facets[:, 0]])
    xi = np.random.default_rng(5).dirichlet([1, 1, 1], 10)[:, 1:]
    for k in range(3):
        found = at(np.repeat(control[:, k], 10, axis=0), np.tile(xi, (len(facets), 1)))[1]
        assert np.allclose(found, np.repeat(normal, 10, axis=0), rtol=0, atol=1e-13)


def test_a_flat_surface_keeps_its_map():
    """Any mesh, and any affine map of it: xi is affine in space but beside the curved rim."""
    rng, x, facets = made("disc")
    moved = x @ rng.normal(size=(3, 3)) + rng.normal(size=3)
    control, _ = net(moved, facets, x)
    xi = rng.dirichlet([1, 1, 1], 10)[:, 1:]
    area = np.column_stack([1 - xi.sum(axis=1), xi])
    expected = np.einsum("na,mai->mni", area, moved[facets])
    found = np.einsum("na,mkai->kmni", tp.shape(xi)[0], control)
    normal = np.cross(*(moved[facets[0, 1:]] - moved[facets[0, 0]]))
    assert np.abs((found - moved[facets[0, 0]]) @ normal).max() < 1e-13
    inner = (np.linalg.norm(x[facets], axis=2) < 1 - 1e-9).all(axis=1)
    assert inner.sum() > 20
    assert np.allclose(found[:, inner], expected[inner], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", SURFACES)
def test_rigid_motions_move_the_surface(name):
    """Also those of the reference, where a ring of few points leaves second derivatives open."""
    rng, x, facets = made(name)
    q, shift = random_rotation(rng), rng.normal(size=3)
    moved = x @ q.T + shift
    here, _ = net(x, facets, x)
    for reference in (x, moved):
        control, _ = net(moved, facets, reference)
        assert np.allclose(control, here @ q.T + shift, rtol=0, atol=1e-12)


def test_nodes_without_a_common_plane_are_named():
    """Where a steep cone of triangles meets: each has its own plane, and edges are straight."""
    turn = 2 * np.pi / 16 * np.arange(16)
    ring = np.column_stack([0.15 * np.cos(turn), 0.15 * np.sin(turn), 0 * turn])
    x = np.r_[ring, [[0, 0, 1.0]]]
    facets = np.column_stack([np.arange(16), (np.arange(16) + 1) % 16, np.full(16, 16)])
    control, irregular = net(x, facets, x)
    assert irregular.all()
    (here, _), (there, _) = beside(control, edges(facets))
    assert np.allclose(here, there, rtol=0, atol=1e-14)


def test_patches_do_not_depend_on_the_numbering():
    for name in SURFACES:
        _, x, facets = made(name)
        control, _ = net(x, facets, x)
        other, _ = net(x, np.roll(facets, -1, axis=1), x)
        xi = np.random.default_rng(6).dirichlet([1, 1, 1], 5)
        here = np.einsum("na,mkai->kmni", tp.shape(xi[:, 1:])[0], control)
        there = np.einsum("na,mkai->kmni", tp.shape(np.roll(xi, -1, axis=1)[:, 1:])[0], other)
        assert np.allclose(np.roll(here, -1, axis=0), there, rtol=0, atol=1e-13)


def test_order_on_a_sphere():
    """Facets miss it by O(h^2), patches on random meshes by O(h^3) and less."""
    rng, error, facet = np.random.default_rng(7), {}, {}
    for n in (100, 400, 1600):
        x, t = sphere(rng, n)
        control, irregular = net(x, t, x)
        assert not irregular.any()
        area = rng.dirichlet([1, 1, 1], 50)
        piece = tp.piece(area[:, 1:])
        found = np.einsum("na,mnai->mni", tp.shape(area[:, 1:])[0], control[:, piece])
        flat = np.einsum("na,mai->mni", area, x[t])
        error[n], facet[n] = (np.abs(np.linalg.norm(p, axis=2) - 1).mean() for p in (found, flat))
    rate = np.log2(error[100] / error[1600]) / 2
    assert rate > 3.0
    assert error[400] < facet[400] / 30


def test_the_surface_stays_near_its_facets():
    """Within half a facet up to the sharpest smooth edges: the search looks as far."""
    rng = np.random.default_rng(8)
    area = rng.dirichlet([1, 1, 1], 50)
    piece, largest = tp.piece(area[:, 1:]), 0.0
    for n in (20, 30, 60):
        x, t = sphere(rng, n)
        control, _ = net(x, t, x)
        found = np.einsum("na,mnai->mni", tp.shape(area[:, 1:])[0], control[:, piece])
        corners = np.repeat(x[t], len(area), axis=0)
        away = compiled.closest_point(found.reshape(-1, 3), corners)[1]
        largest = max(largest, (away / fc.size(corners)).max())
    assert largest < 0.3


# ---- projection
def test_projection_onto_patches():
    rng, x, facets = made("waves")
    control = net(x, facets, x)[0].reshape(-1, 15, 3)
    exact = rng.dirichlet([1, 1, 1], len(control))[:, 1:]
    point, _, normal = fc.frame(control, exact)
    slave = point + rng.uniform(-0.02, 0.02, (len(control), 1)) * normal
    xi, converged = fc.project(slave, control, exact + rng.uniform(-0.1, 0.1, exact.shape))
    assert converged.all()
    assert np.allclose(xi, exact, rtol=0, atol=1e-10)
    for unit in (1e-6, 1e6):
        scaled, same = fc.project(unit * slave, unit * control, xi)
        assert same.all()
        assert np.allclose(scaled, xi, rtol=0, atol=1e-9)
