"""Fields of the bodies in files for ParaView.

The writer has the `Writer` protocol, which all ranks call together. Rank 0 alone touches files: it
gathers owned values and orders them by the numbers of the mesh's input, so the files do not depend
on the partition.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.contact.nodal_pressure import pressures
from dolfinx_nts.ledger import contact_fields
from dolfinx_nts.output.own_functions import Own, checked, of_body, require_meshes
from dolfinx_nts.output.running import Cadence, Running
from dolfinx_nts.output.whole_files import Draft, amend_file, replace_file
from dolfinx_nts.parallel import gather_on_root, on_root, write_on_root
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import StrPath, as_path


def _file_name(name: str) -> str:
    """A file name for a body: without folders, and not hidden."""
    return re.sub(r"^\.+|[^\w.-]+", "_", name)


_XDMF_HEAD = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0"><Domain>\n'
    '<Grid Name="{}" GridType="Collection" CollectionType="Temporal">\n'
)
_XDMF_TAIL = "</Grid>\n</Domain></Xdmf>\n"
#: Part of a body's size by which places of its nodes may differ on other ranks.
_ROUNDED = 1e-9
#: XDMF's names of scalars, vectors and tensors.
_RANKS = ("Scalar", "Vector", "Tensor")
_XDMF_TIME = r'<Grid GridType="Uniform"><Time Value="([^"]*)"/>'
#: XDMF's name of DOLFINx's cells and its order of their vertices.
_CELLS = {
    "interval": ('Polyline" NodesPerElement="2', [0, 1]),
    "triangle": ("Triangle", [0, 1, 2]),
    "quadrilateral": ("Quadrilateral", [0, 1, 3, 2]),
    "tetrahedron": ("Tetrahedron", [0, 1, 2, 3]),
    "hexahedron": ("Hexahedron", [0, 1, 3, 2, 4, 5, 7, 6]),
}
#: The same of intervals of degree 2.
_CURVED = ('Polyline" NodesPerElement="3', [0, 2, 1])


def _shape(values: FloatArray) -> tuple[int, ...]:
    """Shape in a file, where a tensor has its rows one after another."""
    return (*values.shape[:1], *([int(np.prod(values.shape[1:]))] if values.ndim > 1 else []))


class _Series:
    """Files of one body: NAME.h5 holds the numbers, NAME.xdmf tells ParaView what they are."""

    def __init__(
        self, body: Body, index: int, contacts: Mapping[str, int], folder: Path,
        functions: Sequence[Own] = (),
    ) -> None:  # fmt: skip
        self.body, self.index, self.contacts, self._functions = body, index, contacts, functions
        self.path = folder / _file_name(body.name)
        self._times = 0
        table = compat.geometry_dofmap(body.mesh)
        self._kind, self._corners = _CELLS[compat.cell_name(body.mesh)]
        if table.shape[1:] == (3,) and len(self._corners) == 2:
            self._kind, self._corners = _CURVED
        # Of solids of degree 2 the corners, whose pressures are means of what is beside them.
        table = table[:, : len(self._corners)]
        blocks, corner = compat.node_blocks(body.mesh, body.space), np.unique(table)
        self._owned = body.space.dofmap.index_map.size_local
        nodes = corner[(blocks[corner] >= 0) & (blocks[corner] < self._owned)]
        self._nodes, self._blocks = nodes, blocks[nodes]
        original = np.asarray(body.mesh.geometry.input_global_indices)
        everywhere = gather_on_root(body.comm, original[nodes])
        numbers, self._order = np.unique(everywhere, return_index=True)
        self._points = self._nodal(body.space.tabulate_dof_coordinates()[: self._owned])
        owned = body.mesh.topology.index_map(body.mesh.topology.dim).size_local
        cells = gather_on_root(body.comm, original[table[:owned]])
        order = gather_on_root(
            body.comm, np.asarray(body.mesh.topology.original_cell_index[:owned], dtype=np.int64)
        )
        self._cell_order = np.argsort(order)
        self._cells = np.searchsorted(numbers, cells[self._cell_order])

    def _nodal(self, values: FloatArray) -> FloatArray:
        """Values of owned blocks in the order of the file, on rank 0."""
        return gather_on_root(self.body.comm, values[self._blocks])[self._order]

    def create(self) -> None:
        """Write the mesh; rank 0 only."""
        import h5py

        image = io.BytesIO()
        with h5py.File(image, "w") as file:
            file["mesh/points"], file["mesh/cells"] = self._points, self._cells[:, self._corners]
        replace_file(Path(f"{self.path}.h5"), image.getvalue())
        head = _XDMF_HEAD.format(self.path.name)
        replace_file(Path(f"{self.path}.xdmf"), (head + _XDMF_TAIL).encode())

    def go_on(self, run: FloatArray, due: bool) -> None:
        """Keep the times of an earlier part of a run up to here; rank 0 only.

        Args:
            run: Times of its balance; the run goes on from the last [s].
            due: Whether that itself is one to be written; else it is there because a part ended.

        Raises:
            OSError: The files cannot be read or written, or are of another mesh or run.
        """
        import h5py

        numbers, path = Path(f"{self.path}.h5"), Path(f"{self.path}.xdmf")
        with h5py.File(numbers, "r") as file:
            known = file["mesh/points"][()] if "mesh/points" in file else np.empty((0, 3))
        # On other ranks DOLFINx rounds the places of nodes otherwise.
        size = np.ptp(self._points, axis=0).max(initial=0.0)
        same = known.shape == self._points.shape
        if not (same and np.abs(known - self._points).max(initial=0.0) <= _ROUNDED * size):
            raise FileExistsError(
                f"folder={str(path.parent)!r}: holds {path.name} with another mesh; pass another "
                "folder for what follows"
            )
        text, until = path.read_text(), run[-1]
        if not text.endswith(_XDMF_TAIL):
            raise FileExistsError(
                f"folder={str(path.parent)!r}: {path.name} is not whole; pass another folder for "
                "what follows"
            )
        times = [(float(m[1]), m.start()) for m in re.finditer(_XDMF_TIME, text)]
        kept = [time for time, _ in times if time < until or (due and time == until)]
        foreign = np.setdiff1d(kept, run)
        if len(foreign):
            raise FileExistsError(
                f"folder={str(path.parent)!r}: {path.name} is of another run, with a time "
                f"{foreign[0]:.6g} that is none of this one's; pass another folder for what "
                "follows"
            )
        if len(kept) < len(times):
            replace_file(path, (text[: times[len(kept)][1]] + _XDMF_TAIL).encode())
        self._times = len(kept)

    def fields(self, stepper: Running) -> dict[str, FloatArray]:
        """Nodal fields of the last accepted state on rank 0; collective."""
        state = stepper.state
        u, v = (self.body.at_mesh(w[self.index]) for w in (state.u, state.v))
        fields = {
            "displacement": self._nodal(u.reshape(-1, 3)),
            "velocity": self._nodal(v.reshape(-1, 3)),
        }
        system, solution = stepper.system, stepper.solution
        found = contact_fields.at_nodes(system, state, solution.contact_loads, self.body)
        for label, k in self.contacts.items():
            slave, mean = system.contacts[k].slave, stepper.mean_force(k)
            pressure = pressures(slave, mean, system.slave_area(k, state))
            for name, values in (("force", mean), ("pressure", pressure)):
                found[f"contact_{name}_mean_{label}"] = contact_fields.spread(
                    slave, 0.0, values, values
                )
        return fields | {name: self._nodal(values) for name, values in found.items()}

    def own(self, taken: Iterable[str]) -> dict[str, tuple[bool, FloatArray]]:
        """The user's functions: whether on cells, and values on rank 0. Collective.

        Args:
            taken: Names of the other fields.
        """
        found = {}
        for name, on_cells, values in of_body(self._functions, self.body, taken):
            here = values if on_cells else values[self._nodes]
            order = self._cell_order if on_cells else self._order
            found[name] = on_cells, gather_on_root(self.body.comm, here)[order]
        return found

    def append(
        self, time: float, fields: Mapping[str, FloatArray],
        own: Mapping[str, tuple[bool, FloatArray]],
    ) -> None:  # fmt: skip
        """Add one time; rank 0 only. Both files are complete and closed afterwards.

        Args:
            time: [s].
            fields: Nodal ones by name.
            own: As of `own`.

        Raises:
            OSError: They cannot be written; the times before are still whole.
        """
        import h5py

        group, numbers = f"{self._times:06d}", Path(f"{self.path}.h5")
        placed = {name: (False, values) for name, values in fields.items()} | dict(own)
        with Draft(open(numbers, "rb")) as draft:
            with h5py.File(draft, "r+") as file:
                if group in file:  # from a call that failed for want of space for the other file
                    del file[group]
                for name, (_, values) in placed.items():
                    file[f"{group}/{name}"] = values.reshape(_shape(values))
            amend_file(numbers, draft.parts)
        cells = self._item("mesh/cells", self._cells.shape, "Int")
        points = self._item("mesh/points", self._points.shape, "Float")
        lines = [
            f'<Grid GridType="Uniform"><Time Value="{time:.17g}"/>',
            f'<Topology TopologyType="{self._kind}" NumberOfElements="{len(self._cells)}">'
            f"{cells}</Topology>",
            f'<Geometry GeometryType="XYZ">{points}</Geometry>',
        ]
        for name, (on_cells, values) in placed.items():
            kind, centre = _RANKS[values.ndim - 1], "Cell" if on_cells else "Node"
            item = self._item(f"{group}/{name}", _shape(values), "Float")
            head = f'<Attribute Name="{name}" AttributeType="{kind}" Center="{centre}">'
            lines.append(f"{head}{item}</Attribute>")
        # One write over the old tail: the file is well-formed whenever the run dies.
        text, path = "\n".join([*lines, "</Grid>", _XDMF_TAIL]).encode(), Path(f"{self.path}.xdmf")
        amend_file(path, [(os.path.getsize(path) - len(_XDMF_TAIL), text)])
        self._times += 1

    def _item(self, dataset: str, shape: tuple[int, ...], number: str) -> str:
        size = " ".join(map(str, shape))
        return (
            f'<DataItem Dimensions="{size}" NumberType="{number}" Precision="8" Format="HDF">'
            f"{self.path.name}.h5:/{dataset}</DataItem>"
        )


class Fields:
    """Writes each body as a time series FOLDER/NAME.xdmf with NAME.h5, readable in ParaView.

    Displacement [m] and velocity [m/s] at the mesh's nodes, and the fields of the body's contacts
    as of `Solution.contact_fields`.

    With a consistent mass the forces of single steps alternate about the right ones, at Courant
    number 1 by a quarter to two fifths of them and more in shorter steps: contact_force_mean and
    contact_pressure_mean are means over the time of the last two steps, where that is nearly gone.

    The initial and the last accepted state are always written, and every time is on disk before the
    run goes on; where it cannot be written (disk full, folder gone), the run ends and all times
    before are whole. Bodies without a mesh are left out. Existing files of the same names are
    replaced, but a run that goes on from a checkpoint goes on with them: times after it are dropped
    and written anew, as in the uninterrupted run.

    Args:
        folder: Where the files go; made if missing.
        every: Write after every `every`-th step, >= 1.
        interval: Instead of `every`: write after the first step that reaches each multiple of this
            time [s].
        functions: More to write: scalars, 3-vectors or 3 x 3 tensors, in cells (DG 0) or at nodes
            (Lagrange 1), under their names. A Function is written with the body on whose mesh it
            is, as it then is; a callable body -> Function such as `dolfinx_nts.von_mises` is
            called of each body with a material whenever fields are written. So pass `von_mises`
            itself: `von_mises(body)` is the stress of now and would be written at all times.

    Raises:
        TypeError: An item of `functions` is none, or, from `start`, a callable returns none.
        ValueError: The cadence is out of range or given twice; from `start`: no body has a mesh,
            two bodies' names give one file, or a Function has no values in cells or at nodes, is on
            no body's mesh, or has the name of another field.
        OSError: From `start`, before any step and on all ranks: the folder cannot be written, or
            what a run from a checkpoint would go on with is of another mesh or run, or is not
            complete.
    """

    def __init__(
        self, folder: StrPath, *, every: int = 1, interval: float | None = None,
        functions: Iterable[Own] = (),
    ) -> None:  # fmt: skip
        self.folder, self._cadence = as_path("folder", folder), Cadence(every, interval)
        self.functions = checked(functions)
        self._series: list[_Series] = []

    def start(self, stepper: Running) -> None:
        """Create the files with the initial state."""
        system, contacts = stepper.system, stepper.system.contacts
        label = contact_fields.labels(system)
        self._series = []
        for i, body in enumerate(system.bodies):
            if body.mesh is not None:
                own = {n: k for k, n in enumerate(label) if contacts[k].slave.body is body}
                self._series.append(_Series(body, i, own, self.folder, self.functions))
        if not self._series:
            raise ValueError(f"folder={str(self.folder)!r}: no body has a mesh; leave Fields out")
        files = [s.path.name for s in self._series]
        if len(set(files)) < len(files):
            raise ValueError(f"name of bodies: file names {files} are not unique; rename a body")
        require_meshes(self.functions, (series.body for series in self._series))
        due = self._cadence.start(stepper)
        if stepper.restart is not None and self._go_on(stepper, due):
            return
        for series in self._series:
            self._root(stepper, series.create)
        self._append(stepper)

    def _go_on(self, stepper: Running, due: bool) -> bool:
        """Go on with the files of an earlier part of the run; tells whether they are there."""
        comm = stepper.system.comm
        files = [Path(f"{s.path}.{kind}") for s in self._series for kind in ("xdmf", "h5")]
        there = comm.bcast([file.exists() for file in files])
        if not any(there):
            return False
        if not all(there):
            raise FileNotFoundError(
                f"folder={str(self.folder)!r}: holds fields of the run, but no "
                f"{files[there.index(False)].name}; put it back, or pass another folder for what "
                "follows"
            )
        times = stepper.solution.rows.column("time")
        self._tried = times[-1] if due else -np.inf
        for series in self._series:
            on_root(comm, partial(series.go_on, times, due))
        return True

    def write(self, stepper: Running, *, last: bool = False) -> None:
        """Write the accepted state if the cadence asks for it, or if it is the last."""
        if self._cadence.due(stepper) or last:
            self._append(stepper)

    def close(self, stepper: Running) -> None:
        """Write the last accepted state of a run that failed."""
        # Unlike an exception, a status is the same on all ranks, so that all come here.
        failed = not stepper.solution.status.startswith(("running", "completed"))
        if self._series and failed and stepper.state.time > self._tried:
            self._append(stepper)

    def _append(self, stepper: Running) -> None:
        self._tried = time = stepper.state.time
        for series in self._series:
            fields = series.fields(stepper)
            own = series.own(fields)
            self._root(stepper, partial(series.append, time, fields, own))

    def _root(self, stepper: Running, action: Callable[[], Any]) -> None:
        write_on_root(stepper.system.comm, f"folder={str(self.folder)!r}", action)
