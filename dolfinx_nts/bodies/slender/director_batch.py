"""Beams or shells of one kind that a step evaluates together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.batch import BodyBatch
from dolfinx_nts.bodies.slender.director_body import DirectorBody
from dolfinx_nts.bodies.slender.director_elements import DirectorElements
from dolfinx_nts.bodies.slender.director_matrix import DirectorMatrix
from dolfinx_nts.bodies.slender.element_forces import ElementForces
from dolfinx_nts.bodies.slender.element_values import ElementValues
from dolfinx_nts.bodies.slender.node_moments import NodeMoments
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.types import FloatArray, IntArray


class DirectorBatch(ElementForces, BodyBatch):
    """Beams or shells with directors and masses in common, see `DirectorBody.alike`.

    Args:
        bodies: The members.
        numbers: Their numbers in the system, shape (members,).
    """

    def __init__(self, bodies: Sequence[DirectorBody], numbers: IntArray) -> None:
        each = [body.elements for body in bodies]
        directors = len(each[0].masses) - 1
        super().__init__(bodies, numbers, directors, f"{bodies[0].kind}s")
        self.bound, width = bodies[0].bound, 3 + 3 * directors
        cells, ghosts = (
            np.concatenate([
                self.numbered(k, width * getattr(of.values, name)) // width
                for k, of in zip(numbers.tolist(), each, strict=True)
            ])
            for name in ("cells", "ghosts")
        )  # fmt: skip
        self._values = ElementValues(self.comm, self.num_owned // width, ghosts, cells, width)
        self.elements = DirectorElements.together(each, self._values)
        self._moments = NodeMoments(np.empty(0, dtype=np.int64), width, self.length)
        self._none = np.zeros((0, directors, 3, 3))

    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Set the state at t_n."""
        self.elements.begin(moment.u0, rule.taken_at)

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> PETSc.Mat:
        """Return mass M + stiffness K, the same matrix in each call. Collective."""
        if self._matrix is None:
            self._matrix = DirectorMatrix(self._values, self._moments, self.fixed)
        values = self.elements.tangent(u1, mass, stiffness)
        return self._matrix.assemble(values, self._none, 1.0)
