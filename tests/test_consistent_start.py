"""Starts that fit the joints: refused, projected, and first accelerations under constraints."""

import numpy as np
import pytest
from integrators import INTEGRATORS
from scipy.integrate import solve_ivp

import dolfinx_nts as nts

MASS, INERTIA, ARM, G = 2.0, 0.5, 0.7, 9.81


def pendulum(**options):
    """A body hinged about y at the origin, its centre at (ARM, 0, 0)."""
    body = nts.RigidBody.from_inertia(
        MASS, (0.2, INERTIA, 0.4), centre=(ARM, 0, 0), name="bob", **options
    )
    hinge = nts.Revolute(body, None, point=(0, 0, 0), axis=(0, 1, 0), name="hinge")
    return body, nts.System([body], joints=[hinge], gravity=(0, 0, -G))


@pytest.mark.mpi
def test_a_start_that_violates_a_joint_is_refused_by_name_and_amount():
    _, system = pendulum(velocity=(0.3, 0, 0))
    with pytest.raises(ValueError, match=r"joint 'hinge' is violated at 0\.3 m/s.*project_start"):
        nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.1)
    with pytest.raises(TypeError, match="project_start='yes'"):
        nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.1, project_start="yes")


@pytest.mark.mpi
@pytest.mark.parametrize("rule", [nts.EnergyMomentum(), nts.GeneralizedAlpha()], ids=["em", "ga"])
def test_a_projected_start_is_that_after_an_impulse_of_the_hinge(rule):
    """The velocity (0.3, 0, 1) of the centre leaves m ARM / (J + m ARM^2) as spin about -y."""
    body, system = pendulum(velocity=(0.3, 0, 1))
    stepper = nts.Stepper(system, rule, project_start=True)
    stepper.start(0.01)
    spin = MASS * ARM / (INERTIA + MASS * ARM**2)
    assert body.angular_velocity == pytest.approx([0, -spin, 0], abs=1e-12)
    assert body.velocity == pytest.approx([0, 0, spin * ARM], abs=1e-12)
    if rule.accelerations:
        # omega' = -m g ARM / (J + m ARM^2); the centre goes round at omega^2 ARM.
        turn = -MASS * G * ARM / (INERTIA + MASS * ARM**2)
        local = stepper.state.a[0]
        a = np.concatenate(body.comm.allgather(local))[:3]
        assert a == pytest.approx([-(spin**2) * ARM, 0, turn * ARM], abs=1e-10)
    stepper.close()


def exact(t):
    """Angle below the horizontal after a time, by SciPy, from rest at the horizontal."""
    rate = MASS * G * ARM / (INERTIA + MASS * ARM**2)
    found = solve_ivp(
        lambda _, s: [s[1], rate * np.cos(s[0])], (0, t), [0, 0], rtol=1e-12, atol=1e-13
    )
    return found.y[0, -1]


@pytest.mark.parametrize("rule", INTEGRATORS.values(), ids=INTEGRATORS)
@pytest.mark.fast("energy-momentum", "generalized-alpha")
def test_a_pendulum_swings_with_second_order(rule):
    errors, t = [], 0.4
    for dt in (0.02, 0.01):
        body, system = pendulum()
        run = nts.simulate(system, rule, dt=dt, t_end=t)
        angle = np.arctan2(-body.position[2], body.position[0])
        errors.append(abs(angle - exact(t)))
        assert run.status.startswith("completed")
        assert np.linalg.norm(body.position) == pytest.approx(ARM, rel=1e-12)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


def test_reactions_of_a_pendulum_that_hangs():
    """At rest below the hinge: force on the body is its weight, moment is none."""
    body = nts.RigidBody.from_inertia(MASS, (0.2, INERTIA, 0.4), centre=(0, 0, -ARM), name="bob")
    hinge = nts.Revolute(body, None, point=(0, 0, 0), axis=(0, 1, 0), name="hinge")
    system = nts.System([body], joints=[hinge], gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.05)
    assert run.reactions["hinge"].shape == (6, 2, 3)
    assert run.reactions["hinge"][1:, 0] == pytest.approx(np.tile([0, 0, MASS * G], (5, 1)))
    assert np.abs(run.reactions["hinge"][1:, 1]).max() < 1e-9


def test_a_cantilevered_body_is_held_by_force_and_moment():
    """Fixed at the origin with its centre at (ARM, 0, 0): m g, and m g ARM about -y against it."""
    body = nts.RigidBody.from_inertia(MASS, (0.2, INERTIA, 0.4), centre=(ARM, 0, 0), name="bob")
    system = nts.System(
        [body], joints=[nts.Fixed(body, None, point=(0, 0, 0), name="wall")], gravity=(0, 0, -G)
    )
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.05)
    force, moment = run.reactions["wall"][-1]
    assert force == pytest.approx([0, 0, MASS * G], abs=1e-8)
    assert moment == pytest.approx([0, -MASS * G * ARM, 0], abs=1e-8)
    with pytest.raises(ValueError, match="joints, bodies: both have the names"):
        nts.System([body], joints=[nts.Fixed(body, None, point=(0, 0, 0), name="bob")])
