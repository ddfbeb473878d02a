"""Demos of beams and shells, beside theory and what their ledgers say."""

from mpi4py import MPI

import drum_stick
import flying_beam
import flying_plate
import leaf_spring
import pytest
import snap_fit


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
    assert midpoint["steps"] < 10 and not midpoint["status"].startswith("completed")


@pytest.mark.mpi
@pytest.mark.slow
def test_a_flying_plate():
    midpoint = check(flying_plate, 0.1, 2.0, 0.3)
    assert midpoint["steps"] < 20 and not midpoint["status"].startswith("completed")


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_blow_closes_the_ledger():
    found = drum_stick.main(cells=4, t_end=1e-3)
    assert found["status"] == "completed" and found["blows"] >= 1
    assert found["ledger"] < 1e-11 and 0.0 < found["friction"] < 0.05
    assert found["deepest"] < -1e-4


@pytest.mark.slow
def test_the_plate_rings_at_its_first_frequency():
    found = drum_stick.main(comm=MPI.COMM_SELF, dt=1e-4)
    assert found["status"] == "completed" and found["ledger"] < 1e-11
    assert found["last_contact"] < 2e-3
    assert found["peak_frequency"] == pytest.approx(found["first_frequency"], rel=0.05)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_leaves_that_slide_on_each_other():
    """Theory's loop; the clamping pressure stiffens the leaves by 1 %."""
    found = leaf_spring.main(cells=8, steps=5, t_end=0.0)
    assert found["status"] == "completed" and found["off theory"] < 0.05
    for name in ("stiffness stuck", "stiffness sliding", "largest deflection", "deflection left",
                 "friction"):  # fmt: skip
        here, theory = found[name]
        assert here == pytest.approx(theory, rel=0.025), name


@pytest.mark.slow
@pytest.mark.parametrize("search", [leaf_spring.SEARCH, {}], ids=["l2", "whole steps"])
@pytest.mark.parametrize("steps", [5, 10])
@pytest.mark.parametrize("cells", [4, 12])
def test_leaves_slide_in_any_steps(monkeypatch, cells, steps, search):
    """No rounding at the clamp decides whether load steps are solved."""
    monkeypatch.setattr(leaf_spring, "SEARCH", search)
    found = leaf_spring.main(comm=MPI.COMM_SELF, cells=cells, steps=steps, t_end=0.0)
    assert found["status"] == "completed" and found["off theory"] < 0.08


@pytest.mark.slow
def test_leaves_that_are_let_go():
    """Each half swing loses a little more to friction than of a mass on a spring."""
    found = leaf_spring.main(comm=MPI.COMM_SELF, cells=8, t_end=0.025)
    assert found["swing status"] == "completed" and found["ledger"] < 1e-11
    assert found["swing back"] == pytest.approx(-1.75, abs=0.1)
    assert found["energy left"] < 0.03


@pytest.mark.mpi
@pytest.mark.slow
def test_a_hook_that_snaps_behind_its_catch():
    found = snap_fit.main(cells=8, steps=4, dt=5e-5, t_end=7e-3)
    assert found["status"] == found["snap status"] == "completed"
    for name in ("peak force", "on the flat face"):
        here, theory = found[name]
        assert here == pytest.approx(theory, rel=0.02)
    assert found["ledger"] < 1e-11 and found["pull"] < -0.3 * found["peak force"][0]
    # Over the nose, after the lead-in face and the flat one, and free until the end.
    way = snap_fit.CLIMB + snap_fit.FLAT
    assert found["snaps at"] == pytest.approx(way / snap_fit.SPEED, rel=0.05)
    assert found["free since"] < 6.8e-3 and 0.1 < found["energy left"] < 0.5
