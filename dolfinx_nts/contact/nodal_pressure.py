"""What a uniform pressure on a surface is at its nodes, and pressures from forces there.

A facet of degree 1 hands a pressure to its corners in equal parts. A face of nine nodes, four
facets here, does so by Simpson's rule: 1/36 of it to a corner, 4/36 to a middle of a side, 16/36 to
the centre. A face of six nodes has a third at each middle and nothing at its corners, which hold
the body nevertheless: there the pressure is read from the middles beside them (theory 19.6).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dolfinx_nts.kernels import facets
from dolfinx_nts.types import FloatArray


def carried_areas(surface: Any, x: FloatArray) -> FloatArray:
    """Area whose uniform pressure is the force at each point of a `Surface` [m^2], (p,).

    Args:
        surface: The surface.
        x: Where its points are [m], shape (p, 3).
    """
    corners = x[surface.facets]
    if surface.faces is None:
        return facets.tributary_areas(surface.facets, corners, len(x))
    each = facets.areas(corners)[:, None] * surface.faces.parts
    found = np.zeros(len(x))
    np.add.at(found, surface.facets, each)
    return found


def pressures(surface: Any, force: FloatArray, area: FloatArray) -> FloatArray:
    """Pressures at this rank's share of a surface's points [Pa], (share,). Collective.

    They sum up to the forces: what points without area hold is the pressure of their neighbours.

    Args:
        surface: A `Surface`.
        force: Normal forces there [N], shape (share,).
        area: Of all points, as of `carried_areas` [m^2], shape (p,).
    """
    if area.all():
        return force / area[surface.share]
    held, bare = surface.at_all(force), area == 0.0
    at = surface.facets
    # Each corner without area beside each other corner of its facet.
    one, two = (np.repeat(at, at.shape[1], axis=1).ravel(), np.tile(at, at.shape[1]).ravel())
    beside = bare[one] & ~bare[two]
    one, two = one[beside], two[beside]
    number = np.bincount(one, minlength=len(area))[one]
    held = held + np.bincount(two, held[one] / number, len(area))
    found = np.divide(held, area, out=np.zeros_like(held), where=~bare)
    found += np.bincount(one, found[two] / number, len(area))
    return found[surface.share]
