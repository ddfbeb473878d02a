"""Sharp convex edges of bodies, and which of two bodies' edges may meet (theory section 18)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.contact.convex_edges import SHARP
from dolfinx_nts.kernels import library, patches
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Weights of a_1, a_2, b_1, b_2 in x_s = a_1 and in a_1 + b_j - a_i, ij = 11, 21, 22, 12.
SHARES = np.array(
    [[1, 0, 0, 0], [0, 0, 1, 0], [1, -1, 1, 0], [1, -1, 0, 1], [0, 0, 0, 1]], dtype=float
)
#: Edges with a smaller sine between them are parallel. Ends of edges are their nodes', as far as
#: this in convective coordinates. Cosine by which the way between edges may leave the cones of
#: normals that they belong to, as where faces bow. An edge is level with a facet up to this cosine;
#: then so much of it belongs to a node over the facet, which lies on it up to this part of the
#: edges' lengths. Nodes beyond the facet's rim are not the facet's up to the steeper cosine.
LEVEL = 0.1
#: Two edges that meet with a smaller cosine are one line.
_STRAIGHT = -0.95
_LIMITS = library.EdgeLimits(
    parallel=0.05, end=1e-6, outside=5e-2, level=LEVEL, steep=0.6, by_node=0.05, flat=1e-5
)


@dataclass(frozen=True, eq=False)
class Edges:
    """Sharp convex edges of a boundary; axis 0 = edge.

    Attributes:
        surface: The whole boundary of a body.
        ends: Positions of their ends among the surface's points, shape (n, 2).
        corners: Of each of the two facets that meet there the corners, shape (n, 2, nc).
        inside: Which of these are of the part of it that edges were asked for, shape (n, 2).
        goes_on: From which ends another of the edges goes straight on, shape (n, 2).
    """

    surface: Any
    ends: IntArray
    corners: IntArray
    inside: BoolArray
    goes_on: BoolArray


class Near(NamedTuple):
    """Pairs of edges where they come closest; axis 0 = pair.

    Attributes:
        gap: Distance along the normal at the start and at the end of a way, negative where they
            have passed each other [m], shape (n, 2).
        meet: Whether they meet between their ends, and along normals of both, at the start, at the
            end, and where the gap closes between, shape (n, 3).
        turned: Whether a_1 and a_2 have to change places for the normal to point out of the master
            at the start, shape (n,).
        node: Whether an end of the slave's edge is, at the end, over a facet of the master (1), on
            it (2), or beyond its edge or below (end 1: 3, end 2: 4), so near to the place where
            they meet that the contact is the node's, in the last case if that has any; else 0,
            shape (n,).
        beyond: Which end of the slave's edge, 1 or 2, is at the end beyond the master's edge, of
            edges that are no steeper there than `steep`; else 0, shape (n,).
        corner: At which end of the master's edge, 1 or 2, that another one goes straight on from
            they meet at the start or at the end; else 0, shape (n,).
        touch: Whether they meet, with a small gap at the start or one that closes, shape (n,).
        through: Whether they pass each other, shape (n,).
        some: How many touch, and how many pass each other, shape (2,).
    """

    gap: FloatArray
    meet: BoolArray
    turned: BoolArray
    node: IntArray
    beyond: IntArray
    corner: IntArray
    touch: BoolArray
    through: BoolArray
    some: IntArray


class Pairs:
    """Pairs of edges that are near each other.

    Args:
        edges: Those of the slave and of the master.
        numbers: Of edges of the two, as from `within`, shape (n, 2).
    """

    def __init__(self, edges: tuple[Edges, Edges], numbers: IntArray) -> None:
        self.numbers, n = np.ascontiguousarray(numbers), len(numbers)
        # Space that is written anew in each step costs less than new space.
        self._places = [np.empty((2, *e.surface.reference.shape)) for e in edges]
        given = [(e.ends, e.corners, e.inside, e.goes_on) for e in edges]
        sides = [
            library.Edges(
                e.corners.shape[2], *(a.ctypes.data for a in (*places, *arrays))
            )
            for e, places, arrays in zip(edges, self._places, given, strict=True)
        ]
        flags = np.zeros((n, 2), dtype=bool)
        nodes: Any = np.zeros((n, 3), dtype=np.uint8)
        self._near = Near(
            np.empty((n, 2)), np.empty((n, 3), dtype=bool), np.empty(n, dtype=bool), nodes[:, 0],
            nodes[:, 1], nodes[:, 2], flags[:, 0], flags[:, 1], np.zeros(2, dtype=np.int64),
        )  # fmt: skip
        gap, meet, turned, *_, some = self._near
        arrays = self.numbers, gap, meet, turned, nodes, flags, some
        self._given = given, sides, nodes, flags
        self._of_kernel = [*map(ctypes.byref, (*sides, _LIMITS))], [a.ctypes.data for a in arrays]

    def __len__(self) -> int:
        return len(self.numbers)

    def closest(
        self,
        x: Sequence[FloatArray],
        ways: Sequence[FloatArray],
        reach: float,
        near: float = 0.0,
        limit: float = 0.0,
    ) -> Near:
        """Where they come closest; the next call writes over it.

        Args:
            x: Positions of all points of both surfaces [m].
            ways: Their motion [m].
            reach: Pairs farther apart do not meet on these ways [m].
            near: Distance that counts as none [m].
            limit: Gap at the start up to which edges touch that need not come nearer [m].
        """
        for places, *both in zip(self._places, x, ways, strict=True):
            places[0], places[1] = both
        first, last = self._of_kernel
        library.load().closest_edges(*first, reach, near, limit, len(self.numbers), *last)
        return self._near


def sharp_edges(surface: Any, of: Any) -> Edges:
    """Edges of a reference at which two facets meet, sharp and convex.

    Args:
        surface: The whole boundary of a body, a `Surface`.
        of: A part of it: one of the facets at least is to be in there.
    """
    # The others have no edge in common with the part.
    near = np.isin(surface.points, of.points)[surface.facets].sum(axis=1) >= 2
    facets, nc = surface.facets[near], surface.facets.shape[1]
    corners = surface.reference[facets]
    across = patches.neighbours(facets, corners, sharp=-np.inf)
    one, edge = np.nonzero(across >= 0)
    two = across[one, edge] // nc
    first = one < two
    one, two, edge = one[first], two[first], edge[first]
    ends = np.column_stack([facets[one, edge], facets[one, (edge + 1) % nc]])
    start, end = surface.reference[ends].transpose(1, 0, 2)
    inward = [corners[f].mean(axis=1) - 0.5 * (start + end) for f in (one, two)]
    normal = [cross(end - start, inward[0]), cross(start - end, inward[1])]
    normal = [n / np.linalg.norm(n, axis=1, keepdims=True) for n in normal]
    convex = _dot(normal[0], inward[1]) < 0.0
    sharp = convex & (_dot(*normal) < SHARP)
    both = np.column_stack([one, two])[sharp]
    corners = surface.points[facets[both]].reshape(-1, nc).tolist()
    wanted = [tuple(sorted(c)) in of.facet_points for c in corners]
    inside = np.array(wanted, dtype=bool).reshape(both.shape)
    chosen = inside.any(axis=1)
    ends = np.ascontiguousarray(ends[sharp][chosen])
    arrays = facets[both[chosen]], inside[chosen], _goes_on(ends, surface.reference)
    return Edges(surface, ends, *map(np.ascontiguousarray, arrays))


def _goes_on(ends: IntArray, x: FloatArray) -> BoolArray:
    """From which ends (n, 2) of edges one other goes straight on."""
    way = x[ends[:, 1]] - x[ends[:, 0]]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    inward = np.stack([way, -way], axis=1).reshape(-1, 3)
    order = np.argsort(ends, axis=None, kind="stable")
    _, first, count = np.unique(ends.ravel()[order], return_index=True, return_counts=True)
    one, two = (order[first[count == 2] + k] for k in (0, 1))
    straight = _dot(inward[one], inward[two]) < _STRAIGHT
    found = np.zeros(ends.size, dtype=bool)
    found[one[straight]] = found[two[straight]] = True
    return found.reshape(ends.shape)


def within(edges: tuple[Edges, Edges], x: tuple[FloatArray, FloatArray], reach: float) -> IntArray:
    """Numbers of edges (n, 2) of the slave and the master that are nearer than a reach, in order.

    Args:
        edges: Those of the slave and of the master.
        x: Positions of all points of both surfaces [m].
        reach: Distance beyond which none is wanted [m].
    """
    places = [p[e.ends] for p, e in zip(x, edges, strict=True)]
    middles = [p.mean(axis=1) for p in places]
    lengths = [np.linalg.norm(p[:, 1] - p[:, 0], axis=1) for p in places]
    if not all(map(len, middles)):
        return np.empty((0, 2), dtype=np.int64)
    radius = reach + 0.5 * sum(float(length.max()) for length in lengths)
    each = cKDTree(middles[0]).query_ball_tree(cKDTree(middles[1]), radius)
    own = np.repeat(np.arange(len(each)), [len(e) for e in each])
    other = np.concatenate([*map(np.sort, each), []]).astype(np.int64)
    # A ball around the longest edges holds many that short ones are far from.
    far = np.linalg.norm(middles[0][own] - middles[1][other], axis=1)
    close = far <= reach + 0.5 * (lengths[0][own] + lengths[1][other])
    return np.column_stack([own, other])[close]


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    product: FloatArray = np.einsum("...i,...i->...", a, b)
    return product
