"""The rolling demo: from slip to roll as a rigid wheel, as far as a polygon may."""

import numpy as np
import pytest
import rolling as demo


def test_rigid_wheel():
    """Slip ends where both speeds meet at 2/3 v0, and friction has then taken a third."""
    end = demo.SPEED / (3 * demo.FRICTION * demo.GRAVITY)
    speed, spin = demo.rigid(np.array([0.0, 0.5 * end, end, 2 * end]), 0.5)
    assert np.allclose(speed, demo.SPEED * np.array([1, 5 / 6, 2 / 3, 2 / 3]), rtol=1e-14)
    assert np.allclose(spin, demo.SPEED * np.array([0, 1 / 3, 2 / 3, 2 / 3]), rtol=1e-14)


def test_disc_is_a_regular_polygon_of_convex_quadrilaterals():
    x, cells = demo.disc(16, 2)
    corners = x[cells[:, [0, 1, 3, 2]]]
    edges = np.roll(corners, -1, axis=1) - corners
    next_edges = np.roll(edges, -1, axis=1)
    turn = edges[..., 0] * next_edges[..., 1] - edges[..., 1] * next_edges[..., 0]
    assert (turn > 0).all() or (turn < 0).all()
    a, b, c, d = corners.transpose(1, 2, 0)
    area = 0.5 * np.abs((c - a)[0] * (d - b)[1] - (c - a)[1] * (d - b)[0]).sum()
    assert area == pytest.approx(8 * np.sin(2 * np.pi / 16), rel=1e-12)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_friction_turns_the_wheel_while_it_slides():
    """Ten steps of a coarse wheel: mu g brakes it and spins it up, as the rigid one.

    The mean of friction's arm is a little less than the radius, that of a polygon.
    """
    r = demo.main(facets=24, duration=0.04, integrators=("energy-momentum",))["energy-momentum"]
    assert r["status"] == "completed" and r["retries"] == 0
    h, weight = r["history"], demo.FRICTION * demo.GRAVITY
    loss, gain = demo.SPEED - h["speed"][-1], r["kappa"] * h["spin"][-1] * demo.RADIUS
    assert loss == pytest.approx(gain, rel=0.05)
    assert loss == pytest.approx(weight * h["time"][-1], rel=0.05)
    assert 0.0 < r["dissipated"] and r["ledger"] <= 1e-11


@pytest.mark.slow
def test_slips_until_it_rolls():
    """24 facets: the wheel drops by 1 % of its radius between corners, which costs speed."""
    r = demo.main(facets=24, integrators=("energy-momentum",))["energy-momentum"]
    assert r["status"] == "completed"
    assert r["kappa"] == pytest.approx(0.5, rel=0.02)
    assert r["slide_end"] == pytest.approx(1.0, rel=0.15)
    assert r["speed"] == pytest.approx(2 / 3, rel=0.1)
    assert r["spin"] == pytest.approx(r["speed"], rel=0.06)
    assert r["dissipated"] == pytest.approx(1 / 3, rel=0.15)
    assert r["dissipated"] + r["contact_defect"] == pytest.approx(r["energy_lost"], abs=1e-11)
    assert r["ledger"] <= 1e-11
