"""The augmented Lagrangian that makes a saddle point fit for an algebraic multigrid.

Without inertia a body that contact alone holds has a singular matrix, and the Schur complement of
the constraints reaches from the compliance of a node to that of a whole body. With

    W = -F^-1,  F = D - C k^-1 B  (element by element, k the stiffness around each node),

the system [K B; C D] times [1 BW; 0 1] has the corner K + B W C, in which closed contacts are
springs as stiff as their surroundings, and a Schur complement near F, however fine the mesh. The
preconditioner is its block triangle: y = F^-1 g, then (K + B W C) x = f - B (2 - F^-1 D) y. It is
what a field split makes of the matrix whose elements' tangents are those of `augmented`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.solve.linear_solver import PARTS
from dolfinx_nts.types import FloatArray


def augmented(tangent: FloatArray, stiffness: FloatArray) -> FloatArray:
    """Tangents of elements [K B; C D] -> [K + B W C, B (2 - F^-1 D); C F].

    Args:
        tangent: Shape (n, r, r).
        stiffness: Around each coordinate, in the units of K, shape (n, k); the other r - k unknowns
            are the elements' own.
    """
    k = stiffness.shape[1]
    if k == tangent.shape[1] or not len(tangent):
        return tangent
    out, (b, c, d) = tangent.copy(), (tangent[:, :k, k:], tangent[:, k:, :k], tangent[:, k:, k:])
    out[:, k:, k:] -= c @ (b / stiffness[:, :, None])
    inverse = np.linalg.pinv(out[:, k:, k:])
    out[:, :k, :k] -= b @ inverse @ c
    out[:, :k, k:] += b - b @ inverse @ d
    return out


class AugmentedMatrix:
    """What a field split with an algebraic multigrid takes as the matrix of a step.

    Args:
        problem: Equations of the step; its layout must not change.
        bodies: PETSc matrices of its bodies that are awake.
        around: Stiffness that closed contacts of a body get at each of its coordinates [N/m]; None:
            that of their surroundings.

    Attributes:
        matrix: Of the same layout as the step's own.
        mixed: Whether there are bodies with constraints of their own, for which a multigrid is not.
    """

    def __init__(
        self, problem: StepProblem, bodies: Sequence[Body],
        around: Callable[[Any], FloatArray] | None = None,
    ) -> None:  # fmt: skip
        laid, batches = problem.laid, problem.batches
        blocks = [b._replace(pattern=np.ones_like(b.pattern)) for b in laid.blocks]
        self.matrix = StepMatrix(laid.layout, bodies, blocks, split=True, blocked=True, kind="aij")
        stiffness, place = around or problem.stabilization.stiffness, problem.x.duplicate()
        place.set(0.0)
        laid.write([problem.factor * stiffness(body) for body in batches.bodies], place.array_w)
        self._stiffness = laid.at_elements(place, problem.elements) if laid.blocks else []
        place.destroy()
        self._comm = problem.system.comm
        # Those without constraints of their own, and where they are.
        free = [not body.joints for body in batches.bodies]
        known = zip(batches.bodies, batches.join(problem.state.u), strict=True)
        values = np.zeros((2, laid.layout.num_owned))
        both = zip(batches.bodies, free, strict=True)
        laid.write([np.full(body.num_owned, alone) for body, alone in both], values[0])
        laid.write([body.reference + u for body, u in known], values[1])
        self._continua = np.flatnonzero(values[0])
        self.mixed = not all(free[j] for j in laid.awake)
        self._places = values[1][self._continua]

    def assemble(self, tangents: Sequence[FloatArray], *, fresh: bool) -> None:
        """As `StepMatrix.assemble`."""
        new = self.matrix.operator is None
        both = zip(tangents, self._stiffness, strict=True)
        self.matrix.assemble([augmented(a, k) for a, k in both], fresh=fresh)
        if new and not self.mixed and self.matrix.corner.getBlockSize() == 3:
            modes = self._rigid()
            self.matrix.corner.setNearNullSpace(modes)
            modes.destroy()

    def turning(self, tangents: Sequence[FloatArray]) -> FloatArray:
        """Row sums of what elements add to the bodies' own coordinates. Collective.

        It is the stiffness that forces have because they turn with the bodies, in sizes.

        Args:
            tangents: As of `assemble`, which is to follow.
        """
        sums = [np.zeros_like(a) for a in tangents]
        for out, a, around in zip(sums, tangents, self._stiffness, strict=True):
            k = np.arange(around.shape[1])
            out[:, k, k] = np.abs(a[:, : len(k), : len(k)]).sum(axis=2)
        self.matrix.assemble(sums, fresh=True)
        diagonal = self.matrix.corner.getDiagonal()
        found: FloatArray = np.abs(diagonal.array_r)
        diagonal.destroy()
        return found

    def split_bodies(self, snes: PETSc.SNES, operator: PETSc.Mat) -> None:
        """Tell continua, for a multigrid, from other bodies. Collective, before the first solve."""
        ksp = snes.getKSP()
        ksp.setOperators(operator, self.matrix.operator)
        pc = ksp.getPC()
        pc.setUp()
        start, stop = self.matrix.corner.getOwnershipRange()
        others = np.setdiff1d(np.arange(stop - start), self._continua)
        parts, modes = [], self._rigid()
        for index in (self._continua, others):
            numbers = (start + index).astype(PETSc.IntType)
            parts.append(PETSc.IS().createGeneral(numbers, comm=self._comm))
            parts[-1].setBlockSize(3)
        parts[0].compose("nearnullspace", modes)
        bodies = pc.getFieldSplitSubKSP()[0].getPC()
        bodies.setFieldSplitIS(*zip(PARTS, parts, strict=True))
        for each in (*parts, modes):
            each.destroy()

    def _rigid(self) -> Any:
        """Rigid motions of all continua together, which the multigrid keeps. Collective."""
        places = PETSc.Vec().createWithArray(self._places, bsize=3, comm=self._comm)
        modes = PETSc.NullSpace().createRigidBody(places)
        places.destroy()
        return modes

    def destroy(self) -> None:
        """Free the PETSc objects."""
        self.matrix.destroy()
