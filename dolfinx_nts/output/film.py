"""A film of a run: the deformed bodies with their contact forces, as a GIF."""

from __future__ import annotations

import importlib
import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.ledger import contact_fields
from dolfinx_nts.output.pictures import (
    Drawn,
    axes_of,
    bounds,
    check_picture,
    colour_scale,
    painted,
    seen,
)
from dolfinx_nts.output.running import Cadence, Running
from dolfinx_nts.output.whole_files import replace_file
from dolfinx_nts.parallel import gather_on_root, write_on_root
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import StrPath, as_path, require_bool

#: Length of the longest arrow as part of the larger side of the film; forces below this part of the
#: largest are left out.
_LONGEST, _LEAST = 0.2, 0.02
_COLOUR = "crimson"
#: Frames per second.
_PACE = 15.0


class _Frame(NamedTuple):
    """What is seen at a time, on rank 0.

    Attributes:
        time: [s].
        drawn: Facets of the bodies.
        places: Of nodes with contact forces, right and up [m], shape (n, 2).
        forces: There, right and up [N], shape (n, 2).
    """

    time: float
    drawn: list[Drawn]
    places: FloatArray
    forces: FloatArray


class Film:
    """Writes a GIF of a run, all frames of one size and one scale of colours.

    Arrows are contact forces on the nodes of slaves and masters, the longest that of the largest
    force in the film. In dynamics with a consistent mass the forces of single steps alternate. The
    frames are kept on rank 0, 50 bytes for each corner of a facet, and drawn when the run ends, a
    second each; where it fails, the film ends there. A run that goes on from a checkpoint makes a
    film of what follows alone, so give it a path of its own.

    Args:
        path: File, whose ending is .gif; its folder is made if missing.
        every: A frame after every `every`-th step, >= 1; the first and the last state are in it.
        interval: Instead of `every`: a frame after the first step that reaches each multiple of
            this time [s].
        forces: Whether to draw contact forces.
        colour: As of `pictures.picture`, as are the next ones.
        view: Elevation and azimuth of the viewer [degrees].
        limits: Ends of the colour scale; None: those of the film.
        width: Of the bodies [inch], 80 dots per inch.

    Raises:
        ValueError: An argument is out of range; from `start`: no body has a mesh, or one no colour.
        OSError: On all ranks, as the run ends: the file cannot be written.
    """

    def __init__(
        self,
        path: StrPath,
        *,
        every: int = 1,
        interval: float | None = None,
        forces: bool = True,
        colour: str = "speed",
        view: tuple[float, float] = (22.0, -60.0),
        limits: tuple[float, float] | None = None,
        width: float = 5.0,
    ) -> None:
        self.path = as_path("path", path)
        if self.path.suffix.lower() != ".gif":
            raise ValueError(f"path={str(path)!r}: pass a file that ends with .gif")
        self._cadence = Cadence(every, interval)
        require_bool("forces", forces)
        self.forces = forces
        self._look: tuple[Any, ...] = (colour, view, limits, width)
        self._frames: list[_Frame] = []

    def start(self, stepper: Running) -> None:
        """Take the initial state."""
        self._bodies = [b for b in stepper.system.bodies if b.mesh is not None]
        check_picture(self._bodies, *self._look)
        self._frames = []
        self._cadence.start(stepper)
        self._take(stepper)

    def write(self, stepper: Running, *, last: bool = False) -> None:
        """Take the accepted state if it is due, or the last."""
        if self._cadence.due(stepper) or last:
            self._take(stepper)

    def close(self, stepper: Running) -> None:
        """Draw the frames and write the file."""
        if self._frames:
            what = f"path={str(self.path)!r}"
            write_on_root(stepper.system.comm, what, self._draw)
            self._frames = []

    def _take(self, stepper: Running) -> None:
        """Keep what is seen now. Collective."""
        colour, view, _, _ = self._look
        drawn, axes = seen(self._bodies, colour, view), axes_of(*view)[:2]
        found = [(np.empty((0, 3)), np.empty((0, 3)))]
        for body in self._bodies if self.forces else ():
            found += _loads(stepper, body)
        places, forces = (
            gather_on_root(stepper.system.comm, np.concatenate(a)) @ axes.T
            for a in zip(*found, strict=True)
        )
        self._frames.append(_Frame(stepper.state.time, drawn, places, forces))

    def _draw(self) -> None:
        """Paint all frames on one canvas size, and write them; rank 0 only."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        image = importlib.import_module("PIL.Image")  # matplotlib's own need
        colour, view, limits, width = self._look
        every = [d for frame in self._frames for d in frame.drawn]
        scale, ends = colour_scale(every, colour, limits), bounds(every)
        largest = max(np.linalg.norm(f.forces, axis=1).max(initial=0.0) for f in self._frames)
        metres = _LONGEST * float(np.max(ends[1] - ends[0])) / largest if largest else 0.0
        images = []
        for frame in self._frames:
            title = f"t = {frame.time:.4g} s"
            figure = painted(frame.drawn, scale, ends, colour, view, width, title, False)
            _arrows(figure.axes[0], frame, metres, _LEAST * largest)
            figure.set_dpi(80)
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            images.append(image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
        file = io.BytesIO()
        images[0].save(
            file, "GIF", save_all=True, append_images=images[1:], loop=0,
            duration=1e3 / _PACE, disposal=2,
        )  # fmt: skip
        replace_file(self.path, file.getvalue())


def _loads(stepper: Running, body: Any) -> Sequence[tuple[FloatArray, FloatArray]]:
    """Places [m] and contact forces [N] of this rank's nodes, (n, 3) each. Collective."""
    if body.degree is None:
        return []
    loads = stepper.solution.contact_loads
    fields = contact_fields.at_nodes(stepper.system, stepper.state, loads, body)
    owned = body.space.dofmap.index_map.size_local
    x = body.space.tabulate_dof_coordinates()[:owned]
    x = x + body.u.x.array[: 3 * owned].reshape(-1, 3)
    found = [values for name, values in fields.items() if name.startswith("contact_load_")]
    return [(x[load.any(axis=1)], load[load.any(axis=1)]) for load in found]


def _arrows(axes: Any, frame: _Frame, metres: float, least: float) -> None:
    """Forces as arrows, `metres` [m/N] long."""
    shown = np.linalg.norm(frame.forces, axis=1) > least
    if shown.any():
        (x, y), (u, v) = frame.places[shown].T, metres * frame.forces[shown].T
        axes.quiver(
            x, y, u, v, angles="xy", scale_units="xy", scale=1.0, width=0.004, color=_COLOUR,
            zorder=5,
        )  # fmt: skip
