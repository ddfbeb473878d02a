"""Equilibrium of bodies pressed by rigid planes and spheres without a mesh."""

import math

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from scenes import YOUNG, at, box, everywhere, quarter_cube, rubber_stress

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD


@pytest.mark.mpi
def test_a_plane_presses_like_a_prescribed_face():
    """Laterally held: P = mu (s - 1/s) + lambda ln s / s, and the work of the mean force."""
    held = nts.Dirichlet(lambda x: np.full(x.shape[1], True), components=(0, 1))
    support = nts.Dirichlet(at(2, 0.0), components=(2,))
    body = quarter_cube([held, support])
    press = nts.Plane((0, 0, 1), (0, 0, -1), motion=lambda t: (0, 0, -0.3 * t))
    pair = nts.ContactPair(body.surface(lambda x: x[2] > 1 - 1e-9), press)
    run = nts.equilibrium(nts.System([body], contacts=[pair]), load_steps=4)
    assert run.status == "completed"
    stretch = 1 - 0.3 * run.balance["time"]
    force = rubber_stress(stretch, np.log(stretch))
    assert np.abs(run.contact_forces[:, 0, 2] - force).max() < 1e-11 * YOUNG
    assert np.abs(run.reactions["cube"][:, -1, 2] + force).max() < 1e-11 * YOUNG
    mean = 0.5 * (force[1:] + force[:-1]) * np.diff(stretch)
    assert np.allclose(run.balance["external_work"][1:], np.cumsum(mean), rtol=1e-11)


def on_floor(friction, shift):
    mesh = box([0, 0, 0], [1, 1, 0.5], [3, 3, 2])
    top = nts.Dirichlet(lambda x: x[2] > 0.5 - 1e-9, value=lambda t: (shift * t, 0, -0.02 * t))
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=1e5, poisson=0.3), density=1e3, bcs=[top], name="block"
    )
    floor = nts.Plane((0, 0, 0), (0, 0, 1), name="floor")
    face = body.surface(lambda x: x[2] < 1e-9)
    return nts.System([body], contacts=[nts.ContactPair(face, floor, friction=friction)])


@pytest.mark.mpi
@pytest.mark.parametrize("shift", [0.002, 0.1])
@pytest.mark.fast_on_ranks()
def test_friction_carries_the_shear(shift):
    """Pressed down and dragged: sticking, or the whole face slides at mu times the pressure."""
    mu = 0.3
    run = nts.equilibrium(on_floor(mu, shift), load_steps=10)
    assert run.status == "completed"
    force = run.contact_forces[-1, 0]
    top = run.reactions["block"][-1, 0]
    assert np.abs(force + top).max() < 1e-9 * force[2]
    if shift > 0.05:
        assert run.balance["slip"][-1] == 16
        assert force[0] == pytest.approx(-mu * force[2], rel=1e-2)
    else:
        assert run.balance["stick"][-1] > 0
        assert -mu * force[2] < force[0] < 0


@pytest.mark.slow
def test_a_ball_is_pressed_into_a_block_and_let_go():
    """Statics with a moving ball, then a dynamic run that starts there: the ledger closes."""
    mesh = create_box(COMM, [[-1, -1, -1], [1, 1, 0]], [6, 6, 3], CellType.hexahedron)
    hold = nts.Dirichlet(lambda x: x[2] < -1 + 1e-9)

    def scene():
        body = nts.Continuum(
            mesh, nts.NeoHookean(young=1e4, poisson=0.3), density=1e3, bcs=[hold], name="block"
        )
        ball = nts.Sphere(
            (0.02, 0.01, 1.0), 1.0, motion=lambda t: (0, 0, -0.1 * min(t, 2.0 - t)), name="ball"
        )
        face = body.surface(lambda x: x[2] > -1e-9)
        return nts.System([body], contacts=[nts.ContactPair(face, ball, friction=0.2)])

    pressed = nts.equilibrium(scene(), load_steps=5)
    assert pressed.status == "completed"
    force = pressed.contact_forces[-1, 0]
    assert force[2] < 0
    assert np.abs(force + pressed.reactions["block"][-1, 0]).max() < 1e-9 * np.abs(force[2])
    assert pressed.balance["active"][-1] >= 4
    run = nts.simulate(scene(), nts.EnergyMomentum(), dt=2e-2, t_end=1.6, start=pressed)
    assert run.status == "completed"
    table = run.balance
    top = np.abs(table["energy"]).max()
    assert table["active"][1] >= 4
    assert np.abs(table["external_work"]).max() > 0.01 * top
    assert np.abs(table["ledger_residual"]).max() < 1e-10 * top
    assert (np.diff(table["friction_dissipation"]) >= -1e-12 * top).all()


def test_relaxations_lose_no_slip_and_no_dissipation():
    """A stabilized load step gets there in several parts, each with a slip of its own."""
    plain, stabilized = (
        nts.equilibrium(on_floor(0.3, 0.05), load_steps=5, stabilization=value)
        for value in (None, 0.1)
    )
    for run in (plain, stabilized):
        assert run.status == "completed" and run.balance["slip"].any()
    a, b = (r.balance["friction_dissipation"][-1] for r in (plain, stabilized))
    assert b == pytest.approx(a, rel=5e-3)
    slip = plain.state.contacts[0].slip
    assert stabilized.state.contacts[0].slip == pytest.approx(slip, rel=5e-3)


def test_obstacles_of_two_scenes_are_alike_though_their_motions_are_two_functions():
    def floor():
        return nts.Plane((0, 0, 0), (0, 0, 1), motion=lambda t: (0, 0, t))

    assert floor() == floor()
    assert floor() != nts.Plane((0, 0, 1), (0, 0, 1))


def on_slope(degrees, cells, newton=None, others=()):
    """Equilibrium of a rigid block of base 0.2 m and height 0.5 m, and of other bodies."""
    a = math.radians(degrees)
    mesh = create_box(COMM, [[0, 0, 0], [0.2, 0.2, 0.5]], cells, CellType.hexahedron)
    block = nts.RigidBody(mesh, density=1e3, name="block")
    slope = nts.Plane((0, 0, 0), (0, 0, 1))
    pair = nts.ContactPair(block.surface(lambda x: x[2] < 1e-9), slope, friction=0.8)
    down = (9.81 * math.sin(a), 0, -9.81 * math.cos(a))
    system = nts.System([block, *others], contacts=[pair], gravity=down)
    return block, nts.equilibrium(system, load_steps=2, newton=newton)


@pytest.mark.mpi
@pytest.mark.parametrize("cells", [(2, 2, 3), (4, 4, 4)])
@pytest.mark.parametrize("degrees", [12, 18, 20, 21.7])
@pytest.mark.fast_on_ranks("20-cells0")
def test_a_rigid_block_on_a_slope_stays_where_it_rests(degrees, cells):
    """Its weight acts within its base, tan a < b / h = 0.4: nothing moves, however many nodes.

    It turned on its lower edge, where it is in equilibrium, too, but in an unstable one.
    """
    block, run = on_slope(degrees, cells)
    a, weight = math.radians(degrees), 9.81 * 1e3 * 0.2 * 0.2 * 0.5
    assert run.status == "completed"
    assert not run.warnings
    assert np.abs(block.position - [0.1, 0.1, 0.25]).max() < 1e-12
    assert np.abs(block.u.x.array).max(initial=0.0) < 1e-12
    force = weight * np.array([-math.sin(a), 0, math.cos(a)])
    assert np.abs(run.contact_forces[-1, 0] - force).max() < 1e-10 * weight


@pytest.mark.mpi
@pytest.mark.parametrize("young", [10.0, 1e3, 1e7])
def test_a_body_elsewhere_does_not_turn_a_rigid_block(young):
    """However soft it is: contact of the rigid one was scaled by its stiffness."""
    mesh = create_box(COMM, [[5, 0, 0], [5.1, 0.1, 0.1]], [2, 2, 2], CellType.hexahedron)
    held = nts.Dirichlet(at(2, 0.0))
    law = nts.NeoHookean(young=young, poisson=0.3)
    other = nts.Continuum(mesh, law, density=1e-6, bcs=[held], name="other")
    block, run = on_slope(20, (2, 2, 3), others=[other])
    assert run.status == "completed"
    assert np.abs(block.u.x.array).max(initial=0.0) < 1e-12


@pytest.mark.slow
def test_a_rigid_block_on_a_slope_that_is_too_steep_has_no_equilibrium():
    _, run = on_slope(22, (2, 2, 3), nts.Newton(max_retries=1))
    assert "not solved" in run.status


@pytest.mark.parametrize("stabilization", [None, 0.1])
def test_what_slides_under_stabilization_drags_by_coulombs_bound(stabilization):
    """What nodes slid in the first relaxation of a load step, they have slid in all of them."""
    top = nts.Dirichlet(lambda x: x[2] > 0.5 - 1e-9, value=lambda t: (0, 0, -0.01 * min(t, 1.0)))
    mesh = box((0, 0, 0), (1, 1, 0.5), (2, 2, 2))
    pad = nts.Continuum(mesh, nts.NeoHookean(young=1e7, poisson=0.0), density=1e3, bcs=[top])
    floor = nts.Plane((0, 0, 0), (0, 0, 1), motion=lambda t: (0.1 * max(0.0, t - 1.0), 0, 0))
    pair = nts.ContactPair(pad.surface(lambda x: x[2] < 1e-9), floor, friction=0.3)
    times = [0.5, 1.0, 1.25, 1.5, 1.75, 2.0]
    run = nts.equilibrium(
        nts.System([pad], contacts=[pair]), load_steps=times, stabilization=stabilization
    )
    drag, _, normal = np.abs(run.contact_forces[3:, 0]).T
    assert drag / normal == pytest.approx(0.3, rel=1e-9)
    # In the first of these steps the pad follows the floor for a part of the way.
    lost = np.diff(run.balance["friction_dissipation"][3:])
    assert lost == pytest.approx(0.025 * drag[1:], rel=1e-6)


def pad_on(floors, friction, steps, stabilization=None):
    """Drag and normal force of a pad at the end of load steps over floors that slide under it."""
    top = nts.Dirichlet(at(2, 0.5), value=lambda t: (0, 0, -0.01 * min(t, 1.0)))
    rubber = nts.NeoHookean(young=1e7, poisson=0.0)
    mesh = box((0, 0, 0), (1, 1, 0.5), (6, 3, 2))
    pad = nts.Continuum(mesh, rubber, density=1e3, bcs=[top], name="pad")
    moved = nts.Dirichlet(everywhere, value=lambda t: (0.8 * max(0.0, t - 1.0), 0, 0))
    bodies = [
        nts.Continuum(mesh, rubber, density=1e3, bcs=[moved], name=f"floor {k}")
        for k, mesh in enumerate(floors)
    ]
    pairs = [
        nts.ContactPair(
            pad.surface(at(2, 0.0)), body.surface(lambda x: x[2] > -0.05), friction=friction,
            interference="resolve",
        )
        for body in bodies
    ]  # fmt: skip
    system = nts.System([pad, *bodies], contacts=pairs)
    times = [0.5, 1.0, *np.linspace(1.0, 2.0, steps + 1)[1:]]
    run = nts.equilibrium(system, load_steps=times, stabilization=stabilization)
    assert run.status == "completed"
    force = np.abs(run.contact_forces.sum(axis=1))
    return force[2 :: steps // 4][1:, [0, 2]].T


@pytest.mark.parametrize("stabilization", [None, 0.1])
@pytest.mark.fast("None")
def test_nodes_that_slide_over_waves_in_few_load_steps(stabilization):
    """An equilibrium is that of the facets where its nodes are, however far they came in a step.

    Nodes kept the facets where the step began, and four load steps dragged with 57 kN for 37.
    """
    floor = box((-1.03, -0.3, -0.3), (1.97, 1.3, 0), (24, 4, 1))
    x = floor.geometry.x
    waves = 0.004 * (1.0 + np.cos(4.0 * np.pi * x[:, 0]))
    x[:, 2] -= np.where(x[:, 2] > -1e-9, waves, 0.0)
    few = pad_on([floor], 0.3, 4, stabilization)
    assert few == pytest.approx(pad_on([floor], 0.3, 16), rel=1e-6)


@pytest.mark.parametrize("stabilization", [None, 1.0])
def test_a_pad_slides_over_the_seam_of_two_floors(stabilization):
    """What nodes have slid counts for the contact that they come to, too."""
    ends = (-1.03, 0.47, 1.97)
    floors = [
        box((a, -0.3, -0.5), (b, 1.3, 0), (4, 4, 1))
        for a, b in zip(ends[:-1], ends[1:], strict=True)
    ]
    drag, normal = pad_on(floors, 0.3, 4, stabilization)
    assert drag / normal == pytest.approx(0.3, rel=1e-6)
