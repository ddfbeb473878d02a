"""Supports that move by a function of time, and stop: velocities are the function's (theory 21)."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from integrators import INTEGRATORS, MID_STEP
from scenes import at, bottom, box, fail_once

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
MATERIAL = nts.NeoHookean(young=1e4, poisson=0.3)
SPEED, STOP = np.array([1.0, 0.5, 0.0]), 0.045

pytestmark = pytest.mark.mpi
few = pytest.mark.fast("energy-momentum", "newmark")
one_on_ranks = pytest.mark.fast_on_ranks("energy-momentum")
both = pytest.mark.parametrize("rule", INTEGRATORS.values(), ids=INTEGRATORS)
middle = pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)


def ramp(t):
    """At constant velocity until it stops, within a step of those below."""
    return min(t, STOP) * SPEED


def held_cube(value):
    """A cube that flies with its bottom face."""
    bcs = [nts.Dirichlet(bottom, value)]
    return nts.Continuum(box(), MATERIAL, density=2.0, velocity=SPEED, bcs=bcs, name="cube")


def velocities_below(body):
    x = body.space.tabulate_dof_coordinates()
    return body.v.x.array.reshape(-1, 3)[np.abs(x[:, 2]) < 1e-9]


@both
def test_a_guided_body_stops(rule):
    """Its velocity and its kinetic energy are 0 from the step after the stop on, not +-1 m/s."""
    body = nts.RigidBody.from_inertia(
        2.0, (1, 2, 2.5), motion=ramp, rotation=lambda t: (0, 0, 3.0 * min(t, STOP))
    )
    run = nts.simulate(nts.System([body]), rule, dt=0.013, t_end=0.13)
    table, stopped = run.balance, 0.013 * np.arange(len(run.balance["time"])) > STOP
    moving = 0.5 * 2.0 * SPEED @ SPEED + 0.5 * 2.5 * 3.0**2
    # One-sided differences of a rotation err by (w h/8)^2/3.
    np.testing.assert_allclose(table["kinetic"][~stopped], moving, rtol=1e-4)
    assert not table["kinetic"][stopped].any()
    assert not table["linear_momentum"][stopped].any()
    assert not table["angular_momentum"][stopped].any()
    assert not body.velocity.any() and not body.angular_velocity.any()
    # All forces are inertia: every method's ledger closes.
    assert abs(table["ledger_residual"]).max() < 1e-13 * moving
    assert table["external_work"][-1] == pytest.approx(-moving, rel=1e-4)


@few
@one_on_ranks
@both
def test_a_held_face_stops(rule):
    """Within a body that goes on to vibrate."""
    body = held_cube(ramp)
    run = nts.simulate(nts.System([body]), rule, dt=0.004, t_end=0.08)
    # Newmark's energy drifts by 1 %, which the status tells.
    drifts = isinstance(rule, nts.Newmark) and "this integrator does not keep it" in run.status
    assert run.status == "completed" or drifts
    assert not velocities_below(body).any()
    assert run.balance["kinetic"][-1] > 0.01


@one_on_ranks
@middle
def test_momenta_change_by_reactions_and_weight(rule):
    """To rounding, in the step of the stop, too; the energy by the work."""
    gravity = np.array([0, 0, -9.81])
    body = held_cube(ramp)
    run = nts.simulate(nts.System([body], gravity=gravity), rule, dt=0.004, t_end=0.08)
    table, force = run.balance, run.reactions["cube"][1:, 0]
    change = np.diff(table["linear_momentum"], axis=0)
    np.testing.assert_allclose(change, 0.004 * (force + 2.0 * gravity), atol=1e-11)
    if rule.closes_ledger:
        assert abs(table["ledger_residual"]).max() < 1e-10 * abs(table["energy"]).max()


@one_on_ranks
@middle
def test_angular_momentum_changes_by_the_moment_of_the_reaction(rule):
    """About the origin, that of a body beside it, from the force in the middle of the step."""
    place = np.array([0.0, 2.0, 0.5])
    body = nts.RigidBody.from_inertia(
        2.0, (1, 2, 2.5), place, motion=lambda t: np.sin(9.0 * t) * SPEED,
        angular_velocity=(1, 2, 3),
    )  # fmt: skip
    run = nts.simulate(nts.System([body]), rule, dt=0.01, t_end=0.2)
    table, force = run.balance, run.reactions["rigid"][1:, 0]
    y = place + np.sin(9.0 * table["time"])[:, None] * SPEED
    np.testing.assert_allclose(
        np.diff(table["angular_momentum"], axis=0),
        0.01 * np.cross(0.5 * (y[1:] + y[:-1]), force), atol=1e-12,
    )  # fmt: skip
    if rule.closes_ledger:
        assert abs(table["ledger_residual"]).max() < 1e-11 * table["kinetic"].max()


@few
@one_on_ranks
@both
def test_a_smooth_motion_has_the_velocity_of_its_function(rule):
    """To second order in the step, and so have accelerations in the reaction."""

    def errors(dt):
        body = nts.RigidBody.from_inertia(
            2.0, (1, 2, 2.5), motion=lambda t: (np.sin(5.0 * t), 0, 0), rotation=(0, 0, 0)
        )
        run = nts.simulate(nts.System([body]), rule, dt=dt, t_end=0.4)
        table, time = run.balance, run.balance["time"]
        v = table["linear_momentum"][:, 0] / 2.0
        # Where the integrator takes the forces; that of generalised alpha is of inertia.
        late = rule._parameters[2] if rule.accelerations else 0.5
        force = run.reactions["rigid"][1:, 0, 0] / 2.0
        exact = -25.0 * np.sin(5.0 * (time[1:] - late * dt))
        return np.abs(v - 5.0 * np.cos(5.0 * time)).max(), np.abs(force - exact).max()

    coarse, fine = np.array(errors(0.02)), np.array(errors(0.01))
    assert fine[0] < 5.0 * 0.05**2 / 100
    np.testing.assert_allclose(np.log2(coarse / fine), 2.0, atol=0.25)


@one_on_ranks
@middle
def test_turning_has_the_spin_of_its_function(rule):
    """Its error is that of the differences, w (w h/8)^2/3, and the same in every step."""
    w, h = 2.0, 0.05
    body = nts.RigidBody.from_inertia(2.0, (1, 2, 2.5), rotation=lambda t: (0, 0, w * t))
    stepper, speeds = nts.Stepper(nts.System([body]), rule), []
    for _ in range(6):
        stepper.advance(h)
        speeds.append(body.angular_velocity[2])
    stepper.close()
    assert np.ptp(speeds) < 1e-12
    assert speeds[0] / w - 1.0 == pytest.approx((w * h / 8.0) ** 2 / 3.0, rel=0.01)


@few
@one_on_ranks
@both
def test_a_jump_has_the_mean_velocity_wherever_it_is_in_a_step(rule):
    """Not twelve times that, nor minus four times, in the step that it is in."""

    def energies(function):
        body = nts.RigidBody.from_inertia(
            2.0, (1, 2, 2.5), motion=lambda t: (0.01 * function(t), 0, 0),
            rotation=lambda t: (0, 0, 0.02 * function(t)),
        )  # fmt: skip
        return nts.simulate(nts.System([body]), rule, dt=0.01, t_end=0.08).balance["kinetic"]

    eps = 1e-12
    jumps = {5: lambda t: t >= 0.05 - eps, 6: lambda t: t > 0.05 + eps}
    found = {k: energies(function) for k, function in jumps.items()}
    for place in (0.045, 0.0481, 0.0495):
        np.testing.assert_allclose(energies(lambda t, at=place: t > at), found[5], atol=1e-15)
    for k, table in found.items():
        # Directors' chord of 0.02 rad.
        assert table[k] == pytest.approx(0.5 * 2.0 * 1.0 + 0.5 * 2.5 * 2.0**2, rel=1e-4)
        assert abs(np.delete(table, k)).max() < 1e-20


@few
@one_on_ranks
@both
@pytest.mark.fast("energy-momentum")
def test_a_drive_that_jumps_has_the_mean_velocity(rule):
    """Of a joint, too, and none as soon as it stays."""

    def speeds(function):
        body = nts.RigidBody.from_inertia(2.0, (1, 2, 2.5))
        joint = nts.Prismatic(
            body, None, point=(0, 0, 0), axis=(1, 0, 0), displacement=lambda t: 0.01 * function(t)
        )
        stepper, found = nts.Stepper(nts.System([body], joints=[joint]), rule), []
        for _ in range(8):
            stepper.advance(0.01)
            found.append(body.velocity[0])
        stepper.close()
        return np.array(found)

    eps = 1e-12
    right = np.zeros(8)
    right[4] = 1.0
    for function in (lambda t: t >= 0.05 - eps, lambda t: t > 0.048, lambda t: t > 0.04 + eps):
        np.testing.assert_allclose(speeds(function), right, atol=1e-9)


@few
@one_on_ranks
@both
@pytest.mark.fast("newmark")
def test_a_constant_that_is_changed_has_the_mean_velocity(rule):
    """Of the step, and none as soon as it stays."""
    mesh = box()
    place = fem.Constant(mesh, np.zeros(3))
    body = nts.Continuum(mesh, MATERIAL, density=2.0, bcs=[nts.Dirichlet(bottom, place)])
    stepper, found = nts.Stepper(nts.System([body]), rule), []
    for shift in (0.0, 0.01, 0.03, 0.03, 0.03):
        place.value[0] = shift
        stepper.advance(0.02)
        found.append(velocities_below(body)[:, 0])
    stepper.close()
    for seen, right in zip(found, (0.0, 0.5, 1.0, 0.0, 0.0), strict=True):
        np.testing.assert_allclose(seen, right, atol=1e-12)


@few
@one_on_ranks
@both
def test_a_driven_end_of_a_beam_stops(rule):
    """Beams and shells have conditions of their own."""
    end = nts.Dirichlet(at(0, 0.0), ramp)
    mine = slice(None if COMM.rank == 0 else 0)
    cells, x = np.array([[0, 1], [1, 2], [2, 3]])[mine], np.eye(3)[[0] * 4][mine]
    mesh = compat.create_mesh(COMM, cells, x * np.arange(4.0)[mine, None], "interval")
    section = nts.Section(EA=2000, GA=(800, 700), GJ=3, EI=(1, 2), rhoA=1, rhoI=(1e-2, 2e-2))
    beam = nts.Beam(mesh, section, velocity=SPEED, bcs=[end])
    run = nts.simulate(nts.System([beam]), rule, dt=0.004, t_end=0.08)
    # Newmark's energy drifts by 1 %.
    assert run.status.startswith("completed")
    held = np.abs(beam.reference.reshape(-1, 12)[:, 0]) < 1e-9
    v = beam.last_accepted()[1].reshape(-1, 12)
    assert not v[held, :3].any()
    assert run.balance["kinetic"][-1] > 1e-3


@pytest.mark.slow
def test_a_restart_and_halved_steps_stop_alike(mpi_tmp_path):
    """What is prescribed depends on the end of a step and its length alone."""

    def scene():
        return nts.System([held_cube(ramp)])

    rule, options = nts.EnergyMomentum(), {"dt": 0.004, "t_end": 0.08}
    whole = nts.simulate(scene(), rule, **options)
    file, again = mpi_tmp_path / "stop", scene()
    nts.simulate(scene(), rule, checkpoint=nts.Checkpoint(file, every=12), dt=0.004, t_end=0.048)
    run = nts.simulate(again, rule, start=nts.restart(file, again), **options)
    for name in ("kinetic", "external_work"):
        np.testing.assert_allclose(run.balance[name], whole.balance[name], rtol=1e-9, atol=1e-12)

    cut = scene()
    stepper = nts.Stepper(cut, rule)
    fail_once(stepper, 13)
    for _ in range(20):
        stepper.advance(0.004)
    stepper.close()
    assert not velocities_below(cut.bodies[0]).any()
    table = stepper.solution.balance
    assert abs(table["ledger_residual"]).max() < 1e-10 * table["energy"].max()


@middle
@pytest.mark.fast_on_ranks()
def test_a_driven_hinge_between_free_bodies_keeps_the_momenta(rule):
    """It turns one against the other, and stops: no force from elsewhere."""
    w = 3.0
    wheel = nts.RigidBody.from_inertia(2.0, (1, 2, 2.5), angular_velocity=(0, 0, w), name="wheel")
    frame = nts.RigidBody.from_inertia(3.0, (2, 1, 1.5), (0.3, 0, 0), name="frame")
    hinge = nts.Revolute(
        wheel, frame, point=(0, 0, 0), axis=(0, 0, 1), angle=lambda t: w * min(t, STOP)
    )
    system = nts.System([wheel, frame], joints=[hinge])
    run = nts.simulate(system, rule, dt=0.0025, t_end=0.1)
    table, stopped = run.balance, run.balance["time"] > STOP + 0.0025
    for name in ("linear_momentum", "angular_momentum"):
        assert abs(table[name] - table[name][0]).max() < 1e-12
    assert abs(table["ledger_residual"]).max() < 1e-12 * table["kinetic"].max()
    # From then on both are one rigid body.
    spins = np.array([wheel.angular_velocity, frame.angular_velocity])
    np.testing.assert_allclose(spins[0], spins[1], atol=1e-10)
    assert np.ptp(table["kinetic"][stopped]) < 1e-10 * table["kinetic"].max()


@pytest.mark.parametrize("speed, spin", [(30.0, 0.0), (1e3, 100.0)])
@pytest.mark.parametrize("kind", [nts.Prismatic, nts.Revolute])
@pytest.mark.fast("Prismatic-30.0-0.0")
@pytest.mark.fast_on_ranks()
def test_a_slow_drive_stops_in_a_scene_that_flies_and_turns(kind, speed, spin):
    """The miss of its velocity was measured by speeds of the bodies: +-0.15 m/s for ever."""
    drive, place, w = 0.25, np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.0, spin])
    v = speed * np.array([0.6, 0.8, 0.0])
    car = nts.RigidBody.from_inertia(
        1000.0, (100, 200, 250), velocity=v, angular_velocity=w, name="car"
    )
    arm = nts.RigidBody.from_inertia(
        10.0, (1, 2, 2.5), place, velocity=v + np.cross(w, place), angular_velocity=w, name="arm"
    )
    slides = kind is nts.Prismatic
    motion = {"displacement" if slides else "angle": lambda t: drive * min(t, STOP - 2e-4)}
    joint = kind(arm, car, point=place, axis=(1, 0, 0) if slides else (0, 0, 1), **motion)
    system = nts.System([car, arm], joints=[joint])
    stepper = nts.Stepper(system, nts.EnergyMomentum(), project_start=True)
    for _ in range(50):
        stepper.advance(1e-3)
    for _ in range(2):
        stepper.advance(1e-3)
        found = arm.angular_velocity - car.angular_velocity
        if slides:
            # Velocities relative to the turning scene; it turns by tan(w h/2) for w h/2.
            along = nts.motion_of(arm).centre - nts.motion_of(car).centre
            found = (arm.velocity - car.velocity) @ along / np.linalg.norm(along)
        assert np.abs(found).max() < 1e-5 * drive
    stepper.close()
    table = stepper.solution.balance
    assert abs(table["ledger_residual"]).max() < 1e-11 * table["kinetic"].max()


@few
@both
@pytest.mark.fast_on_ranks()
def test_a_driven_flexible_body_stops_where_it_is_held(rule):
    """The face that the slider holds is at rest, what it carries goes on to vibrate."""
    body = nts.Continuum(box(), MATERIAL, density=2.0, velocity=(1, 0, 0), name="cube")
    foot = nts.RigidBody.from_inertia(0.5, (1, 1, 1), velocity=(1, 0, 0), name="foot")
    slider = nts.Prismatic(
        foot, None, point=(0, 0, 0), axis=(1, 0, 0), displacement=lambda t: min(t, STOP)
    )
    tie = nts.Tie(foot, body.surface(bottom))
    system = nts.System([body, foot], joints=[slider, tie])
    run = nts.simulate(system, rule, dt=0.004, t_end=0.08)
    assert run.status.startswith("completed")
    assert abs(foot.velocity).max() < 1e-9
    assert run.balance["kinetic"][-1] > 1e-3
    if rule.closes_ledger:
        table = run.balance
        assert abs(table["ledger_residual"]).max() < 1e-10 * table["energy"].max()
