"""Files of states, checkpoints and saved runs: HDF5, in numberings that do not depend on the ranks.

Version 10, with h5py's names of types:

- attributes `format` ("dolfinx_nts checkpoint" or "dolfinx_nts solution"), `version` (10) and
  `package` (the version that wrote it);
- `notes`: JSON text. `scene` is what `describe` says of the system, `time` t [s]; the rest belongs
  to the run, see `dolfinx_nts.run.checkpoint`;
- `bodies/K/NAME`, of body K of the system, shape (nodes, 3), in the order of `Body.file_order`:
  `reference` X [m], `u` [m], `v` [m/s]; `a` [m/s^2], where the integrator carries any; further
  fields of the run, of an equilibrium `rate` [m] and `force` [N], see `Equilibrium`;
- `inner/K/number` and `inner/K/value`, of body K that has `Body.inner`, one row a cell;
- `contacts/K/NAME`, of contact K, shape (slave nodes, ...): `number`, the input number of the node,
  ascending, and the fields of `ContactHistory`; further ones of the run;
- `edges/K/NAME`, of the edges of contact K that press on each other: the fields of `EdgeHistory`;
- `joints/K/number` and `joints/K/value`, of joint K of `System.joints` that remembers something,
  one row an element;
- `balance/table`, shape (rows, numbers of a row): the columns of the balance table side by side;
- `switches/NAME`: the newest changes of facet, see `dolfinx_nts.run.checkpoint`.

Behind the HDF5 part stand "crc32" and the CRC-32 of that part in four bytes, the lowest first. HDF5
ignores them; `read` refuses a file that does not agree with its checksum.

A checkpoint is written beside its place and then renamed, and the one before is kept as
NAME.previous: whenever a process or a machine stops, one of the two is whole.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import json
import os
import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from dolfinx_nts.output.scene_record import ROUNDED
from dolfinx_nts.parallel import gather_on_root, gather_rows, raise_together
from dolfinx_nts.state import ContactHistory, EdgeHistory, State
from dolfinx_nts.system import System
from dolfinx_nts.types import Array, FloatArray, IntArray

#: Arrays of a file by their place in it, on rank 0; empty elsewhere.
Tables = dict[str, Array]

#: Kinds of files, and the sentence for one that is none.
CHECKPOINT, SOLUTION = "checkpoint", "solution"
_OTHER = {
    CHECKPOINT: "it is no checkpoint; pass the path that Checkpoint had",
    SOLUTION: "it holds no saved run; pass the path that Solution.save had",
}
_VERSION = 10
#: What stands between the HDF5 part and its checksum.
_MARK = b"crc32"


class Numbering:
    """Between the arrays of the ranks and those of the file. Collective."""

    def __init__(self, system: System) -> None:
        self.system, self.comm = system, system.comm
        self._orders, self._counts = [], []
        for body in system.bodies:
            counts = self.comm.gather(body.num_owned // 3)
            self._orders.append(body.file_order())
            self._counts.append(counts)
        self.reference = self.to_file([b.reference for b in system.bodies])

    def to_file(self, values: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the values of each body at all nodes, shape (nodes, 3), on rank 0. Collective."""
        gathered = [gather_on_root(self.comm, v.reshape(-1, 3)) for v in values]
        if self.comm.rank > 0:
            return gathered
        return [rows[order] for rows, order in zip(gathered, self._orders, strict=True)]

    def from_file(self, tables: Tables, name: str) -> tuple[FloatArray, ...]:
        """Return a field of each body at this rank's coordinates. Collective."""
        found = []
        for k, (order, counts) in enumerate(zip(self._orders, self._counts, strict=True)):
            parts = None
            if self.comm.rank == 0:
                rows = np.empty_like(self.reference[k])
                rows[order] = tables[f"bodies/{k}/{name}"]
                parts = np.split(rows, np.cumsum(counts)[:-1])
            found.append(np.ravel(self.comm.scatter(parts)).copy())
        return tuple(found)

    def pack(
        self, state: State, fields: Mapping[str, Sequence[FloatArray]],
        nodal: Mapping[str, Sequence[Array]],
    ) -> Tables:  # fmt: skip
        """Arrays of a state. Collective.

        Args:
            state: The state.
            fields: Further fields of all bodies, or of none.
            nodal: Further arrays of all contacts, one row for each node of `Surface.share`.

        Raises:
            TypeError: A joint remembers something that has no place in the file.
            ValueError: Two elements of a joint have one number.
        """
        fields = {"u": state.u, "v": state.v, "a": state.a, **fields}
        tables: Tables = {}
        for name, values in fields.items():
            for k, rows in enumerate(self.to_file(values) if values else []):
                tables[f"bodies/{k}/{name}"] = rows
        tables |= {f"bodies/{k}/reference": rows for k, rows in enumerate(self.reference)}
        for k, (pair, history) in enumerate(zip(self.system.pairs, state.contacts, strict=True)):
            numbers = pair.slave.original[pair.slave.share]
            more = {name: values[k] for name, values in nodal.items()}
            more |= {"number": numbers, **history._asdict()}
            tables |= self._rows(f"contacts/{k}", more)
        for k, edges in enumerate(state.edges):
            found = {name: gather_on_root(self.comm, v) for name, v in edges._asdict().items()}
            order = np.lexsort(found["pair"].T[::-1]) if self.comm.rank == 0 else []
            tables |= {f"edges/{k}/{name}": rows[order] for name, rows in found.items()}
        for k, values in self._with_inner(state.inner):
            numbers = self.system.bodies[k].inner_numbers
            cells = {"number": numbers, "value": values.reshape(len(numbers), -1)}
            tables |= self._rows(f"inner/{k}", cells)
        for k, joint in enumerate(self.system.joints):
            value = state.joints[k]
            raise_together(self.comm, _misfit(joint, value), TypeError)
            if value is not None:
                found = self._rows(f"joints/{k}", {"number": joint.numbers, "value": value})
                raise_together(self.comm, _repeated(joint.name, found.get(f"joints/{k}/number")))
                tables |= found
        return tables if self.comm.rank == 0 else {}

    def _rows(self, place: str, rows: Mapping[str, Array]) -> Tables:
        found = {name: gather_on_root(self.comm, values) for name, values in rows.items()}
        order = np.argsort(found["number"])
        return {f"{place}/{name}": values[order] for name, values in found.items()}

    def _with_inner(self, values: Sequence[Any]) -> list[tuple[int, Any]]:
        """Numbers of bodies that have `Body.inner`, with values of all bodies, if there are any."""
        bodies = self.system.bodies
        return [(k, v) for k, v in enumerate(values) if bodies[k].has_inner]

    def _inner(self, tables: Tables) -> tuple[FloatArray, ...]:
        """`State.inner` of a file. Collective."""

        def of_body(k: int) -> FloatArray:
            body, names = self.system.bodies[k], ("number", "value")
            rows = self._share(tables, f"inner/{k}", names)
            return self._at(rows, "value", body.inner_numbers, body.name).ravel()

        return self.system.inner_of(of_body)

    def unpack(self, tables: Tables, time: float) -> State:
        """The state of a file. Collective."""
        accelerations = self.comm.bcast("bodies/0/a" in tables)
        joints = [joint.start() for joint in self.system.joints]
        for k, joint in enumerate(self.system.joints):
            rows = self._share(tables, f"joints/{k}", ("number", "value"))
            if rows is not None:
                joints[k] = self._at(rows, "value", joint.numbers, joint.name)
        parts = (self.nodal(tables, name) for name in ContactHistory._fields)
        return State(
            time,
            self.from_file(tables, "u"),
            self.from_file(tables, "v"),
            self.from_file(tables, "a") if accelerations else (),
            contacts=tuple(itertools.starmap(ContactHistory, zip(*parts, strict=True))),
            joints=tuple(joints),
            edges=tuple(self._edges(tables, k) for k in range(len(self.system.contacts))),
            inner=self._inner(tables),
        )

    def _edges(self, tables: Tables, k: int) -> EdgeHistory:
        """What the edges of a contact remember that this rank computes. Collective."""
        rows = self._share(tables, f"edges/{k}", EdgeHistory._fields)
        if k not in self.system.edges or rows is None or not len(rows["pair"]):
            return EdgeHistory.of_start()
        mine = self.system.edges[k].mine[rows["pair"][:, 0]]
        return EdgeHistory(**{name: values[mine] for name, values in rows.items()})

    def nodal(self, tables: Tables, name: str) -> list[Array]:
        """Return an array of each contact at this rank's slave nodes. Collective."""
        found = []
        for k, pair in enumerate(self.system.pairs):
            rows = self._share(tables, f"contacts/{k}", ("number", name))
            numbers = pair.slave.original[pair.slave.share]
            found.append(self._at(rows, name, numbers, pair.name))
        return found

    def _at(
        self, rows: Mapping[str, Array], name: str, numbers: IntArray, whose: str
    ) -> Array:
        """Rows of this rank's elements by their numbers; each has one. Collective.

        Raises:
            ValueError: Elements here and in the file have other numbers, or two have one.
        """
        known, here = rows["number"], np.sort(gather_rows(self.comm, numbers))
        foreign = here[~np.isin(here, known)]
        remedy = "make the system as it was, with the same `numbers`"
        problem = _repeated(whose, known) or _repeated(whose, here)
        if problem is None and len(foreign):
            problem = f"{whose!r}: {int(foreign[0])} is none of its elements or nodes there"
            problem = f"{problem}; {remedy}"
        elif problem is None and len(here) != len(known):
            problem = f"{whose!r}: has {len(known)} elements or nodes there and {len(here)} here"
            problem = f"{problem}; {remedy}"
        if problem is not None:
            raise ValueError(problem)
        return rows[name][np.searchsorted(known, numbers)]

    def _share(self, tables: Tables, place: str, names: Sequence[str]) -> Any:
        here = {n: tables[f"{place}/{n}"] for n in names if f"{place}/{n}" in tables}
        return self.comm.bcast(here or None)

    def check(self, tables: Tables) -> None:
        """Raise on every rank if bodies have other nodes than those in the file. Collective.

        Raises:
            ValueError: They have.
        """
        problem = None
        for k, here in enumerate(self.reference if self.comm.rank == 0 else []):
            off = np.abs(here - tables[f"bodies/{k}/reference"]).max(initial=0.0)
            if not off <= ROUNDED * np.ptp(here, axis=0).max(initial=0.0):
                problem = problem or (
                    f"body {self.system.bodies[k].name!r}: its mesh has other nodes, up to "
                    f"{off:.3g} away, or the same in another order"
                )
        raise_together(self.comm, problem)


def _misfit(joint: Any, value: Any) -> str | None:
    if value is None or (isinstance(value, np.ndarray) and joint.numbers is not None):
        return None
    return (
        f"joint {joint.name!r} remembers a {type(value).__name__}; a checkpoint takes an array "
        "with a row for each element and its attribute `numbers`, see Joint; or leave checkpoint "
        "out"
    )


def _repeated(whose: str, numbers: IntArray | None) -> str | None:
    """Return what is wrong with ascending numbers of elements, if two are equal."""
    twice = [] if numbers is None else numbers[1:][np.diff(numbers) == 0]
    if not len(twice):
        return None
    return (
        f"{whose!r}: two of its elements or nodes have the number {int(twice[0])}; let each have "
        "one of its own on all ranks, see Joint.numbers"
    )


# ---- files
def previous(path: Path) -> Path:
    """Return where the checkpoint before the last one is."""
    return path.with_name(f"{path.name}.previous")


def prepare(path: Path) -> None:
    """Make the folder, and try whether it can be written; rank 0 only.

    Raises:
        OSError: It cannot.
        ImportError: There is no h5py.
    """
    # Before the first step, as it takes longer than ten small checkpoints, and may be missing.
    importlib.import_module("h5py")
    if path.is_dir():
        raise IsADirectoryError("it is a folder; name a file in it")
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.part")
    draft.touch()
    draft.unlink()


def image(kind: str, tables: Tables, notes: Mapping[str, Any]) -> bytes:
    """Content of a file."""
    import h5py

    # In memory, whatever its name.
    with h5py.File(kind, "w", driver="core", backing_store=False) as file:
        file.attrs.update(format=f"dolfinx_nts {kind}", version=_VERSION, package=_package())
        # Numbers may be NumPy's.
        file["notes"] = json.dumps(notes, default=lambda number: number.item())
        for place, values in tables.items():
            file[place] = values
        file.flush()
        data: bytes = file.id.get_file_image()
    return data + _MARK + zlib.crc32(data).to_bytes(4, "little")


@cache
def _package() -> str:
    """Version of this package, which takes a look at the disk."""
    return version("dolfinx_nts")


def write(path: Path, tables: Tables, notes: Mapping[str, Any]) -> None:
    """Write a checkpoint and keep the one before; rank 0 only.

    Raises:
        OSError: It cannot be written; those before are still whole.
    """
    draft = path.with_name(f"{path.name}.part")
    try:
        with open(draft, "wb") as out:
            out.write(image(CHECKPOINT, tables, notes))
            out.flush()
            # Else a machine that stops may leave the new name with nothing behind it.
            os.fsync(out.fileno())
        if path.exists():
            path.replace(previous(path))
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
        raise


def read(path: Path, kind: str) -> tuple[Tables, dict[str, Any]]:
    """Arrays and notes of a file.

    Raises:
        OSError: There is none, it cannot be read, or it is damaged.
        ValueError: It is another file, or of another version.
    """
    import h5py

    tables: Tables = {}
    content = path.read_bytes()
    data, mark, told = content[:-9], content[-9:-4], content[-4:]
    # Before HDF5 sees it, which may not return from a damaged file.
    if mark == _MARK and zlib.crc32(data) != int.from_bytes(told, "little"):
        raise OSError("its checksum is wrong")

    def keep(place: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and place != "notes":
            tables[place] = item[()]

    with h5py.File(io.BytesIO(content), "r") as file:
        if file.attrs.get("format") != f"dolfinx_nts {kind}":
            raise ValueError(_OTHER[kind])
        found = int(file.attrs["version"])
        if found != _VERSION:
            raise ValueError(
                f"its format is version {found}, and this package reads version {_VERSION}; read "
                f"it with dolfinx_nts {file.attrs['package']}"
            )
        if mark != _MARK:
            raise OSError("its checksum is missing")
        notes = json.loads(file["notes"][()])
        file.visititems(keep)
    return tables, notes
