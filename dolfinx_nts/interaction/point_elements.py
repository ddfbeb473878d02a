"""Elements between points of bodies, the same kind in every step: what joints are made of."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dolfinx_nts.interaction.combination import Combination, num_multipliers, of_multipliers
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.interaction.elements import Step, Stopped, entries_of, over
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.interaction.kinematics import Kinematics, differenced, has_constraints, unknown
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.state import State
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False, kw_only=True)
class PointElements:
    """What elements between points of bodies have in common, see `Elements`.

    A subclass adds `evaluate`, which ranks without elements call, too. `body.points` gives the same
    points on all ranks; keep each on one rank by `select`.

    Attributes:
        name: For messages.
        sides: Of each body, the nodes of the elements' points, see `Points`.
    """

    name: str
    sides: tuple[Points, ...]
    combination: ClassVar[Combination | None] = None

    @property
    def num_elements(self) -> int:
        """On this rank."""
        return len(self.sides[0].nodes)

    @cached_property
    def num_coordinates(self) -> int:
        """Coordinates of all nodes of an element."""
        return sum(3 * side.nodes.shape[1] for side in self.sides)

    @property
    def widths(self) -> Mapping[str, int]:
        """No unknowns of its own."""
        return {"augmented": 0, "constraints": 0}

    @property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which: all."""
        return np.ones((self.widths["constraints"],) * 2, dtype=bool)

    @property
    def entries(self) -> BoolArray:
        """All but what `pattern` leaves out."""
        return entries_of(self.num_coordinates, self.pattern)

    @property
    def bilateral(self) -> bool:
        """Its constraints hold always."""
        return True

    @property
    def force_scale(self) -> Any:
        """Unknowns are forces."""
        return 1.0

    def points(self) -> tuple[IntArray, ...]:
        """Global coordinates of each body's nodes."""
        return tuple(side.flat() for side in self.sides)

    def dofs(self) -> tuple[IntArray, ...]:
        """The same with -1 where they are prescribed."""
        return tuple(side.flat(prescribed=-1) for side in self.sides)

    def reference(self) -> FloatArray:
        """Reference positions of the nodes [m], shape (n, nodes, 3)."""
        return np.concatenate([side.reference for side in self.sides], axis=1)

    @property
    def weights(self) -> FloatArray:
        """Weights of the nodes in each side's point, shape (n, sides, nodes)."""
        zeros = [np.zeros_like(side.weights) for side in self.sides]
        rows = [
            np.concatenate([*zeros[:k], side.weights, *zeros[k + 1 :]], axis=1)
            for k, side in enumerate(self.sides)
        ]
        return np.stack(rows, axis=1)

    @cached_property
    def extent(self) -> float:
        """Length beside the displacements whose rounding enters on this rank [m]."""
        return float(np.abs(self.reference()).max(initial=0.0))

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """No augmented unknowns."""
        return np.empty((self.num_elements, 0))

    def rows(self, part: Any, name: str) -> FloatArray:
        """The residual's rows of a field of own unknowns."""
        start = self.num_coordinates if name == "constraints" else part.residual.shape[1]
        return part.residual[:, start:]

    def largest(self, part: Any) -> list[float]:
        """The largest row of its constraints, which are lengths [m], and its extent."""
        rows = of_multipliers(self, self.rows(part, "constraints"))
        return [0.0, float(np.abs(rows).max(initial=0.0)), 0.0, self.extent]

    def ratios(
        self, part: Any, largest: Any, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """Its constraints over what counts as converged, if it has any."""
        if not self.widths["constraints"]:
            return {}
        limit = rtol * motion + 8 * _EPS * (rounded + largest[3])
        return {f"{self.name} constraints": over(largest[1], limit)}

    def resultant(self, part: Any, k: int, u: FloatArray) -> FloatArray:
        """Sums over the nodes of side k."""
        return self.resultants(part, k, u).sum(axis=0)

    def resultants(self, part: Any, k: int, u: FloatArray) -> FloatArray:
        """`resultant` of each element, shape (n, 4, 3). Collective."""
        side = self.sides[k]
        y = side.reference + side.nodal(u)
        start = sum(3 * other.nodes.shape[1] for other in self.sides[:k])
        force = -part.residual[:, start : start + 3 * side.nodes.shape[1]].reshape(y.shape)
        sums = (force * side.places[:, :, None]).sum(axis=1), cross(y, force).sum(axis=1)
        return np.stack([*sums, side.combine(y), np.ones((len(y), 3))], axis=1)

    def ledger(self, part: Any, factor: float) -> dict[str, float]:
        """Nothing lost."""
        return {}

    def stopped(self, part: Any, rate: float) -> Stopped | None:
        """Nothing stops."""
        return None

    def describe(self, part: Any, flips: IntArray) -> tuple[float, str]:
        """The element with the largest rows."""
        size = np.nan_to_num(np.abs(part.residual).max(axis=1), nan=np.inf)
        return float(size.max()), f"{self.name!r}: element {int(size.argmax())}"


class PointPart(NamedTuple):
    """What elements without states contribute, see `Part`."""

    residual: FloatArray
    tangent: FloatArray

    @property
    def status(self) -> BoolArray:
        """Nothing flips."""
        return np.empty((0, len(self.residual)), dtype=bool)


class EveryStep:
    """A `JointCoupling` with the same kind of elements in every step, and nothing to look for.

    Args:
        bodies: Numbers of their bodies in the system.
        make: Makes the elements of a step from it and from what is remembered.
        remember: What is remembered of an accepted one, from its part; nothing without.

    Attributes:
        make: As given.
        step: The last one that began; None before.
    """

    may_slip = False
    rests = False

    def __init__(
        self, bodies: tuple[int, ...], make: Callable[[Step, Any], Any],
        remember: Callable[[Any], Any] | None = None,
    ) -> None:  # fmt: skip
        self.bodies, self.make, self._remember = [bodies], make, remember
        self.elements: list[Any] = []
        self.step: Step | None = None
        self._history: Any = None

    def begin(self, step: Step, history: Any, again: Evaluation | None, search: bool) -> None:
        """Make the elements of a step."""
        self.step, self._history = step, history
        self.elements = [self.make(step, history)]

    def rest(self, bodies: Collection[int]) -> None:
        """It never rests."""

    def rouse(self, bodies: Collection[int]) -> None:
        """It never rests."""

    def hold_alone(self) -> None:
        """Nothing is lent."""

    def touched(self) -> set[int]:
        """All bodies."""
        return set(self.bodies[0])

    def wake(self, e: Evaluation, parts: Sequence[Any]) -> bool:
        """Nothing sleeps."""
        return False

    def misses(self, e: Evaluation, parts: Sequence[Any], motion: FloatArray) -> bool:
        """Nothing is missed."""
        return False

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Zero."""
        return np.zeros(num_multipliers(self.elements[k]))

    def warnings(self, parts: Sequence[Any]) -> list[StepWarning]:
        """Nothing to warn of."""
        return []

    def smallest(self, parts: Sequence[Any]) -> dict[str, float]:
        """Nothing to tell."""
        return {}

    def history(self, parts: Sequence[Any]) -> Any:
        """Return what is remembered of an accepted step."""
        return self._remember(parts[0]) if self._remember else None

    def load_step_work(self, before: Any, after: Any, start: float, end: float) -> float | None:
        """Return what the elements' ledgers say."""
        return None

    def kinematics(self, state: State, dt: float) -> list[Kinematics | None]:
        """Take the kinematics from the residuals of the elements of steps up to this one.

        Raises:
            TypeError: These cannot say it: elements other than `PointElements`, or with unknowns
                beside multipliers, or a `begin` of one's own.
        """
        step, history = self.step, self._history
        if step is None:
            held = [batch for batch in self.elements if has_constraints(batch)]
            if held:
                raise unknown(held[0])
            return [None] * len(self.elements)

        def make(length: float) -> Any:
            return self.make(replace(step, dt=length), history)

        return [differenced(make, self.bodies[0], state, dt)]
