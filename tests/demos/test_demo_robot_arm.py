"""The demo of an arm: Coulomb decides what it holds, and its controllers fall short by M / k."""

import numpy as np
import pytest
import robot_arm as demo


def test_the_pose_reaches_the_wrist():
    for place in (demo.WRIST, demo.WRIST + [0, 0, demo.RISE]):
        upper, fore = demo.pose(place)
        elbow = demo.SHOULDER + demo.UPPER * np.array([np.cos(upper), 0, np.sin(upper)])
        found = elbow + demo.FORE * np.array([np.cos(fore), 0, np.sin(fore)])
        assert found == pytest.approx(place, abs=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "rise"), [("holds", demo.RISE), ("slips", 0.0)])
def test_holds_or_slips(case, rise):
    r = demo.main(cases=(case,))[case]
    assert r["status"].startswith("completed")
    assert r["rise"] == pytest.approx(rise, abs=0.01)
    assert r["turned"] == pytest.approx(demo.TURN if rise else 0.0, abs=0.01)
    for joint in ("shoulder", "elbow"):
        assert r[joint] == pytest.approx(r[f"{joint}_closed"], rel=0.02)
    assert r["ledger"] < 1e-10


@pytest.mark.mpi
def test_grips():
    """The box stays where it is, pressed from both sides alike."""
    r = demo.main(cases=("holds",), t_end=0.05)["holds"]
    assert r["status"].startswith("completed") and abs(r["rise"]) < 1e-4 and r["ledger"] < 1e-10
