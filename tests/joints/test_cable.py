"""Cables over eyelets against closed forms; see theory section 22."""

from mpi4py import MPI

import numpy as np
import pytest
from integrators import ACCELERATED, INTEGRATORS, MID_STEP
from measures import differences
from scenes import RUBBER, box

import dolfinx_nts as nts
from dolfinx_nts.kernels.cable import Lengths, Stretched, turns
from dolfinx_nts.output import Motions

COMM = MPI.COMM_WORLD
G = 9.81
rules = pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)
pytestmark = pytest.mark.mpi


def weight(mass, place, name="load", **options):
    """A rigid body that hangs by its centre."""
    inertia = (0.1, 0.12, 0.15)
    return nts.RigidBody.from_inertia(mass, inertia, centre=place, name=name, **options)


def atwood(masses=(3.0, 2.0), **options):
    """Two weights at a cable over two pins, which turns by a quarter at each."""
    places = np.array([[0, 0, -1.0], [0, 0, 0], [1.0, 0, 0], [1.0, 0, -1.0]])
    a, b = (
        weight(m, place, name)
        for m, place, name in zip(masses, places[[0, 3]], "ab", strict=True)
    )
    cable = nts.Cable(list(zip((a, None, None, b), places, strict=True)), name="rope", **options)
    return cable, nts.System([a, b], joints=[cable], gravity=(0, 0, -G))


def hung(mass=3.0, pins=((0, 0, 0),), held=(1.0, 0, -0.5), **options):
    """A weight on a rail along z, at a cable from a fixed point over pins, the last above it."""
    load = weight(mass, (0, 0, -1.0))
    places = np.array([held, *pins, (0, 0, -1.0)], dtype=float)
    cable = nts.Cable(
        [*((None, x) for x in places[:-1]), (load, places[-1])], name="rope", **options
    )
    rail = nts.Prismatic(load, None, point=(0, 0, -1.0), axis=(0, 0, 1))
    return load, cable, nts.System([load], joints=[rail, cable], gravity=(0, 0, -G))


def path(places):
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def angles(places):
    along = np.diff(places, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    return np.arccos(np.einsum("ki,ki->k", along[1:], along[:-1]))


#: Of the cable that `hung` makes, without arguments [m].
WAY = path([(1.0, 0, -0.5), (0, 0, 0), (0, 0, -1.0)])


def assert_closed(run, tolerance=1e-12):
    table = run.balance
    top = max(np.abs(table[name]).max() for name in ("kinetic", "potential", "external_work"))
    assert run.status == "completed"
    assert np.abs(table["ledger_residual"]).max() < tolerance * top
    for name in ("friction_dissipation", "contact_defect"):
        # The force times the rounding of the cable's length.
        assert (np.diff(table[name]) >= -0.1 * tolerance * top).all()


@rules
@pytest.mark.parametrize("friction", [None, 0.05])
def test_atwoods_machine(rule, friction):
    """a = g (m_1 - m_2 e)/(m_1 + m_2 e), e = exp(mu pi), until the friction takes its part."""
    cable, system = atwood(friction=friction)
    motions = Motions(cable)
    run = nts.simulate(system, rule, dt=0.01, t_end=0.2, output=[motions])
    assert_closed(run)
    e = np.exp((friction or 0.0) * np.pi)
    fall = G * (3.0 - 2.0 * e) / (3.0 + 2.0 * e)
    a, b = system.bodies
    assert a.position == pytest.approx([0, 0, -1.0 - 0.5 * fall * 0.2**2], abs=1e-12)
    assert b.position == pytest.approx([1.0, 0, -1.0 + 0.5 * fall * 0.2**2], abs=1e-12)
    ends = 3.0 * (G - fall), 2.0 * (G + fall)
    assert cable.tensions(run) == pytest.approx([ends[0], np.sqrt(np.prod(ends)), ends[1]])
    assert run.reactions["rope"][1:, 0, 2] == pytest.approx(ends[0])
    sides = motions["rope tensions"][:, [0, -1]]
    assert (sides[0] == 0.0).all() and np.allclose(sides[1:], ends, rtol=1e-9)
    assert np.allclose(motions["rope"], [3.0, 0.0], atol=1e-12)
    lost = (ends[0] - ends[1]) * 0.5 * fall * 0.2**2
    assert run.balance["friction_dissipation"][-1] == pytest.approx(lost, abs=1e-12)
    took = run.joint_works["friction_dissipation"]["rope"][-1]
    assert took == pytest.approx(lost, abs=1e-12)


@rules
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_a_slack_cable_stops_a_weight_as_a_limit_does(rule):
    """Free fall until it is taut; then as a slider on a rail with an end, with the same loss."""
    load, cable, system = hung(length=WAY + 0.3)
    run = nts.simulate(system, rule, dt=0.01, t_end=0.2)
    assert load.position[2] == pytest.approx(-1.0 - 0.5 * G * 0.2**2, abs=1e-12)
    assert (cable.tensions(run) == 0.0).all()
    run = nts.simulate(system, rule, dt=0.01, t_end=0.6)
    assert_closed(run)
    twin = weight(3.0, (0, 0, -1.0))
    rail = nts.Prismatic(twin, None, point=(0, 0, -1.0), axis=(0, 0, 1), limits=(-0.3, np.inf))
    other = nts.simulate(
        nts.System([twin], joints=[rail], gravity=(0, 0, -G)), rule, dt=0.01, t_end=0.6
    )
    assert load.position == pytest.approx(twin.position, abs=1e-11)
    lost = run.balance["contact_defect"]
    assert lost[-1] > 0.1 and lost == pytest.approx(other.balance["contact_defect"], abs=1e-10)


def test_tensions_of_a_cable_that_has_become_taut_alternate_about_the_weight():
    """Their mean over two steps is the weight."""
    _, cable, system = hung(length=WAY + 0.03)
    motions = Motions(cable)
    nts.simulate(system, nts.EnergyMomentum(), dt=0.007, t_end=0.6, output=[motions])
    hangs = slice(-10, None)
    assert np.ptp(motions["rope tensions"][hangs]) > G
    assert motions["rope mean tensions"][hangs] == pytest.approx(3.0 * G, rel=1e-9)
    assert motions["rope mean tensions"].shape == motions["rope tensions"].shape


@rules
@pytest.mark.parametrize("mu", [0.05, 0.3, 1.5])
@pytest.mark.fast("0.3-energy-momentum")
@pytest.mark.fast_on_ranks()
def test_a_slack_cable_with_friction_becomes_taut_at_an_arm_that_rests_on_its_stop(rule, mu):
    """As a slider on a rail with an end: the cable slips, and friction takes a part of the loss."""
    load, arm = weight(3.0, (0, 0, -1.0)), weight(2.0, (1.0, 0, -0.5), "arm")
    cable = nts.Cable(
        [(arm, (1.0, 0, -0.5)), (None, (0, 0, 0)), (load, (0, 0, -1.0))],
        length=WAY + 0.3, friction=mu, name="rope",
    )  # fmt: skip
    rail = nts.Prismatic(load, None, point=(0, 0, -1.0), axis=(0, 0, 1))
    hinge = nts.Revolute(arm, None, point=(1.2, 0, -0.8), axis=(0, 1, 0), limits=(0.0, 1.0))
    system = nts.System([load, arm], joints=[cable, rail, hinge], gravity=(0, 0, -G))
    run = nts.simulate(system, rule, dt=0.01, t_end=0.6)
    assert_closed(run)
    twin = weight(3.0, (0, 0, -1.0))
    end = nts.Prismatic(twin, None, point=(0, 0, -1.0), axis=(0, 0, 1), limits=(-0.3, np.inf))
    alone = nts.System([twin], joints=[end], gravity=(0, 0, -G))
    other = nts.simulate(alone, rule, dt=0.01, t_end=0.6)
    assert load.position == pytest.approx(twin.position, abs=1e-11)
    assert arm.position == pytest.approx((1.0, 0, -0.5), abs=1e-11)
    taken, lost = (run.balance[k] for k in ("friction_dissipation", "contact_defect"))
    assert taken[-1] > 0.05 * lost[-1]
    assert taken + lost == pytest.approx(other.balance["contact_defect"], abs=1e-10)


@pytest.mark.parametrize("rule", INTEGRATORS.values(), ids=INTEGRATORS)
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_a_weight_vibrates_at_an_elastic_cable(rule):
    """omega^2 = EA/(L m) about its rest, to the second order; taut all the time."""
    load, cable, system = hung(axial_stiffness=2e3)
    stiff = 2e3 / WAY
    omega, sag = np.sqrt(stiff / 3.0), 3.0 * G / stiff
    half = np.pi / omega
    run = nts.simulate(system, rule, dt=half / 200, t_end=half)
    assert load.position[2] == pytest.approx(-1.0 - 2.0 * sag, abs=1e-3 * sag)
    assert cable.tensions(run) == pytest.approx(2.0 * 3.0 * G, rel=1e-2)
    run = nts.simulate(system, rule, dt=half / 200, t_end=2.0 * half, start=run)
    assert load.position[2] == pytest.approx(-1.0, abs=2e-3 * sag)
    if rule in MID_STEP.values():
        assert_closed(run)


@rules
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_an_elastic_cable_that_goes_slack_keeps_the_energy(rule):
    """A weight that is thrown up leaves it, and comes back with the speed that it had."""
    load, cable, system = hung(axial_stiffness=2e3, length=1.9)
    run = nts.simulate(system, rule, dt=2e-3, t_end=1.0)
    assert_closed(run)
    stored = run.balance["potential"]
    assert stored[0] == pytest.approx(2e3 / 1.9 / 2 * (WAY - 1.9) ** 2)
    assert (stored == 0.0).any() and stored[-200:].max() > 0.99 * stored.max()
    assert cable.tensions(run).min() >= 0.0


@pytest.mark.parametrize("stiffness", [None, 1e4])
def test_a_winch_lifts_a_weight_in_equilibrium(stiffness):
    """The tension is the weight, and the work of the winch that against gravity."""
    load, cable, system = hung(
        axial_stiffness=stiffness, length=lambda t: WAY - 0.4 * max(t - 1.0, 0.0)
    )
    nts.equilibrium(system, load_steps=1)
    low = load.position[2]
    rest = nts.equilibrium(system, load_steps=[1.0, 1.25, 1.5, 2.0])
    assert rest.status == "completed"
    assert cable.tensions(rest) == pytest.approx(3.0 * G, rel=1e-12)
    if stiffness is None:
        assert load.position[2] - low == pytest.approx(0.4, abs=1e-12)
        # What it does, and what gravity does, is nothing in sum.
        work = rest.balance["external_work"]
        assert np.abs(work).max() < 1e-12 * 3.0 * G * 0.4


def test_a_winch_stretches_a_spring_in_equilibrium():
    """Its work is what the spring stores."""
    load = weight(3.0, (0, 0, -1.0))
    cable = nts.Cable(
        [(None, (1.0, 0, 0)), (None, (0, 0, 0)), (load, (0, 0, -1.0))], length=lambda t: 2 - 0.1 * t
    )
    joints = [
        cable,
        nts.Prismatic(load, None, point=(0, 0, -1.0), axis=(0, 0, 1)),
        nts.Spring(load, None, [(0, 0, -1.0), (0, 0, -2.0)], stiffness=50.0),
    ]
    rest = nts.equilibrium(nts.System([load], joints=joints), load_steps=2)
    assert rest.balance["external_work"] == pytest.approx(
        [0, 0.5 * 50 * 0.05**2, 0.5 * 50 * 0.1**2], abs=1e-13
    )
    assert rest.balance["ledger_residual"] == pytest.approx(0.0, abs=1e-13)


@rules
@pytest.mark.parametrize("stiffness", [None, 1e4])
@pytest.mark.fast("10000.0-midpoint")
@pytest.mark.fast_on_ranks()
def test_a_winch_lifts_a_weight_in_motion(rule, stiffness):
    """It winds h as t^2; work of the winch and of gravity is the kinetic and stored energy."""
    load, cable, system = hung(axial_stiffness=stiffness, length=lambda t: WAY - 0.2 * t**2)
    run = nts.simulate(system, rule, dt=0.01, t_end=1.0)
    assert_closed(run)
    if stiffness is None:
        assert load.position[2] == pytest.approx(-0.8, abs=1e-12)
        assert cable.tensions(run) == pytest.approx(3.0 * (G + 0.4), rel=1e-9)
        kinetic = 0.5 * 3.0 * 0.4**2
        assert run.balance["external_work"][-1] == pytest.approx(kinetic, rel=1e-9)


PINS = {
    1: [(0.0, 0, 0)],
    3: [(2.0, 0, 0.3), (1.0, 0.4, 0), (0.0, 0, 0.2)],
}


def test_a_weight_that_a_winch_pulls_into_an_eyelet():
    """After 0.5 s nothing is left to pull at, and the run says so, not what is usual."""
    load, _, system = hung(length=lambda t: WAY - 2.0 * t)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.02, t_end=1.0)
    assert run.balance["time"][-1] == pytest.approx(0.5, rel=1e-3)
    assert abs(load.position[2]) < 1e-3 * WAY
    assert "part 2 of 'rope' has shrunk to length 0" in run.status
    assert "let its winch (length=) stop" in run.status and "cells" not in run.status


@pytest.mark.parametrize("number", PINS)
@pytest.mark.parametrize("wound", [-0.2, 0.2])
def test_capstan(number, wound):
    """A winch that pulls, or gives, meets the weight times exp(mu angle), or over it."""
    mu, places = 0.3, [(3.0, 0, -0.5), *PINS[number], (0, 0, -1.0)]
    load, cable, system = hung(
        pins=PINS[number], held=places[0], friction=mu, length=lambda t: path(places) + wound * t
    )
    rest = nts.equilibrium(system, load_steps=2)
    factor = np.exp(-np.sign(wound) * mu * angles(places))
    found = cable.tensions(rest)
    assert found[-1] == pytest.approx(3.0 * G, rel=1e-12)
    assert found[:-1] / found[1:] == pytest.approx(factor, rel=1e-9)
    assert load.position[2] == pytest.approx(-1.0 - wound, abs=1e-12)
    assert (np.diff(rest.balance["friction_dissipation"]) > 0.0).all()


def test_friction_of_each_eyelet():
    """Coefficients of their own, one of them zero."""
    mu, places = (0.3, 0.0, 0.1), [(3.0, 0, -0.5), *PINS[3], (0, 0, -1.0)]
    _, cable, system = hung(
        pins=PINS[3], held=places[0], friction=mu, length=lambda t: path(places) - 0.1 * t
    )
    found = cable.tensions(nts.equilibrium(system, load_steps=1))
    assert found[:-1] / found[1:] == pytest.approx(np.exp(mu * angles(places)), rel=1e-9)


@rules
@pytest.mark.parametrize("part", [0.999, 1.001])
def test_friction_holds_two_weights_up_to_its_bound(rule, part):
    """It sticks while m_1/m_2 < exp(mu pi), and the tensions are the weights."""
    mu = 0.1
    masses = 2.0 * np.exp(part * mu * np.pi), 2.0
    cable, system = atwood(masses, friction=mu)
    run = nts.simulate(system, rule, dt=0.01, t_end=0.1)
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-12 * G
    way = -1.0 - system.bodies[0].position[2]
    if part < 1.0:
        assert abs(way) < 1e-11
        assert cable.tensions(run)[[0, 2]] == pytest.approx(np.multiply(masses, G), rel=1e-9)
    else:
        assert way > 1e-6


def test_friction_holds_two_weights_in_equilibrium():
    masses = (2.5, 2.0)
    cable, system = atwood(masses, friction=0.1)
    rest = nts.equilibrium(system, load_steps=2, stabilization=0.1)
    assert rest.status == "completed"
    assert system.bodies[0].position == pytest.approx([0, 0, -1.0], abs=1e-9)
    assert cable.tensions(rest)[[0, 2]] == pytest.approx(np.multiply(masses, G), rel=1e-9)


@pytest.mark.parametrize("masses", [(2.6, 2.0), (2.0, 2.6)])
def test_friction_of_three_eyelets_holds_on_either_side(masses):
    """They stick as one up to exp(mu angle) of all, here 1.38, and share what holds alike."""
    mu, pins = 0.1, [(0, 0, 0), (0.5, 0, 0.2), (1.0, 0, 0)]
    a, b = weight(masses[0], (0, 0, -1.0), "a"), weight(masses[1], (1.0, 0, -1.0), "b")
    places = [(0, 0, -1.0), *pins, (1.0, 0, -1.0)]
    cable = nts.Cable(list(zip((a, None, None, None, b), places, strict=True)), friction=mu)
    rails = [nts.Prismatic(body, None, point=body.position, axis=(0, 0, 1)) for body in (a, b)]
    system = nts.System([a, b], joints=[cable, *rails], gravity=(0, 0, -G))
    rest = nts.equilibrium(system, load_steps=2)
    assert rest.status == "completed"
    assert a.position == pytest.approx([0, 0, -1.0], abs=1e-9)
    turned = np.concatenate([[0.0], np.cumsum(angles(np.array(places)))])
    ratio = np.log(masses[1] / masses[0]) / turned[-1]
    assert abs(ratio) < mu
    expected = masses[0] * G * np.exp(ratio * turned)
    assert cable.tensions(rest) == pytest.approx(expected, rel=1e-9)


def test_a_run_tells_of_an_elastic_cable_too_fast_for_its_steps():
    _, _, system = hung(axial_stiffness=1e7)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.05)
    assert "unresolved" in run.warnings
    _, _, system = hung(axial_stiffness=1e3)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.05)
    assert "unresolved" not in run.warnings


TACKLE = [(0.0, 1), (0.0, 0), (0.1, 0), (0.1, 1), (0.2, 1), (0.2, 0), (0.3, 0), (0.3, 1), (0.6, 1)]


def tackle(held, **options):
    """Four parts carry a load of 4 kg on a rail; at the end of the cable hangs a hand."""
    load = weight(4.0, (0.15, 0, 0))
    hand = weight(held, (0.6, 0, 0), "hand")
    points = [(None if z else load, (x, 0, z)) for x, z in TACKLE]
    cable = nts.Cable([*points, (hand, (0.6, 0, 0))], **options)
    rail = nts.Prismatic(load, None, point=(0.15, 0, 0), axis=(0, 0, 1))
    return load, hand, cable, nts.System([load, hand], joints=[cable, rail], gravity=(0, 0, -G))


@rules
@pytest.mark.parametrize("held", [1.0, 1.5])
def test_block_and_tackle(rule, held):
    """A quarter of the load holds it; with more it rises by a quarter of the hand's way."""
    load, hand, cable, system = tackle(held)
    run = nts.simulate(system, rule, dt=0.01, t_end=0.2)
    fall = G * (held - 1.0) / (held + 4.0 / 16.0)
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-12 * G
    assert hand.position[2] == pytest.approx(-0.5 * fall * 0.2**2, abs=1e-12)
    assert load.position[2] == pytest.approx(0.125 * fall * 0.2**2, abs=1e-12)
    assert cable.tensions(run) == pytest.approx(held * (G - fall), rel=1e-10)


@rules
@pytest.mark.parametrize("held", [0.8, 1.2, 2.0])
def test_block_and_tackle_with_friction(rule, held):
    """Each half turn takes its part; between the bounds all stick, and what holds is shared."""
    mu = 0.05
    load, hand, cable, system = tackle(held, friction=mu)
    run = nts.simulate(system, rule, dt=0.01, t_end=0.2)
    e = np.exp(mu * np.pi)
    share = e**4 / (1.0 + e + e**2 + e**3)
    lowest, highest = 4.0 / e**4 / (1.0 + 1.0 / e + 1.0 / e**2 + 1.0 / e**3), 4.0 * share
    assert lowest < 0.8 < 1.2 < highest < 2.0
    fall = G * (held - 4.0 * share) / (held + share) if held > highest else 0.0
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-12 * G
    assert hand.position[2] == pytest.approx(-0.5 * fall * 0.2**2, abs=1e-11)
    tension = cable.tensions(run)
    assert tension[-1] == pytest.approx(held * (G - fall), rel=1e-9)
    # The parts at the load: from each of its points upwards.
    assert tension[[0, 2, 4, 6]].sum() == pytest.approx(4.0 * (G + fall / 4.0), rel=1e-9)
    ratio = tension[1:] / tension[:-1]
    quarter = np.exp(0.5 * mu * np.pi) * (1.0 + 1e-9)
    assert (ratio <= quarter).all() and (ratio >= 1.0 / quarter).all()


def flying(**options):
    """Two rigid bodies and a block of rubber, which has two eyelets, at one cable; no support."""
    mesh = box([1.0, -0.2, -0.2], [1.6, 0.2, 0.2], [3, 2, 2])
    block = nts.Continuum(mesh, RUBBER, density=20.0, name="block", velocity=(0, 0.3, 1.0))
    a = weight(2.0, (0, 0, 0), "a", velocity=(-1.0, 0, 0.5), angular_velocity=(0.4, 2.0, 1.0))
    b = weight(1.0, (2.5, 0, 0.2), "b", velocity=(2.0, 1.0, 0), angular_velocity=(1.0, 0, 2.0))
    cable = nts.Cable(
        [(a, (0.1, 0.1, 0)), (block, (1.1, 0, 0.1)), (block, (1.5, 0.1, 0.1)), (b, (2.4, 0, 0))],
        name="rope", **options,
    )  # fmt: skip
    return cable, nts.System([a, block, b], joints=[cable])


@rules
@pytest.mark.parametrize(
    "options", [{}, {"friction": 0.2}, {"axial_stiffness": 500.0}], ids=["plain", "friction", "EA"]
)
@pytest.mark.fast("plain-midpoint", "friction-energy-momentum", "EA-energy-momentum")
@pytest.mark.fast_on_ranks()
def test_free_bodies_keep_their_momenta(rule, options):
    _, system = flying(**options)
    run = nts.simulate(system, rule, dt=2e-3, t_end=0.1)
    table = run.balance
    for name in ("linear_momentum", "angular_momentum"):
        values = table[name]
        assert np.abs(values - values[0]).max() < 1e-11 * np.abs(values[0]).max()
    assert np.ptp(table["kinetic"]) > 0.05 * table["kinetic"][0]
    if isinstance(rule, nts.EnergyMomentum):
        assert_closed(run, 1e-11)


def test_a_checkpoint_of_another_cable_is_refused(mpi_tmp_path):
    path = mpi_tmp_path / "run.h5"
    _, system = atwood(friction=0.05)
    written = nts.Checkpoint(path, every=2)
    nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.02, checkpoint=written)
    _, other = atwood(friction=0.06)
    with pytest.raises(ValueError, match="rope"):
        nts.restart(path, other)


# ---- arrays
RNG = np.random.default_rng(5)


def test_discrete_gradient():
    a, b = RNG.normal(size=(2, 6, 3, 3))
    at = [Lengths.value(p, None) for p in (a, b)]
    found = Lengths.gradient(a, b, *at)
    step = np.einsum("nz,nz->n", found.mean, (b - a).reshape(6, 9))
    assert step == pytest.approx(at[1] - at[0], abs=1e-14)
    at_b = differences(lambda p: Lengths.value(p.reshape(6, 3, 3), None), b.reshape(6, 9))
    assert np.abs(found.end - at_b).max() < 1e-9
    change = differences(
        lambda p: Lengths.gradient(a, p.reshape(6, 3, 3), *at).mean, b.reshape(6, 9)
    )
    assert np.abs(found.change - change).max() < 1e-8


def test_angles_of_eyelets():
    p = RNG.normal(size=(6, 3, 3))
    found, slope = turns(p)
    assert found == pytest.approx(np.array([angles(np.cumsum([0 * q[0], *q], axis=0)) for q in p]))
    by_p = differences(lambda q: turns(q.reshape(6, 3, 3))[0], p.reshape(6, 9))
    assert np.abs(slope.reshape(6, 2, 9) - by_p).max() < 1e-8
    straight = np.tile([1.0, 2.0, 0.5], (1, 2, 1))
    angle, slope = turns(straight)
    assert abs(angle[0, 0]) < 1e-7 and np.isfinite(slope).all()


def test_tension_is_the_mean_between_two_ends():
    law = Stretched(3.0, 2.0)
    a, b = np.array([[1.5, 2.3], [2.4, 2.1], [1.2, 1.9], [2.7, 1.1], [1.9, 2.0001]]).T
    mean, change = law.quotient(a, b)
    assert mean * (b - a) == pytest.approx(law.value(b) - law.value(a), abs=1e-15)
    near = 1e-6
    slope = (law.quotient(a, b + near)[0] - law.quotient(a, b - near)[0]) / (2 * near)
    assert change == pytest.approx(slope, abs=1e-8)
    at = np.array([1.0, 2.5])
    assert law.quotient(at, at)[0] == pytest.approx([0.0, 3.0 * 0.5 / 2.0])


@pytest.mark.parametrize("rule", INTEGRATORS.values(), ids=INTEGRATORS)
@pytest.mark.parametrize("force", [0.4, -0.5])
@pytest.mark.fast("0.4-newmark", "0.4-generalized-alpha", "-0.5-newmark", "-0.5-generalized-alpha")
def test_tangent_is_the_derivative_of_the_residual(rule, force):
    """With sticking and slipping eyelets, taut and slack; at moved places."""
    elastic = rule in ACCELERATED.values()
    options = {"axial_stiffness": 50.0} if elastic else {"friction": 0.7}
    cable, system = flying(**options, length=2.7 if force > 0.0 or not elastic else 5.0)
    stepper = nts.Stepper(system, rule)
    stepper.advance(1e-3)
    problem = stepper.problem
    problem.begin(stepper.state, 0.02)
    (coupling,) = [c for c, (k, *_) in problem.couplings.joints if system.joints[k] is cable]
    batch = coupling.elements[0]
    rng = np.random.default_rng(3)
    shape = batch.reference().shape
    x = batch.reference() + 0.02 * rng.normal(size=shape)
    width = batch.widths["constraints"]
    own = np.array([[force, 0.05, 0.6]])[: len(x), :width]
    size = x[0].size if len(x) else 0

    def residual(z):
        given = {"augmented": np.empty((len(z), 0)), "constraints": z[:, size:]}
        return batch.evaluate(z[:, :size].reshape(x.shape), given)

    z = np.hstack([x.reshape(len(x), size), own])
    if len(z):
        found = residual(z).tangent
        expected = differences(lambda y: residual(y).residual, z)
        assert np.abs(found - expected).max() < 1e-7 * max(np.abs(expected).max(), 1e-300)
    stepper.close()


POINTS = [(0, 0, -1.0), (0, 0, 0), (1.0, 0, 0)]


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        (
            {"length": 1.9},
            ValueError,
            r"length=1\.9 of 'rope': is 1\.9 at the start, where its path",
        ),
        ({"length": lambda t: 1.9 + t}, ValueError, "is 1.9 at the start"),
        ({"length": lambda t: -1.0}, nts.UserFunctionError, "return a positive length"),
        ({"length": 0.0}, ValueError, r"length=0\.0: must be"),
        ({"length": "long"}, ValueError, r"length='long': must be"),
        ({"axial_stiffness": 0.0}, ValueError, r"axial_stiffness=0\.0: must be"),
        ({"friction": -0.1}, ValueError, r"friction=-0\.1 of 'rope': pass a coefficient >= 0"),
        ({"friction": (0.1, 0.2)}, ValueError, "one for each of its 1 eyelets"),
        ({"friction": 0.1, "axial_stiffness": 1.0}, ValueError, "is for inextensible cables"),
        ({"points": [0]}, ValueError, r"points=.*pass two or more pairs"),
        ({"points": [0, 1], "friction": 0.1}, ValueError, "of its 0 eyelets"),
        ({"points": [1, 2]}, ValueError, "all are of the ground"),
        ({"points": [0, 1, 1]}, ValueError, r"points\[1\] and points\[2\] coincide"),
        ({"name": 3}, TypeError, "name=3"),
    ],
)
def test_wrong_input(change, error, text):
    load = weight(1.0, (0, 0, -1.0))
    points = [(None if k else load, POINTS[k]) for k in change.get("points", range(3))]
    change = {name: value for name, value in change.items() if name != "points"}
    with pytest.raises(error, match=text):
        nts.Cable(points, **{"name": "rope"} | change)
    with pytest.raises(TypeError, match=r"points\[0\]\[0\]='load': pass a body, or None"):
        nts.Cable([("load", POINTS[0]), (None, POINTS[1])])
    with pytest.raises(ValueError, match=r"points\[1\]\[1\]=\(0, 1\): pass three"):
        nts.Cable([(load, POINTS[0]), (None, (0, 1))])


def test_tensions_are_those_of_a_run_of_its_own():
    cable, system = atwood((2.0, 2.0))
    other, _ = atwood()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.01)
    assert cable.tensions(run) == pytest.approx(2.0 * G)
    with pytest.raises(ValueError, match="another system than that of 'rope'"):
        other.tensions(run)


@pytest.mark.parametrize("rule", ACCELERATED.values(), ids=ACCELERATED)
def test_an_inextensible_cable_asks_for_another_integrator(rule):
    _, system = atwood()
    with pytest.raises(ValueError, match="'rope' may hold and let go.*EnergyMomentum"):
        nts.Stepper(system, rule)
