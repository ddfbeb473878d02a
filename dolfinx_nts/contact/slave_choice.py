"""Which of two surfaces should be the slave: the finer one, and of two alike the softer one."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.contact.obstacles import Obstacle
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import facets as facet_math
from dolfinx_nts.types import BoolArray, FloatArray

#: Surfaces are alike where their node spacings or stiffnesses differ by less than this part.
_ALIKE = 0.1
#: The contact zone reaches this many facets of the larger size beyond the smallest distance.
_ZONE = 1.0


def slave_and_master(a: Any, b: Any) -> tuple[Any, Any]:
    """Two surfaces, or a surface and an obstacle, in the order slave, master. Collective.

    Nodes of the slave are kept out of facets of the master, but not the other way round, so the
    surface with more nodes leaves the other one less room to enter. In this order:

    1. an obstacle is the master;
    2. a rigid body is the master of one that is not;
    3. the slave is the surface whose nodes are closer together: the square root of the area per
       node, of the facets that are near to the other surface in the reference;
    4. spacings within 10 % are alike: the slave is the softer one, by the mean nodal stiffness
       there;
    5. stiffnesses within 10 % are alike, too: the slave is the first one.

    Raises:
        TypeError: One of them is of no known kind, or both are obstacles.
    """
    for name, given in (("a", a), ("b", b)):
        if not isinstance(given, Surface | Obstacle):
            raise TypeError(
                f"{name}={given!r}: pass a Surface, e.g. body.surface(marker), or a Plane, Sphere "
                "or Cylinder"
            )
    if isinstance(a, Obstacle) and isinstance(b, Obstacle):
        raise TypeError(
            f"a={a!r}, b={b!r}: both are obstacles; pass the surface of a body, e.g. "
            "body.surface(marker), as one of them"
        )
    if isinstance(a, Obstacle) or isinstance(b, Obstacle):
        return (b, a) if isinstance(a, Obstacle) else (a, b)
    rigid = [s.body.rigid for s in (a, b)]
    if rigid[0] != rigid[1]:
        return (b, a) if rigid[0] else (a, b)
    zones = _zones(a, b)
    first = _smaller(*(_spacing(s, zone) for s, zone in zip((a, b), zones, strict=True)))
    if first is None and not any(rigid):
        first = _smaller(*(_stiffness(s, zone) for s, zone in zip((a, b), zones, strict=True)))
    return (b, a) if first is False else (a, b)


def _smaller(one: float, two: float) -> bool | None:
    """Return whether the first number is the smaller one; None where they are alike."""
    if abs(one - two) <= _ALIKE * max(one, two):
        return None
    return one < two


def _zones(a: Surface, b: Surface) -> tuple[BoolArray, BoolArray]:
    """Facets of both, shape (m,), with a node that is about as near to the other as any."""
    largest = max(float(_sizes(s).max()) for s in (a, b))
    zones = []
    for own, other in ((a, b), (b, a)):
        distance, _ = cKDTree(other.reference).query(own.reference)
        near = distance <= distance.min() + _ZONE * largest
        zones.append(near[own.facets].any(axis=1))
    return zones[0], zones[1]


def _sizes(surface: Surface) -> FloatArray:
    return facet_math.size(surface.reference[surface.facets])


def _spacing(surface: Surface, zone: BoolArray) -> float:
    """Square root of the area per node of some facets [m]."""
    area = facet_math.areas(surface.reference[surface.facets[zone]])
    # Inside a surface a node has four quadrilaterals, but six triangles.
    per_node = {3: 2.0, 4: 1.0}[surface.facets.shape[1]]
    return float(np.sqrt(per_node * area.mean()))


def _stiffness(surface: Surface, zone: BoolArray) -> float:
    """Mean nodal stiffness of the nodes of some facets [N/m]. Collective."""
    values = surface.material.divided(surface.body.nodal_stiffness())
    return float(values[np.unique(surface.facets[zone])].mean())
