"""Ties of surfaces to bodies, and seams of shells."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.slender.shell import Shell
from dolfinx_nts.contact.search import closest_facets
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.constraint_elements import Equations
from dolfinx_nts.interaction.constraints import Constraints
from dolfinx_nts.interaction.coupling import Joint
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.joints.between import named, points_of
from dolfinx_nts.kernels import facets as fc
from dolfinx_nts.types import IntArray, Settings
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
        self.settings = _settings(self.bodies, surface.original)
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


def _settings(bodies: Sequence[Body], numbers: IntArray) -> Settings:
    """What a restart compares: names of bodies, and input numbers of nodes."""
    nodes = np.sort(numbers).astype(np.int64)
    return {
        "bodies": [body.name for body in bodies],
        "nodes": len(nodes),
        "which nodes": zlib.crc32(nodes.tobytes()),
    }


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


#: Sine of the angle between directors below which their product hardly says how they turn.
_SHARP = np.sin(np.deg2rad(20.0))


@known_options
class Seam(Joint):
    """The edge of a shell along nodes of another one: T-junctions, and corners.

    At each node of the edge phi_A - phi_B = 0 and D_A . D_B is constant, so that the angle between
    both shells stays; a director does not feel what else a rotation has there.

    Args:
        shell: A shell.
        edge: `other.surface(where, side="edge")` of another one, whose nodes lie at nodes of
            `shell`.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: The surface is no edge, or one of `shell`, a node of it lies at no node of
            `shell`, or both meet at less than 20 degrees.
    """

    def __init__(self, shell: Any, edge: Any, *, name: str | None = None) -> None:
        if not isinstance(shell, Shell):
            raise TypeError(f"shell={shell!r}: pass a Shell; Tie(...) holds edges to other bodies")
        if not (isinstance(edge, Surface) and isinstance(edge.body, Shell)):
            raise TypeError(f'edge={edge!r}: pass other.surface(where, side="edge") of a shell')
        other = edge.body
        if other is shell:
            raise ValueError(f"edge: is one of shell {shell.name!r} itself; pass another shell's")
        corners = np.sort(edge.material.nodes[edge.facets, 0], axis=1)
        if ((corners[:, 1:] > corners[:, :-1]).sum(axis=1) != 1).any():
            raise ValueError(
                f"edge: is the top or the bottom of shell {other.name!r}; pass "
                'other.surface(where, side="edge")'
            )
        self.name, self.bodies = named("Seam", (shell, other), name), (shell, other)
        # The top and the bottom of a node depend on the same vectors.
        nodes, first = np.unique(edge.material.nodes[:, 0], return_index=True)
        mine = np.flatnonzero(np.arange(len(nodes)) % shell.comm.size == shell.comm.rank)
        self.numbers = edge.original[first][mine] // 2
        held = edge.material.select(first)
        at = points_of(f"edge of {self.name!r}", shell, held.reference[:, 0])
        product = np.einsum("ni,ni->n", at.reference[:, 1], held.reference[:, 1])
        lengths = shell.length * other.length
        sine = np.sqrt(np.maximum(1.0 - (product / lengths) ** 2, 0.0))
        if sine.min() < _SHARP:
            x = held.reference[sine.argmin(), 0].tolist()
            raise ValueError(
                f"edge: meets shell {shell.name!r} at {np.rad2deg(np.arcsin(sine.min())):.3g} "
                f"degrees at x={x}, and a seam needs 20 or more; make one mesh of both"
            )
        self._sides: tuple[Points, ...] = (at.select(mine), held.select(mine))
        self._scale, self._product = np.sqrt(lengths), product[mine]
        self.settings = _settings(self.bodies, edge.original[first] // 2)

    def coupling(self, bodies: tuple[int, ...]) -> Constraints:
        """Its constraints in a run: one element a node, places and then the angle."""
        n = len(self._product)
        weights, constants, value = np.zeros((n, 4, 2, 4)), np.zeros((n, 4, 2, 3)), np.zeros((n, 4))
        # The vectors of a node: phi_A, D_A, phi_B, D_B.
        weights[:, :3, 0, [0, 2]] = 1.0, -1.0
        constants[:, :3, 1] = np.eye(3)
        weights[:, 3, 0, 1] = 1.0 / self._scale
        weights[:, 3, 1, 3] = 1.0
        value[:, 3] = self._product / self._scale
        return Constraints(
            self.name, bodies, self._sides, Equations(weights, constants, value)
        )
