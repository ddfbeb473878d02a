"""The map of where the schemes hold: its judgement, and its energy-momentum row."""

import csv
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest

import dolfinx_nts as nts
from dolfinx_nts.study import extreme_scenes, stability

COMM = MPI.COMM_WORLD


#: Axes whose runs take minutes or that others test (traps, strong friction), and those whose first
#: or last does half of one.
LEFT_OUT = ("long", "unit", "offset", "held", "place", "touch", "friction")
HEAVY = ("mesh", "strips", "bodies")
#: Those of which both ends are far from the scene as it is; of the others the last one is.
BOTH = ("stiffness", "density", "aspect")
#: What messages of steps that fail there may advise.
REMEDIES = ("smaller loads or speeds may prevent it", "so make its surface the master")


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
@pytest.mark.fast_on_ranks()
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
    rows = stability.main([
        "--only", "offset", "--integrators", "energy-momentum", "--accuracy", "fast",
        "--output", str(tmp_path),
    ])  # fmt: skip
    assert [(row["outcome"], row["accuracy"]) for row in rows] == [("completed", "fast")] * 3
    assert "3 completed" in capsys.readouterr().out
    with (tmp_path / "stability.csv").open() as file:
        assert [row["value"] for row in csv.DictReader(file)] == ["1.0", "1000.0", "1000000.0"]
    assert (tmp_path / "stability.png").stat().st_size > 1e4
    assert "| offset | 1000.0 | completed (" in (tmp_path / "stability.md").read_text()


def test_levels_of_a_scheme_share_a_column():
    def row(value, name, level, outcome, ledger=0.0, steps=9):
        return dict(axis="speed", value=value, integrator=name, accuracy=level, outcome=outcome,
                    ledger=ledger, steps=steps)  # fmt: skip

    text = stability.summary([
        row(1.0, "midpoint", "exact", "completed", 2e-5), row(1.0, "midpoint", "fast", "told", 0.1),
        row(2.0, "midpoint", "exact", "stopped", 0.3), row(2.0, "midpoint", "fast", "stopped"),
        row(1.0, "newmark", "exact", "completed", 3e-2),
    ])  # fmt: skip
    lines = text.splitlines()
    assert lines[0] == "| outcome | midpoint | midpoint, fast | newmark |"
    assert lines[2] == "| completed | 1 | 0 | 1 |" and lines[5] == "| stopped | 1 | 1 | 0 |"
    assert lines[-4:] == [
        "| axis | value | midpoint | newmark |", "|---|---|---|---|",
        "| speed | 1.0 | completed (2e-05); told (1e-01) | completed (3e-02) |",
        "| speed | 2.0 | stopped (step 9, step 9) |  |",
    ]  # fmt: skip


@pytest.mark.parametrize("option", ["--only", "--integrators", "--accuracy"])
def test_unknown_names_are_refused(option):
    with pytest.raises(ValueError, match="'nothing': choose among"):
        stability.main([option, "nothing"])


@pytest.mark.slow
@pytest.mark.parametrize("axis", [axis for axis in stability.AXES if axis not in LEFT_OUT])
def test_the_energy_momentum_scheme_is_nowhere_wrong(axis):
    """At the ends of each axis; what stops names nodes or cells and one remedy."""
    values = stability.AXES[axis][1]
    if axis in HEAVY:  # 12^3 cells beside one, 50 facets and ten bodies take half a minute
        values = values[1:-1]
    for value in (values[0], values[-1]) if axis in BOTH else values[-1:]:
        row = stability.measure(axis, value, "energy-momentum", COMM)
        assert row["outcome"] != "wrong", row
        if row["outcome"] == "stopped":
            assert "node" in row["why"] or "cell" in row["why"], row
            assert any(remedy in row["why"] for remedy in REMEDIES), row
            assert "Try a smaller dt" not in row["why"], row


@pytest.mark.slow
def test_far_from_the_origin_is_as_at_the_origin():
    """A million edges away motion, energy and contact forces are the same to 1e-6."""
    runs = []
    for offset in (0.0, 1e6):
        case = extreme_scenes.Scene(offset=offset).case(COMM)
        runs.append(nts.simulate(
            case.system, nts.EnergyMomentum(), dt=case.dt, t_end=case.steps * case.dt
        ))  # fmt: skip
    near, far = runs
    assert near.balance["active"].max() > 0
    for a, b in (
        (near.contact_forces, far.contact_forces),
        (near.balance["energy"], far.balance["energy"]),
        *zip(near.state.u, far.state.u, strict=True),
    ):
        assert np.abs(a - b).max(initial=0.0) < 1e-6 * np.abs(a).max(initial=1e-30)
