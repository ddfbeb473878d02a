"""Ties of surfaces to material points of rigid bodies and of continua."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.constraints import Constraints, Equations
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.coupling import Joint
from dolfinx_nts.joints.between import named, points_of
from dolfinx_nts.points import Points
from dolfinx_nts.validation import known_options


@known_options
class Tie(Joint):
    """Points of a surface that stay material points of another body: x_k - w_ka y_a = 0.

    Of a rigid body x_k - (phi + theta_ki d_i) = 0. The points of a continuum's surface are its
    nodes, those of a shell's edge, `surface(side="edge")`, its top and bottom, phi -+ D, so that
    places and directors are held: what they are tied to in a continuum keeps its distance there.
    Those of a beam's end are the corners of its section, which what they are tied to follows.

    Args:
        body: A rigid body, or one with cells that the points lie in, such as a continuum.
        surface: `other.surface(...)` of a flexible body; its points are tied where they are at the
            start.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: The surface is one of a rigid body or of `body`, the body is a beam or shell, or
            a point lies in no cell of it.
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
        self._sides: tuple[Points, ...] = (at.part(mine), surface.material.part(mine))

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
