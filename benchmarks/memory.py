"""Resident memory over many steps in which the contact pattern keeps changing.

A rubber cube tumbles under gravity on a cube that stands on a fixed face; candidates come and go,
so matrices and solvers are made anew again and again. Memory must stay flat.
"""

from __future__ import annotations

import argparse

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts


def tumbling(comm: MPI.Comm) -> nts.System:
    """A spinning cube above a supported one."""
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    options = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
    low = create_box(comm, [[-0.5, -0.5, -1], [1.5, 1.5, 0]], [5, 5, 3], **options)
    high = create_box(comm, [[0, 0, 0.02], [1, 1, 1.02]], [4, 4, 4], **options)
    support = nts.Dirichlet(lambda x: x[2] < -1 + 1e-9)
    base = nts.Continuum(low, rubber, density=1e3, bcs=[support], name="base")
    spin = lambda x: np.array([0.3 + 0 * x[0], 0.4 * (x[2] - 0.5), -0.4 * (x[1] - 0.5)])  # noqa: E731
    cube = nts.Continuum(high, rubber, density=1e3, velocity=spin, name="cube")
    pair = nts.ContactPair(
        slave=cube.surface(lambda x: x[2] < 0.02 + 1e-9),
        master=base.surface(lambda x: x[2] > -1e-9),
    )
    return nts.System([base, cube], contacts=[pair], gravity=(0, 0, -9.81))


def resident() -> float:
    """Resident memory of this process [MB]."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * 4096 / 1e6


def main() -> float:
    """Print resident memory along a run; return its growth after the first tenth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args()
    comm = MPI.COMM_WORLD
    stepper = nts.Stepper(tumbling(comm), nts.EnergyMomentum())
    start, new, laid = 0.0, 0, None
    for k in range(1, options.steps + 1):
        stepper.advance(2e-3)
        new, laid = new + (stepper.problem.laid is not laid), stepper.problem.laid
        if k == options.steps // 10:
            start, new = resident(), 0
        if comm.rank == 0 and k % (options.steps // 10) == 0:
            active = int(stepper.solution.rows[-1]["active"])
            print(f"step {k:5d}: {resident():8.2f} MB, {active:3d} active", flush=True)
    growth = comm.allreduce(resident() / start - 1, op=MPI.MAX)
    if comm.rank == 0:
        print(f"growth {100 * growth:.2f} %, {new} new layouts, {stepper.solution.retries} retries")
    return growth


if __name__ == "__main__":
    main()
