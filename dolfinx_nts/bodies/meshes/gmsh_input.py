"""Volumes and surfaces of Gmsh files and models, and what all input of several bodies is made of.

Gmsh is imported when a Gmsh input is read, on rank 0 alone.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.types import FloatArray, IntArray

_BRICK = [0, 1, 3, 2, 4, 5, 7, 6]
#: Gmsh element type -> cell name, DOLFINx node k = Gmsh node order[k]; of degree 1, then 2.
_GMSH_CELLS = {
    4: ("tetrahedron", [0, 1, 2, 3]),
    5: ("hexahedron", _BRICK),
    11: ("tetrahedron", [0, 1, 2, 3, 8, 9, 5, 7, 6, 4]),
    12: ("hexahedron", [*_BRICK, 8, 9, 10, 11, 12, 13, 15, 14, *range(16, 27)]),
}
#: Gmsh element types of facets -> their corners, which come first.
_GMSH_FACETS = {2: 3, 3: 4, 9: 3, 10: 4}


class Volume(NamedTuple):
    """One body of the input.

    Attributes:
        name: Its name.
        kind: DOLFINx cell name.
        cells: Input node numbers in DOLFINx order, shape (m, nodes).
        facets: Tagged facets by numbers of their corners, any order, shape (k, facet corners).
        tags: Tags of the facets, shape (k,).
        regions: Tags of the cells, shape (m,).
        names: Names of some of these.
    """

    name: str
    kind: str
    cells: IntArray
    facets: IntArray
    tags: IntArray
    regions: IntArray
    names: dict[str, int]


class Input(NamedTuple):
    """All bodies of an input.

    Attributes:
        nodes: Input numbers of the nodes, ascending, shape (n,).
        x: Their positions [m], shape (n, 3).
        volumes: The bodies.
        surfaces: Name of a surface -> tag.
    """

    nodes: IntArray
    x: FloatArray
    volumes: list[Volume]
    surfaces: dict[str, int]


def read_gmsh(file_or_model: Any) -> Input:
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
        if not _is_running(gmsh):
            raise ValueError(
                "file_or_model=gmsh.model: Gmsh is not initialised; call gmsh.finalize() only when "
                "the bodies are made"
            )
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


def _read_model(model: Any, source: str) -> Input:
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
    return Input(nodes, np.asarray(x).reshape(-1, 3)[first], volumes, surfaces)


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
) -> Volume:
    """Cells of a physical volume, with all tagged facets of its shape."""
    name = model.getPhysicalName(3, tag) or f"volume_{tag}"
    elements = _elements(model, 3, tag)
    if not elements:
        raise ValueError(
            f"file_or_model: physical volume {name!r} has no mesh; call gmsh.model.mesh.generate(3)"
        )
    if len(elements) != 1 or not set(elements) <= set(_GMSH_CELLS):
        kinds = [model.mesh.getElementProperties(kind)[0] for kind in elements]
        raise ValueError(
            f"file_or_model: physical volume {name!r} holds {listed(kinds)}; it must be meshed "
            "with hexahedra or with tetrahedra only, of degree 1 or 2, hexahedra with 27 nodes "
            "(gmsh.model.mesh.setOrder)"
        )
    ((number, cells),) = elements.items()
    kind, order = _GMSH_CELLS[number]
    corners = 4 if kind == "hexahedron" else 3
    regions = np.full(len(cells), tag)
    cells = cells[:, order]
    return Volume(name, kind, cells, facets[corners], tags[corners], regions, {name: int(tag)})


def _read_surfaces(
    model: Any,
) -> tuple[dict[str, int], dict[int, IntArray], dict[int, IntArray]]:
    """Names of the physical surfaces, and their facets and tags by number of corners."""
    surfaces: dict[str, int] = {}
    owner: dict[int, int] = {}
    corners = set(_GMSH_FACETS.values())
    facets = {n: [np.empty((0, n), np.int64)] for n in corners}
    tags = {n: [np.empty(0, np.int32)] for n in corners}
    for _, tag in model.getPhysicalGroups(2):
        name = model.getPhysicalName(2, tag)
        if name:
            surfaces[name] = int(tag)
        for entity in model.getEntitiesForPhysicalGroup(2, tag):
            if owner.setdefault(entity, tag) != tag:
                both = (model.getPhysicalName(2, t) or t for t in (owner[entity], tag))
                raise ValueError(
                    f"file_or_model: physical surfaces {' and '.join(map(repr, both))} overlap; a "
                    "facet has one tag, so make them disjoint; one surface between two volumes is "
                    "a surface of both bodies"
                )
        for kind, table in _elements(model, 2, tag).items():
            if kind in _GMSH_FACETS:
                facets[_GMSH_FACETS[kind]].append(table[:, : _GMSH_FACETS[kind]])
                tags[_GMSH_FACETS[kind]].append(np.full(len(table), tag, np.int32))
    join = {n: np.concatenate(tables) for n, tables in facets.items()}
    return surfaces, join, {n: np.concatenate(values) for n, values in tags.items()}


def listed(names: Iterable[Any]) -> str:
    """Names for a message."""
    return ", ".join(repr(name) for name in names) or "none"
