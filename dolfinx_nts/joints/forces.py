"""Measures between points and axes of two bodies; forces of springs and dampers (section 14).

By the discrete gradient of a measure c the work of a force D is D (c_1 - c_0): that of a spring,
D = [V(c_1) - V(c_0)]/(c_1 - c_0), is V(c_1) - V(c_0); a damper with D = d (c_1 - c_0)/h takes
d (c_1 - c_0)^2/h.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.interaction.coupling import Moment, Slopes
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.measured import Measured
from dolfinx_nts.interaction.measures import Asked, Measure, Move, columns, holds
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.interaction.sketch import STRAIGHT, Shape, Sketch, along, moved
from dolfinx_nts.joints.between import OfTwo, points_of, require_directions
from dolfinx_nts.kernels import measures as kernel
from dolfinx_nts.kernels.vectors import triad
from dolfinx_nts.types import FloatArray, Vector, Vectors
from dolfinx_nts.validation import StepFailedError, direction, require_same, vector

#: Part of their distance from the origin within which two points are one.
_ROUNDED = 1e-9


class AlongMeasure(OfTwo):
    """What acts along one measure between two bodies; its class sets `law`.

    It stores what its law's `stored` says, if that has one.

    Args:
        ends: As of `OfTwo`.
        name: Likewise.

    Attributes:
        measure: What it acts along.
        law: What it does: a `Law`, or a `HoldingLaw`, whose force is a multiplier.
        entry: Column of the ledger for the work that it takes from the bodies, and the sign with
            which it stands there; "": none. One that is not in every table is in `losses`, too.
    """

    measure: Measure
    law: Any
    entry: tuple[str, float] = ("", 1.0)

    def __init__(self, ends: tuple[Any, Any], name: str | None) -> None:
        super().__init__(ends, name)
        self._given: dict[str, Any] = {"bodies": self._names}
        if ends[0] is ends[1] and ends[0].rigid:
            raise ValueError(
                f"a=b={ends[0].name!r}: a rigid body does not change its size, so {self.name!r} "
                "does nothing; pass another body, or None for the ground"
            )

    def _lay(
        self, kind: Any, sides: list[Points], rows: list[tuple[FloatArray, FloatArray]],
        length: float = 1.0,
    ) -> None:  # fmt: skip
        """Set the measure: vectors of all nodes' weights (k,) and a constant (3,) each."""
        here = tuple(side.select(slice(self._here)) for side in sides)
        n = self._here
        weights, constants = (np.array(part)[None][:n] for part in zip(*rows, strict=True))
        self.measure = Measure(kind, here, weights, constants, np.full(n, length))

    @cached_property
    def settings(self) -> dict[str, Any]:
        """What a restart compares; of a user's own energy nothing."""
        return self._given | dict(self.law.settings)

    @property
    def mid_step(self) -> bool:
        """What holds and lets go asks for an integrator that carries no accelerations."""
        return holds(self.law)

    def potential(self, u: Sequence[FloatArray], history: FloatArray) -> float:
        """Stored energy on this rank [J]. Collective."""
        stored = getattr(self.law, "stored", None)
        return 0.0 if stored is None else float(stored(self._at(u, history)[1]))

    def start(self) -> FloatArray:
        """The turns of an angle begin with none, multipliers with zero."""
        return np.zeros((self._here, 3 if holds(self.law) else 1))

    def check_step(self, step: Step) -> None:
        """Raise where its measure cannot be followed through a step. Collective."""

    def _at(self, u: Sequence[FloatArray], history: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Nodal vectors [m] and the measure. Collective."""
        measure = self.measure
        y = measure.reference() + measure.nodal(u)
        return y, measure.kind.value(measure.vectors(y), history[:, 0])

    def slopes(
        self, u: Sequence[FloatArray], history: FloatArray, when: Moment | None = None
    ) -> Slopes | None:
        """Gradient of the measure, and derivatives of the force; None if it holds. Collective.

        Args:
            u: Owned displacements of each of its bodies [m].
            history: What it remembers there, the measure first.
            when: As of `Joint.slopes`.
        """
        if holds(self.law):
            return None
        measure, (y, at) = self.measure, self._at(u, history)
        p = measure.vectors(y)
        mean = measure.kind.gradient(p, p, at, at).mean.reshape(p.shape)
        along = measure.to_nodes(mean)
        gradients, first = [], 0
        for side in measure.sides:
            here = slice(first, first := first + side.nodes.shape[1])
            gradients.append(side.gathered(along[:, here]))
        asked = None
        if when is not None:
            local = sum(float(g @ v) for g, v in zip(gradients, when.v, strict=True))
            rate = np.full_like(at, self.comm.allreduce(local))
            asked = Asked(when.time, rate, when.dt)
        stiffness, damping = self.comm.allreduce(np.array(self.law.slopes(at, asked))).tolist()
        return Slopes(gradients, stiffness, damping, measure.kind is kernel.Angle)

    def coupling(self, bodies: tuple[int, ...]) -> Measured:
        """What makes its elements in a run, and remembers the measure."""
        return Measured(bodies, self)


class BetweenPoints(AlongMeasure):
    """What acts along the line between two points, whose length is the measure [m].

    Args:
        a: A body, or None: the ground.
        b: A body, or None: the ground.
        points: In the reference [m], one of a and one of b, shape (3,) each.
        name: As of `OfTwo`.

    Attributes:
        distance: Of the points in the reference [m], exactly 0 where they coincide.
        shape: What pictures show of it.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a point lies outside of a flexible body.
    """

    shape: Shape = STRAIGHT

    def __init__(self, a: Any, b: Any, points: Vectors, *, name: str | None = None) -> None:
        ends = (a, b)
        super().__init__(ends, name)
        require_same(self.comm, points=points)
        given = _pair("points", points)
        self._given["points"] = [x.tolist() for x in given]
        held, constant = [], np.zeros(3)
        self._ends: list[tuple[Any, FloatArray]] = []
        for sign, body, x in zip((1.0, -1.0), ends, given, strict=True):
            if body is None:
                constant += sign * x
                self._ends.append((None, x))
                continue
            side = points_of(f"points of {self.name!r}", body, x)
            self._ends.append((side, x))
            held.append((side, sign * side.weights[0]))
        weights = np.concatenate([w for _, w in held])
        self._lay(kernel.Length, [side for side, _ in held], [(weights, constant)])
        length = float(np.linalg.norm(given[0] - given[1]))
        rounded = length <= _ROUNDED * max(map(np.linalg.norm, given))
        self.distance = 0.0 if rounded else length

    def sketch(self, u: Sequence[FloatArray], when: float = 0.0) -> Sketch:
        """Its shape between the points. Collective."""
        ends = moved(self._ends, self.bodies, u)
        return Sketch(along(ends, self.shape, self.distance), ends)

    def _undirected(self, reason: str) -> ValueError:
        return ValueError(
            f"points of {self.name!r}: they coincide, and {reason}; pass points apart from each "
            "other"
        )


class AboutAxis(AlongMeasure):
    """What acts about an axis, by the angle by which a turns relative to b since the reference.

    Args:
        a: A rigid body, or None: the ground.
        b: A rigid body, or None: the ground.
        axis: In the reference, of any length.
        name: As of `OfTwo`.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is flexible.
    """

    def __init__(self, a: Any, b: Any, *, axis: Vector, name: str | None = None) -> None:
        ends = (a, b)
        super().__init__(ends, name)
        require_same(self.comm, axis=axis)
        m1, m2, n = triad(direction(f"axis of {self.name!r}", axis))
        self._given["axis"] = n.tolist()
        require_directions(ends, self.name, at_nodes=False)
        wanted = [(1, m1), (1, m2), (0, m1)]
        sides = [body.directions(n) for body in self.bodies]
        rows = []
        for end, m in wanted:
            body, weights = ends[end], [np.zeros(side.nodes.shape[1]) for side in sides]
            if body is not None:
                weights[self.bodies.index(body)] = body.directions(m).weights[0]
            rows.append((np.concatenate(weights), m if body is None else np.zeros(3)))
        lengths = [body.length for body in self.bodies]
        self._lay(kernel.Angle, sides, rows, float(np.exp(np.mean(np.log(lengths)))))

    def check_step(self, step: Step) -> None:
        """Raise where prescribed rotations may change the angle by half a turn. Collective."""
        start, end = step.state.time, step.state.time + step.dt
        turn = sum(body.prescribed_turn(start, end) for body in self.bodies)
        if turn >= np.pi:
            raise StepFailedError(
                f"step from t={start:.6g}: prescribed rotations may change the angle of "
                f"{self.name!r} by {turn:.3g} rad, half a turn or more; use a smaller dt",
                advises=True,
            )

    @classmethod
    def about(cls, joint: Any, **options: Any) -> Any:
        """One about the axis of a revolute joint.

        Args:
            joint: It has `ends`, two bodies or None for the ground, and `axis`.
            **options: As of the class.

        Raises:
            TypeError: `joint` is none with an axis.
        """
        if not (hasattr(joint, "ends") and hasattr(joint, "axis")):
            raise TypeError(f"joint={joint!r}: pass a joint with an axis, such as Revolute")
        make: Any = cls
        return make(*joint.ends, axis=joint.axis, **options)


class Stiff:
    """Force of a spring, from its stored energy.

    Args:
        energy: V as of `kernel.Linear` or `kernel.Stored`.
        ask: Calls a function of it with arrays.
    """

    def __init__(self, energy: Any, ask: Callable[..., Any]) -> None:
        self._energy, self._ask = energy, ask

    @property
    def settings(self) -> dict[str, float]:
        """Those of a linear one; functions cannot be compared."""
        return self._energy._asdict() if isinstance(self._energy, kernel.Linear) else {}

    @property
    def alike(self) -> type[kernel.Linear] | None:
        """Linear ones are; functions are asked one by one."""
        return kernel.Linear if isinstance(self._energy, kernel.Linear) else None

    @classmethod
    def together(cls, laws: Sequence[Stiff], counts: Sequence[int]) -> Stiff:
        """One with arrays of numbers."""
        stiffness, rest = columns([law._energy for law in laws], counts)
        return cls(kernel.Linear(stiffness, rest), laws[0]._ask)

    def stored(self, at: FloatArray) -> float:
        """V [J] on this rank. Collective."""
        return float(self._ask(self._energy.value, at).sum())

    def pull(self, move: Move) -> tuple[FloatArray, FloatArray]:
        """The mean of V' between both ends. Collective."""
        mean, change = self._ask(self._energy.quotient, *move.ends)
        return mean, move.share * change[:, None] * move.gradient.end

    def slopes(self, at: FloatArray, asked: Asked | None) -> tuple[float, float]:
        """V'' and none. Collective."""
        _, change = self._ask(self._energy.quotient, at, at)
        return 2.0 * float(change.sum()), 0.0


class Viscous(NamedTuple):
    """Force of a damper.

    Attributes:
        damping: c [N s/m] or [N m s], a number or of each element, shape (n,).
    """

    damping: Any

    @property
    def alike(self) -> Hashable:
        """All are."""
        return ()

    @classmethod
    def together(cls, laws: Sequence[Viscous], counts: Sequence[int]) -> Viscous:
        """One with an array of c."""
        return cls(*columns(laws, counts))

    @property
    def settings(self) -> dict[str, float]:
        """C."""
        return self._asdict()

    def pull(self, move: Move) -> tuple[FloatArray, FloatArray]:
        """C times the measure's mean rate in the step, or its rate where forces are taken."""
        gradient = move.gradient
        if move.time is not None:
            c = self.damping / move.time
            change = move.ends[1] - move.ends[0]
            return c * change, np.reshape(c, (-1, 1)) * gradient.end
        rate = np.einsum("nz,nz->n", gradient.mean, move.speed)
        bend = move.share * np.einsum("nz,nzy->ny", move.speed, gradient.change)
        by_end = bend + move.rate * gradient.mean
        return self.damping * rate, np.reshape(self.damping, (-1, 1)) * by_end

    def slopes(self, at: FloatArray, asked: Asked | None) -> tuple[float, float]:
        """None and c."""
        return 0.0, self.damping * len(at)


def _pair(name: str, value: Any) -> list[FloatArray]:
    """Two points, shape (3,) each."""
    try:
        first, second = value
    except (TypeError, ValueError):
        raise ValueError(f"{name}={value!r}: pass two points, one of each body [m]") from None
    return [vector(f"{name}[{k}]", x, "m") for k, x in enumerate((first, second))]
