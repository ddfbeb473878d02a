"""A flying flexible plate: the midpoint rule fails, the energy-momentum scheme does not.

Problem (B30 of the benchmarks). A free plate, 4 x 2 in 8 x 4 shell elements, 0.05 thick, E = 1e5,
nu = 0.3, rho = 10. It spins with the angular velocity (0.5, 1, 2) about its centre and bends, by
velocities cos(pi x / 4) in z. No load acts. Nodes have a place and one director; the energy is
quadratic in strains that are quadratic in these coordinates, transverse shear is that of MITC4.

Reference. Energy and angular momentum are constant.

What to see. The table runs through step sizes. The energy-momentum scheme keeps both to round-off
with each of them. The midpoint rule is 2.2e-3 off in energy with h = 0.02 and 8.9e-2 with h = 0.05;
with h = 0.1 it bends cells by 90 degrees, which ends the run in the 17th step. It keeps the
angular momentum.

    mpirun -n 2 python demos/flying_plate.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from flying_beam import INTEGRATORS, NEWTON, figures, report

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

SIDES, SPIN = (4.0, 2.0), (0.5, 1.0, 2.0)


def plate_mesh(comm, n, m, a, b):
    """N x m quadrilaterals on a rectangle a x b in x-y, built on rank 0."""
    i, j = np.indices((n + 1, m + 1)).reshape(2, -1)
    x = np.stack([a * i / n, b * j / m, 0.0 * i], axis=1)
    k = np.arange(len(x)).reshape(n + 1, m + 1)
    cells = np.stack([k[:-1, :-1], k[1:, :-1], k[:-1, 1:], k[1:, 1:]], axis=-1).reshape(-1, 4)
    if comm.rank > 0:
        x, cells = x[:0], cells[:0]
    return create_mesh(comm, cells, x, "quadrilateral")


def scene(comm, refine=1):
    """The plate."""

    def bending(x):
        return np.stack([0 * x[0], 0 * x[0], np.cos(np.pi * x[0] / SIDES[0])])

    plate = nts.Shell(
        plate_mesh(comm, 8 * refine, 4 * refine, *SIDES), young=1e5, poisson=0.3, thickness=0.05,
        density=10.0, velocity=bending, angular_velocity=SPIN, name="plate",
    )  # fmt: skip
    return nts.System([plate])


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    steps=(0.02, 0.05, 0.1),
    t_end=5.0,
    refine=1,
    integrators=tuple(INTEGRATORS),
    progress=False,
):
    """Run the plate with each integrator and step.

    Args:
        comm: MPI communicator.
        output: Folder for the plot, pictures and fields, or None.
        steps: Step sizes [s].
        t_end: End of each run [s].
        refine: Factor on the elements along each side.
        integrators: Which of "energy-momentum", "midpoint".
        progress: Show a progress line.

    Returns:
        {(integrator, step): figures}; see `flying_beam.figures`.
    """
    results, balances = {}, {}
    for name in integrators:
        for dt in steps:
            clock, system = time.perf_counter(), scene(comm, refine)
            folder = output and Path(output) / f"{name}_{dt:g}"
            writers = []
            if folder:
                film = Film(folder / "film.gif", interval=t_end / 40)
                writers = [Fields(folder, interval=t_end / 20), film]
            run = nts.simulate(
                system, INTEGRATORS[name], dt=dt, t_end=t_end, newton=NEWTON, progress=progress,
                output=writers,
            )  # fmt: skip
            if folder:
                picture(run, folder / "plate.png")
            results[name, dt], balances[f"{name}, h = {dt:g}"] = figures(run), run.balance
            results[name, dt]["seconds"] = time.perf_counter() - clock
    if comm.rank == 0:
        report("flying plate", results)
    if comm.rank == 0 and output is not None:
        from dolfinx_nts.output.plots import compare_balances

        Path(output).mkdir(parents=True, exist_ok=True)
        compare_balances(balances, str(Path(output) / "balance.png"))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/flying_plate", help="plot, pictures and fields")
    parser.add_argument("--t-end", type=float, default=5.0)
    parser.add_argument("--refine", type=int, default=1, help="factor on the elements of a side")
    main(progress=True, **vars(parser.parse_args()))
