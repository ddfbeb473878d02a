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
from dolfinx_nts.kernels.cell_batches import CellBatches, Shape, agrees, load

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
        self.compiled = compiled
        self._batches: CellBatches | None = None
        spaces = [argument.ufl_function_space() for argument in form.arguments()]
        over_cells = all(
            part.integral_type() == "cell" and part.subdomain_id() in ("everywhere", "otherwise")
            for part in form.integrals()
        )
        if over_cells and not any(compat.turns_dofs(space) for space in spaces):
            self._batches = _batches(compiled, spaces, source)

    def add(self, values: FloatArray) -> None:
        """Add the linear form to this rank's values, ghosts included."""
        if self._batches is None:
            compat.add_vector(values, self.compiled)
        else:
            self._batches.add(*compat.packed(self.compiled), values)

    def value(self) -> float:
        """The functional on this rank."""
        if self._batches is None:
            return float(fem.assemble_scalar(self.compiled))
        total = np.zeros(1)
        self.add(total)
        return float(total[0])


def _batches(compiled: Any, spaces: Sequence[Any], source: Path) -> CellBatches | None:
    """What sums a form over a mesh's cells; None where nothing but DOLFINx can."""
    msh = compiled.mesh
    cells = msh.topology.index_map(msh.topology.dim).size_local
    if not cells:
        return None
    coefficients, constants = compat.packed(compiled)
    nodes = compat.geometry_dofmap(msh)[:cells]
    # A functional adds all cells to one entry.
    dofs, block = np.zeros((cells, 1), dtype=np.int32), 1
    if spaces:
        dofs, block = compat.cell_dofs(spaces[0])[:cells], spaces[0].dofmap.index_map_bs
    width = 0 if coefficients is None else coefficients.shape[1]
    shape = Shape(3 * nodes.shape[1], width, block * dofs.shape[1], block)
    loop = load(source, shape, compat.chosen_flags())
    if loop is None:
        return None
    x = msh.geometry.x
    of_cell = np.zeros(0) if coefficients is None else coefficients[0]
    kernel = compat.cell_kernel(compiled)
    if not agrees(loop, kernel, shape, x[nodes[0]], of_cell, constants):
        logger.warning("%s differs for several cells at once; it is taken cell by cell", source)
        return None
    return CellBatches(loop, nodes, x, dofs)


def assemble_vector(b: Any, form: CellForm) -> None:
    """Assemble a linear form into a ghosted PETSc vector, ghosts added to their owners."""
    with b.localForm() as here:
        here.set(0.0)
        form.add(here.array_w)
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
