"""Bodies that a step evaluates together, as one body with all their coordinates."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.directors import turns_of
from dolfinx_nts.types import FloatArray, IntArray

#: Values of all bodies that are kept joined: u, v and a of both ends of a step.
_REMEMBERED = 6


class BodyBatch(Body):
    """Bodies that are `alike`, under no load but gravity, with nothing prescribed.

    Its coordinates are those of its members, rank by rank, on each rank in their order.

    Args:
        bodies: The members.
        numbers: Their numbers in the system, shape (members,).
        directors: That each node has.
        kind: Of the members, for messages.

    Attributes:
        members: Numbers of all in the system, shape (members,).
        own: Numbers in the system of those with coordinates on this rank, shape (own,).
        number_of: Number in the system of the body of each coordinate on all ranks.
        number_here: The same of those on this rank, shape (num_owned,).
    """

    oriented = True
    loads_in_time = False

    def __init__(
        self, bodies: Sequence[Any], numbers: IntArray, directors: int, kind: str
    ) -> None:
        self.name = f"{bodies[0].name} and {len(bodies) - 1} other {kind}"
        self.comm, self.length = bodies[0].comm, bodies[0].length
        self.joints = tuple(joint for body in bodies for joint in body.joints)
        self.members, self._directors = numbers, directors
        sizes = np.array(self.comm.allgather([body.num_owned for body in bodies]))
        first = (np.cumsum(sizes) - sizes.ravel()).reshape(sizes.shape)
        #: Of each member its coordinates' numbers among those of the batch.
        self._numbers = {
            k: np.concatenate([np.arange(a, a + n) for a, n in zip(starts, counts, strict=True)])
            for k, starts, counts in zip(numbers.tolist(), first.T, sizes.T, strict=True)
        }
        self.number_of = np.repeat(np.tile(numbers, len(sizes)), sizes.ravel())
        here = sizes[self.comm.rank]
        self.num_owned, self.own = int(here.sum()), numbers[here > 0]
        self.number_here = np.repeat(numbers, here)
        self._own = [body for body, size in zip(bodies, here, strict=True) if size]
        ends = np.cumsum(here)
        self._starts = (ends - here)[here > 0]
        each = zip(self._starts.tolist(), ends[here > 0].tolist(), strict=True)
        self._slices = list(zip(self.own.tolist(), (slice(*two) for two in each), strict=True))
        self._bodies = list(bodies)
        self.fixed = np.empty(0, dtype=np.int64)
        none = np.empty(0)
        self.reference, self.nodal_mass = (
            np.concatenate([none, *(getattr(body, name) for body in self._own)])
            for name in ("reference", "nodal_mass")
        )
        self.places = np.concatenate([none > 0.0, *(body.places for body in self._own)])
        self._joined: deque[tuple[Any, FloatArray]] = deque(maxlen=_REMEMBERED)

    # ---- from members and back
    def numbered(self, k: int, numbers: IntArray) -> IntArray:
        """Coordinates of a member, by its number in the system -> those of the batch."""
        return self._numbers[k][numbers]

    def joined(self, values: Sequence[FloatArray]) -> FloatArray:
        """Coordinates on this rank, from those of each body of the system: not to be changed."""
        for known, found in self._joined:
            if known is values:
                return found
        found = np.concatenate([np.empty(0), *(values[k] for k in self.own.tolist())])
        # A state's tuples never change, and a step asks for each many times.
        if isinstance(values, tuple):
            self.remember(values, found)
        return found

    def remember(self, values: tuple[FloatArray, ...], joined: FloatArray) -> None:
        """Keep what `joined` makes of a tuple for some time: neither is to be changed."""
        self._joined.append((values, joined))

    def parts(self, values: FloatArray) -> Iterator[tuple[int, FloatArray]]:
        """Number in the system and owned coordinates of each of `own`: views."""
        for k, here in self._slices:
            yield k, values[here]

    def reduced(self, how: Any, values: FloatArray) -> FloatArray:
        """Values (..., num_owned) reduced over the coordinates of each of `own`, (..., own)."""
        if not self.own.size:
            return np.empty((*values.shape[:-1], 0))
        found: FloatArray = how.reduceat(values, self._starts, axis=-1)
        return found

    def motions(self, du: FloatArray) -> FloatArray:
        """`motion_of_points` of each of `own` [m], shape (own,)."""
        each = zip(self._own, self.parts(du), strict=True)
        return np.array([body.motion_of_points(own) for body, (_, own) in each])

    def turns(self, u0: FloatArray, u1: FloatArray) -> FloatArray:
        """`turn` of each of `own` [rad], shape (own,)."""
        width = 3 + 3 * self._directors
        found = turns_of(self.reference + u0, self.reference + u1, self._directors)
        if not self.own.size:
            return found
        turns: FloatArray = np.maximum.reduceat(found, self._starts // width)
        return turns

    # ---- as of Body
    def prescribed(self, time: float) -> FloatArray:
        """Nothing is."""
        return np.empty(0)

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """Gravity [N]."""
        return self.weight(gravity)

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the members' current state. Collective."""
        own, none = dict(self.parts(u)), np.empty(0)
        speeds = dict(self.parts(v))
        for k, body in zip(self.members.tolist(), self._bodies, strict=True):
            body.accept(own.get(k, none), speeds.get(k, none))
