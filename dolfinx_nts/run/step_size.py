"""Adaptive time steps: how far a step errs, how long the next may be, when the next gap closes.

It takes integrators of second order. What a step leaves out is h^3/12 times the third derivative
of q (that of the trapezoidal rule), here from the change of the mean acceleration (v_1 - v_0)/h
since the step before. It costs a product with the mass matrix.
"""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.equations.scales import box_of
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import known_options

#: Error of a step in powers of h, one more than the order of the integrators that it takes.
_ORDER = 3
#: Part of what the error would allow that is taken.
_CAUTION = 0.9
#: Factors of the step: a smaller growth is not worth new matrices; limits of growth and cut.
_WORTHWHILE, _GROWTH, _CUT = 1.25, 4.0, 0.25
#: A step that meets a contact ends this part of it before, lest rounding choose the active nodes.
_BEFORE = 1e-8


@known_options
@dataclass(frozen=True, kw_only=True)
class Adapt:
    """Steps as long as their error allows, which end where a gap closes if that saves energy.

    Attributes:
        tolerance: Largest error of a step, > 0: of the motion (root of its square, weighted by
            mass) relative to what the run's largest such speed covers until t_end, at most half the
            diagonal of the box around all bodies in the reference; and of the energy that nodes
            lose by closing their gaps in mid step, relative to the largest kinetic energy. A step
            in which two surfaces that were apart touch and would lose more is shortened to end
            where the first gap closes, by the velocities at its start; gaps that close while other
            nodes of the pair carry are not met.
        shortest: Smallest step, and smallest time to a gap's closing, over `dt`, in (0, 1].

    Raises:
        TypeError: An argument is no number.
        ValueError: An argument is out of range.
    """

    tolerance: float = 1e-3
    shortest: float = 1.0 / 64.0

    def __post_init__(self) -> None:
        for name, limit in (("tolerance", math.inf), ("shortest", 1.0)):
            value = getattr(self, name)
            if not isinstance(value, numbers.Real) or isinstance(value, bool):
                raise TypeError(f"{name}={value!r}: pass a number")
            if not (0.0 < float(value) <= limit and math.isfinite(value)):
                top = "" if math.isinf(limit) else " and at most 1"
                raise ValueError(f"{name}={value!r}: must be positive, finite{top}")


def factor(error: float) -> float:
    """Return by how much a step may change, from its error over the tolerance.

    Args:
        error: >= 0; a NaN counts as too large.

    Returns:
        Between `_CUT` and `_GROWTH`; 1 where a growth is not worth new matrices.
    """
    if not error > 0.0:
        return _GROWTH if error == 0.0 else _CUT
    change = min(max(_CAUTION * error ** (-1.0 / _ORDER), _CUT), _GROWTH)
    return change if error > 1.0 or change >= _WORTHWHILE else 1.0


class PaceMemory(NamedTuple):
    """What the sizes of the next steps depend on.

    Attributes:
        dt: Size of the next step [s].
        top: Largest speed so far, in the norm of the mass.
        error: Of the last step over its tolerance.
        before: Length of the last step [s]; None: its error says nothing of the next.
        accelerations: Mean ones of the last step [m/s^2], of each body; empty without `before`.
    """

    dt: float
    top: float
    error: float
    before: float | None
    accelerations: tuple[FloatArray, ...]


class Pace:
    """Sizes of the steps of a run, the same on all ranks; remembers the last accepted step.

    The first step, and the first after a contact has been met, where the acceleration jumps, are
    the shortest: nothing is known yet of how far they err.

    Args:
        adapt: Tolerances.
        system: The scene.
        state: State at the start.
        dt: Largest step [s].
        span: Length of the run [s].

    Attributes:
        dt: Size of the next step [s] unless a gap closes or the run ends before.
        longest: Largest size [s].
        shortest: Smallest size [s] but for cut steps and the last ones.
        exceeds: Whether the last step was accepted though its error is above the tolerance.
    """

    def __init__(self, adapt: Adapt, system: System, state: State, dt: float, span: float) -> None:
        self._tolerance, self._span = adapt.tolerance, span
        self.longest, self.shortest = dt, adapt.shortest * dt
        self.dt = self.shortest
        self._top, self._size = _norms(system, state.v)[0], _size(system)
        self._before: tuple[float, tuple[FloatArray, ...]] | None = None
        self._error, self._meets, self.exceeds = 0.0, False, False

    @property
    def memory(self) -> PaceMemory:
        """What `resume` needs to go on as if the run had not ended."""
        before, accelerations = self._before or (None, ())
        return PaceMemory(self.dt, self._top, self._error, before, accelerations)

    def resume(self, memory: PaceMemory) -> None:
        """Go on from another run's memory."""
        self.dt = min(max(memory.dt, self.shortest), self.longest)
        self._top, self._error = memory.top, memory.error
        if memory.before is not None:
            self._before = memory.before, memory.accelerations

    def propose(self, left: float) -> float:
        """The next step [s]; the last two are equal.

        Args:
            left: Time to the end of the run [s].
        """
        if self.dt >= left * (1 - 1e-9):
            return left
        return min(self.dt, 0.5 * left)

    def first_touch(self, problem: StepProblem) -> float:
        """Part of the step that `problem.begin` fixed after which a contact begins, or 1.

        In free flight a node whose gap closes after a part theta of the step would be pushed back
        by 1 - theta of its way. The force for that follows from its mass, and force x gap is lost.
        Nodes that close within the shortest step count as touching. Contacts that carry at t_n are
        left out: a consistent mass makes their nodes bounce in turn, and to meet each bounce costs
        many steps and saves no energy (measured). Every rank must call it.
        """
        comm, state, contacts = problem.system.comm, problem.state, problem.couplings.contacts
        forces = [state.contacts[k].force for k in contacts.numbers]
        carrying = np.array([bool((force > 0.0).any()) for force in forces], dtype=bool)
        comm.Allreduce(MPI.IN_PLACE, carrying, op=MPI.LOR)
        lost, first = 0.0, 1.0
        for c, end, late in zip(contacts.elements, contacts.flight_gaps(), carrying, strict=True):
            gap = c.candidates.gap
            closing = (end < 0.0) & (gap > 0.0) & ~late
            part = gap[closing] / (gap[closing] - end[closing])
            apart = part * problem.dt > self.shortest
            force = -c.law.scale[closing] * end[closing] / problem.factor
            lost += float((force * gap[closing])[apart].sum())
            first = min(first, float(part[apart].min(initial=1.0)))
        lost, first = comm.allreduce(lost), comm.allreduce(first, op=MPI.MIN)
        self._meets = lost > self._tolerance * 0.5 * self._top**2
        return first * (1.0 - _BEFORE) if self._meets else 1.0

    def accepts(self, problem: StepProblem, step: Evaluation) -> bool:
        """Return whether a solved step is good enough; sets `dt` for what comes next. Collective.

        Where a change of facet has left nodes behind their facets the step is taken as it is: a
        shorter one would only expel them faster.
        """
        h, batches = problem.dt, problem.batches
        each = zip(batches.numbers, step.terms, *batches.rates(problem.state), strict=True)
        acceleration = batches.split([
            (problem.supports.advance(k, terms.du, v0, a0)[0] - v0) / h
            for (k, *_), terms, v0, a0 in each
        ])  # fmt: skip
        speed, error = self._measure(problem, acceleration)
        short = h <= self.shortest * (1 + 1e-9)
        if not error <= 1.0 and not short and not self._expels(problem, step):
            self.cut(h * factor(error))
            return False
        self.exceeds = not error <= 1.0
        # After an error that was small by chance the next would be cut again.
        change = factor(max(error, self._error))
        if h >= self.dt * (1 - 1e-9) and change > 1.0:
            self.dt = min(h * change, self.longest)
        self._top = max(self._top, speed)
        self._before, self._error = (h, acceleration), error
        if self._meets:
            self._before, self._error, self.dt = None, 0.0, self.shortest
        return True

    def cut(self, dt: float) -> None:
        """Go on with smaller steps, but not below the shortest."""
        self.dt = max(dt, self.shortest)

    def _measure(
        self, problem: StepProblem, acceleration: tuple[FloatArray, ...]
    ) -> tuple[float, float]:
        """Speed at t_{n+1} in the norm of the mass, and error of the step over its tolerance."""
        h, bodies = problem.dt, problem.system.bodies
        v1 = [v + h * a for v, a in zip(problem.state.v, acceleration, strict=True)]
        if self._before is None:
            return _norms(problem.system, v1)[0], 0.0
        old, last = self._before
        weight = h**3 / (6.0 * (h + old))
        missed = [weight * (a - b) for a, b in zip(acceleration, last, strict=True)]
        for body, e in zip(bodies, missed, strict=True):
            e[body.fixed] = 0.0
        speed, error = _norms(problem.system, v1, missed)
        limit = self._tolerance * min(self._span * max(self._top, speed), self._size)
        return speed, error / limit if error > 0.0 else error

    def _expels(self, problem: StepProblem, step: Evaluation) -> bool:
        gain = 0.0
        for _, c, part, _ in problem.couplings.touching(step):
            gain += float(np.maximum(c.gains(part, problem.factor), 0.0).sum())
        total = float(problem.system.comm.allreduce(gain))
        return total > self._tolerance * 0.5 * self._top**2


def _size(system: System) -> float:
    """Of the bodies that move, in the norm of their mass; infinite of points alone. Collective."""
    mass = 0.0
    for body in system.bodies:
        free = np.ones(body.num_owned, dtype=bool)
        free[body.fixed] = False
        mass += float(body.nodal_mass[free].sum()) / 3.0
    radius = box_of(system)[1]
    return math.sqrt(system.comm.allreduce(mass)) * radius if radius else math.inf


def _norms(system: System, *fields: Any) -> list[float]:
    """Root of x . M x over all bodies of each field."""
    local = [
        sum(float(x @ b.inertia(x)) for b, x in zip(system.bodies, field, strict=True))
        for field in fields
    ]
    return [math.sqrt(max(s, 0.0)) for s in system.comm.allreduce(np.array(local)).tolist()]
