"""What a run says against its own result: counted by kind, in the status, the summary, the CSV."""

import json
import logging

from mpi4py import MPI

import numpy as np
import pytest
from point_mass import mass_on_wall

import dolfinx_nts as nts
from dolfinx_nts.output import BalanceCSV
from dolfinx_nts.run.record import Record, Table, unpacked
from dolfinx_nts.run.run_warnings import RunWarnings


def test_a_kind_is_counted_and_its_worst_case_kept(caplog):
    warnings = RunWarnings()
    for time, size in ((1.0, 2.0), (2.0, 5.0), (3.0, 4.0)):
        warnings.add("drift", time, size, f"off by {size} m", grave=False)
    found = warnings["drift"]
    assert (found.first, found.count, found.worst, found.text) == (1.0, 3, 5.0, "off by 5.0 m")
    assert [r.getMessage() for r in caplog.records] == ["t=1: off by 2.0 m"]
    assert warnings.grave == []


def test_one_grave_case_makes_the_kind_grave(caplog):
    caplog.set_level(logging.CRITICAL)
    warnings = RunWarnings()
    warnings.add("drift", 1.0, 1.0, "off", grave=False)
    warnings.add("drift", 2.0, 2.0, "far off", grave=True)
    assert [w.text for w in warnings.grave] == ["far off"]


def test_each_pair_has_a_warning_of_its_own(caplog):
    """A lesser one after a worse one of another pair; both are read again from a file."""
    found, pairs = RunWarnings(), (("ball", "floor"), ("cup", "ball"))
    for size, pair in zip((2.0, 1.0), pairs, strict=True):
        found.add("inside", size, size, f"{pair[0]} is in {pair[1]}", grave=True, about=pair)
    said = [r.getMessage() for r in caplog.records]
    assert said == ["t=2: ball is in floor", "t=1: cup is in ball"]
    assert list(found) == ["inside"] and len(found) == 1 and found["inside"].worst == 2.0
    assert [w.about for w in found.grave] == [w.about for w in found.every] == list(pairs)
    tables, notes = Record(warnings=found, rows=Table([{"time": 0.0}])).packed()
    again = unpacked(tables, json.loads(json.dumps(notes)))
    assert again["warnings"].every == found.every


@pytest.mark.mpi
def test_a_grave_warning_stands_in_status_summary_and_csv(mpi_tmp_path):
    system, _ = mass_on_wall(-4e-3, velocity=(0.1, 0.0, 0.0))
    path = mpi_tmp_path / "balance.csv"
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=1e-2, t_end=2e-2, output=[BalanceCSV(path)]
    )
    assert run.status.startswith("completed, but nodes that start behind their facets bring")
    assert "warning, energy from behind facets: 1 step from t = 0.01;" in run.summary
    MPI.COMM_WORLD.Barrier()
    text = path.read_text()
    assert "# warning, energy from behind facets: 1 step" in text
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    assert len(table) == len(run.rows)
