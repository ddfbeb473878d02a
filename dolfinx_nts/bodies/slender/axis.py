"""The axis of a beam on an interval mesh: which way it runs, and directors at its nodes."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from dolfinx import mesh as dolfinx_mesh
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.meshes.mesh_check import check_any_mesh
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh, nodes_and_cells
from dolfinx_nts.kernels.beam import shares
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import at_points, floats

#: Cosine of the largest angle between neighbouring cells, 60 degrees.
_STRAIGHT = 0.5
#: Sine of the angle between a direction and the axis below which they are parallel.
_PARALLEL = 1e-6
#: Part of the mesh's size below which a cell has no length.
_SHORT = 1e-12
#: Largest ratio of the ways from a middle node to both ends: it is farther from a quarter of the
#: element, at which lengths would vanish.
_UNEVEN = 2.0


def check_line(mesh: Mesh, degree: Any, name: str) -> int:
    """Raise on every rank unless the mesh is one of intervals in space.

    Args:
        mesh: DOLFINx mesh of degree 1 or 2.
        degree: As of `Beam`.
        name: Of the beam, for messages.

    Returns:
        The degree of the beam.

    Raises:
        TypeError: It is no mesh.
        ValueError: Cells of another kind, another dimension, nodes that are not finite, or a degree
            that is none.
    """
    if not isinstance(mesh, dolfinx_mesh.Mesh):
        raise TypeError(f"mesh={mesh!r}: pass a dolfinx mesh")
    kind, dim = compat.cell_name(mesh), mesh.geometry.dim
    if kind != "interval" or dim != 3:
        raise ValueError(
            f"mesh of {name!r}: {kind} in {dim}D; pass intervals with points of three coordinates"
        )
    least = check_any_mesh(mesh, name, 2)
    if degree is None:
        return least
    if isinstance(degree, bool) or degree not in (1, 2):
        raise ValueError(f"degree={degree!r} of {name!r}: pass 1 or 2, or leave it out")
    if degree < least:
        raise ValueError(
            f"degree={degree!r} of {name!r}: its mesh is of degree {least}; leave degree out, or "
            "pass nts.linear(mesh)"
        )
    return int(degree)


def axis_of(space: fem.FunctionSpace, direction: Any, name: str) -> DirectorMesh:
    """The axis of a mesh that `check_line` let pass; nodes follow it, d_3 is along it. Collective.

    Args:
        space: Lagrange space of degree 1 or 2 on it.
        direction: As of `Beam`.
        name: Of the beam, for messages.

    Raises:
        ValueError: A cell without length, a node of three cells, an angle above 60 degrees, a
            middle node far from the middle, or a direction along the axis.
    """
    x, cells, given = nodes_and_cells(space)
    # As its nodes follow each other; DOLFINx has both ends first.
    cells = cells[:, [0, *range(2, cells.shape[1]), 1]]
    _check_cells(x, cells, name)
    order, forward = _walk(cells, given, len(x))
    cells = np.where(forward[:, None], cells, cells[:, ::-1])
    tangent = _tangents(x, np.concatenate([cells[:, i : i + 2] for i in range(cells.shape[1] - 1)]),
                        name)  # fmt: skip
    first = _first(space.mesh.comm, x, tangent, direction, name)
    directors = np.stack([first, np.cross(tangent, first), tangent], axis=1)
    return DirectorMesh(x, order, cells, directors, cells, shares(x[cells]).sum(axis=2))


def _check_cells(x: FloatArray, cells: IntArray, name: str) -> None:
    count = np.bincount(cells[:, [0, -1]].ravel(), minlength=len(x))
    if count.max() > 2:
        where = x[count.argmax()].tolist()
        raise ValueError(
            f"mesh of {name!r}: {count.max()} cells meet at x={where}; make a beam of each branch "
            "and join them, e.g. by Fixed(a, b, point=...)"
        )
    length = np.linalg.norm(np.diff(x[cells], axis=1), axis=2)
    flat = (length <= _SHORT * np.ptp(x, axis=0).max()).any(axis=1)
    if flat.any():
        where = x[cells[flat.argmax(), 0]].tolist()
        raise ValueError(
            f"mesh of {name!r}: {flat.sum()} cells have no length, e.g. at x={where}; repair it"
        )
    uneven = length.max(axis=1) > _UNEVEN * length.min(axis=1)
    if uneven.any():
        where = x[cells[uneven.argmax(), 1]].tolist()
        raise ValueError(
            f"mesh of {name!r}: the middle node of a cell at x={where} is more than twice as far "
            "from one end as from the other; move it to the middle"
        )


def _walk(cells: IntArray, given: IntArray, n: int) -> tuple[IntArray, BoolArray]:
    """Nodes along the axis, from the end of lowest number in the user's input; cells that do so."""
    near: list[list[tuple[int, int]]] = [[] for _ in range(n)]
    for k, (a, *_, b) in enumerate(cells.tolist()):
        near[a].append((k, b))
        near[b].append((k, a))
    forward, seen = np.zeros(len(cells), dtype=bool), np.zeros(n, dtype=bool)
    order: list[int] = []
    # Ends before the rings, which have none.
    starts = sorted(
        np.unique(cells[:, [0, -1]]).tolist(), key=lambda a: (len(near[a]), int(given[a]))
    )
    for start in starts:
        node, last = start, -1
        while not seen[node]:
            seen[node] = True
            order.append(node)
            ways = sorted((int(given[b]), k, b) for k, b in near[node] if k != last)
            if not ways:
                break
            _, last, following = ways[0]
            forward[last] = cells[last, 0] == node
            order.extend(cells[last, 1:-1].tolist())
            node = following
    return np.array(order), forward


def _tangents(x: FloatArray, cells: IntArray, name: str) -> FloatArray:
    """Unit vectors along the axis at its nodes, of the circle through a node and its neighbours."""
    way = x[cells[:, 1]] - x[cells[:, 0]]
    length = np.linalg.norm(way, axis=1)
    unit = way / length[:, None]
    after, before = np.full((2, len(x)), -1)
    after[cells[:, 0]] = before[cells[:, 1]] = np.arange(len(cells))
    inner = (after >= 0) & (before >= 0)
    a, b = before[inner], after[inner]
    cosine = (unit[a] * unit[b]).sum(axis=1)
    if (cosine < _STRAIGHT).any():
        k = cosine.argmin()
        raise ValueError(
            f"mesh of {name!r}: its axis turns by {np.degrees(np.arccos(cosine[k])):.3g} degrees "
            f"at x={x[np.flatnonzero(inner)[k]].tolist()}, more than 60; refine the mesh, or make "
            "two beams of it and join them by Fixed(a, b, point=...)"
        )
    tangent = np.zeros_like(x)
    tangent[inner] = length[b, None] * unit[a] + length[a, None] * unit[b]
    tangent[inner] /= np.linalg.norm(tangent[inner], axis=1)[:, None]
    # The chord of a circle has the same angle with both ends' tangents.
    for ends, cell, other in ((before < 0, after, 1), (after < 0, before, 0)):
        of = cell[ends]
        far = cells[of, other]
        known = np.where(inner[far, None], tangent[far], unit[of])
        tangent[ends] = 2.0 * (unit[of] * known).sum(axis=1)[:, None] * unit[of] - known
    return tangent


def _first(
    comm: MPI.Comm, x: FloatArray, tangent: FloatArray, direction: Any, name: str
) -> FloatArray:
    """d_1 at right angles to the axis, shape (n, 3). Collective."""
    what = f"direction of {name!r}"
    if direction is None:
        # The axis of coordinates that is farthest from the tangents; of equals y, then z.
        along = np.abs(tangent).max(axis=0)[[1, 2, 0]]
        given = np.roll(np.eye(3), -1, axis=0)[along.round(9).argmin()]
    elif callable(direction):
        given = at_points(comm, what, direction, x.T, (3,)).T
    else:
        given = floats(direction)
        if given.shape != (3,) or not np.isfinite(given).all():
            raise ValueError(f"{what}={direction!r}: pass three finite components, or a function")
    size = np.linalg.norm(given, axis=-1, keepdims=True)
    across = given - (given * tangent).sum(axis=1)[:, None] * tangent
    left = np.linalg.norm(across, axis=1)
    off = left <= _PARALLEL * size.ravel()
    if off.any():
        raise ValueError(
            f"{what}={direction!r}: along the axis at x={x[off.argmax()].tolist()}; pass a vector, "
            "or a function x (3, n) -> (3, n), that is across it everywhere"
        )
    return across / left[:, None]
