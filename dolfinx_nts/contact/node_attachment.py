"""Nodes of a slave, each with a facet of a master or with an obstacle, as points of bodies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinx_nts.contact.contact_measure import Batch
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.types import FloatArray, IntArray

_STILL = np.zeros(3), np.zeros(3)


@dataclass(frozen=True, eq=False, kw_only=True)
class NodeAttachment(Batch):
    """See `Attachment`.

    Attributes:
        slave: Its surface.
        node: Positions of the slaves in it, shape (n,).
        master: Surface of the master; None: it has none.
        facet: Facets of the master, shape (n,).
        patch: What lies over them, as of `Surface.patch_at`, shape (n,).
        path: As of `Attachment`.
    """

    slave: Surface
    node: IntArray
    master: Surface | None = None
    facet: IntArray | None = None
    patch: IntArray | None = None
    path: tuple[FloatArray, FloatArray] = _STILL

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """That of the slave, and of the master."""
        return (self.slave,) if self.master is None else (self.slave, self.master)

    @property
    def numbers(self) -> tuple[IntArray, ...]:
        """The slave, and the points that its patch depends on."""
        slave = self.node[:, None]
        return (slave,) if self.master is None else (slave, self.master.patches[self.patch])

    @property
    def shares(self) -> FloatArray | None:
        """Weights of these points in slave and control points, if they differ."""
        if self.master is None or self.master.weights is None:
            return None
        return beside(np.ones((len(self.node), 1)), self.master.weights[self.patch])

    @cached_property
    def sides(self) -> tuple[Points, ...]:
        """Nodes that the slaves depend on, and those of the masters."""
        slave = self.slave.material.select(self.node)
        if self.master is None:
            return (slave,)
        return slave, self.master.facet_nodes.select(self.patch)

    @cached_property
    def weights(self) -> FloatArray | None:
        """Weights of the nodes in slave and control points, if they differ."""
        slave, *others = self.sides
        control = None if self.master is None else self.master.facet_weights
        if slave.are_nodes and control is None:
            return None
        if control is not None:
            return beside(slave.weights, control[self.patch])
        number = sum(side.nodes.shape[1] for side in others)
        same = np.broadcast_to(np.eye(number), (len(self.node), number, number))
        return beside(slave.weights, same)

    def place(self, i: int) -> str:
        """The node's number in the user's mesh, and its facet."""
        node = f"node {int(self.slave.original[self.node[i]])}"
        return node if self.facet is None else f"{node} on facet {int(self.facet[i])}"


def beside(slave: FloatArray, control: FloatArray) -> FloatArray:
    """Weights in slaves (n, a) and in control points (n, c, b) as one, (n, c + 1, a + b)."""
    n, own = slave.shape
    both = np.zeros((n, control.shape[1] + 1, own + control.shape[2]))
    both[:, 0, :own], both[:, 1:, own:] = slave, control
    return both
