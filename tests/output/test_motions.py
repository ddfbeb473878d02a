"""Angles, ways and lengths of joints over time, beside places and velocities of bodies."""

from mpi4py import MPI

import numpy as np
import pytest

import dolfinx_nts as nts
from dolfinx_nts.output import Motions

COMM = MPI.COMM_WORLD


def swinging():
    """A pendulum that turns over, a slider, a screw-like body and a spring between two of them."""
    arm = nts.RigidBody.from_inertia(
        1.0, 3 * [0.01], (1, 0, 0), velocity=(0, 7.0, 0), angular_velocity=(0, 0, 7.0), name="arm",
        comm=COMM,
    )  # fmt: skip
    block = nts.RigidBody.from_inertia(
        2.0, 3 * [0.1], (0, 3, 0), velocity=(0.5, 0, 0), name="block", comm=COMM
    )
    nut = nts.RigidBody.from_inertia(
        1.0, 3 * [0.2], (0, 0, 3), velocity=(0, 0, 0.3), angular_velocity=(0, 0, -2.0), name="nut",
        comm=COMM,
    )  # fmt: skip
    joints = [
        nts.Revolute(arm, None, point=(0, 0, 0), axis=(0, 0, 1), name="hinge"),
        nts.Prismatic(block, None, point=(0, 3, 0), axis=(1, 0, 0), name="slide"),
        nts.Cylindrical(nut, None, point=(0, 0, 3), axis=(0, 0, 1), name="thread"),
        nts.Spring(arm, block, ((1, 0, 0), (0, 3, 0)), stiffness=3.0, name="spring"),
    ]
    return nts.System([arm, block, nut], joints=joints, gravity=(0, -9.81, 0)), joints


@pytest.mark.mpi
def test_motions_are_those_of_the_bodies():
    system, joints = swinging()
    arm, block, nut = system.bodies
    first = nut.rotation.copy()
    motions, rows = Motions(*joints), []

    class Seen:
        def start(self, stepper):
            self.write(stepper)

        def write(self, stepper, *, last=False):
            turn = nut.rotation @ first.T
            apart, moving = arm.position - block.position, arm.velocity - block.velocity
            length = np.linalg.norm(apart)
            rows.append((
                np.arctan2(arm.position[1], arm.position[0]), arm.angular_velocity[2],
                block.position[0], block.velocity[0], nut.position[2] - 3, nut.velocity[2],
                nut.angular_velocity[2], length, apart @ moving / length,
                np.arctan2(turn[1, 0], turn[0, 0]),
            ))  # fmt: skip

        def close(self, stepper):
            pass

    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=2e-2, t_end=1.6, output=[motions, Seen()]
    )
    assert run.status.startswith("completed")
    right = np.array(rows).T
    assert np.array_equal(motions.time, run.balance["time"])
    angle, rate = motions["hinge"].T
    assert angle.max() > 2 * np.pi
    assert angle == pytest.approx(np.unwrap(right[0]), abs=1e-11)
    assert rate == pytest.approx(right[1], abs=1e-10)
    assert motions["slide"].T == pytest.approx(right[2:4], abs=1e-11)
    assert motions["thread way"].T == pytest.approx(right[4:6], abs=1e-11)
    assert motions["thread angle"][:, 0] == pytest.approx(np.unwrap(right[9]), abs=1e-11)
    assert motions["thread angle"][:, 1] == pytest.approx(right[6], abs=1e-11)
    assert motions["spring"].T == pytest.approx(right[7:9], abs=1e-11)
    with pytest.raises(KeyError, match="name='hinges': no such motion; choose from"):
        motions["hinges"]


def test_what_has_no_motion_is_refused():
    system, (hinge, *_) = swinging()
    ball = nts.Spherical(system.bodies[0], None, point=(1, 0, 0))
    with pytest.raises(TypeError, match="joints=.*pass Revolute, Prismatic or Cylindrical"):
        Motions(hinge, ball)
    with pytest.raises(TypeError, match="joints="):
        Motions()
    other, _ = swinging()
    with pytest.raises(ValueError, match="'hinge' is no joint of the system; add it there"):
        nts.simulate(other, nts.EnergyMomentum(), dt=0.1, t_end=0.1, output=[Motions(hinge)])
    with pytest.raises(ValueError, match="are not unique; rename a joint"):
        nts.simulate(
            system, nts.EnergyMomentum(), dt=0.1, t_end=0.1, output=[Motions(hinge, hinge)]
        )
