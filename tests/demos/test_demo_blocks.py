"""The blocks of three demos go as Coulomb says, on each floor."""

import pytest
import sliding_block
import slope
import stick_slip
from measures import assert_as_coulomb_says


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize(
    ("demo", "floor", "integrator"),
    [(sliding_block, "plane", "energy-momentum"), (slope, "mesh", "midpoint"),
     (stick_slip, "plane", "energy-momentum")],
)  # fmt: skip
def test_figures(demo, floor, integrator):
    (figures,) = demo.main(
        floors=(floor,), integrators=(integrator,), dt=4e-3, cells=(2, 2, 1)
    ).values()
    assert_as_coulomb_says(figures, demo.CLOSED_FORM)
    assert integrator == "midpoint" or figures["ledger"] < 1e-11
