"""A coefficient of friction that depends on the speed of slip and on the pressure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinx_nts.contact.contact_measure import Batch
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import is_finite

#: Of speeds [m/s] and pressures [Pa], arrays (n,) of floats >= 0.
FrictionFunction = Callable[[FloatArray, FloatArray], Any]

#: Part of a speed or a pressure by which a function is asked for its slopes.
_APART = float(np.finfo(float).eps) ** (1 / 3)
#: What is added to a speed or a pressure of 0.
_TINY = float(np.sqrt(np.finfo(float).tiny))
_WANTED = "; it must return positive coefficients for arrays of speed [m/s] and pressure [Pa]"


def at_rest(function: Any) -> float:
    """What a function of the user's says without slip and pressure.

    Raises:
        ValueError: It raises, or returns no positive number.
    """
    none = np.zeros(2)
    try:
        found = np.asarray(function(none, none), dtype=float).reshape(-1)
        value, _ = np.broadcast_to(found, 2).tolist()
    except Exception as error:
        raise ValueError(f"friction={function!r}: raised {error!r}{_WANTED}") from error
    if not (is_finite(value) and value > 0.0):
        raise ValueError(f"friction={function!r}: is {value!r} without slip{_WANTED}")
    return float(value)


@dataclass(frozen=True, eq=False, kw_only=True)
class SlipFriction(Batch):
    """mu of the pairs in a step.

    Attributes:
        function: The user's.
        dt: Length of the step [s]; 0 in statics, where nothing has speed.
        area: On which forces press [m^2], shape (n,).
        factor: What the step equations multiply forces by.
    """

    function: FrictionFunction
    dt: float
    area: FloatArray
    factor: float

    def of(self, distance: FloatArray, force: FloatArray) -> tuple[FloatArray, ...]:
        """mu, and its derivatives by the two.

        Args:
            distance: Slip in the step [m], shape (n,).
            force: That presses [kg m], shape (n,).

        Raises:
            ValueError: The function returns something else than positive numbers.
        """
        rate = 1.0 / self.dt if self.dt else 0.0
        to_pressure = 1.0 / (self.factor * self.area)
        speed, pressure = rate * distance, to_pressure * force.clip(min=0.0)
        ahead, more = speed * (1.0 + _APART) + _TINY, pressure * (1.0 + _APART) + _TINY
        behind, less = speed * (1.0 - _APART), pressure * (1.0 - _APART)
        v = np.concatenate([speed, ahead, behind, speed, speed])
        p = np.concatenate([pressure, pressure, pressure, more, less])
        found = np.broadcast_to(np.asarray(self.function(v, p), dtype=float), v.shape)
        if not (np.isfinite(found) & (found > 0.0)).all():
            k = int(np.argmin(np.isfinite(found) & (found > 0.0)))
            raise ValueError(
                f"friction is {found[k]:.6g} at {v[k]:.6g} m/s and {p[k]:.6g} Pa{_WANTED}"
            )
        mu, by_ahead, by_behind, by_more, by_less = np.split(found, 5)
        return (
            mu, rate * (by_ahead - by_behind) / (ahead - behind),
            to_pressure * (by_more - by_less) / (more - less),
        )  # fmt: skip
