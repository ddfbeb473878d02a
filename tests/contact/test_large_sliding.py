"""Friction over many facets, edges and corners, off the surface and back, against closed forms."""

from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box, meshtags
from integrators import CONTACT_RULES, MID_STEP
from pairs import pairs
from point_mass import MASS, PointMass, PointSurface, Sledge
from scenes import box
from scipy.integrate import solve_ivp

import dolfinx_nts as nts
from dolfinx_nts.contact.candidates import Motion
from dolfinx_nts.contact.skins import locate_facets
from dolfinx_nts.parallel import together

COMM = MPI.COMM_WORLD
GRAVITY, MU, STEP = 9.81, 0.2, 0.01
DOWN = np.array([0.0, 0.0, -GRAVITY])
#: Newton down to rounding, so that nothing but the scheme differs from the closed form.
FLOOR = nts.Newton(rtol=1e-13, linear_solver="direct")


def bend(x, y):
    """Makes general quadrilaterals and triangles of squares, in their plane."""
    return x + 0.04 * np.sin(7 * y + 3 * x), y + 0.05 * np.cos(5 * x - 4 * y)


def shear(x, y):
    """Makes parallelograms of different widths of squares."""
    return x + 0.05 * np.sin(3 * x) + 0.3 * y, y + 0.06 * np.sin(4 * y)


#: Cells of the plate and the map of its plane; facets of "quads" alone have a varying metric.
FACETS = {
    "squares": (CellType.hexahedron, lambda x, y: (x, y)),
    "diagonals": (CellType.tetrahedron, lambda x, y: (x, y)),
    "parallelograms": (CellType.hexahedron, shear),
    "triangles": (CellType.tetrahedron, bend),
    "quads": (CellType.hexahedron, bend),
}


def plate(facets="squares", low=(-1.0, -1.0), high=(1.0, 1.0), top=0.0, n=(8, 8), name="plate"):
    """A plate that does not move, and its upper face."""
    cell, shape = FACETS[facets]
    mesh = box([*low, top - 0.2], [*high, top], [*n, 1], cell)
    x, y, _ = mesh.geometry.x.T
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = shape(x, y)
    everywhere = nts.Dirichlet(lambda x: np.full(x.shape[1], True))
    body = nts.Continuum(
        mesh, nts.StVenantKirchhoff(1.0, 0.3), density=1.0, degree=1, bcs=[everywhere], name=name
    )
    return body, body.surface(lambda x: x[2] > top - 1e-9)


def renumbered(surface):
    """The same facets start at another corner and come in another order."""
    turned = np.array([np.roll(f, k) for k, f in enumerate(surface.facets)])[::-1].copy()
    surface.facets = surface.patches = turned
    return surface


class History(NamedTuple):
    """What a mass did, shape (steps + 1, 3) or (steps + 1,); forces [N] act on it."""

    x: np.ndarray
    v: np.ndarray
    normal: np.ndarray
    tangential: np.ndarray
    stick: np.ndarray
    facet: np.ndarray
    table: dict


def scene(start, velocity, *masters, friction=MU, gravity=DOWN):
    """A mass before some surfaces of plates; (body, surface) each."""
    mass = PointMass(COMM, MASS, start, velocity)
    pairs = [nts.ContactPair(PointSurface(mass, start), m, friction=friction) for _, m in masters]
    return nts.System([mass, *(b for b, _ in masters)], contacts=pairs, gravity=gravity)


def follow(system, integrator, steps, dt=STEP):
    """Advance and record; of several masters, the forces are added up."""
    stepper = nts.Stepper(system, CONTACT_RULES[integrator], newton=FLOOR)
    rows = []
    for k in range(steps + 1):
        if k:
            stepper.advance(dt)
        s, count = stepper.state, len(system.contacts)
        row = [system.bodies[0].reference + s.u[0], s.v[0]]
        found = s.contacts[:count]
        row.append(sum(np.concatenate([c.force, c.tangential.ravel()]) for c in found))
        row.append(sum(c.stick for c in found))
        row.append(np.max([c.facet for c in found], axis=0))
        rows.append(COMM.bcast(np.concatenate(row)))
    stepper.close()
    assert stepper.solution.retries == 0
    x, v, normal, tangential, stick, facet = np.split(np.array(rows), [3, 6, 7, 10, 11], axis=1)
    return History(
        x, v, normal[:, 0], tangential, stick[:, 0], facet[:, 0], stepper.solution.balance
    )


def assert_slides_straight(h, velocity, tolerance, mu=MU):
    """The parabola of a mass that friction slows down, and its constant traction."""
    velocity = np.asarray(velocity)
    speed, t = np.linalg.norm(velocity), h.table["time"]
    unit = velocity / speed
    way = speed * t - mu * GRAVITY * t**2 / 2
    np.testing.assert_allclose(h.x - h.x[0], way[:, None] * unit, rtol=0, atol=tolerance)
    weight = MASS * GRAVITY
    np.testing.assert_allclose(h.normal[1:], weight, rtol=tolerance)
    traction = np.tile(-mu * weight * unit, (len(t) - 1, 1))
    np.testing.assert_allclose(h.tangential[1:], traction, rtol=0, atol=10 * tolerance * weight)
    assert not h.stick.any()
    energy = h.table["energy"][0]
    loss = mu * weight * way
    np.testing.assert_allclose(
        h.table["friction_dissipation"], loss, rtol=0, atol=10 * tolerance * energy
    )
    assert np.abs(h.table["contact_defect"]).max() <= 1e-12 * energy


# ---- over facets
@pytest.mark.parametrize(
    ("integrator", "facets"),
    [
        *((rule, "quads") for rule in CONTACT_RULES),
        *(("energy-momentum", f) for f in FACETS if f != "quads"),
    ],
)
@pytest.mark.slow
def test_slip_and_traction_survive_changes_of_facet(integrator, facets):
    """Every facet starts at another corner than its neighbour."""
    body, face = plate(facets)
    velocity = (2.3, 1.4, 0.0)
    h = follow(scene((-0.81, -0.53, 0.0), velocity, (body, renumbered(face))), integrator, 55)
    assert len(np.unique(h.facet)) >= 7
    # Where the metric varies, only the exact gradient makes a straight slip of a straight way.
    exact = facets != "quads" or integrator == "energy-momentum"
    assert_slides_straight(h, velocity, 1e-12 if exact else 1e-5)


@pytest.mark.parametrize(
    ("integrator", "facets", "way"),
    pairs(MID_STEP, ["squares", "diagonals"], ["along edges", "along diagonals", "over corners"]),
)
@pytest.mark.fast("energy-momentum-squares-along diagonals")
def test_along_edges_and_over_corners(integrator, facets, way):
    """Two to six facets are equally near all the time, or again and again."""
    start, velocity = {
        "along edges": ((-0.9, 0.25), (2.0, 0.0)), "along diagonals": ((-0.75, -0.75), (1.5, 1.5)),
        "over corners": ((-0.5, 0.75), (1.5, -1.5)),
    }[way]  # fmt: skip
    h = follow(scene((*start, 0.0), (*velocity, 0.0), plate(facets)), integrator, 40)
    assert_slides_straight(h, (*velocity, 0.0), 1e-12)


@pytest.mark.parametrize("off", [0.0, 1e-16, -1e-16, 1e-13, -1e-13])
def test_rounding_does_not_choose_the_facet_at_an_edge(off):
    """A mass that stays at its facet on an edge goes over to the next one in whose way it is."""
    _, master = plate("squares")
    mass = PointMass(COMM, MASS, (0.25 + off, 0.1, 0.0), (0.0, 0.0, 0.0))
    pair = nts.ContactPair(PointSurface(mass, mass.reference), master)

    def facet(start, way, current):
        positions = pair.positions([np.array(start) - mass.reference, 0.0 * master.body.reference])
        paths = [np.array([way, 0.0, 0.0]), 0.0 * master.body.reference]
        motion = Motion(0.1, paths, np.array([-1]))
        work = pair.find(positions, np.array([current]), np.zeros((2, 3)), motion)
        return together(COMM, [work])[0].candidates.facet.tolist()

    (left,), (right,) = (facet((x, 0.1, 0.0), 0.0, -1) for x in (0.2, 0.3))
    assert left != right
    assert facet(mass.reference, 0.05, left) == [right]
    assert facet(mass.reference, -0.05, left) == [left]


@pytest.mark.parametrize(
    ("integrator", "facets", "place"),
    pairs(MID_STEP, ["squares", "diagonals"], [(0.1, 0.1), (0.25, 0.1), (0.25, 0.25)]),
)
def test_stuck_inside_on_an_edge_and_on_a_corner(integrator, facets, place):
    """Pulled aside with 0.99 mu m g it stays; of the plate it takes all of the pull."""
    pull = 0.99 * MU * GRAVITY * np.array([0.6, -0.8, 0.0])
    system = scene((*place, 0.0), (0, 0, 0), plate(facets), gravity=DOWN + pull)
    h = follow(system, integrator, 10)
    assert h.stick[1:].all()
    assert np.abs(h.x - h.x[0]).max() < 1e-14
    np.testing.assert_allclose(h.tangential[1:], np.tile(-MASS * pull, (10, 1)), atol=1e-12)
    assert not h.table["friction_dissipation"].any()


@pytest.mark.parametrize(
    ("integrator", "velocity", "friction"),
    pairs(MID_STEP, [(0.0, 0.0, 0.0), (1.5, 0.7, 0.0)], [MU, np.inf]),
)
def test_zero_gap_without_force_is_without_friction(integrator, velocity, friction):
    system = scene((-0.5, 0.25, 0.0), velocity, plate(), friction=friction, gravity=(0, 0, 0))
    h = follow(system, integrator, 10)
    np.testing.assert_allclose(h.v, np.tile(velocity, (11, 1)), rtol=0, atol=1e-14)
    assert not h.normal.any() and not h.tangential.any()
    assert not h.table["friction_dissipation"].any()


# ---- a curved surface
def saddle(height):
    """Facets on z = height x y, which bilinear ones hold exactly."""
    mesh = box([-1, -1, -0.5], [1, 1, 0], [4, 4, 1])
    top = locate_facets(mesh, lambda x: x[2] > -1e-9, None, "top")
    one = np.full(len(top), 1, np.int32)
    tags = meshtags(mesh, 2, np.sort(top), one)
    x, y, _ = mesh.geometry.x.T
    mesh.geometry.x[:, 2] += height * x * y
    everywhere = nts.Dirichlet(lambda x: np.full(x.shape[1], True))
    body = nts.Continuum(
        mesh, nts.StVenantKirchhoff(1.0, 0.3), density=1.0, bcs=[everywhere], name="saddle"
    )
    return body, body.surface(tags, 1)


def on_saddle(height, place, velocity, end):
    """Place and velocity (x, y, v_x, v_y) of a mass that slides with friction on a saddle."""

    def rate(t, y):
        v = np.array([y[2], y[3], height * (y[2] * y[1] + y[0] * y[3])])
        upward = np.array([-height * y[1], -height * y[0], 1.0])
        normal = upward / np.linalg.norm(upward)
        pressure = 2 * height * y[2] * y[3] / np.linalg.norm(upward) - normal @ DOWN
        return [*y[2:], *(DOWN + pressure * (normal - MU * v / np.linalg.norm(v)))[:2]]

    return solve_ivp(rate, (0, end), [*place, *velocity], rtol=1e-12, atol=1e-13).y[:, -1]


@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.slow
def test_sliding_over_a_saddle_is_of_second_order(integrator):
    """Against the equations of motion on the surface, solved without this package."""
    height, (x, y), (vx, vy), end, errors = 0.25, (-0.6, -0.5), (1.5, 0.9), 0.6, []
    exact = on_saddle(height, (x, y), (vx, vy), end)
    for steps in (15, 30, 60):
        start, velocity = (x, y, height * x * y), (vx, vy, height * (vx * y + x * vy))
        h = follow(scene(start, velocity, saddle(height)), integrator, steps, end / steps)
        errors.append(np.abs(np.concatenate([h.x[-1, :2], h.v[-1, :2]]) - exact))
        assert len(np.unique(h.facet[1:])) >= 3 and not h.stick.any()
        assert (np.diff(h.table["friction_dissipation"]) > 0).all()
        energy = h.table["energy"][0]
        assert np.abs(h.table["contact_defect"]).max() < 1e-12 * energy
        if integrator != "midpoint":
            assert np.abs(h.table["ledger_residual"]).max() < 1e-11 * energy
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.abs(rates - 2).max() < 0.1, (errors, rates)


# ---- a block over many facets
def settled_block(facets, friction):
    """A small block thrown over a long plate that it rests on, and the state it starts from."""
    mesh = box([0, 0, 0], [0.1, 0.1, 0.05], [2, 2, 1])

    def on_plate(held):
        block = nts.Continuum(
            mesh, nts.StVenantKirchhoff(1e7, 0.0), density=1e3, velocity=(3.4, 0.3, 0),
            bcs=[nts.Dirichlet(lambda x, k=k: x[k] < 1e-9, components=(k,)) for k in held],
            name="block",
        )  # fmt: skip
        body, face = plate(facets, (-0.3, -0.3), (1.8, 0.5), n=(90, 2))
        below = block.surface(lambda x: x[2] < 1e-9)
        pair = nts.ContactPair(below, face, friction=0.0 if held else friction)
        return nts.System([block, body], contacts=[pair], gravity=DOWN)

    return on_plate(()), nts.equilibrium(on_plate((0, 1)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "facets", "friction"),
    [
        ("energy-momentum", "parallelograms", 0.0),
        ("energy-momentum", "parallelograms", 0.1),
        ("midpoint", "parallelograms", 0.1),
        ("energy-momentum", "triangles", 0.1),
    ],
)
def test_a_block_over_fifty_facets_has_no_switch_defect(integrator, facets, friction):
    system, settled = settled_block(facets, friction)
    stepper, dt = nts.Stepper(system, MID_STEP[integrator], start=settled), 4e-3
    passed = []
    for _ in range(100):
        stepper.advance(dt)
        passed.append(stepper.state.contacts[0].facet.copy())
    table = stepper.solution.balance
    stepper.close()
    changes = (np.diff(passed, axis=0) != 0).sum(axis=0)
    assert changes.min() >= 50
    energy, weight = table["energy"][0], 0.5 * GRAVITY
    assert (table["active"][1:] == 9).all()
    assert np.abs(table["contact_defect"]).max() < 1e-12 * energy
    # The momentum along the way falls by mu m g t, as a rigid block's.
    momentum = np.linalg.norm(table["linear_momentum"][:, :2], axis=1)
    expected = momentum[0] - friction * weight * (table["time"] - table["time"][0])
    np.testing.assert_allclose(momentum, expected, rtol=1e-12 + 1e-3 * friction)
    if integrator == "energy-momentum":
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy


# ---- off the surface
def assert_coulomb(h, acceleration, mu=MU):
    """In each step the momentum changes by gravity and contact; friction is mu p against slip."""
    force = np.column_stack([np.zeros((len(h.x), 2)), h.normal]) + h.tangential
    change = MASS * (np.diff(h.v, axis=0) / STEP - acceleration)
    top = h.normal.max()
    np.testing.assert_allclose(change, force[1:], rtol=0, atol=1e-10 * top)
    way = np.diff(h.x, axis=0)[:, :2]
    slipping = (h.normal[1:] > 0) & (h.stick[1:] == 0)
    unit = way[slipping] / np.linalg.norm(way[slipping], axis=1)[:, None]
    expected = -mu * h.normal[1:][slipping, None] * unit
    friction = h.tangential[1:, :2]
    np.testing.assert_allclose(friction[slipping], expected, rtol=0, atol=1e-10 * top)
    assert np.abs(h.tangential[h.normal == 0]).max() < 1e-14 * top
    assert (np.diff(h.table["friction_dissipation"]) >= 0).all()


@pytest.mark.parametrize(
    ("integrator", "facets"), zip(MID_STEP, ["squares", "triangles"], strict=True)
)
@pytest.mark.slow
def test_slides_off_and_lands_on_another_plate(integrator, facets):
    """Two masters, one lower and beside the other: slide, flight, bounces, slide."""
    upper = plate(facets, (-1, -1), (0, 1), 0.0, (4, 8), "upper")
    lower = plate(facets, (0.1, -1), (2.1, 1), -0.05, (8, 8), "lower")
    h = follow(scene((-0.51, -0.13, 0.0), (3.0, 0.8, 0.0), upper, lower), integrator, 70)
    assert_coulomb(h, DOWN)
    up = h.normal > 0
    leaves = int(np.argmin(up[1:])) + 1
    assert up[1:leaves].all() and 0.0 < h.x[leaves - 1, 0] < 0.1
    lands = leaves + int(np.argmax(up[leaves:]))
    flight = STEP * (lands - leaves)
    # A parabola from the last point of contact, whose speed is that of the slide. A step of contact
    # may leave 16 eps of the scene's extent in the gap, twice that over its length in the speed.
    near = 2 * 16 * np.finfo(float).eps * 2.1 / STEP * leaves * flight
    assert -0.05 < h.x[lands - 1, 2] == pytest.approx(-GRAVITY * flight**2 / 2, abs=near)
    assert h.x[lands, 2] == pytest.approx(-0.05, abs=1e-14)
    assert up[lands:].sum() >= 4
    assert np.abs(h.table["ledger_residual"]).max() < 1e-12 * h.table["energy"][0]


@pytest.mark.parametrize(
    ("integrator", "start"),
    [("midpoint", -0.505), ("energy-momentum", -0.5), ("midpoint", -0.49)],
)
@pytest.mark.slow
def test_two_masters_side_by_side_are_one(integrator, start):
    """Over their seam the gap is closed twice, and carries once."""
    plates = [plate("squares", (k - 1, -1), (k, 1), n=(4, 8), name=f"plate{k}") for k in (0, 1)]
    velocity = (2.0, 0.3, 0.0)
    h = follow(scene((start, -0.13, 0.0), velocity, *plates), integrator, 40)
    assert h.x[-1, 0] > 0.1
    assert_slides_straight(h, velocity, 1e-12)


class Crane(PointMass):
    """A mass that is lifted, drawn back and let down; nothing else pulls at it."""

    @staticmethod
    def acceleration(time):
        phases = ((0.1, (0, 0, -GRAVITY)), (0.2, (0, 0, 15)), (9, (-40, 0, -15)))
        return np.array(next(a for end, a in phases if time < end), dtype=float)

    def external(self, u1, gravity):
        return self.mass * self.acceleration(self.moment.time)[: self.num_owned]


@pytest.mark.parametrize(
    ("integrator", "facets"), zip(MID_STEP, ["triangles", "squares"], strict=True)
)
@pytest.mark.slow
def test_leaves_the_surface_beyond_its_rim_and_comes_back(integrator, facets):
    body, face = plate(facets)
    start = (0.3, 0.17, 0.0)
    mass = Crane(COMM, MASS, start, (3.5, -0.4, 0.0))
    pair = nts.ContactPair(PointSurface(mass, start), face, friction=MU)
    h = follow(nts.System([mass, body], contacts=[pair]), integrator, 60)
    t = h.table["time"]
    assert_coulomb(h, [Crane.acceleration(x + 0.5 * STEP) for x in t[:-1]])
    up = h.normal > 0
    assert up[1:11].all() and not up[11:45].any() and up[45:].any()
    assert h.x[11:45, 0].max() > 1.05 and (h.x[45:, 0] < 1).all()
    # It went out and comes in.
    assert (h.tangential[1:11, 0] < 0).all() and h.tangential[45, 0] > 0


# ---- prescribed coordinates
class Drawn(Sledge):
    """A mass drawn along x over a plate; free across, where friction slows it down."""

    def __init__(self, across, position):
        super().__init__(position)
        self.fixed = self.fixed[:1]
        self.initial_velocity = np.array([Sledge.pace, across, 0.0])[: self.num_owned]

    def prescribed(self, time):
        return np.array([Sledge.pace * time])[: len(self.fixed)]


@pytest.mark.parametrize("integrator", MID_STEP)
def test_friction_does_the_work_of_drawing(integrator):
    """Both directions of slip are prescribed: mu m g times the way goes in and is dissipated."""
    start = (-0.8, 0.13, 0.0)
    mass, (body, face) = Sledge(start), plate()
    pair = nts.ContactPair(PointSurface(mass, start), face, friction=MU)
    pair.slave.fixed[:, :2] = True
    h = follow(nts.System([mass, body], contacts=[pair], gravity=DOWN), integrator, 20)
    work = MU * mass.mass * GRAVITY * Sledge.pace * h.table["time"]
    np.testing.assert_allclose(h.table["friction_dissipation"], work, rtol=0, atol=1e-12)
    np.testing.assert_allclose(h.table["external_work"], work, rtol=0, atol=1e-12)
    np.testing.assert_allclose(h.tangential[1:, 0], -MU * mass.mass * GRAVITY, rtol=1e-12)


@pytest.mark.parametrize("integrator", MID_STEP)
@pytest.mark.slow
def test_drawn_along_it_loses_its_motion_across(integrator):
    """v_y' = -mu g v_y / |v| with v_x prescribed, at second order; one direction of slip is."""
    across, end, errors = 0.7, 0.4, []
    exact = solve_ivp(
        lambda t, y: [y[1], -MU * GRAVITY * y[1] / np.hypot(Sledge.pace, y[1])],
        (0, end), [0.0, across], rtol=1e-12, atol=1e-13,
    ).y[0, -1]  # fmt: skip
    for steps in (10, 20, 40):
        start = (-0.8, 0.13, 0.0)
        mass, (body, face) = Drawn(across, start), plate("parallelograms")
        pair = nts.ContactPair(PointSurface(mass, start), face, friction=MU)
        pair.slave.fixed[:, 0] = True
        system = nts.System([mass, body], contacts=[pair], gravity=DOWN)
        h = follow(system, integrator, steps, end / steps)
        errors.append(h.x[-1, 1] - 0.13 - exact)
    rates = np.log2(np.abs(errors[:-1]) / np.abs(errors[1:]))
    assert np.abs(rates - 2).max() < 0.1, (errors, rates)


# ---- Newton's iteration
def falling_cube(tilt, velocity):
    """A stiff cube whose lower edge touches a plane; velocity: v, and its slopes in z, z, x, y."""
    mesh = box([0, 0, 0], [0.2] * 3, 1)
    x, y, z = mesh.geometry.x.T
    x, z = np.cos(tilt) * x + np.sin(tilt) * z, np.cos(tilt) * z - np.sin(tilt) * x
    mesh.geometry.x[:] = np.column_stack([x, y, z + np.sin(tilt) * 0.2])
    a, b, c, d, e, f, g = velocity
    cube = nts.Continuum(
        mesh, nts.StVenantKirchhoff(2e7, 0.3), density=1e3, name="cube",
        velocity=lambda x: np.array([a + d * x[2], b + e * x[2], c + f * x[0] + g * x[1]]),
    )  # fmt: skip
    faces = cube.surface(lambda x: np.full(x.shape[1], True))
    pair = nts.ContactPair(faces, nts.Plane((0, 0, 0), (0, 0, 1)), friction=0.3)
    return nts.System([cube], contacts=[pair], gravity=DOWN)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("tilt", "velocity"),
    [
        (0.191, (-0.81, 0.941, 0.334, 2.258, 0.632, -4.296, 3.419)),
        (0.104, (-0.526, 0.092, 0.755, 1.575, 1.073, -4.682, -0.02)),
        (0.182, (-0.837, -0.083, -0.379, -4.963, 0.169, -1.27, 3.831)),
        (0.832, (0.945, -0.749, 0.72, 2.205, 2.502, -1.122, -4.424)),
    ],
)
@pytest.mark.fast("0.191-velocity0")
@pytest.mark.fast_on_ranks()
def test_a_node_that_must_slip_is_not_tried_as_stuck_and_as_free_for_ever(tilt, velocity):
    """Stuck it would be drawn down, free it would pass the plane, and Newton flips between them."""
    newton = nts.Newton(max_retries=0)
    stepper = nts.Stepper(falling_cube(tilt, velocity), nts.EnergyMomentum(), newton=newton)
    stepper.advance(2e-3)
    row = stepper.solution.rows[-1]
    assert row["slip"] >= 1 and row["friction_dissipation"] > 0
    assert row["newton_iterations"] <= newton.max_iterations
    stepper.close()


@pytest.mark.slow
def test_a_cube_is_thrown_tumbles_and_slides_for_1000_steps():
    """It bounces off an elastic plate on corners and edges and ends sliding and sticking."""
    kind = {"cell_type": CellType.hexahedron, "ghost_mode": GhostMode.shared_facet}
    small = create_box(COMM, [[0, 0, 0.05], [0.2, 0.2, 0.25]], [1, 1, 1], **kind)
    large = create_box(COMM, [[-0.6, -0.6, -0.2], [2.4, 0.8, 0.0]], [4, 2, 1], **kind)

    def throw(x):
        arm = x - np.array([[0.1], [0.1], [0.15]])
        return np.array([[1.5], [0.3], [-1.0]]) + np.cross([2.0, 5.0, 1.0], arm.T).T

    rubber = nts.NeoHookean(2e6, 0.3)
    cube = nts.Continuum(small, rubber, density=1e3, velocity=throw, name="cube")
    below = nts.Dirichlet(lambda x: x[2] < -0.2 + 1e-9)
    floor = nts.Continuum(large, rubber, density=1e3, bcs=[below], name="floor")
    faces = cube.surface(lambda x: np.full(x.shape[1], True))
    pair = nts.ContactPair(faces, floor.surface(lambda x: x[2] > -1e-9), friction=0.3)
    system = nts.System([cube, floor], contacts=[pair], gravity=DOWN)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1.5e-3, t_end=1.5)
    assert run.status == "completed"
    table, energy = run.balance, run.balance["energy"][0]
    assert len(table["time"]) >= 1001
    assert np.abs(np.diff(table["ledger_residual"])).max() <= 1e-11 * energy
    assert np.abs(table["ledger_residual"]).max() <= 1e-10 * energy
    assert np.diff(table["friction_dissipation"]).min() >= -1e-15 * energy
    assert table["friction_dissipation"][-1] > 0.5 * energy
    touches = np.diff((table["active"] > 0).astype(int))
    assert (touches == 1).sum() > 20
    assert ((table["stick"] > 0) & (table["slip"] > 0)).sum() > 100
