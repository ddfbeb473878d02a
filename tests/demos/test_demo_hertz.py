"""Cylinders and spheres against Hertz, and the mesh they are made of."""

import functools

import half_round
import hertz as demo
import numpy as np
import pytest

#: Published figures of the problems as prescribed.
REFERENCE = {
    "cylinders": {"force": 10, "half_width": 0.680778, "peak": 9.351351},
    "spheres": {"force": 117808.79, "half_width": 0.630179, "peak": 1.416416e5},
}


@functools.cache
def small(name, refinement):
    """Figures of a problem at a hundredth of its size, on a mesh."""
    return demo.main(problems=(name,), scales=(0.01,), refinement=refinement)[name][0.01]


# ---- closed form
@pytest.mark.parametrize("name", REFERENCE)
def test_closed_form_gives_the_published_figures(name):
    problem = demo.PROBLEMS[name]
    for figure, value in REFERENCE[name].items():
        assert getattr(problem, figure) == pytest.approx(value, rel=2e-6)


@pytest.mark.parametrize("name", REFERENCE)
def test_closed_form_carries_the_load_at_any_scale(name):
    problem, whole = demo.PROBLEMS[name].scaled(0.1), demo.PROBLEMS[name]
    assert problem.half_width == pytest.approx(0.1 * whole.half_width, rel=1e-12)
    assert problem.peak == pytest.approx(0.1 * whole.peak, rel=1e-12)
    x = (np.arange(10000) + 0.5) * problem.half_width / 10000
    around = 2 * np.pi * x if problem.spheres else 2.0
    step = problem.half_width / 10000
    assert (around * problem.pressure(x)).sum() * step == pytest.approx(problem.force, rel=1e-5)


# ---- mesh
def edges(cells, points):
    """The three edges at each corner of each cell, shape (8, m, 3, 3)."""
    bits = half_round.CORNERS @ [1, 2, 4]
    assert bits.tolist() == list(range(8))
    return np.array(
        [
            np.stack([points[cells[:, v | b]] - points[cells[:, v & ~b]] for b in (1, 2, 4)], 1)
            for v in range(8)
        ]
    )


@pytest.mark.parametrize("n", [4, 16])
@pytest.mark.parametrize("block", [0.1, 0.001])
@pytest.mark.parametrize("shape", ["whole", "half", "sphere"])
@pytest.mark.fast(
    "whole-0.1-4",
    "whole-0.1-16",
    "whole-0.001-4",
    "whole-0.001-16",
    "half-0.1-4",
    "half-0.1-16",
    "half-0.001-4",
    "half-0.001-16",
    "sphere-0.1-4",
    "sphere-0.1-16",
    "sphere-0.001-4",
)
def test_mesh_is_upright_and_fills_the_body(shape, block, n):
    if shape == "sphere":
        cells, x = half_round.half_sphere(n, 1.0, block)
        volume, radii = np.pi / 6, np.linalg.norm(x - [0, 0, 1], axis=1)
    else:
        cells, x = half_round.half_cylinder(n, 1.0, block, whole=shape == "whole")
        volume, radii = np.pi / 4 * block / n, np.hypot(x[:, 0], x[:, 2] - 1)
        volume *= 2 if shape == "whole" else 1
        assert np.allclose(np.unique(x[:, 1]), [0, block / n], rtol=0, atol=1e-15)
    around = edges(cells, x)
    jacobian = np.linalg.det(around)
    assert (jacobian / np.linalg.norm(around, axis=-1).prod(axis=-1)).min() > 0.3
    assert jacobian.mean(axis=0).sum() == pytest.approx(volume, rel=2.5 / n**2)
    assert radii.max() == pytest.approx(1.0, abs=1e-12)
    assert (x[:, 2].min(), x[:, 2].max()) == pytest.approx((0.0, 1.0), abs=1e-12)
    assert len(np.unique(np.round(x / (block / n), 6), axis=0)) == len(x) == cells.max() + 1


# ---- contact
def check(result, tolerance):
    assert result["status"] == "completed" and result["retries"] == 0
    for name, error in result["error"].items():
        assert abs(error) < tolerance, name


@pytest.mark.mpi
@pytest.mark.parametrize("name", REFERENCE)
@pytest.mark.fast("cylinders")
@pytest.mark.fast_on_ranks()
def test_coarse_mesh_meets_the_closed_form(name):
    result = small(name, 0.8)
    check(result, 0.02)
    assert abs(result["error"]["force"]) < 1e-3


@pytest.mark.slow
def test_what_the_prescribed_load_misses_is_strain():
    runs = demo.main(problems=("spheres",), scales=(1.0, 0.5, 0.01), refinement=0.5)["spheres"]
    whole, half, none = (run["error"]["p0"] for run in runs.values())
    # An eighth of Young's modulus is no small strain: see the demo.
    assert -0.05 < runs[1.0]["error"]["p0"] < 0.0
    # Half the strain, half of it: more at a half would be of another kind.
    assert -0.05 < whole - none < -0.01
    assert abs(half - none) < 0.65 * abs(whole - none)


@pytest.mark.slow
def test_the_mesh_of_the_demo_meets_the_closed_form(tmp_path):
    for name in REFERENCE:
        check(small(name, 1.0), 0.01)
    results = demo.main(problems=("cylinders",), scales=(1.0,), output=tmp_path)
    check(results["cylinders"][1.0], 0.02)
    assert (tmp_path / "hertz.png").stat().st_size > 10_000
    table = np.genfromtxt(tmp_path / "cylinders_1.csv", delimiter=",", names=True)
    assert len(table.dtype.names) == 3
    assert np.allclose(table["pressure"], table["exact_pressure"], rtol=0, atol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", REFERENCE)
def test_figures_converge(name):
    coarse, fine = (abs(small(name, r)["error"]["a"]) for r in (0.5, 1.0))
    assert fine < 0.5 * coarse
