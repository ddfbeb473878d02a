"""Contact of the sharp edges of one body with those of another (theory section 18).

The difference of two edges is a parallelogram, whose gap from the origin is that of the edges: the
measure is `FacetGap`, at points of its own, and the law is that of contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_measure import Batch
from dolfinx_nts.contact.edges import SHARES, Edges, Pairs, within
from dolfinx_nts.contact.surfaces import Surface, gather_each
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.parallel import global_sum
from dolfinx_nts.state import EdgeHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

_STILL = np.zeros(3), np.zeros(3)


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeAttachment(Batch):
    """Edges of two surfaces, by positions of their ends in these, (n, 2) each; see `Attachment`."""

    slave: Surface
    master: Surface
    own: IntArray
    other: IntArray
    path = _STILL

    @property
    def surfaces(self) -> tuple[Surface, Surface]:
        """Those of the slave and of the master."""
        return self.slave, self.master

    @property
    def numbers(self) -> tuple[IntArray, IntArray]:
        """The edges' ends."""
        return self.own, self.other

    @property
    def shares(self) -> FloatArray:
        """Weights of the ends in a_1 and in the corners of the parallelogram."""
        return np.broadcast_to(SHARES, (len(self.own), *SHARES.shape))

    @cached_property
    def sides(self) -> tuple[Points, ...]:
        """Nodes that both ends of an edge depend on, one end after the other."""
        both = zip(self.surfaces, self.numbers, strict=True)
        return tuple(_at_ends(surface.material, ends) for surface, ends in both)

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of these nodes in the same points."""
        each = []
        for i, surface, ends in zip((0, 2), self.surfaces, self.numbers, strict=True):
            weights = surface.material.weights[ends]
            found = np.einsum("pe,nek->npek", SHARES[:, i : i + 2], weights)
            each.append(found.reshape(len(ends), len(SHARES), 2 * weights.shape[2]))
        return np.concatenate(each, axis=2)

    def place(self, i: int) -> str:
        """Numbers of the ends' nodes in the users' meshes."""
        both = zip(self.surfaces, self.numbers, strict=True)
        one, two = (surface.original[ends[i]].tolist() for surface, ends in both)
        return f"edges of nodes {one} and {two}"


def _at_ends(material: Points, ends: IntArray) -> Points:
    """Points at edges' ends (n, 2) as one point of all their nodes."""
    m, n = material, len(ends)
    arrays: tuple[Any, ...] = (m.nodes, m.weights, m.reference, m.fixed, m.places)
    both = (a[ends].reshape(n, 2 * a.shape[1], *a.shape[2:]) for a in arrays)
    return Points(m.body, *both)


class EdgeElements(ContactElements):
    """Elements of edges, which also say what holds each body; see `ContactElements`."""

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"edges of {self.pair.name}"

    def resultant(self, part: Any, k: int, u: FloatArray) -> FloatArray:
        """As of `Elements.resultant`. Collective."""
        side = self.attachment.sides[k]
        y = side.reference + side.nodal(u)
        start = sum(3 * other.nodes.shape[1] for other in self.attachment.sides[:k])
        force = -part.residual[:, start : start + 3 * side.nodes.shape[1]].reshape(y.shape)
        sums = (force * side.places[:, :, None]).sum(axis=(0, 1)), cross(y, force).sum(axis=(0, 1))
        place = 0.5 * np.einsum("nk,nki->i", side.weights, y)
        return np.stack([*sums, place, np.full(3, float(len(y)))])


class EdgeContact:
    """Sharp convex edges of a pair's slave, which must not pass through those of its master.

    They are those of the bodies' whole boundaries that have a facet in the pair's surfaces. They
    are found when the surfaces come near each other for the first time.

    Args:
        pair: The pair.
        bodies: Numbers of its bodies in the system.
        before: Those of pairs that were declared before, whose edges it leaves to them.
    """

    def __init__(
        self, pair: Any, bodies: tuple[int, ...], before: Sequence[EdgeContact]
    ) -> None:
        self.pair, self.bodies = pair, bodies
        self._before = [other for other in before if {*other.bodies} == {*bodies}]

    @cached_property
    def edges(self) -> tuple[Edges, Edges]:
        """Those of the slave and of the master. Collective."""
        edges: tuple[Edges, Edges] = self.pair.sharp_edges
        return edges

    @cached_property
    def ends(self) -> list[IntArray]:
        """Their ends among the points of the pair's surfaces, shape (n, 2)."""
        both = zip(self.edges, self.pair.surfaces, strict=True)
        return [np.searchsorted(s.points, e.surface.points[e.ends]) for e, s in both]

    @cached_property
    def mine(self) -> BoolArray:
        """Which of the slave's edges this rank computes."""
        slave = self.pair.slave
        comm = slave.body.comm
        mine: BoolArray = slave.original[self.ends[0]].sum(axis=1) % comm.size == comm.rank
        return mine

    @cached_property
    def size(self) -> float:
        """Of the smallest facet [m]."""
        return min(surface.smallest for surface in self.pair.surfaces)

    @cached_property
    def lengths(self) -> list[FloatArray]:
        """Of the edges in the reference [m], shape (n,) each."""
        ends = (edges.surface.reference[edges.ends] for edges in self.edges)
        return [np.linalg.norm(x[:, 1] - x[:, 0], axis=1) for x in ends]

    def positions(self, u: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Positions of all points of both boundaries in the pair's frame [m]. Collective.

        Args:
            u: Owned displacements of each body [m].
        """
        moved = gather_each([edges.surface for edges in self.edges], u)
        slave, master = (a + b for a, b in zip(self._references, moved, strict=True))
        return slave, master

    @cached_property
    def _references(self) -> list[FloatArray]:
        return [edges.surface.reference - self.pair.origin for edges in self.edges]

    def nodal_forces(self, history: EdgeHistory) -> FloatArray:
        """Forces of its edges at the points of the slave, half of each at either end [N], (p,).

        Collective.
        """
        force = np.zeros(len(self.pair.slave.points))
        if len(history.pair):
            np.add.at(force, self.ends[0][history.pair[:, 0]], 0.5 * history.force[:, None])
        return global_sum(self.pair.slave.body.comm, force)

    def meets(self, u: Sequence[FloatArray], rise: float, at: BoolArray) -> bool:
        """Whether an edge from one of these points of the slave meets one of the master's.

        Collective.

        Args:
            u: Owned displacements of each body [m].
            rise: The farthest the two are from each other, over the length of the slave's.
            at: The points, shape (p,).
        """
        x, reach = self.positions(u), rise * self.lengths[0]
        found = self.within(x, float(reach.max(initial=0.0)))
        near = Pairs(self.edges, found).closest(x, [np.zeros_like(a) for a in x], np.inf)
        own, close = found[:, 0], np.abs(near.gap[:, 0]) <= reach[found[:, 0]]
        return bool((near.meet[:, 0] & close & at[self.ends[0][own]].any(axis=1)).any())

    def within(self, x: tuple[FloatArray, FloatArray], reach: float) -> IntArray:
        """Its pairs of edges that are nearer than a reach, see `edges.within`.

        Without those that nothing can move, those of pairs declared before, and those that share a
        node. Collective.
        """
        found = within(self.edges, x, reach)
        sides = zip(self.pair.surfaces, self.ends, found.T, strict=True)
        moves = [~surface.fixed[ends[k]].all(axis=(1, 2)) for surface, ends, k in sides]
        keep = moves[0] | moves[1]
        for other in self._before:
            for one, two in ((0, 1), (1, 0)):
                if (other.bodies[one], other.bodies[two]) == self.bodies:
                    keep &= ~(other.has(one, self, 0, found) & other.has(two, self, 1, found))
        if self.bodies[0] == self.bodies[1]:
            one, two = (e.ends[k] for e, k in zip(self.edges, found.T, strict=True))
            keep &= (one[:, :, None] != two[:, None, :]).all(axis=(1, 2))
        return found[keep]

    def has(self, side: int, other: EdgeContact, k: int, found: IntArray) -> BoolArray:
        """Which edges of side k of another one's pairs (n, 2) are among those of a side here."""
        here, there = (_keys(e) for e in (self.edges[side], other.edges[k]))
        return np.isin(there[found[:, k]], here)


def _keys(edges: Edges) -> IntArray:
    """Numbers of edges that say which edge of the boundary it is."""
    low, high = np.sort(edges.ends, axis=1).T
    keys: IntArray = low * len(edges.surface.points) + high
    return keys
