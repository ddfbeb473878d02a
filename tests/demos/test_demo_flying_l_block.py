"""The flying L-block: energy and momenta after the loads have gone."""

from mpi4py import MPI

import flying_l_block as demo
import numpy as np
import pytest


@pytest.mark.mpi
def test_mesh_is_the_published_one():
    body = demo.scene(MPI.COMM_WORLD).bodies[0]
    cells = body.mesh.topology.index_map(3).size_global
    assert cells == 117
    mass = MPI.COMM_WORLD.allreduce(body.nodal_mass[0::3].sum())
    assert mass == pytest.approx(117 * 100)


def check_conserved(result, t_end):
    assert result["status"] == "completed" and result["time"] == pytest.approx(t_end)
    assert result["energy_drift"] < 1e-10
    assert result["angular_momentum_drift"] < 1e-12
    assert result["linear_momentum"] < 1e-12
    assert result["ledger"] < 1e-10


@pytest.mark.mpi
@pytest.mark.slow
def test_energy_momentum_conserves_and_midpoint_does_not():
    results = demo.main(t_end=12.0)
    check_conserved(results["energy-momentum"], 12.0)
    midpoint = results["midpoint"]
    assert midpoint["angular_momentum_drift"] < 1e-12
    assert midpoint["linear_momentum"] < 1e-12
    assert midpoint["energy_drift"] > 1e-2


def test_loads_give_the_angular_momentum_of_a_small_motion():
    result = demo.main(dt=0.5, t_end=5.0, integrators=("energy-momentum",))["energy-momentum"]
    arm = np.array([1.5, 10, 1.5]) - [6, 1.5, 1.5]
    rigid = 9 * np.cross(arm, demo.LOAD) * demo.END / 2
    difference = np.linalg.norm(result["angular_momentum"] - rigid) / np.linalg.norm(rigid)
    assert difference < 0.1  # the block turns by some ten degrees while it is loaded


@pytest.mark.slow
def test_whole_run_with_the_papers_step():
    results = demo.main(dt=1.0, t_end=100.0)
    check_conserved(results["energy-momentum"], 100.0)
    midpoint = results["midpoint"]
    assert midpoint["time"] < 100 and midpoint["status"] != "completed"
    assert midpoint["energy_drift"] > 0.1
    assert midpoint["angular_momentum_drift"] < 1e-11


@pytest.mark.slow
def test_midpoint_drift_shrinks_with_the_step():
    coarse, fine = (
        demo.main(dt=dt, t_end=15.0, integrators=("midpoint",))["midpoint"] for dt in (0.5, 0.25)
    )
    assert coarse["status"] == fine["status"] == "completed"
    assert 2 < coarse["energy_drift"] / fine["energy_drift"] < 12
