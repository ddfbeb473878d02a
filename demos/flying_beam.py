"""A flying flexible beam: the midpoint rule fails, the energy-momentum scheme does not.

Problem (B29 of the benchmarks). A free beam, 10 long in 8 elements along x, EA = GA = 1e4,
EI = GJ = 500, rho A = 1, rho I = 10. It spins with the angular velocity (0.3, 0.5, 1) about its
middle and bends, by velocities 0.5 cos(pi x / 10) in z. No load acts. Nodes have a place and three
directors; the energy is quadratic in strains that are quadratic in these coordinates.

Reference. Energy and angular momentum are constant.

What to see. The table runs through step sizes. The energy-momentum scheme keeps both to round-off
with each of them. The midpoint rule is 1.4e-3 off in energy with h = 0.05 and a tenth with h = 0.2;
with h = 0.5 it multiplies the energy until Newton's method fails after two steps. It keeps the
angular momentum.

    mpirun -n 2 python demos/flying_beam.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

LENGTH, SPIN = 10.0, (0.3, 0.5, 1.0)
SECTION = nts.Section(
    EA=1e4, GA=(1e4, 1e4), GJ=500, EI=(500, 500), rhoA=1, rhoI=(10, 10),
    # For the picture alone: a square of side 0.5.
    outline=[(0.25, 0), (0.25, 0.25), (0, 0.25), (-0.25, 0.25),
             (-0.25, 0), (-0.25, -0.25), (0, -0.25), (0.25, -0.25)],
)  # fmt: skip
INTEGRATORS = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}
#: A failed step ends the run instead of being halved, so that every step has the size asked for.
#: Of long steps "exact", 1e-12 of the forces, is 3e-13 of the energy: here Newton ends at rounding.
NEWTON = nts.Newton(max_retries=0, rtol=1e-15)


def scene(comm, elements=8):
    """The beam, its nodes given by rank 0."""
    x = np.linspace(0.0, LENGTH, elements + 1)[:, None] * np.array([1.0, 0.0, 0.0])
    cells = np.column_stack([np.arange(elements), np.arange(1, elements + 1)])
    if comm.rank > 0:
        x, cells = x[:0], cells[:0]

    def bending(x):
        return np.stack([0 * x[0], 0 * x[0], 0.5 * np.cos(np.pi * x[0] / LENGTH)])

    mesh = create_mesh(comm, cells, x, "interval")
    return nts.System([nts.Beam(mesh, SECTION, velocity=bending, angular_velocity=SPIN)])


def figures(run):
    """Return how far the run came and what it kept."""
    b = run.balance
    energy, spin = b["energy"], b["angular_momentum"]
    return {
        "time": float(b["time"][-1]),
        "steps": len(energy) - 1,
        "energy_drift": float(np.abs(energy / energy[0] - 1).max()),
        "angular_momentum_drift": float(np.abs(spin - spin[0]).max() / np.linalg.norm(spin[0])),
        "status": run.status,
    }


def report(title, results):
    """Print a table of the runs."""
    print(title)
    print(f"{'':17}{'step':>7}{'reached':>9}{'energy drift':>14}{'J drift':>10}")
    for (label, dt), r in results.items():
        print(
            f"{label:17}{dt:7g}{r['time']:9.4g}{r['energy_drift']:14.2e}"
            f"{r['angular_momentum_drift']:10.1e}"
        )


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    steps=(0.05, 0.2, 0.5),
    t_end=20.0,
    integrators=tuple(INTEGRATORS),
    progress=False,
):
    """Run the beam with each integrator and step.

    Args:
        comm: MPI communicator.
        output: Folder for the plot, pictures and fields, or None.
        steps: Step sizes [s].
        t_end: End of each run [s].
        integrators: Which of "energy-momentum", "midpoint".
        progress: Show a progress line.

    Returns:
        {(integrator, step): figures}; see `figures`.
    """
    results, balances = {}, {}
    for name in integrators:
        for dt in steps:
            clock, system = time.perf_counter(), scene(comm)
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
                picture(run, folder / "beam.png")
            results[name, dt], balances[f"{name}, h = {dt:g}"] = figures(run), run.balance
            results[name, dt]["seconds"] = time.perf_counter() - clock
    if comm.rank == 0:
        report("flying beam", results)
    if comm.rank == 0 and output is not None:
        from dolfinx_nts.output.plots import compare_balances

        Path(output).mkdir(parents=True, exist_ok=True)
        compare_balances(balances, str(Path(output) / "balance.png"))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/flying_beam", help="plot, pictures and fields")
    parser.add_argument("--t-end", type=float, default=20.0)
    main(progress=True, **vars(parser.parse_args()))
