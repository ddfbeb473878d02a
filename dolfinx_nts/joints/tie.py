"""Ties of rigid bodies to nodes of flexible ones."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.constraints import Constraints, Equations
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.coupling import Joint
from dolfinx_nts.joints.between import named
from dolfinx_nts.points import Points
from dolfinx_nts.validation import known_options


@known_options
class Tie(Joint):
    """Nodes of a flexible body that move with a rigid one: x_k - (phi + theta_ki d_i) = 0.

    Args:
        rigid: The rigid body.
        surface: `body.surface(...)` of the flexible body; its nodes are tied where they are at the
            start.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: The surface is one of a rigid body.
    """

    def __init__(self, rigid: Any, surface: Any, *, name: str | None = None) -> None:
        if not (isinstance(rigid, Body) and rigid.rigid):
            raise TypeError(f"rigid={rigid!r}: pass a RigidBody, e.g. RigidBody.from_inertia(...)")
        if not isinstance(surface, Surface):
            raise TypeError(f"surface={surface!r}: pass body.surface(...) of a flexible body")
        flexible = surface.body
        if flexible.rigid:
            raise ValueError(
                f"surface: its body {flexible.name!r} is rigid; hold it by Fixed(...), or tie a "
                "surface of a flexible body"
            )
        self.name, self.bodies = named("Tie", (rigid, flexible), name), (rigid, flexible)
        mine = surface.share
        self.numbers = surface.original[mine]
        at = surface.reference[mine]
        nodes = np.sort(surface.original).astype(np.int64)
        #: What a restart compares.
        self.settings = {
            "bodies": [rigid.name, flexible.name],
            "nodes": len(nodes),
            "which nodes": zlib.crc32(nodes.tobytes()),
        }
        self._sides: tuple[Points, ...] = (rigid.at_nodes(mine, at), surface.material.part(mine))

    def coupling(self, bodies: tuple[int, ...]) -> Constraints:
        """Its constraints in a run: one element a node, with the three components."""
        of_rigid, of_node = (side.weights for side in self._sides)
        weights = np.concatenate([-of_rigid, of_node], axis=1)
        n, k = weights.shape
        both, constants = np.zeros((n, 3, 2, k)), np.zeros((n, 3, 2, 3))
        both[:, :, 0] = weights[:, None]
        constants[:, :, 1] = np.eye(3)
        return Constraints(
            self.name, bodies, self._sides, Equations(both, constants, np.zeros((n, 3)))
        )
