"""What a run remembers beside its state and its solution, which a checkpoint keeps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.run.ledger_check import LedgerCheck
from dolfinx_nts.run.locking_watch import LockingWatch
from dolfinx_nts.run.trial import LastSteps
from dolfinx_nts.solve.newton import StepSolver
from dolfinx_nts.state import State


class RunMemory:
    """Memory of the parts of a `Stepper`, which are the arguments."""

    def __init__(
        self, problem: StepProblem, solver: StepSolver, last_steps: LastSteps,
        promises: LedgerCheck, locking: LockingWatch,
    ) -> None:  # fmt: skip
        self._problem, self._solver, self._last_steps = problem, solver, last_steps
        self._promises, self._locking = promises, locking

    @property
    def numbers(self) -> dict[str, Any]:
        """Numbers and tuples of them.

        last: start and length of the last step [s], or None; promised: see `LedgerCheck.memory`;
        measured: see `Rounding`; recent: lengths of the last two steps [s]; stress: see
        `LockingWatch.memory`; solver: see `StepSolver.memory`.
        """
        return {
            "last": self._last_steps.last,
            "promised": self._promises.memory,
            "measured": self._problem.rounding.measured,
            "recent": self._last_steps.lengths,
            "stress": self._locking.memory,
            "solver": self._solver.memory,
        }

    @property
    def nodal(self) -> dict[str, Any]:
        """Of each contact an array at the slave nodes of this rank.

        unknowns: whether they had any in the last step; force_before: p_N in the step before [N].
        """
        found: dict[str, Any] = {"unknowns": self._problem.couplings.contacts.had_unknowns}
        if (force := self._last_steps.force_before) is not None:
            found["force_before"] = force
        return found

    def resume(self, numbers: Mapping[str, Any], nodal: Mapping[str, Any], state: State) -> None:
        """Remember what a checkpoint of a state holds."""
        self._last_steps.resume(numbers, nodal, state)
        self._problem.couplings.contacts.resume(nodal["unknowns"])
        self._promises.resume(numbers["promised"])
        self._problem.rounding.measured = numbers["measured"]
        self._solver.resume(numbers["solver"])
        self._locking.resume(numbers["stress"])
