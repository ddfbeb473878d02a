"""The state in which a run begins: where it comes from, and what it must satisfy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.meshes.mesh_check import places_of
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.equations.supports import rates_at_start
from dolfinx_nts.ledger import resultants
from dolfinx_nts.parallel import first_problem, global_max, raise_together
from dolfinx_nts.run.run_file import Saved
from dolfinx_nts.run.solution import Equilibrium, Restart, Solution
from dolfinx_nts.solve.accuracy import Newton
from dolfinx_nts.start import consistent
from dolfinx_nts.start.initial_contact_forces import with_resting_forces
from dolfinx_nts.start.taken_over import is_like, state_from
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray, Options
from dolfinx_nts.validation import UserFunctionError, is_finite

#: Part of the speed of its bodies by which a joint may be violated at the start as meshes do it,
#: whose centre of mass is off the axis of what they stand for.
_OF_MESHES = 1e-3
#: Part of the speed of supports by which a run that goes on may differ from their motion, as it
#: does by the error of its steps.
_JUMP = 0.1


def check_restart(restart: Restart | None, system: System, time: Any, ledger: bool) -> None:
    """Raise a ValueError where a checkpoint cannot be continued as asked.

    Args:
        restart: What to go on from, if it is a checkpoint.
        system: The scene.
        time: `start_time` as given.
        ledger: Whether the ledger is kept.
    """
    if restart is None:
        return
    if restart.system is not system:
        raise ValueError("start: its system is another one; pass the system to restart(...)")
    if time is not None:
        raise ValueError(f"start_time={time!r}: a restart goes on at its own time; leave it out")
    if ledger and np.isnan(restart.rows[-1]["energy"]):
        raise ValueError("ledger=True: the run of the checkpoint kept none; pass ledger=False")


def refuse_overwritten(system: System) -> None:
    """Raise a ValueError on every rank if a caller has written into a body's u, v or mesh.

    A run begins from the body's options or from `start`, so that what was written would be lost;
    mass, surfaces and forces would be of different meshes. Collective.

    Args:
        system: Its bodies, which hold what a run or their own options wrote last.
    """
    for body in system.bodies:
        if body.mesh is None:
            continue
        text = (
            f"mesh of {body.name!r}: its nodes were moved after the body was made; move them "
            "before, or pass displacement= to the body"
        )
        raise_together(system.comm, text if _is_moved(body) else None)
        found = {name: getattr(body, name).x.array.copy() for name in "uv"}
        body.accept(*Body.last_accepted(body))
        both = ((name, getattr(body, name).x.array, old) for name, old in found.items())
        differ = (name for name, a, b in both if not np.array_equal(a, b, equal_nan=True))
        here = next(differ, None)
        option = "displacement" if here == "u" else "velocity"
        raise_together(
            system.comm,
            here
            and f"body {body.name!r}: its {here} was written since it was made or run, which a run "
            f"would drop; it is undone now: pass {option}= to the body, or start= to the run",
        )


def accept(system: System, state: State) -> None:
    """Give bodies a state, and note what their u and v are then, for `refuse_written`."""
    system.take_inner(state.inner)
    batches = system.batches
    ends = (batches.join(values) for values in (state.u, state.v))
    for body, u, v in zip(batches.bodies, *ends, strict=True):
        body.accept(u, v)
    for body, u, v in zip(system.bodies, state.u, state.v, strict=True):
        # A body's own `accept` need not call the base's.
        Body.accept(body, u, v)
        if body.mesh is not None:
            body._shown = tuple(f.x.array.copy() for f in (body.u, body.v))


def refuse_written(system: System, time: float) -> None:
    """Raise on every rank if a caller has written into a body's u, v or mesh. Collective.

    A run goes on from its own state, so that what was written would be lost, but files and
    pictures would show it, and a mesh whose nodes are moved would have other forces. Other runs of
    the same bodies may have written, too.

    Raises:
        UserFunctionError: Something was written; what was into u and v is undone.
    """
    here = None
    for body in system.bodies:
        if _is_moved(body):
            here = here or (
                f"mesh of {body.name!r}: its nodes were moved during the run, at t={time!r}; "
                "move them before the body is made, or add body.u to a copy of them for pictures"
            )
        for k, known in enumerate(body._shown):
            values = (body.u, body.v)[k].x.array
            # The second test, for NaN, takes four times as long.
            same = np.array_equal(values, known) or np.array_equal(values, known, equal_nan=True)
            if here or same:
                continue
            here = (
                f"body {body.name!r}: its {'uv'[k]} was written during the run, at t={time!r} by "
                "before_step, a writer or between two steps; a run does not take it up, and it is "
                "undone now: move nodes by Dirichlet with a function of time, push them by loads "
                "that are functions of time, or start another run from displacement=, velocity="
            )
    found = first_problem(system.comm, here)
    if found is not None:
        for body in system.bodies:
            body.accept(*Body.last_accepted(body))
        raise UserFunctionError(found)


def _is_moved(body: Body) -> bool:
    """Return whether this rank's nodes of a mesh are elsewhere than the body was made with."""
    made = body.made_on
    return bool(made is not None and made != places_of(body.mesh))


def kind_of(start: Any) -> tuple[str, float | None] | None:
    """What ranks compare of a start: its type and its time."""
    state = getattr(start, "state", start)
    return None if start is None else (type(start).__name__, getattr(state, "time", None))


def of_file(start: Any, system: System) -> Any:
    """What a run is to start from: of a file the equilibrium that it holds. Collective.

    Args:
        start: As of `simulate`; what is of no file is returned as it is.
        system: The scene.

    Raises:
        ValueError: The file holds a run in time, or one of another system.
    """
    if not isinstance(start, Saved):
        return start
    from dolfinx_nts.output import scene_record as scenes
    from dolfinx_nts.output import state_file as files

    if "load_steps" not in start.settings:
        raise ValueError(
            "start: the file holds a run in time, whose steps need more than it has; let that run "
            "write a Checkpoint, and pass restart(path, system)"
        )
    found = scenes.differences(start.scene, scenes.describe(system))
    if found:
        raise ValueError(
            f"start: the file is of another system: {scenes.listed(found)}; make the system as it "
            "was, or start from the result itself"
        )
    numbering, tables = files.Numbering(system), start.tables()
    numbering.check(tables)
    return Equilibrium(
        system,
        status=start.status,
        rows=start.rows,
        settings=start.settings,
        state=numbering.unpack(tables, start.time),
        rates=numbering.from_file(tables, "rate"),
        forces=numbering.from_file(tables, "force"),
    )


def first_state(system: System, start: Any, time: Any) -> State:
    """State that `start` and `start_time` of `simulate` ask for."""
    if time is not None and not is_finite(time):
        raise ValueError(f"start_time={time!r}: must be finite [s]")
    if start is None:
        if time is not None:
            raise ValueError(f"start_time={time!r}: pass start=, too, or leave it out")
        return system.initial_state()
    if not (isinstance(start, Solution) and start.state is not None):
        raise TypeError(
            f"start of type {type(start).__name__}: pass the result of equilibrium(...), of "
            "simulate(...) or of restart(...), or load(...) of a saved equilibrium"
        )
    time = None if time is None else float(time)
    return state_from(system, start.system, start.state, moving=start.moving, time=time)


def incomplete(start: Solution | None) -> str | None:
    """What is wrong with an equilibrium that ended before its last load step, or None."""
    # One that is still running is asked for by a writer of its own, which knows.
    fine = ("completed", "running")
    if start is None or start.moving or start.state is None or start.status.startswith(fine):
        return None
    last = start.settings["load_steps"][-1]
    return (
        f"start: the equilibrium that it begins from is not complete: it ended at "
        f"t={start.state.time:.6g} of {last:.6g} ({start.status}), so loads and supports that it "
        "had not reached may act at once; let it complete, e.g. with equilibrium(..., start=it), "
        "more load_steps or stabilization=0.1, and begin from that one"
    )


def refuse_moved(system: System) -> None:
    """Raise a ValueError where something moves as prescribed; the same on all ranks.

    The energy that an impact with it leaves depends on its motion.
    """
    for pair in system.contacts:
        if pair.driven:
            raise ValueError(
                f"impact='restored': obstacle {pair.master.name!r} moves; use impact='published', "
                "or let a heavy rigid body take its place"
            )
    for joint in system.joints:
        if joint.driven:
            raise ValueError(
                f"impact='restored': joint {joint.name!r} is driven; use impact='published'"
            )
    for body in system.bodies:
        if body.driven:
            raise ValueError(
                f"impact='restored': coordinates of body {body.name!r} move as prescribed by a "
                "function of time; use impact='published', or supports at rest, given as vectors"
            )


def carried_forces(system: System, start: Solution | None) -> dict[str, FloatArray]:
    """Resultants of contacts with which a run begins: the last ones of where it goes on from.

    Returns:
        By column of the balance table; without a start none, and of its other contacts zeros.
    """
    if start is None or not len(start.rows):
        return {}
    row, found = start.rows[-1], {}
    for name in resultants.CONTACTS:
        found[name] = np.zeros((len(system.contacts), 3))
        for k, pair in enumerate(system.contacts):
            for j, known in enumerate(start.system.contacts):
                if pair.is_like(known):
                    found[name][k] = row[name][j]
    return found


def with_prescribed_rates(system: System, state: State, dt: float, *, goes_on: bool) -> State:
    """The state with the rates of prescribed motion as velocities there. Collective.

    Args:
        system: The scene.
        state: At the start.
        dt: First step [s].
        goes_on: Whether another run ended there: velocities then stay unless the motion is another
            one.
    """
    v = [v.copy() for v in state.v]
    for body, values in zip(system.bodies, v, strict=True):
        rate = rates_at_start(body, state.time, dt).velocity
        old = values[body.fixed]
        sizes = [np.abs(a).max(initial=0.0) for a in (rate - old, rate, old)]
        off, *size = global_max(system.comm, np.array(sizes)).tolist()
        if not goes_on or off > _JUMP * max(size):
            values[body.fixed] = rate
    return replace(state, v=tuple(v))


def consistent_start(
    problem: StepProblem, state: State, dt: float, *, continues: bool, project: bool
) -> tuple[State, tuple[float, str] | None]:
    """A start that fits the joints. Collective.

    Args:
        problem: Equations of the step.
        state: At the start.
        dt: First step [s].
        continues: Whether another run with these joints ended there. Velocities at the end of a
            step need not fit: they only do in the mean of two steps.
        project: Project velocities that do not fit, however far they are off.

    Returns:
        The start, and where velocities were projected unasked, how far they were off [m/s], and a
        sentence on it.

    Raises:
        ValueError: It does not fit, and its velocities are not to be projected, or cannot be.
    """
    if not problem.system.joints:
        return state, None
    still = tuple(np.zeros_like(v) for v in state.v)
    problem.begin(replace(state, a=state.a or still), dt, sleep=False)
    found = consistent.violation(problem, state, dt, rates=False)
    if found is not None:
        raise ValueError(
            f"joints: at the start {found[1]!r} is off by {found[0]:.3g}; let the bodies' "
            "displacements and prescribed motion, and what the joint prescribes, begin where "
            "it holds"
        )
    found = None if continues else consistent.violation(problem, state, dt, rates=True)
    if found is None:
        return state, None
    far = consistent.violation(problem, state, dt, rates=True, part=_OF_MESHES)
    if far is not None and not project:
        raise ValueError(
            f"velocity: at the start joint {far[1]!r} is violated at a speed of {far[0]:.3g}; "
            "change the bodies' velocities or the prescribed rates so that they fit, or pass "
            "project_start=True"
        )
    state = replace(state, v=consistent.projection(problem, state, dt))
    left = consistent.violation(problem, state, dt, rates=True)
    if left is not None:
        raise ValueError(
            f"velocity: no velocities fit joint {left[1]!r}, which stays violated at a speed of "
            f"{left[0]:.3g}; prescribed motion, or another joint, contradicts it: leave one of "
            "them out"
        )
    text = (
        f"joint {found[1]!r} was violated at a speed of {found[0]:.3g} at the start, as it may be "
        "where a mesh puts a centre of mass beside an axis; the run begins with the nearest "
        "velocities that fit"
    )
    return state, None if project else (found[0], text)


def fitting(
    problem: StepProblem, state: State, dt: float, *, begun: Solution | None, project: bool,
    resting: tuple[Newton, Options],
) -> tuple[State, tuple[float, str] | None]:  # fmt: skip
    """The start with rates of prescribed motion and accelerations, which fits the joints.

    Collective.

    Args:
        problem: Equations of the step.
        state: At the start.
        dt: First step [s].
        begun: Run that this one goes on from.
        project: As of `consistent_start`.
        resting: Arguments of `with_resting_forces`.

    Returns:
        It, and what `consistent_start` has to tell of it.

    Raises:
        StepFailedError: A joint refuses a step of this length.
    """
    goes_on = begun is not None and begun.moving
    state = with_prescribed_rates(problem.system, state, dt, goes_on=goes_on)
    continues = begun is not None and goes_on and _has_joints_of(problem.system, begun.system)
    state, moved = consistent_start(problem, state, dt, continues=continues, project=project)
    if problem.integrator.accelerations and not state.a:
        carried = with_resting_forces(problem, state, dt, *resting)
        state = replace(state, a=consistent.accelerations(problem, carried, dt))
    return state, moved


def _has_joints_of(system: System, known: System) -> bool:
    """Whether each joint of a system is like one of another's."""
    return all(any(is_like(j, other) for other in known.joints) for j in system.joints)
