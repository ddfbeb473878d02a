"""A block slides to rest: benchmark B4, and what its steps leave out."""

from mpi4py import MPI

import numpy as np
import pytest
import sliding_block as demo

COMM = MPI.COMM_WORLD
SMALL = (2, 2, 1)


def test_closed_forms_are_the_benchmarks():
    """Figures of B4, computed elsewhere."""
    values = list(demo.CLOSED_FORM.values())
    np.testing.assert_allclose(values[:3], [0.509684, 0.254842, 0.5], atol=6e-7)


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", demo.INTEGRATORS)
@pytest.mark.slow
def test_rest_on_an_elastic_plate(integrator):
    mesh, floor = demo.block_mesh(COMM, SMALL), {"floor": "elastic"}
    figures, motion = demo.stop(mesh, floor, dt=4e-3, integrator=integrator)
    for name, value in figures.items():
        assert value == pytest.approx(demo.CLOSED_FORM[name], rel=1e-3), name
    assert integrator == "midpoint" or demo.health([motion.run])["ledger"] < 1e-11


@pytest.mark.parametrize("integrator", demo.INTEGRATORS)
@pytest.mark.parametrize(
    ("dt", "young", "elastic"), [(0.064, 5e7, 1e-6), (0.016, 5e7, 2e-6), (0.002, 5e8, 1e-7)]
)
@pytest.mark.fast("0.016-50000000.0-2e-06-energy-momentum")
def test_what_is_missing_at_rest(integrator, dt, young, elastic):
    """A mass loses mu g h per step and sticks when the next one would turn it: r is left."""
    mesh = demo.block_mesh(COMM, SMALL)
    figures, motion = demo.stop(mesh, {"young": young}, dt=dt, integrator=integrator)
    loss = demo.ROUGH * demo.GRAVITY * motion.time[1]
    left = (demo.SPEED - loss * round(demo.SPEED / loss)) ** 2 / demo.SPEED**2
    # With dt = 0.016 it is half of a loss that is left, but for rounding.
    assert left <= (loss / 2 / demo.SPEED) ** 2 * (1 + 1e-12)
    dissipation = figures["dissipation [J/kg]"] / (demo.SPEED**2 / 2)
    assert dissipation == pytest.approx(1 - left, abs=elastic)
    way = motion.way.max() / demo.CLOSED_FORM["way [m]"]
    assert way == pytest.approx(1 - left, abs=3 * elastic)
