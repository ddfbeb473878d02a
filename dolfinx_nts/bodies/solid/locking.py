"""Cells of a solid that are too stiff for what it does."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.solid.materials import bulk_over_shear
from dolfinx_nts.bodies.solid.stress_jumps import StressJumps
from dolfinx_nts.parallel import anywhere, global_sum
from dolfinx_nts.types import FloatArray

#: Bulk over shear modulus from which on cells of degree 1 lock in any motion (nu = 0.499).
_INCOMPRESSIBLE = 500.0
#: Largest spread of a body's nodes over the least from which on it may bend: a bar or plate of one
#: cell over the thickness is some 4 times as long as thick.
_THIN = 2.3


class Locking:
    """What tells whether a body's cells are too stiff, and what to do.

    Args:
        space: Function space of its displacement.
        reference: Places of its nodes on this rank [m], flat.
        degree: As of `Continuum`, and so are the next ones.
        material: W(C).
        volume: "full" or "projected".
        bending: Whether its cells bend.
        jumps: Makes the jumps of its stress, once they are asked for.
    """

    def __init__(
        self, space: fem.FunctionSpace, reference: FloatArray, degree: int, material: Any, *,
        volume: str, bending: bool, jumps: Callable[[], StressJumps],
    ) -> None:  # fmt: skip
        self._space, self._x, self._bending = space, reference.reshape(-1, 3), bending
        self._linear, self._full = degree == 1, degree == 1 and volume == "full"
        self._material, self._make_jumps = material, jumps
        self._jumps: StressJumps | None = None

    def stress_jumps(self) -> FloatArray:
        """Squares of what the stress jumps between cells, and of the stress. Collective."""
        if self._jumps is None:
            self._jumps = self._make_jumps()
        return self._jumps.sums()

    @property
    def remedy(self) -> str:
        """What to do where the cells are too stiff."""
        if self._linear and compat.cell_name(self._space.mesh) == "tetrahedron":
            return "use degree=2, hexahedra, or a finer mesh"
        if self._bending:
            return "use degree=2, or a finer mesh"
        if self._full:
            thin = "bending=True in thin, stiff parts of regular cells"
            return f"use volume='projected', {thin}, or a finer mesh"
        return "use a finer mesh"

    @property
    def keeps_volume(self) -> bool:
        """Whether cells are of degree 1 and the material hardly changes its volume."""
        return self._full and bulk_over_shear(self._material) > _INCOMPRESSIBLE

    @cached_property
    def is_thin(self) -> bool:
        """Whether it is long or flat, with one cell of degree 1 over its thickness. Collective."""
        if not self._linear or self._bending:
            return False
        x, comm = self._x, self._space.mesh.comm
        count = global_sum(comm, np.array([float(len(x))]))
        off = x - global_sum(comm, x.sum(axis=0)) / count
        # Spread along the axes of the nodes, which is the same whatever way the body is turned.
        moments: FloatArray = np.dot(off.T, off)
        spread = np.linalg.eigvalsh(global_sum(comm, moments))
        if spread[2] < _THIN**2 * spread[0]:
            return False
        outside = compat.exterior_facets(self._space.mesh)
        on_boundary = fem.locate_dofs_topological(self._space, 2, outside)
        inside = len(x) - np.count_nonzero(np.unique(on_boundary) < len(x))
        return not anywhere(comm, bool(inside))

    def destroy(self) -> None:
        """Free the PETSc object."""
        if self._jumps is not None:
            self._jumps.destroy()
