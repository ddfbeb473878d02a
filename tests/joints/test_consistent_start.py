"""Starts that fit the joints: refused, projected, and first accelerations under constraints."""

import numpy as np
import pytest
from integrators import INTEGRATORS
from scenes import box
from scipy.integrate import solve_ivp

import dolfinx_nts as nts
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.solve.convergence import ratios

MASS, INERTIA, ARM, G = 2.0, 0.5, 0.7, 9.81
Z = np.array([0.0, 0.0, 1.0])


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
    with pytest.raises(ValueError, match=r"joint 'hinge' is violated at .* 0\.3;.*project_start"):
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
@pytest.mark.fast("energy-momentum")
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


@pytest.mark.mpi
@pytest.mark.parametrize("metre", [1e-6, 1.0, 1e3])
def test_what_a_mesh_does_to_a_start_is_projected_and_told(metre):
    """A wheel whose centre of mass lies a hair beside its axle; what is further off is refused."""
    def wheel(off):
        low, high = (metre * np.array([off + s, s, 0.2 * s]) for s in (-0.5, 0.5))
        body = nts.RigidBody(box(low, high, 1), density=metre**-3, angular_velocity=(0, 0, 5))
        hinge = nts.Revolute(body, None, point=(0, 0, 0), axis=(0, 0, 1), name="axle")
        return body, nts.System([body], joints=[hinge])

    off = 1e-6
    body, system = wheel(off)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.02)
    # 0.2 kg; the moment of the square about its middle is 1/6 of that.
    spin = 5.0 / (1.0 + 6.0 * off**2)
    assert run.status == "completed"
    assert body.angular_velocity[2] == pytest.approx(spin, rel=1e-9)
    told = run.warnings["start projected"]
    assert told.worst == pytest.approx(5.0 * off * metre, rel=1e-6)
    assert "'axle' was violated at" in told.text
    _, system = wheel(0.01)
    with pytest.raises(ValueError, match=r"joint 'axle' is violated at .*project_start"):
        nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.02)


def rod(name, a, b, va, vb):
    """A thin rod of 1 m and 1 kg between two points that have these velocities."""
    axis = b - a
    columns = np.column_stack([axis, np.cross(Z, axis), Z])
    return nts.RigidBody.from_inertia(
        1.0, (0.0, 1 / 12, 1 / 12), 0.5 * (a + b), columns, velocity=0.5 * (va + vb),
        angular_velocity=np.cross(axis, vb - va), name=name,
    )  # fmt: skip


def four_bars(number, angle, spin):
    """So many four-bars side by side, 1 m apart; cranks at an angle from the vertical."""
    x = np.arange(number + 1.0)[:, None] * [1.0, 0.0, 0.0]
    arm = np.array([np.sin(angle), np.cos(angle), 0.0])
    v, none = spin * np.array([np.cos(angle), -np.sin(angle), 0.0]), np.zeros(3)
    cranks = [rod(f"crank {k}", p, p + arm, none, v) for k, p in enumerate(x)]
    links = [rod(f"link {k}", p + arm, p + x[1] + arm, v, v) for k, p in enumerate(x[:-1])]
    joints = [nts.Revolute(None, c, point=p, axis=Z) for c, p in zip(cranks, x, strict=True)]
    for k, link in enumerate(links):
        joints += [
            nts.Revolute(crank, link, point=x[k + end] + arm, axis=Z)
            for end, crank in enumerate(cranks[k : k + 2])
        ]
    return cranks, nts.System(cranks + links, joints=joints, gravity=(0, -G, 0))


@pytest.mark.slow
def test_a_long_mechanism_passes_where_it_is_singular():
    """40 m of four-bars as they lie flat: the rounding of the far end is in the near joints, too.

    All cranks obey one pendulum's equation, here integrated by SciPy.
    """
    n, t, start = 40, 0.2, [10.40380084250513, 5.9545341601223605]
    pull = G * ((n + 1) / 2 + n) / ((n + 1) / 3 + n)
    exact = solve_ivp(
        lambda _, y: [y[1], pull * np.sin(y[0])], (0, t), start, rtol=1e-12, atol=1e-13
    ).y[0, -1]
    assert (start[0] - 3.5 * np.pi) * (exact - 3.5 * np.pi) < 0.0
    cranks, system = four_bars(n, *start)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=t)
    assert run.status == "completed"
    end = 2.0 * cranks[0].position
    assert end[:2] == pytest.approx([np.sin(exact), np.cos(exact)], abs=1e-3)


def test_joints_know_how_far_their_mechanism_reaches():
    """Rounding of 1e4 m is none of a mechanism of 1 m in the same scene."""
    far = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="far")
    near = nts.RigidBody.from_inertia(1.0, (1, 1, 1), centre=(0, 3, 0), name="near")
    joints = [
        nts.Spherical(far, None, point=(0, 0, 0), name="of the long one"),
        nts.Spherical(far, None, point=(1e4, 0, 0), name="far end"),
        nts.Spherical(near, None, point=(0, 3, 0), name="of the short one"),
    ]
    problem = StepProblem(
        nts.System([far, near], joints=joints), nts.EnergyMomentum(), rtol=1e-12, condense=True
    )
    problem.begin(problem.system.initial_state(), 1e-3)
    with problem.x as x:
        for k in (0, 1):
            x[problem.laid.of_body(k)][:3] += 1e-13
    found = ratios(problem, problem.evaluate(problem.x))
    # Eight roundings of each of the two places that meet.
    limit = 16.0 * np.finfo(float).eps * 1e4
    assert found["of the long one constraints"] == pytest.approx(1e-13 / limit, rel=1e-3)
    assert found["of the short one constraints"] > 1.0
    problem.destroy()
