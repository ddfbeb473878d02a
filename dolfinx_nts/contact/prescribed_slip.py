"""The part of a slip that prescribed coordinates move, of which friction says nothing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinx_nts.contact.contact_measure import Batch
from dolfinx_nts.kernels import nts_element
from dolfinx_nts.kernels.vectors import projector
from dolfinx_nts.types import BoolArray, FloatArray

#: Square of the part of a motion that counts as none.
_IMMOVABLE = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class PrescribedSlip(Batch):
    """What prescribed coordinates do to the slip of elements in one step.

    Attributes:
        start: As of `ContactMeasure`, and so are foot, normal and tangents.
        free: Part of the square of a motion of slave and foot that is not prescribed, along the
            axes, shape (n, 3).
    """

    start: FloatArray
    foot: FloatArray
    normal: FloatArray
    tangents: FloatArray
    free: FloatArray

    @cached_property
    def _prescribed(self) -> BoolArray:
        """Axes along which slave and foot move as prescribed, shape (n, 3)."""
        return self.free <= _IMMOVABLE

    @cached_property
    def any(self) -> bool:
        """Whether anything is prescribed."""
        return bool(self._prescribed.any())

    @cached_property
    def _blocked(self) -> FloatArray:
        """Projector on the tangential parts of the prescribed axes, shape (n, 3, 3).

        Forces there act on prescribed coordinates or along the normal: where the gap is closed, the
        slip there is prescribed.
        """
        along = np.eye(3) - self.normal[:, :, None] * self.normal[:, None]
        return projector(np.matmul(along * self._prescribed[:, None], along), _IMMOVABLE)

    @cached_property
    def unmoved(self) -> FloatArray:
        """Projector on the part of lambda_T that acts on prescribed coordinates only, (n, 2, 2).

        Sticking is no equation there, and lambda_T is set to zero.
        """
        metric = np.matmul(self.tangents, self.tangents.transpose(0, 2, 1))
        dual = nts_element.solve(metric, self.tangents)
        return np.matmul(
            np.matmul(self.tangents, self._blocked), dual.transpose(0, 2, 1)
        )

    def held(
        self, x: FloatArray, still: FloatArray, slid: FloatArray | float = 0.0
    ) -> FloatArray:
        """`unmoved` where the slip prescribed there is zero, else zero, shape (n, 2, 2).

        Nodes that slip leave this part of lambda_T out of the trial, too: Coulomb's law says
        nothing about it, and at the edge of sticking the rows would be singular in it.

        Args:
            x: Points at t_{n+1} [m], shape (n, points, 3).
            still: Slip that counts as none [m], shape (n,).
            slid: As of `ContactLaw`.
        """
        motion = x - self.start
        motion = motion[:, 0] - np.einsum("nk,nki->ni", self.foot, motion[:, 1:])
        slip = np.einsum("nij,nj->ni", self._blocked, motion * self._prescribed)
        before = np.broadcast_to(slid, self.tangents.shape[:2])
        slip += np.einsum("nij,nai,na->nj", self._blocked, self.tangents, before)
        held: FloatArray = self.unmoved.copy()
        held[np.abs(slip).max(axis=1) > still] = 0.0
        return held
