"""What contact is made of beside its law: a gap with a slip, and the points of bodies they are of.

An element of contact is a measure of some points under a law. Another kind of contact is one more
file: an `Attachment`, and a `ContactMeasure` if its gap is no function of points that there is.
Edges that meet, for one, have the gap of facets, see `edge_contact.EdgeAttachment`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np

from dolfinx_nts.interaction.points import Points
from dolfinx_nts.types import BoolArray, FloatArray, IntArray


class Batch:
    """What inherits from it is a dataclass whose arrays have the element as axis 0."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def select(self, chosen: BoolArray) -> Self:
        """Some of the elements, chosen by a mask of shape (n,)."""
        changed: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                changed[name] = value[chosen]
            elif hasattr(value, "select"):
                changed[name] = value.select(chosen)
        return replace(self, **changed)

    @classmethod
    def joined(cls, batches: Sequence[Any], counts: Sequence[int]) -> Any:
        """Those of several batches, one after the other, that differ in numbers and arrays alone.

        Args:
            batches: At least one, of the same class.
            counts: How many elements each has.
        """
        changed: dict[str, Any] = {}
        for name in cls.__dataclass_fields__:
            values = [getattr(batch, name) for batch in batches]
            if hasattr(values[0], "joined"):
                changed[name] = values[0].joined(values, counts)
            elif any(isinstance(v, np.ndarray) for v in values) or (
                isinstance(values[0], float) and any(v != values[0] for v in values)
            ):
                rest = max((np.shape(v)[1:] for v in values), key=len)
                rows = zip(values, counts, strict=True)
                changed[name] = np.concatenate([np.broadcast_to(v, (n, *rest)) for v, n in rows])
        return replace(batches[0], **changed)


class Slip(NamedTuple):
    """Slip and metric in facet sizes with their derivatives by the unknowns of the element."""

    value: FloatArray
    gradient: FloatArray
    metric: FloatArray
    metric_gradient: FloatArray


class Measured(NamedTuple):
    """Residual and tangent of a measure at an iterate, before the law; axis 0 = element.

    Attributes:
        residual: Rows of the points, of augmented unknowns and of constraints, first that of the
            gap, last those of friction, which are zero: [kg m] and [m], shape (n, r).
        tangent: Its derivative, shape (n, r, r).
        gap: g_N at t_{n+1} [m], shape (n,).
        slip: Slip; None without friction.
        normal: Where the contact force acts, shape (n, 3); None without friction.
        let_go: Which are not active, whatever their forces say, shape (n,); None: none is.
    """

    residual: FloatArray
    tangent: FloatArray
    gap: FloatArray
    slip: Slip | None = None
    normal: FloatArray | None = None
    let_go: BoolArray | None = None


class ContactMeasure(Protocol):
    """A gap and a slip as functions of points: arrays in, arrays out; axis 0 = element.

    The slave is the first of an element's points.
    """

    @property
    def start(self) -> FloatArray:
        """Points at t_n [m], shape (n, points, 3)."""

    @property
    def length(self) -> FloatArray:
        """What makes lengths of convective coordinates [m], shape (n,)."""

    @property
    def num_augmented(self) -> int:
        """Unknowns of an element beside points and multipliers; 0 where they are eliminated."""

    @property
    def num_normal(self) -> int:
        """Constraints of an element but those of friction."""

    @property
    def extent(self) -> float:
        """Length beside those of the points whose rounding enters gaps [m]."""

    @property
    def normal(self) -> FloatArray:
        """Unit normals at t_n, out of the master, shape (n, 3)."""

    @property
    def tangents(self) -> FloatArray:
        """Directions of the slip's components at t_n, in facet sizes [-], shape (n, 2, 3)."""

    @property
    def foot(self) -> FloatArray:
        """Weights of the points but the slave in the foot at t_n, shape (n, points - 1)."""

    def gap(self, x: FloatArray) -> FloatArray:
        """Gaps [m] of points at t_{n+1}, (n, points, 3) -> (n,)."""

    def augmented(self, x: FloatArray) -> FloatArray:
        """Augmented unknowns [m] that fit points at t_{n+1}, shape (n, num_augmented)."""

    def evaluate(self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray) -> Measured:
        """Residual and tangent, the product of the force and the motion the change of the gap.

        Args:
            x: Points at t_{n+1} [m], shape (n, points, 3).
            augmented: [m], shape (n, num_augmented).
            multiplier: h^2/2 lambda [kg m], shape (n, num_normal), with friction two more.
        """

    def select(self, chosen: BoolArray) -> Self:
        """That of some elements, see `Batch`."""


class Attachment(Protocol):
    """Which points of bodies a measure takes; axis 0 = element."""

    @property
    def surfaces(self) -> Sequence[Any]:
        """That of the slave, and that of the master if it is of a body."""

    @property
    def numbers(self) -> Sequence[IntArray]:
        """Points of each surface that an element depends on, shape (n, p) each."""

    @property
    def shares(self) -> FloatArray | None:
        """Weights of these in the measure's points, (n, points, sum of p); None if they are one."""

    @property
    def sides(self) -> Sequence[Points]:
        """Nodes of each body that an element depends on."""

    @property
    def weights(self) -> FloatArray | None:
        """Weights of these in the measure's points, (n, points, nodes); None if they are one."""

    @property
    def path(self) -> tuple[FloatArray, FloatArray]:
        """Displacements, at t_n and t_{n+1}, of what the points are relative to [m], (3,) each."""

    def place(self, i: int) -> str:
        """Where an element is, for messages."""

    def select(self, chosen: BoolArray) -> Self:
        """That of some elements, see `Batch`."""


def fixed_of(attachment: Attachment) -> BoolArray:
    """Which coordinates of the surfaces' points are prescribed, shape (n, sum of p, 3)."""
    both = zip(attachment.surfaces, attachment.numbers, strict=True)
    return np.concatenate([surface.fixed[number] for surface, number in both], axis=1)
