"""Coulomb friction on rigid planes, spheres and cylinders: closed forms, and a meshed plate."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from integrators import CONTACT_RULES
from measures import STENCIL
from pairs import pairs
from point_mass import MASS, STEP, turn
from scenes import box
from scenes_obstacles import (
    ACCELERATION,
    CENTRE,
    DOWN,
    OBSTACLES,
    TO_ROUNDING,
    Pair,
    advance,
    block,
    changed,
    sliding,
)

import dolfinx_nts as nts
from dolfinx_nts.contact.contact_law import Rub

COMM = MPI.COMM_WORLD


def drift(time):
    return np.array([0.3, -1.0, 2.0]) * time


# ---- the equations of a step
@pytest.mark.parametrize(
    ("name", "integrator", "state"), pairs(OBSTACLES, CONTACT_RULES, ["stick", "slip", "off"])
)
def test_tangent_is_the_derivative_of_the_residual(name, integrator, state):
    friction = {"stick": np.inf, "slip": 0.3, "off": 0.3}[state]
    pair = Pair(name, integrator, motion=drift, friction=friction)
    gap = pair.at(np.append(pair.x, np.zeros(3))).gap[0]
    normal = -gap + (0.3 if state == "off" else -0.3)
    unknowns = np.concatenate([pair.x, [normal, 0.13, -0.08]])
    part = pair.at(unknowns)
    assert part.active.tolist() == [state != "off"]
    assert part.stick.tolist() == [state == "stick"]
    step = 1e-3
    expected = [
        sum(w / step * pair.residual(unknowns + k * step * e)[0] for k, w in STENCIL)
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(part.tangent[0].T, expected, rtol=0, atol=1e-8 * MASS)


@pytest.mark.parametrize("rubs", [Rub.HARDLY, Rub.SLIDES])
@pytest.mark.parametrize("name", OBSTACLES)
def test_friction_before_the_normal_forces_are_known(name, rubs):
    """Next to none, but not none; then mu p_N against the slip wherever a node has slid."""
    pair = Pair(name, "midpoint", friction=0.3)
    pair.step = replace(pair.step, law=replace(pair.step.law, rubs=rubs))
    tangential = np.array([0.13, -0.08])
    pressed = 0.3 + pair.at(np.append(pair.x, np.zeros(3))).gap[0]
    unknowns = np.array([*pair.x, -pressed, *tangential])
    part = pair.at(unknowns)
    assert part.active[0] and not part.stick[0]
    wanted = tangential - part.residual[0, 4:] / MASS
    if name == "plane":
        slip = part.slip[0] / part.distance[0]
        expected = 0.3 * pressed * slip if rubs is Rub.SLIDES else np.zeros(2)
        np.testing.assert_allclose(wanted, expected, rtol=0, atol=1e-8)
    step, slides = 1e-3, rubs is Rub.SLIDES
    slopes = [
        sum(w / step * pair.residual(unknowns + k * step * e)[0] for k, w in STENCIL)
        for e in np.eye(6)
    ]
    tangent = part.tangent[0].T
    assert np.linalg.norm(tangent[:3, 4:]) > (0.1 if slides else 1e-10) * MASS
    np.testing.assert_allclose(tangent, slopes, rtol=0, atol=(1e-6 if slides else 1e-11) * MASS)


@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.parametrize("name", OBSTACLES)
def test_work_of_friction_is_exact(name, integrator):
    """The tangential force on the relative path does -lambda_T . Df, and is along the surface."""
    pair = Pair(name, integrator, motion=drift, friction=0.3)
    both, normal = (np.append(pair.x, [-0.7, *t]) for t in ([0.4, -0.9], [0.0, 0.0]))
    part = pair.at(both)
    force = pair.at(normal).residual[0, :3] - part.residual[0, :3]
    relative = pair.x - Pair.start(name) - drift(STEP)
    assert force @ relative == pytest.approx(-MASS * np.dot([0.4, -0.9], part.slip[0]), abs=1e-15)
    middle = pair.step.pair.master.gap((Pair.start(name) + 0.5 * relative)[None])
    assert abs(force @ middle.gradient[0, 0]) < 1e-15 * MASS
    np.testing.assert_allclose(part.tangential[0], force, rtol=0, atol=1e-15 * MASS)
    along = relative - middle.gradient[0, 0] * (relative @ middle.gradient[0, 0])
    assert part.distance[0] == pytest.approx(np.linalg.norm(along), rel=1e-14)
    work = pair.step.ledger(part, 1.0)["external_work"]
    assert work == pytest.approx(-part.residual[0, :3] @ drift(STEP))


# ---- closed forms
@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.fast_on_ranks("energy-momentum")
@pytest.mark.fast("midpoint")
def test_a_mass_slides_down_an_incline(integrator):
    """B5: 30 degrees, mu = 0.3."""
    angle, mu, steps = np.pi / 6, 0.3, 50
    normal, along = np.array([np.sin(angle), 0, np.cos(angle)]), [np.cos(angle), 0, -np.sin(angle)]
    system = sliding(nts.Plane((0, 0, 0), normal), mu, (0, 0, 0), (0, 0, 0))
    x, v, rows = advance(system, integrator, steps, 1.0 / steps)
    assert x[-1] @ along == pytest.approx(1.178144, abs=1e-6)
    a = ACCELERATION * (np.sin(angle) - mu * np.cos(angle))
    t = np.linspace(0, 1, steps + 1)
    np.testing.assert_allclose(v @ along, a * t, rtol=0, atol=1e-12)
    np.testing.assert_allclose(x @ along, a * t**2 / 2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(x @ normal, 0.0, rtol=0, atol=1e-14)
    assert rows["friction_dissipation"][-1] / MASS == pytest.approx(3.002750, abs=1e-6)
    assert np.abs(rows["ledger_residual"]).max() < 1e-12 * rows["friction_dissipation"][-1]
    assert rows["slip"][1:].all() and not rows["stick"].any()


@pytest.mark.parametrize(
    ("integrator", "part"),
    [("energy-momentum", 0.999), ("midpoint", 1.001), ("gonzalez contact", np.inf)],
)
def test_a_mass_sticks_if_mu_is_at_least_the_slope(integrator, part):
    angle = np.pi / 6
    normal, along = np.array([np.sin(angle), 0, np.cos(angle)]), [np.cos(angle), 0, -np.sin(angle)]
    start = turn() @ [0.3, 0.2, 0.1]
    system = sliding(nts.Plane(start, normal), part * np.tan(angle), start, (0, 0, 0))
    x, _, rows = advance(system, integrator, 50)
    x -= start
    if part > 1:
        assert rows["stick"][1:].all()
        assert np.abs(x).max() < 1e-14
    else:
        assert rows["slip"][1:].all()
        expected = ACCELERATION * np.sin(angle) * 0.001 * (50 * STEP) ** 2 / 2
        assert x[-1] @ along == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("integrator", CONTACT_RULES)
def test_a_mass_slides_to_rest(integrator):
    """B4: what is left at the last whole step is at most half a step's loss of speed."""
    mu, speed = 0.2, 1.0
    plane = nts.Plane((0, 0, 0), (0, 0, 1))
    velocity = speed * np.array([0.6, 0.8, 0.0])
    x, _, rows = advance(sliding(plane, mu, (0, 0, 0), velocity), integrator, 40)
    bound = mu * ACCELERATION * STEP**2 / 8
    assert 0 <= 0.254842 + 1e-6 - np.linalg.norm(x[-1]) <= bound + 2e-6
    assert np.abs(x @ [0.8, -0.6, 0.0]).max() < 1e-14
    energy = 0.5 * MASS * speed**2
    lost = energy - rows["friction_dissipation"][-1]
    assert -1e-14 <= lost <= MASS * mu * ACCELERATION * bound
    assert (np.diff(rows["friction_dissipation"]) >= 0).all()
    assert rows["stick"][-1] == 1
    assert np.abs(rows["ledger_residual"]).max() < 1e-13 * energy


@pytest.mark.parametrize(
    ("name", "integrator"), zip(["cylinder", "sphere", "cylinder"], CONTACT_RULES, strict=True)
)
@pytest.mark.slow
def test_a_bead_in_a_hoop_slows_down_as_an_exponential_of_its_angle(name, integrator):
    """Without gravity p = m v^2 / R and m v' = -mu p: v = v0 exp(-mu phi), at second order."""
    hollow = {
        "sphere": nts.Sphere((0, 0, 0), 1.0, inside=True),
        "cylinder": nts.Cylinder((0.3, 0, 0), (1, 0, 0), 1.0, inside=True),
    }[name]
    mu, speed, end, errors = 0.3, 2.0, 2.0, []
    for steps in (40, 80, 160):
        system = sliding(hollow, mu, (0, 0, -1.0), (0, speed, 0), (0, 0, 0))
        x, _, rows = advance(system, integrator, steps, end / steps, newton=TO_ROUNDING)
        phi = np.log(1 + mu * speed * end) / mu
        errors.append(np.arctan2(x[-1, 1], -x[-1, 2]) - (phi + np.pi) % (2 * np.pi) + np.pi)
        lost = 0.5 * MASS * speed**2 - rows["energy"][-1]
        assert np.abs(x[:, 0]).max() < 1e-13
        assert rows["slip"][1:].all()
        if integrator != "midpoint":
            assert rows["friction_dissipation"][-1] == pytest.approx(lost, rel=1e-12)
    rates = np.log2(np.abs(errors[:-1]) / np.abs(errors[1:]))
    assert np.abs(rates - 2).max() < 0.1, (errors, rates)


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.fast_on_ranks("energy-momentum")
def test_a_belt_works_twice_what_it_gives(integrator):
    """A mass put on a belt of speed V gets m V^2/2; as much is dissipated, the belt works m V^2."""
    mu, steps = 0.4, 25
    speed = mu * ACCELERATION * STEP * steps
    belt = nts.Plane((0, 0, 0), (0, 0, 1), motion=lambda t: (0.6 * speed * t, 0.8 * speed * t, 0))
    x, v, rows = advance(sliding(belt, mu, (0, 0, 0), (0, 0, 0)), integrator, steps + 10)
    assert np.allclose(v[steps:], speed * np.array([0.6, 0.8, 0]), rtol=0, atol=1e-12)
    energy = 0.5 * MASS * speed**2
    for name, part in (("energy", 1), ("friction_dissipation", 1), ("external_work", 2)):
        assert np.allclose(rows[name][steps:], part * energy, rtol=1e-12), name
    assert np.abs(rows["ledger_residual"]).max() < 1e-12 * energy
    assert rows["slip"][1:steps].all() and rows["stick"][steps + 1 :].all()


# ---- what may not matter
def shaken(name, scene=None, metre=1.0, integrator="energy-momentum", bounce=False, newton=None):
    """A mass on a shaking obstacle, turned by a rotation, in other units of length.

    It stays in contact unless it bounces, which would magnify rounding at each impact.
    """
    scene = np.eye(3) if scene is None else scene
    size, rate = (0.05, 15.0) if bounce else (0.06, 8.0)

    def motion(t):
        return scene @ (metre * size * (1 - np.cos(rate * t)) * np.array([1.0, -0.5, 0.7]))

    master = OBSTACLES[name]
    fields = {f: scene @ getattr(master, f) for f in ("normal", "axis") if hasattr(master, f)}
    fields |= {f: metre * scene @ CENTRE for f in ("point", "centre") if hasattr(master, f)}
    if hasattr(master, "radius"):
        fields["radius"] = metre * master.radius
    outward = master.gap(Pair.start(name)[None]).gradient[0, 0]
    start = Pair.start(name) - (0.0 if bounce else 0.05) * outward
    pull = -12 * outward + [0.4, -0.7, 0.3]
    velocity = np.cross(outward, [0.4, -0.3, 0.2])
    system = sliding(
        changed(master, motion=motion, **fields), 0.3, metre * scene @ start,
        metre * scene @ velocity, metre * scene @ pull,
    )  # fmt: skip
    system.contacts[0].slave.area *= metre**2
    x, v, rows = advance(system, integrator, 60, newton=newton)
    return x @ scene / metre, v @ scene / metre, rows


@pytest.mark.parametrize(("name", "bounce"), zip(OBSTACLES, [True, False] * 3, strict=False))
@pytest.mark.fast("plane-True")
def test_ledger(name, bounce):
    _, _, rows = shaken(name, bounce=bounce, newton=TO_ROUNDING)
    top = np.abs(rows["energy"]).max()
    assert rows["slip"].sum() >= 5 and (bounce or rows["stick"].any())
    assert np.abs(rows["external_work"]).max() > 0.1 * top
    assert np.abs(rows["ledger_residual"]).max() < 1e-12 * top
    assert (np.diff(rows["friction_dissipation"]) >= -1e-13 * top).all()
    assert (np.diff(rows["contact_defect"]) >= -1e-12 * top).all()


# ---- bodies
@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.slow
def test_a_block_slides_on_a_plane_as_on_a_plate(integrator):
    tables, ends = [], []
    for meshed in (True, False):
        body, face = block(velocity=(1.0, 0.4, -0.5))
        master, bodies = nts.Plane((0, 0, 0), (0, 0, 1)), [body]
        if meshed:
            mesh = box([-1, -1, -1], [2, 2, 0], [3, 3, 1])
            hold = nts.Dirichlet(lambda x: np.full(x.shape[1], True))
            bodies.append(
                nts.Continuum(
                    mesh, nts.StVenantKirchhoff(1.0, 0.3), density=1e3, bcs=[hold], name="plate"
                )
            )
            master = bodies[1].surface(lambda x: x[2] > -1e-9)
        pair = nts.ContactPair(face, master, friction=0.3)
        system = nts.System(bodies, contacts=[pair], gravity=DOWN)
        stepper = nts.Stepper(system, CONTACT_RULES[integrator])
        for _ in range(30):
            state = stepper.advance(2e-3)
        tables.append(stepper.solution.balance)
        ends.append(state.u[0])
        stepper.close()
    meshed, analytic = tables
    assert analytic["slip"].max() > 5 and analytic["friction_dissipation"][-1] > 0
    assert np.abs(ends[0] - ends[1]).max(initial=0.0) < 1e-9
    energy = meshed["energy"][0]
    for name in ("energy", "external_work", "contact_defect", "friction_dissipation"):
        assert np.abs(meshed[name] - analytic[name]).max() < 1e-9 * energy, name
    if integrator != "midpoint":
        assert np.abs(analytic["ledger_residual"]).max() < 1e-11 * energy
