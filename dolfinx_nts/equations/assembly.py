"""The PETSc matrices of the step problem: bodies and element blocks -> operator -> solvers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.equations import node_blocks
from dolfinx_nts.equations.layout import ElementBlocks, Layout
from dolfinx_nts.equations.schur import SchurApproximation
from dolfinx_nts.interaction.points import of_nodes
from dolfinx_nts.types import FloatArray, IntArray

#: Coordinates of the busiest rank over the mean; parts of the mesh with their overlap come to more.
_EVENLY = 1.25


class Entries(NamedTuple):
    """Entries of the tangents of elements, and where they stand in a matrix, shape (n,) each.

    Attributes:
        where: Where they stand among the entries of all tangents of their batch.
        rows: Their rows in the matrix.
        cols: Their columns there.
        weights: What they are multiplied by, see `ElementBlocks`; None: nothing.
    """

    where: IntArray
    rows: IntArray
    cols: IntArray
    weights: FloatArray | None = None


class Triplets:
    """An AIJ matrix made of entries of elements' tangents, whoever owns their rows, and of bodies.

    Args:
        comm: MPI communicator.
        size: Its rows and columns on this rank.
        parts: The entries of elements.
        bodies: PETSc matrices whose entries are in it, too.
        to_whole: (body, numbers in it) -> numbers in the new matrix.

    Attributes:
        matrix: The PETSc matrix.
    """

    def __init__(
        self, comm: MPI.Comm, size: tuple[int, int], parts: Sequence[Entries],
        bodies: Sequence[Body] = (), to_whole: Callable[[int, IntArray], IntArray] | None = None,
    ) -> None:  # fmt: skip
        none = np.empty(0, np.int64)
        rows, cols = [none, *(p.rows for p in parts)], [none, *(p.cols for p in parts)]
        self._elements = [(part.where, part.weights) for part in parts]
        self._bodies = [_OfBody(a) for a in bodies]
        for k, body in enumerate(self._bodies):
            assert to_whole is not None
            for row, col in body.numbers():
                rows.append(to_whole(k, row))
                cols.append(to_whole(k, col))
        self.matrix = PETSc.Mat().create(comm)
        self.matrix.setSizes(((size[0], None), (size[1], None)))
        self.matrix.setType("aij")
        petsc_compat.set_preallocation_coo(self.matrix, np.concatenate(rows), np.concatenate(cols))

    def set(self, tangents: Sequence[FloatArray]) -> None:
        """Replace all values. Collective.

        Args:
            tangents: Of each batch of elements, shape (n, r, r).
        """
        values = [np.empty(0)]
        for tangent, (where, weights) in zip(tangents, self._elements, strict=True):
            own = tangent.ravel()[where]
            values.append(own if weights is None else own * weights)
        values += [values for body in self._bodies for values in body.values()]
        petsc_compat.set_values_coo(self.matrix, np.concatenate(values))

    def destroy(self) -> None:
        """Free the PETSc objects; the bodies' matrices stay theirs."""
        for a in (self.matrix, *self._bodies):
            a.destroy()


class _OfBody:
    """Entries of a body's matrix on this rank, whose pattern never changes.

    Args:
        matrix: Of the body; if it is no AIJ matrix, each look converts it.
    """

    def __init__(self, matrix: PETSc.Mat) -> None:
        self._given = matrix
        self._aij = matrix
        if matrix.getType() not in {"seqaij", "mpiaij"}:
            self._aij = matrix.convert("aij", out=PETSc.Mat())
        self._parts = petsc_compat.csr_parts(self._aij)

    def numbers(self) -> Iterator[tuple[IntArray, IntArray]]:
        """Rows and columns of the entries of each part."""
        start, stop = self._aij.getOwnershipRange()
        for pointer, column, number, _ in self._parts:
            yield np.repeat(np.arange(start, stop), np.diff(pointer)), number[column]

    def values(self) -> list[FloatArray]:
        """Their values as the body's matrix is now."""
        if self._aij is not self._given:
            self._given.convert("aij", out=self._aij)
            self._parts = petsc_compat.csr_parts(self._aij)
        return [part[3] for part in self._parts]

    def destroy(self) -> None:
        """Free what was converted."""
        if self._aij is not self._given:
            self._aij.destroy()


class StepMatrix:
    """Jacobian of the step problem in the form that the solvers see.

    Args:
        layout: Fields of the problem.
        bodies: PETSc matrices of the body fields, which are not changed.
        elements: Unknowns of each batch of elements.
        split: Whether solvers see a nest of two fields, "bodies" and "constraints", from which a
            field split takes its blocks without a copy; else one matrix.
        blocked: Whether the bodies' part may be filled in the 3 x 3 blocks of nodes. With
            constraints it needs `split`.
        kind: PETSc's type of it if so: "baij", with which a product takes a third of the time, or
            "aij", as few of PETSc's preconditioners take the first.

    Attributes:
        corner: The bodies' part of the operator.
        operator: What the solvers see, after `assemble`.
    """

    def __init__(
        self, layout: Layout, bodies: Sequence[Body], elements: Sequence[ElementBlocks], *,
        split: bool = False, blocked: bool = False, kind: str = "baij",
    ) -> None:  # fmt: skip
        self._layout, self._elements = layout, list(elements)
        self._in_operator: list[FloatArray] = []
        self._num_bodies, fields = len(bodies), range(layout.counts.shape[1])
        self._split = split and len(fields) > len(bodies)
        found = node_blocks.patterns(bodies) if blocked else None
        halves = [fields[: len(bodies)], fields[len(bodies) :]] if self._split else [fields]
        local = layout.counts[layout.comm.rank]
        layouts = [Layout(layout.comm, local[half].tolist()) for half in halves]
        self._body_layout = layouts[0]
        numbers = [self._numbers(*each) for each in zip(halves, layouts, strict=True)]
        # The operator's upper left corner: the bodies, or all that there is if it is not split. Of
        # each batch the columns of its elements that are in it, and their numbers there.
        self._corner_numbers = numbers[0]
        # That corner, unless it is in blocks, and the other three.
        self._parts: list[Triplets] = []
        for i, j in [(i, j) for i in range(len(halves)) for j in range(len(halves))]:
            size = (layouts[i].num_owned, layouts[j].num_owned)
            first = i == j == 0
            if found is None or not first:
                parts = self._entries(numbers[i], numbers[j])
                of_bodies = (bodies, layouts[0].to_system) if first else ()
                self._parts.append(Triplets(layout.comm, size, parts, *of_bodies))
        self._by_nodes: node_blocks.NodeBlocks | None = None
        self._sums: list[node_blocks.NodeSums] = []
        if found is not None:
            of_elements = [number for _, number in self._corner_numbers]
            self._sums = [node_blocks.NodeSums(*each) for each in self._corner_numbers]
            self._by_nodes = node_blocks.NodeBlocks(
                bodies, found, layouts[0].to_system, of_elements
            )
            own, room = (self._by_nodes.size, None), self._by_nodes.room
            if kind == "baij":
                self.corner = PETSc.Mat().createBAIJ((own, own), 3, nnz=room, comm=layout.comm)
            else:
                room = [np.repeat(3 * blocks, 3) for blocks in room]
                self.corner = PETSc.Mat().createAIJ((own, own), 3, nnz=room, comm=layout.comm)
        else:
            self.corner = self._parts[0].matrix
        self._constraints = self._parts[-3:] if self._split else []
        self._schur: SchurApproximation | None = None
        self.operator: PETSc.Mat = None

    def _entries(
        self,
        of_rows: Sequence[tuple[IntArray, IntArray]],
        of_cols: Sequence[tuple[IntArray, IntArray]],
    ) -> list[Entries]:
        """Of each batch what can be non-zero in some rows and columns, as of `_numbers`."""
        found = []
        for block, rows, cols in zip(self._elements, of_rows, of_cols, strict=True):
            size = len(block.pattern)
            i, j = np.nonzero(block.pattern[np.ix_(rows[0], cols[0])])
            where = rows[0][i] * size + cols[0][j]
            row, col = rows[1][:, i], cols[1][:, j]
            kept, start = (row >= 0) & (col >= 0), size**2 * np.arange(len(row))
            weights = None
            if block.weights is not None:
                weights = (_weights(block, rows[0])[:, i] * _weights(block, cols[0])[:, j])[kept]
            found.append(Entries((start[:, None] + where)[kept], row[kept], col[kept], weights))
        return found

    def assemble(self, tangents: Sequence[FloatArray], *, fresh: bool = True) -> None:
        """Refresh the operator.

        Args:
            tangents: Of each batch of elements, shape (n, r, r).
            fresh: The bodies' matrices are newly assembled; else they are as in the last call.
        """
        if self._by_nodes:
            self._assemble_nodes(self._by_nodes, tangents, fresh or self.operator is None)
        for part in self._parts:
            part.set(tangents)
        if fresh and self._schur is not None:
            self._schur.renew_bodies(self.corner)
        if self.operator is None:
            self.operator = self.corner
            if self._split:
                b, c, d = (part.matrix for part in self._constraints)
                grid = [[self.corner, b], [c, d]]
                self.operator = PETSc.Mat().createNest(grid, comm=self._layout.comm)
            self.operator.assemble()
        # To assemble a nest is to assemble its blocks, each with a message from all to all.
        self.operator.stateIncrease()

    def _assemble_nodes(
        self, blocks: node_blocks.NodeBlocks, tangents: Sequence[FloatArray], fresh: bool
    ) -> None:
        """Bring a corner in blocks up to the bodies' matrices and the elements. Collective."""
        if fresh:
            blocks.fill(self.corner)
        here = [sums.of(tangent) for sums, tangent in zip(self._sums, tangents, strict=True)]
        for k, (sums, values) in enumerate(zip(self._sums, here, strict=True)):
            sums.add(self.corner, values if fresh else values - self._in_operator[k])
        self.corner.assemble()
        self._in_operator = here

    def schur(self) -> SchurApproximation:
        """Approximate Schur complements of the constraints, as the operator is. Collective.

        What they take of the bodies is of the first call or, if later, the last fresh assembly.
        """
        if self._schur is None:
            self._schur = SchurApproximation(*self._touched())
            self._schur.renew_bodies(self.corner)
        self._schur.renew(*(part.matrix for part in self._constraints))
        return self._schur

    def _touched(self) -> tuple[Any, Any]:
        """Index sets of this rank's coordinates that elements touch, and of its constraints."""
        comm, mark = self._layout.comm, self.corner.createVecLeft()
        for _, numbers in self._corner_numbers:
            index = numbers[numbers >= 0].astype(PETSc.IntType)
            mark.setValues(index, np.ones(len(index)), addv=PETSc.InsertMode.ADD_VALUES)
        mark.assemble()
        start, _ = mark.getOwnershipRange()
        touched = np.flatnonzero(mark.array_r)
        if self._by_nodes:
            # PETSc takes a part of a BAIJ matrix by whole blocks.
            touched = of_nodes(np.unique(touched // 3)).ravel()
        touched = (start + touched).astype(PETSc.IntType)
        mark.destroy()
        start, stop = self._constraints[2].matrix.getOwnershipRange()
        cols = PETSc.IS().createStride(stop - start, start, 1, comm=comm)
        return PETSc.IS().createGeneral(touched, comm=comm), cols

    def _numbers(self, fields: Sequence[int], own: Layout) -> list[tuple[IntArray, IntArray]]:
        """Each batch's columns in some fields, and their numbers in the layout of these alone."""
        result = []
        for element in self._elements:
            count = len(element.numbers[0]) if element.numbers else 0
            columns, numbers = [np.empty(0, np.int64)], [np.empty((count, 0))]
            for field, where, number in zip(*element[:3], strict=True):
                if field in fields:
                    columns.append(where)
                    moved = own.to_system(fields.index(field), number)
                    numbers.append(np.where(number < 0, -1, moved))
            result.append((np.concatenate(columns), np.concatenate(numbers, axis=1).astype(int)))
        return result

    def whole_bodies(self) -> list[IntArray] | None:
        """Numbers of the bodies dealt to this rank in their part of the operator, body by body.

        Returns:
            None unless the bodies divide among all ranks about evenly; the same on all ranks.
        """
        layout, comm = self._body_layout, self._layout.comm
        sizes = layout.counts[:, : self._num_bodies].sum(axis=0)
        load, mine = np.zeros(comm.size), []
        for k in np.argsort(-sizes, kind="stable"):
            rank = int(load.argmin())
            load[rank] += sizes[k]
            if rank == comm.rank:
                mine.append(np.sort(layout.to_system(k, np.arange(sizes[k]))))
        return mine if load.max() <= _EVENLY * load.mean() else None

    def field_sets(self, num_bodies: int) -> tuple[tuple[str, Any], tuple[str, Any]]:
        """Index sets "bodies" and "constraints" of the system vector for a field split."""
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
        return ("bodies", parts[0]), ("constraints", parts[1])

    def destroy(self) -> None:
        """Free the PETSc objects; the bodies' matrices stay theirs."""
        made: list[Any] = [self._schur] if self._schur else []
        made += [self.corner] if self._by_nodes else []
        made += [self.operator] if self._split and self.operator else []
        for a in (*self._parts, *made):
            a.destroy()


def _weights(block: ElementBlocks, columns: IntArray) -> FloatArray:
    """Weights of a combined batch's columns, as of `StepMatrix._numbers`, shape (n, columns)."""
    weights, last = block.weights, block.columns[-1]
    assert weights is not None
    out = np.ones((len(weights), len(columns)))
    if len(columns) and columns[-1] == last[-1]:
        out[:, -len(last) :] = weights
    return out
