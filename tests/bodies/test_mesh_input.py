"""One mesh per body: from Gmsh files and models, and from tagged DOLFINx meshes."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import mesh as dolfinx_mesh
from scenes import RUBBER

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.meshes.mesh_input import bodies_from_gmsh, bodies_from_tags

COMM = MPI.COMM_WORLD
#: Young's moduli and a traction [Pa].
SOFT, HARD, PULL = 1e6, 4e6, 10.0


def test_a_dolfinx_without_cell_partitioners_is_told_which_ghosts(monkeypatch):
    """That of the main branch after 0.11; no release is there yet to run."""
    monkeypatch.delattr(dolfinx_mesh, "create_cell_partitioner")
    shared = dolfinx_mesh.GhostMode.shared_facet
    assert compat._ghosts() == {"ghost_mode": shared}


def line_of_blocks(gmsh, kind="hexahedron"):
    """Blocks x in [0, 1] and [1, 2] with a common interface; tags 7, 9; 4, 3, 5 at x = 0, 1, 2."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 0)
    gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    gmsh.model.add("blocks")
    occ, mesh = gmsh.model.occ, gmsh.model.mesh
    boxes = [(3, occ.addBox(x, 0, 0, 1, 1, 1)) for x in (0, 1)]
    occ.fragment(boxes[:1], boxes[1:])
    occ.synchronize()
    for _, tag in gmsh.model.getEntities(1):
        mesh.setTransfiniteCurve(tag, 3)
    for dim, tag in gmsh.model.getEntities(2):
        mesh.setTransfiniteSurface(tag)
        if kind == "hexahedron":
            mesh.setRecombine(dim, tag)
        x = gmsh.model.occ.getCenterOfMass(dim, tag)[0]
        if x in (0, 1, 2):
            name, group = {0: ("start", 4), 1: ("interface", 3), 2: ("", 5)}[int(x)]
            gmsh.model.addPhysicalGroup(2, [tag], group)
            gmsh.model.setPhysicalName(2, group, name)
    for dim, tag in gmsh.model.getEntities(3):
        mesh.setTransfiniteVolume(tag)
        group = 7 if gmsh.model.occ.getCenterOfMass(dim, tag)[0] < 1 else 9
        gmsh.model.addPhysicalGroup(3, [tag], group)
        if group == 7:
            gmsh.model.setPhysicalName(3, group, "left")
    mesh.generate(3)
    return gmsh.model


@pytest.fixture
def blocks():
    """A live model on rank 0, None elsewhere."""
    if COMM.rank > 0:
        yield None
        return
    gmsh = pytest.importorskip("gmsh")
    yield line_of_blocks(gmsh)
    gmsh.finalize()


def identities(part):
    """Input number -> position of all nodes, gathered from the cells of all ranks."""
    x = part.mesh.geometry.x
    pairs = COMM.allgather((np.asarray(part.mesh.geometry.input_global_indices), x))
    return {int(i): tuple(p) for ids, x in pairs for i, p in zip(ids, x, strict=True)}


def check_two_blocks(parts, left, right, cells, facets):
    assert list(parts) == [left, right]
    for name, ends in ((left, (0, 1)), (right, (1, 2))):
        part = parts[name]
        assert part.name == name
        owned = part.mesh.topology.index_map(3).size_local
        assert COMM.allreduce(owned) == cells
        nodes = identities(part)
        assert sorted(nodes) == list(range(27))
        assert {p[0] for p in nodes.values()} == {ends[0], sum(ends) / 2, ends[1]}
        body = nts.Continuum(part.mesh, RUBBER, density=1.0, degree=1, name=name)
        assert COMM.allreduce(body.nodal_mass.sum()) == pytest.approx(3.0, rel=1e-14)
        for x, tag in ((0, 4), (1, 3), (2, 5)):
            if x in ends:
                surface = body.surface(*part.where(tag))
                assert len(surface.facets) == facets and (surface.reference[:, 0] == x).all()
                assert surface.area.sum() == pytest.approx(1.0, rel=1e-14)
            else:
                with pytest.raises(ValueError, match="selects no exterior facet"):
                    body.surface(*part.where(tag))


@pytest.mark.mpi
def test_touching_blocks_of_a_model(blocks):
    parts = bodies_from_gmsh(blocks, COMM)
    check_two_blocks(parts, "left", "volume_9", 8, 4)
    assert parts["left"].surfaces == {"start": 4, "interface": 3}
    assert parts["volume_9"].surfaces == {"interface": 3}
    assert parts["left"].where("start")[1] == 4


@pytest.mark.mpi
@pytest.mark.parametrize("version", [2.2, 4.1])
def test_touching_blocks_of_a_file(blocks, mpi_tmp_path, version):
    path = mpi_tmp_path / "blocks.msh"
    if blocks is not None:
        import gmsh

        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.write(str(path))
    parts = bodies_from_gmsh(path, COMM)
    check_two_blocks(parts, "left", "volume_9", 8, 4)
    if blocks is not None:
        assert gmsh.model.getCurrent() == "blocks" and "dolfinx_nts input" not in gmsh.model.list()
        assert gmsh.option.getNumber("General.Verbosity") == 0


@pytest.mark.mpi
def test_tetrahedra_of_a_model():
    model = line_of_blocks(pytest.importorskip("gmsh"), "tetrahedron") if COMM.rank == 0 else None
    parts = bodies_from_gmsh(model, COMM)
    cells = parts["left"].mesh.topology.index_map(3).size_local
    check_two_blocks(parts, "left", "volume_9", COMM.allreduce(cells), 8)
    if COMM.rank == 0:
        import gmsh

        gmsh.finalize()


def tagged_bar(kind="hexahedron", comm=COMM):
    """A bar x in [0, 2] with cell tags 7 and 9 and facet tags 4, 3 (between them) and 5."""
    cell = getattr(dolfinx_mesh.CellType, kind)
    mode = dolfinx_mesh.GhostMode.shared_facet
    mesh = dolfinx_mesh.create_box(comm, [[0, 0, 0], [2, 1, 1]], [4, 2, 2], cell, ghost_mode=mode)
    cell_map = mesh.topology.index_map(3)
    cells = np.arange(cell_map.size_local + cell_map.num_ghosts, dtype=np.int32)
    x = mesh.geometry.x[compat.geometry_dofmap(mesh)].mean(axis=1)[:, 0]
    cell_tags = dolfinx_mesh.meshtags(mesh, 3, cells, np.where(x < 1, 7, 9).astype(np.int32))
    found = [
        dolfinx_mesh.locate_entities(mesh, 2, lambda x, at=at: np.isclose(x[0], at))
        for at in range(3)
    ]
    values = np.repeat(np.array([4, 3, 5], np.int32), [len(f) for f in found])
    facets = np.concatenate(found)
    order = np.argsort(facets)
    return mesh, cell_tags, dolfinx_mesh.meshtags(mesh, 2, facets[order], values[order])


@pytest.mark.mpi
@pytest.mark.parametrize("kind, cells, facets", [("hexahedron", 8, 4), ("tetrahedron", 48, 8)])
def test_touching_blocks_of_tags(kind, cells, facets):
    parts = bodies_from_tags(*tagged_bar(kind))
    check_two_blocks(parts, "volume_7", "volume_9", cells, facets)
    parts = bodies_from_tags(*tagged_bar(kind), names={"b": 9, "a": 7}, surfaces={"middle": 3})
    assert list(parts) == ["b", "a"]
    assert parts["a"].where("middle")[1] == 3


@pytest.mark.mpi
def test_a_volume_may_be_rigid():
    """One volume of a mesh flexible, the other rigid, in contact at their interface."""
    mesh, cell_tags, facet_tags = tagged_bar()
    parts = bodies_from_tags(
        mesh, cell_tags, facet_tags, names={"soft": 7, "hard": 9}, surfaces={"middle": 3}
    )
    hard = parts["hard"].rigid(density=2e3, velocity=(-1, 0, 0))
    soft = parts["soft"].continuum(nts.NeoHookean(1e6, 0.3), density=1e3)
    pair = nts.ContactPair(
        slave=hard.surface(*parts["hard"].where("middle")),
        master=soft.surface(*parts["soft"].where("middle")),
    )
    run = nts.simulate(
        nts.System([soft, hard], contacts=[pair]), nts.EnergyMomentum(), dt=1e-3, t_end=5e-3
    )
    assert hard.name == "hard" and hard.mass == pytest.approx(2e3)
    assert hard.centre == pytest.approx([1.5, 0.5, 0.5])
    assert run.balance["active"].max() > 0
    assert np.ptp(run.balance["linear_momentum"], axis=0).max() < 1e-12 * 2e3


@pytest.mark.mpi
def test_bodies_of_a_submesh_without_facet_tags():
    """Its cells may leave ranks empty, and 0.5.2 does not number them."""
    mesh, cell_tags, _ = tagged_bar()
    sub, parents, _ = compat.create_submesh(mesh, 3, cell_tags.find(9))
    value = np.full(len(parents), 2, np.int32)
    tags = dolfinx_mesh.meshtags(sub, 3, np.arange(len(parents), dtype=np.int32), value)
    parts = bodies_from_tags(sub, tags, names={"only": 2})
    body = parts["only"].continuum(RUBBER, density=1.0)
    assert COMM.allreduce(body.nodal_mass.sum()) == pytest.approx(3.0, rel=1e-14)
    assert COMM.allreduce(len(parts["only"].facet_tags.indices)) == 0


@pytest.mark.mpi
def test_surface_ids_do_not_depend_on_ranks(blocks):
    """The reference is the same input on this rank alone."""
    everywhere = bodies_from_gmsh(blocks, COMM)
    reference = None
    if COMM.rank == 0:
        alone = bodies_from_gmsh(blocks, MPI.COMM_SELF)
        reference = {name: table(alone[name]) for name in alone}
    reference = COMM.bcast(reference)
    for name, part in everywhere.items():
        for mine, theirs in zip(table(part), reference[name], strict=True):
            assert np.array_equal(mine, theirs)


def table(part):
    """Facets of the interface by input node numbers, and the corners' positions."""
    body = nts.Continuum(part.mesh, RUBBER, density=1.0)
    surface = body.surface(*part.where("interface"))
    return surface.original[surface.facets], surface.reference[surface.facets]


# ---- what is wrong is said on every rank
@pytest.mark.mpi
def test_wrong_files_are_named(mpi_tmp_path):
    if COMM.rank == 0:
        pytest.importorskip("gmsh")
    with pytest.raises(ValueError, match="nowhere.msh'?: no such file"):
        bodies_from_gmsh("nowhere.msh", COMM)
    with pytest.raises(ValueError, match="file_or_model=3: pass a path or gmsh.model"):
        bodies_from_gmsh(3, COMM)
    empty = mpi_tmp_path / "empty.msh"
    if COMM.rank == 0:
        empty.write_text("")
    with pytest.raises(ValueError, match="empty.msh.*cannot read|no physical volume in .*empty"):
        bodies_from_gmsh(empty, COMM)


@pytest.mark.mpi
def test_volumes_of_one_name_are_named(blocks, mpi_tmp_path):
    path = mpi_tmp_path / "twice.msh"
    if blocks is not None:
        import gmsh

        blocks.setPhysicalName(3, 9, "right")
        gmsh.write(str(path))
        path.write_text(path.read_text().replace('"right"', '"left"'))
    with pytest.raises(ValueError, match=r"\['left', 'left'\] of .*twice.msh share a name"):
        bodies_from_gmsh(path, COMM)


def spoil(blocks, how):
    """Make a model wrong; on rank 0."""
    if blocks is None:
        return
    if how == "unmeshed":
        blocks.mesh.clear()
    elif how == "overlapping volumes":
        blocks.addPhysicalGroup(3, [1], 20)
    elif how == "overlapping surfaces":
        blocks.addPhysicalGroup(2, blocks.getEntitiesForPhysicalGroup(2, 3), 20)
    elif how == "degree":
        blocks.mesh.setOrder(3)
    else:
        blocks.removePhysicalGroups([(3, 7), (3, 9)])


@pytest.mark.mpi
@pytest.mark.parametrize(
    "how, message",
    [
        ("unmeshed", "physical volume 'left' has no mesh; call gmsh.model.mesh.generate"),
        ("overlapping volumes", "overlap; a cell has one body"),
        ("overlapping surfaces", "physical surfaces 'interface' and 20 overlap"),
        ("degree", "'left' holds 'Hexahedron 64'.*of degree 1 or 2.*setOrder"),
        ("no volumes", "no physical volume in this model.*addPhysicalGroup"),
    ],
)
def test_wrong_models_are_named(blocks, how, message):
    spoil(blocks, how)
    with pytest.raises(ValueError, match=message):
        bodies_from_gmsh(blocks, COMM)


@pytest.mark.mpi
def test_wrong_tags_and_names_are_named():
    mesh, cell_tags, facet_tags = tagged_bar()
    with pytest.raises(ValueError, match="cell_tags=.*dimension 3"):
        bodies_from_tags(mesh, facet_tags)
    with pytest.raises(ValueError, match="cell_tags=None.*dimension 3"):
        bodies_from_tags(mesh, None)
    with pytest.raises(ValueError, match="facet_tags=.*dimension 2"):
        bodies_from_tags(mesh, cell_tags, cell_tags)
    with pytest.raises(ValueError, match=r"names\['a'\]=8: no such tag; the mesh has 7, 9"):
        bodies_from_tags(mesh, cell_tags, names={"a": 8})
    with pytest.raises(ValueError, match=r"surfaces\['s'\]=1: no such tag; the mesh has 3, 4, 5"):
        bodies_from_tags(mesh, cell_tags, facet_tags, surfaces={"s": 1})
    none = dolfinx_mesh.meshtags(mesh, 3, np.empty(0, np.int32), np.empty(0, np.int32))
    with pytest.raises(ValueError, match="no cell has a tag"):
        bodies_from_tags(mesh, none)
    square = dolfinx_mesh.create_unit_square(COMM, 2, 2)
    with pytest.raises(ValueError, match="triangle in 2D"):
        bodies_from_tags(square, cell_tags)
    parts = bodies_from_tags(mesh, cell_tags, facet_tags, surfaces={"start": 4})
    with pytest.raises(ValueError, match="surface='end': body 'volume_7' has 'start'"):
        parts["volume_7"].where("end")
    nameless = bodies_from_tags(mesh, cell_tags)["volume_7"]
    with pytest.raises(ValueError, match="no surface of 'volume_7' has a name; add physical group"):
        nameless.where("end")
    with pytest.raises(KeyError, match="no body 'volume_8' in this mesh; it has 'volume_7'"):
        parts["volume_8"]


# ---- bodies of several volumes
def check_bar(part, soft, hard):
    """A bar of two halves of other moduli and densities, pulled at its end: springs in series."""
    young = part.by_region({soft: SOFT, hard: HARD})
    density = part.by_region({soft: 1e3, hard: 3e3})
    body = part.continuum(
        nts.StVenantKirchhoff(young, 0.0), density=density, degree=1,
        bcs=[nts.Dirichlet(lambda x: x[0] < 1e-9)],
        traction=[nts.Traction(lambda x: x[0] > 2 - 1e-9, (PULL, 0, 0))],
    )  # fmt: skip
    motion = nts.motion_of(body)
    np.testing.assert_allclose(motion.mass, 4e3, rtol=1e-13)
    np.testing.assert_allclose(motion.centre[0], (0.5 * 1e3 + 1.5 * 3e3) / 4e3, rtol=1e-13)
    nts.equilibrium(nts.System([body]))
    x = body.reference.reshape(-1, 3)
    u = body.u.x.array[: body.num_owned].reshape(-1, 3)[:, 0]
    for place, expected in ((1.0, PULL / SOFT), (2.0, PULL / SOFT + PULL / HARD)):
        there = np.isclose(x[:, 0], place)
        np.testing.assert_allclose(u[there], expected, rtol=1e-4)
    return body


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron"])
@pytest.mark.fast("tetrahedron")
def test_tags_in_one_body(kind):
    parts = nts.bodies_from_tags(*tagged_bar(kind), names={"bar": (7, 9)}, surfaces={"end": 5})
    (part,) = parts.values()
    assert part.name == "bar" and not part.regions
    check_bar(part, 7, 9)
    surface = nts.Continuum(part.mesh, nts.NeoHookean(SOFT, 0.3), density=1.0, degree=1).surface(
        *part.where("end")
    )
    assert surface.area.sum() == pytest.approx(1.0, rel=1e-14)


@pytest.mark.mpi
def test_volumes_of_gmsh_in_one_body(blocks):
    parts = nts.bodies_from_gmsh(blocks, COMM, bodies={"bar": ("left", "volume_9")})
    (part,) = parts.values()
    nodes = part.mesh.geometry.index_map().size_global
    assert part.name == "bar" and nodes == 45  # 5 x 3 x 3, those between them once
    assert set(part.regions) == {"left", "volume_9"}
    assert part.surfaces == {"start": 4, "interface": 3}
    check_bar(part, "left", 9)


@pytest.mark.mpi
def test_one_body_beside_another(blocks):
    parts = nts.bodies_from_gmsh(blocks, COMM, bodies={"base": ["left"]})
    assert list(parts) == ["base", "volume_9"]
    assert set(COMM.allreduce(set(parts["base"].cell_tags.values), lambda a, b: a | b)) == {
        parts["base"].regions["left"]
    }


@pytest.mark.mpi
def test_wrong_regions_are_named(blocks):
    part = nts.bodies_from_tags(*tagged_bar(), names={"bar": [7, 9]})["bar"]
    for values in ({7: 1.0}, {7: 1.0, 9: 2.0, 8: 3.0}, {"left": 1.0}):
        with pytest.raises(ValueError, match="body 'bar' is made of 7, 9; pass a value for each"):
            part.by_region(values)
    with pytest.raises(ValueError, match=r"names\['bar'\]=\(7, 8\): no such tag; .* has 7, 9"):
        nts.bodies_from_tags(*tagged_bar(), names={"bar": (7, 8)})
    with pytest.raises(ValueError, match=r"bodies\['a'\]=\['x'\]: 'x' is no volume that is left"):
        nts.bodies_from_gmsh(blocks, COMM, bodies={"a": ["x"]})
    with pytest.raises(ValueError, match=r"'left' is no volume that is left; there are 'volume_9'"):
        nts.bodies_from_gmsh(blocks, COMM, bodies={"a": ["left"], "b": ["left"]})
    with pytest.raises(ValueError, match=r"bodies\['volume_9'\]: there is a volume of this name"):
        nts.bodies_from_gmsh(blocks, COMM, bodies={"volume_9": ["left"]})
    with pytest.raises(TypeError, match=r"bodies=\{'a': 'left'\}: pass a dict of names of bodies"):
        nts.bodies_from_gmsh(blocks, COMM, bodies={"a": "left"})
