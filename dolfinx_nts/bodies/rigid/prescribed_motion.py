"""Prescribed motion of a rigid body: of its centre of mass, and its rotation."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dolfinx_nts.arrays import FloatArray
from dolfinx_nts.bodies.rigid.inertia import misfit_of_axes
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.validation import agree, call_together, floats, vector_in_time

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

    def __init__(self, comm: Any, name: str, motion: Any, rotation: Any) -> None:
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
