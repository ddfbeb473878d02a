"""How time and memory of a step grow with the mesh: two cubes in contact at "balanced".

The cubes of `step_time.py` at a gap that the first step closes, with more and more cells. Printed
are time per step and coordinate, contact's share of it, and memory per coordinate, which is right
for one mesh a run only: what a smaller one has freed may be used again. Run the largest meshes on 2
ranks. The share is the mean over the ranks, as now one rank owns all slaves, now each half of them:
DOLFINx divides the same mesh differently from run to run.
"""

from __future__ import annotations

import argparse
import time

from mpi4py import MPI

import numpy as np
from clock import Clock
from memory import resident
from step_time import PARTS, cubes

import dolfinx_nts as nts
from dolfinx_nts.solve.accuracy import ACCURACY

#: Of `PARTS`, what contact costs beside the linear solver; the bodies' matrices are stored in
#: blocks in the last two of them.
CONTACT = ("search", "contact elements", "contact into the matrix", "new layout")
#: Steps before those that count: contact begins, matrices and solvers are made.
_WARM = 3


def measure(comm: MPI.Comm, n: int, steps: int, dt: float) -> None:
    """Run and print."""
    before = comm.allreduce(resident())
    stepper = nts.Stepper(
        cubes(comm, n, gap=1e-3), nts.EnergyMomentum(), newton=ACCURACY["balanced"]
    )
    size = stepper.system.size
    for _ in range(_WARM):
        stepper.advance(dt)
    clock = Clock()
    for label in CONTACT:
        clock.time(label, *PARTS[label])
    comm.Barrier()
    begin = time.perf_counter()
    for _ in range(steps):
        stepper.advance(dt)
    seconds = (time.perf_counter() - begin) / steps
    clock.close()
    contact = comm.allreduce(sum(clock.seconds.values())) / comm.size / steps
    memory = comm.allreduce(resident()) - before
    linear = stepper.solver.snes.getLinearSolveIterations()
    rows = stepper.solution.rows[-steps:]
    stepper.close()
    if comm.rank == 0:
        newton = np.mean([row["newton_iterations"] for row in rows])
        print(
            f"n = {n:3}: {size:7} coordinates, {rows[-1]['active']:5.0f} active, {seconds:7.3f} s "
            f"a step, {1e6 * seconds / size:5.1f} us per coordinate, contact "
            f"{100 * contact / seconds:4.1f} %, {newton:.1f} Newton iterations, the last with "
            f"{linear / rows[-1]['newton_iterations']:.0f} of GMRES, "
            f"{1e3 * memory / size:.1f} kB per coordinate",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[9, 16, 26])
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--dt", type=float, default=5e-4, help="step [s]")
    options = parser.parse_args()
    for n in options.cells:
        measure(MPI.COMM_WORLD, n, options.steps, options.dt)


if __name__ == "__main__":
    main()
