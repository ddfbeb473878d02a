"""Velocities restored after nodes come into contact (theory section 7; Laursen and Love 2002).

A node that comes into contact within a step is stopped at the surface, and the energy of its
normal motion is lost; so is that of a joint that reaches its limit, and of what a cable stops as it
becomes taut. An impulse along the forces that stopped it gives the energy back, or the
part of it that a coefficient of restitution e leaves. The energy of bodies that touch or are joined
is a parabola in the multiple of these impulses. Its minimum is a plastic impact; what lies above it
is scaled by e^2. The impulses on slave and master are opposite and act at one place, so they
change neither momentum. They act along the normals alone, also where there is friction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact.edge_contact import EdgeElements
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.mass_solves import Saddle, solve_mass
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.constraint_elements import SHIFT
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import StepFailedError

#: What `simulate(impact=...)` may be.
IMPACTS = ("published", "restored")
#: Solves with constraints, each of which leaves the square root of rounding of what they miss.
_SOLVES = 3


class Impact(NamedTuple):
    """What restoring did in a step.

    Attributes:
        state: With the velocities after it.
        energy: What it gave back [J]; negative where the rebound was too high.
        impulses: Of each contact on its slave body [N s] and their moments about the origin
            [N m s], shape (2, contacts, 3).
    """

    state: State
    energy: float
    impulses: FloatArray


def restored(
    problem: StepProblem, step: Evaluation, state: State, restitution: float
) -> Impact | None:
    """The state after impulses on what came to touch, or was stopped, in a step. Collective.

    Args:
        problem: Equations of the step.
        step: Their solution.
        state: The state it leads to.
        restitution: e between 0 and 1.

    Returns:
        None where nothing was.
    """
    contacts = _new(problem, step)
    system, comm = problem.system, problem.system.comm
    local = np.array([[new.push, new.lost] for new in contacts]).reshape(-1, 2)
    pushes, lost = comm.allreduce(local).T
    if not pushes.sum() > 0.0:
        return None
    _refuse_moved(problem, step)
    bodies_of = [new.bodies for new in contacts]
    both = zip(bodies_of, pushes, strict=True)
    groups = _groups(problem, [bodies for bodies, push in both if push > 0.0])
    forces = _forces(problem, contacts)
    change = _response(problem, step, forces)
    # Not the work of the impulses alone: velocities fit the joints in the mean of two steps only.
    momenta = [b.inertia(dv) for b, dv in zip(system.bodies, change, strict=True)]
    local = np.array([
        [float(p @ v), float(p @ dv)] for p, v, dv in zip(momenta, state.v, change, strict=True)
    ])  # fmt: skip
    works = comm.allreduce(local)
    shares, energy = np.zeros(len(groups)), 0.0
    for group in np.unique(groups):
        speed, ease = works[groups == group].sum(axis=0)
        if not ease > 0.0:
            continue
        own = [_group(groups, bodies) == group for bodies in bodies_of]
        plastic = -speed / ease
        above = max(2.0 * float(lost[own].sum()) / ease + plastic**2, 0.0)
        share = plastic + restitution * math.sqrt(above)
        shares[groups == group] = share
        energy += share * (speed + 0.5 * share * ease)
    v = tuple(a + share * dv for a, share, dv in zip(state.v, shares, change, strict=True))
    impulses = np.zeros((len(system.pairs), 2, 3))
    for new, bodies in zip(contacts, bodies_of, strict=True):
        of = _group(groups, bodies)
        share = float(shares[groups == of].max()) if of >= 0 else 0.0
        if new.contact is not None:
            impulses[new.contact] += share * new.impulse
    impulses = system.on_slaves(impulses).swapaxes(0, 1).copy()
    comm.Allreduce(MPI.IN_PLACE, impulses, op=MPI.SUM)
    return Impact(replace(state, v=v), energy, impulses)


def _refuse_moved(problem: StepProblem, step: Evaluation) -> None:
    """Raise where prescribed coordinates move in a step with an impact: their work is unknown."""
    bodies = problem.system.bodies
    moved = [terms.du[b.fixed].any() for b, terms in zip(bodies, step.bodies, strict=True)]
    moves = problem.system.comm.allreduce(np.array(moved, dtype=int))
    if moves.any():
        name = bodies[int(np.argmax(moves))].name
        raise StepFailedError(
            f"step from t={problem.state.time:.6g}: coordinates of body {name!r} move as "
            "prescribed in an impact; use impact='published', or supports at rest",
            advises=True,
        )


def _groups(problem: StepProblem, touched: list[tuple[int, ...]]) -> npt.NDArray[np.int_]:
    """Bodies that new touches, or joints that hold, link have one number; -1: none is free."""
    system = problem.system
    held = [
        system.joint_bodies[k]
        for coupling, numbers in problem.couplings.joints
        for k in numbers if any(map(_holds, coupling.elements))
    ]  # fmt: skip
    free = np.array([body.num_owned - body.fixed.size for body in system.bodies])
    groups = np.where(system.comm.allreduce(free) > 0, np.arange(len(free)), -1)
    for bodies in (*touched, *held):
        linked = {int(groups[b]) for b in bodies} - {-1}
        if linked:
            groups[np.isin(groups, list(linked))] = min(linked)
    return groups


def _holds(batch: Any) -> bool:
    """Whether elements pass impulses on: a spring does not, nor a slack cable."""
    return bool(batch.bilateral and batch.widths["constraints"])


def _group(groups: npt.NDArray[np.int_], bodies: Sequence[int]) -> int:
    """Number of the group that a contact belongs to."""
    return max(int(groups[b]) for b in bodies)


class _New(NamedTuple):
    """The impulses of what came to touch in a step of a contact, or was stopped by a joint.

    Attributes:
        contact: Number of the contact among `System.pairs`; None: a joint.
        bodies: Numbers of its bodies.
        batch: Its elements, which may be those of other joints, too.
        push: Size of the impulses of the step [N s], their sum on this rank.
        rows: Impulses on the coordinates of the batch [N s], shape (elements, coordinates).
        impulse: On the slave's body, and its moment about the origin [N m s], shape (2, 3).
        lost: Energy that they have lost on this rank [J].
    """

    contact: int | None
    bodies: tuple[int, ...]
    batch: Any
    push: float
    rows: FloatArray
    impulse: FloatArray
    lost: float


def _new(problem: StepProblem, step: Evaluation) -> list[_New]:
    """What came to touch in a step, of each contact and joint, the same on all ranks. Collective.

    Of a contact these are nodes, and edges if any are.
    """
    found, rate = [], problem.integrator.rate(problem.dt)
    couplings = problem.couplings
    nodes = [
        (k, batch, part, old.force[batch.candidates.node] > 0.0)
        for k, batch, part, old in couplings.touching(step)
    ]
    edges = [
        (k, c, part, couplings.contacts.edges[k].pressed) for k, c, part in couplings.of_edges(step)
    ]
    for k, batch, part, pressed in (*nodes, *edges):
        new = part.active & ~pressed
        force = np.where(new, -part.multiplier[:, 0], 0.0)
        lost = float(force @ batch.candidates.gap) / problem.factor
        push = rate * force
        rows, impulse = batch.impulse(part, push)
        if isinstance(batch, EdgeElements):
            first = problem.system.contact_bodies[k][0]
            pushed = SimpleNamespace(residual=-rows)
            impulse = batch.resultant(pushed, 0, step.bodies[first].u1)[:2]
        bodies = problem.system.pair_bodies[k]
        found.append(_New(k, bodies, batch, push.sum(), rows, impulse, lost))
    for coupling, numbers, parts in couplings.of_joints(step):
        for batch, part in zip(coupling.elements, parts, strict=True):
            stopped = batch.stopped(part, rate)
            if stopped is None:
                continue
            rows, sizes = stopped.impulses, np.abs(stopped.impulses).sum(axis=1)
            of = batch.joint if len(numbers) > 1 else np.zeros(len(rows), dtype=int)
            for j, number in enumerate(numbers):
                push, lost = (float(each[of == j].sum()) for each in (sizes, stopped.lost))
                bodies = problem.system.joint_bodies[number]
                found.append(_New(None, bodies, batch, push, rows, np.zeros((2, 3)), lost))
    return found


def _forces(problem: StepProblem, contacts: Sequence[_New]) -> list[FloatArray]:
    """Impulses of all contacts on the owned coordinates of each batch of bodies [N s]."""
    pushed = {id(new.batch): new.rows for new in contacts}
    parts = []
    for batch in problem.elements:
        nothing = np.zeros((batch.num_elements, batch.num_coordinates))
        parts.append(SimpleNamespace(residual=pushed.get(id(batch), nothing)))
    force, batches = problem.laid.forces(problem.elements, parts), problem.batches
    out = problem.laid.read(force, [np.zeros(body.num_owned) for body in batches.bodies])
    for body, own in zip(batches.bodies, out, strict=True):
        own[body.fixed] = 0.0
    return out


def _response(
    problem: StepProblem, step: Evaluation, impulses: Sequence[FloatArray]
) -> tuple[FloatArray, ...]:
    """Change of velocities by impulses on batches [m/s], as joints allow it; of each body."""
    batches = problem.batches
    chosen: list[tuple[Any, Any, tuple[int, ...]]] = [
        (batch, part, of)
        for batch, part, of in zip(
            problem.elements, step.parts, problem.couplings.bodies, strict=True
        )
        if _holds(batch)
    ]
    if not chosen:
        both = zip(batches.bodies, impulses, strict=True)
        return batches.split([solve_mass(body, impulse) for body, impulse in both])
    each = zip(batches.bodies, step.terms, strict=True)
    masses = [body.tangent(terms.u1, 1.0, 0.0) for body, terms in each]
    elements, bodies = [batch for batch, _, _ in chosen], [of for _, _, of in chosen]
    laid = Unknowns(batches, range(batches.count), elements, bodies)
    tangents, lent = [], []
    for batch, part, _ in chosen:
        stop, width = batch.num_coordinates, batch.widths["constraints"]
        slope = part.tangent[:, -width:, :stop]
        tangent = np.zeros_like(part.tangent)
        tangent[:, -width:, :stop], tangent[:, :stop, -width:] = slope, slope.transpose(0, 2, 1)
        lend = SHIFT * np.abs(slope).max(axis=2, initial=0.0)
        tangent[:, range(-width, 0), range(-width, 0)] = -lend
        tangents.append(tangent)
        lent.append(lend)
    matrix = StepMatrix(laid.layout, masses, laid.blocks)
    matrix.assemble(tangents)
    right, rows = np.zeros(laid.layout.num_owned), laid.of_elements("constraints")
    laid.write(impulses, right)
    saddle = Saddle(matrix.operator)
    for _ in range(_SOLVES):
        solution = saddle.solve(right)
        own = laid.own_values(solution, elements)
        left = [-a * of["constraints"] for a, of in zip(lent, own, strict=True)]
        right[rows] = laid.own_rows("constraints", elements, left)
    solution[laid.held] = 0.0
    change = batches.split(laid.read(solution, impulses))
    saddle.destroy()
    matrix.destroy()
    laid.destroy()
    return change
