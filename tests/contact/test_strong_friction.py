"""Contacts that touch without force, and friction without bound: the same on any ranks."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from integrators import CONTACT_RULES, MID_STEP
from measures import PROMISED, kinds, ledger_or_word
from pairs import pairs
from point_mass import MASS, turn
from scenes_obstacles import sliding

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
GRAVITY = 9.81


def box(low, high, parts, name, velocity=(0, 0, 0), bcs=()):
    mesh = create_box(
        COMM, [np.array(low, float), np.array(high, float)], parts, CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    rubber = nts.StVenantKirchhoff(young=1e6, poisson=0.3)
    return nts.Continuum(mesh, rubber, density=1e3, name=name, velocity=velocity, bcs=bcs)


# ---- a touch without force
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("friction", "meshed", "accuracy"),
    pairs([50.0, 1e6, np.inf], [False, True], ["exact", "balanced"]),
)
@pytest.mark.fast_on_ranks()
def test_a_cube_flush_with_a_wall_falls_freely(meshed, friction, accuracy):
    """No force presses it to the wall, so none of friction's acts: v = -g t."""
    system = flush(meshed, friction)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.02, accuracy=accuracy)
    assert run.status == "completed" and run.retries == 0
    momentum = run.balance["linear_momentum"]
    assert momentum[-1, 2] == pytest.approx(-1e3 * GRAVITY * 0.02, rel=1e-9)
    assert not run.balance["active"].any()
    assert run.balance["friction_dissipation"][-1] == 0.0
    assert run.balance["min_gap"].min() > -2e-15


def flush(meshed, friction, gap=0.0):
    """A cube beside a vertical wall that is `gap` away."""
    cube = box((0, 0, 0), (1, 1, 1), (2, 2, 2), "cube")
    side, bodies = cube.surface(lambda x: x[0] < 1e-9), [cube]
    master = nts.Plane((-gap, 0, 0), (1, 0, 0))
    if meshed:
        still = nts.Dirichlet(lambda x: x[0] < 1e-9)
        wall = box((-0.5, -1, -1.1), (-gap, 2, 2.1), (1, 3, 3), "wall", bcs=[still])
        master, bodies = wall.surface(lambda x: x[0] > -1e-9), [cube, wall]
    pair = nts.ContactPair(side, master, friction=friction)
    return nts.System(bodies, contacts=[pair], gravity=(0, 0, -GRAVITY))


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("young", "cells", "friction"),
    [(2e11, 2, 50.0), (2e11, 4, 50.0), (2e11, 6, np.inf), (1e6, 6, np.inf)],
)
@pytest.mark.fast("200000000000.0-2-50.0", "200000000000.0-4-50.0", "1000000.0-6-inf")
@pytest.mark.fast_on_ranks()
def test_a_stiff_or_fine_cube_flush_with_a_wall_falls_freely(young, cells, friction):
    """Rounding of its own forces, a million times that of its weight, presses it to the wall.

    Of the finest, iterates hold what an iterative linear solver leaves.
    """
    mesh = create_box(
        COMM, [[0, 0, 0], [1, 1, 1]], [cells] * 3, CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    material = nts.StVenantKirchhoff(young=young, poisson=0.3)
    cube = nts.Continuum(mesh, material, density=1e3)
    wall = nts.Plane((0, 0, 0), (1, 0, 0))
    pair = nts.ContactPair(cube.surface(lambda x: x[0] < 1e-9), wall, friction=friction)
    system = nts.System([cube], contacts=[pair], gravity=(0, 0, -GRAVITY))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.06)
    assert run.status == "completed" and run.retries == 0
    momentum = run.balance["linear_momentum"][-1]
    assert np.allclose(momentum, [0, 0, -1e3 * GRAVITY * 0.06], rtol=0, atol=1e-9 * 1e3)


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [50.0, np.inf])
@pytest.mark.parametrize("meshed", [False, True])
@pytest.mark.fast_on_ranks()
def test_a_cube_that_touches_as_far_as_coordinates_tell_falls_freely(meshed, friction):
    """100 m off the origin a turned cube's nodes are off its wall by a hundred times rounding."""
    q, at = turn(0.9), np.full(3, 100.0)

    def placed(low, high, parts, name, bcs=()):
        mesh = create_box(
            COMM, [np.array(low, float), np.array(high, float)], parts, CellType.hexahedron,
            ghost_mode=GhostMode.shared_facet,
        )  # fmt: skip
        mesh.geometry.x[:] = mesh.geometry.x @ q.T + at
        rubber = nts.StVenantKirchhoff(young=1e6, poisson=0.3)
        return nts.Continuum(mesh, rubber, density=1e3, name=name, bcs=bcs)

    def on_wall(x):
        return np.abs((x.T - at) @ q[:, 0]) < 1e-9

    cube = placed((0, 0, 0), (1, 1, 1), (2, 2, 2), "cube")
    master, bodies = nts.Plane(at, q[:, 0]), [cube]
    if meshed:
        still = nts.Dirichlet(lambda x: np.full(x.shape[1], True))
        wall = placed((-0.5, -1, -1.1), (0, 2, 2.1), (1, 3, 3), "wall", bcs=[still])
        master, bodies = wall.surface(on_wall), [cube, wall]
    pair = nts.ContactPair(cube.surface(on_wall), master, friction=friction)
    gravity = -GRAVITY * q[:, 2]
    system = nts.System(bodies, contacts=[pair], gravity=gravity)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.02)
    assert run.status == "completed" and run.retries == 0
    momentum = run.balance["linear_momentum"][-1]
    assert np.linalg.norm(momentum - 1e3 * 0.02 * gravity) < 1e-9 * 1e3 * 0.02 * GRAVITY


# ---- no normal force that friction could be in proportion to
@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.parametrize("name", ["sphere", "cylinder"])
@pytest.mark.fast("sphere-midpoint", "cylinder-energy-momentum", "cylinder-gonzalez contact")
@pytest.mark.fast_on_ranks("cylinder-energy-momentum")
def test_a_bead_at_the_side_of_a_ring_hangs_by_infinite_friction(name, integrator):
    """v_t = sqrt(g R / mu) is the speed at which m v^2 / R carries it: zero without bound."""
    ring = {
        "sphere": nts.Sphere((0, 0, 0), 1.0, inside=True),
        "cylinder": nts.Cylinder((0, 0, 0), (0, 1, 0), 1.0, inside=True),
    }[name]
    gravity = (0, 0, -GRAVITY)
    system = sliding(ring, np.inf, (1, 0, 0), (0, 0, 0), gravity)
    run = nts.simulate(system, CONTACT_RULES[integrator], dt=1e-2, t_end=0.2)
    assert run.status == "completed" and run.retries == 0
    assert run.balance["energy"][-1] < 1e-9 * MASS * GRAVITY
    assert np.linalg.norm(run.balance["linear_momentum"][-1]) < 1e-4 * MASS


@pytest.mark.slow
def test_strong_friction_has_a_limit():
    """A soft disc released at the side of a ring, whose nodes press next to nothing there."""
    runs = [_disc(mu) for mu in (1e4, 1e6)]
    for run in runs:
        assert run.status == "completed" and not run.warnings
    near, limit = (run.balance["energy"][-1] for run in runs)
    assert abs(near - limit) < 2e-2 * limit
    # Without a limit a node neither sticks, by a pull, nor leaves, as it would enter the ring.
    endless = _disc(np.inf).status
    assert "infinite friction may let it neither stick nor leave: try friction=1e4" in endless


def _disc(friction):
    mesh = create_box(
        COMM, [np.array([-0.2, 0, -0.2]), np.array([0.2, 0.1, 0.2])], (8, 1, 8),
        CellType.hexahedron, ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    x = mesh.geometry.x
    radius = np.hypot(x[:, 0], x[:, 2])
    x[:, ::2] *= (np.abs(x[:, ::2]).max(axis=1) / np.maximum(radius, 1e-9))[:, None]
    x[:, 0] += 0.8
    rubber = nts.StVenantKirchhoff(young=1e6, poisson=0.3)
    disc = nts.Continuum(mesh, rubber, density=1e3, name="disc")
    rim = disc.surface(lambda x: np.hypot(x[0] - 0.8, x[2]) > 0.2 - 1e-9)
    ring = nts.Cylinder((0, 0, 0), (0, 1, 0), 1.0, inside=True)
    pair = nts.ContactPair(rim, ring, friction=friction)
    system = nts.System([disc], contacts=[pair], gravity=(0, 0, -GRAVITY))
    return nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=0.2)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("rule", "gap", "accuracy"), pairs(MID_STEP, [0.05, 0.0499], ["exact", "balanced"])
)
@pytest.mark.slow
def test_cubes_that_meet_at_the_end_of_a_step(rule, gap, accuracy):
    """mu = 1e6 binds as no bound does; at 5 m/s a gap of 0.05 m closes after five steps."""
    energies = []
    for friction in (1e6, np.inf):
        left = box((0, 0, 0), (1, 1, 1), (3, 3, 3), "left", (5, 0, 0))
        right = box((1 + gap, 0, 0), (2 + gap, 1, 1), (2, 2, 2), "right")
        slave = left.surface(lambda x: x[0] > 1 - 1e-9)
        master = right.surface(lambda x: x[0] < 1 + gap + 1e-9)
        pair = nts.ContactPair(slave, master, friction=friction)
        system = nts.System([left, right], contacts=[pair])
        run = nts.simulate(system, MID_STEP[rule], dt=2e-3, t_end=0.03, accuracy=accuracy)
        assert run.status == "completed" and run.retries == 0
        assert run.balance["linear_momentum"][-1, 0] == pytest.approx(5e3, rel=1e-9)
        energies.append(run.balance["energy"][-1])
    assert energies[0] == pytest.approx(energies[1], rel=1e-7)


# ---- a heavy slave on a light master
def large_on_small(place, friction, n):
    """A cube of one cell on a plate of n^2 facets, 50 of which are as wide as the cube."""
    fine = 1 / 50
    still = nts.Dirichlet(lambda x: x[2] < -fine + 1e-9)
    plate = box((0, 0, -fine), (n * fine, n * fine, 0), (n, n, 1), "plate", bcs=[still])
    cube = box((place, place, 0), (place + 1, place + 1, 1), (1, 1, 1), "cube")
    pair = nts.ContactPair(
        cube.surface(lambda x: x[2] < 1e-9), plate.surface(lambda x: x[2] > -1e-9),
        friction=friction,
    )  # fmt: skip
    return nts.System([cube, plate], contacts=[pair], gravity=(0, 0, -GRAVITY))


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.3, 5.0, np.inf])
@pytest.mark.parametrize("place", [-4e-4, 0.0, 0.062])
@pytest.mark.fast("-0.0004-inf", "0.0-0.3", "0.062-5.0")
@pytest.mark.fast_on_ranks("0.062-5.0")
def test_one_large_element_stands_on_small_facets(place, friction):
    """Its nodes are 1e5 times heavier than the plate's: c belongs to what yields, the plate.

    At the plate's corner they are heavier still, also a little outside of it.
    """
    system = large_on_small(place, friction, 10)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=3e-3)
    assert run.status.startswith("completed") and run.retries == 0
    # 0.2 m of plate under 1 m of cube: to the nearer rim from the node that stands on it.
    assert set(kinds(run)) <= {"contact inside a rim"}
    for told in (w for w in run.warnings.every if w.kind in kinds(run)):
        assert told.worst == pytest.approx(0.2 - max(place, 0.0), rel=5e-3)
    assert run.balance["active"][-1] >= 1
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * run.balance["kinetic"].max()


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "friction"), [(MID_STEP["midpoint"], 0.3), (MID_STEP["energy-momentum"], np.inf)]
)
def test_one_large_element_presses_a_plate_of_400_facets(integrator, friction):
    """20 steps, in which the facets under its node give way: it does not stop."""
    system = large_on_small(0.0, friction, 20)
    run = nts.simulate(system, integrator, dt=1e-3, t_end=0.02, accuracy="balanced")
    assert run.status.startswith("completed") and run.retries == 0
    # 0.4 m of plate under 1 m of cube, whose face the rim of the plate holds, too.
    assert set(kinds(run)) <= {"contact inside a rim"}
    closed = PROMISED["balanced"] if integrator.closes_ledger else 1e-5
    assert ledger_or_word(run, closed) < closed
