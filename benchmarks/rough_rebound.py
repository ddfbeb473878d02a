"""The cube of `explicit_friction.py` by this package, slave nodes with and without mass.

    python benchmarks/rough_rebound.py [cells] [--dt 1.25e-4 ...] [--nu 0.49] [--friction 0.8]

A row for each step and mass: the rebound, and how far it is from that of the shortest step: largest
difference of v_x and v_z at any time over the speed of the throw, and rms difference of the contact
forces' means over a quarter, one and four milliseconds over the rms of these.
"""

from __future__ import annotations

import argparse
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx.mesh import CellType, create_box
from explicit_friction import DENSITY, GAP, SIDE, T_END, THROWN, YOUNG

import dolfinx_nts as nts

WINDOWS = (2.5e-4, 1e-3, 4e-3)


def throw(cells: int, dt: float, mass: str, nu: float, friction: float) -> tuple[Any, Any]:
    """Solution, and motion of the body at its end."""
    mu, bulk = YOUNG / 2 / (1 + nu), YOUNG / 3 / (1 - 2 * nu)

    def energy(c: Any) -> Any:
        j = ufl.sqrt(ufl.det(c))
        over = ufl.tr(c) * j ** (-2 / 3) - 3
        return mu / 2 * over + mu / 20 * over**2 + bulk / 2 * (j - 1) ** 2

    ends = [[0.0, 0.0, GAP], [SIDE, SIDE, SIDE + GAP]]
    mesh = create_box(MPI.COMM_WORLD, ends, [cells] * 3, CellType.hexahedron)
    body = nts.Continuum(mesh, energy, density=DENSITY, velocity=THROWN)
    slave = body.surface(lambda x: np.abs(x[2] - GAP) < 1e-6, mass=mass)
    pair = nts.ContactPair(slave, nts.Plane((0, 0, 0), (0, 0, 1)), friction=friction)
    system = nts.System([body], contacts=[pair])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=T_END, accuracy="balanced")
    return run, nts.motion_of(body)


def apart(run: Any, reference: Any) -> list[float]:
    """How far the velocity, and the means of the force over `WINDOWS`, are from a reference's."""

    def momentum(of: Any, time: Any) -> Any:
        table = of.balance
        both = [np.interp(time, table["time"], table["linear_momentum"][:, i]) for i in (0, 2)]
        return np.stack(both) / (DENSITY * SIDE**3)

    found = []
    for window in (1e-5, *WINDOWS):
        time = np.arange(0.0, T_END, window)
        one, two = momentum(run, time), momentum(reference, time)
        if window == 1e-5:
            found.append(float(np.abs(one - two).max() / np.linalg.norm(THROWN)))
            continue
        one, two = np.diff(one), np.diff(two)
        found.append(float(np.sqrt(((one - two) ** 2).sum() / (two**2).sum())))
    return found


def main() -> None:
    """Print a row for each step and mass."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cells", type=int, nargs="?", default=5)
    parser.add_argument("--dt", type=float, nargs="*", default=[1e-3, 2.5e-4, 6.25e-5])
    parser.add_argument("--nu", type=float, default=0.49)
    parser.add_argument("--friction", type=float, default=0.8)
    given = parser.parse_args()
    print("mass           dt [ms]   v_x   v_z  spin  v apart  force apart over 0.25, 1, 4 ms")
    for mass in ("consistent", "redistributed"):
        runs = {dt: throw(given.cells, dt, mass, given.nu, given.friction) for dt in given.dt}
        reference = runs[min(runs)][0]
        for dt, (run, motion) in runs.items():
            v, *force = apart(run, reference)
            means = " ".join(f"{part:5.2f}" for part in force)
            print(f"{mass:13} {1e3 * dt:8.4f} {motion.velocity[0]:5.3f} {motion.velocity[2]:5.3f}"
                  f" {motion.spin[1]:5.2f} {v:8.3f}  {means}")  # fmt: skip


if __name__ == "__main__":
    main()
