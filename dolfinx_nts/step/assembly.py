"""The PETSc matrices of the step problem: element blocks -> AIJ blocks -> nest -> solvers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.points import of_nodes
from dolfinx_nts.step import node_blocks
from dolfinx_nts.step.layout import ElementBlocks, Layout
from dolfinx_nts.step.schur import SchurApproximation

#: Coordinates of the busiest rank over the mean; parts of the mesh with their overlap come to more.
_EVENLY = 1.25

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]


class Entries(NamedTuple):
    """Entries of the tangents of a batch of elements, and where they stand in a matrix.

    Attributes:
        batch: Number of the batch.
        rows: In an element's tangent, shape (k,).
        cols: Likewise.
        row_numbers: In the matrix, shape (n, k); negative ones are left out.
        col_numbers: Likewise.
    """

    batch: int
    rows: IntArray
    cols: IntArray
    row_numbers: IntArray
    col_numbers: IntArray


class Triplets:
    """An AIJ matrix made of certain entries of elements' tangents, whoever owns their rows.

    Args:
        comm: MPI communicator.
        size: Its rows and columns on this rank.
        parts: The entries.

    Attributes:
        matrix: The PETSc matrix.
    """

    def __init__(self, comm: Any, size: tuple[int, int], parts: Sequence[Entries]) -> None:
        self._entries = [(part.batch, part.rows, part.cols) for part in parts]
        self.matrix = PETSc.Mat().create(comm)
        self.matrix.setSizes(((size[0], None), (size[1], None)))
        self.matrix.setType("aij")
        none = np.empty(0, np.int64)
        rows = np.concatenate([none, *(part.row_numbers.ravel() for part in parts)])
        cols = np.concatenate([none, *(part.col_numbers.ravel() for part in parts)])
        compat.set_preallocation_coo(self.matrix, rows, cols)

    def set(self, tangents: Sequence[FloatArray]) -> None:
        """Replace all values. Collective.

        Args:
            tangents: Of each batch of elements, shape (n, r, r).
        """
        values = [tangents[e][:, rows, cols].ravel() for e, rows, cols in self._entries]
        compat.set_values_coo(self.matrix, np.concatenate([np.empty(0), *values]))

    def destroy(self) -> None:
        """Free the PETSc object."""
        self.matrix.destroy()


class StepMatrix:
    """Nested Jacobian of the step problem, and the form of it that the solvers see.

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
        nest: Blocks of the fields, as of the last fresh assembly, that are converted to one matrix:
            of all fields, or if split of the bodies; None if these are filled in blocks of nodes.
        corner: The bodies' part of the operator.
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
        kind: str = "baij",
    ) -> None:
        self._layout, self._bodies, self._elements = layout, list(bodies), list(elements)
        self._in_operator: list[FloatArray] = []
        fields = range(layout.counts.shape[1])
        self._split = split and len(fields) > len(bodies)
        found = node_blocks.patterns(bodies) if blocked else None
        joined = fields[: len(bodies)] if self._split else fields
        self._sources: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
        for e, element in enumerate(elements if found is None else ()):
            for i, row in enumerate(element.fields):
                for j, col in enumerate(element.fields):
                    if row in joined and col in joined:
                        self._sources.setdefault((row, col), []).append((e, i, j))
        self._blocks = {
            key: self._new_block(*key)
            for key in self._sources
            if key[0] != key[1] or key[0] >= len(bodies)
        }
        # Bodies' matrices with room for elements within the body, which may fill more entries.
        self._copies = {
            i: self._bodies[i].duplicate(copy=False) for i, j in self._sources
            if i == j and i < len(bodies)
        }
        self._same: dict[int, bool] = {}
        self.nest: Any = None
        if found is None:
            grid = [[self._block(i, j) for j in joined] for i in joined]
            self.nest = PETSc.Mat().createNest(grid, comm=layout.comm)
        halves = [fields[: len(bodies)], fields[len(bodies) :]] if self._split else [fields]
        local = layout.counts[layout.comm.rank]
        layouts = [Layout(layout.comm, local[half].tolist()) for half in halves]
        self._body_layout = layouts[0]
        numbers = [self._numbers(*each) for each in zip(halves, layouts, strict=True)]
        # The operator's upper left corner: the bodies, or all that there is if it is not split. Of
        # each batch the columns of its elements that are in it, and their numbers there.
        self._corner_numbers = numbers[0]
        quarters = [(i, j) for i in range(len(halves)) for j in range(len(halves))][1:]
        self._constraints = []
        for i, j in quarters:
            size = (layouts[i].num_owned, layouts[j].num_owned)
            parts = [self._entries(e, numbers[i][e], numbers[j][e]) for e in range(len(elements))]
            self._constraints.append(Triplets(layout.comm, size, parts))
        self._by_nodes: node_blocks.NodeBlocks | None = None
        self.corner = PETSc.Mat()
        if found is not None:
            of_elements = [number for _, number in self._corner_numbers]
            self._by_nodes = node_blocks.NodeBlocks(
                bodies, found, layouts[0].to_system, of_elements
            )
            own, room = (self._by_nodes.size, None), self._by_nodes.room
            if kind == "baij":
                self.corner.createBAIJ((own, own), 3, nnz=room, comm=layout.comm)
            else:
                room = [np.repeat(3 * blocks, 3) for blocks in room]
                self.corner.createAIJ((own, own), 3, nnz=room, comm=layout.comm)
        self._schur: SchurApproximation | None = None
        self.operator: Any = None

    def _block(self, i: int, j: int) -> Any:
        if i == j and i < len(self._bodies):
            return self._copies.get(i, self._bodies[i])
        block = self._blocks.get((i, j))
        return block.matrix if block else None

    def _new_block(self, row: int, col: int) -> Triplets:
        local, parts = self._layout.counts[self._layout.comm.rank], []
        for e, i, j in self._sources[row, col]:
            columns, numbers = self._elements[e].columns, self._elements[e].numbers
            sides = [(np.arange(columns[k].start, columns[k].stop), numbers[k]) for k in (i, j)]
            parts.append(self._entries(e, *sides))
        return Triplets(self._layout.comm, (int(local[row]), int(local[col])), parts)

    def _entries(
        self, e: int, rows: tuple[IntArray, IntArray], cols: tuple[IntArray, IntArray]
    ) -> Entries:
        """Of a batch what can be non-zero in some rows and columns (r,), numbered as (n, r)."""
        i, j = np.nonzero(self._elements[e].pattern[np.ix_(rows[0], cols[0])])
        return Entries(e, rows[0][i], cols[0][j], rows[1][:, i], cols[1][:, j])

    def assemble(self, tangents: Sequence[FloatArray], *, fresh: bool = True) -> None:
        """Add the elements' tangents (n, r, r); refresh nest and operator.

        Args:
            tangents: Of each batch of elements.
            fresh: The bodies' matrices are without elements, newly assembled; else they are as the
                last call left them, and only the operator is changed.
        """
        if self.operator is None or fresh:
            self._renew(tangents)
            if self._schur is not None:
                self._schur.renew_bodies(self.corner)
        else:
            # On several ranks converting is slow. Outside an element's pattern its tangent is zero.
            self.corner.setOption(PETSc.Mat.Option.NEW_NONZERO_LOCATIONS, False)
            self._add([a - b for a, b in zip(tangents, self._in_operator, strict=True)])
        self._in_operator = list(tangents)
        for part in self._constraints:
            part.set(tangents)
        if self.operator is None:
            self.operator = self.corner
            if self._split:
                b, c, d = (part.matrix for part in self._constraints)
                grid = [[self.corner, b], [c, d]]
                self.operator = PETSc.Mat().createNest(grid, comm=self._layout.comm)
            self.operator.assemble()
        # To assemble a nest is to assemble its blocks, each with a message from all to all.
        self.operator.stateIncrease()

    def _renew(self, tangents: Sequence[FloatArray]) -> None:
        """Bring nest and operator's corner up to the bodies' matrices, with elements."""
        if self._by_nodes:
            self._by_nodes.fill(self.corner)
            self._add(tangents)
            return
        for key, sources in self._sources.items():
            if key in self._blocks:
                self._blocks[key].set(tangents)
            else:
                self._fill_copy(key[0], sources, tangents)
        self.nest.assemble()
        # Without `out` the nest itself is converted.
        self.nest.convert("aij", out=self.corner)

    def _add(self, tangents: Sequence[FloatArray]) -> None:
        """Add elements' tangents to the operator's corner."""
        for (columns, numbers), tangent in zip(self._corner_numbers, tangents, strict=True):
            values = tangent[:, columns][:, :, columns]
            if self._by_nodes:
                node_blocks.add(self.corner, numbers, values)
            else:
                _add_block(self.corner, numbers, numbers, values)
        self.corner.assemble()

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
                    columns.append(np.arange(where.start, where.stop))
                    moved = own.to_system(fields.index(field), number)
                    numbers.append(np.where(number < 0, -1, moved))
            result.append((np.concatenate(columns), np.concatenate(numbers, axis=1).astype(int)))
        return result

    def _fill_copy(
        self, k: int, sources: Sequence[tuple[int, int, int]], tangents: Sequence[FloatArray]
    ) -> None:
        """Bring the copy of a body's matrix up to it and to elements within it. Collective."""
        body, a = self._bodies[k], self._copies[k]
        kinds = PETSc.Mat.Structure
        same = self._same.get(k, True)
        structure = kinds.SAME_NONZERO_PATTERN if same else kinds.DIFFERENT_NONZERO_PATTERN
        body.copy(a, structure=structure)
        a.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        for e, i, j in sources:
            element = self._elements[e]
            values = tangents[e][:, element.columns[i], element.columns[j]]
            _add_block(a, element.numbers[i], element.numbers[j], values)
        a.assemble()
        if k not in self._same:
            total = PETSc.Mat.InfoType.GLOBAL_SUM
            self._same[k] = a.getInfo(total)["nz_used"] == body.getInfo(total)["nz_used"]

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
        made = [self.corner, *self._constraints, *self._blocks.values(), *self._copies.values()]
        made += [self.operator] if self._split and self.operator else []
        made += [a for a in (self.nest, self._schur) if a]
        for a in made:
            a.destroy()


def _add_block(a: Any, rows: IntArray, cols: IntArray, values: FloatArray) -> None:
    """Add blocks (n, r, c) at rows (n, r) and columns (n, c); negative numbers are left out."""
    (n, num_rows), num_cols = rows.shape, cols.shape[1]
    a.setValuesIJV(
        np.arange(n * num_rows + 1, dtype=PETSc.IntType) * num_cols,
        np.repeat(cols, num_rows, axis=0).ravel().astype(PETSc.IntType),
        np.ascontiguousarray(values).ravel(),
        addv=PETSc.InsertMode.ADD_VALUES,
        rowmap=rows.ravel().astype(PETSc.IntType),
    )
