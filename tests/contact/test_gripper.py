"""Two soft fingers hold a rigid lump of irregular tetrahedra by friction, up to Coulomb's limit."""

from mpi4py import MPI

import gmsh
import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts

MU, RADIUS, PRESSED, SQUEEZE = 0.3, 0.01, 0.05, 8e-4


def lump():
    """Two spheres that have grown together, of tetrahedra of 3 mm."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 1)
    occ = gmsh.model.occ
    both = occ.addSphere(0, 0, 0, RADIUS), occ.addSphere(0, 0.002, 0.003, 0.9 * RADIUS)
    out, _ = occ.fuse(*([(3, ball)] for ball in both))
    occ.synchronize()
    skin = gmsh.model.getBoundary(out, oriented=False)
    for entities, name in ((out, "lump"), (skin, "skin")):
        dim = entities[0][0]
        group = gmsh.model.addPhysicalGroup(dim, [tag for _, tag in entities])
        gmsh.model.setPhysicalName(dim, group, name)
    for bound in ("Max", "Min"):
        gmsh.option.setNumber(f"Mesh.MeshSize{bound}", 0.003)
    gmsh.model.mesh.generate(3)
    part = nts.bodies_from_gmsh(gmsh.model, MPI.COMM_WORLD)["lump"]
    gmsh.finalize()
    return part


def finger(side):
    """A block beside the lump, pushed towards it from its far face, and its near face."""
    near, far = side * RADIUS, side * (RADIUS + 0.008)
    corners = [[min(near, far), -0.012, -0.012], [max(near, far), 0.012, 0.012]]
    mesh = create_box(MPI.COMM_WORLD, corners, [4, 8, 8], CellType.hexahedron)
    held = nts.Dirichlet(
        lambda x: np.abs(x[0] - far) < 1e-9,
        value=lambda t: (-side * SQUEEZE * min(t / PRESSED, 1.0), 0, 0),
    )
    rubber = nts.NeoHookean(young=2e5, poisson=0.3)
    body = nts.Continuum(mesh, rubber, density=1e3, degree=1, bcs=[held], name=f"finger {side}")
    return body, body.surface(lambda x: np.abs(x[0] - near) < 1e-9)


def gripped(load):
    """The lump, and the run in which both fingers hold it under a load that grows to this [N]."""
    given, fingers = lump(), [finger(side) for side in (-1, 1)]
    body = given.rigid(
        density=1e3, force=lambda t: (0, 0, -load * np.clip((t - PRESSED) / 0.05, 0.0, 1.0))
    )
    skin = body.surface(*given.where("skin"))
    pairs = [nts.ContactPair(surface, skin, friction=MU) for _, surface in fingers]
    system = nts.System([*(block for block, _ in fingers), body], contacts=pairs)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-4, t_end=0.15, accuracy="balanced")
    assert run.balance["time"][-1] == pytest.approx(0.15)
    return body, run


@pytest.fixture(scope="module")
def force():
    """What a finger presses with in the mean over its oscillation, without a load [N]."""
    _, run = gripped(0.0)
    return np.abs(run.contact_forces[run.balance["time"] > PRESSED, :, 0]).mean()


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.95, 1.05])
def test_a_lump_is_held_up_to_the_limit_of_friction_and_not_beyond(force, part):
    """2 mu N is what both fingers can hold: loads of 5 % less and 5 % more."""
    body, _ = gripped(part * 2 * MU * force)
    fell = (body.centre - body.position)[2]
    # The fingers shear by less than 1 mm; what slips has fallen by several.
    assert (fell < 1.5e-3) == (part < 1.0)
