"""The heavy-top demo: steady precession, nodding, and a cone of tetrahedra that does the same."""

from mpi4py import MPI

import heavy_top as demo
import numpy as np
import pytest

import dolfinx_nts as nts

KNOWN = {4e-3: 5.919e-3, 2e-3: 1.488e-3}


@pytest.fixture(scope="module")
def results():
    return demo.main(steps=tuple(KNOWN))


def test_exact_motion():
    """Where both must agree: the nodding top rises to 60 degrees, and keeps its energy."""
    t = np.linspace(0.0, 0.5, 2001)
    axis = demo.nodding(t)
    assert np.abs(np.linalg.norm(axis, axis=1) - 1.0).max() < 1e-11
    assert axis[0] == pytest.approx(demo.steady(0.0), abs=1e-15)
    # The period in which the height u swings between both roots of its cubic, from the integrals
    # L_z, L_3 and E of Lagrange's top.
    tip = demo.ACROSS + demo.MASS * demo.FAR**2
    spin = demo.spin_of(demo.MASS, demo.FAR, demo.ACROSS, demo.ABOUT)
    a, b = demo.ABOUT * spin / tip, 2 * demo.MASS * demo.GRAVITY * demo.FAR / tip
    u = np.cos(demo.LEAN)
    # b (u - x) (1 - x^2) = a^2 (x - u)^2, divided by u - x.
    low = np.roots([-b, a**2, b - a**2 * u])
    low = low[np.abs(low) < 1].item()
    assert axis[:, 2].min() == pytest.approx(low, abs=1e-6)
    assert axis[:, 2].max() == pytest.approx(u, abs=1e-12)


@pytest.mark.parametrize("dt", KNOWN)
@pytest.mark.slow
def test_errors_of_steady_precession(results, dt):
    r = results["steady"][dt]
    assert r["status"] == "completed"
    assert r["error"] == pytest.approx(KNOWN[dt], rel=5e-4)


@pytest.mark.parametrize("motion", ["steady", "nodding"])
@pytest.mark.slow
def test_order_and_balance(results, motion):
    runs = results[motion]
    assert demo.orders(runs) == pytest.approx([2.0], abs=0.1)
    for r in runs.values():
        assert max(r["energy"], r["ledger"], r["spin"]) < 1e-12


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_meshed_cone_precesses():
    """What its facets cut off is mass; the precession that its own moments ask for remains."""
    pytest.importorskip("gmsh")
    comm = MPI.COMM_WORLD
    system = demo.scene(comm, precession=demo.PRECESSION, mesh=demo.cone_mesh(comm, 0.012))
    (cone,) = system.bodies
    assert 0.95 * demo.MASS < cone.mass < demo.MASS
    path = demo.Recorder()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.1, output=[path])
    r = demo.figures(run, path, demo.steady(path.time))
    assert r["status"] == "completed"
    assert r["error"] < 2e-3 and max(r["energy"], r["spin"]) < 1e-12
