"""Equilibrium of a system: static and quasi-static loading in steps, without inertia."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.parallel import anywhere
from dolfinx_nts.run.arguments import same_run
from dolfinx_nts.run.load_steps import LoadStepper
from dolfinx_nts.run.run_file import Saved
from dolfinx_nts.run.simulate import run
from dolfinx_nts.run.solution import Equilibrium
from dolfinx_nts.run.start import kind_of, of_file
from dolfinx_nts.run.writer import Writer, writers
from dolfinx_nts.solve.accuracy import Newton
from dolfinx_nts.system import System
from dolfinx_nts.types import BeforeStep, FloatArray, Options
from dolfinx_nts.validation import (
    floats,
    is_whole,
    known_options,
    require_bool,
    require_positive,
)


def _remedy(system: System) -> tuple[str, str]:
    """What to do if a load step is not solved, and if a small part is not. Collective."""
    texts = (
        "Try more load steps, or inspect the nodes named here",
        "more load steps hardly help: inspect the nodes named here, or go on in time, with "
        "simulate(..., start=), if there may be no equilibrium near, as where something snaps "
        "through",
    )
    joined = {id(body) for joint in system.joints for body in joint.bodies}
    for body in system.bodies:
        held = anywhere(system.comm, bool(body.fixed.any()))
        if not held and id(body) not in joined:
            held_by = (
                f"; {body.name!r}, which nothing but contact holds, must touch at the start, or "
                "needs stabilization=0.1"
            )
            return texts[0] + held_by, texts[1] + held_by
    return texts


def _pseudo_times(load_steps: Any, begin: float) -> list[float]:
    """End of each load step of an equilibrium that begins at a pseudo time."""
    if is_whole(load_steps):
        if load_steps >= 1 and begin < 1.0:
            n = int(load_steps)
            return [*(begin + (1.0 - begin) * k / n for k in range(1, n)), 1.0]
    elif isinstance(load_steps, Sequence | np.ndarray) and not isinstance(load_steps, str):
        times = floats(load_steps)
        good = times.ndim == 1 and times.size and np.isfinite(times).all()
        if good and (np.diff(times, prepend=begin) > 0).all():
            return [float(t) for t in times]
    after = f"{begin:.6g}, where the start ends" if begin else "0"
    number = "a number of steps >= 1, or " if begin < 1.0 else ""
    raise ValueError(
        f"load_steps={load_steps!r}: pass {number}increasing pseudo times > {after}"
    )


def _begin(start: Any, system: System) -> tuple[Any, float]:
    """What an equilibrium goes on from, and its pseudo time; arguments as of it. Collective."""
    if start is None or not isinstance(system, System):
        return start, 0.0
    found = of_file(start, system)
    if not isinstance(found, Equilibrium) or found.state is None:
        raise TypeError(
            f"start of type {type(start).__name__}: pass the result of equilibrium(...), or "
            "load(...) of one that was saved; to begin where a run in time has ended, pass its "
            "displacements to the bodies, displacement=..."
        )
    return found, found.state.time


def _check_bodies(system: System) -> None:
    for body in system.bodies:
        if type(body).nodal_stiffness is Body.nodal_stiffness:
            raise TypeError(
                f"body {body.name!r} has no nodal_stiffness(): equilibrium needs it, see Body"
            )


@known_options
def equilibrium(
    system: System,
    *,
    load_steps: int | Sequence[float] | FloatArray = 1,
    stabilization: float | None = None,
    newton: Newton | None = None,
    petsc_options: Options | None = None,
    output: Sequence[Writer] = (),
    progress: bool = False,
    watch_overlap: bool = True,
    before_step: BeforeStep | None = None,
    start: Equilibrium | Saved | None = None,
) -> Equilibrium:
    """Equilibrium of a system under its loads, reached in load steps of a pseudo time from 0.

    Constant loads (gravity, body forces, tractions) grow in proportion to the pseudo time and are
    complete at 1; loads and Dirichlet values given as functions of time are taken at the pseudo
    time; constant Dirichlet values hold from the start. Velocities and mass play no part. A load
    step that is not solved is cut, up to `newton.max_retries` times.

    A body that nothing but contact holds has an equilibrium only once the contact is closed: nodes
    that touch at the start count as closed, so a block that stands on its support needs nothing
    more, save conditions against sliding and turning. Where bodies have to find each other first,
    or where directions stay free, pass `stabilization`.

    The ledger closes as the square of the load steps: work is that of the mean of their forces.

    A result is gone on from with `start`, also where it has stopped before its last load step, and
    in another process: `nts.equilibrium(system, load_steps=20, start=nts.load("settled.h5"))`,
    after `settled.save("settled.h5")`. Its load steps are those from its pseudo time on; the state
    is that of one equilibrium with the steps of both. The balance begins anew there.

    A dynamic run starts from the result with the initial velocities of the bodies, at its pseudo
    time, or at the `start_time` of `simulate`, from which its functions of time count. Bodies
    correspond by name, so that what holds them may differ:

        def block(bcs=()):
            return nts.Continuum(mesh, rubber, density=1e3, bcs=bcs, name="block")

        def scene(block):
            pair = nts.ContactPair(slave=block.surface(below), master=floor.surface(above))
            return nts.System([block, floor], contacts=[pair], gravity=(0, 0, -9.81))

        pulled = nts.Dirichlet(top, value=lambda t: (0, 0, -0.02 * t))
        settled = nts.equilibrium(scene(block([pulled])), load_steps=10)
        run = nts.simulate(
            scene(block()), nts.EnergyMomentum(), dt=1e-3, t_end=0.2, start=settled, start_time=0.0
        )

    Args:
        system: The scene.
        load_steps: Number of equal steps from 0, or the pseudo time of `start`, to 1, or the
            increasing pseudo times where they end.
        stabilization: Stiffness, over that of its own, that holds each node where it was while a
            load step is solved that is not solved without it; the step is then repeated until
            nothing of it is left in the forces. 0.1 is a good value.
        newton: Tolerances and retries.
        petsc_options: PETSc options of the step's SNES, without prefix.
        output: Writers, as in `simulate`; all ranks call them after every load step.
        progress: Show a progress line on rank 0.
        watch_overlap: Look whether bodies of a contact end up inside each other, as in `simulate`.
        before_step: Callable (time, dt) before every attempt at a load step, with the pseudo time
            at its start and its length; see `simulate`. Loads of a load step are those at its end.
        start: Equilibrium to go on from, or what `load` has read of one: of bodies by the same
            names, whose supports and obstacles are at its pseudo time where it has left them.

    Returns:
        The Equilibrium; the bodies' u hold it. A run that fails says so in `status` and keeps
        everything computed until then, also where a function of time or `before_step` raises, on
        any rank.

    Raises:
        ValueError: An argument is out of range; before any work.
        OutputError: A writer raised, on any rank; the Equilibrium until then is its `solution`.
    """
    same_run(
        system, load_steps=load_steps, stabilization=stabilization, start=kind_of(start)
    )  # fmt: skip
    start, begin = _begin(start, system)
    times = _pseudo_times(load_steps, begin)
    if stabilization is not None:
        require_positive("stabilization", stabilization, "-")
    require_bool("progress", progress)
    output = writers(output)
    if isinstance(system, System):
        _check_bodies(system)
    stepper = LoadStepper(
        system, float(stabilization or 0.0), times[-1], newton=newton, petsc_options=petsc_options,
        watch_overlap=watch_overlap, before_step=before_step, start=start,
    )  # fmt: skip
    stepper.solution.settings |= {"load_steps": times, "stabilization": stabilization}
    lengths = np.diff(times, prepend=begin).tolist()
    steps = list(zip(lengths, times, strict=True))
    run(stepper, steps, output, progress=progress, remedy=_remedy(system))
    return stepper.solution
