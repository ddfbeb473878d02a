"""Rigid bodies that a step evaluates together, as one body with all their coordinates."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.directors import turns_of
from dolfinx_nts.bodies.rigid.rigid import RigidBody
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import FloatArray, IntArray

#: Coordinates of a rigid body.
WIDTH = 12
#: Values of all bodies that are kept joined: u, v and a of both ends of a step.
_REMEMBERED = 6


class RigidBatch(Body):
    """Rigid bodies under no load but gravity, with nothing prescribed: inertia and weight.

    Its coordinates are those of its members, rank by rank, on each rank in their order.

    Args:
        bodies: The members, see `RigidBody.plain`.
        numbers: Their numbers in the system, shape (members,).

    Attributes:
        members: Numbers of all in the system, shape (members,).
        own: Numbers in the system of those that live on this rank, shape (own,).
        number_of: Number in the system of the body of each coordinate on all ranks.
        first: Number of the first coordinate of each member among those of all ranks, (members,).
    """

    rigid = oriented = bound = True
    loads_in_time = False

    def __init__(self, bodies: Sequence[RigidBody], numbers: IntArray) -> None:
        self.name = f"{bodies[0].name} and {len(bodies) - 1} other rigid bodies"
        self.comm = bodies[0].comm
        self.joints = tuple(joint for body in bodies for joint in body.joints)
        owner = np.array([body.owner for body in bodies])
        # By rank, then by number.
        order = np.argsort(owner, kind="stable")
        self.members = numbers
        self.first = np.empty(len(bodies), dtype=np.int64)
        self.first[order] = WIDTH * np.arange(len(bodies))
        self.number_of = np.repeat(numbers[order], WIDTH)
        here = owner == self.comm.rank
        self.own = numbers[here]
        self._own = [body for body, mine in zip(bodies, here, strict=True) if mine]
        self._members = list(bodies)
        self._order = order
        self.num_owned = WIDTH * len(self._own)
        self.fixed = np.empty(0, dtype=np.int64)
        self.places = np.tile([True, False, False, False], len(self._own))
        none = np.empty(0)
        self.reference, self.nodal_mass, self._lent = (
            np.concatenate([none, *(getattr(body, name) for body in self._own)])
            for name in ("reference", "nodal_mass", "lent")
        )
        self._reach = np.array([body.reach for body in self._own]).reshape(-1, 4)
        self._places = self.own.tolist()
        self._joined: deque[tuple[Any, FloatArray]] = deque(maxlen=_REMEMBERED)
        self._matrix: Any = None
        # Mass factor that it holds, and PETSc's count of changes since.
        self._holds: tuple[float, int] | None = None

    def joined(self, values: Sequence[FloatArray]) -> FloatArray:
        """Coordinates on this rank, from those of each body of the system: not to be changed."""
        for known, found in self._joined:
            if known is values:
                return found
        found = np.concatenate([np.empty(0), *(values[k] for k in self._places)])
        # A state's tuples never change, and a step asks for each many times.
        if isinstance(values, tuple):
            self._joined.append((values, found))
        return found

    def motions(self, du: FloatArray) -> FloatArray:
        """`motion_of_points` of each member on this rank [m], shape (own,)."""
        moved = np.abs(du).reshape(-1, 4, 3)
        return np.einsum("bk,bki->bi", self._reach, moved).max(axis=1, initial=0.0)

    def turns(self, u0: FloatArray, u1: FloatArray) -> FloatArray:
        """`turn` of each member on this rank [rad], shape (own,)."""
        return turns_of(self.reference + u0, self.reference + u1, 3)

    # ---- as of Body
    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Nothing on them depends on the step."""

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]."""
        return self.nodal_mass * v

    def internal(self, u1: FloatArray) -> FloatArray:
        """None [N]: what holds the directors are constraints."""
        return np.zeros(self.num_owned)

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """Gravity [N]."""
        return self.weight(gravity)

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> PETSc.Mat:
        """Return mass M."""
        if self._matrix is None:
            # In the 3 x 3 blocks of nodes, as those of other bodies are.
            last = self.comm.scan(self.num_owned)
            rows = np.repeat(np.arange(last - self.num_owned, last), 3)
            cols = 3 * (rows // 3) + np.tile(np.arange(3), self.num_owned)
            self._matrix = petsc_compat.coo_matrix(self.comm, self.num_owned, rows, cols)
        if self._holds != (mass, self._matrix.stateGet()):
            diagonal = mass * (self.nodal_mass + self._lent)
            blocks = diagonal[:, None] * np.tile(np.eye(3), (self.num_owned // 3, 1))
            petsc_compat.set_values_coo(self._matrix, blocks.ravel())
            self._holds = mass, self._matrix.stateGet()
        return self._matrix

    def nodal_stiffness(self) -> FloatArray:
        """None [N/m]."""
        return np.zeros(self.num_owned)

    def potential(self, u: FloatArray) -> float:
        """None [J]: gravity does external work."""
        return 0.0

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the members' current state. Collective."""
        local = np.reshape([self.reference + u, u, v], (3, -1, 4, 3)).swapaxes(0, 1)
        for k, seen in zip(self._order.tolist(), gather_rows(self.comm, local), strict=True):
            self._members[k].show(*seen)

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        if self._matrix is not None:
            self._matrix.destroy()
            self._matrix = None
