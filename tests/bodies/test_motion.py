"""How a body moves as a whole, against closed forms of rigid motions."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from point_mass import PointMass, turn

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
DENSITY, SIZE = 700.0, np.array([0.3, 0.5, 0.8])
CENTRE, SPIN, VELOCITY = np.array([10.0, -3.0, 2.0]), np.array([3.0, -1.0, 2.0]), [0.4, 5.0, -6.0]

pytestmark = pytest.mark.mpi


def box(kind=CellType.hexahedron, **options):
    """A box about CENTRE."""
    mesh = create_box(
        COMM, [CENTRE - SIZE / 2, CENTRE + SIZE / 2], [2, 3, 2], kind,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    return nts.Continuum(mesh, rubber, density=DENSITY, **options)


def exact_inertia(q):
    """Of the box, turned by q."""
    mass, square = DENSITY * SIZE.prod(), SIZE**2
    return q @ np.diag(mass / 12 * (square.sum() - square)) @ q.T


@pytest.mark.parametrize("kind", [CellType.hexahedron, CellType.tetrahedron])
def test_a_box_that_is_turned_moved_and_spins(kind):
    q, shift = turn(), np.array([1.0, 2.0, 3.0])

    def velocity(x):
        return np.cross(SPIN, (x.T - CENTRE) @ q.T).T + np.reshape(VELOCITY, (3, 1))

    def displacement(x):
        return ((x.T - CENTRE) @ q.T + CENTRE + shift - x.T).T

    motion = nts.motion_of(box(kind, velocity=velocity, displacement=displacement))
    inertia = exact_inertia(q)
    assert np.isclose(motion.mass, DENSITY * SIZE.prod(), rtol=1e-12)
    assert np.allclose(motion.centre, CENTRE + shift, rtol=0, atol=1e-12)
    assert np.allclose(motion.velocity, VELOCITY, rtol=0, atol=1e-12)
    assert np.allclose(motion.inertia, inertia, rtol=0, atol=1e-11 * inertia.max())
    assert np.allclose(motion.angular_momentum, inertia @ SPIN, atol=1e-11 * inertia.max())
    assert np.allclose(motion.spin, SPIN, rtol=0, atol=1e-11)
    for value in vars(motion).values():
        assert len({np.asarray(each).tobytes() for each in COMM.allgather(value)}) == 1


def test_given_states_go_before_the_last():
    body = box()
    u, v = np.tile([0.0, 0.1, 0.0], body.num_owned // 3), np.zeros(body.num_owned)
    v[::3] = 2.0
    motion = nts.motion_of(body, u, v)
    assert np.allclose(motion.centre, CENTRE + [0, 0.1, 0], atol=1e-12)
    assert np.allclose(nts.motion_of(body).centre, CENTRE, atol=1e-12)
    assert np.allclose(motion.velocity, [2, 0, 0]) and np.allclose(motion.spin, 0.0, atol=1e-12)
    with pytest.raises(ValueError, match="^v of shape .*owned coordinates of 'body'"):
        nts.motion_of(body, u, np.zeros((2, 3)))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_body_of_the_users_own_that_has_no_inertia(scale):
    """A point mass does not spin, whatever the unit of length."""
    place, velocity = scale * np.array([0.1, 0.7, -0.3]), scale * np.array([0.5, 0.3, 0.0])
    motion = nts.motion_of(PointMass(COMM, 0.7, place, velocity))
    assert np.isclose(motion.mass, 0.7) and np.allclose(motion.centre, place, rtol=1e-14)
    assert np.allclose(motion.velocity, velocity, rtol=1e-14)
    assert np.array_equal(motion.spin, np.zeros(3))


def test_a_rod_does_not_spin_about_itself():
    """Two point masses as one body, the ends of a rod that turns."""
    rod = PointMass(COMM, 2.0, [0.1, 0.2, 0.3], [0.0, 0.0, 0.0])
    if COMM.rank == 0:
        rod.num_owned = 6
        rod.reference = np.array([0.1, 0.2, 0.3, 0.1, 0.2, 0.7])
        rod.nodal_mass = np.full(6, 2.0)
    u, v = np.zeros(rod.num_owned), np.array([0, 0, 0, 0.8, 0, 0.0])[: rod.num_owned]
    motion = nts.motion_of(rod, u, v)
    assert np.isclose(motion.mass, 4.0) and np.allclose(motion.centre, [0.1, 0.2, 0.5])
    assert np.allclose(motion.inertia, np.diag([0.16, 0.16, 0.0]), atol=1e-15)
    assert np.allclose(motion.spin, [0.0, 2.0, 0.0], rtol=1e-12)


class Weightless(PointMass):
    """A point without mass on a spring."""

    def __init__(self):
        super().__init__(COMM, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), name="weightless")

    def internal(self, u1):
        return 5.0 * (0.5 * (self.moment.u0 + u1) - 0.01)

    def tangent(self, u1, mass, stiffness):
        matrix = super().tangent(u1, mass, stiffness)
        matrix.shift(0.5 * stiffness * 5.0)
        return matrix

    def potential(self, u):
        return 2.5 * float((u - 0.01) @ (u - 0.01))


def test_what_has_no_mass_has_no_spin_to_tell_of(recwarn):
    """Its inertia was 0/0, whose eigenvalues ended the run by an error."""
    fast = box(velocity=lambda x: np.cross([0.0, 0.0, 10.0], x.T - CENTRE).T, name="fast")
    system = nts.System([Weightless(), fast])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.11, t_end=0.11)
    assert run.status == "completed" and run.warnings["turns"].text.startswith("body 'fast' turns")
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]
