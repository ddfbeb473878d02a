"""What a step asks of elements with directors, those of one body or of many as one."""

from __future__ import annotations

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.slender.director_elements import DirectorElements
from dolfinx_nts.bodies.slender.director_matrix import DirectorMatrix
from dolfinx_nts.bodies.slender.element_values import ElementValues
from dolfinx_nts.types import FloatArray


class ElementForces(Body):
    """A body whose mass and internal forces are those of its elements.

    Attributes:
        elements: This rank's elements.
    """

    elements: DirectorElements
    _values: ElementValues
    _matrix: DirectorMatrix | None = None

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]. Collective."""
        return self.elements.inertia(v)

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces of the step [N]. Collective."""
        return self.elements.internal(u1)

    def nodal_stiffness(self) -> FloatArray:
        """Mean diagonal of the tangent at each node in the reference [N/m]. Collective."""
        return self.elements.nodal_stiffness()

    def potential(self, u: FloatArray) -> float:
        """Strain energy on this rank [J]. Collective."""
        return self.elements.potential(u)

    def destroy(self) -> None:
        """Free the PETSc objects; the body is of no use then."""
        super().destroy()
        for a in (self._values, self._matrix):
            if a is not None:
                a.destroy()
