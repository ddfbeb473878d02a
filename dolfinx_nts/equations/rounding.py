"""Size of the forces on each body that is rounding."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from dolfinx_nts.arrays import FloatArray
from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.parallel import global_sum

_EPS = float(np.finfo(float).eps)
#: Factor by which h^2/2 may change before the rounding of a body's forces is measured again.
_ANOTHER_STEP = 4.0
#: Roundings in a force between bodies: of both places, of the distance, and of the law itself.
_ENDS = 4.0


class Rounding:
    """Rounding of the forces on bodies: stiffness times length times machine precision.

    The stiffness is the diagonal of a body's matrix in an accepted state, never in an iterate: one
    that runs off may be stiffer by any factor, and its rounding excuses no residual. Forces come
    from displacement gradients, so the length is that of the displacement, wherever the body lies
    and however large it is. Forces between bodies come from places.

    Args:
        batches: Of the bodies of the system.
        tangent: PETSc matrix of a batch at the start of the step, by its number.
        springs: Stiffness there of what acts between bodies, of each body [kg], (bodies,).
            Collective.

    Attributes:
        length: Displacement of each body in the step [m], at most, shape (bodies,).
    """

    def __init__(
        self,
        batches: Batches,
        tangent: Callable[[int], Any],
        springs: Callable[[], FloatArray],
    ) -> None:
        self._batches, self._tangent, self._springs = batches, tangent, springs
        self._diagonal, self._of_factor = np.zeros((2, batches.count))
        self._between, self._springs_known = np.zeros(batches.count), False
        self.length = self._extent = self._moved = self._beside = np.zeros(batches.count)
        self._factor = 1.0

    def begin(
        self, factor: float, length: FloatArray, moved: FloatArray, extent: FloatArray
    ) -> None:
        """Fix the step; what was measured in steps of another size is forgotten.

        Args:
            factor: What the equations multiply forces by, h^2/2 [s^2] or 1.
            length: Displacement of each body in the step [m], at most, shape (bodies,).
            moved: Displacement at t_n [m], shape (bodies,).
            extent: Largest coordinate [m], shape (bodies,).
        """
        self._factor, self.length, self._moved, self._extent = factor, length, moved, extent
        self._beside = extent.copy()
        for body, of in zip(self._batches.bodies, self._batches.numbers, strict=True):
            if body.rounded is not None:
                self._beside[of] = body.rounded
        # Of steps of other sizes the diagonal differs; until rounding matters none is needed.
        old = self._of_factor
        self._diagonal[(factor > _ANOTHER_STEP * old) | (old > _ANOTHER_STEP * factor)] = 0.0
        self._between[:], self._springs_known = 0.0, False

    @property
    def measured(self) -> list[list[float]]:
        """Of each body, what its rounding was last measured by: the diagonal [kg], the factor."""
        return [self._diagonal.tolist(), self._of_factor.tolist()]

    @measured.setter
    def measured(self, known: Sequence[Sequence[float]]) -> None:
        self._diagonal[:], self._of_factor[:] = known

    def is_known(self, bodies: Iterable[int], *, springs: bool) -> bool:
        """Whether the rounding of the forces on all these bodies has been measured.

        Args:
            bodies: Their numbers.
            springs: Whether forces act between bodies, whose rounding is measured in each step.
        """
        known = bool((self._diagonal[list(bodies)] > 0.0).all())
        return known and (self._springs_known or not springs)

    def measure(self, bodies: Iterable[int]) -> None:
        """Measure it anew, for bodies that have stiffened. Collective.

        A director is rounded as its own length is, not as a position: the stiffness of thin bodies
        against what turns it alone counts by that part. Positions are rounded in the forces on
        directors, too, by no more than the mean stiffness of both, as it is definite.
        """
        asked = set(bodies)
        for j, (body, of) in enumerate(
            zip(self._batches.bodies, self._batches.numbers, strict=True)
        ):
            chosen = [k for k in of if k in asked]
            if not chosen:
                continue
            diagonal = self._tangent(j).getDiagonal()
            each = diagonal.array_r.copy()
            diagonal.destroy()
            if body.oriented and not body.rigid:
                each = self._as_rounded(body, each.reshape(-1, 3), self._extent[of[0]])
            squares = [np.zeros(other.num_owned) for other in self._batches.bodies]
            squares[j] = np.square(each)
            norms = np.sqrt(global_sum(self._batches.comm, self._batches.sums(squares)))
            self._diagonal[chosen], self._of_factor[chosen] = norms[chosen], self._factor

    @staticmethod
    def _as_rounded(body: Any, each: FloatArray, extent: float) -> FloatArray:
        """Stiffness of a beam's or shell's nodal vectors against rounding [kg], (num_owned,)."""
        # A node's place comes before its directors.
        place = each[body.places].max(axis=1)[np.cumsum(body.places) - 1, None]
        turns, out = ~body.places, each.copy()
        out[turns] *= body.length / extent
        out[turns] += np.sqrt(np.abs(each[turns] * place[turns]))
        return out.ravel()

    def measure_springs(self) -> None:
        """Measure that of forces between bodies in this step. Collective."""
        self._between, self._springs_known = self._springs(), True

    @property
    def forces(self) -> FloatArray:
        """Norm of the forces on each body in the step that is rounding [kg m]; [N] in statics."""
        return self.at(self.length)

    def at(self, length: FloatArray) -> FloatArray:
        """`forces` at displacements of these lengths [m], shape (bodies,)."""
        between = _ENDS * self._between * (length + self._extent)
        rounding: FloatArray = _EPS * (self._diagonal * (length + self._beside) + between)
        return rounding

    def of(self, bodies: Sequence[int]) -> float:
        """`forces` of some bodies in all [kg m]. Collective."""
        self._measure_unknown(bodies)
        return float(self.forces[list(bodies)].sum())

    def at_rest(self, k: int) -> float:
        """The same of a body at rest [N]. Collective.

        The diagonal may be that of another step size; it grows less than the factor does, so this
        hardly allows more.
        """
        self._measure_unknown([k])
        return float(self.at(self._moved)[k] / max(self._factor, self._of_factor[k]))

    def _measure_unknown(self, bodies: Iterable[int]) -> None:
        self.measure([k for k in bodies if not self._diagonal[k]])
