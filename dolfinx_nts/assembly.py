"""The PETSc matrices of the step problem: element blocks -> AIJ blocks -> nest -> solvers.

No other file creates any. Fields of the step problem are the bodies, then (with the energy-momentum
scheme) the augmented unknowns (d, f), then the multipliers. A rank's unknowns are contiguous: its
part of body 1, body 2, .., (d, f), multipliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import node_blocks

#: Coordinates of the busiest rank over the mean; parts of the mesh with their overlap come to more.
_EVENLY = 1.25

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]


class Layout:
    """Where the fields' unknowns stand in the system vector.

    Args:
        comm: MPI communicator.
        sizes: Unknowns of each field on this rank.
    """

    def __init__(self, comm: Any, sizes: Sequence[int]) -> None:
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
        system: IntArray = self._rank_start[rank] + self._offset[rank, field] + index - start[rank]
        return system


class ElementBlocks(NamedTuple):
    """Unknowns of a batch of elements: their fields, columns and numbers, part by part.

    Attributes:
        fields: Field of each part.
        columns: Slice of each part in the element's unknowns.
        numbers: Numbers in the field, shape (n, columns); negative ones are left out.
        pattern: Which entries of an element's tangent can be non-zero, shape (r, r).
    """

    fields: tuple[int, ...]
    columns: tuple[slice, ...]
    numbers: tuple[IntArray, ...]
    pattern: npt.NDArray[np.bool_]


class StepMatrix:
    """Nested Jacobian of the step problem, and the form of it that the solvers see.

    Args:
        layout: Fields of the problem.
        bodies: PETSc matrices of the body fields; contact is added to them in place, unless they
            are stored in blocks.
        elements: Unknowns of each batch of contact elements.
        split: Whether solvers see a nest of two fields, "bodies" and "contact", from which a field
            split takes its blocks without a copy; else one matrix.
        blocked: Whether the bodies' part may be stored in the 3 x 3 blocks of nodes (BAIJ), with
            which a product takes a third of the time; few of PETSc's preconditioners take it. With
            contact it needs `split`.

    Attributes:
        nest: Blocks of all fields, as of the last fresh assembly. Where the bodies' part is stored
            in blocks of nodes, contact between coordinates is left to `operator`.
        operator: What the solvers see, after `assemble`.
    """

    def __init__(
        self,
        layout: Layout,
        bodies: Sequence[Any],
        elements: Sequence[ElementBlocks],
        *,
        split: bool = False,
        blocked: bool = False,
    ) -> None:
        self._layout, self._bodies, self._elements = layout, list(bodies), list(elements)
        self._in_bodies: list[FloatArray] = []
        self._in_operator: list[FloatArray] = []
        self._sources: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
        for e, element in enumerate(elements):
            for i, row in enumerate(element.fields):
                for j, col in enumerate(element.fields):
                    self._sources.setdefault((row, col), []).append((e, i, j))
        fields = range(layout.counts.shape[1])
        found = node_blocks.patterns(bodies) if blocked else None
        self._by_nodes: node_blocks.NodeBlocks | None = None
        if found is not None:
            for key in [k for k in self._sources if max(k) < len(bodies)]:
                del self._sources[key]
        self._split = split and len(fields) > len(bodies)
        self._blocks = {
            key: self._new_block(*key)
            for key in self._sources
            if key[0] != key[1] or key[0] >= len(bodies)
        }
        grid = [[self._block(i, j) for j in fields] for i in fields]
        self.nest = PETSc.Mat().createNest(grid, comm=layout.comm)
        self._parts = [self.nest]
        halves = [list(fields)]
        if self._split:
            for k in range(len(bodies)):
                for key in ((k, len(bodies)), (len(bodies), k)):
                    if key not in self._blocks:
                        grid[key[0]][key[1]] = self._blocks[key] = self._zero_block(*key)
            halves = [list(fields[: len(bodies)]), list(fields[len(bodies) :])]
            quarters = [[[grid[i][j] for j in b] for i in a] for a in halves for b in halves]
            self._parts = [PETSc.Mat().createNest(q, comm=layout.comm) for q in quarters]
        local = layout.counts[layout.comm.rank]
        layouts = [Layout(layout.comm, local[half].tolist()) for half in halves]
        self._body_layout = layouts[0]
        numbers = [self._numbers(*each) for each in zip(halves, layouts, strict=True)]
        if found is not None:
            contact = [number for _, number in numbers[0]]
            self._by_nodes = node_blocks.NodeBlocks(bodies, found, layouts[0].to_system, contact)
        self._part_numbers = [(a, b) for a in numbers for b in numbers]
        self._converted = [PETSc.Mat() for _ in self._parts]
        if self._by_nodes:
            size = (self._by_nodes.size, None)
            self._converted[0].createBAIJ(
                (size, size), 3, nnz=self._by_nodes.room, comm=layout.comm
            )
        self._near: tuple[Any, ...] = ()
        self.operator: Any = None

    def _block(self, i: int, j: int) -> Any:
        if i == j and i < len(self._bodies):
            return self._bodies[i]
        return self._blocks.get((i, j))

    def _entries(
        self, source: tuple[int, int, int]
    ) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Element rows and columns of a block, and their numbers in the fields (n, entries)."""
        e, i, j = source
        element = self._elements[e]
        rows, cols = np.nonzero(element.pattern[element.columns[i], element.columns[j]])
        return rows, cols, element.numbers[i][:, rows], element.numbers[j][:, cols]

    def _zero_block(self, row: int, col: int) -> Any:
        """A body without contact still has its place in the nest of a split."""
        local = self._layout.counts[self._layout.comm.rank]
        sizes = ((int(local[row]), None), (int(local[col]), None))
        a = PETSc.Mat().createAIJ(sizes, nnz=0, comm=self._layout.comm)
        a.assemble()
        return a

    def _new_block(self, row: int, col: int) -> Any:
        parts = [self._entries(s)[2:] for s in self._sources[row, col]]
        rows = np.concatenate([p[0].ravel() for p in parts])
        cols = np.concatenate([p[1].ravel() for p in parts])
        local = self._layout.counts[self._layout.comm.rank]
        a = PETSc.Mat().create(self._layout.comm)
        a.setSizes(((int(local[row]), None), (int(local[col]), None)))
        a.setType("aij")
        compat.set_preallocation_coo(a, rows, cols)
        return a

    def assemble(self, tangents: Sequence[FloatArray], *, fresh: bool = True) -> None:
        """Add the contact tangents (n, r, r); refresh nest and operator.

        Args:
            tangents: Of each batch of elements.
            fresh: The bodies' matrices are without contact, newly assembled; else they are as the
                last call left them, and only the operator is changed.
        """
        if self.operator is not None and not fresh:
            self._change_operator(tangents)
            return
        self._in_bodies = self._in_operator = list(tangents)
        for key, sources in self._sources.items():
            if key in self._blocks:
                values = [self._values(s, tangents) for s in sources]
                compat.set_values_coo(
                    self._blocks[key], np.concatenate([v.ravel() for v in values])
                )
            else:
                self._add_to_body(self._bodies[key[0]], sources, tangents)
        for part in (self.nest, *self._parts):
            part.assemble()
        for k in range(len(self._parts)):
            self._convert(k, tangents)
        if self.operator is None:
            self.operator = self._converted[0]
            if self._split:
                grid = [self._converted[:2], self._converted[2:]]
                self.operator = PETSc.Mat().createNest(grid, comm=self._layout.comm)
        self.operator.assemble()

    def outgrown(self) -> bool:
        """Whether the bodies' matrices have entries the operator has no room for. Collective."""
        return self._by_nodes is not None and self._by_nodes.outgrown()

    def _convert(self, k: int, tangents: Sequence[FloatArray]) -> None:
        """Bring what the solvers see of a part up to date."""
        if k or not self._by_nodes:
            # Without `out` the nest itself is converted.
            self._parts[k].convert("aij", out=self._converted[k])
            return
        bodies = self._converted[0]
        self._by_nodes.fill(bodies)
        for (i, row), tangent in zip(self._part_numbers[0][0], tangents, strict=True):
            _add(bodies, row, row, tangent[:, i][:, :, i])
        bodies.assemble()

    def _change_operator(self, tangents: Sequence[FloatArray]) -> None:
        """Put other contact tangents into the operator; on several ranks converting is slow."""
        change = [a - b for a, b in zip(tangents, self._in_operator, strict=True)]
        self._in_operator = list(tangents)
        for a, (rows, cols) in zip(self._converted, self._part_numbers, strict=True):
            # Outside the pattern of an element its tangent is zero.
            a.setOption(PETSc.Mat.Option.NEW_NONZERO_LOCATIONS, False)
            for (i, row), (j, col), values in zip(rows, cols, change, strict=True):
                _add(a, row, col, values[:, i][:, :, j])
            a.assemble()
        self.operator.assemble()

    def schur(self) -> tuple[Any, Any]:
        """Two approximate Schur complements of the contact unknowns in the bodies' coordinates.

        They are D - C W B and D - C W A W B, of the coordinates in contact alone: the inverse of
        their block A of the bodies' matrix is replaced by the diagonal matrix W of one over the
        sums of the moduli of its rows, and by W A W. `linear_solver.SchurInverse` uses them. The
        caller destroys the matrices. Collective.
        """
        bodies, above, below, contact = self._converted
        rows, cols, *kept = self._near or (*self._touched(), None, None, None, None)
        near, first, back, second = kept
        if self._by_nodes:
            # PETSc has no product of the two formats, nor renews a part of MPIBAIJ.
            square = bodies.createSubMatrix(rows, rows)
            near = square.convert("aij", out=near or PETSc.Mat())
            square.destroy()
        else:
            near = bodies.createSubMatrix(rows, rows, submat=near)
        first = above.createSubMatrix(rows, cols, submat=first)
        back = below.createSubMatrix(cols, rows, submat=back)
        pointer, _, values = near.getValuesCSR()
        inverse = near.createVecLeft()
        inverse.array_w[:] = 1.0 / np.add.reduceat(np.abs(values), pointer[:-1])
        first.diagonalScale(inverse, None)
        second = near.matMult(first, result=second)
        second.diagonalScale(inverse, None)
        inverse.destroy()
        self._near = (rows, cols, near, first, back, second)
        result = back.matMult(first), back.matMult(second)
        for product in result:
            product.aypx(-1.0, contact, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        return result

    def _touched(self) -> tuple[Any, Any]:
        """Index sets of this rank's coordinates in contact and of its contact unknowns."""
        comm, mark = self._layout.comm, self._converted[0].createVecLeft()
        for _, numbers in self._part_numbers[0][0]:
            index = numbers[numbers >= 0].astype(PETSc.IntType)
            mark.setValues(index, np.ones(len(index)), addv=PETSc.InsertMode.ADD_VALUES)
        mark.assemble()
        start, _ = mark.getOwnershipRange()
        touched = np.flatnonzero(mark.array_r)
        if self._by_nodes:
            # PETSc takes a part of a BAIJ matrix by whole blocks.
            touched = (3 * np.unique(touched // 3)[:, None] + np.arange(3)).ravel()
        touched = (start + touched).astype(PETSc.IntType)
        mark.destroy()
        start, stop = self._converted[3].getOwnershipRange()
        cols = PETSc.IS().createStride(stop - start, start, 1, comm=comm)
        return PETSc.IS().createGeneral(touched, comm=comm), cols

    def withdraw(self) -> None:
        """Take the contact tangents out of the bodies' matrices, but for rounding."""
        change = [-a for a in self._in_bodies]
        for key, sources in self._sources.items():
            if key not in self._blocks and change:
                self._add_to_body(self._bodies[key[0]], sources, change)
        self._in_bodies = []

    def _values(self, source: tuple[int, int, int], tangents: Sequence[FloatArray]) -> FloatArray:
        e, i, j = source
        rows, cols, _, _ = self._entries(source)
        columns = self._elements[e].columns
        values: FloatArray = tangents[e][:, columns[i], columns[j]][:, rows, cols]
        return values

    def _numbers(self, fields: Sequence[int], own: Layout) -> list[tuple[IntArray, IntArray]]:
        """Each batch's columns in some fields, and their numbers in the layout of these alone."""
        result = []
        for element in self._elements:
            count = len(element.numbers[0]) if element.numbers else 0
            columns, numbers = [np.empty(0, np.int64)], [np.empty((count, 0))]
            for field, where, number in zip(*element[:3], strict=True):
                if field in fields:
                    columns.append(np.arange(where.start, where.stop))
                    moved = own.to_system(fields.index(field), number)
                    numbers.append(np.where(number < 0, -1, moved))
            result.append((np.concatenate(columns), np.concatenate(numbers, axis=1).astype(int)))
        return result

    def _add_to_body(
        self, a: Any, sources: Sequence[tuple[int, int, int]], tangents: Sequence[FloatArray]
    ) -> None:
        a.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        for e, i, j in sources:
            element = self._elements[e]
            values = tangents[e][:, element.columns[i], element.columns[j]]
            _add(a, element.numbers[i], element.numbers[j], values)
        a.assemble()

    def whole_bodies(self) -> list[IntArray] | None:
        """Numbers of the bodies dealt to this rank in their part of the operator, body by body.

        Returns:
            None unless the bodies divide among all ranks about evenly; the same on all ranks.
        """
        layout, comm = self._body_layout, self._layout.comm
        sizes = layout.counts[:, : len(self._bodies)].sum(axis=0)
        load, mine = np.zeros(comm.size), []
        for k in np.argsort(-sizes, kind="stable"):
            rank = int(load.argmin())
            load[rank] += sizes[k]
            if rank == comm.rank:
                mine.append(np.sort(layout.to_system(k, np.arange(sizes[k]))))
        return mine if load.max() <= _EVENLY * load.mean() else None

    def field_sets(self, num_bodies: int) -> tuple[tuple[str, Any], tuple[str, Any]]:
        """Index sets "bodies" and "contact" of the system vector for a field split."""
        parts = []
        fields = range(self._layout.counts.shape[1])
        for chosen in (
            [f for f in fields if f < num_bodies],
            [f for f in fields if f >= num_bodies],
        ):
            local = [
                np.arange(*self._layout.owned(f).indices(self._layout.num_owned)) for f in chosen
            ]
            start = self._layout.first_owned
            index = (np.concatenate(local) + start).astype(PETSc.IntType)
            parts.append(PETSc.IS().createGeneral(index, comm=self._layout.comm))
        return ("bodies", parts[0]), ("contact", parts[1])

    def destroy(self) -> None:
        """Free the PETSc objects; the bodies' matrices stay theirs."""
        operator = [self.operator] if self._split and self.operator else []
        nests = [self.nest, *(self._parts if self._split else [])]
        for a in (
            *operator,
            *self._near,
            *self._converted,
            *nests,
            *self._blocks.values(),
        ):
            a.destroy()


def _add(a: Any, rows: IntArray, cols: IntArray, values: FloatArray) -> None:
    """Add blocks (n, r, c) at rows (n, r) and columns (n, c); negative numbers are left out."""
    (n, num_rows), num_cols = rows.shape, cols.shape[1]
    a.setValuesIJV(
        np.arange(n * num_rows + 1, dtype=PETSc.IntType) * num_cols,
        np.repeat(cols, num_rows, axis=0).ravel().astype(PETSc.IntType),
        np.ascontiguousarray(values).ravel(),
        addv=PETSc.InsertMode.ADD_VALUES,
        rowmap=rows.ravel().astype(PETSc.IntType),
    )


def model_problem(
    comm: Any, *, constraint: bool
) -> tuple[Any, tuple[tuple[str, Any], tuple[str, Any]]]:
    """A chain of masses and springs, small but large enough for an algebraic multigrid.

    Args:
        comm: MPI communicator.
        constraint: Whether a multiplier holds the first mass of each rank.

    Returns:
        Its matrix, and the index sets "bodies" and "contact" of its unknowns.
    """
    count, extra = 300, int(constraint)
    a = PETSc.Mat().createAIJ(((count + extra, None), (count + extra, None)), nnz=4, comm=comm)
    start, _ = a.getOwnershipRange()
    for i in range(start, start + count):
        a.setValue(i, i, 3.0)
        if i > start:
            a.setValue(i, i - 1, -1.0)
            a.setValue(i - 1, i, -1.0)
    if constraint:
        a.setValue(start, start + count, 1.0)
        a.setValue(start + count, start, 1.0)
        a.setValue(start + count, start + count, 0.0)
    a.assemble()
    bodies = PETSc.IS().createStride(count, start, 1, comm=comm)
    contact = PETSc.IS().createStride(extra, start + count, 1, comm=comm)
    return a, (("bodies", bodies), ("contact", contact))
