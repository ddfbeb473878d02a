"""Jacobian of a step, as SNES and its preconditioner see it."""

from __future__ import annotations

from petsc4py import PETSc

from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.solve.augmented import AugmentedMatrix
from dolfinx_nts.solve.fieldsplit import keep_bodies, set_schur, take_bodies
from dolfinx_nts.solve.jacobian_reuse import KeptTangents
from dolfinx_nts.solve.presets import Presets


class StepJacobian:
    """The matrices of a step, which live as long as the layout of its unknowns.

    Attributes:
        tangents: Matrices of the bodies.
        matrix: Jacobian as SNES sees it, after `assemble`.
        assembled: Iterate that it is of.
    """

    def __init__(self, problem: StepProblem, presets: Presets) -> None:
        self._problem, self._presets = problem, presets
        self.tangents = KeptTangents(problem, lambda: presets.keeps)
        self.matrix: StepMatrix | None = None
        self._augmented: AugmentedMatrix | None = None
        self.assembled: Evaluation | None = None

    def assemble(self, e: Evaluation, snes: PETSc.SNES, *, solved: bool) -> StepMatrix:
        """Jacobian at an iterate. Every rank must call it.

        Args:
            e: The iterate.
            snes: What solves with it; None before it is made.
            solved: Whether that has done so already.
        """
        bodies, fresh = self.tangents.at(e)
        new, options, laid = self.matrix is None, self._presets.options, self._problem.laid
        if self.matrix is None:
            blocks = laid.blocks
            if options.pivots:
                blocks = [b._replace(pattern=b.pattern & b.entries) for b in blocks]
            self.matrix = StepMatrix(
                laid.layout, bodies, blocks, split=options.split, blocked=options.blocked
            )
            if options.augmented:
                self._augmented = AugmentedMatrix(self._problem, bodies)
        elif solved and laid.own and not options.augmented:
            # Of an augmented matrix contacts that close change the bodies' part.
            keep_bodies(snes, not fresh)
        if fresh or new or laid.blocks:
            tangents = [part.tangent for part in e.parts] if laid.blocks else []
            self.matrix.assemble(tangents, fresh=fresh)
            if self._augmented is not None:
                self._augmented.assemble(tangents, fresh=fresh)
        self.tangents.remember()
        if snes is not None:
            self._refresh_schur(snes)
        self.assembled = e
        return self.matrix

    @property
    def operators(self) -> tuple[PETSc.Mat, PETSc.Mat]:
        """What SNES solves with, and what the preconditioner is made of."""
        assert self.matrix is not None
        source = self.matrix if self._augmented is None else self._augmented.matrix
        return self.matrix.operator, source.operator

    def configure(self, snes: PETSc.SNES) -> None:
        """Set the linear solver's options of a SNES that has its matrices. Collective."""
        assert self.matrix is not None
        problem, options = self._problem, self._presets.options
        split = self.matrix if problem.laid.own else None
        ours = options.by_rank and problem.system.comm.size > 1
        bodies = self.matrix.whole_bodies() if ours else None
        whole = bodies is not None
        mixed = self._augmented is not None and self._augmented.mixed
        options.configure(snes, split, len(problem.laid.awake), whole=whole, mixed=mixed)
        self._refresh_schur(snes)
        if self._augmented is not None and mixed:
            self._augmented.split_bodies(snes, self.matrix.operator)
        if bodies is not None:
            take_bodies(snes, self.matrix.operator, bodies, split is not None)

    def _refresh_schur(self, snes: PETSc.SNES) -> None:
        """Give the preset's field split the Schur complement of the matrix as it is now."""
        if self._problem.laid.own and self._presets.options.schur:
            assert self.matrix is not None
            set_schur(snes, self.matrix.schur())

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        if self.matrix is not None:
            self.matrix.destroy()
            self.matrix = None
        if self._augmented is not None:
            self._augmented.destroy()
            self._augmented = None
