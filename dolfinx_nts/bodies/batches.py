"""The bodies of a scene as a step sees them: those that are alike together, others one by one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.bodies.batch import BodyBatch
from dolfinx_nts.bodies.rigid.rigid import RigidBody
from dolfinx_nts.bodies.rigid.rigid_batch import RigidBatch
from dolfinx_nts.bodies.slender.beam import Beam
from dolfinx_nts.bodies.slender.director_batch import DirectorBatch
from dolfinx_nts.bodies.slender.shell import Shell
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray, IntArray

#: What evaluates several bodies of a class that are alike.
_TOGETHER: dict[type, Any] = {RigidBody: RigidBatch, Beam: DirectorBatch, Shell: DirectorBatch}


class Batches:
    """Batches of bodies, each of which a step evaluates as one body.

    What belongs to a body alone, such as its tolerances, comes as an array by its number.

    Args:
        bodies: Of the system.
        together: Whether bodies that are alike make one batch; else each body is one.

    Attributes:
        comm: MPI communicator.
        count: Number of bodies of the system.
        bodies: Of each batch what evaluates it: a `BodyBatch`, which come first, or the one body.
        numbers: Of each batch the numbers of its bodies in the system.
    """

    def __init__(self, bodies: Sequence[Any], *, together: bool = True) -> None:
        self.comm, self.count = bodies[0].comm, len(bodies)
        found: dict[Any, list[int]] = {}
        for k, body in enumerate(bodies):
            # A class of the user's own may override anything.
            alike = body.alike if together and type(body) in _TOGETHER else None
            found.setdefault(k if alike is None else (type(body), alike), []).append(k)
        self.numbers = sorted(found.values(), key=lambda of: len(of) == 1)
        self.bodies: list[Any] = [
            bodies[k] if len(of) == 1
            else _TOGETHER[type(bodies[k])]([bodies[i] for i in of], np.array(of))
            for of in self.numbers for k in of[:1]
        ]  # fmt: skip
        #: Batch of each body, then of each one that stands for itself as a side of elements.
        self._batch = np.zeros(self.count + len(self.bodies), dtype=np.int64)
        for j, of in enumerate(self.numbers):
            self._batch[[*of, self.count + j]] = j

    @property
    def several(self) -> list[BodyBatch]:
        """Those of more than one body, the first of `bodies`."""
        return [body for body in self.bodies if isinstance(body, BodyBatch)]

    def batch_of(self, k: int) -> int:
        """Number of a body's batch; `count` + j, for a side of all of batch j, stands for j."""
        return int(self._batch[k])

    def in_batch(self, k: int, numbers: IntArray) -> IntArray:
        """A body's coordinates -> those of its batch; negative numbers stay."""
        batch = self.bodies[self._batch[k]]
        if k >= self.count or not isinstance(batch, BodyBatch):
            return numbers
        return np.where(numbers < 0, numbers, batch.numbered(k, numbers))

    def body_of(self, k: int, numbers: IntArray) -> IntArray:
        """Numbers of the bodies that coordinates of a body, or of a side of a batch, are of."""
        if k < self.count:
            return np.full(numbers.shape, k)
        batch = self.bodies[self._batch[k]]
        assert isinstance(batch, BodyBatch)
        return batch.number_of[numbers]

    # ---- from bodies to batches and back
    def join(self, values: Sequence[FloatArray]) -> list[FloatArray]:
        """Owned coordinates of each batch from those of each body."""
        return [
            body.joined(values) if isinstance(body, BodyBatch) else values[of[0]]
            for body, of in zip(self.bodies, self.numbers, strict=True)
        ]

    def split(self, values: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Owned coordinates of each body from those of each batch: views."""
        out = [np.empty(0)] * self.count
        for body, of, own in zip(self.bodies, self.numbers, values, strict=True):
            if isinstance(body, BodyBatch):
                for k, part in body.parts(own):
                    out[k] = part
            else:
                out[of[0]] = own
        found = tuple(out)
        for body, own in zip(self.bodies, values, strict=True):
            if isinstance(body, BodyBatch):
                body.remember(found, own)
        return found

    def share(self, *values: Sequence[FloatArray]) -> None:
        """Let all ranks know those of batches of rigid bodies, see `Body.known`. Collective."""
        for body in self.several if self.comm.size > 1 else ():
            if isinstance(body, RigidBatch):
                body.share(*values)

    def rates(self, state: State) -> tuple[list[FloatArray], list[FloatArray | None]]:
        """Velocities [m/s] of each batch and, of schemes that carry them, accelerations [m/s^2]."""
        return self.join(state.v), [*self.join(state.a)] if state.a else [None] * len(self.bodies)

    def sums(self, values: Sequence[FloatArray]) -> FloatArray:
        """Sum of values (..., num_owned) over the owned coordinates of each body, (..., bodies)."""
        return self._reduced(np.add, values)

    def largest(self, values: Sequence[FloatArray]) -> FloatArray:
        """Largest absolute value at the owned coordinates of each body, shape (bodies,)."""
        return self._reduced(np.maximum, [np.abs(own) for own in values])

    def _reduced(self, how: Any, values: Sequence[FloatArray]) -> FloatArray:
        out = np.zeros((*values[0].shape[:-1], self.count))
        for body, of, own in zip(self.bodies, self.numbers, values, strict=True):
            if isinstance(body, BodyBatch):
                out[..., body.own] = body.reduced(how, own)
            else:
                out[..., of[0]] = how.reduce(own, axis=-1, initial=0.0)
        return out

    def motions(self, du: Sequence[FloatArray]) -> FloatArray:
        """`Body.motion_of_points` of each body on this rank [m], shape (bodies,)."""
        out = np.zeros(self.count)
        for body, of, own in zip(self.bodies, self.numbers, du, strict=True):
            if isinstance(body, BodyBatch):
                out[body.own] = body.motions(own)
            else:
                out[of[0]] = body.motion_of_points(own)
        return out

    def destroy(self) -> None:
        """Free the PETSc objects of batches of several; those of bodies are theirs."""
        for batch in self.several:
            batch.destroy()
