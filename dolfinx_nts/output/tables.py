"""Tables of a run in files: the balance, and the forces of supports, joints and contacts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from dolfinx_nts.ledger import balance as ledger
from dolfinx_nts.ledger import resultants
from dolfinx_nts.output.running import Running
from dolfinx_nts.output.whole_files import extend_file, replace_file
from dolfinx_nts.parallel import write_on_root
from dolfinx_nts.validation import StrPath, as_path

_UNITS = {"time": "s", "min_gap": "m"}
_UNITS |= {"linear_momentum": "kg m/s", "angular_momentum": "kg m^2/s"}
_UNITS |= dict.fromkeys(("active", "stick", "slip", "min_det", "newton_iterations"), "-")


class BalanceCSV:
    """Writes the balance table: a row for the start and at once one per accepted step, all digits.

    The run's warnings follow as lines that begin with "#".

    Args:
        path: File; its folder is made if missing, an existing file is replaced.

    Raises:
        OSError: From `start`, before any step and on all ranks: the file cannot be written.
    """

    def __init__(self, path: StrPath) -> None:
        self.path = as_path("path", path)
        self._open = False

    def start(self, stepper: Running) -> None:
        """Write the header and the row of the initial state."""
        self._rows = 0
        self._columns, header = self._of(stepper)
        line = ",".join(header) + "\n"
        self._root(stepper, lambda: replace_file(self.path, line.encode()))
        self.write(stepper)

    def _of(self, stepper: Running) -> tuple[tuple[str, ...], list[str]]:
        """Columns of the table to write, and their headings."""
        columns, header = ledger.columns(stepper.system), []
        for name in columns:
            unit = _UNITS.get(name, "J")
            vector = np.ndim(stepper.solution.rows[0][name]) > 0
            header += [f"{name}{s} [{unit}]" for s in (("_x", "_y", "_z") if vector else ("",))]
        return columns, header

    def write(self, stepper: Running, *, last: bool = False) -> None:
        """Add the rows of the steps accepted since the last call."""
        self._root(stepper, lambda: self._append(stepper))

    def close(self, stepper: Running) -> None:
        """Add rows that are still missing and the warnings, unless the file could not be written.

        Raises:
            OSError: On rank 0: it can no longer be written.
        """
        if self._open:
            self._append(stepper, (f"# {w}" for w in stepper.solution.warnings.lines))
        self._open = False

    def _append(self, stepper: Running, footer: Iterable[str] = ()) -> None:
        self._open = False
        lines = []
        for row in stepper.solution.rows[self._rows :]:
            cells = np.concatenate([np.ravel(row[name]) for name in self._columns])
            lines.append(",".join(f"{x:.17g}" for x in cells.tolist()))
        extend_file(self.path, "".join(f"{line}\n" for line in (*lines, *footer)).encode())
        self._rows += len(lines)
        self._open = True

    def _root(self, stepper: Running, action: Callable[[], Any]) -> None:
        write_on_root(stepper.system.comm, f"path={str(self.path)!r}", action)


class ForcesCSV(BalanceCSV):
    """Writes the forces of supports, joints and contacts: a row for the start and one per step.

    - Of each body: the force or moment of each of its conditions.
    - Of each joint: force, and moment about its point, on the first of its bodies.
    - Of each contact: force, and moment about the origin, on its slave.

    See `Solution.reactions`, `Solution.contact_forces` and `Solution.contact_moments`.

    Args:
        path: File; its folder is made if missing, an existing file is replaced.

    Raises:
        OSError: From `start`, before any step and on all ranks: the file cannot be written.
    """

    def _of(self, stepper: Running) -> tuple[tuple[str, ...], list[str]]:
        system, header = stepper.system, ["time [s]"]
        joints = system.declared_joints
        columns = [resultants.reactions_of(item) for item in (*system.bodies, *joints)]
        labels = [
            f"{body.name}_{row}_{{}} [{unit}]"
            for body in system.bodies
            for row, unit in body.reaction_labels
        ]
        for joint in joints:
            labels += [f"{joint.name}_force_{{}} [N]", f"{joint.name}_moment_{{}} [N m]"]
        labels += [f"contact_{pair.name}_{{}} [N]" for pair in system.contacts]
        labels += [f"contact_{pair.name}_moment_{{}} [N m]" for pair in system.contacts]
        header += [label.format(axis) for label in labels for axis in "xyz"]
        contacts = (resultants.CONTACT_FORCES, resultants.CONTACT_MOMENTS)
        return ("time", *columns, *contacts), header
