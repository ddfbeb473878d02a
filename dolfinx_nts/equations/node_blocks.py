"""The bodies' matrices side by side in the 3 x 3 blocks of their nodes (PETSc's BAIJ).

They are filled from the bodies' AIJ matrices block by block: by way of a nest and PETSc's
conversions a new layout of the elements would cost as much as several Newton iterations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.interaction.points import of_nodes
from dolfinx_nts.kernels import library
from dolfinx_nts.types import Array, FloatArray, IntArray

#: Nodes at a time.
_CHUNK = 500
#: Name by which a matrix knows its pattern.
_PATTERN = "dolfinx_nts_pattern"
#: Of each part of a body's matrix: where its block rows begin, and the nodes in their columns.
Pattern = list[tuple[IntArray, IntArray]]


def patterns(bodies: Sequence[PETSc.Mat]) -> list[Pattern] | None:
    """Block rows of the bodies' matrices, None unless all consist of whole blocks. Collective.

    Bodies of the user's own may have any coordinates. PETSc has no incomplete
    factorisation in blocks of a matrix without rows.
    """
    nodes = all(a.getBlockSize() == 3 and a.getType() in {"seqaij", "mpiaij"} for a in bodies)
    nodes &= any(a.getLocalSize()[0] for a in bodies)
    here = [_pattern(a) for a in bodies] if nodes else [None]
    found = [p for p in here if p is not None]
    everywhere = bodies[0].comm.tompi4py().allreduce(len(found) == len(bodies), op=MPI.LAND)
    return found if everywhere else None


def _pattern(a: Any) -> Pattern | None:
    """Block rows of this rank's parts of an AIJ matrix, if its entries are whole blocks.

    The matrix keeps it: elements have a new layout much more often than a body has.
    """
    known: Pattern | None = a.getAttr(_PATTERN)
    if known is None:
        known = _find_pattern(a)
        a.setAttr(_PATTERN, known)
    return known


def _find_pattern(a: Any) -> Pattern | None:
    parts = []
    for pointer, column, number, _ in petsc_compat.csr_parts(a):
        length = np.diff(pointer).reshape(-1, 3)
        if len(number) % 3 or (length % 3).any() or (length != length[:, :1]).any():
            return None
        node = number[::3] // 3
        if (number.reshape(-1, 3) != of_nodes(node)).any():
            return None
        start, blocks = pointer[::3] // 9, [np.empty(0, column.dtype)]
        for chunk in _chunks(start):
            block = _blocks(start, column, chunk)
            blocks.append(block[:, 0, 0] // 3)
            if (block != 3 * blocks[-1][:, None, None] + np.arange(3, dtype=column.dtype)).any():
                return None
        parts.append((start, node[np.concatenate(blocks)]))
    return parts


def _chunks(start: IntArray) -> list[slice]:
    """Ranges of block rows, so small that temporary arrays stay in the processor's cache."""
    stop = len(start) - 1
    return [slice(k, min(k + _CHUNK, stop)) for k in range(0, stop, _CHUNK)]


def _blocks(start: IntArray, entries: Array, chunk: slice) -> Array:
    """Columns or values of some block rows of an AIJ matrix, block by block, (blocks, 3, 3)."""
    start = start[chunk.start : chunk.stop + 1].astype(np.intp)
    count = np.diff(start)
    # Of the first axis; a node's other rows follow after as many triples as it has blocks.
    triple = np.arange(start[0], start[-1]) + np.repeat(2 * start[:-1], count)
    rows = triple[:, None] + np.repeat(count, count)[:, None] * np.arange(3)
    return np.take(entries.reshape(-1, 3), rows, axis=0)


class NodeBlocks:
    """What a BAIJ matrix of all bodies, with room for elements between their nodes, is made of.

    Args:
        bodies: Their PETSc matrices.
        found: What `patterns` says of them.
        to_whole: (body, numbers in it) -> numbers in the new matrix.
        elements: Of each batch the numbers in the new matrix, three to a node, shape (n, 3 nodes);
            negative ones are left out.

    Attributes:
        size: Rows on this rank.
        room: Blocks in each of its block rows, at most: in its own columns, in those of others.
    """

    def __init__(
        self, bodies: Sequence[PETSc.Mat], found: Sequence[Pattern],
        to_whole: Callable[[int, IntArray], IntArray], elements: Sequence[IntArray],
    ) -> None:  # fmt: skip
        comm, index = bodies[0].comm.tompi4py(), PETSc.IntType
        self._bodies, self._rows, self._patterns = list(bodies), [], []
        local = sum(a.getLocalSize()[0] for a in bodies) // 3
        first = np.cumsum([0, *comm.allgather(local)])
        blocks = np.zeros((local, 2), dtype=np.int64)
        for k, (a, parts) in enumerate(zip(bodies, found, strict=True)):
            start, stop = (i // 3 for i in a.getOwnershipRange())
            rows = to_whole(k, 3 * np.arange(start, stop)) // 3
            for i, (pointer, _) in enumerate(parts):
                blocks[rows - first[comm.rank], i] = np.diff(pointer)
            self._rows.append(rows.astype(index))
            self._patterns.append(
                [(p, (to_whole(k, 3 * n.astype(np.int64)) // 3).astype(index)) for p, n in parts]
            )
        blocks += _most_couplings(comm, first, elements)
        np.minimum(blocks, (local, first[-1] - local), out=blocks)
        self.size = 3 * local
        self.room = [b.astype(index) for b in np.ascontiguousarray(blocks.T)]

    def fill(self, matrix: PETSc.Mat) -> None:
        """Replace all values by those of the bodies, to which others may be added. Collective."""
        if matrix.assembled:
            matrix.zeroEntries()
        for a, rows, parts in zip(self._bodies, self._rows, self._patterns, strict=True):
            csr = petsc_compat.csr_parts(a)
            for (start, node), (*_, values) in zip(parts, csr, strict=True):
                for chunk in _chunks(start):
                    here = start[chunk.start : chunk.stop + 1]
                    matrix.setValuesBlockedIJV(
                        here - here[0],
                        node[here[0] : here[-1]],
                        _blocks(start, values, chunk),
                        rowmap=rows[chunk],
                    )
        matrix.assemble(PETSc.Mat.AssemblyType.FLUSH)


class NodeSums:
    """The blocks of a batch of elements between nodes, of which many stand at the same place.

    PETSc takes longer to find a block's place than to add to it, so they are summed up before.

    Args:
        columns: Of coordinates in the elements' tangents, three to a node, shape (3 nodes,).
        numbers: Of these in the matrix, shape (n, 3 nodes); negative ones are left out.
    """

    def __init__(self, columns: IntArray, numbers: IntArray) -> None:
        n, count = len(numbers), numbers.shape[1] // 3
        self._columns, self._numbers = (a.astype(np.int64) for a in (columns, numbers))
        node = numbers.reshape(n, count, 3).max(axis=2, initial=-1) // 3
        row, col = np.broadcast_arrays(node[:, :, None], node[:, None])
        on, width = (row >= 0) & (col >= 0), int(node.max(initial=0)) + 1
        place, where = np.unique(row[on] * width + col[on], return_inverse=True)
        self._where = np.full(on.shape, -1)
        self._where[on] = where
        rows, cols = np.divmod(place, width)
        rows, first = np.unique(rows, return_index=True)
        self._rows, self._cols, self._start = (
            a.astype(PETSc.IntType) for a in (rows, cols, np.append(first, len(place)))
        )

    def of(self, tangents: FloatArray) -> FloatArray:
        """Sums of the elements' tangents (n, r, r), shape (blocks, 3, 3)."""
        out, width = np.zeros((len(self._cols), 3, 3)), tangents.shape[1]
        count = len(self._columns) // 3
        given = self._columns, self._numbers, self._where, tangents
        library.run(library.load().node_sums, count, width, len(self._numbers), *given, out)
        return out

    def add(self, matrix: PETSc.Mat, values: FloatArray) -> None:
        """Add sums to a matrix of blocks, to be assembled."""
        matrix.setValuesBlockedIJV(
            self._start, self._cols, values, addv=PETSc.InsertMode.ADD_VALUES, rowmap=self._rows
        )


def _most_couplings(comm: MPI.Comm, first: IntArray, elements: Sequence[IntArray]) -> IntArray:
    """Upper bound of the blocks that elements need in each of this rank's rows. Collective.

    In its own columns and in those of others, shape (nodes, 2). `first` is the first node of each
    rank, and the number of all; elements as of `NodeBlocks`.
    """
    local = int(first[comm.rank + 1] - first[comm.rank])
    count = PETSc.Vec().createMPI((2 * local, None), comm=comm)
    for numbers in elements:
        node = numbers.reshape(len(numbers), numbers.shape[1] // 3, 3).max(axis=2) // 3
        row, col = np.broadcast_arrays(node[:, :, None], node[:, None, :])
        kept = (row >= 0) & (col >= 0) & (row != col)
        row, col = row[kept], col[kept]
        away = np.searchsorted(first, row, "right") != np.searchsorted(first, col, "right")
        where = (2 * row + away).astype(PETSc.IntType)
        count.setValues(where, np.ones(len(where)), addv=PETSc.InsertMode.ADD_VALUES)
    count.assemble()
    most: IntArray = count.array_r.reshape(-1, 2).astype(np.int64)
    count.destroy()
    return most
