"""A cable in a step: its forces, and the equations of its multipliers (theory section 22).

Its parts, one from each point to the next, have the lengths l_k and the tensions T_k. The force on
the bodies is -T_k times the discrete gradient of l_k, so that its work is -sum T_k (l_k1 - l_k0).

Eyelets with nothing but rigid parts between them, whose points are both of the ground or of one
rigid body, slide together, as a group: only the free parts move bodies. With the tension T of the
first of them and the friction f_j of each group between two, the work is -T times the change of the
path c_0 = sum l_k, and -f_j times that of the path c_j behind the group, which is what slides over
it: the end is tied, a winch gives at the first point. What a winch gives slides over all eyelets
before the first free part, whose friction moves no body but is work of the winch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.interaction.constraint_elements import SHIFT
from dolfinx_nts.interaction.elements import NO_DIRECTION, Step, Stopped
from dolfinx_nts.interaction.measures import Measure
from dolfinx_nts.interaction.point_elements import EveryStep, PointElements
from dolfinx_nts.kernels.cable import Lengths, Stretched, turns
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Slip counts so many times a friction force of its size in what decides whether a group slips.
_STEEP = 1e3
#: Part of its length within which a cable is taut.
_TAUT = 8.0 * float(np.finfo(float).eps)
#: Part of its length from which on a part is told that may have drawn two points together.
_SHORT = 1e-3


class CablePart(NamedTuple):
    """What a cable contributes, see `Part`.

    Attributes:
        residual: Rows of coordinates and of multipliers [kg m].
        tangent: Its derivative.
        status: Whether it is taut, then where it sticks, and where it slides towards its end.
        memory: See `Memory`, shape (n, columns).
        works: What each column of the ledger has of it [J].
    """

    residual: FloatArray
    tangent: FloatArray
    status: BoolArray
    memory: FloatArray
    works: Mapping[str, float]


class Memory(NamedTuple):
    """What a cable remembers of a state, as columns; n = 0 on ranks without it.

    Attributes:
        tension: Of its parts [N], shape (n, v).
        path: c_0 [m], shape (n, 1).
        length: Its own, which a winch changes [m], shape (n, 1).
        begun: Its own where the step, or load step, began [m], shape (n, 1).
        since: c_j there [m], shape (n, multipliers).
    """

    tension: FloatArray
    path: FloatArray
    length: FloatArray
    begun: FloatArray
    since: FloatArray

    @classmethod
    def of(cls, columns: FloatArray, parts: int) -> Memory:
        """From an array for cables of so many parts."""
        return cls(*np.split(columns, np.arange(parts, parts + 4), axis=1))


class _Rows(NamedTuple):
    """Equations of the multipliers, which are lengths; m of them, v parts.

    Attributes:
        value: [m], shape (n, m).
        by_end: Derivative by the vectors at t_{n+1}, shape (n, m, v, 3).
        by_force: By the multipliers, shape (n, m, m).
        status: As of `CablePart`.
    """

    value: FloatArray
    by_end: FloatArray
    by_force: FloatArray
    status: BoolArray


@dataclass(frozen=True, eq=False, kw_only=True)
class CableElements(PointElements):
    """A cable in a step, on the rank that has it.

    Attributes:
        measure: Its length.
        step: The step.
        y0: Nodal vectors at t_n [m], shape (n, k, 3).
        stiffness: EA [N]; None: inextensible.
        friction: Coefficients at its eyelets, shape (v - 1,).
        levels: Numbers of the parts where multipliers begin: the first free one and, with friction,
            the others; none of an elastic cable.
        before: Tensions at t_n [N], shape (n, v).
        lengths: Its own at t_n, where forces are taken, and at t_{n+1} [m].
        begun: As of `Memory`.
        since: Likewise.
        scale: Force per motion in the units of the step.
    """

    measure: Measure
    step: Step
    y0: FloatArray
    stiffness: float | None
    friction: FloatArray
    levels: IntArray
    before: FloatArray
    lengths: tuple[float, float, float]
    begun: FloatArray
    since: FloatArray
    scale: float

    @property
    def bilateral(self) -> bool:
        """An elastic one has no multiplier, another one may be slack."""
        return self.stiffness is not None

    @cached_property
    def widths(self) -> Mapping[str, int]:
        """A multiplier for T, and for each f_j."""
        return {"augmented": 0, "constraints": len(self.levels)}

    @property
    def force_scale(self) -> float:
        """Unknowns are lengths: h^2/2 T, or T in statics, over this."""
        return self.scale

    @cached_property
    def sums(self) -> FloatArray:
        """Derivatives of T_k by the multipliers, and of c_j by l_k, shape (v, multipliers)."""
        found = np.arange(self.measure.weights.shape[1])[:, None] >= self.levels
        found[:, :1] = True
        return found.astype(float)

    @cached_property
    def groups(self) -> FloatArray:
        """Coefficients at the eyelets of each group between free parts, shape (m - 1, v - 1)."""
        eyelet = np.arange(1, len(self.friction) + 1)
        inside = (eyelet > self.levels[:-1, None]) & (eyelet <= self.levels[1:, None])
        found: FloatArray = inside * self.friction
        return found

    @property
    def taken_at(self) -> float | None:
        """Where gradients are; None: discrete ones, of all that keep no accelerations."""
        rule = self.step.integrator
        return None if rule.inertia and not rule.accelerations else rule.taken_at

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> CablePart:
        """Residual and tangent."""
        measure, theta, n, sums = self.measure, self.taken_at, len(x), self.sums
        factor, size, v = self.step.factor, self.num_coordinates, measure.weights.shape[1]
        force = own["constraints"]
        first, last = self.y0, x
        if theta is not None:
            first = last = self.y0 + theta * (x - self.y0)
        start, a, b, end = (measure.vectors(y) for y in (self.y0, first, last, x))
        ends = [Lengths.value(p, self.begun) for p in (a, b)]
        gradient = Lengths.gradient(a, b, *ends)
        share = 1.0 if theta is None else 2.0 * theta
        width = size + self.widths["constraints"]
        residual, tangent = np.zeros((n, width)), np.zeros((n, width, width))
        mean = gradient.mean.reshape(n, v, 3)
        bend = share * gradient.change
        parts = Lengths.each(end)
        path, paths = parts @ sums, parts.sum(axis=1)
        status = np.empty((0, n), dtype=bool)
        if self.stiffness is not None:
            pull, steep = self._stretched(*ends)
            tension = told = np.repeat(pull[:, None], v, axis=1)
            slope = share * steep[:, None] * gradient.end
            more = gradient.mean[:, :, None] * slope[:, None]
            works = {"external_work": self._winch(Lengths.value(start, pull), paths)}
        else:
            unit = self.scale
            pulls = unit / factor * force
            tension, more = pulls @ sums.T, np.zeros((n, 1, 1))
            told = self._told(tension, start, end)
            rows = self._rows(force, path, start, end)
            along = np.einsum("nva,nvi,vm->naim", measure.weights, mean, sums)
            to_end = np.einsum("nmvi,nva->nmai", rows.by_end, measure.weights)
            residual[:, size:] = unit * rows.value
            tangent[:, :size, size:] = unit * along.reshape(n, size, width - size)
            tangent[:, size:, :size] = unit * to_end.reshape(n, width - size, size)
            tangent[:, size:, size:] = unit * rows.by_force
            status = rows.status
            # Of a force that is to vanish rounding is left.
            told = np.where(rows.value[:, :1] == force[:, :1], 0.0, told)
            way = path - self.since
            if theta is None:
                way = np.einsum("nvi,nvi->nv", mean, end - start) @ sums
            works = self._works(pulls, told, way)
        forces = tension[:, :, None] * mean
        residual[:, :size] = factor * measure.to_nodes(forces).reshape(n, size)
        inner = (np.repeat(tension, 3, axis=1)[:, :, None] * bend + more)
        tangent[:, :size, :size] = factor * measure.bent_at_nodes(inner)
        length = np.full((n, 1), self.lengths[-1])
        memory = Memory(told, paths[:, None], length, self.begun[:, None], self.since)
        return CablePart(residual, tangent, status, np.hstack(memory), works)

    # ---- elastic
    def _stretched(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Tension between paths a and b, and its derivative by b."""
        before, taken, after = self.lengths
        free = (before, after) if self.taken_at is None else (taken,)
        found = [Stretched(self.stiffness or 0.0, length).quotient(a, b) for length in free]
        pull, slope = np.mean(found, axis=0)
        return pull, slope

    def _winch(self, a: FloatArray, b: FloatArray) -> float:
        """Work of a change of the free length, in the mean of both ends' paths [J]."""
        return winch_work(self.stiffness or 0.0, (a, b), (self.lengths[0], self.lengths[-1]))

    # ---- inextensible
    def _rows(
        self, force: FloatArray, path: FloatArray, start: FloatArray, end: FloatArray
    ) -> _Rows:
        """T >= 0, c_0 <= L, T (c_0 - L) = 0; each group sticks, or slips at a bound."""
        n, v = end.shape[:2]
        grown = Lengths.gradient(end, end, *(self.begun,) * 2).end.reshape(n, 1, v, 3)
        off = path[:, :1] - self.lengths[-1]
        held = force[:, :1] + off > -_TAUT * self.lengths[-1]
        value = np.where(held, off, force[:, :1])
        by_end = held[:, :, None, None] * grown
        unit = np.eye(len(self.levels))
        by_force = ~held[:, :, None] * unit[:1]
        if len(unit) == 1:
            return _Rows(value, by_end, by_force, held.T)
        angle, bent = self._turns(start, end)
        angle, bent = angle @ self.groups.T, np.einsum("je,nevi->njvi", self.groups, bent)
        tension = np.cumsum(force, axis=1)[:, :-1]
        before = np.maximum(tension, 0.0)
        more, less = np.expm1(angle), -np.expm1(-angle)
        slip, rub = (path - self.since)[:, 1:], force[:, 1:]
        # From one bound Newton's method goes to the other by way of sticking, however far it slips,
        # or it would go to and fro. From between them slip decides: between two ends that are held
        # a cable must slip, and equations by which it sticks there have no solution.
        told = np.where(np.abs(slip) > _TAUT * path[:, :1], slip, 0.0)
        trial = rub + np.clip(_STEEP * told, -less * before, more * before)
        on = trial >= more * before
        back = ~on & (trial <= -less * before)
        stick = ~(on | back)
        # A bound is T times `part`, which is `more` or -`less`.
        part = np.where(on, more, -less)
        value = np.hstack([value, np.where(stick, slip, rub - part * before)])
        behind = self.sums[:, 1:].T[None, :, :, None] * grown
        slides = ((1.0 + part) * before)[:, :, None, None] * bent
        by_end = np.concatenate(
            [by_end, np.where(stick[:, :, None, None], behind, -slides)], axis=1
        )
        ahead = np.tril(np.ones_like(unit))[:-1]
        own = unit[1:] - (part * (tension > 0.0))[:, :, None] * ahead
        # Groups of a tackle share what holds, and a limit may hold what sticks.
        own = np.where(stick[:, :, None], -SHIFT * unit[1:], own)
        by_force = np.concatenate([by_force, own], axis=1)
        return _Rows(value, by_end, by_force, np.hstack([held, stick, on]).T)

    def _turns(self, start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angles at the eyelets where forces are taken, and their derivatives by the vectors."""
        share = 0.5 if self.taken_at is None else 1.0
        angle, bent = turns(start + share * (end - start))
        return angle, share * bent

    def _told(self, tension: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
        """Tensions of all parts [N], also of rigid ones, from those of the free ones.

        Within a group it changes as it does on the way to slip. Before the first free part it is at
        a bound while the winch moves, and else keeps its ratio to what is behind.
        """
        rub = np.cumsum(self.friction * self._turns(start, end)[0], axis=1)
        along, free, given = (
            np.pad(rub, ((0, 0), (1, 0))),
            self.levels,
            self.lengths[-1] - self.begun,
        )
        told, first = tension.copy(), free[0]
        for x, new, old, feed in zip(along, told, self.before, given, strict=True):
            if not (new > 0.0).all():
                continue
            new[:] = np.exp(np.interp(x, x[free], np.log(new[free])))
            ratio, most = 0.0, x[first]
            if feed:
                ratio = -np.sign(feed) * most
            elif old[first] > 0.0 < old[0]:
                ratio = np.clip(np.log(old[0] / old[first]), -most, most)
            if most:
                new[:first] *= np.exp(ratio * (1.0 - x[:first] / most))
        return told

    def _works(self, pulls: FloatArray, told: FloatArray, way: FloatArray) -> dict[str, float]:
        """What leaves by T and by each f_j while c_j changes by `way` [J]."""
        given, pull, winch = self.lengths[-1] - self.begun, pulls[:, 0], told[:, 0]
        rubbed = (pulls * way)[:, 1:].sum(axis=1) + (pull - winch) * given
        return {
            "external_work": -float((winch * given).sum()),
            "contact_defect": float((pull * (way[:, 0] - given)).sum()),
            "friction_dissipation": float(rubbed.sum()),
        }

    def largest(self, part: CablePart) -> list[float]:
        """The largest row of its multipliers [m], and its extent."""
        rows = np.abs(self.rows(part, "constraints")).max(initial=0.0)
        return [0.0, float(rows) / self.scale, 0.0, self.extent]

    def ledger(self, part: CablePart, factor: float) -> dict[str, float]:
        """Work of the winch, what a jerk takes that makes it taut, and friction [J]."""
        return dict(part.works)

    def stopped(self, part: CablePart, rate: float) -> Stopped | None:
        """Whether it became taut; None of an elastic one."""
        if self.bilateral:
            return None
        size, width = self.num_coordinates, self.measure.weights.shape[1]
        pull = Memory.of(part.memory, width).tension[:, self.levels[0]]
        new = (self.before[:, self.levels[0]] == 0.0) & (pull != 0.0)
        push = np.where(new, -rate * self.step.factor * pull / self.scale, 0.0)
        lost = np.where(new, part.works["contact_defect"], 0.0)
        return Stopped(push[:, None] * part.tangent[:, size, :size], lost)

    def describe(self, part: Any, flips: Any) -> tuple[float, str]:
        """Its rows, and how often it became taut or slack, or stuck or slipped."""
        weight, text = super().describe(part, flips)
        text = f"{text}, flips {int(flips.sum())} times" if flips.any() else text
        places = self.measure.reference(), self.y0
        begun, parts = (Lengths.each(self.measure.vectors(y)).ravel() for y in places)
        k = int(parts.argmin())
        if parts[k] > _SHORT * parts.sum() or parts[k] > 0.5 * begun[k]:
            return weight, text
        return weight, (
            f"{text}, part {k + 1} of {self.name!r} has shrunk to length 0, or nearly, and has "
            f"{NO_DIRECTION}: let its winch (length=) stop before a point reaches the next one"
        )


def winch_work(
    stiffness: float, paths: tuple[FloatArray, FloatArray], lengths: tuple[Any, Any]
) -> float:
    """Change of the stored energy with the free length, in the mean of the paths at both ends [J].

    Beside the tension, which is the mean of those of both free lengths, it leaves nothing over.
    """
    before, after = (Stretched(stiffness, free) for free in lengths)
    return float(0.5 * sum((after.value(c) - before.value(c)).sum() for c in paths))


def pulls_of(tension: FloatArray, levels: IntArray) -> FloatArray:
    """Multipliers, (n, m), from tensions of the parts, (n, v) [N]."""
    return np.diff(tension[:, levels], prepend=0.0, axis=1)


class CableCoupling(EveryStep):
    """Makes `CableElements` in every step, and remembers `Memory`.

    Args:
        bodies: Numbers of its bodies in the system.
        cable: Its scene's part: name, measure, levels, `length_at`, stiffness, friction.
    """

    def __init__(self, bodies: tuple[int, ...], cable: Any) -> None:
        super().__init__(bodies, self._elements, lambda part: part.memory)
        self._cable = cable

    def _elements(self, step: Step, history: FloatArray) -> CableElements:
        cable, measure = self._cable, self._cable.measure
        u = [step.state.u[b] for b in self.bodies[0]]
        y0 = measure.reference() + measure.nodal(u)
        start, rule = step.state.time, step.integrator
        # Forces that are taken between both ends have the length of their time.
        parts = (0.0, 0.5 if rule.taken_at is None else rule.taken_at, 1.0)
        lengths = [cable.length_at(start + part * step.dt) for part in parts]
        old = Memory.of(history, measure.weights.shape[1])
        self._old = old
        begun, since = old.begun[:, 0], old.since
        if step.dt:
            begun = np.full(len(y0), lengths[0])
        made = CableElements(
            name=cable.name, sides=measure.sides, measure=measure, step=step, y0=y0,
            stiffness=cable.axial_stiffness, friction=cable.friction,
            levels=cable.levels, before=old.tension,
            lengths=(lengths[0], lengths[1], lengths[2]), begun=begun, since=since,
            scale=min(step.mean_scale(side.body) for side in measure.sides),
        )  # fmt: skip
        if not step.dt:
            return made
        return replace(made, since=Lengths.each(measure.vectors(y0)) @ made.sums)

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """The multipliers of the last step; a taut one stays so on a winch that gives."""
        batch, old = self.elements[k], self._old
        guess: FloatArray = batch.step.factor / batch.scale * pulls_of(old.tension, batch.levels)
        given = max(batch.lengths[-1] - batch.lengths[0], 0.0)
        guess[:, :1] += given * (old.path >= (1.0 - _TAUT) * old.length)
        return guess

    def load_step_work(self, before: Any, after: Any, start: float, end: float) -> float:
        """Work of the winch, of the mean of the tensions at both ends [J]."""
        cable = self._cable
        old, new = (Memory.of(m, cable.measure.weights.shape[1]) for m in (before, after))
        lengths = cable.length_at(start), cable.length_at(end)
        if cable.axial_stiffness is not None:
            return winch_work(cable.axial_stiffness, (old.path, new.path), lengths)
        pull = 0.5 * (old.tension[:, 0] + new.tension[:, 0])
        return -float(pull.sum()) * (lengths[1] - lengths[0])
