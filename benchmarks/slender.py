"""An arm on a hinge falls from the horizontal: as a rigid body, beam, shell or continuum.

A scene for `tradeoff`, which measures what each costs for which error of the motion, beside a
continuum of degree 2 and short steps:

    python -m dolfinx_nts.study.tradeoff benchmarks/slender.py --set young=1e8
        --vary part=rigid,beam,shell,linear,quadratic dt=2e-2,1e-2,5e-3
        --reference part=quadratic dt=2.5e-3
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "demos"))
from flying_plate import plate_mesh

LONG, WIDE, THICK, DENSITY, POISSON = 1.0, 0.1, 0.05, 1e3, 0.3


def hinge(x):
    """Where the arm is held: the middle of its first face."""
    return (np.abs(x[0]) < 1e-9) & (np.abs(x[2]) < 1e-9)


def make(part, young, cells, comm):
    """The arm along x, about z = 0, and its joints."""
    held = [nts.Dirichlet(hinge)]
    elastic = {"young": young, "poisson": POISSON}
    if part == "beam":
        x = np.linspace([0.0, WIDE / 2, 0.0], [LONG, WIDE / 2, 0.0], cells[0] + 1)
        pieces = np.column_stack([np.arange(cells[0]), np.arange(1, cells[0] + 1)])
        # Held at a node alone it could turn about its axis and the vertical, which nothing does.
        section = nts.Rectangle(THICK, WIDE).section(**elastic, density=DENSITY)
        return nts.Beam(
            create_mesh(comm, pieces if comm.rank == 0 else pieces[:0], x, "interval"),
            section, direction=(0, 0, 1), bcs=held, name=part,
        ), []  # fmt: skip
    if part == "shell":
        mesh = plate_mesh(comm, cells[0], cells[1], LONG, WIDE)
        return nts.Shell(mesh, **elastic, thickness=THICK, density=DENSITY, bcs=held, name=part), []
    low, high = [0.0, 0.0, -THICK / 2], [LONG, WIDE, THICK / 2]
    mesh = create_box(comm, [low, high], cells, CellType.hexahedron)
    if part == "rigid":
        body = nts.RigidBody(mesh, density=DENSITY, name=part)
        return body, [nts.Revolute(body, None, point=(0, WIDE / 2, 0), axis=(0, 1, 0))]
    material = nts.StVenantKirchhoff(**elastic)
    degree = {"linear": 1, "quadratic": 2}[part]
    body = nts.Continuum(mesh, material, density=DENSITY, degree=degree, name=part)
    # A condition holds whole faces, which could not turn.
    return body, [nts.Spherical(body, None, point=(0, y, 0), name=f"at {y}") for y in (0, WIDE)]


def main(
    *, comm=MPI.COMM_WORLD, part="beam", young=1e8, cells=(20, 2, 2), dt=5e-3, t_end=0.4
):
    """Let it fall.

    Args:
        comm: MPI communicator.
        part: "rigid", "beam", "shell", or "linear" or "quadratic", continua of these degrees.
        young: Young's modulus [Pa].
        cells: Along the arm, across and through it, of those that the part has; the last is even.
        dt: Step [s].
        t_end: End of the run [s].

    Returns:
        The solution.
    """
    body, joints = make(part, young, cells, comm)
    system = nts.System([body], joints=joints, gravity=(0, 0, -9.81))
    return nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=t_end, accuracy="balanced")


if __name__ == "__main__":
    print(main().summary())
