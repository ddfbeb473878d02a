"""CPU time a step of beams and shells that swing freely, beside continua of as many coordinates.

    python benchmarks/thin_growth.py --beam 1000 8300 --shell 25 50 100 128 --continuum 15 26 31
    python benchmarks/thin_growth.py --copies 20 --beam 20 --shell 4 --continuum

A beam has as many elements as is said, a shell and a continuum as many along a side. With
`--copies` there are as many of each, beside each other; `--alone` evaluates them one by one.
"""

import argparse
import sys
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "demos"))
from flying_plate import plate_mesh

STEPS, DT, RUBBER = 3, 1e-3, {"young": 1e6, "poisson": 0.3, "density": 1e3}


def swinging(x):
    """Velocities across [m/s]."""
    return np.stack([0 * x[0], 0 * x[0], np.cos(np.pi * x[0])])


def body(kind, n, copy=0):
    """A body one metre long."""
    name = f"{kind} {copy}"
    if kind == "beam":
        x = np.linspace([0.0, copy, 0.0], [1.0, copy, 0.0], n + 1)
        pieces = np.column_stack([np.arange(n), np.arange(1, n + 1)])
        mesh = create_mesh(MPI.COMM_SELF, pieces, x, "interval")
        return nts.Beam(mesh, nts.Circle(0.01).section(**RUBBER), velocity=swinging, name=name)
    if kind == "shell":
        mesh = plate_mesh(MPI.COMM_SELF, n, n, 1.0, 1.0)
        mesh.geometry.x[:, 1] += 2.0 * copy
        return nts.Shell(mesh, thickness=0.02, velocity=swinging, name=name, **RUBBER)
    mesh = create_box(MPI.COMM_SELF, [[0, 0, 0], [1, 1, 1]], [n] * 3, CellType.hexahedron)
    material = nts.NeoHookean(young=RUBBER["young"], poisson=RUBBER["poisson"])
    mesh.geometry.x[:, 1] += 2.0 * copy
    return nts.Continuum(mesh, material, density=RUBBER["density"], velocity=swinging, name=name)


def main(sizes, copies=1, alone=False):
    """Print a row for each kind and size."""
    if alone:
        nts.Beam.alike = nts.Shell.alike = None
    for kind, numbers in sizes.items():
        for n in numbers:
            scene = nts.System([body(kind, n, copy) for copy in range(copies)])
            stepper = nts.Stepper(scene, nts.EnergyMomentum())
            stepper.advance(DT)
            start = time.process_time()
            for _ in range(STEPS):
                stepper.advance(DT)
            each = (time.process_time() - start) / STEPS
            many = sum(found.num_owned for found in scene.bodies)
            print(
                f"{copies} {kind} {n}: {many} coordinates, {1e3 * each:.0f} ms a step, "
                f"{1e6 * each / many:.1f} us each",
                flush=True,
            )
            stepper.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--beam", type=int, nargs="*", default=[250, 1000])
    parser.add_argument("--shell", type=int, nargs="*", default=[25, 50])
    parser.add_argument("--continuum", type=int, nargs="*", default=[15])
    parser.add_argument("--copies", type=int, default=1)
    parser.add_argument("--alone", action="store_true")
    given = vars(parser.parse_args())
    options = {name: given.pop(name) for name in ("copies", "alone")}
    main(given, **options)
