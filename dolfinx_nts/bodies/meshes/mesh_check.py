"""Whether a mesh is fit for a body: its kind, its coordinates, no cell flat or inside out."""

from __future__ import annotations

import zlib

from mpi4py import MPI

import basix
import numpy as np
import numpy.typing as npt
from dolfinx import mesh as dolfinx_mesh
from dolfinx.mesh import Mesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact.linear_facets import vertex_nodes
from dolfinx_nts.contact.surfaces import flux
from dolfinx_nts.parallel import gather_rows, raise_together
from dolfinx_nts.types import FloatArray, IntArray

HashArray = npt.NDArray[np.uint64]

#: Corners of the cells of each kind.
_CORNERS = {"interval": 2, "triangle": 3, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 8}
#: Nodes of the cells of degree 2 of each kind that bodies may have.
NODES = {"interval": 3, "tetrahedron": 10, "hexahedron": 27}
#: Corner -> its three edge neighbours in DOLFINx vertex order.
_NEIGHBOURS = np.array([[c ^ 1, c ^ 2, c ^ 4] for c in range(8)])
#: The triple product flips sign at every second corner.
_PARITY = np.array([1 - 2 * (bin(c).count("1") % 2) for c in range(8)])
#: Corners of the six faces, cyclic and counter-clockwise seen from outside.
_FACES = np.array(
    [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
)


def places_of(mesh: Mesh) -> int:
    """Checksum of where a mesh's nodes on this rank are."""
    return zlib.crc32(np.ascontiguousarray(mesh.geometry.x).tobytes())


def check_mesh(mesh: Mesh, name: str) -> int:
    """Raise on every rank unless the mesh is a valid 3D mesh.

    Returns:
        Its degree, 1 or 2, on every rank.

    Raises:
        TypeError: It is no mesh.
        ValueError: Cells of another kind, not finite, inverted or overlapping.
    """
    if not isinstance(mesh, dolfinx_mesh.Mesh):
        raise TypeError(f"mesh={mesh!r}: pass a dolfinx mesh")
    kind = compat.cell_name(mesh)
    if kind not in ("hexahedron", "tetrahedron") or mesh.geometry.dim != 3:
        remedy = ""
        if kind in ("triangle", "quadrilateral"):
            remedy = (
                "; for plane strain pass nts.extrude(mesh, thickness), one cell thick, and hold "
                "both its sides in z; FormBody takes surfaces"
            )
        raise ValueError(
            f"mesh of {name!r}: {kind} in {mesh.geometry.dim}D; pass 3D hexahedra or tetrahedra"
            f"{remedy}"
        )
    degree = _check_nodes(mesh, name, 2)
    cells = compat.geometry_dofmap(mesh)[: mesh.topology.index_map(3).size_local]
    _check_cells(mesh, name, mesh.geometry.x[cells[:, : _CORNERS[kind]]])
    if degree > 1:
        _check_curved(mesh, name, mesh.geometry.x[cells])
    return degree


def check_any_mesh(mesh: Mesh, name: str, degree: int = 1) -> int:
    """Raise on every rank unless the mesh is valid, of any dimension.

    Args:
        mesh: DOLFINx mesh.
        name: Of its body, for messages.
        degree: Largest one that it may have, 1 or 2; that of a mesh of surfaces is 1.

    Returns:
        The degree it has, on every rank.

    Raises:
        ValueError: Cells of another kind, not finite; in 3D inverted or overlapping.
    """
    if mesh.topology.dim == 3:
        return check_mesh(mesh, name)
    return _check_nodes(mesh, name, degree)


def refuse_repeated(mesh: Mesh, name: str) -> None:
    """Raise on every rank if cells are there twice, as where each rank gives the whole mesh.

    Cells are the same that have the same places. Surfaces and lines may lie on each other, so that
    theirs are the same if they have the same nodes, or if all of them lie on others on several
    ranks.

    Args:
        mesh: DOLFINx mesh.
        name: Argument, and whose it is, for messages.

    Raises:
        ValueError: They are.
    """
    dim = mesh.topology.dim
    cells = compat.geometry_dofmap(mesh)[: mesh.topology.index_map(dim).size_local]
    # As bits, as lattices put many a sum of coordinates twice; 0.0 takes signs of zeros away.
    x = _hashed((mesh.geometry.x + 0.0).view(np.uint64))
    places = _hashed(x[:, 0] + _hashed(x[:, 1] + _hashed(x[:, 2])))
    # Whatever their order.
    of_cell = places[cells].sum(axis=1)
    found, count = np.unique(gather_rows(mesh.comm, of_cell), return_counts=True)
    if dim < 3 and (mesh.comm.size == 1 or (count == 1).any()):
        nodes = _hashed(np.asarray(mesh.geometry.input_global_indices, dtype=np.uint64))
        of_cell = nodes[cells].sum(axis=1)
        found, count = np.unique(gather_rows(mesh.comm, of_cell), return_counts=True)
    if (count == 1).all():
        return
    twice = np.flatnonzero(np.isin(of_cell, found[count > 1]))
    where = mesh.geometry.x[cells[twice[:1]]].mean(axis=(0, 1)).tolist() if len(twice) else []
    text = (
        f"{name}: {(count > 1).sum()} cells are there {count.max()} times, e.g. the one at "
        f"x={where}; give each cell once, on one rank, not the whole mesh on every rank"
    )
    raise_together(mesh.comm, text if len(twice) else None)


def pieces_of(mesh: Mesh) -> int:
    """Number of parts of a mesh that share no node, the same on all ranks. Collective."""
    size = mesh.topology.index_map(mesh.topology.dim).size_local
    cells = compat.geometry_dofmap(mesh)[:size]
    nodes, owned = len(mesh.geometry.x), mesh.geometry.index_map().size_local
    used = np.unique(cells)
    one = np.repeat(cells[:, 0], cells.shape[1])
    _, label = _joined(one, cells.ravel(), nodes)
    count, label = np.unique(label[used], return_inverse=True)
    first = np.cumsum([0, *mesh.comm.allgather(len(count))])
    numbers = np.asarray(mesh.geometry.input_global_indices)[used]
    # What a node that several ranks have is part of on each of them.
    shared = np.isin(numbers, gather_rows(mesh.comm, numbers[used >= owned]))
    both = np.column_stack([numbers[shared], label[shared] + first[mesh.comm.rank]])
    node, part = gather_rows(mesh.comm, both).T
    _, node = np.unique(node, return_inverse=True)
    number, _ = _joined(part, first[-1] + node, first[-1] + int(node.max(initial=-1)) + 1)
    return number


def _joined(one: IntArray, two: IntArray, count: int) -> tuple[int, IntArray]:
    """Number of parts of a graph with these edges and so many nodes, and each node's part."""
    edges = coo_matrix((np.ones(len(one), dtype=bool), (one, two)), (count, count))
    return connected_components(edges, directed=False)


def _hashed(a: HashArray) -> HashArray:
    """Numbers of 64 bits, one for each, that look like random ones (splitmix64)."""
    a = (a ^ (a >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    a = (a ^ (a >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return a ^ (a >> np.uint64(31))


def _check_nodes(mesh: Mesh, name: str, degree: int = 1) -> int:
    """Raise on every rank unless the nodes are those of known cells, and finite.

    Returns:
        Degree of the cells.
    """
    kind, cells = compat.cell_name(mesh), compat.geometry_dofmap(mesh)
    if kind not in _CORNERS:
        raise ValueError(f"mesh of {name!r}: {kind}; pass a mesh of {', '.join(_CORNERS)}")
    corners = _CORNERS[kind]
    nodes = mesh.comm.allreduce(cells.shape[1], op=MPI.MAX)
    known, of_degree = [corners], "1"
    if degree > 1 and kind in NODES:
        known, of_degree = [corners, NODES[kind]], "1 or 2"
    if nodes not in known:
        raise ValueError(
            f"mesh of {name!r}: {nodes} nodes per {kind}, not {' or '.join(map(str, known))}; pass "
            f"a mesh of degree {of_degree}, e.g. nts.linear(mesh), which keeps its corners, or "
            "mesh with this order in Gmsh"
        )
    nan = np.flatnonzero(~np.isfinite(mesh.geometry.x).all(axis=1))
    text = f"mesh of {name!r}: {len(nan)} nodes are not finite, e.g. {mesh.geometry.x[nan[:1]]}"
    raise_together(mesh.comm, f"{text}; check the coordinates for NaN" if len(nan) else None)
    refuse_repeated(mesh, f"mesh of {name!r}")
    return 1 + known.index(nodes)


def _check_cells(mesh: Mesh, name: str, x: FloatArray) -> None:
    """Raise on every rank if one of the cells with corners x (n, 4 or 8, 3) is inverted."""
    if x.shape[1] == 8:
        edges = x[:, _NEIGHBOURS] - x[:, :, None]
        det = np.linalg.det(edges) * _PARITY
        volumes = flux(x[:, _FACES] - x[:, :1, None]).sum(axis=1)
    else:
        edges = (x[:, 1:] - x[:, :1])[:, None]
        det = np.linalg.det(edges)
        volumes = det[:, 0] / 6
    size = np.linalg.norm(edges, axis=-1).prod(axis=-1)
    flat = (np.abs(det) <= 1e-12 * size).any(axis=1)
    bad = np.flatnonzero(flat | (np.abs(np.sign(det).sum(axis=1)) < det.shape[1]))
    where = f"e.g. the one at x={x[bad[:1]].mean(axis=(0, 1)).tolist()}" if len(bad) else ""
    text = f"mesh of {name!r}: {len(bad)} inverted or flat cells, {where}; repair the mesh"
    raise_together(mesh.comm, text if len(bad) else None)
    # A cell turned inside out as a whole: the volumes add up to more than the boundary encloses.
    # Seen from a point of the mesh: from a far origin the cones over its boundary would cancel.
    corner = np.append(mesh.geometry.x, np.full((1, 3), np.inf), axis=0).min(axis=0)
    mesh.comm.Allreduce(MPI.IN_PLACE, corner, op=MPI.MIN)
    boundary = mesh.geometry.x[vertex_nodes(mesh, compat.exterior_facets(mesh))] - corner
    local = np.array([np.abs(volumes).sum(), flux(boundary).sum()])
    volume, enclosed = mesh.comm.allreduce(local)
    if abs(volume - enclosed) > 1e-9 * volume:
        raise ValueError(
            f"mesh of {name!r}: inverted or overlapping cells, whose volumes add up to "
            f"{volume:.12g} while the boundary encloses {enclosed:.12g}; repair the mesh"
        )


def _check_curved(mesh: Mesh, name: str, x: FloatArray) -> None:
    """Raise on every rank if one of the cells with nodes x (n, 10 or 27, 3) is folded."""
    kind = getattr(basix.CellType, compat.cell_name(mesh))
    variant = basix.LagrangeVariant.gll_warped
    element = basix.create_element(basix.ElementFamily.P, kind, 2, variant)
    slopes = element.tabulate(1, element.points)[1:, :, :, 0]
    det = np.linalg.det(np.einsum("dpk,nki->npdi", slopes, x))
    bad = np.flatnonzero(np.abs(np.sign(det).sum(axis=1)) < det.shape[1])
    where = f"e.g. the one at x={x[bad[:1]].mean(axis=(0, 1)).tolist()}" if len(bad) else ""
    text = (
        f"mesh of {name!r}: {len(bad)} curved cells are folded, {where}; repair the mesh, with "
        "Gmsh's option Mesh.HighOrderOptimize, or pass nts.linear(mesh)"
    )
    raise_together(mesh.comm, text if len(bad) else None)
