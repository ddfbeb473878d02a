"""Demos of beams and shells: the flying ones keep what the midpoint rule does not; a blow rings."""

import drum_stick
import flying_beam
import flying_plate
import pytest
from mpi4py import MPI


def check(demo, dt, t_end, drift):
    """Both integrators at one step size."""
    found = demo.main(steps=(dt,), t_end=t_end)
    exact, midpoint = (found[name, dt] for name in ("energy-momentum", "midpoint"))
    assert exact["status"] == "completed" and exact["time"] == pytest.approx(t_end)
    assert max(exact["energy_drift"], exact["angular_momentum_drift"]) < 1e-12
    assert midpoint["energy_drift"] > drift and midpoint["angular_momentum_drift"] < 1e-11
    return midpoint


@pytest.mark.mpi
@pytest.mark.slow
def test_a_flying_beam():
    midpoint = check(flying_beam, 0.5, 5.0, 1.0)
    assert midpoint["steps"] == 4 and not midpoint["status"].startswith("completed")


@pytest.mark.mpi
@pytest.mark.slow
def test_a_flying_plate():
    midpoint = check(flying_plate, 0.1, 1.5, 0.3)
    assert midpoint["steps"] < 15 and not midpoint["status"].startswith("completed")


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_blow_closes_the_ledger():
    found = drum_stick.main(cells=4, t_end=1e-3)
    assert found["status"] == "completed" and found["blows"] >= 1
    assert found["ledger"] < 1e-11 and 0.0 < found["friction"] < 0.05
    assert found["deepest"] < -1e-4


@pytest.mark.slow
def test_the_plate_rings_at_its_first_frequency():
    found = drum_stick.main(comm=MPI.COMM_SELF)
    assert found["status"] == "completed" and found["ledger"] < 1e-11
    assert found["last_contact"] < 2e-3
    assert found["peak_frequency"] == pytest.approx(found["first_frequency"], rel=0.05)
