"""The force that a joint's bearing carries, as its friction takes it (theory section 13).

What holds a body at rest alternates from step to step about the right force, such as the tension of
a cable that has become taut. Friction that took each step's force alone would slip in every other
one. Of three equal steps there is one mean without lag in which what alternates cancels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dolfinx_nts.types import FloatArray

#: Weights of a step's force and those of the two before it, where both are known. Their sum is 1,
#: their alternating sum and their mean lag are 0: with those of two steps alone, friction would be
#: of first order.
_WEIGHTS = 0.75, 0.5, -0.25


class Carried(NamedTuple):
    """What friction takes as the force that a bearing of b components carries.

    Attributes:
        force: [N], shape (n, b).
        share: Its derivative by that of the step, shape (n, 1).
        memory: What the next step needs, shape (n, 1 + 2 b).
    """

    force: FloatArray
    share: FloatArray
    memory: FloatArray

    @classmethod
    def of(cls, force: FloatArray, memory: FloatArray, *, inertia: bool) -> Carried:
        """From the force of the step, (n, b), and the memory; in statics nothing alternates."""
        known, last, before = np.split(memory, [1, 1 + force.shape[1]], axis=1)
        if not inertia:
            return cls(force, np.ones_like(known), np.zeros_like(memory))
        now, one, two = (
            np.where(known < 2.0, alone, weight)
            for alone, weight in zip((1.0, 0.0, 0.0), _WEIGHTS, strict=True)
        )
        more = np.minimum(known + 1.0, 2.0)
        return cls(now * force + one * last + two * before, now, np.hstack([more, force, last]))


def no_memory(n: int, bearing: int) -> FloatArray:
    """The memory of a start."""
    return np.zeros((n, 1 + 2 * bearing))
