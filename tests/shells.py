"""Meshes of shells."""

import numpy as np
from mpi4py import MPI

from dolfinx_nts import dolfinx_compat as compat


def surface_mesh(x, cells, comm=MPI.COMM_WORLD, kind="quadrilateral"):
    """A mesh of these nodes and cells, all given by rank 0."""
    mine = slice(None if comm.rank == 0 else 0)
    x = np.asarray(x, dtype=float)
    return compat.create_mesh(comm, np.asarray(cells)[mine], x[mine], kind)


def grid(n, m):
    """Cells of n x m on nodes numbered along the second direction first."""
    k = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    corners = [k[:-1, :-1], k[1:, :-1], k[:-1, 1:], k[1:, 1:]]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def plate_nodes(n, m, a, b):
    """Nodes of n x m cells on a rectangle of sides a and b with a corner at the origin."""
    x, y = np.meshgrid(np.linspace(0, a, n + 1), np.linspace(0, b, m + 1), indexing="ij")
    return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)


def plate(n, m, a, b, comm=MPI.COMM_WORLD):
    return surface_mesh(plate_nodes(n, m, a, b), grid(n, m), comm)
