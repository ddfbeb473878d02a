"""Parts of the unknowns as PETSc fieldsplits, and the Schur complement that preconditions one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from petsc4py import PETSc

from dolfinx_nts.equations.schur import SchurApproximation
from dolfinx_nts.types import IntArray

BODIES = "fieldsplit_bodies_"
CONSTRAINTS = "fieldsplit_constraints_"
#: What `SchurInverse` factorises with.
FACTORS = "factors_"
#: Name under which the first matrix stores the second approximation.
_SECOND = "dolfinx_nts_second"


def name_parts(snes: PETSc.SNES, *parts: tuple[str, Any]) -> None:
    """Name parts of the unknowns, by index sets that are freed."""
    snes.getKSP().getPC().setFieldSplitIS(*parts)
    for _, index in parts:
        index.destroy()


class SchurInverse:
    """Preconditioner of the constraints: S^-1 ~ F^-1 M F^-1 from two approximations of S.

    With F = D - C W B and M = D - C W A W B this is Newton's (Schulz's) step from F^-1 towards the
    inverse of D - C (2 W - W A W) B. Where A W maps what B spans into itself, and D = 0, it is
    exact (the least-squares commutator): about so with consistent mass, for which a polynomial in
    A alone needs more terms. Without M it is F^-1.
    """

    def create(self, pc: PETSc.PC) -> None:
        """Called by PETSc, as the other methods are."""
        self._factors = PETSc.PC().create(pc.comm)
        self._between: Any = None
        self._work: tuple[Any, ...] = ()

    def setFromOptions(self, pc: PETSc.PC) -> None:
        """Options of the factorisation."""
        self._factors.setOptionsPrefix(f"{pc.getOptionsPrefix() or ''}{FACTORS}")
        self._factors.setFromOptions()

    def setUp(self, pc: PETSc.PC) -> None:
        """Factorise anew."""
        _, first = pc.getOperators()
        if self._between:
            self._between.destroy()
        self._between = first.query(_SECOND)
        self._factors.setOperators(first)
        self._factors.setUp()
        if not self._work:
            self._work = first.createVecs()

    def apply(self, _pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Approximate S y = x."""
        if not self._between:
            self._factors.apply(x, y)
            return
        a, b = self._work
        self._factors.apply(x, a)
        self._between.mult(a, b)
        self._factors.apply(b, y)

    def destroy(self, _pc: PETSc.PC) -> None:
        """Free what `create` and `setUp` made."""
        for each in (self._factors, self._between, *self._work):
            if each:
                each.destroy()


def set_schur(snes: PETSc.SNES, approximation: SchurApproximation) -> None:
    """Give a Schur field split what its constraints are preconditioned with.

    Args:
        snes: The SNES.
        approximation: For `SchurInverse`, whose matrix is the first of the two.
    """
    approximation.first.compose(_SECOND, approximation.second)
    user = PETSc.PC.SchurPreType.USER
    snes.getKSP().getPC().setFieldSplitSchurPreType(user, approximation.first)


def take_bodies(
    snes: PETSc.SNES, operator: PETSc.Mat, bodies: Sequence[IntArray], split: bool
) -> None:
    """Let this rank's preconditioner take whole bodies. Collective, before the first solve.

    Args:
        snes: Configured with `whole`.
        operator: What it solves with.
        bodies: Numbers of each body in the bodies' part of the operator.
        split: Whether the preconditioner is a field split.
    """
    ksp = snes.getKSP()
    ksp.setOperators(operator, operator)
    pc = ksp.getPC()
    if split:
        pc.setUp()
        pc = pc.getFieldSplitSubKSP()[0].getPC()
    index = [numbers.astype(PETSc.IntType) for numbers in bodies]
    parts = [PETSc.IS().createGeneral(numbers, comm=PETSc.COMM_SELF) for numbers in index]
    pc.setASMLocalSubdomains(len(parts), parts)
    for part in parts:
        part.destroy()


def keep_bodies(snes: PETSc.SNES, keep: bool) -> None:
    """Whether a field split keeps the bodies' preconditioner when the matrix changes.

    Args:
        snes: Has solved a linear system before.
        keep: Keep it, or make it anew from now on.
    """
    pc = snes.getKSP().getPC()
    if pc.getType() == "fieldsplit":
        pc.getFieldSplitSubKSP()[0].getPC().setReusePreconditioner(keep)
