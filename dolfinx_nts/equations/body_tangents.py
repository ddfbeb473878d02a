"""PETSc matrices of the bodies in a step, and what is lent to them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.equations.stabilization import Stabilization
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_max
from dolfinx_nts.types import FloatArray

#: Share of the stiffness around them that matrices of a load step lend to directors, which may be
#: free to spin, as those of a string between hinges: rounding alone would say how far.
_SPIN = 1e-11


class BodyTangents:
    """M + factor K of each batch of bodies, without contact.

    Args:
        batches: Of the bodies.
        inertia: Whether the equations have inertia.
        stabilization: In statics, what holds each node at t_n.
        laid: Gives the layout of the unknowns.

    Attributes:
        factor: What the equations of the step multiply forces by, h^2/2 [s^2] or 1.
        lent: Share of the stiffness around each coordinate that is added, see `LentStiffness`.
    """

    def __init__(
        self, batches: Batches, inertia: bool, stabilization: Stabilization,
        laid: Callable[[], Unknowns],
    ) -> None:  # fmt: skip
        self._batches, self._mass, self._stabilization = batches, float(inertia), stabilization
        self._laid, self.factor, self.lent = laid, 1.0, 0.0
        self._spins = [not inertia and _may_spin(body) for body in batches.bodies]

    def at(self, e: Evaluation) -> list[PETSc.Mat]:
        """PETSc matrices of the batches that are awake at an iterate. Collective."""
        return [self.of(j, e.terms[j].u1) for j in self._laid().awake]

    def of(self, j: int, u1: FloatArray) -> PETSc.Mat:
        """PETSc matrix of a batch at a displacement: its bodies in the step. Collective."""
        a = self.of_all(j, u1)
        body, spins = self._batches.bodies[j], self._spins[j]
        if self.lent or spins:
            share = np.where(np.repeat(body.places, 3), 0.0, _SPIN if spins else 0.0)
            share = np.maximum(self.lent, share)
            _add_to_diagonal(a, share * self._stabilization.stiffness(body))
        return self._laid().part(j, a)

    def of_all(self, j: int, u1: FloatArray) -> PETSc.Mat:
        """`of` all the bodies of a batch, with nothing lent. Collective."""
        body = self._batches.bodies[j]
        a = body.tangent(u1, self._mass, self.factor)
        if self._stabilization.share:
            _add_to_diagonal(a, self._stabilization.of(body))
        return a


def _may_spin(body: Body) -> bool:
    """Whether none of a body's directors is prescribed. Collective."""
    if body.rigid:
        return False
    directors = ~np.repeat(body.places, 3)
    local = np.array([directors.any(), directors[body.fixed].any()], dtype=float)
    some, clamped = global_max(body.comm, local)
    return bool(some and not clamped)


def _add_to_diagonal(a: Any, values: FloatArray) -> None:
    held = a.createVecLeft()
    held.array_w[:] = values
    a.setDiagonal(held, addv=PETSc.InsertMode.ADD_VALUES)
    held.destroy()
