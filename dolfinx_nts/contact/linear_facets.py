"""Linear facets over the nodes of cells' faces: one a face of degree 1, four a face of degree 2.

Searches, edges and watches see these, whatever the degree of a body; what is measured over them are
the faces themselves, see `faces`.
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
        corners: Nodes of the cell at the facets' corners, cyclic, counter-clockwise seen from
            outside of the cell of reference, shape (faces, facets, corners).
        parts: What each corner has of the force of a uniform pressure on its facet, which is that
            of the face in all, the same shape.
        nodes: All nodes of each face, as of `face_points`, shape (faces, nodes).
        at: Where the corners are in the face, (facets, corners, 2) for each face.
    """

    corners: IntArray
    parts: FloatArray
    nodes: IntArray
    at: IntArray


def face_points(corners: int, degree: int) -> IntArray:
    """Places of a face's nodes in steps along the two edges from a vertex, shape (nodes, 2)."""
    every = range(degree + 1)
    return np.array([(i, j) for i in every for j in every if corners == 4 or i + j <= degree])


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
    steps = _in_steps(len(faces[0]), degree)
    of_face = face_points(len(faces[0]), degree)
    corners, nodes, at = [], [], []
    for face in faces:
        first, *along = vertices[face[:3]]
        arms = (along - first) / degree
        inward = np.cross(*arms) @ (first - vertices.mean(axis=0)) < 0.0
        at.append(steps[:, ::-1] if inward else steps)
        places = [first + of @ arms for of in (at[-1], of_face)]
        distance = [np.linalg.norm(x[..., None, :] - element.points, axis=-1) for x in places]
        corners.append(distance[0].argmin(axis=-1))
        nodes.append(distance[1].argmin(axis=-1))
    weight = np.ones(len(element.points))
    if degree > 1:
        # Simpson's rule in two directions, and on a triangle that of its middles.
        of_entities = (0.0, 1.0, 1.0, 1.0) if kind == "tetrahedron" else (1.0, 2.0, 4.0, 8.0)
        for value, entities in zip(of_entities, element.entity_dofs, strict=True):
            weight[np.concatenate([*entities]).astype(int)] = value
    parts = weight[np.array(corners)]
    return CellFaces(
        np.array(corners), parts / parts.sum(axis=2, keepdims=True), np.array(nodes), np.array(at)
    )


def _in_steps(corners: int, degree: int) -> IntArray:
    """Corners of a face's facets in the steps of `face_points`, shape (facets, corners, 2)."""
    every = range(degree)
    if corners == 3:
        up = [(i, j) for i in every for j in every if i + j < degree]
        found = [[(i, j), (i + 1, j), (i, j + 1)] for i, j in up]
        found += [[(i + 1, j), (i + 1, j + 1), (i, j + 1)] for i, j in up if i + j + 2 <= degree]
    else:
        found = [[(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)] for i in every for j in every]
    return np.array(found)


class BodyFacets(NamedTuple):
    """Linear facets over those of a body; those of a face stand together.

    Attributes:
        corners: Blocks on this rank, cyclic and counter-clockwise seen from outside, (m, corners).
        parts: As of `CellFaces`, the same shape.
        nodes: Blocks of all nodes of the face, as of `face_points`, shape (m, nodes).
        at: Where the corners are in it, in its steps, shape (m, corners, 2).
    """

    corners: IntArray
    parts: FloatArray
    nodes: IntArray
    at: IntArray


def vertex_nodes(mesh: Mesh, local_facets: IntArray) -> IntArray:
    """Geometry nodes at the vertices of facets, as of `body_facets`, shape (m, corners)."""
    return _oriented(mesh, local_facets, compat.geometry_dofmap(mesh), 1).corners


def body_facets(body: Any, local_facets: IntArray) -> BodyFacets:
    """Linear facets over a body's.

    Args:
        body: With a mesh, a space and its degree; None is 1.
        local_facets: This rank's owned facets of its boundary.
    """
    return _oriented(body.mesh, local_facets, compat.cell_dofs(body.space), body.degree or 1)


def _oriented(mesh: Mesh, local_facets: IntArray, cells: IntArray, degree: int) -> BodyFacets:
    """Facets from nodes of cells, the vertices' first, shape (cells, nodes)."""
    topology, faces = mesh.topology, faces_of_cell(compat.cell_name(mesh), degree)
    _, facets, corners = faces.corners.shape
    cell, face = np.empty(0, dtype=np.int32), np.empty(0, dtype=np.int64)
    if len(local_facets):
        topology.create_connectivity(2, 3)
        topology.create_connectivity(3, 2)
        to_cell, to_facet = topology.connectivity(2, 3), topology.connectivity(3, 2)
        cell = np.array([to_cell.links(f)[0] for f in local_facets], dtype=np.int32)
        both = zip(cell, local_facets, strict=True)
        face = np.array([np.flatnonzero(to_facet.links(c) == f)[0] for c, f in both])
    own, parts, at = cells[cell], faces.parts[face], faces.at[face]
    of_face = faces.corners[face].reshape(len(cell), facets * corners)
    found = np.take_along_axis(own, of_face, axis=1).reshape(len(cell), facets, corners)
    # Cells may be numbered either way round.
    turned = _left_handed(mesh.geometry.x[compat.geometry_dofmap(mesh)[cell]], corners)
    for of in (found, parts, at):
        of[turned] = of[turned][:, :, ::-1]
    whole = np.take_along_axis(own, faces.nodes[face], axis=1)
    return BodyFacets(
        found.reshape(-1, corners), parts.reshape(-1, corners), np.repeat(whole, facets, axis=0),
        at.reshape(-1, corners, 2),
    )  # fmt: skip


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
