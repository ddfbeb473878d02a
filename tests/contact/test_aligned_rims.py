"""Which side of a master holds a node at a rim: one that the node faces, of whole boundaries."""

from mpi4py import MPI

import gmsh
import numpy as np
import pytest
from dolfinx.mesh import CellType
from measures import kinds
from scenes import box, everywhere

import dolfinx_nts as nts


def face(x):
    """Marker of what meets."""
    return np.abs(x[2] - 1) < 1e-9


def pressed(cells, poisson, slave, master, friction=0.0):
    """Two cubes on each other, the upper one pressed by a fifth of its height; its force [N]."""
    bodies = []
    for z, n, nu, name in zip((1, 0), cells, poisson, ("upper", "lower"), strict=True):
        end, push = (2.0, -0.2) if z else (0.0, 0.0)
        held = nts.Dirichlet(
            lambda x, end=end: np.abs(x[2] - end) < 1e-9,
            value=lambda t, push=push: (0, 0, push * t),
        )
        mesh = box((0, 0, z), (1, 1, z + 1), (n, n, 2))
        rubber = nts.NeoHookean(young=1e6, poisson=nu)
        bodies.append(nts.Continuum(mesh, rubber, density=1e3, bcs=[held], name=name))
    upper, lower = bodies
    pair = nts.ContactPair(upper.surface(slave), lower.surface(master), friction=friction)
    run = nts.equilibrium(nts.System(bodies, contacts=[pair]), load_steps=4)
    assert run.status == "completed" and not kinds(run)
    return run.contact_forces[-1, 0]


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cells", "poisson", "friction"),
    [((1, 1), (0.3, 0.3), 0.0), ((4, 3), (0.3, 0.2), 0.0), ((2, 2), (0.3, 0.45), 0.0),
     ((3, 4), (0.3, 0.45), 0.3)],
)  # fmt: skip
@pytest.mark.fast_on_ranks()
def test_nodes_at_the_rims_stay_with_the_face_that_they_face(cells, poisson, friction):
    """A side that no facet of the slave faces is none of its masters, whichever way rims move."""
    faces = pressed(cells, poisson, face, face, friction)
    assert faces[2] > 1e5
    for slave in (everywhere, face):
        whole = pressed(cells, poisson, slave, everywhere, friction)
        assert whole == pytest.approx(faces, abs=1e-9 * faces[2])


def stepped():
    """A floor of 4 x 2 x 0.5 with a wall on its last quarter, of tetrahedra."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 1)
    occ = gmsh.model.occ
    floor, wall = occ.addBox(0, 0, -0.5, 4, 2, 0.5), occ.addBox(3, 0, 0, 1, 2, 1)
    out, _ = occ.fuse([(3, floor)], [(3, wall)])
    occ.synchronize()
    for entities, name in ((out, "step"), (gmsh.model.getBoundary(out, oriented=False), "skin")):
        dim = entities[0][0]
        group = gmsh.model.addPhysicalGroup(dim, [tag for _, tag in entities])
        gmsh.model.setPhysicalName(dim, group, name)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.8)
    gmsh.model.mesh.generate(3)
    part = nts.bodies_from_gmsh(gmsh.model, MPI.COMM_WORLD)["step"]
    gmsh.finalize()
    return part


def test_a_bottom_that_is_declared_alone_does_not_pass_through_a_wall():
    """What is beyond the rim of a declared face may face anything, and so may the nodes there."""
    given, rubber = stepped(), nts.NeoHookean(young=1e7, poisson=0.3)
    step = given.continuum(
        rubber, density=1e3, bcs=[nts.Dirichlet(lambda x: x[2] < -0.5 + 1e-9)], name="step"
    )
    mesh = box((1.5, 0.6, 1e-4), (2.2, 1.3, 0.7), (2, 2, 2))
    cube = nts.Continuum(mesh, rubber, density=1e3, velocity=(2, 0, 0), name="cube")
    pair = nts.ContactPair(
        cube.surface(lambda x: x[2] < 1e-4 + 1e-9), step.surface(*given.where("skin"))
    )
    system = nts.System([step, cube], contacts=[pair])
    nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.5, accuracy="balanced")
    # It is at the wall after 0.4 s.
    assert nts.motion_of(cube).velocity[0] < 0.0


@pytest.mark.parametrize("cell", [CellType.hexahedron, CellType.tetrahedron])
def test_a_brick_on_a_plate_that_is_thinner(cell):
    """Its top faces the plate's bottom, but that is not beyond an edge of what is near."""
    fixed = nts.RigidBody(
        box((-1, -1, -0.2), (1, 1, 0), (1, 1, 1), cell), density=1e3, motion=(0, 0, 0), name="plate"
    )
    brick = nts.RigidBody(
        box((-0.5, -0.25, 0), (0.5, 0.25, 0.3), (4, 2, 1), cell), density=1e3, name="brick"
    )
    pair = nts.ContactPair(brick.surface(everywhere), fixed.surface(everywhere))
    system = nts.System([brick, fixed], contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.02)
    assert run.status == "completed"
    assert np.abs(nts.motion_of(brick).velocity).max() < 1e-9
