"""Rates of what a function of time prescribes, told by its values within a step (theory 21)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dolfinx_nts.types import BoolArray, FloatArray

#: Where functions are asked, over the step, from the end at which rates are sought: near to it
#: for the velocity, so that few kinks lie between, and evenly for the acceleration, which rounding
#: spoils sooner.
PARTS = (0.0, 0.125, 0.25, 0.5, 0.75, 1.0)
#: Mean velocities between these times belong to a jump or a kink where one differs from the others
#: by more than this part of all that they change by in the step: a steady acceleration has a
#: seventh at most ...
_ALONE = 1.0 / 3.0
#: ... by this part of the largest of them ...
_LARGE = 0.1
#: ... and by more than this part of the largest value between two times, which may be rounding.
_ROUNDED = 64.0 * float(np.finfo(float).eps)


class Told(NamedTuple):
    """Rates at one end of a step.

    Attributes:
        velocity: [m/s].
        doubt: What it may err by [m/s], as a formula with twice the times says.
        acceleration: [m/s^2].
    """

    velocity: FloatArray
    doubt: FloatArray
    acceleration: FloatArray


def times(at: float, other: float) -> tuple[float, ...]:
    """Where functions are asked for their rates at one end of a step [s], (6,), both ends exactly.

    Args:
        at: That end [s].
        other: The other one [s].
    """
    return tuple((1.0 - part) * at + part * other for part in PARTS)


def told(values: FloatArray, span: float, before: FloatArray | None = None) -> Told:
    """Rates of a function by one-sided differences of second order.

    A function that jumps in the step, or whose velocity does near the time, has no difference that
    means anything: it has the mean velocity of the step, however late it jumps.

    Args:
        values: At `times` [m], shape (6, ...).
        span: The step [s], with a minus for rates at its start.
        before: Velocity at the start of the step [m/s]. None: rates there are sought, where a
            function that is about to jump still has the slower of its velocities.
    """
    # Written in this way, the rates of what does not move are 0, not rounding.
    back = values[0] - values[1:]
    parts = np.diff(PARTS).reshape(-1, *[1] * (back.ndim - 1))
    means = np.diff(back, axis=0, prepend=np.zeros_like(back[:1])) / (parts * span)
    fine, coarse = (
        (4.0 * back[k] - back[k + 1]) / (2.0 * PARTS[k + 1] * span) for k in (0, 1)
    )
    doubt = 2.0 * np.abs(fine - coarse)
    second = (5.0 * back[1] - 4.0 * back[2] + back[3]) / (PARTS[2] * span) ** 2
    noise = _ROUNDED * float(np.abs(values).max(initial=0.0)) / (PARTS[1] * abs(span))
    late, jumps = _broken(means, before, noise)
    if before is None:
        slower = np.where(np.abs(means[0]) < np.abs(means[1]), means[0], means[1])
        away = np.abs(means[0] - means[1])
        return Told(np.where(late, slower, fine), np.where(late, away, doubt), second)
    mean, broken = back[-1] / span, late | jumps
    return Told(
        np.where(broken, mean, fine),
        np.where(broken, 0.0, doubt),
        np.where(broken, (mean - before) / span, second),
    )


def _broken(
    means: FloatArray, before: FloatArray | None, noise: float
) -> tuple[BoolArray, BoolArray]:
    """Where mean velocities (5, ...), the latest first, have a kink near their end, and a jump.

    A kink leaves each between its neighbours, a jump does not. `noise` [m/s] is neither.
    """
    chain = means if before is None else np.concatenate([means, before[None]])
    change = np.abs(np.diff(chain, axis=0))
    large = np.maximum(_ALONE * change.sum(axis=0), _LARGE * np.abs(chain).max(axis=0)) + noise
    later, inner, earlier = chain[:-2], chain[1:-1], chain[2:]
    above, below = inner - np.maximum(later, earlier), np.minimum(later, earlier) - inner
    return change[0] > large, (np.maximum(above, below) > large).any(axis=0)
