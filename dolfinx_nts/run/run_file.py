"""Runs in files: `Solution.save` and `load`, for what is computed of a run without its scene."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.parallel import write_on_root
from dolfinx_nts.run.record import Record, unpacked
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import Array, Rows
from dolfinx_nts.validation import StrPath, as_path


@dataclass(eq=False, kw_only=True, repr=False)
class Saved(Record):
    """A run as `load` reads it; its tables and sentences are those of `Record`.

    Attributes:
        time: Of the last state [s].
        bodies: Of each body, by its name, arrays of shape (nodes, 3) in the order of its files:
            `reference` X [m], `u` [m], `v` [m/s], and `a` [m/s^2] where the integrator carries any;
            of an equilibrium `rate` [m] and `force` [N], see `Equilibrium`.
        contacts: Of each contact, in their order: `number`, the input numbers of its slave nodes,
            ascending, and for each of them the fields of `ContactHistory`. Then the same of what
            is added to them, see `System.pairs`.
        joints: Of each joint that remembers something, by its name, `number` and `value`.
        scene: Names, kinds and sizes of bodies, contacts and joints.
        versions: Of the packages that made the run.
    """

    time: float
    bodies: Mapping[str, Mapping[str, Array]]
    contacts: tuple[Mapping[str, Array], ...]
    joints: Mapping[str, Mapping[str, Array]]
    scene: Mapping[str, Any]
    versions: Mapping[str, str]

    def tables(self) -> dict[str, Array]:
        """Arrays of the last state by their places in the file."""
        names = [joint["name"] for joint in self.scene["joints"]]
        joints = {names.index(name): found for name, found in self.joints.items()}
        groups = {
            "bodies": dict(enumerate(self.bodies.values())),
            "contacts": dict(enumerate(self.contacts)),
            "joints": joints,
        }
        return {
            f"{kind}/{number}/{name}": values
            for kind, group in groups.items()
            for number, found in group.items()
            for name, values in found.items()
        }

    def plot(self, path: StrPath | None = None) -> Any:
        """Plot energies, ledger and momenta over time.

        Args:
            path: Picture file; its ending chooses the format. None: no file.

        Returns:
            matplotlib's Figure.
        """
        from dolfinx_nts.output.plots import plot_balance

        return plot_balance(self.balance, None if path is None else as_path("path", path))


def save(
    record: Record, system: System, state: State,
    fields: Mapping[str, Sequence[npt.NDArray[np.float64]]], path: Path,
) -> None:  # fmt: skip
    """Write a run, and further fields of its bodies; see `Solution.save`. Collective."""
    from dolfinx_nts.output import scene_record as scenes
    from dolfinx_nts.output import state_file as files
    from dolfinx_nts.output.whole_files import replace_file

    tables = files.Numbering(system).pack(state, fields, {})
    of_record, notes = record.packed()
    tables |= of_record
    notes |= {"scene": scenes.describe(system), "time": state.time, "versions": versions()}
    write_on_root(
        system.comm, f"path={str(path)!r}",
        lambda: replace_file(path, files.image(files.SOLUTION, tables, notes)),
    )  # fmt: skip


def load(path: StrPath) -> Saved:
    """Read what `Solution.save` wrote, without the scene; each rank by itself.

        run = nts.load("out/run.h5")
        print(run.summary)
        heights = run.bodies["ball"]["reference"][:, 2] + run.bodies["ball"]["u"][:, 2]

    Of an equilibrium, `equilibrium` and `simulate` take it as their start. A run in time cannot
    start from it; see `restart`.

    Args:
        path: Of the file.

    Raises:
        TypeError: `path` is not a path.
        OSError: There is no such file, or it cannot be read.
        ValueError: It is another file, or of another version.
    """
    from dolfinx_nts.output import state_file as files

    try:
        tables, notes = files.read(as_path("path", path), files.SOLUTION)
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"path={str(path)!r}: there is no such file; pass the path that Solution.save had"
        ) from error
    except ValueError as error:
        raise ValueError(f"path={str(path)!r}: {error}") from error
    except (OSError, KeyError, RuntimeError) as error:
        raise OSError(f"path={str(path)!r}: cannot be read, it may be damaged ({error})") from error
    scene = notes["scene"]
    groups: dict[str, Rows] = {kind: [{} for _ in scene[kind]] for kind in ("bodies", "joints")}
    # What is added to contacts follows these.
    pairs = {place.split("/")[1] for place in tables if place.startswith("contacts/")}
    groups["contacts"] = [{} for _ in pairs]
    for place, values in tables.items():
        kind, number, *name = place.split("/")
        if kind in groups:
            groups[kind][int(number)][name[0]] = values
    names = {kind: [item["name"] for item in scene[kind]] for kind in ("bodies", "joints")}
    remembered = zip(names["joints"], groups["joints"], strict=True)
    return Saved(
        **unpacked(tables, notes),
        time=notes["time"],
        bodies=dict(zip(names["bodies"], groups["bodies"], strict=True)),
        contacts=tuple(groups["contacts"]),
        joints={name: found for name, found in remembered if found},
        scene=scene,
        versions=notes["versions"],
    )


def versions() -> dict[str, str]:
    """Versions of what makes a run, by name."""
    return {
        "dolfinx_nts": version("dolfinx_nts"),
        "DOLFINx": ".".join(map(str, compat.VERSION)),
        "PETSc": ".".join(map(str, PETSc.Sys.getVersion())),
        "NumPy": np.__version__,
        "Python": platform.python_version(),
    }
