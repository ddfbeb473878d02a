"""The multipliers of least norm, where constraints repeat each other.

The forces on the bodies do not determine the multipliers there (a loop with too many joints): a
part of them lies in the null space of the forces' columns and does nothing. How large Newton's
method leaves it depends on the path of the iterates; here it is taken out.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import lsqr

from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.combination import num_multipliers
from dolfinx_nts.types import FloatArray

logger = logging.getLogger(__name__)


#: Tolerance of the least squares, relative to the multipliers.
_RTOL = 1e-14
#: Iterations over unknowns that least squares may take; in exact arithmetic one is enough.
_ITERATIONS = 10
#: Solves by least squares, each for what the one before has left.
_PASSES = 2
#: What SciPy's lsqr says where its iterations did not do.
_LIMIT = 7
#: Norm below which the part of a random vector in the null space counts as zero.
_NONE = 1e-6


def form_tree(joints: Sequence[Sequence[int]]) -> bool:
    """Whether joints, each given by the numbers of its bodies, form no loop with the ground.

    Those cannot repeat each other.
    """
    group: dict[int, int] = {}
    for bodies in joints:
        ends = [*bodies, -1] if len(bodies) == 1 else list(bodies)
        known = [group.setdefault(b, b) for b in ends]
        if len(set(known)) < len(known):
            return False
        for b, g in group.items():
            if g in known:
                group[b] = known[0]
    return True


def hanging(joints: Sequence[Sequence[int]], free: Collection[int]) -> list[bool]:
    """Whether a free body hangs on each joint, by it alone, once what hangs below is taken away.

    Such joints repeat no other constraint.

    Args:
        joints: Numbers of the bodies of each joint.
        free: Rigid bodies without prescribed motion.
    """
    held: dict[int, set[int]] = {}
    for j, bodies in enumerate(joints):
        for b in bodies:
            held.setdefault(b, set()).add(j)
    hangs = [False] * len(joints)
    ends = [b for b in held if b in free and len(held[b]) == 1]
    while ends:
        for j in list(held[ends.pop()]):
            hangs[j] = True
            for b in joints[j]:
                held[b].discard(j)
                if b in free and len(held[b]) == 1:
                    ends.append(b)
    return hangs


class NullSpace:
    """Multipliers of bilateral constraints that exert no force on any body.

    Args:
        laid: Layout of the unknowns.
        comm: MPI communicator.
        elements: Batches of elements.
        bodies: Numbers of the bodies of each batch.
        parts: Their contributions at the solution.
    """

    def __init__(
        self, laid: Unknowns, comm: MPI.Comm, elements: Sequence[Any],
        bodies: Sequence[tuple[int, ...]], parts: Sequence[Any],
    ) -> None:  # fmt: skip
        places, entries, scales, start, count = [], [], [np.empty(0)], 0, 0
        for batch, numbers, part in zip(elements, bodies, parts, strict=True):
            n, m, size = batch.num_elements, batch.widths["constraints"], num_multipliers(batch)
            if batch.bilateral and size:
                places.append(np.arange(start, start + size))
                scale = np.broadcast_to(batch.force_scale, n)
                if batch.combination is None:
                    rows, weight = np.arange(size).reshape(n, m, 1), np.ones((n, m, 1))
                    scales.append(np.repeat(scale, m))
                else:  # one multiplier may have forces of several units
                    (rows, weight, _), scale = batch.combination, np.ones(n)
                    scales.append(np.ones(size))
                both = zip(numbers, batch.dofs(), strict=True)
                columns = np.concatenate([laid.numbers_of(k, dofs) for k, dofs in both], axis=1)
                force = part.tangent[:, : batch.num_coordinates, -m:, None] * weight[:, None]
                found = np.broadcast_arrays(
                    count + rows[:, None], columns[:, :, None, None],
                    force / scale[:, None, None, None],
                )  # fmt: skip
                count += size
                some = (found[1] >= 0) & (found[2] != 0.0)
                entries.append([array[some] for array in found])
            start += size
        none = [np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)]
        local = [np.concatenate(arrays) for arrays in zip(none, *entries, strict=True)]
        ranks = comm.allgather((count, local))
        first = np.cumsum([0, *(number for number, _ in ranks)])
        row, column, force = (
            np.concatenate(arrays) for arrays in zip(*(arrays for _, arrays in ranks), strict=True)
        )
        row = row + np.repeat(first[:-1], [len(arrays[0]) for _, arrays in ranks])
        names, column = np.unique(column, return_inverse=True)
        self._comm, self._size = comm, start
        self._places, self._scales = np.concatenate([none[0], *places]), np.concatenate(scales)
        self._own = slice(first[comm.rank], first[comm.rank + 1])
        self._matrix = csr_matrix((force, (row, column)), (first[-1], len(names)))

    def is_empty(self) -> bool:
        """Whether no constraint repeats others.

        Where this holds at one time, it holds at all but single instants, such as dead centres.
        """
        size = self._matrix.shape[0]
        if not size:
            return True
        probe = np.random.default_rng(0).standard_normal(size)
        return float(np.linalg.norm(self._null(probe))) <= _NONE * np.sqrt(size)

    def part(self, multipliers: FloatArray) -> FloatArray:
        """Part of multipliers in the null space; without it they push alike and have least norm.

        Collective.

        Args:
            multipliers: Unknowns of all elements on this rank.
        """
        out = np.zeros(self._size)
        own = self._scales * multipliers[self._places]
        found = self._null(np.concatenate(self._comm.allgather(own)))
        out[self._places] = found[self._own] / self._scales
        return out

    def _null(self, v: FloatArray) -> FloatArray:
        """The part of all bilateral multipliers in the null space."""
        most = _ITERATIONS * max(self._matrix.shape)
        found = v
        # What rounding leaves of all else in the first pass would act on the bodies.
        for _ in range(_PASSES):
            least, reason, *_ = lsqr(
                self._matrix, found, atol=_RTOL, btol=_RTOL, conlim=0.0, iter_lim=most
            )
            if reason == _LIMIT and self._comm.rank == 0:
                logger.warning(
                    "forces of joints that repeat each other: those of least norm are not found in "
                    "%d iterations; those given move the bodies in the same way, but may have a "
                    "part that cancels out: drop a joint of the loop", most,
                )  # fmt: skip
            found = found - self._matrix @ least
        return found
