"""Linear solves of bodies by themselves: with their mass, or by factors of any matrix."""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.types import FloatArray


class Saddle:
    """Factors of a matrix by MUMPS, without equations that repeat others. Collective."""

    def __init__(self, matrix: PETSc.Mat) -> None:
        self._x, self._b = matrix.createVecs()
        self._ksp = PETSc.KSP().create(matrix.getComm())
        self._ksp.setType("preonly")
        self._ksp.setOperators(matrix)
        pc = self._ksp.getPC()
        pc.setType("lu")
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        for option, value in ((14, 2000), (24, 1)):
            pc.getFactorMatrix().setMumpsIcntl(option, value)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of A x = right, owned entries. Collective."""
        self._b.array_w[:] = right
        self._ksp.solve(self._b, self._x)
        return self._x.array_r.copy()

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        for a in (self._x, self._b, self._ksp):
            a.destroy()


class _Mass:
    """The mass of a body as a PETSc matrix, with zeros at prescribed coordinates."""

    def __init__(self, body: Body) -> None:
        self._body = body

    def mult(self, _matrix: Any, x: Any, y: Any) -> None:
        """M x."""
        y.array_w[:] = self._body.inertia(x.array_r.copy())
        y.array_w[self._body.fixed] = 0.0

    def getDiagonal(self, _matrix: Any, diagonal: Any) -> None:  # noqa: N802 (PETSc's name)
        """What serves as the diagonal for preconditioning."""
        # Rows of a tetrahedron of degree 2 have negative sums at its vertices.
        diagonal.array_w[:] = np.abs(self._body.nodal_mass)


def solve_mass(body: Body, right: FloatArray) -> FloatArray:
    """Solution of M x = right, owned entries, zero at prescribed coordinates. Collective.

    Args:
        body: Its inertia is positive definite.
        right: Owned entries.
    """
    size = (body.num_owned, None)
    mass = PETSc.Mat().createPython((size, size), _Mass(body), comm=body.comm)
    mass.setUp()
    x, b = mass.createVecs()
    b.array_w[:] = right
    b.array_w[body.fixed] = 0.0
    ksp = PETSc.KSP().create(mass.getComm())
    ksp.setType("cg")
    ksp.getPC().setType("jacobi")
    ksp.setTolerances(rtol=1e-14, max_it=1000)
    ksp.setOperators(mass)
    ksp.solve(b, x)
    solution: FloatArray = x.array_r.copy()
    for a in (x, b, ksp, mass):
        a.destroy()
    return solution
