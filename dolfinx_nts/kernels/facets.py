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
import numpy.typing as npt

from dolfinx_nts.kernels import patches, triangle_patches
from dolfinx_nts.kernels.vectors import cross, solve_2x2

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int_]
BoolArray = npt.NDArray[np.bool_]

EPS = float(np.finfo(np.float64).eps)

# Newton converges quadratically, so the step after one of this size is at round-off.
LAST_STEP = 1e-10
_MAX_NEWTON = 60
# Squared sine of an angle between two edges that is rounding only.
COLLINEAR = 1e-14
_MAX_HALVINGS = 40
_MAX_BISECTIONS = 120

_REFERENCE = {
    3: np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
    4: np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
}
#: Modules of smooth patches by the number of control points.
_SMOOTH = {p.NUM_POINTS: p for p in (patches, triangle_patches)}
# Exact for what the facets need: integrals of N_I over a flat triangle, and over a parallelogram.
_QUADRATURE = {
    3: (np.array([[1.0, 1.0]]) / 3.0, np.array([0.5])),
    4: (_REFERENCE[4] / np.sqrt(3.0), np.ones(4)),
}


def _reference(nc: int) -> FloatArray:
    """Reference corners [-], shape (nc, 2), or an error that names the supported kinds."""
    if nc not in _REFERENCE:
        raise ValueError(f"A facet has 3 (triangle) or 4 (quadrilateral) corners, not {nc}.")
    return _REFERENCE[nc]


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
    tangents = np.einsum("nia,nij->naj", first, corners)
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


def _shares(corners: FloatArray) -> FloatArray:
    """Integral of each N_I over its facet [m^2], shape (n, nc)."""
    nc = corners.shape[1]
    _reference(nc)
    points, weights = _QUADRATURE[nc]
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
    s, t = _REFERENCE[4].T
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


def closest_point(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Global closest point of each bounded facet, edges and corners included.

    Triangles are solved directly. A quadrilateral whose squared distance is convex over the
    reference square (proved per pair by exact bounds of its Hessian) has one minimum, found by a
    bracketed Newton method; for all others every stationary point is enumerated.

    Args:
        points: Points x [m], shape (n, 3).
        corners: Facet corners [m], shape (n, nc, 3).

    Returns:
        Coordinates in the closed reference facet [-], shape (n, 2), and distances [m], shape (n,).
    """
    nc = corners.shape[1]
    _reference(nc)
    start, spans = _local(points, corners)
    if nc == 3:
        xi = _closest_triangle(start, spans)
    else:
        gram = _gram(start, spans)
        convex = _is_convex(gram)
        xi = np.empty((len(points), 2))
        xi[convex] = _closest_convex(gram[:, :, convex])
        if not convex.all():
            xi[~convex] = _closest_warped(start[~convex], spans[~convex])
    return xi, _distance(start, spans, xi)


def _distance(start: FloatArray, spans: FloatArray, xi: FloatArray) -> FloatArray:
    """Distance of the facets' points at `xi` [m], shape (n,)."""
    offset = start + np.einsum("ni,nij->nj", shape(xi, spans.shape[1])[0], spans)
    return np.linalg.norm(offset, axis=1)


def _closest_edge(start: FloatArray, spans: FloatArray) -> FloatArray:
    """Closest point on the facets' boundaries [-], shape (n, 2)."""
    corner = _reference(spans.shape[1])
    y = start[:, None] + spans
    edges = np.roll(spans, -1, axis=1) - spans
    square = np.einsum("nij,nij->ni", edges, edges)
    along = -np.einsum("nij,nij->ni", y, edges)
    # A collapsed edge is its corner.
    tau = np.divide(along, square, out=np.zeros_like(square), where=square > 0.0).clip(0.0, 1.0)
    foot = y + tau[..., None] * edges
    best = np.einsum("nij,nij->ni", foot, foot).argmin(axis=1)
    tau_best = tau[np.arange(len(y)), best][:, None]
    return (1.0 - tau_best) * corner[best] + tau_best * np.roll(corner, -1, 0)[best]


@np.errstate(divide="ignore", invalid="ignore")
def _closest_triangle(start: FloatArray, spans: FloatArray) -> FloatArray:
    """Closest point on triangles [-], shape (n, 2)."""
    gradient, metric, _, _ = _bilinear(_modes(start, spans), np.zeros((2, len(start))))
    xi = -_symmetric(metric, gradient).T
    square = metric[0] * metric[2]
    flat = square - metric[1] ** 2 <= COLLINEAR * square
    xi[flat] = -1.0
    outside = ~((xi >= 0.0).all(axis=1) & (xi.sum(axis=1) <= 1.0))
    xi[outside] = _closest_edge(start[outside], spans[outside])
    return xi


def _gram(start: FloatArray, spans: FloatArray) -> FloatArray:
    """Products c_k . c_l of `_modes` [m^2], shape (4, 4, n)."""
    c = _modes(start, spans)
    return np.einsum("kjn,ljn->kln", c, c)


def _least(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Minimum of a + 2 b t + c t^2 over [-1, 1] with c >= 0, shape (n,)."""
    inner = np.divide(-b, c, out=-np.sign(b), where=np.abs(b) < c)
    return a + inner * (2.0 * b + c * inner)


def _is_convex(g: FloatArray) -> BoolArray:
    """Return whether |xbar - x|^2 is certainly convex over the reference square, shape (n,).

    Its second derivatives in s, in t, and the mixed one depend on t only, on s only, and are
    bilinear: their extremes are known exactly.
    """
    in_s = _least(g[1, 1], g[1, 3], g[3, 3])
    in_t = _least(g[2, 2], g[2, 3], g[3, 3])
    mixed = [
        np.abs(g[0, 3] + g[1, 2] + 2.0 * (g[1, 3] * s + g[2, 3] * t + g[3, 3] * s * t))
        for s, t in _REFERENCE[4]
    ]
    return (in_s > 0.0) & (np.max(mixed, axis=0) ** 2 < in_s * in_t)


def _slope(g: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Minimise over s in [-1, 1] at fixed t.

    Args:
        g: Products of `_gram` [m^2], shape (4, 4, n).
        t: Second coordinate [-], shape (n,).

    Returns:
        The minimiser s [-] and the first and second derivative by t of the minimum of
        |xbar - x|^2 / 2 [m^2], each of shape (n,).
    """
    cross = g[0, 3] + g[1, 2]
    square = g[1, 1] + t * (2.0 * g[1, 3] + t * g[3, 3])
    raw = -(g[0, 1] + t * (cross + t * g[2, 3])) / square
    s = raw.clip(-1.0, 1.0)
    in_t = g[2, 2] + s * (2.0 * g[2, 3] + s * g[3, 3])
    mixed = cross + 2.0 * (g[1, 3] * s + t * (g[2, 3] + g[3, 3] * s))
    slope = g[0, 2] + s * (cross + g[1, 3] * s) + t * in_t
    return s, slope, in_t - np.where(raw == s, mixed**2 / square, 0.0)


@np.errstate(divide="ignore", invalid="ignore")
def _closest_convex(g: FloatArray) -> FloatArray:
    """Closest point where |xbar - x|^2 is convex: the root of a monotone function of t.

    Args:
        g: Products of `_gram` [m^2], shape (4, 4, n).

    Returns:
        Coordinates [-], shape (n, 2).
    """
    n = g.shape[2]
    t = np.zeros(n)
    ends = np.ones(n)
    t[_slope(g, -ends)[1] >= 0.0] = -1.0
    t[_slope(g, ends)[1] <= 0.0] = 1.0
    active = np.flatnonzero(np.abs(t) < 1.0)
    low, high = -np.ones(len(active)), np.ones(len(active))
    g_active = g[:, :, active]
    for _ in range(_MAX_BISECTIONS):
        if not active.size:
            break
        old = t[active]
        _, slope, curvature = _slope(g_active, old)
        low, high = np.where(slope < 0.0, old, low), np.where(slope < 0.0, high, old)
        new = old - slope / curvature
        newton = (new >= low) & (new <= high)
        t[active] = new = np.where(newton, new, 0.5 * (low + high))
        last = newton & (np.abs(new - old) <= LAST_STEP)
        rest = ~(last | (high - low <= 4.0 * EPS))
        active, low, high = active[rest], low[rest], high[rest]
        g_active = g_active[:, :, rest]
    return np.column_stack([_slope(g, t)[0], t])


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Coefficients of products of polynomials, lowest power first, shape (n, ka + kb - 1)."""
    result = np.zeros((len(a), a.shape[1] + b.shape[1] - 1))
    for power in range(a.shape[1]):
        result[:, power : power + b.shape[1]] += a[:, power, None] * b
    return result


def _derivative(a: FloatArray) -> FloatArray:
    """Coefficients of the derivatives of polynomials, lowest power first, shape (n, k - 1)."""
    return a[:, 1:] * np.arange(1, a.shape[1])


def _sign_changes(coefficients: FloatArray) -> FloatArray:
    """All points of [-1, 1] where each polynomial changes its sign.

    Between the roots of its derivative a polynomial is monotone, so bisection is safe. Intervals
    without a root return one of their ends.

    Args:
        coefficients: Lowest power first, shape (n, k).

    Returns:
        Points in ascending order [-], shape (n, k - 1), the sign changes among them.
    """
    n, k = coefficients.shape
    ends = np.ones((n, 1))
    inner = _sign_changes(_derivative(coefficients)) if k > 2 else np.empty((n, 0))
    nodes = np.hstack([-ends, inner, ends])

    def value(t: FloatArray) -> FloatArray:
        result = np.zeros_like(t)
        for power in range(k - 1, -1, -1):
            result = result * t + coefficients[:, power, None]
        return result

    low, high = nodes[:, :-1], nodes[:, 1:]
    negative = value(low) < 0.0
    while np.any(high - low > 4.0 * EPS):
        middle = 0.5 * (low + high)
        below = (value(middle) < 0.0) == negative
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return 0.5 * (low + high)


def _closest_warped(start: FloatArray, spans: FloatArray) -> FloatArray:
    """Closest point to the origin on any quadrilaterals, convex problem or not.

    For fixed t the surface is a straight line. Its squared distance P - Q^2 / B, with P, Q, B
    quadratic in t, is stationary where P' B^2 - 2 Q Q' B + Q^2 B' = 0, a quintic: the closest
    point is on the boundary or at one of its roots.

    Args:
        start: First corner relative to the point [m], shape (n, 3).
        spans: Corners relative to the first corner [m], shape (n, 4, 3).

    Returns:
        Coordinates [-], shape (n, 2).
    """
    # The quintic holds sixth powers of lengths, which would underflow in small units.
    unit = np.maximum(np.abs(start).max(axis=1), np.abs(spans).max(axis=(1, 2)))
    unit[unit == 0.0] = 1.0
    g = _gram(start / unit[:, None], spans / unit[:, None, None])
    p = np.column_stack([g[0, 0], 2.0 * g[0, 2], g[2, 2]])
    q = np.column_stack([g[0, 1], g[0, 3] + g[1, 2], g[2, 3]])
    b = np.column_stack([g[1, 1], 2.0 * g[1, 3], g[3, 3]])
    quintic = _product(_product(_derivative(p), b), b)
    quintic -= 2.0 * _product(_product(q, _derivative(q)), b)
    quintic += _product(_product(q, q), _derivative(b))
    t = _sign_changes(quintic)
    powers = t[:, :, None] ** np.arange(3)
    numerator = -np.einsum("nrk,nk->nr", powers, q)
    square = np.einsum("nrk,nk->nr", powers, b)
    s = np.divide(numerator, square, out=np.zeros_like(t), where=square > 0.0).clip(-1.0, 1.0)
    edge = _closest_edge(start, spans)
    trial = np.concatenate([edge[:, None], np.stack([s, t], axis=2)], axis=1)
    n, k, _ = trial.shape
    pair = np.repeat(np.arange(n), k)
    distance = _distance(start[pair], spans[pair], trial.reshape(-1, 2)).reshape(n, k)
    best = trial[np.arange(n), distance.argmin(axis=1)]
    return _polish(start, spans, best)


def _polish(start: FloatArray, spans: FloatArray, xi: FloatArray) -> FloatArray:
    """Bring interior closest points from the quintic's accuracy to round-off [-], shape (n, 2)."""
    polished, converged = _refine(start, spans, xi)
    inside = (np.abs(xi).max(axis=1) < 1.0) & (np.abs(polished).max(axis=1) <= 1.0)
    return np.where((converged & inside)[:, None], polished, xi)
