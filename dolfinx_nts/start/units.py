"""Numbers that are not of one system of units, of bodies under gravity and of limits of angles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from dolfinx_nts.bodies.solid.mass import stiffness_along
from dolfinx_nts.joints.laws import Limits
from dolfinx_nts.kernels.measures import Angle
from dolfinx_nts.parallel import anywhere, global_max, global_sum
from dolfinx_nts.system import System

#: Units that scenes are written in: length [m] and time [s]. That of mass drops out of a speed.
_UNITS = {
    "m and s": (1.0, 1.0),
    "mm and s": (1e-3, 1.0),
    "mm and ms": (1e-3, 1e-3),
    "cm and s": (1e-2, 1.0),
    "um and s": (1e-6, 1.0),
    "inches and s": (0.0254, 1.0),
    "feet and s": (0.3048, 1.0),
}
#: Gravity of the Earth [m/s^2], and by which part of it a number may differ to be meant as that.
_EARTH, _LIKE = 9.81, 0.03
#: Speeds sqrt(E/rho) of materials [m/s]: a gel of 100 Pa has 0.3, diamond 17,000.
_SLOWEST, _FASTEST = 0.2, 2.5e4
#: Weight over E times the section above which a body is no body any more.
_CRUSHED = 10.0
#: A turn [rad], and by which part of it a number may differ from a whole one that was meant.
_TURN, _WHOLE = 2.0 * np.pi, 1e-12
_REMEDY = "check that modulus, density, lengths and gravity are in one system of units"


def doubtful_units(system: System, *, in_time: bool) -> Iterator[tuple[str, float, str]]:
    """Bodies that gravity would crush, or of a wave speed that no material has; limits in degrees.

    Limits of an angle are taken for such if they are whole numbers beyond a turn. Collective.

    The first is a ratio without units. The second needs the units of length and time, which
    gravity tells if it is that of the Earth; without gravity nothing is known.

    Args:
        system: The scene.
        in_time: Whether mass counts: in statics next to no density means no weight.

    Yields:
        Name of a body or joint, by which factor it is out of range, and a sentence with a remedy.
    """
    gravity = float(np.linalg.norm(system.gravity))
    unit, meant = next(
        (
            (length / time, name)
            for name, (length, time) in _UNITS.items()
            if abs(gravity * length / time**2 / _EARTH - 1.0) < _LIKE
        ),
        (np.nan, ""),
    )
    for body in system.bodies:
        free = anywhere(body.comm, len(body.fixed) < body.num_owned)
        if not (gravity and free) or body.rigid or body.mesh is None:
            continue
        speed = _wave_speed(body)
        if not speed > 0.0:
            continue
        heights = body.reference.reshape(-1, 3)[body.places] @ (system.gravity / gravity)
        ends = np.array([heights.max(initial=-np.inf), (-heights).max(initial=-np.inf)])
        crushed = gravity * float(global_max(body.comm, ends).sum()) / speed**2 / _CRUSHED
        off, beside = max(
            (in_time * speed * unit / _FASTEST, "more"), (_SLOWEST / (speed * unit), "less")
        )
        if off > 1.0:
            yield body.name, off, (
                f"the wave speed sqrt(E/rho) of body {body.name!r} is {speed * unit:.2g} m/s if "
                f"gravity={gravity:.4g} is that of the Earth in {meant}, {beside} than any "
                f"material has: {_REMEDY}"
            )
        elif crushed > 1.0:
            yield body.name, crushed, (
                f"the weight of body {body.name!r} over its section is {_CRUSHED * crushed:.2g} "
                f"times its modulus, which no support bears: {_REMEDY}"
            )
    for joint in system.joints:
        limits = _angles(joint)
        most = max((abs(end) for end in limits if np.isfinite(end)), default=0.0)
        if most > _TURN and np.allclose(limits, np.round(limits), rtol=_WHOLE, atol=0.0):
            yield joint.name, most / _TURN, (
                f"{joint.name!r}: {limits[0]:.5g} and {limits[1]:.5g} rad are up to "
                f"{most / _TURN:.2g} turns; pass np.radians of angles in degrees"
            )


def _angles(joint: Any) -> tuple[float, ...]:
    """Limits of an angle [rad], if a joint is of such."""
    law: Any = getattr(joint, "law", None)
    if not isinstance(law, Limits) or joint.measure.kind is not Angle:
        return ()
    return law.low / joint.of.length, law.high / joint.of.length


def _wave_speed(body: Any) -> float:
    """sqrt(E/rho) of a body, from energies of stretches without change of volume. Collective."""
    mass = body.nodal_mass.reshape(-1, 3)[:, 0] * body.places
    x = body.reference.reshape(-1, 3)
    total, *moment = global_sum(body.comm, np.array([mass.sum(), *(mass @ x)]))
    arm = x - np.outer(body.places, moment) / (total or 1.0)
    stretches = (arm * (1.5 * axis - 0.5) for axis in np.eye(3))
    local = np.array([stiffness_along(body.potential, u.ravel()) for u in stretches])
    stiffness = float(global_sum(body.comm, local).max())
    return float(np.sqrt(stiffness / total)) if stiffness > 0.0 < total else 0.0
