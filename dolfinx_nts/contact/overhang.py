"""Slaves that reach over a master's rim, before which contact ends at the last of their nodes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.crossings import Finding
from dolfinx_nts.contact.search import closest_facets
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: All but this part of a contact's force must act at the rim: a body that tips stands on one edge.
_ELSEWHERE = 0.01
#: A node is beyond the rim if it is beside the master by this part of a facet, and more beside it
#: than above it.
_BESIDE = 0.05
#: The rim touches a facet that it is no farther above or below than this part of the distance from
#: the node that carries, unless the facet rises from the master by more than the second part, as
#: that of a ball does.
FLAT, _RISES = 0.2, 0.05
#: It tips to one side: the mean way to the rim is this part of its length, or more.
_ONE_SIDE = 0.5
#: Distance from the rim, in widths of the slave's surface, that is told, and that is grave.
_LEAST, _GRAVE = 0.05, 0.3


class Overhang(NamedTuple):
    """How far inside the rim a contact ends.

    Attributes:
        distance: From the nodes that carry to the rim [m], weighted by their forces.
        size: The same in widths of the slave's surface [-].
        node: The point of the slave that carries most.
    """

    distance: float
    size: float
    node: int


def overhang(
    x: FloatArray,
    facets: IntArray,
    force: FloatArray,
    corners: FloatArray,
    held: BoolArray | None = None,
    elsewhere: float = 0.0,
) -> Overhang | None:
    """Return how far inside the rim of a master contact ends, if all of its force acts there.

    Between nodes facets of the slave carry nothing. Where one of them reaches over the rim of the
    master, its nodes before the rim carry for the part up to there, so a body tips about these
    nodes, not about the rim.

    Args:
        x: Points of the slave's surface [m], shape (p, 3).
        facets: Its facets, shape (m, nc).
        force: Normal force of each point [N], >= 0, shape (p,).
        corners: Corners of the master's facets [m], shape (n, nc, 3).
        held: Points that carry in another contact, which hold what reaches over the rim, shape
            (p,); None: there are none.
        elsewhere: What the master's corners bear [N].
    """
    total, on = float(force.sum()) + elsewhere, (force > 0.0)[facets]
    part = on.any(axis=1) & ~on.all(axis=1)
    facets, on = facets[part], on[part]
    # A touch without force may have rounding in it, of any sign; most often some carry amid others.
    if not total > 0.0 or float(force[np.unique(facets)].sum()) < (1.0 - _ELSEWHERE) * total:
        return None
    corner = x[facets]
    at = closest_facets(corner[~on], corners, reach=np.inf)
    foot = np.full_like(corner, np.nan)
    foot[~on] = fc.frame(corners[at.facet], at.xi)[0]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, -1] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    way = corner - foot
    above = np.einsum("mki,mi->mk", way, normal)
    beside = np.linalg.norm(way - above[..., None] * normal[:, None], axis=2)
    beyond = (beside > _BESIDE * fc.size(corner)[:, None]) & (beside > np.abs(above))
    if held is not None:
        beyond &= ~held[facets]
    # From each corner to the nearest of the places at the rim below corners beyond it.
    arm = foot[:, None] - corner[:, :, None]
    way = np.where(beyond[:, None], np.linalg.norm(arm, axis=3), np.inf)
    chosen = way.argmin(axis=2)[..., None]
    height = np.abs(np.einsum("mkli,mi->mkl", arm, normal))
    nearest, height, rises = (
        np.take_along_axis(a, chosen, axis=2)[..., 0]
        for a in (way, height, _rises(corner, on, corners))
    )
    nearest[~(height <= FLAT * nearest) | rises] = np.inf
    way = np.take_along_axis(arm, chosen[..., None], axis=2)[:, :, 0]
    # The nearest last, as of several facets of a node it counts.
    order = np.argsort(-nearest[on])
    node = facets[on][order]
    inside, to_rim = np.full(len(x), np.inf), np.zeros_like(x)
    inside[node], to_rim[node] = nearest[on][order], way[on][order]
    rim = np.flatnonzero((force > 0.0) & np.isfinite(inside))
    if float(force[rim].sum()) < (1.0 - _ELSEWHERE) * total:
        return None
    aside = float(np.linalg.norm(force[rim] @ to_rim[rim]))
    if aside < _ONE_SIDE * float(force[rim] @ inside[rim]):
        return None
    mean = float(np.average(inside[rim], weights=force[rim]))
    size = mean / float(np.ptp(x, axis=0).max())
    node = int(rim[force[rim].argmax()])
    return Overhang(mean, size, node) if size > _LEAST else None


def _rises(corner: FloatArray, on: BoolArray, master: FloatArray) -> BoolArray:
    """Whether facets (m, nc, 3) rise from the master's (k, nc, 3) on the way between corners.

    From each corner that carries, `on` (m, nc), to the others: shape (m, nc, nc), that one first.
    """
    at = closest_facets(corner[on], master, reach=np.inf)
    normal = np.zeros_like(corner)
    normal[on] = fc.frame(master[at.facet], at.xi)[2]
    edge = corner[:, None] - corner[:, :, None]
    rise: FloatArray = np.einsum("mkli,mki->mkl", edge, normal)
    return rise > _RISES * np.linalg.norm(edge, axis=3)


def inside_rim(
    contact: Any,
    positions: tuple[FloatArray, ...],
    force: FloatArray,
    held: BoolArray | None = None,
    elsewhere: float = 0.0,
) -> Finding | None:
    """As `overhang`, of a contact, with a sentence and a remedy.

    Args:
        contact: A contact of two surfaces.
        positions: Of all points of both, as of `ContactPair.positions` [m].
        force: Normal force of each point of the slave, also of its edges [N].
        held: As of `overhang`.
        elsewhere: As of `overhang` [N].
    """
    (x, y), slave, master = positions, contact.slave, contact.master
    if not len(slave.facets):
        return None
    found = overhang(x, slave.facets, force, y[master.facets], held, elsewhere)
    if found is None:
        return None
    one, two, node = slave.body.name, master.body.name, int(slave.original[found.node])
    text = (
        f"facets of {one!r} reach over the rim of {two!r}, and all of contact {contact.name!r} "
        f"acts at their nodes before it, most at node {node}, inside the rim by "
        f"{found.distance:.3g}, or {found.size:.2g} of the surface's width: a body that tips "
        f"there turns about these nodes, not about the rim; use a finer mesh of {one!r} there, or "
        f"take {two!r} as the slave"
    )
    place, grave = x[found.node] + contact.origin, found.size > _GRAVE
    return Finding(
        "contact inside a rim", found.distance, found.size, place, (one, two), (node,), text, grave
    )
