"""Meshes of bodies made of others: plane ones that are extruded, curved ones with straight edges.

They are built anew on all ranks, with nodes and cells numbered as in the input.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import mesh as dolfinx_mesh
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.meshes.mesh_check import refuse_repeated
from dolfinx_nts.parallel import gather_on_root
from dolfinx_nts.types import FloatArray, IntArray
from dolfinx_nts.validation import is_whole, require_positive

_CORNERS = {"interval": 2, "triangle": 3, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 8}
#: Corners of three tetrahedra in a prism, whose lower corners 0, 1, 2 ascend by their numbers: so
#: neighbours split the quadrilateral between them alike.
_TETRAHEDRA = [[0, 1, 2, 5], [0, 1, 4, 5], [0, 3, 4, 5]]


def extrude(mesh: Mesh, thickness: float, *, layers: int = 1) -> Any:
    """A body of a plane mesh and a thickness in z, e.g. for plane strain. Collective.

    Quadrilaterals become hexahedra, triangles three tetrahedra in each layer. In plane strain one
    layer is held in z on both sides:

        mesh = nts.extrude(plane, 0.1)
        held = nts.Dirichlet(lambda x: x[2] > -1.0, components=(2,))  # all nodes are on a side

    Forces and energies are those of this thickness. On a mesh of triangles the diagonals of the
    tetrahedra make motions in the plane differ a little from those on a plane mesh.

    Args:
        mesh: DOLFINx mesh of triangles or quadrilaterals; of a mesh of degree 2 its corners.
        thickness: [m], > 0; the sides are z = 0 and z = thickness over a mesh in the plane.
        layers: Cells through the thickness, >= 1.

    Returns:
        DOLFINx mesh of degree 1.

    Raises:
        TypeError: `mesh` is none.
        ValueError: Its cells are of another kind, or an argument is out of range.
    """
    kind = _kind(mesh, ("triangle", "quadrilateral"))
    require_positive("thickness", thickness, "m")
    if not (is_whole(layers) and layers >= 1):
        raise ValueError(f"layers={layers!r}: pass a whole number >= 1")
    cells, x = _on_root(mesh)
    n, heights = len(x), np.linspace(0.0, thickness, layers + 1)
    points = np.concatenate([x + [0.0, 0.0, z] for z in heights])
    # Layer by layer the numbers of lower corners, then of those above them.
    below = np.concatenate([cells + k * n for k in range(layers)])
    if kind == "triangle":
        below = np.sort(below, axis=1)
        prisms = np.concatenate([below, below + n], axis=1)
        return _made(mesh.comm, prisms[:, _TETRAHEDRA].reshape(-1, 4), points, "tetrahedron")
    both = np.concatenate([below, below + n], axis=1)
    return _made(mesh.comm, both, points, "hexahedron")


def linear(mesh: Mesh) -> Any:
    """The mesh of degree 1 through the corners of a curved one's cells. Collective.

    Curved edges become straight: a boundary of radius r and edges of length h lies up to
    h^2 / (8 r) beside the curve, and the volume errs by as much of its surface.

    Args:
        mesh: DOLFINx mesh of tetrahedra, hexahedra, triangles, quadrilaterals or intervals of any
            degree.

    Returns:
        DOLFINx mesh of degree 1.

    Raises:
        TypeError: `mesh` is none.
        ValueError: Its cells are of another kind.
    """
    kind = _kind(mesh, tuple(_CORNERS))
    return _made(mesh.comm, *_on_root(mesh), kind, mesh.geometry.dim)


def _kind(mesh: Mesh, known: tuple[str, ...]) -> str:
    """Cell type of a mesh, one of those known."""
    if not isinstance(mesh, dolfinx_mesh.Mesh):
        raise TypeError(f"mesh={mesh!r}: pass a dolfinx mesh")
    kind = compat.cell_name(mesh)
    if kind not in known:
        raise ValueError(f"mesh: {kind} in {mesh.geometry.dim}D; pass a mesh of {', '.join(known)}")
    refuse_repeated(mesh, "mesh")
    return kind


def _on_root(mesh: Mesh) -> tuple[IntArray, FloatArray]:
    """Corners of the cells, (m, corners), and places of nodes that are some, (n, 3), on rank 0."""
    corners, dim = _CORNERS[compat.cell_name(mesh)], mesh.topology.dim
    owned = mesh.topology.index_map(dim).size_local
    original = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)
    own = compat.geometry_dofmap(mesh)[:owned, :corners]
    cells = gather_on_root(mesh.comm, original[own])
    number = np.asarray(mesh.topology.original_cell_index[:owned], dtype=np.int64)
    cells = cells[np.argsort(gather_on_root(mesh.comm, number))]
    nodes, first = np.unique(gather_on_root(mesh.comm, original), return_index=True)
    x = gather_on_root(mesh.comm, mesh.geometry.x)[first]
    used, numbers = np.unique(cells, return_inverse=True)
    return numbers.reshape(-1, corners), x[np.searchsorted(nodes, used)]


def _made(comm: MPI.Comm, cells: IntArray, x: FloatArray, kind: str, dim: int = 3) -> Any:
    return compat.create_mesh(comm, cells, x[:, :dim], kind)
