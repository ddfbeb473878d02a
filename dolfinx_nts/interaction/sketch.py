"""What is drawn of joints, springs and cables: lines, points and axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.kernels.vectors import triad
from dolfinx_nts.types import FloatArray


class Sketch(NamedTuple):
    """What is drawn of a thing that has no facets, the same on all ranks.

    Attributes:
        lines: Ends of straight lines [m], shape (l, 2, 3).
        points: Places that are marked [m], shape (p, 3).
        axes: A place [m] and a direction [-] each, shape (a, 2, 3); how long one is drawn is up to
            the picture.
    """

    lines: FloatArray = np.empty((0, 2, 3))
    points: FloatArray = np.empty((0, 3))
    axes: FloatArray = np.empty((0, 2, 3))


def joined(sketches: Sequence[Sketch]) -> Sketch:
    """All of them as one."""
    return Sketch(*(np.concatenate(part) for part in zip(Sketch(), *sketches, strict=True)))


def moved(held: Sequence[tuple[Any, FloatArray]], bodies: Sequence[Any], u: Any) -> FloatArray:
    """Where material points of bodies and places of the ground are [m], shape (n, 3). Collective.

    Args:
        held: One of `Points` each, or None for the ground, and the place at the start [m], (3,).
        bodies: Their bodies.
        u: Owned displacements of each of these [m].
    """
    found = []
    for side, place in held:
        if side is None:
            found.append(place)
            continue
        k = next(k for k, body in enumerate(bodies) if body is side.body)
        found.append(side.combine(side.reference + side.nodal(u[k]))[0])
    return np.array(found)


#: Of what is along a line from 0 to 1: part of the line, radius and angle, shape (l, 2, 3).
Shape = FloatArray


def _chain(corners: Any) -> Shape:
    """The straight lines from each corner to the next."""
    corners = np.array(corners, dtype=float)
    return np.stack([corners[:-1], corners[1:]], axis=1)


def _coil(turns: int, radius: float, ends: float) -> Shape:
    """A coil between straight ends."""
    part = np.linspace(0.0, 1.0, 12 * turns + 1)
    corners = np.column_stack([
        ends + (1.0 - 2.0 * ends) * part, np.full(len(part), radius), 2.0 * np.pi * turns * part
    ])  # fmt: skip
    return _chain([[0.0, 0.0, 0.0], *corners, [1.0, 0.0, 0.0]])


def _dashpot(start: float, piston: float, end: float, radius: float) -> Shape:
    """A pot that is open at its end, and a piston in it on a rod."""
    angle = np.linspace(0.0, 2.0 * np.pi, 17)

    def ring(part: float, size: float) -> Shape:
        return _chain(np.column_stack([np.full(17, part), np.full(17, size), angle]))

    walls = [[[start, radius, a], [end, radius, a]] for a in angle[:-1:4]]
    plate = [[[p, 0.0, a], [p, radius, a]] for p in (start, piston) for a in angle[:-1:4]]
    rods = [[[0.0, 0.0, 0.0], [start, 0.0, 0.0]], [[piston, 0.0, 0.0], [1.0, 0.0, 0.0]]]
    return np.concatenate([walls, plate, rods, ring(start, radius), ring(end, radius)])


STRAIGHT = _chain([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
#: Eight lines, and seven gaps as long as these.
DASHED = _chain(np.pad(np.linspace(0.0, 1.0, 16)[:, None], ((0, 0), (0, 2))))[::2]
COIL, DASHPOT = _coil(7, 0.08, 0.12), _dashpot(0.35, 0.55, 0.7, 0.06)


def along(ends: FloatArray, shape: Shape, width: float) -> FloatArray:
    """Lines of a shape between two points [m], shape (l, 2, 3).

    Args:
        ends: The points [m], shape (2, 3).
        shape: What is between them.
        width: Length that its radii are parts of [m].
    """
    way = ends[1] - ends[0]
    length = float(np.linalg.norm(way))
    if length == 0.0:
        return np.empty((0, 2, 3))
    m1, m2, _ = triad(way / length)
    part, radius, angle = np.moveaxis(shape, -1, 0)[..., None]
    aside = np.cos(angle) * m1 + np.sin(angle) * m2
    lines: FloatArray = ends[0] + part * way + width * radius * aside
    return lines
