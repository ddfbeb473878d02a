"""Rigid bodies that a step evaluates together, as one body with all their coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.batch import BodyBatch
from dolfinx_nts.bodies.rigid.rigid import RigidBody
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import FloatArray, IntArray


class RigidBatch(BodyBatch):
    """Rigid bodies: inertia and weight, see `RigidBody.alike`.

    Args:
        bodies: The members.
        numbers: Their numbers in the system, shape (members,).
    """

    rigid = bound = True

    def __init__(self, bodies: Sequence[RigidBody], numbers: IntArray) -> None:
        super().__init__(bodies, numbers, 3, "rigid bodies")
        owners = [body.owner for body in bodies]
        self._order = np.argsort(owners, kind="stable").tolist()
        self._counts, self._shared = np.bincount(owners, minlength=self.comm.size), 0
        self._lent = np.concatenate([np.empty(0), *(body.lent for body in self._own)])
        self._reach = np.array([body.reach for body in self._own]).reshape(-1, 4)
        self._matrix: Any = None
        # Mass factor that it holds, and PETSc's count of changes since.
        self._holds: tuple[float, int] | None = None

    def motions(self, du: FloatArray) -> FloatArray:
        """As of `BodyBatch`, all at once."""
        moved = np.abs(du).reshape(-1, 4, 3)
        return np.einsum("bk,bki->bi", self._reach, moved).max(axis=1, initial=0.0)

    # ---- as of Body
    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Nothing on them depends on the step."""

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]."""
        return self.nodal_mass * v

    def internal(self, u1: FloatArray) -> FloatArray:
        """None [N]: what holds the directors are constraints."""
        return np.zeros(self.num_owned)

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> PETSc.Mat:
        """Return mass M."""
        if self._matrix is None:
            # In the 3 x 3 blocks of nodes, as those of other bodies are.
            last = self.comm.scan(self.num_owned)
            rows = np.repeat(np.arange(last - self.num_owned, last), 3)
            cols = 3 * (rows // 3) + np.tile(np.arange(3), self.num_owned)
            self._matrix = petsc_compat.coo_matrix(self.comm, self.num_owned, rows, cols)
        if self._holds != (mass, self._matrix.stateGet()):
            diagonal = mass * (self.nodal_mass + self._lent)
            blocks = diagonal[:, None] * np.tile(np.eye(3), (self.num_owned // 3, 1))
            petsc_compat.set_values_coo(self._matrix, blocks.ravel())
            self._holds = mass, self._matrix.stateGet()
        return self._matrix

    def nodal_stiffness(self) -> FloatArray:
        """None [N/m]."""
        return np.zeros(self.num_owned)

    def potential(self, u: FloatArray) -> float:
        """None [J]: gravity does external work."""
        return 0.0

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the members' current state. Collective."""
        local = np.reshape([self.reference + u, u, v], (3, -1, 4, 3)).swapaxes(0, 1)
        for k, seen in zip(self._order, self._gathered(local), strict=True):
            self._bodies[k].show(*seen)

    def share(self, *values: Sequence[FloatArray]) -> None:
        """Let all ranks know values at owned coordinates, of each body of the system. Collective.

        The members remember those of the last two calls.
        """
        local = np.stack([self.joined(each).reshape(-1, 4, 3) for each in values], axis=1)
        for k, tables in zip(self._order, self._gathered(local), strict=True):
            body, own = self._bodies[k], [each[self.members[k]] for each in values]
            body.known = (*zip(own, tables, strict=True), *body.known[: self._shared])
        self._shared = len(values)

    def _gathered(self, local: FloatArray) -> FloatArray:
        """What the ranks have of each of their members, in the order `_order`. Collective."""
        return gather_rows(self.comm, local, self._counts)

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        if self._matrix is not None:
            self._matrix.destroy()
            self._matrix = None
