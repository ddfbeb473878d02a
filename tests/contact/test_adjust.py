"""Gaps at the start that count as none, against weights, impulses and balances."""

from mpi4py import MPI

import measures
import numpy as np
import pytest
from scenes import UNITS, at, box, rubbing_blocks

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
#: Gap of the block over its edge, gravity over the edge [1/s^2], weight of 1,000 kg over the edge.
GAP, GRAVITY = 1e-2, 10.0
WEIGHT = 1e3 * GRAVITY


def block_on(kind, unit=1.0, sign=1.0, **options):
    """A unit cube a little above or inside a plate, or an obstacle, under its weight.

    Args:
        kind: What it is on: "plate" or "plane".
        unit: Edge of the cube [m].
        sign: -1: inside.
        options: Of the contact.
    """
    soft = nts.NeoHookean(young=1e6 / unit, poisson=0.3)
    gap = sign * GAP
    mesh = box((0, 0, 0), (1, 1, 1), 3)
    mesh.geometry.x[:, 2] += gap
    mesh.geometry.x[:] *= unit
    cube = nts.Continuum(mesh, soft, density=1e3 / unit**3, name="cube")
    bodies, master = [cube], nts.Plane((0, 0, 0), (0, 0, 1))
    if kind == "plate":
        mesh = box((-0.5, -0.5, -0.5), (1.5, 1.5, 0), (4, 4, 1))
        mesh.geometry.x[:] *= unit
        held = [nts.Dirichlet(at(2, -0.5 * unit, unit))]
        plate = nts.Continuum(mesh, soft, density=1e3 / unit**3, bcs=held, name="plate")
        bodies.append(plate)
        master = plate.surface(at(2, 0.0, unit))
    pair = nts.ContactPair(cube.surface(at(2, gap * unit, unit)), master, **options)
    return nts.System(bodies, contacts=[pair], gravity=(0, 0, -GRAVITY * unit))


@pytest.mark.parametrize("kind", ["plate", "plane"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.fast("1.0-plane", "-1.0-plane")
def test_a_block_beside_a_plate_rests_on_it_at_once(kind, sign):
    for unit in (1.0, UNITS[0]):
        system = block_on(kind, unit, sign, friction=0.3, adjust=1.001 * GAP * unit)
        run = nts.equilibrium(system)
        assert run.status == "completed" and not measures.kinds(run)
        assert run.contact_forces[-1, 0, 2] == pytest.approx(WEIGHT * unit, rel=1e-8)
        table = run.balance
        assert np.abs(table["min_gap"][-1]) < 1e-12 * unit and table["active"][-1] == 16


@pytest.mark.fast_on_ranks()
def test_it_stays_at_rest_in_time():
    """From the first instant, on its equilibrium and inside the plate; else it would fall."""
    system = block_on("plate", sign=-1.0, friction=0.3, adjust=1.001 * GAP)
    rest = nts.equilibrium(system)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=1e-2, start=rest, start_time=0)
    assert run.status == "completed" and not measures.kinds(run)
    assert np.abs(run.contact_forces[:, 0, 2] / WEIGHT - 1.0).max() < 1e-7
    assert run.balance["kinetic"].max() < 1e-12 * rest.balance["energy"][-1]
    assert np.abs(run.balance["min_gap"]).max() < 1e-12


def rubbing(adjust):
    """Blocks 0.05 beside each other, one of which flies at the other."""
    system = rubbing_blocks(0.3)
    (pair,) = system.contacts
    touching = nts.ContactPair(pair.slave, pair.master, friction=0.3, adjust=adjust)
    return nts.System(system.bodies, contacts=[touching])


@pytest.mark.parametrize("integrator", [nts.EnergyMomentum(), nts.Midpoint()])
@pytest.mark.fast("integrator0")
@pytest.mark.fast_on_ranks()
def test_bodies_that_touch_across_a_gap_keep_momenta_and_energy(integrator):
    run = nts.simulate(rubbing(0.0501), integrator, dt=2e-3, t_end=0.06)
    assert run.status == "completed"
    table = run.balance
    # At 2 m/s the gap would take 25 ms.
    assert table["active"][1] >= 9 and table["friction_dissipation"][2] > 0.0
    for name in ("linear_momentum", "angular_momentum"):
        off = np.abs(table[name] - table[name][0]).max()
        assert off < 1e-12 * np.abs(table[name][0]).max()
    if isinstance(integrator, nts.EnergyMomentum):
        energy = table["energy"][0]
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy
    assert table["min_gap"][1:].min() > -1e-10
    far = nts.simulate(rubbing(0.0499), integrator, dt=2e-3, t_end=0.01)
    assert not far.balance["active"].any()


def test_a_checkpoint_of_another_gap_is_refused(mpi_tmp_path):
    path = mpi_tmp_path / "run.h5"
    saves = nts.Checkpoint(path, every=1)
    nts.simulate(rubbing(0.0501), nts.EnergyMomentum(), dt=2e-3, t_end=2e-3, checkpoint=saves)
    with pytest.raises(ValueError, match="adjust"):
        nts.restart(path, rubbing(0.0502))


@pytest.mark.parametrize("adjust", [-1.0, np.inf, "near", None, True])
def test_what_is_no_distance_is_refused(adjust):
    system = rubbing_blocks(0.0)
    (pair,) = system.contacts
    with pytest.raises(ValueError, match=r"adjust=.*: pass a distance >= 0"):
        nts.ContactPair(pair.slave, pair.master, adjust=adjust)
