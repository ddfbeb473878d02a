"""`compiled_law.obstacle` in NumPy: the element without a facet."""

import numpy as np

from dolfinx_nts.contact.coulomb import Slip
from dolfinx_nts.contact.obstacles import inverse


def element(elements, x, multiplier):
    """Residual and tangent of (x, lambda_N, lambda_T), gap and slip, as `_element` has them."""
    master, end, middle = elements.obstacle, elements.obstacle.gap(x[:, 0]), elements._middle(x)
    gradient, slope = middle.gradient[:, 0], elements.theta * middle.hessian
    if not elements.direct:
        gradient, slope = master.discrete_gradient(elements.x0[:, 0], x[:, 0])
    normal = multiplier[:, :1]
    residual = np.zeros((len(x), 3 + elements.num_constraints))
    tangent = np.zeros((*residual.shape, residual.shape[1]))
    residual[:, :3], residual[:, 3] = normal * gradient, end.value
    tangent[:, :3, :3] = normal[:, :, None] * slope
    tangent[:, :3, 3], tangent[:, 3, :3] = gradient, end.gradient[:, 0]
    slip = None
    if elements.num_tangential:
        slip = add_friction(elements, residual, tangent, middle, x, multiplier)
    return residual, tangent, end.value, slip


def add_friction(elements, residual, tangent, middle, x, multiplier):
    """Add lambda_T t^a to the rows of x; returns the slip Df^a = t^a . (x_1 - x_0).

    t_a are the directions e_a of `_tangents` less their part along the normal n where the force
    acts. Dual to them are t^a = e_a - n_0 (n . e_a) / (n . n_0), which lie along the surface,
    too, and t^a . t_b = t^a . e_b = 1 or 0, because n_0 . e_b = 0.
    """
    motion, e, theta = (x - elements.x0)[:, 0], elements._tangents, elements.theta
    normal, n0, t = middle.gradient[:, 0], elements.candidates.normal, multiplier[:, -2:]
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
