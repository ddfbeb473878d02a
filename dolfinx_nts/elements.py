"""What a step asks of whatever couples coordinates: contacts, joints, springs and ties."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from dolfinx_nts.evaluation import Evaluation, Moment
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.kinematics import Kinematics
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.validation import StepFailedError, UserFunctionError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]


_EPS = float(np.finfo(float).eps)


def over(value: float, limit: float) -> float:
    """A size over its limit; 0 over anything is 0."""
    if value == 0.0:
        return 0.0
    return float(value / limit) if limit > 0 else np.inf


class StepWarning(NamedTuple):
    """What an accepted step did that its user may not have meant; see `RunWarning`.

    Attributes:
        kind: What it is, e.g. "slip".
        size: How bad, in the unit that `text` names.
        text: Sentence with a remedy.
        about: Names of the contact, joint or bodies that it is about; a run keeps the worst of each
            kind for each of them. Empty for the whole scene.
        grave: Whether it may make the result wrong.
    """

    kind: str
    size: float
    text: str
    about: tuple[str, ...] = ()
    grave: bool = False


@dataclass(frozen=True, eq=False)
class Step:
    """What a step tells those who make its elements.

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

    def scale(self, surface: Any) -> FloatArray:
        """Force per motion of a `Surface`'s points in the units of the step, (p,). Collective.

        Massless nodes have their stiffness for it: with more, Newton's method would go to and fro
        between contact and none, and stick and slip, in small steps.
        """
        massless = surface.massless
        if self.integrator.inertia and not massless.any():
            mass: FloatArray = surface.mass
            return mass
        change = self.factor * self.integrator.theta
        stiff = change * surface.material.divided(self.stiffness(surface.body))
        return np.where(massless, stiff, surface.mass) if self.integrator.inertia else stiff


class Part(Protocol):
    """What elements contribute at an iterate; axis 0 = element."""

    @property
    def residual(self) -> FloatArray:
        """Rows of coordinates and own unknowns, shape (n, r).

        Those of the coordinates are minus the forces on the bodies times `Step.factor` [kg m].
        """

    @property
    def tangent(self) -> FloatArray:
        """Its derivative, shape (n, r, r)."""

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
    def alike(self) -> tuple[Any, ...] | None:
        """What batches of its class have in common that its `evaluate_alike` takes at once.

        None: each batch is evaluated by itself.
        """

    @property
    def extent(self) -> float:
        """Length beside the displacements whose rounding is in its rows, on this rank [m]."""

    @property
    def force_scale(self) -> float:
        """Force, in the step's units, per unit of a constraint's unknown."""

    def points(self) -> tuple[IntArray, ...]:
        """Global coordinates of each body, shape (n, k) each."""

    def dofs(self) -> tuple[IntArray, ...]:
        """The same with -1 where they are prescribed."""

    def reference(self) -> FloatArray:
        """Return what is added to the displacements of these coordinates [m], (n, k / 3, 3)."""

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """Augmented unknowns that fit predicted positions, shape (n, augmented)."""

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> Part:
        """Residual and tangent. All ranks call it, also those without elements.

        No later call may depend on it. What it raises on one rank ends the solution on all, see
        `evaluate_together`.

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

        Of elements that do not know it, NaN, and so are the `reactions` of their joint.

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

        All ranks return the same columns. A column that only a joint has is energy [J] that leaves.
        """

    def describe(self, part: Any, flips: IntArray) -> tuple[float, str]:
        """Weight and text of the worst element, for messages.

        Args:
            part: Last iterate.
            flips: How often `Part.status` changed, shape (states, n).
        """


def evaluate_together(
    comm: Any,
    elements: Sequence[Any],
    places: Sequence[FloatArray],
    own: Sequence[Mapping[str, FloatArray]],
) -> tuple[Any, ...]:
    """What elements contribute at an iterate; what fails on one rank fails on all. Collective.

    Arrays of single elements cost as much as those of hundreds, so batches that are `alike` are
    evaluated by one call.

    Args:
        comm: MPI communicator.
        elements: Batches of elements.
        places: Of each, as of `Elements.evaluate`.
        own: Of each, as of `Elements.evaluate`.

    Raises:
        UserFunctionError: One raised on some rank.
        StepFailedError: It raised this.
    """
    parts: list[Any] = [None] * len(elements)
    groups: dict[Any, list[int]] = {}
    for k, batch in enumerate(elements):
        alike = batch.alike
        groups.setdefault(k if alike is None else (type(batch), *alike), []).append(k)
    cause, problem = None, None
    for group in groups.values():
        try:
            batches = [elements[k] for k in group]
            found = _of_group(batches, [places[k] for k in group], [own[k] for k in group])
        except Exception as error:  # any: a rank that raises alone would leave the others waiting
            if cause is None:
                cause, problem = error, _problem(elements[group[0]], error)
            continue
        for k, part in zip(group, found, strict=True):
            parts[k] = part
    if global_max(comm, np.array([float(cause is not None)]))[0]:
        kind, text, advises = next(filter(None, comm.allgather(problem)))
        raise kind(text, advises=advises) from cause
    return tuple(parts)


def _of_group(
    batches: Sequence[Any], places: Sequence[FloatArray], own: Sequence[Mapping[str, FloatArray]]
) -> Sequence[Any]:
    """What batches that are alike, or a single one, contribute."""
    if len(batches) == 1:
        return [batches[0].evaluate(places[0], own[0])]
    alike: Sequence[Any] = batches[0].evaluate_alike(batches, places, own)
    return alike


def _problem(batch: Any, error: Exception) -> tuple[type[StepFailedError], str, bool]:
    """What to raise on all ranks where elements have raised on one, and whether it advises."""
    if isinstance(error, StepFailedError):
        kind = UserFunctionError if isinstance(error, UserFunctionError) else StepFailedError
        return kind, str(error), error.advises
    text = f"{batch.name!r}: its elements raised {error!r}; correct it"
    return UserFunctionError, text, True


class Slopes(NamedTuple):
    """What a force along a coordinate, a length or an angle, does near a state.

    Attributes:
        gradients: Of the coordinate, by the owned coordinates of each body of the joint.
        stiffness: Change of the force with the coordinate [N/m], or [N m] of an angle, the same on
            all ranks.
        damping: The same with the coordinate's rate [N s/m] or [N m s].
        about: Whether the coordinate is an angle.
    """

    gradients: Sequence[FloatArray]
    stiffness: float
    damping: float = 0.0
    about: bool = False


class Joint:
    """What a System accepts beside contacts: joints, springs, ties; part of the scene.

    A joint of one's own inherits from it, sets `name` and `bodies`, and has `coupling`; all else
    has a default here. All ranks call all its functions, also those without elements. What one
    raises must be raised on all ranks, or the others wait for ever; `Elements.evaluate` alone may
    raise on some.

    Attributes:
        name: For messages.
        bodies: Bodies of the system that it couples.
        losses: Columns of the balance table for energy that leaves through it, of its own names;
            its elements' `ledger` says how much.
        numbers: One number per element on this rank, the same on any number of ranks; None: it
            remembers nothing that a checkpoint keeps.
        driven: Whether it moves bodies as prescribed by a function of time, which impacts that give
            their energy back refuse.
    """

    name: str
    bodies: tuple[Any, ...]
    losses: tuple[str, ...] = ()
    numbers: IntArray | None = None
    driven: bool = False

    @cached_property
    def settings(self) -> Mapping[str, Any]:
        """Numbers and texts by name that it was made with, for JSON and the same on all ranks.

        A checkpoint goes on only with equal ones. Without any, name and kind alone are compared.
        """
        return {}

    def start(self) -> Any:
        """Return what it remembers at the start."""
        return None

    def potential(self, u: Sequence[FloatArray], history: Any) -> float:
        """Stored energy on this rank [J]. Collective.

        Args:
            u: Owned displacements of each of its bodies [m].
            history: What it remembers there, such as the turns of an angle.
        """
        return 0.0

    def slopes(self, u: Sequence[FloatArray], history: Any) -> Slopes | None:
        """What its force does, if it is one along a coordinate and holds nothing. Collective.

        A run warns of one that is too fast for its steps. Arguments are those of `potential`; None,
        for all of them, of a joint that holds.
        """
        return None

    def coupling(self, bodies: tuple[int, ...]) -> JointCoupling:
        """Return what makes its elements in a run.

        Args:
            bodies: Numbers of its bodies in the system.
        """
        raise NotImplementedError(f"{type(self).__name__} has no coupling(); see nts.Joint")


#: What an object has that is used as a joint without being a `Joint`.
_PROTOCOL = tuple(name for name in (*Joint.__annotations__, *vars(Joint)) if name[0] != "_")


def is_joint(given: Any) -> bool:
    """Return whether an object is a `Joint` or has all that one has."""
    return isinstance(given, Joint) or all(hasattr(given, name) for name in _PROTOCOL)


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

    def warnings(self, parts: Sequence[Any]) -> list[StepWarning]:
        """Return what an accepted step did that its user may not have meant. Collective.

        Args:
            parts: Solution, of each of `elements`.

        Returns:
            Warnings, the same on all ranks.
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

    def hold_alone(self) -> None:
        """Take note that its constraints repeat no others: its equations need no compliance.

        A run calls it at its start.
        """

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
