"""Cross-sections of beams, what holds their nodes, and forces on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.bodies.conditions import VectorInTime
from dolfinx_nts.validation import floats, known_options, require_positive

FloatArray = npt.NDArray[np.float64]


@known_options
@dataclass(frozen=True, kw_only=True)
class Section:
    """Stiffness and mass of a beam's cross-section, with axes 1 and 2 at right angles.

    Attributes:
        EA: Against stretch [N].
        GA: Against shear along 1 and 2 [N].
        GJ: Against twist [N m^2].
        EI: Against bending about 1 and 2 [N m^2].
        rhoA: Mass per length [kg/m].
        rhoI: Moments of inertia per length about 1 and 2, int rho x_2^2 and int rho x_1^2 [kg m].

    Raises:
        ValueError: A value is not positive and finite.
    """

    EA: float
    GA: Sequence[float]
    GJ: float
    EI: Sequence[float]
    rhoA: float
    rhoI: Sequence[float]

    def __post_init__(self) -> None:
        for name, unit in (("EA", "N"), ("GJ", "N m^2"), ("rhoA", "kg/m")):
            require_positive(name, getattr(self, name), unit)
        for name, unit in (("GA", "N"), ("EI", "N m^2"), ("rhoI", "kg m")):
            given = getattr(self, name)
            array = floats(given)
            if array.shape != (2,) or not (np.isfinite(array) & (array > 0.0)).all():
                raise ValueError(
                    f"{name}={given!r}: pass two positive, finite numbers [{unit}], of the axes 1 "
                    "and 2"
                )

    @property
    def stiffness(self) -> FloatArray:
        """GA_1, GA_2, EA, EI_1, EI_2, GJ, shape (6,)."""
        return np.array([*self.GA, self.EA, *self.EI, self.GJ], dtype=np.float64)

    @property
    def radius(self) -> float:
        """Of gyration about the axis [m]."""
        return float(np.sqrt(sum(self.rhoI) / self.rhoA))

    @property
    def masses(self) -> FloatArray:
        """Per length, of the place and of the directors times `radius` [kg/m], shape (4,)."""
        square = self.radius**2
        return np.array([self.rhoA, self.rhoI[1] / square, self.rhoI[0] / square, 0.0])


@known_options
@dataclass(frozen=True)
class Clamp:
    """Nodes of a beam that neither move nor turn.

    Attributes:
        where: Function x (3, n) -> bool (n,).
    """

    where: Any


@known_options
@dataclass(frozen=True)
class PointForce:
    """Dead force on a node of a beam.

    Attributes:
        where: Function x (3, n) -> bool (n,) that is true at one node.
        value: [N]: a vector, or a function of time.
    """

    where: Any
    value: VectorInTime
