"""Points of a slave's facets, and the slaves whose gaps are means of theirs.

Slaves are the nodes of a surface, each with a hat over the facets around it, and points have parts
in those of their facet (theory section 17). Which points take part is the pair's to say.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.candidates import Motion
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.contact.surface_sums import Sums
from dolfinx_nts.contact.surfaces import Surface, gather_each
from dolfinx_nts.kernels import facets
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Part of a node's area that has to lie over the master for it to be a candidate: rows of less
#: would be nearly those of its neighbours.
_COVERED = 1e-3
#: Part of a motion that a slave whose gap is prescribed may make along the normal, or its foot, and
#: gap over the size of the facets with which it lies on the master.
PRESCRIBED = 1e-2
#: Corners of a facet that lie beside each corner.
_BESIDE = {3: ~np.eye(3, dtype=bool), 4: np.roll(np.eye(4, dtype=bool), 1, axis=1)}
_BESIDE[4] = _BESIDE[4] | _BESIDE[4].T


class SurfaceCandidates(NamedTuple):
    """Slave nodes that may touch in a step, and the points whose gaps theirs are the means of.

    Attributes:
        node: As of `Candidates`, and so are normal, gap and length, means of the points'.
        facet: Zeros, of no meaning.
        patch: Zeros.
        xi: Zeros.
        normal: Unit normals, shape (n, 3).
        gap: g_A0 [m], shape (n,).
        length: Size of the facets [m], shape (n,).
        points: Those of the rank's facets.
    """

    node: IntArray
    facet: IntArray
    patch: IntArray
    xi: FloatArray
    normal: FloatArray
    gap: FloatArray
    length: FloatArray
    points: OverMaster

    def select(self, chosen: IntArray | BoolArray) -> SurfaceCandidates:
        """Some of the nodes, by number or by a mask; points stay."""
        nodal: Any = [*(a[chosen] for a in self[:-1]), self.points]
        return SurfaceCandidates(*nodal)


class OverMaster(NamedTuple):
    """Points of a slave's facets over a master; axis 0 = point.

    Attributes:
        own: Facets of the slave, shape (n,).
        other: Facets of the master, shape (n,).
        shape: Weights of the nodes of the facets' faces, shape (n, nodes).
        xi: Their feet on the master's facets at t_n, shape (n, 2).
        normal: Outward normals of the master there, shape (n, 3).
        gap: g_q [m], shape (n,).
        length: Size of the master's facet [m], shape (n,).
        cut: As of `Sums`, shape (n, 2).
        slot: Positions in the slave's `share` of those that are corners of the facet, or -1.
        hat: Phi_A of the facet's corners there, shape (n, nodes).
        part: w_q Phi_A, the reference area that these have there [m^2], shape (n, nodes).
    """

    own: IntArray
    other: IntArray
    shape: FloatArray
    xi: FloatArray
    normal: FloatArray
    gap: FloatArray
    length: FloatArray
    cut: FloatArray
    slot: IntArray
    hat: FloatArray
    part: FloatArray

    def select(self, chosen: IntArray | BoolArray) -> OverMaster:
        """Some of the points, by number or by a mask."""
        return OverMaster._make(a[chosen] for a in self)


def moved(
    pair: ContactPair, positions: Sequence[FloatArray], motion: Motion | None
) -> Sequence[FloatArray]:
    """Positions of all points of a pair's surfaces after a motion [m]. Collective."""
    if motion is None:
        return positions
    ways = gather_each(pair.surfaces, motion.paths)
    return tuple(x + way for x, way in zip(positions, ways, strict=True))


def check_slave(pair: ContactPair) -> None:
    """Raise a ValueError unless a pair may be integrated over its slave. Collective."""
    if not len(pair.slave.facets):
        raise ValueError(
            f'integration="surface": the slave, of {pair.slave.body.name!r}, has points alone; '
            'use integration="nodes"'
        )
    if pair.adjust:
        raise ValueError(
            f'adjust={pair.adjust!r}: closes the gaps of nodes, and integration="surface" '
            "takes its gaps at points between them; leave one of them out"
        )
    for surface in pair.surfaces:
        if surface.massless.any():
            raise ValueError(
                f'integration="surface": nodes of {surface.body.name!r} have no mass; use '
                'mass="consistent" for its surface, or integration="nodes"'
            )


class SlavePoints:
    """What points have in the slaves of this rank.

    Args:
        slave: The surface.

    Attributes:
        facets: Those that have slaves of this rank, shape (m,).
    """

    def __init__(self, slave: Surface) -> None:
        self._slave = slave
        self._position = np.full(len(slave.points), -1)
        self._position[slave.share] = np.arange(len(slave.share))
        self.facets = np.flatnonzero((self._position[slave.facets] >= 0).any(axis=1))

    def at(
        self, facet: IntArray, xi: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
        """Shape, slot, hat and part of points as of `OverMaster`.

        Args:
            facet: Their facets, shape (n,).
            xi: Where they are in these, shape (n, 2).
            weight: Part of the area of the facet's coordinates that each stands for, shape (n,).
        """
        slave = self._slave
        corners, nodes = slave.facets[facet], slave.face_nodes[facet]
        hats, slopes, _ = facets.shape(xi, corners.shape[1])
        sides = np.matmul(slopes.transpose(0, 2, 1), slave.reference[corners])
        area = weight * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        # A multiplier at each node of the face, though those of its other facets have no part.
        own_nodes = nodes[:, :, None] == corners[:, None]
        slot = np.where(own_nodes.any(axis=2), self._position[nodes], -1)
        hat = np.einsum("nkc,nc->nk", own_nodes, hats)
        return slave.shape(facet, xi), slot, hat, area[:, None] * hat

    @cached_property
    def supported(self) -> IntArray:
        """Points of the slave of which a support holds a coordinate, on all ranks alike, (m,)."""
        return np.flatnonzero(self._slave.fixed.any(axis=1))

    def hand_over(
        self, points: OverMaster, gap: FloatArray, normal: FloatArray
    ) -> OverMaster:
        """The same points, with hats of slaves handed on that supports hold on or in the master.

        The mean gap around such a slave has none of its own motion, and repeats those of its
        neighbours. So it has no multiplier, and those beside it on its facets have its hat, too:
        hats sum up to one as before, and a uniform pressure stays one. Where it keeps off, its mean
        is open while these press, and their hats stay narrow.

        Args:
            points: The points.
            gap: Of `supported` at the step's end, if it is prescribed [m], else inf, shape (m,).
            normal: Of the master there, shape (m, 3).
        """
        slave, at = self._slave, self.supported
        on = gap <= PRESCRIBED * np.sqrt(slave.area[at])
        on &= np.linalg.norm(normal * ~slave.fixed[at], axis=1) <= PRESCRIBED
        if not on.any():
            return points
        held = np.isin(np.arange(len(slave.points)), at[on])
        corners, nodes = slave.facets[points.own], slave.face_nodes[points.own]
        of_facet, beside = held[corners], _BESIDE[corners.shape[1]]
        to = beside & ~of_facet[:, None]
        # Beside a slave whose neighbours are held, too, is the corner across.
        to |= ~to.any(axis=2, keepdims=True) & ~of_facet[:, None]
        to = np.where(of_facet[:, :, None], to, np.eye(len(beside), dtype=bool))
        share = to / np.maximum(to.sum(axis=2, keepdims=True), 1)
        own = (nodes[:, :, None] == corners[:, None]).astype(float)
        passed = np.matmul(np.matmul(own, share), own.transpose(0, 2, 1))
        hat, part = (np.einsum("nk,nkl->nl", of, passed) for of in points[-2:])
        slot = np.where(held[nodes], -1, points.slot)
        return points._replace(slot=slot, hat=hat, part=part)

    @cached_property
    def none(self) -> OverMaster:
        """No points."""
        number, flat = np.empty(0, dtype=np.int64), np.empty((0, 2))
        shape = np.empty((0, self._slave.face_nodes.shape[1]))
        return OverMaster(
            number, number, shape, flat, np.empty((0, 3)), np.empty(0), np.empty(0), flat,
            shape.astype(np.int64), shape, shape,
        )  # fmt: skip

    def nodes(self, points: OverMaster) -> SurfaceCandidates:
        """The nodes of the rank that points make candidates of."""
        number, on = len(self._slave.share), points.slot >= 0
        slot, part = points.slot[on], points.part[on]

        def sums(values: FloatArray) -> FloatArray:
            """Sums over the points of a node, shape (share,)."""
            each = np.broadcast_to(values[:, None], on.shape)[on]
            return np.asarray(np.bincount(slot, part * each, number), dtype=float)

        covered = np.bincount(slot, part, number)
        node = np.flatnonzero(covered > _COVERED * self._slave.area[self._slave.share])
        means = [points.gap, points.length, *points.normal.T]
        gap, length, *normal = (sums(values)[node] / covered[node] for values in means)
        directions = np.stack(normal, axis=1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        chosen = np.append(np.isin(np.arange(number), node), False)[points.slot]
        area = np.where(chosen, np.append(covered, 1.0)[points.slot], 1.0)
        points = points._replace(part=np.where(chosen, points.part, 0.0) / area)
        none = np.zeros(len(node), dtype=np.int64)
        return SurfaceCandidates(
            node, none, none, np.zeros((len(node), 2)), directions, gap, length, points
        )

    def numbered(self, found: SurfaceCandidates) -> tuple[OverMaster, IntArray, BoolArray]:
        """Points of candidates in the order of their elements.

        Args:
            found: The candidates.

        Returns:
            The points, with the numbers of candidates for slots; their elements; which is the
            first of one.
        """
        number = np.full(len(self._slave.share) + 1, -1)
        number[found.node] = np.arange(len(found.node))
        slot = number[found.points.slot]
        points = found.points._replace(slot=slot).select((slot >= 0).any(axis=1))
        points = points.select(np.lexsort((points.other, points.own)))
        both = np.column_stack([points.own, points.other])
        new: Any = np.diff(both, axis=0, prepend=-1).any(axis=1)
        return points, np.cumsum(new) - 1, new


def sums_of(found: SurfaceCandidates, points: OverMaster, element: IntArray) -> Sums:
    """What points that are `numbered` contribute to candidates."""
    return Sums(
        slaves=len(found.node), element=element, slot=points.slot,
        share=np.where(points.slot >= 0, points.part, 0.0), shape=points.shape, hat=points.hat,
        cut=points.cut,
    )  # fmt: skip
