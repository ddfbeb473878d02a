"""Rigid planes, spheres and cylinders without a mesh, against closed forms and meshed walls."""

import re

from mpi4py import MPI

import numpy as np
import pytest
from integrators import CONTACT_RULES
from measures import STENCIL, differences
from pairs import pairs
from point_mass import MASS, SPEED, STEP, PointMass, PointSurface, wall
from scenes_obstacles import (
    ACCELERATION,
    CENTRE,
    OBSTACLES,
    TURN,
    Pair,
    advance,
    block,
    point_on,
)

import dolfinx_nts as nts
from dolfinx_nts.output import Fields
from dolfinx_nts.output.pictures import picture

COMM = MPI.COMM_WORLD


# ---- kernels
def distance(name, x):
    """The gaps again, from the definitions."""
    axis = TURN[:, 2]
    along = (x - CENTRE) @ axis
    if name == "plane":
        return along
    if name in ("sphere", "bowl"):
        r = np.sqrt(((x - CENTRE) ** 2).sum(axis=1)) - 1.3
    else:
        r = np.sqrt(((x - CENTRE - along[:, None] * axis) ** 2).sum(axis=1)) - 0.9
    return -r if name in ("bowl", "bore") else r


def cloud(seed, n=40):
    rng = np.random.default_rng(seed)
    return CENTRE + rng.uniform(-2, 2, (n, 3))


@pytest.mark.parametrize("name", OBSTACLES)
def test_gap_and_its_derivatives(name):
    obstacle, x = OBSTACLES[name], cloud(0)
    x = x[np.abs(distance("sphere", x) + 1.3) > 0.2]
    gap = obstacle.gap(x)
    np.testing.assert_allclose(gap.value, distance(name, x), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(gap.gradient, axis=2), 1.0, rtol=1e-14)
    far = np.abs(distance("bore", x) - 0.9) > 0.1
    expected = differences(lambda y: distance(name, y), x)
    np.testing.assert_allclose(gap.gradient[far, 0], expected[far], atol=1e-8)
    slope = differences(lambda y: obstacle.gap(y).gradient[:, 0], x)
    np.testing.assert_allclose(gap.hessian[far], slope[far], atol=1e-6)


@pytest.mark.parametrize("name", OBSTACLES)
def test_discrete_gradient_is_directional_and_consistent(name):
    obstacle, x0, x1 = OBSTACLES[name], cloud(1), cloud(2)
    gradient, tangent = obstacle.discrete_gradient(x0, x1)
    change = distance(name, x1) - distance(name, x0)
    np.testing.assert_allclose(((x1 - x0) * gradient).sum(axis=1), change, rtol=0, atol=2e-15 * 4)
    expected = differences(lambda y: obstacle.discrete_gradient(x0, y)[0], x1, 1e-4)
    np.testing.assert_allclose(tangent, expected, atol=1e-9)
    # Without motion it is the gradient, half of whose change is the Hessian's.
    same, half = obstacle.discrete_gradient(x0, x0)
    np.testing.assert_allclose(same, obstacle.gap(x0).gradient[:, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(half, obstacle.gap(x0).hessian / 2, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", ["sphere", "bowl", "cylinder", "bore"])
def test_the_centre_is_far_from_the_surface_and_harmless(name):
    x = CENTRE[None]
    gap, (gradient, tangent) = OBSTACLES[name].gap(x), OBSTACLES[name].discrete_gradient(x, x)
    np.testing.assert_allclose(gap.value, distance(name, x), rtol=1e-15)
    for array in (gap.gradient, gap.hessian, gradient, tangent):
        assert np.isfinite(array).all()


# ---- the equations of a step
@pytest.mark.parametrize(
    ("name", "integrator", "active"), pairs(OBSTACLES, CONTACT_RULES, [True, False])
)
def test_tangent_is_the_derivative_of_the_residual(name, integrator, active):
    pair = Pair(name, integrator, motion=lambda t: (0.3 * t, -t, 2.0 * t))
    gap = pair.at(np.append(pair.x, 0.0)).gap[0]
    unknowns = np.append(pair.x, -gap + (-0.3 if active else 0.3))
    part = pair.at(unknowns)
    assert part.active.tolist() == [active]
    step = 1e-3
    expected = [
        sum(w / step * pair.residual(unknowns + k * step * e)[0] for k, w in STENCIL)
        for e in np.eye(4)
    ]
    np.testing.assert_allclose(part.tangent[0].T, expected, rtol=0, atol=1e-9 * MASS)


@pytest.mark.parametrize("integrator", ["energy-momentum", "gonzalez contact"])
@pytest.mark.parametrize("name", OBSTACLES)
def test_work_of_the_force_is_the_change_of_the_gap(name, integrator):
    """Relative to a moving obstacle: f . (dx - dc) = -lambda (g_1 - g_0)."""
    pair = Pair(name, integrator, motion=lambda t: (0.3 * t, -t, 2.0 * t))
    part = pair.at(np.append(pair.x, -0.7))
    dc = np.array([0.3, -1.0, 2.0]) * STEP
    assert part.gap[0] == pytest.approx(distance(name, (pair.x - dc)[None])[0], abs=1e-15)
    force, dx = -part.residual[0, :3], pair.x - Pair.start(name)
    change = part.gap[0] - pair.step.candidates.gap[0]
    assert force @ (dx - dc) == pytest.approx(0.7 * MASS * change, abs=1e-15)
    assert pair.step.ledger(part, 1.0)["external_work"] == pytest.approx(force @ dc, abs=1e-15)


# ---- one mass
@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
def test_moment_of_an_obstacle_that_moves_is_that_of_its_force_where_the_mass_is(integrator):
    """A floor slides under a mass at (1, 0, 0) and lifts it; its force is along z."""
    start = np.array([1.0, 0.0, 0.0])
    floor = nts.Plane((0, 0, 0), (0, 0, 1), motion=lambda t: (40 * t * t, 30 * t * t, t * t))
    body = PointMass(COMM, MASS, start, (0.0, 0.0, 0.0))
    pair = nts.ContactPair(PointSurface(body, start), floor)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, CONTACT_RULES[integrator], dt=0.01, t_end=0.1)
    force, moment = run.contact_forces[1:, 0], run.contact_moments[1:, 0]
    assert (force[:, 2] > 0.0).sum() >= 5
    assert np.abs(moment - np.cross(start, force)).max() < 1e-12 * force.max()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integrator", "theta"),
    [("midpoint", 0.0), ("energy-momentum", 0.1), ("gonzalez contact", 0.49), ("midpoint", 0.5),
     ("energy-momentum", 0.51), ("gonzalez contact", 1.0)],
)  # fmt: skip
@pytest.mark.fast_on_ranks("energy-momentum-0.1", "gonzalez contact-0.49", "gonzalez contact-1.0")
def test_rebound_from_a_plane(integrator, theta):
    """B6: the step that closes the gap leaves 2 theta - 1 of the speed."""
    start = TURN @ [0.3, 0.2, theta * STEP * SPEED]
    master = nts.Plane((0, 0, 0), 7.0 * TURN[:, 2])
    _, v, rows = advance(point_on(master, start, -SPEED * TURN[:, 2]), integrator, 4)
    expected = [-1.0, 1 - 2 * theta] + 3 * [abs(1 - 2 * theta)]
    assert np.allclose(v @ TURN[:, 2] / SPEED, expected, rtol=0, atol=1e-12)
    assert np.allclose(v @ TURN[:, :2], 0.0, rtol=0, atol=1e-12)
    energy, lost = 0.5 * MASS * SPEED**2, 2 * MASS * SPEED**2 * theta * (1 - theta)
    assert np.allclose(rows["contact_defect"][1:], lost, rtol=0, atol=1e-12 * energy)
    assert np.abs(rows["ledger_residual"]).max() < 1e-12 * energy


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.fast_on_ranks()
def test_a_plane_is_a_fixed_facet(integrator):
    """Bouncing obliquely under gravity: the same path as on the face of a fixed hexahedron."""
    start, velocity, gravity = np.array([0.3, 0.2, 0.04]), (0.4, -0.7, -SPEED), (0, 1.0, -30.0)
    body, face, _ = wall()
    mass = PointMass(COMM, MASS, start, velocity)
    pair = nts.ContactPair(PointSurface(mass, start), face)
    meshed = advance(
        nts.System([mass, body], contacts=[pair], gravity=gravity), integrator, 20
    )  # fmt: skip
    plane = nts.Plane((5.0, -3.0, 0.0), (0.0, 0.0, 1.0))
    analytic = advance(point_on(plane, start, velocity, gravity), integrator, 20)
    assert analytic[2]["active"].sum() > 2
    for a, b in zip(analytic[:2], meshed[:2], strict=True):
        assert np.abs(a - b).max() < 1e-12 * SPEED
    for name in ("energy", "external_work", "contact_defect"):
        assert np.abs(analytic[2][name] - meshed[2][name]).max() < 1e-12 * MASS * SPEED**2, name


BOWLS = {
    "sphere": nts.Sphere((0, 0, 0), 1.0, inside=True),
    "cylinder": nts.Cylinder((0.3, 0, 0), (1, 0, 0), 1.0, inside=True),
}


@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.slow
def test_without_gravity_a_mass_in_a_sphere_follows_a_great_circle(integrator):
    """A radial force has no moment: the plane of motion and the angular momentum stay."""
    start, velocity = TURN @ [0.0, 0.0, -1.0], TURN @ [0.6, 0.8, 0.0]
    system = point_on(BOWLS["sphere"], start, velocity)
    x, v, rows = advance(system, integrator, 300)
    momentum = MASS * np.cross(start, velocity)
    assert np.allclose(rows["angular_momentum"], momentum, rtol=0, atol=1e-12 * MASS)
    assert np.abs(x @ momentum).max() < 1e-12 * MASS
    assert np.allclose(np.linalg.norm(x, axis=1), 1.0, rtol=0, atol=1e-12)
    # Chords of equal length: half of each is sin(angle / 2).
    angle = np.arcsin(np.linalg.norm(np.diff(x, axis=0), axis=1) / 2) * 2
    assert np.ptp(angle) < 1e-10
    assert angle[0] == pytest.approx(STEP, rel=STEP**2)


@pytest.mark.parametrize("far", [1e3, 1e6, 1e9])
def test_far_away_obstacles(far):
    """Their rounding is no failure: a huge ball, or a plane given by a far point, is a floor."""
    normal = TURN @ [0.0, 0.0, 1.0]
    masters = [
        nts.Plane((0, 0, 0), normal),
        nts.Plane(far * TURN[:, 0], normal),
        nts.Sphere(-far * normal, far),
        nts.Sphere(far * normal, far, inside=True),
        nts.Cylinder(-far * normal, TURN[:, 1], far),
    ]
    speeds = []
    for master in masters:
        start, velocity, gravity = TURN @ [0.3, 0.2, 0.04], TURN @ [0, 0, -SPEED], -30 * normal
        _, v, rows = advance(point_on(master, start, velocity, gravity), "energy-momentum", 12)
        assert rows["active"].sum() > 1
        speeds.append(v)
    for v in speeds[1:]:
        assert np.abs(v - speeds[0]).max() < 100 / far + 1e-14 * far / STEP


# ---- obstacles that move


def test_a_floor_that_flees_does_not_pull():
    floor = nts.Plane((0, 0, 0), (0, 0, 1), motion=lambda t: (0, 0, -t))
    x, _, rows = advance(point_on(floor, (0, 0, 0), (0.1, 0, 0)), "midpoint", 5)
    assert not rows["active"].any()
    assert np.allclose(x[:, 2], 0.0, rtol=0, atol=0)


# ---- bodies


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_facets_and_obstacles_in_one_scene(mpi_tmp_path):
    """A block on a block on a floor between two walls; fields and balance are written."""
    low, low_face = block((0, 0, 0.002), 1.0, name="low", velocity=(0.4, 0, 0))
    high, high_face = block((0.1, 0.1, 1.004), name="high")
    floor = nts.Plane((0, 0, 0), (0, 0, 1), name="floor")
    walls = [nts.Plane((x, 0, 0), (1 - 2 * x, 0, 0)) for x in (0, 1)]
    sides = low.surface(lambda x: (x[0] < 1e-9)), low.surface(lambda x: x[0] > 1 - 1e-9)
    contacts = [
        nts.ContactPair(low_face, floor),
        nts.ContactPair(high_face, low.surface(lambda x: x[2] > 1.002 - 1e-9)),
        *(nts.ContactPair(side, w) for side, w in zip(sides, walls, strict=True)),
    ]
    system = nts.System([low, high], contacts=contacts, gravity=(0, 0, -9.81))
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=2e-3, t_end=0.03,
        output=[Fields(mpi_tmp_path)],
    )  # fmt: skip
    assert run.status == "completed"
    energy = np.abs(run.balance["energy"]).max()
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * energy
    assert run.balance["active"].max() > 10
    if COMM.rank == 0:
        text = (mpi_tmp_path / "low.xdmf").read_text()
        names = set(re.findall(r'Attribute Name="contact_force_(?!mean)([^"]*)"', text))
        assert names == {"low-floor", "low-plane_2", "low-plane_3"}
    picture(system.bodies, mpi_tmp_path / "scene.png")


# ---- bad input
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nts.Plane((0, 0), (0, 0, 1)), r"point=\(0, 0\): pass three finite"),
        (lambda: nts.Plane((0, 0, 0), (0, 0, 0)), r"normal=\(0, 0, 0\): has no direction"),
        (lambda: nts.Plane((0, 0, 0), (0, 0, np.nan)), "normal=.*three finite"),
        (lambda: nts.Sphere((0, 0, 0), 0.0), "radius=0.0: must be positive"),
        (lambda: nts.Sphere((0, 0, np.inf), 1.0), "centre=.*three finite"),
        (lambda: nts.Sphere((0, 0, 0), 1.0, inside=3), "inside=3: pass True"),
        (lambda: nts.Cylinder((0, 0, 0), (0, 0, 0), 1.0), "axis=.*no direction"),
        (lambda: nts.Cylinder((0, 0, 0), (0, 0, 1), -1.0), "radius=-1.0"),
        (lambda: nts.Plane((0, 0, 0), (0, 0, 1), motion=3.0), "motion=3.0: pass a function"),
        (lambda: nts.Plane((0, 0, 0), (0, 0, 1), motion=lambda t: t), "motion of 'plane' at t=0"),
        (lambda: nts.Plane((0, 0, 0), (0, 0, 1), motion=lambda t: (0, 0, 1 + t)), "start at zero"),
        (lambda: nts.Plane((0, 0, 0), (0, 0, 1), speed=1), "speed=1: unknown option of Plane"),
    ],
)
def test_bad_obstacles(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()


@pytest.mark.mpi
@pytest.mark.parametrize("place", [(1e6, 0.0, 1e6), (3e6, -2e6, 1e6)])
@pytest.mark.parametrize("name", ["plane", "sphere", "cylinder"])
@pytest.mark.fast("cylinder-place1")
@pytest.mark.fast_on_ranks()
def test_an_obstacle_may_be_anywhere(name, place):
    """At 1e-6 g a cube settles by 1e-8 m, a hundred roundings of coordinates 1e6 m away."""
    works = []
    for at in (np.zeros(3), np.array(place)):
        obstacle = {
            "plane": nts.Plane(at + [30.0, 20.0, 0.0], (0, 0, 1)),
            "sphere": nts.Sphere(at + [0.5, 0.5, -2.0], 2.0),
            "cylinder": nts.Cylinder(at + [0.5, 0.0, -2.0], (0, 1, 0), 2.0),
        }[name]
        body, face = block(low=at, size=1.0, velocity=(0, 0, 0))
        pair = nts.ContactPair(face, obstacle)
        system = nts.System([body], contacts=[pair], gravity=(0, 0, -1e-6 * ACCELERATION))
        run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.04)
        work = np.abs(run.balance["external_work"]).max()
        assert run.status == "completed" and run.balance["active"][-1] > 0
        # Of a round one, positions over its radius have the digits that doubles have.
        assert np.abs(run.balance["ledger_residual"]).max() < 1e-6 * work
        works.append(work)
    assert works[1] == pytest.approx(works[0], rel=1e-5)


@pytest.mark.mpi
def test_bad_contacts():
    body, face = block()
    plane = nts.Plane((0, 0, 0), (0, 0, 1))
    with pytest.raises(TypeError, match="master=3.0: pass a Surface.*Plane"):
        nts.ContactPair(face, 3.0)
    with pytest.raises(TypeError, match="slave=Plane"):
        nts.ContactPair(plane, face)
    other, _ = block(name="other")
    with pytest.raises(ValueError, match="slave body 'block' is not among"):
        nts.System([other], contacts=[nts.ContactPair(face, plane)])
    twice = [nts.ContactPair(face, nts.Plane((0, 0, 0), (0, 0, s)), friction=0.0) for s in (1, 2)]
    with pytest.raises(ValueError, match="same nodes of 'block' out of the same plane"):
        nts.System([body], contacts=twice)
    deep = nts.Plane((0, 0, 0.5), (0, 0, 1), name="floor")
    with pytest.raises(ValueError, match="'block-floor': 9 slave nodes start inside the master"):
        nts.System([body], contacts=[nts.ContactPair(face, deep)])


@pytest.mark.mpi
@pytest.mark.parametrize(
    "obstacle",
    [nts.Plane((0, 0, 0.1), (0, 0, -1)), nts.Cylinder((0.5, 0, 2.0), (0, 1, 0), 2.0)],
)
def test_a_body_on_the_wrong_side_is_refused(obstacle):
    """It is near the obstacle's surface inside, where nothing would hold it."""
    _, face = block(low=(0, 0, 0.1))
    text = f"all of 'block' starts inside '{obstacle.name}'.*normal of a plane point to the body"
    with pytest.raises(ValueError, match=text):
        nts.System([face.body], contacts=[nts.ContactPair(face, obstacle)])


@pytest.mark.mpi
def test_a_motion_that_breaks_down_ends_the_run():
    motion = {0.0: (0, 0, 0)}
    floor = nts.Plane((0, 0, -1), (0, 0, 1), motion=lambda t: motion.get(t, (0, 0, np.nan)))
    body, face = block()
    system = nts.System([body], contacts=[nts.ContactPair(face, floor)])
    run = nts.simulate(system, nts.Midpoint(), dt=1e-3, t_end=1e-3)
    assert re.search(r"^motion of 'plane' at t=0.001: returned .*three finite", run.status)
