"""Python in processes of its own: a fresh interpreter, or ranks under mpirun."""

import os
import subprocess
import sys
from pathlib import Path

DEMOS = Path(__file__).resolve().parents[1] / "demos"
#: How the variables begin by which OpenMPI and MPICH tell a process that it is a rank.
TELLS_RANKS = ("OMPI_COMM", "OMPI_UNIVERSE", "OMPI_APP", "PMI", "PRTE_", "ORTE_", "HYDI_")
TELLS_RANKS += ("MPI_LOCAL", "OMPI_MCA_ess", "OMPI_MCA_orte", "OMPI_MCA_pmix")
#: Of ranks that share cores, also as root: OpenMPI of 4 and since 5.
SHARED = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_hwloc_base_binding_policy": "none",
    "OMPI_MCA_mpi_yield_when_idle": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "PRTE_ALLOW_RUN_AS_ROOT": "1",
    "PRTE_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "PRTE_MCA_hwloc_default_binding_policy": "none",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
}

#: Time [s] that ranks under mpirun have.
_PATIENCE = 600


def environment_of_processes():
    """Return this process' variables without those of its own MPI, which would mislead others."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(TELLS_RANKS)}
    return environment | SHARED | {"OMP_NUM_THREADS": "1"}


def in_fresh_python(code):
    """Return what code prints in a new interpreter that does not believe to be a rank."""
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment_of_processes(), cwd="/", text=True,
        capture_output=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def mpirun(ranks):
    """Return the command that runs Python on ranks, by mpirun of the same environment."""
    beside = Path(sys.executable).with_name("mpirun")
    return [str(beside) if beside.exists() else "mpirun", "-n", str(ranks), sys.executable]


def on_ranks(ranks: int, *arguments: str, well: bool = True) -> str:
    """Run Python with these arguments under mpirun and return what it printed.

    Args:
        ranks: Number of them.
        arguments: Of the interpreter.
        well: Whether it must succeed; else it must fail, and what it says on stderr is returned,
            too.
    """
    # Ranks that hang show where, before they are stopped.
    tells = {"PYTEST_ADDOPTS": f"-o faulthandler_timeout={_PATIENCE - 120}"}
    try:
        done = subprocess.run(
            [*mpirun(ranks), *arguments],
            env=environment_of_processes() | tells | {"PYTHONPATH": str(DEMOS)},
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired as late:
        said = [text.decode(errors="replace") for text in (late.stdout, late.stderr) if text]
        raise AssertionError("\n".join([str(late), *said])) from late
    assert (done.returncode == 0) == well, done.stdout + done.stderr
    return done.stdout if well else done.stdout + done.stderr
