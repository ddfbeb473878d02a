"""The tangent of beams and shells as a matrix of PETSc."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.slender.element_values import ElementValues
from dolfinx_nts.bodies.slender.node_moments import NodeMoments
from dolfinx_nts.types import FloatArray, IntArray


class DirectorMatrix:
    """Sums of what elements and moments contribute where coordinates are free. Collective.

    Args:
        values: Which elements there are.
        moments: On which nodes moments act.
        fixed: Prescribed coordinates of this rank.
    """

    def __init__(self, values: ElementValues, moments: NodeMoments, fixed: IntArray) -> None:
        held = np.zeros(values.num_owned)
        held[fixed] = 1.0
        self._fixed, self._size = fixed, values.num_owned
        of_elements = values.of(held).reshape(-1, 3 * values.num_vectors) > 0.5
        at_moments = moments.at(held > 0.5)
        both = (a[..., :, None] | a[..., None, :] for a in (of_elements, at_moments))
        self._held = [np.flatnonzero(held) for held in both]
        self._matrix = values.matrix(moments.at(values.numbers))

    def assemble(
        self, of_elements: FloatArray, of_moments: FloatArray, diagonal: float
    ) -> PETSc.Mat:
        """Return the matrix, the same in each call. Collective.

        Args:
            of_elements: Shape (n, size, size); held coordinates are set to 0.
            of_moments: Shape (m, directors, 3, 3), likewise.
            diagonal: What stands on the diagonal of held coordinates.
        """
        own = np.zeros(self._size)
        own[self._fixed] = diagonal
        for values, held in zip((of_elements, of_moments), self._held, strict=True):
            values.reshape(-1)[held] = 0.0
        whole = np.concatenate([of_elements.ravel(), of_moments.ravel(), own])
        petsc_compat.set_values_coo(self._matrix, whole)
        return self._matrix

    def destroy(self) -> None:
        """Free the PETSc matrix."""
        self._matrix.destroy()
