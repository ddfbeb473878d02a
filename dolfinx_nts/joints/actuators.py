"""Torques and forces between two bodies that a user's function gives, such as a controller's."""

from __future__ import annotations

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.joints.forces import AboutAxis, BetweenPoints
from dolfinx_nts.joints.laws import Motor, driven_by
from dolfinx_nts.types import Vector, Vectors
from dolfinx_nts.validation import known_options


@known_options
class Torque(AboutAxis):
    """A torque about an axis, without a joint. Its work is external work.

    Args:
        a: A rigid body, on which the torque acts, or None: the ground.
        b: A rigid body, on which its opposite acts, or None: the ground.
        axis: In the reference, of any length.
        torque: Function of time [s], of the angle [rad] by which a turns relative to b about the
            axis since the reference, and of its rate [rad/s]; returns a torque [N m].
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is flexible.
    """

    entry = ("external_work", -1.0)

    def __init__(
        self, a: Body | None, b: Body | None, *, axis: Vector, torque: Motor,
        name: str | None = None,
    ) -> None:  # fmt: skip
        super().__init__(a, b, axis=axis, name=name)
        self.law = driven_by(self, "torque", torque, 1.0)


@known_options
class Thrust(BetweenPoints):
    """A force along the line between two points, as of a cylinder. Its work is external work.

    Args:
        a: A body, or None: the ground.
        b: A body, or None: the ground.
        points: In the reference [m], one of a and one of b, shape (3,) each.
        force: Function of time [s], of the distance of the points [m], and of its rate [m/s];
            returns a force [N] that drives them apart.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, a point lies outside a flexible body, or the points
            coincide.
    """

    entry = ("external_work", -1.0)

    def __init__(
        self, a: Body | None, b: Body | None, points: Vectors, *, force: Motor,
        name: str | None = None,
    ) -> None:  # fmt: skip
        super().__init__(a, b, points, name=name)
        if self.distance == 0.0:
            raise self._undirected("a force along their line has no direction")
        self.law = driven_by(self, "force", force, self.distance)
