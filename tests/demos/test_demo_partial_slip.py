"""Cylinders that are pressed and sheared, against Cattaneo and Mindlin."""

import functools

import numpy as np
import partial_slip as demo
import pytest

#: Published figures of the problem as prescribed.
REFERENCE = {"force": 10, "half_width": 0.680778, "shear": 0.93616, "stick": 0.496511}


@functools.cache
def small(refinement):
    """Figures at a hundredth of the problem's size, on a mesh."""
    return demo.main(scales=(0.01,), refinement=refinement)[0.01]


# ---- closed form
def test_closed_form_gives_the_published_figures():
    for figure, value in REFERENCE.items():
        assert getattr(demo.CYLINDERS, figure) == pytest.approx(value, rel=2e-6)
    traction = demo.CYLINDERS.traction(demo.CYLINDERS.stick)
    assert traction == pytest.approx(1.279571, rel=1e-6)


def test_closed_form_carries_the_loads_at_any_scale():
    problem, whole = demo.CYLINDERS.scaled(0.1), demo.CYLINDERS
    assert problem.half_width == pytest.approx(0.1 * whole.half_width, rel=1e-12)
    assert problem.peak == pytest.approx(0.1 * whole.peak, rel=1e-12)
    step = problem.half_width / 10000
    x = (np.arange(10000) + 0.5) * step
    assert 2 * problem.pressure(x).sum() * step == pytest.approx(problem.force, rel=1e-5)
    assert 2 * problem.traction(x).sum() * step == pytest.approx(problem.shear, rel=1e-5)


# ---- contact
def check(result, tolerance):
    assert result["status"] == "completed" and result["retries"] == 0
    for name, error in result["error"].items():
        assert abs(error) < tolerance, name
    table = result["profile"]
    assert (np.abs(table["traction"]) <= 0.2 * table["pressure"] * (1 + 1e-6)).all()


@pytest.mark.mpi
@pytest.mark.slow
def test_coarse_mesh_meets_the_closed_form():
    result = small(0.8)
    check(result, 0.02)
    assert abs(result["error"]["force"]) < 1e-3


@pytest.mark.slow
def test_the_mesh_of_the_demo_meets_the_closed_form(tmp_path):
    check(small(1.0), 0.01)
    check(demo.main(scales=(1.0,), output=tmp_path)[1.0], 0.02)
    assert (tmp_path / "partial_slip.png").stat().st_size > 10_000
    table = np.genfromtxt(tmp_path / "cylinders_1.csv", delimiter=",", names=True)
    assert len(table.dtype.names) == 5
    assert np.allclose(table["pressure"], table["exact_pressure"], rtol=0, atol=0.5)


@pytest.mark.slow
def test_figures_converge():
    coarse, fine = small(0.5), small(1.0)
    for name in ("a", "q_max"):
        assert abs(fine["error"][name]) < 0.5 * abs(coarse["error"][name])
    assert fine["difference"]["traction"] < 0.7 * coarse["difference"]["traction"]
