"""What a search for contact is told and finds: which slave nodes may touch what in a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Candidates are sought this part of a facet beyond the reach of the step's motion.
MARGIN = 0.5


class Candidates(NamedTuple):
    """Slave nodes that may touch in a step, one facet each; axis 0 = pair.

    Attributes:
        node: Positions in the slave surface's `share`, shape (n,).
        facet: Facets of the master surface, shape (n,).
        patch: What lies over them there, as of `Surface.patch_at`, shape (n,).
        xi: Orthogonal projection at t_n, shape (n, 2).
        normal: Outward unit normal of the master there, shape (n, 3).
        gap: g_0 [m], shape (n,).
        length: Size of the facet [m], shape (n,).
    """

    node: IntArray
    facet: IntArray
    patch: IntArray
    xi: FloatArray
    normal: FloatArray
    gap: FloatArray
    length: FloatArray

    def select(self, chosen: IntArray | BoolArray) -> Candidates:
        """Return some of the candidates, by number or by a mask."""
        return Candidates._make(a[chosen] for a in self)


NO_CANDIDATES = Candidates(
    np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64),
    np.empty((0, 2)), np.empty((0, 3)), np.empty(0), np.empty(0),
)  # fmt: skip


class Motion(NamedTuple):
    """How slaves and masters are expected to move in a step.

    Attributes:
        reach: Bound on the motion of slaves relative to the master [m].
        paths: Displacement of each of a pair's bodies over the step [m], owned coordinates.
        aimed: Facet that a path of an earlier attempt at the step met, or -1, of each of the rank's
            slave nodes.
        solved: Whether the paths are those of a solution, whose end is to be in equilibrium.
        at_rest: Whether it is a load step, which may be of any length and lead elsewhere.
    """

    reach: float
    paths: Sequence[FloatArray]
    aimed: IntArray
    solved: bool = False
    at_rest: bool = False


class Found(NamedTuple):
    """What a search found.

    Attributes:
        candidates: Slave nodes that may touch.
        followed: Which of the rank's slave nodes are known not to have passed by the surface's
            edge, shape (share,).
        cover: Relative motion [m] for which the search misses no contact, the same on all ranks.
    """

    candidates: Candidates
    followed: BoolArray
    cover: float
