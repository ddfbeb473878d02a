"""Boxes, balls and rings of hexahedra or tetrahedra in NumPy alone, and what can be known of them.

Mass, momenta, energies and overlaps come from nodes and cells by quadrature and geometry that share
no code with the package; its meshes are only made of the same nodes.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.spatial import cKDTree

from dolfinx_nts import dolfinx_compat

CORNERS = np.array([(i, j, k) for k, j, i in product((0, 1), repeat=3)])
#: A cube in six tetrahedra about its diagonal: cells side by side meet in the same triangles.
KUHN = np.array(
    [[0, 1 << p[0], (1 << p[0]) + (1 << p[1]), 7] for p in permutations(range(3))]
)
FACES = np.array([(1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)])


def hexahedra(cells, closed=False):
    """Corners of a grid's cells, (m, 8) in DOLFINx's order; closed: the first axis is a ring."""
    numbers = np.arange(np.prod([cells[0] + (not closed), cells[1] + 1, cells[2] + 1]))
    numbers = numbers.reshape(-1, cells[1] + 1, cells[2] + 1)
    i, j, k = (a.ravel() for a in np.meshgrid(*map(np.arange, cells), indexing="ij"))
    around = len(numbers)
    return np.stack([numbers[(i + a) % around, j + b, k + c] for a, b, c in CORNERS], axis=1)


def grid(shape, cells):
    """Nodes of a shape of about unit size about the origin, shape (n, 3)."""
    ends = [np.linspace(-1.0, 1.0, n + 1) for n in cells]
    if shape == "ring":
        ends[0] = np.linspace(0.0, 2.0 * np.pi, cells[0], endpoint=False)
    x = np.stack([a.ravel() for a in np.meshgrid(*ends, indexing="ij")], axis=1)
    if shape == "ring":
        radius = 0.4 - 0.1 * x[:, 1]
        return np.stack([radius * np.cos(x[:, 0]), radius * np.sin(x[:, 0]), 0.3 * x[:, 2]], axis=1)
    if shape == "ball":
        far = np.linalg.norm(x, axis=1)
        x *= (0.2 + 0.8 * np.abs(x).max(axis=1) / np.where(far > 0.0, far, 1.0))[:, None]
    return 0.5 * x


def distances(points, triangles):
    """Distance of each point to the nearest of the triangles (m, 3, 3), shape (n,)."""
    a, b, c = (triangles[None, :, k] for k in range(3))
    p, normal = points[:, None], np.cross(triangles[:, 1] - triangles[:, 0],
                                          triangles[:, 2] - triangles[:, 0])  # fmt: skip
    nearest, above = np.full((len(points), len(triangles)), np.inf), True
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        along = np.clip(((p - start) * edge).sum(2) / (edge**2).sum(2), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(p - start - along[..., None] * edge, axis=2))
        above &= (np.cross(edge, p - start) * normal).sum(2) >= 0.0
    to_plane = np.abs(((p - a) * normal).sum(2)) / np.linalg.norm(normal, axis=1)
    return np.where(above, np.minimum(to_plane, nearest), nearest).min(axis=1)


@dataclass(frozen=True, eq=False)
class Solid:
    """Nodes and cells of a body.

    Attributes:
        x: Reference [m], shape (n, 3).
        cells: Corners, shape (m, 8) or (m, 4).
        points: Of quadrature along an edge of a hexahedron: 2 are the package's of flexible bodies,
            3 are exact for the mass.
    """

    x: np.ndarray
    cells: np.ndarray
    points: int = 2

    @staticmethod
    def of(shape, cells, cell, points=2):
        corners = hexahedra(cells, shape == "ring")
        if cell == "tetrahedron":
            corners = corners[:, KUHN].reshape(-1, 4)
        return Solid(grid(shape, cells), corners, points)

    def mesh(self, comm):
        """The DOLFINx mesh of it."""
        first = comm.rank == 0
        kind = "hexahedron" if self.cells.shape[1] == 8 else "tetrahedron"
        cells, x = (a if first else a[:0] for a in (self.cells, self.x))
        return dolfinx_compat.create_mesh(comm, cells, x, kind)

    @cached_property
    def tets(self):
        """Tetrahedra that fill it, shape (k, 4)."""
        return self.cells[:, KUHN].reshape(-1, 4) if self.cells.shape[1] == 8 else self.cells

    @cached_property
    def boundary(self):
        """Triangles of one tetrahedron only, shape (t, 3)."""
        faces = self.tets[:, FACES].reshape(-1, 3)
        _, index, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        return faces[index[count == 1]]

    def facing(self, direction, least):
        """Marker of the boundary whose outward normals have at least this part along a direction.

        All corners of a facet of it are corners of such a triangle.
        """
        corners = self.x[self.boundary]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        along = normal @ np.asarray(direction) / np.linalg.norm(normal, axis=1)
        # Which side is out: just behind a triangle there is the body.
        size = np.sqrt(np.linalg.norm(normal, axis=1, keepdims=True))
        behind = corners.mean(axis=1) - 1e-6 * normal / size
        along *= np.where(self.inside(self.x, behind), 1.0, -1.0)
        nodes = cKDTree(self.x[np.unique(self.boundary[along >= least - 1e-9])].reshape(-1, 3))
        near = 1e-9 * self.edge
        return lambda x: (nodes.query(x.T)[0] < near) if nodes.n else np.full(x.shape[1], False)

    @cached_property
    def edge(self):
        """Longest edge of the boundary [m]."""
        corners = self.x[self.boundary]
        return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()

    @cached_property
    def _quadrature(self):
        """N (g, a), dN/dX (m, g, a, 3) and weights (m, g) [m^3]."""
        if self.cells.shape[1] == 4:
            a, b = 0.5854101966249685, 0.1381966011250105
            shape = np.full((4, 4), b) + (a - b) * np.eye(4)
            slope = np.broadcast_to(np.vstack([-np.ones(3), np.eye(3)]), (4, 4, 3))
            weights = np.full(4, 1 / 24)
        else:
            t, w = leggauss(self.points)
            at = np.array(list(product((1 + t) / 2, repeat=3)))
            one = np.where(CORNERS, at[:, None], 1 - at[:, None])
            shape, sign = one.prod(2), np.where(CORNERS, 1.0, -1.0)
            slope = np.stack([sign[:, k] * np.delete(one, k, 2).prod(2) for k in range(3)], 2)
            weights = np.array(list(product(w / 2, repeat=3))).prod(1)
        jacobian = np.einsum("mai,gaj->mgij", self.x[self.cells], slope)
        gradient = np.einsum("gaj,mgji->mgai", slope, np.linalg.inv(jacobian))
        return shape, gradient, weights * np.abs(np.linalg.det(jacobian))

    @cached_property
    def mass(self):
        """Consistent mass matrix at density 1 [m^3], shape (n, n)."""
        shape, _, weights = self._quadrature
        mass = np.zeros((len(self.x), len(self.x)))
        element = np.einsum("mg,ga,gb->mab", weights, shape, shape)
        np.add.at(mass, (self.cells[:, :, None], self.cells[:, None, :]), element)
        return mass

    def energy(self, y, law):
        """Integral of a W(C) over the body [J] where its nodes are at y (n, 3)."""
        _, gradient, weights = self._quadrature
        f = np.einsum("mai,mgaj->mgij", y[self.cells], gradient)
        return float((weights * law(np.swapaxes(f, 2, 3) @ f)).sum())

    def inside(self, y, points):
        """Which points (n, 3) are inside it where its nodes are at y, shape (n,)."""
        near = ((points > y.min(axis=0)) & (points < y.max(axis=0))).all(axis=1)
        found = np.zeros(len(points), dtype=bool)
        if near.any():
            corners = y[self.tets]
            frame = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
            frame = np.where(np.abs(np.linalg.det(frame))[:, None, None] > 0, frame, np.eye(3))
            offset = points[near, None] - corners[None, :, 0]
            part = np.einsum("tij,ntj->nti", np.linalg.inv(frame), offset)
            found[near] = ((part.min(2) >= 0) & (part.sum(2) <= 1)).any(axis=1)
        return found

    def samples(self, y):
        """Its nodes on the boundary and the middles of its triangles there."""
        return np.concatenate([y[np.unique(self.boundary)], y[self.boundary].mean(axis=1)])

    def depth(self, y, points):
        """How deep each point is inside it [m], 0 outside, shape (n,)."""
        depth, found = np.zeros(len(points)), self.inside(y, points)
        if found.any():
            depth[found] = distances(points[found], y[self.boundary])
        return depth
