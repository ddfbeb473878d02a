"""Contact for thousands of steps: whose energy grows until the run fails, and whose does not.

Problem. A rubber cube of one trilinear cell, edge 1 m, E = 1 MPa, nu = 0.3, 1 t/m^3, g = 9.81
m/s^2, on a plane. *Bouncing*: it falls from 0.2 m, mu = 0.1. *Rubbing*: it lies on a plane that
shakes sideways by 5 cm at 7 rad/s, mu = 0.3, and slides on it all the time. Steps of 3.2 ms are a
twentieth of the time for which two such cubes touch.

Reference. Energy beside all that is accounted for (work, friction, gaps that close in mid step)
cannot grow: the ledger's residual is zero.

What to see. With the same steps `Newmark` wins energy in impacts and in frictional contact until a
cell turns inside out and the run stops; when that is depends on rounding, so that on other ranks it
may be later, at three times the energy. The energy-momentum scheme completes with its ledger at
rounding. The midpoint rule completes, too: we found no scene of contact in which its drift ends a
run that the energy-momentum scheme completes; without contact there is one (`flying_l_block.py`).
Generalised alpha completes; when the cube bounces, 17 % of the energy has come from nowhere.
`python -m dolfinx_nts.study.stability` runs both scenes for 20,000 steps, and 90 others.

    mpirun -n 2 python demos/stability.py
"""

import argparse
from pathlib import Path

from mpi4py import MPI

import numpy as np

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture
from dolfinx_nts.study.extreme_scenes import long_run

INTEGRATORS = {
    "energy-momentum": nts.EnergyMomentum(),
    "midpoint": nts.Midpoint(),
    "newmark": nts.Newmark(),
    "generalized-alpha": nts.GeneralizedAlpha(),
}
#: Steps of each scene, a few more than `Newmark` survives.
STEPS = {"bouncing": 2400, "rubbing": 900}


def figures(run):
    """How far a run came, and the energy that nothing accounts for, over the largest there was."""
    b = run.balance
    largest = max(np.abs(b[name]).max() for name in ("kinetic", "potential"))
    return {
        "steps": float(len(b["time"]) - 1),
        "time": float(b["time"][-1]),
        "gained": float(b["ledger_residual"].max() / largest),
        "missing": float(np.abs(b["ledger_residual"]).max() / largest),
        "status": run.status,
    }


def report(results):
    for scene, runs in results.items():
        print(f"{scene:12}" + "".join(f"{name:>19}" for name in runs))
        for name in ("steps", "time", "gained", "missing"):
            print(f"{name:12}" + "".join(f"{r[name]:19.6g}" for r in runs.values()))
        for label, r in runs.items():
            print(f"  {label}: {r['status'][:100]}")


def main(*, comm=MPI.COMM_WORLD, output=None, steps=STEPS, integrators=tuple(INTEGRATORS),
         progress=False):  # fmt: skip
    """Run scenes with each integrator.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        steps: {"bouncing" or "rubbing": steps}.
        integrators: Which of "energy-momentum", "midpoint", "newmark", "generalized-alpha".
        progress: Show a progress line.

    Returns:
        {scene: {integrator: figures}}; see `figures`.
    """
    results = {}
    for scene, number in steps.items():
        results[scene], balances = {}, {}
        for name in integrators:
            case = long_run(comm, scene)
            folder = Path(output) / scene if output else None
            writers = []
            if folder:
                film = Film(folder / f"{name}.gif", every=max(1, number // 30))
                writers = [Fields(folder / name, every=20), film]
            run = nts.simulate(
                case.system, INTEGRATORS[name], dt=case.dt, t_end=number * case.dt,
                progress=progress, output=writers,
            )  # fmt: skip
            results[scene][name], balances[name] = figures(run), run.balance
            if folder:
                picture(run, str(folder / f"{name}.png"), colour="speed")
        if folder and comm.rank == 0:
            from dolfinx_nts.output.plots import compare_balances

            compare_balances(balances, str(folder / "balance.png"))
    if comm.rank == 0:
        report(results)
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/stability_demo", help="pictures and fields")
    parser.add_argument("--bouncing", type=int, default=STEPS["bouncing"], help="steps")
    parser.add_argument("--rubbing", type=int, default=STEPS["rubbing"], help="steps")
    options = vars(parser.parse_args())
    main(progress=True, output=options.pop("output"), steps=options)
