"""Edges of a master: where it turns away from its slaves, facets' planes go on, the body does not.

A node that touches a facet slides on to the next one over the edges of a curved surface. Over a
sharp convex edge it leaves the body, and what crosses a facet's plane beyond such an edge passes
the facet on its other side.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dolfinx_nts.contact import passages
from dolfinx_nts.kernels import compiled, facets, patches
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: A node farther than this from a facet, in facet sizes, is beside it.
ASIDE = 1e-4
#: A node this part of a facet behind it, or less, is outside.
OUTSIDE = 1e-6
#: Least cosine between normals of facets whose convex edge is one of a curved surface, such as a
#: cylinder of twelve facets.
SHARP = 0.85
#: That of facets at an inner edge, in which a node is held out of both. In a bore of facets one
#: that slides is behind the next one for a step, by less than they sag.
INNER = 0.7
#: What hits a facet so near to a sharp edge, in ways that it slides in a step, passes beside it.
_GRAZES = 1e-2
#: Over so many facets of a curved surface a node is followed to its sharp edge.
_MOST_FACETS = 3


class ConvexEdges:
    """Which facets of a master meet at its edges, and what passes these.

    Args:
        at: Facets of the surface, shape (m, nc).
        corners: Their corners in the reference [m], shape (m, nc, 3).

    Attributes:
        joined: As of `patches.neighbours`, without sharp edges.
        sharp: Which facets have a sharp edge, shape (m,).
        inner: Ends of the edges at which the master turns towards its slaves, shape (n, 2).
        inner_facets: The two facets of each, ascending, shape (n, 2).
    """

    def __init__(self, at: IntArray, corners: FloatArray) -> None:
        self._at = at
        self.joined = patches.neighbours(at, corners)
        self.beside = patches.neighbours(at, corners, sharp=-np.inf)
        nc, (one, edge) = at.shape[1], np.nonzero(self.beside >= 0)
        two, (place, normal) = self.beside[one, edge] // nc, middles(corners)
        rise = np.einsum("ni,ni->n", place[two] - place[one], normal[one])
        cosine = np.einsum("ni,ni->n", normal[one], normal[two])
        turns = (rise < 0.0) & (cosine < SHARP)
        self.joined[one[turns], edge[turns]] = -1
        meets = (rise > 0.0) & (cosine < INNER) & (one < two)
        ends = np.stack([at, np.roll(at, -1, axis=1)], axis=2)
        self.inner: IntArray = ends[one, edge][meets]
        self.inner_facets = np.column_stack([one, two])[meets]
        self.sharp: BoolArray = ((self.beside >= 0) & (self.joined < 0)).any(axis=1)

    @property
    def smooth(self) -> tuple[IntArray, IntArray, IntArray]:
        """Facets, those that they go on to, and over which of their edges, shape (n,) each."""
        one, edge = np.nonzero(self.joined >= 0)
        return one, self.joined[one, edge] // self.joined.shape[1], edge

    @cached_property
    def faces(self) -> IntArray:
        """Number of each facet's face, shape (m,): faces that meet at an inner edge differ.

        Others may have the same, so that there are few.
        """
        size, smooth = len(self.sharp), np.sort(np.column_stack(self.smooth[:2]), axis=1)
        key = [size, 1]
        one, two = smooth[~np.isin(smooth @ key, self.inner_facets @ key)].T
        joined = coo_array((np.ones(len(one)), (one, two)), shape=(size, size))
        count, face = connected_components(joined, directed=False)
        number, meet = np.full(count, -1), face[self.inner_facets]
        for k in np.unique(meet):
            beside = meet[(meet == k).any(axis=1)]
            number[k] = np.setdiff1d(np.arange(len(beside) + 1), number[beside[beside != k]])[0]
        return np.maximum(number, 0)[face]

    def across(
        self,
        points: FloatArray,
        facet: IntArray,
        master: FloatArray,
        master_path: FloatArray,
        part: FloatArray,
    ) -> IntArray:
        """Facets across the sharp convex edges that points (n, 3) are beyond, or -1, (n,).

        Args:
            points: [m].
            facet: Facets in whose planes they are, shape (n,).
            master: Points of the master at t_n [m].
            master_path: Their motion in the step [m].
            part: How much of that they have behind them, shape (n,).
        """
        at, nc = self._at, self._at.shape[1]
        pairs = np.arange(len(points))

        def corners(of: IntArray) -> FloatArray:
            now: FloatArray = master[at[of]] + part[:, None, None] * master_path[at[of]]
            return now

        for k in range(_MOST_FACETS):
            xi, converged = compiled.project(points, corners(facet), np.zeros((len(points), 2)))
            excess = facets.edge_excess(xi, nc)
            edge = excess.argmax(axis=1)
            out = converged & (excess[pairs, edge] > ASIDE)
            joined = self.joined[facet, edge]
            onward = out & (joined >= 0)
            if k == _MOST_FACETS - 1 or not onward.any():
                break
            facet = np.where(onward, joined // nc, facet)
        beside = self.beside[facet, edge]
        out &= (beside >= 0) & (joined < 0)
        other = np.where(out, beside // nc, 0)
        foot, _, normal = facets.frame(corners(other), np.zeros((len(points), 2)))
        gap = np.einsum("ni,ni->n", normal, points - foot)
        out &= gap > ASIDE * facets.size(master[at[other]])
        return np.where(out, other, -1)

    def cut_corners(
        self, x: FloatArray, way: FloatArray, master: FloatArray, master_path: FloatArray,
        stops: passages.Stops | None = None,
    ) -> BoolArray:  # fmt: skip
        """Which nodes without contact come through a facet and out beyond its edge, shape (n,).

        They hit it and slide over its edge in one step. What is at the facet already only slides.

        Args:
            x: Nodes at t_n [m], shape (n, 3).
            way: Their motion in the solved step [m], shape (n, 3).
            master: Points of the master at t_n [m].
            master_path: Their motion [m].
            stops: As of `passages.first_hits`.
        """
        at, cut = self._at, np.zeros(len(x), dtype=bool)
        hit, part = passages.first_hits(x, way, master[at], master_path[at], stops)
        some = np.flatnonzero(hit >= 0)
        if not some.size:
            return cut
        hit, part, x, way = hit[some], part[some], x[some], way[some]
        corners, carried = master[at[hit]], master_path[at[hit]]
        xi, _ = compiled.closest_point(x, corners)
        foot, _, normal = facets.frame(corners, xi)
        far = np.einsum("ni,ni->n", normal, x - foot) > OUTSIDE * facets.size(corners)
        points, then = x + part[:, None] * way, corners + part[:, None, None] * carried
        xi, _ = compiled.closest_point(points, then)
        _, _, normal = facets.frame(then, xi)
        shape, _, _ = facets.shape(xi, at.shape[1])
        slides = way - np.einsum("nc,nci->ni", shape, carried)
        slides -= np.einsum("ni,ni->n", slides, normal)[:, None] * normal
        beyond = self.across(points + _GRAZES * slides, hit, master, master_path, part)
        cut[some] = far & (beyond < 0)
        return cut


def middles(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Middles [m] and normals of facets, shape (m, 3) each."""
    middle = np.full((len(corners), 2), 1.0 / 3.0 if corners.shape[1] == 3 else 0.0)
    place, _, normal = facets.frame(corners, middle)
    return place, normal
