"""Meshes of degree 2, whose cells are curved: from Gmsh, from tags, in files and pictures."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import meshtags
from scenes import RUBBER
from xdmf import read_xdmf

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import output
from dolfinx_nts.bodies.meshes.mesh_input import bodies_from_gmsh, bodies_from_tags
from dolfinx_nts.output import pictures

COMM = MPI.COMM_WORLD
#: Volumes and areas of both shapes: a ball of radius 1; a ring's quarter between radii 1 and 2.
VOLUME = {"tetrahedron": 4 / 3 * np.pi, "hexahedron": 0.75 * np.pi}


@pytest.fixture(params=["tetrahedron", "hexahedron"])
def part(request):
    """A ball of tetrahedra, or a quarter of a ring of hexahedra, of degree 2, named "part"."""
    gmsh = pytest.importorskip("gmsh")
    model = _model(gmsh, request.param) if COMM.rank == 0 else None
    found = bodies_from_gmsh(model, COMM)["part"]
    if COMM.rank == 0:
        gmsh.finalize()
    return found


def _model(gmsh, kind):
    gmsh.initialize(readConfigFiles=False)
    gmsh.option.setNumber("General.Verbosity", 0)
    gmsh.model.add("curved")
    occ = gmsh.model.occ
    if kind == "tetrahedron":
        volumes = [occ.addSphere(0, 0, 0, 1.0)]
        occ.synchronize()
        gmsh.option.setNumber("Mesh.CharacteristicLengthMax", 0.5)
    else:
        line = occ.addLine(occ.addPoint(1, 0, 0), occ.addPoint(2, 0, 0))
        swept = occ.revolve([(1, line)], 0, 0, 0, 0, 0, 1, np.pi / 2, [4], recombine=True)
        plane = [entity for entity in swept if entity[0] == 2]
        solid = occ.extrude(plane, 0, 0, 1, [2], recombine=True)
        occ.synchronize()
        gmsh.model.mesh.setTransfiniteCurve(line, 3)
        volumes = [tag for dim, tag in solid if dim == 3]
    gmsh.model.setPhysicalName(3, gmsh.model.addPhysicalGroup(3, volumes, 1), "part")
    skin = [tag for _, tag in gmsh.model.getEntities(2)]
    gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, skin, 2), "skin")
    gmsh.model.mesh.generate(3)
    gmsh.model.mesh.setOrder(2)
    return gmsh.model


def on_curve(x, kind):
    """How far points (n, 3) of the boundary are from its nearest curved face."""
    if kind == "tetrahedron":
        return np.abs(np.linalg.norm(x, axis=1) - 1)
    radius = np.hypot(x[:, 0], x[:, 1])
    flat = (np.abs(x[:, 2] * (1 - x[:, 2])) < 1e-9) | (np.abs(x[:, :2]) < 1e-9).any(axis=1)
    return np.where(flat, 0.0, np.minimum(np.abs(radius - 1), np.abs(radius - 2)))


@pytest.mark.mpi
def test_gmsh(part):
    """Nodes are on the curves, volumes are those of parabolas, of which chords miss 1 to 10 %."""
    kind = compat.cell_name(part.mesh)
    body = part.continuum(RUBBER, density=1.0)
    rigid = part.rigid(density=1.0)
    assert body.degree == 2
    mass = COMM.allreduce(body.nodal_mass[::3].sum())
    assert mass == pytest.approx(VOLUME[kind], rel=1e-3) and rigid.mass == pytest.approx(mass)
    skin = body.surface(*part.where("skin"))
    assert on_curve(skin.reference, kind).max() < 1e-9
    assert np.array_equal(skin.original, rigid.surface(*part.where("skin")).original)
    coarse = nts.Continuum(nts.linear(part.mesh), RUBBER, density=1.0)
    chords = COMM.allreduce(coarse.nodal_mass[::3].sum())
    assert abs(mass - VOLUME[kind]) < 0.05 * abs(chords - VOLUME[kind])


@pytest.mark.mpi
def test_tags(part):
    """The mesh goes through arrays and comes out the same."""
    mesh = part.mesh
    size = mesh.topology.index_map(3).size_local + mesh.topology.index_map(3).num_ghosts
    every = np.arange(size, dtype=np.int32)
    tags = meshtags(mesh, 3, every, np.full(size, 7, dtype=np.int32))
    again = bodies_from_tags(mesh, tags, part.facet_tags, names={"again": 7}, surfaces={"skin": 2})
    one, two = (p.continuum(RUBBER, density=1.0) for p in (part, again["again"]))
    masses = [COMM.allreduce(body.nodal_mass[::3].sum()) for body in (one, two)]
    assert masses[1] == pytest.approx(masses[0], rel=1e-12)
    areas = [
        body.surface(*p.where("skin")).area.sum()
        for body, p in zip((one, two), (part, again["again"]), strict=True)
    ]
    assert areas[1] == pytest.approx(areas[0], rel=1e-12)


@pytest.mark.mpi
@pytest.mark.fast("hexahedron")
@pytest.mark.fast_on_ranks()
def test_files_and_pictures(part, mpi_tmp_path):
    """Corners of the cells, with the fields there."""
    body = part.continuum(RUBBER, density=1.0, velocity=lambda x: np.stack([x[1], x[2], x[0]]))
    run = nts.Stepper(nts.System([body]), nts.Midpoint())
    output.Fields(mpi_tmp_path, functions=[nts.von_mises]).start(run)
    file = read_xdmf(mpi_tmp_path / "part.xdmf")
    flat = nts.linear(part.mesh)
    assert len(file.points) == flat.geometry.index_map().size_global
    assert len(file.cells) == flat.topology.index_map(3).size_global
    assert len(np.unique(file.cells)) == len(file.points)
    assert np.allclose(file.fields[0]["velocity"], file.points[:, [1, 2, 0]], atol=1e-14)
    for colour in ("speed", "stress"):
        pictures.picture([body], mpi_tmp_path / f"{colour}.png", colour=colour, width=2.0)
    run.close()


@pytest.mark.mpi
def test_points_of_curved_cells(part):
    """A point inside, and one between chord and curve, where it has its own displacement."""
    body = part.continuum(RUBBER, density=1.0)
    far, angle = 0.99 * (1 if compat.cell_name(part.mesh) == "tetrahedron" else 2), np.pi / 16
    x = np.array([[far * np.cos(angle), far * np.sin(angle), 0.01]])
    points = body.points(x)
    assert points.combine(points.reference) == pytest.approx(x, abs=1e-9)


@pytest.mark.mpi
def test_folded_cells(part):
    """The middles between the corners are moved to the other side."""
    mesh, corners = part.mesh, {"tetrahedron": 4, "hexahedron": 8}
    kept = np.unique(compat.geometry_dofmap(mesh)[:, : corners[compat.cell_name(mesh)]])
    places = mesh.geometry.x[kept]
    mesh.geometry.x[:] *= -2.0
    mesh.geometry.x[kept] = places
    with pytest.raises(ValueError, match="curved cells are folded"):
        nts.Continuum(mesh, RUBBER, density=1.0)
