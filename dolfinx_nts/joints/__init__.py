"""Joints between rigid bodies, points of flexible ones, and the ground (theory section 13).

Each is a few constraints v . w = c in vectors that are linear in the bodies' coordinates: material
directions, differences of material points, fixed directions. All are lengths [m].
"""

from dolfinx_nts.joints.kinds import (
    Cylindrical,
    Distance,
    Fixed,
    Planar,
    Prismatic,
    Revolute,
    Spherical,
    Universal,
)
from dolfinx_nts.joints.tie import Seam, Tie

__all__ = [
    "Cylindrical",
    "Distance",
    "Fixed",
    "Planar",
    "Prismatic",
    "Revolute",
    "Seam",
    "Spherical",
    "Tie",
    "Universal",
]
