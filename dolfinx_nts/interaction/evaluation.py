"""Where a step evaluates its equations, and what they are at an iterate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.types import FloatArray


class EvaluationPoint(NamedTuple):
    """Where a step evaluates the forces of a body.

    Attributes:
        u0: Displacement at t_n [m], owned coordinates.
        time: Of the loads [s].
        ramp: Part of constant loads that acts.
        rate: Change of the velocity there with u_1 [1/s]; 0 in statics.
        drift: Velocity there for u_1 = u_0 [m/s]; None: zero.
        inner: What else forces depend on at t_n, see `Body.inner`.
    """

    u0: FloatArray
    time: float
    ramp: float = 1.0
    rate: float = 0.0
    drift: FloatArray | None = None
    inner: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class BodyTerms:
    """Parts of a body's or a batch's equation at an iterate, [kg m] except u1 and du [m].

    Owned coordinates.

    Attributes:
        u1: Displacement at t_{n+1}.
        du: u_1 - u_0.
        internal: h^2/2 internal forces.
        external: h^2/2 external forces.
        coupling: h^2/2 forces of elements, such as contact forces G^T lambda.
        residual: Complete equation, also at prescribed coordinates, where it is h^2/2 times the
            reaction.
    """

    u1: FloatArray
    du: FloatArray
    internal: FloatArray
    external: FloatArray
    coupling: FloatArray
    residual: FloatArray


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The step equations at an iterate.

    Attributes:
        x: Iterate it belongs to, this rank's part.
        terms: Of each batch of bodies.
        split: From the coordinates of each batch to those of each body.
        parts: Contribution of each batch of elements.
        moved: Largest motion of a coordinate on all ranks [m].
        measures: What rows of augmented unknowns are measured by, over all ranks: the last two of
            `Elements.largest` of each batch, shape (batches, 2); empty without such unknowns.
        turned: Whether contacts have another status on any rank than in the iterate before.
        iterations: Newton iterations it took.
        min_det: Smallest det F of all bodies, once solved.
    """

    x: FloatArray
    terms: tuple[BodyTerms, ...]
    split: Callable[[Sequence[FloatArray]], tuple[FloatArray, ...]]
    parts: tuple[Any, ...]
    moved: float = 0.0
    measures: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    turned: bool = True
    iterations: int = 0
    min_det: float = np.inf

    @cached_property
    def bodies(self) -> tuple[BodyTerms, ...]:
        """Terms of each body: views."""
        names = [of.name for of in fields(BodyTerms)]
        each = [self.split([getattr(of, name) for of in self.terms]) for name in names]
        return tuple(BodyTerms(*found) for found in zip(*each, strict=True))


def free(body: Any, residual: FloatArray) -> FloatArray:
    """Residual with zeros at the prescribed coordinates, whose equation is the prescription."""
    out = residual.copy()
    out[body.fixed] = 0.0
    return out
