"""What joints between two bodies share: their ends, and constraints made of products of vectors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.interaction.constraint_elements import Equations
from dolfinx_nts.interaction.constraint_rows import Arm, Upright
from dolfinx_nts.interaction.constraints import Constraints
from dolfinx_nts.interaction.coupling import Joint
from dolfinx_nts.interaction.sketch import Sketch
from dolfinx_nts.kernels import quadratic
from dolfinx_nts.parallel import rank_of
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import require_name, require_same, vector

Times = tuple[float, ...]

#: Part of a joint's size by which what is given may miss what the start prescribes.
ROUNDED = 1e-9


@dataclass(frozen=True, eq=False)
class Vector:
    """w_a y_a + constant of a joint's nodes: a material point or direction, or a fixed one.

    Attributes:
        weights: w_a, shape (k,).
        constant: Shape (3,).
    """

    weights: FloatArray
    constant: FloatArray

    def __add__(self, other: Vector) -> Vector:
        return Vector(self.weights + other.weights, self.constant + other.constant)

    def __sub__(self, other: Vector) -> Vector:
        return self + -1.0 * other

    def __rmul__(self, factor: float) -> Vector:
        return Vector(factor * self.weights, factor * self.constant)


class Product(NamedTuple):
    """A constraint v . w = c.

    Attributes:
        first: v.
        second: w; v . w is a length.
        value: c at each of the times that were asked for [m]; empty: 0.
    """

    first: Vector
    second: Vector
    value: Sequence[float] = ()


def assemble(products: Sequence[Product], times: int) -> tuple[Equations, FloatArray]:
    """Constraints of one element, and c at so many times [m], shape (times, 1, m)."""
    both = [(p.first, p.second) for p in products]
    weights, constants = (
        np.array([[[getattr(v, name) for v in pair] for pair in both]])
        for name in ("weights", "constant")
    )
    values = [p.value or (0.0,) * times for p in products]
    prescribed = np.array(values).T[:, None]
    return Equations(weights, constants, prescribed[0]), prescribed


class OfTwo(Joint):
    """What is between two bodies, or a body and the ground; one element on one rank.

    Args:
        ends: Its bodies; None is the ground.
        name: In messages and files; None: made of its kind and the bodies' names.

    Attributes:
        name: As given or made.
        ends: As given.
        bodies: Its bodies without the ground.
    """

    def __init__(self, ends: tuple[Body | None, Body | None], name: str | None) -> None:
        self.name, self.ends = named(type(self).__name__, ends, name), ends
        self.bodies = tuple(body for body in ends if body is not None)
        self.comm = self.bodies[0].comm
        self._here = int(self.comm.rank == rank_of(self.name, self.comm))
        self.numbers = np.arange(self._here)

    @property
    def _names(self) -> list[str]:
        """Of both ends."""
        return ["ground" if body is None else body.name for body in self.ends]


class Between(OfTwo, ABC):
    """A joint between two bodies, see `OfTwo`.

    Args:
        a: A body.
        b: Another one. None, of either, is the ground.
        points: Where it holds them at the start [m], two of shape (3,), and the argument's name.
        name: As of `OfTwo`.

    Attributes:
        sides: Nodes of both, on which its vectors depend.
        p_a: Its point of A, or of the ground; p_b alike.
        length: What makes a length of a product of two directions [m].
        motion: What is prescribed, see `drive`.
        axes: Those that pictures show.
    """

    motion: Motion | None = None
    axes: Sequence[Vector] = ()

    def __init__(
        self, a: Body | None, b: Body | None, points: tuple[str, Any, Any], name: str | None
    ) -> None:
        super().__init__((a, b), name)
        if a is not None and a is b:
            raise ValueError(
                f"a=b={a.name!r}: a {type(self).__name__} joins two bodies; pass another one, or "
                "None for the ground"
            )
        argument, *given = points
        require_same(self.comm, **{argument: given, "name": name})
        places = [vector(argument, x, "m") for x in given]
        self._places = places
        held = [
            None if body is None else points_of(f"{argument} of {self.name!r}", body, x)
            for body, x in zip((a, b), places, strict=True)
        ]
        self.sides = [side for side in held if side is not None]
        widths = [0 if side is None else side.nodes.shape[1] for side in held]
        self._slots = slice(0, widths[0]), slice(widths[0], None)
        self._nodes = sum(widths)
        self.p_a, self.p_b = (
            self._vector(end, side, x)
            for end, side, x in zip((0, 1), held, places, strict=True)
        )
        lengths = [body.length for body in self.bodies if body.oriented]
        self.length = float(np.exp(np.mean(np.log(lengths)))) if lengths else 1.0

    def _vector(self, end: int, side: Any, fixed: FloatArray) -> Vector:
        """A vector at an end, from its `Points`, or of the ground."""
        weights = np.zeros(self._nodes)
        if side is None:
            return Vector(weights, fixed)
        weights[self._slots[end]] = side.weights[0]
        return Vector(weights, np.zeros(3))

    def directions(self, axes: FloatArray) -> tuple[list[Vector], list[Vector]]:
        """Directions at both ends that coincide at the start.

        Args:
            axes: Shape (n, 3).

        Raises:
            ValueError: A body has none.
        """
        require_directions(self.ends, self.name, at_nodes=True)
        of_a, of_b = (
            [self._vector(end, self._direction(body, d, x), d) for d in axes]
            for end, (body, x) in enumerate(zip(self.ends, self._places, strict=True))
        )
        return of_a, of_b

    @staticmethod
    def _direction(body: Any, along: FloatArray, x: FloatArray) -> Any:
        """`Points` of a direction that turns with a body where a joint holds it; None: ground."""
        return body and body.directions_at(along, x)

    def drive(self, argument: str, function: Any, unit: str, read: Callable[..., Any]) -> None:
        """Prescribe what a function of time says. Collective.

        Args:
            argument: Its name.
            function: The user's.
            unit: Of its values.
            read: `number_at`, or `at_time` for vectors.
        """
        self.driven = True
        self.motion = Motion(self.comm, f"{argument} of {self.name!r}", function, unit, read)

    @abstractmethod
    def products(self, times: Times) -> Iterable[Product]:
        """Its constraints at times within a step, the same on all ranks. Collective."""

    def upright(self, times: Times) -> Iterable[Product]:
        """Products that are positive unless directions have turned over. Collective.

        `products` that are zero at right angles do not tell directions from opposite ones.
        """
        return ()

    def sketch(self, u: Sequence[FloatArray], when: float = 0.0) -> Sketch:
        """Both points, the line between them, and the axes at the first. Collective."""
        both = zip(self.sides, u, strict=True)
        y = np.concatenate([side.reference + side.nodal(v) for side, v in both], axis=1)[0]
        p, q, *axes = (v.weights @ y + v.constant for v in (self.p_a, self.p_b, *self.axes))
        marked = np.array([(p, n) for n in axes]).reshape(-1, 2, 3)
        return Sketch(np.array([[p, q]]), np.array([p, q]), marked)

    def arm(self) -> Vector | None:
        """A vector whose turn in a step is looked at, as no body need turn with it."""
        return None

    def meet(self, *values: FloatArray) -> Iterator[Product]:
        """p_A - p_B = c, which is given at each of the times, (3,), or 0."""
        each = zip(*values, strict=True) if values else ((),) * 3
        for e, value in zip(np.eye(3), each, strict=True):
            yield Product(self.p_a - self.p_b, Vector(np.zeros(self._nodes), e), value)

    def square(self, first: Vector, second: Vector) -> Product:
        """Two directions that stay at right angles."""
        return Product(self.length * first, second)

    def _in_step(self, times: Times) -> tuple[Equations, FloatArray]:
        """Equations of this rank's element, if it is here, and c at each of the times."""
        return self._here_of(self.products(times), times)

    def _here_of(
        self, products: Iterable[Product], times: Times
    ) -> tuple[Equations, FloatArray]:
        found, prescribed = assemble(list(products), len(times))
        n = self._here
        return Equations(*(a[:n] for a in found)), prescribed[:, :n]

    def _kept_upright(self) -> Upright | Equations | None:
        """What `Constraints` take for `upright`, if there is any. Collective."""
        products = list(self.upright((0.0,)))
        if not products:
            return None
        if not self.motion:
            return self._here_of(products, (0.0,))[0]

        def upright(y: FloatArray, times: Times) -> FloatArray:
            now, _ = self._here_of(self.upright(times), times)
            return quadratic.value(quadratic.factors(now.weights, now.constants, y))

        return upright

    @cached_property
    def settings(self) -> dict[str, Any]:
        """What a restart compares; of a motion only whether there is one."""
        return {
            "bodies": self._names,
            "points": [place.tolist() for place in self._places],
            "driven": self.driven,
        }

    def coupling(self, bodies: tuple[int, ...]) -> Constraints:
        """Its constraints in a run. Collective."""
        sides = [side.select(slice(self._here)) for side in self.sides]
        equations, _ = self._in_step((0.0,))
        found, n = self.arm(), self._here
        arm = None if found is None else Arm(found.weights[None][:n], found.constant[None][:n])
        return Constraints(
            self.name, bodies, sides, equations, self._in_step if self.motion else None,
            upright=self._kept_upright(), arm=arm,
        )  # fmt: skip


def named(kind: str, ends: Sequence[Any], name: str | None) -> str:
    """Name of what is between two bodies, or a body and the ground, which are checked.

    Args:
        kind: Of joint, spring or damper.
        ends: Its bodies; None is the ground.
        name: As given; None: one is made.
    """
    if name is not None:
        require_name("name", name)
    for role, body in zip("ab", ends, strict=True):
        if isinstance(body, type):
            raise TypeError(
                f"{role}={body!r}: is a class; pass a body made from it, {body.__name__}(...)"
            )
        if body is not None and not isinstance(body, Body):
            raise TypeError(f"{role}={body!r}: pass a body, or None for the ground")
    if all(body is None for body in ends):
        raise ValueError(f"a=None, b=None: a {kind} needs a body; only one end may be the ground")
    both = ("ground" if body is None else body.name for body in ends)
    return name or f"{kind.lower()} of {' and '.join(both)}"


def require_directions(ends: Sequence[Any], name: str, *, at_nodes: bool) -> None:
    """Raise a ValueError where a body has no directions.

    Args:
        ends: Bodies; None is the ground.
        name: Of what needs them.
        at_nodes: Whether directions that each node has of its own will do.
    """
    for role, body in zip("ab", ends, strict=True):
        if body is not None and not (body.oriented if at_nodes else body.rigid):
            raise ValueError(
                f"{role}={body.name!r}: a flexible body has no directions for {name!r}; tie a "
                "rigid body to a patch of its nodes, Tie(rigid, body.surface(...)), or fix one to "
                "a node of a beam, Fixed(rigid, beam, point=...), and take that one"
            )


def points_of(argument: str, body: Body, x: FloatArray) -> Any:
    """A body's material points for a joint or spring, whose argument an error names."""
    try:
        return body.points(x)
    except ValueError as error:
        raise ValueError(f"{argument}: {error}") from error


class Motion:
    """A number or a vector that a function of the user's prescribes; it raises on all ranks alike.

    Args:
        comm: MPI communicator.
        name: Of the argument.
        function: Callable time [s] -> value.
        unit: Of its values.
        read: `number_at`, or `at_time` for vectors.

    Attributes:
        first: Value at t = 0.
    """

    def __init__(
        self, comm: MPI.Comm, name: str, function: Any, unit: str, read: Callable[..., Any]
    ) -> None:
        if not callable(function):
            raise TypeError(f"{name}={function!r}: pass a function of time, or leave it out")
        self._given = comm, name, function, unit
        self._read = read
        self.first = self.at(0.0)

    def at(self, time: float) -> Any:
        """Value at a time. Collective."""
        comm, name, function, unit = self._given
        return self._read(comm, name, function, time, unit)

    def since_start(self, time: float) -> Any:
        """Its change since t = 0. Collective."""
        return self.at(time) - self.first
