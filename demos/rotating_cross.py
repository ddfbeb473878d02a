"""A rotating elastic cross: the midpoint rule blows up, the energy-momentum scheme does not.

Problem (B15 of the benchmarks). An X of four arms, 3 long, 1 wide and 1 thick, about a unit cube;
W = a (tr C - 3) + b (tr cof C - 3) + c/2 (J - 1)^2 - d ln J with a = 2.5e4, b = 5e4, c = 5e5,
d = 2 (a + 2 b), and rho = 1000. It starts undeformed with the angular velocity omega = 4 about its
axis, so it also pulsates radially. No load acts.

Reference. Energy, linear and angular momentum are constant. At the start the body moves as a rigid
one: J = I omega = 232667 and E = J omega / 2 = 465333, with I / rho = 1/6 + 4 * 14.5.

What to see. The table runs through step sizes. The energy-momentum scheme keeps the energy to
round-off with each of them. The midpoint rule, stable with every step for linear problems, drifts
by an amount that grows with the square of the step (4e-4 with h = 0.01, 1.3e-2 with 0.05); with
h = 0.1 it multiplies the energy until Newton's method fails. Both keep the momenta.

    mpirun -n 2 python demos/rotating_cross.py
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

DENSITY, OMEGA, ARM = 1000.0, 4.0, 3
INTEGRATORS = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}
#: A failed step ends the run instead of being halved, so that every step has the size asked for.
NEWTON = nts.Newton(max_retries=0)
LINE_SEARCH = {"snes_linesearch_type": "bt"}


def cross_mesh(comm, refine):
    """Cubes of size 1/refine, centred at the origin, built on rank 0."""
    n = (2 * ARM + 1) * refine
    i, j, k = np.indices((n, n, refine)).reshape(3, -1)
    middle = [(a >= ARM * refine) & (a < (ARM + 1) * refine) for a in (i, j)]
    lower = np.stack([i, j, k], axis=1)[middle[0] | middle[1]]
    corners = np.indices((2, 2, 2)).reshape(3, -1)[::-1].T  # x runs fastest: DOLFINx's order
    points, cells = np.unique(
        (lower[:, None] + corners).reshape(-1, 3), axis=0, return_inverse=True
    )
    cells, x = cells.reshape(-1, 8), points / refine - [ARM + 0.5, ARM + 0.5, 0.5]
    if comm.rank > 0:
        x, cells = x[:0], cells[:0]
    return create_mesh(comm, cells, x, "hexahedron")


def scene(comm, refine=1):
    """The cross, rotating about z."""

    def velocity(x):
        return OMEGA * np.stack([-x[1], x[0], 0 * x[2]])

    material = nts.MooneyRivlin(a=2.5e4, b=5e4, c=5e5)
    mesh = cross_mesh(comm, refine)
    body = nts.Continuum(mesh, material, density=DENSITY, velocity=velocity, name="cross")
    return nts.System([body])


def figures(run):
    """Return how far the run came and what it kept."""
    b = run.balance
    spin = b["angular_momentum"]
    return {
        "time": float(b["time"][-1]),
        "energy": float(b["energy"][0]),
        "angular_momentum": float(spin[0, 2]),
        "energy_drift": float(np.abs(b["energy"] / b["energy"][0] - 1).max()),
        "angular_momentum_drift": float(np.abs((spin - spin[0]) / spin[0, 2]).max()),
        "newton_iterations": float(b["newton_iterations"][1:].mean()) if len(spin) > 1 else np.nan,
        "status": run.status,
    }


def report(results):
    print("rotating cross")
    print(f"{'':17}{'step':>7}{'reached':>9}{'energy drift':>14}{'J drift':>10}{'iterations':>11}")
    for (label, dt), r in results.items():
        print(
            f"{label:17}{dt:7g}{r['time']:9.4g}{r['energy_drift']:14.2e}"
            f"{r['angular_momentum_drift']:10.1e}{r['newton_iterations']:11.1f}"
        )


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    steps=(0.01, 0.02, 0.05, 0.1),
    t_end=5.0,
    refine=1,
    integrators=tuple(INTEGRATORS),
    progress=False,
):
    """Run the cross with each integrator and step.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        steps: Step sizes [s].
        t_end: End of each run [s].
        refine: Elements across an arm.
        integrators: Which of "energy-momentum", "midpoint".
        progress: Show a progress line.

    Returns:
        {(integrator, step): figures}; see `figures`.
    """
    results, balances = {}, {}
    for name in integrators:
        for dt in steps:
            clock, system = time.perf_counter(), scene(comm, refine)
            folder = output and Path(output) / f"{name}_{dt:g}"
            writers = []
            if folder:
                film = Film(folder / "film.gif", interval=t_end / 30, colour="stress")
                writers = [Fields(folder, interval=0.1), film]
            run = nts.simulate(
                system, INTEGRATORS[name], dt=dt, t_end=t_end, newton=NEWTON,
                petsc_options=LINE_SEARCH, progress=progress, output=writers,
            )  # fmt: skip
            if folder:
                picture(run, folder / "cross.png", colour="stress")
            results[name, dt], balances[f"{name}, h = {dt:g}"] = figures(run), run.balance
            results[name, dt]["seconds"] = time.perf_counter() - clock
    if comm.rank == 0:
        report(results)
    if comm.rank == 0 and output is not None:
        from dolfinx_nts.output.plots import compare_balances

        Path(output).mkdir(parents=True, exist_ok=True)
        compare_balances(balances, str(Path(output) / "balance.png"))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/rotating_cross", help="pictures and fields")
    parser.add_argument("--t-end", type=float, default=5.0)
    parser.add_argument("--refine", type=int, default=1, help="elements across an arm")
    main(progress=True, **vars(parser.parse_args()))
