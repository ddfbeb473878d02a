"""A table of numbers that grows row by row: what a run keeps of each of its steps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, overload

import numpy as np

from dolfinx_nts.arrays import FloatArray

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
