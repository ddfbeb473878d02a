"""The matrix of a rigid body: its mass, and how the forces of a torque follow the directors."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.types import FloatArray, IntArray


class RigidMatrix:
    """A PETSc matrix, the same at all times, filled anew where it has changed.

    Args:
        comm: MPI communicator.
        masses: Of the coordinates, all of them on one rank, with what is lent to them [kg].
        fixed: As of `Body`.
        total: Mass [kg].
    """

    def __init__(self, comm: MPI.Comm, masses: FloatArray, fixed: IntArray, total: float) -> None:
        self._comm, self._mass, self._fixed, self._total = comm, masses, fixed, total
        self._matrix: Any = None
        # Mass factor that it holds, and PETSc's count of changes since.
        self._holds: tuple[float, int] | None = None

    def at(self, mass: float, turning: FloatArray | None) -> PETSc.Mat:
        """Mass times the masses, less what torques do at the directors. Collective.

        Args:
            mass: Factor.
            turning: By the directors, shape (9, 9); None: nothing turns, on any rank.
        """
        if self._matrix is None:
            self._matrix = petsc_compat.dense_matrix(self._comm, len(self._mass))
        if turning is None and self._holds == (mass, self._matrix.stateGet()):
            return self._matrix
        if self._mass.size:
            whole = np.diag(mass * self._mass)
            if turning is not None:
                whole[3:, 3:] -= turning
            if self._fixed.size:
                whole[self._fixed] = whole[:, self._fixed] = 0.0
                whole[self._fixed, self._fixed] = mass * self._total or 1.0
            numbers = np.arange(12, dtype=PETSc.IntType)
            self._matrix.setValues(numbers, numbers, whole.ravel())
        self._matrix.assemble()
        self._holds = (mass, self._matrix.stateGet()) if turning is None else None
        return self._matrix

    def destroy(self) -> None:
        """Free it."""
        if self._matrix is not None:
            self._matrix.destroy()
