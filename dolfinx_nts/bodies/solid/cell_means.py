"""Means in cells that stand in forms and depend on the displacement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from petsc4py import PETSc
from ufl.algorithms.analysis import extract_coefficients
from ufl.core.expr import Expr

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.solid.parameters import Taken, in_expressions
from dolfinx_nts.forms import CellForm, compile_forms
from dolfinx_nts.types import FloatArray


class _Mean(NamedTuple):
    """A Function of degree 0 and what it is the mean of.

    Attributes:
        function: The Function.
        expression: In UFL.
        taken: Its parameters, if it holds nothing else.
    """

    function: fem.Function
    expression: Expr
    taken: Taken | None


class EntriesOfCells:
    """Entries of linear forms in each of this rank's cells.

    Args:
        space: Of their test function, whose cells share no entries.
    """

    def __init__(self, space: fem.FunctionSpace) -> None:
        topology = space.mesh.topology
        self.cells, block = topology.index_map(topology.dim).size_local, space.dofmap.bs
        dofs = compat.cell_dofs(space)[: self.cells]
        shape = self.cells, block * dofs.shape[1]
        self._entries = (block * dofs[:, :, None] + np.arange(block)).reshape(shape)
        self._size = space.dofmap.index_map.size_local * space.dofmap.index_map_bs

    def __call__(self, form: CellForm) -> FloatArray:
        """Entries of a form, shape (cells, entries)."""
        values = np.zeros(self._size)
        form.add(values)
        return values[self._entries]


class CellMeans:
    """Functions of degree 0 that are the cells' means of expressions with the displacement.

    An expression may hold means that were made before it. What the displacement does to a form
    through them stays within the cells, so that matrices keep their entries.

    Args:
        mesh: DOLFINx mesh.
        dx: Measure of it.

    Attributes:
        dx: The measure.
        space: Function space of the means.
        sums: Entries of forms on it.
        volume: Of this rank's cells [m^3], shape (cells,), once compiled.
        moving: Numbers of the means that the unknown displacement changes, once compiled.
    """

    def __init__(self, mesh: Mesh, dx: Any) -> None:
        self.dx, self.space = dx, compat.function_space(mesh, "DG", 0)
        self.sums = EntriesOfCells(self.space)
        self.moving: list[int] = []
        self._means: list[_Mean] = []
        self._forms: list[CellForm] = []

    @property
    def functions(self) -> list[fem.Function]:
        """The means."""
        return [mean.function for mean in self._means]

    @property
    def expressions(self) -> list[Expr]:
        """What they are the means of."""
        return [mean.expression for mean in self._means]

    def mean(self, expression: Expr, *, given: bool = False) -> Expr:
        """A Function that is the mean of an expression once `evaluate` was called.

        Args:
            expression: In UFL.
            given: Whether it holds parameters alone.
        """
        function = fem.Function(self.space)
        taken = Taken(in_expressions([expression])) if given else None
        self._means.append(_Mean(function, expression, taken))
        return function

    def compile(self, unknown: Any) -> None:
        """Compile the means.

        Args:
            unknown: Displacement [m] that changes; what does not depend on it is evaluated by
                `evaluate(everything=True)` alone.
        """
        moving = {unknown}
        for k, mean in enumerate(self._means):
            if moving & set(extract_coefficients(mean.expression)):
                moving.add(mean.function)
                self.moving.append(k)
        q = ufl.TestFunction(self.space)
        own = [ufl.inner(mean.expression, q) * self.dx for mean in self._means]
        volume, *self._forms = compile_forms([ufl.as_ufl(1.0) * q * self.dx, *own])
        self.volume = self.sums(volume)[:, 0]
        for k, mean in enumerate(self._means):
            if mean.taken is not None:
                self.set(k, self.sums(self._forms[k])[:, 0])

    def evaluate(self, *, everything: bool = True) -> None:
        """Give the means their values at the displacements of now.

        Args:
            everything: Also what does not depend on the unknown displacement.
        """
        for k, form in enumerate(self._forms):
            taken, due = self._means[k].taken, k in self.moving
            if everything and not due:
                due = taken is None or taken.changed
            if due:
                self.set(k, self.sums(form)[:, 0])
            if due and taken is not None:
                taken.take()

    def set(self, k: int, sums: FloatArray) -> None:
        """Give a mean its values, from integrals over this rank's cells, shape (cells,)."""
        self._means[k].function.x.array[: self.sums.cells] = sums / self.volume

    def derivatives(self, k: int, unknown: Any, apart: Any, one: Any) -> dict[int, CellForm]:
        """Derivatives of a mean times the cells' volumes.

        Args:
            k: Its number.
            unknown: The displacement.
            apart: Test function of displacements in each cell.
            one: Function of degree 0 that is 1.

        Returns:
            By the displacement (-1), and by the means before it (their numbers) that it holds.
        """
        expression, q = self._means[k].expression, ufl.TestFunction(self.space)
        held = set(extract_coefficients(expression))
        forms = {-1: ufl.derivative(expression * self.dx, unknown, apart)}
        for j in self.moving[: self.moving.index(k)]:
            function = self._means[j].function
            if function in held:
                forms[j] = ufl.derivative(expression * q * self.dx, function, one)
        return dict(zip(forms, compile_forms(list(forms.values())), strict=True))


class NodesOfCells:
    """What each of this rank's cells adds to the coordinates of its nodes.

    Args:
        space: Function space of the displacements.

    Attributes:
        space: Of displacements in each cell apart: a linear form with a test function in it is
            summed over no cells.
        entries: Of such a form, shape (cells, coordinates of a cell).
        dofs: Coordinates of this rank that belong to them.
    """

    def __init__(self, space: fem.FunctionSpace) -> None:
        degree = compat.lagrange_degree(space)
        assert degree is not None
        self.space = compat.function_space(space.mesh, "DG", degree, (3,))
        self.entries = EntriesOfCells(self.space)
        nodes = compat.cell_dofs(space)[: self.entries.cells].astype(PETSc.IntType)
        coordinates = 3 * nodes[:, :, None] + np.arange(3, dtype=PETSc.IntType)
        self.dofs = coordinates.reshape(len(nodes), 3 * nodes.shape[1])
        index_map = space.dofmap.index_map
        self._size = 3 * (index_map.size_local + index_map.num_ghosts)

    def add(self, matrix: PETSc.Mat, blocks: FloatArray, masks: Sequence[Any]) -> None:
        """Add a block of each cell to a matrix of the body. Collective.

        Args:
            matrix: The matrix.
            blocks: Shape (cells, coordinates of a cell, coordinates of a cell); changed.
            masks: DOLFINx conditions whose rows and columns are left out.
        """
        free = np.ones(self._size)
        for mask in masks:
            free[mask.dof_indices()[0]] = 0.0
        free = free[self.dofs]
        blocks *= free[:, :, None] * free[:, None, :]
        dofs, width = self.dofs, self.dofs.shape[1]
        start = np.arange(dofs.size + 1, dtype=PETSc.IntType) * width
        matrix.setValuesLocalIJV(
            start, np.repeat(dofs, width, axis=0).ravel(), blocks.ravel(),
            addv=PETSc.InsertMode.ADD_VALUES, rowmap=dofs.ravel(),
        )  # fmt: skip
        matrix.assemble()


class WithinCells(Protocol):
    """A linear form of displacements and of what follows from them within each cell."""

    @property
    def inner(self) -> FloatArray:
        """What a step goes on from at its end, of this rank's cells, see `Body.inner`."""

    def begin(self, inner: FloatArray | None) -> None:
        """Set the state at t_n, as that of the displacement is; None: that of a body at rest."""

    def move(self) -> None:
        """Evaluate what follows from the displacement at t_{n+1}, which has been set."""

    def add(self, values: FloatArray) -> None:
        """Add the form to this rank's values, ghosts included."""

    def add_to(self, matrix: PETSc.Mat, factor: float, masks: Sequence[Any]) -> None:
        """Add what the displacement does through it, as evaluated last. Collective.

        Args:
            matrix: Derivative of the form with what is in the cells as it is.
            factor: Of what is added.
            masks: DOLFINx conditions whose rows and columns are left out.
        """


class FormWithMeans:
    """A linear form that holds means in cells, and its derivative by the displacement.

    Args:
        means: What the form holds, none of them compiled.
        form: In UFL.
        w: Its test function, on the space of the displacements.
        unknown: The displacement.
    """

    def __init__(self, means: CellMeans, form: Any, w: Any, unknown: Any) -> None:
        self._means = means
        means.compile(unknown)
        self._nodes = NodesOfCells(w.ufl_function_space())
        apart, one = ufl.TestFunction(self._nodes.space), fem.Function(means.space)
        one.x.array[:] = 1.0
        work = ufl.replace(form, {w: apart})
        pushes = [ufl.derivative(work, means.functions[k], one) for k in means.moving]
        self._form, *self._pushes = compile_forms([form, *pushes])
        self._derivatives = [means.derivatives(k, unknown, apart, one) for k in means.moving]

    @property
    def inner(self) -> FloatArray:
        """Nothing: means follow from the displacement alone."""
        return np.empty(0)

    def begin(self, inner: FloatArray | None) -> None:
        """Evaluate all means."""
        self._means.evaluate()

    def move(self) -> None:
        """Evaluate the means that the displacement at t_{n+1} changes."""
        self._means.evaluate(everything=False)

    def add(self, values: FloatArray) -> None:
        """Add the form to this rank's values, ghosts included."""
        self._form.add(values)

    def add_to(self, matrix: PETSc.Mat, factor: float, masks: Sequence[Any]) -> None:
        """As of `WithinCells`."""
        means, of_nodes = self._means, self._nodes.entries
        rows: dict[int, FloatArray] = {}
        added: FloatArray | float = 0.0
        for k, of, forms in zip(means.moving, self._pushes, self._derivatives, strict=True):
            push, row = of_nodes(of), of_nodes(forms[-1])
            for j in forms.keys() - {-1}:
                row += means.sums(forms[j]) * rows[j]
            rows[k] = row / means.volume[:, None]
            added = added + push[:, :, None] * (factor * rows[k])[:, None, :]
        self._nodes.add(matrix, np.asarray(added), masks)
