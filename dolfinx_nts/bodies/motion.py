"""How a body moves as a whole: mass, centre, velocity, inertia and spin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from dolfinx import fem

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.parallel import global_sum
from dolfinx_nts.types import FloatArray

#: Part of the largest moment of inertia below which a smaller one counts as rounding ...
_NO_ARM = 1e-12
#: ... and part of the distance from the origin below which an arm does.
_SAME_PLACE = 16 * float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Motion of a body as a whole, the same on all ranks.

    Attributes:
        mass: [kg].
        centre: Centre of mass [m], shape (3,).
        velocity: Of the centre of mass [m/s], shape (3,).
        angular_momentum: About the centre of mass [kg m^2/s], shape (3,).
        inertia: Tensor of inertia about the centre of mass as the body is deformed now [kg m^2],
            shape (3, 3).
        spin: Angular velocity of the rigid body with this inertia and angular momentum [rad/s],
            shape (3,); about the line on which all mass lies it is 0.
    """

    mass: float
    centre: FloatArray
    velocity: FloatArray
    angular_momentum: FloatArray
    inertia: FloatArray
    spin: FloatArray


def motion_of(body: Body, u: FloatArray | None = None, v: FloatArray | None = None) -> BodyMotion:
    """Mass, centre, velocity, inertia and spin of a body, during and after a run. Collective.

    Args:
        body: Any body.
        u: Owned displacements [m], shape (num_owned,), e.g. `stepper.state.u[0]` in a writer;
            default: the last accepted ones.
        v: Owned velocities [m/s], shape (num_owned,); default: likewise.

    Raises:
        TypeError: `body` is none.
        ValueError: The body was destroyed.
    """
    if not hasattr(body, "nodal_mass"):
        raise TypeError(f"body={body!r}: pass a body, e.g. run.system.bodies[0]")
    body.check_alive()
    known = body.last_accepted()
    u, v = _owned(body, "u", u, known[0]), _owned(body, "v", v, known[1])
    place = body.reference + u
    weights = [body.nodal_mass, body.inertia(place), body.inertia(v)]
    local = np.concatenate([body.linear_momentum(w) for w in weights])
    masses, first, momentum = global_sum(body.comm, local).reshape(3, 3)
    mass = float(masses[0])
    centre, velocity = first / mass, momentum / mass
    # About the centre: far from the origin a difference of moments about it would lose digits.
    moves = body.places[:, None]
    arm, off = place.reshape(-1, 3) - moves * centre, u - (moves * centre).ravel()
    turning = [v - (moves * velocity).ravel()]
    turning += [np.cross(axis, arm).ravel() for axis in np.eye(3)]
    local = np.concatenate([body.angular_momentum(off, body.inertia(w)) for w in turning])
    about, *columns = global_sum(body.comm, local).reshape(4, 3)
    inertia = 0.5 * (np.array(columns) + np.transpose(columns))
    moments, axes = np.linalg.eigh(inertia)
    least = max(_NO_ARM * moments[-1], mass * (_SAME_PLACE * np.linalg.norm(centre)) ** 2)
    turns = moments > least
    spin = axes[:, turns] @ (about @ axes[:, turns] / moments[turns])
    return BodyMotion(mass, centre, velocity, about, inertia, spin)


def _owned(body: Body, name: str, given: FloatArray | None, known: FloatArray) -> FloatArray:
    """The given coordinates, a dolfinx Function or an array, or those known."""
    values: Any = known if given is None else given
    array = np.asarray(values.x.array if isinstance(values, fem.Function) else values)
    if array.ndim != 1 or len(array) < body.num_owned:
        raise ValueError(
            f"{name} of shape {array.shape}: pass the {body.num_owned} owned coordinates of "
            f"{body.name!r}"
        )
    return array[: body.num_owned]
