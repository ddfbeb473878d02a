"""One mesh per body from input that holds several: Gmsh files and models, tagged DOLFINx meshes.

Every body gets a mesh of its own, built anew from the cells of its volume:

- bodies that touch share no node, so contact can open between them;
- each body is spread over all ranks, while a DOLFINx submesh stays where its parent's cells are and
  may leave ranks empty;
- nodes are numbered by their order in the input, so `mesh.geometry.input_global_indices`, and with
  it every contact surface, does not depend on the number of ranks.

The input passes through rank 0. Gmsh is imported when a Gmsh input is read, on rank 0 alone.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from dolfinx import mesh as dolfinx_mesh
from mpi4py import MPI

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.continuum import Continuum
from dolfinx_nts.bodies.rigid import RigidBody
from dolfinx_nts.parallel import on_root
from dolfinx_nts.validation import is_whole

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
T = TypeVar("T")

#: Gmsh element type -> cell name, DOLFINx vertex k = Gmsh vertex order[k].
_GMSH_CELLS = {4: ("tetrahedron", [0, 1, 2, 3]), 5: ("hexahedron", [0, 1, 3, 2, 4, 5, 7, 6])}
#: Gmsh element types of facets -> their corners.
_GMSH_FACETS = {2: 3, 3: 4}
_CORNERS = {"tetrahedron": 4, "hexahedron": 8}


@dataclass(frozen=True, eq=False)
class Part:
    """The mesh of one body, with the tags of its facets.

    Attributes:
        name: Name of the volume.
        mesh: dolfinx mesh of degree 1.
        facet_tags: dolfinx meshtags of its tagged facets, interior ones included.
        surfaces: Name of a surface -> its tag, for the named surfaces of the input that this body
            has facets of.
    """

    name: str
    mesh: Any
    facet_tags: Any
    surfaces: Mapping[str, int]

    def where(self, surface: str | int) -> tuple[Any, int]:
        """A tagged surface, as `Dirichlet`, `Traction` and (with *) `Continuum.surface` take it.

        Args:
            surface: Name or tag.

        Returns:
            The facet tags and the tag.

        Raises:
            ValueError: The body has no such surface.
        """
        tag = self.surfaces.get(surface) if isinstance(surface, str) else surface
        # A rank need not hold facets of a tag, so a number that no rank knows is left to the user
        # of the tags, who asks all ranks.
        if not is_whole(tag):
            raise ValueError(
                f"surface={surface!r}: body {self.name!r} has {_listed(self.surfaces)}; "
                "pass one of these names, or a tag"
            )
        return self.facet_tags, int(tag)

    def continuum(
        self, material: Callable[[Any], Any], *, density: float, **options: Any
    ) -> Continuum:
        """The flexible body on this mesh, under this name.

        Args:
            material: Strain energy W(C) [J/m^3].
            density: Reference density [kg/m^3].
            **options: Further arguments of `Continuum`.
        """
        return Continuum(self.mesh, material, density=density, **{"name": self.name, **options})

    def rigid(self, *, density: float, **options: Any) -> RigidBody:
        """The rigid body on this mesh, under this name.

        Args:
            density: [kg/m^3].
            **options: Further arguments of `RigidBody`.
        """
        return RigidBody(self.mesh, density=density, **{"name": self.name, **options})


class Parts(dict[str, Part]):
    """Name of a volume -> its part; an unknown name is answered with the known ones."""

    def __missing__(self, name: str) -> Part:
        raise KeyError(f"no body {name!r} in this mesh; it has {_listed(self)}")


class _Volume(NamedTuple):
    """One body of the input.

    Attributes:
        name: Its name.
        kind: DOLFINx cell name.
        cells: Input node numbers in DOLFINx order, shape (m, corners).
        facets: Tagged facets by input node numbers, any order, shape (k, facet corners).
        tags: Tags of the facets, shape (k,).
    """

    name: str
    kind: str
    cells: IntArray
    facets: IntArray
    tags: IntArray


class _Input(NamedTuple):
    """All bodies of an input.

    Attributes:
        nodes: Input numbers of the nodes, ascending, shape (n,).
        x: Their positions [m], shape (n, 3).
        volumes: The bodies.
        surfaces: Name of a surface -> tag.
    """

    nodes: IntArray
    x: FloatArray
    volumes: list[_Volume]
    surfaces: dict[str, int]


def bodies_from_gmsh(file_or_model: Any, comm: Any) -> Parts:
    """One mesh per physical volume of a Gmsh file or model.

    Physical surfaces become facet tags of every body that has facets of them, so an interface of
    two volumes is a surface of both.

    Args:
        file_or_model: Path of a .msh file (or of anything with a mesh that Gmsh opens), or a live
            `gmsh.model` with a mesh. Only rank 0's value is looked at; others may pass None.
        comm: MPI communicator of the bodies; every rank must call this.

    Returns:
        Physical name of a volume ("volume_<tag>" if it has none) -> Part.

    Raises:
        ImportError: There is no Gmsh on rank 0.
        TypeError: `comm` is no communicator.
        ValueError: No such file or no physical volume; a volume is not all hexahedra or all
            tetrahedra of degree 1, or has no mesh; physical groups overlap. Raised on every rank.
    """
    if not isinstance(comm, MPI.Comm):
        raise TypeError(f"comm={comm!r}: pass an MPI communicator, e.g. MPI.COMM_WORLD")
    return _parts(comm, on_root(comm, lambda: _read_gmsh(file_or_model)))


def bodies_from_tags(
    mesh: Any,
    cell_tags: Any,
    facet_tags: Any = None,
    *,
    names: Mapping[str, int] | None = None,
    surfaces: Mapping[str, int] | None = None,
) -> Parts:
    """One mesh per cell tag of a DOLFINx mesh.

    Args:
        mesh: 3D hexahedral or tetrahedral mesh of degree 1.
        cell_tags: dolfinx meshtags; each value is a body, cells without one belong to none.
        facet_tags: dolfinx meshtags of facets; a facet between two bodies becomes one of each.
        names: Name of a body -> its cell tag; only these are made. By default every tag is, under
            the name "volume_<tag>".
        surfaces: Name of a surface -> its facet tag, for `Part.where`.

    Returns:
        Name -> Part.

    Raises:
        TypeError: An argument is of another type.
        ValueError: The mesh or the tags are of the wrong kind, or a name stands for a tag that no
            cell or facet has. Raised on every rank.
    """
    if not isinstance(mesh, dolfinx_mesh.Mesh):
        raise TypeError(f"mesh={mesh!r}: pass a dolfinx mesh")
    for what, mapping in (("names", names), ("surfaces", surfaces)):
        if not isinstance(mapping, Mapping | None):
            raise TypeError(
                f"{what}={mapping!r}: pass a dict of names and tags, e.g. {{'base': 1}}"
            )
    kind = compat.cell_name(mesh)
    if kind not in _CORNERS or mesh.geometry.dim != 3:
        raise ValueError(
            f"mesh: {kind} in {mesh.geometry.dim}D; pass a 3D mesh of hexahedra or tetrahedra"
        )
    for what, tags, dim in (("cell_tags", cell_tags, 3), ("facet_tags", facet_tags, 2)):
        if getattr(tags, "dim", None) != dim and not (tags is None and dim == 2):
            raise ValueError(f"{what}={tags!r}: pass meshtags of dimension {dim}")
    local = (*_tagged_cells(mesh, cell_tags), *_tagged_facets(mesh, facet_tags))
    gathered = mesh.comm.gather(local)
    bodies, named = dict(names or {}), dict(surfaces or {})
    return _parts(mesh.comm, on_root(mesh.comm, lambda: _merge(kind, gathered, bodies, named)))


def _parts(comm: Any, data: _Input | None) -> Parts:
    """Distribute the bodies that rank 0 holds."""
    names = comm.bcast(None if data is None else [v.name for v in data.volumes])
    surfaces = comm.bcast(None if data is None else data.surfaces)
    parts = Parts()
    for k, name in enumerate(names):
        parts[name] = _part(comm, name, None if data is None else _body(data, k), surfaces)
    return parts


def _body(data: _Input, index: int) -> tuple[str, IntArray, FloatArray, IntArray, IntArray]:
    """Cell name, cells, positions, facets and tags of a body in its own node numbers."""
    volume = data.volumes[index]
    nodes = np.unique(volume.cells)
    facets = volume.facets
    inside = np.isin(facets, nodes).all(axis=1)
    return (
        volume.kind,
        np.searchsorted(nodes, volume.cells),
        data.x[np.searchsorted(data.nodes, nodes)],
        np.sort(np.searchsorted(nodes, facets[inside]), axis=1),
        volume.tags[inside],
    )


def _part(comm: Any, name: str, body: Any, surfaces: Mapping[str, int]) -> Part:
    """Mesh and facet tags of one body whose arrays rank 0 holds."""
    kind, facets, tags = comm.bcast(None if body is None else (body[0], *body[3:]))
    if body is None:
        cells, x = np.empty((0, _CORNERS[kind]), np.int64), np.empty((0, 3))
    else:
        cells, x = body[1:3]
    mesh = compat.create_mesh(comm, cells, x, kind)
    mesh.topology.create_entities(2)
    mesh.topology.create_connectivity(2, 3)
    found, values = _find_facets(mesh, facets, tags)
    known = set(comm.allreduce(np.unique(values).tolist()))
    here = {surface: tag for surface, tag in surfaces.items() if tag in known}
    return Part(name, mesh, dolfinx_mesh.meshtags(mesh, 2, found, values), here)


def _find_facets(mesh: Any, facets: IntArray, tags: IntArray) -> tuple[IntArray, IntArray]:
    """This rank's facets with the given nodes, ascending, and their tags.

    Args:
        mesh: dolfinx mesh with facets.
        facets: Input node numbers, ascending in each row, shape (k, facet corners).
        tags: Shape (k,).
    """
    facet_map = mesh.topology.index_map(2)
    every = np.arange(facet_map.size_local + facet_map.num_ghosts, dtype=np.int32)
    nodes = compat.entities_to_geometry(mesh, 2, every)
    here = np.sort(np.asarray(mesh.geometry.input_global_indices)[nodes], axis=1)
    if not len(facets) or not len(here):
        return np.empty(0, np.int32), np.empty(0, np.int32)
    _, number = np.unique(np.concatenate([facets, here]), axis=0, return_inverse=True)
    number = number.ravel()
    value = np.zeros(number.max() + 1, np.int32)
    is_tagged = np.zeros(len(value), bool)
    value[number[: len(facets)]], is_tagged[number[: len(facets)]] = tags, True
    mine = number[len(facets) :]
    chosen = is_tagged[mine]
    return every[chosen], value[mine[chosen]]


# ---- DOLFINx meshes
def _tagged_cells(mesh: Any, cell_tags: Any) -> tuple[IntArray, IntArray, FloatArray]:
    """This rank's owned tagged cells: tags, nodes (m, corners), positions (m, corners, 3)."""
    owned = cell_tags.indices < mesh.topology.index_map(3).size_local
    index = cell_tags.indices[owned]
    table = compat.geometry_dofmap(mesh)
    nodes = table[index] if len(index) else np.empty((0, table.shape[1]), np.int32)
    ids = np.asarray(mesh.geometry.input_global_indices)
    return cell_tags.values[owned], ids[nodes], mesh.geometry.x[nodes]


def _tagged_facets(mesh: Any, facet_tags: Any) -> tuple[IntArray, IntArray]:
    """This rank's tagged facets: tags and nodes."""
    index = np.empty(0, np.int32) if facet_tags is None else facet_tags.indices
    nodes = compat.entities_to_geometry(mesh, 2, index)
    values = np.empty(0, np.int32) if facet_tags is None else facet_tags.values
    return values, np.asarray(mesh.geometry.input_global_indices)[nodes]


def _merge(
    kind: str, gathered: list[Any], names: dict[str, int], surfaces: dict[str, int]
) -> _Input:
    """The input from the tagged cells and facets of all ranks; on rank 0."""
    tags, cells, x, values, facets = (_joined(tables) for tables in zip(*gathered, strict=True))
    if not len(tags):
        raise ValueError("cell_tags: no cell has a tag; tag the cells of each body")
    if cells.shape[1] != _CORNERS[kind]:
        raise ValueError("mesh: geometry of degree above 1; pass a mesh of degree 1")
    # An order that does not depend on the ranks; a submesh does not know the original one.
    order = np.lexsort(cells.T)
    tags, cells, x = tags[order], cells[order], x[order]
    names = names or {f"volume_{tag}": int(tag) for tag in np.unique(tags)}
    for what, mapping, known in (("names", names, tags), ("surfaces", surfaces, values)):
        for name, tag in mapping.items():
            if tag not in known:
                present = _listed(np.unique(known).tolist())
                raise ValueError(f"{what}[{name!r}]={tag!r}: no such tag; the mesh has {present}")
    nodes, first = np.unique(cells, return_index=True)
    volumes = [_Volume(n, kind, cells[tags == tag], facets, values) for n, tag in names.items()]
    return _Input(nodes, x.reshape(-1, 3)[first], volumes, surfaces)


def _joined(tables: Iterable[npt.NDArray[Any]]) -> npt.NDArray[Any]:
    """Rows of all ranks; ranks without rows may not know how wide they are."""
    tables = list(tables)
    return np.concatenate([t for t in tables if len(t)] or tables[:1])


# ---- Gmsh
def _read_gmsh(file_or_model: Any) -> _Input:
    """The input from a file or a live model; on rank 0."""
    try:
        gmsh = importlib.import_module("gmsh")
    except ImportError as error:
        raise ImportError(
            f"Gmsh input needs the module gmsh ({error}); on Debian: apt install python3-gmsh"
        ) from None
    if not isinstance(file_or_model, str | os.PathLike):
        if not hasattr(file_or_model, "getPhysicalGroups"):
            raise ValueError(f"file_or_model={file_or_model!r}: pass a path or gmsh.model")
        return _read_model(file_or_model, "this model")
    path = os.fspath(file_or_model)
    if not os.path.isfile(path):
        raise ValueError(f"file_or_model={path!r}: no such file in {os.getcwd()}")
    with _opened(gmsh, path) as model:
        return _read_model(model, path)


@contextmanager
def _opened(gmsh: Any, path: str) -> Iterator[Any]:
    """The model in a file; the caller's own Gmsh session, if there is one, is left as it was."""
    running = _is_running(gmsh)
    if not running:
        gmsh.initialize(readConfigFiles=False)
    current = gmsh.model.getCurrent()
    verbosity = gmsh.option.getNumber("General.Verbosity")
    gmsh.option.setNumber("General.Verbosity", 0)
    gmsh.model.add("dolfinx_nts input")
    try:
        try:
            gmsh.merge(path)
        except Exception as error:
            raise ValueError(f"file_or_model={path!r}: Gmsh cannot read it ({error})") from None
        yield gmsh.model
    finally:
        gmsh.model.remove()
        gmsh.option.setNumber("General.Verbosity", verbosity)
        if running:
            gmsh.model.setCurrent(current)
        elif hasattr(gmsh, "isInitialized"):
            gmsh.finalize()


def _is_running(gmsh: Any) -> bool:
    """Return whether Gmsh is initialised."""
    if hasattr(gmsh, "isInitialized"):
        return bool(gmsh.isInitialized())
    # 4.8 must be probed: an initialised one has a model. A finalised one prints errors when probed,
    # so on 4.8 a session begun here is left open.
    try:
        return bool(gmsh.model.list())
    except Exception:
        return False


def _read_model(model: Any, source: str) -> _Input:
    """Physical volumes and surfaces of a model's mesh."""
    groups = model.getPhysicalGroups(3)
    if not groups:
        raise ValueError(
            f"file_or_model: no physical volume in {source}; make one per body with "
            "gmsh.model.addPhysicalGroup(3, volumes)"
        )
    nodes, x, _ = model.mesh.getNodes()
    nodes, first = np.unique(np.asarray(nodes, np.int64), return_index=True)
    surfaces, facets, tags = _read_surfaces(model)
    volumes = [_read_volume(model, tag, facets, tags) for _, tag in groups]
    names = [v.name for v in volumes]
    if len(set(names)) < len(names):
        raise ValueError(f"file_or_model: the physical volumes {names} of {source} share a name")
    entities = [e for _, tag in groups for e in model.getEntitiesForPhysicalGroup(3, tag)]
    if len(set(entities)) < len(entities):
        raise ValueError(
            f"file_or_model: physical volumes {names} of {source} overlap; a cell has one body"
        )
    return _Input(nodes, np.asarray(x).reshape(-1, 3)[first], volumes, surfaces)


def _elements(model: Any, dim: int, tag: int) -> dict[int, IntArray]:
    """Element type -> node numbers, shape (m, nodes), of a physical group."""
    found: dict[int, list[IntArray]] = {}
    for entity in model.getEntitiesForPhysicalGroup(dim, tag):
        types, numbers, nodes = model.mesh.getElements(dim, entity)
        for kind, n, table in zip(types, numbers, nodes, strict=True):
            found.setdefault(int(kind), []).append(np.asarray(table, np.int64).reshape(len(n), -1))
    return {kind: np.concatenate(tables) for kind, tables in found.items()}


def _read_volume(
    model: Any, tag: int, facets: dict[int, IntArray], tags: dict[int, IntArray]
) -> _Volume:
    """Cells of a physical volume, with all tagged facets of its shape."""
    name = model.getPhysicalName(3, tag) or f"volume_{tag}"
    elements = _elements(model, 3, tag)
    if len(elements) != 1 or not set(elements) <= set(_GMSH_CELLS):
        kinds = [model.mesh.getElementProperties(kind)[0] for kind in elements]
        raise ValueError(
            f"file_or_model: physical volume {name!r} holds {_listed(kinds)}; it must be meshed "
            "with hexahedra or with tetrahedra only, of degree 1"
        )
    ((number, cells),) = elements.items()
    kind, order = _GMSH_CELLS[number]
    corners = 4 if kind == "hexahedron" else 3
    return _Volume(name, kind, cells[:, order], facets[corners], tags[corners])


def _read_surfaces(
    model: Any,
) -> tuple[dict[str, int], dict[int, IntArray], dict[int, IntArray]]:
    """Names of the physical surfaces, and their facets and tags by number of corners."""
    surfaces: dict[str, int] = {}
    owner: dict[int, int] = {}
    facets = {n: [np.empty((0, n), np.int64)] for n in _GMSH_FACETS.values()}
    tags = {n: [np.empty(0, np.int32)] for n in _GMSH_FACETS.values()}
    for _, tag in model.getPhysicalGroups(2):
        name = model.getPhysicalName(2, tag)
        if name:
            surfaces[name] = int(tag)
        for entity in model.getEntitiesForPhysicalGroup(2, tag):
            if owner.setdefault(entity, tag) != tag:
                raise ValueError(
                    f"file_or_model: physical surfaces {owner[entity]} and {tag} overlap; a facet "
                    "has one tag, so make them disjoint"
                )
        for kind, table in _elements(model, 2, tag).items():
            if kind in _GMSH_FACETS:
                facets[_GMSH_FACETS[kind]].append(table)
                tags[_GMSH_FACETS[kind]].append(np.full(len(table), tag, np.int32))
    join = {n: np.concatenate(tables) for n, tables in facets.items()}
    return surfaces, join, {n: np.concatenate(values) for n, values in tags.items()}


def _listed(names: Iterable[Any]) -> str:
    return ", ".join(repr(name) for name in names) or "none"
