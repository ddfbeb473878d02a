"""How far points of a surface are from each other along it: what lies beside a point of its own."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from dolfinx_nts.kernels import facets as facet_math
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Ways along the surface are known up to this many facets.
_FAR = 3.0
#: A facet is beside a point as long as the way to it along the surface is not longer than this
#: times that through space. About a fold whose sides close by less than 37 degrees it is not.
_RATIO = 3.0
#: A way is shorter if it is so by more than rounding.
_SHORTER = 1.0 - 1e-12


class Neighbourhoods:
    """Which facets of a surface are beside which of its points.

    Facets that share a corner with a facet of the point always are, others by the way along edges
    and diagonals of facets, in the reference.

    Args:
        at: Facets of the surface, shape (m, nc).
        reference: Reference positions of its points [m], shape (p, 3).
    """

    def __init__(self, at: IntArray, reference: FloatArray) -> None:
        self._at, self._number = at, len(reference)
        pairs = np.concatenate([at[:, both] for both in permutations(range(at.shape[1]), 2)])
        one, two = np.divmod(np.unique(pairs @ [self._number, 1]), self._number)
        length = np.linalg.norm(reference[one] - reference[two], axis=1)
        limit = np.zeros(self._number)
        np.maximum.at(limit, at, _FAR * facet_math.size(reference[at])[:, None])
        self._key, self._way = _ways(one, two, length, limit)
        every = np.arange(self._number)
        ring = np.concatenate([one * self._number + two, every * self._number + every])
        self._way[np.searchsorted(self._key, ring)] = -1.0

    def beside(self, point: IntArray, facet: IntArray, distance: FloatArray) -> BoolArray:
        """Return whether facets are beside points.

        Args:
            point: Positions of points in the surface, shape (n,).
            facet: Facets, shape (n,).
            distance: Through space [m], shape (n,).
        """
        key = point[:, None] * self._number + self._at[facet]
        i = np.searchsorted(self._key, key).clip(max=len(self._key) - 1)
        way = np.where(self._key[i] == key, self._way[i], np.inf).min(axis=1)
        return way <= _RATIO * distance


def _ways(
    one: IntArray, two: IntArray, length: FloatArray, limit: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Shortest ways between nodes of a graph.

    Args:
        one: Ends of the edges, both directions, ascending, shape (k,).
        two: Their other ends, shape (k,).
        length: Of the edges [m], shape (k,).
        limit: Longest way of interest from each node [m], shape (p,).

    Returns:
        Number of the first node times p plus that of the second, ascending, and the ways [m].
    """
    p = len(limit)
    start = np.searchsorted(one, np.arange(p + 1))
    every = np.arange(p)
    key = np.concatenate([one * p + two, every * p + every])
    way = np.concatenate([length, np.zeros(p)])
    order = np.argsort(key)
    key, way = key[order], way[order]
    new_key, new_way = one * p + two, length
    while len(new_key):
        source, end = np.divmod(new_key, p)
        count = start[end + 1] - start[end]
        first = np.repeat(start[end] - np.concatenate([[0], np.cumsum(count)[:-1]]), count)
        edge = first + np.arange(count.sum())
        source, longer = np.repeat(source, count), np.repeat(new_way, count) + length[edge]
        short = longer <= limit[source]
        new_key, new_way = _least(source[short] * p + two[edge[short]], longer[short])
        i = np.searchsorted(key, new_key).clip(max=len(key) - 1)
        better = (key[i] != new_key) | (new_way < _SHORTER * way[i])
        new_key, new_way = new_key[better], new_way[better]
        key, way = _least(np.concatenate([key, new_key]), np.concatenate([way, new_way]))
    return key, way


def _least(key: IntArray, value: FloatArray) -> tuple[IntArray, FloatArray]:
    """Different keys, ascending, and the least value of each."""
    # Of rows that are sorted already, one after the other, this is a merge.
    order = np.argsort(key, kind="stable")
    key, value = key[order], value[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    return key[first], np.minimum.reduceat(value, first) if len(first) else value
