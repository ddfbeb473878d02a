"""The flying L-shaped block: free tumbling that only an energy-momentum scheme follows for long.

Problem (Simo, Tarnow 1992). An L of 117 unit cubes (x <= 6, y <= 10, z <= 3, legs 3 wide), one
hexahedron each, W = a (tr C - 3) + b (tr cof C - 3) + c/2 (J - 1)^2 - d ln J with a = 831.25,
b = 166.25, c = 1e4, d = 2 (a + 2 b), and rho = 100. Opposite tractions +-(256, 512, 768)/9 on the
ends of the legs, y = 10 and x = 6, grow until t = 2.5 and vanish at t = 5. Then nothing acts.

Reference. The loads are opposite, so the linear momentum stays zero at all times. Angular momentum
and energy are constant from t = 5 on.

What to see. With the energy-momentum scheme and h = 1, in which the block turns by a large part of
a radian, both are constant to round-off over the whole run. The midpoint rule keeps the momenta but
not the energy: it grows until, before t = 30, Newton's method fails. Newton's steps are shortened
where they overshoot (`bt`): full ones diverge in one step of the energy-momentum run too.

    mpirun -n 2 python demos/flying_l_block.py --t-end 200
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

LOAD = np.array([256.0, 512.0, 768.0]) / 9
PEAK, END = 2.5, 5.0
INTEGRATORS = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}
#: A failed step ends the run instead of being halved, so that every step has the size asked for.
NEWTON = nts.Newton(max_retries=0)
LINE_SEARCH = {"snes_linesearch_type": "bt"}


def unit_cubes(comm, inside):
    """Mesh of the unit cubes whose lower corners i, j, k `inside` accepts, built on rank 0."""
    corners = np.indices((2, 2, 2)).reshape(3, -1)[::-1].T  # x runs fastest: DOLFINx's order
    lower = np.array([c for c in np.ndindex(16, 16, 16) if inside(*c)])
    points, cells = np.unique(
        (lower[:, None] + corners).reshape(-1, 3), axis=0, return_inverse=True
    )
    cells = cells.reshape(-1, 8)
    if comm.rank > 0:
        points, cells = points[:0], cells[:0]
    return create_mesh(comm, cells, points, "hexahedron")


def factor(t):
    """Triangle in time."""
    return np.interp(t, [0.0, PEAK, END], [0.0, 1.0, 0.0])


def scene(comm):
    """The block with its loads."""
    mesh = unit_cubes(comm, lambda i, j, k: k < 3 and ((i < 3 and j < 10) or (i < 6 and j < 3)))
    traction = [
        nts.Traction(lambda x: x[1] > 10 - 1e-9, lambda t: factor(t) * LOAD),
        nts.Traction(lambda x: x[0] > 6 - 1e-9, lambda t: -factor(t) * LOAD),
    ]
    material = nts.MooneyRivlin(a=831.25, b=166.25, c=1e4)
    return nts.System([nts.Continuum(mesh, material, density=100.0, traction=traction, name="L")])


def figures(run):
    """Energy and momenta, and how far they change after the loads have gone."""
    b = run.balance
    free = b["time"] > END - 1e-9
    free[-1] |= not free.any()  # a run that fails earlier has nothing to compare
    energy, spin = b["energy"][free], b["angular_momentum"][free]
    drift = np.linalg.norm(spin - spin[0], axis=1) / np.linalg.norm(spin[0])
    # The momentum each load alone would have given is the scale of a momentum that is zero.
    scale = 9 * np.linalg.norm(LOAD) * END / 2
    return {
        "energy": float(energy[0]),
        "energy_end": float(energy[-1] / energy[0]),
        "energy_drift": float(np.abs(energy / energy[0] - 1).max()),
        "angular_momentum": spin[0],
        "angular_momentum_drift": float(drift.max()),
        "linear_momentum": float(np.abs(b["linear_momentum"]).max() / scale),
        "ledger": float(np.abs(b["ledger_residual"]).max() / energy[0]),
        "time": float(b["time"][-1]),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "status": run.status,
    }


def report(results, dt):
    print(f"flying L-block, h = {dt:g}")
    print(f"{'':24}" + "".join(f"{name:>18}" for name in results))
    for name in next(iter(results.values())):
        if name not in ("status", "angular_momentum"):
            print(f"{name:24}" + "".join(f"{r[name]:18.8g}" for r in results.values()))
    for label, r in results.items():
        spin = ", ".join(f"{x:.6g}" for x in r["angular_momentum"])
        print(f"{label}: angular momentum ({spin}); {r['status']}")


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    dt=1.0,
    t_end=50.0,
    integrators=tuple(INTEGRATORS),
    progress=False,
):
    """Run the block with each integrator.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        dt: Step [s]; the paper's is 1.
        t_end: End of the run [s]; the paper's is 200.
        integrators: Which of "energy-momentum", "midpoint".
        progress: Show a progress line.

    Returns:
        {integrator: figures}; see `figures`.
    """
    results, balances = {}, {}
    for name in integrators:
        clock, system = time.perf_counter(), scene(comm)
        writers = []
        if output:
            folder = Path(output) / name
            writers = [Fields(folder), Film(folder / "film.gif", interval=t_end / 30)]
        run = nts.simulate(
            system, INTEGRATORS[name], dt=dt, t_end=t_end, newton=NEWTON, progress=progress,
            petsc_options=LINE_SEARCH, output=writers,
        )  # fmt: skip
        results[name], balances[name] = figures(run), run.balance
        results[name]["seconds"] = time.perf_counter() - clock
        if output is not None:
            picture(run, str(Path(output) / f"block_{name}.png"), colour="speed")
    if comm.rank == 0:
        report(results, dt)
    if comm.rank == 0 and output is not None:
        from dolfinx_nts.output.plots import compare_balances

        compare_balances(balances, str(Path(output) / "balance.png"))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/flying_l_block", help="pictures and fields")
    parser.add_argument("--dt", type=float, default=1.0)
    parser.add_argument("--t-end", type=float, default=50.0)
    main(progress=True, **vars(parser.parse_args()))
