"""Bodies of tetrahedra that Gmsh makes of what is drawn, and how deep they are in each other."""

from mpi4py import MPI

import gmsh
import numpy as np
from scipy.spatial import cKDTree
from solids import distances

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import geometry_dofmap

#: Faces of a tetrahedron.
FACES = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))


def of_gmsh(draw, size):
    """What `draw(occ)` returns, of tetrahedra of a size."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 1)
    out = draw(gmsh.model.occ)
    gmsh.model.occ.synchronize()
    group = gmsh.model.addPhysicalGroup(3, [tag for _, tag in out])
    gmsh.model.setPhysicalName(3, group, "part")
    for bound in ("Max", "Min"):
        gmsh.option.setNumber(f"Mesh.MeshSize{bound}", size)
    gmsh.model.mesh.generate(3)
    part = nts.bodies_from_gmsh(gmsh.model, MPI.COMM_WORLD)["part"]
    gmsh.finalize()
    return part


def tetrahedra(body, start):
    """Nodes now and cells of a body of degree 1, on one rank.

    Of a rigid one `start` is its position and rotation at the start.
    """
    if body.rigid:
        x, cells = body.mesh.geometry.x, geometry_dofmap(body.mesh)
        return body.position + (x - start[0]) @ start[1] @ body.rotation.T, cells
    space = body.u.function_space
    cells = space.dofmap.list
    cells = np.array(getattr(cells, "array", cells)).reshape(-1, 4)
    return space.tabulate_dof_coordinates() + body.u.x.array.reshape(-1, 3), cells


def skin(cells):
    """Faces of tetrahedra that only one of them has."""
    faces, number = np.unique(
        np.sort(np.concatenate([cells[:, f] for f in FACES]), axis=1), axis=0, return_counts=True
    )
    return faces[number == 1]


def deepest(body, other, start=None, other_start=None, between=0):
    """Depth of the deepest node of a body in another one, over the other's mean edge.

    Or of its nodes and of points between them, as many on each edge of its skin.
    """
    (points, own), (x, cells) = tetrahedra(body, start), tetrahedra(other, other_start)
    if between:
        ends = points[skin(own)]
        ways = np.linspace(0.0, 1.0, between + 2)[:-1, None, None, None]
        points = (ends + ways * (np.roll(ends, 1, axis=1) - ends)).reshape(-1, 3)
    corners = x[cells]
    edges = np.linalg.norm(corners[:, 1:] - corners[:, :1], axis=2)
    tree = cKDTree(corners.mean(axis=1))
    found = tree.query_ball_point(points, edges.max())
    near = [(i, k) for i, cells_near in enumerate(found) for k in cells_near]
    if not near:
        return 0.0
    node, cell = np.array(near).T
    ways = (corners[cell, 1:] - corners[cell, :1]).transpose(0, 2, 1)
    weights = np.linalg.solve(ways, (points[node] - corners[cell, 0])[:, :, None])[:, :, 0]
    weights = np.column_stack([1.0 - weights.sum(axis=1), weights])
    inside = np.unique(node[(weights > 1e-9).all(axis=1)])
    if not inside.size:
        return 0.0
    faces = x[skin(cells)]
    return max(distances(points[[i]], faces).min() for i in inside) / edges.mean()
