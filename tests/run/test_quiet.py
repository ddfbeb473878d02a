"""What compilers say is not for the user: a cold cache prints nothing, an error is still told."""

import subprocess
import sys

import pytest
from processes import environment_of_processes, in_fresh_python

SCRIPT = """
from mpi4py import MPI

import ufl
from dolfinx.mesh import CellType, create_box

from dolfinx_nts import dolfinx_compat as compat, forms

mesh = create_box(MPI.COMM_SELF, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.tetrahedron)
space = compat.vector_space(mesh, 1)
compat.function_space(mesh, "DG", 0), compat.function_space(mesh, "DG", 0, (3, 3))
w = ufl.TestFunction(space)
forms.compile_forms([{form}])
"""


def run(form, cache, scene="", before=""):
    """Run the script in a new interpreter that does not believe to be an MPI rank of this one.

    Args:
        form: What it compiles.
        cache: Folder for what is compiled.
        scene: Lines after it.
        before: Lines before it.
    """
    return subprocess.run(
        [sys.executable, "-c", before + SCRIPT.replace("{form}", form) + scene],
        env=environment_of_processes() | {"XDG_CACHE_HOME": str(cache)},
        cwd=cache,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_a_cold_cache_prints_nothing(tmp_path):
    done = run("w[2] * ufl.dx", tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    # The form; DOLFINx 0.5 compiles the elements of spaces, too.
    assert list(tmp_path.rglob("*.so"))


@pytest.mark.slow
def test_a_run_with_a_bar_tells_what_it_compiles(tmp_path):
    """In one line above the bar, and with a warm cache in none."""
    scene = """
import dolfinx_nts as nts

body = nts.Continuum(mesh, nts.StVenantKirchhoff(1e6, 0.3), density=1e3)
nts.simulate(nts.System([body]), nts.Midpoint(), dt=1e-3, t_end=1e-3, progress=True)
"""
    for lines in (1, 0):
        done = run("w[2] * ufl.dx", tmp_path, scene)
        assert (done.returncode, done.stdout.count("compiling forms")) == (0, lines)
        assert done.stderr.count("INFO") == 0


@pytest.mark.slow
def test_who_asks_is_told_what_is_compiled(tmp_path):
    asks = "import logging\nlogging.basicConfig(level=logging.INFO)\n"
    done = run("w[1] * ufl.dx", tmp_path, before=asks)
    assert done.returncode == 0
    assert done.stderr.count("compiling forms of a material or mesh that is new here") == 1


@pytest.mark.slow
def test_a_compiler_that_fails_is_told(tmp_path, monkeypatch):
    """A compiler that says why and gives up."""
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho no space left >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    done = run("w[2] * ufl.dx", tmp_path)
    assert done.returncode != 0
    assert "no space left" in done.stderr and "Error" in done.stderr


@pytest.mark.slow
def test_without_a_compiler_it_is_said_what_to_install(tmp_path, monkeypatch):
    """In the last line, and without what cffi has called."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    (tmp_path / "ssh").symlink_to("/bin/true")  # OpenMPI looks for it
    done = run("w[2] * ufl.dx", tmp_path)
    assert done.returncode != 0 and "cffi" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("RuntimeError: ") and "No such file or directory" in last
    assert "gcc, libc6-dev and python3-dev" in last and "ziglang" in last


#: A body at rest, whose step asks no linear solver, in a run that nobody closes.
LEFT_OPEN = """
import os
os.environ["PETSC_OPTIONS"] = "-options_left"
from mpi4py import MPI
from dolfinx.mesh import CellType, create_box
import dolfinx_nts as nts

mesh = create_box(MPI.COMM_SELF, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)
body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3)
stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum())
stepper.advance(1e-3)
assert stepper.solution.rows[-1]["newton_iterations"] == 0
"""


@pytest.mark.slow
def test_petsc_does_not_complain_of_options_that_a_run_left():
    told = in_fresh_python(LEFT_OPEN)
    assert "no unused options" in told and "nts_" not in told
