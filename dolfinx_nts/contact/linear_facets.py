"""Linear facets over the nodes of cells' faces: one a face of degree 1, four a face of degree 2.

What touches sees flat or bilinear facets whatever the degree of the body: points of them are linear
in the nodes, so that contact keeps energy and momenta of a body of degree 2 as of one of degree 1
(theory 19.6).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import basix
import numpy as np
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Highest degree whose nodes are where the cell's own numbering says, whatever its neighbours'.
HIGHEST = 2


class CellFaces(NamedTuple):
    """The faces of a cell as linear facets.

    Attributes:
        nodes: Nodes of the cell at their corners, cyclic, counter-clockwise seen from outside of
            the cell of reference, shape (faces, facets, corners).
        parts: What each corner has of the force of a uniform pressure on its facet, which is that
            of the face in all, the same shape.
    """

    nodes: IntArray
    parts: FloatArray


@cache
def faces_of_cell(kind: str, degree: int) -> CellFaces:
    """Facets of a cell's faces.

    Args:
        kind: "hexahedron" or "tetrahedron".
        degree: Of its Lagrange element, 1 or 2.
    """
    cell = getattr(basix.CellType, kind)
    variant = basix.LagrangeVariant.gll_warped
    element = basix.create_element(basix.ElementFamily.P, cell, degree, variant)
    vertices, faces = basix.geometry(cell), basix.topology(cell)[2]
    nodes = np.array([_of_face(vertices, face, element.points, degree) for face in faces])
    weight = np.ones(len(element.points))
    if degree > 1:
        # Simpson's rule in two directions, and on a triangle that of its middles.
        of_entities = (0.0, 1.0, 1.0, 1.0) if kind == "tetrahedron" else (1.0, 2.0, 4.0, 8.0)
        for value, entities in zip(of_entities, element.entity_dofs, strict=True):
            weight[np.concatenate([*entities]).astype(int)] = value
    parts = weight[nodes]
    return CellFaces(nodes, parts / parts.sum(axis=2, keepdims=True))


def _of_face(vertices: FloatArray, face: list[int], nodes: FloatArray, degree: int) -> IntArray:
    """Nodes at the corners of the facets of a face with these vertices, (facets, corners)."""
    first, one, two = vertices[face[:3]]
    step, every = np.stack([one - first, two - first]) / degree, range(degree)
    if len(face) == 3:
        up = [(i, j) for i in every for j in every if i + j < degree]
        cells = [[(i, j), (i + 1, j), (i, j + 1)] for i, j in up]
        cells += [[(i + 1, j), (i + 1, j + 1), (i, j + 1)] for i, j in up if i + j + 2 <= degree]
    else:
        cells = [[(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)] for i in every for j in every]
    x = first + np.array(cells) @ step
    if np.cross(*step) @ (first - vertices.mean(axis=0)) < 0.0:
        x = x[:, ::-1]
    return np.linalg.norm(x[:, :, None] - nodes, axis=3).argmin(axis=2)


def vertex_nodes(mesh: Mesh, local_facets: IntArray) -> IntArray:
    """Geometry nodes at the vertices of facets, as of `body_facets`, shape (m, corners)."""
    return _oriented(mesh, local_facets, compat.geometry_dofmap(mesh), 1)[0]


def body_facets(body: Any, local_facets: IntArray) -> tuple[IntArray, FloatArray]:
    """Blocks of coordinates at the corners of linear facets over a body's, and their parts.

    Args:
        body: With a mesh, a space and its degree; None is 1.
        local_facets: This rank's owned facets of its boundary.

    Returns:
        Blocks on this rank, cyclic and counter-clockwise seen from outside, and parts as of
        `CellFaces`, shape (m, corners) each; those of a face stand together.
    """
    return _oriented(body.mesh, local_facets, compat.cell_dofs(body.space), body.degree or 1)


def _oriented(
    mesh: Mesh, local_facets: IntArray, cells: IntArray, degree: int
) -> tuple[IntArray, FloatArray]:
    """Nodes of facets and parts, from those of cells, the vertices' first, (cells, nodes)."""
    topology, faces = mesh.topology, faces_of_cell(compat.cell_name(mesh), degree)
    corners = faces.nodes.shape[2]
    if not len(local_facets):
        return np.empty((0, corners), dtype=np.int32), np.empty((0, corners))
    topology.create_connectivity(2, 3)
    topology.create_connectivity(3, 2)
    to_cell, to_facet = topology.connectivity(2, 3), topology.connectivity(3, 2)
    cell = np.array([to_cell.links(f)[0] for f in local_facets], dtype=np.int32)
    both = zip(cell, local_facets, strict=True)
    face = [int(np.flatnonzero(to_facet.links(c) == f)[0]) for c, f in both]
    nodes, parts = faces.nodes[face], faces.parts[face].copy()
    found = cells[cell[:, None, None], nodes]
    # Cells may be numbered either way round.
    turned = _left_handed(mesh.geometry.x[compat.geometry_dofmap(mesh)[cell]], corners)
    found[turned], parts[turned] = found[turned][..., ::-1], parts[turned][..., ::-1]
    return found.reshape(-1, corners), parts.reshape(-1, corners)


def _left_handed(x: FloatArray, corners: int) -> BoolArray:
    """Which cells with nodes x (m, nodes, 3) [m] and faces of so many corners are."""
    arms = x[:, [1, 2, corners]] - x[:, :1]
    turned: BoolArray = np.linalg.det(arms) < 0.0
    return turned


def node_places(body: Any) -> FloatArray:
    """Reference positions of all nodes of a body on this rank [m], shape (blocks, 3)."""
    mesh, space = body.mesh, body.space
    x: FloatArray = space.tabulate_dof_coordinates().copy()
    # Without the rounding of DOLFINx's map of cells, which differs between ranks.
    blocks = compat.node_blocks(mesh, space)
    there = blocks >= 0
    x[blocks[there]] = mesh.geometry.x[there]
    return x


def node_numbers(body: Any) -> IntArray:
    """Numbers of all nodes of a body on this rank that are the same on any number of ranks.

    Those of the input, if the mesh has all nodes; else by the cells' order there. Collective.
    """
    mesh, space = body.mesh, body.space
    index_map = space.dofmap.index_map
    nodes = compat.geometry_dofmap(mesh)
    if nodes.shape[1] == compat.cell_dofs(space).shape[1]:
        found = np.full(index_map.size_local + index_map.num_ghosts, -1, dtype=np.int64)
        blocks = compat.node_blocks(mesh, space)
        there = blocks >= 0
        found[blocks[there]] = np.asarray(mesh.geometry.input_global_indices)[there]
        return found
    order = mesh.comm.bcast(body.file_order())
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    local = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    return number[index_map.local_to_global(local)]
