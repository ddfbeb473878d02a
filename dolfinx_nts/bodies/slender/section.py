"""Cross-sections of beams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import floats, is_finite, known_options, require_positive


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
        outline: For contact and pictures, corners (x_1, x_2) of a polygon about the axis [m],
            counter-clockwise, an even number, at least 6; empty: none.

    Raises:
        ValueError: A value is not positive and finite, or the outline is no such polygon.
    """

    EA: float
    GA: Sequence[float]
    GJ: float
    EI: Sequence[float]
    rhoA: float
    rhoI: Sequence[float]
    outline: Sequence[Sequence[float]] = ()

    def __post_init__(self) -> None:
        _check_outline(self.outline)
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
        """Radius of gyration about the axis [m]."""
        return float(np.sqrt(sum(self.rhoI) / self.rhoA))

    @property
    def masses(self) -> FloatArray:
        """Per length, of the place and of the directors times `radius` [kg/m], shape (4,)."""
        square = self.radius**2
        return np.array([self.rhoA, self.rhoI[1] / square, self.rhoI[0] / square, 0.0])


def _check_outline(outline: Sequence[Sequence[float]]) -> None:
    corners = floats(outline)
    if not corners.size and np.iterable(outline):
        return
    good = corners.ndim == 2 and corners.shape[1] == 2 and len(corners) in range(6, 1000, 2)
    if good and np.isfinite(corners).all():
        x, y = corners.T
        good = bool((x * np.roll(y, -1) - y * np.roll(x, -1) > 0.0).all())
    if not good:
        raise ValueError(
            f"outline={outline!r}: pass corners (x_1, x_2) [m] that run counter-clockwise around "
            "the axis, an even number of at least 6"
        )


@known_options
@dataclass(frozen=True)
class Circle:
    """Solid circular cross-section.

    Attributes:
        radius: [m].

    Raises:
        ValueError: It is not positive and finite.
    """

    radius: float

    def __post_init__(self) -> None:
        require_positive("radius", self.radius, "m")

    def section(self, *, young: float, poisson: float, density: float) -> Section:
        """Stiffness and mass of the section of one material.

        Shear is that of Cowper (1966), 6 (1 + nu) / (7 + 6 nu) of G A.

        Args:
            young: Young's modulus [Pa].
            poisson: Poisson's ratio [-].
            density: [kg/m^3].

        Raises:
            ValueError: A value is out of range.
        """
        _check(young, poisson, density)
        bending = 0.25 * np.pi * self.radius**4
        shear = 6 * (1 + poisson) / (7 + 6 * poisson)
        angle = np.pi / 6 * np.arange(12)
        outline = self.radius * np.column_stack([np.cos(angle), np.sin(angle)])
        return _section(np.pi * self.radius**2, (bending, bending), 2 * bending, shear,
                        young, poisson, density, outline)  # fmt: skip


@known_options
@dataclass(frozen=True)
class Rectangle:
    """Solid rectangular cross-section.

    Attributes:
        width: Along axis 1 [m].
        height: Along axis 2 [m].

    Raises:
        ValueError: A value is not positive and finite.
    """

    width: float
    height: float

    def __post_init__(self) -> None:
        require_positive("width", self.width, "m")
        require_positive("height", self.height, "m")

    def section(self, *, young: float, poisson: float, density: float) -> Section:
        """Stiffness and mass of the section of one material.

        Shear is that of Cowper (1966), 10 (1 + nu) / (12 + 11 nu) of G A; twist that of
        Saint-Venant, free to warp (Timoshenko and Goodier, Theory of Elasticity, section 109).

        Args:
            young: Young's modulus [Pa].
            poisson: Poisson's ratio [-].
            density: [kg/m^3].

        Raises:
            ValueError: A value is out of range.
        """
        _check(young, poisson, density)
        b, h = self.width, self.height
        long, short = max(b, h), min(b, h)
        odd = np.arange(1, 40, 2)
        series = (np.tanh(0.5 * np.pi * odd * long / short) / odd**5).sum()
        twist = long * short**3 / 3 * (1 - 192 / np.pi**5 * short / long * series)
        shear = 10 * (1 + poisson) / (12 + 11 * poisson)
        # Every second corner lies in the middle of a side.
        outline = 0.5 * np.array([b, h]) * np.array(
            [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]]
        )
        return _section(b * h, (b * h**3 / 12, h * b**3 / 12), twist, shear,
                        young, poisson, density, outline)  # fmt: skip


def _check(young: float, poisson: float, density: float) -> None:
    require_positive("young", young, "Pa")
    require_positive("density", density, "kg/m^3")
    if not (is_finite(poisson) and -1.0 < poisson <= 0.5):
        raise ValueError(f"poisson={poisson!r}: must lie above -1 and not above 0.5")


def _section(
    area: float, second: tuple[float, float], twist: float, shear: float,
    young: float, poisson: float, density: float, outline: FloatArray,
) -> Section:  # fmt: skip
    """A section of one material; `second` moments about the axes 1 and 2 [m^4], `twist` [m^4].

    Of `shear` the part of G A that resists shear; `outline` [m], shape (k, 2).
    """
    modulus = young / (2 * (1 + poisson))
    return Section(
        EA=young * area,
        GA=(shear * modulus * area,) * 2,
        GJ=modulus * twist,
        EI=(young * second[0], young * second[1]),
        rhoA=density * area,
        rhoI=(density * second[0], density * second[1]),
        outline=tuple(map(tuple, outline.tolist())),
    )
