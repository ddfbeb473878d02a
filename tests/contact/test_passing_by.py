"""Bodies that pass beside each other, whose whole boundaries are surfaces, feel nothing."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from integrators import MID_STEP
from scenes import RUBBER, everywhere

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD


def box(low, size, cells, kind=CellType.hexahedron):
    low = np.asarray(low, dtype=float)
    return create_box(COMM, [low, low + size], cells, kind)


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast_on_ranks("energy-momentum")
@pytest.mark.fast("midpoint")
def test_a_cube_flies_below_another_one(integrator):
    """Of the two facets at the upper edge it is the top that keeps the other cube outside."""
    low = nts.Continuum(
        box((0, 0, 0), 1.0, (2, 2, 2)), RUBBER, density=1e3, velocity=(2, 0, 0), name="low"
    )
    high = nts.Continuum(box((1.05, 0, 1.1), 1.0, (2, 2, 2)), RUBBER, density=1e3, name="high")
    pair = nts.ContactPair(high.surface(everywhere), low.surface(everywhere))
    run = nts.simulate(nts.System([low, high], contacts=[pair]), integrator, dt=2e-3, t_end=0.06)
    assert run.status == "completed" and run.balance["active"].max() == 0
    assert np.abs(nts.motion_of(high).velocity).max() < 1e-12
    assert np.abs(run.balance["contact_defect"]).max() == 0.0


@pytest.mark.mpi
@pytest.mark.slow
def test_a_block_falls_once_it_has_left_the_table():
    """Its end passes the edge at 0.3 s, later by as much as it has turned about the edge."""
    table = nts.RigidBody(
        box((-1, -1, -0.5), (2, 2, 0.5), (4, 4, 1)), density=1e3, motion=(0, 0, 0),
        rotation=(0, 0, 0), name="table",
    )  # fmt: skip
    block = nts.RigidBody(
        box((0.7, -0.2, 0), (0.4, 0.4, 0.2), (4, 2, 1)), density=1e3, velocity=(1, 0, 0),
        name="block",
    )  # fmt: skip
    pair = nts.ContactPair(block.surface(lambda x: x[2] < 1e-9), table.surface(everywhere))
    system = nts.System([table, block], contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=4e-3, t_end=0.4)
    off = run.balance["time"] > 0.33
    assert run.status == "completed" and run.balance["active"][off].max() == 0
    # Free fall from then on.
    momentum = run.balance["linear_momentum"][off][:, 2]
    fall = -9.81 * 0.032e3 * (run.balance["time"][off] - run.balance["time"][off][0])
    assert np.allclose(momentum - momentum[0], fall, rtol=1e-9, atol=1e-9 * 32.0)


@pytest.mark.mpi
@pytest.mark.parametrize("number", range(12))
@pytest.mark.fast_on_ranks("1")
@pytest.mark.fast("0")
def test_boxes_that_pass_at_random(number):
    """One flies along a side of the other, 1 to 50 mm away, in steps of up to 0.15 m."""
    rng = np.random.default_rng(number)
    kind = (CellType.hexahedron, CellType.tetrahedron)[number % 2]
    axis, clear = number % 3, rng.uniform(1e-3, 0.05)
    way = rng.normal(size=3)
    way[axis] = 0.0
    way /= np.linalg.norm(way)
    middle = rng.uniform(-0.5, 0.5, 3)
    middle[axis] = 1.0 + clear
    rests = nts.RigidBody(
        box((0, 0, 0), 1.0, rng.integers(1, 4, 3), kind), density=1e3, name="rests"
    )
    mesh = box(middle - 1.2 * way, rng.uniform(0.2, 1.0, 3), rng.integers(1, 4, 3), kind)
    options = {"density": 1e3, "velocity": way, "name": "flies"}
    flies = nts.RigidBody(mesh, **options)
    if number % 4 > 1:
        flies = nts.Continuum(mesh, RUBBER, **options)
    slave, master = (rests, flies) if rng.random() < 0.5 else (flies, rests)
    pair = nts.ContactPair(slave.surface(everywhere), master.surface(everywhere), friction=0.3)
    system = nts.System([rests, flies], contacts=[pair])
    dt = rng.uniform(0.02, 0.15)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=2.4)
    assert run.status == "completed"
    assert np.abs(rests.velocity).max() < 1e-12
    assert np.abs(nts.motion_of(flies).velocity - way).max() < 1e-10
