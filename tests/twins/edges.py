"""Pairs of edges where they come closest, as `kernels/edges.c` has them."""

import numpy as np


def closest(
    edges, x, pairs, parallel=0.05, end=1e-6, outside=5e-2, level=0.1, steep=0.6, flat=1e-5,
    by_node=0.05,
):  # fmt: skip
    """Gap, whether they meet, whether a_1 and a_2 change places, nodes."""
    (a, one), (b, two) = (_sides(e, p, k) for e, p, k in zip(edges, x, pairs.T, strict=True))
    along, across = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0]
    normal = np.cross(across, along)
    lengths = np.linalg.norm(along, axis=1) * np.linalg.norm(across, axis=1)
    sine = np.linalg.norm(normal, axis=1) / lengths
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turned = np.einsum("ni,nki->n", normal, two) > 0.0
    normal[turned] *= -1.0
    between = a.mean(axis=1) - b.mean(axis=1)
    meet = sine > parallel
    where = np.full((len(pairs), 2), np.inf)
    matrix = 0.5 * np.stack([along, -across], axis=2)[meet]
    where[meet] = np.einsum("nji,ni->nj", np.linalg.pinv(matrix), -between[meet])
    on = edges[1].goes_on[pairs[:, 1], (where[:, 1] > 0.0).astype(int)]
    meet &= np.abs(where[:, 0]) < 1.0 - end
    meet &= np.abs(where[:, 1]) < np.where(on, 1.0 + end, 1.0 - end)
    held, beyond = np.zeros((2, len(pairs)), dtype=int)
    size = 0.5 * np.minimum(np.linalg.norm(along, axis=1), np.linalg.norm(across, axis=1))
    for f in range(2):
        cosine = np.einsum("ni,ni->n", normal, two[:, f])
        of_surface = edges[1].inside[pairs[:, 1], f]
        plane = np.cross(across, two[:, f])
        plane *= -np.sign(np.einsum("ni,ni->n", plane, two[:, 1 - f]))[:, None]
        plane /= np.linalg.norm(plane, axis=1)[:, None]
        into = np.cross(plane, across)
        into *= np.sign(np.einsum("ni,ni->n", into, two[:, f]))[:, None]
        ends = a - b.mean(axis=1)[:, None]
        over = np.einsum("nki,ni->nk", ends, into) > 0.0
        height = np.einsum("nki,ni->nk", ends, plane)
        last = (where[:, 0] > 0.0).astype(int)
        near = (np.abs(np.abs(where[:, 0]) - 1.0) < by_node) & (cosine > -level) & of_surface
        inside = over[np.arange(len(pairs)), last]
        height = height[np.arange(len(pairs)), last]
        kind = np.where(height > flat * size, 1, np.where(height > -flat * size, 2, 0))
        kind *= near & inside
        asked = near & (kind == 0) & (held == 0)
        held = np.where(kind > 0, np.maximum(np.where(held >= 3, 0, held), kind), held)
        held[asked] = 3 + last[asked]
        out = ~over.all(axis=1) & (cosine > -steep) & of_surface
        beyond[out] = np.where(over[:, 0], 2, 1)[out]
    for sign, inward in ((1.0, two), (-1.0, one)):
        cosine = sign * np.einsum("ni,nki->nk", normal, inward)
        meet &= (cosine < outside).all(axis=1)
    return np.einsum("ni,ni->n", between, normal), meet, turned, held, beyond


def _sides(edges, x, k):
    """Ends, and unit vectors from their middle to those of both facets."""
    ends = x[edges.ends[k]]
    inward = x[edges.corners[k]].mean(axis=2) - ends.mean(axis=1)[:, None]
    return ends, inward / np.linalg.norm(inward, axis=2, keepdims=True)
