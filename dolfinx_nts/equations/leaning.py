"""Forces that others carry and laws lean on: those of a joint's bearing, or all of a contact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from mpi4py import MPI

import numpy as np

from dolfinx_nts.parallel import Asking
from dolfinx_nts.types import FloatArray, IntArray


class Load(Protocol):
    """Multipliers that a law depends on, whose columns follow all others in its tangents."""

    def columns(self, elements: Sequence[Any], starts: Sequence[int]) -> IntArray:
        """Numbers of the multipliers in their field, shape (n, columns). Collective.

        Args:
            elements: Batches of elements.
            starts: Of the first multiplier of each in the field.
        """

    def told(
        self, elements: Sequence[Any], own: Sequence[dict[str, FloatArray]]
    ) -> dict[str, FloatArray]:
        """What is added to the unknowns of the batch at an iterate.

        Args:
            elements: Batches of elements.
            own: Of each its own unknowns, see `Unknowns.own_values`.
        """


class BearingLoad(NamedTuple):
    """The force of a joint's bearing.

    It tells "load", the force times the factor of the step, (n, bearing), and "by_unknowns", its
    derivative by each of these unknowns, (n, 1).

    Attributes:
        batch: Number of the batch that has the multipliers.
        rows: Its elements on this rank, one of each element of the law's.
        bearing: How many multipliers of each, the first ones.
    """

    batch: int
    rows: IntArray
    bearing: int

    def columns(self, elements: Sequence[Any], starts: Sequence[int]) -> IntArray:
        """As of `Load`."""
        first = starts[self.batch] + elements[self.batch].widths["constraints"] * self.rows
        found: IntArray = first[:, None] + np.arange(self.bearing)
        return found

    def told(
        self, elements: Sequence[Any], own: Sequence[dict[str, FloatArray]]
    ) -> dict[str, FloatArray]:
        """As of `Load`."""
        scale = elements[self.batch].scale[self.rows, None]
        force = own[self.batch]["constraints"][self.rows, : self.bearing]
        return {"load": scale * force, "by_unknowns": scale}


class PressingLoad(NamedTuple):
    """The normal forces of a contact on all ranks, for a law whose one element is on one of them.

    It tells "load", this rank's part of their sum times the factor of the step, (1,), on the law's
    rank "by_unknowns", the derivative of the sum by each of the unknowns, (n, unknowns), and
    "normal", a unit vector along which most of it acts as the step begins, (3,), and "spread", what
    acts along the next axis over that, from 0 to 1.

    Attributes:
        comm: MPI communicator.
        batches: Numbers of the contact's batches.
        here: Elements of the law on this rank, 0 or 1.
        by_unknowns: Of all ranks, one after the other, shape (unknowns,).
        normal: Shape (3,).
        spread: See above.
    """

    comm: MPI.Comm
    batches: Sequence[int]
    here: int
    by_unknowns: FloatArray
    normal: FloatArray
    spread: float

    @classmethod
    def of(
        cls, comm: MPI.Comm, batches: Sequence[int], elements: Sequence[Any],
        guesses: Sequence[FloatArray], here: int,
    ) -> Asking[PressingLoad]:  # fmt: skip
        """Return it, as of `parallel.together`.

        Args:
            comm: MPI communicator.
            batches: Numbers of the contact's batches.
            elements: All batches of the step.
            guesses: Multipliers of the last step of each of the contact's, (n, constraints).
            here: As of the class.
        """
        own = [np.empty((0, 5))]
        for k, guess in zip(batches, guesses, strict=True):
            law, normal = elements[k].law, elements[k].measure.normal
            own.append(np.column_stack([-law.scale, -law.scale * guess[:, 0], normal]))
        rows = yield np.concatenate(own)
        force, normals = rows[:, 1].clip(min=0.0), rows[:, 2:]
        # Where nothing presses yet, all that may touch counts.
        weight = force if force.any() else np.ones(len(rows))
        sizes, axes = np.linalg.eigh(np.einsum("n,ni,nj->ij", weight, normals, normals))
        spread = float(sizes[1] / sizes[2]) if sizes[2] > 0.0 else 0.0
        return cls(comm, tuple(batches), here, rows[:, 0], axes[:, -1], spread)

    def columns(self, elements: Sequence[Any], starts: Sequence[int]) -> IntArray:
        """As of `Load`. Collective."""
        own = [np.empty(0, dtype=np.int64)]
        for k in self.batches:
            width = elements[k].widths["constraints"]
            own.append(starts[k] + width * np.arange(elements[k].num_elements))
        numbers = np.concatenate(self.comm.allgather(np.concatenate(own)))
        return np.tile(numbers, (self.here, 1))

    def told(
        self, elements: Sequence[Any], own: Sequence[dict[str, FloatArray]]
    ) -> dict[str, FloatArray]:
        """As of `Load`."""
        sums = [-(elements[k].law.scale @ own[k]["constraints"][:, 0]) for k in self.batches]
        by_unknowns = np.tile(self.by_unknowns, (self.here, 1))
        load = np.array([sum(sums, start=0.0)])
        return {
            "load": load, "by_unknowns": by_unknowns, "normal": self.normal,
            "spread": np.array(self.spread),
        }  # fmt: skip
