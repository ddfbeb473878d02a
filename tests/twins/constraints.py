"""Residual and tangent of constraints in NumPy, as of `constraints.c`."""

import numpy as np

from dolfinx_nts.kernels import quadratic as kernel


def evaluate(batch, x, own):
    """Residual, tangent and gap of `ConstraintElements`."""
    weights, constants, _ = batch.equations
    n, m, _, k = weights.shape
    last, scale = 3 * k, batch.scale[:, None]
    multiplier = scale * own["constraints"]
    start, end = (kernel.factors(weights, constants, y) for y in (batch.y0, x))
    force = kernel.gradient(weights, start + batch.theta * (end - start)).reshape(n, m, last)
    gap = kernel.value(end) - batch.prescribed[1]
    residual = np.empty((n, last + m))
    residual[:, :last] = np.matmul(multiplier[:, None], force)[:, 0]
    residual[:, last:] = scale * gap
    tangent = np.zeros((n, last + m, last + m))
    bend = np.einsum("nm,nmab->nab", batch.theta * multiplier, batch.curvature)
    for i in range(3):
        tangent[:, i:last:3, i:last:3] = bend
    tangent[:, :last, last:] = (scale[:, :, None] * force).transpose(0, 2, 1)
    gradient = kernel.gradient(weights, end).reshape(n, m, last)
    tangent[:, last:, :last] = scale[:, :, None] * gradient
    rows, lent = np.arange(last, last + m), batch.lent[:, None]
    bent = np.abs(batch.curvature).max(axis=(2, 3))
    tangent[:, rows, rows] = -scale * np.where(lent > 0.0, lent + np.abs(gap) * bent, 0.0)
    return residual, tangent, gap
