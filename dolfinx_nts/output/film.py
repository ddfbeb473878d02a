"""A film of a run: the deformed bodies with their contact forces, as a GIF."""

from __future__ import annotations

import importlib
import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import basix
import numpy as np

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.ledger import contact_fields
from dolfinx_nts.output.colours import Colour
from dolfinx_nts.output.painting import Look, Painter
from dolfinx_nts.output.pictures import check_look
from dolfinx_nts.output.running import Cadence, Running
from dolfinx_nts.output.seen import Given, Seen, seen
from dolfinx_nts.output.whole_files import replace_file
from dolfinx_nts.parallel import gather_on_root, write_on_root
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import StrPath, as_path, require_bool

#: Length of the longest arrow as part of the larger side of the film; forces below this part of the
#: largest are left out.
_LONGEST, _LEAST = 0.2, 0.02
_COLOUR = "crimson"
#: Weight of a vertex that is none but for rounding.
_NONE = 1e-12
#: Dots per inch, and frames per second.
_DOTS, _PACE = 80, 15.0


class _Frame(NamedTuple):
    """What is seen at a time, on rank 0.

    Attributes:
        title: Its time, or pseudo time.
        seen: Bodies, obstacles and joints.
        places: Of vertices with contact forces [m], shape (n, 3).
        forces: There [N], shape (n, 3).
    """

    title: str
    seen: Seen
    places: FloatArray
    forces: FloatArray


class Film:
    """Writes a GIF of a run, all frames of one size and one scale of colours.

    What is in a frame is that of `pictures.picture` of a run; "pressure" is the mean of two steps.
    Arrows are contact forces on the vertices of slaves and masters, which share those of the nodes
    between them, the longest that of the largest force in the film. In dynamics with a consistent
    mass the forces of single steps alternate. The frames are kept on rank 0, 32 bytes for each
    corner of a facet, and drawn when the run ends, a second each; where it fails, the film ends
    there. A run that goes on from a checkpoint makes a
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
        width: Of what is drawn [inch], 80 dots per inch.
        units: As of `pictures.picture`.
        hide: As of `pictures.picture`; what is hidden has no arrows either.

    Raises:
        TypeError: From `start`: an item of `hide` is none.
        ValueError: An argument is out of range; from `start`: no body has a mesh, or the colour.
        OSError: On all ranks, as the run ends: the file cannot be written.
    """

    def __init__(
        self, path: StrPath, *, every: int = 1, interval: float | None = None, forces: bool = True,
        colour: Colour = "speed", view: tuple[float, float] = (22.0, -60.0),
        limits: tuple[float, float] | None = None, width: float = 5.0, units: str = "m",
        hide: Sequence[Any] = (),
    ) -> None:  # fmt: skip
        self.path = as_path("path", path)
        if self.path.suffix.lower() != ".gif":
            raise ValueError(f"path={str(path)!r}: pass a file that ends with .gif")
        self._cadence = Cadence(every, interval)
        require_bool("forces", forces)
        self.forces = forces
        self._look: tuple[Any, ...] = (colour, view, limits, width, units)
        self._hide = hide
        self._frames: list[_Frame] = []

    def start(self, stepper: Running) -> None:
        """Take the initial state."""
        check_look(Given.of("system", stepper, self._hide), *self._look)
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
        given = Given.of("system", stepper, self._hide)
        now = seen(given, self._look[0])
        found = [(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)))]
        for k, body in enumerate(given.shown if self.forces else ()):
            found += _loads(stepper, body, k)
        places, shares, names = (
            gather_on_root(stepper.system.comm, np.concatenate(a))
            for a in zip(*found, strict=True)
        )
        _, first, of = np.unique(names, axis=0, return_index=True, return_inverse=True)
        places, forces = places[first], np.zeros((len(first), 3))
        np.add.at(forces, np.ravel(of), shares)
        time = f"{stepper.state.time:.4g}"
        title = f"t = {time} s" if stepper.solution.moving else f"pseudo time {time}"
        self._frames.append(_Frame(title, now, places, forces))

    def _draw(self) -> None:
        """Paint all frames on one canvas size, and write them; rank 0 only."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        image = importlib.import_module("PIL.Image")  # matplotlib's own need
        colour, view, limits, width, units = self._look
        every = [frame.seen for frame in self._frames]
        painter = Painter(every, colour, limits, Look(view, width, units, _DOTS))
        flat = [frame.forces @ painter.turn[:, :2] for frame in self._frames]
        largest = max(np.linalg.norm(f, axis=1).max(initial=0.0) for f in flat)
        low, high = painter.ends
        metres = _LONGEST * float((high - low).max()) / largest if largest else 0.0
        images = []
        for k, (frame, forces) in enumerate(zip(self._frames, flat, strict=True)):
            figure = painter.figure(k, frame.title)
            places = frame.places @ painter.turn[:, :2]
            _arrows(figure.axes[0], places, metres * forces, _LEAST * metres * largest)
            figure.set_dpi(_DOTS)
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            images.append(image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
        file = io.BytesIO()
        images[0].save(
            file, "GIF", save_all=True, append_images=images[1:], loop=0,
            duration=1e3 / _PACE, disposal=2,
        )  # fmt: skip
        replace_file(self.path, file.getvalue())


def _loads(
    stepper: Running, body: Any, k: int
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """What this rank's nodes give the vertices of their cells of contact forces. Collective.

    Nodes of degree 2 between vertices carry most of a pressure, or all of it; each hands its force
    to those around it as a linear function does. That keeps sums, and moments where edges are
    straight.

    Args:
        stepper: The run.
        body: One of its bodies.
        k: Its number.

    Returns:
        Of each contact places [m], forces [N], and what tells the vertices apart, (n, 3) each.
    """
    if body.degree is None:
        return []
    loads = stepper.solution.contact_loads
    fields = contact_fields.at_nodes(stepper.system, stepper.state, loads, body)
    x = body.space.tabulate_dof_coordinates() + body.u.x.array.reshape(-1, 3)
    index_map, cells = body.space.dofmap.index_map, compat.cell_dofs(body.space)
    kind = getattr(basix.CellType, compat.cell_name(body.mesh))
    variant = basix.LagrangeVariant.gll_warped
    nodal, linear = (
        basix.create_element(basix.ElementFamily.P, kind, d, variant) for d in (body.degree, 1)
    )
    weights = linear.tabulate(0, nodal.points)[0, :, :, 0]
    last = np.zeros(len(x), dtype=np.int64)  # cell and place in it of each node
    last[cells.ravel()] = np.arange(cells.size)
    found = []
    names = [name for name in fields if name.startswith("contact_load_")]
    for number, load in enumerate(fields[name] for name in names):
        there = np.flatnonzero(load.any(axis=1))
        cell, own = np.divmod(last[there], cells.shape[1])
        vertices = cells[cell, : linear.dim]
        shares = weights[own][..., None] * load[there, None]
        some = weights[own] > _NONE
        ids = index_map.local_to_global(vertices[some].astype(np.int32))
        known = np.column_stack([np.full(len(ids), k), np.full(len(ids), number), ids])
        found.append((x[vertices[some]], shares[some], known.astype(float)))
    return found


def _arrows(axes: Any, places: FloatArray, ways: FloatArray, least: float) -> None:
    """Forces as arrows, right and up [m], shape (n, 2), those longer than the least."""
    shown = np.linalg.norm(ways, axis=1) > least
    if shown.any():
        (x, y), (u, v) = places[shown].T, ways[shown].T
        axes.quiver(
            x, y, u, v, angles="xy", scale_units="xy", scale=1.0, width=0.004, color=_COLOUR,
            zorder=5,
        )  # fmt: skip
