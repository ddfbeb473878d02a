"""Meshes of shells."""

from mpi4py import MPI

import numpy as np

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


def ball(n):
    """Nodes and cells of a unit sphere: a cube of n x n cells a side, blown up; tops outside."""
    turns = np.tan(np.linspace(-np.pi / 4, np.pi / 4, n + 1))
    a, b = (t.ravel() for t in np.meshgrid(turns, turns, indexing="ij"))
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            x = np.empty((len(a), 3))
            x[:, axis], x[:, (axis + 1) % 3], x[:, (axis + 2) % 3] = sign, a, sign * b
            sides.append(x / np.linalg.norm(x, axis=1, keepdims=True))
    every = np.concatenate(sides)
    _, first, number = np.unique(every.round(9), axis=0, return_index=True, return_inverse=True)
    cells = np.concatenate([grid(n, n) + k * len(a) for k in range(6)])
    return every[first], number.ravel()[cells]
