"""The middle surface of a shell on a mesh of quadrilaterals: its sides and directors."""

from __future__ import annotations

import numpy as np
from dolfinx import fem
from dolfinx import mesh as dolfinx_mesh
from dolfinx.mesh import Mesh
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.meshes.mesh_check import check_any_mesh
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh, nodes_and_cells
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.types import FloatArray, IntArray

#: Corners of a cell in DOLFINx's order as they follow each other.
_CYCLIC = [0, 1, 3, 2]
#: Cosine of the largest angle between neighbouring cells, 60 degrees.
_SMOOTH = 0.5
#: Sine of a cell's angle, over the whole cell's size, below which it is flat.
_FLAT = 1e-9
#: What joins shells, for messages.
_SEAM = 'nts.Seam(shell, other.surface(where, side="edge"))'


def check_midsurface(mesh: Mesh, name: str) -> None:
    """Raise on every rank unless the mesh is one of quadrilaterals in space.

    Raises:
        TypeError: It is no mesh.
        ValueError: Cells of another kind, another dimension, nodes that are not finite.
    """
    if not isinstance(mesh, dolfinx_mesh.Mesh):
        raise TypeError(f"mesh={mesh!r}: pass a dolfinx mesh")
    kind, dim = compat.cell_name(mesh), mesh.geometry.dim
    if kind == "triangle":
        raise ValueError(
            f"mesh of {name!r}: triangle cells would lock; make quadrilaterals of them, in Gmsh by "
            "Mesh.RecombineAll = 1, or cut each triangle into three"
        )
    if kind != "quadrilateral" or dim != 3:
        raise ValueError(
            f"mesh of {name!r}: {kind} in {dim}D; pass quadrilaterals with points of three "
            "coordinates"
        )
    check_any_mesh(mesh, name)


def midsurface_of(space: fem.FunctionSpace, name: str) -> DirectorMesh:
    """Nodes in the order of the user's input, cells of one orientation, directors. Collective.

    The director of a node is the mean of the normals of its cells there, each weighted by its
    angle, so that it does not depend on how a mesh divides a surface. The cell with the lowest
    numbers of nodes in the user's input says which side of each part is the top.

    Args:
        space: Lagrange space of degree 1 on a mesh that `check_midsurface` let pass.
        name: Of the shell, for messages.

    Raises:
        ValueError: A flat cell, an edge of three cells, a fold above 60 degrees, a surface with one
            side, cells that share a node alone, or a node whose cells have no common normal.
    """
    x, cells, given = nodes_and_cells(space)
    cells = cells[:, _CYCLIC]
    _check_cells(x, cells, name)
    edge, count = _edges(cells)
    if count.max() > 2:
        where = x[cells[np.divmod(np.flatnonzero(count[edge] > 2)[0], 4)]].tolist()
        raise ValueError(
            f"mesh of {name!r}: {count.max()} cells meet in an edge at x={where}; a mesh has no "
            f"T-junctions: make a shell of each part, and join them by {_SEAM}"
        )
    _check_corners(x, cells, edge, given, name)
    cells = _oriented(x, cells, edge, given, name)
    _check_folds(x, cells, edge, name)
    directors = _directors(x, cells, name)
    edge, count = _edges(cells)
    ends = np.stack([cells, np.roll(cells, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges = ends[count[edge] == 1]
    halves = 0.5 * np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)
    lengths = np.repeat(halves[:, None], 2, axis=1)
    return DirectorMesh(x, np.argsort(given), cells, directors[:, None], edges, lengths)


def _edges(cells: IntArray) -> tuple[IntArray, IntArray]:
    """Number of each cell's edges, shape (4 c,), and how many cells have each."""
    ends = np.sort(np.stack([cells, np.roll(cells, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    _, edge, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    return edge.ravel(), count


def _corner_normals(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit normals (c, 4, 3) and angles (c, 4) [rad] at the corners x (c, 4, 3) of cells."""
    ahead, back = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    normal = cross(ahead, back)
    size = np.linalg.norm(normal, axis=2)
    angle = np.arctan2(size, (ahead * back).sum(axis=2))
    return normal / np.where(size > 0.0, size, 1.0)[:, :, None], angle


def _directors(x: FloatArray, cells: IntArray, name: str) -> FloatArray:
    """Unit means of the normals at the nodes, shape (n, 3)."""
    normals, angles = _corner_normals(x[cells])
    directors = np.zeros_like(x)
    np.add.at(directors, cells, angles[:, :, None] * normals)
    size = np.linalg.norm(directors, axis=1, keepdims=True)
    directors /= np.where(size > 0.0, size, 1.0)
    # Of neighbours folds are checked, but not of cells that face each other over a steep tip.
    off = (normals * directors[cells]).sum(axis=2) < _SMOOTH
    if off.any():
        where = x[cells[off][0]].tolist()
        raise ValueError(
            f"mesh of {name!r}: the cells at the node at x={where} look in different directions, "
            "by more than 60 degrees from their mean; cut the tip off, or make a shell of each part"
        )
    return directors


def _centre_normals(x: FloatArray) -> FloatArray:
    """Normals in the middle of cells with corners x (c, 4, 3), of twice their area, (c, 3)."""
    return cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])


def _check_cells(x: FloatArray, cells: IntArray, name: str) -> None:
    corners = x[cells]
    size = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
    ahead, back = (np.roll(corners, s, axis=1) - corners for s in (-1, 1))
    across = np.einsum("cki,ci->ck", cross(ahead, back), _centre_normals(corners))
    bad = (across <= _FLAT * (size**2)[:, None]).any(axis=1)
    if bad.any():
        where = corners[bad.argmax()].mean(axis=0).tolist()
        raise ValueError(
            f"mesh of {name!r}: {bad.sum()} cells are flat, concave or twisted, e.g. the one at "
            f"x={where}; repair the mesh"
        )


def _check_corners(
    x: FloatArray, cells: IntArray, edge: IntArray, given: IntArray, name: str
) -> None:
    """Raise where cells share a node but no edge; DOLFINx makes two nodes of it between ranks."""
    ends = np.stack([cells, np.roll(cells, -1, axis=1)], axis=-1).reshape(-1, 2)
    outer = np.bincount(ends[np.bincount(edge)[edge] == 1].ravel(), minlength=len(x))
    _, first, times = np.unique(given, return_index=True, return_counts=True)
    alone = np.concatenate([np.flatnonzero(outer > 2), first[times > 1]])
    if alone.size:
        raise ValueError(
            f"mesh of {name!r}: cells share the node at x={x[alone[0]].tolist()}, but no edge "
            "there; make a shell of each part"
        )


def _oriented(
    x: FloatArray, cells: IntArray, edge: IntArray, given: IntArray, name: str
) -> IntArray:
    """Cells turned so that neighbours run through their edges in opposite directions."""
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(edge[order][1:] == edge[order][:-1])
    one, two = order[same], order[same + 1]
    starts = cells.ravel()
    turned = starts[one] == starts[two]
    a, b = one // 4, two // 4
    pairs = csr_matrix((np.ones(len(a)), (a, b)), shape=(len(cells),) * 2)
    count, part = connected_components(pairs, directed=False)
    sign = np.ones(len(cells), dtype=bool)
    if turned.any():
        relative = {}
        for i, j, t in zip(a.tolist(), b.tolist(), turned.tolist(), strict=True):
            relative[i, j] = relative[j, i] = t
        lowest = np.lexsort(np.sort(given[cells], axis=1).T[::-1])
        for start in (lowest[np.argmax(part[lowest] == k)] for k in range(count)):
            visited, before = breadth_first_order(pairs, start, directed=False)
            for i in visited[1:].tolist():
                sign[i] = sign[before[i]] ^ relative[int(before[i]), i]
        wrong = (sign[a] ^ sign[b]) != turned
        if wrong.any():
            where = x[cells[a[wrong.argmax()]]].mean(axis=0).tolist()
            raise ValueError(
                f"mesh of {name!r}: the surface has one side alone, e.g. at x={where}; cut it"
            )
    return np.where(sign[:, None], cells, cells[:, ::-1])


def _check_folds(x: FloatArray, cells: IntArray, edge: IntArray, name: str) -> None:
    # Turned cells number their edges otherwise; which cells share one stays.
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(edge[order][1:] == edge[order][:-1])
    a, b = order[same] // 4, order[same + 1] // 4
    normal = _centre_normals(x[cells])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    cosine = (normal[a] * normal[b]).sum(axis=1)
    if (cosine < _SMOOTH).any():
        k = cosine.argmin()
        where = (0.5 * (x[cells[a[k]]].mean(axis=0) + x[cells[b[k]]].mean(axis=0))).tolist()
        raise ValueError(
            f"mesh of {name!r}: folds by {np.degrees(np.arccos(np.clip(cosine[k], -1, 1))):.3g} "
            f"degrees at x={where}, more than 60; refine the mesh, round the fold, or make a shell "
            f"of each part, and join them by {_SEAM}"
        )
