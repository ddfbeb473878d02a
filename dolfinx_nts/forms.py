"""Forms in UFL, compiled, and what is summed up with them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.kernels.cell_batches import CellBatches, Field, Shape, agrees, load

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float64]


def compile_forms(forms: Sequence[Any]) -> list[Any]:
    """Compile forms in UFL.

    Returns:
        A `CellForm` of each that has at most one argument, and DOLFINx's form of any other.
    """
    compiled = []
    for form in forms:
        made, source = compat.compile_form(form)
        compiled.append(made if len(form.arguments()) > 1 else CellForm(form, made, source))
    return compiled


class CellForm:
    """A compiled functional or linear form.

    Integrals over all cells of a mesh are evaluated for several cells at once; those over parts of
    it or over facets are DOLFINx's.

    Args:
        form: In UFL.
        compiled: By DOLFINx.
        source: FFCx's C code of it.
    """

    def __init__(self, form: Any, compiled: Any, source: Path) -> None:
        self._compiled = compiled
        self._batches = _batches(form, compiled, source)

    def add(self, values: FloatArray) -> None:
        """Add the linear form to this rank's values, ghosts included."""
        if self._batches is None:
            compat.add_vector(values, self._compiled)
        else:
            self._batches.add(compat.constants(self._compiled), values)

    def value(self) -> float:
        """The functional on this rank."""
        if self._batches is None:
            return float(fem.assemble_scalar(self._compiled))
        total = np.zeros(1)
        self.add(total)
        return float(total[0])


def _batches(form: Any, compiled: Any, source: Path) -> CellBatches | None:
    """What sums a form over the cells; None where nothing but DOLFINx can."""
    msh = compiled.mesh
    cells = msh.topology.index_map(msh.topology.dim).size_local
    over_cells = all(
        part.integral_type() == "cell" and part.subdomain_id() in ("everywhere", "otherwise")
        for part in form.integrals()
    )
    functions = compat.functions(form, compiled)
    spaces = [argument.ufl_function_space() for argument in form.arguments()]
    of_all = [*spaces, *(f.function_space for f in functions)]
    if not cells or not over_cells or any(compat.turns_dofs(space) for space in of_all):
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
    loop = load(source, shape, compat.chosen_flags())
    if loop is None:
        return None
    x, constants = msh.geometry.x, compat.constants(compiled)
    of_cell = [f.values.reshape(-1, f.size)[f.dofs[0]].ravel() for f in fields]
    first = np.concatenate([np.empty(0), *of_cell])
    if not agrees(loop, compat.cell_kernel(compiled), shape, x[nodes[0]], first, constants):
        logger.warning("%s differs for several cells at once; it is taken cell by cell", source)
        return None
    return CellBatches(loop, nodes, x, dofs, fields)


def assemble_vector(b: Any, form: CellForm) -> None:
    """Assemble a linear form into a ghosted PETSc vector, ghosts added to their owners."""
    with b.localForm() as here:
        here.set(0.0)
        form.add(here.array_w)
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
