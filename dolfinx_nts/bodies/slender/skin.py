"""The whole skin of a beam or shell: points at its nodes, and the facets between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dolfinx_nts.arrays import FloatArray, IntArray
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh

#: Parts of a shell's skin.
SIDES = ("bottom", "top", "edge")


class Hull(NamedTuple):
    """A closed skin, the same on all ranks; the points of a node follow each other.

    Attributes:
        node: Node of each point, shape (p,).
        weights: Of the node's vectors, shape (p, vectors).
        original: Number of each point, whatever the partition, shape (p,).
        facets: Corners, cyclic and counter-clockwise seen from outside, shape (m, 4).
        part: Of each facet, of a shell as of `SIDES`, of a beam 0, shape (m,).
    """

    node: IntArray
    weights: FloatArray
    original: IntArray
    facets: IntArray
    part: IntArray


def _ranked(skeleton: DirectorMesh) -> IntArray:
    """Number of each node in the order of files."""
    rank = np.empty_like(skeleton.order)
    rank[skeleton.order] = np.arange(len(rank))
    return rank


def of_shell(skeleton: DirectorMesh) -> Hull:
    """Skin of a shell: phi - D, then phi + D of each node."""
    cells, edges, n = skeleton.cells, skeleton.edges, len(skeleton.x)
    a, b = edges.T
    facets = [
        2 * cells[:, ::-1], 2 * cells + 1, np.stack([2 * a, 2 * b, 2 * b + 1, 2 * a + 1], axis=1)
    ]  # fmt: skip
    point = np.arange(2 * n)
    weights = np.column_stack([np.ones(2 * n), 2.0 * (point % 2) - 1.0])
    original = (2 * _ranked(skeleton)[:, None] + np.arange(2)).ravel()
    part = np.repeat(np.arange(3), [len(f) for f in facets])
    return Hull(point // 2, weights, original, np.concatenate(facets), part)


def of_beam(skeleton: DirectorMesh, outline: FloatArray) -> Hull:
    """Skin of a beam: polygons at its nodes, and at its ends fans about their centres.

    Args:
        skeleton: Nodes.
        outline: Corners of the polygon over the directors' length, counter-clockwise, an even
            number, shape (k, 2).
    """
    k, n, cells = len(outline), len(skeleton.x), skeleton.cells
    corner, following = np.arange(k), np.roll(np.arange(k), -1)
    starts, stops = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    a, b = ((k + 1) * ends[:, None] for ends in (starts, stops))
    facets = [np.stack([a + corner, a + following, b + following, b + corner], axis=-1)]
    every = np.arange(n)
    fan = np.stack([np.full(k // 2, k), *(np.roll(corner, -i)[::2] for i in range(3))], axis=1)
    for other, way in ((stops, -1), (starts, 1)):
        # The first node of a line has no cell that ends there.
        ends = np.setdiff1d(every, other)
        caps = (k + 1) * ends[:, None, None] + fan
        facets.append(caps[:, :, [0, 1, 2, 3][::way]])
    weights = np.zeros((k + 1, 4))
    weights[:, 0], weights[:k, 1:3] = 1.0, outline
    original = ((k + 1) * _ranked(skeleton)[:, None] + np.arange(k + 1)).ravel()
    whole = np.concatenate([f.reshape(-1, 4) for f in facets])
    part = np.zeros(len(whole), dtype=np.int64)
    return Hull(np.repeat(every, k + 1), np.tile(weights, (n, 1)), original, whole, part)
