"""The step without forces: where bodies would fly, and with which momentum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.equations.body_tangents import BodyTangents
from dolfinx_nts.equations.mass_solves import Saddle
from dolfinx_nts.equations.scales import Lengths
from dolfinx_nts.equations.supports import StepSupports
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.types import BoolArray, FloatArray

#: A motion of supports goes on as before if it differs by less than this part.
_STEADY = 1e-6
#: Motion of supports, over the scene, that tells which forces they make.
_TRIED = 1e-7
#: How much farther than its supports a body may come, as the end of a beam whose other end turns.
_FARTHEST = 1e3


class Flight:
    """Free flight of a system's bodies over a step; `begin` fixes it.

    Args:
        batches: Bodies that are evaluated together.
        integrator: Rules of the step.
        supports: Prescribed coordinates, which begin the step here.
        lengths: Those of the step, which begin it here.
        inertial: M du of a motion of a batch [kg m]; in statics the force of the stabilization [N].

    Attributes:
        ends: Displacement of each batch at t_{n+1} [m].
        momentum: M (u_1 - u_0) of each batch [kg m]; zero in statics.
        jumps: In statics, how far prescribed coordinates of each batch go beside what its motion
            would have them do [m], in the order of `fixed`.
    """

    def __init__(
        self, batches: Batches, integrator: Any, supports: StepSupports, lengths: Lengths,
        inertial: Callable[[Body, FloatArray], FloatArray],
    ) -> None:  # fmt: skip
        self._batches, self._integrator, self._inertial = batches, integrator, inertial
        self._supports, self._lengths = supports, lengths
        self.ends: list[FloatArray] = []
        self.momentum: list[FloatArray] = []
        self.jumps: list[FloatArray] = []

    def begin(self, state: State, u0: Sequence[FloatArray], dt: float) -> BoolArray:
        """Fly from the state at t_n, displacements u0 of each batch [m]. Collective.

        Returns:
            Whether each body starts without speed, shape (bodies,).
        """
        batches, integrator = self._batches, self._integrator
        v0, a0 = batches.rates(state)
        ahead = [integrator.ahead(v, a, dt) for v, a in zip(v0, a0, strict=True)]
        self.ends = [u + du for u, du in zip(u0, ahead, strict=True)]
        self.jumps = []
        for body, u1 in zip(batches.bodies, self.ends, strict=True):
            there = body.prescribed(state.time + dt)
            self.jumps.append(there - u1[body.fixed])
            u1[body.fixed] = there
        self._supports.begin(state, batches.split(self.ends), dt)
        rates = [v0] + [[dt * a for a in a0 if a is not None]] * bool(state.a)
        speed = self._lengths.begin(u0, rates, self.ends)
        # In statics v only predicts the first guess.
        moves = (speed > 0.0) & integrator.inertia
        moves[list(self._supports.moving)] = True
        self.momentum = []
        each = zip(batches.bodies, batches.numbers, ahead, self.ends, strict=True)
        for body, of, du, u1 in each:
            if not moves[of].any():
                self.momentum.append(np.zeros_like(du))
                continue
            flown = du if len(of) > 1 else self._supports.ahead(of[0], du, u1)
            self.momentum.append(self._inertial(body, flown))
        return speed == 0.0

    def follow_supports(
        self, u0: Sequence[FloatArray], touching: set[int], tangents: BodyTangents
    ) -> None:
        """Let bodies follow what supports do beside their motion, in `ends`. Collective.

        Else the cells at the supports would take all of it: those of a material that hardly changes
        its volume have no way back from there.

        Args:
            u0: As of `begin`.
            touching: Bodies that may touch, which stay where they are: what stands in their way is
                not known yet.
            tangents: Matrices of the batches.
        """
        comm, batches = self._batches.comm, self._batches
        for j, body in enumerate(batches.bodies):
            if body.rigid or not body.driven or touching.intersection(batches.numbers[j]):
                continue
            start, end, jump = u0[j], self.ends[j], np.zeros(body.num_owned)
            jump[body.fixed] = self.jumps[j]
            sizes = np.array([np.abs(a).max(initial=0.0) for a in (jump, end - start)])
            largest, moved = global_max(comm, sizes)
            if not largest > _STEADY * moved:
                continue
            part = _TRIED * self._lengths.radius / largest
            pull = (body.internal(start + part * jump) - body.internal(start)) / part
            pull[body.fixed] = 0.0
            saddle = Saddle(tangents.of_all(j, start))
            way = saddle.solve(-pull)
            saddle.destroy()
            way[body.fixed] = 0.0
            far = global_max(comm, np.abs(way).max(initial=0.0, keepdims=True))[0]
            if far <= _FARTHEST * largest:
                end += way
