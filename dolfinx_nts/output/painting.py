"""What is seen of a scene as a figure of matplotlib, from back to front, without a display."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.output.colours import Colour, scale_of
from dolfinx_nts.output.seen import Drawn, Seen, obstacle_facets
from dolfinx_nts.types import FloatArray

#: About how many patches bodies and obstacles are made of, for each dot per inch: more hide hidden
#: faces better.
_PATCHES = 100
#: Direction of the light in (right, up, towards the viewer).
_LIGHT = np.array([-0.35, 0.55, 0.76])
#: Colours of facets without a value, of obstacles from both sides, edges of facets, lines, points
#: and axes.
_GREY, _OBSTACLE, _BEHIND = "0.72", (0.93, 0.93, 0.9), (0.86, 0.86, 0.83)
_RIM, _LINE, _MARK = (0, 0, 0, 0.5), "0.15", "crimson"
#: Half the length of an axis, as part of the smaller side of a picture; the least part that this
#: is of the larger one; the least height of what is drawn [inch].
_AXIS, _THIN, _HEIGHT = 0.07, 0.05, 1.4


class Look(NamedTuple):
    """How all pictures of a scene are drawn.

    Attributes:
        view: Elevation above the x-y plane and azimuth from the x axis, of the viewer [degrees].
        width: Of what is drawn [inch].
        units: Of lengths.
        dots: Per inch.
    """

    view: tuple[float, float]
    width: float
    units: str
    dots: int


def axes_of(elevation: float, azimuth: float) -> FloatArray:
    """Rows: right, up and towards the viewer."""
    e, a = math.radians(elevation), math.radians(azimuth)
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    towards = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    return np.stack([right, np.cross(towards, right), towards])


class Painter:
    """Paints what is seen at several times, on one size of paper and with one scale of colours.

    Args:
        everything: What is seen, one a figure.
        colour: What bodies are coloured by.
        limits: Ends of its scale; None: those of everything.
        look: How it is drawn.

    Attributes:
        turn: From coordinates in space to those right, up and towards the viewer, shape (3, 3).
        ends: Of all that is drawn, right and up [m], two of shape (2,).
    """

    def __init__(self, everything: Sequence[Seen], colour: Colour, limits: Any, look: Look) -> None:
        self._everything, self._look = everything, look
        values = [d.values.ravel() for now in everything for d in now.drawn]
        self._scale = scale_of(np.concatenate([np.empty(0), *values]), colour, limits, look.units)
        self._obstacles = obstacle_facets(everything)
        self.turn = axes_of(*look.view).T
        points = [s.points for s in everything]
        points += [corners.reshape(-1, 3) for corners, _ in self._obstacles]
        flat = np.concatenate(points) @ self.turn[:, :2]
        low, high = flat.min(axis=0), flat.max(axis=0)
        # A line seen from aside still has a figure, and the text of the colour bar has its height.
        sides = high - low
        least = np.array([_THIN * sides[1], max(_THIN, _HEIGHT / look.width) * sides[0]])
        thin = np.maximum(least - sides, 0.0) if sides.any() else np.ones(2)
        self.ends = low - 0.5 * thin, high + 0.5 * thin

    def figure(self, k: int, title: str, labels: bool = False) -> Any:
        """A figure of the k-th, with the bodies' names if wanted."""
        from matplotlib import colormaps
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        now, scale, look = self._everything[k], self._scale, self._look
        colours = colormaps[scale.map].with_extremes(bad=_GREY)
        colours.colorbar_extend = scale.extend
        mappable = ScalarMappable(Normalize(*scale.limits), colours)
        figure, axes = _figure(self.ends, look, title)
        axes.add_collection(_shapes(now, self._obstacles[k], mappable, self.turn, look.dots))
        _mark(axes, now, self.turn)
        _furnish(figure, axes, mappable, scale.text, look, now.drawn if labels else ())
        return figure


def _cut(
    corners: FloatArray, values: FloatArray, size: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Facets cut into patches of about one size, whatever the meshes.

    Returns:
        Corners of the patches (k, 4, 3), their values (k, c), and the pieces of the facets' edges
        as flat patches (l, 4, 3).
    """
    wanted = np.linalg.norm(corners[:, 2:] - corners[:, :2], axis=2).max(axis=1) / size
    number = np.clip(np.ceil(wanted), 1, 60).astype(int)
    parts = [_divided(corners[number == n], values[number == n], n) for n in np.unique(number)]
    empty = (np.empty((0, 4, 3)), np.empty((0, *values.shape[2:])), np.empty((0, 4, 3)))
    patches, means, rims = (np.concatenate(part) for part in zip(empty, *parts, strict=True))
    return patches, means, rims


def _divided(
    corners: FloatArray, values: FloatArray, n: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Every facet into n x n patches, as `_cut` returns them."""
    line = np.linspace(0, 1, n + 1)
    s, t = np.meshgrid(line, line, indexing="ij")
    weights = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=-1)
    x = np.einsum("ijc,mcd->mijd", weights, corners)
    value = np.einsum("ijc,mc...->mij...", weights, values)

    def patches(a: FloatArray) -> FloatArray:
        parts = [a[:, :-1, :-1], a[:, 1:, :-1], a[:, 1:, 1:], a[:, :-1, 1:]]
        return np.stack(parts, axis=3).reshape(-1, 4, *a.shape[3:])

    rim = np.concatenate([x[:, :, 0], x[:, -1], x[:, :, -1], x[:, 0]])
    return patches(x), patches(value).mean(axis=1), _flat(rim[:, :-1], rim[:, 1:])


def _flat(start: FloatArray, end: FloatArray) -> FloatArray:
    """Lines as patches without area, shape (l, 4, 3)."""
    return np.stack([start, end, end, start], axis=-2).reshape(-1, 4, 3)


def _normals(x: FloatArray) -> FloatArray:
    """Unit normals of quadrilaterals (n, 4, 3), zero where degenerate."""
    normal = np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(size > 0, size, 1.0)


def _lit(rgba: FloatArray, normals: FloatArray) -> FloatArray:
    light = np.clip(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    rgba[:, :3] *= (0.7 + 0.3 * light)[:, None]
    return rgba


def _shapes(
    now: Seen, obstacles: tuple[FloatArray, FloatArray], mappable: Any, turn: FloatArray,
    dots: int,
) -> Any:
    """What faces the viewer, and lines, from back to front."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgba

    corners = np.concatenate([np.empty((0, 4, 3)), *(d.corners for d in now.drawn)]) @ turn
    values = np.concatenate([np.empty((0, 4)), *(d.values for d in now.drawn)])
    front = _normals(corners)[:, 2] > 0
    corners, values = corners[front], values[front]
    walls, normals = (a @ turn for a in obstacles)
    both = np.concatenate([corners, walls])
    diagonals = both[:, 2:] - both[:, :2]
    area = 0.5 * np.linalg.norm(np.cross(diagonals[:, 0], diagonals[:, 1]), axis=1)
    lines = now.sketch.lines @ turn
    lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    size = math.sqrt(2 * float(area.sum()) / (_PATCHES * dots)) or float(lengths.max(initial=1.0))
    x, value, rim = _cut(corners, values, size)
    wall, normal, _ = _cut(walls, np.repeat(normals[:, None], 4, axis=1), size)
    # A plane that is seen from behind hides nothing, nor does the near side of a hollow: they are
    # painted first.
    behind = normal[:, 2] <= 0
    paint = _lit(np.tile(to_rgba(_OBSTACLE), (len(wall), 1)), normal)
    paint[behind] = to_rgba(_BEHIND)
    rod, _, _ = _cut(_flat(lines[:, 0], lines[:, 1]), np.zeros((len(lines), 4)), size)
    dot = 72.0 / dots
    each: list[tuple[FloatArray, FloatArray, float, Any]] = [
        # What is drawn, its colours, widths of its lines, and how much nearer it counts: edges
        # else vanish below the patches beside them, and bodies in the floor that they stand on.
        (wall, paint, dot, np.where(behind, -np.inf, -1.0)),
        (x, _lit(mappable.to_rgba(value), _normals(x)), dot, 0.0),
        (rim, np.tile(to_rgba(_RIM), (len(rim), 1)), 0.35, 0.5),
        (rod, np.tile(to_rgba(_LINE), (len(rod), 1)), 1.3, 1.0),
    ]  # fmt: skip
    depth = np.concatenate([a[..., 2].mean(axis=1) + near * size for a, _, _, near in each])
    order = np.argsort(depth)
    shapes, rgba = (np.concatenate([part[k] for part in each])[order] for k in (0, 1))
    widths = np.concatenate([np.full(len(a), w) for a, _, w, _ in each])[order]
    return PolyCollection(shapes[..., :2], facecolors=rgba, edgecolors=rgba, linewidths=widths)


def _mark(axes: Any, now: Seen, turn: FloatArray) -> None:
    """Points and axes of joints, also of those within bodies."""
    half = _AXIS * min(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    for place, direction in now.sketch.axes:
        n = half * direction / np.linalg.norm(direction)
        ends = np.array([place - n, place + n]) @ turn
        axes.plot(*ends[:, :2].T, color=_MARK, linewidth=1.2, linestyle="-.", zorder=4)
    x = now.sketch.points @ turn[:, :2]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    there = ((x >= [left, low]) & (x <= [right, high])).all(axis=1)
    look = {"s": 16, "facecolors": "white", "edgecolors": _LINE, "linewidths": 1.0}
    axes.scatter(*x[there].T, zorder=4.5, clip_on=False, **look)


def _figure(ends: tuple[FloatArray, FloatArray], look: Look, title: str) -> tuple[Any, Any]:
    """Figure and axes of the bodies: one length unit is the same in both directions."""
    from matplotlib.figure import Figure

    (low, high), width = ends, look.width
    height = width * (high[1] - low[1]) / (high[0] - low[0])
    # Tall scenes keep their height; the rest of the figure has fixed sizes on paper [inch].
    shrink = min(1.0, 1.3 * width / height)
    width, height = shrink * width, shrink * height
    figure = Figure(figsize=(width + 1.2, height + 1.2))
    total = figure.get_size_inches()
    axes = figure.add_axes((0.1 / total[0], 0.8 / total[1], width / total[0], height / total[1]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.axis("off")
    axes.set_title(title, fontsize=11, loc="left")
    return figure, axes


def _furnish(
    figure: Any, axes: Any, mappable: Any, text: str, look: Look, named: Sequence[Drawn]
) -> None:
    """Colour bar, axes' directions, scale bar and names."""
    from matplotlib.transforms import Affine2D

    total, box = figure.get_size_inches(), axes.get_position()
    height = min(box.height, max(0.8 * box.height, 2.0 / total[1]))
    place = (box.x1 + 0.2 / total[0], box.y0 + (box.height - height) / 2, 0.14 / total[0], height)
    if text:
        bar = figure.colorbar(mappable, cax=figure.add_axes(place))
        bar.set_label(text, fontsize=9)
        bar.ax.tick_params(labelsize=8)
        bar.formatter.set_powerlimits((-2, 4))
        bar.outline.set_visible(False)

    # Not figure.dpi_scale_trans, which bbox_inches="tight" leaves behind.
    inch = Affine2D().scale(*1 / total) + figure.transFigure

    def line(start: tuple[float, float], end: tuple[float, float], **style: Any) -> None:
        axes.annotate("", end, start, inch, inch, annotation_clip=False, arrowprops=style)

    turn = axes_of(*look.view)
    for name, (x, y) in zip("xyz", 0.32 * turn[:2].T, strict=True):
        line((0.5, 0.35), (0.5 + x, 0.35 + y), arrowstyle="->", lw=0.8, shrinkA=0, shrinkB=0)
        axes.text(
            0.5 + 1.35 * x,
            0.35 + 1.35 * y,
            name,
            fontsize=8,
            ha="center",
            va="center",
            transform=inch,
        )
    metre = box.width * total[0] / float(np.diff(axes.get_xlim())[0])
    power = 10.0 ** math.floor(math.log10(1.5 / metre))
    length = max(k * power for k in (1, 2, 5) if k * power * metre <= 1.5)
    line((1.1, 0.3), (1.1 + length * metre, 0.3), arrowstyle="-", lw=1.5, shrinkA=0, shrinkB=0)
    axes.text(1.1, 0.36, f"{length:g} {look.units}", fontsize=8, transform=inch)
    there: list[FloatArray] = []
    middles = [((d.corners.reshape(-1, 3).mean(axis=0) @ turn.T)[:2], d.name) for d in named]
    for x, name in sorted(middles, key=lambda middle: middle[0][1]):
        # Names of bodies at one place stand above each other, in the bodies' order.
        while any((np.abs(metre * (x - y)) < _NAME_SIZE).all() for y in there):
            x = x + [0.0, _NAME_SIZE[1] / metre]
        there.append(x)
        axes.annotate(name, x, fontsize=9, ha="center", bbox=_NAME_BOX)


#: Room that a name takes [inch].
_NAME_SIZE = np.array([0.6, 0.2])
_NAME_BOX = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
