"""`compiled_law.to_nodes` and `compiled_law.wrenches` in NumPy."""

import numpy as np


def to_nodes(weights, residual, tangent):
    """Residual and tangent by points as those by the nodes that these are made of."""
    n, points, _ = weights.shape
    rest = residual.shape[1] - 3 * points
    by_places = np.einsum("npk,ij->npikj", weights, np.eye(3)).reshape(n, 3 * points, -1)
    width = by_places.shape[2]
    whole = np.zeros((n, 3 * points + rest, width + rest))
    whole[:, : 3 * points, :width], whole[:, 3 * points :, width:] = by_places, np.eye(rest)
    turned = whole.transpose(0, 2, 1)
    return np.matmul(turned, residual[:, :, None])[:, :, 0], turned @ tangent @ whole


def wrenches(y, push, places, fixed):
    """Force and moment about the middle of their places of forces on nodes."""
    number = places.astype(float)
    push = np.where(fixed, 0.0, push)
    middle = np.einsum("nk,nki->ni", number, y) / number.sum(axis=1)[:, None]
    moment = np.cross(y - middle[:, None] * number[:, :, None], push).sum(axis=1)
    return np.column_stack([np.einsum("nk,nki->ni", number, push), moment])
