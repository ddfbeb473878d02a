"""Frames in which a scene may be seen: in other units, turned, with other numbers of nodes."""

from dataclasses import dataclass, field

from mpi4py import MPI

import numpy as np

from dolfinx_nts import dolfinx_compat as compat

#: Hexahedra and quadrilaterals are cut into these simplices, alike in neighbours (Kuhn).
_TETS = np.array([
    [0, 1, 3, 7], [0, 1, 5, 7], [0, 2, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 4, 6, 7]
])  # fmt: skip
_DIM = {"hexahedron": 3, "tetrahedron": 3, "quadrilateral": 2, "interval": 1}


@dataclass(frozen=True)
class Frame:
    """How a scene is seen; times and densities are the same in all frames.

    Attributes:
        unit: Length of the scene's unit of length [m].
        turn: Rotation, shape (3, 3).
        shuffle: Seed of the order of nodes and cells; None: as they are counted.
        comm: MPI communicator.
    """

    unit: float = 1.0
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    shuffle: int | None = None
    comm: MPI.Comm = field(default_factory=lambda: MPI.COMM_WORLD)

    def place(self, *x):
        """Places [m] of the scene's (n, 3) or (3,)."""
        return self.unit * (np.asarray(x, dtype=float).reshape(-1, 3) @ self.turn.T).squeeze()

    def axis(self, *n):
        """A direction."""
        return self.turn @ np.asarray(n, dtype=float)

    def back(self, x):
        """The scene's places of places (n, 3) [m]."""
        return np.asarray(x).reshape(-1, 3) @ self.turn / self.unit

    def where(self, marker):
        """A marker of DOLFINx, x (3, n) -> bool (n,), of one of the scene's places (n, 3)."""
        return lambda x: marker(self.back(x.T))

    def size(self, value, power):
        """What is a length to some power: moduli 2, stiffness 3, forces 4, torques 5."""
        return value * self.unit**power

    def grid(self, kind, low, high, cells, axes=(0, 1, 2)):
        """Mesh of a box of the scene, of a plate on its lower face, or of a line along its x.

        `axes` are those of the scene that x, y and z become.
        """
        dim, low, high = _DIM[kind], np.array(low, float), np.array(high, float)
        counts = np.array([*cells, 1, 1][:3]) + 1
        counts[dim:] = 1
        steps = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
        x = np.stack(np.meshgrid(*steps, indexing="ij"), axis=3)
        number = np.arange(x[..., 0].size).reshape(x.shape[:3])
        corners = [
            number[tuple(slice(c >> d & 1, n - 1 + (c >> d & 1)) if d < dim else slice(None)
                         for d, n in enumerate(counts))].ravel()
            for c in range(2**dim)
        ]  # fmt: skip
        found, x = np.stack(corners, axis=1), x.reshape(-1, 3)[:, np.argsort(axes)]
        if kind == "tetrahedron":
            found = found[:, _TETS].reshape(-1, 4)
        if self.shuffle is not None:
            rng = np.random.default_rng(self.shuffle)
            order = rng.permutation(len(x))
            x, found = x[order], rng.permutation(np.argsort(order)[found])
        root = self.comm.rank == 0
        return compat.create_mesh(
            self.comm, found if root else found[:0], self.place(x) if root else x[:0], kind
        )
