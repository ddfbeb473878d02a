"""Meshes of lines in space."""

import numpy as np
from mpi4py import MPI

from dolfinx_nts import dolfinx_compat as compat


def interval_mesh(x, cells=None, comm=MPI.COMM_WORLD):
    """A mesh of these nodes, all given by rank 0, in their order unless told."""
    if cells is None:
        cells = np.column_stack([np.arange(len(x) - 1), np.arange(1, len(x))])
    mine = slice(None if comm.rank == 0 else 0)
    x = np.asarray(x, dtype=float)
    return compat.create_mesh(comm, np.asarray(cells)[mine], x[mine], "interval")


def curved_mesh(x, comm=MPI.COMM_WORLD):
    """A mesh of degree 2 of these nodes, every second one in the middle of a cell."""
    first = np.arange(0, len(x) - 2, 2)
    return interval_mesh(x, np.column_stack([first, first + 2, first + 1]), comm)


def straight(n, length=1.0, way=(1, 0, 0)):
    return np.linspace(0, length, n + 1)[:, None] * np.array(way, dtype=float)


def arc(n, radius, angle):
    a = np.linspace(0, angle, n + 1)
    return radius * np.column_stack([np.sin(a), 1 - np.cos(a), 0 * a])
