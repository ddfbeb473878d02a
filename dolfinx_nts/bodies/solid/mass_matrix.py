"""The mass matrix of a body with a function space, also where nodes have lost their mass."""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.arrays import BoolArray, FloatArray, IntArray
from dolfinx_nts.bodies.solid.massless import redistributed


class MassMatrix:
    """Mass matrix of a body.

    Args:
        form: Compiled mass.

    Attributes:
        matrix: PETSc matrix, the same scalar in each of the three directions.
        nodal: Its row sums [kg], shape (num_owned,).
        nodal_before: The same before nodes lost their mass.
    """

    def __init__(self, form: Any) -> None:
        self._form = form
        self.matrix: Any = None
        self._consistent: Any = None
        self._change: Any = None
        self._sum: Any = None
        self.assemble()

    def assemble(self) -> None:
        """Assemble it, anew where what the form is made of has changed. Collective."""
        full = compat.create_matrix(self._form)
        compat.assemble_matrix(full, self._form, (), 0.0)
        if self.matrix is None:
            self._in, self._out = full.createVecs()
        else:
            self.matrix.destroy()
        # Directions do not mix: two of three entries of the blocks are zero.
        self.matrix = compat.without_zeros(full)
        full.destroy()
        self._sum_up()
        self.nodal_before = self.nodal

    def _sum_up(self) -> None:
        self.nodal = self.times(np.ones(self._in.getLocalSize()))

    def times(self, v: FloatArray) -> FloatArray:
        """M v. Collective."""
        self._in.array_w[:] = v
        self.matrix.mult(self._in, self._out)
        product: FloatArray = self._out.array_r.copy()
        return product

    # ---- nodes without mass
    def redistribute(self, massless: BoolArray, x: FloatArray, fixed: IntArray) -> str:
        """Take the mass of nodes and give it to others, see `massless`. Collective.

        Args:
            massless: This rank's nodes that shall have none, shape (n,).
            x: Reference positions of this rank's nodes [m], shape (n, 3).
            fixed: As of `Body`.

        Returns:
            What is wrong with what is left, for messages; if anything is, the mass stays.
        """
        first = self.matrix if self._consistent is None else self._consistent
        new, problem = redistributed(first, massless, x)
        if problem:
            return problem
        if self._consistent is not None:
            self.matrix.destroy()
            self._change.destroy()
        self._consistent, self.matrix = first, new
        self._sum_up()
        change = new.copy()
        change.axpy(-1.0, first, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        start, _ = change.getOwnershipRange()
        change.zeroRowsColumns((start + fixed).astype(PETSc.IntType), diag=0.0)
        self._change = change
        return ""

    def corrected(self, tangent: Any, mass: float) -> Any:
        """A tangent with `mass` times this mass in place of the form's. Collective.

        It is the same matrix in each call: a new one if mass is where the form has no entries.

        Args:
            tangent: PETSc matrix, the same in each call, with `mass` times the form's mass.
            mass: Factor.
        """
        if self._change is None:
            return tangent
        if self._sum is None:
            self._sum = tangent.copy()
            other = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
            self._sum.axpy(mass, self._change, structure=other)
            return self._sum
        subset = PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN
        self._sum.zeroEntries()
        self._sum.axpy(1.0, tangent, structure=subset)
        self._sum.axpy(mass, self._change, structure=subset)
        return self._sum

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for a in (self.matrix, self._consistent, self._change, self._sum, self._in, self._out):
            if a is not None:
                a.destroy()
