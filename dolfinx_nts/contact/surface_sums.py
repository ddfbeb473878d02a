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
from dolfinx_nts.kernels import compiled
from dolfinx_nts.types import FloatArray, IntArray

_STILL = np.zeros(3), np.zeros(3)


@dataclass(frozen=True, eq=False, kw_only=True)
class FacetAttachment(Batch):
    """Facets of a slave over facets of a master, see `Attachment`; axis 0 = pair of these.

    Attributes:
        slave: Its surface.
        own: Facets of the slave, shape (n,).
        master: Surface of the master; None: it has none.
        other: Facets of the master, shape (n,), or zeros.
        path: As of `Attachment`.
    """

    slave: Surface
    own: IntArray
    master: Surface | None
    other: IntArray
    path: tuple[FloatArray, FloatArray] = _STILL
    shares = None

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """That of the slave, and of the master."""
        return (self.slave,) if self.master is None else (self.slave, self.master)

    @property
    def numbers(self) -> tuple[IntArray, ...]:
        """The slave's nodes, and the points that the master's patches depend on."""
        own = self.slave.face_nodes[self.own]
        return (own,) if self.master is None else (own, self.master.patches[self.other])

    @cached_property
    def sides(self) -> tuple[Points, ...]:
        """Nodes that these depend on."""
        corners = self.slave.material.joined(self.slave.face_nodes[self.own])
        if self.master is None:
            return (corners,)
        return corners, self.master.facet_nodes.select(self.other)

    @cached_property
    def weights(self) -> FloatArray | None:
        """Weights of these in the corners, (n, corners of both, nodes); None if they are one."""
        control = None if self.master is None else self.master.facet_weights
        material = self.slave.material
        if material.are_nodes and control is None:
            return None
        of_corners = material.weights[self.slave.face_nodes[self.own]]
        n, corners, nodes = of_corners.shape
        if control is None:
            width = sum(side.nodes.shape[1] for side in self.sides[1:])
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
        own = f"facet {int(self.own[i])}"
        return own if self.master is None else f"{own} and facet {int(self.other[i])}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Sums(Batch):
    """What points contribute to; axis 0 = point.

    Attributes:
        slaves: How many there are.
        element: Element that has the point, in ascending order, shape (n,).
        slot: Slaves whose gaps it is a part of, one at each corner of its facet; -1: none.
        share: Its parts C_qA in their gaps [-], 0 where there is none, shape (n, corners).
        shape: Weights of the facet's corners in it, shape (n, corners).
        hat: Shape functions of these slaves in it, >= 0, shape (n, corners).
        cut: Where on the master's facets they were when they were chosen, shape (n, 2).
    """

    slaves: int
    element: IntArray
    slot: IntArray
    share: FloatArray
    shape: FloatArray
    hat: FloatArray
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

    def how(self, multiplier: FloatArray, frame: FloatArray) -> compiled.Summed:
        """The same for kernels, of slaves that carry so much along directions."""
        number = int(self.element[-1]) + 1 if len(self.element) else 0
        return compiled.Summed(
            self.element, self.slot, self.shape, self.share, multiplier, frame, number
        )

    def carried(
        self, multiplier: FloatArray, frame: FloatArray, along: FloatArray
    ) -> FloatArray:
        """Multipliers of points (n, m) from those of slaves (slaves, m), whose forces are vectors.

        Args:
            multiplier: lambda_N, or lambda_N and forces along two directions.
            frame: These directions, shape (slaves, 2, 3).
            along: Those of the points, shape (n, 2, 3).
        """
        own = self.to_points(multiplier)
        if multiplier.shape[1] > 1:
            pull = self.to_points(np.einsum("nk,nki->ni", multiplier[:, 1:], frame))
            own[:, 1:] = np.einsum("nai,ni->na", along, pull)
        return own

    def moves(self, attachment: FacetAttachment, foot: FloatArray) -> list[Any]:
        """Weights of each surface's points in the motion of slaves against their feet, sparse.

        Args:
            attachment: Facets of the elements.
            foot: Weights of the control points of the master's facets in the points' feet.
        """
        master = attachment.master
        if master is not None and master.weights is not None:
            weights = master.weights[attachment.other[self.element]]
            foot = np.einsum("nk,nkp->np", foot, weights)
        # Corners without a slave have one beyond the last.
        slave = np.where(self.slot < 0, self.slaves, self.slot)
        of_slaves = _sparse(self.share, slave, self.slaves + 1).T.tocsr()[: self.slaves]
        both = zip(attachment.surfaces, attachment.numbers, (self.shape, -foot), strict=False)
        return [
            of_slaves @ _sparse(weights, numbers[self.element], len(surface.points))
            for surface, numbers, weights in both
        ]


def _sparse(values: FloatArray, column: IntArray, number: int) -> Any:
    """Rows of so many columns with the same number of entries each, at given columns (n, k)."""
    n, k = values.shape
    start = np.arange(0, n * k + 1, k)
    return scipy.sparse.csr_array((values.ravel(), column.ravel(), start), shape=(n, number))
