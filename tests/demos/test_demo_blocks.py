"""The blocks of three demos go as Coulomb says, on each floor, and leave pictures and fields."""

from mpi4py import MPI

import pytest
import sliding_block
import slope
import stick_slip
from measures import assert_as_coulomb_says

COMM = MPI.COMM_WORLD
SMALL = (2, 2, 1)
#: Each demo with the names of its motions.
DEMOS = [(sliding_block, {"thrown"}), (slope, set(slope.PARTS)), (stick_slip, {"pulled"})]
ranks = pytest.param(
    "ranks",
    marks=[pytest.mark.mpi, pytest.mark.slow, pytest.mark.skipif(COMM.size == 1, reason="serial")],
)
by_demo = pytest.mark.parametrize(
    ("demo", "parts"), DEMOS, ids=[demo.__name__ for demo, _ in DEMOS]
)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["serial", ranks])
@by_demo
def test_figures_and_files_on_a_plane(demo, parts, where, mpi_tmp_path):
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
        assert folders == {f"{part}_plane_energy-momentum" for part in parts}
    assert (mpi_tmp_path / f"{demo.__name__}.png").stat().st_size > 10000


@pytest.mark.slow
@by_demo
def test_figures_on_a_mesh_by_the_midpoint_rule(demo, parts):
    (figures,) = demo.main(
        floors=("mesh",), integrators=("midpoint",), dt=4e-3, cells=SMALL
    ).values()
    assert_as_coulomb_says(figures, demo.CLOSED_FORM)
