"""Forms in UFL, compiled, and what is summed up with them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.kernels import library
from dolfinx_nts.kernels.cell_batches import CellBatches, Field, Shape, difference, load
from dolfinx_nts.types import FloatArray, IntArray

logger = logging.getLogger(__name__)


def compile_forms(forms: Sequence[Any]) -> list[Any]:
    """Compile forms in UFL.

    Returns:
        A `CellForm` of each that has at most one argument, and DOLFINx's form of any other.
    """
    both = zip(forms, compat.compile_forms(forms), strict=True)
    return [
        made if len(form.arguments()) > 1 else CellForm(made, source, _cells(form, made))
        for form, (made, source) in both
    ]


class _Cells(NamedTuple):
    """What a form over all cells of a mesh is evaluated with; arrays as of `CellBatches`."""

    shape: Shape
    nodes: IntArray
    x: FloatArray
    dofs: IntArray
    fields: list[Field]


def _cells(form: Any, compiled: Any) -> _Cells | None:
    """What a form is evaluated with for several cells at once; None where DOLFINx does better.

    It does over facets and parts of a mesh, and without Functions a form is hardly evaluated again.
    """
    over_cells = all(
        part.integral_type() == "cell" and part.subdomain_id() in ("everywhere", "otherwise")
        for part in form.integrals()
    )
    functions = compat.functions(form, compiled)
    spaces = [argument.ufl_function_space() for argument in form.arguments()]
    of_all = [*(f.function_space for f in functions), *spaces]
    elsewhere = any(space.ufl_domain() != form.ufl_domain() for space in of_all)
    if not functions or not over_cells or elsewhere:
        return None
    msh = of_all[0].mesh
    cells = msh.topology.index_map(msh.topology.dim).size_local
    all_dofs = [compat.plain_dofs(space, cells) for space in of_all]
    blocks = [space.dofmap.bs for space in of_all]
    if not spaces:
        # A functional adds all cells to one entry.
        all_dofs.append(np.zeros((cells, 1), dtype=np.int32))
        blocks.append(1)
    known = [dofs for dofs in all_dofs if dofs is not None]
    if not cells or len(known) < len(all_dofs):
        return None
    fields = [Field(f.x.array, *of) for f, *of in zip(functions, known, blocks, strict=False)]
    nodes, dofs, block = compat.geometry_dofmap(msh)[:cells], known[-1], blocks[-1]
    width = sum(field.dofs.shape[1] * field.size for field in fields)
    shape = Shape(3 * nodes.shape[1], width, block * dofs.shape[1], block)
    return _Cells(shape, nodes, msh.geometry.x, dofs, fields)


class CellForm:
    """A compiled functional or linear form, evaluated for several cells at once where that can be.

    Args:
        compiled: By DOLFINx.
        source: FFCx's C code of it.
        cells: What it is evaluated with; None: DOLFINx evaluates it.
    """

    def __init__(self, compiled: Any, source: Path, cells: _Cells | None) -> None:
        self._compiled, self._source, self._cells = compiled, source, cells
        if cells is not None:
            # The C compiler works beside FFCx, which is busy with the next form.
            self._loop = library.Beside(_load, source, cells.shape, tuple(compat.chosen_flags()))
            of_cell = [f.values.reshape(-1, f.size)[f.dofs[0]].ravel() for f in cells.fields]
            self._first = np.concatenate(of_cell), compat.constants(compiled)

    @cached_property
    def batches(self) -> CellBatches | None:
        """What sums it over the cells; None where DOLFINx does."""
        if self._cells is None:
            return None
        shape, nodes, x, *_ = self._cells
        kernel, level = compat.cell_kernel(self._compiled), logging.WARNING
        try:
            loop = self._loop.result()
            why = difference(loop, kernel, shape, x[nodes[0]], *self._first)
        except library.NotMadeError as error:
            why, level = str(error), logging.INFO
        if why:
            text = "the kernel of %s for several cells at once is not used, but that for one: %s"
            logger.log(level, text, self._source, why)
            return None
        return CellBatches(loop, *self._cells[1:])

    def add(self, values: FloatArray) -> None:
        """Add the linear form to this rank's values, ghosts included."""
        if self.batches is None:
            petsc_compat.add_vector(values, self._compiled)
        else:
            self.batches.add(compat.constants(self._compiled), values)

    def value(self) -> float:
        """The functional on this rank."""
        if self.batches is None:
            return float(fem.assemble_scalar(self._compiled))
        total = np.zeros(1)
        self.add(total)
        return float(total[0])


@lru_cache
def _load(source: Path, shape: Shape, flags: tuple[str, ...]) -> Any:
    """As `load`, from a file and beside it."""
    try:
        code = source.read_text()
    except OSError as error:
        raise library.NotMadeError(str(error)) from error
    return load(code, shape, source.parent, flags)


def assemble_vector(b: Any, form: CellForm) -> None:
    """Assemble a linear form into a ghosted PETSc vector, ghosts added to their owners."""
    with b.localForm() as here:
        here.set(0.0)
        form.add(here.array_w)
    petsc_compat.sum_ghosts(b)
