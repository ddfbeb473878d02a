"""The cradle demo: rigid rows against their closed form, flexible ones against point masses."""

import newtons_cradle as demo
import pytest

THREE = {"balls": 3, "cells": 2}


def test_references_conserve():
    """Of three masses with Hertz's springs the speeds are known; both keep momentum and energy."""
    assert demo.chain(3, 1.5) == pytest.approx([-0.071, 0.076, 0.995], abs=1e-3)
    for power in (1.0, 1.5):
        speeds = demo.chain(5, power)
        assert [speeds.sum(), (speeds**2).sum()] == pytest.approx([1.0, 1.0], rel=1e-6)
    speeds, lost = demo.block(5, 0.3)
    assert [speeds.sum(), (speeds**2).sum() + lost] == pytest.approx([1.0, 1.0], rel=1e-14)


@pytest.mark.mpi
@pytest.mark.parametrize("theta", [0.0, 0.25, 0.5])
@pytest.mark.fast_on_ranks("0.25")
@pytest.mark.fast("0.25")
def test_rigid_balls_that_touch_move_as_one(theta):
    r = demo.main(kinds=("rigid, touching",), parts=(theta,), cells=2, duration=3e-3)
    (r,) = r["rigid, touching"].values()
    speeds, lost = demo.block(5, theta)
    assert r["speeds"] == pytest.approx(speeds, abs=1e-10)
    assert r["contact_defect"] == pytest.approx(lost, abs=1e-10)
    assert r["momentum"] < 1e-12 and r["ledger"] < 1e-11


@pytest.mark.slow
def test_rigid_balls_apart_hand_it_on_if_gaps_close_between_steps():
    """All to the last ball, without loss; half a step later a plastic blow of two comes first."""
    runs = demo.main(kinds=("rigid, apart",), parts=(0.0, 0.5), cells=2, duration=0.03)
    whole, half = runs["rigid, apart"].values()
    assert whole["speeds"] == pytest.approx([0, 0, 0, 0, 1], abs=1e-9)
    assert abs(whole["contact_defect"]) < 1e-9
    met = half["history"]["time"] <= 7.5e-3
    assert half["history"]["speeds"][met][-1] == pytest.approx([0.5, 0.5, 0, 0, 0], abs=1e-9)
    assert max(whole["momentum"], half["momentum"]) < 1e-12


@pytest.mark.mpi
@pytest.mark.slow
def test_a_flexible_row_hands_it_on():
    """Three coarse balls: most of it to the last one, as of a chain of linear springs."""
    r = demo.main(kinds=("flexible, touching",), parts=(0.25,), duration=0.02, **THREE)
    (r,) = r["flexible, touching"].values()
    assert r["status"].startswith("completed") and r["momentum"] < 1e-12 and r["ledger"] < 1e-11
    assert r["speeds"] == pytest.approx(demo.chain(3, 1.0), abs=0.06)
    lost = r["contact_defect"] + r["within"]
    assert (r["speeds"] ** 2).sum() + lost == pytest.approx(1.0, abs=1e-11)


@pytest.mark.slow
def test_five_flexible_balls_that_touch():
    """At either end of the parts of the step: near the speeds of the chain of linear springs."""
    runs = demo.main(kinds=("flexible, touching",), parts=(0.0, 0.5))
    for r in runs["flexible, touching"].values():
        assert r["speeds"] == pytest.approx(demo.chain(5, 1.0), abs=0.03)
        assert r["momentum"] < 1e-12 and r["ledger"] < 1e-11


@pytest.mark.slow
def test_flexible_balls_apart_come_to_the_textbook_with_the_step():
    """What the last of three lacks falls at least as the step does."""
    lacks = []
    for dt in (5e-4, 1.25e-4):
        kinds = ("flexible, apart",)
        r = demo.main(kinds=kinds, parts=(0.25,), balls=3, dt=dt, duration=0.036)[kinds[0]][0.25]
        assert r["momentum"] < 1e-12 and r["ledger"] < 1e-11
        lacks.append(1.0 - r["speeds"][-1])
    assert 0.0 < lacks[1] < lacks[0] / 4
