"""Surfaces by the direction that facets face and by feature angle, against tags and planes."""

from mpi4py import MPI

import numpy as np
import pytest
from rotations import rotation
from scenes import CELLS, RUBBER, at, box, everywhere

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
RADIUS, LENGTH = 1.0, 3.0


def body_of(kind, mesh):
    """A continuum or a rigid body of a mesh."""
    if kind == "rigid":
        return nts.RigidBody(mesh, density=1.0)
    return nts.Continuum(mesh, RUBBER, density=1.0)


def facets(surface):
    """Its facets by input numbers of their corners."""
    return {tuple(sorted(f)) for f in surface.original[surface.facets].tolist()}


@pytest.fixture(scope="module")
def cylinder():
    """A cylinder of tetrahedra of Gmsh, its mantle and its ends tagged."""
    model = None
    if COMM.rank == 0:
        gmsh = pytest.importorskip("gmsh")
        gmsh.initialize()
        gmsh.option.setNumber("General.Verbosity", 0)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
        model = gmsh.model
        model.occ.addCylinder(0, 0, 0, 0, 0, LENGTH, RADIUS)
        model.occ.synchronize()
        model.addPhysicalGroup(3, [1])
        for _, tag in model.getEntities(2):
            z = model.occ.getCenterOfMass(2, tag)[2]
            name = {0.0: "low", LENGTH: "high"}.get(round(z, 6), "mantle")
            model.setPhysicalName(2, model.addPhysicalGroup(2, [tag]), name)
        model.mesh.generate(3)
    (part,) = nts.bodies_from_gmsh(model, COMM).values()
    yield part
    if COMM.rank == 0:
        gmsh.finalize()


@pytest.mark.parametrize("kind", ["continuum", "rigid"])
def test_a_mantle_grows_without_the_end_faces(cylinder, kind):
    body = body_of(kind, cylinder.mesh)
    wanted = facets(body.surface(*cylinder.where("mantle")))
    # A band about the middle has facets of the mantle alone, and not all of them.
    band = lambda x: np.abs(x[2] - LENGTH / 2) < 0.3 * LENGTH  # noqa: E731
    seeds = facets(body.surface(band))
    assert seeds < wanted
    grown = body.surface(band, angle=45)
    assert facets(grown) == wanted
    # Chords of a circle, so less than the cylinder's, by an eighth of their angle squared at most.
    area = 2 * np.pi * RADIUS * LENGTH
    assert 0.96 * area < grown.area.sum() < area
    # Beyond 90 degrees the ends belong to it, below the turn of the chords nothing does.
    assert facets(body.surface(band, angle=100)) == facets(body.surface(everywhere))
    assert facets(body.surface(band, angle=1)) < wanted


def test_ends_face_along_the_axis(cylinder):
    body = body_of("continuum", cylinder.mesh)
    for name, axis in (("low", (0, 0, -2)), ("high", (0, 0, 5.0))):
        wanted = facets(body.surface(*cylinder.where(name)))
        assert facets(body.surface(everywhere, normal=axis, angle=30)) == wanted
    tag = cylinder.where("mantle")
    half = body.surface(*tag, normal=(1, 0, 0), angle=90)
    middle = half.reference[half.facets].mean(axis=1)
    # Normals of chords point as their middles do, but for their size.
    assert (middle[:, 0] > -0.3).all() and 0.4 < half.area.sum() / body.surface(*tag).area.sum()


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_faces_of_a_box(cell, size):
    turn = rotation(0.6, (0.3, -0.5, 0.2))
    mesh = box(high=(size, size, size), cells=3, cell=CELLS[cell])
    body = body_of("continuum", mesh)
    sides = [facets(body.surface(at(a, v, size))) for a in range(3) for v in (0.0, size)]
    mesh = box(high=(size, size, size), cells=3, cell=CELLS[cell])
    mesh.geometry.x[:] = mesh.geometry.x @ turn.T
    body = body_of("continuum", mesh)
    for axis in range(3):
        for k, sign in enumerate((-1.0, 1.0)):
            toward = sign * turn[:, axis]
            wanted = sides[2 * axis + k]
            assert facets(body.surface(everywhere, normal=toward, angle=1e-3)) == wanted
            # Those beside it are 90 degrees off: within that, but not nearer.
            assert facets(body.surface(everywhere, normal=toward, angle=89.9)) == wanted
            assert len(facets(body.surface(everywhere, normal=toward, angle=90))) == 5 * len(wanted)
    corner = lambda x: (turn.T @ x)[1] < 0.34 * size  # noqa: E731
    some = facets(body.surface(corner))
    # What the marker holds of five sides goes on to the edges, whatever way the box is turned.
    grown = facets(body.surface(corner, angle=90))
    assert some < grown == set().union(*(side for side in sides if side & some))
    assert facets(body.surface(corner, angle=91)) == set().union(*sides)


@pytest.mark.parametrize("kind", ["continuum", "rigid"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"normal": (0, 0, 1)}, r"normal=\(0, 0, 1\): pass angle="),
        ({"normal": (0, 0, 0), "angle": 1}, r"normal=\(0, 0, 0\): pass a vector"),
        ({"normal": (0, 1), "angle": 1}, r"normal=\(0, 1\): pass three finite"),
        ({"angle": 0.0}, r"angle=0.0: pass an angle above 0"),
        ({"angle": 181}, r"angle=181: pass an angle above 0"),
        ({"angle": "wide"}, r"angle='wide': pass an angle above 0"),
        ({"normal": (1, 1, 0), "angle": 5}, r"angle=5: no facet .* 45 degrees off"),
        ({"angle": 5 + COMM.rank}, "angle" if COMM.size > 1 else None),
        ({"normal": (0, 1 + COMM.rank, 0), "angle": 5}, "normal" if COMM.size > 1 else None),
    ],
)
def test_bad_input_is_named_on_every_rank(kind, options, message):
    body = body_of(kind, box(cells=1))
    if message is None:
        body.surface(everywhere, **options)
        return
    with pytest.raises(ValueError, match=message):
        body.surface(everywhere, **options)
