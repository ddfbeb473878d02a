"""Nodes of a mesh with directors, its cells, and its whole skin, as every rank knows them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import FloatArray, IntArray


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


def nodes_and_cells(space: fem.FunctionSpace) -> tuple[FloatArray, IntArray, IntArray]:
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


#: Parts of a shell's skin.
SIDES = ("bottom", "top", "edge")


class WholeSkin(NamedTuple):
    """A closed skin, the same on all ranks; the points of a node follow each other.

    Attributes:
        node: Node of each point, shape (p,).
        weights: Of the node's vectors, shape (p, vectors).
        original: Number of each point, whatever the partition, shape (p,).
        facets: Corners, cyclic and counter-clockwise seen from outside, shape (m, 4).
        part: Of each facet, of a shell as of `SIDES`, of a beam 0, shape (m,).
    """

    node: IntArray
    weights: FloatArray
    original: IntArray
    facets: IntArray
    part: IntArray


def _ranked(director_mesh: DirectorMesh) -> IntArray:
    """Number of each node in the order of files."""
    rank = np.empty_like(director_mesh.order)
    rank[director_mesh.order] = np.arange(len(rank))
    return rank


def of_shell(director_mesh: DirectorMesh) -> WholeSkin:
    """Skin of a shell: phi - D, then phi + D of each node."""
    cells, edges, n = director_mesh.cells, director_mesh.edges, len(director_mesh.x)
    a, b = edges.T
    facets = [
        2 * cells[:, ::-1], 2 * cells + 1, np.stack([2 * a, 2 * b, 2 * b + 1, 2 * a + 1], axis=1)
    ]  # fmt: skip
    point = np.arange(2 * n)
    weights = np.column_stack([np.ones(2 * n), 2.0 * (point % 2) - 1.0])
    original = (2 * _ranked(director_mesh)[:, None] + np.arange(2)).ravel()
    part = np.repeat(np.arange(3), [len(f) for f in facets])
    return WholeSkin(point // 2, weights, original, np.concatenate(facets), part)


def of_beam(director_mesh: DirectorMesh, outline: FloatArray) -> WholeSkin:
    """Skin of a beam: polygons at its nodes, and at its ends fans about their centres.

    Args:
        director_mesh: Nodes.
        outline: Corners of the polygon over the directors' length, counter-clockwise, an even
            number, shape (k, 2).
    """
    k, n, cells = len(outline), len(director_mesh.x), director_mesh.cells
    corner, following = np.arange(k), np.roll(np.arange(k), -1)
    starts, stops = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    a, b = ((k + 1) * ends[:, None] for ends in (starts, stops))
    facets = [np.stack([a + corner, a + following, b + following, b + corner], axis=-1)]
    every = np.arange(n)
    fan = np.stack([np.full(k // 2, k), *(np.roll(corner, -i)[::2] for i in range(3))], axis=1)
    for other, way in ((stops, -1), (starts, 1)):
        # The first node of a line has no cell that ends there.
        ends = np.setdiff1d(every, other)
        caps = (k + 1) * ends[:, None, None] + fan
        facets.append(caps[:, :, [0, 1, 2, 3][::way]])
    weights = np.zeros((k + 1, 4))
    weights[:, 0], weights[:k, 1:3] = 1.0, outline
    original = ((k + 1) * _ranked(director_mesh)[:, None] + np.arange(k + 1)).ravel()
    whole = np.concatenate([f.reshape(-1, 4) for f in facets])
    part = np.zeros(len(whole), dtype=np.int64)
    return WholeSkin(np.repeat(every, k + 1), np.tile(weights, (n, 1)), original, whole, part)
