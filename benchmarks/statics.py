"""Equilibrium of two blocks with friction, or of two spheres (Hertz): time and memory.

    python benchmarks/statics.py --cells 20 --solver direct
    python benchmarks/statics.py --cells 20 --solver multigrid
    mpirun -n 2 python benchmarks/statics.py --cells 43 --solver multigrid
    mpirun -n 2 python benchmarks/statics.py --scene spheres --cells 27 --solver multigrid

A block is pressed on another and sheared. The meshes do not match: n^3 cells below, (n - 1)^3
above. Nothing but contact holds the upper block from below. 20 cells make 5e4 coordinates, 43 make
5e5. The spheres are those of `demos/hertz.py`, in two load steps, with n cells from the middle of
the contact to the side of the finely meshed block: 12 make 5e4 coordinates, 27 make 5e5. Processor
time and memory are sums over all ranks; a mesh and solver needs a run of its own, as the peak of
memory is that of the process.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "demos"))
import hertz

_SCALE = 1e-9


def spheres(comm: Any, cells: int) -> nts.System:
    """A soft half sphere on a hundred times as stiff a one."""
    problem = replace(hertz.PROBLEMS["spheres"], cells=cells)
    system: nts.System = hertz.pressed(comm, problem)
    return system


def blocks(comm: Any, cells: int) -> nts.System:
    """Two blocks of E = 1 MPa, 30 kPa and 5 mm of shear on the upper face."""
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    ends = {"lower": ([0, 0, 0], [1, 1, 1]), "upper": ([0.1, 0.1, 1.0], [0.9, 0.9, 1.8])}
    number = {"lower": cells, "upper": max(cells - 1, 1)}
    mesh = {
        name: create_box(comm, [*box], [number[name]] * 3, CellType.hexahedron)
        for name, box in ends.items()
    }
    foot = nts.Dirichlet(lambda x: x[2] < _SCALE)

    def top(x: Any) -> Any:
        return x[2] > 1.8 - _SCALE

    sheared = nts.Dirichlet(top, value=lambda t: (5e-3 * t, 0, 0), components=(0, 1))
    pressed = nts.Traction(top, lambda t: (0, 0, -3e4 * t))
    lower = nts.Continuum(mesh["lower"], rubber, density=1e3, bcs=[foot], name="lower")
    upper = nts.Continuum(
        mesh["upper"], rubber, density=1e3, bcs=[sheared], traction=[pressed], name="upper"
    )
    pair = nts.ContactPair(
        slave=upper.surface(lambda x: x[2] < 1 + _SCALE),
        master=lower.surface(lambda x: x[2] > 1 - _SCALE),
        friction=0.3,
    )
    return nts.System([lower, upper], contacts=[pair])


#: Scene and its load steps.
SCENES = {"blocks": (blocks, 1), "spheres": (spheres, 2)}


def measure(comm: Any, scene: str, cells: int, solver: str) -> dict[str, Any]:
    """Find equilibrium; what it took, the same on all ranks."""
    make, load_steps = SCENES[scene]
    system = make(comm, cells)
    comm.Barrier()
    wall, cpu = time.perf_counter(), time.process_time()
    newton = nts.Newton(linear_solver=solver)
    run = nts.equilibrium(system, load_steps=load_steps, newton=newton)
    own = np.array([time.process_time() - cpu])
    comm.Allreduce(MPI.IN_PLACE, own)
    memory = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    last = run.rows[-1]
    return {
        "coordinates": system.size, "status": run.status, "energy": last["energy"],
        "iterations": int(run.balance["newton_iterations"].sum()), "stick": int(last["stick"]),
        "slip": int(last["slip"]), "wall": time.perf_counter() - wall, "cpu": float(own[0]),
        "memory": memory / 1e6,
    }  # fmt: skip


def main() -> None:
    """Print a line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="blocks", choices=list(SCENES))
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--solver", default="auto")
    options = parser.parse_args()
    found = measure(MPI.COMM_WORLD, options.scene, options.cells, options.solver)
    if MPI.COMM_WORLD.rank == 0:
        per = 1e6 * found["cpu"] / found["iterations"] / found["coordinates"]
        print(
            "{coordinates} coordinates, {solver}: {status}, {iterations} Newton iterations, "
            "{stick} stick, {slip} slip, energy {energy:.12g} J; {cpu:.1f} s of processors, "
            "{wall:.1f} s of wall, {per:.1f} us an iteration and coordinate, {memory:.2f} GB at "
            "most".format(**found, solver=options.solver, per=per)
        )


if __name__ == "__main__":
    main()
