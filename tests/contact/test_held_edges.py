"""Friction over the surface where supports or other contacts hold edges of the slave.

There the mean slip around a node repeats what its neighbours' rows of friction say.
"""


from mpi4py import MPI

import numpy as np
import pytest
from measures import assert_tangent
from scenes import at, box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
MU = 0.3
#: Faces of a unit cube: floor, left, right, front, back.
FACES = [(2, 0.0), (0, 0.0), (0, 1.0), (1, 0.0), (1, 1.0)]


def wall(axis, side, **options):
    return nts.Plane(side * np.eye(3)[axis], (1.0 - 2.0 * side) * np.eye(3)[axis], **options)


def rubs(body, axis, side, friction=MU, integration="surface", **options):
    face = body.surface(at(axis, side))
    return nts.ContactPair(
        face, wall(axis, side, **options), friction=friction, integration=integration
    )


# ---- a block that is pressed
def beside_a_wall(cells, integration):
    """Rubber in a room of supports that are smooth, but for one wall; force on the slave [N]."""
    bcs = [nts.Dirichlet(at(k, s), components=(k,)) for k, s in FACES if (k, s) != (0, 0.0)]
    lid = nts.Dirichlet(at(2, 1.0), components=(2,), value=lambda t: (0, 0, -0.1 * t))
    body = nts.Continuum(
        box(cells=cells), nts.NeoHookean(1.0, 0.49), density=1.0, bcs=[*bcs, lid],
        volume="projected",
    )  # fmt: skip
    pair = rubs(body, 0, 0.0, integration=integration)
    run = nts.equilibrium(nts.System([body], contacts=[pair]), load_steps=4)
    assert run.status == "completed"
    return run.contact_forces[-1, 0]


@pytest.mark.mpi
def test_supports_hold_edges_beside_a_wall():
    """Over the surface friction is that of nodes but for less than the error of the mesh."""
    surface, nodes = (beside_a_wall(3, integration) for integration in ("surface", "nodes"))
    finer = beside_a_wall(6, "nodes")
    assert surface[0] == pytest.approx(nodes[0], rel=2e-3)
    assert abs(surface[2] - nodes[2]) < abs(nodes[2] - finer[2])
    assert abs(surface[1]) < 1e-9 * surface[0]


def in_a_room(comm=COMM):
    """Rubber between six walls, of which the lid comes down."""
    body = nts.Continuum(
        box(cells=2, comm=comm), nts.NeoHookean(1.0, 0.49), density=1.0, degree=2
    )
    lid = rubs(body, 2, 1.0, motion=lambda t: (0, 0, -0.1 * min(t, 1.0)))
    return nts.System([body], contacts=[lid, *(rubs(body, *face) for face in FACES)])


def pressed_together(comm=COMM):
    run = nts.equilibrium(in_a_room(comm), load_steps=2)
    assert run.status == "completed"
    return run


@pytest.mark.mpi
def test_a_block_between_six_walls():
    """Forces are in balance and as symmetrical as the room; all load steps are solved as asked."""
    run = pressed_together()
    # What this is for: without, they were cut and the run stopped or took three times as many.
    assert len(run.balance["time"]) == 3
    lid, floor, *walls = run.contact_forces[-1]
    assert abs(run.contact_forces[-1].sum(axis=0)).max() < 1e-9 * abs(lid[2])
    for (axis, side), force in zip(FACES[1:], walls, strict=True):
        inwards = (1.0 - 2.0 * side) * force[axis]
        assert inwards == pytest.approx(walls[0][0], rel=1e-9)
        assert 0.01 * inwards < force[2] < MU * inwards
    for contact in run.state.contacts:
        friction = np.linalg.norm(contact.tangential, axis=1)
        assert (friction <= MU * (1 + 1e-9) * contact.force).all()


# ---- a block that is drawn
def drawn(held, way, comm=COMM, floor=None):
    """A block is pressed on a floor, then its top is drawn; x is held at two sides.

    Args:
        held: "supports" or "walls" hold the sides, "left" is a wall on one side alone.
        way: Of the top from pseudo time 1 to 2 [m], shape (3,).
        comm: MPI communicator.
        floor: Motion of the floor; None: it is at rest.
    """

    def value(t):
        return np.multiply(way, max(t - 1.0, 0.0)) - [0, 0, 0.03 * min(t, 1.0)]

    bcs = [nts.Dirichlet(at(2, 0.4), value, (0, 1, 2) if way[0] else (1, 2))]
    if held == "supports":
        bcs += [nts.Dirichlet(at(0, side), components=(0,)) for side in (0.0, 1.0)]
    mesh = box(high=(1, 1, 0.4), cells=(3, 3, 1), comm=comm)
    body = nts.Continuum(mesh, nts.NeoHookean(1.0, 0.3), density=1.0, bcs=bcs)
    pairs = [rubs(body, 2, 0.0, **({"motion": floor} if floor else {}))]
    for side in {"supports": (), "walls": (0.0, 1.0), "left": (0.0,)}[held]:
        pairs.append(rubs(body, 0, side, friction=0.0))
    times = [0.5, 1.0, *np.linspace(1.0, 2.0, 5)[1:]]
    run = nts.equilibrium(nts.System([body], contacts=pairs), load_steps=times)
    assert run.status == "completed"
    return run


def of_edge(run):
    """Forces that press and friction of the floor's nodes at x = 0, on this rank."""
    floor, body = run.state.contacts[0], run.system.bodies[0]
    slave = run.system.contacts[0].slave
    edge = slave.reference[slave.share][:, 0] < 1e-9
    force = floor.force[edge]
    assert body.comm.allreduce(force.max(initial=0.0), op=MPI.MAX) > 0.0
    return force, floor.tangential[edge]


@pytest.mark.mpi
@pytest.mark.parametrize("held", ["supports", "walls"])
def test_a_block_with_held_edges_is_drawn_along_them(held):
    """Its friction is mu N, that of its edges along them."""
    run = drawn(held, (0, 0.4, 0))
    force = run.contact_forces[-1, 0]
    assert force[1] == pytest.approx(-MU * force[2], rel=1e-9)
    normal, friction = of_edge(run)
    assert friction[:, 1] == pytest.approx(-MU * normal, rel=1e-9)
    assert (np.abs(friction[:, 0]) <= 1e-12 * normal).all()


@pytest.mark.mpi
def test_a_floor_that_slides_under_held_edges_rubs_there():
    """There supports hold nodes, but not their slip."""
    run = drawn("supports", (0, 0, 0), floor=lambda t: (0.4 * max(t - 1.0, 0.0), 0, 0))
    force = run.contact_forces[-1, 0]
    assert force[0] == pytest.approx(MU * force[2], rel=1e-6)
    normal, friction = of_edge(run)
    assert friction[:, 0] == pytest.approx(MU * normal, rel=1e-6)


@pytest.mark.mpi
def test_an_edge_rubs_once_its_wall_lets_go():
    run = drawn("left", (0.4, 0, 0))
    assert run.contact_forces[2, 1, 0] > 0.0 and run.contact_forces[-1, 1, 0] == 0.0
    force = run.contact_forces[-1, 0]
    assert force[0] == pytest.approx(-MU * force[2], rel=1e-6)
    normal, friction = of_edge(run)
    assert friction[:, 0] == pytest.approx(-MU * normal, rel=1e-3)


# ---- equations
def test_tangent_is_the_derivative_of_the_residual():
    """With held directions, of nodes that stick and others that slip."""

    def look(problem, at_x):
        own = problem.laid.own_values(at_x.x, problem.elements)
        problem.couplings.tell_loads(own, {})
        assert all(np.abs(each["held"]).max() > 0.9 for each in own)

    assert_tangent(pressed_together(MPI.COMM_SELF), look)


@pytest.mark.mpi
@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
@pytest.mark.parametrize("scene", [
    pressed_together, lambda comm=COMM: drawn("walls", (0, 0.4, 0), comm),
], ids=["room", "drawn"])  # fmt: skip
def test_ranks_do_not_matter(scene):
    """Of friction of nodes that stick at an edge of two contacts the sum alone is known."""
    one, all_ranks = scene(MPI.COMM_SELF), scene()
    a, b = (run.contact_forces[-1] for run in (one, all_ranks))
    assert a == pytest.approx(b, rel=1e-6, abs=1e-6 * np.abs(a).max())
