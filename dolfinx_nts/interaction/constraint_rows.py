"""What elements of constraints are made of, which a step chooses from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.interaction.constraint_elements import Equations
from dolfinx_nts.interaction.points import Points, joined_sides
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: From nodal vectors at the end of a step (n, k, 3) and the times of both its ends [s].
Upright = Callable[[FloatArray, tuple[float, ...]], FloatArray]


class Arm(NamedTuple):
    """Vectors w_a y_a + constant, of each element.

    Attributes:
        weights: w_a, shape (n, k).
        constant: Shape (n, 3).
    """

    weights: FloatArray
    constant: FloatArray

    def at(self, y: FloatArray) -> FloatArray:
        """Their values from nodal vectors (n, k, 3), shape (n, 3)."""
        return np.einsum("nk,nki->ni", self.weights, y) + self.constant


@dataclass(frozen=True, eq=False)
class ConstraintRows:
    """The elements of this rank; axis 0 = element.

    Attributes:
        sides: Of each body, or of a batch of bodies, the nodes of the elements.
        equations: Their coefficients.
        upright: See `Constraints`; of equations, their values are what is positive.
        arm: See `Constraints`.
        lent: As of `ConstraintElements`, (n,).
        joint: Number of each element's joint, (n,).
        bodies: Numbers of the bodies of each element in the system, shape (n, sides).
        force: Multipliers of the last step, shape (n, m).
        scale: As of `ConstraintElements`, shape (n,), once it is known.
    """

    sides: tuple[Points, ...]
    equations: Equations
    upright: Upright | Equations | None
    arm: Arm | None
    lent: FloatArray
    joint: IntArray
    bodies: IntArray
    force: FloatArray
    scale: FloatArray

    def select(self, chosen: BoolArray) -> ConstraintRows:
        """Return some of them. Collective."""
        def some(given: Any) -> Any:
            if isinstance(given, tuple):
                return type(given)(*(a[chosen] for a in given))
            return given[chosen] if isinstance(given, np.ndarray) else given

        sides = tuple(side.select(chosen) for side in self.sides)
        others = {f.name: some(getattr(self, f.name)) for f in fields(self) if f.name != "sides"}
        return ConstraintRows(sides, **others)


def joined(
    each: Sequence[ConstraintRows], of: Sequence[tuple[int, ...]], batch: Any
) -> ConstraintRows:
    """The elements of joints that are alike as those of one, of the batch that has their bodies.

    Args:
        each: Those of the joints.
        of: Numbers of their bodies.
        batch: A `BodyBatch`.
    """
    def both(name: str) -> Any:
        found = [getattr(rows, name) for rows in each]
        if isinstance(found[0], tuple):
            return type(found[0])(*map(np.concatenate, zip(*found, strict=True)))
        return np.concatenate(found) if isinstance(found[0], np.ndarray) else found[0]

    others = {f.name: both(f.name) for f in fields(ConstraintRows) if f.name != "sides"}
    counts = [len(rows.joint) for rows in each]
    return ConstraintRows(
        joined_sides([rows.sides for rows in each], of, batch),
        **others | {"joint": np.repeat(np.arange(len(each)), counts)},
    )
