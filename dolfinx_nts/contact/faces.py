"""Faces of degree 2 that linear facets are parts of: where their points are, and their patches.

Points of a face are linear in its nodes, so contact keeps energy and momenta as of degree 1. Taken
as its linear facets, a face would hand a uniform pressure to its nodes in other parts than its
cell: between blocks of 27-node cells that do not match, stresses err four times as much.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from dolfinx_nts.contact.linear_facets import face_points
from dolfinx_nts.kernels import facets, patches, triangle_patches
from dolfinx_nts.types import FloatArray, IntArray

#: Degree of the faces.
_DEGREE = 2


class Faces(NamedTuple):
    """Axis 0 = facet.

    Attributes:
        parts: What each corner has of the force of a uniform pressure on the facet, (m, nc).
        at: Where the corners are in the face, in steps as of `face_points`, shape (m, nc, 2).
        nodes: Points at the nodes of the face, in the order of `face_points`, shape (m, 9 or 6).
    """

    parts: FloatArray
    at: IntArray
    nodes: IntArray

    def shape(self, number: IntArray, xi: FloatArray) -> FloatArray:
        """Weights of a face's nodes in points of facets (n,) at xi (n, 2), (n, nodes)."""
        corners = self.at.shape[1]
        linear, _, _ = facets.shape(xi, corners)
        place = np.einsum("nc,ncd->nd", linear, self.at[number])
        return _powers(place, corners) @ _coefficients(corners)

    def patches(self) -> FloatArray:
        """Control points over each facet from the face's nodes, (m, 16 or 15, nodes).

        The polynomial of degree 2 is written as one of those of smooth patches.
        """
        control = _ON_TRIANGLES if self.at.shape[1] == 3 else _ON_SQUARES
        (m, k), xi = self.nodes.shape, control.xi
        number, every = np.repeat(np.arange(m), len(xi)), np.tile(xi, (m, 1))
        return np.matmul(control.from_values, self.shape(number, every).reshape(m, len(xi), k))


class _Control(NamedTuple):
    """Places (k, 2) from whose values control points follow, shape (control points, k)."""

    xi: FloatArray
    from_values: FloatArray


def _on_triangles() -> _Control:
    s = np.linspace(0.0, 1.0, 5)
    xi = np.array([(a, b) for k, a in enumerate(s) for b in s[: 5 - k]])
    return _Control(xi, np.linalg.inv(triangle_patches.shape(xi)[0]))


_ON_TRIANGLES = _on_triangles()
#: Overhauser's cubics of a polynomial of degree 2 are that itself.
_ON_SQUARES = _Control(patches.PLACES, np.eye(patches.NUM_POINTS))


def _powers(place: FloatArray, corners: int) -> FloatArray:
    """Products of powers of both coordinates in a face's polynomials, (n, 2) -> (n, terms)."""
    i, j = face_points(corners, _DEGREE).T
    return place[:, :1] ** i * place[:, 1:] ** j


@cache
def _coefficients(corners: int) -> FloatArray:
    """Of these powers in the shape functions of a face's nodes, shape (terms, nodes)."""
    return np.linalg.inv(_powers(face_points(corners, _DEGREE).astype(float), corners))
