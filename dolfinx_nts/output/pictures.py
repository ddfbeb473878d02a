"""Pictures of a scene as it stands: deformed bodies, obstacles, joints, springs and cables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.output.colours import UNITS, Colour, check_colour
from dolfinx_nts.output.painting import Look, Painter
from dolfinx_nts.output.plots import save_figure
from dolfinx_nts.output.seen import Given, seen
from dolfinx_nts.parallel import write_on_root
from dolfinx_nts.validation import (
    StrPath,
    as_path,
    floats,
    require_bool,
    require_one_of,
    require_positive,
)

#: Per inch.
_DOTS = 200


def picture(
    scene: Any, path: StrPath, *, colour: Colour = "speed", title: str = "", labels: bool = False,
    view: tuple[float, float] = (22.0, -60.0), limits: tuple[float, float] | None = None,
    width: float = 7.0, units: str = "m", hide: Sequence[Any] = (),
) -> None:  # fmt: skip
    """Draw a scene as it stands; every rank calls it, rank 0 writes.

    Obstacles are drawn as far as the bodies reach. Points and axes of joints are drawn over the
    bodies; a cable is straight between its points, also where it is slack. Rigid bodies without a
    mesh are lines from their centres to their joints; of a beam without an outline the axis is
    drawn.

    Args:
        scene: A `System`, what `simulate` or `equilibrium` return, a `Stepper`, or a sequence of
            bodies, which are drawn alone. Bodies are in the state of `body.u`, `body.v`, obstacles
            where they are at the run's last time, or at t = 0.
        path: Picture file; its ending chooses the format.
        colour: "speed" [m/s], "stress" (von Mises of the Cauchy stress) [Pa], "pressure" of contact
            on slaves [Pa], for which the scene is a run; or a function of a body with a material
            that returns a scalar Function in cells or at nodes. Bodies without the colour are grey.
            "body": each has one of its own.
        title: Text above the picture.
        labels: Whether to write the bodies' names beside them.
        view: Elevation above the x-y plane and azimuth from the x axis, of the viewer [degrees].
        limits: Ends of the colour scale, e.g. equal ones for all pictures of a run; None: the
            percentiles 2 and 98 of values that are not zero, and zero where it occurs, symmetric
            where there are values of both signs; of "pressure" zero and the largest. The colour
            bar has a tip where values lie beyond.
        width: Of what is drawn on paper [inch]; 200 dots per inch.
        units: Of lengths in the scene: "m", or "mm" with stresses in MPa.
        hide: Bodies and obstacles of a run or a `System` that are left out, themselves or their
            names, such as a housing around a seal.

    Raises:
        TypeError: The scene is none, or has an item without a mesh; an item of `hide` is none.
        ValueError: Unknown colour, or one that no body has, no body, or an argument out of range.
        OSError: On all ranks: the file cannot be written.
    """
    given = Given.of("scene", scene, hide)
    check_look(given, colour, view, limits, width, units)
    require_bool("labels", labels)
    file = as_path("path", path)
    now = seen(given, colour)

    def draw() -> None:
        painter = Painter([now], colour, limits, Look(view, width, units, _DOTS))
        figure = painter.figure(0, title, labels)
        save_figure(figure, file, dpi=_DOTS, bbox_inches="tight", pad_inches=0.05)

    write_on_root(given.comm, f"path={str(path)!r}", draw)


def check_look(
    given: Given, colour: Any, view: Any, limits: Any, width: float, units: Any
) -> None:
    """Raise unless the arguments of `picture` fit."""
    check_colour(colour, given.bodies, given.run)
    require_one_of("units", units, UNITS)
    for name, values in (("view", view), ("limits", (0, 1) if limits is None else limits)):
        if floats(values).shape != (2,) or not np.isfinite(floats(values)).all():
            raise ValueError(f"{name}={values!r}: pass two finite numbers")
    if limits is not None and limits[0] >= limits[1]:
        raise ValueError(f"limits={limits!r}: the first must be below the second")
    require_positive("width", width, "inch")
