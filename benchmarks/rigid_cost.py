"""CPU time of a step of a sliding cube, flexible and rigid, with friction at all nodes of its side.

python benchmarks/rigid_cost.py [--cells 25]
"""

import argparse
import time

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts


def main(cells: int, *, rigid: bool, steps: int = 10) -> float:
    """Fastest of the steps [s]."""
    mesh = create_box(
        MPI.COMM_WORLD, [np.zeros(3), np.ones(3)], [cells] * 3, CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    options = {"density": 1e3, "velocity": (1, 0, 0), "name": "cube"}
    if rigid:
        body = nts.RigidBody(mesh, **options)
    else:
        body = nts.Continuum(mesh, nts.NeoHookean(1e9, 0.3), **options)
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    pair = nts.ContactPair(slave=body.surface(lambda x: x[2] < 1e-9), master=floor, friction=0.3)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -9.81))
    newton = nts.Newton(rtol=1e-9, reuse=True)
    stepper = nts.Stepper(system, nts.EnergyMomentum(), newton=newton)
    times = []
    for _ in range(steps + 3):
        start = time.process_time()
        stepper.advance(1e-4)
        times.append(time.process_time() - start)
    return min(times[3:])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=25)
    given = parser.parse_args().cells
    soft, stiff = (main(given, rigid=rigid) for rigid in (False, True))
    print(
        f"{3 * (given + 1) ** 3} coordinates: {1e3 * soft:.1f} ms a step, "
        f"rigid {1e3 * stiff:.1f} ms: {soft / stiff:.1f} times"
    )
