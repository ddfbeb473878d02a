"""When the equations of a step count as solved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_max, global_sum
from dolfinx_nts.types import FloatArray

#: Rounding of a sum of elements' forces over the norm of all of them: their own rounding and that
#: of the solution, which the elements' stiffness passes on.
_CANCELLED = 32 * float(np.finfo(float).eps)


def worst(problem: StepProblem, e: Evaluation) -> float:
    """The largest of `ratios`. Collective."""
    of_bodies, of_elements = _of_bodies(problem, e), _of_elements(problem, e)
    found = np.array([of_bodies.max(), *(max(one.values()) for one in of_elements if one)])
    if of_elements:
        found = global_max(problem.system.comm, found.max(keepdims=True))
    return float(found[0])


def ratios(problem: StepProblem, e: Evaluation) -> dict[str, float]:
    """Residual of each block over what counts as converged there; solved when all are <= 1.

    Collective.
    """
    names = [body.name for body in problem.system.bodies]
    ratio = dict(zip(names, _of_bodies(problem, e).tolist(), strict=True))
    for found in _of_elements(problem, e):
        # Several contacts of two bodies have one name.
        for name, value in found.items():
            ratio[name] = max(value, ratio.get(name, 0.0))
    largest = global_max(problem.system.comm, np.array(list(ratio.values())))
    return dict(zip(ratio, largest.tolist(), strict=True))


def unrest(problem: StepProblem, e: Evaluation) -> tuple[float, str]:
    """Force of the stabilization over what counts as zero, the largest; and its body's name.

    Collective.
    """
    both = zip(problem.batches.bodies, e.terms, strict=True)
    held = [problem.stabilization.of(body) * terms.du for body, terms in both]
    found = _over_limits(problem, e, held, problem.rounding.at(problem.lengths.displacement_of(e)))
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


def _of_bodies(problem: StepProblem, e: Evaluation) -> FloatArray:
    """`ratios` of the bodies, shape (bodies,). Collective."""
    residuals = [terms.residual for terms in e.terms]
    return _over_limits(problem, e, residuals, problem.rounding.forces)


def _over_limits(
    problem: StepProblem, e: Evaluation, forces: Sequence[FloatArray], rounding: FloatArray
) -> FloatArray:
    """A force on each batch over that which counts as zero, by body; asleep 0. Collective.

    It is measured by the largest of its inertial, internal, external and coupling forces. Of
    elements' forces that cancel each other, as on a body without mass of note between two springs,
    only the rounding counts, so that strong joints loosen no tolerance.
    """
    batches, parts = problem.batches, _forces_on(problem, e, forces)
    squares = np.empty((6, batches.count))
    squares[:5] = batches.sums([np.square(own) for own in parts])
    squares[5] = problem.laid.gross_forces(problem.elements, e.parts, batches.count)
    norms = np.sqrt(global_sum(batches.comm, squares))
    limits = problem.rtol * norms[1:5].max(axis=0) + _CANCELLED * norms[5] + rounding
    found = np.zeros(batches.count)
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
    """`ratios` of each batch of elements on this rank, for their own unknowns. Collective."""
    if not problem.laid.own:
        return []
    moved = max(float(np.abs(terms.du).max(initial=0.0)) for terms in e.terms)
    comm, linked, elements = problem.system.comm, problem.couplings.linked, problem.elements
    # MPI's maximum may swallow a NaN, so it travels as a flag.
    local = [moved, float(any(np.isnan(part.residual.sum()) for part in e.parts))]
    for c, part in zip(elements, e.parts, strict=True):
        local += c.largest(part)
    extents = np.zeros(problem.couplings.mechanisms)
    for c, of in zip(elements, linked, strict=True):
        if of is not None:
            np.maximum.at(extents, of, c.extents if np.ndim(of) else c.extent)
    top = global_max(comm, np.array([*local, *extents]))
    motion = max(top[0], float(problem.lengths.motion.max()))
    rounded = motion + problem.lengths.rounded
    extents = top[len(local) :]
    sizes, found = top[2 : len(local)].reshape(-1, 4), []
    for c, part, largest, of in zip(elements, e.parts, sizes, linked, strict=True):
        # What rounding leaves open in a joint the linear solve passes on to all that its bodies
        # link.
        given = largest if of is None else [*largest[:3], extents[of]]
        ratio = c.ratios(part, given, motion, rounded, problem.rtol)
        found.append(ratio if not top[1] else dict.fromkeys(ratio, np.inf))
    return found
