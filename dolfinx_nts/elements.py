"""What a step asks of whatever couples coordinates: contacts, joints, springs and ties."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from dolfinx_nts.bodies.body import Moment
from dolfinx_nts.bodies.points import Points
from dolfinx_nts.evaluation import Evaluation
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.kinematics import Kinematics, differenced, has_constraints, unknown

if TYPE_CHECKING:
    from dolfinx_nts.contact.surfaces import Surface
    from dolfinx_nts.system import State

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]


_EPS = float(np.finfo(float).eps)


def over(value: float, limit: float) -> float:
    """A size over its limit; 0 over anything is 0."""
    if value == 0.0:
        return 0.0
    return float(value / limit) if limit > 0 else np.inf


@dataclass(frozen=True, eq=False)
class Step:
    """A step as those know it who make its elements.

    Attributes:
        state: At t_n.
        dt: Length [s]; 0 in the relaxations of equilibrium.
        factor: What the step equations multiply forces by [s^2].
        integrator: Its rules.
        condense: Whether unknowns that stand in one element alone are eliminated there.
        first: Displacement of each body after flight without forces [m].
        ahead: Motion of each body along which contact is sought [m].
        motion: Largest component of each body's motion [m], shape (bodies,).
        length: Displacement of each body that sets the rounding of its forces [m], shape (bodies,).
        stiffness: Of a body, that of each of its coordinates' neighbourhood [N/m]; for statics.
        moments: Of each body, when its forces are taken and how fast it moves there.
        force_rounding: Of some bodies, the norm of forces that is rounding [kg m]. Collective.
    """

    state: State
    dt: float
    factor: float
    integrator: Integrator
    condense: bool
    first: Sequence[FloatArray]
    ahead: Sequence[FloatArray]
    motion: FloatArray
    length: FloatArray
    stiffness: Callable[[Any], FloatArray]
    moments: Sequence[Moment]
    force_rounding: Callable[[Sequence[int]], float]

    def mean_scale(self, body: Any) -> float:
        """Force per motion in the mean over a body's places, in the step's units. Collective."""
        inertia = self.integrator.inertia
        values = body.nodal_mass if inertia else self.stiffness(body)
        chosen = values[::3][body.places]
        total = body.comm.allreduce(np.array([chosen.sum(), len(chosen)]))
        return float(total[0] / total[1])

    def scale(self, surface: Surface) -> FloatArray:
        """Force per motion of a surface's points in the units of the step, (p,). Collective.

        Massless nodes have their stiffness for it: with more, Newton's method would go to and fro
        between contact and none, and stick and slip, in small steps.
        """
        massless = surface.massless
        if self.integrator.inertia and not massless.any():
            return surface.mass
        stiff = self.factor * surface.material.divided(self.stiffness(surface.body))
        return np.where(massless, stiff, surface.mass) if self.integrator.inertia else stiff


class Part(Protocol):
    """What elements contribute at an iterate; axis 0 = element.

    Attributes:
        residual: Rows of coordinates [kg m] (forces times `Step.factor`), then of own unknowns.
        tangent: Its derivative, shape (n, r, r).
        status: What Newton's method may flip from iterate to iterate, shape (states, n).
    """

    residual: FloatArray
    tangent: FloatArray

    @property
    def status(self) -> BoolArray:
        """What Newton's method may flip from iterate to iterate, shape (states, n)."""


class Elements(Protocol):
    """A batch of elements in a step; axis 0 = element. They are never changed."""

    @property
    def name(self) -> str:
        """Name for messages."""

    @property
    def num_elements(self) -> int:
        """On this rank."""

    @property
    def num_coordinates(self) -> int:
        """Coordinates of bodies per element."""

    @property
    def widths(self) -> Mapping[str, int]:
        """Own unknowns per element by field, "augmented" and "constraints"."""

    @property
    def pattern(self) -> BoolArray:
        """Which constraints stand in the rows of which, shape (m, m)."""

    @property
    def bilateral(self) -> bool:
        """Whether its constraints hold always and in both directions, as those of joints."""

    @property
    def force_scale(self) -> float:
        """What a constraint's unknown is multiplied by to be a force, in the step's units."""

    def points(self) -> tuple[IntArray, ...]:
        """Global coordinates of each body, shape (n, k) each."""

    def dofs(self) -> tuple[IntArray, ...]:
        """The same with -1 where they are prescribed."""

    def reference(self) -> FloatArray:
        """Return what is added to the displacements of these coordinates [m], (n, k / 3, 3)."""

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """Augmented unknowns that fit predicted positions, shape (n, augmented)."""

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> Part:
        """Residual and tangent; pure. All ranks call it.

        Args:
            x: Reference plus displacement at t_{n+1} [m], shape (n, k / 3, 3).
            own: Own unknowns by field, shape (n, width).
        """

    def rows(self, part: Any, name: str) -> FloatArray:
        """The residual's rows of a field of own unknowns, shape (n, width)."""

    def largest(self, part: Any) -> list[float]:
        """Four sizes on this rank whose maxima over all ranks `ratios` needs."""

    def ratios(
        self, largest: FloatArray, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """Own rows over what counts as converged, by names for messages.

        Args:
            largest: `largest` over all ranks.
            motion: Largest motion of the step [m].
            rounded: Length whose rounding is in all positions [m].
            rtol: Tolerance of Newton's method.
        """

    def resultant(self, part: Any, k: int, u: FloatArray) -> FloatArray:
        """Resultant of its forces on one of its bodies, this rank's part. Collective.

        Elements may leave it out; the `reactions` of a joint that has such are NaN.

        Args:
            part: Solution of the step.
            k: Number of the body among those of the elements.
            u: Owned displacements of that body where the step takes its forces [m].

        Returns:
            Factor of the step times force and moment about the origin, the sum of the points where
            the elements hold the body [m], and, in each entry, their number, shape (4, 3).
        """

    def ledger(self, part: Any, factor: float) -> dict[str, float]:
        """Sums of an accepted step on this rank, by columns of the balance table.

        Of the same columns on all ranks; those that only a joint has are energies [J] that leave.
        """

    def describe(self, part: Any, flips: IntArray) -> tuple[float, str]:
        """Weight and text of the worst element, for messages.

        Args:
            part: Last iterate.
            flips: How often `Part.status` changed, shape (states, n).
        """


class Joint(Protocol):
    """What a System accepts beside contacts: joints, springs, ties; part of the scene.

    Attributes:
        name: For messages.
        bodies: Bodies of the system that it couples.
        losses: Columns of the balance table for energy that leaves through it, of its own names;
            its elements' `ledger` says how much.
        numbers: Of each element on this rank, one that does not depend on the ranks; may be missing
            where it remembers nothing that a checkpoint must hold.
        settings: Numbers and texts by name, for JSON and the same on all ranks, that it was made
            with; a checkpoint goes on only with equal ones. It may be missing: then name and kind
            alone are compared.
    """

    name: str
    bodies: tuple[Any, ...]
    losses: tuple[str, ...]

    def start(self) -> Any:
        """Return what it remembers at the start."""

    def potential(self, u: Sequence[FloatArray], history: Any) -> float:
        """Stored energy on this rank [J]. Collective.

        Args:
            u: Owned displacements of each of its bodies [m].
            history: What it remembers there, such as the turns of an angle.
        """

    def coupling(self, bodies: tuple[int, ...]) -> JointCoupling:
        """Return what makes its elements in a run.

        Args:
            bodies: Numbers of its bodies in the system.
        """


@dataclass(frozen=True, eq=False, kw_only=True)
class PointElements:
    """What elements between points of bodies have in common, see `Elements`.

    A kind of its own adds `evaluate`, and what else it has to say. Each element is to be on one
    rank alone: what `body.points` gives is the same on all.

    Attributes:
        name: For messages.
        sides: Of each body, the nodes of the elements' points, see `Points`.
    """

    name: str
    sides: tuple[Points, ...]

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
    def bilateral(self) -> bool:
        """Its constraints hold always."""
        return True

    @property
    def force_scale(self) -> float:
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
        own: FloatArray = part.residual[:, start:]
        return own

    def largest(self, part: Any) -> list[float]:
        """The largest row of its constraints, which are lengths [m], and its extent."""
        rows = self.rows(part, "constraints")
        return [0.0, float(np.abs(rows).max(initial=0.0)), 0.0, self.extent]

    def ratios(
        self, largest: FloatArray, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """Its constraints over what counts as converged, if it has any."""
        if not self.widths["constraints"]:
            return {}
        limit = rtol * motion + 8 * _EPS * (rounded + float(largest[3]))
        return {f"{self.name} constraints": over(float(largest[1]), limit)}

    def resultant(self, part: Any, k: int, u: FloatArray) -> FloatArray:
        """Sums over the nodes of side k."""
        side, out = self.sides[k], np.zeros((4, 3))
        y = side.reference + side.nodal(u)
        start = sum(3 * other.nodes.shape[1] for other in self.sides[:k])
        force = -part.residual[:, start : start + 3 * side.nodes.shape[1]].reshape(y.shape)
        out[0] = force[side.places].sum(axis=0)
        out[1] = cross(y, force).sum(axis=(0, 1))
        out[2], out[3] = side.combine(y).sum(axis=0), len(y)
        return out

    def ledger(self, part: Any, factor: float) -> dict[str, float]:
        """Nothing lost."""
        return {}

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
    """

    may_slip = False

    def __init__(
        self,
        bodies: tuple[int, ...],
        make: Callable[[Step, Any], Any],
        remember: Callable[[Any], Any] | None = None,
    ) -> None:
        self.bodies, self._make, self._remember = [bodies], make, remember
        self.elements: list[Any] = []
        self._begun: tuple[Step, Any] | None = None

    def begin(self, step: Step, history: Any, again: Evaluation | None, search: bool) -> None:
        """Make the elements of a step."""
        self._begun = step, history
        self.elements = [self._make(step, history)]

    def touched(self) -> set[int]:
        """All bodies."""
        return set(self.bodies[0])

    def wake(self, u1: Sequence[FloatArray]) -> bool:
        """Nothing sleeps."""
        return False

    def misses(self, e: Evaluation, parts: Sequence[Any], motion: FloatArray) -> bool:
        """Nothing is missed."""
        return False

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Zero."""
        batch = self.elements[k]
        return np.zeros((batch.num_elements, batch.widths["constraints"]))

    def let_slip(self) -> None:
        """Nothing slips."""

    def give_way(self) -> bool:
        """Nothing yields."""
        return False

    def warnings(self, parts: Sequence[Any]) -> list[tuple[str, float, str]]:
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
        if self._begun is None:
            held = [batch for batch in self.elements if has_constraints(batch)]
            if held:
                raise unknown(held[0])
            return [None] * len(self.elements)
        step, history = self._begun

        def make(length: float) -> Any:
            return self._make(replace(step, dt=length), history)

        return [differenced(make, self.bodies[0], state, dt)]


class Coupling(Protocol):
    """Makes elements of one kind, step after step; one for a run.

    Attributes:
        elements: Those of the current step that have unknowns, the same number on all ranks.
        bodies: Numbers of the bodies of each of `elements`, in the order of their coordinates.
    """

    elements: list[Any]
    bodies: list[tuple[int, ...]]

    def begin(self, step: Step, history: Any, again: Evaluation | None, search: bool) -> None:
        """Make the elements of a step. Collective.

        Args:
            step: The step.
            history: What it remembers at t_n.
            again: Solution of this step that was not covered, see `misses`.
            search: Whether what may couple is sought anew.
        """

    def touched(self) -> set[int]:
        """Numbers of the bodies that elements move, the same on all ranks. Collective."""

    def wake(self, u1: Sequence[FloatArray]) -> bool:
        """Return whether a solved step asks for more elements, which are made. Collective."""

    def misses(self, e: Evaluation, parts: Sequence[Any], motion: FloatArray) -> bool:
        """Return whether a step may have passed by something, so that it begins again. Collective.

        Args:
            e: Its solution.
            parts: Of it, those of `elements`.
            motion: Largest component of each body's motion [m], shape (bodies,).
        """

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Constraints' unknowns of elements k as in the last step, shape (n, constraints).

        Args:
            k: Number among `elements`.
            x: Positions of the first guess, as of `Elements.evaluate`.
        """

    @property
    def may_slip(self) -> bool:
        """Whether `let_slip` changes anything."""

    def let_slip(self) -> None:
        """Let sticking nodes slip under a slight pull in Newton's iterations of this step.

        Every solution of the step stays one, and no other is added.
        """

    def give_way(self) -> bool:
        """Limit a force that had no limit (friction=inf) from the next step on.

        The run asks for it where shorter steps do not help.

        Returns:
            Whether there is such a thing that had none yet, the same on all ranks.
        """

    def warnings(self, parts: Sequence[Any]) -> list[tuple[str, float, str]]:
        """Return what an accepted step did that its user may not have meant. Collective.

        Args:
            parts: Solution, of each of `elements`.

        Returns:
            Kinds, sizes and sentences as of `RunWarning`, the same on all ranks.
        """

    def smallest(self, parts: Sequence[Any]) -> dict[str, float]:
        """Minima of an accepted step on this rank, by columns of the balance table."""

    def history(self, parts: Sequence[Any]) -> Any:
        """Return what is remembered of an accepted step.

        Args:
            parts: Solution, of each of `elements`.
        """


class JointCoupling(Coupling, Protocol):
    """What a `Joint` makes: a `Coupling` that also says what its forces do."""

    def load_step_work(self, before: Any, after: Any, start: float, end: float) -> float | None:
        """External work in a load step of `equilibrium` on this rank [J]. Collective.

        It is that of the mean of the forces at both ends, as the work of loads is.

        Args:
            before: What it remembers at the start of the load step.
            after: At its end.
            start: Pseudo time where the load step starts.
            end: Where it ends.

        Returns:
            None: the work is what `Elements.ledger` says, in which forces are those of the end.
        """

    def kinematics(self, state: State, dt: float) -> list[Kinematics | None]:
        """Return how the constraints change in time at a state, of each of `elements`. Collective.

        A start has to fit them, and first accelerations keep them. None, on all ranks alike, for
        elements without constraints, or with such as a start need not fit.

        Args:
            state: The state; without accelerations they count as zero.
            dt: Time in which prescribed values are told [s].
        """
