"""When the equations of a step count as solved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_sum, sums_and_largest
from dolfinx_nts.types import FloatArray

#: Rounding of a sum of elements' forces over the norm of all of them: their own rounding and that
#: of the solution, which the elements' stiffness passes on.
_CANCELLED = 32 * float(np.finfo(float).eps)


def worst(problem: StepProblem, e: Evaluation, *flags: bool) -> tuple[float, list[bool]]:
    """The largest of `ratios`, and which of some flags any rank has. Collective, in one call."""
    own = [max(one.values()) for one in _of_elements(problem, e) if one]
    sizes = np.array([np.max(own, initial=0.0), *flags])
    of_bodies, (largest, *found) = _found(problem, e, sizes)
    return float(np.max([of_bodies.max(), largest])), [flag > 0.0 for flag in found]


def ratios(problem: StepProblem, e: Evaluation) -> dict[str, float]:
    """Residual of each block over what counts as converged there; solved when all are <= 1.

    Collective.
    """
    names = [body.name for body in problem.system.bodies]
    ratio = dict.fromkeys(names, 0.0)
    for found in _of_elements(problem, e):
        # Several contacts of two bodies have one name.
        for name, value in found.items():
            ratio[name] = max(value, ratio.get(name, 0.0))
    of_bodies, largest = _found(problem, e, np.array(list(ratio.values())))
    largest[: len(names)] = np.maximum(largest[: len(names)], of_bodies)
    return dict(zip(ratio, largest.tolist(), strict=True))


def unrest(problem: StepProblem, e: Evaluation) -> tuple[float, str]:
    """Force of the stabilization over what counts as zero, the largest; and its body's name.

    Collective.
    """
    both = zip(problem.batches.bodies, e.terms, strict=True)
    held = [problem.stabilization.of(body) * terms.du for body, terms in both]
    squares = global_sum(problem.batches.comm, _squares(problem, e, held))
    rounding = problem.rounding.at(problem.lengths.displacement_of(e))
    found = _over_limits(problem, squares, rounding)
    k = int(np.argmax(found))
    return float(found[k]), problem.system.bodies[k].name


def leaves_work(problem: StepProblem, e: Evaluation, share: float) -> bool:
    """Whether the residual does more work in the step than a part of the forces' work. Collective.

    It is the bodies' part of what the step misses in the ledger.

    Args:
        problem: Equations of the step.
        e: Iterate.
        share: The part, of the largest work of one kind of forces on one body.
    """
    parts = _forces_on(problem, e, [terms.residual for terms in e.terms])
    both = list(zip(parts, e.terms, strict=True))
    works = problem.batches.sums([forces * terms.du for forces, terms in both])
    squares = problem.batches.sums([np.square(terms.du) for terms in e.terms])
    work = global_sum(problem.system.comm, np.array([*works, squares])).T
    rounding = problem.rounding.forces @ np.sqrt(work[:, 5])
    return abs(work[:, 0].sum()) > share * np.abs(work[:, 1:5]).max() + rounding


def _found(
    problem: StepProblem, e: Evaluation, sizes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`ratios` of the bodies, shape (bodies,), and the largest of some sizes over all ranks (n,).

    Collective.
    """
    squares = _squares(problem, e, [terms.residual for terms in e.terms])
    total, top = sums_and_largest(problem.system.comm, squares.ravel(), sizes)
    return _over_limits(problem, total.reshape(squares.shape), problem.rounding.forces), top


def _squares(
    problem: StepProblem, e: Evaluation, forces: Sequence[FloatArray]
) -> FloatArray:
    """Squares of a force on each body and of those it is measured by, this rank's part, (6, n)."""
    batches, parts = problem.batches, _forces_on(problem, e, forces)
    squares = np.empty((6, batches.count))
    squares[:5] = batches.sums([np.square(own) for own in parts])
    squares[5] = problem.laid.gross_forces(problem.elements, e.parts, batches.count)
    return squares


def _over_limits(
    problem: StepProblem, squares: FloatArray, rounding: FloatArray
) -> FloatArray:
    """A force on each body over that which counts as zero; asleep 0.

    It is measured by the largest of its inertial, internal, external and coupling forces. Of
    elements' forces that cancel each other, as on a body without mass of note between two springs,
    only the rounding counts, so that strong joints loosen no tolerance.

    Args:
        problem: Equations of the step.
        squares: `_squares` of all ranks.
        rounding: Of forces on each body, shape (bodies,).
    """
    norms, found = np.sqrt(squares), np.zeros(problem.batches.count)
    limits = problem.rtol * norms[1:5].max(axis=0) + _CANCELLED * norms[5] + rounding
    with np.errstate(divide="ignore", over="ignore"):
        np.divide(norms[0], limits, out=found, where=problem.is_awake & (norms[0] != 0.0))
    return np.where(np.isnan(found), np.inf, found)


def _forces_on(
    problem: StepProblem, e: Evaluation, forces: Sequence[FloatArray]
) -> list[FloatArray]:
    """Of each batch the given forces where it is free, then all of the step's, (5, num_owned)."""
    found = []
    each = zip(problem.batches.bodies, forces, problem.flight.momentum, e.terms, strict=True)
    for body, own, flight, terms in each:
        rows = np.array([own, flight, terms.internal, terms.external, terms.coupling])
        rows[0, body.fixed] = 0.0
        found.append(rows)
    return found


def _of_elements(problem: StepProblem, e: Evaluation) -> list[dict[str, float]]:
    """`ratios` of each batch of elements on this rank, for their own unknowns."""
    if not problem.laid.own:
        return []
    motion = max(e.moved, float(problem.lengths.motion.max()))
    rounded, found = motion + problem.lengths.rounded, []
    each = zip(problem.elements, e.parts, problem.couplings.linked, strict=True)
    for k, (c, part, of) in enumerate(each):
        given = c.largest(part)
        if len(e.measures):
            given[2:] = e.measures[k].tolist()
        if of is not None:
            # What rounding leaves open in a joint the linear solve passes on to all that its
            # bodies link.
            given[3] = problem.extents[of]
        ratio = c.ratios(part, given, motion, rounded, problem.rtol)
        if np.isnan(part.residual.sum()):
            ratio = dict.fromkeys(ratio, np.inf)
        found.append(ratio)
    return found
