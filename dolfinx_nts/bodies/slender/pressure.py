"""Pressure on cells of shells."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from dolfinx_nts.bodies.loads import Pressure, pressure_at
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh
from dolfinx_nts.kernels import pressure as kernel
from dolfinx_nts.types import Array, FloatArray
from dolfinx_nts.validation import at_points


class Pressures:
    """The pressures on this rank's cells. Collective.

    Args:
        comm: MPI communicator.
        director_mesh: The shell's nodes.
        cells: Nodes of this rank's cells, cyclic, shape (n, corners).
        loads: Loads by their position among all of the body's.
        name: Of the body, for messages.

    Raises:
        TypeError: where is no function.
        ValueError: where selects no cell.
    """

    def __init__(
        self, comm: MPI.Comm, director_mesh: DirectorMesh, cells: Array,
        loads: dict[int, Pressure], name: str,
    ) -> None:  # fmt: skip
        self._comm = comm
        self._loads: list[tuple[Pressure, FloatArray, str]] = []
        rest = director_mesh.x[cells]
        self._unit = kernel.force(rest, rest, 1.0) if loads else np.zeros((len(cells), 0, 3))
        for k, load in loads.items():
            chosen = np.ones(len(director_mesh.x), dtype=bool)
            if load.where is not None:
                what = f"Pressure.where of forces[{k}] of {name!r}"
                if not callable(load.where):
                    raise TypeError(
                        f"{what}={load.where!r}: pass a function x (3, n) -> bool (n,)"
                    )
                chosen = at_points(comm, what, load.where, director_mesh.x.T, (), "b")
                if not chosen[director_mesh.cells].all(axis=1).any():
                    raise ValueError(
                        f"{what}={load.where!r}: selects no cell; select all corners of the cells "
                        "it acts on"
                    )
            on_cells = chosen[cells].all(axis=1).astype(float)
            self._loads.append((load, on_cells, f"Pressure.value of forces[{k}] of {name!r}"))
        self.begin(0.0, 1.0)

    def __bool__(self) -> bool:
        """Whether there are any, on all ranks."""
        return bool(self._loads)

    def begin(self, time: float, ramp: float) -> None:
        """Set the pressures of a step. Collective.

        Args:
            time: [s].
            ramp: Part of constant loads that acts.
        """
        dead, following = np.zeros((2, len(self._unit)))
        for load, on_cells, what in self._loads:
            value = pressure_at(self._comm, what, load.value, time, ramp)
            (following if load.follower else dead)[:] += value * on_cells
        self._following = following[:, None, None]
        self._dead = dead[:, None, None] * self._unit

    def forces(self, x0: FloatArray, x1: FloatArray, theta: float | None) -> FloatArray:
        """Forces on the corners of this rank's cells [N], see `kernels.pressure.force`."""
        return self._dead + self._following * kernel.force(x0, x1, theta)

    def tangent(self, x0: FloatArray, x1: FloatArray, theta: float | None) -> FloatArray:
        """Their derivative by x_1 [N/m], shape (n, 4, 3, 4, 3)."""
        return self._following[..., None, None] * kernel.tangent(x0, x1, theta)
