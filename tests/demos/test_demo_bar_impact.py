"""The elastic bar on a rigid wall: exact solution, closed forms, and an independent linear code."""

from mpi4py import MPI

import bar_impact as demo
import numpy as np
import pytest

import dolfinx_nts as nts

#: Elements: E/E0, rebound of the centre of mass over v0.
REFERENCE = {50: (0.9978, 0.9841), 100: (0.9987, 0.9892), 200: (0.9992, 0.9927)}


def linear_bar(elements, gravity, t_end):
    """Linear bar in 1D, midpoint rule, contact by a multiplier with g_{n+1} = 0.

    Returns rows of time, gap, pressure, energy with gravity's, momentum.
    """
    dx = demo.LENGTH / elements
    dt, n = dx / demo.WAVE, elements + 1
    mass, stiffness = np.zeros((n, n)), np.zeros((n, n))
    for e in range(elements):
        at = np.ix_([e, e + 1], [e, e + 1])
        mass[at] += demo.DENSITY * dx / 6 * np.array([[2, 1], [1, 2]])
        stiffness[at] += demo.YOUNG / dx * np.array([[1, -1], [-1, 1]])
    weight = mass.sum(axis=1) * (demo.GRAVITY if gravity else 0.0)
    inverse = np.linalg.inv(mass + dt**2 / 4 * stiffness)
    u, v, rows = np.zeros(n), np.full(n, 0.0 if gravity else -demo.SPEED), []
    for k in range(round(t_end / dt)):
        u1 = inverse @ (mass @ (u + dt * v) - dt**2 / 4 * stiffness @ u - dt**2 / 2 * weight)
        force = max(0.0, -(u1[0] + demo.GAP) / inverse[0, 0])
        u1 += force * inverse[0]
        v, u = 2 * (u1 - u) / dt - v, u1
        energy = 0.5 * (v @ mass @ v + u @ stiffness @ u) + weight @ u
        pressure = 2 / dt**2 * force
        rows.append(((k + 1) * dt, u[0] + demo.GAP, pressure, energy, (mass @ v).sum()))
    return np.array(rows).T


def test_exact_solution_is_continuous_and_periodic():
    for gravity, end in ((False, 1.5), (True, 16 / 3)):
        gap, _ = demo.exact(np.linspace(0, end, 20001), gravity)
        fastest = 0.02
        assert np.abs(np.diff(gap)).max() < fastest * end / 20000
        assert gap.min() >= 0
    gap, pressure = demo.exact(np.array([1 + 1e-9, 5 / 3 - 1e-9, 11 / 3 + 1e-9, 16 / 3]), True)
    np.testing.assert_allclose(pressure, [0.3, 0.5, 0.5, 0.0], atol=1e-8)
    np.testing.assert_allclose(gap, [0, 0, 0, demo.GAP], atol=1e-15)


@pytest.mark.parametrize(("elements", "energy", "rebound"), [(n, *r) for n, r in REFERENCE.items()])
def test_linear_bar_meets_the_published_losses(elements, energy, rebound):
    _, _, _, e, momentum = linear_bar(elements, False, 1.5)
    mass = demo.DENSITY * demo.LENGTH
    assert e[-1] / (mass * demo.SPEED**2 / 2) == pytest.approx(energy, abs=5e-5)
    assert momentum[-1] / mass / demo.SPEED == pytest.approx(rebound, abs=5e-5)


def check_impact(result, elements):
    """Figures of one integrator against the exact solution; contact is as sharp as a step."""
    dt = demo.LENGTH / elements / demo.WAVE
    assert result["status"] == "completed" and result["retries"] == 0
    # The end of the bar reaches the wall at the end of a step, so rounding decides which one.
    np.testing.assert_allclose(result["contact_start"], [0.5], atol=1.01 * dt)
    np.testing.assert_allclose(result["contact_end"], [0.5 + demo.CONTACT], atol=2.01 * dt)
    # The momentum that goes into vibration shrinks like the root of the mesh size.
    np.testing.assert_allclose(result["pressure"], [0.3], rtol=0.2 / elements**0.5)
    np.testing.assert_allclose(result["impulse"], [0.2], rtol=0.1 / elements**0.5)
    mass = demo.DENSITY * demo.LENGTH
    assert result["impulse"].sum() == pytest.approx(mass * demo.SPEED * (1 + result["rebound"]))
    assert result["shortening"] == pytest.approx(demo.SPEED / 3, rel=0.2 / elements**0.5)
    assert result["min_gap"] > -1e-13 * demo.LENGTH
    # From 600 coordinates on matrices are kept, which the strain v / c makes wrong: each iteration
    # gains that part. Otherwise the linear problem takes one, and one more where contact changes.
    kept = 12 * (elements + 1) >= 600
    most = np.log(1e-12) / np.log(demo.SPEED / demo.WAVE) if kept else 2
    assert result["newton_iterations"] < most


@pytest.mark.slow
def test_new_matrices_take_one_iteration_where_nothing_changes():
    dt = demo.LENGTH / 50 / demo.WAVE
    run = nts.simulate(
        demo.scene(MPI.COMM_WORLD, 50, gravity=False), nts.EnergyMomentum(), dt=dt, t_end=1.5,
        newton=nts.Newton(reuse=False),
    )  # fmt: skip
    assert run.balance["active"].max() == 4
    # One more where contact changes, and one that rounding may ask for.
    assert np.median(run.balance["newton_iterations"][1:]) <= 2


@pytest.mark.mpi
def test_impact_is_the_same_on_two_ranks():
    results = demo.main(elements=10, t_end=0.8, integrators=("energy-momentum",))
    _, gap, pressure, _, _ = linear_bar(10, False, 0.8)
    h = results["energy-momentum"]["history"]
    np.testing.assert_allclose(h["gap"], gap, atol=1e-3 * demo.GAP)
    np.testing.assert_allclose(h["pressure"], pressure, atol=0.01 * 0.3)
    assert results["energy-momentum"]["ledger"] < 1e-12


@pytest.mark.slow
def test_bar_follows_the_linear_bar():
    elements, t_end = 20, 1.3
    results = demo.main(elements=elements, t_end=t_end)
    time, gap, pressure, energy, momentum = linear_bar(elements, False, t_end)
    mass = demo.DENSITY * demo.LENGTH
    for result in results.values():
        check_impact(result, elements)
        h = result["history"]
        np.testing.assert_allclose(h["time"], time)
        # Strains are 3e-4; the pressure of single steps at the release is sensitive to them.
        np.testing.assert_allclose(h["gap"], gap, atol=1e-3 * demo.GAP)
        np.testing.assert_allclose(h["pressure"], pressure, atol=0.01 * 0.3)
        assert result["energy"] == pytest.approx(energy[-1] / 5e-4, abs=3e-4)
        assert result["rebound"] == pytest.approx(momentum[-1] / mass / demo.SPEED, abs=3e-4)
    assert results["energy-momentum"]["ledger"] < 1e-12


@pytest.mark.slow
def test_impact():
    """Of the coarsest bar; the linear one, which it follows, has the others' figures, too."""
    elements = 50
    energy, rebound = REFERENCE[elements]
    results = demo.main(elements=elements)
    for result in results.values():
        check_impact(result, elements)
        assert result["energy"] == pytest.approx(energy, abs=3e-4)
        assert result["rebound"] == pytest.approx(rebound, abs=3e-4)
    assert results["energy-momentum"]["ledger"] < 1e-12


@pytest.mark.slow
def test_dropped_bar():
    elements = 50
    dt = demo.LENGTH / elements / demo.WAVE
    rules = ("energy-momentum",)
    (result,) = demo.main(elements=elements, gravity=True, integrators=rules).values()
    assert result["status"] == "completed" and result["retries"] == 0
    np.testing.assert_allclose(result["contact_start"], [1, 11 / 3], atol=2.01 * dt)
    np.testing.assert_allclose(result["contact_end"], [5 / 3, 13 / 3], atol=3.01 * dt)
    np.testing.assert_allclose(result["impulse"], 0.266667, rtol=1 / elements)
    assert result["gap_error"] < 5 / elements
    assert result["rebound"] == pytest.approx(0, abs=2 / elements)
    assert 1 - 1 / elements < result["energy"] <= 1 + 1e-6
    assert result["ledger"] < 1e-12


@pytest.mark.slow
def test_dropped_bar_follows_the_linear_bar():
    result = demo.main(elements=20, gravity=True, t_end=3.0, integrators=("energy-momentum",))
    _, gap, _, energy, _ = linear_bar(20, True, 3.0)
    h = result["energy-momentum"]["history"]
    np.testing.assert_allclose(h["gap"], gap, atol=3e-3 * demo.GAP)
    assert result["energy-momentum"]["energy"] == pytest.approx(1 + energy[-1] / 5e-4, abs=1e-3)
