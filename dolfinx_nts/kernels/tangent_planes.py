"""Tangent planes at the nodes of a surface of triangles, which its smooth patches share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dolfinx_nts.kernels.patches import SHARP
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: What a second derivative weighs in fits to a node's ring: little where the ring tells it.
_RIDGE = 1e-2
#: A fit's plane must see a facet no flatter than this cosine, and edges no straighter than this
#: sine.
_STEEP, _STRAIGHT = 0.2, 0.25


class Rims(NamedTuple):
    """Where tangent planes of facets beside each other need not be the same.

    Attributes:
        after: Whether the facet beside the edge to the next corner has another, shape (m, 3).
        before: The same of the edge to the last corner, shape (m, 3).
        line: Two points beside each point on a line of such edges that runs on there, shape
            (points, 2); -1 where none does.
    """

    after: BoolArray
    before: BoolArray
    line: IntArray


class Planes(NamedTuple):
    """Tangent planes of fans: the facets around a node that edges join smoothly.

    Attributes:
        fan: Fan of each corner of the facets, shape (m, 3).
        ring: Points that the plane depends on, repeated ones without weight, shape (n, r).
        weights: Weights of their positions less the node's in the derivatives by the two
            coordinates of the plane, shape (n, 2, r).
        after: Coordinates of the tangent of the edge to the next corner [m], shape (m, 3, 2).
        before: The same of the edge to the last corner [m], shape (m, 3, 2).
        bad: Which corners the plane of their fan does not do for, shape (m, 3).
    """

    fan: IntArray
    ring: IntArray
    weights: FloatArray
    after: FloatArray
    before: FloatArray
    bad: BoolArray


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product of vectors in a plane, (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def fans(facets: IntArray, edge: IntArray) -> IntArray:
    """Fan of each corner, shape (m, 3), from the edges' `neighbours`."""
    f, k = np.nonzero(edge >= 0)
    g, j = np.divmod(edge[f, k], 3)
    one = np.r_[3 * f + k, 3 * f + (k + 1) % 3]
    two = np.r_[3 * g + (j + 1) % 3, 3 * g + j]
    joined = coo_array((np.ones(len(one)), (one, two)), shape=(facets.size, facets.size))
    return connected_components(joined, directed=False)[1].reshape(facets.shape)


def lines(facets: IntArray, edge: IntArray, x: FloatArray) -> IntArray:
    """Attribute `line` of `Rims`: where two edges that are not smooth go on nearly straight."""
    f, k = np.nonzero(edge < 0)
    ends = np.sort(np.column_stack([facets[f, k], facets[f, (k + 1) % 3]]), axis=1)
    ends = np.unique(ends, axis=0)
    both = np.concatenate([ends, ends[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    count = np.bincount(both[:, 0], minlength=len(x))
    pair = np.flatnonzero(count == 2)
    beside = both[(np.cumsum(count) - count)[pair, None] + np.arange(2), 1]
    arms = x[beside] - x[pair, None]
    arms /= np.linalg.norm(arms, axis=2, keepdims=True)
    straight = -np.einsum("ni,ni->n", arms[:, 0], arms[:, 1]) >= SHARP
    line = np.full((len(x), 2), -1)
    line[pair[straight]] = beside[straight]
    return line


def _rings(fan: IntArray, point: IntArray, node: IntArray) -> tuple[IntArray, BoolArray]:
    """Different points of each fan in rows, filled up with the fan's node; and which are points."""
    pairs = np.unique(np.column_stack([fan, point]), axis=0)
    count = np.bincount(pairs[:, 0], minlength=len(node))
    column = np.arange(len(pairs)) - np.repeat(np.cumsum(count) - count, count)
    ring = np.repeat(node[:, None], int(count.max(initial=0)), axis=1)
    ring[pairs[:, 0], column] = pairs[:, 1]
    return ring, np.arange(ring.shape[1]) < count[:, None]


def _fit(linear: FloatArray, p: FloatArray) -> FloatArray:
    """Weights (n, u, r) of data at places p (n, r, 2) in the quadratics that fit them best.

    Args:
        linear: Linear unknowns in each datum, shape (n, r, u).
        p: Places [-].
    """
    (n, r, u), (s, t) = linear.shape, p.transpose(2, 0, 1)
    rows = np.zeros((n, r + 3, u + 3))
    # So scaled, what a second derivative weighs is the same in any axes of the plane.
    mixed = np.sqrt(2.0) * s * t
    rows[:, :r, :u], rows[:, :r, u:] = linear, np.stack([s * s, mixed, t * t], axis=2)
    rows[:, r:, u:] = _RIDGE * np.eye(3)
    return np.linalg.pinv(rows)[:, :u, :r]


def planes(facets: IntArray, fan: IntArray, x: FloatArray, rims: Rims) -> Planes:
    """Tangent planes of given fans.

    A fan around an inner point takes the linear part of the quadratic that fits its ring best. A
    line of sharp edges, or a rim, that runs on has the tangent of the parabola through three of its
    points, to which the fit adds a direction across it. Where such lines end, edges are straight,
    and those at both ends of a fan span its plane.
    """
    flat, node = fan.ravel(), np.zeros(int(fan.max(initial=-1)) + 1, dtype=np.int64)
    node[flat] = facets.ravel()
    after, before = (np.roll(facets, shift, axis=1).ravel() for shift in (-1, 1))
    ring, there = _rings(np.r_[flat, flat], np.r_[after, before], node)
    corners = x[facets]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.zeros((len(node), 3))
    np.add.at(normal, flat, np.repeat(area, 3, axis=0))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = np.cross(np.eye(3)[np.abs(normal).argmin(axis=1)], normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first)], axis=1)
    p = np.einsum("nri,nai->nra", x[ring] - x[node][:, None], axes)
    size = np.sqrt((p**2).sum(axis=(1, 2)) / there.sum(axis=1))[:, None, None]
    weights, tangents = _fit(p / size, p / size) / size, p.copy()

    ends = np.full((len(node), 2), -1)
    for end, (side, point) in enumerate(((rims.after, after), (rims.before, before))):
        ends[flat[side.ravel()], end] = point[side.ravel()]
    bad = (ends[:, 0] >= 0) & (ends[:, 0] == ends[:, 1])
    one = np.flatnonzero((ends[:, 0] >= 0) & ~bad)
    at = (ring[one][:, :, None] == ends[one][:, None]).argmax(axis=1)
    runs = rims.line[node[one], 0] >= 0
    on, at_on = one[runs], at[runs]
    weights[on], tau = _beside_line(p[on], size[on], at_on)
    tangents[on[:, None], at_on] = tau
    on, at_on = one[~runs], at[~runs]
    arms = p[on[:, None], at_on]
    turn, length = cross(arms[:, 0], arms[:, 1]), np.linalg.norm(arms, axis=2).prod(axis=1)
    several = np.bincount(flat, minlength=len(node))[on] > 1
    bad[on] = several & (np.abs(turn) < _STRAIGHT * length)
    weights[on] = 0.0
    weights[on[:, None], :, at_on] = np.linalg.pinv(arms).transpose(0, 2, 1)

    def of(point: IntArray) -> FloatArray:
        column = (ring[flat] == point[:, None]).argmax(axis=1)
        return tangents[flat, column].reshape(*fan.shape, 2)

    to, fro = of(after), of(before)
    upright = np.einsum("mi,mki->mk", area, normal[fan])
    upright /= np.linalg.norm(area, axis=1, keepdims=True)
    bad = bad[fan] | (cross(to, fro) <= 0.0) | (upright < _STEEP)
    return Planes(fan, ring, weights, to, fro, bad)


def _beside_line(p: FloatArray, size: FloatArray, at: IntArray) -> tuple[FloatArray, FloatArray]:
    """Tangent planes of fans that end at a line of edges which runs on through their nodes.

    Args:
        p: Places of the rings in the planes [m], shape (n, r, 2).
        size: Sizes of the rings [m], shape (n, 1, 1).
        at: Columns of the points on the line, shape (n, 2).

    Returns:
        Weights as of `Planes`, (n, 2, r), and tangents towards both points [m], shape (n, 2, 2).
    """
    every = np.arange(len(p))[:, None]
    length = np.linalg.norm(p[every, at], axis=2)
    # With x = x_0 + a s + b s^2 through s = -r, 0 and 1.
    r = length[:, 1] / length[:, 0]
    line = np.zeros(p.shape[:2])
    line[every, at] = np.stack([r / (1.0 + r), -1.0 / (r * (1.0 + r))], axis=1)
    tau = np.einsum("nr,nra->na", line, p)
    unit = tau / np.linalg.norm(tau, axis=1, keepdims=True)
    across = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    height = np.einsum("nra,na->nr", p, across) / size[:, 0]
    h = _fit(height[:, :, None], p / size)[:, 0] / size[:, 0]
    along_line = line / np.linalg.norm(tau, axis=1)[:, None]
    h -= np.einsum("nr,nra,na->n", h, p, unit)[:, None] * along_line
    weights = np.einsum("na,nr->nar", unit, along_line) + np.einsum("na,nr->nar", across, h)
    return weights, np.stack([tau, -r[:, None] * tau], axis=1)
