"""Springs and dampers between points of bodies, and about axes (theory section 14).

A force D acts along a coordinate xi, a length or an angle. By a discrete gradient of xi its work is
D (xi_1 - xi_0): that of a spring, D = [V(xi_1) - V(xi_0)]/(xi_1 - xi_0), is V(xi_1) - V(xi_0); a
damper with D = c (xi_1 - xi_0)/h takes c (xi_1 - xi_0)^2/h. Where an integrator has no discrete
gradients, D and the gradient are those of the place and velocity where it takes its forces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from dolfinx_nts.bodies.points import Points
from dolfinx_nts.constraints import rank_of
from dolfinx_nts.elements import EveryStep, PointElements, Step
from dolfinx_nts.kernels import springs as kernel
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.validation import (
    call_together,
    is_finite,
    known_options,
    require_name,
    require_positive,
    vector,
)

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Function = Callable[[Any], Any]

#: Part of their distance from the origin within which two points are one.
_ROUNDED = 1e-9
#: Part of the start's coordinate over which a user's energy is compared with its force, and part of
#: the force by which they may differ there: enough for a kink, not for a sign.
_COMPARED, _ALIKE = 1e-2, 0.1


@dataclass(frozen=True, eq=False)
class _Way:
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


class _SpringPart(NamedTuple):
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


class _Move(NamedTuple):
    """A coordinate in a step, as forces along it need it.

    Attributes:
        ends: Between which its gradient is taken, two of shape (n,).
        gradient: Its gradient.
        share: Part of a change at t_{n+1} that is one of the second end, for what is the same if
            both ends change places.
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


class _Force(Protocol):
    """A force D along a coordinate."""

    def pull(self, move: _Move) -> tuple[FloatArray, FloatArray]:
        """D, shape (n,), and its derivative by the vectors at t_{n+1}, shape (n, 3 v)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _SpringElements(PointElements):
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

    way: _Way
    force: _Force
    step: Step
    y0: FloatArray
    drift: FloatArray
    near: FloatArray
    loses: str

    def evaluate(self, x: FloatArray, own: Any) -> _SpringPart:
        """Residual and tangent."""
        way, rule, n = self.way, self.step.integrator, len(x)
        direct = rule.contact_gradient == "direct"
        rate = self.step.moments[0].rate
        du = x - self.y0
        first, last = (self.y0, x) if not direct else (self.y0 + rule.theta * du,) * 2
        a, b = way.vectors(first), way.vectors(last)
        at_a = way.coordinate.value(a, self.near)
        at_b = at_a if direct else way.coordinate.value(b, at_a)
        gradient = way.coordinate.gradient(a, b, at_a, at_b)
        move = _Move(
            ends=(at_a, at_b),
            gradient=gradient,
            share=2.0 * rule.theta if direct else 1.0,
            speed=way.directed(self.drift + rate * du).reshape(n, 3 * len(way.weights)),
            rate=rate,
            time=None if direct else self.step.dt,
        )
        pull, slope = self.force.pull(move)
        bend = move.share * pull[:, None, None] * gradient.change
        tangent = (bend + gradient.mean[:, :, None] * slope[:, None]).reshape(n, *a.shape[1:] * 2)
        along = np.einsum("va,nvi->nai", way.weights, gradient.mean.reshape(a.shape))
        size, factor = self.num_coordinates, self.step.factor
        return _SpringPart(
            factor * (pull[:, None, None] * along).reshape(n, size),
            factor
            * np.einsum("va,nviwj,wb->naibj", way.weights, tangent, way.weights, optimize=True)
            .reshape(n, size, size),
            way.coordinate.value(way.vectors(x), at_b),
            pull * np.einsum("nai,nai->n", along, du),
        )  # fmt: skip

    def ledger(self, part: _SpringPart, factor: float) -> dict[str, float]:
        """What a damper takes [J]."""
        return {self.loses: float(part.work.sum())} if self.loses else {}


class _Between:
    """What springs and dampers have in common, see `Joint`.

    Args:
        ends: Its bodies; None is the ground.
        name: In messages and files; None: made of its kind and the bodies' names.
    """

    losses: tuple[str, ...] = ()
    _way: _Way
    _force: _Force

    def __init__(self, ends: tuple[Any, Any], name: str | None) -> None:
        kind = type(self).__name__
        if name is not None:
            require_name("name", name)
        for role, body in zip("ab", ends, strict=True):
            if body is not None and not hasattr(body, "points"):
                raise TypeError(f"{role}={body!r}: pass a body, or None for the ground")
        self.bodies = tuple(body for body in ends if body is not None)
        if not self.bodies:
            raise ValueError(
                f"a=None, b=None: a {kind} needs a body; only one end may be the ground"
            )
        both = " and ".join("ground" if body is None else body.name for body in ends)
        self.name = name or f"{kind} of {both}"
        if ends[0] is ends[1] and hasattr(ends[0], "directions"):
            raise ValueError(
                f"a=b={ends[0].name!r}: a rigid body does not change its size, so {self.name!r} "
                "does nothing; pass another body, or None for the ground"
            )
        self.comm = self.bodies[0].comm
        self._here = int(self.comm.rank == rank_of(self.name, self.comm))

    def _lay(
        self, coordinate: Any, sides: list[Points], rows: list[tuple[FloatArray, FloatArray]]
    ) -> None:
        """Set the coordinate: vectors of all nodes' weights (k,) and a constant (3,) each."""
        here = tuple(side.part(slice(self._here)) for side in sides)
        weights, constants = (np.array(part) for part in zip(*rows, strict=True))
        self._way = _Way(coordinate, here, weights, constants)

    def start(self) -> FloatArray:
        """The turns of an angle begin with none."""
        return np.zeros(self._here)

    def potential(self, u: Sequence[FloatArray], history: FloatArray) -> float:
        """None [J]."""
        return 0.0

    def _at(self, u: Sequence[FloatArray], history: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Nodal vectors [m] and the coordinate. Collective."""
        y = self._way.reference() + self._way.nodal(u)
        return y, self._way.coordinate.value(self._way.vectors(y), history)

    def coupling(self, bodies: tuple[int, ...]) -> EveryStep:
        """What makes its elements in a run, and remembers the coordinate."""
        way, still = self._way, [np.zeros(body.num_owned) for body in self.bodies]

        def make(step: Step, history: FloatArray) -> _SpringElements:
            y0, near = self._at([step.state.u[b] for b in bodies], history)
            drift = [step.moments[b].drift for b in bodies]
            velocity = [none if v is None else v for v, none in zip(drift, still, strict=True)]
            return _SpringElements(
                name=self.name, sides=way.sides, way=way, force=self._force, step=step, y0=y0,
                drift=way.nodal(velocity), near=near, loses="".join(self.losses),
            )  # fmt: skip

        return EveryStep(bodies, make, lambda part: part.end)


class _BetweenPoints(_Between):
    """Along the line between two points; attributes as of `Joint`."""

    def _between(self, ends: tuple[Any, Any], points: Any) -> float:
        """Set the coordinate; its value in the reference, exactly 0 where the points coincide."""
        given = _pair("points", points)
        held, constant = [], np.zeros(3)
        for sign, body, x in zip((1.0, -1.0), ends, given, strict=True):
            if body is None:
                constant += sign * x
                continue
            try:
                side = body.points(x)
            except ValueError as error:
                raise ValueError(f"points of {self.name!r}: {error}") from error
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


class _AboutAxis(_Between):
    """About an axis of two bodies; attributes as of `Joint`."""

    def _about(self, ends: tuple[Any, Any], axis: Any) -> None:
        """Set the coordinate: the angle by which A turns relative to B, 0 in the reference."""
        given = vector("axis", axis, "-")
        size = float(np.linalg.norm(given))
        if size == 0.0:
            raise ValueError(f"axis={axis!r}: has no direction; pass a vector that is not zero")
        for role, body in zip("ab", ends, strict=True):
            if body is not None and not hasattr(body, "directions"):
                raise ValueError(
                    f"{role}={body.name!r}: a flexible body has no directions for {self.name!r}; "
                    "tie a rigid body to a patch of its nodes and turn that one"
                )
        n = given / size
        m1 = np.cross(np.eye(3)[np.abs(n).argmin()], n)
        m1 /= np.linalg.norm(m1)
        wanted = [(1, m1), (1, np.cross(n, m1)), (0, m1)]
        sides = [body.directions(n) for body in self.bodies]
        rows = []
        for end, m in wanted:
            body, weights = ends[end], [np.zeros(side.nodes.shape[1]) for side in sides]
            if body is not None:
                weights[self.bodies.index(body)] = body.directions(m).weights[0]
            rows.append((np.concatenate(weights), m if body is None else np.zeros(3)))
        self._lay(kernel.Angle, sides, rows)

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


class _Stiff:
    """Force of a spring, from its stored energy.

    Args:
        energy: V as of `kernel.Linear` or `kernel.Stored`.
        ask: Calls a function of it with arrays.
    """

    def __init__(self, energy: Any, ask: Callable[..., Any]) -> None:
        self._energy, self._ask = energy, ask

    def stored(self, at: FloatArray) -> float:
        """V [J] on this rank. Collective."""
        return float(self._ask(self._energy.value, at).sum())

    def pull(self, move: _Move) -> tuple[FloatArray, FloatArray]:
        """The mean of V' between both ends. Collective."""
        mean, change = self._ask(self._energy.quotient, *move.ends)
        return mean, move.share * change[:, None] * move.gradient.end


class _Viscous(NamedTuple):
    """Force of a damper.

    Attributes:
        damping: c [N s/m] or [N m s].
    """

    damping: float

    def pull(self, move: _Move) -> tuple[FloatArray, FloatArray]:
        """C times the coordinate's mean rate in the step, or its rate where forces are taken."""
        gradient = move.gradient
        if move.time is not None:
            c = self.damping / move.time
            return c * (move.ends[1] - move.ends[0]), c * gradient.end
        rate = np.einsum("nz,nz->n", gradient.mean, move.speed)
        bend = move.share * np.einsum("nz,nzy->ny", move.speed, gradient.change)
        return self.damping * rate, self.damping * (bend + move.rate * gradient.mean)


class _Stores(_Between):
    """What stores energy."""

    _force: _Stiff

    def potential(self, u: Sequence[FloatArray], history: FloatArray) -> float:
        """Stored energy on this rank [J]. Collective."""
        return self._force.stored(self._at(u, history)[1])

    def _by_stiffness(self, stiffness: Any, rest: float, unit: str) -> None:
        require_positive("stiffness", stiffness, unit)
        linear = kernel.Linear(float(stiffness), rest)
        self._force = _Stiff(linear, lambda function, *arrays: function(*arrays))

    def _by_energy(self, energy: Any, force: Any, start: float) -> None:
        """Take a user's V, after a look at it and at its derivative near the start. Collective."""
        for name, value in (("energy", energy), ("force", force)):
            if not (callable(value) or (value is None and name == "force")):
                raise TypeError(f"{name}={value!r}: pass a function of an array")
        stored = kernel.Stored(energy, force, self._way.coordinate.unit)
        label = f"energy of {self.name!r}"

        def ask(function: Callable[..., Any], *arrays: Any) -> Any:
            return call_together(self.comm, label, function, *arrays)

        raise_together(self.comm, ask(_unlike, stored, start, label))
        self._force = _Stiff(stored, ask)


def _unlike(stored: kernel.Stored, start: float, label: str) -> str | None:
    """Why a user's V and its derivative do not fit near the start, if they do not."""
    way = _COMPARED * max(abs(start), stored.unit)
    x = start + way * np.linspace(0.0, 1.0, 9)
    energy, force = stored.value(x), stored.force(x)
    if not (np.isfinite(energy) & np.isfinite(force)).all():
        return f"{label}: it or its derivative is not finite at {start:.6g}, where it starts"
    work = float(way * (0.5 * (force[0] + force[-1]) + force[1:-1].sum()) / 8.0)
    rounding = 8.0 * np.finfo(float).eps * float(np.abs(energy).max())
    missing = abs(float(energy[-1] - energy[0]) - work)
    if missing <= _ALIKE * way * float(np.abs(force).max()) + rounding:
        return None
    return (
        f"{label}: changes by {energy[-1] - energy[0]:.6g} J from {x[0]:.6g} to {x[-1]:.6g}, its "
        f"derivative says {work:.6g} J; pass force=dV/dl, or write it so that it takes complex "
        "arrays"
    )


def _pair(name: str, value: Any) -> list[FloatArray]:
    """Two points, shape (3,) each."""
    try:
        first, second = value
    except (TypeError, ValueError):
        raise ValueError(f"{name}={value!r}: pass two points, one of each body [m]") from None
    return [vector(f"{name}[{k}]", x, "m") for k, x in enumerate((first, second))]


def _one_of(stiffness: Any, energy: Any, force: Any, rest: tuple[str, Any]) -> None:
    """Raise unless either stiffness, with rest, or energy, with force, is given."""
    if (stiffness is None) == (energy is None):
        raise ValueError(
            f"stiffness={stiffness!r}, energy={energy!r}: pass one of them, energy as a function V"
        )
    if energy is None and force is not None:
        raise ValueError(f"force={force!r}: belongs to energy=; pass that, too, or leave it out")
    if energy is not None and rest[1] is not None:
        raise ValueError(f"{rest[0]}={rest[1]!r}: belongs to stiffness=; energy says where it is")


@known_options
class Spring(_Stores, _BetweenPoints):
    """A spring between a point of a body and one of another, or of the ground.

    Linear, V = k/2 (l - length)^2, or with a V(l) of one's own. A spring of length 0 is smooth
    wherever its points are. Any other one has no direction where they coincide, and none starts so.

    Args:
        a: A body, or None: the ground.
        b: A body, or None: the ground.
        points: In the reference [m], one of a and one of b, shape (3,) each; those of rigid bodies
            may lie outside of them.
        stiffness: k [N/m], > 0.
        length: Where a linear spring is free [m]; default: its length in the reference.
        energy: V(l) [J] of an array of lengths [m], in place of stiffness.
        force: dV/dl [N] of an array, positive in tension. Without it V is differentiated by complex
            step, for which it has to take complex arrays (no abs, no comparison of lengths but by
            their real parts).
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a point lies outside of a flexible body.
        UserFunctionError: energy or force raises.
    """

    def __init__(
        self,
        a: Any,
        b: Any,
        points: Any,
        *,
        stiffness: float | None = None,
        length: float | None = None,
        energy: Function | None = None,
        force: Function | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__((a, b), name)
        _one_of(stiffness, energy, force, ("length", length))
        start = self._between((a, b), points)
        if length is not None and not (is_finite(length) and length >= 0):
            raise ValueError(f"length={length!r}: must be >= 0 and finite [m]")
        if energy is not None:
            if start == 0.0:
                raise self._undirected("a force of one's own has no direction there")
            self._by_energy(energy, force, start)
            return
        rest = start if length is None else float(length)
        if start == 0.0 and rest > 0.0:
            raise self._undirected(f"a spring of length={rest!r} has no direction there")
        self._by_stiffness(stiffness, rest, "N/m")


@known_options
class Damper(_BetweenPoints):
    """A damper between a point of a body and one of another, or of the ground: force c dl/dt.

    What it takes is `damping_dissipation` in the ledger. In equilibrium it does nothing.

    Args:
        a: A body, or None: the ground.
        b: A body, or None: the ground.
        points: In the reference [m], one of a and one of b, apart from each other.
        damping: c [N s/m], > 0.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a point lies outside of a flexible body.
    """

    losses = ("damping_dissipation",)

    def __init__(
        self, a: Any, b: Any, points: Any, *, damping: float, name: str | None = None
    ) -> None:
        super().__init__((a, b), name)
        require_positive("damping", damping, "N s/m")
        if self._between((a, b), points) == 0.0:
            raise self._undirected("a damper has no direction there")
        self._force = _Viscous(float(damping))


@known_options
class TorsionSpring(_Stores, _AboutAxis):
    """A torsion spring about an axis that two rigid bodies, or one and the ground, share.

    Its angle phi is the turn of a relative to b about the axis since the reference, over any number
    of turns; less than half a turn in a step. A joint with this axis has to hold the bodies.
    `TorsionSpring.about(joint, stiffness=...)` takes bodies and axis from a joint.

    Args:
        a: A rigid body, or None: the ground.
        b: A rigid body, or None: the ground.
        axis: In the reference, of any length.
        stiffness: k [N m], > 0, of V = k/2 (phi - angle)^2.
        angle: Where it is free [rad]; default: 0.
        energy: V(phi) [J] of an array of angles [rad], in place of stiffness.
        force: dV/dphi [N m] of an array, as of `Spring`.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is flexible.
        UserFunctionError: energy or force raises.
    """

    def __init__(
        self,
        a: Any,
        b: Any,
        *,
        axis: Any,
        stiffness: float | None = None,
        angle: float | None = None,
        energy: Function | None = None,
        force: Function | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__((a, b), name)
        _one_of(stiffness, energy, force, ("angle", angle))
        self._about((a, b), axis)
        if angle is not None and not is_finite(angle):
            raise ValueError(f"angle={angle!r}: must be finite [rad]")
        if energy is not None:
            self._by_energy(energy, force, 0.0)
        else:
            self._by_stiffness(stiffness, float(angle or 0.0), "N m")


@known_options
class TorsionDamper(_AboutAxis):
    """A torsion damper about an axis, as of `TorsionSpring`: torque c dphi/dt.

    What it takes is `damping_dissipation` in the ledger. In equilibrium it does nothing.

    Args:
        a: A rigid body, or None: the ground.
        b: A rigid body, or None: the ground.
        axis: In the reference, of any length.
        damping: c [N m s], > 0.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is flexible.
    """

    losses = ("damping_dissipation",)

    def __init__(
        self, a: Any, b: Any, *, axis: Any, damping: float, name: str | None = None
    ) -> None:
        super().__init__((a, b), name)
        require_positive("damping", damping, "N m s")
        self._about((a, b), axis)
        self._force = _Viscous(float(damping))
