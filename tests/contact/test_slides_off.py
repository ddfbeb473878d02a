"""A vertex slides off a face over its rim: from there on the edge behind it lies on the rim."""

import numpy as np
import pytest
from scenes import at, box, everywhere
from scipy.spatial.transform import Rotation

import dolfinx_nts as nts

#: Edges of a cube by the numbers of its corners, x fastest.
EDGES = [(k, k + d) for k in range(8) for d in (1, 2, 4) if not k & d]


@pytest.mark.parametrize("exchange", [False, True])
@pytest.mark.parametrize("speed", [2.0, 5.0, 10.0])
def test_no_edge_enters_the_rim(speed, exchange):
    turn = Rotation.from_euler("zy", [30, 35], degrees=True).as_matrix()
    mesh = box([0, 0, 0], [1, 1, 1], [1, 1, 1])
    local = mesh.geometry.x.copy()
    mesh.geometry.x[:] = local @ turn.T
    lowest = mesh.geometry.x[mesh.geometry.x[:, 2].argmin()]
    mesh.geometry.x[:] += [-0.003, 0.1, 0.0] - lowest
    table = nts.RigidBody(
        box([-3, -2, -1], [0, 2, 0], [1, 1, 1]), density=1.0, motion=lambda t: (0, 0, 0),
        rotation=lambda t: (0, 0, 0), name="table",
    )  # fmt: skip
    cube = nts.RigidBody(mesh, density=1.0, velocity=(speed, 0, -1.0), name="cube")
    both = cube.surface(everywhere), table.surface(at(2, 0.0))
    pair = nts.ContactPair(*(both[::-1] if exchange else both))
    system = nts.System([table, cube], contacts=[pair], gravity=(0, 0, -9.81))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    order = np.lexsort(local.round(6).T)
    deepest = 0.0
    for _ in range(25):
        stepper.advance(2e-3)
        x = (mesh.geometry.x - cube.centre)[order] @ cube.rotation.T + cube.position
        for i, j in EDGES:
            along = x[i] + np.linspace(0, 1, 401)[:, None] * (x[j] - x[i])
            deepest = max(deepest, float(np.minimum(-along[:, 0], -along[:, 2]).max()))
    assert deepest < 1e-6
