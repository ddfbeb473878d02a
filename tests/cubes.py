"""Blocks that are turned, to meet on edges and vertices."""

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType
from scenes import box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
HEX = CellType.hexahedron
HALF = np.sqrt(0.5)


def turned(
    matrix, centre, name, size=(1, 1, 1), cells=2, cell=HEX, kind=None, metre=1.0, young=1e5,
    **options,
):  # fmt: skip
    """A block about a centre, turned by a matrix."""
    size = np.array(size)
    mesh = box(-0.5 * size, 0.5 * size, cells, cell, COMM)
    mesh.geometry.x[:] = metre * (mesh.geometry.x @ np.transpose(matrix) + centre)
    if kind is nts.RigidBody:
        return nts.RigidBody(mesh, density=1e3, name=name, **options)
    material = nts.NeoHookean(young / metre, 0.3)
    options = {"degree": 1} | options
    return nts.Continuum(mesh, material, density=1e3 / metre**3, name=name, **options)


#: By 45 degrees about x: an edge along x is on top, and one below.
ON_EDGE = np.array([[1, 0, 0], [0, HALF, -HALF], [0, HALF, HALF]])


def about_z(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
