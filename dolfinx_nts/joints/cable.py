"""Cables without mass over eyelets: slack, taut, with friction, on a winch (theory section 22)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.interaction.coupling import Joint, Moment, Slopes
from dolfinx_nts.interaction.measures import Measure
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.interaction.sketch import DASHED, STRAIGHT, Sketch, along, moved
from dolfinx_nts.joints.between import ROUNDED, Motion, points_of
from dolfinx_nts.joints.cable_elements import CableCoupling, Memory
from dolfinx_nts.kernels.cable import Lengths, Stretched
from dolfinx_nts.parallel import rank_of
from dolfinx_nts.types import FloatArray, Vector
from dolfinx_nts.validation import (
    UserFunctionError,
    floats,
    known_options,
    number_at,
    require_name,
    require_positive,
    require_same,
    vector,
)


@known_options
class Cable(Joint):
    """A cable without mass from its first point over eyelets to its last; it only pulls.

    Eyelets are points of bodies or of the ground, without size: an eyelet on a rigid body is the
    pulley of a tackle. Inextensible, or elastic with `axial_stiffness`. What makes an inextensible
    one taut with a jerk is `contact_defect` in the ledger, work of a winch `external_work`.

    Args:
        points: From the first to the last, two or more pairs of a body, or None for the ground, and
            a place in the reference [m], shape (3,). A body may have several.
        length: Of the cable without tension [m]: None is that of its path in the reference; or a
            function of time, as of a winch, which gives and takes at the first point.
        axial_stiffness: EA [N]; None: inextensible.
        friction: Coefficient mu at all eyelets, or one of each: the tension on one side is at most
            exp(mu angle) times that on the other, by the angle that the cable turns. Of
            inextensible ones.
        name: In messages and files; default: kind and bodies.

    Attributes:
        measure: The length of its path.
        levels: As of `CableElements`.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, two points in a row coincide, a point lies outside
            of a flexible body, or an inextensible cable is shorter than its path at the start.
        UserFunctionError: length raises, or is not a positive number.
    """

    stops = ", a cable that became taut"

    def __init__(
        self,
        points: Sequence[tuple[Body | None, Vector]],
        *,
        length: float | Callable[[float], float] | None = None,
        axial_stiffness: float | None = None,
        friction: float | Sequence[float] | None = None,
        name: str | None = None,
    ) -> None:
        ends, places = _pairs(points)
        self.bodies = tuple({id(body): body for body in ends if body is not None}.values())
        free = [k for k, pair in enumerate(pairwise(ends)) if not _rigid(*pair)]
        if not free:
            raise ValueError(
                f"points={points!r}: all are of the ground, or of one rigid body, which a cable "
                "does not move; pass a point of another body, too"
            )
        names = ["ground" if body is None else body.name for body in ends]
        if name is not None:
            require_name("name", name)
        self.name = name or f"cable of {' and '.join(dict.fromkeys(names))}"
        self.comm = self.bodies[0].comm
        require_same(
            self.comm, points=places, length=length, axial_stiffness=axial_stiffness,
            friction=friction, name=name,
        )  # fmt: skip
        self._here = int(self.comm.rank == rank_of(self.name, self.comm))
        self.numbers = np.arange(self._here)
        parts = np.linalg.norm(np.diff(places, axis=0), axis=1)
        small = parts <= ROUNDED * np.abs(places).max()
        if small.any():
            k = int(small.argmax())
            raise ValueError(
                f"points={points!r} of {self.name!r}: points[{k}] and points[{k + 1}] coincide, "
                "and a part between them has no direction; leave one of them out"
            )
        if axial_stiffness is not None:
            require_positive("axial_stiffness", axial_stiffness, "N")
            axial_stiffness = float(axial_stiffness)
        self.axial_stiffness = axial_stiffness
        self.friction = self._coefficients(friction, len(parts) - 1)
        held = free[: len(free) if self.friction.any() else 1]
        self.levels = np.array(held if axial_stiffness is None else [], dtype=np.int64)
        self.measure = self._measure(ends, places)
        self._path = float(parts.sum())
        self._take_length(length)
        self.settings = {
            "bodies": names, "points": places.tolist(), "driven": self.driven,
            "length": None if self.driven else self._length,
            "axial_stiffness": axial_stiffness,
            "friction": self.friction.tolist(),
        }  # fmt: skip

    def _coefficients(self, friction: Any, eyelets: int) -> FloatArray:
        """Of each eyelet."""
        if friction is None:
            return np.zeros(eyelets)
        given = floats(friction)
        fits = given.size in {1, eyelets} and np.isfinite(given).all() and (given >= 0.0).all()
        if not (fits and eyelets):
            raise ValueError(
                f"friction={friction!r} of {self.name!r}: pass a coefficient >= 0, or one for each "
                f"of its {eyelets} eyelets, the points between the first and the last"
            )
        if self.axial_stiffness is not None:
            raise ValueError(
                f"friction={friction!r}, axial_stiffness={self.axial_stiffness!r} of "
                f"{self.name!r}: friction is for inextensible cables; leave one of them out"
            )
        return np.broadcast_to(given.ravel(), eyelets).astype(float)

    def _measure(self, ends: Sequence[Body | None], places: FloatArray) -> Measure:
        """Vectors from each point to the next, of the nodes of all bodies."""
        found: list[Any] = []
        self._held: list[tuple[Points | None, FloatArray]] = [(None, x) for x in places]
        for body in self.bodies:
            mine = [k for k, end in enumerate(ends) if end is body]
            side = points_of(f"points of {self.name!r}", body, places[mine])
            found.append((mine, *_merged(side)))
            for k, j in enumerate(mine):
                self._held[j] = side.select([k]), places[j]
        count = sum(side.nodes.shape[1] for _, side, _ in found)
        weights, constants, first = np.zeros((len(ends), count)), places.copy(), 0
        for mine, side, own in found:
            weights[mine, first : (first := first + side.nodes.shape[1])] = own
            constants[mine] = 0.0
        sides = tuple(side.select(slice(self._here)) for _, side, _ in found)
        n = self._here
        between, apart = (np.diff(given, axis=0)[None][:n] for given in (weights, constants))
        return Measure(Lengths, sides, between, apart, np.ones(n))

    def _take_length(self, length: Any) -> None:
        """Set its length, which a winch changes. Collective."""
        self.driven = callable(length)
        self._motion = None
        if self.driven:
            label = f"length of {self.name!r}"
            self._motion = Motion(self.comm, label, length, "m", number_at)
        elif length is not None:
            require_positive("length", length, "m")
        self._length = self._path if length is None or self.driven else float(length)
        first = self.length_at(0.0)
        if self.axial_stiffness is None and first < (1.0 - ROUNDED) * self._path:
            raise ValueError(
                f"length={length!r} of {self.name!r}: is {first!r} at the start, where its path "
                f"is {self._path!r} long; pass at least that, leave it out, or pass "
                "axial_stiffness=, as an elastic cable may start with tension"
            )

    def sketch(self, u: Sequence[FloatArray], when: float = 0.0) -> Sketch:
        """Its path, dashed while it is slack, and its points. Collective."""
        path = moved(self._held, self.bodies, u)
        parts = np.linalg.norm(np.diff(path, axis=0), axis=1)
        slack = parts.sum() < (1.0 - ROUNDED) * self.length_at(when)
        shape = DASHED if slack else STRAIGHT
        lines = [along(np.array(ends), shape, 0.0) for ends in pairwise(path)]
        return Sketch(np.concatenate(lines), path)

    def length_at(self, time: float) -> float:
        """Its length without tension at a time [m]. Collective.

        Raises:
            UserFunctionError: The user's function raises, or is not positive.
        """
        if self._motion is None:
            return self._length
        length = float(self._motion.at(time))
        if length <= 0.0:
            raise UserFunctionError(
                f"length of {self.name!r} at t={time!r}: is {length!r}; return a positive length "
                "[m]"
            )
        return length

    def tensions(self, run: Any) -> FloatArray:
        """Tension of each part at the last state of a run [N], shape (parts,). Collective.

        Args:
            run: What `simulate` or `equilibrium` return, or a `Stepper`.

        Raises:
            ValueError: It has no state, or its system does not have this cable.
        """
        state, joints = run.state, run.system.joints
        numbers = [k for k, joint in enumerate(joints) if joint is self]
        if state is None or not numbers:
            raise ValueError(f"run={run!r}: has no state yet, or another system than that of "
                             f"{self.name!r}; pass a run of its own")  # fmt: skip
        parts = self.measure.weights.shape[1]
        own = Memory.of(state.joints[numbers[0]], parts).tension.sum(axis=0)
        total: FloatArray = self.comm.allreduce(own)
        return total

    @property
    def mid_step(self) -> bool:
        """An inextensible one holds and lets go."""
        return self.axial_stiffness is None

    def start(self) -> FloatArray:
        """No tension."""
        parts, length = self.measure.weights.shape[1], self.length_at(0.0)
        row = [*np.zeros(parts), self._path, length, length, *np.zeros(len(self.levels))]
        return np.tile(row, (self._here, 1))

    def potential(self, u: Sequence[FloatArray], history: FloatArray) -> float:
        """Stored energy on this rank [J]. Collective."""
        if self.axial_stiffness is None:
            return 0.0
        path = Lengths.value(self._vectors(u), history)
        free = Memory.of(history, self.measure.weights.shape[1]).length[:, 0]
        return float(Stretched(self.axial_stiffness, free).value(path).sum())

    def slopes(
        self, u: Sequence[FloatArray], history: FloatArray, when: Moment | None = None
    ) -> Slopes | None:
        """Gradient of its path, and its stiffness while taut; None of inextensible. Collective."""
        if self.axial_stiffness is None:
            return None
        measure, p = self.measure, self._vectors(u)
        path = Lengths.value(p, history)
        mean = Lengths.gradient(p, p, path, path).mean.reshape(p.shape)
        along, gradients, first = measure.to_nodes(mean), [], 0
        for side in measure.sides:
            here = slice(first, first := first + side.nodes.shape[1])
            gradients.append(side.gathered(along[:, here]))
        free = Memory.of(history, measure.weights.shape[1]).length[:, 0]
        _, change = Stretched(self.axial_stiffness, free).quotient(path, path)
        return Slopes(gradients, 2.0 * float(self.comm.allreduce(change.sum())))

    def _vectors(self, u: Sequence[FloatArray]) -> FloatArray:
        """Its vectors [m], shape (n, v, 3). Collective."""
        return self.measure.vectors(self.measure.reference() + self.measure.nodal(u))

    def coupling(self, bodies: tuple[int, ...]) -> CableCoupling:
        """What makes its elements in a run, and remembers its tensions."""
        return CableCoupling(bodies, self)


def _pairs(points: Any) -> tuple[list[Any], FloatArray]:
    """Bodies and places, shape (points, 3)."""
    ends, places = [], []
    try:
        given = [(body, place) for body, place in points]
    except (TypeError, ValueError):
        given = []
    if len(given) < 2:
        raise ValueError(
            f"points={points!r}: pass two or more pairs of a body, or None for the ground, and a "
            "place [m], e.g. [(load, (0, 0, -1)), (None, (0, 0, 0))]"
        )
    for k, (body, place) in enumerate(given):
        if body is not None and not isinstance(body, Body):
            raise TypeError(f"points[{k}][0]={body!r}: pass a body, or None for the ground")
        ends.append(body)
        places.append(vector(f"points[{k}][1]", place, "m"))
    return ends, np.array(places)


def _rigid(a: Body | None, b: Body | None) -> bool:
    """Whether a part between points of these keeps its length."""
    return a is b and (a is None or a.rigid)


def _merged(side: Points) -> tuple[Points, FloatArray]:
    """Several points as one of all their nodes, each node once, and their weights (points, k).

    The one point is their mean.
    """
    p, width = side.nodes.shape
    _, first, place = np.unique(side.nodes, return_index=True, return_inverse=True)
    weights = np.zeros((p, len(first)))
    np.add.at(weights, (np.repeat(np.arange(p), width), place.ravel()), side.weights.ravel())
    whole = side.joined(np.arange(p)[None]).columns(first)
    arrays = (whole.reference, whole.fixed, whole.places)
    return Points(side.body, whole.nodes, weights.mean(axis=0)[None], *arrays), weights
