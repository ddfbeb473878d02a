"""A hammer strikes a soft post: the hammer as a rigid body, or as a continuum with its stiffness.

A scene for `tradeoff`, which measures what each costs for the same error of the motion:

    python -m dolfinx_nts.study.tradeoff benchmarks/rigid_or_stiff.py --set stiffness=1e9
        --vary hammer=rigid,continuum dt=4e-3,2e-3,1e-3 --reference hammer=continuum dt=2.5e-4
"""

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts


def block(comm, low, high, cells):
    return create_box(
        comm, [low, high], cells, CellType.hexahedron, ghost_mode=GhostMode.shared_facet
    )


def main(*, comm=MPI.COMM_WORLD, hammer="rigid", stiffness=1e9, cells=6, dt=1e-3, t_end=0.08):
    """Strike.

    Args:
        comm: MPI communicator.
        hammer: "rigid" or "continuum".
        stiffness: Young's modulus of the hammer [Pa]; the post has 1e6.
        cells: Along an edge of the hammer.
        dt: Step [s].
        t_end: End of the run [s].

    Returns:
        The solution.
    """
    mesh = block(comm, [-0.3, -0.3, 1.01], [0.3, 0.3, 1.61], [cells] * 3)
    options = {"density": 2e3, "name": "hammer"}
    if hammer == "rigid":
        head = nts.RigidBody(mesh, velocity=(0, 0, -3), angular_velocity=(0, 1, 0), **options)
    else:
        head = nts.Continuum(
            mesh, nts.NeoHookean(stiffness, 0.3), **options,
            velocity=lambda x: np.array([x[2] - 1.31, 0 * x[0], -3 - x[0]]),
        )  # fmt: skip
    ground = block(comm, [-0.2, -0.2, 0.0], [0.2, 0.2, 1.0], [4, 4, 8])
    post = nts.Continuum(
        ground, nts.NeoHookean(1e6, 0.3), density=1e3, name="post",
        bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)],
    )  # fmt: skip
    pair = nts.ContactPair(
        slave=post.surface(lambda x: x[2] > 1 - 1e-9),
        master=head.surface(lambda x: x[2] < 1.01 + 1e-9),
        friction=0.3,
    )
    system = nts.System([head, post], contacts=[pair])
    return nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=t_end, accuracy="balanced")


if __name__ == "__main__":
    print(main().summary())
