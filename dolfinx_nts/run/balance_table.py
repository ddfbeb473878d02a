"""The ledger of a run: its balance table, a row for each accepted step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.ledger import balance, resultants
from dolfinx_nts.parallel import Asking, together
from dolfinx_nts.run.ledger_check import LedgerCheck
from dolfinx_nts.run.record import Table
from dolfinx_nts.run.solution import Solution
from dolfinx_nts.run.start import carried_forces
from dolfinx_nts.run.trial import Trial
from dolfinx_nts.state import State
from dolfinx_nts.types import BalanceRow


class Ledger:
    """Keeps the balance table of a run.

    Args:
        solution: Whose table it is.
        promises: What energies and works are held to.
        kept: Whether energies, momenta, works and counts are known; if not, forces alone are.
    """

    def __init__(self, solution: Solution, promises: LedgerCheck, *, kept: bool) -> None:
        self._solution, self._system = solution, solution.system
        self._promises, self._kept = promises, kept
        self._known: dict[str, balance.Measured] = {}
        self._material_change = 0.0
        # The table and its length when its last row was last known, and that row.
        self._last: tuple[Any, int, Mapping[str, Any]] | None = None
        # Of the state at t_n with materials that have changed since its row was written.
        self._restated: dict[str, Any] | None = None

    def open(self, state: State, start: Solution | None) -> None:
        """Write the row of the start. Collective."""
        forces = resultants.at_start(self._system) | carried_forces(self._system, start)
        self._solution.rows = Table([balance.first_row(self._system, state) | forces])

    def restate(self, state: State, what: str, *, beyond: float) -> None:
        """Name what a change of bodies or joints does to energy and momenta. Collective.

        Args:
            state: Last accepted state.
            what: Begin of the sentence on it.
            beyond: Part of the energies that a difference must exceed.
        """
        if not self._kept:
            return
        before = self._restated or self._solution.rows[-1]
        self._known.clear()
        now = balance.measure(self._system, state, self._known)
        added = {name: now[name] - before[name] for name in now}
        energies = "kinetic", "potential"
        if sum(abs(added[e]) for e in energies) <= beyond * sum(abs(before[e]) for e in energies):
            return
        self._restated, change = now, added["kinetic"] + added["potential"]
        self._material_change += change
        text = (
            f"{what} adds {change:.3g} to the energy without work, see material_change in the "
            "balance"
        )
        if added["kinetic"]:
            momentum, spin = (np.linalg.norm(added[f"{s}_momentum"]) for s in ("linear", "angular"))
            text += (
                f"; {added['kinetic']:.3g} of it are kinetic: velocities stay as they are, and "
                f"{momentum:.3g} of linear and {spin:.3g} of angular momentum come without a force"
            )
        self._solution.warn("material changed", state.time, abs(change), text)

    def take_change(self) -> float:
        """What `restate` has found since the last row [J], which the next one is to have."""
        change, self._material_change, self._restated = self._material_change, 0.0, None
        return change

    def before(self, state: State) -> BalanceRow:
        """What `measuring` finds at t_n, which the table has but for changes of materials."""
        if not self._kept:
            return together(self._system.comm, [balance.momenta(self._system, state)])[0]
        return self._restated or self._last_row()

    def measuring(self, state: State) -> Asking[BalanceRow]:
        """Momenta of a state, and energies if they are kept, as of `parallel.together`."""
        if not self._kept:
            return balance.momenta(self._system, state)
        return balance.measuring(self._system, state, self._known)

    def _last_row(self) -> BalanceRow:
        """The table's last row, read from the table only if `enter` did not write it."""
        rows = self._solution.rows
        if self._last is None or self._last[0] is not rows or self._last[1] != len(rows):
            self._last = rows, len(rows), rows[-1]
        return self._last[2]

    def enter(self, problem: StepProblem, trial: Trial) -> None:
        """Write the row of a step that is accepted, and hold it to its promises. Collective."""
        step, impact, rows = trial.step, trial.impact, self._solution.rows
        before = self._last_row()
        known = {"time": trial.state.time, "newton_iterations": step.iterations}
        works: list[Asking[Any]] = [resultants.of_step(problem, step)]
        if self._kept:
            works += [
                balance.step_terms(problem, step), self._promises.motions(problem, step),
                balance.switches(problem, step, trial.state.time),
            ]  # fmt: skip
        forces, *of_ledger = together(self._system.comm, works)
        if self._kept:
            terms, motions, switches = of_ledger
            terms |= known
            terms["impact_restored"] = 0.0 if impact is None else impact.energy
            terms["material_change"] = self.take_change()
            if trial.fitted is not None:
                terms["external_work"] += trial.fitted.work
            first = float(rows.column("energy")[0])
            row = balance.next_row(first, before, trial.measured, terms)
        else:
            row = balance.unknown_row(self._system) | known
        if impact is not None:
            for name, impulse in zip(resultants.CONTACTS, impact.impulses, strict=True):
                forces[name] = forces[name] + impulse / problem.dt
        if trial.fitted is not None:
            for name, impulse in trial.fitted.reactions.items():
                forces[name] = forces[name] + impulse / problem.dt
        row |= forces
        rows.append(row)
        self._last = rows, len(rows), row
        if self._kept:
            self._promises.hold(problem, step, before, row, trial.impulses, motions)
            self._solution.switches.extend(switches)
