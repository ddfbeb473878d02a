"""The wheel demo: rolling on the tread's length, balances of momentum, and the blow of the step."""

import numpy as np
import pytest
import wheel as demo


def test_the_step_is_smooth():
    """Flat at both ends of the rise, half of it in the middle."""
    x = demo.AT + demo.LONG * np.array([-1.0, 0.0, 0.5, 1.0, 2.0])
    right = demo.STEP * np.array([0, 0, 0.5, 1, 1])
    assert demo.rise(x) == pytest.approx(right, abs=1e-12)
    assert demo.rise(x[[1, 3]] + 1e-6) == pytest.approx(demo.rise(x[[1, 3]] - 1e-6), abs=1e-9)


@pytest.mark.mpi
@pytest.mark.slow
def test_rolls_on_the_flat():
    """The way over the angle is the radius of the tread's length, and the axle is lower."""
    r = demo.main(facets=24, dt=4e-3, duration=0.08)
    assert r["status"] == "completed"
    assert r["effective"] == pytest.approx(r["tread"], rel=5e-3)
    assert r["height"] < 0.995 * r["tread"]
    assert max(r["momentum"], r["carriage"]) < 1e-12 and r["ledger"] < 1e-11


@pytest.mark.slow
def test_over_the_step():
    """More is lost than lifting takes, and ledger and momenta know where it is."""
    r = demo.main(dt=4e-3)
    assert r["status"] == "completed" and r["retries"] == 0
    assert r["effective"] == pytest.approx(r["tread"], rel=2e-3)
    assert r["pressed"] == pytest.approx(1.0, abs=0.03) and r["slipped"] < 0.03
    assert 2.0 < r["peak"] and r["lift"] < r["lost"] < 2.0 * r["lift"]
    assert 0.0 < r["friction"] + r["contact_defect"] < 0.2 * (r["lost"] - r["lift"])
    assert max(r["momentum"], r["carriage"]) < 1e-12 and r["ledger"] < 1e-11
