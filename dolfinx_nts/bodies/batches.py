"""The bodies of a scene as a step sees them: plain rigid ones together, all others one by one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.bodies.rigid.rigid_batch import WIDTH, RigidBatch
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray, IntArray


class Batches:
    """Batches of bodies, each of which a step evaluates as one body.

    What belongs to a body alone, such as its tolerances, comes as an array by its number.

    Args:
        bodies: Of the system.
        together: Whether plain rigid bodies make one batch; else each body is one.

    Attributes:
        comm: MPI communicator.
        count: Number of bodies of the system.
        bodies: Of each batch what evaluates it: a `RigidBatch`, or the one body itself.
        numbers: Of each batch the numbers of its bodies in the system.
        rigid: The batch of several, if there is one; the first of `bodies` then.
    """

    def __init__(self, bodies: Sequence[Any], *, together: bool = True) -> None:
        self.comm, self.count = bodies[0].comm, len(bodies)
        plain = [k for k, body in enumerate(bodies) if together and getattr(body, "plain", False)]
        plain = plain if len(plain) > 1 else []
        alone = [k for k in range(len(bodies)) if k not in set(plain)]
        self.rigid = RigidBatch([bodies[k] for k in plain], np.array(plain)) if plain else None
        several: list[Any] = [self.rigid] if self.rigid else []
        self.bodies = several + [bodies[k] for k in alone]
        self.numbers = [plain] * len(several) + [[k] for k in alone]
        #: Batch of each body, then of each batch that stands for itself as a side of elements ...
        self._batch = np.zeros(self.count + len(self.bodies), dtype=np.int64)
        #: ... and where the body's coordinates begin in the numbering of its batch.
        self._first = np.zeros_like(self._batch)
        for j, of in enumerate(self.numbers):
            self._batch[[*of, self.count + j]] = j
        if self.rigid:
            self._first[plain] = self.rigid.first

    def batch_of(self, k: int) -> int:
        """Number of a body's batch; `count` + j, for a side of all of batch j, stands for j."""
        return int(self._batch[k])

    def in_batch(self, k: int, numbers: IntArray) -> IntArray:
        """A body's coordinates -> those of its batch; negative numbers stay."""
        first = self._first[k]
        return np.where(numbers < 0, numbers, numbers + first) if first else numbers

    def body_of(self, k: int, numbers: IntArray) -> IntArray:
        """Numbers of the bodies that coordinates of a body, or of a side of a batch, are of."""
        if k < self.count:
            return np.full(numbers.shape, k)
        j = k - self.count
        if self.rigid is None or j:
            return np.full(numbers.shape, self.numbers[j][0])
        return self.rigid.number_of[numbers]

    # ---- from bodies to batches and back
    def join(self, values: Sequence[FloatArray]) -> list[FloatArray]:
        """Owned coordinates of each batch from those of each body."""
        return [
            body.joined(values) if body is self.rigid else values[of[0]]
            for body, of in zip(self.bodies, self.numbers, strict=True)
        ]

    def split(self, values: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Owned coordinates of each body from those of each batch: views."""
        out = [np.empty(0)] * self.count
        for body, of, own in zip(self.bodies, self.numbers, values, strict=True):
            if body is self.rigid:
                for k, row in zip(body.own.tolist(), own.reshape(-1, WIDTH), strict=True):
                    out[k] = row
            else:
                out[of[0]] = own
        return tuple(out)

    def rates(self, state: State) -> tuple[list[FloatArray], list[FloatArray | None]]:
        """Velocities [m/s] of each batch and, of schemes that carry them, accelerations [m/s^2]."""
        return self.join(state.v), [*self.join(state.a)] if state.a else [None] * len(self.bodies)

    def sums(self, values: Sequence[FloatArray]) -> FloatArray:
        """Sum of values (..., num_owned) over the owned coordinates of each body, (..., bodies)."""
        return self._reduced(np.add, values)

    def largest(self, values: Sequence[FloatArray]) -> FloatArray:
        """Largest absolute value at the owned coordinates of each body, shape (bodies,)."""
        return self._reduced(np.maximum, [np.abs(own) for own in values])

    def _reduced(self, how: np.ufunc, values: Sequence[FloatArray]) -> FloatArray:
        out = np.zeros((*values[0].shape[:-1], self.count))
        for body, of, own in zip(self.bodies, self.numbers, values, strict=True):
            if body is self.rigid:
                each = own.reshape(*own.shape[:-1], len(body.own), WIDTH)
                out[..., body.own] = how.reduce(each, axis=-1)
            else:
                out[..., of[0]] = how.reduce(own, axis=-1, initial=0.0)
        return out

    def motions(self, du: Sequence[FloatArray]) -> FloatArray:
        """`Body.motion_of_points` of each body on this rank [m], shape (bodies,)."""
        out = np.zeros(self.count)
        for body, of, own in zip(self.bodies, self.numbers, du, strict=True):
            if body is self.rigid:
                out[body.own] = body.motions(own)
            else:
                out[of[0]] = body.motion_of_points(own)
        return out

    def destroy(self) -> None:
        """Free the PETSc objects of batches of several; those of bodies are theirs."""
        if self.rigid:
            self.rigid.destroy()
