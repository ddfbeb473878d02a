"""Bilinear quadrilateral and linear triangular facets: shape functions, frames, projections.

All functions are batched with axis 0 = pair (one point, one facet) and infer the kind of facet
from the number of corners `nc`:

- `nc = 4`: bilinear, corners cyclic and counter-clockwise seen from outside the body, `xi` in
  [-1, 1]^2, reference corners (-1, -1), (1, -1), (1, 1), (-1, 1);
- `nc = 3`: linear, N = (1 - xi_1 - xi_2, xi_1, xi_2), `xi` in the unit triangle.

`shape`, `third`, `frame` and `project` take the control points of a smooth patch as well: `nc = 16`
over a quadrilateral, see `patches`, and `nc = 15` over a triangle, see `triangle_patches`.

Lengths may come in any unit: every test in this module is relative.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dolfinx_nts.kernels import patches, triangle_patches
from dolfinx_nts.kernels.vectors import cross, solve_2x2
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

EPS = float(np.finfo(np.float64).eps)
#: Of the corners of a quadrilateral: derivatives by xi and eta in the middle, and by both.
_BILINEAR = 0.25 * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1], [1, -1, 1, -1]], dtype=float)

# Newton converges quadratically, so the step after one of this size is at round-off.
LAST_STEP = 1e-10
_MAX_NEWTON = 60
_MAX_HALVINGS = 40

CORNERS = {
    3: np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
    4: np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
}
#: Modules of smooth patches by the number of control points.
_SMOOTH = {p.NUM_POINTS: p for p in (patches, triangle_patches)}
#: Points and weights, exact for degree 2, on quadrilaterals for 3 in each direction.
QUADRATURE = {
    3: (np.array([[1.0, 1.0], [4.0, 1.0], [1.0, 4.0]]) / 6.0, np.full(3, 1.0 / 6.0)),
    4: (CORNERS[4] / np.sqrt(3.0), np.ones(4)),
}


def _reference(nc: int) -> FloatArray:
    """Reference corners [-], shape (nc, 2), or an error that names the supported kinds."""
    if nc not in CORNERS:
        raise ValueError(f"A facet has 3 (triangle) or 4 (quadrilateral) corners, not {nc}.")
    return CORNERS[nc]


def shape(xi: FloatArray, nc: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shape functions and their first and second derivatives.

    Args:
        xi: Convective coordinates [-], shape (n, 2).
        nc: Number of corners, 3 or 4, or of control points, 15 or 16.

    Returns:
        N [-], shape (n, nc); dN/dxi^a [-], shape (n, nc, 2); d2N/dxi^a dxi^b [-],
        shape (n, nc, 2, 2).
    """
    if nc in _SMOOTH:
        return _SMOOTH[nc].shape(xi)
    corner = _reference(nc)
    n = len(xi)
    if nc == 3:
        values = np.column_stack([1.0 - xi[:, 0] - xi[:, 1], xi])
        first = np.broadcast_to(np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]]), (n, 3, 2))
        return values, first.copy(), np.zeros((n, 3, 2, 2))
    factor = 1.0 + xi[:, None, :] * corner
    values = 0.25 * factor[..., 0] * factor[..., 1]
    first = 0.25 * corner * factor[..., ::-1]
    second = np.zeros((n, 4, 2, 2))
    second[..., 0, 1] = second[..., 1, 0] = 0.25 * corner[:, 0] * corner[:, 1]
    return values, first, second


def third(xi: FloatArray, nc: int) -> FloatArray | None:
    """Third derivatives of the shape functions, shape (n, nc, 2, 2, 2); None where they are 0.

    Args:
        xi: Convective coordinates [-], shape (n, 2).
        nc: Number of corners or control points.
    """
    return _SMOOTH[nc].third(xi) if nc in _SMOOTH else None


def frame(corners: FloatArray, xi: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Point, tangents and outward unit normal of each facet at its coordinates.

    Args:
        corners: Facet corners [m], shape (n, nc, 3).
        xi: Convective coordinates [-], shape (n, 2).

    Returns:
        Point [m], shape (n, 3); tangents a_1, a_2 [m], shape (n, 2, 3); normal
        a_1 x a_2 / |a_1 x a_2| [-], shape (n, 3), nan where the facet has no area at `xi`.
    """
    values, first, _ = shape(xi, corners.shape[1])
    point = np.einsum("ni,nij->nj", values, corners)
    tangents = np.matmul(first.transpose(0, 2, 1), corners)
    normal = cross(tangents[:, 0], tangents[:, 1])
    with np.errstate(invalid="ignore"):
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return point, tangents, normal


def size(corners: FloatArray) -> FloatArray:
    """Mean edge length of each facet [m], shape (n,); non-zero for slivers, too.

    Args:
        corners: Facet corners [m], shape (n, nc, 3).
    """
    edges = np.concatenate([corners[:, 1:], corners[:, :1]], axis=1) - corners
    lengths: FloatArray = np.sqrt(np.einsum("nki,nki->nk", edges, edges))
    return lengths.sum(axis=1) / corners.shape[1]


def edge_excess(xi: FloatArray, nc: int) -> FloatArray:
    """Return how far coordinates lie beyond each edge of the reference facet, in half facet widths.

    Args:
        xi: Convective coordinates [-], shape (n, 2).
        nc: Number of corners, 3 or 4.

    Returns:
        For edge k (corner k to k + 1), negative inside [-], shape (n, nc).
    """
    _reference(nc)
    a, b = xi.T
    if nc == 4:
        return np.column_stack([-1.0 - b, a - 1.0, b - 1.0, -1.0 - a])
    return 2.0 * np.column_stack([-b, a + b - 1.0, -a])


def turned_over(corners: FloatArray, xi: FloatArray) -> BoolArray:
    """Which facets face the other way where coordinates lie, far beyond an edge, shape (n,).

    A quadrilateral whose corners are in no plane goes on bent, and what projects onto it where it
    has turned over may be anywhere; triangles are flat, and smooth patches have neighbours.

    Args:
        corners: Facet corners or control points [m], shape (n, nc, 3).
        xi: Convective coordinates [-], shape (n, 2).
    """
    found = np.zeros(len(xi), dtype=bool)
    if corners.shape[1] != 4:
        return found
    beyond = np.flatnonzero((np.abs(xi) > 1.0).any(axis=1))
    if beyond.size:
        along, across, bent = (_BILINEAR @ corners[beyond]).swapaxes(0, 1)
        # The normal is (along + eta bent) x (across + xi bent).
        middle, at = cross(along, across), xi[beyond, :, None]
        more = cross(middle, at[:, 0] * along - at[:, 1] * across)
        found[beyond] = (middle * middle + bent * more).sum(axis=1) <= 0.0
    return found


def _shares(corners: FloatArray) -> FloatArray:
    """Integral of each N_I over its facet [m^2], shape (n, nc)."""
    nc = corners.shape[1]
    _reference(nc)
    points, weights = QUADRATURE[nc]
    values, first, _ = shape(points, nc)
    tangents = np.einsum("gia,nij->ngaj", first, corners)
    jacobian = np.linalg.norm(np.cross(tangents[:, :, 0], tangents[:, :, 1]), axis=2)
    return (jacobian * weights) @ values


def areas(corners: FloatArray) -> FloatArray:
    """Facet areas [m^2], shape (n,), by the quadrature of `tributary_areas`.

    Args:
        corners: Facet corners [m], shape (n, nc, 3).
    """
    return _shares(corners).sum(axis=1)


def tributary_areas(facets: IntArray, corners: FloatArray, num_points: int) -> FloatArray:
    """Area that belongs to each surface point: the integral of its N_I over all facets.

    Exact for triangles and parallelograms, 2 x 2 Gauss points for other quadrilaterals.

    Args:
        facets: Point number of each corner, shape (nf, nc).
        corners: Facet corners [m], shape (nf, nc, 3).
        num_points: Number of surface points.

    Returns:
        Areas [m^2], shape (num_points,), which sum up to the sum of `areas`.
    """
    shares = _shares(corners).ravel()
    total = np.zeros(num_points)
    np.add.at(total, facets.ravel(), shares)
    return total


def _symmetric(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solutions (2, n) of symmetric systems (11, 12, 22; n), see `solve_2x2`."""
    m11, m12, m22 = matrix
    return solve_2x2((m11, m12, m12, m22), (right[0], right[1]))


#: Of |xbar - x|^2 / 2 at the current coordinates: gradient (2, n), metric and Hessian (11, 12, 22)
#: of shape (3, n), and step (2, n) -> coefficients of t, t^2, .. of the change after t steps.
_Expansion = tuple[FloatArray, FloatArray, FloatArray, Callable[[FloatArray], list[FloatArray]]]


def _modes(start: FloatArray, spans: FloatArray) -> FloatArray:
    """Vectors of xbar - x = c_0 + c_1 s + c_2 t + c_3 s t [m], shape (4, 3, n)."""
    if spans.shape[1] == 3:
        return np.stack([start.T, spans[:, 1].T, spans[:, 2].T, np.zeros(start.T.shape)])
    s, t = CORNERS[4].T
    corners = spans.transpose(1, 2, 0).reshape(4, -1)
    c = (0.25 * np.array([np.ones(4), s, t, s * t]) @ corners).reshape(4, 3, -1)
    c[0] += start.T
    return c


def _bilinear(c: FloatArray, xi: FloatArray) -> _Expansion:
    """Expansion of the distance from facets.

    Args:
        c: Of `_modes` [m], shape (4, 3, n).
        xi: Convective coordinates [-], shape (2, n).
    """
    vectors = np.empty(c.shape)
    vectors[:2] = c[1:3] + xi[::-1, None] * c[3]
    vectors[2] = c[3]
    vectors[3] = c[0] + xi[0] * c[1] + xi[1] * vectors[1]
    g = np.einsum("kjn,ljn->kln", vectors, vectors)
    metric = g[[0, 0, 1], [0, 1, 1]]
    hessian = metric.copy()
    hessian[1] += g[2, 3]

    def change(step: FloatArray) -> list[FloatArray]:
        a, b = step
        twist = a * b
        along = 0.5 * (a * (a * g[0, 0] + 2.0 * b * g[0, 1]) + b * b * g[1, 1])
        cross = twist * (a * g[0, 2] + b * g[1, 2])
        return [
            a * g[0, 3] + b * g[1, 3], along + twist * g[2, 3], cross, 0.5 * twist**2 * g[2, 2],
        ]  # fmt: skip

    return g[:2, 3], metric, hessian, change


def _curved(start: FloatArray, spans: FloatArray, xi: FloatArray) -> _Expansion:
    """Expansion of the distance from smooth patches.

    Args:
        start: First corner relative to the point [m], shape (n, 3).
        spans: Control points relative to the first corner [m], shape (n, nc, 3).
        xi: Convective coordinates [-], shape (2, n).
    """
    values, first, second = shape(xi.T, spans.shape[1])
    offset = start + np.einsum("ni,nij->nj", values, spans)
    tangents = np.einsum("nia,nij->anj", first, spans)
    gradient = np.einsum("anj,nj->an", tangents, offset)
    square = np.einsum("anj,bnj->abn", tangents, tangents)
    height = np.matmul(spans, offset[:, :, None])[:, :, 0]
    curved = square + np.einsum("niab,ni->abn", second, height)
    metric, hessian = (np.stack([a[0, 0], a[0, 1], a[1, 1]]) for a in (square, curved))

    def change(step: FloatArray) -> list[FloatArray]:
        along = _SMOOTH[spans.shape[1]].along(xi.T, step.T)
        powers = np.einsum("nip,nij->pnj", along[:, :, 1:], spans)
        out = np.zeros((2 * len(powers), len(start)))
        out[: len(powers)] = np.einsum("pnj,nj->pn", powers, offset)
        out[0] = np.einsum("an,an->n", gradient, step)
        for i, one in enumerate(powers):
            for j, two in enumerate(powers):
                out[i + j + 1] += 0.5 * np.einsum("nj,nj->n", one, two)
        return list(out)

    return gradient, metric, hessian, change


def _descent_step(gradient: FloatArray, metric: FloatArray, hessian: FloatArray) -> FloatArray:
    """Newton step for |xbar - x|^2 / 2 [-], shape (2, n); makes the Hessian definite in place."""
    in_a, mixed, in_b = hessian
    # Beyond the centre of curvature Newton would climb to a saddle: descend on a definite matrix.
    bound = np.sqrt(np.maximum(in_a, 0.0) * np.maximum(in_b, 0.0))
    bad = np.abs(mixed) >= bound * (1.0 - 1e-8)
    if bad.any():
        limit = 0.9 * np.sqrt(metric[0, bad] * metric[2, bad])
        mixed[bad] = np.clip(mixed[bad], -limit, limit)
        in_a[bad], in_b[bad] = metric[0, bad], metric[2, bad]
    return -_symmetric(hessian, gradient)


def _step_length(change: list[FloatArray]) -> FloatArray:
    """First of 1, 1/2, 1/4, ... with sufficient descent, shape (n,); 0 where there is none."""
    length = np.ones(len(change[0]))
    for _ in range(_MAX_HALVINGS):
        gain = change[-1]
        for coefficient in change[-2::-1]:
            gain = coefficient + length * gain
        poor = ~(gain <= 1e-4 * change[0])
        if not poor.any():
            return length
        length[poor] *= 0.5
    length[poor] = 0.0
    return length


def _local(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """First corner from the point, shape (n, 3), and corners from it, shape (n, nc, 3), both [m].

    Kept apart because the tangents of a facet must not lose digits to a far point.
    """
    return corners[:, 0] - points, corners - corners[:, :1]


@np.errstate(divide="ignore", invalid="ignore")
def _refine(start: FloatArray, spans: FloatArray, xi: FloatArray) -> tuple[FloatArray, BoolArray]:
    """The Newton iterations of `project`; start and spans as of `_local`."""
    xi = np.array(np.transpose(xi), dtype=np.float64)
    converged = np.zeros(xi.shape[1], dtype=bool)
    # Rounding of `start` limits the step that a far point can reach.
    far = np.abs(start).max(axis=1) / np.abs(spans).max(axis=(1, 2))
    last_step = LAST_STEP + 1e3 * EPS * far
    modes = None if spans.shape[1] in _SMOOTH else _modes(start, spans)
    active = np.arange(len(start))
    for _ in range(_MAX_NEWTON):
        if not active.size:
            break
        if modes is None:
            *terms, change = _curved(start[active], spans[active], xi[:, active])
        else:
            *terms, change = _bilinear(modes[:, :, active], xi[:, active])
        step = _descent_step(*terms)
        largest = np.abs(step).max(axis=0)
        # Not so where a step is not finite.
        last = largest <= last_step[active]
        if last.all():
            xi[:, active] += step
            converged[active] = True
            break
        finite = np.isfinite(largest)
        length = np.where(last, 1.0, _step_length(change(step)))
        xi[:, active[finite]] += (length * step)[:, finite]
        converged[active[last]] = True
        active = active[finite & ~last & (length > 0.0)]
    return xi.T, converged


def project(
    points: FloatArray, corners: FloatArray, xi: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Unclamped orthogonal projection onto the extended surface: (x - xbar) . a_a = 0.

    Newton's method from the given start to round-off. It only takes steps that bring the foot
    point nearer, so it ends at a (local) minimum of the distance, and a projection that does not
    converge is still the best one found.

    Args:
        points: Points x [m], shape (n, 3).
        corners: Facet corners or control points [m], shape (n, nc, 3).
        xi: Start [-], shape (n, 2).

    Returns:
        Coordinates [-], shape (n, 2), not restricted to the facet, and whether each converged,
        shape (n,).
    """
    return _refine(*_local(points, corners), xi)
