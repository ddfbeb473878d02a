"""What a step asks of elements of any kind: contacts, joints, springs and ties."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from mpi4py import MPI

import numpy as np

from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.combination import Combination
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.parallel import Asking, anywhere, together
from dolfinx_nts.state import State
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import StepFailedError, UserFunctionError

_EPS = float(np.finfo(float).eps)
#: What a failed step is told of an element that has shrunk to a point, with what to do.
NO_DIRECTION = "no direction in which to pull"
#: Elements, and what they raised.
Raised = tuple[Any, Exception]


def over(value: float, limit: float) -> float:
    """A size over its limit; 0 over anything is 0."""
    if value == 0.0:
        return 0.0
    return float(value / limit) if limit > 0 else np.inf


@dataclass(frozen=True, eq=False)
class Step:
    """What those who make a step's elements know of the step.

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
        stiffness: Of a body, that of each of its coordinates' neighbourhood [N/m]; for statics. Of
            bodies in contact these are the second argument, see `Stabilization`.
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
    stiffness: Callable[..., FloatArray]
    moments: Sequence[EvaluationPoint]
    force_rounding: Callable[[Sequence[int]], float]

    def mean_scale(self, body: Any) -> float:
        """Force per motion in the mean over a body's places, in the step's units. Collective."""
        inertia = self.integrator.inertia
        values = body.nodal_mass if inertia else self.stiffness(body)
        chosen = values[::3][body.places]
        total = body.comm.allreduce(np.array([chosen.sum(), len(chosen)]))
        return float(total[0] / total[1])

    def least_scales(self, each: Sequence[Sequence[Any]]) -> FloatArray:
        """The least `mean_scale` of the bodies of each of several, shape (len(each),). Collective.

        Args:
            each: Bodies, which may be the same in many.
        """
        known: dict[int, float] = {}
        for body in (body for bodies in each for body in bodies):
            if id(body) not in known:
                known[id(body)] = self.mean_scale(body)
        return np.array([min(known[id(body)] for body in bodies) for bodies in each])

    def scale(self, surface: Any, bodies: Sequence[Any]) -> FloatArray:
        """Force per motion of a `Surface`'s points in the units of the step, (p,). Collective.

        Massless nodes have their stiffness for it: with more, Newton's method would go to and fro
        between contact and none, and stick and slip, in small steps.

        Args:
            surface: The surface.
            bodies: Those of its contact.
        """
        massless = surface.massless
        if self.integrator.inertia and not massless.any():
            return surface.mass
        change = self.factor * self.integrator.theta
        stiff = change * surface.material.divided(self.stiffness(surface.body, bodies))
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


class Stopped(NamedTuple):
    """What joints stopped in a step that moved freely before: at limits, as cables became taut.

    Attributes:
        impulses: With which they did, on the coordinates [N s], zero of others, shape (n, k).
        lost: Energy that this took [J], shape (n,).
    """

    impulses: FloatArray
    lost: FloatArray


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
    def entries(self) -> BoolArray:
        """Which entries of a tangent can be non-zero, those of augmented unknowns left out.

        An entry that is False stays zero as long as the layout of a step's unknowns is kept. Shape
        (k + m, k + m), of k coordinates and m constraints.
        """

    @property
    def combination(self) -> Combination | None:
        """How unknowns of its constraints follow from multipliers; None: each has its own."""

    @property
    def bilateral(self) -> bool:
        """Whether its constraints hold always and in both directions, as those of joints."""

    @property
    def extent(self) -> float:
        """Length beside the displacements whose rounding is in its rows, on this rank [m]."""

    @property
    def force_scale(self) -> Any:
        """Force, in the step's units, per unit of a constraint's unknown; of each element (n,)."""

    def points(self) -> tuple[IntArray, ...]:
        """Global coordinates of each body, shape (n, k) each."""

    def dofs(self) -> tuple[IntArray, ...]:
        """The same with -1 where they are prescribed."""

    def reference(self) -> FloatArray:
        """Return what is added to the displacements of these coordinates [m], (n, k / 3, 3)."""

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """Augmented unknowns that fit predicted positions, shape (n, augmented)."""

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> Part | Asking[Part]:
        """Residual and tangent. All ranks call it, also those without elements.

        What needs other ranks asks them as of `parallel.together`, in one call for all batches.

        No later call may depend on it. What it raises on one rank ends the solution on all, see
        `evaluate_together`.

        Args:
            x: Reference plus displacement at t_{n+1} [m], shape (n, k / 3, 3).
            own: Own unknowns by field, shape (n, width).
        """

    def rows(self, part: Any, name: str) -> FloatArray:
        """The residual's rows of a field of own unknowns, shape (n, width)."""

    def largest(self, part: Any) -> list[float]:
        """Two sizes of rows on this rank, and two that these are measured by."""

    def ratios(
        self, part: Any, largest: Any, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """Own rows over what counts as converged, by names for messages; ranks may differ.

        Args:
            part: As of `largest`.
            largest: `largest`, the last two over all ranks if there are augmented unknowns; where
                joints link the elements' bodies, the last one is that of the linked ones, of each
                element (n,) of several joints.
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

    def stopped(self, part: Any, rate: float) -> Stopped | None:
        """What came to be held in an accepted step; None of what holds always, or never.

        Args:
            part: Solution of the step.
            rate: Impulse over what forces are in the units of the step [1/s].
        """

    def describe(self, part: Any, flips: IntArray) -> tuple[float, str]:
        """Weight and text of the worst element, for messages.

        Args:
            part: Last iterate.
            flips: How often `Part.status` changed, shape (states, n).
        """


def entries_of(num_coordinates: int, pattern: BoolArray) -> BoolArray:
    """`Elements.entries` of elements in which all coordinates stand in all rows."""
    entries = np.ones((num_coordinates + len(pattern),) * 2, dtype=bool)
    entries[num_coordinates:, num_coordinates:] = pattern
    return entries


def evaluate_together(
    comm: MPI.Comm, elements: Sequence[Any], places: Sequence[FloatArray],
    own: Sequence[Mapping[str, FloatArray]],
) -> tuple[Any, ...]:  # fmt: skip
    """What elements contribute at an iterate; what fails on one rank fails on all. Collective.

    Args:
        comm: MPI communicator.
        elements: Batches of elements.
        places: Of each, as of `Elements.evaluate`.
        own: Of each, as of `Elements.evaluate`.

    Raises:
        UserFunctionError: One raised on some rank.
        StepFailedError: It raised this.
    """
    parts, raised = evaluate_here(comm, elements, places, own)
    if anywhere(comm, raised is not None):
        raise_of_all(comm, raised)
    return parts


def evaluate_here(
    comm: MPI.Comm, elements: Sequence[Any], places: Sequence[FloatArray],
    own: Sequence[Mapping[str, FloatArray]],
) -> tuple[tuple[Any, ...], Raised | None]:  # fmt: skip
    """As `evaluate_together`, and what elements raised on this rank, of which others do not know.

    Collective. If any rank has raised, all are to call `raise_of_all`.
    """
    raised: list[Raised] = []

    def evaluated(batch: Any, *at: Any) -> Asking[Any]:
        try:
            part = batch.evaluate(*at)
            return (yield from part) if isinstance(part, Generator) else part
        except Exception as error:  # any: a rank that raises alone would leave the others waiting
            raised.append((batch, error))

    return tuple(together(comm, map(evaluated, elements, places, own))), next(iter(raised), None)


def raise_of_all(comm: MPI.Comm, raised: Raised | None) -> None:
    """Raise what elements raised on the first rank where they did. Collective.

    Raises:
        UserFunctionError: One raised on some rank.
        StepFailedError: It raised this.
    """
    problem = None if raised is None else _problem(*raised)
    kind, text, advises = next(filter(None, comm.allgather(problem)))
    raise kind(text, advises=advises) from (None if raised is None else raised[1])


def _problem(batch: Any, error: Exception) -> tuple[type[StepFailedError], str, bool]:
    """What to raise on all ranks where elements have raised on one, and whether it advises."""
    if isinstance(error, StepFailedError):
        kind = UserFunctionError if isinstance(error, UserFunctionError) else StepFailedError
        return kind, str(error), error.advises
    text = f"{batch.name!r}: its elements raised {error!r}; correct it"
    return UserFunctionError, text, True
