"""When the equations of a step count as solved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.elements import over
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import global_max, global_sum

FloatArray = npt.NDArray[np.float64]

#: Rounding of a sum of elements' forces over the norm of all of them: their own rounding and that
#: of the solution, which the elements' stiffness passes on.
_CANCELLED = 32 * float(np.finfo(float).eps)


def ratios(problem: StepProblem, e: Evaluation) -> dict[str, float]:
    """Residual of each block over what counts as converged there; solved when all are <= 1.

    Collective.
    """
    residuals = [terms.residual for terms in e.terms]
    of_bodies = _over_limits(problem, e, residuals, problem.rounding.forces)
    ratio = dict(zip((b.name for b in problem.system.bodies), of_bodies, strict=True))
    if problem.laid.own:
        ratio |= _of_elements(problem, e)
    return ratio


def unrest(problem: StepProblem, e: Evaluation) -> tuple[float, str]:
    """Force of the stabilization over what counts as zero, the largest; and its body's name.

    Collective.
    """
    both = zip(problem.batches.bodies, e.terms, strict=True)
    held = [problem.stabilization.of(body) * terms.du for body, terms in both]
    found = _over_limits(problem, e, held, problem.rounding.at(problem.lengths.displacement_of(e)))
    k = int(np.argmax(found))
    return found[k], problem.system.bodies[k].name


def leaves_work(problem: StepProblem, e: Evaluation, share: float) -> bool:
    """Whether the residual does more work in the step than a part of the forces' work. Collective.

    It is the bodies' part of what the step misses in the ledger.

    Args:
        problem: Equations of the step.
        e: Iterate.
        share: The part, of the largest work of one kind of forces on one body.
    """
    parts = _forces_on(problem, e, [terms.residual for terms in e.terms])
    moves = [terms.du for terms in e.terms]
    local = [
        problem.batches.sums([a * du for a, du in zip(part, moves, strict=True)])
        for part in (*parts, moves)
    ]
    work = global_sum(problem.system.comm, np.array(local)).T
    rounding = problem.rounding.forces @ np.sqrt(work[:, 5])
    return abs(work[:, 0].sum()) > share * np.abs(work[:, 1:5]).max() + rounding


def _over_limits(
    problem: StepProblem, e: Evaluation, forces: Sequence[FloatArray], rounding: FloatArray
) -> list[float]:
    """A force on each batch over that which counts as zero, by body; asleep 0. Collective.

    It is measured by the largest of its inertial, internal, external and coupling forces. Of
    elements' forces that cancel each other, as on a body without mass of note between two springs,
    only the rounding counts, so that strong joints loosen no tolerance.
    """
    batches = problem.batches
    squares = [
        batches.sums([np.square(own) for own in part]) for part in _forces_on(problem, e, forces)
    ]
    squares.append(problem.laid.gross_forces(problem.elements, e.parts, batches.count))
    norms = np.sqrt(global_sum(batches.comm, np.array(squares)))
    limits = problem.rtol * norms[1:5].max(axis=0) + _CANCELLED * norms[5] + rounding
    found, sizes = [0.0] * batches.count, norms[0].tolist()
    for k in problem.awake:
        found[k] = over(sizes[k], limits[k])
    return found


def _forces_on(
    problem: StepProblem, e: Evaluation, forces: Sequence[FloatArray]
) -> list[Sequence[FloatArray]]:
    """Given forces on each batch where they are free, then all kinds of the step's forces."""
    left = [own.copy() for own in forces]
    for body, own in zip(problem.batches.bodies, left, strict=True):
        own[body.fixed] = 0.0
    kinds = ("internal", "external", "coupling")
    return [left, problem.flight, *([getattr(t, kind) for t in e.terms] for kind in kinds)]


def _of_elements(problem: StepProblem, e: Evaluation) -> dict[str, float]:
    """`ratios` of the elements' own unknowns."""
    moved = max(float(np.abs(terms.du).max(initial=0.0)) for terms in e.terms)
    # MPI's maximum may swallow a NaN, so it travels as a flag.
    rows = np.concatenate([np.empty(0), *(p.residual.ravel() for p in e.parts)])
    local = [moved, float(np.isnan(rows).any())]
    for c, part in zip(problem.elements, e.parts, strict=True):
        local += c.largest(part)
    top = global_max(problem.system.comm, np.array(local))
    motion = max(top[0], float(problem.lengths.motion.max()))
    rounded = motion + float(problem.lengths.moved.max())
    sizes, ratio = top[2:].reshape(-1, 4), dict[str, float]()
    # What rounding leaves open in a joint the linear solve passes on to all that its bodies link.
    for of in problem.couplings.mechanisms:
        sizes[of, 3] = sizes[of, 3].max(initial=0.0)
    for c, largest in zip(problem.elements, sizes, strict=True):
        broken = np.inf if top[1] else 0.0
        # Several contacts of two bodies have one name.
        for name, value in c.ratios(largest, motion, rounded, problem.rtol).items():
            ratio[name] = max(value, broken, ratio.get(name, 0.0))
    return ratio
