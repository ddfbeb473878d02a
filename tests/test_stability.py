"""The map of where the schemes hold: its judgement, and its energy-momentum row."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

import dolfinx_nts as nts
from dolfinx_nts.study import extreme_scenes, stability

COMM = MPI.COMM_WORLD


#: Axes whose runs take minutes.
MINUTES = ("long", "bodies")


@pytest.fixture(scope="module")
def case():
    return extreme_scenes.Scene(gap=0.5).case(COMM)


@pytest.fixture(scope="module")
def run(case):
    return nts.simulate(case.system, nts.EnergyMomentum(), dt=case.dt, t_end=8 * case.dt)


def doctored(run, column=None, by=0.0, **changes):
    """A run like this one whose last row is off by a part of the column's size."""
    balance = {name: values.copy() for name, values in run.balance.items()}
    if column:
        balance[column][-1] += by * np.abs(balance["energy"]).max()
    known = {"status": run.status, "retries": run.retries, "warnings": run.warnings}
    return SimpleNamespace(balance=balance, system=run.system, **known | changes)


@pytest.mark.mpi
def test_a_good_run_is_completed(run, case):
    assert stability.judge(run, nts.EnergyMomentum(), case)[0] == "completed"
    assert run.balance["active"].max() > 0
    assert stability.judge(doctored(run, retries=2), nts.EnergyMomentum(), case)[0] == "cut back"


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("column", "by", "outcome"),
    [
        ("linear_momentum", 1e-3, "wrong"),
        ("angular_momentum", 1e-3, "wrong"),
        ("ledger_residual", 1e-5, "wrong"),
        ("ledger_residual", 1e-7, "completed"),
    ],
)
def test_what_is_off_without_a_word_is_wrong(run, case, column, by, outcome):
    found, why = stability.judge(doctored(run, column, by), nts.EnergyMomentum(), case)
    assert found == outcome and bool(why) == (outcome == "wrong")


def test_what_is_off_and_says_so_is_told(run, case):
    warning = SimpleNamespace(kind="ledger", text="misses 1 J")
    off = doctored(run, "ledger_residual", 1e-5, warnings={"ledger": warning})
    outcome, why = stability.judge(off, nts.EnergyMomentum(), case)
    assert outcome == "told" and why.endswith("ledger: misses 1 J")
    assert stability.judge(doctored(run, status="not solved"), nts.EnergyMomentum(), case) == (
        "stopped", "not solved",
    )  # fmt: skip


@pytest.mark.slow
def test_the_program_writes_table_and_picture(tmp_path, capsys):
    rows = stability.main(
        ["--only", "offset", "--integrators", "energy-momentum", "--output", str(tmp_path)]
    )
    assert [row["outcome"] for row in rows] == ["completed"] * 3
    assert "3 completed" in capsys.readouterr().out
    with (tmp_path / "stability.csv").open() as file:
        assert [row["value"] for row in csv.DictReader(file)] == ["1.0", "1000.0", "1000000.0"]
    assert (tmp_path / "stability.png").stat().st_size > 1e4


@pytest.mark.parametrize("option", ["--only", "--integrators"])
def test_unknown_names_are_refused(option):
    with pytest.raises(ValueError, match="'nothing': choose among"):
        stability.main([option, "nothing"])


@pytest.mark.slow
@pytest.mark.parametrize("axis", [axis for axis in stability.AXES if axis not in MINUTES])
def test_the_energy_momentum_scheme_is_nowhere_wrong(axis):
    """At both ends of each axis; what stops says which nodes, or which cells, and what to do."""
    values = stability.AXES[axis][1]
    if axis == "mesh":  # 12^3 cells beside one take half a minute
        values = values[1:-1]
    for value in (values[0], values[-1]):
        row = stability.measure(axis, value, "energy-momentum", COMM)
        assert row["outcome"] != "wrong", row
        assert row["outcome"] != "stopped" or ("node" in row["why"] or "cell" in row["why"]), row
