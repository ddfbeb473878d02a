"""Two blocks collide: the midpoint rule and the energy-momentum scheme side by side.

A unit cube of 4 x 4 x 4 hexahedra flies at 2 m/s, turning slowly, into a larger cube of 3 x 3 x 3
hexahedra at rest. Both are rubber-like (neo-Hookean, E = 1 MPa, nu = 0.3, 1000 kg/m^3), there is no
friction, no gravity and no support: linear and angular momentum and energy have nowhere to go.

What to see:

- both integrators keep linear and angular momentum to round-off;
- the energy-momentum scheme closes the energy ledger to round-off at every step: what is missing
  in the end (5.1 %) was lost when nodes became active inside a step, and the ledger says so;
- the midpoint rule drifts: its ledger does not close;
- no node penetrates with either of them.

Run it with `python demos/two_blocks.py`, or unchanged on two ranks with
`mpirun -n 2 python demos/two_blocks.py`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.output import BalanceCSV, Fields, Film
from dolfinx_nts.output.pictures import picture
from dolfinx_nts.output.plots import compare_balances

RUBBER = nts.NeoHookean(young=1e6, poisson=0.3)
INTEGRATORS = {"midpoint": nts.Midpoint(), "energy-momentum": nts.EnergyMomentum()}


def scene(
    comm: MPI.Comm,
    *,
    cells: tuple[int, int] = (4, 3),
    material: Any = RUBBER,
    cell_type: CellType = CellType.hexahedron,
    density: float = 1e3,
    metre: float = 1.0,
    speed: float | None = None,
    mass: str = "consistent",
    friction: float = 0.0,
    integration: str = "nodes",
) -> nts.System:
    """Two cubes, the first about to hit the second.

    Args:
        comm: MPI communicator.
        cells: Cells along an edge of the first and the second cube.
        material: Strain energy of both.
        cell_type: Hexahedra or tetrahedra, of degree 1.
        density: Reference density [kg/m^3] in the units of the scene.
        metre: Length of a metre in the units of the scene, e.g. 1e3 for a scene in mm.
        speed: Speed of the first cube, 2 m/s if not given; the spin scales with it.
        mass: Of the first cube's nodes that touch, "consistent" or "redistributed".
        friction: Coefficient of friction.
        integration: As of `ContactPair`.
    """

    def box(corner: list[float], size: float, shift: float, n: int) -> Any:
        low = metre * (np.array(corner) + shift)
        high = metre * (np.array(corner) + shift + size)
        low[0], high[0] = metre * corner[0], metre * (corner[0] + 1.0)
        return create_box(comm, [low, high], [n] * 3, cell_type, ghost_mode=GhostMode.shared_facet)

    def spin(x: np.ndarray) -> np.ndarray:
        """2 m/s along x and 0.5 rad/s about the y axis through the centre."""
        arm = (x / metre - 0.5) / 4
        along = 2.0 * metre if speed is None else speed
        return along * np.array([1.0 + arm[2], 0 * x[0], -arm[0]])

    left = nts.Continuum(
        box([0, 0, 0], 1.0, 0.0, cells[0]), material, density=density, velocity=spin, degree=1,
        name="left",
    )  # fmt: skip
    right = nts.Continuum(
        box([1.05, 0, 0], 1.2, -0.1, cells[1]), material, density=density, degree=1, name="right"
    )
    tolerance = 1e-9 * metre
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > metre - tolerance, mass=mass),
        master=right.surface(lambda x: x[0] < 1.05 * metre + tolerance),
        friction=friction,
        integration=integration,
    )
    return nts.System([left, right], contacts=[pair])


def figures(run: nts.Solution) -> dict[str, Any]:
    """Return what the run kept and lost, relative to the energy and momenta it started with."""
    table = run.balance
    energy, momentum, spin = (table[k] for k in ("energy", "linear_momentum", "angular_momentum"))
    lost, defect = 1 - energy[-1] / energy[0], table["contact_defect"][-1] / energy[0]
    return {
        "status": run.status,
        "ledger": float(np.abs(table["ledger_residual"]).max() / energy[0]),
        "linear_momentum": float(np.abs(momentum - momentum[0]).max() / np.abs(momentum[0]).max()),
        "angular_momentum": float(np.abs(spin - spin[0]).max() / np.abs(spin[0]).max()),
        "energy_lost": float(lost),
        "contact_defect": float(defect),
        "their_difference": float(abs(lost - defect)),
        "min_gap": float(table["min_gap"].min()),
        "newton_iterations": int(table["newton_iterations"].sum()),
        "max_active": int(table["active"].max()),
        "retries": run.retries,
    }


def main(
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    dt: float = 2e-3,
    t_end: float = 0.2,
    cells: tuple[int, int] = (4, 3),
    output: str | None = None,
    progress: bool = False,
) -> dict[str, dict[str, Any]]:
    """Run the impact with both integrators.

    Args:
        comm: MPI communicator.
        dt: Step [s].
        t_end: End of the run [s].
        cells: Cells along an edge of the first and the second cube.
        output: Folder for tables, plots, pictures and fields.
        progress: Show a progress line.

    Returns:
        `figures` of each integrator.
    """
    results, tables = {}, {}
    for name, integrator in INTEGRATORS.items():
        system = scene(comm, cells=cells)
        writers = []
        if output:
            folder = Path(output) / name
            folder.mkdir(parents=True, exist_ok=True)
            writers = [Fields(folder, every=5), BalanceCSV(folder / "balance.csv")]
            writers += [Film(folder / "film.gif", interval=t_end / 25)]
        run = nts.simulate(
            system, integrator, dt=dt, t_end=t_end, output=writers, progress=progress
        )
        results[name], tables[name] = figures(run), run.balance
        if output:
            run.plot(folder / "balance.png")
            picture(run, folder / "speed.png", colour="speed")
    if output and comm.rank == 0:
        compare_balances(tables, Path(output) / "two_blocks.png")
    if comm.rank == 0:
        _print(results)
    return results


def _print(results: dict[str, dict[str, Any]]) -> None:
    rows = list(next(iter(results.values())))
    print(f"{'':>18}" + "".join(f"{name:>20}" for name in results))
    for row in rows:
        cells = [result[row] for result in results.values()]
        text = [f"{c:20.3e}" if isinstance(c, float) else f"{c!s:>20.20}" for c in cells]
        print(f"{row:>18}" + "".join(text))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/two_blocks", help="tables, pictures, fields")
    parser.add_argument("--dt", type=float, default=2e-3, help="step [s]")
    parser.add_argument("--t-end", type=float, default=0.2, help="end of the run [s]")
    parser.add_argument("--cells", type=int, nargs=2, default=(4, 3), help="cells along the edges")
    options = parser.parse_args()
    main(
        dt=options.dt,
        t_end=options.t_end,
        cells=tuple(options.cells),
        output=options.output,
        progress=True,
    )
