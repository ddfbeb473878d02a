"""How the linear systems of a step are solved: presets, the user's PETSc options, their check."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.solve.fieldsplit import BODIES, CONSTRAINTS, FACTORS, SchurInverse, name_parts
from dolfinx_nts.solve.model_problem import model_problem
from dolfinx_nts.types import Options

#: What `Newton.linear_solver` may be.
SOLVERS = ("auto", "direct", "krylov", "multigrid")
#: Those that MUMPS may take over from.
ITERATIVE = ("krylov", "multigrid")
#: MUMPS's option for workspace beyond what it guesses [%].
WORKSPACE = "mat_mumps_icntl_14"
#: Presets; a user's `petsc_options` override them one by one.
PRESETS: dict[str, dict[str, Any]] = {
    # LU of the converted AIJ; indefinite pivoting needs more workspace than MUMPS guesses.
    "direct": {
        "snes_linesearch_type": "basic",
        "ksp_type": "preonly",
        "pc_type": "lu",
        "pc_factor_mat_solver_type": "mumps",
        WORKSPACE: 80,
    },
    # In dynamics mass dominates the bodies' M + h^2/2 K: incomplete factors are good. "selfp" is
    # replaced by `SchurApproximation`, but for a user who asks for it, and where options are
    # checked.
    "krylov": {
        "snes_linesearch_type": "basic",
        "ksp_type": "fgmres",
        "ksp_pc_side": "right",
        # Looser costs Newton iterations, and their number then depends on rounding and units.
        "ksp_rtol": 1e-5,
        "ksp_gmres_restart": 60,
        "ksp_max_it": 300,
        "pc_type": "fieldsplit",
        "pc_fieldsplit_type": "schur",
        "pc_fieldsplit_schur_fact_type": "upper",
        "pc_fieldsplit_schur_precondition": "selfp",
        BODIES + "ksp_type": "preonly",
        BODIES + "pc_type": "bjacobi",
        BODIES + "sub_pc_type": "icc",
        CONSTRAINTS + "ksp_type": "preonly",
        CONSTRAINTS + "pc_type": "python",
        CONSTRAINTS + "pc_python_type": f"{SchurInverse.__module__}.SchurInverse",
        CONSTRAINTS + FACTORS + "pc_type": "lu",
        CONSTRAINTS + FACTORS + "pc_factor_mat_solver_type": "mumps",
        # Of a user who takes LU for the first of the two approximations alone.
        CONSTRAINTS + "pc_factor_mat_solver_type": "mumps",
    },
}
# Without inertia: the field split takes the augmented matrix, see `augmented.py`, whose lower
# right block is the Schur complement's approximation, element by element.
_MULTIGRID = {
    "ksp_type": "preonly",
    "pc_type": "gamg",
    # The graph of one matrix does for those of all iterates.
    "pc_gamg_reuse_interpolation": True,
}
PRESETS["multigrid"] = PRESETS["krylov"] | {
    "pc_fieldsplit_schur_precondition": "a11",
    **{BODIES + k: v for k, v in _MULTIGRID.items()},
    CONSTRAINTS + "pc_type": "bjacobi",
    CONSTRAINTS + "sub_pc_type": "lu",
}
#: Parts of the bodies where not all of them are for a multigrid.
PARTS = ("continua", "others")
_MIXED = {
    BODIES + "pc_type": "fieldsplit",
    BODIES + "pc_fieldsplit_type": "symmetric_multiplicative",
    **{f"{BODIES}fieldsplit_{PARTS[0]}_{k}": v for k, v in _MULTIGRID.items()},
    f"{BODIES}fieldsplit_{PARTS[1]}_ksp_type": "preonly",
    f"{BODIES}fieldsplit_{PARTS[1]}_pc_type": "lu",
    f"{BODIES}fieldsplit_{PARTS[1]}_pc_factor_mat_solver_type": "mumps",
}
#: On several ranks the preconditioner of bodies is additive Schwarz with an overlap of one node,
#: which halves the iterations of smooth motion; without overlap it gains nothing.
_PARTS = {BODIES + "pc_type": "asm"}
#: The same where each rank takes whole bodies: as few iterations as on one rank. Their numbering
#: is that of the parts, which makes incomplete factors poor; of blocks PETSc reorders LU's only.
_WHOLE = _PARTS | {
    BODIES + "pc_asm_type": "basic",
    BODIES + "pc_asm_overlap": 0,
    BODIES + "sub_pc_type": "ilu",
    BODIES + "sub_pc_factor_mat_ordering_type": "rcm",
}
# Chains of rigid bodies and beams: factors hardly fill in, and KLU, made for circuits, takes half
# of the time that MUMPS spends on thousands of small fronts.
PRESETS["chains"] = {k: v for k, v in PRESETS["direct"].items() if k != WORKSPACE} | {
    "pc_factor_mat_solver_type": "klu"
}
# KLU knows no ranks: each of them solves all, which takes a fifth of MUMPS's time on two.
_ON_EACH_RANK = {
    "pc_type": "redundant",
    "redundant_pc_type": "lu",
    "redundant_pc_factor_mat_solver_type": "klu",
}
# Of equations that repeat others MUMPS leaves one out: a node that sticks to a floor and touches a
# wall has more constraints than coordinates.
PRESETS |= {"null-pivots": PRESETS["direct"] | {"mat_mumps_icntl_24": 1}}
# Where many do, as of a rigid body, it would put off all pivots of the compliance that they are
# lent (`constraints.SHIFT`), and run out of workspace. With them a contact costs 12 coordinates of
# the body and no more.
_REDUNDANT = {
    # Small pivots cost digits, of which a second solve brings back some.
    "mat_mumps_cntl_1": 1e-9,
    "ksp_type": "richardson",
    "ksp_norm_type": "none",
    "ksp_max_it": 2,
}
PRESETS |= {
    "redundant": PRESETS["direct"] | _REDUNDANT,
    "redundant null-pivots": PRESETS["null-pivots"] | _REDUNDANT,
}
#: Rows and columns are scaled in one pass: to make them alike by iteration takes as long as a
#: solve. MUMPS cannot on several ranks, and would scale nothing.
_ONE_PASS = {"mat_mumps_icntl_8": 4}
#: Below so many coordinates, without and with contact, both presets cost much the same, and MUMPS
#: leaves nothing but rounding, so that Newton's iterations hardly depend on units and ranks.
_FEW = (100, 600)
#: The same of "multigrid" without inertia, for continua alone and beside other bodies; of thin ones
#: MUMPS has less work than of the cubes that break even at 4,000.
_FEW_STATIC = (10_000, 20_000)
#: Iterations of each for 1e3 coordinates that take as long as MUMPS, and how they grow.
_WORTH = {"krylov": (60, 0.4), "multigrid": (10, 0.5)}


def choose(
    size: int, contact: bool, inertia: bool, given: Options, mixed: bool = False
) -> str:
    """Preset to begin with, but "direct" where that is as good or the user asks for it.

    Without inertia incomplete factors are poor, and "multigrid" takes their place.

    Args:
        size: Coordinates of all bodies without constraints of their own, and of those with a few
            that are worth it.
        contact: Whether contacts are declared.
        inertia: Whether the step equations have inertia.
        given: The user's PETSc options; those of a linear solver are meant for "direct".
        mixed: Whether there are other bodies beside these.
    """
    own = any(not name.startswith("snes_") for name in given)
    if own or size < (_FEW[contact] if inertia else _FEW_STATIC[mixed]):
        return "direct"
    return "krylov" if inertia else "multigrid"


def most_iterations(preset: str, size: int) -> int:
    """Krylov iterations that take as long as MUMPS, measured on blocks of 1e3 to 5e4 coordinates.

    Args:
        preset: One of `ITERATIVE`.
        size: Coordinates of all bodies.
    """
    number, power = _WORTH[preset]
    return int(number * max(1.0, size / 1e3) ** power)


#: In place of the preset's where the augmented unknowns are condensed: without zeros on its
#: diagonal their small block needs no pivoting, and starting MUMPS takes longer than all else.
_CONDENSED: Mapping[str, Mapping[str, Any]] = {
    "krylov": {CONSTRAINTS + FACTORS + "pc_type": "redundant"},
}
#: PETSc's errors "no support", "unknown type", "missing factor": an option has a wrong value.
_WRONG_VALUE = (56, 86, 92)
#: Numbers of prefixes never used, and prefixes that are free again: PETSc keeps the name of each
#: that it has seen until it ends, so that new ones for each run would never stop to take memory.
_numbers = itertools.count()
_free: list[str] = []


class SolverOptions:
    """PETSc options of a step's SNES, and which of the user's PETSc has asked for.

    Args:
        comm: MPI communicator.
        preset: Name of a preset.
        condense: Whether the augmented unknowns are condensed.
        given: The user's options without prefix; they override the preset.
        limit: Krylov iterations of a solve that are one too many, the preset's if None.
        workspace: MUMPS's beyond its guess [%], in place of the preset's and of the user's.
    """

    def __init__(
        self, comm: MPI.Comm, preset: str, condense: bool, given: Options, limit: int | None = None,
        workspace: int | None = None,
    ) -> None:  # fmt: skip
        self._comm, self._given = comm, dict(given)
        known = dict(PRESETS[preset])
        if preset == "krylov" and comm.size > 1:
            known |= _PARTS
        if preset == "chains" and comm.size > 1:
            known |= _ON_EACH_RANK
        if preset.startswith("redundant") and comm.size == 1:
            known |= _ONE_PASS
        if limit is not None:
            known["ksp_max_it"] = limit
        if workspace is not None:
            known[WORKSPACE] = workspace
            self._given.pop(WORKSPACE, None)
        if condense and preset in _CONDENSED:
            known = {k: v for k, v in known.items() if not k.startswith(CONSTRAINTS + FACTORS)}
            known |= _CONDENSED[preset]
        self._preset = known
        self._all = {**known, **self._given}
        self.augmented = preset == "multigrid" and self.split
        self._unchecked = set(self._given)
        self._entered: dict[str, str] = {}
        # Of a run that nobody closed they are removed, too: PETSc would complain when it ends of
        # those that a linear solver would have asked for that had nothing to solve.
        self._prefixes: list[str] = []
        weakref.finalize(self, _remove, self._entered, self._prefixes)

    @property
    def schur(self) -> bool:
        """Whether the preset's Schur complement is to be replaced by `SchurApproximation`."""
        name, kind = "pc_fieldsplit_schur_precondition", self._all.get("pc_fieldsplit_type")
        ours = self._preset.get(name) == "selfp" and name not in self._given
        return self.split and kind == "schur" and ours

    @property
    def most_iterations(self) -> int:
        """Iterations of a linear solve, for five digits, that are not too many."""
        return int(self._all["ksp_max_it"])

    @property
    def pivots(self) -> bool:
        """Whether factors take any entry of a column for its pivot, as KLU's do.

        They need no room beside the entries that can be non-zero, which MUMPS does: without it
        redundant contacts of rigid bodies leave it no pivot.
        """
        return bool(self._all.get("pc_factor_mat_solver_type") == "klu")

    @property
    def split(self) -> bool:
        """Whether the preconditioner is a field split, which takes the blocks of a nest."""
        return bool(self._all["pc_type"] == "fieldsplit")

    @property
    def blocked(self) -> bool:
        """Whether the bodies' matrices may be in blocks of nodes.

        If so, their preconditioner is the preset's, or has a matrix of its own.
        """
        own = any(k.startswith(("pc_", BODIES)) for k in self._given)
        return self.split and (self.augmented or not own)

    @property
    def by_rank(self) -> bool:
        """Whether each rank's preconditioner may take whole bodies, see `take_bodies`."""
        return self.blocked and not self.augmented

    def configure(
        self, snes: PETSc.SNES, matrix: StepMatrix | None, num_bodies: int, *, whole: bool = False,
        mixed: bool = False,
    ) -> None:  # fmt: skip
        """Set a SNES up from the options.

        Without constraints a field split has one part only, so the bodies' options are used.

        Args:
            snes: The SNES.
            matrix: Its matrix, if there are constraints to split off.
            num_bodies: Fields of the matrix that are bodies.
            whole: Whether each rank's preconditioner takes whole bodies, see `take_bodies`.
            mixed: Whether some bodies are not for a multigrid, see `AugmentedMatrix.split_bodies`.

        Raises:
            ValueError: PETSc refuses a value.
        """
        self._all = self._preset | (_WHOLE if whole else {}) | (_MIXED if mixed else {})
        self._all |= self._given
        options = {k: k for k in self._all}
        if matrix is None and self.split:
            outer = {k: k for k in self._all if not k.startswith(("pc_", "fieldsplit_"))}
            inner = [k for k in self._all if k.startswith(BODIES)]
            own = {k.removeprefix(BODIES): k for k in inner if not k.startswith(BODIES + "ksp_")}
            options = outer | own
        self._set(snes, options)
        if matrix is not None and self.split:
            name_parts(snes, *matrix.field_sets(num_bodies))

    def _set(self, snes: PETSc.SNES, options: Mapping[str, str]) -> None:
        """Give a SNES options (name -> the user's name) under a prefix that no other one has."""
        prefix = _free.pop() if _free else f"nts_{next(_numbers)}_"
        self._prefixes.append(prefix)
        snes.setOptionsPrefix(prefix)
        database = PETSc.Options()
        for name, source in options.items():
            database[prefix + name] = self._all[source]
            self._entered[prefix + name] = source
        try:
            with petsc_compat.klu_options() if self.pivots else nullcontext():
                snes.setFromOptions()
                if self.pivots:
                    ksp, (matrix, source, _) = snes.getKSP(), snes.getJacobian()
                    ksp.setOperators(matrix, source)
                    pc = ksp.getPC()
                    if pc.getType() == "redundant":
                        # A matrix without factors fails in the solve again, and is replaced there.
                        with suppress(PETSc.Error):
                            pc.setUp()
                    else:
                        pc.setFactorSetUpSolverType()
        except PETSc.Error as error:
            raise self._refused(error) from error

    def check(self, snes: PETSc.SNES, matrix: PETSc.Mat, source: PETSc.Mat) -> None:
        """Raise on every rank if PETSc asks for one of the user's options nowhere in a solve.

        Nothing is solved yet: most options are asked for when the solver is set up. If some are
        not, a small model problem with a constraint is solved, which asks for those of the solve
        itself and of a field split that waits for constraints. PETSc has no list of the names it
        knows: it marks an option as used when the code that reads it runs.

        Args:
            snes: The configured SNES.
            matrix: Its assembled matrix.
            source: What its preconditioner is made of.

        Raises:
            ValueError: PETSc does not know an option or its value.
        """
        if not self._unchecked:
            return
        try:
            ksp = snes.getKSP()
            ksp.setOperators(matrix, source)
            ksp.setUp()
            ksp.setUpOnBlocks()
            self._forget_used()
            if self._unchecked:
                self._solve_model()
                self._forget_used()
        except PETSc.Error as error:
            if error.ierr in _WRONG_VALUE:
                raise self._refused(error) from error
            raise
        for name in sorted(self._unchecked):
            raise ValueError(
                f"petsc_options[{name!r}]={self._given[name]!r}: not used by PETSc; "
                "correct its name or remove it"
            )

    def _refused(self, error: Exception) -> ValueError:
        given = {k: self._given[k] for k in sorted(self._unchecked)}
        why = str(error).splitlines()[-1].split("] ")[-1]
        return ValueError(f"petsc_options={given!r}: {why}; correct the value")

    def _forget_used(self) -> None:
        used = {name for key, name in self._entered.items() if petsc_compat.option_used(key)}
        self._unchecked -= set().union(*self._comm.allgather(used))

    def _solve_model(self) -> None:
        split = self.split
        matrix, parts = model_problem(self._comm, constraint=split)
        snes = PETSc.SNES().create(self._comm)
        x, f = matrix.createVecs()
        snes.setFunction(lambda _snes, x, f: (matrix.mult(x, f), f.shift(-1.0)), f)
        snes.setJacobian(lambda *_: None, matrix, matrix)
        self._set(snes, {k: k for k in self._all})
        if split:
            name_parts(snes, *parts)
        snes.solve(None, x)
        for a in (snes, x, f, matrix):
            a.destroy()

    def remove(self) -> None:
        """Take the options out of PETSc's global database."""
        _remove(self._entered, self._prefixes)


def _remove(entered: dict[str, str], prefixes: list[str]) -> None:
    database = PETSc.Options()
    for key in entered:
        database.delValue(key)
    _free.extend(prefixes)
    entered.clear()
    prefixes.clear()
