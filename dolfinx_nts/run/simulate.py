"""The time loop: `simulate` for a whole run."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from typing import Any

from dolfinx_nts.run.arguments import same_run
from dolfinx_nts.run.checkpoint import Checkpoint, Saver
from dolfinx_nts.run.interrupts import Interrupted
from dolfinx_nts.run.paced import paced
from dolfinx_nts.run.progress import progress_bar
from dolfinx_nts.run.run_file import Saved
from dolfinx_nts.run.solution import Solution
from dolfinx_nts.run.start import refuse_written
from dolfinx_nts.run.step_size import Adapt, Pace
from dolfinx_nts.run.stepper import Stepper
from dolfinx_nts.run.writer import Writer, call_here, call_writers, writers
from dolfinx_nts.solve.accuracy import ACCURACY, Newton
from dolfinx_nts.system import System
from dolfinx_nts.types import BeforeStep, Options
from dolfinx_nts.validation import (
    OutputError,
    StepFailedError,
    UserFunctionError,
    known_options,
    require_bool,
    require_one_of,
    require_positive,
)

logger = logging.getLogger(__name__)

#: A step that fails where it is cut to less than this part would hardly pass in shorter ones.
_CUT_FAR = 0.01
#: Order of the integrators whose error `Adapt` knows.
_ADAPTED = 2


@known_options
def simulate(
    system: System,
    integrator: Any,
    *,
    dt: float,
    t_end: float,
    newton: Newton | None = None,
    petsc_options: Options | None = None,
    output: Sequence[Writer] = (),
    progress: bool = False,
    start: Solution | Saved | None = None,
    start_time: float | None = None,
    accuracy: str | None = None,
    sleep: bool = False,
    adapt: Adapt | None = None,
    watch_overlap: bool = True,
    before_step: BeforeStep | None = None,
    project_start: bool = False,
    ledger: bool = True,
    impact: str = "published",
    restitution: float = 1.0,
    checkpoint: Checkpoint | None = None,
) -> Solution:
    """Run a system from t = 0, or from an equilibrium, to t_end.

    Args:
        system: The scene.
        integrator: `EnergyMomentum()`, `Midpoint()`, `Newmark()`, `GeneralizedAlpha()`, or one of
            the user's own with the `Integrator` protocol.
        dt: Largest step [s], > 0; t_end is reached in equal steps unless `adapt` is given. Loads
            given as functions of time are asked once in each: shorter ones may be missed.
        t_end: End of the run [s], > 0.
        newton: Tolerances and retries.
        petsc_options: PETSc options of the step's SNES, without prefix, e.g. {"pc_type":
            "fieldsplit"}.
        output: Writers of `dolfinx_nts.output`, or of one's own with the `Writer` protocol, which
            all ranks call before the first step, after every accepted step and at the end:

                class Heights:
                    def start(self, stepper):
                        self.rows = []
                    def write(self, stepper, *, last=False):
                        centre = nts.motion_of(stepper.system.bodies[0]).centre
                        self.rows.append((stepper.state.time, centre[2]))
                    def close(self, stepper):
                        print(len(self.rows), "steps;", stepper.solution.status)

                heights = Heights()
                run = nts.simulate(system, integrator, dt=1e-3, t_end=0.2, output=[heights])

        progress: Show a progress line on rank 0.
        start: Result of `equilibrium` (see there), also as `load` reads it, or of another run to
            start from; or of `restart`, with which an interrupted run goes on. With the same dt and
            whole steps before and after the result is that of one run, on one rank to the bit where
            no matrices are kept (see `Newton.reuse`) or with `restart`, else to the tolerance. From
            `equilibrium` bodies begin with their `velocity`; from a run or a `restart` they move on
            as there, and their `velocity` and `angular_velocity` are ignored, as `displacement`
            always is.
        start_time: Time at which a run from `start` begins [s], from which functions of time and
            `t_end` count; default: the time of `start`, which is a pseudo time in equilibrium.
        accuracy: In place of `newton`: "exact", the default, closes the ledger to rounding;
            "balanced" to about 1e-8 and "fast" to about 1e-5 of the energy.
        sleep: Leave a body out of a step while its velocity is exactly zero, its forces balance to
            rounding and no contact may reach it; it wakes in the first step in which that ends. The
            solution is the same; a body that has moved hardly ever comes to rest exactly. When a
            caller changes a material during the run, the forces on all sleepers are looked at anew.
        adapt: Choose the steps by their error and by closing gaps.
        watch_overlap: Look whether bodies of a contact end up inside each other, with all of their
            boundaries, or an obstacle in the facets that it is the master of, and warn. It costs
            less than one part in fifty of the steps unless the bodies move by a quarter of a facet
            in few of them.
        before_step: Callable (time, dt) that all ranks call before every attempt at a step, also
            when it is cut or its length chosen anew, with the time at its start [s] and its length
            [s]; the last call before a step is with the step's own. It may change the Constants and
            Functions in a material and in an `extra_form`, here from an old load to a new one in
            0.1 s:

                load = fem.Constant(mesh, 0.0)
                body = nts.Continuum(
                    mesh, rubber, density=1e3, extra_form=lambda u, v, w, t: -load * w[2] * ufl.ds
                )

                def ramp(time, dt):
                    load.value = 2e3 * min((time + dt / 2) / 0.1, 1.0)

                run = nts.simulate(system, nts.EnergyMomentum(), ..., before_step=ramp)

            It should depend on its arguments alone, as steps may be tried again. The first call
            comes before the row of the start. What changes a material's energy later is
            "material_change" in the balance.

        project_start: Start with the nearest velocities, in the kinetic energy, that the joints
            allow. Else a start that violates a joint is refused with its name; one that violates it
            by less than a thousandth of its bodies' speed, as meshes may, is projected with a
            warning.
        ledger: Keep energies, momenta, works and counts in the balance; without it they are NaN
            after the start, and nothing watches over energy and momentum. It costs a few parts in a
            hundred of small scenes' steps.
        impact: "published": nodes that come into contact lose the energy of their normal motion,
            see contact_defect in the balance, and so do joints that reach a limit and cables that
            become taut. "restored": impulses along the forces that stopped them give it back at the
            end of the step, see impact_restored; momenta and gaps stay as they are.
            High frequencies are excited, and contacts open and close more often. For
            `EnergyMomentum()` and `Midpoint()` in equal steps, without prescribed motion. The
            impulses have no tangential part, also where there is friction. They are in
            contact_forces and contact_moments, but not in the reactions of supports and joints nor
            in the fields of nodal contact forces.
        restitution: Of "restored", between 0 (plastic) and 1: root of the part of the energy above
            that of a plastic impact that is left.
        checkpoint: Write what `restart` needs to go on with the run; see `Checkpoint`. One that
            cannot be written causes a warning, and the run goes on.

    Returns:
        The Solution. SIGINT (Ctrl-C) and SIGTERM on any rank end the run after the step that is
        being made, with the status "interrupted: ..."; a second one ends the process as if nothing
        handled it. A run that fails says so in `status` and keeps everything computed until then,
        also where a function of time or `before_step` raises, or returns what it must not, on any
        rank: the run ends there, and all writers are closed. Only one that raises between
        collective calls of its own on some ranks alone makes the others wait for ever.

    Raises:
        TypeError: An argument is of another type.
        ValueError: An argument is out of range; before any work.
        OutputError: A writer raised, on any rank, as on a full disk: the run ends there and its
            Solution is the error's `solution`. A script that does not handle it ends with an exit
            status other than 0. All writers are closed; what they wrote before can be read.
        Exception: Before any step, what the `start` of a writer raises.
    """
    # Of a checkpoint not the path, which rank 0 writes.
    cadence = (getattr(checkpoint, "every", None), getattr(checkpoint, "seconds", None))
    same_run(system, dt=dt, t_end=t_end, accuracy=accuracy, adapt=adapt, checkpoint=cadence)
    require_positive("dt", dt, "s")
    require_positive("t_end", t_end, "s")
    require_bool("progress", progress)
    output = writers(output)
    if not isinstance(adapt, Adapt | None):
        raise TypeError(f"adapt={adapt!r}: pass Adapt(tolerance=...)")
    if adapt is not None and getattr(integrator, "order", _ADAPTED) != _ADAPTED:
        raise ValueError(
            f"adapt={adapt!r}: {integrator!r} is not of second order; leave adapt out, or choose "
            "another integrator"
        )
    if adapt is not None and impact != "published":
        raise ValueError(
            f"adapt={adapt!r}, impact={impact!r}: after impulses the error of a step depends on "
            "rounding; leave one of them out"
        )
    if not isinstance(checkpoint, Checkpoint | None):
        raise TypeError(f"checkpoint={checkpoint!r}: pass Checkpoint(path, every=100)")
    newton = _newton(newton, accuracy)
    stepper = Stepper(
        system, integrator, newton=newton, petsc_options=petsc_options, start=start,
        start_time=start_time, sleep=sleep, watch_overlap=watch_overlap, before_step=before_step,
        project_start=project_start, ledger=ledger, impact=impact, restitution=restitution,
    )  # fmt: skip
    begin = stepper.state.time
    if not t_end > begin:
        raise ValueError(
            f"t_end={t_end!r}: must lie after the start's time {begin!r} [s]; pass a later one, or "
            "begin after an equilibrium with start_time=0.0"
        )
    remedy = (
        "Try a smaller dt",
        "a smaller dt hardly helps: look at what is named here for nodes that two contacts or a "
        "support hold, cells too coarse for it, and loads or speeds that crush them",
    )
    end, dt = float(t_end), float(dt)
    stepper.solution.settings |= {"dt": dt, "t_end": end, "adapt": adapt and repr(adapt)}
    if adapt is not None:
        return run(
            stepper, [(dt, end)], output, progress=progress, remedy=remedy, adapt=adapt,
            checkpoint=checkpoint,
        )  # fmt: skip
    equal = _equal_steps(begin, end, dt)
    if isinstance(start, Solution) and start.moving and start_time is None:
        # The steps of the whole run, to the bit, if it had the same and stopped at the end of one.
        whole = _equal_steps(start.rows[0]["time"], end, dt)
        left = [step for step in whole if step[1] > begin]
        if left and any(time == begin for _, time in whole):
            equal = left
    return run(
        stepper, equal, output, progress=progress, remedy=remedy, checkpoint=checkpoint
    )


def _equal_steps(begin: float, end: float, dt: float) -> list[tuple[float, float]]:
    """Length and end of each step [s], at most dt long.

    A last step much shorter than the others would expel a node that the one before left behind a
    facet with a speed of gap / dt. Where steps of dt meet the end, dt stays as it is to the bit, so
    that a run in two parts has the steps of one.
    """
    steps = max(1, math.ceil((end - begin) / dt * (1 - 1e-9)))
    if not math.isclose(begin + steps * dt, end, rel_tol=1e-15):
        dt = (end - begin) / steps
    return [(dt, begin + (k + 1) * dt) for k in range(steps)]


def _newton(newton: Newton | None, accuracy: str | None) -> Newton | None:
    if accuracy is None:
        return newton
    if newton is not None:
        raise ValueError(f"accuracy={accuracy!r}, newton={newton!r}: pass one of them")
    require_one_of("accuracy", accuracy, ACCURACY)
    return ACCURACY[accuracy]


def run(
    stepper: Stepper, steps: Sequence[tuple[float, float]], output: Sequence[Writer], *,
    progress: bool, remedy: tuple[str, str], adapt: Adapt | None = None,
    checkpoint: Checkpoint | None = None,
) -> Solution:  # fmt: skip
    """Advance to each of the times, write, say how it ended, and free the stepper.

    Args:
        stepper: Stepper that has made no step.
        steps: Length and end of each [s], one after another; with `adapt` the largest and the end.
        output: Writers.
        progress: Show a progress line on rank 0.
        remedy: What to do if a step fails and says nothing better, for `status`, and what if it
            fails as well where it is cut to a small part.
        adapt: How to choose the steps between, each of which is written.
        checkpoint: Where and how often to write what `restart` needs.
    """
    with stepper.interrupts:
        return _run(stepper, steps, output, progress, remedy, adapt, checkpoint)


def _run(
    stepper: Stepper, steps: Sequence[tuple[float, float]], output: Sequence[Writer],
    progress: bool, remedy: tuple[str, str], adapt: Adapt | None, checkpoint: Checkpoint | None,
) -> Solution:  # fmt: skip
    """`run` while signals are noted."""
    solution, root = stepper.solution, stepper.system.comm.rank == 0
    started: list[Writer] = []
    saver = None
    lost: tuple[str | None, BaseException | None] = None, None
    try:
        try:
            saver = None if checkpoint is None else Saver(checkpoint, stepper)
            with progress_bar(None if adapt else len(steps), progress and root) as bar:
                try:
                    signal = _march(stepper, steps, output, started, adapt, bar, saver)
                except Interrupted as within:
                    signal = str(within)
            refuse_written(stepper.system, stepper.state.time)
            stepper.look(last=True)
            if signal is None:
                solution.finish()
            else:
                _stop(stepper, _interrupted(stepper, signal, checkpoint))
        except OutputError as failure:
            _last_look(stepper)
            lost = str(failure), failure.__cause__
        except UserFunctionError as failure:
            _last_look(stepper)
            _stop(stepper, str(failure), failure.__cause__)
        except StepFailedError as failure:
            _last_look(stepper)
            jump = stepper.jumps_at_start(steps[0][0])
            text = solution.worded(str(failure))
            if jump:
                text += f"; {jump}"
            elif not failure.advises:
                whole, cut = remedy
                far = failure.part < _CUT_FAR
                short = f"Steps of {failure.part:.2g} of the length asked for fail, too, so that "
                text += f". {short}{cut}" if far else f". {whole}"
            # The status has all of it, which scripts print.
            headline = text.partition("; ")[0].partition(": ")[0].partition(" (")[0]
            _stop(stepper, text, told=f"{headline}: the run's status says where and what to do")
        except BaseException:
            # Where one rank alone comes here, no other answers.
            call_here(stepper, started, "close")
            raise
        if saver is not None:
            saver.save()
        unclosed = call_writers(stepper, started, "close")
    finally:
        stepper.close()
    problem, cause = lost if lost[0] is not None else unclosed
    if problem is not None:
        _end(solution, problem)
        raise OutputError(solution.status, solution) from cause
    return solution


def _last_look(stepper: Stepper) -> None:
    """Warn if bodies are inside each other where a run stops, which may be why. Collective."""
    try:
        stepper.look(last=True)
    except UserFunctionError:
        # An obstacle whose motion raises again, as the status says.
        logger.debug("no last look for overlaps", exc_info=True)


def _march(
    stepper: Stepper, steps: Sequence[tuple[float, float]], output: Sequence[Writer],
    started: list[Writer], adapt: Adapt | None, bar: Any, saver: Saver | None,
) -> str | None:  # fmt: skip
    """Make the steps and write them; tells the signal that ended them before.

    Arguments as of `run`, and the writers it has started.
    """
    pace, (dt, _) = None, steps[0]
    if bar is not None:
        stepper.note = bar.set_postfix_str
    if adapt is None:
        stepper.start(dt)
    else:
        stepper.start(adapt.shortest * dt)
        begin = stepper.solution.rows[0]["time"]
        pace = Pace(adapt, stepper.system, stepper.state, dt, steps[-1][1] - begin)
        if stepper.restart is not None and stepper.restart.pace is not None:
            pace.resume(stepper.restart.pace)
    if saver is not None:
        saver.pace = pace
    started.extend(output)
    problem, cause = call_writers(stepper, output, "start")
    if problem is not None:
        raise cause or RuntimeError(problem)
    for whole, last in _moves(stepper, steps, pace):
        problem, cause = call_writers(stepper, output, "write", last=last)
        if problem is not None:
            raise OutputError(problem, stepper.solution) from cause
        # A run that went on from a part of a step would not have the steps of the whole run.
        if not whole:
            continue
        if bar is not None:
            row = stepper.solution.rows[-1]
            active, newton = f"{row['active']:.0f}", int(row["newton_iterations"])
            bar.set_postfix(active=active, newton=newton, refresh=False)
            bar.update()
        if saver is not None:
            saver.step()
        signal = stepper.interrupts.seen()
        if signal is not None:
            return signal
    return None


def _interrupted(stepper: Stepper, signal: str, checkpoint: Checkpoint | None) -> str:
    text = f"interrupted: {signal} came before t={stepper.state.time!r}"
    if checkpoint is None:
        lasting = "a Checkpoint" if stepper.solution.moving else "what save() writes of it"
        return f"{text}; go on with start=this solution; {lasting} outlives the process, too"
    return text + f"; go on with start=restart({str(checkpoint.path)!r}, system)"


def _stop(
    stepper: Stepper, reason: str, cause: BaseException | None = None, *, told: str = ""
) -> None:
    """Keep in the status why a run ended, and log it, or what is told, where it is known best."""
    _end(stepper.solution, reason)
    if stepper.system.comm.rank == 0 or cause is not None:
        logger.warning("%s", told or reason)
    if cause is not None:
        logger.debug("where it was raised", exc_info=cause)


def _end(solution: Solution, reason: str) -> None:
    """Keep in the status why a run ended, after what ended it before."""
    ended = solution.status not in ("running", "completed")
    solution.status = f"{solution.status}; {reason}" if ended else reason


def _moves(
    stepper: Stepper, steps: Sequence[tuple[float, float]], pace: Pace | None
) -> Iterator[tuple[bool, bool]]:
    """Advance by one accepted step; tells whether it ends a step asked for, and the run."""
    for k, (dt, time) in enumerate(steps):
        final = k == len(steps) - 1
        if pace is None:
            for whole in stepper.in_parts(dt, end=time):
                yield whole, whole and final
        else:
            for _ in paced(stepper, pace, time):
                yield True, final and stepper.state.time == time
