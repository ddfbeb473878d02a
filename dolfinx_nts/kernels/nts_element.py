"""Batched node-to-surface element: gap, invariants, constraints, gradients and exact tangents.

Axis 0 of every array is the pair (one slave node, one master facet with nc corners, or the smooth
patch over it with nc = 15 or 16 control points, which take the place of the corners). Two
descriptions of the same element: the direct one (projection and normal eliminated, for the midpoint
rule, theory section 4) and the one in invariants (normal d and convective coordinates f as
unknowns, for the energy-momentum scheme, sections 3 and 5). Nothing here knows about MPI, PETSc or
bodies.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts.kernels import discrete_gradient, facets, patches, triangle_patches
from dolfinx_nts.kernels.vectors import solve_2x2
from dolfinx_nts.types import FloatArray

#: Constraints per pair: the gap and five augmented ones (43).
NUM_CONSTRAINTS = 6
#: Augmented unknowns per pair: d in R^3 and f in R^2.
NUM_AUGMENTED = 5
#: Gauss points that make the mean value exact: the constraints have degree <= 4 in pi over a facet,
#: 12 over a patch on a quadrilateral, 8 on a triangle.
GAUSS_POINTS = {3: 2, 4: 2, patches.NUM_POINTS: 6, triangle_patches.NUM_POINTS: 4}


class Gap(NamedTuple):
    """Direct description of the gap (16), (35).

    Attributes:
        value: g_N [m], shape (n,).
        gradient: dg/dx [-], shape (n, nc + 1, 3); node 0 is the slave.
        hessian: d2g/dx2 [1/m], shape (n, 3 (nc + 1), 3 (nc + 1)).
    """

    value: FloatArray
    gradient: FloatArray
    hessian: FloatArray


class Element(NamedTuple):
    """Contribution of the pairs to the step equations (63)-(66).

    Attributes:
        force: gradient of the constraints times the multipliers, shape (n, z).
        constraint: g at t_{n+1}, shape (n, 6).
        stiffness: d force / d z_1, shape (n, z, z).
        force_gradient: d force / d lambda transposed, shape (n, 6, z).
        constraint_gradient: d constraint / d z_1, shape (n, 6, z).
        invariants: Mean of pi_0 and pi_1, shape (n, p).
        invariant_gradient: d invariants / d z_1, shape (n, p, z).
    """

    force: FloatArray
    constraint: FloatArray
    stiffness: FloatArray
    force_gradient: FloatArray
    constraint_gradient: FloatArray
    invariants: FloatArray
    invariant_gradient: FloatArray


def gap(x: FloatArray, xi: FloatArray) -> Gap:
    """Normal gap with its exact first and second derivative at the orthogonal projection.

    Args:
        x: Slave node and facet corners [m], shape (n, nc + 1, 3).
        xi: Orthogonal projection of the slave onto the facet, shape (n, 2); must be converged.

    Returns:
        The gap, positive outside the master (35), with the projection and the normal linearised.
    """
    nc = x.shape[1] - 1
    shape, dshape, ddshape = facets.shape(xi, nc)
    zero = np.zeros((len(x), 1))
    weight = np.concatenate([zero + 1.0, -shape], axis=1)
    dshape = np.concatenate([zero[:, :, None] + np.zeros(2), dshape], axis=1)
    _, tangents, normal = facets.frame(x[:, 1:], xi)
    value = np.einsum("nk,nki,ni->n", weight, x, normal)
    curvature = np.einsum("nkab,nki,ni->nab", ddshape, x[:, 1:], normal)
    metric = np.einsum("nai,nbi->nab", tangents, tangents)

    rhs = np.einsum("nk,nai->naki", weight, tangents)
    slope = np.einsum("ni,nka->naki", normal, dshape)
    rhs += value[:, None, None, None] * slope
    dxi = _solve2(metric - value[:, None, None] * curvature, rhs)
    tilt = slope + np.einsum("nab,nbki->naki", curvature, dxi)
    dnormal = -np.einsum("naj,naki->njki", tangents, _solve2(metric, tilt))
    hessian = np.einsum("nk,nilj->nkilj", weight, dnormal)
    hessian -= np.einsum("ni,nka,nalj->nkilj", normal, dshape, dxi)
    size = 3 * (nc + 1)
    return Gap(value, np.einsum("nk,ni->nki", weight, normal), hessian.reshape(len(x), size, size))


class Projection(NamedTuple):
    """Convective coordinates of the slave as functions of the positions.

    Attributes:
        gradient: dxi^a/dx [1/m], shape (n, 2, 3 (nc + 1)).
        metric: m_ab = a_a . a_b [m^2], shape (n, 2, 2).
        metric_gradient: dm_ab/dx [m], shape (n, 2, 2, 3 (nc + 1)).
        hessian: multiplier_a d2xi^a/dx2, shape (n, 3 (nc + 1), 3 (nc + 1)).
    """

    gradient: FloatArray
    metric: FloatArray
    metric_gradient: FloatArray
    hessian: FloatArray


def projection(x: FloatArray, xi: FloatArray, multiplier: FloatArray) -> Projection:
    """Exact derivatives of the orthogonal projection r_a = (x_s - xbar) . a_a = 0.

    Args:
        x: Slave node and facet corners [m], shape (n, nc + 1, 3).
        xi: Orthogonal projection of the slave onto the facet, shape (n, 2); must be converged.
        multiplier: Weights lambda_a of the second derivative, shape (n, 2).
    """
    n, nc = len(x), x.shape[1] - 1
    size = 3 * (nc + 1)
    shape, dshape, ddshape = (
        np.concatenate([np.zeros_like(s[:, :1]), s], axis=1) for s in facets.shape(xi, nc)
    )
    weight = -shape
    weight[:, 0] = 1.0
    offset = np.einsum("nk,nki->ni", weight, x)
    tangents = np.einsum("nka,nki->nai", dshape, x)
    bend = np.einsum("nkab,nki->nabi", ddshape, x)
    metric = np.einsum("nai,nbi->nab", tangents, tangents)
    slope = metric - np.einsum("nabi,ni->nab", bend, offset)

    rows = np.einsum("nk,nai->naki", weight, tangents)
    rows += np.einsum("nka,ni->naki", dshape, offset)
    gradient = _solve2(slope, rows).reshape(n, 2, size)

    # mu . r has the derivatives of lambda . xi once mu solves the adjoint equation.
    mu = _solve2(slope, multiplier[:, :, None])[:, :, 0]
    along = np.einsum("na,nka->nk", mu, dshape)
    xx = weight[:, :, None] * along[:, None] + along[:, :, None] * weight[:, None]
    hessian = np.einsum("nkl,ij->nkilj", xx, np.eye(3)).reshape(n, size, size)
    mixed = np.einsum("nk,nci->nkic", weight, np.einsum("na,naci->nci", mu, bend))
    mixed -= np.einsum("nkc,ni->nkic", dshape, np.einsum("na,nai->ni", mu, tangents))
    mixed += np.einsum("nkc,ni->nkic", np.einsum("na,nkac->nkc", mu, ddshape), offset)
    mixed -= np.einsum("nk,nci->nkic", along, tangents)
    mixed = mixed.reshape(n, size, 2)
    bent = np.einsum("na,naci,ndi->ncd", mu, bend, tangents)
    inner = -np.einsum("ncdi,nai,na->ncd", bend, tangents, mu) - bent - bent.transpose(0, 2, 1)
    if (third := facets.third(xi, nc)) is not None:
        along_offset = np.einsum("nki,ni->nk", x[:, 1:], offset)
        inner += np.einsum("na,nkacd,nk->ncd", mu, third, along_offset)
    cross = np.matmul(mixed, gradient)
    hessian += cross + cross.transpose(0, 2, 1)
    hessian += np.matmul(gradient.transpose(0, 2, 1), np.matmul(inner, gradient))

    half = np.einsum("nka,nbi->nabki", dshape, tangents).reshape(n, 2, 2, size)
    half += np.einsum("naci,nbi,ncz->nabz", bend, tangents, gradient)
    return Projection(gradient, metric, half + half.transpose(0, 2, 1, 3), hessian)


def _solve2(a: FloatArray, b: FloatArray) -> FloatArray:
    """Solve the 2x2 systems a (n, 2, 2) for b (n, 2, ...); not finite where singular."""
    a11, a12, a21, a22 = a.reshape(-1, 4, *[1] * (b.ndim - 2)).swapaxes(0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return solve_2x2((a11, a12, a21, a22), (b[:, 0], b[:, 1])).swapaxes(0, 1)


def solve(a: FloatArray, b: FloatArray) -> FloatArray:
    """Solve the systems a (n, k, k) for b (n, k, m); NaN for all if one of them is singular.

    An exception would leave the other ranks waiting; a NaN ends the step on all of them.
    """
    try:
        x: FloatArray = np.linalg.solve(a, b)
    except np.linalg.LinAlgError:
        return np.full_like(b, np.nan)
    return x


@lru_cache
def _invariant_maps(nc: int) -> tuple[FloatArray, FloatArray, npt.NDArray[np.intp]]:
    """Constant D^2 pi (p, z, z), the linear part of D pi (p, z), and the pairs I <= J (2, .)."""
    pairs = np.array(np.triu_indices(nc))
    num_z, num_yy = 3 * (nc + 2) + 2, pairs.shape[1]
    second = np.zeros((num_yy + nc + 3, num_z, num_z))
    y = np.zeros((nc, 3, num_z))
    d = np.zeros((3, num_z))
    for i in range(3):
        d[i, 3 * (nc + 1) + i] = 1.0
        y[:, i, i] = -1.0
        for corner in range(nc):
            y[corner, i, 3 * (corner + 1) + i] = 1.0
    products = [(y[i], y[j]) for i, j in pairs.T] + [(yi, d) for yi in y] + [(d, d)]
    for p, (a, b) in enumerate(products):
        second[p] = a.T @ b + b.T @ a
    linear = np.zeros((len(second), num_z))
    linear[-2, -2] = linear[-1, -1] = 1.0
    return second, linear, pairs


def invariant_gradient(z: FloatArray, nc: int) -> FloatArray:
    """D pi(z), shape (n, p, z); linear in z because pi is quadratic (45)."""
    second, linear, _ = _invariant_maps(nc)
    p, size, _ = second.shape
    return (z @ second.reshape(p * size, size).T).reshape(len(z), p, size) + linear


def invariants(z: FloatArray, nc: int, gradient: FloatArray | None = None) -> FloatArray:
    """The invariants pi(z) of theory section 3: 17 of a quadrilateral, 12 of a triangle.

    A patch has 155 over a quadrilateral and 138 over a triangle.

    Args:
        z: (x_s, x_1 .. x_nc, d, f), shape (n, 3 (nc + 2) + 2).
        nc: Corners of a facet or control points of a patch.
        gradient: D pi(z) where it is known already.

    Returns:
        [y_I . y_J (I <= J), y_I . d, d . d, f], shape (n, p).
    """
    gradient = invariant_gradient(z, nc) if gradient is None else gradient
    linear = _invariant_maps(nc)[1]
    return 0.5 * np.matmul(gradient + linear, z[:, :, None])[:, :, 0]


def constraints(pi: FloatArray, nc: int) -> FloatArray:
    """The six constraints (43) from the invariants: gap, two tangent, unit normal, two projection.

    Args:
        pi: Invariants, shape (n, p).
        nc: Corners of a facet.

    Returns:
        Shape (n, 6), units (m, m, m, -, m^2, m^2).
    """
    shape, dshape, _ = facets.shape(pi[:, -2:], nc)
    yy, yd, dd = _split(pi, nc)
    tangent = np.einsum("nia,ni->na", dshape, yd)
    projection = np.einsum("ni,nij,nja->na", shape, yy, dshape)
    normal = np.einsum("ni,ni->n", shape, yd)
    return np.column_stack([-normal, tangent, 0.5 * (dd - 1.0), -projection])


def _split(pi: FloatArray, nc: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """y_I . y_J as a full symmetric matrix, y_I . d and d . d."""
    pairs = _invariant_maps(nc)[2]
    yy = np.empty((len(pi), nc, nc))
    yy[:, pairs[0], pairs[1]] = yy[:, pairs[1], pairs[0]] = pi[:, : pairs.shape[1]]
    return yy, pi[:, pairs.shape[1] : -3], pi[:, -3]


def constraint_gradient(pi: FloatArray, nc: int) -> FloatArray:
    """dg/dpi of the six constraints, shape (n, 6, p)."""
    shape, dshape, ddshape = facets.shape(pi[:, -2:], nc)
    yy, yd, _ = _split(pi, nc)
    pairs = _invariant_maps(nc)[2]
    i, j, num = pairs[0], pairs[1], pairs.shape[1]
    out = np.zeros((len(pi), NUM_CONSTRAINTS, pi.shape[1]))
    out[:, 0, num:-3] = -shape
    out[:, 1:3, num:-3] = dshape.transpose(0, 2, 1)
    out[:, 3, -3] = 0.5
    symmetric = shape[:, i, None] * dshape[:, j] + shape[:, j, None] * dshape[:, i]
    out[:, 4:, :num] = -(symmetric * np.where(i == j, 0.5, 1.0)[:, None]).transpose(0, 2, 1)
    yn, ydn = np.matmul(yy, shape[:, :, None])[:, :, 0], np.matmul(yy, dshape)
    out[:, 0, -2:] = -np.einsum("nia,ni->na", dshape, yd)
    out[:, 1:3, -2:] = np.einsum("niab,ni->nab", ddshape, yd)
    out[:, 4:, -2:] = -np.einsum("nib,nia->nab", dshape, ydn)
    out[:, 4:, -2:] -= np.einsum("ni,niab->nab", yn, ddshape)
    return out


def constraint_curvature(pi: FloatArray, multiplier: FloatArray, nc: int) -> FloatArray:
    """Columns of d2(lambda . g)/dpi2 that belong to f, shape (n, p, 2); all others vanish.

    The constraints are linear in the invariants of x and d once f is held, so the second derivative
    is these columns, their transpose, and nothing else.
    """
    shape, dshape, ddshape = facets.shape(pi[:, -2:], nc)
    yy, yd, _ = _split(pi, nc)
    pairs = _invariant_maps(nc)[2]
    i, j, num = pairs[0], pairs[1], pairs.shape[1]
    normal, tangent, projection = multiplier[:, 0], multiplier[:, 1:3], multiplier[:, 4:]
    bent = np.einsum("niab,na->nib", ddshape, projection)
    slope = np.einsum("nia,na->ni", dshape, projection)
    out = np.zeros((len(pi), pi.shape[1], 2))
    out[:, num:-3] = -normal[:, None, None] * dshape + np.einsum("niab,na->nib", ddshape, tangent)
    full = dshape[:, i] * slope[:, j, None] + shape[:, i, None] * bent[:, j]
    full += dshape[:, j] * slope[:, i, None] + shape[:, j, None] * bent[:, i]
    out[:, :num] = -full * np.where(i == j, 0.5, 1.0)[:, None]
    ff = -np.einsum("n,nibc,ni->nbc", normal, ddshape, yd)
    ff -= np.einsum("nibc,ni->nbc", ddshape, np.matmul(yy, slope[:, :, None])[:, :, 0])
    mixed = np.matmul(dshape.transpose(0, 2, 1), np.matmul(yy, bent))
    if (third := facets.third(pi[:, -2:], nc)) is not None:
        yn = np.matmul(yy, shape[:, :, None])
        factor = yd[:, :, None] * tangent[:, None] - yn * projection[:, None]
        ff += np.einsum("niabc,nia->nbc", third, factor)
    out[:, -2:] = ff - mixed - mixed.transpose(0, 2, 1)
    return out


def metric(pi: FloatArray, nc: int) -> tuple[FloatArray, FloatArray]:
    """Metric of the tangents m_ab = sum N_I,a N_J,b y_I . y_J from the invariants (theory 6).

    Args:
        pi: Invariants, shape (n, p).
        nc: Corners of a facet.

    Returns:
        m_ab [m^2], shape (n, 2, 2), and dm_ab/dpi, shape (n, 2, 2, p).
    """
    _, dshape, ddshape = facets.shape(pi[:, -2:], nc)
    yy, _, _ = _split(pi, nc)
    i, j = _invariant_maps(nc)[2]
    value = np.einsum("nia,nij,njb->nab", dshape, yy, dshape)
    gradient = np.zeros((len(pi), 2, 2, pi.shape[1]))
    products = np.einsum("nka,nkb->nabk", dshape[:, i], dshape[:, j])
    products += products.transpose(0, 2, 1, 3)
    gradient[..., : len(i)] = products * np.where(i == j, 0.5, 1.0)
    bent = np.einsum("niac,nij,njb->nabc", ddshape, yy, dshape)
    gradient[..., -2:] = bent + bent.transpose(0, 2, 1, 3)
    return value, gradient


def element(
    z0: FloatArray,
    z1: FloatArray,
    multiplier: FloatArray | Callable[[FloatArray], FloatArray],
    contact_gradient: str,
) -> Element:
    """Energy-momentum element in invariants with its exact tangent (63)-(66).

    Args:
        z0: (x_s, x_I, d, f) at t_n, shape (n, 3 (nc + 2) + 2).
        z1: The same at t_{n+1}.
        multiplier: lambda, shape (n, 6), or what makes it of the `force_gradient`.
        contact_gradient: Discrete gradient in pi, "mean-value" or "gonzalez".

    Returns:
        Forces, constraints and tangents in z.
    """
    nc = (z0.shape[1] - 2) // 3 - 2
    points, second = GAUSS_POINTS[nc], _invariant_maps(nc)[0]
    d0, d1 = invariant_gradient(z0, nc), invariant_gradient(z1, nc)
    pi0, pi1 = invariants(z0, nc, d0), invariants(z1, nc, d1)
    dm = 0.5 * (d0 + d1)

    def slope(pi: FloatArray) -> FloatArray:
        return constraint_gradient(pi, nc)

    def bend(pi: FloatArray) -> FloatArray:
        """Return the curvature with as many copies of the multipliers as there are points."""
        return constraint_curvature(pi, np.resize(force, (len(pi), NUM_CONSTRAINTS)), nc)

    mean = contact_gradient == "mean-value"
    discrete = discrete_gradient.mean_value if mean else discrete_gradient.gonzalez
    gradient = discrete(pi0, pi1, slope, points)
    force_gradient = np.matmul(gradient, dm)
    force = multiplier(force_gradient) if callable(multiplier) else multiplier
    if mean:
        curvature = discrete_gradient.mean_value_tangent(pi0, pi1, bend, points)
        stiffness = _curvature_stiffness(dm, curvature, d1)
    else:
        rest = discrete_gradient.gonzalez_tangent(
            pi0, pi1, force, slope, lambda pi: _full_curvature(bend(pi)), points
        )
        stiffness = np.matmul(dm.transpose(0, 2, 1), np.matmul(rest, d1))
    work = np.matmul(force[:, None], gradient)[:, 0]
    stiffness += 0.5 * (work @ second.reshape(len(second), -1)).reshape(stiffness.shape)
    return Element(
        np.matmul(work[:, None], dm)[:, 0],
        constraints(pi1, nc),
        stiffness,
        force_gradient,
        np.matmul(slope(pi1), d1),
        0.5 * (pi0 + pi1),
        0.5 * d1,
    )


def _curvature_stiffness(dm: FloatArray, curvature: FloatArray, d1: FloatArray) -> FloatArray:
    """D pi(z_m)^T H D pi(z_1) for an H given by its f columns; D pi is the identity on f."""
    out = np.zeros((len(dm), dm.shape[2], dm.shape[2]))
    out[:, :, -2:] = np.matmul(dm.transpose(0, 2, 1), curvature)
    out[:, -2:] += np.matmul(curvature.transpose(0, 2, 1), d1)
    out[:, -2:, -2:] -= curvature[:, -2:]
    return out


def _full_curvature(columns: FloatArray) -> FloatArray:
    """The symmetric matrix whose f columns are given."""
    n, p, _ = columns.shape
    out = np.zeros((n, p, p))
    out[:, -2:] = columns.transpose(0, 2, 1)
    out[:, :, -2:] = columns
    return out
