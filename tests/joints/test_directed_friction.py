"""Friction of ball joints and of planes against closed forms; see theory section 13."""

import numpy as np
import pytest
from integrators import MID_STEP
from measures import differences

import dolfinx_nts as nts

G = 9.81
rules = pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)
pytestmark = pytest.mark.mpi


def body(mass, inertia, name="body", **options):
    """A rigid body at the origin."""
    return nts.RigidBody.from_inertia(mass, inertia, centre=(0, 0, 0), name=name, **options)


def assert_closed(run):
    assert run.status == "completed"
    balance = run.balance
    assert np.abs(balance["ledger_residual"]).max() < 1e-11 * balance["energy"].max()


@rules
def test_a_ball_stops_in_its_socket(rule):
    """About any axis the rate falls by bound/inertia, to the second order of the steps."""
    inertia, bound, errors = 0.3, 0.5, []
    for dt in (0.04, 0.02):
        ball = body(2.0, (inertia,) * 3, angular_velocity=(1.0, 2.0, 2.0))
        friction = nts.JointFriction(bound=bound)
        joint = nts.Spherical(ball, None, point=(0, 0, 0), friction=friction)
        run = nts.simulate(nts.System([ball], joints=[joint]), rule, dt=dt, t_end=2.0)
        assert_closed(run)
        time, kinetic = (run.balance[k] for k in ("time", "kinetic"))
        expected = 0.5 * inertia * np.maximum(3.0 - bound / inertia * time, 0.0) ** 2
        errors.append(np.abs(kinetic - expected)[time < 1.7].max())
        assert kinetic[-1] < 1e-4 * kinetic[0]
    assert errors[1] < 8e-4 and errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


@rules
def test_two_bodies_end_with_their_common_turn(rule):
    """Momenta stay, and all that two rates differ by is lost, whatever the axes."""
    both = [
        body(2.0, (0.3,) * 3, "a", angular_velocity=(1.0, 2.0, 2.0), velocity=(1.0, 0, 0)),
        body(1.0, (0.1,) * 3, "b", angular_velocity=(-2.0, 1.0, 0.0), velocity=(1.0, 0, 0)),
    ]
    friction = nts.JointFriction(bound=0.5)
    joint = nts.Spherical(*both, point=(0, 0, 0), friction=friction)
    run = nts.simulate(nts.System(both, joints=[joint]), rule, dt=0.02, t_end=0.8)
    assert_closed(run)
    momentum = run.balance["angular_momentum"]
    assert np.abs(momentum - momentum[0]).max() < 1e-12
    expected = 0.3 * np.array([1.0, 2.0, 2.0]) + 0.1 * np.array([-2.0, 1.0, 0.0])
    assert momentum[-1] == pytest.approx(expected, abs=1e-12)
    left = 1.5 + 0.5 * expected @ expected / 0.4
    assert run.balance["kinetic"][-1] == pytest.approx(left, rel=1e-4)


@rules
def test_a_ball_rubs_by_what_it_carries(rule):
    """A body that hangs below it and spins upright: the torque is mu r m g."""
    spin, mu, radius = 4.0, 0.2, 0.05
    top = nts.RigidBody.from_inertia(
        2.0, (0.4, 0.4, 0.3), centre=(0, 0, -0.5), angular_velocity=(0, 0, spin), name="top"
    )
    friction = nts.JointFriction(coefficient=mu, radius=radius)
    joint = nts.Spherical(top, None, point=(0, 0, 0), friction=friction)
    system = nts.System([top], joints=[joint], gravity=(0, 0, -G))
    run = nts.simulate(system, rule, dt=0.02, t_end=1.0)
    assert run.status == "completed"
    rate = spin - mu * radius * 2.0 * G / 0.3 * run.balance["time"]
    kinetic = run.balance["kinetic"]
    assert kinetic == pytest.approx(0.5 * 0.3 * rate**2, rel=2e-3)
    assert run.balance["friction_dissipation"] == pytest.approx(kinetic[0] - kinetic, abs=1e-10)


@rules
@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 2, 2)])
def test_a_block_slides_on_a_plane_and_stops(rule, axis):
    """On a straight way of v^2/(2 mu g), by the force at right angles to the plane."""
    n = np.array(axis) / np.linalg.norm(axis)
    along = np.cross(n, (1.0, 0.5, 0.0))
    speed = np.linalg.norm(along)
    block = body(2.0, (0.3,) * 3, velocity=along)
    friction = nts.JointFriction(coefficient=0.3)
    joint = nts.Planar(block, None, point=(0, 0, 0), axis=axis, sliding_friction=friction)
    system = nts.System([block], joints=[joint], gravity=-G * n)
    run = nts.simulate(system, rule, dt=0.02, t_end=0.6)
    assert_closed(run)
    assert block.position == pytest.approx(along * speed / (2 * 0.3 * G), abs=2e-4)


@rules
@pytest.mark.parametrize(("slope", "slides"), [(0.29, False), (0.31, True)])
def test_a_block_slides_where_its_slope_exceeds_the_friction(rule, slope, slides):
    block = body(2.0, (0.3,) * 3)
    friction = nts.JointFriction(coefficient=0.3)
    joint = nts.Planar(block, None, point=(0, 0, 0), axis=(0, 0, 1), sliding_friction=friction)
    down = G * np.array([0.6 * slope, 0.8 * slope, -1.0])
    run = nts.simulate(nts.System([block], joints=[joint], gravity=down), rule, dt=0.02, t_end=0.6)
    assert run.status == "completed"
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-12 * 2.0 * G
    way = 0.5 * (slope - 0.3) * G * 0.6**2 * slides
    assert block.position == pytest.approx((0.6 * way, 0.8 * way, 0.0), abs=1e-11)
    rub = run.mean_of_two_steps(run.reactions[f"{joint.name} sliding friction"])[-1, 0]
    held = 2.0 * G * min(slope, 0.3)
    assert rub == pytest.approx((-0.6 * held, -0.8 * held, 0.0), abs=1e-9)


def test_a_plane_has_limits_friction_and_a_motor_for_its_turn():
    """As of a hinge: driven by 0.5 N m against 0.2 N m up to its limit."""
    block = body(2.0, (0.3,) * 3)
    joint = nts.Planar(
        block, None, point=(0, 0, 0), axis=(0, 0, 1),
        turning_friction=nts.JointFriction(bound=0.2), turning_limits=(-1.0, 0.4),
        turning_motor=lambda t, angle, rate: 0.5,
    )  # fmt: skip
    system = nts.System([block], joints=[joint])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.02, t_end=0.8)
    assert_closed(run)
    assert run.balance["kinetic"][-1] == pytest.approx(0.5 * 0.3 * 0.8**2, rel=2e-5)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.02, t_end=1.2, start=run)
    assert_closed(run)
    assert run.balance["contact_defect"][-1] > 0.05


def test_friction_holds_in_equilibrium():
    """A block that is pulled by less than its friction stays; the friction is the pull."""
    block = body(2.0, (0.3,) * 3, force=(0.3, 0.4, -10.0))
    friction = nts.JointFriction(coefficient=0.1)
    joint = nts.Planar(
        block, None, point=(0, 0, 0), axis=(0, 0, 1),
        sliding_friction=friction, turning_friction=nts.JointFriction(bound=0.1),
    )  # fmt: skip
    rest = nts.equilibrium(nts.System([block], joints=[joint]), load_steps=2)
    assert rest.status == "completed"
    assert block.position == pytest.approx((0, 0, 0), abs=1e-12)
    rub = rest.reactions[f"{joint.name} sliding friction"][-1, 0]
    assert rub == pytest.approx((-0.3, -0.4, 0.0), abs=1e-9)


def test_a_hinge_rebounds_beside_a_ball_with_friction():
    """Impulses that give back energy at a limit know no friction: the rod keeps its rate."""
    rod = body(2.0, (0.3,) * 3, "rod", angular_velocity=(0, 0, 2.0))
    ball = body(1.0, (0.1,) * 3, "ball", angular_velocity=(0, 0, 2.0))
    hinge = nts.Revolute(rod, None, point=(0, 0, 0), axis=(0, 0, 1), limits=(-1.0, 0.5))
    friction = nts.JointFriction(coefficient=0.1, radius=0.01)
    socket = nts.Spherical(ball, rod, point=(0, 0, 0), friction=friction)
    system = nts.System([rod, ball], joints=[hinge, socket])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.02, t_end=0.6, impact="restored")
    assert_closed(run)
    # Nothing presses in the socket, so that the ball turns on.
    assert run.balance["angular_momentum"][-1] == pytest.approx((0, 0, -0.6 + 0.2), abs=1e-3)


@rules
@pytest.mark.parametrize("bound", [0.01, 1e6])
@pytest.mark.parametrize("kind", [nts.Spherical, nts.Planar])
def test_tangent_is_the_derivative_of_the_residual(rule, bound, kind):
    a, b = body(2.0, (0.3, 0.4, 0.5), "a"), body(1.0, (0.1, 0.2, 0.15), "b")
    more = {"friction": nts.JointFriction(bound=bound)}
    if kind is nts.Planar:
        more = {"sliding_friction": more["friction"], "axis": (1, 2, 2)}
    joint = kind(a, b, point=(0.1, 0.2, 0.3), **more)
    stepper = nts.Stepper(nts.System([a, b], joints=[joint]), rule)
    stepper.problem.begin(stepper.state, 0.01)
    (batch,) = (e for e in stepper.problem.elements if e.name.endswith("friction"))
    rng, size = np.random.default_rng(3), batch.num_coordinates
    x = batch.y0 + 0.05 * rng.normal(size=batch.y0.shape)
    own = rng.normal(scale=0.05, size=(len(x), batch.widths["constraints"]))

    def residual(z):
        given = {"augmented": z[:, :0], "constraints": z[:, size:]}
        return batch.evaluate(z[:, :size].reshape(x.shape), given)

    if len(x):
        z = np.hstack([x.reshape(1, size), own])
        found = residual(z)
        assert found.status.all() == (bound > 1.0)
        expected = differences(lambda y: residual(y).residual, z, 1e-6)
        assert np.abs(found.tangent - expected).max() < 1e-6 * np.abs(expected).max()
    stepper.close()


@pytest.mark.parametrize(
    ("kind", "argument", "value", "error", "text"),
    [
        (nts.Spherical, "friction", 0.3, TypeError, "friction=0.3: pass nts.JointFriction"),
        (
            nts.Spherical, "friction", nts.JointFriction(coefficient=0.3), ValueError,
            "pass its radius=",
        ),
        (nts.Planar, "sliding_friction", 0.3, TypeError, "sliding_friction=0.3: pass"),
        (
            nts.Planar, "sliding_friction", nts.JointFriction(coefficient=0.3, radius=0.1),
            ValueError, "has no radius; drop it",
        ),
    ],
)  # fmt: skip
def test_bad_input(kind, argument, value, error, text):
    more = {"axis": (0, 0, 1)} if kind is nts.Planar else {}
    with pytest.raises(error, match=text):
        kind(body(1.0, (1.0,) * 3), None, point=(0, 0, 0), **{argument: value}, **more)
