"""What holds the nodes of beams and shells, and what acts on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from dolfinx_nts.bodies.conditions import VectorInTime
from dolfinx_nts.validation import is_whole, known_options


@known_options
@dataclass(frozen=True)
class Clamp:
    """Nodes of a beam or shell that neither move nor turn.

    Attributes:
        where: Function x (3, n) -> bool (n,).
        components: Which of x, y, z of places and directors are held. Fewer than three are for
            shells: (0,) makes a plane x = const one of symmetry.

    Raises:
        ValueError: Unknown component.
    """

    where: Any
    components: tuple[int, ...] = (0, 1, 2)

    def __post_init__(self) -> None:
        given = self.components
        listed = isinstance(given, Sequence) and all(is_whole(c) and 0 <= c <= 2 for c in given)
        if not listed or not given:
            raise ValueError(f"components={given!r}: pass a tuple of some of 0, 1, 2")


class Load:
    """Dead load at nodes.

    Attributes:
        where: Function x (3, n) -> bool (n,).
        value: A vector, or a function of time.
        unit: Of the value.
        per_length: Whether it acts along edges between nodes; else on one node.
        turns: Whether it is a moment.
    """

    where: Any
    value: VectorInTime
    unit: ClassVar[str]
    per_length: ClassVar[bool]
    turns: ClassVar[bool]


@known_options
@dataclass(frozen=True)
class PointForce(Load):
    """Dead force on a node of a beam or shell.

    Attributes:
        where: Function x (3, n) -> bool (n,) that is true at one node.
        value: [N]: a vector, or a function of time.
    """

    where: Any
    value: VectorInTime
    unit, per_length, turns = "N", False, False


@known_options
@dataclass(frozen=True)
class PointMoment(Load):
    """Dead moment on a node of a beam or shell; shells do not feel what is along their director.

    Attributes:
        where: Function x (3, n) -> bool (n,) that is true at one node.
        value: [N m]: a vector, or a function of time.
    """

    where: Any
    value: VectorInTime
    unit, per_length, turns = "N m", False, True


@known_options
@dataclass(frozen=True)
class LineForce(Load):
    """Dead force per length of a beam's reference, or of the edge of a shell's.

    Attributes:
        value: [N/m]: a vector, or a function of time.
        where: Function x (3, n) -> bool (n,): it acts between neighbours for which it is true;
            None: everywhere, of a shell on its whole edge.
    """

    value: VectorInTime
    where: Any = None
    unit, per_length, turns = "N/m", True, False


@known_options
@dataclass(frozen=True)
class LineMoment(Load):
    """Dead moment per length of a beam's reference, or of the edge of a shell's.

    Attributes:
        value: [N m/m]: a vector, or a function of time.
        where: As of `LineForce`.
    """

    value: VectorInTime
    where: Any = None
    unit, per_length, turns = "N m/m", True, True
