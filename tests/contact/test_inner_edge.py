"""Nodes in an inner edge of a master: one contact holds them out of both faces, or of all three."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from gmsh_parts import of_gmsh
from rotations import rotation
from scenes import RUBBER, at, box, everywhere

import dolfinx_nts as nts
from dolfinx_nts.contact.convex_edges import ConvexEdges

over = pytest.mark.parametrize("integration", ["nodes", "surface"])


@pytest.mark.parametrize(("n", "count"), [(16, 0), (7, 7)])
@pytest.mark.parametrize("outwards", [False, True])
def test_a_bore_of_many_facets_has_no_inner_edges(n, count, outwards):
    """Sixteen facets around turn by 22.5 degrees each, which is a curve; a shaft has none."""
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    y, k = np.concatenate([ring, ring + [0, 0, 1]]), np.arange(n)
    facets = np.stack([k, k + n, (k + 1) % n + n, (k + 1) % n], axis=1)
    at = facets[:, ::-1] if outwards else facets
    edges = ConvexEdges(at, y[at])
    inner = edges.inner
    assert len(inner) == (0 if outwards else count)
    assert (inner[:, 0] % n == inner[:, 1] % n).all()
    # Faces beside each other differ: of seven around three kinds do.
    assert len(np.unique(edges.faces)) == (3 if len(inner) else 1)
    one, two = edges.faces[edges.inner_facets].T
    assert (one != two).all()


def room():
    """Floor and wall as one body of two cells, the inner side from z = 1 of a box."""
    mesh = box([0, 0, 0], [2, 1, 1], [2, 1, 1])
    places = {(0, 0): (-1, -0.3), (0, 1): (-1, 0), (1, 0): (1.3, -0.3)}
    places |= {(1, 1): (1, 0), (2, 0): (1.3, 1), (2, 1): (1, 1)}
    x = mesh.geometry.x
    x[:, ::2] = [places[int(round(a)), int(round(b))] for a, b in x[:, ::2]]
    return nts.RigidBody(
        mesh, density=1e3, motion=(0, 0, 0), rotation=(0, 0, 0), name="room"
    )  # fmt: skip


PLANES = [nts.Plane((0, 0, 0), (0, 0, 1)), nts.Plane((1, 0, 0), (-1, 0, 0), name="wall")]
LEANS = (5, 0, -9.81)


def BOTH(x):  # noqa: N802
    """Floor and wall of the room."""
    return (at(2, 0.0)(x) & (x[0] < 1.1)) | at(0, 1.0)(x)


def leaning(way=(0.0, 0.0)):
    """A rubber cube in the edge of the room, or off it."""
    dx, dz = way
    return nts.Continuum(
        box([0.5 + dx, 0.2, dz], [1 + dx, 0.7, 0.5 + dz]), RUBBER, density=1e3, name="cube",
        bcs=[nts.Dirichlet(at(1, 0.2), components=(1,))],
    )  # fmt: skip


def pressed(masters, integration):
    """Equilibrium of a rubber cube that its weight presses into the edge, and its energy [J]."""
    cube, (body, surfaces) = leaning(), masters()
    own = cube.surface(everywhere)
    pairs = [nts.ContactPair(own, s, integration=integration) for s in surfaces]
    system = nts.System([cube, *body], contacts=pairs, gravity=LEANS)
    run = nts.equilibrium(system, load_steps=2)
    return run, run.balance["potential"][-1]


@pytest.mark.mpi
@over
def test_a_cube_in_the_edge_of_a_room(integration):
    """With one contact for both faces it is held as with a contact for each, or by two planes.

    Held out of one of them alone, its edge passed through the other; it stored a tenth too much.
    """

    def whole():
        body = room()
        return [body], [body.surface(BOTH)]

    def each():
        body = room()
        return [body], [body.surface(at(2, 0.0)), body.surface(at(0, 1.0))]

    _, right = pressed(lambda: ([], PLANES), integration)
    for masters in (each, whole):
        run, energy = pressed(masters, integration)
        assert run.status == "completed" and energy == pytest.approx(right, rel=1e-9)
    weight = 1e3 * 0.5**3 * np.array([5.0, 0.0, -9.81])
    assert np.allclose(run.contact_forces[-1, 0], -weight, atol=1e-9 * np.abs(weight).max())
    # Forces of nodes are those of both faces: of the edge's nodes, too.
    fields = run.contact_fields(run.system.bodies[0])
    force = sum_of(fields["contact_force_cube-room"], run.system.comm)
    assert force == pytest.approx(np.abs(weight).sum(), rel=1e-9)


def sum_of(field, comm):
    """Sum of the values of a field at all nodes."""
    size = field.function_space.dofmap.index_map.size_local
    return comm.allreduce(field.x.array[:size].sum())


@pytest.mark.mpi
@over
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_overlap_with_both_faces_is_pressed_out(friction, integration):
    """A cube held on its far sides that starts in floor and wall: as with a contact for each."""

    def fitted(masters):
        held = [(1, at(1, 0.2)), (0, at(0, 0.51)), (2, at(2, 0.495))]
        cube = nts.Continuum(
            box([0.51, 0.2, -0.005], [1.01, 0.7, 0.495]), RUBBER, density=1e3, name="cube",
            bcs=[nts.Dirichlet(where, components=(k,)) for k, where in held],
        )  # fmt: skip
        body = room()
        pairs = [
            nts.ContactPair(
                cube.surface(everywhere), body.surface(m), interference="resolve",
                friction=friction, integration=integration,
            )
            for m in masters
        ]  # fmt: skip
        return nts.equilibrium(nts.System([cube, body], contacts=pairs), load_steps=2)

    one, each = fitted([BOTH]), fitted([at(2, 0.0), at(0, 1.0)])
    assert one.status == each.status == "completed"
    for name in ("potential", "interference_work", "friction_dissipation"):
        assert one.balance[name] == pytest.approx(each.balance[name], rel=1e-9), name
    forces = [run.contact_forces[-1].sum(axis=0) for run in (one, each)]
    assert np.allclose(*forces, rtol=0.0, atol=1e-9 * np.abs(forces[0]).max())


@pytest.mark.mpi
def test_a_bar_slides_down_a_v_groove():
    """Flanks of 45 degrees bear W cos(slope)/sqrt(2) each: friction is sqrt(2) mu W cos(slope).

    Whole boundaries are declared, so that nodes of the bar's lower edge touch both flanks.
    """

    def draw(occ):
        block = occ.addBox(-0.5, -0.3, -0.3, 2, 0.6, 0.5)
        cut = occ.addBox(-1, -0.4, -0.4, 3, 0.8, 0.8)
        occ.rotate([(3, cut)], 0, 0, 0, 1, 0, 0, np.pi / 4)
        occ.translate([(3, cut)], 0, 0, 0.4 * np.sqrt(2))
        return occ.cut([(3, block)], [(3, cut)])[0]

    friction, slope, still = 0.1, np.radians(20.0), (0.0, 0.0, 0.0)
    groove = of_gmsh(draw, 0.2).rigid(density=1e3, motion=still, rotation=still, name="groove")
    mesh = box([0, 0, 0], [0.4, 0.2, 0.2], [4, 2, 2])
    mesh.geometry.x[:] = mesh.geometry.x @ rotation(np.pi / 4, (1, 0, 0)).T
    bar = nts.RigidBody(mesh, density=1e3, name="bar")
    pair = nts.ContactPair(bar.surface(everywhere), groove.surface(everywhere), friction=friction)
    gravity = 9.81 * np.array([np.sin(slope), 0.0, -np.cos(slope)])
    system = nts.System([bar, groove], contacts=[pair], gravity=gravity)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.3)
    assert run.status == "completed"
    speed = 0.3 * 9.81 * (np.sin(slope) - np.sqrt(2.0) * friction * np.cos(slope))
    assert bar.velocity == pytest.approx([speed, 0.0, 0.0], abs=1e-8 * speed)


@pytest.mark.mpi
def test_a_row_that_two_contacts_share_is_held_out_of_both_faces():
    """A contact for the cube's bottom and one for its side, each with the whole room as master."""
    _, right = pressed(lambda: ([], PLANES), "nodes")
    cube, body = leaning(), room()
    pairs = [
        nts.ContactPair(cube.surface(side), body.surface(BOTH)) for side in (at(2, 0.0), at(0, 1.0))
    ]
    system = nts.System([cube, body], contacts=pairs, gravity=LEANS)
    run = nts.equilibrium(system, load_steps=2)
    assert run.status == "completed"
    assert run.balance["potential"][-1] == pytest.approx(right, rel=1e-9)


@pytest.mark.mpi
@pytest.mark.parametrize("way", [(-0.002, 0.004), (0.002, -0.004), (0.004, -0.002)])
def test_gaps_to_both_faces_are_adjusted(way):
    """A cube off, or inside, floor and wall by millimetres settles as if it touched both."""
    _, right = pressed(lambda: ([], PLANES), "nodes")
    cube, body = leaning(way), room()
    pair = nts.ContactPair(cube.surface(everywhere), body.surface(BOTH), adjust=0.01)
    run = nts.equilibrium(nts.System([cube, body], contacts=[pair], gravity=LEANS), load_steps=2)
    assert run.status == "completed"
    assert run.balance["potential"][-1] == pytest.approx(right, rel=1e-9)


@pytest.mark.mpi
def test_touches_stay_with_their_faces():
    """A cube hits floor and wall and leaves the floor first: it touches the wall as before."""

    def thrown_in(masters):
        cube = nts.Continuum(
            box([0.5, 0.2, 0], [1, 0.7, 0.5]), nts.NeoHookean(young=1e6, poisson=0.3), density=1e3,
            velocity=(1, 0, -1), name="cube",
        )  # fmt: skip
        body = room()
        pairs = [nts.ContactPair(cube.surface(everywhere), body.surface(m)) for m in masters]
        system = nts.System([cube, body], contacts=pairs, gravity=(0, 0, -9.81))
        run = nts.simulate(
            system, nts.EnergyMomentum(), dt=1e-3, t_end=0.015, impact="restored", accuracy="exact"
        )
        return run.state.u[0], run.balance["impact_restored"]

    one, each = thrown_in([BOTH]), thrown_in([at(2, 0.0), at(0, 1.0)])
    for found, expected in zip(one, each, strict=True):
        size = np.abs(expected).max(initial=0.0)
        assert np.abs(found - expected).max(initial=0.0) <= 1e-9 * size


@pytest.mark.mpi
def test_a_run_goes_on_with_the_forces_of_all_faces():
    """From an equilibrium in a corner of three faces, in another system of the same bodies."""

    def resting():
        cube = nts.Continuum(
            box([0, 0, 0], [0.5] * 3, [2] * 3), RUBBER, density=1e3, name="cube"
        )  # fmt: skip
        corner = rigid_corner()
        pair = nts.ContactPair(cube.surface(everywhere), corner.surface(within))
        return nts.System([cube, corner], contacts=[pair], gravity=(-3, -4, -9.81))

    rests = nts.equilibrium(resting(), load_steps=2)
    run = nts.simulate(resting(), nts.EnergyMomentum(), dt=1e-3, t_end=2e-3, start=rests,
                       start_time=0.0)  # fmt: skip
    assert np.ptp(run.balance["active"]) == 0.0
    force, weight = run.contact_forces[-1, 0], 1e3 * 0.5**3 * np.array([3, 4, 9.81])
    assert force == pytest.approx(weight, rel=1e-6)


def within(x):
    """On the inner faces of the corner."""
    zero = np.abs(x) < 1e-9
    return zero.any(axis=0) & (x > -1e-9).all(axis=0)


def drawn_corner():
    """Three faces that meet, of Gmsh's tetrahedra."""

    def draw(occ):
        whole, hole = occ.addBox(-0.4, -0.4, -0.4, 2.4, 2.4, 2.4), occ.addBox(0, 0, 0, 3, 3, 3)
        return occ.cut([(3, whole)], [(3, hole)])[0]

    return of_gmsh(draw, 0.5)


def rigid_corner():
    still = (0.0, 0.0, 0.0)
    return drawn_corner().rigid(density=1e3, motion=still, rotation=still, name="corner")


def thrown(masters, friction=0.0, t_end=0.12, integration="nodes", **soft):
    """A cube thrown, spinning, into a corner of Gmsh's tetrahedra, and how it ends."""
    mesh = create_box(MPI.COMM_WORLD, [[0.1] * 3, [0.6] * 3], [3] * 3, CellType.hexahedron)
    cube = nts.Continuum(
        mesh, nts.NeoHookean(young=1e6, poisson=0.3), density=1e3, name="cube", degree=1,
        velocity=lambda x: np.array(
            [-3.0 - 2.0 * (x[1] - 0.3), 2.0 * (x[0] - 0.3) - 2.5, -2.0 + 0.0 * x[0]]
        ),
    )  # fmt: skip
    corner = rigid_corner()
    if soft:
        law = nts.NeoHookean(**soft)
        corner = drawn_corner().continuum(law, density=1e3, degree=1, name="corner")
    each = [lambda x, k=k: within(x) & (np.abs(x[k]) < 1e-9) for k in range(3)]
    chosen = {"one": [within], "each": each}[masters]
    own = cube.surface(everywhere)
    pairs = [
        nts.ContactPair(own, corner.surface(m), friction=friction, integration=integration)
        for m in chosen
    ]
    system = nts.System([cube, corner], contacts=pairs)
    return nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=t_end, accuracy="exact")


@pytest.mark.mpi
def test_a_rigid_cube_is_fitted_into_a_soft_corner():
    """It overlaps with three faces by different ways, each of which is pressed out evenly.

    Which face is the nearest changes with the load steps; an overlap is that of its face.
    """
    each = [lambda x, k=k: within(x) & (np.abs(x[k]) < 1e-9) for k in range(3)]

    def fitted(masters):
        held = nts.Dirichlet(lambda x: (x < -0.4 + 1e-9).any(axis=0))
        law = nts.NeoHookean(young=1e6, poisson=0.3)
        corner = drawn_corner().continuum(law, density=1e3, degree=1, bcs=[held], name="corner")
        mesh, still = box([-0.004, -0.002, -0.003], [0.496, 0.498, 0.497], [2] * 3), (0, 0, 0)
        cube = nts.RigidBody(mesh, density=1e3, motion=still, rotation=still, name="cube")
        own = cube.surface(everywhere)
        pairs = [nts.ContactPair(own, corner.surface(m), interference="resolve") for m in masters]
        run = nts.equilibrium(nts.System([cube, corner], contacts=pairs), load_steps=3)
        assert run.status == "completed"
        return run

    one, apart = fitted([within]), fitted(each)
    for name in ("potential", "interference_work"):
        assert one.balance[name] == pytest.approx(apart.balance[name], rel=1e-6), name
    assert np.allclose(
        one.contact_forces.sum(axis=1), apart.contact_forces.sum(axis=1), rtol=0.0,
        atol=1e-6 * np.abs(apart.contact_forces).max(),
    )  # fmt: skip


@pytest.mark.mpi
@over
def test_a_cube_thrown_into_a_corner_is_held_out_of_three_faces(integration):
    """One contact of all faces gives the motion that a contact of each of them gives."""
    one, each = (thrown(m, integration=integration) for m in ("one", "each"))
    assert one.status == each.status == "completed"
    assert np.abs(one.state.u[0] - each.state.u[0]).max(initial=0.0) < 1e-9
    energy = one.balance["energy"]
    assert np.abs(one.balance["ledger_residual"]).max() < 1e-11 * energy[0]
    # It has been in the corner: 12 N s and more on each of the faces.
    impulse = one.balance["linear_momentum"][-1] - one.balance["linear_momentum"][0]
    assert (impulse[:3] > 12.0).all()


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_soft_corner_keeps_momenta_and_the_ledger(friction):
    run = thrown("one", friction, 0.06, young=1e6, poisson=0.3)
    assert run.status == "completed"
    table = run.balance
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
    for name in ("linear_momentum", "angular_momentum"):
        off = np.abs(table[name] - table[name][0]).max()
        assert off < 1e-12 * np.abs(table[name][0]).max(), name
