"""Everything that a step starts from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact.history import ContactHistory

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class State:
    """Everything a step starts from; never changed, a step makes a new one.

    Attributes:
        time: t [s].
        u: Owned displacements of each body [m].
        v: Owned velocities of each body [m/s].
        a: Owned accelerations of each body [m/s^2], where the integrator carries any; else empty.
        contacts: What each contact remembers of its slave nodes.
        joints: What each of `System.joints` remembers.
    """

    time: float
    u: tuple[FloatArray, ...]
    v: tuple[FloatArray, ...]
    a: tuple[FloatArray, ...]
    contacts: tuple[ContactHistory, ...]
    joints: tuple[Any, ...]
