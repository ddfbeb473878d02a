"""Means in cells that stand in forms and depend on the displacement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc
from ufl.algorithms.analysis import extract_coefficients
from ufl.core.expr import Expr

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.solid.parameters import Taken, in_expressions
from dolfinx_nts.forms import CellForm, compile_forms
from dolfinx_nts.types import FloatArray


class CellMeans:
    """Functions of degree 0 that are the cells' means of expressions with the displacement.

    An expression may hold means that were made before it. What the displacement does to a form
    through them stays within the cells, so that matrices keep their entries.

    Args:
        space: Function space of the displacements.
        dx: Measure of the mesh.

    Attributes:
        functions: The means.
    """

    def __init__(self, space: fem.FunctionSpace, dx: Any) -> None:
        self._space, self._dx = space, dx
        self._constant = compat.function_space(space.mesh, "DG", 0)
        self._expressions: list[Expr] = []
        self.functions: list[fem.Function] = []
        self._taken: list[Taken | None] = []
        self._compiled: list[Any] = []
        self._moving: list[int] = []

    def mean(self, expression: Expr, *, given: bool = False) -> Expr:
        """A Function that is the mean of an expression once `evaluate` was called.

        Args:
            expression: In UFL.
            given: Whether it holds parameters alone.
        """
        self._expressions.append(expression)
        self.functions.append(fem.Function(self._constant))
        self._taken.append(Taken(in_expressions([expression])) if given else None)
        return self.functions[-1]

    # ---- values
    def compile(self, unknown: Any) -> None:
        """Compile the means.

        Args:
            unknown: Displacement [m] that changes; what does not depend on it is evaluated by
                `evaluate(everything=True)` alone.
        """
        q, moving = ufl.TestFunction(self._constant), {unknown}
        for k, expression in enumerate(self._expressions):
            if moving & set(extract_coefficients(expression)):
                moving.add(self.functions[k])
                self._moving.append(k)
        own = [ufl.inner(expression, q) * self._dx for expression in self._expressions]
        volume, *self._compiled = compile_forms([ufl.as_ufl(1.0) * q * self._dx, *own])
        self._volume = self._of_cells(volume)
        for k, taken in enumerate(self._taken):
            if taken is not None:
                self._take(k)

    def evaluate(self, *, everything: bool = True) -> None:
        """Give the means their values at the displacements of now.

        Args:
            everything: Also what does not depend on the unknown displacement.
        """
        each = zip(self.functions, self._compiled, self._taken, strict=True)
        for k, (function, form, taken) in enumerate(each):
            if taken is None and (everything or k in self._moving):
                function.x.array[: len(self._volume)] = self._of_cells(form) / self._volume
            elif taken is not None and everything and taken.changed:
                self._take(k)

    def _take(self, k: int) -> None:
        """Evaluate a mean of parameters."""
        taken = self._taken[k]
        assert taken is not None
        taken.take()
        values = self.functions[k].x.array
        values[: len(self._volume)] = self._of_cells(self._compiled[k]) / self._volume

    def _of_cells(self, form: CellForm) -> FloatArray:
        """A linear form of degree 0 in this rank's cells, in their order, shape (cells,)."""
        values = np.zeros(self._constant.dofmap.index_map.size_local)
        form.add(values)
        return values

    # ---- derivatives
    def compile_derivatives(self, unknown: Any, work: Any, w: Any) -> None:
        """Compile the derivatives through the means of a linear form.

        Args:
            unknown: Displacement that changes.
            work: The form.
            w: Its test function.
        """
        mesh, count = self._space.mesh, mesh_cells(self._space.mesh)
        degree = compat.lagrange_degree(self._space)
        assert degree is not None
        # Entries of a linear form with such a test function are those of each cell alone.
        broken = compat.function_space(mesh, "DG", degree, (3,))
        apart, q = ufl.TestFunction(broken), ufl.TestFunction(self._constant)
        self._dofs = compat.cell_dofs(broken)[:count]
        self._nodes = compat.cell_dofs(self._space)[:count].astype(PETSc.IntType)
        one = fem.Function(self._constant)
        one.x.array[:] = 1.0
        work, forms, self._chain = ufl.replace(work, {w: apart}), [], []
        for k in self._moving:
            expression, function = self._expressions[k], self.functions[k]
            forms.append(ufl.derivative(expression * self._dx, unknown, apart))
            forms.append(ufl.derivative(work, function, one))
            earlier = [j for j in self._moving if j < k]
            held = set(extract_coefficients(expression))
            links = [j for j in earlier if self.functions[j] in held]
            self._chain.append(links)
            for j in links:
                forms.append(ufl.derivative(expression * q * self._dx, self.functions[j], one))
        self._derivatives = compile_forms(forms)
        self._broken_size = 3 * broken.dofmap.index_map.size_local

    def add_to(self, matrix: PETSc.Mat, factor: float, masks: Sequence[Any]) -> None:
        """Add to a matrix what the displacement does through the means. Collective.

        Args:
            matrix: Derivative of the form with the means as they are.
            factor: Of what is added.
            masks: DOLFINx conditions whose rows and columns are left out.
        """
        free, forms = np.ones(3 * self._space_nodes()), iter(self._derivatives)
        for mask in masks:
            free[mask.dof_indices()[0]] = 0.0
        free = free.reshape(-1, 3)[self._nodes].reshape(len(self._nodes), -1)
        rows: dict[int, FloatArray] = {}
        width = free.shape[1]
        added = np.zeros((len(free), width, width))
        for k, links in zip(self._moving, self._chain, strict=True):
            row, push = self._apart(next(forms)), self._apart(next(forms))
            for j in links:
                row += self._of_cells(next(forms))[:, None] * rows[j]
            rows[k] = row
            row /= self._volume[:, None]
            added += push[:, :, None] * row[:, None, :]
        added *= factor * free[:, :, None] * free[:, None, :]
        nodes = self._nodes
        # One row of blocks for each node of each cell.
        blocks = added.reshape(-1, nodes.shape[1], 3, nodes.shape[1], 3).swapaxes(2, 3)
        start = np.arange(nodes.size + 1, dtype=PETSc.IntType) * nodes.shape[1]
        cols = np.repeat(nodes, nodes.shape[1], axis=0)
        matrix.setValuesBlockedLocalIJV(
            start, cols.ravel(), blocks.ravel(), addv=PETSc.InsertMode.ADD_VALUES,
            rowmap=nodes.ravel(),
        )  # fmt: skip
        matrix.assemble()

    def _space_nodes(self) -> int:
        index_map = self._space.dofmap.index_map
        return int(index_map.size_local + index_map.num_ghosts)

    def _apart(self, form: CellForm) -> FloatArray:
        """A linear form's entries of each cell, shape (cells, coordinates of a cell)."""
        values = np.zeros(self._broken_size)
        form.add(values)
        return values.reshape(-1, 3)[self._dofs].reshape(len(self._dofs), -1)


def mesh_cells(mesh: Any) -> int:
    """Number of this rank's own cells."""
    return int(mesh.topology.index_map(mesh.topology.dim).size_local)
