"""Oriented facets of a mesh and the points at their corners, which every rank knows."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact.faces import Faces
from dolfinx_nts.contact.linear_facets import body_facets, node_numbers, node_places
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import FloatArray, IntArray, Marker
from dolfinx_nts.validation import at_points, is_whole


def locate_facets(mesh: Mesh, marker: Marker, tag: int | None, what: str) -> IntArray:
    """This rank's owned exterior facets selected by a marker function or by a tag.

    Args:
        mesh: dolfinx mesh.
        marker: Callable x (3, n) -> bool (n,) that must hold at all corners of a facet, or dolfinx
            meshtags.
        tag: Value to look for when `marker` is meshtags.
        what: Name of the argument for messages.

    Raises:
        TypeError: `marker` is neither callable nor meshtags with a tag.
        ValueError: The marker raises or returns no truth values, the tags are not facet tags or of
            another mesh, or no exterior facet is selected, or an interior facet is.
    """
    exterior, dim = compat.exterior_facets(mesh), mesh.topology.dim - 1
    if tag is None:
        if not callable(marker):
            advice = ""
            if isinstance(marker, tuple):
                advice = " as two arguments, e.g. surface(*part.where('top'))"
            elif isinstance(marker, str):
                advice = f", which part.where({marker!r}) has of a surface with this name"
            raise TypeError(
                f"{what}={marker!r}: pass a function of x with shape (3, n), or meshtags and a tag"
                f"{advice}"
            )
        nodes = compat.entities_to_geometry(mesh, dim, exterior)
        used, chosen = np.unique(nodes), np.zeros(len(mesh.geometry.x), dtype=bool)
        chosen[used] = at_points(mesh.comm, what, marker, mesh.geometry.x[used].T, (), "b")
        found = exterior[chosen[nodes].all(axis=1)]
        wrong = foreign = 0
    else:
        if callable(marker):
            raise TypeError(f"{what}: a function of x takes no tag, but {tag!r} is given")
        if not hasattr(marker, "find") or marker.dim != dim:
            raise ValueError(
                f"{what}={marker!r}: pass facet meshtags (dimension {dim}), not cell or edge tags"
            )
        if not is_whole(tag):
            raise TypeError(f"{what} (tag {tag!r}): pass a whole number as the tag")
        tagged = marker.find(tag)
        found = np.intersect1d(tagged, exterior).astype(np.int32)
        owned = tagged < mesh.topology.index_map(dim).size_local
        wrong = int(np.count_nonzero(owned) - len(found))
        foreign = int(not compat.is_tagging(marker, mesh))
    every = mesh.comm.allgather((len(found), wrong, foreign))
    total, wrong, foreign = (int(n) for n in np.sum(every, axis=0))
    name = what if tag is None else f"{what} (tag {tag})"
    if foreign:
        raise ValueError(f"{name}: these meshtags are of another mesh; pass those of this body's")
    if wrong:
        raise ValueError(
            f"{name}: {wrong} interior facets selected; a contact surface must lie on the boundary"
        )
    if not total:
        raise ValueError(
            f"{name}: selects no exterior facet; check the marker's tolerance or the tag"
        )
    return found


class Skin(NamedTuple):
    """Oriented facets and the points at their corners, which every rank knows.

    Attributes:
        points: Numbers of the points in the body, ascending, those of a rank's nodes together,
            shape (p,).
        facets: Corners as positions in `points`, cyclic and counter-clockwise seen from outside, in
            an order that does not depend on the partition, shape (m, nc).
        original: Numbers that do not depend on the partition, shape (p,).
        reference: Reference positions [m], shape (p, 3).
        rows: Of the points at nodes of the mesh that this rank owns, in order, those nodes'
            positions among the owned ones, shape (n,).
        material: The points as functions of the body's coordinates.
        faces: Those of degree 2 that the facets are parts of; None: each is one itself.
    """

    points: IntArray
    facets: IntArray
    original: IntArray
    reference: FloatArray
    rows: IntArray
    material: Points
    faces: Faces | None = None


def skin_of_mesh(body: Any, local_facets: IntArray) -> Skin:
    """Facets of a body's mesh, whose corners are nodes of the body. Collective.

    Args:
        body: The body.
        local_facets: This rank's owned facets.
    """
    mesh, index_map = body.mesh, body.space.dofmap.index_map
    found = body_facets(body, local_facets)
    local = found.corners
    corners, whole = (
        index_map.local_to_global(of.ravel().astype(np.int32)).reshape(of.shape)
        for of in (local, found.nodes)
    )
    table = gather_rows(mesh.comm, np.stack([corners, node_numbers(body)[local]], axis=-1))
    x = gather_rows(mesh.comm, node_places(body)[local])
    roll, order = in_order(table[..., 1])
    table = np.take_along_axis(table, roll[..., None], axis=1)[order]
    x = np.take_along_axis(x, roll[..., None], axis=1)[order]
    faces = None
    if (body.degree or 1) > 1:
        parts, at, nodes = (gather_rows(mesh.comm, a) for a in (found.parts, found.at, whole))
        parts = np.take_along_axis(parts, roll, axis=1)[order]
        faces = parts, np.take_along_axis(at, roll[..., None], axis=1)[order], nodes[order]
    points, first, inverse = np.unique(table[..., 0], return_index=True, return_inverse=True)
    reference = x.reshape(-1, 3)[first]
    low, high = index_map.local_range
    rows = points[(points >= low) & (points < high)] - low
    return Skin(
        points, inverse.reshape(table.shape[:2]), table[..., 1].ravel()[first], reference, rows,
        body.at_nodes(points, reference),
        None if faces is None else Faces(*faces[:2], np.searchsorted(points, faces[2])),
    )  # fmt: skip


def in_order(ids: IntArray) -> tuple[IntArray, IntArray]:
    """How to order facets whatever the partition, by numbers (m, nc) of their corners.

    Returns:
        Order of the corners of each facet, (m, nc), the lowest first, and of the facets, (m,).
    """
    first = ids.argmin(axis=1)
    roll = (first[:, None] + np.arange(ids.shape[1])) % ids.shape[1]
    return roll, np.lexsort(np.sort(ids, axis=1).T[::-1])


def boundary_of_mesh(body: Any, u: FloatArray) -> FloatArray:
    """Corners of the exterior facets of a body's mesh that this rank has [m], (m, nc, 3).

    Collective.
    """
    mesh = body.mesh
    blocks = body_facets(body, compat.exterior_facets(mesh)).corners
    values = body.at_mesh(u)
    if mesh.comm.size > 1:
        moved = fem.Function(body.space)
        moved.x.array[: len(values)] = values
        moved.x.scatter_forward()
        values = moved.x.array
    return node_places(body)[blocks] + values.reshape(-1, 3)[blocks]
