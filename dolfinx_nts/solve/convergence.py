"""When the equations of a step count as solved."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.elements import over
from dolfinx_nts.interaction.evaluation import Evaluation, free
from dolfinx_nts.parallel import global_max, global_sum

FloatArray = npt.NDArray[np.float64]

#: Rounding of a sum of elements' forces over the norm of all of them: their own rounding and that
#: of the solution, which the elements' stiffness passes on.
_CANCELLED = 32 * float(np.finfo(float).eps)


def ratios(problem: StepProblem, e: Evaluation) -> dict[str, float]:
    """Residual of each block over what counts as converged there; solved when all are <= 1.

    Collective.
    """
    bodies = problem.system.bodies
    residuals = {k: free(bodies[k], e.bodies[k].residual) for k in problem.awake}
    of_bodies = _over_limits(problem, e, residuals, problem.rounding.forces)
    ratio = dict(zip((b.name for b in bodies), of_bodies, strict=True))
    if problem.laid.own:
        ratio |= _of_elements(problem, e)
    return ratio


def unrest(problem: StepProblem, e: Evaluation) -> tuple[float, str]:
    """Force of the stabilization over what counts as zero, the largest; and its body's name.

    Collective.
    """
    bodies = problem.system.bodies
    held = {k: problem.stabilization.of(bodies[k]) * e.bodies[k].du for k in problem.awake}
    found = _over_limits(problem, e, held, problem.rounding.at(problem.lengths.displacement_of(e)))
    k = int(np.argmax(found))
    return found[k], bodies[k].name


def leaves_work(problem: StepProblem, e: Evaluation, share: float) -> bool:
    """Whether the residual does more work in the step than a part of the forces' work. Collective.

    It is the bodies' part of what the step misses in the ledger.

    Args:
        problem: Equations of the step.
        e: Iterate.
        share: The part, of the largest work of one kind of forces on one body.
    """
    local = np.zeros((len(e.bodies), 6))
    for k in problem.awake:
        t = e.bodies[k]
        left = free(problem.system.bodies[k], t.residual)
        parts = (left, problem.flight[k], t.internal, t.external, t.coupling, t.du)
        local[k] = [float(p @ t.du) for p in parts]
    work = global_sum(problem.system.comm, local)
    rounding = problem.rounding.forces @ np.sqrt(work[:, 5])
    return abs(work[:, 0].sum()) > share * np.abs(work[:, 1:5]).max() + rounding


def _over_limits(
    problem: StepProblem, e: Evaluation, forces: Mapping[int, FloatArray], rounding: FloatArray
) -> list[float]:
    """A force on each body over that which counts as zero there; asleep 0. Collective.

    It is measured by the largest of its inertial, internal, external and coupling forces. Of
    elements' forces that cancel each other, as on a body without mass of note between two springs,
    only the rounding counts, so that strong joints loosen no tolerance.
    """
    squares = np.zeros((len(e.bodies), 6))
    for k in problem.awake:
        t = e.bodies[k]
        parts = (forces[k], problem.flight[k], t.internal, t.external, t.coupling)
        squares[k, :5] = [float(p @ p) for p in parts]
    squares[:, 5] = problem.laid.gross_forces(problem.elements, e.parts, len(e.bodies))
    norms = np.sqrt(global_sum(problem.system.comm, squares))
    limits = problem.rtol * norms[:, 1:5].max(axis=1) + _CANCELLED * norms[:, 5] + rounding
    return [over(a, b) for a, b in zip(norms[:, 0], limits, strict=True)]


def _of_elements(problem: StepProblem, e: Evaluation) -> dict[str, float]:
    """`ratios` of the elements' own unknowns."""
    moved = max(float(np.abs(b.du).max(initial=0.0)) for b in e.bodies)
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
