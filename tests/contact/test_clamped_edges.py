"""Contact over the surface whose slave has nodes that supports hold on the master.

There the mean gap around a node repeats what its neighbours' rows say, and it has no row.
"""

from mpi4py import MPI

import numpy as np
import pytest
from integrators import CONTACT_RULES
from measures import assert_tangent
from scenes import CELLS, UNITS, at, box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
MU = 0.2
SIDES = (0.0, 1.0)


def block(cells, low, way, *, cell="hexahedron", degree=2, nu=0.49, metre=1.0, comm=COMM, bcs=()):
    """A cube in plane strain on a smooth support, whose lid is clamped and moves."""
    every = [
        nts.Dirichlet(at(2, metre, metre), way), nts.Dirichlet(at(2, 0.0), components=(2,)),
        *(nts.Dirichlet(at(1, side * metre, metre), components=(1,)) for side in SIDES), *bcs,
    ]  # fmt: skip
    corners = np.multiply(metre, [low, np.add(low, 1.0)])
    return nts.Continuum(
        box(*corners, list(cells), CELLS[cell], comm), nts.NeoHookean(1.0 / metre, nu),
        density=1.0, degree=degree, bcs=every, name=f"block at {low[0]}",
    )  # fmt: skip


def wall(side, kind, metre, comm):
    """A wall at x = 0 or 1, and the body that it is of, if any."""
    if kind == "plane":
        normal = np.array([1.0 - 2.0 * side, 0, 0])
        return nts.Plane(side * metre * np.eye(3)[0], normal), []
    low, high = [1.0 if side else -0.3, -0.5, -0.5], [1.3 if side else 0.0, 1.5, 1.5]
    still = {"motion": lambda t: (0, 0, 0), "rotation": lambda t: (0, 0, 0)}
    mesh = box(*np.multiply(metre, [low, high]), 2, comm=comm)
    body = nts.RigidBody(mesh, density=1.0, name=f"wall at {side}", **still)
    return body.surface(at(0, side * metre, metre)), [body]


def lidded(
    cells, *, kind="plane", way=(0, 0, -0.1), sides=SIDES, friction=0.0, integration="surface",
    metre=1.0, comm=COMM, **options
):  # fmt: skip
    """A block between walls, or beside another block, whose lids come down."""

    def lid(t):
        return np.multiply(metre, way(t) if callable(way) else np.multiply(way, t))

    options |= {"metre": metre, "comm": comm}
    how = {"friction": friction, "integration": integration}
    if kind == "block":
        blocks = [
            block([n, 1, n], (low, 0, 0), lid, **options, bcs=[
                nts.Dirichlet(at(0, 2.0 * low * metre, metre), components=(0,))
            ])
            for n, low in zip(cells, SIDES, strict=True)
        ]  # fmt: skip
        slave, master = (body.surface(at(0, metre, metre)) for body in blocks)
        return nts.System(blocks, contacts=[nts.ContactPair(slave, master, **how)])
    bodies, pairs = [block(cells, (0, 0, 0), lid, **options)], []
    for side in sides:
        master, of = wall(side, kind, metre, comm)
        bodies += of
        slave = bodies[0].surface(at(0, side * metre, metre))
        pairs.append(nts.ContactPair(slave, master, **how))
    return nts.System(bodies, contacts=pairs)


def pressed(cells, **options):
    run = nts.equilibrium(lidded(cells, **options), load_steps=4)
    assert run.status == "completed"
    return run


# ---- a clamped lid between walls
@pytest.mark.mpi
@pytest.mark.parametrize(("kind", "cells", "options"), [
    ("plane", (3, 1, 3), {}), ("rigid", (3, 1, 3), {}), ("rigid", (2, 2, 3), {"degree": 1}),
    ("plane", (2, 2, 2), {"cell": "tetrahedron"}), ("block", (3, 3), {}), ("block", (3, 2), {}),
    ("rigid", (2, 2, 3), {"cell": "tetrahedron", "degree": 1}), ("block", (2, 3), {"degree": 1}),
])  # fmt: skip
@pytest.mark.fast_on_ranks("rigid-cells1-options1", "block-cells5-options5")
def test_patch_with_clamped_edges(kind, cells, options):
    """Lids move along what the blocks touch; pressure is uniform on any meshes, also at edges.

    With a row for each node of the clamped edges these bore 0.3 of the force, steps were cut, or
    the run stopped.
    """
    check_patch(pressed(cells, kind=kind, **options))


def test_patch_with_clamped_edges_in_any_unit():
    for metre in UNITS:
        check_patch(pressed((3, 1, 3), kind="rigid", metre=metre, degree=1), metre)


def check_patch(run, metre=1.0):
    assert len(run.balance["time"]) == 5 and run.retries == 0
    # Neo-Hookean, not stretched along x: P_x = -lambda ln J.
    exact = -0.49 / (1.49 * 0.02) * np.log(0.9) * metre
    forces, body = run.contact_forces[-1], run.system.bodies[0]
    assert np.abs(np.abs(forces[:, 0]) - exact).max() < 1e-9 * exact
    assert np.abs(forces[:, 1:]).max() < 1e-9 * exact
    lid, fields = run.reactions[body.name][-1][0], run.contact_fields(body)
    assert abs(lid[0]) < 1e-9 * exact
    for name in (name for name in fields if name.startswith("contact_pressure")):
        pressure = fields[name].x.array
        there = pressure[np.isfinite(pressure) & (pressure != 0.0)]
        assert np.abs(there * 0.9 * metre**2 / exact - 1.0).max(initial=0.0) < 1e-9


def forces_in_all(run):
    """Of supports and contacts on the block [N]."""
    return run.reactions["block at 0"][-1].sum(axis=0) + run.contact_forces[-1].sum(axis=0)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_clamped_lid_with_friction():
    """Forces tend to those of nodes on a finer mesh; every load step is solved as asked."""
    lids = []
    for n in (3, 6):
        run = pressed((n, 1, n), friction=MU)
        assert len(run.balance["time"]) == 5 and run.retries == 0
        left, right = run.contact_forces[-1]
        assert left * [-1, 1, 1] == pytest.approx(right, rel=1e-8, abs=1e-8 * left[0])
        assert 0.01 * left[0] < left[2] < MU * left[0]
        assert np.abs(forces_in_all(run)).max() < 1e-9 * left[0]
        lids.append(run.reactions["block at 0"][-1][0, 2])
    finer = pressed((12, 1, 12), friction=MU, integration="nodes")
    errors = np.abs(np.array(lids) - finer.reactions["block at 0"][-1][0, 2])
    assert errors[1] < 0.5 * errors[0] < 0.02 * abs(lids[1])


@pytest.mark.mpi
@pytest.mark.parametrize("into", [0.004, 0.02])
@pytest.mark.fast("0.02")
def test_an_edge_that_supports_draw_from_one_wall_into_the_other(into):
    """There nodes that are prescribed are not held, as with nodes; what is beside them is.

    With rows of their own the forces were 1.4 and 2 times those of nodes.
    """
    surface, nodes = (
        pressed((3, 1, 3), nu=0.3, way=(into, 0, -0.1), integration=integration)
        for integration in ("surface", "nodes")
    )
    one, two = (np.abs(run.contact_forces[-1][:, 0]) for run in (surface, nodes))
    assert one == pytest.approx(two, rel=0.11)
    assert np.abs(forces_in_all(surface)).max() < 1e-9 * one[0]


# ---- dynamics
@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["plane", "rigid"])
@pytest.mark.fast_on_ranks("rigid")
def test_ledger_while_an_edge_comes_to_a_wall_and_leaves(kind):
    """It is closed whatever hats there are."""

    system = lidded(
        (3, 1, 2), degree=1, nu=0.3, friction=MU, kind=kind, sides=(0.0,),
        way=lambda t: (0.02 * np.sin(8.0 * t) ** 2, 0.0, -0.1 * t),
    )  # fmt: skip
    run = nts.simulate(system, CONTACT_RULES["energy-momentum"], dt=0.02, t_end=1.0)
    # Facets that tilt by more than six degrees leave their sharp edges, and gaps jump.
    assert run.status.startswith("completed")
    table = run.balance
    top = np.abs(table["external_work"]).max()
    assert table["active"].max() >= 4
    assert np.abs(table["ledger_residual"]).max() < 1e-10 * top


# ---- equations
def test_tangent_is_the_derivative_of_the_residual():
    """None of the slaves is one of the lid."""

    def look(problem, at_x):
        for c in problem.elements:
            at_z = c.pair.slave.reference[c.pair.slave.share[c.candidates.node], 2]
            assert len(at_z) == 6 * 3 and at_z.max() < 0.9

    assert_tangent(pressed((3, 1, 3), friction=MU, comm=MPI.COMM_SELF), look)


@pytest.mark.mpi
@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
@pytest.mark.parametrize("options", [
    {"kind": "rigid"}, {"cell": "tetrahedron", "degree": 1, "nu": 0.3},
])  # fmt: skip
def test_ranks_do_not_matter(options):
    one, both = (
        pressed((3, 2, 3), friction=MU, comm=comm, **options).contact_forces[-1]
        for comm in (MPI.COMM_SELF, COMM)
    )
    assert both == pytest.approx(one, rel=1e-8, abs=1e-8 * np.abs(one).max())
