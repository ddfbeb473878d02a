"""Measures of points, and laws of the forces along them (theory section 22).

A measure c, a length or an angle, is a function of vectors that are linear in the bodies'
coordinates, with a discrete gradient whose product with their motion is c_1 - c_0. A law says which
force D acts along it, or holds the force as a multiplier and says which equation that satisfies.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from dolfinx_nts.interaction.points import Points, joined_sides, nodal
from dolfinx_nts.kernels.measures import Gradient
from dolfinx_nts.types import BoolArray, FloatArray, Settings


@dataclass(frozen=True, eq=False)
class Measure:
    """One kind of measure between two bodies, or a body and the ground; axis 0 = element.

    Attributes:
        kind: How it follows from vectors, such as `kernels.measures.Length`.
        sides: Nodes that these depend on, of each body, or of a batch of bodies.
        weights: Of the nodes in the vectors, shape (n, v, k).
        constants: What is added, shape (n, v, 3).
        length: What makes a length of it [m], shape (n,): 1 of a length, that of the bodies of an
            angle.
    """

    kind: type[Any]
    sides: tuple[Points, ...]
    weights: FloatArray
    constants: FloatArray
    length: FloatArray

    def vectors(self, y: FloatArray) -> FloatArray:
        """From nodal vectors (n, k, 3), shape (n, v, 3)."""
        return self.directed(y) + self.constants

    def directed(self, y: FloatArray) -> FloatArray:
        """The same without constants, as of velocities."""
        return self.weights @ y

    def to_nodes(self, values: FloatArray) -> FloatArray:
        """Sums at the nodes, (n, k, 3), of what acts on the vectors, (n, v, 3)."""
        return self.weights.swapaxes(1, 2) @ values

    def bent_at_nodes(self, values: FloatArray) -> FloatArray:
        """The same, (n, 3 k, 3 k), of derivatives by the vectors, (n, 3 v, 3 v)."""
        n, v, k = self.weights.shape
        to_nodes = self.weights.swapaxes(1, 2)
        rows = (to_nodes @ values.reshape(n, v, 9 * v)).reshape(n, 3 * k, v, 3)
        both = to_nodes @ rows.swapaxes(1, 2).reshape(n, v, 9 * k)
        return both.reshape(n, k, 3 * k, 3).swapaxes(1, 2).reshape(n, 3 * k, 3 * k)

    def nodal(self, values: Sequence[FloatArray]) -> FloatArray:
        """Values at the nodes, (n, k, 3), from those of the bodies' coordinates. Collective."""
        return nodal(self.sides, range(len(self.sides)), values)

    def reference(self) -> FloatArray:
        """Nodal vectors in the reference [m], shape (n, k, 3)."""
        return np.concatenate([side.reference for side in self.sides], axis=1)

    @classmethod
    def joined(
        cls, each: Sequence[Measure], of: Sequence[tuple[int, ...]], batch: Any
    ) -> Measure:
        """Those of one kind as one; arguments as of `joined_sides`."""
        sides = joined_sides([measure.sides for measure in each], of, batch)
        values = (
            np.concatenate([getattr(measure, name) for measure in each])
            for name in ("weights", "constants", "length")
        )
        return cls(each[0].kind, sides, *values)


class Asked(NamedTuple):
    """When and at which rates a law is asked for its slopes.

    Attributes:
        time: [s].
        rate: Of the measure, shape (n,).
        dt: Step that follows [s].
    """

    time: float
    rate: FloatArray
    dt: float


class Move(NamedTuple):
    """A measure in a step, as laws need it.

    Attributes:
        ends: Between which its gradient is taken, two of shape (n,).
        gradient: Its gradient.
        share: Derivative by the vectors at t_{n+1} over that by the second end, of what is
            symmetric in both ends.
        speed: Of the vectors where forces are taken, shape (n, 3 v).
        rate: Its change with the vectors at t_{n+1} [1/s].
        time: Length of the step [s] if the ends are those of the step; else None.
        when: Time at which forces are taken [s].
    """

    ends: tuple[FloatArray, FloatArray]
    gradient: Gradient
    share: float
    speed: FloatArray
    rate: float
    time: float | None
    when: float


class Law(Protocol):
    """Which force D acts along a measure; it has no multiplier.

    One that stores energy has `stored(at)`, too, the energy on this rank [J], and a D whose product
    with the change of the measure is that of the energy. Collective. One that is evaluated for many
    joints at once has what `Shared` has.
    """

    @property
    def settings(self) -> Settings:
        """What it was made of, for restarts."""

    def pull(self, move: Move) -> tuple[FloatArray, FloatArray]:
        """D, shape (n,), and its derivative by the vectors at t_{n+1}, shape (n, 3 v)."""

    def slopes(self, at: FloatArray, asked: Asked | None) -> tuple[float, float]:
        """Derivatives of D by the measure and by its rate on this rank. Collective.

        Args:
            at: The measure.
            asked: When and at which rates; None: a user's function of time is not asked.
        """


class Row(NamedTuple):
    """The equation of a multiplier, whose force and measure are lengths here; shape (n,) each.

    Attributes:
        value: [m].
        by_end: Its derivative by the measure at t_{n+1}.
        by_force: Its derivative by the force.
        status: What Newton's iterations may flip.
        by_bound: Its derivative by the bound over `unit`, of a law whose bound follows from what
            its joint carries.
    """

    value: FloatArray
    by_end: FloatArray
    by_force: FloatArray
    status: BoolArray
    by_bound: FloatArray | None = None


class HoldingLaw(Protocol):
    """Which equation the multiplier of a measure satisfies; see `Shared`, too."""

    @property
    def settings(self) -> Settings:
        """What it was made of, for restarts."""

    def row(self, start: FloatArray, end: FloatArray, force: FloatArray, unit: FloatArray) -> Row:
        """Its equation. One solution, whatever the unit of forces.

        Args:
            start: The measure at t_n [m], shape (n,).
            end: At t_{n+1}.
            force: D over `unit` [m].
            unit: Force or torque per length of `force`, shape (n,).
        """


class Shared(Protocol):
    """A law of numbers, of which many make one of arrays."""

    @property
    def alike(self) -> Hashable | None:
        """What laws of a class have in common that `together` takes; None: it takes none."""

    @classmethod
    def together(cls, laws: Sequence[Any], counts: Sequence[int]) -> Any:
        """One for all their elements.

        Args:
            laws: Laws that are `alike`.
            counts: Number of elements of each on this rank.
        """


def columns(laws: Sequence[tuple[float, ...]], counts: Sequence[int]) -> list[FloatArray]:
    """Of each number of laws, which are tuples of them, one of each element; as of `Shared`."""
    return [np.repeat(np.array(column), counts) for column in zip(*laws, strict=True)]


class Rubs(HoldingLaw, Protocol):
    """A law that sticks and slips, with what leads Newton's method to it."""

    def blurred(self, width: float) -> HoldingLaw:
        """A law close to it, without a step between stick and slip below a width of slip [m]."""

    def parted(self, held: BoolArray) -> HoldingLaw:
        """The law of what sticks where told so, shape (n,), and slips on elsewhere."""

    def unlike(self, slip: FloatArray, pull: FloatArray, width: float) -> FloatArray:
        """What a force D misses of the blurred law, over the largest one, shape (n,).

        Args:
            slip: Change of the measure as a length [m], shape (n,).
            pull: D, shape (n,).
            width: Of the blurred law [m].
        """


def holds(law: Any) -> bool:
    """Whether a law holds its force as a multiplier."""
    return hasattr(law, "row")
