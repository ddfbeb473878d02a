"""Ties of surfaces to material points of rigid bodies and of continua."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.contact.search import closest_facets
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.constraint_elements import Equations
from dolfinx_nts.interaction.constraints import Constraints
from dolfinx_nts.interaction.coupling import Joint
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.joints.between import named, points_of
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.validation import known_options

#: Nodes lie on a surface up to this part of its largest facet; weights up to the other hold none.
_ON, _HELD = 1e-3, 1e-9


@known_options
class Tie(Joint):
    """Points of a surface that stay material points of another body: x_k - w_ka y_a = 0.

    Of a rigid body x_k - (phi + theta_ki d_i) = 0. The points of a continuum's surface are its
    nodes, those of a shell's edge, `surface(side="edge")`, its top and bottom, phi -+ D, so that
    places and directors are held: what they are tied to in a continuum keeps its distance there.
    Those of a beam's end are the corners of its section: what they are tied to keeps its shape
    there.

    Args:
        body: A rigid body, or one with cells that the points lie in, such as a continuum.
        surface: `other.surface(...)` of a flexible body; its points are tied where they are at the
            start.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: The surface is one of a rigid body or of `body`, the body is a beam or shell, a
            point lies in no cell of it, or nodes of it lie on the surface between its points.
    """

    def __init__(self, body: Any, surface: Any, *, name: str | None = None) -> None:
        if not isinstance(body, Body):
            raise TypeError(f"body={body!r}: pass a rigid body, or one that the points lie in")
        if not isinstance(surface, Surface):
            raise TypeError(f"surface={surface!r}: pass body.surface(...) of a flexible body")
        flexible = surface.body
        if body.oriented and not body.rigid:
            raise ValueError(
                f"body={body.name!r}: only nodes of a beam or shell are points of it; tie its "
                "surface to the other body, join shells by Seam(...), or fix a rigid body to a "
                "node of a beam, Fixed(rigid, beam, point=...), and tie that one"
            )
        if flexible is body:
            raise ValueError(f"surface: is one of body {body.name!r} itself; pass another body's")
        if flexible.rigid:
            raise ValueError(
                f"surface: its body {flexible.name!r} is rigid; hold it by Fixed(...), or tie a "
                "surface of a flexible body"
            )
        self.name, self.bodies = named("Tie", (body, flexible), name), (body, flexible)
        mine = surface.share
        self.numbers = surface.original[mine]
        nodes = np.sort(surface.original).astype(np.int64)
        #: What a restart compares.
        self.settings = {
            "bodies": [body.name, flexible.name],
            "nodes": len(nodes),
            "which nodes": zlib.crc32(nodes.tobytes()),
        }
        at = points_of(f"surface of {self.name!r}", body, surface.reference)
        if not body.rigid:
            _check_covered(self.name, body, surface, at)
        self._sides: tuple[Points, ...] = (at.select(mine), surface.material.select(mine))

    def coupling(self, bodies: tuple[int, ...]) -> Constraints:
        """Its constraints in a run: one element a point, with the three components."""
        of_body, of_point = (side.weights for side in self._sides)
        weights = np.concatenate([-of_body, of_point], axis=1)
        n, k = weights.shape
        both, constants = np.zeros((n, 3, 2, k)), np.zeros((n, 3, 2, 3))
        both[:, :, 0] = weights[:, None]
        constants[:, :, 1] = np.eye(3)
        return Constraints(
            self.name, bodies, self._sides, Equations(both, constants, np.zeros((n, 3)))
        )


def _check_covered(name: str, body: Any, surface: Surface, at: Points) -> None:
    """Raise a ValueError if the body has nodes on the surface that no point of it holds.

    They would go their own way there, and the body give way between the points that are held.
    """
    x = body.boundary().reference
    corners = surface.reference[surface.facets]
    size = float(fc.size(corners).max())
    on = closest_facets(x, corners, reach=_ON * size).facet >= 0
    held = at.reference[np.abs(at.weights) > _HELD]
    free = int((cKDTree(held).query(x[on])[0] > _ON * size).sum()) if on.any() else 0
    if free:
        raise ValueError(
            f"surface of {name!r}: {free} nodes of {body.name!r} lie on it between its points, "
            "which do not hold them; make the mesh of the surface finer there, or that of the body "
            "coarser, or tie the body's surface to the other body where that one has cells"
        )
