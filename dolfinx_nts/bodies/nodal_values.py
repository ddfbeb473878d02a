"""Nodes of a body: their values that users give, and their order; values in its cells."""

from __future__ import annotations

import re
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.parallel import gather_on_root, global_max, raise_together
from dolfinx_nts.types import FloatArray, IntArray
from dolfinx_nts.validation import UserFunctionError, at_points, vector


def motion_on(space: fem.FunctionSpace, name: str) -> tuple[fem.Function, fem.Function]:
    """Functions for the displacement and the velocity of a body of this name."""
    stem = re.sub(r"\W", "_", name, flags=re.ASCII)  # DOLFINx makes C identifiers of the names
    return fem.Function(space, name=f"{stem}_u"), fem.Function(space, name=f"{stem}_v")


def nodal_values(
    space: fem.FunctionSpace, name: str, body: str, given: Any, unit: str
) -> FloatArray:
    """Values of a vector field at all nodes of this rank, shape (nodes, 3). Collective.

    Args:
        space: Lagrange space of 3-vectors.
        name: Of the argument.
        body: Name of the body.
        given: A vector, a callable x (3, n) -> (3, n), or a Function of vectors.
        unit: Its unit, for messages.
    """
    x = space.tabulate_dof_coordinates()
    if isinstance(given, fem.Function) and given.ufl_shape == (3,):
        return at_nodes(space, f"{name}={given!s} of {body!r}", given)
    if callable(given) and not hasattr(given, "ufl_shape"):
        # The nodes of Lagrange elements are their interpolation points.
        return at_points(space.mesh.comm, f"{name} of {body!r}", given, x.T, (3,)).T
    else_ = "a callable x (3, n) -> (3, n), or a Function of vectors"
    return np.tile(vector(name, given, unit, or_else=else_), (len(x), 1))


def at_nodes(space: fem.FunctionSpace, what: str, value: Any) -> FloatArray:
    """Values of a Function of vectors at all nodes of this rank, shape (nodes, 3). Collective.

    Args:
        space: Lagrange space of 3-vectors.
        what: Argument and its value.
        value: The Function.

    Raises:
        ValueError: It is on another mesh, of another kind of space, or not finite.
    """
    if value.function_space.mesh.ufl_domain() != space.mesh.ufl_domain():
        raise ValueError(f"{what}: is on another mesh; make it on that of the body")
    if compat.lagrange_degree(value.function_space) is None:
        raise ValueError(
            f"{what}: may have several values at a node; interpolate it into a continuous space, "
            "one of Lagrange elements for 3-vectors"
        )
    here = fem.Function(space)
    here.interpolate(value)
    found: FloatArray = here.x.array.reshape(-1, 3)
    bad = not np.isfinite(found).all()
    text = f"{what}: is not finite; check it for NaN"
    raise_together(space.mesh.comm, text if bad else None, UserFunctionError)
    return found


def cell_function(mesh: Mesh, name: str, values: FloatArray) -> fem.Function:
    """Function of degree 0 from values in this rank's cells, (n, 3) or (n, 3, 3). Collective."""
    function = fem.Function(compat.function_space(mesh, "DG", 0, values.shape[1:]), name=name)
    of_cells = compat.cell_dofs(function.function_space)[: len(values), 0]
    rows = values.reshape(len(values), 3 ** (values.ndim - 1))
    function.x.array.reshape(-1, rows.shape[1])[of_cells] = rows
    function.x.scatter_forward()
    return function


def order_of_input(space: fem.FunctionSpace) -> IntArray:
    """Nodes in the order in which the cells of the input name them, on rank 0. Collective."""
    mesh, index_map = space.mesh, space.dofmap.index_map
    owned = mesh.topology.index_map(mesh.topology.dim).size_local
    cells = compat.cell_dofs(space)[:owned]
    nodes = index_map.local_to_global(cells.ravel().astype(np.int32)).reshape(cells.shape)
    original = np.asarray(mesh.topology.original_cell_index[:owned], dtype=np.int64)
    order = np.argsort(gather_on_root(mesh.comm, original))
    _, first = np.unique(gather_on_root(mesh.comm, nodes)[order], return_index=True)
    return np.argsort(first)


def largest_side(comm: MPI.Comm, reference: FloatArray) -> float:
    """Of the box around nodes of all ranks [m], from their coordinates. Collective."""
    x = reference.reshape(-1, 3)
    ends = np.array([x.max(axis=0, initial=-np.inf), (-x).max(axis=0, initial=-np.inf)])
    return float(global_max(comm, ends).sum(axis=0).max())
