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
from dolfinx_nts.step import node_blocks

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
        pattern: Which entries of an element's tangent can be non-zero, shape (r, r); all of those
            that couple coordinates of bodies with anything.
    """

    fields: tuple[int, ...]
    columns: tuple[slice, ...]
    numbers: tuple[IntArray, ...]
    pattern: npt.NDArray[np.bool_]


class Entries(NamedTuple):
    """Entries of a batch of contact tangents, and where they stand in a matrix.

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
    """An AIJ matrix made of certain entries of the contact tangents, whoever owns their rows.

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


class SchurApproximation:
    """Schur complements D - C W B and D - C W A W B, approximate: see `linear_solver.SchurInverse`.

    They take the coordinates in contact alone: A is their block of the bodies' matrix, W the
    diagonal matrix of one over the sums of the moduli of its rows, D the contact's own block, B and
    C stand above and below.

    Args:
        rows: Index set of this rank's coordinates in contact, in the bodies' part.
        cols: Of its contact unknowns, in the contact's part.

    Attributes:
        first: D - C W B, after `renew`.
        second: D - C W A W B.
    """

    def __init__(self, rows: Any, cols: Any) -> None:
        self._rows, self._cols = rows, cols
        # Made when first needed, then kept with their patterns.
        self._near: Any = None
        self._inverse: Any = None
        self._above: Any = None
        self._below: Any = None
        self._between: Any = None
        self.first: Any = None
        self.second: Any = None

    def renew_bodies(self, bodies: Any) -> None:
        """Take A from the bodies' matrix. Collective."""
        if bodies.getType().endswith("baij"):
            # PETSc has no product of the two formats, nor renews a part of MPIBAIJ.
            square = bodies.createSubMatrix(self._rows, self._rows)
            self._near = square.convert("aij", out=self._near or PETSc.Mat())
            square.destroy()
        else:
            self._near = bodies.createSubMatrix(self._rows, self._rows, submat=self._near)
        if self._inverse is None:
            self._inverse = self._near.createVecLeft()
        pointer, _, values = self._near.getValuesCSR()
        self._inverse.array_w[:] = 1.0 / np.add.reduceat(np.abs(values), pointer[:-1])

    def renew(self, above: Any, below: Any, contact: Any) -> None:
        """Compute both complements from the other blocks, A as it is. Collective."""
        self._above = above.createSubMatrix(self._rows, self._cols, submat=self._above)
        self._below = below.createSubMatrix(self._cols, self._rows, submat=self._below)
        self._above.diagonalScale(self._inverse, None)
        self._between = self._near.matMult(self._above, result=self._between)
        self._between.diagonalScale(self._inverse, None)
        self.first = self._below.matMult(self._above, result=self.first)
        self.second = self._below.matMult(self._between, result=self.second)
        for product in (self.first, self.second):
            # All coordinates of an element are coupled with all its unknowns (`ElementBlocks`), so
            # that D's pattern lies in that of C W B.
            product.aypx(-1.0, contact, structure=PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for a in (
            self._rows, self._cols, self._near, self._inverse, self._above, self._below,
            self._between, self.first, self.second,
        ):  # fmt: skip
            if a:
                a.destroy()


class StepMatrix:
    """Nested Jacobian of the step problem, and the form of it that the solvers see.

    Args:
        layout: Fields of the problem.
        bodies: PETSc matrices of the body fields, which are not changed.
        elements: Unknowns of each batch of contact elements.
        split: Whether solvers see a nest of two fields, "bodies" and "constraints", from which a
            field split takes its blocks without a copy; else one matrix.
        blocked: Whether the bodies' part may be stored in the 3 x 3 blocks of nodes (BAIJ), with
            which a product takes a third of the time; few of PETSc's preconditioners take it. With
            contact it needs `split`.

    Attributes:
        nest: Blocks of the fields, as of the last fresh assembly, that are converted to one matrix:
            of all fields, or if split of the bodies; None if these are stored in blocks of nodes.
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
        # Bodies' matrices with room for contact within the body, which may fill more entries.
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
        self._contact = []
        for i, j in quarters:
            size = (layouts[i].num_owned, layouts[j].num_owned)
            parts = [self._entries(e, numbers[i][e], numbers[j][e]) for e in range(len(elements))]
            self._contact.append(Triplets(layout.comm, size, parts))
        self._by_nodes: node_blocks.NodeBlocks | None = None
        self._corner = PETSc.Mat()
        if found is not None:
            contact = [number for _, number in self._corner_numbers]
            self._by_nodes = node_blocks.NodeBlocks(bodies, found, layouts[0].to_system, contact)
            own = (self._by_nodes.size, None)
            self._corner.createBAIJ((own, own), 3, nnz=self._by_nodes.room, comm=layout.comm)
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
        """Add the contact tangents (n, r, r); refresh nest and operator.

        Args:
            tangents: Of each batch of elements.
            fresh: The bodies' matrices are without contact, newly assembled; else they are as the
                last call left them, and only the operator is changed.
        """
        if self.operator is None or fresh:
            self._renew(tangents)
            if self._schur is not None:
                self._schur.renew_bodies(self._corner)
        else:
            # On several ranks converting is slow. Outside an element's pattern its tangent is zero.
            self._corner.setOption(PETSc.Mat.Option.NEW_NONZERO_LOCATIONS, False)
            self._add([a - b for a, b in zip(tangents, self._in_operator, strict=True)])
        self._in_operator = list(tangents)
        for part in self._contact:
            part.set(tangents)
        if self.operator is None:
            self.operator = self._corner
            if self._split:
                b, c, d = (part.matrix for part in self._contact)
                grid = [[self._corner, b], [c, d]]
                self.operator = PETSc.Mat().createNest(grid, comm=self._layout.comm)
            self.operator.assemble()
        # To assemble a nest is to assemble its blocks, each with a message from all to all.
        self.operator.stateIncrease()

    def _renew(self, tangents: Sequence[FloatArray]) -> None:
        """Bring nest and operator's corner up to the bodies' matrices, with contact."""
        if self._by_nodes:
            self._by_nodes.fill(self._corner)
            self._add(tangents)
            return
        for key, sources in self._sources.items():
            if key in self._blocks:
                self._blocks[key].set(tangents)
            else:
                self._fill_copy(key[0], sources, tangents)
        self.nest.assemble()
        # Without `out` the nest itself is converted.
        self.nest.convert("aij", out=self._corner)

    def _add(self, tangents: Sequence[FloatArray]) -> None:
        """Add contact tangents to the operator's corner."""
        for (columns, numbers), tangent in zip(self._corner_numbers, tangents, strict=True):
            values = tangent[:, columns][:, :, columns]
            if self._by_nodes:
                node_blocks.add(self._corner, numbers, values)
            else:
                _add_block(self._corner, numbers, numbers, values)
        self._corner.assemble()

    def schur(self) -> SchurApproximation:
        """Approximate Schur complements of the contact unknowns, as the operator is. Collective.

        What they take of the bodies is of the first call or, if later, the last fresh assembly.
        """
        if self._schur is None:
            self._schur = SchurApproximation(*self._touched())
            self._schur.renew_bodies(self._corner)
        self._schur.renew(*(part.matrix for part in self._contact))
        return self._schur

    def _touched(self) -> tuple[Any, Any]:
        """Index sets of this rank's coordinates in contact and of its contact unknowns."""
        comm, mark = self._layout.comm, self._corner.createVecLeft()
        for _, numbers in self._corner_numbers:
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
        start, stop = self._contact[2].matrix.getOwnershipRange()
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
        """Bring the copy of a body's matrix up to it and to contact within the body. Collective."""
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
        made = [self._corner, *self._contact, *self._blocks.values(), *self._copies.values()]
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


def model_problem(
    comm: Any, *, constraint: bool
) -> tuple[Any, tuple[tuple[str, Any], tuple[str, Any]]]:
    """A chain of masses and springs, small but large enough for an algebraic multigrid.

    Args:
        comm: MPI communicator.
        constraint: Whether a multiplier holds the first mass of each rank.

    Returns:
        Its matrix, and the index sets "bodies" and "constraints" of its unknowns.
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
    return a, (("bodies", bodies), ("constraints", contact))


class Saddle:
    """Factors of a matrix by MUMPS, without equations that repeat others. Collective.

    Args:
        matrix: PETSc AIJ matrix.
    """

    def __init__(self, matrix: Any) -> None:
        self._x, self._b = matrix.createVecs()
        self._ksp = PETSc.KSP().create(matrix.getComm())
        self._ksp.setType("preonly")
        self._ksp.setOperators(matrix)
        pc = self._ksp.getPC()
        pc.setType("lu")
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        for option, value in ((14, 2000), (24, 1)):
            pc.getFactorMatrix().setMumpsIcntl(option, value)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of A x = right, owned entries. Collective."""
        self._b.array_w[:] = right
        self._ksp.solve(self._b, self._x)
        solution: FloatArray = self._x.array_r.copy()
        return solution

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        for a in (self._x, self._b, self._ksp):
            a.destroy()


class _Mass:
    """The mass of a body as a PETSc matrix, with zeros at prescribed coordinates."""

    def __init__(self, body: Any) -> None:
        self._body = body

    def mult(self, _matrix: Any, x: Any, y: Any) -> None:
        """M x."""
        y.array_w[:] = self._body.inertia(x.array_r.copy())
        y.array_w[self._body.fixed] = 0.0

    def getDiagonal(self, _matrix: Any, diagonal: Any) -> None:  # noqa: N802 (PETSc's name)
        """What serves as the diagonal for preconditioning."""
        diagonal.array_w[:] = self._body.nodal_mass


def solve_mass(body: Any, right: FloatArray) -> FloatArray:
    """Solution of M x = right, owned entries, zero at prescribed coordinates. Collective.

    Args:
        body: Its inertia is positive definite.
        right: Owned entries.
    """
    size = (body.num_owned, None)
    mass = PETSc.Mat().createPython((size, size), _Mass(body), comm=body.comm)
    mass.setUp()
    x, b = mass.createVecs()
    b.array_w[:] = right
    b.array_w[body.fixed] = 0.0
    ksp = PETSc.KSP().create(mass.getComm())
    ksp.setType("cg")
    ksp.getPC().setType("jacobi")
    ksp.setTolerances(rtol=1e-14, max_it=1000)
    ksp.setOperators(mass)
    ksp.solve(b, x)
    solution: FloatArray = x.array_r.copy()
    for a in (x, b, ksp, mass):
        a.destroy()
    return solution
