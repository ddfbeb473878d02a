"""`compiled.closest_point` in NumPy."""

import numpy as np

from dolfinx_nts.kernels.compiled import COLLINEAR
from dolfinx_nts.kernels.facets import (
    CORNERS,
    EPS,
    LAST_STEP,
    _bilinear,
    _local,
    _modes,
    _reference,
    _refine,
    _symmetric,
    shape,
)

_MAX_BISECTIONS = 120


def closest_point(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def _distance(start: np.ndarray, spans: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """Distance of the facets' points at `xi` [m], shape (n,)."""
    offset = start + np.einsum("ni,nij->nj", shape(xi, spans.shape[1])[0], spans)
    return np.linalg.norm(offset, axis=1)


def _closest_edge(start: np.ndarray, spans: np.ndarray) -> np.ndarray:
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
def _closest_triangle(start: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Closest point on triangles [-], shape (n, 2)."""
    gradient, metric, _, _ = _bilinear(_modes(start, spans), np.zeros((2, len(start))))
    xi = -_symmetric(metric, gradient).T
    square = metric[0] * metric[2]
    flat = square - metric[1] ** 2 <= COLLINEAR * square
    xi[flat] = -1.0
    outside = ~((xi >= 0.0).all(axis=1) & (xi.sum(axis=1) <= 1.0))
    xi[outside] = _closest_edge(start[outside], spans[outside])
    return xi


def _gram(start: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Products c_k . c_l of `_modes` [m^2], shape (4, 4, n)."""
    c = _modes(start, spans)
    return np.einsum("kjn,ljn->kln", c, c)


def _least(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Minimum of a + 2 b t + c t^2 over [-1, 1] with c >= 0, shape (n,)."""
    inner = np.divide(-b, c, out=-np.sign(b), where=np.abs(b) < c)
    return a + inner * (2.0 * b + c * inner)


def _is_convex(g: np.ndarray) -> np.ndarray:
    """Return whether |xbar - x|^2 is certainly convex over the reference square, shape (n,).

    Its second derivatives in s, in t, and the mixed one depend on t only, on s only, and are
    bilinear: their extremes are known exactly.
    """
    in_s = _least(g[1, 1], g[1, 3], g[3, 3])
    in_t = _least(g[2, 2], g[2, 3], g[3, 3])
    mixed = [
        np.abs(g[0, 3] + g[1, 2] + 2.0 * (g[1, 3] * s + g[2, 3] * t + g[3, 3] * s * t))
        for s, t in CORNERS[4]
    ]
    return (in_s > 0.0) & (np.max(mixed, axis=0) ** 2 < in_s * in_t)


def _slope(g: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
def _closest_convex(g: np.ndarray) -> np.ndarray:
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


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Coefficients of products of polynomials, lowest power first, shape (n, ka + kb - 1)."""
    result = np.zeros((len(a), a.shape[1] + b.shape[1] - 1))
    for power in range(a.shape[1]):
        result[:, power : power + b.shape[1]] += a[:, power, None] * b
    return result


def _derivative(a: np.ndarray) -> np.ndarray:
    """Coefficients of the derivatives of polynomials, lowest power first, shape (n, k - 1)."""
    return a[:, 1:] * np.arange(1, a.shape[1])


def _sign_changes(coefficients: np.ndarray) -> np.ndarray:
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

    def value(t: np.ndarray) -> np.ndarray:
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


def _closest_warped(start: np.ndarray, spans: np.ndarray) -> np.ndarray:
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


def _polish(start: np.ndarray, spans: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """Bring interior closest points from the quintic's accuracy to round-off [-], shape (n, 2)."""
    polished, converged = _refine(start, spans, xi)
    inside = (np.abs(xi).max(axis=1) < 1.0) & (np.abs(polished).max(axis=1) <= 1.0)
    return np.where((converged & inside)[:, None], polished, xi)
