"""Rigid bodies and joints in runs of every kind: sleeping, adaptive, balanced, continued."""

import pytest

import dolfinx_nts as nts

G = 9.81


def scene(name=""):
    """A pendulum of two links beside a body at rest on a prescribed place."""
    one = nts.RigidBody.from_inertia(2.0, (0.1, 0.2, 0.2), centre=(0.5, 0, 0), name="one")
    two = nts.RigidBody.from_inertia(1.0, (0.1, 0.2, 0.2), centre=(1.5, 0, 0), name="two")
    rests = nts.RigidBody.from_inertia(3.0, (1, 1, 1), centre=(9, 0, 0), motion=(0, 0, 0),
                                       rotation=(0, 0, 0), name="rests")  # fmt: skip
    joints = [
        nts.Revolute(one, None, point=(0, 0, 0), axis=(0, 1, 0), name="pivot"),
        nts.Spherical(one, two, point=(1, 0, 0), name="elbow"),
    ]
    return nts.System([one, two, rests], joints=joints, gravity=(0, 0, -G))


@pytest.mark.mpi
def test_a_joint_of_the_same_name_may_hold_less():
    """A rod that a weld held in equilibrium swings once a hinge of its name holds it."""

    def scene(joint, **axis):
        rod = nts.RigidBody.from_inertia(2.0, 3 * [0.1], (0.5, 0.0, 0.0), name="rod")
        held = joint(rod, None, point=(0, 0, 0), name="hinge", **axis)
        return nts.System([rod], joints=[held], gravity=(0, 0, -9.81))

    still, swings = nts.equilibrium(scene(nts.Fixed)), scene(nts.Revolute, axis=(0, 1, 0))
    run = nts.simulate(
        swings, nts.EnergyMomentum(), dt=1e-3, t_end=1e-2, start=still, start_time=0.0
    )
    assert run.status == "completed"
    # m g s over the moment about the hinge; it falls by less than a degree.
    turned = 2.0 * 9.81 * 0.5 / (0.1 + 2.0 * 0.25) * 1e-2
    assert run.system.bodies[0].angular_velocity == pytest.approx([0, turned, 0], rel=1e-4)


def test_a_start_from_another_body_is_told():
    """A body without a mesh has no mesh object to be used again."""
    ours = [nts.RigidBody.from_inertia(2.0, 3 * [x], name="mass") for x in (0.1, 0.2)]
    known = nts.simulate(nts.System(ours[:1]), nts.Midpoint(), dt=0.1, t_end=0.1)
    with pytest.raises(ValueError, match="body 'mass' has another reference there; give it the m"):
        nts.simulate(nts.System(ours[1:]), nts.Midpoint(), dt=0.1, t_end=0.2, start=known)
