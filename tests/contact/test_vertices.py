"""Cubes that meet vertex on vertex and vertex on edge: their edges alone hold them apart."""

import numpy as np
import pytest
from cubes import ON_EDGE, about_z, turned
from scenes import everywhere

import dolfinx_nts as nts

#: Turned so that a diagonal of the cube is along z.
ON_VERTEX = np.array([[1, -1, 0], [1, 1, -2], [1, 1, 1]]) / np.sqrt([[2], [6], [3]])
#: Half of what is between the ends along z.
EDGE, VERTEX = np.sqrt(0.5), np.sqrt(0.75)


def falling(lower, upper, offset, exchanged, kind=None):
    """A cube falls at 2 m/s; `lower` and `upper` are turns and heights of both."""
    above = np.array([*offset, lower[1] + upper[1] + 0.02])
    speed = {"velocity": (0, 0, -2.0)}
    bodies = [
        turned(lower[0], np.zeros(3), "lower", kind=kind),
        turned(upper[0], above, "upper", kind=kind, **speed),
    ]
    surfaces = [body.surface(everywhere) for body in bodies]
    pair = nts.ContactPair(*(surfaces if exchanged else surfaces[::-1]), friction=0.3)
    return nts.System(bodies, contacts=[pair])


SCENES = {
    "vertices": ((ON_VERTEX, VERTEX), (ON_VERTEX, VERTEX)),
    "vertices, turned": ((ON_VERTEX, VERTEX), (about_z(60.0) @ ON_VERTEX, VERTEX)),
    "vertex on edge": ((ON_EDGE, EDGE), (ON_VERTEX, VERTEX)),
    "edge on vertex": ((ON_VERTEX, VERTEX), (ON_EDGE, EDGE)),
}


def after(system):
    """Velocities and spins of both, shape (2, 6)."""
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.06, accuracy="exact")
    assert run.status == "completed"
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * run.balance["energy"][0]
    assert run.balance["min_gap"].min() > -1e-12
    moving = [nts.motion_of(body) for body in system.bodies]
    return np.array([[*m.velocity, *m.spin] for m in moving])


@pytest.mark.mpi
@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("scene", ["vertices", "vertices, turned"])
@pytest.mark.fast("vertices-True", "vertices, turned-False", "vertices, turned-True")
@pytest.mark.fast_on_ranks()
def test_rigid_cubes_that_meet_on_their_axis_exchange_their_velocities(scene, exchanged):
    """An elastic central impact of equal masses; three faces or edges carry alike."""
    found = after(falling(*SCENES[scene], (0.0, 0.0), exchanged, nts.RigidBody))
    right = np.zeros((2, 6))
    right[0, 2] = -2.0
    np.testing.assert_allclose(found, right, atol=2e-3)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.fast("vertices")
def test_it_does_not_matter_which_cube_is_the_slave(scene):
    """Beside the axis one pair of edges carries, in whatever roles."""
    one, two = (after(falling(*SCENES[scene], (0.03, 0.02), e)) for e in (False, True))
    assert np.abs(one[0]).max() > 1e-3
    np.testing.assert_allclose(one, two, atol=1e-8 * np.abs(one).max())
