"""The slider-crank demo: closed kinematics, a rod that bows under a blow, and all balances."""

import numpy as np
import pytest
import slider_crank as demo


def test_closed_kinematics():
    """At both dead centres, with the rod at right angles to the crank, and its length anywhere."""
    r, length = demo.ARM, demo.LENGTH
    upright = np.arctan2(length, r)
    known = [r + length, length - r, np.hypot(r, length)]
    assert demo.place(np.array([0.0, np.pi, upright])) == pytest.approx(known, rel=1e-14)
    angle = np.linspace(0.0, 7.0, 50)
    crank = r * np.array([np.cos(angle), np.sin(angle)])
    rod = np.hypot(demo.place(angle) - crank[0], crank[1])
    assert rod == pytest.approx(np.full(50, length), rel=1e-14)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_ten_steps():
    """Joints hold, and bearing, guide, spring, floor and gravity explain the momentum."""
    r = demo.main(rods=("flexible",), t_end=5e-3, cells=12)["flexible"]
    assert r["status"] == "completed" and r["hit"] == np.inf
    assert r["ledger"] < 1e-11 and r["momentum"] < 1e-12
    assert 1e-6 < r["closure"] < 3e-4


@pytest.mark.parametrize("kind", demo.RODS)
@pytest.mark.slow
def test_a_blow(kind):
    """Balances to round-off, friction under the stop over its way, and joints that hold."""
    dt = 1e-3
    r = demo.main(rods=(kind,), dt=dt, t_end=0.125, cells=12)[kind]
    h = r["history"]
    assert r["status"].startswith("completed") and r["retries"] == 0
    assert r["ledger"] < 1e-11 and r["lost_before"] < 1e-11 and r["momentum"] < 1e-12
    # The face is there within the step in which the blow begins.
    k = round(r["hit"] / dt)
    reach = demo.ARM + demo.LENGTH - demo.REACH
    assert demo.place(h["angle"][k - 1]) - 1e-3 < reach < demo.place(h["angle"][k]) + 1e-3
    assert r["pushed"] > demo.REACH and r["speed"] < 0.8
    # The bumper bulges and rubs on the slider, too.
    assert r["drag"] > 0.02 and 0.0 < r["dissipated"] - r["drag"] < 2e-3
    if kind == "rigid":
        assert r["closure"] < 1e-12
    else:
        assert 1e-5 < r["closure_before"] < 3e-4 < r["closure"] < 3e-3
        assert r["bend"] > 5e-4
