"""Masters that stand flush with each other, whose faces between them may catch a slave."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, permutations
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact.search import apart, closest_facets
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.kernels.vectors import range_of
from dolfinx_nts.types import FloatArray

#: Facets lie on each other up to this part of their size, with normals of this cosine or less.
_ON, _OPPOSITE = 1e-3, -0.99


def hidden_facets(contacts: Sequence[Any], u: Sequence[FloatArray]) -> tuple[int, str] | None:
    """Facets of two masters of one slave that lie on each other. Collective.

    A node that slides over the seam of the two may be caught by such a face, which is inside the
    one body that the two look like.

    Args:
        contacts: Those of the system, of which those with a master body count.
        u: For each of them the owned displacements of its master's body [m].

    Returns:
        How many facets, and a sentence with a remedy; None where there are none.
    """
    masters = [
        (pair, pair.master, pair.master.positions(moved))
        for pair, moved in zip(contacts, u, strict=True)
        if len(pair.bodies) == 2
    ]
    of: dict[int, list[Any]] = {}
    for one in masters:
        of.setdefault(id(one[0].slave.body), []).append(one)
    count, text = 0, ""
    for one, two in chain.from_iterable(map(_near_each_other, of.values())):
        bodies = one[0].slave.body, one[1].body, two[1].body
        beside = len(set(map(id, bodies))) == 3
        for (pair, surface, x), (other, its, y) in permutations((one, two)) if beside else ():
            on = _lying_on(surface, x, its, y)
            if on.size and not text:
                nodes = sorted(int(n) for n in surface.original[surface.facets[on[0]]])
                text = (
                    f"the facet of nodes {nodes} of {surface.body.name!r} lies on one of "
                    f"{its.body.name!r}, and both are masters, of {pair.name!r} and "
                    f"{other.name!r}: it may catch a node of {pair.slave.body.name!r} that slides "
                    "over the seam; leave out of both masters the faces that touch each other"
                )
            count += len(on)
    return (count, text) if count else None


def _near_each_other(masters: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
    """Two and two masters of one slave whose boxes are as good as in touch."""
    boxes = np.array([range_of(x) for _, _, x in masters])
    sizes = (boxes[:, 0] + boxes[:, 1]).max(axis=1)
    for i, one in enumerate(masters):
        outside = -(boxes[i] + boxes[i + 1 :, ::-1]).min(axis=(1, 2))
        near = outside < _ON * (sizes[i] + sizes[i + 1 :])
        for j in np.flatnonzero(near):
            yield one, masters[i + 1 + j]


def _lying_on(
    surface: Surface, x: FloatArray, other: Surface, y: FloatArray
) -> npt.NDArray[np.signedinteger[Any]]:
    """Facets whose middles lie on those of another surface that face the opposite way."""
    corners, its = x[surface.facets], y[other.facets]
    size = fc.size(corners)
    if apart(corners.mean(axis=1), its, _ON * float(size.max())):
        return np.empty(0, dtype=np.int64)
    found = closest_facets(corners.mean(axis=1), its, reach=_ON * size)
    near = np.flatnonzero(found.facet >= 0)
    middle = np.full((len(near), 2), 1 / 3 if corners.shape[1] == 3 else 0.0)
    mine = fc.frame(corners[near], middle)[2]
    theirs = fc.frame(its[found.facet[near]], found.xi[near])[2]
    return near[np.einsum("ni,ni->n", mine, theirs) <= _OPPOSITE]
