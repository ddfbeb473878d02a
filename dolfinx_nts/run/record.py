"""What a run has to tell in numbers and sentences, with or without its scene."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, overload

import numpy as np

from dolfinx_nts.ledger import resultants
from dolfinx_nts.ledger.balance import CHANGES, COLUMNS, OF_JOINTS, Switch, Switches
from dolfinx_nts.run.run_warnings import RunWarning, RunWarnings
from dolfinx_nts.types import Array, FloatArray

Row = dict[str, Any]

#: Rows there is room for at first.
_ROOM = 16


class Table(Sequence[Row]):
    """Rows of floats and arrays of floats, kept as one array per column.

    The first row chooses the columns and their shapes. A row is a new dict whenever it is asked
    for: what is done to it leaves the table as it is.

    Args:
        rows: First rows.
    """

    def __init__(self, rows: Iterable[Mapping[str, Any]] = ()) -> None:
        self._columns: dict[str, FloatArray] = {}
        self._room = self._length = 0
        for row in rows:
            self.append(row)

    @classmethod
    def of(cls, columns: Mapping[str, FloatArray]) -> Table:
        """A table of whole columns, all with as many rows."""
        table = cls()
        table._columns = {name: np.array(column, dtype=float) for name, column in columns.items()}
        table._room = table._length = len(next(iter(columns.values())))
        return table

    @property
    def columns(self) -> dict[str, FloatArray]:
        """All columns up to now, see `column`."""
        return {name: self.column(name) for name in self._columns}

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row that has at least the columns of the first."""
        if self._length == self._room:
            self._grow(row)
        for name, column in self._columns.items():
            column[self._length] = row[name]
        self._length += 1

    def _grow(self, row: Mapping[str, Any]) -> None:
        """Make room for a quarter more rows."""
        self._room = max(_ROOM, self._room + self._room // 4)
        for name in self._columns or row:
            column = np.empty((self._room, *np.shape(row[name])))
            if self._length:
                column[: self._length] = self._columns[name]
            self._columns[name] = column

    def column(self, name: str) -> FloatArray:
        """The column up to now, shape (rows, ...): no copy, and read-only."""
        view = self._columns[name][: self._length]
        view.flags.writeable = False
        return view

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> list[Row]: ...
    def __getitem__(self, index: int | slice) -> Row | list[Row]:
        if isinstance(index, slice):
            return [self._row(k) for k in range(self._length)[index]]
        return self._row(range(self._length)[index])

    def _row(self, k: int) -> Row:
        return {
            name: column[k].copy() if column.ndim > 1 else float(column[k])
            for name, column in self._columns.items()
        }


#: Arrays by their place in a file.
Tables = dict[str, Array]

_COUNTS = ("retries", "rejected", "exceeded")
_OF_SWITCHES = ("time", "contact", "node", "facets", "defect")


@dataclass(eq=False, kw_only=True, repr=False)
class Record:
    """What a run has to tell: its balance table, resultants, warnings and how it ended.

    Attributes:
        status: "completed"; "completed, but ..." with what may be wrong in it; or why the run
            stopped and what to do.
        rows: Balance table, one row for the start and one per accepted step; some 150 B each.
        retries: How often a step was dropped and cut.
        rejected: How often a step was dropped for its error and shortened, see `Adapt`.
        exceeded: Steps taken though their motion errs more than `Adapt` asks for: the shortest it
            may take, and those that move nodes out from behind their facets.
        switches: Changes of facet of nodes in contact: the newest 10,000, and sums over all.
        warnings: What the run has to say against its result, by kind; see `RunWarning`.
        settings: What the run was called with, as text and numbers.
    """

    status: str = "running"
    rows: Table = field(default_factory=Table)
    retries: int = 0
    rejected: int = 0
    exceeded: int = 0
    switches: Switches = field(default_factory=Switches)
    warnings: RunWarnings = field(default_factory=RunWarnings)
    settings: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.summary}>"

    def _repr_html_(self) -> str:
        """Summary and a small plot, which Jupyter shows."""
        text = f"<pre>{html.escape(self.summary)}</pre>"
        if len(self.rows) < 2 or np.isnan(self.rows[-1]["energy"]):
            return text
        try:
            from dolfinx_nts.output.plots import picture_of, plot_balance

            image = picture_of(plot_balance(self.balance), dpi=70)
        except ImportError:  # matplotlib is optional
            return text
        source = base64.b64encode(image).decode()
        return f'{text}<img alt="energy, ledger and momenta" src="data:image/png;base64,{source}">'

    @property
    def balance(self) -> dict[str, FloatArray]:
        """Columns of the balance table, shape (rows,) or (rows, 3), identical on all ranks.

        They are read-only and hold the rows up to now.
        """
        columns = self.rows.columns.items()
        return {name: column for name, column in columns if not resultants.is_resultant(name)}

    @property
    def reactions(self) -> dict[str, FloatArray]:
        """Force of each `Dirichlet` condition on each body [N], shape (rows, conditions, 3).

        Of a rigid body those of its prescribed motion: force, then moment of rotation [N m].

        Of each joint, by its name, force [N] and moment about its point [N m] on the first of its
        bodies, shape (rows, 2, 3). They are NaN where elements of one's own do not say them, see
        `Elements.resultant`.

        In dynamics that of each step, with inertia, where the integrator takes its forces; the row
        of the start is zero. A coordinate that two conditions prescribe counts with the later one.
        """
        start, columns = resultants.REACTIONS, self.rows.columns.items()
        return {name.removeprefix(start): c for name, c in columns if name.startswith(start)}

    @property
    def joint_works(self) -> dict[str, dict[str, FloatArray]]:
        """Parts of columns of the balance by joints, by the column's name and the joint's.

            run.joint_works["friction_dissipation"]["hinge friction"][-1]

        Energy since the start [J], shape (rows,): "friction_dissipation", "contact_defect" of
        limits and cables, "external_work" of motors and prescribed motion, and what dampers take.
        """
        columns, end = self.rows.columns, OF_JOINTS
        parts = {
            name.removesuffix(end): c for name, c in columns.items() if name.endswith(end)
        }
        count = next((c.shape[1] for c in parts.values()), 0)
        joints = list(self.reactions)[len(self.reactions) - count :]
        return {name: dict(zip(joints, c.T, strict=True)) for name, c in parts.items()}

    @property
    def contact_forces(self) -> FloatArray:
        """Resultant of each contact on its slave body [N], shape (rows, contacts, 3).

        In dynamics that of each step; with a consistent mass the forces of single steps alternate,
        see `mean_of_two_steps`.
        """
        return self.rows.column(resultants.CONTACT_FORCES)

    @property
    def contact_moments(self) -> FloatArray:
        """Moment of each contact on its slave body about the origin [N m], (rows, contacts, 3).

        Of the forces of `contact_forces`, where their nodes are when the integrator takes them;
        that on the master, if it is a body, is its opposite.
        """
        return self.rows.column(resultants.CONTACT_MOMENTS)

    def mean_of_two_steps(self, values: FloatArray) -> FloatArray:
        """Means of each step and the one before it over their time.

        Forces that hold something at rest, such as reactions, those of limits and of contacts,
        alternate about these from step to step.

            run.mean_of_two_steps(run.reactions["hinge"])[-1]

        Args:
            values: Of each row of the balance table, such as `reactions` of one joint or
                `contact_forces`, shape (rows, ...).

        Returns:
            The same shape. The row of the start and that of the first step are as given.

        Raises:
            ValueError: There are not as many values as rows.
        """
        given = np.asarray(values, dtype=float)
        if len(given) != len(self.rows):
            raise ValueError(f"values of {len(given)} rows: pass one for each of {len(self.rows)}")
        return resultants.mean_of_two_steps(self.rows.column("time"), given)

    @property
    def summary(self) -> str:
        """How the run went in a few lines: steps, energy, changes of facet; equal on all ranks."""
        if not len(self.rows):
            return self.status
        first, last = self.rows[0], self.rows[-1]
        steps = len(self.rows) - 1
        iterations = self.balance["newton_iterations"].sum() / max(steps, 1)
        # What a run that is complete says in its status stands in the lines of its warnings.
        doubtful = self.status.startswith("completed, but")
        status = "completed, but see the warnings" if doubtful else self.status
        # Why it has ended is a sentence by itself.
        then = ": " if status.startswith(("running", "completed")) else "\n"
        lines = [
            f"{status}{then}{steps} steps to t = {last['time']:.6g}, {self.retries} retries, "
            f"{self.rejected} rejected, {iterations:.2f} Newton iterations per step",
        ]
        if np.isnan(last["energy"]):
            lines.append("no ledger was kept")
        else:
            others = {"massless_defect": -1.0} | dict.fromkeys(CHANGES, 1.0)
            # What joints and bodies add are losses.
            others |= dict.fromkeys(self.balance.keys() - set(COLUMNS), -1.0)
            more = "".join(
                f"{' + ' if sign > 0 else ' - '}{name.replace('_', ' ')} {last[name]:.6g}"
                for name, sign in sorted(others.items())
                if last[name]
            )
            lines.append(
                f"energy {first['energy']:.6g} + external work {last['external_work']:.6g} - "
                f"friction {last['friction_dissipation']:.6g} - contact "
                f"{last['contact_defect']:.6g}{more} = {last['energy']:.6g}, "
                f"but for {last['ledger_residual']:.2g}"
            )
        if self.exceeded:
            lines.append(f"{self.exceeded} steps taken though they err more than their tolerance")
        found, worst = self.switches, self.switches.worst
        if worst is not None:
            lines.append(
                f"{found.number} changes of facet: contact defect {found.defect:.3g} in all, "
                f"mean of absolute values {found.size / found.number:.3g}; most "
                f"{worst.defect:.3g} at t = {worst.time:.6g} ({worst.contact}, node "
                f"{worst.node}, facet {worst.facets[0]} to {worst.facets[1]})"
            )
        return "\n".join([*lines, *self.warnings.lines])

    def packed(self) -> tuple[Tables, dict[str, Any]]:
        """Arrays and notes of a file from which `unpacked` makes the fields of a record."""
        newest, switches = list(self.switches), self.switches
        names = list(dict.fromkeys(s.contact for s in newest))
        columns = self.rows.columns
        # One array: making a place in a file takes longer than writing a short column.
        flat = [column.reshape(len(column), -1) for column in columns.values()]
        found: Tables = {"balance/table": np.hstack(flat)}
        found["switches/time"] = np.array([s.time for s in newest])
        found["switches/contact"] = np.array([names.index(s.contact) for s in newest], dtype=int)
        found["switches/node"] = np.array([s.node for s in newest], dtype=int)
        found["switches/facets"] = np.array([s.facets for s in newest], dtype=int).reshape(-1, 2)
        found["switches/defect"] = np.array([s.defect for s in newest])
        return found, {
            "status": self.status,
            "settings": self.settings,
            "columns": {name: column.shape[1:] for name, column in columns.items()},
            "counts": [getattr(self, name) for name in _COUNTS],
            "warnings": [asdict(w) for w in self.warnings.every],
            "switches": [switches.number, switches.defect, switches.size, switches.worst],
            "contacts": names,
        }


def unpacked(tables: Mapping[str, Array], notes: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a record from what `Record.packed` has made, by name."""
    table, shapes = tables["balance/table"], notes["columns"]
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
    flat = np.split(table, ends[:-1], axis=1)
    columns = {
        name: values.reshape(len(table), *shape)
        for (name, shape), values in zip(shapes.items(), flat, strict=True)
    }
    parts = (tables[f"switches/{name}"].tolist() for name in _OF_SWITCHES)
    switches = Switches()
    switches.extend(
        Switch(t, notes["contacts"][k], node, (before, after), defect)
        for t, k, node, (before, after), defect in zip(*parts, strict=True)
    )
    switches.number, switches.defect, switches.size, worst = notes["switches"]
    if worst is not None:
        t, name, node, (before, after), defect = worst
        switches.worst = Switch(t, name, node, (before, after), defect)
    return {
        "status": notes["status"],
        "rows": Table.of(columns),
        "switches": switches,
        "warnings": RunWarnings(
            RunWarning(**w | {"about": tuple(w["about"])}) for w in notes["warnings"]
        ),
        "settings": notes["settings"],
        **dict(zip(_COUNTS, notes["counts"], strict=True)),
    }
