"""Rigid bodies and joints in runs of every kind: sleeping, adaptive, balanced, continued."""

import numpy as np
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


def places(system):
    return np.concatenate([body.position for body in system.bodies])


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("options", "promise"),
    [({}, 1e-11), ({"sleep": True}, 1e-11), ({"accuracy": "balanced"}, 1e-8)],
    ids=["exact", "sleep", "balanced"],
)
@pytest.mark.fast_on_ranks("balanced")
def test_the_ledger_of_a_double_pendulum(options, promise):
    system = scene()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=0.1, **options)
    table = run.balance
    size = np.abs(table["external_work"]).max()
    assert run.status == "completed" and run.retries == 0
    assert np.abs(table["ledger_residual"]).max() < promise * size
    known = scene()
    nts.simulate(known, nts.EnergyMomentum(), dt=1e-2, t_end=0.1)
    assert places(system) == pytest.approx(places(known), abs=1e-6)


@pytest.mark.slow
def test_adaptive_steps_of_a_double_pendulum():
    system, known = scene(), scene()
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=0.05, t_end=0.5, adapt=nts.Adapt(tolerance=1e-3)
    )
    nts.simulate(known, nts.EnergyMomentum(), dt=1e-3, t_end=0.5)
    size = np.abs(run.balance["external_work"]).max()
    assert run.status == "completed"
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * size
    assert np.abs(places(system) - places(known)).max() < 5e-3


@pytest.mark.parametrize(
    "rule", [nts.EnergyMomentum(), nts.GeneralizedAlpha()], ids=["em", "ga"]
)
@pytest.mark.fast("ga")
def test_two_halves_are_one_run(rule):
    """A run that goes on remembers the joints' multipliers."""
    whole, first, second = scene(), scene(), scene()
    run = nts.simulate(whole, rule, dt=5e-3, t_end=0.2)
    half = nts.simulate(first, rule, dt=5e-3, t_end=0.1)
    rest = nts.simulate(second, rule, dt=5e-3, t_end=0.2, start=half)
    assert rest.status == run.status == "completed"
    assert places(second) == pytest.approx(places(whole), abs=1e-11)
    for name in ("pivot", "elbow"):
        assert rest.reactions[name][-1] == pytest.approx(run.reactions[name][-1], abs=1e-6)


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
