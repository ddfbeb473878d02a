"""Everything that a step starts from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.types import BoolArray, FloatArray, IntArray


class ContactHistory(NamedTuple):
    """What a contact remembers from step to step, of each slave node in this rank's share.

    Attributes:
        facet: Facet in the last step, or -1, shape (n,).
        force: Contact force p_N [N], >= 0.
        gap: Gap [m], infinite where a node was no candidate.
        tangential: Friction force [N], shape (n, 3).
        stick: Whether it sticks.
        slip: Distance that it has slipped since the start [m].
        followed: Whether it is not known to have passed by the surface's edge.
        overlap: How deep it may lie in the master at pseudo time 0, >= 0 [m]; at 1, not at all.
    """

    facet: IntArray
    force: FloatArray
    gap: FloatArray
    tangential: FloatArray
    stick: BoolArray
    slip: FloatArray
    followed: BoolArray
    overlap: FloatArray

    @classmethod
    def of_start(cls, n: int) -> ContactHistory:
        """Return the history of n nodes that have not touched yet."""
        off, none = np.zeros(n, dtype=bool), np.zeros(n)
        return cls(
            np.full(n, -1), none, np.full(n, np.inf), np.zeros((n, 3)), off, none.copy(), ~off,
            none.copy(),
        )

    def beside(self, other: ContactHistory) -> ContactHistory:
        """What both know of the same nodes: forces in all, and the smaller gap."""
        slides = (self.force > 0.0) & ~self.stick | (other.force > 0.0) & ~other.stick
        return self._replace(
            force=self.force + other.force, gap=np.minimum(self.gap, other.gap),
            tangential=self.tangential + other.tangential,
            stick=(self.stick | other.stick) & ~slides,
            slip=np.maximum(self.slip, other.slip),
        )  # fmt: skip


class EdgeHistory(NamedTuple):
    """What the edges of a contact remember that press on each other, on this rank; axis 0 = pair.

    Attributes:
        pair: Numbers of the slave's and of the master's edge, shape (n, 2).
        force: Contact force p_N [N], shape (n,).
        tangential: Friction force on the slave [N], shape (n, 3).
    """

    pair: IntArray
    force: FloatArray
    tangential: FloatArray

    @classmethod
    def of_start(cls) -> EdgeHistory:
        """Return that of edges that have not touched yet."""
        return cls(np.empty((0, 2), dtype=np.int64), np.empty(0), np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class State:
    """Everything a step starts from; never changed, a step makes a new one.

    Attributes:
        time: t [s].
        u: Owned displacements of each body [m].
        v: Owned velocities of each body [m/s].
        a: Owned accelerations of each body [m/s^2], where the integrator carries any; else empty.
        contacts: What each contact remembers of its slave nodes.
        joints: What each of `System.joints` remembers.
        edges: What the edges of each contact remember; empty without contacts.
        inner: What forces of each body depend on beside u, see `Body.inner`; empty where no body
            has any.
    """

    time: float
    u: tuple[FloatArray, ...]
    v: tuple[FloatArray, ...]
    a: tuple[FloatArray, ...]
    contacts: tuple[ContactHistory, ...]
    joints: tuple[Any, ...]
    edges: tuple[EdgeHistory, ...] = ()
    inner: tuple[FloatArray, ...] = ()

    def inner_of(self, k: int) -> FloatArray | None:
        """Of a body, where it has any."""
        return self.inner[k] if self.inner else None

    def acceleration(self, k: int) -> FloatArray | None:
        """Of a body [m/s^2], where the integrator carries any."""
        return self.a[k] if self.a else None
