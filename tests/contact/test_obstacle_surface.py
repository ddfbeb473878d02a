"""Contact with obstacles that is integrated over the slave's surface (theory section 17)."""

import itertools

import numpy as np
import pytest
from scenes import CELLS, RUBBER, at, bottom, box, everywhere, symmetry

import dolfinx_nts as nts


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("degree", [1, 2])
def test_uniform_pressure_on_a_plane(cell, degree):
    """nu = 0: the pressure is what was applied."""
    body = nts.Continuum(
        box((0, 0, 0), (1, 1, 1), 2, CELLS[cell]), nts.StVenantKirchhoff(1.0, 0.0), density=1.0,
        degree=degree, bcs=symmetry(), traction=[nts.Traction(at(2, 1.0), (0, 0, -1e-4))],
    )  # fmt: skip
    slave = body.surface(bottom)
    pair = nts.ContactPair(slave, nts.Plane((0, 0, 0), (0, 0, 1)), integration="surface")
    run = nts.equilibrium(nts.System([body], contacts=[pair]))
    assert run.status == "completed"
    pressure = run.state.contacts[0].force / slave.area[slave.share]
    assert np.abs(pressure / 1e-4 - 1.0).max() < 1e-8


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.fast("tetrahedron")
def test_rubber_that_fills_its_room(cell):
    """W(l) = mu/2 (l^2 - 1 - 2 ln l) + lambda/2 (ln l)^2, nu = 0.49, pressed by a fifth.

    With nodes the vertices of tetrahedra, which have no force, could be pushed out.
    """
    body = nts.Continuum(
        box((0, 0, 0), (1, 1, 1), 2, CELLS[cell]), nts.NeoHookean(1.0, 0.49), density=1.0, degree=2
    )
    contacts = []
    for axis, side in itertools.product(range(3), (0.0, 1.0)):
        place = side * np.eye(3)[axis]
        lid = {"motion": lambda t: (0, 0, -0.2 * t)} if axis == 2 and side else {}
        wall = nts.Plane(place, (1.0 - 2.0 * side) * np.eye(3)[axis], **lid)
        contacts.append(
            nts.ContactPair(body.surface(at(axis, side)), wall, integration="surface")
        )
    run = nts.equilibrium(nts.System([body], contacts=contacts), load_steps=2)
    mu, bulk, stretch = 0.5 / 1.49, 0.49 / (1.49 * 0.02), 0.8
    exact = mu * (stretch - 1.0 / stretch) + bulk * np.log(stretch) / stretch
    assert run.status == "completed" and not run.warnings
    assert run.contact_forces[-1, 4:, 2] == pytest.approx((-exact, exact), rel=1e-11)


@pytest.mark.mpi
@pytest.mark.parametrize("integration", ["surface", "nodes"])
def test_friction_where_walls_hold_the_same_nodes(integration):
    """Nodes of edges stick to the floor as the walls' gaps say already: one equation too many.

    The walls are smooth and keep the width: nothing slides, and the pressure is that of
    `test_rubber_that_fills_its_room` at nu = 0.3.
    """
    body = nts.Continuum(
        box((0, 0, 0), (1, 1, 1), 2, CELLS["tetrahedron"]), nts.NeoHookean(1.0, 0.3), density=1.0,
        degree=2,
    )  # fmt: skip
    contacts = []
    for axis, side in itertools.product(range(3), (0.0, 1.0)):
        place, motion = side * np.eye(3)[axis], {}
        if axis == 2 and side:
            motion = {"motion": lambda t: (0, 0, -0.2 * t)}
        wall = nts.Plane(place, (1.0 - 2.0 * side) * np.eye(3)[axis], **motion)
        friction = 0.3 if axis == 2 else 0.0
        face = body.surface(at(axis, side))
        contacts.append(
            nts.ContactPair(face, wall, friction=friction, integration=integration)
        )
    run = nts.equilibrium(nts.System([body], contacts=contacts), load_steps=2)
    mu, lame, stretch = 0.5 / 1.3, 0.3 / (1.3 * 0.4), 0.8
    exact = mu * (stretch - 1.0 / stretch) + lame * np.log(stretch) / stretch
    assert run.status == "completed"
    assert run.contact_forces[-1, 4:, 2] == pytest.approx((-exact, exact), rel=1e-9)
    # How friction and the walls divide what holds the edges is not unique, their sum is.
    assert np.abs(run.contact_forces[-1].sum(axis=0)).max() < 1e-9 * abs(exact)
    place = body.reference.reshape(-1, 3)
    moved = body.u.x.array[: body.num_owned].reshape(-1, 3)
    assert moved == pytest.approx(place * [0, 0, stretch - 1.0], abs=1e-9)


def test_a_block_that_slides_and_bounces_keeps_the_ledger():
    body = nts.Continuum(
        box((0, 0, 0.01), (1, 1, 1.01), 1, CELLS["tetrahedron"]), RUBBER, density=1e3, degree=2,
        velocity=(1.0, 0.2, -1.0),
    )  # fmt: skip
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    pair = nts.ContactPair(
        body.surface(everywhere), floor, friction=0.2, integration="surface"
    )
    run = nts.simulate(
        nts.System([body], contacts=[pair]), nts.EnergyMomentum(), dt=2.5e-3, t_end=0.06
    )
    table = run.balance
    assert run.status == "completed" and table["active"].max() >= 4
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
    rubbed = table["friction_dissipation"]
    assert (np.diff(rubbed) >= 0.0).all() and rubbed[-1] > 0.0
