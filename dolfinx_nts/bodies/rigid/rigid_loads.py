"""Dead loads on a rigid body, and its prescribed motion."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np
from scipy.spatial.transform import Rotation

from dolfinx_nts.bodies.conditions import VectorInTime
from dolfinx_nts.bodies.loads import load_at
from dolfinx_nts.bodies.rigid.inertia import Inertia, misfit_of_axes
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import UserFunctionError, agree, call_together, floats, vector_in_time

#: Part of a torque along an axis without inertia that counts as none.
_ALONG = 1e-6


class RigidLoads:
    """Force and torque on a rigid body.

    Args:
        comm: MPI communicator.
        name: The body's, for messages.
        force: As of `RigidBody`.
        torque: As of `RigidBody`.
        euler: As of `Inertia`.

    Attributes:
        in_time: Whether one of them is a function of time.
        force: In the step [N], shape (3,), after `begin`.
        torque: In the step [N m], shape (3,).
    """

    def __init__(
        self, comm: MPI.Comm, name: str, force: VectorInTime, torque: VectorInTime,
        euler: FloatArray,
    ) -> None:  # fmt: skip
        self._comm, self._name, self._turned = comm, name, euler > 0.0
        self._given = ("force", force, "N"), ("torque", torque, "N m")
        self.in_time = callable(force) or callable(torque)

    @property
    def settings(self) -> dict[str, VectorInTime]:
        """As they were given, by their names."""
        return {name: value for name, value, _ in self._given}

    @property
    def none(self) -> bool:
        """Whether there are none at any time."""
        return not any(callable(value) or np.any(value) for _, value, _ in self._given)

    def begin(self, time: float, ramp: float, axes: FloatArray) -> None:
        """Set the loads at a time [s]. Collective.

        Args:
            time: When.
            ramp: Part of those loads that are no functions of time.
            axes: Principal axes as they are now, as columns.

        Raises:
            UserFunctionError: The torque is about an axis without inertia.
        """
        self.force, self.torque = (
            load_at(self._comm, f"{what} of {self._name!r}", value, unit, time, ramp)
            for what, value, unit in self._given
        )
        self._check_torque(axes)

    def _check_torque(self, axes: FloatArray) -> None:
        """Refuse a torque about the axis of a rod, or on a point: nothing resists it."""
        if np.count_nonzero(self._turned) > 1:
            return
        free = axes[:, self._turned].T if self._turned.any() else np.eye(3)
        if np.abs(free @ self.torque).max() > _ALONG * np.linalg.norm(self.torque):
            raise UserFunctionError(
                f"torque of {self._name!r}={self.torque.tolist()!r}: the body has no inertia about "
                f"{'its axis' if len(free) == 1 else 'any axis'}; give it some, or leave the "
                "torque out"
            )

    @property
    def turn(self) -> bool:
        """Whether there is a torque in the step."""
        return bool(self.torque.any())

    def on_directors(self, directors: FloatArray) -> FloatArray:
        """The torque's forces t x D_i on directors D_i (3, 3) in [m], shape (3, 3) [N]."""
        return cross(np.tile(self._turning(directors), (3, 1)), directors)

    def _turning(self, directors: FloatArray) -> FloatArray:
        """The vector t [N/m] with sum D_i x (t x D_i) = torque, whose impulse is exact then.

        On orthonormal directors it is torque / (2 l^2); in the middle of a step they are shorter.
        """
        squares = directors.T @ directors
        whole = np.trace(squares) * np.eye(3) - squares
        return np.linalg.solve(whole, self.torque)

    def gradient(self, directors: FloatArray) -> FloatArray:
        """Derivative of the torque's forces t x D_i by the directors, shape (9, 9)."""
        squares = directors.T @ directors
        t = self._turning(directors)
        # (trace - squares) dt = - (change of both) t
        change = np.concatenate(
            [2.0 * np.outer(t, d) - (d @ t) * np.eye(3) - np.outer(d, t) for d in directors], axis=1
        )
        dt = -np.linalg.solve(np.trace(squares) * np.eye(3) - squares, change)
        gradient = np.kron(np.eye(3), _spin(t))
        for i, d in enumerate(directors):
            gradient[3 * i : 3 * i + 3] -= _spin(d) @ dt
        return gradient


def _spin(a: FloatArray) -> FloatArray:
    """Matrix of a x."""
    x, y, z = a
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


#: Parts of a step at which a prescribed rotation is asked for how far it turns.
_ASKED = (0.0, 0.30, 0.57, 1.0)


class PrescribedMotion:
    """What `motion` and `rotation` of a rigid body prescribe.

    Args:
        comm: MPI communicator.
        name: The body's, for messages.
        motion: As of `RigidBody`.
        rotation: As of `RigidBody`.

    Attributes:
        moves: Whether it prescribes where the centre of mass is.
        turns: Whether it prescribes the rotation.
        in_time: Whether one of them is a function of time.
    """

    def __init__(self, comm: MPI.Comm, name: str, motion: Any, rotation: Any) -> None:
        self._comm, self._name, self._motion, self._rotation = comm, name, motion, rotation
        self.moves, self.turns = motion is not None, rotation is not None
        self.in_time = callable(motion) or callable(rotation)

    def refuse_beside(self, velocity: FloatArray, angular_velocity: FloatArray) -> None:
        """Refuse velocities at the start, (3,) each, beside what prescribes them.

        Raises:
            ValueError: One is given twice.
        """
        for what, speed, drive, prescribed in (
            ("velocity", velocity, "motion", self.moves),
            ("angular_velocity", angular_velocity, "rotation", self.turns),
        ):
            if speed.any() and prescribed:
                raise ValueError(
                    f"{what} of {self._name!r}={speed.tolist()!r}: {drive}= prescribes it; leave "
                    f"{what} out, or {drive}="
                )

    def displacement(self, time: float) -> FloatArray:
        """That of the centre of mass [m], shape (3,). Collective."""
        return vector_in_time(self._comm, f"motion of {self._name!r}", self._motion, time, "m")

    def rotation(self, time: float) -> FloatArray:
        """The rotation since the start, shape (3, 3). Collective."""
        given, name, moves = self._rotation, f"rotation of {self._name!r}", callable(self._rotation)
        if moves:
            name = f"{name} at t={time!r}"
            given = call_together(self._comm, name, given, time)
        problem, turned = None, np.eye(3)
        array = floats(given)
        if array.shape not in ((3,), (3, 3)) or not np.isfinite(array).all():
            problem = "pass a rotation vector (3,) [rad] or a rotation matrix (3, 3)"
        elif array.shape == (3,):
            turned = Rotation.from_rotvec(array).as_matrix()
        else:
            problem, turned = misfit_of_axes(array), array
        if moves:
            text = f"{name}: returned {given!r}; {problem}"
            agree(self._comm, name, turned, text if problem else None)
        else:
            raise_together(self._comm, f"{name}={given!r}: {problem}" if problem else None)
        return turned

    def coordinates(self, time: float, inertia: Inertia) -> FloatArray:
        """Displacements of the four nodes, 0 where they are free [m], shape (12,). Collective."""
        u = np.zeros((4, 3))
        if self.moves:
            u[0] = self.displacement(time)
        if self.turns:
            turn = self.rotation(time) - np.eye(3)
            u[1:] = inertia.length * (turn @ inertia.axes).T
        return u.ravel()

    def turn(self, start: float, end: float) -> float:
        """Turn between two times [rad], at least. Collective.

        Its function is also asked at times between that share no period: rates below a hundred
        turns in this time that look slow at all of them are slow.
        """
        if not callable(self._rotation):
            return 0.0
        turned = [self.rotation(start + part * (end - start)) for part in _ASKED]
        cosines = [0.5 * float((a * b).sum()) - 0.5 for a, b in pairwise(turned)]
        return float(np.arccos(np.clip(cosines, -1.0, 1.0)).sum())
