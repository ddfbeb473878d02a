"""A block behind a spring sticks and slips as its closed form says."""

import math

import numpy as np
import pytest
import stick_slip as demo
from measures import assert_as_coulomb_says
from mpi4py import MPI

COMM = MPI.COMM_WORLD
SMALL = (2, 2, 1)


def test_closed_form_of_stick_slip_solves_the_equation_of_motion():
    """A rigid block behind the spring, by small explicit steps with Coulomb's law."""
    dt, end = 2e-5, demo.END
    bound, x, v = demo.FRICTION * demo.GRAVITY, 0.0, 0.0
    times, ways = dt * np.arange(int(end / dt)), []
    for t in times:
        ways.append(x)
        pull = demo.FREQUENCY**2 * (demo.spring_end(t) - x)
        # What friction may take from the velocity of this step, at most all of it.
        free = v + dt * pull
        v = math.copysign(max(abs(free) - dt * bound, 0.0), free)
        x += dt * v
    np.testing.assert_allclose(ways, demo.jerky_way(times), rtol=0, atol=2e-3 * demo.JERK)


ranks = pytest.param(
    "ranks",
    marks=[pytest.mark.mpi, pytest.mark.slow, pytest.mark.skipif(COMM.size == 1, reason="serial")],
)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["serial", ranks])
def test_figures_and_files_on_a_plane(where, mpi_tmp_path):
    results = demo.main(
        floors=("plane",), integrators=("energy-momentum",), dt=4e-3, cells=SMALL,
        output=str(mpi_tmp_path),
    )  # fmt: skip
    (figures,) = results.values()
    assert_as_coulomb_says(figures, demo.CLOSED_FORM)
    assert figures["ledger"] < 1e-11
    COMM.barrier()
    for file in ("balance.csv", "block.png", "block.xdmf"):
        folders = {p.parent.name for p in mpi_tmp_path.glob(f"*/{file}")}
        assert folders == {"pulled_plane_energy-momentum"}
    assert (mpi_tmp_path / f"{demo.__name__}.png").stat().st_size > 10000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("floor", "integrator"),
    [("plane", "midpoint"), ("mesh", "midpoint"), ("mesh", "energy-momentum")],
)
def test_figures(floor, integrator):
    (figures,) = demo.main(
        floors=(floor,), integrators=(integrator,), dt=4e-3, cells=SMALL
    ).values()
    assert_as_coulomb_says(figures, demo.CLOSED_FORM)
    assert integrator == "midpoint" or figures["ledger"] < 1e-11
