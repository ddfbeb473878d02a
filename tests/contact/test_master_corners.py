"""Vertices and nodes of sharp edges of a master stay out of facets of its slave."""

from mpi4py import MPI

import numpy as np
import pytest
from cubes import HALF, ON_EDGE, turned
from dolfinx.mesh import CellType, create_box
from measures import kinds
from scenes import RUBBER, box, everywhere

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
#: Turned so that a diagonal of the cube is along z.
ON_VERTEX = np.array([[1, -1, 0], [1, 1, -2], [1, 1, 1]]) / np.sqrt([[2], [6], [3]])
#: Half of that diagonal.
VERTEX = np.sqrt(0.75)
HELD = {"motion": lambda t: (0, 0, 0), "rotation": lambda t: (0, 0, 0)}


def pair_of(master, slave, exchanged, **options):
    """Contact of two surfaces, of which the vertices are on the first."""
    both = (master, slave) if exchanged else (slave, master)
    return nts.ContactPair(slave=both[0], master=both[1], **options)


def slab(kind, cell=CellType.hexahedron, metre=1.0, **options):
    """A block below z = 0, of facets of half a metre, and its upper face."""
    mesh = box((-1, -1, -1), (1, 1, 0), (4, 4, 2), cell)
    mesh.geometry.x[:] *= metre
    if kind is nts.RigidBody:
        body = nts.RigidBody(mesh, density=1e3 / metre**3, name="slab", **options)
    else:
        material = nts.NeoHookean(1e6 / metre, 0.3)
        given = {"density": 1e3 / metre**3, "degree": 1, "name": "slab"}
        body = nts.Continuum(mesh, material, **given, **options)
    return body, body.surface(lambda x: x[2] > -1e-9 * metre)


def thrown(kind=nts.Continuum, exchanged=False, friction=0.0, metre=1.0, at=(0.13, 0.07)):
    """A rigid cube thrown at the slab, a vertex ahead, between the slab's nodes."""
    lower, face = slab(kind, metre=metre)
    mesh = box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 1)
    mesh.geometry.x[:] = metre * (mesh.geometry.x @ ON_VERTEX.T + [*at, VERTEX + 0.02])
    cube = nts.RigidBody(
        mesh, density=1e3 / metre**3, name="cube", velocity=(0.5 * metre, 0, -2.0 * metre)
    )
    pair = pair_of(cube.surface(everywhere), face, exchanged, friction=friction)
    return nts.System([cube, lower], contacts=[pair])


def end(system):
    """Velocity and spin of the first body."""
    moving = nts.motion_of(system.bodies[0])
    return np.array([*moving.velocity, *moving.spin])


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("kind", [nts.Continuum, nts.RigidBody])
@pytest.mark.fast_on_ranks()
def test_a_vertex_of_the_master_bounces_as_one_of_the_slave_does(kind, friction):
    runs = []
    for exchanged in (False, True):
        system = thrown(kind, exchanged, friction)
        run = nts.simulate(
            system, nts.EnergyMomentum(), dt=1e-3, t_end=0.1, accuracy="exact", output=()
        )
        assert run.status == "completed" and not kinds(run)
        table = run.balance
        energy = table["energy"]
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy[0]
        for name in ("linear_momentum", "angular_momentum"):
            off = np.abs(table[name] - table[name][0]).max()
            assert off < 1e-12 * np.abs(table[name]).max()
        lost = table["contact_defect"][-1] + table["friction_dissipation"][-1]
        assert energy[0] - energy[-1] == pytest.approx(lost, abs=1e-11 * energy[0])
        assert table["min_gap"].min() > -1e-12
        runs.append((end(system), run.contact_forces[:, 0]))
    assert runs[0][0][2] > 0.1
    np.testing.assert_allclose(runs[0][0], runs[1][0], atol=1e-7 * np.abs(runs[1][0]).max())
    most = np.abs(runs[1][1]).max()
    np.testing.assert_allclose(runs[0][1], -runs[1][1], atol=1e-7 * most)


def inside(x, tets, point):
    """How deep a point is in tetrahedra of nodes x [m], negative outside."""
    corner = x[tets]
    inverse = np.linalg.inv((corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1))
    weight = np.einsum("tij,tj->ti", inverse, point - corner[:, 0])
    weight = np.concatenate([1.0 - weight.sum(axis=1, keepdims=True), weight], axis=1)
    slope = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    return float((weight / np.linalg.norm(slope, axis=2)).min(axis=1).max())


@pytest.mark.skipif(COMM.size > 1, reason="takes all cells from one rank")
def test_the_vertex_is_in_no_tetrahedron_of_the_slave():
    lower, face = slab(nts.Continuum, CellType.tetrahedron)
    cube = turned(
        ON_VERTEX, np.array([0.13, 0.07, VERTEX + 0.02]), "cube", cells=1, kind=nts.RigidBody,
        velocity=(0.5, 0.0, -2.0),
    )  # fmt: skip
    pair = nts.ContactPair(face, cube.surface(everywhere))
    stepper = nts.Stepper(nts.System([cube, lower], contacts=[pair]), nts.EnergyMomentum())
    tip = cube.mesh.geometry.x[cube.mesh.geometry.x[:, 2].argmin()] - cube.position
    tets = compat.geometry_dofmap(lower.mesh)
    deep, low = [], []
    for _ in range(80):
        stepper.advance(1e-3)
        point = cube.position + cube.rotation @ tip
        x = lower.mesh.geometry.x + lower.u.x.array.reshape(-1, 3)
        deep.append(inside(x, tets, point))
        low.append(point[2])
    stepper.close()
    assert max(deep) < 1e-3 and min(low) < -0.05


@pytest.mark.mpi
@pytest.mark.parametrize("kind", [nts.Continuum, nts.RigidBody])
@pytest.mark.fast_on_ranks()
def test_an_edge_of_the_master_lies_on_a_face_of_the_slave(kind):
    """A prism with its edge down, between the nodes; it rebounds as if its nodes were slaves."""
    ends = []
    for exchanged in (False, True):
        lower, face = slab(kind)
        prism = turned(
            ON_EDGE, np.array([0.07, 0.12, HALF + 0.02]), "prism", kind=nts.RigidBody,
            velocity=(0.0, 0.0, -2.0),
        )  # fmt: skip
        system = nts.System(
            [prism, lower], contacts=[pair_of(prism.surface(everywhere), face, exchanged)]
        )
        run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.1, accuracy="exact")
        # What activation loses is told where it is much.
        assert run.status == "completed" and set(kinds(run)) <= {"energy lost to contact"}
        table = run.balance
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
        assert table["min_gap"].min() > -1e-12
        for name in ("linear_momentum", "angular_momentum"):
            off = np.abs(table[name] - table[name][0]).max()
            assert off < 1e-12 * np.abs(table[name]).max()
        ends.append(end(system))
    assert ends[0][2] > 0.1
    np.testing.assert_allclose(ends[0], ends[1], atol=0.02 * np.abs(ends[1]).max())


@pytest.mark.mpi
@pytest.mark.parametrize("kind", [nts.Continuum, nts.RigidBody])
@pytest.mark.fast_on_ranks()
def test_a_vertex_that_slides_over_facets_is_slowed_by_mu_g(kind):
    """v = v_0 - mu g t, of a cube that does not turn, over four facets, and the lines between."""
    friction, g, speed, last = 0.2, 9.81, 2.0, 0.5
    held = HELD if kind is nts.RigidBody else {"bcs": [nts.Dirichlet(everywhere)]}
    lower, face = slab(kind, **held)
    cube = turned(
        ON_VERTEX, np.array([-0.7, 0.07, VERTEX]), "cube", cells=1, kind=nts.RigidBody,
        velocity=(speed, 0.0, 0.0), rotation=lambda t: (0, 0, 0),
    )  # fmt: skip
    pair = nts.ContactPair(face, cube.surface(everywhere), friction=friction)
    system = nts.System([cube, lower], contacts=[pair], gravity=(0, 0, -g))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=last, accuracy="exact")
    assert run.status == "completed" and not kinds(run)
    lost = speed - end(system)[0]
    assert lost == pytest.approx(friction * g * last, rel=5e-3)
    work = 0.5 * 1e3 * (speed**2 - (speed - friction * g * last) ** 2)
    assert run.balance["friction_dissipation"][-1] == pytest.approx(work, rel=5e-3)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_vertex_pressed_into_a_soft_block_bears_what_the_other_declaration_says():
    forces = []
    for exchanged in (False, True):
        lower, face = slab(nts.Continuum, bcs=[nts.Dirichlet(lambda x: x[2] < -1 + 1e-9)])
        cube = turned(
            ON_VERTEX, np.array([0.13, 0.07, VERTEX]), "cube", cells=1, kind=nts.RigidBody,
            motion=lambda t: (0, 0, -0.1 * t), rotation=lambda t: (0, 0, 0),
        )  # fmt: skip
        pair = pair_of(cube.surface(everywhere), face, exchanged)
        run = nts.equilibrium(nts.System([cube, lower], contacts=[pair]), load_steps=4)
        assert run.status == "completed" and not kinds(run)
        borne = run.reactions["slab"][-1].sum(axis=0)
        own = run.contact_forces[-1, 0]
        np.testing.assert_allclose(borne, own if exchanged else -own, rtol=1e-6)
        forces.append(borne)
    assert forces[0][2] > 1e4
    np.testing.assert_allclose(forces[0], forces[1], rtol=1e-7)


def thrown_cubes(cells, exchanged=False, t_end=0.02, **options):
    """A cube is thrown at another one, spinning a little; the rims of their faces coincide."""

    def velocity(x):
        return np.array([2.0 + 0.5 * (x[2] - 0.5), 0.0 * x[0], -0.5 * (x[0] - 0.5)])

    left = nts.Continuum(
        box((0, 0, 0), (1, 1, 1), cells[0]), RUBBER, density=1e3, velocity=velocity, name="left"
    )
    right = nts.Continuum(
        box((1.004, 0, 0), (2.004, 1, 1), cells[1]), RUBBER, density=1e3, name="right"
    )
    faces = [left.surface(lambda x: x[0] > 1 - 1e-9), right.surface(lambda x: x[0] < 1.004 + 1e-9)]
    pair = nts.ContactPair(*faces[:: -1 if exchanged else 1], **options)
    return nts.simulate(
        nts.System([left, right], contacts=[pair]), nts.EnergyMomentum(), dt=1e-3, t_end=t_end,
        accuracy="exact",
    )  # fmt: skip


@pytest.mark.mpi
@pytest.mark.parametrize(("cells", "t_end"), [((4, 5), 0.02), ((2, 5), 0.015), ((5, 3), 0.02)])
@pytest.mark.fast_on_ranks()
def test_flat_faces_give_what_they_give_without_corners(cells, t_end, monkeypatch):
    """Whichever is the finer: the master's rim is held by the slave's nodes that lie on it."""
    forces = []
    for _ in range(2):
        forces.append(thrown_cubes(cells, t_end=t_end).contact_forces)
        monkeypatch.setattr("dolfinx_nts.system.corners_of", lambda pair: [])
    assert np.abs(forces[0]).max() > 1e3
    np.testing.assert_allclose(*forces, rtol=0.0, atol=1e-9 * np.abs(forces[0]).max())


@pytest.mark.slow
def test_a_rim_that_slave_nodes_leave_holds_in_their_place(monkeypatch):
    """Both declarations come nearer to contact in the mean, which hardly depends on them."""

    def spins(**options):
        moving = [
            nts.motion_of(thrown_cubes((4, 5), e, 0.06, **options).system.bodies[0])
            for e in (False, True)
        ]
        return np.array([[m.velocity[0], m.spin[1]] for m in moving])

    right = spins(integration="surface").mean(axis=0)
    found = spins()
    monkeypatch.setattr("dolfinx_nts.system.corners_of", lambda pair: [])
    without = spins()
    assert (np.abs(found - right) < np.abs(without - right)).all()


def test_a_rigid_cube_rests_on_a_facet_that_is_larger_than_its_face():
    """None of the slave's nodes lie under it: four vertices bear its weight."""
    lower, face = slab(nts.RigidBody, **HELD)
    cube = nts.RigidBody(
        box((0.1, 0.1, 0.0), (0.4, 0.4, 0.3), 1), density=1e3, name="cube", velocity=(0, 0, 0)
    )
    pair = nts.ContactPair(face, cube.surface(everywhere))
    system = nts.System([cube, lower], contacts=[pair], gravity=(0, 0, -10.0))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.1, accuracy="exact")
    assert run.status == "completed" and not kinds(run)
    np.testing.assert_allclose(cube.position, [0.25, 0.25, 0.15], atol=1e-9)
    assert -np.mean(run.contact_forces[1:, 0, 2]) == pytest.approx(270.0, rel=0.06)


@pytest.mark.parametrize(("facets", "across"), [(1, 2), (4, 2), (4, 4)])
def test_a_block_that_is_wider_than_a_table_tips_about_its_rim(facets, across):
    """No edges cross. By the closed form of small angles, m g x^2 / (2 v (I + m x^2)), I = m/6."""
    table = nts.RigidBody(box((-3, -0.4, -1), (0, 0.4, 0), (3, 2, 1)), density=1e3, **HELD)
    block = nts.RigidBody(
        box((-0.9, -0.5, 0), (0.1, 0.5, 1), (facets, across, 1)), density=1e3, velocity=(2, 0, 0),
        name="block",
    )  # fmt: skip
    faces = [b.surface(lambda x: np.abs(x[2]) < 1e-9) for b in (block, table)]
    system = nts.System([table, block], contacts=[nts.ContactPair(*faces)], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.45, accuracy="balanced")
    assert run.status == "completed" and not kinds(run)
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-9 * run.balance["energy"][0]
    right = 9.81 * 0.25 / (4.0 * (1.0 / 6.0 + 0.25))
    assert block.angular_velocity[1] == pytest.approx(right, rel=0.03)


def test_nodes_that_tilt_beyond_a_rim_are_not_thrown_out_when_they_return():
    """A soft cube of two cells bends over the rim of one of five: it wins no energy there."""

    def velocity(x):
        return np.array([2.0 + 0.5 * (x[2] - 0.5), 0.0 * x[0], -0.5 * (x[0] - 0.5)])

    left = nts.Continuum(
        box((0, 0, 0), (1, 1, 1), 2), RUBBER, density=1e3, velocity=velocity, name="left"
    )
    right = nts.Continuum(box((1.004, 0, 0), (2.004, 1, 1), 5), RUBBER, density=1e3, name="right")
    pair = nts.ContactPair(
        left.surface(lambda x: x[0] > 1 - 1e-9), right.surface(lambda x: x[0] < 1.004 + 1e-9)
    )
    system = nts.System([left, right], contacts=[pair])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.03, accuracy="exact")
    energy = run.balance["energy"]
    assert run.status == "completed"
    assert np.diff(energy).max() < 1e-3 * energy[0]


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_rigid_face_that_falls_flat_is_held_at_its_corners():
    """Its face lies on one node of the slave; the other declaration is the measure."""
    found = []
    for cube_is_slave in (False, True):
        ends = ((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0))
        slab = nts.Continuum(
            create_box(COMM, ends, (4, 4, 2), CellType.hexahedron),
            nts.NeoHookean(young=1e6, poisson=0.3), density=1e3,
            bcs=[nts.Dirichlet(lambda x: x[2] < -1 + 1e-9)], name="slab",
        )  # fmt: skip
        ends = ((-0.3, -0.3, 0.001), (0.3, 0.3, 0.6))
        mesh = create_box(COMM, ends, (1, 1, 1), CellType.hexahedron)
        cube = nts.RigidBody(mesh, density=1e3, velocity=(0.0, 0.0, -1.0), name="cube")
        sides = [cube.surface(lambda x: x[0] > -9.0), slab.surface(lambda x: x[2] > -1e-9)]
        slave, master = sides if cube_is_slave else sides[::-1]
        system = nts.System([cube, slab], contacts=[nts.ContactPair(slave=slave, master=master)])
        run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.03)
        assert run.status == "completed" and not kinds(run)
        found.append([*nts.motion_of(cube).velocity, run.balance["energy"][-1]])
    assert np.abs(found[0][2] - found[1][2]) < 1e-6 and found[0][3] == pytest.approx(found[1][3])
