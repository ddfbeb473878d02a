"""Two approximate Schur complements of the contact unknowns, and the preconditioner of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

#: Prefix of the options of what `SchurInverse` factorises with.
FACTORS = "factors_"
#: Name by which its matrix knows the second approximation.
_SECOND = "dolfinx_nts_second"


class SchurApproximation:
    """Two approximate Schur complements D - C W B and D - C W A W B, for `SchurInverse`.

    They take the coordinates in contact alone: A is their block of the bodies' matrix, W the
    diagonal matrix of one over the sums of the moduli of its rows, D the contact's own block, B and
    C stand above and below.

    Args:
        rows: Index set of this rank's coordinates in contact, in the bodies' part.
        cols: Of its contact unknowns, in the contact's part.

    Attributes:
        first: D - C W B, after `renew`.
        second: D - C W A W B.
    """

    def __init__(self, rows: Any, cols: Any) -> None:
        self._rows, self._cols = rows, cols
        # Made when first needed, then kept with their patterns.
        self._near: Any = None
        self._inverse: Any = None
        self._above: Any = None
        self._below: Any = None
        self._between: Any = None
        self.first: Any = None
        self.second: Any = None

    def renew_bodies(self, bodies: Any) -> None:
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

    def renew(self, above: Any, below: Any, contact: Any) -> None:
        """Compute both complements from the other blocks, A as it is. Collective."""
        self._above = above.createSubMatrix(self._rows, self._cols, submat=self._above)
        self._below = below.createSubMatrix(self._cols, self._rows, submat=self._below)
        self._above.diagonalScale(self._inverse, None)
        self._between = self._near.matMult(self._above, result=self._between)
        self._between.diagonalScale(self._inverse, None)
        self.first = self._below.matMult(self._above, result=self.first)
        self.second = self._below.matMult(self._between, result=self.second)
        for product in (self.first, self.second):
            # What stands in D are the unknowns of one slave node, which share its coordinates.
            product.aypx(-1.0, contact, structure=PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)

    def give(self, snes: Any) -> None:
        """Let the contact part of a SNES' Schur field split be preconditioned with them."""
        self.first.compose(_SECOND, self.second)
        user = PETSc.PC.SchurPreType.USER
        snes.getKSP().getPC().setFieldSplitSchurPreType(user, self.first)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for a in (
            self._rows, self._cols, self._near, self._inverse, self._above, self._below,
            self._between, self.first, self.second,
        ):  # fmt: skip
            if a:
                a.destroy()


class SchurInverse:
    """Preconditioner of the contact part: S^-1 ~ F^-1 M F^-1 from two approximations of S.

    With F = D - C W B and M = D - C W A W B this is Newton's (Schulz's) step from F^-1 towards the
    inverse of D - C (2 W - W A W) B. Where A W maps what B spans into itself, and D = 0, it is
    exact (the least-squares commutator): about so with consistent mass, for which a polynomial in
    A alone needs more terms. Without M it is F^-1.
    """

    def create(self, pc: Any) -> None:
        """Called by PETSc, as the other methods are."""
        self._factors = PETSc.PC().create(pc.comm)
        self._between: Any = None
        self._work: tuple[Any, ...] = ()

    def setFromOptions(self, pc: Any) -> None:
        """Options of the factorisation."""
        self._factors.setOptionsPrefix(f"{pc.getOptionsPrefix() or ''}{FACTORS}")
        self._factors.setFromOptions()

    def setUp(self, pc: Any) -> None:
        """Factorise anew."""
        _, first = pc.getOperators()
        if self._between:
            self._between.destroy()
        self._between = first.query(_SECOND)
        self._factors.setOperators(first)
        self._factors.setUp()
        if not self._work:
            self._work = first.createVecs()

    def apply(self, _pc: Any, x: Any, y: Any) -> None:
        """Approximate S y = x."""
        if not self._between:
            self._factors.apply(x, y)
            return
        a, b = self._work
        self._factors.apply(x, a)
        self._between.mult(a, b)
        self._factors.apply(b, y)

    def destroy(self, _pc: Any) -> None:
        """Free what `create` and `setUp` made."""
        for each in (self._factors, self._between, *self._work):
            if each:
                each.destroy()
