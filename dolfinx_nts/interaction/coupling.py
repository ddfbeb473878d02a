"""What the scene has of whatever couples bodies, and what makes elements of it step after step."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Protocol

from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.interaction.kinematics import Kinematics
from dolfinx_nts.interaction.sketch import Sketch
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray, IntArray, Settings


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


class Moment(NamedTuple):
    """When and at what rates a user's function is asked for its slopes.

    Attributes:
        time: [s].
        dt: Step that follows [s].
        v: Owned velocities of each of a joint's bodies [m/s].
    """

    time: float
    dt: float
    v: Sequence[FloatArray]


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
        parts: Joints beside it that come with it, such as its friction.
        stops: What it does where it takes energy that the ledger calls `contact_defect`; it stands
            behind the name.
    """

    name: str
    bodies: tuple[Any, ...]
    losses: tuple[str, ...] = ()
    numbers: IntArray | None = None
    driven: bool = False
    parts: tuple[Any, ...] = ()
    stops: str = ""

    def __repr__(self) -> str:
        # One of a class of the user's own may not have its name yet.
        of = ", ".join(repr(body.name) for body in getattr(self, "bodies", ()))
        return f"<{type(self).__name__} {getattr(self, 'name', '')!r} of {of}>"

    @cached_property
    def settings(self) -> Settings:
        """Numbers and texts by name that it was made with, for JSON and the same on all ranks.

        A checkpoint goes on only with equal ones. Without any, name and kind alone are compared.
        """
        return {}

    @property
    def mid_step(self) -> bool:
        """Whether it asks for an integrator that carries no accelerations."""
        return False

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

    def slopes(
        self, u: Sequence[FloatArray], history: Any, when: Moment | None = None
    ) -> Slopes | None:
        """What its force does, if it is one along a coordinate and holds nothing. Collective.

        A run warns of one that is too fast for its steps.

        Args:
            u: As of `potential`.
            history: Likewise.
            when: None: a user's function of time is not asked and counts as none.

        Returns:
            None, for all arguments, of a joint that holds.
        """
        return None

    def sketch(self, u: Sequence[FloatArray], when: float = 0.0) -> Sketch:
        """What pictures show of it. Collective.

        Args:
            u: Owned displacements of each of its bodies [m].
            when: Time [s].
        """
        return Sketch()

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

    def wake(self, e: Evaluation, parts: Sequence[Any]) -> bool:
        """Return whether a solved step asks for more elements, which are made. Collective."""

    def misses(self, e: Evaluation, parts: Sequence[Any], motion: FloatArray) -> bool:
        """Return whether a step may have passed by something, so that it begins again. Collective.

        Args:
            e: Its solution.
            parts: Of it, those of `elements`.
            motion: Largest component of each body's motion [m], shape (bodies,).
        """

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Multipliers of elements k as in the last step, in order, shape (n, constraints) if own.

        Args:
            k: Number among `elements`.
            x: Positions of the first guess, as of `Elements.evaluate`.
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
    """What a `Joint` makes: a `Coupling` that also says what its forces do.

    Attributes:
        rests: Whether a step does without it where its bodies do not move, by `rest`.
    """

    rests: bool

    def rest(self, bodies: Collection[int]) -> None:
        """Leave the step that has begun if it is of bodies that stay where they are. Collective."""

    def rouse(self, bodies: Collection[int]) -> None:
        """Be in the step again if it is of these bodies. Collective."""

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
            dt: Time over which prescribed values are differentiated [s].
        """
