"""Checkpoints: what a run writes so that it can go on after its process has ended.

The file is described in `dolfinx_nts.output.state_file`; of its `notes` the run has

- `status` and `settings`, see `Record`; `columns`, the names of those of the balance table in their
  order, and the shape of each in a row;
- `counts`: retries, rejected, exceeded, see `Record`;
- `warnings`: the fields of each `RunWarning`;
- `switches`: number, defect, size and worst of `Switches`; the newest are in `switches/time`,
  `contact` (its number in `contacts`), `node`, `facets` and `defect`;
- `contacts`: names of the contacts of these;
- `loads`: of each body the loads and supports that are constant, to tell a restart with others;
- `last`: start and length of the last step [s], or null;
- `promised`: largest energies and rounding that the ledger is held against, and kinetic energy at
  the start of bodies whose motion is prescribed [J]; the largest loss to contact in a step, the end
  of that step and what took most of it;
- `measured`: of each body, diagonals of its matrix and factors, from which rounding is judged;
- `pace`: what `Adapt` remembers, see `PaceMemory`, but its accelerations, which are
  `bodies/K/acceleration`; or null;
- `recent`: lengths of the last two steps [s];
- `stress`: steps, and of each body how much its stress jumped and was, see `LockingWatch.memory`;
- `solver`: the preset of the linear solver in use, the steps for which it still is, MUMPS's
  workspace by preset where it is not the first, and whether constraints of joints repeat each other
  (null: not known yet), see `StepSolver.memory`.

Further arrays of contact K are `unknowns`, whether a node had unknowns in the last step, and
`force_before` p_N [N] of the step before, if there was one.
"""

from __future__ import annotations

import logging
import time
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinx_nts.parallel import on_root, write_on_root
from dolfinx_nts.run.record import Tables, unpacked
from dolfinx_nts.run.solution import Restart
from dolfinx_nts.run.step_size import Pace, PaceMemory
from dolfinx_nts.system import System
from dolfinx_nts.validation import StrPath, as_path, is_whole, known_options, require_positive

if TYPE_CHECKING:
    from dolfinx_nts.run.stepper import Stepper

logger = logging.getLogger(__name__)

#: Notes that are the stepper's.
_MEMORY = ("last", "promised", "measured", "recent", "stress", "solver")


@known_options
@dataclass(frozen=True)
class Checkpoint:
    """Where and how often `simulate` writes what `restart` needs.

    It is also written when the run ends: completed, interrupted, or because a step failed. A kill
    at any moment leaves a whole file: each is written beside its place and renamed, and the one
    before is kept as PATH.previous.

    Attributes:
        path: File; its folder is made. What is there is replaced.
        every: Write after this many steps.
        seconds: Write after the first step that ends this many seconds of wall time after the last
            checkpoint. One of both must be given.

    Raises:
        TypeError: `path` is not a path.
        ValueError: An argument is out of range, or neither cadence is given.
    """

    path: StrPath
    _: KW_ONLY
    every: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        as_path("path", self.path)
        if self.every is None and self.seconds is None:
            raise ValueError("every=None, seconds=None: pass one, e.g. Checkpoint(path, every=100)")
        if self.every is not None and not (is_whole(self.every) and self.every > 0):
            raise ValueError(f"every={self.every!r}: must be a positive whole number of steps")
        if self.seconds is not None:
            require_positive("seconds", self.seconds, "s")


class Saver:
    """Writes the checkpoints of a run; every method is collective.

    Attributes:
        pace: Of the run, if it has one.

    Raises:
        OSError: The file cannot be written.
        TypeError: A joint remembers something that has no place in it.
    """

    def __init__(self, checkpoint: Checkpoint, stepper: Stepper) -> None:
        self._options, self._stepper = checkpoint, stepper
        self._path = Path(checkpoint.path)
        self._steps, self._since = 0, time.monotonic()
        self._saved: Any = None
        self.pace: Pace | None = None
        self._what = f"checkpoint: path={str(self._path)!r}"
        comm = stepper.system.comm
        # A run without checkpoints loads no writers.
        from dolfinx_nts.output import scene_record as scenes
        from dolfinx_nts.output import state_file as files

        write_on_root(comm, self._what, lambda: files.prepare(self._path))
        self._numbering = files.Numbering(stepper.system)
        self._scene, self._loads = scenes.describe(stepper.system), scenes.loads(stepper.system)
        self._numbering.pack(stepper.state, {}, {})

    def step(self) -> None:
        """Write if it is time to, after an accepted step."""
        self._steps += 1
        every, seconds = self._options.every, self._options.seconds
        due = every is not None and self._steps % every == 0
        if seconds is not None and not due:
            waited = time.monotonic() - self._since >= seconds
            due = self._stepper.system.comm.bcast(waited)
        if due:
            self.save()

    def save(self) -> None:
        """Write the last accepted state; if that fails, warn and go on."""
        from dolfinx_nts.output import state_file as files

        stepper, state = self._stepper, self._stepper.state
        if state is self._saved:
            return
        memory = None if self.pace is None else self.pace.memory
        more = {"acceleration": memory.accelerations} if memory else {}
        tables = self._numbering.pack(state, more, stepper.memory.nodal)
        of_record, notes = stepper.solution.packed()
        tables |= of_record
        notes |= {
            "scene": self._scene,
            "loads": self._loads,
            "time": state.time,
            "pace": memory and memory._replace(accelerations=())._asdict(),
            **stepper.memory.numbers,
        }
        try:
            comm = stepper.system.comm
            write_on_root(comm, self._what, lambda: files.write(self._path, tables, notes))
        except OSError as error:
            stepper.solution.warn("checkpoint", state.time, 1.0, str(error))
        else:
            self._saved = state
        # A restart has no matrices of earlier steps: without them here, it is the same run.
        stepper.solver.forget()
        self._since = time.monotonic()


def restart(path: StrPath, system: System) -> Restart:
    """Return what a checkpoint holds, as the `start` of a run that goes on from there. Collective.

    The scene is made anew by the same script:

        run = nts.simulate(
            system, integrator, dt=1e-3, t_end=0.2, start=nts.restart("out/run.h5", system),
            checkpoint=nts.Checkpoint("out/run.h5", every=100),
        )

    With the same options, and checkpoints after the same steps, the run is the uninterrupted one:
    to the bit in serial, else to its tolerance. (Where matrices are kept, they are made anew after
    each checkpoint.) Its balance, warnings and changes of facet go on, and so do equal steps and
    those of `Adapt`. A longer `t_end`, another `dt`, another integrator are legal: it goes on from
    the state then. Obstacles at another place or of another size are refused with their numbers.
    Materials that give the bodies another energy cause the warning "material changed" with what
    they add, constant loads and supports with other values the warning "loads changed". Functions
    are not in the file and must be the same: loads and supports in time, motion of bodies and
    obstacles.
    `contact_fields` are zero until the first step.

    `BalanceCSV` and `ForcesCSV` write the whole table anew; `Fields` goes on with the files in its
    folder, if there are any, and drops the times after the checkpoint. A writer of your own must
    handle a restart itself: `stepper.restart` is not None then.

    Args:
        path: Of the `Checkpoint`. If it cannot be read the one before it is taken, with a warning.
        system: The same scene as that of the run, on any number of ranks.

    Returns:
        The start, with the Solution up to there.

    Raises:
        TypeError: An argument is of another type.
        OSError: There is no checkpoint, or none can be read.
        ValueError: The file is none, or the system has other bodies, meshes, masses, contacts or
            joints.
    """
    from dolfinx_nts.output import scene_record as scenes
    from dolfinx_nts.output import state_file as files

    place = as_path("path", path)
    if not isinstance(system, System):
        raise TypeError(f"system={system!r}: pass the System of the run")
    system.check_alive()
    comm = system.comm
    tables, notes = on_root(comm, lambda: _read(place)) or ({}, {})
    notes = comm.bcast(notes)
    found = scenes.differences(notes["scene"], scenes.describe(system))
    if found:
        raise ValueError(
            f"path={str(path)!r}: was written by another system: {scenes.listed(found)}; make the "
            "system as it was, or start from the Solution of another run"
        )
    numbering = files.Numbering(system)
    numbering.check(tables)
    columns = comm.bcast({k: v for k, v in tables.items() if "balance/" in k or "switches/" in k})
    pace = notes["pace"]
    if pace is not None:
        kept = comm.bcast("bodies/0/acceleration" in tables)
        accelerations = numbering.from_file(tables, "acceleration") if kept else ()
        pace = PaceMemory(**{**pace, "accelerations": accelerations})
    two = len(notes["recent"]) > 1
    before = {"force_before": numbering.nodal(tables, "force_before")} if two else {}
    made = Restart(
        system,
        **unpacked(columns, notes) | {"status": f"restart at t={notes['time']!r}"},
        state=numbering.unpack(tables, notes["time"]),
        memory={name: notes[name] for name in _MEMORY},
        nodal_memory={"unknowns": numbering.nodal(tables, "unknowns")} | before,
        pace=pace,
    )
    changed = scenes.differences(notes["loads"], scenes.loads(system))
    if changed:
        what = scenes.listed(changed)
        text = f"the restart was given other loads, supports or viscosities: {what}"
        made.warn("loads changed", notes["time"], len(changed), text)
    return made


def _read(path: Path) -> tuple[Tables, dict[str, Any]]:
    """The last whole checkpoint; rank 0 only."""
    from dolfinx_nts.output import state_file as files

    try:
        return files.read(path, files.CHECKPOINT)
    except OSError as error:
        try:
            found = files.read(files.previous(path), files.CHECKPOINT)
        except OSError:
            kind = FileNotFoundError if not path.exists() else OSError
            raise kind(
                f"path={str(path)!r}: cannot be read ({error}), nor can the checkpoint before it; "
                "pass the path that Checkpoint had"
            ) from error
        logger.warning("%s cannot be read (%s); going on from the checkpoint before", path, error)
        return found
    except ValueError as error:
        raise ValueError(f"path={str(path)!r}: {error}") from error
