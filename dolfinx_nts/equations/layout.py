"""Where the unknowns of a step stand: of fields in the system vector, of elements in fields.

Fields of the step problem are the bodies, then (with the energy-momentum scheme) the augmented
unknowns (d, f), then the multipliers. A rank's unknowns are contiguous: its part of body 1, body 2,
.., (d, f), multipliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from dolfinx_nts.types import IntArray


class Layout:
    """Where the fields' unknowns stand in the system vector.

    Args:
        comm: MPI communicator.
        sizes: Unknowns of each field on this rank.
    """

    def __init__(self, comm: MPI.Comm, sizes: Sequence[int]) -> None:
        counts = np.asarray(comm.allgather(list(sizes)), dtype=np.int64)
        zero = np.zeros((1, counts.shape[1]), np.int64)
        self.comm, self.counts, self._rank = comm, counts, comm.rank
        self._field_start = np.concatenate([zero, counts.cumsum(axis=0)])
        self._rank_start = np.concatenate([[0], counts.sum(axis=1).cumsum()])
        self._offset = counts.cumsum(axis=1) - counts

    @property
    def num_owned(self) -> int:
        """Unknowns on this rank."""
        return int(self.counts[self._rank].sum())

    @property
    def first_owned(self) -> int:
        """Number of this rank's first unknown in the system vector."""
        return int(self._rank_start[self._rank])

    def owned(self, field: int) -> slice:
        """Where a field stands among this rank's unknowns."""
        start = int(self._offset[self._rank, field])
        return slice(start, start + int(self.counts[self._rank, field]))

    def start(self, field: int) -> int:
        """First number of this rank's unknowns within a field."""
        return int(self._field_start[self._rank, field])

    def to_system(self, field: int, index: IntArray) -> IntArray:
        """Numbers within a field -> numbers in the system vector."""
        start = self._field_start[:, field]
        rank = np.searchsorted(start, index, side="right") - 1
        return self._rank_start[rank] + self._offset[rank, field] + index - start[rank]


class ElementBlocks(NamedTuple):
    """Unknowns of a batch of elements: their fields, columns and numbers, part by part.

    Attributes:
        fields: Field of each part.
        columns: Columns of each part in the element's unknowns; one of a constraint with several
            multipliers occurs as often.
        numbers: Numbers in the field, shape (n, columns); negative ones are left out.
        pattern: Which entries of a tangent are in a matrix, shape (r, r): all that couple
            coordinates of bodies with anything.
        entries: Which of them can be non-zero, see `Elements.entries`.
        weights: Of the multipliers, the last part, in the constraints, shape (n, columns); None:
            they are one.
    """

    fields: tuple[int, ...]
    columns: tuple[IntArray, ...]
    numbers: tuple[IntArray, ...]
    pattern: npt.NDArray[np.bool_]
    entries: npt.NDArray[np.bool_]
    weights: npt.NDArray[np.float64] | None = None

    def with_columns(self, field: int, numbers: IntArray) -> ElementBlocks:
        """With unknowns of others, (n, columns), on which all rows may depend."""
        size, more = len(self.pattern), numbers.shape[1]
        wide = [np.zeros((size + more,) * 2, dtype=bool) for _ in range(2)]
        for new, old in zip(wide, (self.pattern, self.entries), strict=True):
            new[:size, :size], new[:size, size:] = old, True
        return self._replace(
            fields=(*self.fields, field), columns=(*self.columns, np.arange(size, size + more)),
            numbers=(*self.numbers, numbers), pattern=wide[0], entries=wide[1],
        )
