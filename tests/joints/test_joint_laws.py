"""Friction, limits and motors of joints against closed forms; see theory section 22."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from integrators import ACCELERATED, MID_STEP
from measures import dense, differences, relative
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, lsq_linear

import dolfinx_nts as nts
from dolfinx_nts.interaction.measured import Measured
from dolfinx_nts.solve.rubbing_joints import RubbingJoints

COMM = MPI.COMM_WORLD
G = 9.81
MASS, ARM, INERTIA = 1.5, 0.5, 0.2
#: Of small swings of a pendulum.
PERIOD = 2 * np.pi * np.sqrt((0.1 + MASS * ARM**2) / (MASS * G * ARM))
rules = pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)
pytestmark = pytest.mark.mpi


def disc(spin, unit=1.0, **laws):
    """It turns about z."""
    inertia = np.array([0.1, 0.1, INERTIA]) * unit**5
    body = nts.RigidBody.from_inertia(unit**3, inertia, name="disc", angular_velocity=(0, 0, spin))
    hinge = nts.Revolute(body, None, point=(0, 0, 0), axis=(0, 0, 1), name="hinge", **laws)
    return body, nts.System([body], joints=[hinge])


def pendulum(**laws):
    """Horizontal at the start, about y; its weight turns it by positive angles."""
    body = nts.RigidBody.from_inertia(MASS, (0.01, 0.1, 0.1), centre=(ARM, 0, 0), name="arm")
    hinge = nts.Revolute(body, None, point=(0, 0, 0), axis=(0, 1, 0), name="hinge", **laws)
    return body, nts.System([body], joints=[hinge], gravity=(0, 0, -G))


def pin(friction, argument):
    """Of a rod along z in a sleeve."""
    rod = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="rod")
    return nts.Cylindrical(rod, None, point=(0, 0, 0), axis=(0, 0, 1), **{argument: friction})


def slider(tilt, speed=0.0, **laws):
    """On a slope along x, turned by `tilt` about y."""
    axis = np.array([np.cos(tilt), 0, -np.sin(tilt)])
    body = nts.RigidBody.from_inertia(MASS, (1, 1, 1), name="slider", velocity=speed * axis)
    rail = nts.Prismatic(body, None, point=(0, 0, 0), axis=axis, name="rail", **laws)
    return body, axis, nts.System([body], joints=[rail], gravity=(0, 0, -G))


def angle(body):
    """Of a pendulum."""
    return -np.arctan2(body.position[2], body.position[0])


def assert_closed(run):
    table = run.balance
    top = max(np.abs(table[name]).max() for name in ("kinetic", "potential", "external_work"))
    assert run.status == "completed"
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * top
    assert (np.diff(table["friction_dissipation"]) >= -1e-14 * top).all()


@pytest.mark.parametrize(
    ("rule", "unit"), zip(MID_STEP.values(), (1.0, 1e-3), strict=True), ids=MID_STEP
)
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_friction_stops_a_disc(rule, unit):
    """omega = omega_0 - b t/I, until it stands; all of its energy is dissipated."""
    bound, spin = 0.3 * unit**5, 5.0
    body, system = disc(spin, unit, friction=nts.JointFriction(bound=bound))
    run = nts.simulate(system, rule, dt=0.02, t_end=4.0)
    assert_closed(run)
    time, energy = run.balance["time"], run.balance["kinetic"]
    omega = spin - bound * time / (INERTIA * unit**5)
    assert np.allclose(energy / unit**5, 0.5 * INERTIA * np.maximum(omega, 0) ** 2, atol=2e-3)
    assert run.balance["friction_dissipation"][-1] == pytest.approx(energy[0], rel=1e-3)
    # It stands, and what the scheme leaves of the last step's speed alternates.
    turned = body.rotation @ np.eye(3)
    nts.simulate(system, rule, dt=0.02, t_end=4.1, start=run)
    assert np.allclose(body.rotation, turned, atol=1e-12)


@pytest.mark.parametrize("stabilization", [None, 1.0])
@pytest.mark.parametrize("off", [0.0, 3e-15, 7e-15])
def test_a_clutch_slips_at_rest(stabilization, off):
    """A spring of 2 N m/rad turns by 0.5 rad under a clutch of 1 N m that is driven farther.

    The second load step ends just where it begins to slip, whatever rounding says.
    """
    inertia = (0.1, 0.1, INERTIA)
    crank, turned = (nts.RigidBody.from_inertia(1.0, inertia, name=n) for n in ("crank", "turned"))
    about = {"point": (0, 0, 0), "axis": (0, 0, 1)}
    joints = [
        nts.Revolute(crank, None, angle=lambda t: t, name="drive", **about),
        nts.Revolute(turned, crank, friction=nts.JointFriction(bound=1.0), name="clutch", **about),
        nts.TorsionSpring(turned, None, axis=(0, 0, 1), stiffness=2.0 + off, name="spring"),
    ]
    system = nts.System([crank, turned], joints=joints)
    run = nts.equilibrium(system, load_steps=[0.25, 0.5, 0.75, 1.0], stabilization=stabilization)
    assert run.status == "completed" and not run.retries
    assert np.arctan2(turned.rotation[1, 0], turned.rotation[0, 0]) == pytest.approx(0.5)
    lost = run.balance["friction_dissipation"]
    assert lost == pytest.approx([0, 0, 0, 0.25, 0.5], abs=1e-9)


@rules
def test_friction_holds_a_pendulum(rule):
    """A bound above the moment of the weight: it rests, and friction carries that moment."""
    moment = MASS * G * ARM
    body, system = pendulum(friction=nts.JointFriction(bound=1.01 * moment))
    run = nts.simulate(system, rule, dt=0.01, t_end=0.1)
    assert run.status == "completed" and abs(angle(body)) < 1e-12
    assert np.allclose(run.reactions["hinge friction"][1:, 1], [0, -moment, 0], atol=1e-9)
    body, system = pendulum(friction=nts.JointFriction(bound=0.99 * moment))
    nts.simulate(system, rule, dt=0.01, t_end=0.1)
    assert angle(body) > 1e-6


@pytest.mark.fast_on_ranks()
def test_a_pendulum_bounces_on_its_limit_until_friction_has_it():
    """It never passes the limit, and gains nothing there; at rest, friction and limit carry it."""
    seen = []
    body, system = pendulum(limits=(-np.inf, 0.5), friction=nts.JointFriction(bound=1.0))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    for _ in range(250):
        stepper.advance(1e-2)
        seen.append(angle(body))
    assert max(seen) < 0.5 + 1e-10 and max(seen[:40]) > 0.45
    assert seen[-1] == pytest.approx(0.5, abs=1e-3)
    assert np.ptp(seen[-20:]) < 1e-3
    table = stepper.solution.balance
    assert (np.diff(table["contact_defect"]) >= -1e-12).all()
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * table["external_work"].max()


@rules
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_a_door_rests_where_both_hinges_hold_it_twice(rule):
    """Each has friction and the same limit; together they bear the moment of the weight."""
    door = nts.RigidBody.from_inertia(MASS, (0.01, 0.1, 0.1), centre=(ARM, 0, 0), name="door")
    friction = nts.JointFriction(bound=1.0)
    hinges = [
        nts.Revolute(
            door, None, point=(0, y, 0), axis=(0, 1, 0), name=f"hinge {y}",
            limits=(-1.0, 0.3), friction=friction,
        )
        for y in (-0.2, 0.2)
    ]  # fmt: skip
    system = nts.System([door], joints=hinges, gravity=(0, 0, -G))
    run = nts.simulate(system, rule, dt=0.02, t_end=2.0)
    assert_closed(run)
    assert angle(door) == pytest.approx(0.3, abs=1e-12)
    held = sum(
        run.reactions[f"hinge {y} {law}"][-2:, 1, 1].mean()
        for y in (-0.2, 0.2) for law in ("limits", "friction")
    )  # fmt: skip
    assert held == pytest.approx(-MASS * G * ARM * np.cos(0.3), rel=1e-6)


@pytest.mark.parametrize("bound", [0.5, 5.0])
def test_hinges_of_a_long_chain_begin_to_slip(bound):
    """50 links that stand out horizontally: which hinges go is a problem of all of them at once.

    Accelerations at rest make a^T M a/2 - weight^T a + bound sum|a| least; the torques are its
    dual, a least squares problem with bounds.
    """
    links, length, mass, dt = 50, 0.1, 0.1, 1e-3
    inertia, joints, bodies = mass * length**2 / 12, [], []
    for k in range(links):
        bodies.append(
            nts.RigidBody.from_inertia(
                mass,
                (0.1 * inertia, inertia, inertia),
                name=f"link {k}",
                centre=(length * (k + 0.5), 0, 0),
            )  # fmt: skip
        )
        joints.append(
            nts.Revolute(
                bodies[k],
                bodies[k - 1] if k else None,
                point=(length * k, 0, 0),
                axis=(0, 1, 0),
                friction=nts.JointFriction(bound=bound),
                name=f"hinge {k}",
            )  # fmt: skip
        )
    system = nts.System(bodies, joints=joints, gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=dt)
    assert run.status == "completed"
    arm = length * (np.arange(links) + 0.5 - np.arange(links)[:, None])
    # Angles are from link to link, and a hinge moves what is beyond it.
    beyond = arm * (arm > 0.0)
    turned = np.triu(np.ones((links, links)))
    matrix = mass * beyond @ beyond.T + inertia * turned @ turned.T
    weight = mass * G * beyond.sum(axis=1)
    root = np.linalg.cholesky(np.linalg.inv(matrix)).T
    dual = lsq_linear(root, root @ weight, (-bound, bound), method="bvls", tol=1e-14).x
    # Which hinges go is well conditioned, how far is so without those that stick.
    slides, right = np.abs(dual) > (1.0 - 1e-9) * bound, np.zeros(links)
    pulled = (weight - bound * np.sign(dual))[slides]
    right[slides] = np.linalg.solve(matrix[np.ix_(slides, slides)], pulled)
    assert slides.any() and (right * np.sign(dual) >= 0.0).all()
    torques = [run.reactions[f"hinge {k} friction"][-1, 1, 1] for k in range(links)]
    assert torques == pytest.approx(matrix @ right - weight, abs=1e-5 * bound)
    angles = np.array([np.arctan2(-b.rotation[2, 0], b.rotation[0, 0]) for b in bodies])
    slips = np.diff(angles, prepend=0.0)
    assert slips == pytest.approx(0.5 * dt**2 * right, abs=1e-6 * dt**2 * np.abs(right).max())
    assert_closed(run)
    took = run.joint_works["friction_dissipation"]
    each = np.array([took[f"hinge {k} friction"][-1] for k in range(links)])
    works = bound * 0.5 * dt**2 * np.abs(right)
    assert each == pytest.approx(works, abs=1e-5 * works.max())
    assert each.sum() == pytest.approx(run.balance["friction_dissipation"][-1], rel=1e-12)


@rules
@pytest.mark.fast("midpoint")
@pytest.mark.fast_on_ranks()
def test_a_slider_with_friction_and_an_end(rule):
    """It slides v^2/(2 b/m) on the level; on a slope it ends at its limit."""
    body, axis, system = slider(0.0, 2.0, friction=nts.JointFriction(bound=3.0))
    run = nts.simulate(system, rule, dt=0.01, t_end=2.0)
    assert_closed(run)
    assert body.position @ axis == pytest.approx(2.0**2 / (2 * 3.0 / MASS), rel=1e-4)
    body, axis, system = slider(0.4, limits=(-0.1, 0.3))
    run = nts.simulate(system, rule, dt=0.01, t_end=1.0)
    assert_closed(run)
    assert body.position @ axis == pytest.approx(0.3, abs=1e-11)


@pytest.mark.parametrize("rule", (MID_STEP | ACCELERATED).values(), ids=MID_STEP | ACCELERATED)
@pytest.mark.fast("generalized-alpha")
@pytest.mark.fast_on_ranks()
def test_a_controller_holds_an_angle(rule):
    """T = -k (a - a_0) - d da/dt rests where k (a - a_0) is the moment of the weight."""
    stiff, damping, wanted = 50.0, 10.0, 0.3
    body, system = pendulum(motor=lambda t, a, rate: -stiff * (a - wanted) - damping * rate)
    run = nts.simulate(system, rule, dt=0.02, t_end=4.0)
    rest = brentq(lambda a: stiff * (a - wanted) - MASS * G * ARM * np.cos(a), 0.0, 1.0)
    assert angle(body) == pytest.approx(rest, abs=1e-6)
    if rule in MID_STEP.values():
        assert_closed(run)


def test_a_motor_is_not_asked_about_an_iterate_that_runs_off():
    """So that the step is cut, and the user's function is not blamed."""
    asked = []

    def motor(time, angle, rate):
        asked.append((angle, rate))
        return 2.0 * angle + rate

    rod = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="rod")
    hinge = nts.Revolute(rod, None, point=(0, 0, 0), axis=(0, 0, 1), motor=motor)
    at, rate = np.array([np.nan, 0.5, 0.1]), np.array([1.0, 3.0, np.inf])
    np.testing.assert_array_equal(hinge.parts[0].law._ask(0.0, at, rate), [np.nan, 4.0, np.nan])
    assert asked == [(0.5, 3.0)]


def test_a_motor_that_raises_is_told_with_time_and_line(caplog):
    """Of the step in whose middle it does; the traceback is for those who ask for it."""

    def motor(t, angle, rate):
        return 1.0 / (t < 0.5)

    line = motor.__code__.co_firstlineno + 1
    _, system = disc(0.0, motor=motor)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.1, t_end=1.0)
    assert run.balance["time"][-1] == pytest.approx(0.5, rel=1e-12)
    assert run.status.startswith("motor of 'hinge' at t=0.55: ")
    assert f"raised ZeroDivisionError('float division by zero'), line {line} of" in run.status
    told = [record for record in caplog.records if record.levelname == "WARNING"]
    assert told and not any(record.exc_info for record in told)


def spinning(**laws):
    """A body on a rail along z, about which it turns, too; it rises by 1 m/s and turns by 2/s."""
    body = nts.RigidBody.from_inertia(
        MASS, (0.1, 0.1, INERTIA), name="nut", velocity=(0, 0, 1.0), angular_velocity=(0, 0, 2.0)
    )
    rail = nts.Cylindrical(body, None, point=(0, 0, 0), axis=(0, 0, 1), name="rail", **laws)
    return body, nts.System([body], joints=[rail])


@pytest.mark.slow
def test_laws_of_a_cylindrical_joint_act_on_its_way_and_its_angle():
    """Friction that brakes both, each after v^2 m/(2 b); a motor that makes it a screw."""
    rule = nts.EnergyMomentum()
    friction = {
        "sliding_friction": nts.JointFriction(bound=3.0),
        "turning_friction": nts.JointFriction(bound=0.4),
    }
    body, system = spinning(**friction)
    run = nts.simulate(system, rule, dt=0.01, t_end=1.5)
    assert_closed(run)
    assert body.position[2] == pytest.approx(1.0 * MASS / (2 * 3.0), rel=1e-3)
    turned = np.arctan2(body.rotation[1, 0], body.rotation[0, 0])
    assert turned == pytest.approx(2.0**2 * INERTIA / (2 * 0.4), rel=1e-3)
    body, system = spinning(
        sliding_limits=(-0.5, 0.2), sliding_motor=lambda t, s, rate: 2.0 - 6.0 * rate,
        turning_limits=(-0.5, 0.5), turning_motor=lambda t, a, rate: -1.0 - 0.3 * rate,
        turning_friction=nts.JointFriction(bound=0.1),
    )  # fmt: skip
    run = nts.simulate(system, rule, dt=0.01, t_end=3.0)
    assert run.status == "completed"
    assert body.position[2] == pytest.approx(0.2, abs=1e-11)
    assert np.arctan2(body.rotation[1, 0], body.rotation[0, 0]) == pytest.approx(-0.5, abs=1e-11)
    held = run.reactions["rail sliding limits"][-2:, 0, 2].mean()
    assert held == pytest.approx(-2.0, abs=1e-6)
    means = run.mean_of_two_steps(run.reactions["rail sliding limits"])
    assert means[-1, 0, 2] == pytest.approx(held, abs=1e-12)


@pytest.mark.parametrize(
    ("unit", "rule"), zip((1e-3, 1.0), MID_STEP.values(), strict=True), ids=MID_STEP
)
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_a_ball_joint_lets_an_arm_fall_to_its_cone(rule, unit):
    """A pendulum on a ball joint with a damper comes to rest 0.4 rad below the horizontal."""
    body = nts.RigidBody.from_inertia(
        MASS * unit**3, np.array([0.01, 0.1, 0.1]) * unit**5, centre=(ARM * unit, 0, 0), name="arm"
    )
    ball = nts.Spherical(body, None, point=(0, 0, 0), cone=((3.0, 0, 0), 0.4), name="ball")
    friction = nts.TorsionDamper(body, None, axis=(0, 1, 0), damping=2.0 * unit**5)
    system = nts.System([body], joints=[ball, friction], gravity=(0, 0, -G * unit))
    run = nts.simulate(system, rule, dt=0.02, t_end=2.0)
    assert_closed(run)
    assert angle(body) == pytest.approx(0.4, abs=1e-10)
    assert body.position[1] == pytest.approx(0.0, abs=1e-12 * unit)
    moment = MASS * G * ARM * np.cos(0.4) * unit**5
    # At rest on a limit what the scheme leaves of the last step's speed alternates.
    held = run.reactions["ball cone"][-2:, 1, 1].mean()
    assert held == pytest.approx(-moment, rel=1e-6)


@pytest.mark.parametrize("rule", (MID_STEP | ACCELERATED).values(), ids=MID_STEP | ACCELERATED)
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_actuators_make_an_oscillator(rule):
    """T = -k a about an axis, F = -k (l - l_0) along a line: half a period, by the second order."""
    stiff, start = 0.2, 0.5
    omega = np.sqrt(stiff / INERTIA)
    disc_ = nts.RigidBody.from_inertia(1.0, (0.1, 0.1, INERTIA), name="disc")
    mass = nts.RigidBody.from_inertia(MASS, (1, 1, 1), centre=(3.0, 0, 0), name="mass")
    joints = [
        nts.Revolute(disc_, None, point=(0, 0, 0), axis=(0, 0, 1)),
        nts.Torque(
            disc_, None, axis=(0, 0, 2), torque=lambda t, a, rate: -stiff * (a - start), name="coil"
        ),
        nts.Thrust(
            mass, None, [(3.0, 0, 0), (0, 0, 0)], name="cylinder",
            force=lambda t, x, rate: -omega**2 * MASS * (x - 2.5),
        ),
    ]  # fmt: skip
    run = nts.simulate(nts.System([disc_, mass], joints=joints), rule, dt=0.02, t_end=np.pi / omega)
    assert np.arctan2(disc_.rotation[1, 0], disc_.rotation[0, 0]) == pytest.approx(1.0, abs=2e-4)
    assert mass.position == pytest.approx([2.0, 0, 0], abs=2e-4)
    if rule in MID_STEP.values():
        assert_closed(run)


@pytest.mark.parametrize("rule", ACCELERATED.values(), ids=ACCELERATED)
def test_laws_that_let_go_ask_for_another_integrator(rule):
    _, system = disc(1.0, friction=nts.JointFriction(bound=0.1))
    with pytest.raises(ValueError, match="'hinge friction' may hold and let go.*EnergyMomentum"):
        nts.Stepper(system, rule)


@pytest.mark.parametrize(
    ("laws", "error", "text"),
    [
        ({"friction": 0.3}, TypeError, r"friction=0\.3: pass nts\.JointFriction"),
        ({"limits": (0.2, 0.5)}, ValueError, r"limits=\(0\.2, 0\.5\): .* count from the start"),
        ({"limits": (None, 0.5)}, ValueError, r"limits=\(None, 0\.5\): .*-math\.inf or math\.inf"),
        (
            {"limits": (-1.0, 0.2), "angle": lambda t: t},
            ValueError,
            r"limits=\(-1\.0, 0\.2\) of 'hinge': its motion is prescribed",
        ),
        (
            {"motor": lambda t, a, w: 1.0, "angle": lambda t: t},
            ValueError,
            "of 'hinge': its motion is prescribed, which no motor changes",
        ),
        ({"limits": 1.0}, ValueError, r"limits=1\.0: pass the smallest"),
        ({"motor": 2.0}, TypeError, r"motor=2\.0: pass a function of time"),
    ],
)
def test_wrong_laws(laws, error, text):
    with pytest.raises(error, match=text):
        disc(0.0, **laws)
    for given, text in (
        ({"bound": 0.0}, "bound=0.0: must be"),
        ({}, "bound=None, coefficient=None: pass exactly one"),
        ({"bound": 1.0, "coefficient": 0.1}, "pass exactly one"),
        ({"bound": 1.0, "radius": 0.1}, "radius=0.1: goes with coefficient="),
    ):
        with pytest.raises(ValueError, match=text):
            nts.JointFriction(**given)
    with pytest.raises(ValueError, match="turning_friction=.*: pass its radius=, too"):
        pin(nts.JointFriction(coefficient=0.1), "turning_friction")
    with pytest.raises(ValueError, match="sliding_friction=.*: what slides has no radius"):
        pin(nts.JointFriction(coefficient=0.1, radius=0.1), "sliding_friction")
    wrong = [(0, 0, 1), ((0, 0, 1), 0.0), ((0, 0, 1), 4.0), 0.5, ((0, 0, 1), "far")]
    for given in wrong:
        body = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="a")
        with pytest.raises(ValueError, match=r"cone=.* of 'ball': pass a direction and the"):
            nts.Spherical(body, None, point=(0, 0, 0), cone=given, name="ball")
    with pytest.raises(TypeError, match=r"torque=3\.0: pass a function of time"):
        nts.Torque(body, None, axis=(0, 0, 1), torque=3.0)
    with pytest.raises(ValueError, match="they coincide"):
        nts.Thrust(body, None, [(0, 0, 0), (0, 0, 0)], force=lambda t, x, rate: 1.0)
    with pytest.raises(ValueError, match=r"turning_limits=\(1, 2\): pass the smallest"):
        nts.Cylindrical(body, None, point=(0, 0, 0), axis=(0, 0, 1), turning_limits=(1, 2))


def chain_with_laws(holding):
    """Links between which laws of many numbers act, and one of another kind."""
    turning = [np.array([0.1, 0.3 * k, -0.2]) for k in range(6)]
    links = [
        nts.RigidBody.from_inertia(
            1.0 + 0.1 * k, (0.01, 0.1, 0.1), centre=(k + 0.5, 0, 0), name=f"link {k}",
            angular_velocity=turning[k],
        )
        for k in range(6)
    ]  # fmt: skip
    hinges, more = [], []
    for k, (a, b) in enumerate(zip(links, [None, *links], strict=False)):
        laws = {}
        if holding:  # what sticks at its limit has no share of its own that is right
            laws = {"limits": (-0.05 - 0.01 * k, 0.06)}
            if k % 2:
                laws = {"friction": nts.JointFriction(bound=0.3 + 0.4 * k)}
        hinges.append(
            nts.Revolute(a, b, point=(k, 0, 0), axis=(0, 1, 0.1 * k), name=f"hinge {k}", **laws)
        )
        options = {"stiffness": 5.0 + k, "angle": 0.1 * k, "name": f"torsion spring {k}"}
        more.append(nts.TorsionSpring.about(hinges[-1], **options))
        more.append(nts.TorsionDamper.about(hinges[-1], damping=0.1 + k, name=f"damper {k}"))
        ends = (k + 0.5, 0, 0.3), (k - 0.4, 0.1 * k, 0)
        more.append(nts.Spring(a, b, ends, stiffness=20.0 + k, name=f"spring {k}"))
    return nts.System(links, joints=[*hinges, *more], gravity=(0, 0, -G))


@pytest.mark.parametrize("rule", [*MID_STEP.values(), *ACCELERATED.values()])
@pytest.mark.fast_on_ranks()
def test_laws_that_are_alike_do_what_each_does_alone(rule, monkeypatch):
    """Reactions by name, columns of the ledger and what each joint remembers."""
    holding, runs = rule in MID_STEP.values(), []
    for alone in (False, True):
        if alone:
            monkeypatch.setattr(Measured, "alike", None)
        system = chain_with_laws(holding)
        exact = nts.Newton(rtol=1e-14)
        stepper = nts.Stepper(system, rule, project_start=True, newton=exact)
        for _ in range(20):
            stepper.advance(0.01)
        joints = [coupling for coupling, _ in stepper.problem.couplings.joints]
        count = sum(isinstance(coupling, Measured) for coupling in joints)
        runs.append((stepper.solution.balance, stepper.state, count))
        stepper.close()
    (one, state, together), (two, right, count) = runs
    assert together < count == len(system.declared_joints) - 6
    for name in one.keys() - {"newton_iterations", "ledger_residual"}:
        a, b = np.asarray(one[name], dtype=float), np.asarray(two[name], dtype=float)
        known = np.isfinite(b)
        size = np.abs(b[known]).max(initial=1.0)
        assert np.array_equal(np.isfinite(a), known), name
        # Velocities and forces have the rounding of positions over h and its square.
        assert np.abs(a[known] - b[known]).max(initial=0.0) <= 1e-10 * size, name
    for a, b in zip(state.u, right.u, strict=True):
        assert np.abs(a - b).max(initial=0.0) <= 1e-12
    if holding:  # some slip, some have met a limit
        assert one["friction_dissipation"][-1] > 0.0
        assert one["contact_defect"].any()
    # Forces of laws are torques of the same size; Newmark's carry their rounding on.
    most = max(float(np.abs(b).max(initial=0.0)) for b in right.joints if b is not None)
    most = COMM.allreduce(most, op=MPI.MAX)
    for a, b in zip(state.joints, right.joints, strict=True):
        if b is not None:
            assert a.shape == b.shape
            assert np.abs(a - b).max(initial=0.0) <= 1e-9 * most


def swings(friction, start, parts, steps):
    """Of a pendulum let go at an angle from its lowest place: angles, and the table."""
    centre = ARM * np.array([np.sin(start), 0, -np.cos(start)])
    body = nts.RigidBody.from_inertia(MASS, (0.01, 0.1, 0.1), centre=centre, name="arm")
    hinge = nts.Revolute(body, None, point=(0, 0, 0), axis=(0, 1, 0), friction=friction)
    system = nts.System([body], joints=[hinge], gravity=(0, 0, -G))
    stepper, found = nts.Stepper(system, nts.EnergyMomentum()), [start]
    for _ in range(steps):
        stepper.advance(PERIOD / parts)
        found.append(np.arctan2(body.position[0], -body.position[2]))
    table = stepper.solution.balance
    lost = table["friction_dissipation"]
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * MASS * G * ARM
    assert (np.diff(lost) >= 0.0).all()
    return np.array(found), table


def test_friction_of_a_pin_stops_a_pendulum():
    """Of small swings the amplitude falls by 2 mu r/L each half, as m g L (A^2 - B^2)/2 is lost to
    mu r m g (A + B); it stops where m g L A is less than mu r m g.
    """
    part, first, radius = 5e-3, 0.0525, 0.05
    pin = nts.JointFriction(coefficient=part * ARM / radius, radius=radius)
    angles, _ = swings(pin, first, 40, 125)
    ends = first - 2 * part * np.arange(6)
    assert np.abs(angles[:101:20]) == pytest.approx(ends, abs=4e-3 * first)
    assert np.ptp(angles[105:]) < 1e-12


@pytest.mark.parametrize("reach", [0.02, 0.2])
def test_friction_of_a_pin_takes_the_reaction_of_its_step(reach):
    """A wide swing, mu r/L = `reach`, against its equation by SciPy: of second order.

    The reaction has the acceleration in it, on which friction acts.
    """
    turned = 0.1 + MASS * ARM**2

    def rates(_, y):
        angle, rate = y
        weight, across = MASS * G * np.sin(angle), MASS * (ARM * rate**2 + G * np.cos(angle))

        def missed(bend):
            load = np.hypot(MASS * ARM * bend + weight, across)
            return turned * bend + ARM * weight - reach * ARM * load

        return rate, brentq(missed, -1e3, 1e3, xtol=1e-14)

    start, end = 1.2, 0.3 * PERIOD
    exact = solve_ivp(rates, (0.0, end), (start, 0.0), rtol=1e-11, atol=1e-13).y[0, -1]
    pin = nts.JointFriction(coefficient=reach * ARM / 0.05, radius=0.05)
    errors = [abs(swings(pin, start, 10 * n, 3 * n)[0][-1] - exact) for n in (4, 8)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("part", [0.9, 1.1])
def test_friction_of_a_pin_takes_the_load_of_a_cable_that_alternates(part):
    """A weight has become taut at a mast, whose pin carries 30 kg g; a torque acts from then on.

    Up to mu r times that it sticks; beyond it the mast and the weight on its rail turn by t^2/2.
    """
    mast = nts.RigidBody.from_inertia(10.0, (2, 2, 2), centre=(0, 0, 0), name="mast")
    load = nts.RigidBody.from_inertia(20.0, (0.2, 0.2, 0.2), centre=(1, 0, -1), name="load")
    bound = 0.1 * 0.1 * 30.0 * G
    pin = nts.Revolute(
        mast, None, point=(0, 0, 0), axis=(0, 0, 1), name="pin",
        friction=nts.JointFriction(coefficient=0.1, radius=0.1),
        motor=lambda t, angle, rate: part * bound * (t > 0.5),
    )  # fmt: skip
    rail = nts.Prismatic(load, mast, point=(1, 0, -1), axis=(0, 0, 1))
    rope = nts.Cable([(mast, (1, 0, 0)), (load, (1, 0, -1))], length=1.02)
    system = nts.System([mast, load], joints=[pin, rail, rope], gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.8)
    assert run.status == "completed" and "ledger" not in run.warnings
    assert np.ptp(run.reactions["pin"][-10:, 0, 2]) > 10.0 * G
    turned = np.arcsin(mast.rotation[1, 0])
    turn = 0.5 * 0.3**2 * max(part - 1.0, 0.0) * bound / (2.0 + 0.2 + 20.0)
    # The pull that turns the weight about adds to the load.
    assert turned == pytest.approx(turn, rel=1e-5, abs=1e-9 * 0.3**2)


def test_friction_of_a_rail_by_what_it_carries():
    """A slider on a slope: a = g (sin - mu cos), or it sticks."""
    tilt, mu = 0.5, 0.3
    body, axis, system = slider(tilt, friction=nts.JointFriction(coefficient=mu))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.02, t_end=0.4)
    assert_closed(run)
    way = 0.5 * G * (np.sin(tilt) - mu * np.cos(tilt)) * 0.4**2
    assert body.position @ axis == pytest.approx(way, rel=1e-10)
    body, axis, system = slider(np.arctan(0.99 * mu), friction=nts.JointFriction(coefficient=mu))
    nts.simulate(system, nts.EnergyMomentum(), dt=0.02, t_end=0.4)
    assert abs(body.position @ axis) < 1e-12


@pytest.mark.skipif(COMM.size > 1, reason="reads the whole matrix")
def test_the_tangent_knows_the_load_of_a_pin():
    """The whole Jacobian of a pin that slips, against differences of the residual."""
    _, system = pendulum(friction=nts.JointFriction(coefficient=0.4, radius=0.05))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    for _ in range(3):
        stepper.advance(0.02)
    problem, x = stepper.problem, stepper.problem.x.array_r.copy()
    x += 1e-4 * np.random.default_rng(1).uniform(-1, 1, len(x))

    def residual(values):
        other = problem.x.duplicate()
        other.array_w[:] = values
        found = problem.residual(problem.evaluate(other))
        other.destroy()
        return found

    with problem.x as at:
        at[:] = x
    stepper.solver.assemble(problem.evaluate(problem.x))
    # Joints' rows are lent a compliance, which is in the matrix alone.
    found = dense(stepper.solver.matrix.operator)[-1]
    expected = differences(lambda y: np.array([residual(z)[-1] for z in y]), x[None], 1e-6)[0]
    assert np.count_nonzero(np.abs(found) > 1e-9 * np.abs(found).max()) > 1
    assert relative(found, expected) < 1e-8
    stepper.close()


@pytest.mark.parametrize("slip, blurs", [(1e-17, False), (1e-9, True)])
def test_friction_is_not_blurred_by_slip_that_is_rounding(slip, blurs):
    """Of a joint at rest that sticks and slips in turns: a width of rounding leads nowhere."""
    _, system = pendulum(friction=nts.JointFriction(bound=2.0 * MASS * G * ARM))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    stepper.advance(1e-3)
    problem = stepper.problem
    problem.begin(stepper.state, 1e-3)
    rubbing, e = RubbingJoints(problem), problem.evaluate(problem.x)
    rubbing.restart()
    (k,) = (k for k, batch in enumerate(problem.elements) if batch.name == "hinge friction")

    def iterate(sticks):
        part, batch = e.parts[k], problem.elements[k]
        memory = part.memory.copy()
        memory[:, 0] = batch.since + slip / batch.measure.length
        parts = list(e.parts)
        parts[k] = part._replace(status=np.full_like(part.status, sticks), memory=memory)
        return replace(e, parts=parts)

    led = [rubbing.at(iterate(n % 2), iterate(1 - n % 2), problem.x)[1] for n in range(6)]
    assert any(led) is blurs
    stepper.close()
