"""Sharp convex edges of surfaces, and which of two surfaces' edges may meet (theory section 18)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.contact.convex_edges import SHARP
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import patches
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Weights of a_1, a_2, b_1, b_2 in x_s = a_1 and in a_1 + b_j - a_i, ij = 11, 21, 22, 12.
SHARES = np.array(
    [[1, 0, 0, 0], [0, 0, 1, 0], [1, -1, 1, 0], [1, -1, 0, 1], [0, 0, 0, 1]], dtype=float
)
#: Least sine of the angle between edges that meet; others are parallel.
_PARALLEL = 0.05
#: Ends of edges belong to their nodes, as far as this in convective coordinates.
_END = 1e-6
#: Cosine by which the way between edges may leave the cones of normals that they belong to.
_OUTSIDE = 1e-6


class Edges(NamedTuple):
    """Sharp convex edges of a surface; axis 0 = edge.

    Attributes:
        ends: Positions of their ends among the surface's points, shape (n, 2).
        facets: The facets that meet there, shape (n, 2).
    """

    ends: IntArray
    facets: IntArray


class Near(NamedTuple):
    """Pairs of edges and where they come closest; axis 0 = pair.

    Attributes:
        own: Edges of the slave, shape (n,).
        other: Edges of the master, shape (n,).
        ends: Ends a_1, a_2, b_1, b_2 [m], shape (n, 4, 3).
        gap: Distance along the normal, negative where they have passed each other [m], shape (n,).
        inside: Whether they meet between their ends, and along normals of both, shape (n,).
        turned: Whether a_1 and a_2 have to change places for the normal to point out of the master.
    """

    own: IntArray
    other: IntArray
    ends: FloatArray
    gap: FloatArray
    inside: BoolArray
    turned: BoolArray


def sharp_edges(surface: Surface, of: Surface) -> Edges:
    """Edges of a reference at which two facets meet, sharp and convex.

    Args:
        surface: The whole boundary of a body.
        of: A part of it: one of the facets at least is to be in there.
    """
    facets, nc = surface.facets, surface.facets.shape[1]
    corners = surface.reference[facets]
    across = patches.neighbours(facets, corners, sharp=-np.inf)
    one, edge = np.nonzero(across >= 0)
    two = across[one, edge] // nc
    first = one < two
    one, two, edge = one[first], two[first], edge[first]
    ends = np.column_stack([facets[one, edge], facets[one, (edge + 1) % nc]])
    start, end = surface.reference[ends].transpose(1, 0, 2)
    inward = [corners[f].mean(axis=1) - 0.5 * (start + end) for f in (one, two)]
    normal = [np.cross(end - start, inward[0]), np.cross(start - end, inward[1])]
    normal = [n / np.linalg.norm(n, axis=1, keepdims=True) for n in normal]
    convex = np.einsum("ni,ni->n", normal[0], inward[1]) < 0.0
    wanted = [tuple(sorted(c)) in of.facet_points for c in surface.points[facets].tolist()]
    inside = np.array(wanted, dtype=bool)
    chosen = convex & (np.einsum("ni,ni->n", *normal) < SHARP) & (inside[one] | inside[two])
    return Edges(ends[chosen], np.column_stack([one, two])[chosen])


def near(
    slave: tuple[Surface, Edges, FloatArray], master: tuple[Surface, Edges, FloatArray],
    reach: float,
) -> Near:
    """Pairs of edges that are nearer than a reach, and are not parallel.

    Args:
        slave: Surface, its edges and the positions of all its points [m].
        master: The same of the master.
        reach: Distance beyond which none is wanted [m].
    """
    places = [x[edges.ends] for _, edges, x in (slave, master)]
    middles = [p.mean(axis=1) for p in places]
    lengths = [np.linalg.norm(p[:, 1] - p[:, 0], axis=1) for p in places]
    radius = reach + 0.5 * sum(float(length.max(initial=0.0)) for length in lengths)
    found = np.empty((0, 2), dtype=np.int64)
    if all(len(m) for m in middles):
        each = cKDTree(middles[0]).query_ball_tree(cKDTree(middles[1]), radius)
        own = np.repeat(np.arange(len(each)), [len(e) for e in each])
        found = np.column_stack([own, np.concatenate([*each, []]).astype(np.int64)])
    pairs = _closest(slave, master, found, reach)
    near_ones = np.abs(pairs.gap) <= reach
    return Near._make(a[near_ones] for a in pairs)


def _closest(
    slave: tuple[Surface, Edges, FloatArray], master: tuple[Surface, Edges, FloatArray],
    found: IntArray, reach: float,
) -> Near:
    """Pairs (n, 2) of edges where they come closest, without parallel ones."""
    own, other = found.T
    (a, one), (b, two) = (
        (x[edges.ends[k]], x[s.facets[edges.facets[k]]].mean(axis=2) - x[edges.ends[k]].mean(
            axis=1)[:, None])
        for (s, edges, x), k in ((slave, own), (master, other))
    )  # fmt: skip
    along, across = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0]
    normal = np.cross(across, along)
    size = np.linalg.norm(normal, axis=1)
    lengths = np.linalg.norm(along, axis=1) * np.linalg.norm(across, axis=1)
    normal /= np.where(size > 0.0, size, 1.0)[:, None]
    turned = np.einsum("ni,nki->n", normal, two) > 0.0
    normal[turned] *= -1.0
    between = a.mean(axis=1) - b.mean(axis=1)
    # Least squares of |a(s) - b(t)| in s, t of [-1, 1].
    matrix = np.stack([0.5 * along, -0.5 * across], axis=2)
    square = np.einsum("nij,nik->njk", matrix, matrix)
    straight = size > _PARALLEL * lengths
    square[~straight] = np.eye(2)
    right = -np.einsum("nij,ni->nj", matrix, between)
    where = np.linalg.solve(square, right[:, :, None])[:, :, 0]
    inside = (np.abs(where) < 1.0 - _END).all(axis=1)
    for sign, inward in ((1.0, two), (-1.0, one)):
        cosine = sign * np.einsum("ni,nki->nk", normal, inward) / np.linalg.norm(inward, axis=2)
        inside &= (cosine < _OUTSIDE).all(axis=1)
    gap = np.einsum("ni,ni->n", between, normal)
    pairs = Near(own, other, np.concatenate([a, b], axis=1), gap, inside, turned)
    return Near._make(values[straight] for values in pairs)
