"""Forces along a coordinate, a length or an angle, between points of bodies (theory section 14).

A force D acts along a coordinate xi, a length or an angle. By a discrete gradient of xi its work is
D (xi_1 - xi_0): that of a spring, D = [V(xi_1) - V(xi_0)]/(xi_1 - xi_0), is V(xi_1) - V(xi_0); a
damper with D = c (xi_1 - xi_0)/h takes c (xi_1 - xi_0)^2/h. Where an integrator has no discrete
gradients, D and the gradient are those of the place and velocity where it takes its forces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from dolfinx_nts.interaction.coupling import Joint, Slopes
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.point_elements import EveryStep, PointElements
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.joints.between import direction, named, points_of, require_directions, triad
from dolfinx_nts.kernels import springs as kernel
from dolfinx_nts.parallel import rank_of
from dolfinx_nts.validation import StepFailedError, require_same, vector

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Part of their distance from the origin within which two points are one.
_ROUNDED = 1e-9


@dataclass(frozen=True, eq=False)
class Way:
    """A coordinate between two bodies, or a body and the ground.

    Attributes:
        coordinate: How it follows from vectors.
        sides: Nodes that these depend on, of each body.
        weights: Of the nodes in the vectors, shape (v, k).
        constants: What is added, shape (v, 3).
    """

    coordinate: type[kernel.Length] | type[kernel.Angle]
    sides: tuple[Points, ...]
    weights: FloatArray
    constants: FloatArray

    def vectors(self, y: FloatArray) -> FloatArray:
        """From nodal vectors (n, k, 3), shape (n, v, 3)."""
        return self.directed(y) + self.constants

    def directed(self, y: FloatArray) -> FloatArray:
        """The same without constants, as of velocities."""
        found: FloatArray = np.einsum("va,nai->nvi", self.weights, y)
        return found

    def nodal(self, values: Sequence[FloatArray]) -> FloatArray:
        """Values at the nodes, (n, k, 3), from those of the bodies' coordinates. Collective."""
        parts = [side.nodal(v) for side, v in zip(self.sides, values, strict=True)]
        return np.concatenate(parts, axis=1)

    def reference(self) -> FloatArray:
        """Nodal vectors in the reference [m], shape (n, k, 3)."""
        return np.concatenate([side.reference for side in self.sides], axis=1)


class SpringPart(NamedTuple):
    """What springs and dampers contribute, see `Part`.

    Attributes:
        residual: Rows of coordinates [kg m].
        tangent: Its derivative.
        end: Coordinate at t_{n+1}, shape (n,).
        work: Of the forces against the motion of the step [J], shape (n,).
    """

    residual: FloatArray
    tangent: FloatArray
    end: FloatArray
    work: FloatArray

    @property
    def status(self) -> BoolArray:
        """Nothing flips."""
        return np.empty((0, len(self.residual)), dtype=bool)


class Move(NamedTuple):
    """A coordinate in a step, as forces along it need it.

    Attributes:
        ends: Between which its gradient is taken, two of shape (n,).
        gradient: Its gradient.
        share: Derivative by the vectors at t_{n+1} over that by the second end, of what is
            symmetric in both ends.
        speed: Of the vectors where forces are taken, shape (n, 3 v).
        rate: Its change with the vectors at t_{n+1} [1/s].
        time: Length of the step [s] if the ends are those of the step; else None.
    """

    ends: tuple[FloatArray, FloatArray]
    gradient: kernel.Gradient
    share: float
    speed: FloatArray
    rate: float
    time: float | None


class Force(Protocol):
    """A force D along a coordinate."""

    @property
    def settings(self) -> dict[str, float]:
        """The numbers that it was made of."""

    def pull(self, move: Move) -> tuple[FloatArray, FloatArray]:
        """D, shape (n,), and its derivative by the vectors at t_{n+1}, shape (n, 3 v)."""

    def slopes(self, at: FloatArray) -> tuple[float, float]:
        """Derivatives of D by the coordinate and by its rate on this rank. Collective."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SpringElements(PointElements):
    """One spring or damper in a step, on the rank that has it.

    Attributes:
        way: Its coordinate.
        force: Along it.
        step: The step.
        y0: Nodal vectors at t_n [m], shape (n, k, 3).
        drift: Their velocities where forces are taken without motion [m/s], shape (n, k, 3).
        near: Coordinate at t_n, shape (n,).
        loses: Column of the ledger for its work; "": none.
    """

    way: Way
    force: Force
    step: Step
    y0: FloatArray
    drift: FloatArray
    near: FloatArray
    loses: str

    def evaluate(self, x: FloatArray, own: Any) -> SpringPart:
        """Residual and tangent."""
        way, theta, n = self.way, self.step.integrator.taken_at, len(x)
        rate = self.step.moments[0].rate
        du = x - self.y0
        first, last = (self.y0, x) if theta is None else (self.y0 + theta * du,) * 2
        a, b = way.vectors(first), way.vectors(last)
        at_a = way.coordinate.value(a, self.near)
        at_b = way.coordinate.value(b, at_a) if theta is None else at_a
        gradient = way.coordinate.gradient(a, b, at_a, at_b)
        move = Move(
            ends=(at_a, at_b),
            gradient=gradient,
            share=1.0 if theta is None else 2.0 * theta,
            speed=way.directed(self.drift + rate * du).reshape(n, 3 * len(way.weights)),
            rate=rate,
            time=self.step.dt if theta is None else None,
        )
        pull, slope = self.force.pull(move)
        bend = move.share * pull[:, None, None] * gradient.change
        tangent = (bend + gradient.mean[:, :, None] * slope[:, None]).reshape(n, *a.shape[1:] * 2)
        along = np.einsum("va,nvi->nai", way.weights, gradient.mean.reshape(a.shape))
        size, factor = self.num_coordinates, self.step.factor
        return SpringPart(
            factor * (pull[:, None, None] * along).reshape(n, size),
            factor
            * np.einsum("va,nviwj,wb->naibj", way.weights, tangent, way.weights, optimize=True)
            .reshape(n, size, size),
            way.coordinate.value(way.vectors(x), at_b),
            pull * np.einsum("nai,nai->n", along, du),
        )  # fmt: skip

    def ledger(self, part: SpringPart, factor: float) -> dict[str, float]:
        """What a damper takes [J]."""
        return {self.loses: float(part.work.sum())} if self.loses else {}


class Between(Joint):
    """What springs and dampers have in common, see `Joint`.

    Args:
        ends: Its bodies; None is the ground.
        name: In messages and files; None: made of its kind and the bodies' names.
    """

    _way: Way
    _force: Force

    def __init__(self, ends: tuple[Any, Any], name: str | None) -> None:
        self.name = named(type(self).__name__, ends, name)
        self.bodies = tuple(body for body in ends if body is not None)
        both = ["ground" if body is None else body.name for body in ends]
        self._given: dict[str, Any] = {"bodies": both}
        if ends[0] is ends[1] and ends[0].rigid:
            raise ValueError(
                f"a=b={ends[0].name!r}: a rigid body does not change its size, so {self.name!r} "
                "does nothing; pass another body, or None for the ground"
            )
        self.comm = self.bodies[0].comm
        self._here = int(self.comm.rank == rank_of(self.name, self.comm))
        self.numbers = np.arange(self._here)

    def _lay(
        self, coordinate: Any, sides: list[Points], rows: list[tuple[FloatArray, FloatArray]]
    ) -> None:
        """Set the coordinate: vectors of all nodes' weights (k,) and a constant (3,) each."""
        here = tuple(side.part(slice(self._here)) for side in sides)
        weights, constants = (np.array(part) for part in zip(*rows, strict=True))
        self._way = Way(coordinate, here, weights, constants)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """What a restart compares; of a user's own energy nothing."""
        return self._given | self._force.settings

    def start(self) -> FloatArray:
        """The turns of an angle begin with none."""
        return np.zeros(self._here)

    def _check(self, step: Step) -> None:
        """Raise where its coordinate cannot be followed through a step. Collective."""

    def _at(self, u: Sequence[FloatArray], history: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Nodal vectors [m] and the coordinate. Collective."""
        y = self._way.reference() + self._way.nodal(u)
        return y, self._way.coordinate.value(self._way.vectors(y), history)

    def slopes(self, u: Sequence[FloatArray], history: FloatArray) -> Slopes:
        """Gradient of the coordinate, and derivatives of the force. Collective.

        Args:
            u: Owned displacements of each of its bodies [m].
            history: The coordinate there.
        """
        y, at = self._at(u, history)
        p = self._way.vectors(y)
        mean = self._way.coordinate.gradient(p, p, at, at).mean.reshape(p.shape)
        along = np.einsum("va,nvi->nai", self._way.weights, mean)
        gradients, first = [], 0
        for side in self._way.sides:
            here = slice(first, first := first + side.nodes.shape[1])
            gradients.append(side.gathered(along[:, here]))
        stiffness, damping = self.comm.allreduce(np.array(self._force.slopes(at))).tolist()
        return Slopes(gradients, stiffness, damping, self._way.coordinate is kernel.Angle)

    def coupling(self, bodies: tuple[int, ...]) -> EveryStep:
        """What makes its elements in a run, and remembers the coordinate."""
        way, still = self._way, [np.zeros(body.num_owned) for body in self.bodies]

        def make(step: Step, history: FloatArray) -> SpringElements:
            self._check(step)
            y0, near = self._at([step.state.u[b] for b in bodies], history)
            drift = [step.moments[b].drift for b in bodies]
            velocity = [none if v is None else v for v, none in zip(drift, still, strict=True)]
            return SpringElements(
                name=self.name, sides=way.sides, way=way, force=self._force, step=step, y0=y0,
                drift=way.nodal(velocity), near=near, loses="".join(self.losses),
            )  # fmt: skip

        return EveryStep(bodies, make, lambda part: part.end)


class BetweenPoints(Between):
    """Along the line between two points; attributes as of `Joint`."""

    def _between(self, ends: tuple[Any, Any], points: Any) -> float:
        """Set the coordinate; its value in the reference, exactly 0 where the points coincide."""
        require_same(self.comm, points=points)
        given = _pair("points", points)
        self._given["points"] = [x.tolist() for x in given]
        held, constant = [], np.zeros(3)
        for sign, body, x in zip((1.0, -1.0), ends, given, strict=True):
            if body is None:
                constant += sign * x
                continue
            side = points_of(f"points of {self.name!r}", body, x)
            held.append((side, sign * side.weights[0]))
        weights = np.concatenate([w for _, w in held])
        self._lay(kernel.Length, [side for side, _ in held], [(weights, constant)])
        length = float(np.linalg.norm(given[0] - given[1]))
        return 0.0 if length <= _ROUNDED * max(map(np.linalg.norm, given)) else length

    def _undirected(self, reason: str) -> ValueError:
        return ValueError(
            f"points of {self.name!r}: they coincide, and {reason}; pass points apart from each "
            "other"
        )


class AboutAxis(Between):
    """About an axis of two bodies; attributes as of `Joint`."""

    def _about(self, ends: tuple[Any, Any], axis: Any) -> None:
        """Set the coordinate: the angle by which A turns relative to B, 0 in the reference."""
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
        self._lay(kernel.Angle, sides, rows)

    def _check(self, step: Step) -> None:
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

    def stored(self, at: FloatArray) -> float:
        """V [J] on this rank. Collective."""
        return float(self._ask(self._energy.value, at).sum())

    def pull(self, move: Move) -> tuple[FloatArray, FloatArray]:
        """The mean of V' between both ends. Collective."""
        mean, change = self._ask(self._energy.quotient, *move.ends)
        return mean, move.share * change[:, None] * move.gradient.end

    def slopes(self, at: FloatArray) -> tuple[float, float]:
        """V'' and none. Collective."""
        _, change = self._ask(self._energy.quotient, at, at)
        return 2.0 * float(change.sum()), 0.0


class Viscous(NamedTuple):
    """Force of a damper.

    Attributes:
        damping: c [N s/m] or [N m s].
    """

    damping: float

    @property
    def settings(self) -> dict[str, float]:
        """C."""
        return self._asdict()

    def pull(self, move: Move) -> tuple[FloatArray, FloatArray]:
        """C times the coordinate's mean rate in the step, or its rate where forces are taken."""
        gradient = move.gradient
        if move.time is not None:
            c = self.damping / move.time
            return c * (move.ends[1] - move.ends[0]), c * gradient.end
        rate = np.einsum("nz,nz->n", gradient.mean, move.speed)
        bend = move.share * np.einsum("nz,nzy->ny", move.speed, gradient.change)
        return self.damping * rate, self.damping * (bend + move.rate * gradient.mean)

    def slopes(self, at: FloatArray) -> tuple[float, float]:
        """None and c."""
        return 0.0, self.damping * len(at)


def _pair(name: str, value: Any) -> list[FloatArray]:
    """Two points, shape (3,) each."""
    try:
        first, second = value
    except (TypeError, ValueError):
        raise ValueError(f"{name}={value!r}: pass two points, one of each body [m]") from None
    return [vector(f"{name}[{k}]", x, "m") for k, x in enumerate((first, second))]
