"""The node-to-surface element against plain definitions, exact differences and symmetries."""

import math

import numpy as np
import pytest
from facet_kinds import CENTRE, FLAT, KINDS, POWERS, RING
from measures import STENCIL, differences, relative
from pairs import pairs
from rotations import random_rotation

from dolfinx_nts.kernels import discrete_gradient, nts_element
from dolfinx_nts.kernels import facets as fc

RULES = ("mean-value", "gonzalez")
#: How far off f is, and what it moves by; polynomials of degree 4 grow fast beside their triangle.
SPREAD, MOVED = {3: 0.5, 4: 0.5, 16: 0.5, 15: 0.1}, {3: 1.0, 4: 1.0, 16: 1.0, 15: 0.2}
#: Part of the control points' distance that they are shifted by: 0.2 of corners.
WARP = {3: 0.2, 4: 0.2, 16: 0.2, 15: 0.05}


def shape(f, nc):
    """N and dN/df of one facet, written out; takes complex numbers."""
    s, t = f
    if nc == 15:
        power = areas(f)
        first = np.stack([POWERS[:, i] * power(DOWN[i]) for i in range(3)], axis=1)
        return power(POWERS), first @ TO_AREAS
    if nc == 16:
        (a, da, _), (b, db, _) = catmull_rom((1 + s) / 2), catmull_rom((1 + t) / 2)
        i, j = RING.T + 1
        return a[i] * b[j], np.stack([da[i] * b[j], a[i] * db[j]], axis=1) / 2
    if nc == 3:
        return np.array([1 - s - t, s, t]), np.array([[-1.0, -1], [1, 0], [0, 1]])
    n = np.array([(1 - s) * (1 - t), (1 + s) * (1 - t), (1 + s) * (1 + t), (1 - s) * (1 + t)]) / 4
    dn = np.array([[t - 1, s - 1], [1 - t, -1 - s], [1 + t, 1 + s], [-1 - t, 1 - s]]) / 4
    return n, dn


#: Of the points, and less one at one or two of the corners, not below 0.
UNITS = np.eye(3, dtype=int)
DOWN = [np.maximum(POWERS - unit, 0) for unit in UNITS]
DOWN2 = [[np.maximum(POWERS - a - b, 0) for b in UNITS] for a in UNITS]
NUMBER = np.array([24 / math.prod(map(math.factorial, e)) for e in POWERS.tolist()])
TO_AREAS = np.array([[-1, -1], [1, 0], [0, 1]])


def areas(f):
    """Powers of a point's area coordinates, and products of them with given exponents."""
    at = np.array([1 - f[0] - f[1], f[0], f[1]])[:, None] ** np.arange(5)
    return lambda exponents: NUMBER * at[np.arange(3), exponents].prod(axis=1)


def catmull_rom(t):
    """Weights of four points at -1, 0, 1, 2 on the curve from 0 to 1, their first and second
    derivatives."""
    weights = np.array([-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3]) / 2
    weights = [*weights, (t + 4 * t**2 - 3 * t**3) / 2, (t**3 - t**2) / 2]
    slopes = [(-1 + 4 * t - 3 * t**2) / 2, (-10 * t + 9 * t**2) / 2]
    slopes += [(1 + 8 * t - 9 * t**2) / 2, (3 * t**2 - 2 * t) / 2]
    return (
        np.array(weights),
        np.array(slopes),
        np.array([2 - 3 * t, 9 * t - 5, 4 - 9 * t, 3 * t - 1]),
    )


def shape_curvature(f, nc):
    """d2N/df2 of one facet, shape (nc, 2, 2), written out; takes complex numbers."""
    if nc == 15:
        power, second = areas(f), np.zeros((15, 3, 3), dtype=complex)
        for i in range(3):
            for j in range(3):
                factor = POWERS[:, i] * (POWERS[:, j] - (i == j))
                second[:, i, j] = factor * power(DOWN2[i][j])
        return TO_AREAS.T @ second @ TO_AREAS
    if nc == 16:
        (a, da, dda), (b, db, ddb) = (catmull_rom((1 + s) / 2) for s in f)
        i, j = RING.T + 1
        mixed = da[i] * db[j]
        second = np.array([[dda[i] * b[j], mixed], [mixed, a[i] * ddb[j]]]) / 4
        return second.transpose(2, 0, 1)
    mixed = np.array([1, -1, 1, -1]) / 4 if nc == 4 else np.zeros(3)
    return mixed[:, None, None] * np.array([[0, 1], [1, 0]])


def split(z, nc):
    return z[:3], z[3 : 3 * nc + 3].reshape(nc, 3), z[3 * nc + 3 : -2], z[-2:]


def geometric_constraints(z, nc):
    """The six constraints of one pair as geometry states them; takes complex numbers."""
    slave, corners, d, f = split(z, nc)
    n, dn = shape(f, nc)
    xbar, a = n @ corners, dn.T @ corners
    return np.array(
        [d @ (slave - xbar), d @ a[0], d @ a[1], (d @ d - 1) / 2, *(a @ (slave - xbar))]
    )


def products(z, nc):
    """The invariants of one pair by their definition."""
    slave, corners, d, f = split(z, nc)
    y = [c - slave for c in corners]
    yy = [y[i] @ y[j] for i in range(nc) for j in range(i, nc)]
    return np.array([*yy, *(yi @ d for yi in y), d @ d, *f])


def constraints_of_invariants(pi, nc):
    """Theory section 3; takes complex numbers."""
    n, dn = shape(pi[-2:], nc)
    upper = np.triu_indices(nc)
    yy = np.zeros((nc, nc), dtype=pi.dtype)
    yy[upper] = pi[: len(upper[0])]
    yy.T[upper] = yy[upper]
    yd = pi[len(pi) - 3 - nc : -3]
    return np.array([-n @ yd, *(dn.T @ yd), (pi[-3] - 1) / 2, *(-(n @ yy @ dn))])


def complex_step(function, x):
    """Jacobian of a complex-safe function, to round-off, shape (rows, len(x))."""
    step = 1e-40
    columns = [function(x + 1j * step * unit).imag / step for unit in np.eye(len(x))]
    return np.stack(columns, axis=-1)


def along_one(rng, function, x, slope, step=1e-3):
    """Largest difference of a batched function's slope (n, m, m) and stencils, along a unit vector.

    Each entry of the slope is seen along any direction, and all of them would take m times as long.
    """
    unit = rng.normal(size=x.shape)
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    expected = sum(w * function(x + k * step * unit) for k, w in STENCIL) / step
    return np.abs(np.einsum("nij,nj->ni", slope, unit) - expected).max()


def random_pairs(rng, n, nc):
    """Any state of the unknowns: warped facets, normals of any length, slaves anywhere near."""
    corners = FLAT[nc] + WARP[nc] * rng.uniform(-1, 1, (n, nc, 3))
    slave = np.array([0.5, 0.4, 0.1]) + 0.3 * rng.uniform(-1, 1, (n, 3))
    d = np.array([0.0, 0, 1]) + 0.3 * rng.uniform(-1, 1, (n, 3))
    f = CENTRE[nc] + SPREAD[nc] * rng.uniform(-1, 1, (n, 2))
    return np.concatenate([slave, corners.reshape(n, -1), d, f], axis=1)


def random_step(rng, n, nc, motion=0.2):
    z0 = random_pairs(rng, n, nc)
    moved = motion * rng.uniform(-1, 1, z0.shape)
    moved[:, -2:] *= MOVED[nc]
    z1 = z0 + moved
    return z0, z1, rng.normal(size=(n, 6))


# ---- invariants and constraints


@pytest.mark.parametrize("nc", KINDS)
def test_projection_and_normal_satisfy_the_augmented_constraints(nc):
    z = random_pairs(np.random.default_rng(5), 50, nc)
    slave, corners = z[:, :3], z[:, 3:-5].reshape(50, nc, 3)
    xi, converged = fc.project(slave, corners, np.tile(CENTRE[nc], (50, 1)))
    assert converged.all()
    foot, _, normal = fc.frame(corners, xi)
    z[:, -5:-2], z[:, -2:] = normal, xi
    g = nts_element.constraints(nts_element.invariants(z, nc), nc)
    distance = np.linalg.norm(slave - foot, axis=1)
    # Sums over the corners round with their weights, which add up to 264 beyond a curved triangle.
    weights = fc.shape(xi, nc)[:2]
    sums = 1.0 + sum(np.abs(w).reshape(50, -1).sum(axis=1) for w in weights)
    rounding = 4 * np.finfo(float).eps * sums
    assert (np.abs(np.abs(g[:, 0]) - distance) <= rounding).all()
    assert (np.abs(g[:, 1:]).max(axis=1) <= rounding).all()
    value = nts_element.gap(z[:, :-5].reshape(50, nc + 1, 3), xi).value
    assert (np.abs(value - g[:, 0]) <= rounding).all()


# ---- the direct description
def projected_gap(x, xi, nc):
    """Signed distance of one slave by Newton's method on the projection; takes complex numbers."""
    slave, corners = x.reshape(nc + 1, 3)[0], x.reshape(nc + 1, 3)[1:]
    xi = xi + 0j
    for _ in range(10):
        n, dn = shape(xi, nc)
        a, y = dn.T @ corners, slave - n @ corners
        hessian = a @ a.T - np.einsum("kab,k->ab", shape_curvature(xi, nc), corners @ y)
        xi = xi + np.linalg.solve(hessian, a @ y)
    n, dn = shape(xi, nc)
    a = dn.T @ corners
    normal = np.cross(a[0], a[1])
    return normal @ (slave - n @ corners) / np.sqrt(normal @ normal)


def random_gaps(rng, n, nc):
    z = random_pairs(rng, n, nc)
    x = z[:, :-5].reshape(n, nc + 1, 3)
    xi, converged = fc.project(x[:, 0], x[:, 1:], np.tile(CENTRE[nc], (n, 1)))
    assert converged.all()
    return x, xi


@pytest.mark.parametrize("nc", KINDS)
@pytest.mark.fast("3", "4", "16")
def test_gap_and_its_derivatives(nc):
    """The second one along any direction."""
    rng, rows = np.random.default_rng(8), 8 if nc < 15 else 1
    x, xi = random_gaps(rng, rows, nc)
    found = nts_element.gap(x, xi)
    size = 3 * (nc + 1)

    def values(flat):
        return np.array([projected_gap(r, p, nc) for r, p in zip(flat, xi, strict=True)])

    def gradients(flat):
        return np.array(
            [
                complex_step(lambda r, p=p: projected_gap(r, p, nc), row)
                for row, p in zip(flat, xi, strict=True)
            ]
        )

    flat = x.reshape(rows, size)
    assert np.allclose(found.value, values(flat).real, rtol=0, atol=1e-14)
    assert np.allclose(found.gradient.reshape(rows, size), gradients(flat), rtol=0, atol=1e-13)
    assert along_one(rng, gradients, flat, found.hessian) < 1e-9 * np.abs(found.hessian).max()
    asymmetry = np.abs(found.hessian - found.hessian.transpose(0, 2, 1)).max()
    assert asymmetry < 1e-13 * np.abs(found.hessian).max()


@pytest.mark.parametrize("nc", KINDS)
def test_gap_over_a_flat_facet_is_the_height(nc):
    rng = np.random.default_rng(9)
    turn, shift = random_rotation(rng), rng.normal(size=3)
    xi = CENTRE[nc] + 0.1 * rng.uniform(-1, 1, (20, 2))
    n, _, _ = fc.shape(xi, nc)
    height = rng.uniform(-0.2, 0.2, 20)
    x = np.zeros((20, nc + 1, 3))
    x[:, 1:] = 0.5 * FLAT[nc]
    x[:, 0] = n @ (0.5 * FLAT[nc])
    x[:, 0, 2] += height
    g = nts_element.gap(x @ turn.T + shift, xi)
    assert np.allclose(g.value, height, rtol=0, atol=2e-15)
    weight = np.concatenate([np.ones((20, 1)), -n], axis=1)
    assert np.allclose(g.gradient, weight[:, :, None] * turn[:, 2], rtol=0, atol=1e-14)


# ---- the element in invariants
@pytest.mark.parametrize(("motion", "nc", "rule"), pairs([1.0, 0.2, 1e-3], KINDS, RULES))
def test_directionality(nc, rule, motion):
    z0, z1, multiplier = random_step(np.random.default_rng(11), 100, nc, motion)
    # gradbar g . D pi(z_m) . (z_1 - z_0) = gradbar g . (pi_1 - pi_0) = g(pi_1) - g(pi_0)
    e = nts_element.element(z0, z1, multiplier, rule)
    found = np.einsum("nmz,nz->nm", e.force_gradient, z1 - z0)
    g0, g1 = (np.array([geometric_constraints(row, nc) for row in z]) for z in (z0, z1))
    assert np.abs(found - (g1 - g0)).max() < 1e-14 * max(1.0, np.abs(g1).max())
    assert np.allclose(e.constraint, g1, rtol=0, atol=1e-14)
    work = np.einsum("nz,nz->n", e.force, z1 - z0)
    expected = np.einsum("nm,nm->n", multiplier, g1 - g0)
    assert np.abs(work - expected).max() < 2e-14 * max(1.0, np.abs(g1).max())


@pytest.mark.parametrize("nc", KINDS)
def test_mean_value_is_the_integral_of_the_gradient(nc):
    z0, z1, multiplier = random_step(np.random.default_rng(12), 20, nc)
    pi0, pi1 = nts_element.invariants(z0, nc), nts_element.invariants(z1, nc)
    number = nts_element.GAUSS_POINTS[nc]
    found = discrete_gradient.mean_value(
        pi0, pi1, lambda pi: nts_element.constraint_gradient(pi, nc), number
    )
    copies = np.tile(multiplier, (number, 1))
    tangent = discrete_gradient.mean_value_tangent(
        pi0,
        pi1,
        lambda pi: nts_element._full_curvature(nts_element.constraint_curvature(pi, copies, nc)),
        number,
    )
    points, weights = np.polynomial.legendre.leggauss(9)
    gradient, slope = 0.0, 0.0
    for x, w in zip(0.5 + 0.5 * points, 0.5 * weights, strict=True):
        pi = pi0 + x * (pi1 - pi0)
        gradient = gradient + w * nts_element.constraint_gradient(pi, nc)
        curvature = nts_element.constraint_curvature(pi, multiplier, nc)
        slope = slope + w * x * nts_element._full_curvature(curvature)
    assert np.allclose(found, gradient, rtol=0, atol=4e-15)
    assert np.allclose(tangent, slope, rtol=0, atol=1e-14)


def test_gonzalez_is_the_corrected_formula_row_by_row():
    nc = 4
    z0, z1, multiplier = random_step(np.random.default_rng(13), 5, nc)
    pi0, pi1 = nts_element.invariants(z0, nc), nts_element.invariants(z1, nc)
    e = nts_element.element(z0, z1, multiplier, "gonzalez")
    for k in range(5):
        middle, change = 0.5 * (pi0[k] + pi1[k]), pi1[k] - pi0[k]
        gradient = complex_step(lambda p: constraints_of_invariants(p, nc), middle)
        for row in range(6):
            rise = constraints_of_invariants(pi1[k], nc) - constraints_of_invariants(pi0[k], nc)
            factor = (rise[row] - gradient[row] @ change) / (change @ change)
            gradient[row] += factor * change
        jacobian = complex_step(lambda x: products(x, nc), 0.5 * (z0[k] + z1[k]))
        assert np.allclose(e.force_gradient[k], gradient @ jacobian, rtol=0, atol=1e-14)
        assert np.allclose(e.force[k], multiplier[k] @ gradient @ jacobian, rtol=0, atol=1e-13)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("nc", KINDS)
def test_tangents(nc, rule):
    rng = np.random.default_rng(14)
    z0, z1, multiplier = random_step(rng, 10, nc)
    e = nts_element.element(z0, z1, multiplier, rule)
    force = lambda z: nts_element.element(z0, z, multiplier, rule).force  # noqa: E731
    assert along_one(rng, force, z1, e.stiffness) < 1e-9 * np.abs(e.stiffness).max()
    by_multiplier = differences(
        lambda m: nts_element.element(z0, z1, m, rule).force, multiplier, 1.0
    )
    assert relative(e.force_gradient, by_multiplier.transpose(0, 2, 1)) < 1e-13
    geometry = [complex_step(lambda x: geometric_constraints(x, nc), row) for row in z1]
    assert np.allclose(e.constraint_gradient, geometry, rtol=0, atol=2e-14)


def test_over_triangles_both_rules_are_the_midpoint_gradient():
    z0, z1, multiplier = random_step(np.random.default_rng(20), 50, 3)
    middle = 0.5 * (nts_element.invariants(z0, 3) + nts_element.invariants(z1, 3))
    gradient = nts_element.invariant_gradient(0.5 * (z0 + z1), 3)
    expected = nts_element.constraint_gradient(middle, 3) @ gradient
    for rule in RULES:
        found = nts_element.element(z0, z1, multiplier, rule).force_gradient
        assert np.allclose(found, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("nc", KINDS)
def test_at_rest(nc, rule):
    rng = np.random.default_rng(17)
    z, _, multiplier = random_step(rng, 10 if nc < 15 else 2, nc)
    with np.errstate(all="raise"):
        e = nts_element.element(z, z, multiplier, rule)
    gradient = [complex_step(lambda x: geometric_constraints(x, nc), row) for row in z]
    assert np.allclose(e.force_gradient, gradient, rtol=0, atol=1e-14)
    assert np.allclose(e.force, np.einsum("nm,nmz->nz", multiplier, gradient), rtol=0, atol=2e-14)

    def force(x):
        rows = [complex_step(lambda r: geometric_constraints(r, nc), row) for row in x]
        return np.einsum("nm,nmz->nz", multiplier, rows)

    # A discrete gradient is symmetric in both ends: its tangent at rest is half the Hessian.
    assert along_one(rng, force, z, 2.0 * e.stiffness) < 2e-9 * np.abs(e.stiffness).max()


@pytest.mark.parametrize("nc", KINDS)
@pytest.mark.parametrize("motion", [1e-6, 1e-8, 1e-10])
def test_gonzalez_near_rest_has_no_noise(nc, motion):
    """Both rules differ by O(D pi) in the tangent and O(D pi^2) in the force."""
    z0, z1, multiplier = random_step(np.random.default_rng(21), 50, nc, motion)
    expected, found = (nts_element.element(z0, z1, multiplier, rule) for rule in RULES)
    assert relative(found.force, expected.force) < 1e-11
    assert relative(found.stiffness, expected.stiffness) < 1e-5
