"""Meshes made of others: their volumes, energies of plane strain, and the same on any ranks."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, create_rectangle
from scenes import at, box

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
KINDS = {"triangle": CellType.triangle, "quadrilateral": CellType.quadrilateral}
THICKNESS = 0.25

pytestmark = pytest.mark.mpi


def volume(mesh):
    one = fem.Constant(mesh, 1.0)
    return COMM.allreduce(fem.assemble_scalar(fem.form(one * ufl.dx(mesh))))


def cells_of(mesh):
    return mesh.topology.index_map(mesh.topology.dim).size_global


@pytest.mark.fast("triangle-6-3")
@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize(("kind", "each"), [("triangle", 6), ("quadrilateral", 1)])
def test_an_extruded_plane(kind, each, layers):
    plane = create_rectangle(COMM, [np.zeros(2), np.array([2.0, 1.0])], [4, 3], KINDS[kind])
    mesh = nts.extrude(plane, THICKNESS, layers=layers)
    assert cells_of(mesh) == 12 * each * layers
    np.testing.assert_allclose(volume(mesh), 2.0 * THICKNESS, rtol=1e-13)
    # The mesh is checked: no cell is flat or inside out, and all fit each other.
    body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3)
    assert np.isclose(nts.motion_of(body).mass, 500.0)


@pytest.mark.fast("quadrilateral")
@pytest.mark.parametrize("kind", KINDS)
def test_plane_strain(kind):
    """A sheet pulled in x, free in y: the stiffness E/(1 - nu^2) of plane strain, not E."""
    young, poisson, strain = 1e6, 0.3, 1e-6
    plane = create_rectangle(COMM, [np.zeros(2), np.ones(2)], [3, 3], KINDS[kind])
    mesh = nts.extrude(plane, THICKNESS)
    held = [
        nts.Dirichlet(lambda x: x[2] > -1.0, components=(2,)),
        nts.Dirichlet(at(0, 0.0), components=(0,)),
        nts.Dirichlet(at(1, 0.0), components=(1,)),
        nts.Dirichlet(at(0, 1.0), (strain, 0, 0), components=(0,)),
    ]
    body = nts.Continuum(mesh, nts.NeoHookean(young, poisson), density=1e3, bcs=held)
    run = nts.equilibrium(nts.System([body]))
    assert run.status == "completed"
    pull = run.reactions["body"][-1, 3, 0]
    np.testing.assert_allclose(pull, young / (1 - poisson**2) * strain * THICKNESS, rtol=1e-5)


def ball(order):
    """A ball of cells of an order, made by Gmsh."""
    gmsh = pytest.importorskip("gmsh")
    if COMM.rank == 0:
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.addSphere(0, 0, 0, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(3, [1], 1)
        gmsh.option.setNumber("Mesh.MeshSizeMin", 0.5)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(order)
    mesh, _, _ = compat.model_to_mesh(gmsh.model, COMM)
    if COMM.rank == 0:
        gmsh.finalize()
    return mesh


def test_a_curved_mesh_is_made_straight():
    """Degree 3 is refused, with this remedy."""
    curved, straight = ball(2), ball(1)
    with pytest.raises(ValueError, match=r"20 nodes per tetrahedron, .* nts.linear\(mesh\)"):
        nts.Continuum(ball(3), nts.NeoHookean(1e6, 0.3), density=1e3)
    made = nts.linear(curved)
    assert cells_of(made) == cells_of(straight)
    np.testing.assert_allclose(volume(made), volume(straight), rtol=1e-12)
    nts.Continuum(made, nts.NeoHookean(1e6, 0.3), density=1e3)
    # What its docstring says of the volume.
    lost = 4 / 3 * np.pi - volume(made)
    assert 0 < lost < 4 * np.pi * 0.5**2 / 8


@pytest.mark.fast_on_ranks()
def test_one_cell_on_any_ranks():
    """Also where a rank has none: the corners are those of the input."""
    far = np.array([2.0, 1.0])
    plane = create_rectangle(COMM, [np.zeros(2), far], [1, 1], KINDS["quadrilateral"])
    for mesh, top in ((nts.extrude(plane, THICKNESS), THICKNESS), (nts.linear(plane), 0.0)):
        assert cells_of(mesh) == 1
        x = np.unique(np.concatenate(COMM.allgather(mesh.geometry.x)), axis=0)
        expected = {(a, b, c) for a in (0.0, 2.0) for b in (0.0, 1.0) for c in (0.0, top)}
        assert {*map(tuple, x.tolist())} == expected


def test_what_cannot_be_made():
    plane = create_rectangle(COMM, [np.zeros(2), np.ones(2)], [3, 3], CellType.triangle)
    with pytest.raises(ValueError, match=r"triangle in 2D; .* plane strain pass nts.extrude\(mesh"):
        nts.Continuum(plane, nts.NeoHookean(1e6, 0.3), density=1e3)
    with pytest.raises(TypeError, match="^mesh=3: pass a dolfinx mesh"):
        nts.extrude(3, 1.0)
    with pytest.raises(ValueError, match="mesh: hexahedron in 3D; pass a mesh of triangle, quad"):
        nts.extrude(box(), 1.0)
    with pytest.raises(ValueError, match=r"^thickness=0: must be positive and finite \[m\]"):
        nts.extrude(plane, 0)
    with pytest.raises(ValueError, match=r"^layers=0: pass a whole number >= 1"):
        nts.extrude(plane, 1.0, layers=0)
