"""What a newcomer got without a word: free motions, lost energy, crushed cells, open ledgers."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx.mesh import CellType, create_box
from lines import interval_mesh
from point_mass import MASS, SPEED, STEP, mass_on_wall
from scenes import CELLS, at, box, everywhere

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi


def cube(layers=2, **options):
    return nts.Continuum(
        box(cells=(2, 2, layers)), nts.NeoHookean(1e6, 0.3), density=1e3, name="cube", **options
    )


def stretched(rate):
    """All nodes of a cube of one layer are prescribed, those of its top move by rate t."""
    return [
        nts.Dirichlet(lambda x: x[2] < 1e-9),
        nts.Dirichlet(lambda x: x[2] > 1 - 1e-9, value=lambda t: (0, 0, rate * t)),
    ]


def standing(friction=0.0, **options):
    body = cube(**options)
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    pair = nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), floor, friction=friction)
    return nts.System([body], contacts=[pair], gravity=(0, 0, -9.81))


def held(axis):
    return nts.Dirichlet(lambda x: x[axis] < 1e-9, components=(axis,))


@pytest.mark.mpi
@pytest.mark.parametrize("cells", [2, 5, 10])
def test_the_spin_of_a_wire_about_its_axis_is_no_free_motion(cells):
    """It hangs from a pin; before its load acts, what nothing resists is its swing alone."""
    x = np.linspace(0, 1, cells + 1)[:, None] * [np.cos(0.3), 0, -np.sin(0.3)]
    section = nts.Circle(5e-4).section(young=2e11, poisson=0.3, density=7800.0)

    def pinned(x):
        pull = nts.PointForce(lambda y: np.abs(y[2] - x[-1, 2]) < 1e-9, (0, 0, -50))
        pin = nts.Dirichlet(lambda y: np.linalg.norm(y, axis=0) < 1e-9)
        wire = nts.Beam(interval_mesh(x), section, bcs=[pin], forces=[pull], name="wire")
        return nts.System([wire])

    down = pinned(np.linalg.norm(x, axis=1)[:, None] * [0, 0, -1.0])
    # Rounding turns what nothing holds: without it the spin is solved on some machines alone.
    hangs = nts.equilibrium(down, stabilization=0.1)
    assert hangs.status == "completed" and not hangs.warnings
    swings = nts.equilibrium(pinned(x), newton=nts.Newton(max_retries=0))
    words = swings.status.split("(")[1].split(")")[0]
    way = np.array([float(c) for c in words.split(",")])
    axis = x[-1]
    # It moves across its axis, or turns about what is across.
    assert "nothing resists body 'wire'" in swings.status and abs(way @ axis) < 0.02


@pytest.mark.parametrize("sides", [(), (1,)])
@pytest.mark.fast_on_ranks("sides1")
def test_a_body_that_slides_is_no_equilibrium(sides):
    """A block pulled by up to twice what friction carries: half of it is reached at t = 1.5.

    Planes of symmetry at its sides, as of a piece of a seal, do not keep it from sliding along.
    """
    weight, mu = 1e3 * 9.81 * 0.1 * 0.05 * 0.02, 0.3
    pull = nts.Traction(
        at(0, 0.1), lambda t: (2 * mu * weight * max(t - 1, 0) / (0.05 * 0.02), 0, 0)
    )
    block = nts.Continuum(
        box([0, 0, 0], [0.1, 0.05, 0.02], (4, 3, 2)), nts.NeoHookean(young=1e6, poisson=0.3),
        density=1e3, body_force=lambda t: (0, 0, -9.81e3 * min(t, 1)), traction=[pull],
        bcs=[held(axis) for axis in sides], name="block",
    )  # fmt: skip
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    pair = nts.ContactPair(block.surface(at(2, 0.0)), floor, friction=mu)
    run = nts.equilibrium(
        nts.System([block], contacts=[pair]), load_steps=[1, 1.4, 1.8],
        newton=nts.Newton(max_retries=3),
    )  # fmt: skip
    assert 1.4 <= run.balance["time"][-1] <= 1.5
    assert run.status.startswith(f"friction is used up (all nodes of {pair.name!r} slip: ")
    assert "friction can carry no more load" in run.status
    assert "body 'block' slides; use simulate, or hold it" in run.status
    assert "another" not in run.status and "more load steps" not in run.status


@pytest.mark.parametrize(
    ("options", "stabilization", "words"),
    [
        ({}, None, "nothing resists body 'cube' "),
        ({"bcs": [held(0)]}, None, "moving along (0, 1, 0)"),
        ({"bcs": [held(1)]}, None, "moving along (1, 0, 0)"),
        ({"bcs": [held(0), held(1)]}, None, None),
        ({"friction": 0.3}, None, None),
        ({}, 0.1, None),
    ],
)
@pytest.mark.fast_on_ranks("options0-None-nothing resists body 'cube' ", "options5-0.1-None")
def test_motions_that_nothing_resists(options, stabilization, words):
    run = nts.equilibrium(standing(**options), stabilization=stabilization)
    if words is None:
        assert run.status == "completed" and "free motion" not in run.warnings
    elif run.status.startswith("completed"):
        assert words in run.warnings["free motion"].text and run.warnings["free motion"].grave
    else:
        # Where rounding makes the matrix singular, the solver says so by itself.
        assert COMM.size > 1 and "needs stabilization=0.1" in run.status


@pytest.mark.parametrize("theta", [0.02, 0.5])
def test_energy_lost_to_contact(theta):
    """A mass that reaches the wall after a part theta of the step loses 4 theta (1 - theta)."""
    system, _ = mass_on_wall(theta * STEP * SPEED)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=STEP, t_end=2 * STEP)
    energy = 0.5 * MASS * SPEED**2
    assert run.status == "completed"
    assert ("energy lost to contact" in run.warnings) == (theta == 0.5)
    if theta == 0.5:
        warning = run.warnings["energy lost to contact"]
        assert warning.worst == pytest.approx(energy, rel=1e-12) and not warning.grave
        assert f", by {system.contacts[0].name!r};" in warning.text
        assert warning.text.startswith("nodes that begin") and "impact='restored'" in warning.text


@pytest.mark.parametrize("winch", [False, True])
def test_energy_lost_to_a_cable(winch):
    """A weight falls by 0.3 m until its cable is taut, in the step of mean speed d/dt from v."""
    weight = nts.RigidBody.from_inertia(2.0, (0.01,) * 3, centre=(0, 0, -1))
    points = [(None, (0, 0, 0)), (weight, (0, 0, -1))]
    rope = nts.Cable(points, length=(lambda t: 1.3) if winch else 1.3, name="rope")
    system = nts.System([weight], joints=[rope], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=2.0)
    warning = run.warnings["energy lost to contact"]
    assert warning.worst == pytest.approx(2.0 * 9.81 * 0.3, rel=0.01)
    v, d = 9.81 * 0.24, 0.3 - 0.5 * 9.81 * 0.24**2
    loss = v**2 - (2.0 * d / 0.01 - v) ** 2 + 2.0 * 9.81 * d
    assert f"to t=0.25: {loss:.3g}, by 'rope', a cable that became taut" in warning.text
    assert warning.text.startswith("limits and cables")
    assert ("impact='restored'" in warning.text) is not winch
    # The 175 steps in which it hangs from there on lose nothing more, and do not count.
    assert warning.count < 10


@pytest.mark.parametrize("low", [0.03, 0.5])
def test_crushed_cells(low):
    """All nodes are prescribed: det F falls to `low`."""
    system = nts.System([cube(1, bcs=stretched(low - 1.0))])
    run = nts.simulate(system, nts.Midpoint(), dt=0.1, t_end=1.0)
    assert run.balance["min_det"][-1] == pytest.approx(low, rel=1e-12)
    assert ("crushed cells" in run.warnings) == (low < 0.05)


@pytest.mark.parametrize("load_steps", [1, 20])
def test_load_steps_that_are_too_few_for_the_ledger(load_steps):
    """Pulled to twice its length: W = E^2/2 with E = 3/2, the work of one step 1/2 F E."""
    material = nts.StVenantKirchhoff(1.0, 0.0)
    body = nts.Continuum(box(cells=(2, 2, 1)), material, density=1.0, bcs=stretched(1.0))
    run = nts.equilibrium(nts.System([body]), load_steps=load_steps)
    assert run.status == "completed"
    missed = run.balance["ledger_residual"][-1]
    if load_steps == 1:
        assert missed == pytest.approx(0.5 * 1.5**2 - 0.5 * 2 * 1.5, rel=1e-12)
        assert run.warnings["ledger"].worst == pytest.approx(-missed)
    assert ("ledger" in run.warnings) == (load_steps == 1)


def test_constant_values_of_conditions_act_at_once_in_statics():
    """Their energy is there before the first load step: more of these do not help."""
    top = nts.Dirichlet(lambda x: x[2] > 1 - 1e-9, value=(0, 0, 0.1))
    body = cube(bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9), top])
    run = nts.equilibrium(nts.System([body]))
    assert run.balance["potential"][0] > run.balance["potential"][-1] > 0
    assert "functions of the pseudo time" in run.warnings["ledger"].text


@pytest.mark.parametrize("young", [1e1, 1e4])
@pytest.mark.slow
def test_a_stiff_body_on_a_soft_one_is_held(young):
    """Steel that sticks to a pad whose base is fixed: soft is not free."""
    mesh = box([0, 0, -0.5], [1.0, 1.0, 0.0], [2, 2, 1])
    pad = nts.Continuum(
        mesh, nts.NeoHookean(young, 0.3), density=1e3, name="pad",
        bcs=[nts.Dirichlet(lambda x: x[2] < -0.5 + 1e-9)],
    )  # fmt: skip
    steel = nts.Continuum(box(), nts.NeoHookean(2e11, 0.3), density=1e-3, name="steel")
    pair = nts.ContactPair(
        steel.surface(lambda x: x[2] < 1e-9), pad.surface(lambda x: x[2] > -1e-9), friction=np.inf
    )
    run = nts.equilibrium(nts.System([steel, pad], contacts=[pair], gravity=(0, 0, -9.81)))
    assert "free motion" not in run.warnings


def spinning_cube():
    """A stiff one, at 50 rad/s."""
    return nts.Continuum(
        box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 1), nts.NeoHookean(1e9, 0.3), density=1e3,
        velocity=lambda x: 50.0 * np.stack([-x[1], x[0], 0 * x[0]]), name="cube",
    )  # fmt: skip


@pytest.mark.parametrize("turn", [0.9, 1.0, 1.2])
@pytest.mark.fast("1.0")
@pytest.mark.fast_on_ranks("1.0")
def test_a_flexible_body_that_turns_by_a_radian_in_a_step_is_told(turn):
    """By its spin: the angle of a turn of 1 rad a step comes out short by a twelfth."""
    system, dt = nts.System([spinning_cube()]), turn / 50
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=3 * dt)
    assert run.status == "completed" and ("turns" in run.warnings) is (turn > 0.95)
    if turn > 0.95:
        # Stretched by its turning it is slower than at first, by no more than this.
        assert 0.9 * turn < run.warnings["turns"].worst <= turn * (1 + 1e-9)
        assert run.warnings["turns"].count == 3
        assert "body 'cube' turns by" in run.warnings["turns"].text


def test_a_flexible_body_that_turns_far_in_later_steps_is_told():
    stepper = nts.Stepper(nts.System([spinning_cube()]), nts.EnergyMomentum())
    for _ in range(14):
        stepper.advance(1e-3)
    assert not stepper.solution.warnings
    for _ in range(2):
        stepper.advance(2e-2)
    assert stepper.solution.warnings["turns"].worst == pytest.approx(1.0, abs=0.05)
    stepper.close()


@pytest.mark.parametrize(
    ("kind", "cell"), [(nts.Continuum, "hexahedron"), (nts.FormBody, "tetrahedron")]
)
@pytest.mark.fast_on_ranks("Continuum-hexahedron")
def test_one_point_of_quadrature_leaves_the_mass_whole(kind, cell):
    """A cube that turns at 2 rad/s about its centre: J = m/6 2 = 333, E = 333."""
    mesh = box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 1, CELLS[cell])
    options = {
        "density": 1e3, "quadrature_degree": 1,
        "velocity": lambda x: 2.0 * np.stack([-x[1], x[0], 0 * x[0]]),
    }  # fmt: skip
    if kind is nts.Continuum:
        body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), degree=1, **options)
    else:
        space = compat.vector_space(mesh, 1)
        stored = lambda u: 1e3 * ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx  # noqa: E731
        body = nts.FormBody(space, stored, **options)
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=5e-3, t_end=2e-2)
    exact = 1e3 / 6
    assert run.status == "completed"
    assert run.balance["energy"][0] == pytest.approx(0.5 * exact * 4, rel=1e-12)
    turning = run.balance["angular_momentum"][0]
    assert turning == pytest.approx([0, 0, 2 * exact], rel=1e-12, abs=1e-9)
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-12 * exact


@pytest.mark.fast_on_ranks()
def test_a_run_from_a_settled_state_begins_with_its_contact_forces():
    """9.81 kN of weight on the plane; the first row had none while nine nodes were active."""
    system = standing(friction=0.3)
    settled = nts.equilibrium(system)
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=2e-3, t_end=4e-3, start=settled, start_time=0.0
    )
    assert run.balance["active"][0] == 9
    assert run.contact_forces[0, 0] == pytest.approx([0, 0, 9810], rel=1e-9, abs=1e-6)
    assert run.contact_moments[0, 0] == pytest.approx([4905, -4905, 0], rel=1e-9, abs=1e-6)
    other = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=1e-3)
    assert not other.contact_forces[0].any()


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_restored_impulses_have_no_friction_and_say_so(friction):
    body = cube(velocity=(3, 0, -2))
    floor = nts.Plane((0, 0, -1e-3), (0, 0, 1))
    pair = nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), floor, friction=friction)
    run = nts.simulate(
        nts.System([body], contacts=[pair]), nts.EnergyMomentum(), dt=1e-3, t_end=3e-3,
        impact="restored",
    )  # fmt: skip
    assert run.status == "completed"
    assert ("impulses without friction" in run.warnings) is (friction > 0)


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("0.3")
def test_a_weight_below_the_rounding_of_a_stiff_body_is_told(friction):
    """Dust on steel: the weight of 5e-9 N is lost in the forces of the plate's nodes."""
    steel, soft = (nts.NeoHookean(young, 0.3) for young in (2e11, 0.1))
    plate = nts.Continuum(
        box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.0), (2, 2, 1)), steel, density=7.8e3, name="plate",
        bcs=[nts.Dirichlet(lambda x: x[2] < -0.499)],
    )  # fmt: skip
    dust = nts.Continuum(
        box((-0.11, -0.12, 0.0), (0.1, 0.1, 0.1), (1, 1, 1)), soft, density=1e-7, name="dust",
        velocity=(0.3, 0.0, 0.0),
    )  # fmt: skip
    pair = nts.ContactPair(
        dust.surface(lambda x: x[2] < 1e-9), plate.surface(lambda x: x[2] > -1e-9),
        friction=friction,
    )  # fmt: skip
    system = nts.System([dust, plate], contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.02)
    depth = 0.05 - nts.motion_of(dust).centre[2]
    if friction:
        # It falls freely, but for what it bends; the plate's facets are squares of half a metre.
        assert "nodes of contact 'dust-plate' lie up to" in run.status
        assert "pass friction=0" in run.status
        assert run.warnings["contact below rounding"].worst == pytest.approx(2 * depth, rel=1e-3)
        assert depth == pytest.approx(9.81 * 0.02**2 / 2, rel=1e-3)
    else:
        assert run.status == "completed" and depth < 1e-7


@pytest.mark.parametrize(("turn", "told"), [(0.3, False), (0.9, True)])
@pytest.mark.fast_on_ranks("0.9-True")
def test_an_arm_that_cuts_a_corner_is_told(turn, told):
    """Points at radius 2 leave the chord of an arc of 0.9 rad by 2 (1 - cos 0.45) = 0.2 m."""
    rate, pivot = turn / 0.01, 1.1

    def centre(t):
        return pivot * (np.cos(rate * t) - 1.0), pivot * np.sin(rate * t), 0.0

    arm = nts.RigidBody(
        box((0.2, -0.05, -0.2), (2.0, 0.05, 0.2), (4, 1, 1)), density=1e3, name="arm",
        motion=centre, rotation=lambda t: (0.0, 0.0, rate * t),
    )  # fmt: skip
    away = box((1.93, 1.5, -0.04), (2.01, 1.58, 0.04), (1, 1, 1))
    ball = nts.RigidBody(away, density=1e3, name="ball")
    pair = nts.ContactPair(arm.surface(lambda x: x[1] > 0.049), ball.surface(everywhere))
    system = nts.System([arm, ball], contacts=[pair])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.01)
    if not told:
        assert run.status == "completed"
        return
    assert "contact 'arm-ball'" in run.status and "smaller dt" in run.status
    # By the largest component of a motion, which is at least 1/sqrt(2) of it in the plane.
    worst, exact = run.warnings["cut corners"].worst, 2.0 * (1.0 - np.cos(turn / 2))
    assert 0.7 * exact < worst < 1.01 * exact


@pytest.mark.parametrize("facets", [CellType.hexahedron, CellType.tetrahedron])
@pytest.mark.parametrize("whole", [True, False])
def test_masters_that_hide_faces_between_them_are_told(whole, facets):
    """Of two plates side by side with their whole boundaries as masters; not with their tops."""

    def solid(name, low, high, **options):
        mesh = create_box(COMM, [np.array(low), np.array(high)], (2, 2, 1), facets)
        return nts.RigidBody(mesh, density=1e3, name=name, **options)

    held = {"motion": (0, 0, 0), "rotation": (0, 0, 0)}
    plates = [solid(f"plate {k}", (k - 1.0, 0.0, -0.3), (k, 1.0, 0.0), **held) for k in (0, 1)]
    die = solid("die", (-0.3, 0.4, 0.1), (-0.1, 0.6, 0.3))
    bottom = die.surface(lambda x: x[2] < 0.1 + 1e-9)
    pairs = [
        nts.ContactPair(bottom, plate.surface(lambda x: whole | (x[2] > -1e-9))) for plate in plates
    ]
    run = nts.simulate(
        nts.System([*plates, die], contacts=pairs), nts.EnergyMomentum(), dt=1e-3, t_end=1e-3
    )
    assert run.status == "completed" and ("hidden facets" in run.warnings) is whole
    if whole:
        found = run.warnings["hidden facets"]
        # Two squares, or four triangles, of each plate.
        assert found.worst == (4 if facets == CellType.hexahedron else 8)
        assert "'plate 0' lies on one of 'plate 1'" in found.text


@pytest.mark.parametrize(
    ("gravity", "load", "told"),
    [(9.81, None, True), (0.0, (0, 0, -10.0), True), (0.0, lambda t: (0, 0, -10.0 * t), False)],
    ids=["gravity", "constant", "function"],
)
def test_load_steps_that_end_before_all_loads_act(gravity, load, told):
    traction = [] if load is None else [nts.Traction(lambda x: x[2] > 1 - 1e-9, load)]
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [2, 2, 2], CellType.hexahedron)
    body = nts.Continuum(
        mesh, nts.StVenantKirchhoff(1e6, 0.0), density=1e3, traction=traction,
        bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)],
    )  # fmt: skip
    system = nts.System([body], gravity=(0, 0, -gravity))
    run = nts.equilibrium(system, load_steps=[0.25, 0.5])
    assert run.status == "completed" and ("part of the loads" in run.warnings) == told
    if told:
        warning = run.warnings["part of the loads"]
        assert (warning.first, warning.worst, warning.grave) == (0.5, 0.5, False)
        assert "end at t=0.5, with 50 % of the constant loads" in warning.text
    # Half of the loads is what it supports, and the look at them has changed nothing.
    half = 0.5 * (1e3 * gravity + (10.0 if load else 0.0))
    assert run.reactions[body.name][-1, 0, 2] == pytest.approx(half, rel=1e-9)
    assert "part of the loads" not in nts.equilibrium(system, load_steps=2).warnings
