"""Nodes of a mesh with directors, and its cells, as every rank knows them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.arrays import FloatArray, IntArray
from dolfinx_nts.parallel import gather_rows


class DirectorMesh(NamedTuple):
    """A line or surface in the reference, the same on all ranks; axis 0 = node where not told.

    Attributes:
        x: Nodes in the global numbering [m], shape (n, 3).
        order: Nodes in the order of files, shape (n,).
        cells: Nodes of the cells of all ranks in rank order, oriented, shape (c, corners).
        directors: Unit vectors, shape (n, d, 3).
        edges: Nodes of lines along which loads per length act, neighbours, shape (e, 2 or 3).
        lengths: Of each line what its nodes bear [m], as `edges`.
    """

    x: FloatArray
    order: IntArray
    cells: IntArray
    directors: FloatArray
    edges: IntArray
    lengths: FloatArray


def nodes_and_cells(space: Any) -> tuple[FloatArray, IntArray, IntArray]:
    """Nodes and cells of a mesh on all ranks. Collective.

    Args:
        space: Lagrange space of degree 1 on it, or of 2 on intervals.

    Returns:
        Nodes [m], (n, 3), nodes of the cells in DOLFINx's order, (c, corners), and numbers of the
        nodes in the user's input, (n,), -1 of those that it does not have.
    """
    mesh, comm, index_map = space.mesh, space.mesh.comm, space.dofmap.index_map
    owned, own_cells = index_map.size_local, mesh.topology.index_map(mesh.topology.dim).size_local
    x = gather_rows(comm, space.tabulate_dof_coordinates()[:owned])
    dofs = compat.cell_dofs(space)[:own_cells]
    numbers = index_map.local_to_global(dofs.ravel().astype(np.int32)).reshape(dofs.shape)
    cells = gather_rows(comm, np.asarray(numbers, dtype=np.int64))
    blocks = compat.node_blocks(mesh, space)
    here = (blocks >= 0) & (blocks < owned)
    given = np.full(owned, -1, dtype=np.int64)
    given[blocks[here]] = np.asarray(mesh.geometry.input_global_indices)[here]
    return x, cells, gather_rows(comm, given)
