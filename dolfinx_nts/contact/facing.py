"""Which sides of a master may hold slave nodes: those that the slave's body faces there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dolfinx_nts.contact.convex_edges import middles
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Least cosine between one normal and the opposite of the other of what faces each other; sides of
#: a right angle do not, also where bodies that are pressed have turned them by 17 degrees.
_FACING = 0.3

#: Numbers of slaves and of facets -> which of these pairs face each other.
Faces = Callable[[IntArray, IntArray], BoolArray]


class Facing:
    """Directions in which the body of a slave faces others at its nodes. Collective.

    A node faces what one of the body's facets there does, also one that is not declared: it keeps
    at most the angle to the declared one that it has in the reference.

    Args:
        slave: The slave.
    """

    def __init__(self, slave: Surface) -> None:
        self._slave, at = slave, slave.facets
        facet, edge = np.nonzero(slave.boundary_edges)
        ends = np.stack([at[facet, edge], at[facet, (edge + 1) % at.shape[1]]], axis=1)
        beside = _beside(slave, ends)
        known = beside[:, 0] > 0.0
        self._facet, self._ends = facet[known], ends[known]
        own, along = self._along(slave.reference)
        # Both parts of the other normal, along the facet's own and out of the facet at this edge.
        parts = [np.einsum("ni,ni->n", beside[known, 1:], way) for way in (own, along)]
        self._parts = np.stack(parts, axis=1)
        rows = np.concatenate([
            np.repeat(np.arange(len(at)), at.shape[1]),
            np.repeat(len(at) + np.arange(len(self._facet)), 2),
        ])  # fmt: skip
        self._points, self._rows = np.concatenate([at.ravel(), self._ends.ravel()]), rows
        order = np.argsort(self._points, kind="stable")
        points = self._points[order]
        self._of, self._first = rows[order], np.searchsorted(points, slave.share)
        number = np.searchsorted(points, slave.share, side="right") - self._first
        # What is beyond an edge that ends the body, as of a shell, may face anything.
        self._count = np.where(np.isin(slave.share, ends[~known]), 0, number)

    def _along(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normals of facets at open edges, and unit vectors out of them there, (n, 3) each."""
        _, normal = middles(x[self._slave.facets[self._facet]])
        edge = np.diff(x[self._ends], axis=1)[:, 0]
        way = np.cross(edge, normal)
        return normal, way / np.linalg.norm(way, axis=1)[:, None]

    def of(self, x: FloatArray, corners: FloatArray) -> Faces:
        """Which facets face which of this rank's slaves.

        Args:
            x: Points of the slave [m].
            corners: Of the master's facets [m], shape (m, nc, 3).
        """
        slave = self._slave
        own, other = middles(x[slave.facets])[1], middles(corners)[1]
        beside = np.einsum("na,nai->ni", self._parts, np.stack(self._along(x), axis=1))
        own = np.concatenate([own, beside])
        # The tip of a needle has facets that face nothing ahead of it, but their mean does.
        mean = np.zeros_like(x)
        np.add.at(mean, self._points, own[self._rows])
        mean = mean[slave.share]
        mean /= np.maximum(np.linalg.norm(mean, axis=1), np.finfo(float).tiny)[:, None]

        def faces(node: IntArray, facet: IntArray) -> BoolArray:
            number = self._count[node]
            pair = np.repeat(np.arange(len(node)), number)
            start = np.cumsum(number) - number
            mine = self._of[self._first[node][pair] + np.arange(len(pair)) - start[pair]]
            found = (number == 0) | opposite(mean[node], other[facet])
            found[pair[opposite(own[mine], other[facet[pair]])]] = True
            return found

        return faces


def _beside(slave: Surface, ends: IntArray) -> FloatArray:
    """Whether facets of the body go on beyond edges of its surface, and their normals, (n, 4).

    Collective.

    Args:
        slave: The surface.
        ends: Edges that it ends at, shape (n, 2).
    """
    found = np.zeros((len(ends), 4))
    if not len(ends) or slave.body.mesh is None:
        return found
    whole = slave.body.boundary()
    at, own = whole.points[whole.facets], np.sort(slave.points[ends], axis=1)
    normal = middles(whole.reference[whole.facets])[1]
    both = np.stack([at, np.roll(at, -1, axis=1)], axis=-1).reshape(-1, 2)
    # An edge as one number, which is sought faster than two.
    number, wanted = (np.sort(e, axis=1) @ [whole.points[-1] + 1, 1] for e in (both, own))
    here = np.flatnonzero(np.isin(number, wanted))
    rows = {edge: k for k, edge in enumerate(wanted.tolist())}
    for side in here.tolist():
        facet = side // at.shape[1]
        if tuple(sorted(at[facet].tolist())) not in slave.facet_points:
            row = found[rows[int(number[side])]]
            row[0], row[1:] = 1.0, normal[facet]
    return found


def opposite(one: FloatArray, two: FloatArray) -> BoolArray:
    """Return which of unit normals (n, 3) face each other, shape (n,)."""
    facing: BoolArray = np.einsum("ni,ni->n", one, two) < -_FACING
    return facing
