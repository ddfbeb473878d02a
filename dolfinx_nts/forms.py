"""Forms in UFL, compiled, and what is summed up with them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.kernels import library
from dolfinx_nts.kernels.cell_batches import CellBatches, Field, Shape, agrees, load

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]


def compile_forms(forms: Sequence[Any]) -> list[Any]:
    """Compile forms in UFL.

    Returns:
        A `CellForm` of each that has at most one argument, and DOLFINx's form of any other.
    """
    compiled = []
    for form in forms:
        made, source = compat.compile_form(form)
        if len(form.arguments()) <= 1:
            cells = _cells(form, made)
            # The C compiler works beside FFCx, which is busy with the next form.
            loop = cells and library.beside.submit(_load, source, cells.shape)
            made = CellForm(made, source, cells, loop)
        compiled.append(made)
    return compiled


def _load(source: Path, shape: Shape) -> Any:
    """As `load`, from a file."""
    try:
        return load(source.read_text(), shape, compat.chosen_flags())
    except OSError as error:
        logger.debug("%s is taken cell by cell: %s", source, error)
        return None


class _Cells(NamedTuple):
    """What a form over all cells of a mesh is evaluated with; arrays as of `CellBatches`."""

    shape: Shape
    nodes: IntArray
    x: FloatArray
    dofs: IntArray
    fields: list[Field]

    def arguments_of_first(self) -> tuple[FloatArray, FloatArray]:
        """Coordinates of the first cell and its values of all Functions."""
        of_cell = [f.values.reshape(-1, f.size)[f.dofs[0]].ravel() for f in self.fields]
        return self.x[self.nodes[0]], np.concatenate(of_cell)


def _cells(form: Any, compiled: Any) -> _Cells | None:
    """What a form is evaluated with for several cells at once; None where DOLFINx does better.

    It does over facets and parts of a mesh, and without Functions a form is hardly evaluated again.
    """
    msh = compiled.mesh
    cells = msh.topology.index_map(msh.topology.dim).size_local
    over_cells = all(
        part.integral_type() == "cell" and part.subdomain_id() in ("everywhere", "otherwise")
        for part in form.integrals()
    )
    functions = compat.functions(form, compiled)
    spaces = [argument.ufl_function_space() for argument in form.arguments()]
    turned = any(compat.turns_dofs(s) for s in (*spaces, *(f.function_space for f in functions)))
    if not cells or not functions or not over_cells or turned:
        return None
    nodes = compat.geometry_dofmap(msh)[:cells]
    # A functional adds all cells to one entry.
    dofs, block = np.zeros((cells, 1), dtype=np.int32), 1
    if spaces:
        dofs, block = compat.cell_dofs(spaces[0])[:cells], spaces[0].dofmap.bs
    fields = [
        Field(f.x.array, compat.cell_dofs(f.function_space)[:cells], f.function_space.dofmap.bs)
        for f in functions
    ]
    width = sum(field.dofs.shape[1] * field.size for field in fields)
    shape = Shape(3 * nodes.shape[1], width, block * dofs.shape[1], block)
    return _Cells(shape, nodes, msh.geometry.x, dofs, fields)


class CellForm:
    """A compiled functional or linear form, evaluated for several cells at once where that can be.

    Args:
        compiled: By DOLFINx.
        source: FFCx's C code of it.
        cells: What it is evaluated with; None: DOLFINx evaluates it.
        loop: Future of what `load` returns.
    """

    def __init__(self, compiled: Any, source: Path, cells: _Cells | None, loop: Any) -> None:
        self._compiled, self._source, self._cells, self._loop = compiled, source, cells, loop

    @cached_property
    def batches(self) -> CellBatches | None:
        """What sums it over the cells; None where DOLFINx does."""
        loop = self._cells and self._loop.result()
        if self._cells is None or loop is None:
            return None
        x, first = self._cells.arguments_of_first()
        kernel, constants = compat.cell_kernel(self._compiled), compat.constants(self._compiled)
        if not agrees(loop, kernel, self._cells.shape, x, first, constants):
            text = "%s differs for several cells at once; it is taken cell by cell"
            logger.warning(text, self._source)
            return None
        return CellBatches(loop, *self._cells[1:])

    def add(self, values: FloatArray) -> None:
        """Add the linear form to this rank's values, ghosts included."""
        if self.batches is None:
            compat.add_vector(values, self._compiled)
        else:
            self.batches.add(compat.constants(self._compiled), values)

    def value(self) -> float:
        """The functional on this rank."""
        if self.batches is None:
            return float(fem.assemble_scalar(self._compiled))
        total = np.zeros(1)
        self.add(total)
        return float(total[0])


def assemble_vector(b: Any, form: CellForm) -> None:
    """Assemble a linear form into a ghosted PETSc vector, ghosts added to their owners."""
    with b.localForm() as here:
        here.set(0.0)
        form.add(here.array_w)
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
