"""What makes elements of constraints in every step: of one joint, or of many that are alike."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from operator import is_
from typing import Any

import numpy as np

from dolfinx_nts.interaction.constraint_elements import (
    SHIFT,
    ConstraintElements,
    ConstraintPart,
    Equations,
    extents_of,
    largest_of_joints,
)
from dolfinx_nts.interaction.constraint_kinematics import Moving
from dolfinx_nts.interaction.constraint_rows import Arm, ConstraintRows, Upright, joined
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.interaction.kinematics import FAR_TURN, Kinematics
from dolfinx_nts.interaction.point_elements import EveryStep
from dolfinx_nts.interaction.points import Points, nodal
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.parallel import global_max, raise_together
from dolfinx_nts.state import State
from dolfinx_nts.types import BoolArray, FloatArray
from dolfinx_nts.validation import StepFailedError


class Constraints(EveryStep):
    """Makes `ConstraintElements` in every step, and remembers their multipliers.

    Args:
        name: For messages.
        bodies: Numbers of their bodies in the system.
        sides: Of each body, the nodes of the elements, here those of this rank.
        equations: Of this rank's elements.
        driven: Equations for some times, and c at each of them [m], shape (times, n, m); None:
            nothing is prescribed. Collective.
        redundant: Whether they may repeat others.
        upright: Numbers that are positive unless directions have turned over, which solves the
            equations, too. Collective. Or the equations whose products they are.
        arm: Vectors [m] whose turn in a step is looked at.
    """

    def __init__(
        self, name: str, bodies: tuple[int, ...], sides: Sequence[Points], equations: Equations,
        driven: Callable[[tuple[float, ...]], tuple[Equations, FloatArray]] | None = None, *,
        redundant: bool = True, upright: Upright | Equations | None = None, arm: Arm | None = None,
    ) -> None:  # fmt: skip
        n = len(equations.value)
        rows = ConstraintRows(
            tuple(sides), equations, upright, arm, np.full(n, SHIFT if redundant else 0.0),
            np.zeros(n, dtype=int), np.tile(bodies, (n, 1)), np.zeros_like(equations.value),
            np.ones(n),
        )  # fmt: skip
        self._set_up((name,), bodies, rows, driven)

    def _set_up(
        self, names: Sequence[str], bodies: tuple[int, ...], rows: ConstraintRows,
        driven: Any = None,
    ) -> None:
        super().__init__(bodies, self._elements)
        self._of, self._names, self._driven = bodies, tuple(names), driven
        others = f" and {len(names) - 1} others" if len(names) > 1 else ""
        self._name = f"{names[0]}{others}"
        self._touched = set(bodies)
        self._members: Sequence[Constraints] = (self,)
        self._all, self._resting = rows, frozenset[int]()
        #: Multipliers of the last accepted step, of all and of each joint.
        self._told: tuple[FloatArray, list[FloatArray]] = rows.force, []
        self._take(rows)
        self._scaled = False
        # What is prescribed may move its bodies in any step.
        self.rests = driven is None

    def _take(self, rows: ConstraintRows) -> None:
        """Let these be the elements of the step."""
        self._rows = rows
        self._rest = np.concatenate([side.reference for side in rows.sides], axis=1)
        self._curvature = kernel.curvature(rows.equations.weights)
        self._extents = extents_of(rows.equations, self._rest)

    # ---- many joints as one
    @property
    def alike(self) -> Hashable | None:
        """What joints within a batch have in common that `together` takes; None: none does."""
        rows, upright = self._all, self._all.upright
        if self._driven is not None:
            return None
        form = upright.value.shape[1] if isinstance(upright, Equations) else upright
        widths = (side.nodes.shape[1] for side in rows.sides)
        return (*widths, rows.equations.value.shape[1], form, rows.arm is None)

    @classmethod
    def together(cls, joints: Sequence[Constraints], batch: Any, number: int) -> Constraints:
        """One for joints that are `alike`, whose bodies are members of a batch.

        Args:
            joints: The joints.
            batch: A `BodyBatch`.
            number: For which the batch stands as the body of a side, see `Batches`.
        """
        rows = joined([joint._all for joint in joints], [joint._of for joint in joints], batch)
        new = cls.__new__(cls)
        names = [name for joint in joints for name in joint._names]
        new._set_up(names, (number,) * len(rows.sides), rows)
        new._members = joints
        new._touched = set().union(*(joint._of for joint in joints))
        return new

    # ---- in a step
    def begin(self, step: Step, history: Any, again: Evaluation | None, search: bool) -> None:
        """Make the elements of a step."""
        if self._resting:
            self._resting = frozenset()
            self._take(self._all)
        given = history if len(self._names) > 1 else (history,)
        force, told = self._told
        if not (told and all(map(is_, given, told))):
            force = self._known(given)
        self._scale(step)
        self._all = self._rows = replace(self._all, force=force)
        self.bodies = [self._of]
        super().begin(step, history, again, search)

    def _known(self, given: Sequence[Any]) -> FloatArray:
        """Multipliers from those of each joint: a guess alone.

        A run may go on from one whose joint of this name had other equations.
        """
        start, known = 0, self._all.force.copy()
        counts = np.bincount(self._all.joint, minlength=len(self._names)).tolist()
        for own, count in zip(given, counts, strict=True):
            here = known[start : start + count]
            if own is not None and own.shape == here.shape:
                here[:] = own
            start += count
        return known

    def _scale(self, step: Step) -> None:
        """Ask for the scales of the elements, in dynamics once. Collective."""
        if self._scaled and step.integrator.inertia:
            return
        least = step.least_scales([
            [side.body for side in joint._all.sides] for joint in self._members
        ])
        joint = self._all.joint
        self._all, self._scaled = replace(self._all, scale=least[joint]), True

    def rest(self, bodies: Collection[int]) -> None:
        """Leave out of the step the elements of bodies that stay where they are. Collective."""
        if not self._touched.isdisjoint(bodies):
            self._choose(self._resting | (self._touched & set(bodies)))

    def rouse(self, bodies: Collection[int]) -> None:
        """Take elements of bodies into the step again. Collective."""
        if not self._resting.isdisjoint(bodies):
            self._choose(self._resting - set(bodies))

    def _choose(self, resting: frozenset[int]) -> None:
        """Let all elements be in the step but those of some bodies. Collective."""
        self._resting = frozenset(resting)
        self.elements, self.bodies = [], []
        if self._resting >= self._touched:
            return
        assert self.step is not None
        self._take(self._all.select(~self._rest_of_rows()))
        self.elements, self.bodies = [self._elements(self.step, None)], [self._of]

    def _rest_of_rows(self) -> BoolArray:
        """Which of all elements are not in the step."""
        return np.isin(self._all.bodies, list(self._resting)).any(axis=1)

    def touched(self) -> set[int]:
        """All bodies."""
        return self._touched

    def history(self, parts: Sequence[Any]) -> Any:
        """Multipliers of an accepted step: of a joint alone an array, of many one of each."""
        force = self._all.force
        if parts:
            (part,) = parts
            force = force.copy()
            force[~self._rest_of_rows()] = part.multiplier / self._factor
        ends = np.searchsorted(self._all.joint, np.arange(len(self._names) + 1)).tolist()
        each = [force[a:b] for a, b in pairwise(ends)]
        self._told = force, each
        return each if len(each) > 1 else each[0]

    def hold_alone(self) -> None:
        """They repeat no others: nothing is lent to them, which light bodies would feel."""
        self._all = self._rows = replace(self._all, lent=np.zeros_like(self._all.lent))

    def _elements(self, step: Step, history: Any) -> ConstraintElements:
        self._factor, rows = step.factor, self._rows
        equations, prescribed = self._at(step.state.time, step.state.time + step.dt)
        driven = equations is not rows.equations
        return ConstraintElements(
            name=self._name,
            sides=rows.sides,
            equations=equations,
            curvature=kernel.curvature(equations.weights) if driven else self._curvature,
            rest=self._rest,
            prescribed=prescribed,
            y0=self._rest + self._nodal(step.state.u),
            scale=rows.scale,
            theta=step.integrator.theta,
            lent=rows.lent,
            extents=extents_of(equations, self._rest) if driven else self._extents,
            names=self._names,
            joint=rows.joint,
            moves=self._driven is not None,
        )

    def _nodal(self, values: Sequence[FloatArray]) -> FloatArray:
        """Values at the nodes, (n, k, 3), from those of each body of the system. Collective."""
        return nodal(self._rows.sides, self._of, values)

    def _at(self, *times: float) -> tuple[Equations, FloatArray]:
        """Equations that hold at these times, and c at each of them."""
        if self._driven is not None:
            return self._driven(times)
        equations = self._rows.equations
        return equations, np.array([equations.value] * len(times))

    def misses(
        self, e: Evaluation, parts: Sequence[ConstraintPart], motion: FloatArray
    ) -> bool:
        """Nothing is missed. Collective.

        Raises:
            StepFailedError: Directions have turned over.
        """
        step, upright = self.step, self._rows.upright
        if upright is None or step is None or not parts:
            return False
        (part,) = parts
        if isinstance(upright, Equations):
            along = kernel.value(kernel.factors(*upright[:2], part.end))
        else:
            along = upright(part.end, (step.state.time, step.state.time + step.dt))
        over = ~(along > 0.0).all(axis=tuple(range(1, along.ndim)))
        raise_together(
            self._rows.sides[0].body.comm,
            None if not over.any() else (
                f"step from t={step.state.time:.6g} with dt={step.dt:.3g}: "
                f"{self._names[self._rows.joint[over.argmax()]]!r} ends with directions turned "
                "over, which solves its equations, too; use a smaller dt"
            ),
            partial(StepFailedError, advises=True),
        )  # fmt: skip
        return False

    def warnings(self, parts: Sequence[ConstraintPart]) -> list[StepWarning]:
        """Whose arm has turned too far in the step. Collective."""
        arm = self._rows.arm
        if not parts or arm is None or self.step is None or not self.step.integrator.inertia:
            return []
        (part,) = parts
        one, two = arm.at(part.start), arm.at(part.end)
        sine = np.linalg.norm(np.cross(one, two), axis=1)
        angles = np.arctan2(sine, np.einsum("ni,ni->n", one, two))
        turns = global_max(self._rows.sides[0].body.comm, self._by_joint(angles))
        return [
            StepWarning(
                "turns", float(turns[k]),
                f"joint {self._names[k]!r} turns by {turns[k]:.2g} rad in a step, too far for "
                "the angle to be right, though energy and momenta may be kept; use a smaller dt",
                (self._names[k],), False,
            )
            for k in np.flatnonzero(turns > FAR_TURN)
        ]  # fmt: skip

    def _by_joint(self, values: FloatArray) -> FloatArray:
        """Largest of the elements' values (n, ...), >= 0, of each joint on this rank."""
        return largest_of_joints(len(self._names), self._rows.joint, values)

    def kinematics(self, state: State, dt: float) -> list[Kinematics | None]:
        """Do as `JointCoupling`, in closed form but for what is prescribed."""
        if not self.elements:
            return []
        (batch,) = self.elements
        of = Moving(self._rest, self._nodal, self._at, self._by_joint, self.step)
        return [of.kinematics(batch, state, dt)]

    def load_step_work(
        self, before: Any, after: Any, start: float, end: float
    ) -> float:
        """Work of prescribed values, -lambda . (c_1 - c_0) with the mean of both lambda [J]."""
        if self._driven is None:
            return 0.0
        _, (c0, c1) = self._at(start, end)
        # Nothing acts before the first load step.
        force = after if before is None else before + after
        return -0.5 * float((force * (c1 - c0)).sum())

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Multipliers of the last step."""
        return self._factor * self._rows.force / self._rows.scale[:, None]
