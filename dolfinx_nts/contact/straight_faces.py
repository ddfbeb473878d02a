"""Straight faces of degree 2 that may stand for a curve, as those of a mesh of straight cells."""

from __future__ import annotations

import numpy as np

from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import patches

#: Angles between neighbouring faces [rad] that a coarse mesh of a curve has. Those below change
#: forces by less than 1 %, those above are corners.
_CURVE = np.deg2rad(10.0), np.deg2rad(40.0)
#: Part of the faces that has such a neighbour, from which on the surface looks like a curve.
_MOST = 0.5
#: A face is flat whose facets' normals have a cosine between them short of one by no more.
_FLAT = 1e-6


def turn_of_straight_faces(surface: Surface) -> float:
    """Angle from one to the next of a surface's faces that are flat, of degree 2 and of a curve.

    Args:
        surface: A surface.

    Returns:
        The median [rad]; 0 where faces are curved, or most have no neighbour at such an angle.
    """
    if surface.faces is None or not len(surface.facets):
        return 0.0
    corners = surface.reference[surface.facets]
    spans = corners - corners[:, :1]
    normal = np.cross(spans, np.roll(spans, -1, axis=1)).sum(axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # The facets of one face have its nodes in common.
    _, first, face = np.unique(
        surface.faces.nodes, axis=0, return_index=True, return_inverse=True
    )
    face = face.ravel()
    if (np.einsum("ni,ni->n", normal, normal[first[face]]) < 1.0 - _FLAT).any():
        return 0.0
    across = patches.neighbours(surface.facets, corners, sharp=-np.inf)
    one, edge = np.nonzero(across >= 0)
    two = across[one, edge] // surface.facets.shape[1]
    angle = np.arccos(np.einsum("ni,ni->n", normal[one], normal[two]).clip(-1.0, 1.0))
    bent = (angle > _CURVE[0]) & (angle < _CURVE[1])
    if len(np.unique(face[one[bent]])) < _MOST * len(first):
        return 0.0
    return float(np.median(angle[bent]))
