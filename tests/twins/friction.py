"""Coulomb friction as one semi-smooth equation per pair: stick and slip by return mapping.

Works on covariant tangential multipliers and contravariant slips in the metric of the facet, so
that a facet's shape and numbering do not matter (theory section 6).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


class ReturnMap(NamedTuple):
    """Residual of Coulomb's law and its derivatives; axis 0 = pair.

    Attributes:
        residual: The slip where a node sticks [slip], else what the multiplier misses of
            mu p_N along the trial direction [multiplier], shape (n, 2).
        stick: Whether the trial lies within Coulomb's bound, shape (n,).
        d_multiplier: Shape (n, 2, 2).
        d_slip: Shape (n, 2, 2).
        d_metric: For symmetric changes of the metric, shape (n, 2, 2, 2).
        d_bound: Shape (n, 2).
    """

    residual: FloatArray
    stick: BoolArray
    d_multiplier: FloatArray
    d_slip: FloatArray
    d_metric: FloatArray
    d_bound: FloatArray


def _raise(metric: FloatArray, covariant: FloatArray) -> FloatArray:
    """Contravariant components m^ab t_b, shape (n, 2); not finite where the metric is singular."""
    (a, b), (_, d) = metric.transpose(1, 2, 0)
    t1, t2 = covariant.T
    return np.column_stack([d * t1 - b * t2, a * t2 - b * t1]) / (a * d - b * b)[:, None]


def length(metric: FloatArray, covariant: FloatArray) -> FloatArray:
    """||t|| of covariant components in the metric, shape (n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        square: FloatArray = np.einsum("na,na->n", covariant, _raise(metric, covariant))
        return np.sqrt(square)


def return_map(
    multiplier: FloatArray,
    slip: FloatArray,
    metric: FloatArray,
    bound: FloatArray,
    c: FloatArray,
) -> ReturnMap:
    """Coulomb's law for the trial t + c m s: stick within the bound, else slip along the trial.

    A solution has s = 0 and ||t|| <= bound, or t = bound m s / ||s||; it does not depend on c (51).

    Args:
        multiplier: Covariant lambda_T, shape (n, 2).
        slip: Contravariant slip f_1 - f_0, shape (n, 2).
        metric: m_ab = a_a . a_b, shape (n, 2, 2).
        bound: mu p_N in the units of ||lambda_T||, shape (n,).
        c: Algorithmic scale > 0, force per slip distance, shape (n,).
    """
    n = len(multiplier)
    one = np.broadcast_to(np.eye(2), (n, 2, 2))
    trial = multiplier + c[:, None] * np.einsum("nab,nb->na", metric, slip)
    with np.errstate(divide="ignore", invalid="ignore"):
        size = length(metric, trial)
        stick = size <= bound
        unit = trial / size[:, None]
        raised = _raise(metric, unit)
        across = (one - unit[:, :, None] * raised[:, None]) / size[:, None, None]
        press = np.where(stick, 0.0, bound)[:, None]
        residual = multiplier - press * unit
        d_multiplier = one - press[:, :, None] * across
        d_slip = -(press * c[:, None])[:, :, None] * np.matmul(across, metric)
        turn = c[:, None, None, None] * across[:, :, :, None] * slip[:, None, None]
        turn += 0.5 * unit[:, :, None, None] * (raised[:, :, None] * raised[:, None])[:, None]
        d_metric = -press[:, :, None, None] * turn
        d_bound = -unit
    residual[stick] = slip[stick]
    d_multiplier[stick], d_slip[stick] = 0.0, np.eye(2)
    d_metric[stick], d_bound[stick] = 0.0, 0.0
    return ReturnMap(residual, stick, d_multiplier, d_slip, d_metric, d_bound)
