"""What a run promises of its energy, held against every accepted step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.ledger import balance
from dolfinx_nts.parallel import Asking, global_max
from dolfinx_nts.run.solution import Solution
from dolfinx_nts.solve.accuracy import EXACT
from dolfinx_nts.types import BalanceRow, FloatArray

#: What the ledger may miss of the energy, over the tolerance of Newton's method ...
_PER_TOLERANCE = 10.0
#: ... and at least, as rounding adds up over the steps.
_LEAST = 1e-11
#: Part of the energy whose loss from the ledger makes a result doubtful, with a rule that closes
#: it and with one that does not.
_DOUBTFUL, _OPEN = 1e-3, 1e-2
#: Part of the energy that contact may bring, in a step or in a run, without a warning.
_GAIN = 0.01
#: Part of the energy that contact may take over a run without a word.
_LOSS = 0.1
_EPS = float(np.finfo(float).eps)
#: Rounding of a step's energy over that of its forces times its motion.
_ROUNDING = 10.0
#: What a run says of an energy without a value.
NOT_FINITE = (
    "the energy is not finite: that of a material, a form or a spring may not be defined for its "
    "deformation"
)


class LedgerCheck:
    """Compares the ledger of a run with what its integrator and its accuracy promise.

    Args:
        solution: Where warnings go.
        integrator: Of the run.
        rtol: Tolerance of Newton's method.
    """

    def __init__(self, solution: Solution, integrator: Integrator, rtol: float) -> None:
        self._solution, self._closes = solution, integrator.closes_ledger
        self._remedy = "use a smaller dt" if rtol <= EXACT else 'pass accuracy="exact"'
        self._remedy += integrator.ledger_remedy
        self._open = f"use EnergyMomentum(){integrator.ledger_remedy}"
        self._promise = max(_PER_TOLERANCE * rtol, _LEAST) if self._closes else _OPEN
        self._largest, self._whole, self._rounding = 0.0, 0.0, 0.0
        # Of bodies whose motion is prescribed: which they are, and their kinetic energy at first.
        self._driven: list[int] | None = None
        self._first = 0.0
        # Largest loss in a step [J], the end of that [s], and what took most of it.
        self._jerk = 0.0, 0.0, ""

    @property
    def memory(self) -> tuple[float, float, float, float, tuple[float, float, str]]:
        """Largest energies, rounding, energy of driven bodies [J]; the step that lost most."""
        return self._largest, self._whole, self._rounding, self._first, self._jerk

    def resume(self, memory: Sequence[Any]) -> None:
        """Go on from another run's memory."""
        self._largest, self._whole, self._rounding, self._first, jerk = memory
        loss, time, where = jerk
        self._jerk = loss, time, where

    @staticmethod
    def motions(problem: StepProblem, step: Evaluation) -> Asking[FloatArray]:
        """Norm of each body's motion in a step [m], (bodies,), as of `parallel.together`."""
        squares = problem.batches.sums([np.square(terms.du) for terms in step.terms])
        return np.sqrt((yield squares, np.empty(0))[0])

    def hold(
        self, problem: StepProblem, step: Evaluation, before: BalanceRow,
        row: BalanceRow, impulses: float, motions: FloatArray,
    ) -> None:  # fmt: skip
        """Warn if a step's ledger misses too much, or contact brought energy. Collective.

        Args:
            problem: Equations of the step.
            step: Their solution.
            before: BalanceRow of the balance table before it.
            row: BalanceRow of the step.
            impulses: Of all forces in the step, the sum of their absolute values [kg m/s].
            motions: As of `motions`.
        """
        energy = self._measure(problem, step, before, row)
        self._rounding += _ROUNDING * float(problem.rounding.forces @ motions) / problem.factor
        # Forces do some work even where nothing moves, as gaps are solved to 8 eps of positions:
        # the 2,450 N at each corner of a box at rest act over 1.7e-15 m.
        self._rounding += _ROUNDING * _EPS * impulses / problem.dt * problem.rounded_length
        self._tell_gain(problem, step, before, row, energy)
        missing = abs(row["ledger_residual"])
        promise = max(self._promise * self._largest, _LEAST * self._whole)
        if missing <= promise + self._rounding:
            return
        part = self._part(missing)
        if self._closes:
            text = (
                f"the ledger misses {missing:.3g}, {part:.2g} of the largest energy, where this "
                f"accuracy promises {self._promise:.0e}; {self._remedy}"
            )
        else:
            text = (
                f"the energy has changed by {missing:.3g}, {part:.2g} of the largest, more than "
                f"work, friction and contact account for; this integrator does not keep it: "
                f"{self._open}"
            )
        if not np.isfinite(missing):
            text = NOT_FINITE
        doubtful = not part <= (_DOUBTFUL if self._closes else _OPEN)
        self._solution.warn("ledger", row["time"], missing, text, grave=doubtful)

    def _measure(
        self, problem: StepProblem, step: Evaluation, before: BalanceRow,
        row: BalanceRow,
    ) -> float:  # fmt: skip
        """Note the largest energies; return that at the end of the step [J]. Collective.

        What bodies have whose motion is prescribed counts only for rounding: a heavy plate that
        drives past would hide what a body on it gains.
        """
        names = ("kinetic", "potential", "external_work", "friction_dissipation")
        sizes = [abs(one[name]) for one in (before, row) for name in names]
        self._whole, driven = max(self._whole, *sizes), [0.0, 0.0]
        bodies, comm = problem.system.bodies, problem.system.comm
        if self._driven is None and problem.integrator.inertia:
            free = [float(len(body.fixed) < body.num_owned) for body in bodies]
            self._driven = np.flatnonzero(global_max(comm, np.array(free)) == 0.0).tolist()
        if self._driven:
            local = np.zeros(2)
            for k in self._driven:
                v0, a0 = problem.state.v[k], problem.state.acceleration(k)
                speeds = v0, problem.supports.advance(k, step.bodies[k].du, v0, a0)[0]
                local += [0.5 * float(v @ bodies[k].inertia(v)) for v in speeds]
            driven = comm.allreduce(local).tolist()
            # The first row is that of the start, unless the run goes on.
            self._first = self._first if len(self._solution.rows) > 2 else driven[0]
            sizes = [abs(one[name]) for one in (before, row) for name in names[1::2]]
            for one, own in zip((before, row), driven, strict=True):
                work = abs(one["external_work"] - own + self._first)
                sizes += [one["kinetic"] - own, work]
        self._largest = max(self._largest, *sizes)
        return abs(float(row["energy"]) - driven[1])

    def _part(self, energy: float) -> float:
        """An energy over the largest one."""
        return energy / self._largest if self._largest else np.inf

    def _tell_gain(
        self, problem: StepProblem, step: Evaluation, before: BalanceRow,
        row: BalanceRow, energy: float,
    ) -> None:  # fmt: skip
        """Warn if contact has brought energy, in this step or in all. Collective."""
        total = row["impact_restored"] - row["contact_defect"]
        gain = total - before["impact_restored"] + before["contact_defect"]
        massless, kind = -row["massless_defect"], "energy from behind facets"
        if massless > _GAIN * self._largest + self._rounding:
            self._solution.warn(
                "energy from massless nodes", row["time"], massless,
                "nodes without mass that leave within steps have brought an energy of "
                f"{massless:.3g}, {self._part(massless):.2g} of the largest energy; "
                "use a smaller dt",
                grave=True,
            )  # fmt: skip
        remedy = "use a finer or smoother master, or a smaller, constant dt"
        nodes = bool(self._solution.system.contacts)
        now = row["massless_defect"] - before["massless_defect"] - gain
        if now > self._jerk[0]:
            self._jerk = now, row["time"], balance.largest_loss(problem, step, before, row)
        if not nodes and gain > _GAIN * energy + self._rounding:
            kind, text = "energy from limits of joints", (
                "joints at their limits that touch or leave in mid step bring an energy of "
                f"{gain:.3g} into a scene of {before['energy']:.3g}; use a smaller dt, in "
                "which nothing turns through a cone or past a limit"
            )
        elif gain > _GAIN * energy + self._rounding:
            where = balance.expelled(problem, step)
            text = (
                f"nodes that start behind their facets bring an energy of {gain:.3g} into "
                f"a scene of {before['energy']:.3g}, most {where}; after changes of facet {remedy}"
            )
        elif gain > 0.0 and total > _GAIN * self._largest + self._rounding:
            gain, text = total, (
                "nodes that start steps behind their facets have brought an energy of "
                f"{total:.3g} in all, {self._part(total):.2g} of the largest energy; {remedy}"
            )
        else:
            # What a coefficient of restitution takes is asked for.
            asked, lost = row["impact_restored"] != 0.0, -total - massless
            enough = lost > _LOSS * self._largest + self._rounding
            if not asked and enough and now > self._rounding:
                system, (most, when, where) = self._solution.system, self._jerk
                joints = any(joint.stops for joint in system.joints)
                who = "limits and cables" if joints else "" if nodes else "joints"
                who = ", ".join(["nodes"] * nodes + [who] * bool(who))
                moved = any(x.driven for x in (*system.contacts, *system.joints, *system.bodies))
                restored = "impact='restored' with EnergyMomentum or Midpoint"
                self._solution.warn(
                    "energy lost to contact", row["time"], lost,
                    f"{who} that begin or cease to act in mid step took an energy "
                    f"of {lost:.3g}, "
                    f"{self._part(lost):.2g} of the largest energy, the most in the step to "
                    f"t={when:.6g}: {most:.3g}{f', by {where}' * bool(where)}; how bodies rebound "
                    "may depend on it; compare with a smaller dt (with Adapt a smaller tolerance)"
                    f"{' and, where bodies are meshes, a finer one' * nodes}"
                    f"{'' if moved else f', or pass {restored}'}",
                )  # fmt: skip
            return
        self._solution.warn(kind, row["time"], gain, text, grave=True)
