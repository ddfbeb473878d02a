"""Values at the nodes of this rank's beams or shells, element by element, and sums of them."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.types import FloatArray, IntArray


class ElementValues:
    """Takes nodal vectors from their owners to elements, and what elements contribute back.

    Args:
        comm: MPI communicator.
        size: Number of nodes of this rank.
        ghosts: Global numbers of other ranks' nodes that it needs.
        cells: Global numbers of the nodes of this rank's elements, shape (n, nodes).
        width: Coordinates of a node.

    Attributes:
        here: Global numbers of this rank's nodes.
        num_owned: Coordinates of this rank.
        numbers: Their global numbers.
        cells: As given, and so are `ghosts`.
        nodes: Nodes of the elements on this rank, shape (n, nodes).
        num_vectors: Nodal vectors of an element.
    """

    def __init__(
        self, comm: MPI.Comm, size: int, ghosts: IntArray, cells: IntArray, width: int
    ) -> None:
        start = comm.exscan(size) or 0
        stop = start + size
        self.here, self._width, self.cells = slice(start, stop), width, cells
        self.num_owned, self.ghosts = width * size, ghosts
        self.numbers = width * start + np.arange(self.num_owned)
        self._shared = PETSc.Vec().createGhost(
            ghosts.astype(PETSc.IntType), (self.num_owned, None), bsize=width, comm=comm
        )
        known = np.concatenate([np.arange(start, stop), ghosts])
        order = np.argsort(known)
        self.nodes = order[np.searchsorted(known[order], cells)]
        self.num_vectors = self.nodes.shape[1] * width // 3
        # Number on this rank of each coordinate, element after element.
        self._rows = (width * self.nodes[:, :, None] + np.arange(width)).ravel()

    def of(self, owned: FloatArray) -> FloatArray:
        """Values at the nodes of this rank's elements, shape (n, k, 3). Collective."""
        self._shared.array_w[:] = owned
        self._shared.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        with self._shared.localForm() as local:
            values = local.array_r.reshape(-1, self._width)[self.nodes]
        return values.reshape(len(self.nodes), self.num_vectors, 3)

    def sums(self, values: FloatArray) -> FloatArray:
        """Sums at this rank's coordinates of what elements contribute, (n, 3 k). Collective."""
        with self._shared.localForm() as local:
            size = local.getLocalSize()
            local.array_w[:] = np.bincount(self._rows, values.ravel(), minlength=size)
        self._shared.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return self._shared.array_r.copy()

    def matrix(self, of_nodes: IntArray) -> PETSc.Mat:
        """Matrix of triplets: of elements, of single nodes, and of the whole diagonal. Collective.

        Args:
            of_nodes: Coordinates of single nodes that have entries of their own, (m, d, 3).
        """
        width, size = self._width, 3 * self.num_vectors
        numbers = (width * self.cells[:, :, None] + np.arange(width)).reshape(-1, size)
        rows, cols = zip(
            *(np.broadcast_arrays(a[..., :, None], a[..., None, :]) for a in (numbers, of_nodes)),
            strict=True,
        )
        return petsc_compat.coo_matrix(
            self._shared.comm, self.num_owned,
            *(np.concatenate([*(a.ravel() for a in both), self.numbers]) for both in (rows, cols)),
        )  # fmt: skip

    def destroy(self) -> None:
        """Free the PETSc vector."""
        self._shared.destroy()
