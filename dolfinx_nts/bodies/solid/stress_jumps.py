"""How much the stress of a body jumps between its cells, which tells of cells that lock."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.solid.cell_means import CellMeans
from dolfinx_nts.forms import assemble_vector, compile_forms
from dolfinx_nts.parallel import global_sum
from dolfinx_nts.types import FloatArray

#: Strain that is rounding.
_ROUNDED_STRAIN = 1e-12


class StressJumps:
    """int |S - S*|^2 / int |S|^2, with S* of the corners' means over the cells (theory 19.7).

    Cells that lock hold large stresses of either sign that do nothing in the mean. Below 0.1 the
    body's stiffness is right within some per cent; a locked body has 0.3 to 1.

    Args:
        stress: Symmetric tensor in UFL [Pa].
        mesh: DOLFINx mesh.
        dx: Measure of the energy.
        means: Compiled means in cells that the stress holds.
        energy: What the displacements of now store on this rank [J].
    """

    def __init__(
        self, stress: Any, mesh: Mesh, dx: ufl.Measure, means: CellMeans | None,
        energy: Callable[[], float],
    ) -> None:  # fmt: skip
        self._comm, self._means, self._energy = mesh.comm, means, energy
        tensors = compat.function_space(mesh, "Lagrange", 1, (3, 3))
        numbers = compat.function_space(mesh, "Lagrange", 1)
        self._smooth = fem.Function(tensors)
        corners = basix.geometry(getattr(basix.CellType, compat.cell_name(mesh)))
        rule = {
            "quadrature_rule": "custom",
            "quadrature_points": tuple(map(tuple, corners.tolist())),
            "quadrature_weights": (1.0 / len(corners),) * len(corners),
        }
        at_corners = ufl.Measure("dx", mesh, metadata=rule)
        sums = ufl.inner(stress, ufl.TestFunction(tensors)) * at_corners
        weights = ufl.as_ufl(1.0) * ufl.TestFunction(numbers) * at_corners
        jump = stress - self._smooth
        one = fem.Constant(mesh, 1.0)
        self._sums, weigh, volume, *self._squares = compile_forms(
            [sums, weights, one * dx, ufl.inner(jump, jump) * dx, ufl.inner(stress, stress) * dx]
        )
        self._volume = float(global_sum(self._comm, np.array([volume.value()]))[0])
        self._vector, shares = (petsc_compat.create_vector(s) for s in (tensors, numbers))
        assemble_vector(shares, weigh)
        self._weights = shares.array_r.copy()
        shares.destroy()

    def sums(self) -> FloatArray:
        """Both integrals at the displacements of now [Pa^2 m^3], shape (2,). Collective.

        Zeros where nothing is strained: all stress is rounding there.
        """
        if self._means is not None:
            self._means.evaluate()
        assemble_vector(self._vector, self._sums)
        means = self._vector.array_r.reshape(-1, 9) / self._weights[:, None]
        self._smooth.x.array[: means.size] = means.ravel()
        self._smooth.x.scatter_forward()
        squares = [form.value() for form in self._squares]
        *found, stored = global_sum(self._comm, np.array([*squares, self._energy()])).tolist()
        # Stress times strain is twice the energy.
        strained = 2.0 * abs(stored) > _ROUNDED_STRAIN * math.sqrt(found[1] * self._volume)
        return np.array(found) if strained else np.zeros(2)

    def destroy(self) -> None:
        """Free the PETSc object."""
        self._vector.destroy()
