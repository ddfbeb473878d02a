"""A block on a slope: benchmark B5, and the verge of slipping."""

import numpy as np
import pytest
import slope as demo
from measures import assert_as_coulomb_says
from mpi4py import MPI

COMM = MPI.COMM_WORLD
SMALL = (2, 2, 1)


def test_closed_forms_are_the_benchmarks():
    """Figures of B5, computed elsewhere."""
    values = list(demo.CLOSED_FORM.values())
    np.testing.assert_allclose(values[:2], [1.178144, 3.00275], atol=6e-7)


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
        assert folders == {f"{part}_plane_energy-momentum" for part in demo.PARTS}
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
