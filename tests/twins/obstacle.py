"""`compiled_law.obstacle` in NumPy: the element without a facet."""

import numpy as np

from dolfinx_nts.contact.contact_measure import Measured, Slip
from dolfinx_nts.contact.obstacles import inverse


def element(measure, x, multiplier):
    """Residual and tangent of (x, lambda_N, lambda_T), gap and slip, as `ObstacleGap.evaluate`."""
    master, x0 = measure.obstacle, measure.start
    end, middle = master.gap(x[:, 0]), master.gap((x0 + measure.theta * (x - x0))[:, 0])
    gradient, slope = middle.gradient[:, 0], measure.theta * middle.hessian
    if measure.rule != "direct":
        gradient, slope = master.discrete_gradient(x0[:, 0], x[:, 0])
    normal = multiplier[:, :1]
    residual = np.zeros((len(x), 3 + multiplier.shape[1]))
    tangent = np.zeros((*residual.shape, residual.shape[1]))
    residual[:, :3], residual[:, 3] = normal * gradient, end.value
    tangent[:, :3, :3] = normal[:, :, None] * slope
    tangent[:, :3, 3], tangent[:, 3, :3] = gradient, end.gradient[:, 0]
    if multiplier.shape[1] == 1:
        return Measured(residual, tangent, end.value)
    slip = add_friction(measure, residual, tangent, middle, x, multiplier)
    return Measured(residual, tangent, end.value, slip, middle.gradient[:, 0])


def add_friction(measure, residual, tangent, middle, x, multiplier):
    """Add lambda_T t^a to the rows of x; returns the slip Df^a = t^a . (x_1 - x_0).

    t_a are the directions e_a of `tangents` less their part along the normal n where the force
    acts. Dual to them are t^a = e_a - n_0 (n . e_a) / (n . n_0), which lie along the surface,
    too, and t^a . t_b = t^a . e_b = 1 or 0, because n_0 . e_b = 0.
    """
    motion, e, theta = (x - measure.start)[:, 0], measure.tangents, measure.theta
    normal, n0, t = middle.gradient[:, 0], measure.normal, multiplier[:, -2:]
    part, turn = np.einsum("nai,ni->na", e, normal), theta * np.matmul(e, middle.hessian)
    per_height = inverse(np.einsum("ni,ni->n", normal, n0))[:, None]
    tilt = part * per_height
    n0_turn = theta * np.einsum("ni,nij->nj", n0, middle.hessian)
    tilt_gradient = (turn - tilt[:, :, None] * n0_turn[:, None]) * per_height[:, :, None]
    dual = e - tilt[:, :, None] * n0[:, None]

    residual[:, :3] += np.einsum("na,nai->ni", t, dual)
    tangent[:, :3, :3] -= n0[:, :, None] * np.einsum("na,naj->nj", t, tilt_gradient)[:, None]
    tangent[:, :3, -2:] = dual.transpose(0, 2, 1)
    gradient = np.zeros((len(x), 2, residual.shape[1]))
    rise = np.einsum("ni,ni->n", n0, motion)[:, None, None]
    gradient[..., :3] = dual - rise * tilt_gradient
    metric_gradient = np.zeros((len(x), 2, 2, residual.shape[1]))
    half = -part[:, :, None, None] * turn[:, None]
    metric_gradient[..., :3] = half + half.transpose(0, 2, 1, 3)
    metric = np.eye(2) - part[:, :, None] * part[:, None]
    return Slip(np.einsum("nai,ni->na", dual, motion), gradient, metric, metric_gradient)
