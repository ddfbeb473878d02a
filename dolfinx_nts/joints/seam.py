"""Seams of shells: T-junctions, and folds too sharp for one mesh."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.bodies.slender.shell import Shell
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.constraint_elements import Equations
from dolfinx_nts.interaction.constraints import Constraints
from dolfinx_nts.interaction.coupling import Joint
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.joints.between import named, points_of
from dolfinx_nts.validation import known_options

FloatArray = npt.NDArray[np.float64]

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
                f"degrees at x={x}, where 20 or more tell how directors turn; make one mesh of both"
            )
        self._sides: tuple[Points, ...] = (at.select(mine), held.select(mine))
        self._scale, self._product = np.sqrt(lengths), product[mine]
        numbers = np.sort(edge.original[first] // 2).astype(np.int64)
        #: What a restart compares.
        self.settings = {
            "bodies": [shell.name, other.name],
            "nodes": len(numbers),
            "which nodes": zlib.crc32(numbers.tobytes()),
        }

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
