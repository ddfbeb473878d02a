"""Meshes whose cells are there several times, as where each rank gives the whole of one."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import mesh as dolfinx_mesh

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.meshes.mesh_check import refuse_repeated

COMM = MPI.COMM_WORLD
SEVERAL = pytest.mark.skipif(COMM.size == 1, reason="needs several ranks")
PLACES = np.array([[x, y, z] for x in (0, 1, 2) for y in (0, 1) for z in (0, 1)], dtype=float)
CELLS = {
    "interval": np.array([[0, 4], [4, 8]]),
    "quadrilateral": np.array([[0, 2, 4, 6], [4, 6, 8, 10]]),
    "hexahedron": np.array([[0, 1, 2, 3, 4, 5, 6, 7], [4, 5, 6, 7, 8, 9, 10, 11]]),
}


def mesh(kind, cells, x):
    """Of cells and points that rank 0 gives."""
    root = COMM.rank == 0
    return compat.create_mesh(COMM, cells if root else cells[:0], x if root else x[:0], kind)


def bodies(of):
    """A body of each kind that takes such a mesh."""
    kind = compat.cell_name(of)
    if kind == "interval":
        section = nts.Circle(0.1).section(young=1e6, poisson=0.3, density=1e3)
        yield lambda: nts.Beam(of, section, name="body")
    elif kind == "quadrilateral":
        given = {"young": 1e6, "poisson": 0.3, "thickness": 0.1, "density": 1e3}
        yield lambda: nts.Shell(of, name="body", **given)
    else:
        law = nts.NeoHookean(1e6, 0.3)
        yield lambda: nts.Continuum(of, law, density=1e3, name="body")
        yield lambda: nts.RigidBody(of, density=1e3, name="body")


@SEVERAL
@pytest.mark.mpi
@pytest.mark.parametrize("kind", CELLS)
@pytest.mark.parametrize("copied", [False, True])
def test_a_whole_mesh_on_every_rank_is_refused(kind, copied):
    """Whether cells name the points of rank 0, or those of their own rank."""
    cells = CELLS[kind] + copied * COMM.rank * len(PLACES)
    text = rf"^cells: ranks 0 and 1 give the same 2 cells; .*np\.empty\(\(0, {cells.shape[1]}\)\)"
    with pytest.raises(ValueError, match=text):
        compat.create_mesh(COMM, cells, PLACES, kind)


@SEVERAL
@pytest.mark.mpi
@pytest.mark.parametrize("kind", CELLS)
def test_a_whole_mesh_on_every_rank_is_refused_in_a_mesh_of_dolfinx(kind, monkeypatch):
    """DOLFINx's own create_mesh takes it, with copies of all points, and twice the mass."""
    monkeypatch.setattr(compat, "_refuse_whole", lambda *_: None)
    copied = CELLS[kind] + COMM.rank * len(PLACES)
    for make in bodies(compat.create_mesh(COMM, copied, PLACES, kind)):
        with pytest.raises(ValueError, match=f"^mesh of 'body': 2 cells are there {COMM.size}"):
            make()


@pytest.mark.mpi
@pytest.mark.parametrize("kind", CELLS)
def test_each_cell_given_once_is_no_matter(kind):
    for make in bodies(mesh(kind, CELLS[kind], PLACES)):
        make().destroy()


@pytest.mark.mpi
def test_cells_at_the_same_places_are_refused():
    """A copy of a cube's cells with nodes of its own: twice the mass, and no word."""
    cells = np.concatenate([CELLS["hexahedron"], CELLS["hexahedron"] + len(PLACES)])
    twice = mesh("hexahedron", cells, np.concatenate([PLACES, PLACES]))
    text = r"^mesh of 'body': 2 cells are there 2 times, e\.g\. the one at x=\[.*; give each cell"
    for make in bodies(twice):
        with pytest.raises(ValueError, match=text):
            make()
    with pytest.raises(ValueError, match="^mesh: 2 cells are there 2 times"):
        nts.linear(twice)


@pytest.mark.mpi
def test_cells_of_a_lattice_are_not_taken_for_each_other():
    """Gmsh's are equilateral: x + sqrt(3) z is the same at many nodes."""
    box = dolfinx_mesh.create_box(
        COMM, [np.zeros(3), np.array([8.0, 8.0, 8.0 / np.sqrt(3.0)])], [8] * 3,
        dolfinx_mesh.CellType.tetrahedron,
    )  # fmt: skip
    refuse_repeated(box, "mesh")


@pytest.mark.mpi
@pytest.mark.parametrize("pieces", [1, 2, 3])
def test_a_mesh_in_pieces_is_told(pieces):
    """Boxes that touch, as of Gmsh without a fragment, share no node."""
    box = CELLS["hexahedron"]
    cells = np.concatenate([box + k * len(PLACES) for k in range(pieces)])
    x = np.concatenate([PLACES + [2.0 * k, 0, 0] for k in range(pieces)])
    body = nts.Continuum(
        mesh("hexahedron", cells, x), nts.NeoHookean(1e6, 0.3), density=1e3, name="body"
    )
    assert body.pieces == pieces
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=1e-3, t_end=2e-3)
    assert run.status == "completed"
    assert list(run.warnings) == (["pieces"] if pieces > 1 else [])
    if pieces > 1:
        assert f"'body' falls into {pieces} pieces" in run.warnings["pieces"].text
