"""Slave nodes in an inner edge of a master, which a contact holds out of one of its two faces."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.contact.crossings import Finding
from dolfinx_nts.contact.search import closest_facets
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.types import FloatArray, IntArray

#: Facets meet at an edge where the cosine of the angle between their normals is below this; in a
#: bore of facets a node that slides is behind the next one for a step, which is known.
_SHARP = 0.7
#: Depth behind one of the two facets that is told, in sizes of the smaller one: in stiff bodies a
#: little of it takes all of a force, and gaps are solved to rounding.
_DEEP = 1e-6
#: A node in the edge is not farther from it than this many depths.
_NEAR = 2.0
#: No facet is nearer to it than this part of the depth.
_ALONE = 0.5


class Behind(NamedTuple):
    """The node that lies deepest.

    Attributes:
        node: Point of the slave.
        facet: Facet of the master that it lies behind.
        depth: [m].
        size: The same in sizes of the smaller of the two facets [-].
    """

    node: int
    facet: int
    depth: float
    size: float


class InnerEdges:
    """Edges of a master's surface at which it turns towards the side of the slave.

    Args:
        facets: Facets of the surface, shape (m, nc).
        y: Its nodes [m], from which these edges are chosen once.
    """

    def __init__(self, facets: IntArray, y: FloatArray) -> None:
        self._facets = facets
        ends = np.stack([facets, np.roll(facets, -1, axis=1)], axis=2).reshape(-1, 2)
        facet = np.repeat(np.arange(len(facets)), facets.shape[1])
        order = np.lexsort((ends.max(axis=1), ends.min(axis=1)))
        ends, facet = np.sort(ends[order], axis=1), facet[order]
        same = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
        two = np.stack([facet[same], facet[same + 1]], axis=1)
        place, normal = self._planes(y, two)
        rise = np.einsum("ni,ni->n", place[:, 1] - place[:, 0], normal[:, 0])
        cosine = np.einsum("ni,ni->n", normal[:, 0], normal[:, 1])
        inner = (rise > 0.0) & (cosine < _SHARP)
        self._ends, self._two = ends[same[inner]], two[inner]

    def __len__(self) -> int:
        return len(self._two)

    def behind(self, points: FloatArray, force: FloatArray, y: FloatArray) -> Behind | None:
        """Return the node that carries at one facet and lies deepest behind the one beside it.

        Args:
            points: Those of the slave [m], shape (p, 3).
            force: Their normal forces [N], shape (p,).
            y: Nodes of the master now [m].
        """
        carry = np.flatnonzero(force > 0.0)
        if not len(carry) or not len(self):
            return None
        ends, normals = y[self._ends], self._planes(y, self._two)[1]
        corners = y[self._facets]
        sizes = fc.size(corners)[self._two].min(axis=1)
        # Farther away none lies in the edge, see below.
        reach = 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) + _NEAR * sizes
        at = cKDTree(points[carry]).query_ball_point(ends.mean(axis=1), reach)
        edge = np.repeat(np.arange(len(at)), [len(near) for near in at])
        node = carry[np.concatenate(at).astype(np.int64)]
        x, along = points[node] - ends[edge, 0], (ends[:, 1] - ends[:, 0])[edge]
        on = np.einsum("ni,ni->n", x, along) / np.einsum("ni,ni->n", along, along)
        away = np.linalg.norm(x - np.clip(on, 0.0, 1.0)[:, None] * along, axis=1)
        depths, size = -np.einsum("ni,nki->nk", x, normals[edge]), sizes[edge]
        depth = depths.max(axis=1)
        deep = np.flatnonzero((away <= _NEAR * depth) & (depth <= size) & (depth > _DEEP * size))
        # On the far side of a thin wall other facets are nearer.
        others = closest_facets(points[node[deep]], corners, reach=_ALONE * depth[deep])
        alone = deep[others.facet < 0]
        if not len(alone):
            return None
        n = alone[depth[alone].argmax()]
        facet = int(self._two[edge[n], depths[n].argmax()])
        return Behind(int(node[n]), facet, float(depth[n]), float(depth[n] / size[n]))

    def _planes(self, y: FloatArray, two: IntArray) -> tuple[FloatArray, FloatArray]:
        """Middles and normals of pairs of facets, shape (n, 2, 3) each."""
        corners = y[self._facets[two.ravel()]]
        middle = np.full((len(corners), 2), 1 / 3 if corners.shape[1] == 3 else 0.0)
        place, _, normal = fc.frame(corners, middle)
        return place.reshape(-1, 2, 3), normal.reshape(-1, 2, 3)


def in_inner_edge(
    edges: InnerEdges, contact: Any, positions: tuple[FloatArray, ...], force: FloatArray
) -> Finding | None:
    """As `InnerEdges.behind`, of a contact, with a sentence and a remedy.

    Args:
        edges: Those of the contact's master.
        contact: A contact of two surfaces.
        positions: Of all points of both, as of `ContactPair.positions` [m].
        force: Normal force of each point of the slave [N].
    """
    (x, y), slave, master = positions, contact.slave, contact.master
    found = edges.behind(x, force, y)
    if found is None:
        return None
    one, two, node = slave.body.name, master.body.name, int(slave.original[found.node])
    corners = sorted(int(n) for n in master.original[master.facets[found.facet]])
    text = (
        f"node {node} of {one!r} lies in an inner edge of {two!r}, behind the facet of nodes "
        f"{corners} by {found.depth:.3g}, or {found.size:.2g} of a facet: contact "
        f"{contact.name!r} holds a node out of one facet at a time; declare a contact for each of "
        f"the faces of {two!r} that meet there"
    )
    place = x[found.node] + contact.origin
    return Finding(
        "node in an inner edge", found.depth, found.size, place, (one, two), (node,), text
    )
