"""A mass at one point, a body of the user's own, and walls that it meets.

It has three coordinates, a constant mass matrix and no potential. It shows all that `System` and
`ContactPair` ask of a body and of a surface.
"""

from mpi4py import MPI

import dolfinx
import numpy as np
from petsc4py import PETSc
from rotations import rotation
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.contact.skins import locate_facets

COMM = MPI.COMM_WORLD
MASS, SPEED, STEP = 2.5, 3.0, 0.02


class PointMass(nts.Body):
    """A mass at one point; rank 0 owns its three coordinates."""

    def __init__(self, comm, mass, position, velocity, name="mass"):
        self.name, self.comm, self.mass = name, comm, mass
        self.num_owned = n = 3 if comm.rank == 0 else 0
        self.reference = np.array(position, dtype=float)[:n]
        self.initial_velocity = np.array(velocity, dtype=float)[:n]
        self.nodal_mass = np.full(n, mass)
        self.fixed = np.empty(0, dtype=np.int64)
        self.u, self.v = np.zeros(n), self.initial_velocity.copy()
        self._matrix = PETSc.Mat().createAIJ(((n, None), (n, None)), nnz=3, comm=comm)
        first = self._matrix.getOwnershipRange()[0]
        self._rows = np.arange(first, first + n, dtype=PETSc.IntType)

    def begin_step(self, rule, moment):
        self.rule, self.moment = rule, moment

    def inertia(self, v):
        return self.mass * v

    def internal(self, u1):
        return np.zeros(self.num_owned)

    def external(self, u1, gravity):
        return self.mass * gravity[: self.num_owned]

    def tangent(self, u1, mass, stiffness):
        self._matrix.zeroEntries()
        self._matrix.setValues(self._rows, self._rows, mass * self.mass * np.eye(self.num_owned))
        self._matrix.assemble()
        return self._matrix

    def prescribed(self, time):
        return np.empty(0)

    def potential(self, u):
        return 0.0

    def accept(self, u, v):
        super().accept(u, v)
        self.u, self.v = u.copy(), v.copy()


class Sledge(PointMass):
    """A mass that is drawn along x; free to follow the surface in z."""

    pace = 1.0
    """How fast it is drawn [m/s]."""

    def __init__(self, position):
        super().__init__(COMM, 1.0, position, (self.pace, 0.0, 0.0), name="sledge")
        self.fixed = np.arange(self.num_owned)[:2]

    def prescribed(self, time):
        return np.array([self.pace * time, 0.0])[: len(self.fixed)]


class PointSurface(nts.Surface):
    """The mass as a slave surface: one point, no facets."""

    def __init__(self, body, position):
        self.body = body
        self.points, self.original = np.array([0]), np.array([0])
        self.reference = np.array([position], dtype=float)
        self.facets, self.area = np.empty((0, 4), dtype=np.int64), np.ones(1)
        self.share = np.arange(body.num_owned // 3)
        self.rows = self.share
        self.fixed = np.zeros((1, 3), dtype=bool)
        one = np.ones((1, 1))
        self.material = nts.Points(
            body, np.array([[0]]), one, self.reference[:, None], self.fixed[:, None], one > 0
        )


def turn(angle=0.7):
    return rotation(angle, (1, -2, 2))


def wall(turned=False):
    """One fixed hexahedron; its surface is at z = 0, or turned in space."""
    mesh = box([-1, -1, -1], [1, 1, 0], [2, 2, 1])
    q = turn() if turned else np.eye(3)
    top = locate_facets(mesh, lambda x: x[2] > -1e-9, None, "top")
    tags = dolfinx.mesh.meshtags(mesh, 2, np.sort(top), np.full(len(top), 1, np.int32))
    mesh.geometry.x[:] = mesh.geometry.x @ q.T
    body = nts.Continuum(
        mesh,
        nts.StVenantKirchhoff(1.0, 0.3),
        density=1.0,
        name="wall",
        bcs=[nts.Dirichlet(lambda x: np.full(x.shape[1], True))],
    )
    return body, body.surface(tags, 1), q


def mass_on_wall(gap, velocity=(0.0, 0.0, -SPEED), turned=False):
    body, master, q = wall(turned)
    position, velocity = q @ [0.3, 0.2, gap], q @ velocity
    mass = PointMass(COMM, MASS, position, velocity)
    pair = nts.ContactPair(slave=PointSurface(mass, position), master=master)
    return nts.System([mass, body], contacts=[pair]), q
