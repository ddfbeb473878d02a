"""Two named surfaces of a face with a row of nodes between them, on one master.

A block of 2 x 1 x 1 stands on a plate, its lower face cut into two patches at x = 1.
"""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
PRESSURE, PUSH = 1000.0, 100.0

pytestmark = pytest.mark.mpi


def box(low, high, cells):
    return create_box(COMM, [low, high], cells, CellType.hexahedron)


def scene(friction, *, poisson=0.3, push=PUSH, on="plate", velocity=(0.0, 0.0, 0.0), bcs=()):
    """Patches x < 1 and x > 1 of the block, in this order, each with its coefficient."""
    rubber = nts.NeoHookean(young=1e6, poisson=poisson)
    load = nts.Traction(lambda x: x[2] > 2 - 1e-9, (push, 0.0, -PRESSURE))
    block = nts.Continuum(
        box((0, 0, 1), (2, 1, 2), (4, 2, 2)), rubber, density=1e3, traction=[load], name="block",
        velocity=velocity, bcs=bcs,
    )  # fmt: skip
    bodies, master = [block], nts.Plane((0, 0, 1), (0, 0, 1))
    if on == "plate":
        held = nts.Dirichlet(lambda x: x[2] < 1e-9)
        plate = nts.Continuum(
            box((-0.5, -0.5, 0), (2.5, 1.5, 1), (6, 4, 2)), rubber, density=1e3, bcs=[held],
            name="plate",
        )  # fmt: skip
        bodies, master = [block, plate], plate.surface(lambda x: x[2] > 1 - 1e-9)

    def patch(side):
        return block.surface(lambda x: (x[2] < 1 + 1e-9) & (side * (x[0] - 1) < 1e-9))

    both = zip((1, -1), friction, strict=True)
    pairs = [nts.ContactPair(patch(side), master, friction=mu) for side, mu in both]
    return nts.System(bodies, contacts=pairs)


@pytest.mark.parametrize("on", ["plate", "plane"])
@pytest.mark.parametrize("friction", [(0.4, 0.4), (0.4, 0.1)])
@pytest.mark.fast_on_ranks()
def test_both_together_carry_the_load(friction, on):
    run = nts.equilibrium(scene(friction, on=on))
    assert run.status == "completed"
    total = run.contact_forces[-1].sum(axis=0)
    assert np.abs(total - (-2 * PUSH, 0.0, 2 * PRESSURE)).max() < 1e-6 * PRESSURE


def test_a_shared_node_belongs_to_the_pair_that_is_declared_first():
    """Under one pressure everywhere: half of the row's area is the second patch's."""
    fixed = nts.Dirichlet(lambda x: x[2] < 1 + 1e-9, components=(0, 1))
    system = scene((0.0, 0.0), poisson=0.0, push=0.0, on="plane", bcs=[fixed])
    held, run = system.bodies[0], nts.equilibrium(system)
    forces = run.contact_forces[-1][:, 2]
    assert forces == pytest.approx([1.25 * PRESSURE, 0.75 * PRESSURE], rel=1e-8)
    fields = run.contact_fields(held)
    pressure = fields[next(name for name in fields if name.startswith("contact_pressure"))]
    owned = held.space.sub(0).collapse()[0].dofmap.index_map.size_local
    carried = pressure.x.array[:owned]
    carried = carried[carried > 0.0]
    assert COMM.allreduce(len(carried)) == 9
    assert np.abs(carried - PRESSURE).max(initial=0.0) < 1e-8 * PRESSURE


@pytest.mark.fast_on_ranks()
def test_each_patch_slides_by_its_own_coefficient():
    friction = (0.4, 0.1)
    system = scene(friction, push=0.0, velocity=(1.0, 0.0, 0.0))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=5e-3)
    assert run.status.startswith("completed")
    table, forces = run.balance, run.contact_forces
    rubs = np.linalg.norm(forces[1:, :, :2], axis=2)
    assert table["slip"].max() > 0 and not table["stick"].any()
    # The plate's facets tilt by some 1e-3, and normals with them.
    assert np.abs(rubs - np.array(friction) * forces[1:, :, 2]).max() < 1e-2 * forces[:, :, 2].max()
    assert np.abs(table["ledger_residual"]).max() < 1e-9 * table["energy"][0]


def test_what_is_no_row_of_nodes_between_two_is_refused():
    system = scene((0.0, 0.0))
    block, plate = system.bodies
    first = system.contacts[0]
    with pytest.raises(ValueError, match="same nodes of 'block' out of the same facets of 'plate'"):
        nts.System([block, plate], contacts=[first, nts.ContactPair(first.slave, first.master)])
    part = plate.surface(lambda x: (x[2] > 1 - 1e-9) & (x[0] > 0.5 - 1e-9))
    other = nts.ContactPair(system.contacts[1].slave, part)
    with pytest.raises(ValueError, match=r"a row of nodes of 'block', node \d+ .*pass one master"):
        nts.System([block, plate], contacts=[first, other])
