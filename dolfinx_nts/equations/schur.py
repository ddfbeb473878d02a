"""Approximate Schur complements of the elements' own unknowns, for their preconditioner."""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc


class SchurApproximation:
    """Schur complements D - C W B and D - C W A W B, approximate: see `fieldsplit.SchurInverse`.

    They take the coordinates alone that elements touch: A is their block of the bodies' matrix, W
    the diagonal matrix of one over the sums of the moduli of its rows, D the constraints' own
    block, B and C stand above and below.

    Args:
        rows: Index set of this rank's coordinates that elements touch, in the bodies' part.
        cols: Of its constraints, in their part.

    Attributes:
        first: D - C W B, after `renew`.
        second: D - C W A W B.
    """

    def __init__(self, rows: PETSc.IS, cols: PETSc.IS) -> None:
        self._rows, self._cols = rows, cols
        # Made when first needed, then kept with their patterns.
        self._near: Any = None
        self._inverse: Any = None
        self._above: Any = None
        self._below: Any = None
        self._between: Any = None
        self.first: Any = None
        self.second: Any = None

    def renew_bodies(self, bodies: PETSc.Mat) -> None:
        """Take A from the bodies' matrix. Collective."""
        if bodies.getType().endswith("baij"):
            # PETSc has no product of the two formats, nor renews a part of MPIBAIJ.
            square = bodies.createSubMatrix(self._rows, self._rows)
            self._near = square.convert("aij", out=self._near or PETSc.Mat())
            square.destroy()
        else:
            self._near = bodies.createSubMatrix(self._rows, self._rows, submat=self._near)
        if self._inverse is None:
            self._inverse = self._near.createVecLeft()
        pointer, _, values = self._near.getValuesCSR()
        self._inverse.array_w[:] = 1.0 / np.add.reduceat(np.abs(values), pointer[:-1])

    def renew(self, above: PETSc.Mat, below: PETSc.Mat, own: PETSc.Mat) -> None:
        """Compute both complements from the other blocks, A as it is. Collective."""
        self._above = above.createSubMatrix(self._rows, self._cols, submat=self._above)
        self._below = below.createSubMatrix(self._cols, self._rows, submat=self._below)
        self._above.diagonalScale(self._inverse, None)
        self._between = self._near.matMult(self._above, result=self._between)
        self._between.diagonalScale(self._inverse, None)
        self.first = self._below.matMult(self._above, result=self.first)
        self.second = self._below.matMult(self._between, result=self.second)
        for product in (self.first, self.second):
            # All coordinates of an element are coupled with all its unknowns (`ElementBlocks`), so
            # that D's pattern lies in that of C W B.
            product.aypx(-1.0, own, structure=PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for a in (
            self._rows, self._cols, self._near, self._inverse, self._above, self._below,
            self._between, self.first, self.second,
        ):  # fmt: skip
            if a:
                a.destroy()
