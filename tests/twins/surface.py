"""`compiled.over_surface` in NumPy: sums of `FacetGap` with friction as a vector in space."""

import numpy as np

from dolfinx_nts.kernels import facets


def middle(measure, x, xi):
    """Directions of friction (n, 2, 3), their derivatives by control points and by the slip."""
    theta, length = measure.theta, measure.length[:, None, None]
    control = (measure.start + theta * (x - measure.start))[:, 1:]
    _, first, second = facets.shape(measure.xi + theta * (xi - measure.xi), control.shape[1])
    bends = np.einsum("niab,nij->nabj", second, control)
    along = np.einsum("nia,nij->naj", first, control)
    return along / length, theta * first / length, theta * bends / length[..., None] ** 2


def over_surface(measure, x, element, slot, shape, share, multiplier, directions, number):
    """Residual and tangent of elements, forces of points, gap, slip and pulls of slaves."""
    (n, corners), (slaves, width), size = slot.shape, multiplier.shape, 3 * x.shape[1]
    there = np.where(slot < 0, slaves, slot)
    share = np.where(slot < 0, 0.0, share)
    of = np.concatenate([multiplier, np.zeros((1, width))])[there]
    frame = np.concatenate([directions, np.zeros((1, 2, 3))])[there]
    xi = measure.projection(x)
    along, by_control, by_slip = middle(measure, x, xi)
    own = np.zeros((n, width))
    own[:, 0] = (share * of[..., 0]).sum(axis=1)
    pull = np.einsum("nc,nck,ncki->ni", share, of[..., 1:], frame[:, :, : width - 1])
    if width > 1:
        own[:, 1:] = np.einsum("nai,ni->na", along, pull)
    found = measure.evaluate(x, np.empty((n, 0)), own)
    tangent = np.zeros((n, size + corners * width, size + corners * width))
    tangent[:, :size, :size] = found.tangent[:, :size, :size]
    columns, rows = np.zeros((2, n, corners, width, size))
    columns[:, :, 0] = found.tangent[:, None, :size, size]
    rows[:, :, 0] = found.tangent[:, None, size, :size]
    slips = np.zeros((n, 3))
    if width > 1:
        value, slope = found.slip.value, found.slip.gradient[..., :size]
        turns = np.einsum("nbz,nabi->nazi", slope, by_slip)
        for i in range(3):
            turns[:, :, 3 + i :: 3, i] += by_control.transpose(0, 2, 1)
        slips = np.einsum("nai,na->ni", along, value)
        by_friction = found.tangent[:, :size, size + 1 :]
        tangent[:, :size, :size] += np.einsum("nza,naxi,ni->nzx", by_friction, turns, pull)
        by_points = np.einsum("naz,nai->nzi", slope, along)
        by_points += np.einsum("na,nazi->nzi", value, turns)
        columns[:, :, 1:] = np.einsum("nza,nai,ncki->nckz", by_friction, along, frame)
        rows[:, :, 1:] = np.einsum("nzi,ncki->nckz", by_points, frame)
    columns, rows = share[:, :, None, None] * columns, share[:, :, None, None] * rows
    tangent[:, size:, :size] = rows.reshape(n, -1, size)
    tangent[:, :size, size:] = columns.reshape(n, -1, size).transpose(0, 2, 1)
    # From x_s to the corners of the slave's facet.
    nc = x.shape[1] - 1
    spread = np.zeros((n, size + corners * width, 3 * (corners + nc) + corners * width))
    for i in range(3):
        spread[:, i, i : 3 * corners : 3] = shape
    spread[:, 3:, 3 * corners :] = np.eye(size - 3 + corners * width)
    residual = np.zeros((n, size + corners * width))
    residual[:, :size] = found.residual[:, :size]
    rows = np.einsum("nij,ni->nj", spread, residual)
    both = spread.transpose(0, 2, 1) @ tangent @ spread
    out = np.zeros((number, rows.shape[1])), np.zeros((number, *both.shape[1:]))
    np.add.at(out[0], element, rows)
    np.add.at(out[1], element, both)

    def to_slaves(values):
        total = np.zeros((slaves + 1, *values.shape[2:]))
        np.add.at(total, there, values)
        return total[:-1]

    pulls = np.einsum("nckz,nck->ncz", columns[..., :3], of)
    sums = (to_slaves(share[..., None] * v[:, None]) for v in (found.gap[:, None], slips))
    gap, slip = sums
    return (*out, found.residual[:, :size].reshape(x.shape), gap[:, 0], slip, to_slaves(pulls))


def law_of_sums(slot, scale, slopes, elements, tangent):
    """Laws of slaves in elements whose rows of multipliers are the slaves' gap and slips."""
    corners, each = slot.shape[1], slopes.shape[1]
    size, out = tangent.shape[1] - corners * each, tangent.copy()
    for i, c in zip(*np.nonzero(slot >= 0), strict=True):
        k, here = slot[i, c], slice(size + c * each, size + (c + 1) * each)
        out[i, here, :size] = slopes[k, :, :each] @ tangent[i, here, :size]
        out[i, :size, here] *= scale[k]
        out[i, here, here] = slopes[k, :, 3:] / elements[k]
    return out
