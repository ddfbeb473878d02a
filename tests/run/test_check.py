"""`python -m dolfinx_nts --check`, as a user calls it."""

import subprocess
import sys

import pytest
from processes import environment_of_processes


@pytest.mark.parametrize("threads", ["1", "2"])
def test_check_runs_two_steps_and_tells_what_is_slow(threads):
    environment = environment_of_processes() | {"OMP_NUM_THREADS": threads}
    done = subprocess.run(
        [sys.executable, "-m", "dolfinx_nts", "--check"], env=environment, cwd="/", text=True,
        capture_output=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "installed: DOLFINx" in done.stdout
    assert "in contact" in done.stdout and "completed" in done.stdout
    assert ("slow: set OMP_NUM_THREADS=1" in done.stdout) == (threads == "2")
