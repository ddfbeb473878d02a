"""A scene that can be turned and zoomed, in a notebook or a window, with pyvista.

pyvista is no need of the package: `pip install "dolfinx_nts[view]"`, or pyvista of your own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.output.colours import Colour, scale_of
from dolfinx_nts.output.pictures import check_look
from dolfinx_nts.output.seen import Given, Seen, obstacle_facets, seen
from dolfinx_nts.parallel import on_root
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import known_options

_GREY, _OBSTACLE, _LINE, _MARK = "#b8b8b8", "#ededE6", "#262626", "crimson"
#: Opacity of obstacles from behind.
_CLEAR = 0.3
#: Half the length of an axis, as part of the diagonal of the scene.
_AXIS = 0.04


@known_options
def view(
    scene: Any,
    *,
    colour: Colour = "speed",
    limits: tuple[float, float] | None = None,
    units: str = "m",
    hide: Sequence[Any] = (),
) -> Any:
    """A scene as it stands, to be turned and zoomed; every rank calls it.

    What is in it is that of `pictures.picture`, whose arguments these are.

        view(run, colour="stress").show()

    Args:
        scene: A `System`, what `simulate` or `equilibrium` return, a `Stepper`, or bodies.
        colour: What bodies are coloured by.
        limits: Ends of the colour scale; None: as of `picture`.
        units: Of lengths in the scene: "m", or "mm" with stresses in MPa.
        hide: Bodies and obstacles that are left out.

    Returns:
        pyvista's Plotter on rank 0, with an actor of the name of each body, and "obstacles",
        "obstacles from behind", "lines", "points" and "axes"; None on the others.

    Raises:
        ModuleNotFoundError: pyvista is not installed.
        TypeError: As of `picture`.
        ValueError: As of `picture`.
    """
    given = Given.of("scene", scene, hide)
    check_look(given, colour, (0.0, 0.0), limits, 1.0, units)
    now = seen(given, colour)
    return on_root(given.comm, lambda: _plotter(now, colour, limits, units))


def _plotter(now: Seen, colour: Colour, limits: Any, units: str) -> Any:
    import pyvista

    values = np.concatenate([np.empty(0), *(d.values.ravel() for d in now.drawn)])
    scale = scale_of(values, colour, limits, units)
    plotter = pyvista.Plotter()
    for drawn in now.drawn:
        plotter.add_mesh(
            _facets(drawn.corners), name=drawn.name, scalars=drawn.values.ravel(),
            clim=scale.limits, cmap=scale.map, nan_color=_GREY, show_edges=True,
            scalar_bar_args={"title": scale.text}, show_scalar_bar=bool(scale.text),
        )  # fmt: skip
    ((corners, _),) = obstacle_facets([now])
    if len(corners):
        # A floor is seen from below, and so are the bodies through it.
        walls = _facets(corners)
        plotter.add_mesh(walls, name="obstacles", color=_OBSTACLE, culling="back")
        plotter.add_mesh(
            walls, name="obstacles from behind", color=_OBSTACLE, culling="front", opacity=_CLEAR
        )
    half = _AXIS * float(np.linalg.norm(np.ptp(now.points, axis=0)))
    place, along = np.moveaxis(now.sketch.axes, 1, 0)
    along = half * along / np.linalg.norm(along, axis=1, keepdims=True)
    axes = np.stack([place - along, place + along], axis=1)
    for name, lines, look in (("lines", now.sketch.lines, _LINE), ("axes", axes, _MARK)):
        if len(lines):
            mesh = pyvista.line_segments_from_points(lines.reshape(-1, 3))
            plotter.add_mesh(mesh, name=name, color=look, line_width=3)
    if len(now.sketch.points):
        plotter.add_mesh(
            pyvista.PolyData(now.sketch.points), name="points", color=_LINE, point_size=9,
            render_points_as_spheres=True,
        )  # fmt: skip
    plotter.show_axes()
    return plotter


def _facets(corners: FloatArray) -> Any:
    """Facets (m, 4, 3) with corners of their own, so that each may have its values there."""
    import pyvista

    number = np.arange(4 * len(corners)).reshape(-1, 4)
    faces = np.column_stack([np.full(len(corners), 4), number])
    return pyvista.PolyData(corners.reshape(-1, 3), faces.ravel())
