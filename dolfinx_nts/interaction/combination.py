"""Multipliers that stand in several elements, or elements whose constraints have several."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.types import FloatArray, IntArray


class Combination(NamedTuple):
    """Constant weights C of multipliers in the constraints of a batch, lambda_q = C_qA lambda_A.

    The rows of the multipliers are those of the constraints times C^T: what holds is a sum of
    measures, and the work is that of the sum. All elements that a multiplier stands in are on
    its rank; one with multipliers of two ranks is on both, there with theirs, as it is linear.
    The multigrid and the check of an equilibrium's stability take each constraint for one alone.

    Attributes:
        number: Multipliers in each constraint, among the batch's on this rank, shape (n, m, s).
        weight: Their weights [-], 0 where there are fewer than s, shape (n, m, s).
        size: Multipliers on this rank.
    """

    number: IntArray
    weight: FloatArray
    size: int

    def of_constraints(self, multipliers: FloatArray) -> FloatArray:
        """C times values of multipliers (size,): those of constraints, shape (n, m)."""
        return (self.weight * multipliers[self.number]).sum(axis=2)

    def of_multipliers(self, rows: FloatArray) -> FloatArray:
        """C^T times values of constraints (n, m): those of multipliers, shape (size,)."""
        parts = (self.weight * rows[:, :, None]).ravel()
        return np.asarray(np.bincount(self.number.ravel(), parts, self.size), dtype=float)


def num_multipliers(batch: Any) -> int:
    """Multipliers of a batch of elements on this rank."""
    if batch.combination is None:
        return int(batch.num_elements * batch.widths["constraints"])
    return int(batch.combination.size)


def of_multipliers(batch: Any, rows: FloatArray) -> FloatArray:
    """Values of a batch's constraints (n, m) -> of its multipliers, shape (multipliers,)."""
    both = batch.combination
    return rows.ravel() if both is None else both.of_multipliers(rows)
