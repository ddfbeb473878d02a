"""Faults made for real: a full disk of 300 kB, MUMPS without memory, Jupyter's stop button.

What a limit on the size of files can stand for is in test_whole_files, kills in test_checkpoint.
"""

import json
import queue
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from processes import environment_of_processes, mpirun
from scenes import box, thrown_block

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
TESTS = str(Path(__file__).parents[1])

#: Each step writes fields and a checkpoint to a disk of 300 kB, until it is full.
ON_A_SMALL_DISK = """
import json, sys
from pathlib import Path
from mpi4py import MPI
sys.path.insert(0, {tests!r})
import dolfinx_nts as nts
from dolfinx_nts.output import Fields
from dolfinx_nts.output.state_file import previous
from scenes import meeting_blocks
from xdmf import read_xdmf

disk = Path(sys.argv[1])
ended = None
try:
    run = nts.simulate(
        meeting_blocks(), nts.EnergyMomentum(), dt=1e-4, t_end=0.1,
        output=[Fields(disk)] if "fields" in sys.argv else [],
        checkpoint=nts.Checkpoint(disk / "run.h5", every=1) if "checkpoint" in sys.argv else None,
    )
except nts.OutputError as error:
    ended, run = error, error.solution
told = {{"status": run.status, "steps": len(run.rows) - 1, "warnings": list(run.warnings)}}
if "fields" in sys.argv:
    file = read_xdmf(disk / "left.xdmf")
    told |= {{"times": file.times, "read": len(file.fields)}}
if "checkpoint" in sys.argv:
    told["at"] = nts.restart(disk / "run.h5", meeting_blocks()).state.time
    told["parts"] = [p.name for p in disk.glob("*.part")]
if MPI.COMM_WORLD.rank == 0:
    print(json.dumps(told), flush=True)
if ended is not None:
    raise ended
"""


def on_a_small_disk(tmp_path, ranks, *what):
    """What the script tells, run in a mount namespace of its own with a tmpfs of 300 kB.

    With fields it ends with the exit status of an exception.
    """
    script, disk = tmp_path / "script.py", tmp_path / "disk"
    disk.mkdir()
    script.write_text(ON_A_SMALL_DISK.format(tests=TESTS))
    command = [*(mpirun(ranks) if ranks > 1 else [sys.executable]), str(script), str(disk), *what]
    inside = f"mount -t tmpfs -o size=300k tmpfs {disk} && exec \"$@\""
    space = ["unshare", "--mount", "--propagation", "private", "sh", "-c"]
    if subprocess.run([*space, inside, "sh", "true"], capture_output=True, check=False).returncode:
        pytest.skip("mounting is not allowed here")
    done = subprocess.run(
        [*space, inside, "sh", *command], capture_output=True, text=True, timeout=300, check=False,
        env=environment_of_processes(),
    )  # fmt: skip
    assert done.returncode == ("fields" in what), done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_a_full_disk_of_300_kb(tmp_path):
    """It ended in a segmentation fault once, as HDF5 closes its files at exit."""
    if COMM.size > 1:
        pytest.skip("starts ranks of its own")
    told = on_a_small_disk(tmp_path, 2, "fields")
    assert "No space left on device" in told["status"]
    assert told["status"].count("OSError") == 1
    assert told["read"] == len(told["times"]) > 5
    assert np.allclose(np.diff(told["times"]), 1e-4)


@pytest.mark.slow
def test_a_disk_that_fields_fill_keeps_the_last_checkpoint(tmp_path):
    if COMM.size > 1:
        pytest.skip("needs a mount of its own")
    told = on_a_small_disk(tmp_path, 1, "fields", "checkpoint")
    assert "No space left on device" in told["status"] and not told["parts"]
    assert "checkpoint" in told["warnings"] or told["at"] == told["times"][-1]
    assert 0 < told["at"] <= 1e-4 * told["steps"]


@pytest.mark.mpi
def test_mumps_without_memory_is_told():
    """1 MB, which a factorisation of 4,000 coordinates does not fit in."""
    held = nts.Dirichlet(lambda x: x[2] < 1e-9)
    body = nts.Continuum(
        box(cells=10), nts.NeoHookean(1e6, 0.3), density=1e3, bcs=[held], velocity=(1.0, 2.0, 3.0)
    )
    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=1e-3, t_end=3e-3,
        newton=nts.Newton(linear_solver="direct", max_retries=0),
        petsc_options={"mat_mumps_icntl_23": 1},
    )  # fmt: skip
    assert COMM.allgather(run.status) == [run.status] * COMM.size
    assert "memory" in run.status and len(run.rows) == 1
    # The process is sound: the next run is as ever.
    again = nts.simulate(thrown_block(), nts.EnergyMomentum(), dt=1e-3, t_end=3e-3)
    assert again.status == "completed"


#: A cell that runs for ever, and says when it has begun.
CELL = """
import sys, signal
sys.path.insert(0, {tests!r})
import dolfinx_nts as nts
from scenes import thrown_block
before = signal.getsignal(signal.SIGINT)
def tell(time, dt):
    if 0.01 < time < 0.0115:
        print("begun", flush=True)
run = nts.simulate(thrown_block(), nts.EnergyMomentum(), dt=1e-3, t_end=1e3, before_step=tell)
print(run.status.split(" came")[0], len(run.rows) > 9, signal.getsignal(signal.SIGINT) is before)
"""


@pytest.mark.slow
def test_jupyter_s_stop_button_ends_the_run_and_keeps_it(tmp_path):
    if COMM.size > 1:
        pytest.skip("starts a kernel of its own")
    pytest.importorskip("ipykernel", reason="apt install python3-ipykernel python3-jupyter-client")
    manager = pytest.importorskip("jupyter_client.manager").KernelManager()
    manager.kernel_spec.argv = [sys.executable, "-m", "ipykernel_launcher", "-f",
                                "{connection_file}"]  # fmt: skip
    manager.start_kernel(cwd=str(tmp_path))
    client = manager.blocking_client()
    client.start_channels()
    try:
        client.wait_for_ready(timeout=120)

        def until(done):
            said = ""
            while not done(said):
                try:
                    message = client.get_iopub_msg(timeout=120)
                except queue.Empty:
                    pytest.fail(f"the kernel says nothing more after {said!r}")
                said += message["content"].get("text", "")
                said += "\n".join(message["content"].get("traceback", []))
                if message["content"].get("execution_state") == "idle" and said:
                    break
            return said

        client.execute(textwrap.dedent(CELL.format(tests=TESTS)))
        said = until(lambda said: "begun" in said)
        assert "begun" in said, said
        manager.interrupt_kernel()
        said = until(lambda said: said.endswith(("True\n", "False\n")))
        assert "interrupted: SIGINT True True" in said
        client.execute("print(run.balance['energy'][0] > 0, 'still here')")
        assert "True still here" in until(lambda said: "still here" in said)
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
        shutil.rmtree(tmp_path, ignore_errors=True)
