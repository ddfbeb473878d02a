"""Smooth patches over quadrilateral facets: bicubic, interpolating, linear in the nodes.

A patch is the tensor product of Overhauser's cubics (Catmull and Rom 1974: each piece runs from
control point 0 to 1, with half the chord of their neighbours as tangents) over the 4 x 4 control
points of a facet and its ring. Axis 0 is the pair or the facet, and

- the control points are four of each kind, cyclic like the corners k: the corners; those beyond k
  on the line of the edge from k + 1; those beyond k on the line of the edge from k - 1; those
  diagonally beyond k;
- `xi` in [-1, 1]^2 is the facet's.
"""

from __future__ import annotations

import numpy as np

from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Control points of a patch.
NUM_POINTS = 16
#: Least cosine between the normals of facets that an edge joins smoothly; sharper ones stay edges.
SHARP = 0.5

#: Coefficients of 1, s, s^2, s^3 of the cubics of the control points at s = -3, -1, 1, 3.
_CUBICS = np.array([[-1, 1, 1, -1], [9, -11, -1, 3], [9, 11, -1, -3], [-1, -1, 1, 1]]) / 16.0
#: The same of their derivatives by s, order 0 to 3 on axis 0.
_DERIVATIVES = np.array(
    [
        np.pad(np.polynomial.polynomial.polyder(_CUBICS, order, axis=1), ((0, 0), (0, order)))
        for order in range(4)
    ]
)
_CORNER = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
#: BalanceRow and column of each control point in the 4 x 4 grid.
_ROW, _COLUMN = (
    np.concatenate(
        [
            _CORNER,
            2 * _CORNER - np.roll(_CORNER, -1, axis=0),
            2 * _CORNER - np.roll(_CORNER, 1, axis=0),
            3 * _CORNER,
        ]
    )
    + 3
).T // 2
#: Where control points are whose patch is as even as a facet, shape (16, 2).
PLACES = np.stack([2.0 * _ROW - 3.0, 2.0 * _COLUMN - 3.0], axis=1)


def _cubics(s: FloatArray) -> FloatArray:
    """Cubics and their derivatives at s, shape (order 4, n, 4)."""
    powers = s[:, None] ** np.arange(4)
    return np.matmul(powers, _DERIVATIVES.transpose(0, 2, 1))


def _derivative(xi: FloatArray, orders: list[tuple[int, int]]) -> list[FloatArray]:
    """Derivatives of the shape functions of given orders in both coordinates, each (n, 16)."""
    a, b = _cubics(xi[:, 0])[:, :, _ROW], _cubics(xi[:, 1])[:, :, _COLUMN]
    return [a[i] * b[j] for i, j in orders]


def shape(xi: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shape functions of the control points, with first and second derivatives.

    Args:
        xi: Convective coordinates [-], shape (n, 2).

    Returns:
        Shapes (n, 16), (n, 16, 2) and (n, 16, 2, 2).
    """
    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    value, da, db, daa, dab, dbb = _derivative(xi, orders)
    second = np.stack([daa, dab, dab, dbb], axis=2).reshape(len(xi), NUM_POINTS, 2, 2)
    return value, np.stack([da, db], axis=2), second


def third(xi: FloatArray) -> FloatArray:
    """Third derivatives of the shape functions at xi (n, 2), shape (n, 16, 2, 2, 2)."""
    d = _derivative(xi, [(3, 0), (2, 1), (1, 2), (0, 3)])
    parts = [d[a + b + c] for a in range(2) for b in range(2) for c in range(2)]
    return np.stack(parts, axis=2).reshape(len(xi), NUM_POINTS, 2, 2, 2)


def along(xi: FloatArray, step: FloatArray) -> FloatArray:
    """Coefficients of t^0 .. t^6 of the shape functions at xi + t step, shape (n, 16, 7).

    Args:
        xi: Convective coordinates [-], shape (n, 2).
        step: Direction [-], shape (n, 2).
    """
    order = np.arange(4)
    factor = step[:, :, None] ** order / np.array([1.0, 1.0, 2.0, 6.0])
    a, b = (_cubics(xi[:, k]).transpose(1, 2, 0) * factor[:, None, k] for k in range(2))
    a, b = a[:, _ROW], b[:, _COLUMN]
    out = np.zeros((len(xi), NUM_POINTS, 7))
    for i in order:
        out[:, :, i : i + 4] += a[:, :, i, None] * b
    return out


def neighbours(facets: IntArray, corners: FloatArray, sharp: float = SHARP) -> IntArray:
    """Number nc f + k of the edge that facet f's edge k (corner k to k + 1) is joined to.

    Args:
        facets: Points of each facet, cyclic, same orientation for all, shape (m, nc).
        corners: Their positions in the reference configuration [m], shape (m, nc, 3).
        sharp: Edges are sharp where facets' normals have a cosine below this, and join nothing;
            -inf: no edge is.

    Returns:
        Shape (m, nc); -1 at the end of the surface, at sharp edges and where it branches.
    """
    nc = facets.shape[1]
    spans = corners - corners[:, :1]
    normal = np.cross(spans, np.roll(spans, -1, axis=1)).sum(axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    start, end = facets.ravel(), np.roll(facets, -1, axis=1).ravel()
    order = np.lexsort((np.maximum(start, end), np.minimum(start, end)))
    key = np.sort(np.column_stack([start, end])[order], axis=1)
    first = np.flatnonzero(np.r_[True, (key[1:] != key[:-1]).any(axis=1)])
    count = np.diff(first, append=len(key))
    one, two = order[first[count == 2]], order[first[count == 2] + 1]
    smooth = np.einsum("ni,ni->n", normal[one // nc], normal[two // nc]) >= sharp
    smooth &= start[one] == end[two]
    across = np.full(len(start), -1)
    across[one[smooth]], across[two[smooth]] = two[smooth], one[smooth]
    return across.reshape(facets.shape)


def _follow(to: IntArray, start: IntArray) -> IntArray:
    """to[start], with -1 where start is -1."""
    return np.where(start >= 0, to[start], -1)


def control_net(facets: IntArray, corners: FloatArray) -> tuple[IntArray, FloatArray, BoolArray]:
    """Control points of the patches as combinations of the surface's own points.

    A line of edges runs straight on through a point of four facets, and along a rim through a
    point of two. Where it does not run on (the rim itself, sharp edges, other points), the control
    point beyond is extrapolated linearly, which makes that end of the edge straight. What happens
    along an edge depends on the edge alone: patches are always joined without gaps, and with one
    tangent plane where all eight points around their edge are regular.

    Args:
        facets: Points of each facet, cyclic, same orientation for all, shape (m, 4).
        corners: Their positions in the reference configuration [m], shape (m, 4, 3).

    Returns:
        Points of each patch, shape (m, 16), of which repeated ones have no weight; weights (m, 16
        control points, 16 points) [-]; and which facets have an irregular corner, shape (m,).
    """
    m = len(facets)
    edge = neighbours(facets, corners)
    # The same point as a corner of the next facet clockwise and counter-clockwise around it.
    a = np.roll(edge, 1, axis=1).ravel()
    b = np.where(edge >= 0, edge - edge % 4 + (edge + 1) % 4, -1).ravel()
    aa, bb = _follow(a, a), _follow(b, b)
    own = np.arange(4 * m)
    kind = np.zeros(4 * m, dtype=int)
    kind[(a < 0) & (b < 0)] = 1
    kind[((a >= 0) & (aa < 0) & (b < 0)) | ((b >= 0) & (bb < 0) & (a < 0))] = 2
    kind[(_follow(aa, aa) == own) & (aa != own)] = 4
    # An edge that two sides see alike needs one rule on all sides of its ends.
    size = int(facets.max(initial=-1)) + 1
    low, high = np.full(size, 4), np.zeros(size, dtype=int)
    np.minimum.at(low, facets.ravel(), kind)
    np.maximum.at(high, facets.ravel(), kind)
    regular = ((low == high) & (low > 0))[facets.ravel()]
    has = [regular & (a >= 0), regular & (b >= 0), regular & (kind == 4)]
    beyond = [
        np.roll(facets, shift, axis=1).ravel()[_follow(to, own)]
        for shift, to in ((1, a), (-1, b), (-2, aa))
    ]
    slots = [facets] + [
        np.where(there, point, facets.ravel()).reshape(m, 4)
        for there, point in zip(has, beyond, strict=True)
    ]
    weights = _weights(*(there.reshape(m, 4) for there in has))
    return np.concatenate(slots, axis=1), weights, ~regular.reshape(m, 4).all(axis=1)


def _weights(has_a: BoolArray, has_b: BoolArray, has_diagonal: BoolArray) -> FloatArray:
    """Weights of `control_net` from which of the points beyond each corner exist, each (m, 4)."""
    m = len(has_a)
    weights = np.zeros((m, NUM_POINTS, NUM_POINTS))
    one = np.eye(NUM_POINTS)
    weights[:, :4] = one[:4]
    for k in range(4):
        after, before = (k + 1) % 4, (k - 1) % 4
        weights[:, 4 + k] = np.where(has_a[:, k, None], one[4 + k], 2 * one[k] - one[after])
        weights[:, 8 + k] = np.where(has_b[:, k, None], one[8 + k], 2 * one[k] - one[before])
    for k in range(4):
        after, before = (k + 1) % 4, (k - 1) % 4
        by_a = 2 * weights[:, 4 + k] - weights[:, 8 + before]
        by_b = 2 * weights[:, 8 + k] - weights[:, 4 + after]
        # A line that runs on is a line of control points; across it the rim is extrapolated.
        share = 0.5 * (1.0 + has_a[:, k].astype(float) - has_b[:, k])[:, None]
        rest = share * by_a + (1.0 - share) * by_b
        weights[:, 12 + k] = np.where(has_diagonal[:, k, None], one[12 + k], rest)
    return weights
