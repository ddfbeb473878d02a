"""Python in processes of its own: a fresh interpreter, or ranks under mpirun."""

import os
import subprocess
import sys
from pathlib import Path

DEMOS = Path(__file__).resolve().parents[1] / "demos"


def in_fresh_python(code):
    """Return what code prints in a new interpreter that does not believe to be a rank."""
    mpi = ("OMPI_", "PMIX_", "PRTE_", "ORTE_")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(mpi)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd="/", text=True, capture_output=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def environment_of_ranks():
    """Return this process' variables without those of its own MPI, which would mislead others."""
    own = ("OMPI_COMM", "OMPI_UNIVERSE", "OMPI_APP", "PMIX_", "PRTE_", "ORTE_")
    own += ("OMPI_MCA_ess", "OMPI_MCA_orte", "OMPI_MCA_pmix")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(own)}
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    return environment | {"OMP_NUM_THREADS": "1", "OMPI_MCA_mpi_yield_when_idle": "1"}


def on_ranks(ranks: int, *arguments: str, well: bool = True) -> str:
    """Run Python with these arguments under mpirun and return what it printed.

    Args:
        ranks: Number of them.
        arguments: Of the interpreter.
        well: Whether it must succeed; else it must fail, and what it says on stderr is returned,
            too.
    """
    environment = environment_of_ranks() | {"PYTHONPATH": str(DEMOS)}
    command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), sys.executable]
    done = subprocess.run(
        [*command, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert (done.returncode == 0) == well, done.stdout + done.stderr
    return done.stdout if well else done.stdout + done.stderr
