"""`compiled_law.laws` in NumPy: the laws of contact and friction of a pair."""

import numpy as np

from dolfinx_nts.contact.contact_law import HARDLY, NO_PULL, OPENING, STRONG, UNEVEN, Rub
from dolfinx_nts.kernels.compiled_law import Obeyed
from twins.friction import length, return_map


def laws(law, x, measured, multiplier, together):
    """Write the laws into the pairs' rows, as `ContactLaw.obey` does; theory 6, 9 and 16."""
    residual, tangent, gap, slip, normal, let_go = measured
    scale, of_end = law.scale, 1.0 + law.massless
    end = at_end(law, multiplier)
    force, row = end[:, 0], law.row
    opens = np.where(gap > 0.0, OPENING, 1.0)
    none = law.no_force
    if slip is not None and law.endless:
        none = none - pull(law, slip, end)
    active = -force - law.yielding * opens * gap > none
    if let_go is not None:
        active &= ~let_go
    off = ~active
    residual[off, row] = force[off] / scale[off]
    tangent[off, row] = 0.0
    tangent[off, row, row] = of_end[off] / scale[off]
    tangent[active, row, row] -= together.normal / scale[active]
    stick, distance = np.zeros_like(active), np.zeros(len(x))
    on_slave, tangential = -residual[:, :3], np.zeros((len(x), 3))
    if slip is not None:
        stick = rub(law, x, residual, tangent, slip, end, active, together)
        square = np.einsum("na,nab,nb->n", slip.value, slip.metric, slip.value)
        distance[active] = np.sqrt(square[active])
        along = np.einsum("ni,ni->n", on_slave, normal)
        tangential = on_slave - along[:, None] * normal
    residual[:, row:] *= scale[:, None]
    tangent[:, row:] *= scale[:, None, None]
    tangent[:, :, row:] *= scale[:, None, None]
    if slip is not None and law.rubs is Rub.HARDLY and not law.endless:
        rub_hardly(law, residual, tangent, slip, end, active)
        stick[:] = False
    return Obeyed(residual, tangent, end, active, stick, distance, on_slave, tangential)


def at_end(law, multiplier):
    """Multipliers at t_{n+1} from those of the step, of which they are half at massless nodes."""
    if law.before is None:
        return multiplier
    some, end = law.massless, multiplier.copy()
    end[some] *= 2.0
    end[some, 0] -= law.before[some, 0]
    if law.num_tangential:
        end[some, -2:] -= law.before[some, 1:]
    return end


def pull(law, slip, multiplier):
    """Pull [kg m] up to which a node that sticks is not let go, shape (n,)."""
    t, s = multiplier[:, -2:], law.tangential_scale[:, None] * slip.value
    friction = length(slip.metric, t)
    resists = friction**2 + np.einsum("na,na->n", t, s) > 0.0
    resists &= ~law.prescribed.unmoved.any(axis=(1, 2))
    return np.where(resists, NO_PULL * friction, 0.0)


def return_scale(law, slip, bound, held):
    """Scale c of the return map; nodes that are made to slip cannot stick, shape (n,)."""
    c = law.tangential_scale
    if law.endless or not law.prescribed.any:
        return c
    c = c.copy()
    moved = law.prescribed.unmoved.any(axis=(1, 2)) & ~held.any(axis=(1, 2))
    s = slip.value[moved]
    distance = np.sqrt(np.einsum("na,nab,nb->n", s, slip.metric[moved], s))
    c[moved] = np.maximum(c[moved], 2.0 * bound[moved] / distance)
    return c


def lent_to_stick(scale, together, force, stick):
    """Compliance lent to pairs that stick, so that friction divides as normal forces do."""
    part = np.full(np.count_nonzero(stick), UNEVEN)
    np.divide(together.force, -force[stick], out=part, where=force[stick] < 0.0)
    part = np.clip(part, 1.0 / UNEVEN, UNEVEN)
    return together.tangential * part / scale[stick]


def rub_hardly(law, residual, tangent, slip, end, of):
    """Write the rows of lambda_T [kg m] of pairs that touch as if they hardly rubbed."""
    of_end = 1.0 + law.massless
    stiffness = HARDLY * law.yielding[of, None]
    metric = slip.metric[of]
    residual[of, -2:] = end[of, -2:]
    residual[of, -2:] -= stiffness * np.einsum("nab,nb->na", metric, slip.value[of])
    rows = -stiffness[:, :, None] * np.matmul(metric, slip.gradient[of])
    rows[:, :, -2:] += (of_end * law.scale)[of, None, None] * np.eye(2)
    tangent[of, -2:] = rows


def rub(law, x, residual, tangent, slip, multiplier, active, together):
    """Write the rows of lambda_T [m], the last two, behind that of the gap; which pairs stick."""
    yielding, prescribed = law.yielding, law.prescribed
    mu, t = law.coefficient, multiplier[:, -2:]
    force, scale = multiplier[:, 0], law.scale[:, None, None]
    normal = residual.shape[1] - multiplier.shape[1]
    new = active & (force >= 0.0) & (mu > STRONG or law.redundant)
    bound = mu * np.where(active, -force if mu > STRONG else np.maximum(-force, 0.0), 0.0)
    bound[new] -= mu * yielding[new] * residual[new, normal]
    bound[active & law.endless] = np.inf
    held = prescribed.held(x, law.still)
    loose = np.eye(2) - held
    trial = np.einsum("nab,nb->na", loose, t)
    of_end = (1.0 + law.massless)[:, None, None]
    found = return_map(trial, slip.value, slip.metric, bound, return_scale(law, slip, bound, held))
    stick = found.stick & active
    rows = np.einsum("nab,nbz->naz", found.d_slip, slip.gradient)
    rows += np.einsum("nabc,nbcz->naz", found.d_metric, slip.metric_gradient)
    rows[:, :, -2:] += of_end * np.matmul(found.d_multiplier, loose)
    rows[:, :, normal] -= mu * of_end[:, 0] * found.d_bound
    by_gap = found.d_bound[new, :, None] * tangent[new, normal][:, None]
    rows[new] -= mu * yielding[new, None, None] * by_gap
    value, slipping = found.residual, ~stick
    said = np.eye(2) - np.where(stick[:, None, None], prescribed.unmoved, 0.0).transpose(0, 2, 1)
    value, rows = np.einsum("nab,nb->na", said, value), np.matmul(said, rows)
    value[slipping] /= scale[slipping, 0]
    rows[slipping] /= scale[slipping]
    unsaid = np.where(stick[:, None, None], prescribed.unmoved, held) / scale
    value += np.einsum("nab,nb->na", unsaid, t)
    rows[:, :, -2:] += of_end * unsaid
    if together.tangential:
        lent = lent_to_stick(law.scale, together, force, stick)
        rows[stick, :, -2:] -= np.eye(2) * lent[:, None, None]
    value[~active], rows[~active] = t[~active] / scale[~active, 0], 0.0
    rows[~active, :, -2:] = of_end[~active] * np.eye(2) / scale[~active]
    residual[:, -2:], tangent[:, -2:] = value, rows
    return stick
