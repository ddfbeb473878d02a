"""Which preset of the linear solver a run uses, and how far its solves go."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from petsc4py import PETSc

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.solve.accuracy import Newton
from dolfinx_nts.solve.linear_solver import ITERATIVE, SolverOptions, most_iterations
from dolfinx_nts.system import System
from dolfinx_nts.types import Options

#: Part of the tolerance that an iteration aims at if it may be the last: a step that only just
#: converges would leave its whole tolerance to the ledger, where factors leave rounding.
_AIM = 1e-3
#: Range of the linear solver's tolerance that is worth it.
_FINE, _COARSE = 1e-12, 1e-5
#: With kept matrices it is this part of what an iteration leaves of the residual, as more digits
#: than the matrices allow are in vain, ...
_BELOW = 0.1
#: ... and at most this.
_KEPT = 1e-3
#: Steps before the first linear solver is tried again, at the price of about one of them.
_PATIENCE = 10
#: What MUMPS says in INFOG(1) where more pivots were put off than it has workspace for ...
_NO_WORKSPACE = (-8, -9, -17, -20)
#: ... and where it or the machine has not the memory that it needs.
_NO_MEMORY = (*_NO_WORKSPACE, -5, -7, -11, -13, -14, -19)
#: Workspace beyond MUMPS's guess [%] that it gets then, where another preset is left to try and
#: where none is. Thin bodies need it, whose nodes have about as many constraints as coordinates.
_WORKSPACE = {True: 400, False: 2000}


def _mumps_factors(pc: Any) -> Any:
    """Matrix of MUMPS's factors, whose INFOG(1) is the same on all ranks; None of others."""
    factors = pc.getType() in ("lu", "cholesky") and pc.getFactorSolverType() == "mumps"
    return pc.getFactorMatrix() if factors else None


_HAS_KLU = PETSc.Sys.hasExternalPackage("suitesparse")


def _is_chain(body: Body) -> bool:
    """Whether a body's matrix is as sparse as that of a line: rigid bodies and beams."""
    return body.bound or (body.mesh is not None and body.mesh.topology.dim == 1)


class Presets:
    """The presets of a run in the order in which they take over where a linear solve fails.

    After "krylov", "multigrid" and "chains" comes MUMPS, and then MUMPS without equations that
    repeat others, with which scenes begin that are likely to have some.

    Args:
        system: The scene.
        newton: Tolerances.
        first: Preset to begin with.
        given: The user's PETSc options, which override the presets.
        condense: Whether the contact unknowns are condensed.
        inertia: Whether the step equations have inertia.

    Attributes:
        options: PETSc options of the preset in use.
    """

    def __init__(
        self, system: System, newton: Newton, first: str, given: Options, condense: bool,
        inertia: bool,
    ) -> None:  # fmt: skip
        self._system, self._newton, self._given = system, newton, given
        self._condense, self._patience = condense, 0
        self._keeps = newton.keeps(system, inertia)
        self.forget()
        self._workspace: dict[str, int] = {}
        mumps: tuple[str, ...] = ("direct", "null-pivots")
        redundant = [pair.redundant for pair in system.contacts]
        if any(redundant):
            # No equation repeats another where bodies have mass and all contacts are lent a
            # compliance, as joints are: to look for such ones takes a fifth of MUMPS's time.
            mumps = ("redundant", "redundant null-pivots", "null-pivots")
            mumps = mumps if inertia and all(redundant) else mumps[1:]
        own = given.keys() & {"ksp_type", "pc_type", "pc_factor_mat_solver_type"}
        self._names: tuple[str, ...] = (first,)
        if first == "direct":
            self._names = mumps[:1] if own else mumps
            chains = all(map(_is_chain, system.bodies)) and not system.contacts
            auto = newton.linear_solver == "auto" and not given
            # Statics may leave a motion free, which MUMPS stands better.
            if chains and auto and inertia and _HAS_KLU:
                self._names = ("chains", *mumps)
        elif newton.linear_solver == "auto":
            self._names += mumps
        self.use(0)

    @property
    def name(self) -> str:
        """The preset in use."""
        return self._names[self._chosen]

    @property
    def keeps(self) -> bool:
        """Whether iterations may use matrices of an earlier iterate, see `Newton.reuse`."""
        return self._keeps and (self.name in ITERATIVE or self._newton.reuse is True)

    @property
    def memory(self) -> tuple[str, int, dict[str, int]]:
        """For a run that goes on: the preset in use, for how many more steps, and workspaces."""
        return self.name, self._patience, self._workspace

    def resume(self, memory: Sequence[Any]) -> None:
        """Go on from another run's memory, unless this run has no such preset."""
        name, patience, workspace = memory
        if name in self._names:
            self._patience, self._workspace = patience, dict(workspace)
            self.use(self._names.index(name))

    def first_is_due(self) -> bool:
        """Count a step; tells whether another than the first preset was in use for long enough."""
        self._patience -= 1
        return self._chosen > 0 and self._patience < 0

    def use(self, chosen: int) -> None:
        """Change to a preset by its number; the SNES and its options must be gone."""
        self._chosen = chosen
        weighed = self.name in ITERATIVE and self._newton.linear_solver == "auto"
        limit = most_iterations(self.name, self._system.size) if weighed else None
        workspace = self._workspace.get(self.name)
        self.options = SolverOptions(
            self._system.comm, self.name, self._condense, self._given, limit, workspace
        )

    def alternative(self, snes: PETSc.SNES = None) -> int | None:
        """Number of the preset that takes over where a linear solve failed, None if none does.

        It is the one in use where MUMPS may try again with more workspace, which it then gets.

        Args:
            snes: The SNES that failed, None if it is of no use any more.
        """
        follows = self._chosen < len(self._names) - 1
        factors = None if snes is None else _mumps_factors(snes.getKSP().getPC())
        if factors is not None and factors.getMumpsInfog(1) in _NO_WORKSPACE:
            had = factors.getMumpsIcntl(14)
            if had < _WORKSPACE[follows]:
                self._workspace[self.name] = min(max(5 * had, 400), _WORKSPACE[follows])
                return self._chosen
        if not follows:
            return None
        self._patience = _PATIENCE
        return self._chosen + 1

    def forget(self) -> None:
        """Forget what iterations with kept matrices have left."""
        self._left = 1.0

    def learn(self, worst: float, before: float) -> None:
        """Take note of an iteration with kept matrices in which no element changed its status.

        Args:
            worst: Residual after it over its tolerance.
            before: The same before it.
        """
        left = worst / before
        # In the end rounding is left, which says nothing of the matrices.
        self._left = left if worst > 1.0 else min(left, self._left)

    def aim(self, snes: PETSc.SNES, worst: float) -> None:
        """Let the Krylov solver of "krylov" and "multigrid" go as far as is worth it at an iterate.

        Args:
            snes: The SNES.
            worst: Residual of the iterate over its tolerance.
        """
        if self.name not in ITERATIVE or self._given.keys() & {"ksp_rtol", "ksp_max_it"}:
            return
        aim, limit = _AIM / worst, self.options.most_iterations
        if self.keeps:
            # What the linear solver leaves of the last iteration is missing in the momenta.
            last = worst * self._left <= 1.0
            rtol = min(max(aim, _FINE if last else _BELOW * self._left), _KEPT)
        else:
            rtol = aim if _FINE <= aim <= _COARSE else _COARSE
        if rtol < _COARSE:
            limit = int(limit * math.log(rtol) / math.log(_COARSE))
        snes.getKSP().setTolerances(rtol=rtol, max_it=limit)

    def why_failed(self, snes: PETSc.SNES, reason: int) -> tuple[str, bool]:
        """PETSc's reason of a failure in words, and whether they say what to do."""
        if reason != PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            return f"SNES reason {reason}", False
        ksp = snes.getKSP()
        why = f"the linear solver {self.name!r} failed, KSP reason {ksp.getConvergedReason()}"
        why += self.with_options
        factors = _mumps_factors(ksp.getPC())
        advises = factors is not None and factors.getMumpsInfog(1) in _NO_MEMORY
        if advises:
            why += (
                "; MUMPS did not get the memory for its factors: use more ranks or memory, "
                "Newton(linear_solver='krylov') (in statics 'multigrid'), or a coarser mesh"
            )
        if self._names[0] in ITERATIVE and len(self._names) == 1:
            why += "; linear_solver='auto' goes on with MUMPS where that happens"
        return why, advises

    @property
    def with_options(self) -> str:
        """The user's options as the end of a sentence, if there are any."""
        return f", with petsc_options={dict(self._given)!r}" if self._given else ""
