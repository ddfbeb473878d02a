"""Smooth patches over triangular facets: quartic, interpolating, linear in the nodes.

Three quartic triangles lie over each facet, one beside each edge, which meet at its centre as in
Clough and Tocher's element (Clough and Tocher 1965; for tangent planes along edges of surfaces of
any shape Shirman and Sequin 1987). A node's ring gives its tangent plane, an edge's ends give the
cubic along it and a vector across it, and both triangles beside an edge take their derivatives
across it from these two. All weights come from the reference and stay, so that the surface is
linear in the nodes: nothing is divided by lengths of the moving surface, as unit normals would be.

Axis 0 is the pair or the patch. `xi` is the facet's, N = (1 - xi_1 - xi_2, xi_1, xi_2), in all of
its three pieces: the control points are Bernstein's of degree 4 over the whole facet, those of its
corners first, beyond its piece the polynomial goes on.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from math import comb, factorial, prod

import numpy as np

from dolfinx_nts.kernels import tangent_planes
from dolfinx_nts.kernels.patches import neighbours
from dolfinx_nts.kernels.tangent_planes import Planes, Rims
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Patches over a facet.
PIECES = 3
_DEGREE = 4


def _exponents(degree: int) -> list[tuple[int, ...]]:
    """Powers of the three area coordinates in Bernstein's polynomials, those of corners first."""
    every = (e for e in product(range(degree + 1), repeat=3) if sum(e) == degree)
    return sorted(every, key=lambda e: (max(e) < degree, [-n for n in e]))


_EXPONENTS = _exponents(_DEGREE)
#: Control points of a patch.
NUM_POINTS = len(_EXPONENTS)
_AT = {e: i for i, e in enumerate(_EXPONENTS)}
#: Facets whose weights are made at a time.
_PORTION = 2048


def _coefficients() -> FloatArray:
    """Coefficients of xi_1^a xi_2^b of Bernstein's polynomials, whole numbers, (5, 5, 15)."""
    out = np.zeros((_DEGREE + 1, _DEGREE + 1, NUM_POINTS))
    for number, (i, j, k) in enumerate(_EXPONENTS):
        scale = factorial(_DEGREE) // (factorial(i) * factorial(j) * factorial(k))
        for a, b in product(range(i + 1), repeat=2):
            if a + b <= i:
                out[j + a, k + b, number] += scale * (-1) ** (a + b) * comb(i, a) * comb(i - a, b)
    return out


#: Coefficients of the powers of xi_1 and xi_2 of the control points' polynomials, (5, 5, 15).
COEFFICIENTS = _coefficients()


@lru_cache
def _differences(first: int, second: int) -> FloatArray:
    """Return the map from control points to those of a derivative, of a lower degree."""
    out, old = np.eye(NUM_POINTS), _EXPONENTS
    for corner in [1] * first + [2] * second:
        at, degree = {e: i for i, e in enumerate(old)}, sum(old[0])
        old = _exponents(degree - 1)
        steps = np.eye(3, dtype=int)
        to, fro = ([at[tuple(np.add(e, steps[c]))] for e in old] for c in (corner, 0))
        out = float(degree) * (out[to] - out[fro])
    return out


def _derivatives(xi: FloatArray, order: int) -> list[FloatArray]:
    """Derivatives of an order with 0, 1, .. of them by the second coordinate, each (n, 15)."""
    degree = _DEGREE - order
    exponents = _exponents(degree)
    area = np.column_stack([1.0 - xi[:, 0] - xi[:, 1], xi])
    powers = area[:, :, None] ** np.arange(degree + 1)
    scale = np.array([factorial(degree) / prod(map(factorial, e)) for e in exponents])
    values = scale * powers[:, np.arange(3), np.array(exponents)].prod(axis=2)
    return [values @ _differences(order - b, b) for b in range(order + 1)]


def shape(xi: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shape functions of the control points, with first and second derivatives.

    Args:
        xi: Convective coordinates [-], shape (n, 2).

    Returns:
        Shapes (n, 15), (n, 15, 2) and (n, 15, 2, 2).
    """
    (value,), first, (aa, ab, bb) = (_derivatives(xi, order) for order in range(3))
    second = np.stack([aa, ab, ab, bb], axis=2).reshape(len(xi), NUM_POINTS, 2, 2)
    return value, np.stack(first, axis=2), second


def third(xi: FloatArray) -> FloatArray:
    """Third derivatives of the shape functions at xi (n, 2), shape (n, 15, 2, 2, 2)."""
    d = _derivatives(xi, 3)
    parts = [d[a + b + c] for a, b, c in product(range(2), repeat=3)]
    return np.stack(parts, axis=2).reshape(len(xi), NUM_POINTS, 2, 2, 2)


def along(xi: FloatArray, step: FloatArray) -> FloatArray:
    """Coefficients of t^0 .. t^4 of the shape functions at xi + t step, shape (n, 15, 5).

    Args:
        xi: Convective coordinates [-], shape (n, 2).
        step: Direction [-], shape (n, 2).
    """
    out = np.zeros((len(xi), NUM_POINTS, _DEGREE + 1))
    for order in range(_DEGREE + 1):
        for b, derivative in enumerate(_derivatives(xi, order)):
            factor = step[:, 0] ** (order - b) * step[:, 1] ** b
            scale = comb(order, b) / factorial(order)
            out[:, :, order] += scale * factor[:, None] * derivative
    return out


def piece(xi: FloatArray) -> IntArray:
    """Return which piece of a facet lies over xi (n, 2): that beside edge k, (n,)."""
    far = np.column_stack([1.0 - xi[:, 0] - xi[:, 1], xi]).argmin(axis=1)
    return (far + 1) % PIECES


# ---- tangent planes at the nodes


# ---- from tangent planes to control points
def _elevated(points: FloatArray, degree: int) -> FloatArray:
    """Bernstein coefficients of curves of axis 0 in a higher degree."""
    while len(points) <= degree:
        k, zero = len(points), np.zeros_like(points[:1])
        share = (np.arange(k + 1) / k).reshape(-1, *[1] * (points.ndim - 1))
        points = share * np.r_[zero, points] + (1.0 - share) * np.r_[points, zero]
    return points


def _edge(
    ends: FloatArray, tangents: FloatArray, across: FloatArray, parts: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The first two rows of control points, (5, ...) and (4, ...), of the piece beside an edge.

    Args:
        ends: Both ends of the edge, shape (2, ...).
        tangents: Derivatives along it there, shape (2, ...).
        across: Vectors across it there, shape (2, ...).
        parts: What the derivatives towards the third corner have of across and along, at both ends,
            shape (2 ends, 2, ...), to be multiplied with the others.
    """
    cubic = np.stack([ends[0], ends[0] + tangents[0] / 3, ends[1] - tangents[1] / 3, ends[1]])
    row, slope = _elevated(cubic, _DEGREE), 3.0 * np.diff(cubic, axis=0)
    (a0, b0), (a1, b1) = parts
    v0, v1 = across
    quadratic = np.stack([a0 * v0, 0.5 * (a0 * v1 + a1 * v0), a1 * v1])
    c0, c1, c2 = slope
    towards = np.stack([b0 * c0, (2 * b0 * c1 + b1 * c0) / 3, (b0 * c2 + 2 * b1 * c1) / 3, b1 * c2])
    towards += _elevated(quadratic, 3)
    return row, row[:-1] + (_elevated(slope, 3) + towards) / (3 * _DEGREE)


def _layers(rows: FloatArray, seconds: FloatArray, middles: FloatArray) -> FloatArray:
    """Control points of the three pieces, joined with one tangent plane.

    Args:
        rows: Control points on the edges, shape (3 edges, 5, ...).
        seconds: Those of the next row, shape (3, 4, ...).
        middles: The middle one of the row after, which is free, shape (3, ...).

    Returns:
        Shape (3, 15, ...), numbered as of the triangle of the edge's ends and the centre.
    """
    last = np.roll(np.arange(PIECES), 1)
    inner = (seconds[:, 0] + seconds[:, 1] + seconds[last, 2]) / 3
    near = (inner + middles + middles[last]) / 3
    other = np.roll(np.arange(PIECES), -1)
    out = np.empty((PIECES, NUM_POINTS, *rows.shape[2:]))
    for i in range(_DEGREE + 1):
        out[:, _AT[_DEGREE - i, i, 0]] = rows[:, i]
    for i in range(_DEGREE):
        out[:, _AT[_DEGREE - 1 - i, i, 1]] = seconds[:, i]
    out[:, _AT[2, 0, 2]], out[:, _AT[1, 1, 2]], out[:, _AT[0, 2, 2]] = inner, middles, inner[other]
    out[:, _AT[1, 0, 3]], out[:, _AT[0, 1, 3]] = near, near[other]
    out[:, _AT[0, 0, 4]] = near.mean(axis=0)
    return out


@lru_cache
def _beyond() -> FloatArray:
    """Return the map (15, 15) from a piece's control points to those over the facet.

    The facet's corners are those of the edge and the one opposite, 3 centre - both.
    """
    out = np.zeros((NUM_POINTS, NUM_POINTS))
    for number, (i, j, k) in enumerate(_EXPONENTS):
        for a, b in product(range(k + 1), repeat=2):
            if a + b <= k:
                c = k - a - b
                scale = factorial(k) // (factorial(a) * factorial(b) * factorial(c))
                out[number, _AT[i + a, j + b, c]] += scale * (-1.0) ** (a + b) * 3.0**c
    return out


def _turned(points: FloatArray, k: int) -> FloatArray:
    """Control points numbered as of the corners k, k + 1 and k + 2, as of 0, 1 and 2, on axis 0."""
    return points[[_AT[e[k], e[(k + 1) % 3], e[(k + 2) % 3]] for e in _EXPONENTS]]


@lru_cache
def _middles() -> FloatArray:
    """Weights of 12 points on the edges and 6 beside them in the free points, shape (3, 18).

    Second and third derivatives jump where pieces meet. The free points make the sum of the squared
    jumps at the centre and half way to the corners least, so that polynomials of degree 4 stay what
    they are. (The second ones alone leave a hump open that bends all pieces alike.)
    """
    given, last = np.eye(21), np.roll(np.arange(PIECES), 1)
    rows = given[:12].reshape(PIECES, _DEGREE, -1)
    rows = np.concatenate([rows, np.roll(rows[:, :1], -1, axis=0)], axis=1)
    first = (rows[:, 0] + rows[:, 1] + rows[last, 3]) / 3
    beside = given[12:18].reshape(PIECES, 2, -1)
    seconds = np.stack([first, *beside.swapaxes(0, 1), np.roll(first, -1, axis=0)], axis=1)
    whole = _beyond() @ _layers(rows, seconds, given[18:])
    jump = np.stack([whole[k] - _turned(whole[last[k]], 2) for k in range(PIECES)])
    at = np.array([[1.0, 1.0], [0.5, 0.5]]) / 3
    across = along(at, np.array([[1.0, -1.0]] * 2))[:, :, 2:4]
    jumps = np.einsum("naj,kag->knjg", across, jump).reshape(-1, 21)
    return -np.linalg.pinv(jumps[:, 18:]) @ jumps[:, :18]


def _own_points(facets: IntArray, planes: Planes) -> tuple[IntArray, FloatArray]:
    """Points of each facet's patches, corners first, and the tangent planes' weights of them.

    Returns:
        Points, repeated ones without weight, shape (m, p), and weights, shape (m, 3, 2, p).
    """
    m, ring = len(facets), planes.ring[planes.fan]
    every = np.concatenate([facets, ring.reshape(m, -1)], axis=1)
    # Corners are to come first, in their order.
    key = every.copy()
    for k in range(3):
        key[every == facets[:, [k]]] = k - 3
    sorted_key = np.sort(key, axis=1)
    new = np.ones(key.shape, dtype=bool)
    new[:, 1:] = sorted_key[:, 1:] != sorted_key[:, :-1]
    row, column = np.nonzero(new)
    place = new.cumsum(axis=1)[row, column] - 1
    different = np.full((m, int(new.sum(axis=1).max(initial=0))), -3)
    different[row, place] = sorted_key[row, column]
    at = (key[:, 3:, None] == different[:, None]).argmax(axis=2).reshape(ring.shape)
    weights = np.zeros((m, 3, 2, different.shape[1]))
    own = planes.weights[planes.fan]
    index = np.arange(m)[:, None, None], np.arange(3)[:, None]
    for a in range(2):
        np.add.at(weights[:, :, a], (*index, at), own[:, :, a])
        weights[:, np.arange(3), a, np.arange(3)] -= own[:, :, a].sum(axis=2)
    corner = np.take_along_axis(facets, different.clip(-3, -1) + 3, axis=1)
    return np.where(different < 0, corner, different), weights


def control_net(facets: IntArray, x: FloatArray) -> tuple[IntArray, FloatArray, BoolArray]:
    """Control points of the patches as combinations of the surface's own points.

    A surface through the nodes with one tangent plane along each edge but for the rim, sharp edges,
    and edges that end at a node where the facets around see no common plane. Flat surfaces stay
    flat, and but for facets beside a curved rim xi is affine in space.

    Args:
        facets: Points of each facet, counter-clockwise seen from outside, shape (m, 3).
        x: Reference positions of all points [m], shape (p, 3).

    Returns:
        Points of each facet's patches, shape (m, q), of which repeated ones have no weight; weights
        (m, 3 pieces, 15 control points, q) [-]; and which facets have a corner without a tangent
        plane in common with all others around it, shape (m,).
    """
    edge = neighbours(facets, x[facets])
    fan = tangent_planes.fans(facets, edge)
    rims = Rims(edge < 0, np.roll(edge, 1, axis=1) < 0, tangent_planes.lines(facets, edge, x))
    planes = tangent_planes.planes(facets, fan, x, rims)
    without = np.zeros(len(x), dtype=bool)
    without[facets[planes.bad]] = True
    alone = without[facets]
    if alone.any():
        # There each facet has its own plane, and all edges are straight.
        fan = np.where(alone, fan.max() + 1 + np.arange(fan.size).reshape(fan.shape), fan)
        fan = np.unique(fan, return_inverse=True)[1].reshape(fan.shape)
        rims.line[without] = -1
        planes = tangent_planes.planes(
            facets, fan, x, Rims(rims.after | alone, rims.before | alone, rims.line)
        )
    points, d = _own_points(facets, planes)
    weights = np.empty((len(facets), PIECES, NUM_POINTS, points.shape[1]))
    for start in range(0, len(facets), _PORTION):
        part = slice(start, start + _PORTION)
        weights[part] = _weights(d[part], planes.after[part], planes.before[part])
    return points, weights, alone.any(axis=1)


def _weights(d: FloatArray, after: FloatArray, before: FloatArray) -> FloatArray:
    """Weights of facets' points in their control points, shape (m, 3 pieces, 15, q).

    Args:
        d: Weights of the points in the corners' tangent planes, shape (m, 3, 2, q).
        after: Of `Planes`.
        before: Of `Planes`.
    """
    one = np.zeros((3, len(d), d.shape[3]))
    one[np.arange(3), :, np.arange(3)] = 1.0

    def derivative(k: int, direction: FloatArray) -> FloatArray:
        """Return the derivative by a direction (m, 2) in the plane of corner k, shape (m, q)."""
        return np.einsum("ma,maq->mq", direction, d[:, k])

    rows, seconds = [], []
    for k in range(3):
        n = (k + 1) % 3
        # Along the edge, and towards the third corner, in the planes of both ends.
        ends = [(k, after[:, k], before[:, k]), (n, -before[:, n], after[:, n] - before[:, n])]
        tangents, across, parts = [], [], []
        for corner, e, third_corner in ends:
            normal = np.stack([-e[:, 1], e[:, 0]], axis=1)
            turned = tangent_planes.cross(e, third_corner)
            shares = np.stack([turned, np.einsum("ma,ma->m", e, third_corner)])
            tangents.append(derivative(corner, e))
            across.append(derivative(corner, normal))
            parts.append((shares / np.einsum("ma,ma->m", e, e))[:, :, None])
        row, second = _edge(one[[k, n]], *(np.stack(a) for a in (tangents, across, parts)))
        rows.append(row)
        seconds.append(second)
    row, second = np.stack(rows), np.stack(seconds)
    given = np.concatenate([a.reshape(-1, *row.shape[2:]) for a in (row[:, :4], second[:, 1:3])])
    middle = np.einsum("kg,gmq->kmq", _middles(), given)
    whole = np.einsum("ab,kbmq->kamq", _beyond(), _layers(row, second, middle))
    weights = np.stack([_turned(whole[k], k) for k in range(PIECES)]).transpose(2, 0, 1, 3).copy()
    # What rounding leaves here would be a force on nobody.
    weights[..., :3] += (1.0 - weights.sum(axis=3, keepdims=True)) / 3
    return weights
