"""The ironing demo: forces in the published band, on a coarser mesh than the demo's."""

import ironing as demo
import numpy as np
import pytest

COARSE = {"block": (24, 4), "die": (8, 3)}


def assert_inside_the_band(result, at):
    for name, (low, high) in zip(demo.DIRECTIONS, demo.BAND[at], strict=True):
        assert low <= result[f"{name} at {at}"] <= high, name


def test_the_way_of_the_die():
    assert demo.path(0.5) == (0.0, -0.5 * demo.DOWN, 0.0)
    assert demo.path(1.5) == (0.5 * demo.ALONG, -demo.DOWN, 0.0)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_first_touch_is_where_the_gap_says():
    """The arc is 0.2 mm above the block: contact at time 0.2, and no force before."""
    result = demo.main(**COARSE, steps=(10, 50), end=0.4)
    assert result["status"] == "completed"
    closed = result["time"] > 0.2 + 1e-9
    assert (np.abs(result["vertical"][~closed]) < 1e-6).all()
    assert (result["vertical"][closed] > 1.0).all()


@pytest.mark.slow
def test_forces_are_inside_the_published_band():
    result = demo.main(**COARSE, steps=(10, 100), end=1.5)
    assert result["status"] == "completed"
    for at in demo.BAND:
        assert_inside_the_band(result, at)
    # Drawn along, friction carries at least mu times the load; climbing out of the trough adds.
    ratio = result["horizontal at 1.5"] / result["vertical at 1.5"]
    assert demo.FRICTION < ratio < 0.5
    assert 0.0 < result["dissipated"] < result["work"]
