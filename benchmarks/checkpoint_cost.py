"""What checkpoints cost: their part of a run that writes one every 100 steps, and their size.

The run is that of step_time.py, two cubes of n^3 and (n + 1)^3 hexahedra that collide. Time in
checkpoints and time of the run are of the same run, so that another user of the machine slows both;
processor time leaves out the wait for the disk (fsync), which other users lengthen most.
With --steps 0 the first state is written alone, as of 5e5 coordinates, of which no step is needed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from mpi4py import MPI

from clock import Clock
from step_time import cubes

import dolfinx_nts as nts
from dolfinx_nts.run.checkpoint import Saver


def main(cells: int, steps: int, every: int, accuracy: str) -> dict[str, float]:
    """Run and print; the folder of the files is gone afterwards."""
    comm, clock, dt = MPI.COMM_WORLD, Clock(), 1e-3
    folder = Path(comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None))
    path, system, saves = folder / "run.h5", cubes(comm, cells), 0
    options = nts.Checkpoint(path, every=every)
    clock.time("save", Saver, "save")
    begin, busy = time.perf_counter(), time.process_time()
    if steps:
        nts.simulate(
            system, nts.EnergyMomentum(), dt=dt, t_end=steps * dt, accuracy=accuracy,
            checkpoint=options,
        )  # fmt: skip
        saves = steps // every
    else:
        stepper = nts.Stepper(system, nts.EnergyMomentum())
        stepper.start(dt)
        Saver(options, stepper).save()
        stepper.close()
        saves = 1
    whole, spent = time.perf_counter() - begin, clock.seconds["save"]
    whole_cpu, spent_cpu = time.process_time() - busy, clock.cpu["save"]
    clock.close()
    bytes_of_u_and_v = 2 * 8 * system.size
    found = {
        "coordinates": system.size,
        "ms": 1e3 * spent / saves,
        "percent": 100 * spent / (whole - spent) if steps else float("nan"),
        "percent_cpu": 100 * spent_cpu / (whole_cpu - spent_cpu) if steps else float("nan"),
        "size": path.stat().st_size / bytes_of_u_and_v,
    }
    comm.barrier()
    if comm.rank == 0:
        print(
            f"{system.size} coordinates, {steps} steps: {found['ms']:.1f} ms a checkpoint, "
            f"{found['percent']:.2f} % of the run ({found['percent_cpu']:.2f} % of its processor "
            f"time), {found['size']:.2f} times the bytes of u and v"
        )
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="*", default=[4, 8])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--every", type=int, default=100)
    parser.add_argument("--accuracy", default="balanced")
    given = parser.parse_args()
    for n in given.cells:
        main(n, given.steps, given.every, given.accuracy)
