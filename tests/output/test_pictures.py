"""What pictures and films show of a scene: where it is, and the scale of its colours."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import box, symmetry, top

import dolfinx_nts as nts
from dolfinx_nts.interaction.sketch import Sketch
from dolfinx_nts.kernels.nts_element import Gap
from dolfinx_nts.output import Film
from dolfinx_nts.output.colours import scale_of
from dolfinx_nts.output.pictures import picture
from dolfinx_nts.output.seen import Given, Seen, obstacle_facets, seen

image = pytest.importorskip("PIL.Image")
COMM = MPI.COMM_WORLD
SOFT = nts.StVenantKirchhoff(1e5, 0.3)


@pytest.fixture(scope="module")
def spinning():
    """Two rigid bodies and a soft one, which has turned and moved, with all that is drawn."""
    one = nts.RigidBody.from_inertia(
        1.0, (1.0, 2.0, 2.5), angular_velocity=(1.0, 2.0, 3.0), name="one"
    )
    rod = nts.RigidBody.from_inertia(1.0, (1.0, 1.0, 1.0), (2.0, 0.0, 0.0), name="rod")
    soft = nts.Continuum(box((4, 0, 0), (5, 1, 1), 1), SOFT, density=1e3, name="soft")
    way = [(soft, (5, 1, 1)), (None, (3, 3, 3)), (one, (0, 0, 1))]
    system = nts.System([one, rod, soft], joints=[
        nts.Spring(one, soft, [(0.5, 0.2, 0.1), (4.0, 0.3, 0.7)], stiffness=1.0, name="spring"),
        nts.Damper(None, one, [(0.0, 3.0, 0.0), (0.1, 0.5, 0.0)], damping=1e-2, name="damper"),
        nts.Revolute(one, rod, point=(1.0, 0.0, 0.0), axis=(0.0, 0.6, 0.8), name="hinge"),
        nts.Universal(None, rod, point=(2.0, 0, 0), axes=[(1, 0, 0), (0, 1, 0)], name="cross"),
        nts.Cable(way, length=9.0, name="rope"),
    ])  # fmt: skip
    start = {body: (body.position, body.rotation) for body in (one, rod)}
    stepper = nts.Stepper(system, nts.EnergyMomentum(), project_start=True)
    for _ in range(3):
        stepper.advance(0.05)
    stepper.close()

    def now(body, x):
        """Where a point of a body is, by its position and rotation, or its displacement."""
        if body is None:
            return np.array(x, dtype=float)
        if body is not soft:
            centre, axes = start[body]
            return body.position + body.rotation @ axes.T @ (x - centre)
        nodes, u = body.space.tabulate_dof_coordinates(), body.u.x.array.reshape(-1, 3)
        weights = np.prod(1.0 - np.abs(x - nodes), axis=1)  # of the one cell, trilinear
        return x + weights @ u

    return system, now


def sketch(system, name):
    joint = next(j for j in system.declared_joints if j.name == name)
    return joint.sketch([body.last_accepted()[0] for body in joint.bodies])


def test_what_springs_joints_and_cables_show_moves_with_the_bodies(spinning):
    system, now = spinning
    one, rod, soft = system.bodies
    for name, ends in {
        "spring": [(one, (0.5, 0.2, 0.1)), (soft, (4.0, 0.3, 0.7))],
        "damper": [(None, (0.0, 3.0, 0.0)), (one, (0.1, 0.5, 0.0))],
        "hinge": [(one, (1.0, 0.0, 0.0)), (rod, (1.0, 0.0, 0.0))],
        "cross": [(None, (2.0, 0.0, 0.0)), (rod, (2.0, 0.0, 0.0))],
        "rope": [(soft, (5, 1, 1)), (None, (3, 3, 3)), (one, (0, 0, 1))],
    }.items():
        found, right = sketch(system, name), [now(*end) for end in ends]
        assert found.points == pytest.approx(np.array(right), abs=1e-12), name
        lines = found.lines.reshape(-1, 3)
        for x in right:  # lines begin and end there
            assert np.linalg.norm(lines - x, axis=1).min() < 1e-12, name
    hinge, cross = sketch(system, "hinge"), sketch(system, "cross")
    axis = now(one, (0.0, 0.6, 0.8)) - now(one, (0.0, 0.0, 0.0))
    assert hinge.axes[0, 1] == pytest.approx(axis, abs=1e-12)
    arm = now(rod, (2.0, 1.0, 0.0)) - now(rod, (2.0, 0.0, 0.0))
    assert cross.axes[:, 1] == pytest.approx(np.array([(1.0, 0.0, 0.0), arm]), abs=1e-12)


@pytest.mark.parametrize(("first", "drawn"), [(2.1, 8 / 15), (2.0, 1.0)])
def test_a_cable_is_dashed_while_it_is_slack(first, drawn):
    """Of 15 pieces 8 are drawn, while a winch takes in 2.5 mm."""
    body = nts.RigidBody.from_inertia(1.0, (1.0, 1.0, 1.0), (0.0, 0.0, -2.0))
    rope = nts.Cable([(None, (0, 0, 0)), (body, (0, 0, -2))], length=lambda t: first - 0.25 * t)
    run = nts.simulate(nts.System([body], joints=[rope]), nts.Midpoint(), dt=0.01, t_end=0.01)
    lines = seen(Given.of("scene", run), "speed").sketch.lines[:, :, 2]
    found = np.ptp(lines, axis=1).sum()
    assert found == pytest.approx(-body.position[2] * drawn, rel=1e-12)


def test_rigid_bodies_without_a_mesh_are_lines_to_their_joints(spinning, tmp_path):
    system, now = spinning
    one, rod, _ = system.bodies
    given = Given.of("scene", system)
    lines = seen(given, "speed").sketch.lines
    for body, end in ((one, (1.0, 0.0, 0.0)), (rod, (1.0, 0.0, 0.0)), (one, (0.0, 0.0, 1.0))):
        right = np.array([body.position, now(body, end)])
        assert np.abs(lines - right).max(axis=(1, 2)).min() < 1e-12
    alone = nts.System([rod], joints=[nts.Spherical(rod, None, point=(1.0, 0.0, 0.0))])
    picture(alone, tmp_path / "rod.png")
    at_its_centre = nts.Spherical(rod, None, point=(2.0, 0.0, 0.0))
    picture(nts.System([rod], joints=[at_its_centre]), tmp_path / "point.png")
    with pytest.raises(ValueError, match="joints are drawn, of which it has none"):
        picture(nts.System([nts.RigidBody.from_inertia(1.0, (1, 1, 1))]), tmp_path / "none.png")


def test_a_coil_keeps_its_width():
    """7 turns of 0.08 of its first length, whatever it is stretched to."""
    body = nts.RigidBody.from_inertia(1.0, (1.0, 1.0, 1.0), (0.0, 0.0, 2.0), velocity=(0, 0, 50.0))
    spring = nts.Spring(None, body, [(0, 0, 0), (0, 0, 2.0)], stiffness=1.0)
    nts.simulate(nts.System([body], joints=[spring]), nts.EnergyMomentum(), dt=0.01, t_end=0.02)
    lines = spring.sketch([body.last_accepted()[0]]).lines
    radius = np.linalg.norm(lines[..., :2], axis=-1).max()
    assert radius == pytest.approx(0.16) and np.ptp(lines[..., 2]) > 2.9


def shown(obstacle, time=0.0):
    """Facets and normals of an obstacle beside a cube of side 1."""
    cube = nts.Continuum(box(cells=1), SOFT, density=1.0)
    system = nts.System([cube], contacts=[nts.ContactPair(cube.surface(top), obstacle)])
    now = seen(Given((cube,), system, None, time), "speed")
    ((corners, normals),) = obstacle_facets([now])
    across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return corners, normals, 0.5 * np.linalg.norm(across, axis=1).sum()


def test_planes_reach_as_far_as_the_bodies():
    slope = np.array([0.1, 0.2, 1.0]) / np.sqrt(1.05)
    corners, normals, _ = shown(nts.Plane((0, 0, -0.5), slope, motion=lambda t: (0, 0, 2 * t)), 0.1)
    assert np.abs((corners - [0, 0, -0.3]) @ slope).max() < 1e-12
    assert np.abs(normals - slope).max() < 1e-12
    assert (corners.min(axis=(0, 1))[:2] < 0.0).all() and (corners.max(axis=(0, 1))[:2] > 1.0).all()


@pytest.mark.parametrize("inside", [False, True])
def test_balls_are_whole(inside):
    """Their area is 4 pi R^2, and they show the side at which bodies are."""
    centre, radius = np.array([0.5, 0.5, 0.5 if inside else 1.7]), 1.0 if inside else 0.6
    corners, normals, area = shown(nts.Sphere(centre, radius, inside=inside))
    assert np.linalg.norm(corners - centre, axis=-1) == pytest.approx(radius, rel=1e-12)
    if not inside:
        assert area == pytest.approx(4.0 * np.pi * radius**2, rel=0.01)
    outward = np.einsum("ni,ni->n", normals, corners.mean(axis=1) - centre)
    assert ((outward < 0.0) == inside).all()


class Ridge(nts.Obstacle):
    """An obstacle of a user's own, without a shape that the package knows: z < |x| / 2."""

    name, motion = "ridge", None

    def about(self, origin):
        return self

    def gap(self, x):
        normal = np.tile([0.0, 0.0, 2.0], (len(x), 1))
        normal[:, 0] = -np.sign(x[:, 0])
        value = (2.0 * x[:, 2] - np.abs(x[:, 0])) / 5**0.5
        return Gap(value, normal[:, None] / 5**0.5, np.zeros((len(x), 3, 3)))


def test_obstacles_of_ones_own_are_drawn():
    ends = np.array([[[-1.0, -1, 0], [1, 1, 1]]])
    now = Seen([], Sketch(lines=ends), [(Ridge(), np.zeros(3))])
    ((corners, _),) = obstacle_facets([now])
    x, _, z = corners.reshape(-1, 3).T
    assert len(corners) > 1000 and np.abs(z - 0.5 * np.abs(x)).max() < 0.05


# ---- colours
def test_one_peak_does_not_set_the_scale():
    values = np.random.default_rng(3).uniform(1.0, 2.0, 1000)
    values[7] = 1e6
    low, high = np.percentile(values, [2.0, 98.0])
    scale = scale_of(values, "speed", None, "m")
    assert scale.limits == pytest.approx((low, high)) and scale.extend == "both"
    scale = scale_of(values, "stress", None, "m")
    assert scale.limits == pytest.approx((0.0, high)) and scale.extend == "max"
    # Zeros are none of the values, but in the scale, and NaN is nothing.
    more = np.concatenate([values, np.zeros(5000), np.full(10, np.nan)])
    assert scale_of(more, "stress", None, "m").limits == pytest.approx((0.0, high))
    assert scale_of(more, "stress", (0.0, 2e6), "m").extend == "neither"


def test_the_scale_of_what_has_both_signs_is_symmetric():
    values = np.random.default_rng(4).uniform(-3.0, 1.0, 1000)
    end = -np.percentile(values, 2.0)
    scale = scale_of(values, lambda body: body.u, None, "m")
    assert scale.limits == pytest.approx((-end, end)) and scale.map == "coolwarm"
    assert scale_of(values + 4.0, "stress", None, "mm").text == "von Mises stress [MPa]"


def test_the_scale_of_contact_pressure_ends_at_its_peak():
    values = np.r_[np.full(1000, 1.0), 7.0]
    scale = scale_of(values, "pressure", None, "m")
    assert scale.limits == (0.0, 7.0) and scale.extend == "neither"


@pytest.mark.parametrize("value", [0.0, 2.5, -2.5])
def test_a_constant_has_a_scale_that_holds_it(value):
    low, high = scale_of(np.full(9, value), "speed", None, "m").limits
    assert low <= value <= high and low < high


def standing():
    """A block of one cell on a plane beside a rigid one, in equilibrium."""
    rigid = nts.RigidBody(box((2, 0, 0), (3, 1, 1), 1), density=1.0, name="hard")
    block = nts.Continuum(box(cells=1), SOFT, density=1e3, name="block", bcs=symmetry())
    bottom = block.surface(lambda x: np.isclose(x[2], 0.0))
    return nts.System(
        [block, rigid], contacts=[nts.ContactPair(bottom, nts.Plane((0, 0, 0), (0, 0, 1)))],
        joints=[nts.Fixed(None, rigid, point=(2.5, 0.5, 0.5))], gravity=(0, 0, -10.0),
    )  # fmt: skip


@pytest.mark.mpi
def test_pressure_and_stress_beside_rigid_bodies():
    """Below a block of one cell the pressure is its weight per area; elsewhere there is none."""
    run = nts.equilibrium(standing(), load_steps=1)
    given = Given.of("scene", run)
    for colour, weight in (("pressure", 1e4), ("stress", None)):
        soft, hard = seen(given, colour).drawn
        if COMM.rank == 0:
            assert np.isnan(hard.values).all()
            below = np.abs(soft.corners[..., 2]).max(axis=1) < 1e-2
            if weight is None:
                assert np.isfinite(soft.values).all()
            else:
                length, width = np.ptp(soft.corners[below], axis=(0, 1))[:2]
                assert soft.values[below] == pytest.approx(weight / (length * width), rel=1e-9)
                assert np.isnan(soft.values[~below]).any(axis=1).all()


@pytest.mark.mpi
@pytest.mark.slow
def test_a_film_of_pressure_beside_rigid_bodies(mpi_tmp_path):
    """From below: colours where there is contact, and grey elsewhere, as large as seen from there.

    Towards the viewer are 0.383, 0.663 and 0.643 of a face in x, y and z, and of the two cubes one
    lower face has a colour.
    """
    writer = Film(mpi_tmp_path / "p.gif", colour="pressure", width=2.0, view=(-40.0, -60.0))
    nts.equilibrium(standing(), load_steps=1, output=[writer])
    COMM.Barrier()
    with image.open(mpi_tmp_path / "p.gif") as file:
        assert file.n_frames == 2
        file.seek(1)
        pixels = np.asarray(file.convert("RGB")).astype(int)[:, :160]
    plain = np.ptp(pixels, axis=-1) < 12
    grey = plain & (pixels[..., 0] < 200) & (pixels[..., 0] > 60)
    # The floor, which is lighter, is seen around them from behind.
    assert (plain & (pixels[..., 0] > 210) & (pixels[..., 0] < 225)).sum() > 0.1 * grey.sum()
    part = (np.ptp(pixels, axis=-1) > 60).sum() / grey.sum()
    assert part == pytest.approx(0.643 / (2 * 0.383 + 2 * 0.663 + 0.643), rel=0.15)


def test_a_function_of_a_body_colours_it(tmp_path):
    """Its values at nodes are those at the corners: u_z = 0.1 x; what is no scalar is refused."""
    body = nts.Continuum(box(cells=2), SOFT, density=1.0)
    body.u.interpolate(lambda x: 0.1 * np.stack([0 * x[0], 0 * x[0], x[0]]))
    (drawn,) = seen(Given((body,), None, None, 0.0), lambda body: body.u.sub(2).collapse()).drawn
    assert drawn.values == pytest.approx(0.1 * drawn.corners[..., 0], abs=1e-12)
    with pytest.raises(ValueError, match=r"colour of body .* has shape \(3,\); return a scalar"):
        picture([body], tmp_path / "p.png", colour=lambda body: body.u)


def test_what_hides_others_is_left_out():
    """By itself or by name; the pressure is that of the whole scene."""
    run = nts.equilibrium(standing(), load_steps=1)
    soft, hard = run.system.bodies
    floor = run.system.contacts[0].master

    def left(*hide):
        now = seen(Given.of("scene", run, hide), "pressure")
        return [d.name for d in now.drawn], [m for m, _ in now.obstacles]

    assert left() == (["block", "hard"], [floor])
    assert left(hard, floor) == left("hard", floor.name) == (["block"], [])
    kept = seen(Given.of("scene", run, ["hard"]), "pressure").drawn[0].values
    whole = seen(Given.of("scene", run), "pressure").drawn[0].values
    assert np.array_equal(kept, whole, equal_nan=True) and np.nanmax(kept) > 0.0
    for hide, message in (
        (["housing"], r"hide: 'housing' is not there; pass some of \['block', 'hard', "),
        ([soft, hard], r"leave one of \['block', 'hard'\] to be seen"),
    ):
        with pytest.raises(ValueError, match=message):
            Given.of("scene", run, hide)
    with pytest.raises(TypeError, match=r"hide='hard': .* such as \['hard'\]"):
        picture(run, "p.png", hide="hard")


class Titles(Film):
    """Keeps the titles of the frames in place of painting them."""

    def _draw(self):
        self.titles = [frame.title for frame in self._frames]


def test_titles_of_load_steps_are_pseudo_times():
    film = Titles("p.gif")
    nts.equilibrium(standing(), load_steps=[1.0, 1.126], output=[film])
    assert film.titles == ["pseudo time 0", "pseudo time 1", "pseudo time 1.126"]


def test_pressure_of_what_has_no_contact(tmp_path):
    system = standing()
    with pytest.raises(ValueError, match=r"colour='pressure': a scene has no contact forces; pass"):
        picture(system, tmp_path / "p.png", colour="pressure")


def test_each_body_has_a_colour_of_its_own():
    """Also a rigid one, without anything to read off; the ninth has that of the first."""
    bodies = [
        nts.RigidBody(box((2 * k, 0, 0), (2 * k + 1, 1, 1), 1), density=1.0, name=f"body {k}")
        for k in range(9)
    ]
    drawn = seen(Given.of("scene", bodies), "body").drawn
    values = [set(d.values.ravel()) for d in drawn]
    assert all(len(of) == 1 for of in values) and len(set().union(*values)) == 8
    assert values[8] == values[0] and scale_of(drawn[0].values, "body", None, "m").text == ""
