"""Dead loads on a rigid body: a force on its centre of mass, and a torque on its directors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dolfinx_nts.arrays import FloatArray
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.validation import UserFunctionError, vector_in_time

VectorInTime = Sequence[float] | FloatArray | Callable[[float], Any]

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
        self, comm: Any, name: str, force: VectorInTime, torque: VectorInTime, euler: FloatArray
    ) -> None:
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
            (1.0 if callable(value) else ramp)
            * vector_in_time(self._comm, f"{what} of {self._name!r}", value, time, unit)
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
        turning: FloatArray = np.linalg.solve(whole, self.torque)
        return turning

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
