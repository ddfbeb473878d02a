"""What an impact costs: figures of `study.impacts` against closed forms, and its refusals."""

import csv

from mpi4py import MPI

import numpy as np
import pytest

import dolfinx_nts as nts
from dolfinx_nts.study import impacts

COMM = MPI.COMM_WORLD


def test_hertz_impact_has_the_published_figures():
    """B11: approach, force and duration; the impulse over time turns the momentum round."""
    exact = impacts.Hertz()
    t, force = exact.over_time()
    assert exact.approach == pytest.approx(6.62583e-3, rel=1e-5)
    assert exact.force == pytest.approx(7.90238, rel=1e-5)
    assert t[-1] == pytest.approx(0.195017, rel=2e-4)
    impulse = float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(t)))
    assert impulse == pytest.approx(2 * exact.mass * exact.speed, rel=2e-4)


@pytest.mark.mpi
def test_a_rigid_block_rebounds_as_each_way_says():
    """B6 at theta = 1/4: half its speed, all of it, none; the touch met gives all of it, too."""
    rebound = {
        way: impacts.measure("B6", way, COMM) for way in ("published", "restored", "plastic")
    }
    for way, speed in (("published", 0.5), ("restored", 1.0), ("plastic", 0.0)):
        assert rebound[way]["rebound"] == pytest.approx(speed, abs=1e-11)
        assert rebound[way]["lost"] == pytest.approx(1.0 - speed**2, abs=1e-11)
    met = impacts.measure("B6", "touch met", COMM)
    assert met["rebound"] == pytest.approx(1.0, abs=1e-4)
    refused = impacts.measure("B6", "redistributed", COMM)
    assert refused["status"].startswith("refused: mass='redistributed' of a surface of 'block'")
    assert "rebound" not in refused and refused["status"][:40] in impacts.line(refused)


@pytest.mark.slow
def test_the_bar_as_closed_forms_and_linear_codes_have_it():
    """B2: E/E0 and rebound of the benchmark; a plastic impact takes m/(2 n sqrt(3)) at the end."""
    wanted = {
        "published": (2.2e-3, 0.578, 0.9841),
        "plastic": (0.01 / np.sqrt(3.0), 0.014, 0.979),
        "redistributed": (-7e-4, 0.022, 0.985),
    }
    for way, (lost, deviation, rebound) in wanted.items():
        row = impacts.measure("B2", way, COMM)
        assert row["status"] == "completed"
        assert row["lost"] == pytest.approx(lost, abs=1e-6 if way == "plastic" else 2e-4)
        assert row["deviation"] == pytest.approx(deviation, abs=0.002)
        assert row["rebound"] == pytest.approx(rebound, abs=1e-3)


@pytest.mark.slow
def test_a_sphere_on_a_plane_is_hertz():
    """B11 with eight cells to the equator: force, rebound, and nodes that come and leave once."""
    for way in ("published", "redistributed"):
        row = impacts.measure("B11", way, COMM)
        assert row["largest"] == pytest.approx(impacts.Hertz().force, rel=0.06)
        assert row["deviation"] < 0.06 and row["rebound"] == pytest.approx(1.0, abs=3e-3)
        assert abs(row["lost"]) < 1e-3 and row["rough"] < 0.02


@pytest.mark.parametrize("cells", [2, 5])
def test_the_ball_is_round_and_upright(cells):
    mesh = impacts.ball_mesh(COMM, cells)
    body = nts.Continuum(mesh, nts.NeoHookean(1.0, 0.3), density=1.0, name="ball")
    radius = np.linalg.norm(mesh.geometry.x, axis=1)
    assert COMM.allreduce(radius.max(), op=MPI.MAX) == pytest.approx(1.0, abs=1e-12)
    volume = nts.motion_of(body).mass
    # Facets cut off of it what the square of their size says.
    assert 0.5 < volume / (np.pi / 3) < 1.0


def test_the_program_writes_its_table(tmp_path, capsys):
    rows = impacts.main(
        ["--only", "B6", "--ways", "published", "redistributed", "--output", str(tmp_path)]
    )
    assert [row["way"] for row in rows] == ["published", "redistributed"]
    if COMM.rank == 0:
        assert "| B6 | published | 0.75 |" in capsys.readouterr().out
        with (tmp_path / "impacts.csv").open() as file:
            assert [row["problem"] for row in csv.DictReader(file)] == ["B6", "B6"]


@pytest.mark.parametrize("option", ["--only", "--ways"])
def test_unknown_names_are_refused(option):
    with pytest.raises(ValueError, match="'nothing': choose among"):
        impacts.main([option, "nothing"])
