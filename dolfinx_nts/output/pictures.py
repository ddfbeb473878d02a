"""Pictures of the deformed bodies, coloured by speed or stress, without a display."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.slender.director_body import DirectorBody
from dolfinx_nts.bodies.solid.stress import von_mises
from dolfinx_nts.contact.linear_facets import body_facets, node_places
from dolfinx_nts.output.plots import save_figure
from dolfinx_nts.parallel import gather_on_root, write_on_root
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import (
    StrPath,
    as_path,
    floats,
    items,
    require_bool,
    require_one_of,
    require_positive,
)


def picture(
    bodies: Sequence[Any],
    path: StrPath,
    *,
    colour: str = "speed",
    title: str = "",
    labels: bool = False,
    view: tuple[float, float] = (22.0, -60.0),
    limits: tuple[float, float] | None = None,
    width: float = 7.0,
) -> None:
    """Draw the boundary of the deformed bodies; every rank calls it, rank 0 writes.

    Args:
        bodies: Continua and rigid bodies, in the state of `body.u`, `body.v`; beams and shells, of
            which the skin is drawn.
        path: Picture file; its ending chooses the format.
        colour: "speed" [m/s] or "stress" (von Mises of the Cauchy stress) [Pa].
        title: Text above the picture.
        labels: Whether to write the bodies' names beside them.
        view: Elevation above the x-y plane and azimuth from the x axis, of the viewer [degrees].
        limits: Ends of the colour scale, e.g. equal ones for all pictures of a run.
        width: Of the bodies on paper [inch]; 200 dots per inch.

    Raises:
        TypeError: A body without a mesh.
        ValueError: Unknown colour, or one that a body has not, no body, one without a skin, or an
            argument out of range.
        OSError: On all ranks: the file cannot be written.
    """
    bodies = items("bodies", bodies, _has_mesh, "Continuum bodies")
    check_picture(bodies, colour, view, limits, width)
    require_bool("labels", labels)
    file = as_path("path", path)
    drawn = seen(bodies, colour, view)

    def draw() -> None:
        scale = colour_scale(drawn, colour, limits)
        figure = painted(drawn, scale, bounds(drawn), colour, view, width, title, labels)
        save_figure(figure, file, dpi=200, bbox_inches="tight", pad_inches=0.05)

    write_on_root(bodies[0].comm, f"path={str(path)!r}", draw)


def _has_mesh(body: Any) -> bool:
    return isinstance(body, Body) and body.mesh is not None


def check_picture(bodies: Sequence[Any], colour: str, view: Any, limits: Any, width: float) -> None:
    """Raise unless the arguments of `picture` fit."""
    require_one_of("colour", colour, _COLOURS)
    if not bodies:
        raise ValueError(f"bodies={bodies!r}: pass at least one")
    for name, values in (("view", view), ("limits", (0, 1) if limits is None else limits)):
        if floats(values).shape != (2,) or not np.isfinite(floats(values)).all():
            raise ValueError(f"{name}={values!r}: pass two finite numbers")
    if limits is not None and limits[0] >= limits[1]:
        raise ValueError(f"limits={limits!r}: the first must be below the second")
    require_positive("width", width, "inch")
    for body in bodies:
        thin = isinstance(body, DirectorBody)
        if thin and colour != "speed":
            raise ValueError(
                f"colour={colour!r}: {body.kind} {body.name!r} has none; colour by 'speed', or see "
                "its resultants()"
            )
        if colour != "speed" and body.law is None:
            raise ValueError(
                f"colour={colour!r}: body {body.name!r} has no material; colour by 'speed', or "
                "leave it out"
            )
        if not (body.has_skin if thin else body.mesh.topology.dim == 3):
            raise ValueError(f"bodies: {body.name!r} has no volume; leave it out")


class Drawn(NamedTuple):
    """Facets of a body as the viewer sees them.

    Attributes:
        name: Of the body.
        corners: Coordinates right, up and towards the viewer [m], shape (m, 4, 3).
        values: What is coloured, at the corners, shape (m, 4).
    """

    name: str
    corners: FloatArray
    values: FloatArray


def seen(bodies: Sequence[Any], colour: str, view: tuple[float, float]) -> list[Drawn]:
    """What a viewer sees of bodies as they stand, on rank 0; as of `picture`. Collective."""
    drawn = []
    for body in bodies:
        corners, values = _coloured_facets(body, colour)
        corners = corners @ axes_of(*view).T
        drawn.append(
            Drawn(body.name, gather_on_root(body.comm, corners), gather_on_root(body.comm, values))
        )
    return drawn


def painted(
    drawn: Sequence[Drawn],
    scale: Any,
    ends: tuple[FloatArray, FloatArray],
    colour: str,
    view: tuple[float, float],
    width: float,
    title: str,
    labels: bool,
) -> Any:
    """A figure of what is seen; of the same `ends` (`bounds`) and width it has the same size."""
    figure, axes = _figure(ends, width, title)
    axes.add_collection(_shapes(drawn, scale))
    _furnish(figure, axes, scale, _COLOURS[colour][1], view, drawn if labels else ())
    return figure


_COLOURS = {"speed": ("viridis", "speed [m/s]"), "stress": ("plasma", "von Mises stress [Pa]")}


def _coloured_facets(body: Any, colour: str) -> tuple[FloatArray, FloatArray]:
    """This rank's boundary facets.

    Returns:
        Deformed corners [m], shape (m, 4, 3), a triangle's last one twice, and the values there,
        shape (m, 4).
    """
    if isinstance(body, DirectorBody):
        return _skin(body)
    mesh, local = body.mesh, compat.exterior_facets(body.mesh)
    blocks = body_facets(body, local).corners[:, [0, 1, 2, -1]]
    corners = node_places(body)[blocks] + body.u.x.array.reshape(-1, 3)[blocks]
    if colour == "speed":
        return corners, np.linalg.norm(body.v.x.array.reshape(-1, 3)[blocks], axis=-1)
    stress = von_mises(body, at="cells")
    to_cell = mesh.topology.connectivity(2, 3)
    cells = np.array([to_cell.links(f)[0] for f in local], dtype=np.int64)
    dofs = compat.cell_dofs(stress.function_space)
    value = stress.x.array[dofs[cells, 0]] if len(cells) else np.empty(0)
    of_facets = np.repeat(value, len(corners) // max(len(cells), 1))
    return corners, np.tile(of_facets[:, None], 4)


def _skin(body: DirectorBody) -> tuple[FloatArray, FloatArray]:
    """This rank's part of a skin, deformed corners [m], (m, 4, 3), and the speed there, (m, 4)."""
    skin, (u, v) = body.boundary(), body.last_accepted()
    speed = np.linalg.norm(skin.gather(v), axis=1)
    mine = skin.facets[body.comm.rank :: body.comm.size]
    return skin.positions(u)[mine], speed[mine]


def axes_of(elevation: float, azimuth: float) -> FloatArray:
    """Rows: right, up and towards the viewer."""
    e, a = math.radians(elevation), math.radians(azimuth)
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    towards = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    return np.stack([right, np.cross(towards, right), towards])


#: About how many patches a picture is made of: more hide hidden faces better.
_PATCHES = 20000
#: Direction of the light in (right, up, towards the viewer).
_LIGHT = np.array([-0.35, 0.55, 0.76])


def _patches(corners: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Facets cut into patches of about one size, whatever the meshes.

    Returns:
        Corners of the patches (k, 4, 3), their values (k,), and the pieces of the facets' edges as
        flat patches (l, 4, 3).
    """
    diagonals = corners[:, 2:] - corners[:, :2]
    area = 0.5 * np.linalg.norm(np.cross(diagonals[:, 0], diagonals[:, 1]), axis=1)
    wanted = np.linalg.norm(diagonals, axis=2).max(axis=1) / np.sqrt(2 * area.sum() / _PATCHES)
    number = np.clip(np.ceil(wanted), 1, 60).astype(int)
    parts = [_cut(corners[number == n], values[number == n], n) for n in np.unique(number)]
    patches, means, rims = (np.concatenate(part) for part in zip(*parts, strict=True))
    return patches, means, rims


def _cut(
    corners: FloatArray, values: FloatArray, n: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Every facet into n x n patches, as `_patches` returns them."""
    line = np.linspace(0, 1, n + 1)
    s, t = np.meshgrid(line, line, indexing="ij")
    weights = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=-1)
    x = np.einsum("ijc,mcd->mijd", weights, corners)
    value = np.einsum("ijc,mc->mij", weights, values)

    def patches(a: FloatArray) -> FloatArray:
        parts = [a[:, :-1, :-1], a[:, 1:, :-1], a[:, 1:, 1:], a[:, :-1, 1:]]
        return np.stack(parts, axis=3).reshape(-1, 4, *a.shape[3:])

    rim = np.concatenate([x[:, :, 0], x[:, -1], x[:, :, -1], x[:, 0]])
    pieces = np.stack([rim[:, :-1], rim[:, 1:], rim[:, 1:], rim[:, :-1]], axis=2)
    return patches(x), patches(value).mean(axis=1), pieces.reshape(-1, 4, 3)


def _normals(x: FloatArray) -> FloatArray:
    """Unit normals of quadrilaterals (n, 4, 3), zero where degenerate."""
    normal = np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(size > 0, size, 1.0)


def colour_scale(drawn: Sequence[Drawn], colour: str, limits: Any) -> Any:
    """Colours of what is seen, between given limits or its own."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    values = np.concatenate([d.values for d in drawn])
    low, high = (values.min(), values.max()) if limits is None else limits
    if limits is None and high - low <= 1e-9 * high:
        # A constant field would otherwise show its rounding errors.
        low, high = 0.0, 1.1 * high or 1.0
    return ScalarMappable(Normalize(low, high), colormaps[_COLOURS[colour][0]])


def _shapes(drawn: Sequence[Drawn], scale: Any) -> Any:
    """Return what faces the viewer, from back to front."""
    from matplotlib.collections import PolyCollection

    corners, values = (np.concatenate([d[k] for d in drawn]) for k in (1, 2))
    front = _normals(corners)[:, 2] > 0
    x, value, rim = _patches(corners[front], values[front])
    light = np.clip(_normals(x) @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    rgba = scale.to_rgba(value)
    rgba[:, :3] *= (0.7 + 0.3 * light)[:, None]
    rgba = np.concatenate([rgba, np.tile([0.0, 0.0, 0.0, 0.5], (len(rim), 1))])
    # Edges count as a little nearer than they are, else the patches beside them cover them.
    size = np.linalg.norm(np.ptp(x, axis=1), axis=1).mean()
    depth = np.concatenate([x[..., 2].mean(axis=1), rim[..., 2].mean(axis=1) + 0.5 * size])
    order = np.argsort(depth)
    shapes = np.concatenate([x, rim])[order, :, :2]
    return PolyCollection(shapes, facecolors=rgba[order], edgecolors=rgba[order], linewidths=0.35)


def bounds(drawn: Sequence[Drawn]) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest coordinates right and up of what is seen [m], shape (2,) each."""
    points = np.concatenate([d.corners for d in drawn])[..., :2].reshape(-1, 2)
    return points.min(axis=0), points.max(axis=0)


def _figure(ends: tuple[FloatArray, FloatArray], width: float, title: str) -> tuple[Any, Any]:
    """Figure and axes of the bodies: one length unit is the same in both directions."""
    from matplotlib.figure import Figure

    low, high = ends
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
    figure: Any,
    axes: Any,
    scale: Any,
    text: str,
    view: tuple[float, float],
    named: Sequence[Drawn],
) -> None:
    """Colour bar, axes' directions, scale bar and names."""
    from matplotlib.transforms import Affine2D

    total, box = figure.get_size_inches(), axes.get_position()
    height = min(box.height, max(0.8 * box.height, 2.0 / total[1]))
    place = (box.x1 + 0.2 / total[0], box.y0 + (box.height - height) / 2, 0.14 / total[0], height)
    bar = figure.colorbar(scale, cax=figure.add_axes(place))
    bar.set_label(text, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.formatter.set_powerlimits((-2, 4))
    bar.outline.set_visible(False)

    # Not figure.dpi_scale_trans, which bbox_inches="tight" leaves behind.
    inch = Affine2D().scale(*1 / total) + figure.transFigure

    def line(start: tuple[float, float], end: tuple[float, float], **look: Any) -> None:
        axes.annotate("", end, start, inch, inch, annotation_clip=False, arrowprops=look)

    for name, (x, y) in zip("xyz", 0.32 * axes_of(*view)[:2].T, strict=True):
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
    axes.text(1.1, 0.36, f"{length:g} m", fontsize=8, transform=inch)
    for body in named:
        x, y = body.corners[..., :2].reshape(-1, 2).mean(axis=0)
        axes.annotate(body.name, (x, y), fontsize=9, ha="center", bbox=_NAME_BOX)


_NAME_BOX = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
