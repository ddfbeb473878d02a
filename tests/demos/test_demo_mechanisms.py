"""The demo of mechanisms: of order two beside SciPy and published angles; energies are kept."""

import mechanisms as demo
import numpy as np
import pytest

#: Times at which errors are compared, and steps [s].
ENDS = {"pendulum": (2.0, 1e-2), "four-bars": (1.0, 1e-2), "governor": (0.5, 2e-3)}


@pytest.mark.parametrize("case", ENDS)
def test_of_order_two_beside_scipy(case):
    end, dt = ENDS[case]
    found = [demo.main(cases=(case,), dt=h, t_end=end)[case] for h in (dt, dt / 2)]
    assert np.log2(found[0]["error"] / found[1]["error"]) == pytest.approx(2.0, abs=0.1)
    assert max(r["ledger"] for r in found) < 1e-10


@pytest.mark.slow
def test_angles_of_the_squeezer_are_the_published_ones():
    """The crank has turned by 15.87 rad."""
    found = [demo.main(cases=("squeezer",), dt=h)["squeezer"] for h in (1e-4, 5e-5)]
    assert found[1]["error"] < 3e-3
    assert np.log2(found[0]["error"] / found[1]["error"]) == pytest.approx(2.0, abs=0.1)
    assert max(r["energy"] for r in found) < 1e-11


@pytest.mark.mpi
def test_the_loop_of_bricard_closes():
    r = demo.main(cases=("bricard",), t_end=0.5)["bricard"]
    assert r["status"] == "completed" and r["error"] < 1e-12 and r["energy"] < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("case", demo.CASES)
def test_whole_runs(case):
    r = demo.main(cases=(case,))[case]
    assert r["status"] == "completed"
    assert r["error"] < 1e-2 and r["ledger"] < 1e-10
    assert case == "governor" or r["energy"] < 1e-11
