"""One mesh per body from input that holds several: Gmsh files and models, tagged DOLFINx meshes.

Every body gets a mesh of its own, built anew from the cells of its volume:

- bodies that touch share no node, so contact can open between them;
- each body is spread over all ranks, while a DOLFINx submesh stays where its parent's cells are and
  may leave ranks empty;
- nodes are numbered by their order in the input, so `mesh.geometry.input_global_indices`, and with
  it every contact surface, does not depend on the number of ranks.

The input passes through rank 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from dolfinx import mesh as dolfinx_mesh
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.meshes.gmsh_input import Input, Volume, listed, read_gmsh
from dolfinx_nts.bodies.meshes.mesh_check import NODES
from dolfinx_nts.bodies.rigid.rigid import RigidBody
from dolfinx_nts.bodies.solid.continuum import Continuum
from dolfinx_nts.bodies.solid.parameters import Parameter
from dolfinx_nts.parallel import on_root
from dolfinx_nts.types import Array, FloatArray, IntArray
from dolfinx_nts.validation import is_whole

_CORNERS = {"tetrahedron": 4, "hexahedron": 8}


@dataclass(frozen=True, eq=False)
class Part:
    """The mesh of one body, with the tags of its cells and facets.

    Attributes:
        name: Name of the volume.
        mesh: dolfinx mesh, of degree 2 if the input is.
        facet_tags: dolfinx meshtags of its tagged facets, interior ones included.
        surfaces: Name of a surface -> its tag, for the named surfaces of the input that this body
            has facets of.
        cell_tags: dolfinx meshtags of its cells: their tags in the input.
        regions: Name of a volume of the input -> its tag, for the named ones in this body.
    """

    name: str
    mesh: Mesh
    facet_tags: Any
    surfaces: Mapping[str, int]
    cell_tags: Any
    regions: Mapping[str, int]

    def where(self, surface: str | int) -> tuple[Any, int]:
        """A tagged surface, as `Dirichlet`, `Traction` and, with a star, `surface` take it.

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
        if not is_whole(tag) and not self.surfaces:
            raise ValueError(
                f"surface={surface!r}: no surface of {self.name!r} has a name; add physical groups "
                "of dimension 2, or pass a function of x in place of where(...)"
            )
        if not is_whole(tag):
            raise ValueError(
                f"surface={surface!r}: body {self.name!r} has {listed(self.surfaces)}; "
                "pass one of these names, or a tag"
            )
        return self.facet_tags, int(tag)

    def by_region(self, values: Mapping[str | int, float]) -> Any:
        """A parameter that differs between the volumes of this body. Collective.

            young = part.by_region({"rubber": 1e6, "belt": 1e9})  # [Pa]
            tyre = part.continuum(nts.NeoHookean(young, 0.4), density=1.1e3)

        Args:
            values: By name or tag of each volume, the same on all ranks.

        Returns:
            dolfinx Function of degree 0, as parameters of materials and densities may be.

        Raises:
            ValueError: A volume has no value, or is not in the body.
        """
        here = self.cell_tags.values
        tags = sorted(set().union(*self.mesh.comm.allgather(set(here.tolist()))))
        known = {self.regions.get(k, k) if isinstance(k, str) else k: k for k in values}
        names = {tag: name for name, tag in self.regions.items()}
        wanted = listed(names.get(tag, tag) for tag in tags)
        if set(known) != set(tags):
            raise ValueError(
                f"values={dict(values)!r}: body {self.name!r} is made of {wanted}; pass a value "
                "for each of them and for nothing else"
            )
        found = fem.Function(compat.function_space(self.mesh, "DG", 0))
        dofs = compat.cell_dofs(found.function_space)[self.cell_tags.indices, 0]
        found.x.array[dofs] = [values[known[tag]] for tag in here.tolist()]
        return found

    def continuum(
        self, material: Callable[[Any], Any], *, density: Parameter, **options: Any
    ) -> Continuum:
        """The flexible body on this mesh, under this name.

        Args:
            material: Strain energy W(C) [J/m^3].
            density: Reference density [kg/m^3], as of `Continuum`.
            **options: Further arguments of `Continuum`.
        """
        return Continuum(self.mesh, material, density=density, **{"name": self.name, **options})

    def rigid(self, *, density: Parameter, **options: Any) -> RigidBody:
        """The rigid body on this mesh, under this name.

        Args:
            density: [kg/m^3], as of `RigidBody`.
            **options: Further arguments of `RigidBody`.
        """
        return RigidBody(self.mesh, density=density, **{"name": self.name, **options})


class Parts(dict[str, Part]):
    """Name of a volume -> its part; an unknown name is answered with the known ones."""

    def __missing__(self, name: str) -> Part:
        raise KeyError(f"no body {name!r} in this mesh; it has {listed(self)}")


def bodies_from_gmsh(
    file_or_model: Any, comm: MPI.Comm, *, bodies: Mapping[str, Sequence[str]] | None = None
) -> Parts:
    """One mesh per physical volume of a Gmsh file or model, or of several of them.

    Physical surfaces become facet tags of every body that has facets of them, so an interface of
    two volumes is a surface of both.

    Args:
        file_or_model: Path of a .msh file (or of anything with a mesh that Gmsh opens), or a live
            `gmsh.model` with a mesh. Only rank 0's value is looked at; others may pass None.
        comm: MPI communicator of the bodies; every rank must call this.
        bodies: Name of a body -> names of the volumes that it is made of, whose cells stay
            connected and keep their tags, see `Part.by_region`. Other volumes are bodies of their
            own.

    Returns:
        Physical name of a volume ("volume_<tag>" if it has none) -> Part.

    Raises:
        ImportError: There is no Gmsh on rank 0.
        TypeError: `comm` is no communicator, or `bodies` no dict of sequences.
        ValueError: `bodies` names an unknown volume, or one twice; no such file or no physical
            volume; a volume is not all hexahedra or all tetrahedra of one degree, 1 or 2, or has
            no mesh;
            physical groups overlap. Raised on every rank.
    """
    if not isinstance(comm, MPI.Comm):
        raise TypeError(f"comm={comm!r}: pass an MPI communicator, e.g. MPI.COMM_WORLD")
    if not isinstance(bodies, Mapping | None) or any(
        isinstance(names, str) or not isinstance(names, Sequence)
        for names in (bodies or {}).values()
    ):
        raise TypeError(
            f"bodies={bodies!r}: pass a dict of names of bodies and of their volumes, e.g. "
            "{'tyre': ('rubber', 'belt')}"
        )
    return _parts(comm, on_root(comm, lambda: _united(read_gmsh(file_or_model), bodies or {})))


def bodies_from_tags(
    mesh: Mesh, cell_tags: Any, facet_tags: Any = None, *,
    names: Mapping[str, int | Sequence[int]] | None = None,
    surfaces: Mapping[str, int] | None = None,
) -> Parts:  # fmt: skip
    """One mesh per cell tag of a DOLFINx mesh.

    Args:
        mesh: 3D hexahedral or tetrahedral mesh of degree 1 or 2.
        cell_tags: dolfinx meshtags; each value is a body, cells without one belong to none.
        facet_tags: dolfinx meshtags of facets; a facet between two bodies becomes one of each.
        names: Name of a body -> its cell tag, or several, which its cells keep, see
            `Part.by_region`; only these are made. By default every tag is a body, under the name
            "volume_<tag>".
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


def _parts(comm: MPI.Comm, data: Input | None) -> Parts:
    """Distribute the bodies that rank 0 holds."""
    names = comm.bcast(None if data is None else [v.name for v in data.volumes])
    surfaces = comm.bcast(None if data is None else data.surfaces)
    parts = Parts()
    for k, name in enumerate(names):
        parts[name] = _part(comm, name, None if data is None else _body(data, k), surfaces)
    return parts


def _united(data: Input, bodies: Mapping[str, Sequence[str]]) -> Input:
    """The input with some of its volumes in one body; on rank 0."""
    left, made = {v.name: v for v in data.volumes}, []
    for body, names in bodies.items():
        parts = []
        for name in names:
            if name not in left:
                raise ValueError(
                    f"bodies[{body!r}]={list(names)!r}: {name!r} is no volume that is left; there "
                    f"are {listed(left)}"
                )
            parts.append(left.pop(name))
        kinds = {(part.kind, part.cells.shape[1]) for part in parts}
        if len(kinds) != 1:
            raise ValueError(
                f"bodies[{body!r}]={list(names)!r}: has cells of {len(kinds)} kinds; pass volumes "
                "of hexahedra only, or of tetrahedra only, all of one degree"
            )
        cells, regions = (
            np.concatenate([getattr(p, which) for p in parts]) for which in ("cells", "regions")
        )
        known = {name: tag for part in parts for name, tag in part.names.items()}
        made.append(parts[0]._replace(name=body, cells=cells, regions=regions, names=known))
    if shared := [v.name for v in made if v.name in left]:
        raise ValueError(f"bodies[{shared[0]!r}]: there is a volume of this name, too; rename it")
    return data._replace(volumes=[*made, *left.values()])


def _body(data: Input, index: int) -> tuple[Any, ...]:
    """Cell name, cells, positions, facets, tags, regions, names of a body in its node numbers."""
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
        volume.regions,
        volume.names,
    )


def _part(comm: MPI.Comm, name: str, body: Any, surfaces: Mapping[str, int]) -> Part:
    """Mesh and tags of one body whose arrays rank 0 holds."""
    shared = comm.bcast(None if body is None else (body[0], body[1].shape[1], *body[3:]))
    kind, nodes, facets, tags, regions, names = shared
    cells, x = np.empty((0, nodes), np.int64), np.empty((0, 3))
    if body is not None:
        cells, x = body[1:3]
    mesh = compat.create_mesh(comm, cells, x, kind)
    mesh.topology.create_entities(2)
    mesh.topology.create_connectivity(2, 3)
    found, values = _find_facets(mesh, facets, tags)
    known = set(comm.allreduce(np.unique(values).tolist()))
    here = {surface: tag for surface, tag in surfaces.items() if tag in known}
    facet_tags = dolfinx_mesh.meshtags(mesh, 2, found, values)
    original = np.asarray(mesh.topology.original_cell_index, dtype=np.int64)
    every = np.arange(len(original), dtype=np.int32)
    cell_tags = dolfinx_mesh.meshtags(mesh, 3, every, regions[original].astype(np.int32))
    return Part(name, mesh, facet_tags, here, cell_tags, names)


def _find_facets(mesh: Mesh, facets: IntArray, tags: IntArray) -> tuple[IntArray, IntArray]:
    """This rank's facets with the given nodes, ascending, and their tags.

    Of input node numbers, ascending in each row, shape (k, facet corners), and tags (k,).
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
def _tagged_cells(mesh: Mesh, cell_tags: Any) -> tuple[IntArray, IntArray, FloatArray]:
    """This rank's owned tagged cells: tags, nodes (m, corners), positions (m, corners, 3)."""
    owned = cell_tags.indices < mesh.topology.index_map(3).size_local
    index = cell_tags.indices[owned]
    table = compat.geometry_dofmap(mesh)
    nodes = table[index] if len(index) else np.empty((0, table.shape[1]), np.int32)
    ids = np.asarray(mesh.geometry.input_global_indices)
    return cell_tags.values[owned], ids[nodes], mesh.geometry.x[nodes]


def _tagged_facets(mesh: Mesh, facet_tags: Any) -> tuple[IntArray, IntArray]:
    """This rank's tagged facets: tags and nodes."""
    index = np.empty(0, np.int32) if facet_tags is None else facet_tags.indices
    nodes = compat.entities_to_geometry(mesh, 2, index)
    values = np.empty(0, np.int32) if facet_tags is None else facet_tags.values
    return values, np.asarray(mesh.geometry.input_global_indices)[nodes]


def _merge(
    kind: str, gathered: list[Any], names: dict[str, Any], surfaces: dict[str, int]
) -> Input:
    """The input from the tagged cells and facets of all ranks; on rank 0."""
    tags, cells, x, values, facets = (_joined(tables) for tables in zip(*gathered, strict=True))
    if not len(tags):
        raise ValueError("cell_tags: no cell has a tag; tag the cells of each body")
    if cells.shape[1] not in (_CORNERS[kind], NODES[kind]):
        raise ValueError("mesh: geometry of degree above 2; pass a mesh of degree 1 or 2")
    # An order that does not depend on the ranks; a submesh does not know the original one.
    order = np.lexsort(cells.T)
    tags, cells, x = tags[order], cells[order], x[order]
    names = names or {f"volume_{tag}": int(tag) for tag in np.unique(tags)}
    for what, mapping, known in (("names", names, tags), ("surfaces", surfaces, values)):
        for name, given in mapping.items():
            group: list[Any] = [given]
            if what == "names" and isinstance(given, Sequence) and not isinstance(given, str):
                group = list(given)
            if not group or any(tag not in known for tag in group):
                present = listed(np.unique(known).tolist())
                raise ValueError(f"{what}[{name!r}]={given!r}: no such tag; the mesh has {present}")
    nodes, first = np.unique(cells, return_index=True)
    volumes = []
    for name, given in names.items():
        own = np.isin(tags, given)
        volumes.append(Volume(name, kind, cells[own], facets, values, tags[own], {}))
    return Input(nodes, x.reshape(-1, 3)[first], volumes, surfaces)


def _joined(tables: Iterable[Array]) -> Array:
    """Rows of all ranks; ranks without rows may not know how wide they are."""
    tables = list(tables)
    return np.concatenate([t for t in tables if len(t)] or tables[:1])
