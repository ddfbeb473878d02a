"""The program that measures speed against accuracy, on a small script of a user's."""

import csv
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import dolfinx_nts as nts
from dolfinx_nts.study import scene_runs, tradeoff

COMM = MPI.COMM_WORLD
ROOT = Path(__file__).parents[2]
SCRIPT = """
from mpi4py import MPI
from dolfinx.mesh import create_box
from scipy.integrate import solve_ivp
import dolfinx_nts as nts


def main(cells=2, speed=1.0):
    mesh = create_box(MPI.COMM_WORLD, [[0, 0, 0], [1, 1, 1]], [cells] * 3)
    body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e4, degree=1, name="cube",
                         velocity=lambda x: speed * x[[1, 2, 0]])
    nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=0.02, t_end=0.2)
    raise AssertionError("only the first run counts")
"""


@pytest.fixture
def script(tmp_path):
    path = COMM.bcast(tmp_path / "scene.py")
    if COMM.rank == 0:
        path.write_text(SCRIPT)
    COMM.Barrier()
    return str(path)


@pytest.mark.mpi
def test_means_of_a_rigid_body_are_those_of_its_points():
    """Of u, and of u times X over the radius of gyration: (R - 1) int rho X X^T."""
    axes = Rotation.from_rotvec((0.3, -0.5, 0.2)).as_matrix()
    moments = np.array([1.0, 2.0, 2.5])
    body = nts.RigidBody.from_inertia(
        4.0, moments, (1, 2, 3), axes, velocity=(3, 0, 1), angular_velocity=(1, 2, 3), name="brick"
    )
    way, stepper = scene_runs.Motion(), nts.Stepper(nts.System([body]), nts.EnergyMomentum())
    way.start(stepper)
    stepper.advance(0.1)
    way.write(stepper)
    stepper.close()
    turned = body.rotation @ axes.T
    euler = axes @ np.diag(0.5 * moments.sum() - moments) @ axes.T
    size = np.sqrt(np.trace(euler) / 4.0)
    mean = (turned - np.eye(3)) @ euler / (4.0 * size)
    moved = way.motion[1] - way.motion[0]
    assert moved[:3] == pytest.approx(0.1 * np.array([3, 0, 1]), abs=1e-12)
    assert moved[3:].reshape(3, 3).T == pytest.approx(mean, abs=1e-12)


@pytest.mark.mpi
@pytest.mark.slow
def test_error_of_the_trajectory_is_of_second_order(script):
    """Against a much finer step of the same run the errors of h and h/2 are as 4 to 1."""
    reference = {"accuracy": "exact", "dt_factor": 1 / 16}
    vary = {"accuracy": ["exact", "fast"], "dt_factor": [1.0, 0.5]}
    rows = tradeoff.compare(script, vary, {}, reference, COMM)
    assert [r["dt_factor"] for r in rows] == [1 / 16, 1.0, 0.5, 1.0, 0.5]
    assert [r["dt [s]"] for r in rows[1:3]] == [0.02, 0.01]
    first, *others = rows
    assert all(first[name] == 0.0 for name in scene_runs.ERRORS if name != "ledger")
    assert 3.7 < others[0]["trajectory"] / others[1]["trajectory"] < 4.3
    for exact, fast in zip(others[:2], others[2:], strict=True):
        assert exact["ledger"] < 1e-12 < fast["ledger"] < 1e-4
        assert fast["trajectory"] == pytest.approx(exact["trajectory"], rel=1e-2)
    assert tradeoff.recommend(rows)[0][1] in others


@pytest.mark.slow
def test_mesh_refinement_compares_with_another_mesh(script):
    rows = tradeoff.compare(script, {"cells": [1, 2, 3]}, {"dt": 0.01}, {"cells": 6}, COMM)
    errors = [r["trajectory"] for r in rows[1:]]
    assert errors == sorted(errors, reverse=True)


def test_affine_motion_has_a_closed_form(script):
    """Shear u = a y e_x of a unit cube of size sqrt(3 / 12): a / 12 over the size."""
    run = scene_runs.measure(script, {}, COMM)
    body = run.solution.system.bodies[0]
    u = np.zeros(body.num_owned)
    u[0::3] = 0.2 + 0.3 * body.reference[1::3]
    mean = COMM.allreduce(body.inertia(u) @ scene_runs.affine(body)[0])
    expected = np.zeros(12)
    expected[0], expected[6] = 0.2 + 0.3 / 2, 0.3 / 12 / 0.5
    assert np.abs(mean - expected).max() < 1e-14


def test_a_run_that_fails_is_a_row_with_its_reason(script):
    vary = {"max_iterations": [25, 1], "max_retries": [0]}
    rows = tradeoff.compare(script, vary, {}, {"dt_factor": 0.5}, COMM)
    assert rows[1]["status"] == "completed"
    assert "not solved" in rows[2]["status"] and np.isnan(rows[2]["trajectory"])
    assert tradeoff.recommend(rows)[0][1] is rows[1]
    rows = tradeoff.compare(script, {"cells": [2, 0]}, {}, {}, COMM)
    assert rows[2]["status"].startswith("RuntimeError") or "cells" in rows[2]["status"]


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ({"colour": ["red"]}, "colour=.*neither an argument of main"),
        ({"integrator": ["euler"]}, "integrator='euler': choose one of"),
        ({"dt": [0.1], "dt_factor": [1.0]}, "dt, dt_factor: choose one of them"),
        ({"accuracy": ["exact", "fats"]}, "accuracy='fats': choose one of"),
        ({"linear_solver": ["mumps"]}, "linear_solver='mumps': choose one of"),
        ({"adapt": [-1.0]}, "tolerance=-1.0: must be positive"),
        ({"stress": ["foo"]}, "stress='foo': choose one of"),
        ({"dt_factor": [0]}, "dt_factor=0: must be positive"),
        ({"reuse": ["yes"]}, "reuse='yes': pass True or False"),
    ],
)
def test_unknown_choices(script, vary, message):
    with pytest.raises((TypeError, ValueError), match=message):
        tradeoff.compare(script, vary, {}, {}, COMM)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "cells=3,4"], r"--set cells=\[3, 4\]: has 2 values"),
        (["--vary", "accuracy=fast", "accuracy=exact"], "--vary accuracy: is given twice"),
        (["--vary", "dt=abc"], "dt='abc': must be positive"),
    ],
)
def test_unfit_arguments(script, arguments, message):
    with pytest.raises(ValueError, match=message):
        tradeoff.main([script, *arguments])
    with pytest.raises(ValueError, match="economy: takes"):
        tradeoff.main(["economy", "--vary", "cells=2,3"])


def test_unknown_scene(tmp_path):
    with pytest.raises(ValueError, match="no such file"):
        scene_runs.load("nowhere")
    empty = tmp_path / "empty.py"
    empty.write_text("")
    with pytest.raises(ValueError, match="has no function main"):
        scene_runs.load(str(empty))


@pytest.mark.slow
def test_command_line(script, tmp_path, capsys):
    folder = tmp_path / "out"
    rows = tradeoff.main(
        [script, "--vary", "accuracy=fast,exact", "dt_factor=2,1", "--output", str(folder)]
    )
    lines = (folder / "tradeoff.csv").read_text().splitlines()
    table = list(csv.DictReader(lines[1:]))
    assert lines[0].startswith("# ") and "DOLFINx" in lines[0]
    assert len(table) == len(rows) == 5
    assert table[0]["dt_factor"] == "0.25"
    assert (folder / "tradeoff.png").stat().st_size > 10_000
    advice = (folder / "recommendation.txt").read_text()
    assert "trajectory within 0.01: accuracy=" in advice
    assert advice.split("\n", 1)[1] in capsys.readouterr().out


def test_the_reference_takes_a_quarter_of_a_step_that_is_set(script, tmp_path):
    rows = tradeoff.main([script, "--set", "dt=0.04", "--output", str(tmp_path)])
    assert [r["dt [s]"] for r in rows] == [0.01, 0.04, 0.04, 0.04]
    assert all(0 < r["trajectory"] < 0.1 for r in rows[1:])


def test_a_script_with_a_module_beside_it(tmp_path):
    """As `python scene.py` finds it."""
    scene, beside = tmp_path / "scene.py", tmp_path / "spacing_of_scene.py"
    scene.write_text(
        "from __future__ import annotations\n"
        "from dataclasses import dataclass\n"
        "from spacing_of_scene import CELLS\n"
        "@dataclass\n"
        "class Size:\n"
        "    cells: int = CELLS\n"
        "def main():\n"
        "    return Size().cells\n"
    )
    beside.write_text("CELLS = 3\n")
    for _ in range(2):
        assert scene_runs.load(str(scene)).main() == 3
    assert str(tmp_path) not in sys.path


@pytest.mark.parametrize("call", ["nts.simulate", "simulate"])
def test_a_script_may_import_simulate_as_it_likes(tmp_path, call):
    scene, imports = tmp_path / "scene.py", "import dolfinx_nts as nts"
    text = SCRIPT.replace("nts.simulate", call)
    scene.write_text(text.replace(imports, f"{imports}\nfrom dolfinx_nts import simulate"))
    run = scene_runs.measure(str(scene), {"dt_factor": 2.0}, COMM)
    assert run.status == "completed" and run.dt == 0.04
    assert run.solution.balance["time"][1] == pytest.approx(0.04)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["rigid", "beam", "shell", "linear", "quadratic"])
def test_a_slender_arm_of_any_kind_falls_as_a_pendulum(part):
    """A stiff one, whose angle is that of an arm that turns about the middle of its end."""
    slender = scene_runs.load(str(ROOT / "benchmarks/slender.py"))
    long, thick = slender.LONG, slender.THICK
    rate = 0.5 * long * 9.81 / (long**2 / 3 + thick**2 / 12)
    mass = slender.DENSITY * long * slender.WIDE * thick
    found = slender.main(part=part, young=1e10, cells=(5, 2, 2), dt=1e-2).balance
    fall = solve_ivp(lambda _, y: [y[1], rate * np.cos(y[0])], (0, 0.4), [0.0, 0.0], rtol=1e-10)
    energy = 0.5 * mass * 9.81 * long * np.sin(fall.y[0, -1])
    assert np.abs(found["ledger_residual"]).max() < 1e-8 * energy
    assert found["kinetic"][-1] == pytest.approx(energy, rel=5e-4)
