"""Facets of a mesh by the direction that they face, and up to its features: its sharp edges."""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx.mesh import Mesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact.linear_facets import vertex_nodes
from dolfinx_nts.contact.skins import in_order, locate_facets
from dolfinx_nts.kernels import facets
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import FloatArray, IntArray, Marker
from dolfinx_nts.validation import is_finite, require_same, vector

#: Part of an angle that is rounding of normals.
_ROUNDING = 1e-9


def choose_facets(
    mesh: Mesh, marker: Marker, tag: int | None, normal: Any, angle: Any, what: str
) -> IntArray:
    """This rank's owned exterior facets of a marker that face a way, or what they go on to.

    The same facets on any number of ranks. Collective.

    Args:
        mesh: dolfinx mesh.
        marker: As of `locate_facets`.
        tag: As of `locate_facets`.
        normal: Direction that outward normals of the reference are compared with; None: grow.
        angle: Largest angle to it, or angle of features [degrees]; None: as marked.
        what: Name of the marker for messages.

    Raises:
        TypeError: As of `locate_facets`.
        ValueError: As of `locate_facets`; `angle` is no angle or lacks, `normal` is no direction,
            or no facet faces it.
    """
    toward = _direction(mesh, normal, angle)
    found = locate_facets(mesh, marker, tag, what)
    if angle is None:
        return found
    if toward is None:
        return _grown(mesh, found, angle)
    off = _angles(_normals(mesh, found)[1], toward)
    chosen = found[off <= (1.0 + _ROUNDING) * angle]
    if not mesh.comm.allreduce(len(chosen)):
        nearest = min(mesh.comm.allgather(float(off.min(initial=180.0))))
        raise ValueError(
            f"normal={normal!r}, angle={angle!r}: no facet of {what} faces that way; the nearest "
            f"one is {nearest:.3g} degrees off, so pass another direction or a larger angle"
        )
    return chosen


def _direction(mesh: Mesh, normal: Any, angle: Any) -> FloatArray | None:
    """The unit vector along `normal`, once it and `angle` are checked. Collective."""
    require_same(mesh.comm, normal=normal, angle=angle)
    if angle is not None and not (is_finite(angle) and 0.0 < angle <= 180.0):
        raise ValueError(f"angle={angle!r}: pass an angle above 0 and up to 180 [degrees]")
    if normal is None:
        return None
    if angle is None:
        raise ValueError(
            f"normal={normal!r}: pass angle=, too, by how much normals of facets may differ from "
            "it [degrees]"
        )
    toward = vector("normal", normal, "-")
    length = float(np.linalg.norm(toward))
    if not length > 0.0:
        raise ValueError(f"normal={normal!r}: pass a vector of some length")
    return toward / length


def _normals(mesh: Mesh, local: IntArray) -> tuple[IntArray, FloatArray]:
    """Input numbers of facets' corners, (m, nc), and normals (m, 3), the same bits on any rank."""
    nodes = vertex_nodes(mesh, local)
    ids = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)[nodes]
    roll, _ = in_order(ids)
    corners = mesh.geometry.x[np.take_along_axis(nodes, roll, axis=1)]
    middle = np.full((len(ids), 2), 1.0 / 3.0 if ids.shape[1] == 3 else 0.0)
    return ids, facets.frame(corners, middle)[2]


def _angles(normals: FloatArray, others: FloatArray) -> FloatArray:
    """Angles between unit vectors (m, 3) and others, (m, 3) or (3,) [degrees], shape (m,)."""
    others = np.broadcast_to(others, normals.shape)
    sine = np.linalg.norm(cross(normals, others), axis=1)
    return np.degrees(np.arctan2(sine, np.einsum("ni,ni->n", normals, others)))


def _grown(mesh: Mesh, seeds: IntArray, angle: float) -> IntArray:
    """This rank's facets that are reached from the seeds of all without a feature. Collective."""
    exterior = compat.exterior_facets(mesh)
    ids, normals = (gather_rows(mesh.comm, part) for part in _normals(mesh, exterior))
    seeded = gather_rows(mesh.comm, np.isin(exterior, seeds))
    edges = np.sort(np.stack([ids, np.roll(ids, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    _, edge, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    # Where more than two facets meet, surfaces touch.
    order = np.argsort(edge.ravel(), kind="stable")
    inner = order[count[edge.ravel()[order]] == 2].reshape(-1, 2) // ids.shape[1]
    one, two = inner[_angles(normals[inner[:, 0]], normals[inner[:, 1]])
                     < (1.0 - _ROUNDING) * angle].T  # fmt: skip
    size = len(ids)
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, two)), shape=(size, size))
    _, part = connected_components(graph, directed=False)
    reached = np.isin(part, part[seeded])
    start = mesh.comm.exscan(len(exterior)) or 0
    return exterior[reached[start : start + len(exterior)]]
