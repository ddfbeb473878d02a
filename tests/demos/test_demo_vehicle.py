"""The demo of a vehicle that brakes: deceleration and load transfer beside their closed forms."""

import pytest
import vehicle as demo


@pytest.mark.slow
def test_brakes():
    """Rolling on polygons takes something, too: 2 % more than the brakes alone."""
    r = demo.main(t_end=0.8)
    assert r["status"].startswith("completed")
    assert r["deceleration"] == pytest.approx(r["closed"], rel=0.04)
    assert r["transfer"] == pytest.approx(r["closed_transfer"], rel=0.1)
    assert r["weight"] == pytest.approx(1.0, abs=0.03)
    assert r["friction"] < 0.01 and r["ledger"] < 1e-9


@pytest.mark.mpi
def test_rolls_before_it_brakes():
    """What the motors and gravity do is little, and no wheel slides."""
    r = demo.main(facets=16, t_end=0.03)
    assert r["status"].startswith("completed")
    assert abs(r["braked"]) < 1e-2 and r["friction"] < 1e-6 and r["ledger"] < 1e-9
