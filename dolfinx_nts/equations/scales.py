"""Lengths and rounding of a step, which tolerances and guards are measured by."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dolfinx_nts.bodies.batch import BodyBatch
from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.elements import evaluate_together
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_max, global_sum
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

_EPS = float(np.finfo(float).eps)


class Lengths:
    """Lengths of a scene [m], the same on all ranks; `begin` measures a step.

    Attributes:
        centre: Middle of all bodies in the reference, shape (3,).
        radius: Half the diagonal of the box around them.
        director: The longest one of all bodies, about the size of the largest rigid one.
        motion: Largest motion of a point of each body that is predicted, shape (bodies,).
        extent: Largest coordinate, likewise.
        moved: Largest displacement at t_n, likewise.
        fall: What a body at rest may fall in the step, at most.
    """

    def __init__(self, system: System) -> None:
        self._batches = system.batches
        self.centre, self.radius, self.director = box_of(system)
        self.motion, self.extent, self.moved = np.zeros((3, len(system.bodies)))
        self.fall = 0.0
        links = (*system.contact_bodies, *system.joint_bodies)
        ends = np.array([two for of in links for two in pairwise(of)], dtype=np.int64)
        a, b = ends.reshape(-1, 2).T
        graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(system.bodies),) * 2)
        #: Number of each body's group, which contacts and joints link.
        self._groups, self._group = connected_components(graph, directed=False)

    def begin(
        self, u: Sequence[FloatArray], rates: Sequence[Sequence[FloatArray]],
        first: Sequence[FloatArray],
    ) -> FloatArray:  # fmt: skip
        """Measure a step. Collective.

        Args:
            u: Displacements of each batch at t_n [m].
            rates: Velocities then and, of schemes that carry them, accelerations times the step
                [m/s].
            first: Displacements at t_{n+1} that are predicted [m].

        Returns:
            Largest speed of each body [m/s], shape (bodies,).
        """
        batches = self._batches
        du = [u1 - u0 for u1, u0 in zip(first, u, strict=True)]
        places = [b.reference + u1 for b, u1 in zip(batches.bodies, first, strict=True)]
        local = [batches.motions(du), *map(batches.largest, (places, u, *rates))]
        found = global_max(batches.comm, np.array(local))
        self.motion, self.extent, self.moved = found[:3]
        return found[3:].max(axis=0)

    def displaced(self, fall: float) -> FloatArray:
        """Displacement of each body in the step, at most, shape (bodies,).

        Args:
            fall: What a body at rest may fall [m].
        """
        self.fall = fall
        # A body at rest beside a moving one gets the rounding of the linear solve for both.
        longest = np.zeros(self._groups)
        np.maximum.at(longest, self._group, self.moved + self.motion + fall)
        return longest[self._group]

    @property
    def rounded(self) -> float:
        """Length beside the motion of the step whose rounding is in all positions.

        A body at rest may have no extent, but the forces on it are rounded as its fall would be.
        """
        return float(self.moved.max()) + self.fall

    @property
    def span(self) -> float:
        """Distance of the bodies' farthest coordinate from `centre`, at most."""
        return self.radius + self.director + float((self.moved + self.motion).max())

    def motion_of(self, e: Evaluation) -> FloatArray:
        """Largest component of each body's motion in an evaluation, shape (bodies,). Collective."""
        return global_max(self._batches.comm, self._batches.motions([t.du for t in e.terms]))

    def displacement_of(self, e: Evaluation) -> FloatArray:
        """Largest displacement of each body in an evaluation, shape (bodies,). Collective.

        An iterate that runs off excuses no more than the positions would.
        """
        local = self._batches.largest([terms.u1 for terms in e.terms])
        return np.minimum(global_max(self._batches.comm, local), self.extent + self.moved)


def box_of(system: System) -> tuple[FloatArray, float, float]:
    """Middle of the box around all bodies' places, half its diagonal, longest director [m].

    All in the reference. Collective.
    """
    ends = np.full((3, 3), -np.inf)
    ends[2] = 0.0
    for body in system.bodies:
        x = body.reference.reshape(-1, 3)
        directors, x = x[~body.places], x[body.places]
        np.maximum(ends[0], x.max(axis=0, initial=-np.inf), out=ends[0])
        np.maximum(ends[1], (-x).max(axis=0, initial=-np.inf), out=ends[1])
        ends[2, 0] = max(ends[2, 0], np.linalg.norm(directors, axis=1).max(initial=0.0))
    high, low, (directors, *_) = global_max(system.comm, ends) * [[1.0], [-1.0], [1.0]]
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)), float(directors)


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
        self, batches: Batches, tangent: Callable[[int], Any], springs: Callable[[], FloatArray]
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
                here = body.number_here[::3] if isinstance(body, BodyBatch) else of
                each = self._as_rounded(body, each.reshape(-1, 3), self._extent[here])
            squares = [np.zeros(other.num_owned) for other in self._batches.bodies]
            squares[j] = np.square(each)
            norms = np.sqrt(global_sum(self._batches.comm, self._batches.sums(squares)))
            self._diagonal[chosen], self._of_factor[chosen] = norms[chosen], self._factor

    @staticmethod
    def _as_rounded(body: Body, each: FloatArray, extent: FloatArray) -> FloatArray:
        """Stiffness of a beam's or shell's nodal vectors against rounding [kg], (num_owned,)."""
        # A node's place comes before its directors.
        place = each[body.places].max(axis=1)[np.cumsum(body.places) - 1, None]
        turns, out = ~body.places, each.copy()
        shares = np.broadcast_to(body.length / extent, turns.shape)
        out[turns] *= shares[turns, None]
        out[turns] += np.sqrt(np.abs(each[turns] * place[turns]))
        return out.ravel()

    def renew(self, bodies: Iterable[int], length: FloatArray) -> None:
        """Measure it anew at an iterate, and that of forces between bodies. Collective.

        Args:
            bodies: As of `measure`.
            length: Displacements there [m], shape (bodies,), if longer than what was predicted.
        """
        self.length = np.maximum(self.length, length)
        self.measure(bodies)
        self._between, self._springs_known = self._springs(), True

    @property
    def forces(self) -> FloatArray:
        """Norm of the forces on each body in the step that is rounding [kg m]; [N] in statics."""
        return self.at(self.length)

    def at(self, length: FloatArray) -> FloatArray:
        """`forces` at displacements of these lengths [m], shape (bodies,)."""
        between = _ENDS * self._between * (length + self._extent)
        return _EPS * (self._diagonal * (length + self._beside) + between)

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


def stiffness_between(
    batches: Batches, laid: Unknowns, elements: Sequence[Any], bodies: Sequence[tuple[int, ...]],
    u: Sequence[FloatArray],
) -> FloatArray:  # fmt: skip
    """Norm of the stiffness of elements without own unknowns, of each body [kg]. Collective.

    Args:
        batches: Of bodies.
        laid: Layout of the unknowns.
        elements: Batches of elements.
        bodies: Numbers of the bodies of each batch.
        u: Owned displacements of each batch of bodies [m].

    Returns:
        Shape (bodies,); [N/m] in statics.
    """
    local, start = np.zeros(batches.count), laid.x.duplicate()
    start.set(0.0)
    laid.write(u, start.array_w)
    positions = laid.positions(start, elements)
    own = laid.own_values(start.array_r, elements)
    start.destroy()
    chosen = [i for i, batch in enumerate(elements) if not any(batch.widths.values())]
    parts = evaluate_together(
        laid.layout.comm,
        [elements[i] for i in chosen],
        [positions[i] for i in chosen],
        [own[i] for i in chosen],
    )
    for i, part in zip(chosen, parts, strict=True):
        first = 0
        for k, dofs in zip(bodies[i], elements[i].dofs(), strict=True):
            stop = first + dofs.shape[1]
            along = part.tangent[:, first:stop, first:stop].diagonal(axis1=1, axis2=2)
            free = dofs >= 0
            np.add.at(local, batches.body_of(k, dofs[free]), np.square(along[free]))
            first = stop
    return np.sqrt(laid.layout.comm.allreduce(local))
