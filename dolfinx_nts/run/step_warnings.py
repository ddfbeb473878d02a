"""Warnings that a start, an accepted step, or load steps give cause for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinx_nts.bodies.batch import BodyBatch
from dolfinx_nts.bodies.motion import motion_of
from dolfinx_nts.bodies.solid.inversion import describe, smallest_dets
from dolfinx_nts.contact.hidden_facets import hidden_facets
from dolfinx_nts.contact.overlap import OverlapWatch
from dolfinx_nts.contact.pair import INITIAL_PENETRATION
from dolfinx_nts.contact.straight_faces import turn_of_straight_faces
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.interaction.kinematics import FAR_TURN
from dolfinx_nts.parallel import anywhere, global_max, global_sum
from dolfinx_nts.run.solution import Solution
from dolfinx_nts.run.start import incomplete
from dolfinx_nts.solve.instability import releasing_motions
from dolfinx_nts.solve.newton import StepSolver
from dolfinx_nts.start.free_motion import free_motion
from dolfinx_nts.start.massless_start import off_balance, thick_layer
from dolfinx_nts.start.units import doubtful_units
from dolfinx_nts.start.unresolved import tell_unresolved
from dolfinx_nts.state import State
from dolfinx_nts.system import cut_off
from dolfinx_nts.types import FloatArray

#: As `FAR_TURN`, of a flexible body, by its spin: as it turns it stretches, and turns more slowly.
_STRETCHED = 0.95
#: Its spin is measured after 1, 2, 4, 8, 16 steps and then every so many, as it costs 1 % of one.
_SELDOM = 32
#: Turn in a step [rad] below which points hardly leave their straight ways.
_BENT = 0.1
#: Part of an overlap from which on what flat facets cut off a curve is told.
_SAG_TOLD = 0.05
#: Part of that which an overlap has to be, not to be rounding.
_SAG_LEAST = 1e-3


def tell_start(
    solution: Solution, problem: StepProblem, state: State, dt: float, begun: Solution | None,
    moved: tuple[float, str] | None,
) -> None:  # fmt: skip
    """Warn of what a start may not have been meant to be. Collective.

    Args:
        solution: The run.
        problem: Equations of the first step.
        state: The start.
        dt: First step [s].
        begun: Run that this one goes on from.
        moved: How far the start was projected onto its joints, and a sentence.
    """
    system = problem.system
    tell_units(solution, state.time, in_time=True)
    if moved is not None:
        solution.warn("start projected", state.time, *moved)
    doubt = incomplete(begun)
    if doubt:
        solution.warn("start", state.time, 1.0, doubt, grave=True)
    missing, text = off_balance(problem, state, dt)
    if text:
        solution.warn("massless nodes", state.time, missing, text)
    ratio, text = thick_layer(system)
    if text:
        solution.warn("thick layer", state.time, ratio, text)
    fast = tell_unresolved(problem, state, dt)
    if fast:
        solution.warn("unresolved", state.time, *fast)
    masters = [state.u[bodies[-1]] for bodies in system.contact_bodies]
    hidden = hidden_facets(system.contacts, masters)
    if hidden:
        solution.warn("hidden facets", state.time, *hidden)


def tell_step(solution: Solution, problem: StepProblem, step: Evaluation, state: State) -> None:
    """Warn of what an accepted step did that its user may not have meant. Collective.

    Args:
        solution: The run.
        problem: Equations of the step.
        step: Their solution.
        state: At the end of the step.
    """
    _tell_turns(solution, problem, state)
    tell_inversion(solution, problem, step, state)
    tell_couplings(solution, problem, step, state)
    tell_doubts(solution, state)


def tell_doubts(solution: Solution, state: State) -> None:
    """Warn of what bodies themselves doubt in an accepted state. Collective."""
    bodies = solution.system.bodies if solution.system.has_inner else []
    for body, u in zip(bodies, state.u, strict=False):
        _tell(solution, state, body.doubts(u))


def tell_overlap(solution: Solution, watch: OverlapWatch, state: State, *, last: bool) -> None:
    """Warn of bodies inside each other; arguments as of `Stepper.look`. Collective."""
    for found in watch.look(
        state.u, state.time, contacts=state.contacts, edges=state.edges, last=last
    ):
        solution.warn(
            found.kind, state.time, found.depth, found.text, grave=found.grave, about=found.about
        )


def tell_inversion(
    solution: Solution, problem: StepProblem, step: Evaluation, state: State
) -> None:
    """Warn of cells that are inside out, or nearly so. Collective; arguments as of `tell_step`."""
    bodies = problem.system.bodies
    low = np.array([body.low_dets[0] for body in bodies])
    if step.min_det >= low.max(initial=0.0):
        return
    dets = smallest_dets(problem.system, state.u)
    for k in np.flatnonzero(dets < low):
        body, det = bodies[k], float(dets[k])
        text, remedy = describe(body, state.u[k])
        if body.oriented:
            solution.warn(
                "turn of an element", state.time, 1.0 - det, f"{text}; {remedy}", about=(body.name,)
            )
        elif det <= 0.0:
            text += "; what comes after it may be wrong"
            solution.warn("inversion", state.time, -det, text, grave=True)
        else:
            text += "; so near to that the result depends on the mesh"
            solution.warn("crushed cells", state.time, 1.0 - det, text)


def tell_couplings(
    solution: Solution, problem: StepProblem, step: Evaluation, state: State
) -> None:
    """Warn of what contacts and joints tell. Collective; arguments as of `tell_step`."""
    for coupling, parts in problem.couplings.each(step):
        _tell(solution, state, coupling.warnings(parts))


def _tell(solution: Solution, state: State, warnings: Sequence[StepWarning]) -> None:
    for found in warnings:
        solution.warn(
            found.kind, state.time, found.size, found.text, about=found.about, grave=found.grave
        )


def tell_stressed(solution: Solution, time: float) -> None:
    """Warn of bodies whose undeformed state is under stress, as their first step has shown."""
    sizes = {body.name: body.stressed for body in solution.system.bodies}
    found = {name: size for name, size in sizes.items() if size is not None}
    if not found or "stress at rest" in solution.warnings:
        return
    worst, names = max(found.values()), ", ".join(map(repr, found))
    one = len(found) == 1
    solution.warn(
        "stress at rest", time, worst,
        f"{f'body {names} is' if one else f'bodies {names} are'} under a stress of about "
        f"{worst:.2g} of {'its' if one else 'their'} stiffness while undeformed, and "
        f"{'moves by itself' if one else 'move by themselves'}; unless that is meant, let "
        "W(C), where C = F^T F, have dW/dC = 0 at C = 1",
    )  # fmt: skip


def tell_pieces(solution: Solution, time: float) -> None:
    """Warn of solid bodies whose mesh falls into pieces. Collective."""
    found = {body.name: body.pieces for body in solution.system.bodies if body.pieces > 1}
    for name, pieces in found.items():
        solution.warn(
            "pieces", time, pieces,
            f"the mesh of body {name!r} falls into {pieces} pieces that share no node; fuse or "
            "fragment the volumes in Gmsh, or make each a body",
            about=(name,),
        )  # fmt: skip


def tell_straight(solution: Solution, time: float) -> None:
    """Warn of contact surfaces of degree 2 whose faces are straight and seem to be of a curve."""
    surfaces = (s for pair in solution.system.contacts for s in pair.surfaces)
    for surface in {id(s): s for s in surfaces}.values():
        angle, name = np.degrees(turn_of_straight_faces(surface)), surface.body.name
        if angle:
            solution.warn(
                "straight faces", time, angle,
                f"a contact surface of {name!r} has straight faces that turn by {angle:.2g} "
                "degrees from one to the next: if the part is curved, forces and pressures are "
                "those of a polygon; gmsh.model.mesh.setOrder(2) lets cells follow the curve, and "
                "a finer mesh comes nearer to it",
                about=(name,),
            )  # fmt: skip


def tell_units(solution: Solution, time: float, *, in_time: bool) -> None:
    """Warn of bodies whose numbers no one system of units explains. Collective."""
    for name, size, text in doubtful_units(solution.system, in_time=in_time):
        solution.warn("units", time, size, text, about=(name,))


def tell_frictionless(solution: Solution, impulses: FloatArray, time: float) -> None:
    """Warn of restored impulses in contacts with friction, of which they know nothing.

    Args:
        solution: The run.
        impulses: Of each contact [N s], shape (contacts, 3), the same on all ranks.
        time: End of the step [s].
    """
    for pair, impulse in zip(solution.system.contacts, impulses, strict=True):
        size = float(np.linalg.norm(impulse))
        if pair.friction and size:
            solution.warn(
                "impulses without friction", time, size,
                f"impact='restored' has given contact {pair.name!r} an impulse of {size:.3g} "
                f"along its normals, none of friction={pair.friction:.3g}; pass "
                "impact='published' if friction in impacts matters",
            )  # fmt: skip


def _tell_turns(solution: Solution, problem: StepProblem, new: State) -> None:
    """Warn where a body has turned too far in an accepted step. Collective."""
    system, old = problem.system, problem.state
    steps = len(solution.rows) - 1
    often = steps % _SELDOM == 0 or (steps < _SELDOM and steps & (steps - 1) == 0)
    measured = often or "turns" in solution.warnings
    awake: set[int] = set()
    if measured:
        # What has no mass has no spin.
        own = np.array([b.nodal_mass.sum() for b in system.bodies])
        masses = global_sum(system.comm, own)
        awake = set(problem.awake) & set(np.flatnonzero(masses > 0.0).tolist())
    oriented = [body.oriented for body in system.bodies]
    if not (any(oriented) or awake):
        return
    local = np.zeros((2, len(oriented)))
    seen, driven = local
    batches = problem.batches
    ends = (batches.join(state.u) for state in (old, new))
    for body, (k, *_), u0, u1 in zip(batches.bodies, batches.numbers, *ends, strict=True):
        if isinstance(body, BodyBatch):
            seen[body.own] = body.turns(u0, u1)
        elif body.oriented:
            driven[k] = body.prescribed_turn(old.time, new.time)
            seen[k] = body.turn(u0, u1)
        elif k in awake:
            spin = motion_of(body, u1, new.v[k]).spin
            seen[k] = problem.dt * float(np.linalg.norm(spin))
    seen, driven = global_max(system.comm, local)
    turns, far = np.maximum(seen, driven), np.where(oriented, FAR_TURN, _STRETCHED)
    worst = int((turns / far).argmax())
    if turns[worst] > far[worst]:
        name, turn = system.bodies[worst].name, float(turns[worst])
        by = "by" if turn < np.pi else "by at least"
        prescribed = driven[worst] > FAR_TURN
        solution.warn(
            "turns", new.time, turn,
            f"body {name!r} turns {by} {turn:.2g} rad in a step, too far for the angle to be "
            f"right, though {'its places' if prescribed else 'energy and momenta'} may be "
            f"{'as prescribed' if prescribed else 'kept'}; use a smaller dt",
            grave=bool(prescribed),
        )  # fmt: skip
    _tell_corners(solution, problem, new, turns)


def _tell_corners(
    solution: Solution, problem: StepProblem, new: State, turns: FloatArray
) -> None:
    """Warn where points of a rigid body leave the straight ways on which contact is sought.

    A point on an arc of angle phi with chord c leaves the chord by c/2 tan(phi/4). What it meets
    there is missed if it is smaller than that. Collective.

    Args:
        solution: The run.
        problem: Equations of the step.
        new: State at its end.
        turns: Turn in the step of each body [rad], the same on all ranks.
    """
    system, old = problem.system, problem.state
    bodies = [k for k in np.flatnonzero(turns > _BENT).tolist() if system.bodies[k].oriented]
    if not bodies:
        return
    chords = [system.bodies[k].motion_of_points(new.u[k] - old.u[k]) for k in bodies]
    for k, chord in zip(bodies, global_max(system.comm, np.array(chords)), strict=True):
        way = 0.5 * float(chord) * float(np.tan(0.25 * min(turns[k], np.pi)))
        for pair, both in zip(system.contacts, system.contact_bodies, strict=True):
            if k not in both:
                continue
            if len(both) < 2:
                size = pair.master.width
                missed = f"obstacle {pair.master.name!r}, whose radius is {size:.2g}"
            else:
                other = pair.master if k == both[0] else pair.slave
                size = other.smallest
                missed = f"facets of {other.body.name!r} that are {size:.2g} wide"
            if way > size:
                name = system.bodies[k].name
                solution.warn(
                    "cut corners", new.time, way,
                    f"body {name!r} turns by {turns[k]:.2g} rad in a step: its points leave their "
                    f"straight ways by up to {way:.2g}, and contact {pair.name!r}, which is "
                    f"sought on these, may miss {missed}; use a smaller dt",
                    grave=True, about=(pair.name,),
                )  # fmt: skip


def tell_at_rest(
    solution: Solution, solver: StepSolver, step: Evaluation, state: State
) -> None:
    """Warn of motions that nothing resists, and of those that lead away. Collective.

    Args:
        solution: Load steps without stabilization, which would leave such motions at rest.
        solver: Of their equations.
        step: Solution of the last one.
        state: At its end.
    """
    problem, time = solver.problem, state.time
    found = free_motion(problem, solver, step)
    if found:
        solution.warn(
            "free motion", time, 1.0,
            f"{found}: how far it has moved so is chance; hold it by a Dirichlet condition, "
            "a joint or prescribed motion, or pass "
            "stabilization=0.1, which leaves it where it is",
            grave=True,
        )  # fmt: skip
    number = 0 if _slips(solution, state) else releasing_motions(problem, step)
    if number:
        solution.warn(
            "unstable equilibrium", time, float(number),
            f"{number} independent motion{'s' if number > 1 else ''} away from this state "
            f"release{'' if number > 1 else 's'} energy: it is an equilibrium, but not a "
            "stable one, and a small disturbance leads elsewhere, as in buckling or tipping; "
            "to find where, begin with a small displacement= in that direction, or disturb the "
            "loads",
        )  # fmt: skip


def _slips(solution: Solution, state: State) -> bool:
    """Whether nodes slip with friction, whose forces have no potential. Collective."""
    both = zip(solution.system.pairs, state.contacts, strict=True)
    slip = any(p.friction and bool(((c.force > 0.0) & ~c.stick).any()) for p, c in both)
    return anywhere(solution.system.comm, slip)


def tell_cut_off(solution: Solution, state: State) -> None:
    """Warn if an overlap at the start may be that of flat facets, or is partly. Collective."""
    system = solution.system
    for pair, depth in zip(system.contacts, system.penetration(state), strict=True):
        deep, text = float(depth.max(initial=0.0)), cut_off(pair, depth)
        sag = pair.sag(depth > 0.0)
        if not text and sag > _SAG_TOLD * deep > 0.0:
            part = 100.0 * sag / deep
            text = (
                f"flat facets cut {part:.2g} % of that off a curve, by which the pressure may "
                "be wrong: take a finer mesh, or smoothing=True for the master"
            )
        if text and deep > _SAG_LEAST * sag:
            solution.warn(
                "flat facets", state.time, deep,
                f"contact {pair.name!r}: nodes start inside by up to {deep:.3g} of a facet; "
                + text,
                about=(pair.name,),
            )  # fmt: skip


def tell_part_of_loads(
    solution: Solution, problem: StepProblem, state: State, end: float
) -> None:
    """Warn if load steps were asked to end before all of the constant loads act. Collective.

    Args:
        solution: The load steps.
        problem: Their equations.
        state: At their end.
        end: Pseudo time at which they were asked to end.
    """
    now = state.time
    if not now == end < 1.0:
        return
    if problem.loads.grow():
        solution.warn(
            "part of the loads", now, 1.0 - now,
            f"load_steps end at t={now:.6g}, with {100 * now:.3g} % of the constant loads "
            "(gravity and loads that are no functions of time); all of them act at t=1",
        )  # fmt: skip
    depths = solution.system.penetration(state)
    deep = max((float(d.max(initial=0.0)) for d in depths), default=0.0)
    if deep > INITIAL_PENETRATION:
        solution.warn(
            "part of the interference", now, deep,
            f"load_steps end at t={now:.6g}, where {100 * (1.0 - now):.3g} % of the overlap "
            f"at the start is left, up to {deep:.3g} of a facet; none is at t=1",
        )  # fmt: skip
