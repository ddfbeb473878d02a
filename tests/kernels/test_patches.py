"""Smooth patches: interpolation, tangent planes along edges, extrapolation, irregular points."""

import numpy as np
import pytest
from facet_kinds import LINE

from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.kernels import patches

#: Ends of edge k, from corner k to k + 1.
CORNER = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])


def sheet(nx, ny, height=None):
    """Points and facets of a grid over [0, nx] x [0, ny]."""
    x, y = np.meshgrid(np.arange(nx + 1.0), np.arange(ny + 1.0), indexing="ij")
    z = np.zeros_like(x) if height is None else height(x, y)
    number = np.arange(x.size).reshape(x.shape)
    quads = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    return np.stack([x, y, z], axis=2).reshape(-1, 3), np.stack(quads, axis=2).reshape(-1, 4)


def shuffled(rng, facets):
    """The same facets in another order, each starting at another corner."""
    start = rng.integers(4, size=len(facets))[:, None]
    facets = np.take_along_axis(facets, (start + np.arange(4)) % 4, axis=1)
    return facets[rng.permutation(len(facets))]


def disc(spokes=5):
    """Quadrilaterals around a point where `spokes` of them meet, in two rings."""
    angle = np.pi / spokes * np.arange(2 * spokes)
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0.1 * np.cos(2 * angle)])
    x = np.concatenate([[[0, 0, 0.2]], ring, 2.0 * ring])
    n = 2 * spokes
    facets = [[0, 1 + k, 1 + k + 1, 1 + (k + 2) % n] for k in range(0, n, 2)]
    for k in range(n):
        a, b = 1 + k, 1 + (k + 1) % n
        facets.append([a, a + n, b + n, b])
    return x, np.array(facets)


def box():
    """The six faces of a cube of 3 x 3 facets each, seen from outside; edges are sharp."""
    x, f = sheet(3, 3)
    x = x / 1.5 - [1, 1, -1]
    turns = [np.eye(3)]
    for axis in range(3):
        for angle in (1, 2, 3):
            c, s = [(0, 1), (-1, 0), (0, -1)][angle - 1]
            i, j = (axis + 1) % 3, (axis + 2) % 3
            turn = np.eye(3)
            turn[[i, i, j, j], [i, j, i, j]] = [c, -s, s, c]
            turns.append(turn)
    faces, seen = [], set()
    for turn in turns:
        normal = tuple(np.round(turn[:, 2]).astype(int))
        if normal not in seen:
            seen.add(normal)
            faces.append(x @ turn.T)
    assert len(faces) == 6
    points = np.concatenate(faces)
    facets = np.concatenate([f + k * len(x) for k in range(6)])
    unique, inverse = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    return unique, inverse.ravel()[facets]


def net(x, facets, reference=None):
    """Control points at x (p, 3), and which facets have irregular corners."""
    reference = x if reference is None else reference
    points, weights, irregular = patches.control_net(facets, reference[facets])
    assert points.shape == (len(facets), 16)
    assert np.array_equal(points[:, :4], facets)
    return weights @ x[points], irregular


def at(control, facet, xi):
    """Point and normal of one patch at xi (n, 2)."""
    point, _, normal = fc.frame(np.tile(control[facet], (len(xi), 1, 1)), xi)
    return point, normal


def edges(facets):
    """Pairs of (facet, edge) that share an edge; the second runs against the first."""
    place, pairs = {}, []
    for f, corners in enumerate(facets):
        for k in range(4):
            ends = (corners[k], corners[(k + 1) % 4])
            if ends[::-1] in place:
                pairs.append((place[ends[::-1]], (f, k)))
            place[ends] = (f, k)
    return pairs


def along_edge(k, backwards=False):
    share = (1 - LINE if backwards else 1 + LINE)[:, None] / 2
    return (1 - share) * CORNER[k] + share * CORNER[(k + 1) % 4]


# ---- shape functions


def test_control_points_on_a_plane_grid_give_the_plane_map():
    """Points where the grid has them or would have them: xi is affine in space."""
    x, facets = sheet(3, 2)
    control, irregular = net(x, facets)
    assert not irregular.any()
    xi = np.random.default_rng(4).uniform(-1.3, 1.3, (40, 2))
    for f, corners in enumerate(facets):
        expected = x[corners[0]] + np.column_stack([0.5 * (1 + xi), np.zeros(40)])
        point, normal = at(control, f, xi)
        assert np.allclose(point, expected, rtol=0, atol=1e-14)
        assert np.allclose(normal, [0, 0, 1], rtol=0, atol=1e-15)


def test_an_irregular_mesh_of_a_plane_gives_the_plane():
    rng = np.random.default_rng(5)
    for x, facets in (disc(3), disc(5), sheet(4, 3)):
        flat = x * [1, 1, 0] + 0.05 * rng.normal(size=x.shape) * [1, 1, 0]
        control, _ = net(flat, shuffled(rng, facets))
        assert np.array_equal(control[..., 2], np.zeros((len(facets), 16)))


# ---- how patches meet
def surfaces(rng):
    wavy = sheet(5, 4, lambda x, y: 0.3 * np.sin(x) * np.cos(y))
    ring = sheet(8, 3)
    turn = np.pi / 4 * ring[0][:, 0]
    tube = np.column_stack([np.sin(turn), ring[0][:, 1], np.cos(turn)])
    closed = np.where(ring[1] >= 32, ring[1] - 32, ring[1])
    out = {
        "sheet": wavy,
        "tube": (tube[:32], closed),
        "disc": disc(),
        "three": disc(3),
        "box": box(),
    }
    return {k: (x, shuffled(rng, f)) for k, (x, f) in out.items()}


@pytest.mark.parametrize("name", ["sheet", "tube", "disc", "three", "box"])
def test_patches_interpolate_and_leave_no_gaps(name):
    rng = np.random.default_rng(6)
    reference, facets = surfaces(rng)[name]
    x = reference + 0.1 * rng.normal(size=reference.shape)
    control, _ = net(x, facets, reference)
    for f, corners in enumerate(facets):
        assert np.allclose(at(control, f, CORNER)[0], x[corners], rtol=0, atol=1e-14)
    pairs = edges(facets)
    assert len(pairs) > 5
    for (f, k), (g, m) in pairs:
        here, there = at(control, f, along_edge(k))[0], at(control, g, along_edge(m, True))[0]
        assert np.allclose(here, there, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("name", "smooth"), [("sheet", 31), ("tube", 40)])
def test_one_tangent_plane_along_the_edges_of_regular_surfaces(name, smooth):
    rng = np.random.default_rng(7)
    reference, facets = surfaces(rng)[name]
    x = reference + 0.1 * rng.normal(size=reference.shape)
    control, irregular = net(x, facets, reference)
    assert not irregular.any()
    pairs = edges(facets)
    assert len(pairs) == smooth
    for (f, k), (g, m) in pairs:
        here, there = at(control, f, along_edge(k))[1], at(control, g, along_edge(m, True))[1]
        assert np.allclose(here, there, rtol=0, atol=1e-13)


def test_a_sharp_edge_stays_an_edge():
    """Each face of a cube is a sheet of its own: flat to the rim, right-angled there."""
    x, facets = box()
    control, irregular = net(x, facets)
    assert not irregular.any()
    normals = np.cross(control[:, 1] - control[:, 0], control[:, 3] - control[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    xi = np.random.default_rng(8).uniform(-1, 1, (10, 2))
    for f, normal in enumerate(normals):
        assert np.allclose(at(control, f, xi)[1], normal, rtol=0, atol=1e-14)


def test_irregular_points_are_named_and_the_rest_is_smooth():
    x, facets = disc()
    _, irregular = net(x, facets)
    # The five around the centre; the ring outside touches points of three facets, too.
    assert irregular[:5].all()
    x, facets = sheet(6, 6)
    hole = np.delete(facets, 14, axis=0)
    irregular = net(x, hole)[1]
    around = [f for f in range(len(hole)) if np.intersect1d(hole[f], facets[14]).size]
    assert np.array_equal(np.flatnonzero(irregular), around)


def test_order_of_a_cylinder():
    """Facets miss the circle by delta^2/8 of its radius, patches by O(delta^4)."""
    error = {}
    for n in (16, 32, 64):
        x, facets = sheet(n, 2)
        turn = 2 * np.pi / n * x[:, 0]
        tube = np.column_stack([np.sin(turn), x[:, 1], np.cos(turn)])
        control, _ = net(tube, facets)
        inner = n // 2 * 2
        xi = np.column_stack([LINE, 0 * LINE])
        point, normal = at(control, inner, xi)
        radial = point * [1, 0, 1] / np.linalg.norm(point * [1, 0, 1], axis=1)[:, None]
        error[n] = [
            np.abs(np.linalg.norm(point * [1, 0, 1], axis=1) - 1).max(),
            np.linalg.norm(normal - radial, axis=1).max(),
        ]
        delta = 2 * np.pi / n
        assert error[n][0] < 0.05 * delta**2 / 8
    rates = np.log2(np.array(error[16]) / error[32]), np.log2(np.array(error[32]) / error[64])
    assert np.allclose(rates, [[4, 3], [4, 3]], rtol=0, atol=0.15)


# ---- projection
def test_projection_onto_patches():
    rng = np.random.default_rng(10)
    x, facets = sheet(4, 4, lambda x, y: 0.2 * np.sin(x) * np.cos(y))
    control, _ = net(x, facets)
    facet = rng.integers(len(facets), size=400)
    exact = rng.uniform(-1.2, 1.2, (400, 2))
    point, tangents, normal = fc.frame(control[facet], exact)
    height = rng.uniform(-0.5, 0.5, 400)
    slave = point + height[:, None] * normal
    xi, converged = fc.project(slave, control[facet], exact + rng.uniform(-0.3, 0.3, (400, 2)))
    assert converged.all()
    assert np.allclose(xi, exact, rtol=0, atol=1e-12)
    # From anywhere it ends at a foot point that is no farther than where it began.
    start = rng.uniform(-1, 1, (400, 2))
    slave = point + 0.4 * rng.normal(size=(400, 3))
    xi, converged = fc.project(slave, control[facet], start)
    assert converged.mean() > 0.97
    foot, tangents, _ = fc.frame(control[facet], xi)
    begin = fc.frame(control[facet], start)[0]
    away = np.linalg.norm(slave - foot, axis=1)
    assert (away <= np.linalg.norm(slave - begin, axis=1) * (1 + 1e-14)).all()
    slope = np.einsum("naj,nj->na", tangents, slave - foot)[converged]
    assert np.abs(slope).max() < 1e-13
    # In other units the same.
    for unit in (1e-6, 1e6):
        scaled, same = fc.project(unit * slave, unit * control[facet], start)
        assert np.array_equal(same, converged)
        assert np.allclose(scaled[same], xi[same], rtol=0, atol=1e-9)
