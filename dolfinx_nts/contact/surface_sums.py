"""Facets of a slave over those of a master, and what their points contribute to its nodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from dolfinx_nts.contact.contact_measure import Batch
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.types import FloatArray, IntArray

_STILL = np.zeros(3), np.zeros(3)


@dataclass(frozen=True, eq=False, kw_only=True)
class FacetAttachment(Batch):
    """Facets of a slave over facets of a master, see `Attachment`; axis 0 = pair of these."""

    slave: Surface
    master: Surface
    own: IntArray
    other: IntArray
    path = _STILL
    shares = None

    @property
    def surfaces(self) -> tuple[Surface, Surface]:
        """Those of the slave and of the master."""
        return self.slave, self.master

    @property
    def numbers(self) -> tuple[IntArray, IntArray]:
        """The slave's nodes, and the points that the master's patches depend on."""
        return self.slave.face_nodes[self.own], self.master.patches[self.other]

    @cached_property
    def sides(self) -> tuple[Points, Points]:
        """Nodes that these depend on."""
        corners = self.slave.material.joined(self.slave.face_nodes[self.own])
        return corners, self.master.facet_nodes.select(self.other)

    @cached_property
    def weights(self) -> FloatArray | None:
        """Weights of these in the corners, (n, corners of both, nodes); None if they are one."""
        control, material = self.master.facet_weights, self.slave.material
        if material.are_nodes and control is None:
            return None
        of_corners = material.weights[self.slave.face_nodes[self.own]]
        n, corners, nodes = of_corners.shape
        if control is None:
            width = self.master.facet_nodes.nodes.shape[1]
            of_master = np.broadcast_to(np.eye(width), (n, width, width))
        else:
            of_master = control[self.other]
        own = np.einsum("nca,cd->ncda", of_corners, np.eye(corners))
        out = np.zeros((n, corners + of_master.shape[1], corners * nodes + of_master.shape[2]))
        out[:, :corners, : corners * nodes] = own.reshape(n, corners, corners * nodes)
        out[:, corners:, corners * nodes :] = of_master
        return out

    def place(self, i: int) -> str:
        """The facets' numbers."""
        return f"facets {int(self.own[i])} and {int(self.other[i])}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Sums(Batch):
    """What points contribute to; axis 0 = point.

    Attributes:
        slaves: How many there are.
        element: Element that has the point, in ascending order, shape (n,).
        slot: Slaves whose gaps it is a part of, one at each corner of its facet; -1: none.
        share: Its parts C_qA in their gaps [-], 0 where there is none, shape (n, corners).
        shape: Weights of the facet's corners in it, shape (n, corners).
        cut: Where on the master's facets they were when they were chosen, shape (n, 2).
    """

    slaves: int
    element: IntArray
    slot: IntArray
    share: FloatArray
    shape: FloatArray
    cut: FloatArray

    @cached_property
    def _incidence(self) -> Any:
        """Which slave is at which corner of which point."""
        n, corners = self.slot.shape
        row, column = self.slot.ravel(), np.arange(n * corners)
        on = row >= 0
        entries = np.ones(on.sum()), (row[on], column[on])
        return scipy.sparse.csr_array(entries, shape=(self.slaves, n * corners))

    def by_slave(self, values: FloatArray) -> FloatArray:
        """Sums of what points have at each corner of theirs (n, corners, k), shape (slaves, k)."""
        return self._incidence @ values.reshape(self.slot.size, values.shape[2])

    def to_slaves(self, values: FloatArray) -> FloatArray:
        """C times values of points, (n,) or (n, k)."""
        columns = values if values.ndim > 1 else values[:, None]
        found = self.by_slave(self.share[:, :, None] * columns[:, None])
        return found.reshape(self.slaves, *values.shape[1:])

    def at_corners(self, values: FloatArray) -> FloatArray:
        """Values of slaves (slaves, ..) at each point's corners, 0 at others, (n, corners, ..)."""
        padded = np.concatenate([values, np.zeros((1, *values.shape[1:]))])
        return padded[self.slot]

    def to_points(self, values: FloatArray) -> FloatArray:
        """C^T times values of slaves (slaves, ..), shape (n, ..)."""
        return np.einsum("nc,nc...->n...", self.share, self.at_corners(values))

    def moves(self, attachment: FacetAttachment, foot: FloatArray) -> list[Any]:
        """Weights of each surface's points in the motion of slaves against their feet, sparse.

        Args:
            attachment: Facets of the elements.
            foot: Weights of the control points of the master's facets in the points' feet.
        """
        if attachment.master.weights is not None:
            weights = attachment.master.weights[attachment.other[self.element]]
            foot = np.einsum("nk,nkp->np", foot, weights)
        # Corners without a slave have one beyond the last.
        slave = np.where(self.slot < 0, self.slaves, self.slot)
        of_slaves = _sparse(self.share, slave, self.slaves + 1).T.tocsr()[: self.slaves]
        both = zip(attachment.surfaces, attachment.numbers, (self.shape, -foot), strict=True)
        return [
            of_slaves @ _sparse(weights, numbers[self.element], len(surface.points))
            for surface, numbers, weights in both
        ]


def _sparse(values: FloatArray, column: IntArray, number: int) -> Any:
    """Rows of so many columns with the same number of entries each, at given columns (n, k)."""
    n, k = values.shape
    start = np.arange(0, n * k + 1, k)
    return scipy.sparse.csr_array((values.ravel(), column.ravel(), start), shape=(n, number))
