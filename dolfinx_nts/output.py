"""Writers for `simulate(output=[...])`, plots of the balance table, pictures of the bodies.

A writer has `start(stepper)`, `write(stepper, last=...)` and `close(stepper)`, which all ranks call
together. Rank 0 alone touches files: it gathers owned values and orders them by the numbers of the
mesh's input, so the files do not depend on the partition.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from dolfinx_nts import balance as ledger
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact import ContactPair
from dolfinx_nts.discrete_gradient import strain_derivative
from dolfinx_nts.simulate import Stepper
from dolfinx_nts.surfaces import _oriented_nodes
from dolfinx_nts.system import State

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
StrPath = str | os.PathLike[str]
Balance = Mapping[str, FloatArray]


# ---- what the writers share
def _on_root(comm: Any, what: str, action: Callable[[], Any]) -> Any:
    """Result of an action of rank 0, on rank 0; if it fails, every rank raises."""
    result, cause, problem = None, None, None
    if comm.rank == 0:
        try:
            result = action()
        except Exception as error:  # any: a rank left alone in a collective call would hang
            cause, problem = error, (isinstance(error, OSError), f"{error or repr(error)}")
    problem = comm.bcast(problem)
    if problem is None:
        return result
    if not problem[0]:
        raise RuntimeError(f"{what}: rank 0 failed: {problem[1]}") from cause
    raise OSError(
        f"{what}: cannot be written ({problem[1]}); pass a place that exists or can be made, with "
        "space and write permission"
    ) from cause


def _gather(comm: Any, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Rows of all ranks in rank order on rank 0, none elsewhere."""
    parts = comm.gather(rows)
    return rows[:0] if parts is None else np.concatenate([p for p in parts if len(p)] or parts)


def _node_blocks(body: Any) -> IntArray:
    """Block of coordinates of each geometry node of this rank, ghosts included, shape (nodes,)."""
    geometry = compat.geometry_dofmap(body.mesh)
    blocks = np.full(len(body.mesh.geometry.x), -1, dtype=np.int64)
    blocks[geometry] = compat.cell_dofs(body.space)[: len(geometry), : geometry.shape[1]]
    return blocks


def _file_name(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)


# ---- fields
_XDMF_HEAD = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0"><Domain>\n'
    '<Grid Name="{}" GridType="Collection" CollectionType="Temporal">\n'
)
_XDMF_TAIL = "</Grid>\n</Domain></Xdmf>\n"
#: XDMF's name of a cell and its order of DOLFINx's vertices.
_CELLS = {8: ("Hexahedron", [0, 1, 3, 2, 4, 5, 7, 6]), 4: ("Tetrahedron", [0, 1, 2, 3])}


class _Series:
    """Files of one body: NAME.h5 holds the numbers, NAME.xdmf tells ParaView what they are."""

    def __init__(self, body: Any, index: int, contacts: Mapping[str, int], folder: Path) -> None:
        self.body, self.index, self.contacts = body, index, contacts
        self.path = folder / _file_name(body.name)
        self._times = 0
        blocks = _node_blocks(body)
        nodes = np.flatnonzero((blocks >= 0) & (blocks < body.num_owned // 3))
        self._blocks = blocks[nodes]
        original = np.asarray(body.mesh.geometry.input_global_indices)
        numbers, self._order = np.unique(_gather(body.comm, original[nodes]), return_index=True)
        self._points = self._nodal(body.reference.reshape(-1, 3))
        owned = body.mesh.topology.index_map(3).size_local
        cells = _gather(body.comm, original[compat.geometry_dofmap(body.mesh)[:owned]])
        order = _gather(
            body.comm, np.asarray(body.mesh.topology.original_cell_index[:owned], dtype=np.int64)
        )
        self._cells = np.searchsorted(numbers, cells[np.argsort(order)])

    def _nodal(self, values: FloatArray) -> FloatArray:
        """Values of owned blocks in the order of the file, on rank 0."""
        gathered: FloatArray = _gather(self.body.comm, values[self._blocks])[self._order]
        return gathered

    def create(self) -> None:
        """Write the mesh; rank 0 only."""
        import h5py

        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._kind, corners = _CELLS[self._cells.shape[1]]
        with h5py.File(f"{self.path}.h5", "w", locking=False) as file:
            file["mesh/points"], file["mesh/cells"] = self._points, self._cells[:, corners]
        head = _XDMF_HEAD.format(self.path.name)
        Path(f"{self.path}.xdmf").write_bytes((head + _XDMF_TAIL).encode())

    def fields(self, stepper: Stepper) -> dict[str, FloatArray]:
        """Nodal fields of the last accepted state on rank 0; collective."""
        state, owned = stepper.state, self.body.num_owned // 3
        fields = {
            "displacement": self._nodal(state.u[self.index].reshape(-1, 3)),
            "velocity": self._nodal(state.v[self.index].reshape(-1, 3)),
        }
        for label, k in self.contacts.items():
            contact = stepper.system.contacts[k]
            for name, (elsewhere, values) in _contact_fields(contact, state, k).items():
                nodal = np.full(owned, elsewhere)
                nodal[contact.slave.rows[:, 0] // 3] = values
                fields[f"{name}_{label}"] = self._nodal(nodal)
        return fields

    def append(self, time: float, fields: Mapping[str, FloatArray]) -> None:
        """Add one time; rank 0 only. Both files are complete and closed afterwards."""
        import h5py

        group = f"{self._times:06d}"
        with h5py.File(f"{self.path}.h5", "a", locking=False) as file:
            for name, values in fields.items():
                file[f"{group}/{name}"] = values
        cells = self._item("mesh/cells", self._cells.shape, "Int")
        points = self._item("mesh/points", self._points.shape, "Float")
        lines = [
            f'<Grid><Time Value="{time:.17g}"/>',
            f'<Topology TopologyType="{self._kind}" NumberOfElements="{len(self._cells)}">'
            f"{cells}</Topology>",
            f'<Geometry GeometryType="XYZ">{points}</Geometry>',
        ]
        for name, values in fields.items():
            kind = "Vector" if values.ndim == 2 else "Scalar"
            item = self._item(f"{group}/{name}", values.shape, "Float")
            head = f'<Attribute Name="{name}" AttributeType="{kind}" Center="Node">'
            lines.append(f"{head}{item}</Attribute>")
        # One write over the old tail: the file is well-formed whenever the run dies.
        with open(f"{self.path}.xdmf", "r+b") as text:
            text.seek(-len(_XDMF_TAIL), os.SEEK_END)
            text.write("\n".join([*lines, "</Grid>", _XDMF_TAIL]).encode())
        self._times += 1

    def _item(self, dataset: str, shape: tuple[int, ...], number: str) -> str:
        size = " ".join(map(str, shape))
        return (
            f'<DataItem Dimensions="{size}" NumberType="{number}" Precision="8" Format="HDF">'
            f"{self.path.name}.h5:/{dataset}</DataItem>"
        )


def _contact_fields(pair: ContactPair, state: State, k: int) -> dict[str, tuple[float, FloatArray]]:
    """Name -> value elsewhere and values at the owned slave nodes."""
    slave, force, gap = pair.slave, state.force[k], state.gap[k]
    near = np.isfinite(gap)
    return {
        "contact_force": (0.0, force),
        "contact_pressure": (0.0, force / slave.area[slave.owned]),
        "contact_gap": (np.nan, np.where(near, gap, np.nan)),
        "contact_status": (-1.0, np.where(force > 0, 2.0, near.astype(float))),
    }


class Fields:
    """Writes each body as a time series FOLDER/NAME.xdmf with NAME.h5, readable in ParaView.

    Displacement [m] and velocity [m/s] at the mesh's nodes. At the slave body of a contact also,
    with the contact's name appended, contact_force p_N [N], contact_pressure (force per tributary
    reference area) [Pa], contact_gap [m] (NaN where unknown) and contact_status (-1 not a slave
    node, 0 far away, 1 near, 2 in contact). The initial and the last accepted state are always
    written, and every time is on disk before the run goes on. Bodies without a mesh are left out;
    existing files of the same names are replaced.

    Args:
        folder: Where the files go; made if missing.
        every: Write after every `every`-th step, >= 1.
        interval: Instead of `every`: write after the first step that reaches each multiple of this
            time [s].

    Raises:
        ValueError: The cadence is out of range or given twice; from `start`: no body has a mesh,
            or two bodies' names give one file.
        OSError: From `start`, before any step and on all ranks: the folder cannot be written.
    """

    def __init__(self, folder: StrPath, *, every: int = 1, interval: float | None = None) -> None:
        if not isinstance(every, int | np.integer) or isinstance(every, bool) or every < 1:
            raise ValueError(f"every={every!r}: pass a whole number of steps >= 1")
        if interval is not None:
            if not (isinstance(interval, int | float) and 0 < interval < math.inf):
                raise ValueError(f"interval={interval!r}: must be positive and finite [s]")
            if every != 1:
                raise ValueError(f"every={every!r}, interval={interval!r}: pass one of the two")
        self.folder, self.every, self.interval = Path(folder), every, interval
        self._series: list[_Series] = []

    def start(self, stepper: Stepper) -> None:
        """Create the files with the initial state."""
        system, contacts = stepper.system, stepper.system.contacts
        names = [_file_name(c.name) for c in contacts]
        label = [n if names.count(n) == 1 else f"{n}_{k}" for k, n in enumerate(names)]
        self._series = []
        for i, body in enumerate(system.bodies):
            if hasattr(body, "mesh"):
                own = {n: k for k, n in enumerate(label) if contacts[k].slave.body is body}
                self._series.append(_Series(body, i, own, self.folder))
        if not self._series:
            raise ValueError(f"folder={str(self.folder)!r}: no body has a mesh; leave Fields out")
        files = [s.path.name for s in self._series]
        if len(set(files)) < len(files):
            raise ValueError(f"name of bodies: file names {files} are not unique; rename a body")
        for series in self._series:
            self._root(stepper, series.create)
        self._steps, self._next = 0, self.interval or 0.0
        self._append(stepper)

    def write(self, stepper: Stepper, *, last: bool = False) -> None:
        """Write the accepted state if the cadence asks for it, or if it is the last."""
        self._steps += 1
        due = self._steps % self.every == 0
        if self.interval is not None:
            reached = stepper.state.time * (1 + 1e-12)
            due = reached >= self._next
            if due:
                self._next = self.interval * (math.floor(reached / self.interval) + 1)
        if due or last:
            self._append(stepper)

    def close(self, stepper: Stepper) -> None:
        """Write the last accepted state of a run that failed."""
        # Unlike an exception, a status is the same on all ranks, so that all come here.
        failed = stepper.solution.status not in ("running", "completed")
        if self._series and failed and stepper.state.time > self._written:
            self._append(stepper)

    def _append(self, stepper: Stepper) -> None:
        state = stepper.state
        for series in self._series:
            self._root(stepper, partial(series.append, state.time, series.fields(stepper)))
        self._written = state.time

    def _root(self, stepper: Stepper, action: Callable[[], Any]) -> None:
        _on_root(stepper.system.comm, f"folder={str(self.folder)!r}", action)


# ---- balance table
_UNITS = {"time": "s", "min_gap": "m"}
_UNITS |= {"linear_momentum": "kg m/s", "angular_momentum": "kg m^2/s"}
_UNITS |= dict.fromkeys(("active", "stick", "slip", "newton_iterations"), "-")


class BalanceCSV:
    """Writes the balance table: a row for the start and at once one per accepted step, all digits.

    Args:
        path: File; its folder is made if missing, an existing file is replaced.

    Raises:
        OSError: From `start`, before any step and on all ranks: the file cannot be written.
    """

    def __init__(self, path: StrPath) -> None:
        self.path = Path(path)
        self._file: IO[str] | None = None

    def start(self, stepper: Stepper) -> None:
        """Write the header and the row of the initial state."""
        header, self._rows = [], 0
        for name in ledger.COLUMNS:
            unit = _UNITS.get(name, "J")
            vector = np.ndim(stepper.solution.rows[0][name]) > 0
            header += [f"{name}{s} [{unit}]" for s in (("_x", "_y", "_z") if vector else ("",))]

        def create() -> IO[str]:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = open(self.path, "w", encoding="utf-8")
            file.write(",".join(header) + "\n")
            return file

        self._file = _on_root(stepper.system.comm, f"path={str(self.path)!r}", create)
        self.write(stepper)

    def write(self, stepper: Stepper, *, last: bool = False) -> None:
        """Add the rows of the steps accepted since the last call."""
        _on_root(stepper.system.comm, f"path={str(self.path)!r}", lambda: self._append(stepper))

    def close(self, stepper: Stepper) -> None:
        """Add rows that are still missing and close the file."""
        if self._file is not None:
            with self._file:
                self._append(stepper)
            self._file = None

    def _append(self, stepper: Stepper) -> None:
        assert self._file is not None
        for row in stepper.solution.rows[self._rows :]:
            cells = np.concatenate([np.ravel(row[name]) for name in ledger.COLUMNS])
            self._file.write(",".join(f"{x:.17g}" for x in cells.tolist()) + "\n")
            self._rows += 1
        self._file.flush()


# ---- plots of the balance table
class _Panel(NamedTuple):
    """One plot; with `floor`, absolute values on a logarithmic axis, from that value upwards."""

    title: str
    unit: str
    lines: dict[str, FloatArray]
    floor: float | None = None
    steps: bool = False


#: Lower end of logarithmic axes relative to what is compared: nothing below means anything.
_ROUND_OFF = 0.1 * float(np.finfo(float).eps)


def _panels(balance: Balance, several: bool) -> list[_Panel]:
    missing = sorted(set(ledger.COLUMNS) - set(balance))
    if missing:
        raise ValueError(f"balance: columns {missing} are missing; pass Solution.balance")
    if several:
        energy = _Panel("Total energy", "[J]", {"": balance["energy"]})
    else:
        lines = {"total": balance["energy"]} | {n: balance[n] for n in ("kinetic", "potential")}
        energy = _Panel("Energy", "[J]", lines)
    work = {
        name.replace("_", " "): balance[name]
        for name in ("contact_defect", "external_work", "friction_dissipation")
        if name == "contact_defect" or balance[name].any()
    }
    nodes = {
        n: balance[n] for n in ("active", "stick", "slip") if n == "active" or balance[n].any()
    }
    scale = float(np.abs(balance["energy"]).max()) or 1.0
    residual = {"": balance["ledger_residual"] / scale}
    panels = [
        energy,
        _Panel("Ledger residual / largest energy", "[-]", residual, _ROUND_OFF),
        _Panel(", ".join(work).capitalize(), "[J]", work),
        _Panel("Slave nodes in contact", "[-]", nodes, steps=True),
    ]
    for name, unit in (("linear", "kg m/s"), ("angular", "kg m²/s")):
        value = balance[f"{name}_momentum"]
        size = float(np.linalg.norm(value, axis=1).max())
        title = f"Change of {name} momentum (of {size:.3g} {unit})"
        change = {"": np.linalg.norm(value - value[0], axis=1)}
        panels.append(_Panel(title, f"[{unit}]", change, _ROUND_OFF * (size or 1.0)))
    return panels


def plot_balance(balance: Balance, path: StrPath) -> None:
    """Plot energies, ledger residual, defect and work, active nodes, momentum changes over time.

    Call it on one rank; `Solution.plot` sees to that.

    Args:
        balance: `Solution.balance`.
        path: Picture file; its ending chooses the format.

    Raises:
        ValueError: Columns are missing.
    """
    _plot({"": balance}, path)


def compare_balances(balances: Mapping[str, Balance], path: StrPath) -> None:
    """Plot several runs together, e.g. both integrators. Call it on one rank.

    Args:
        balances: Label -> `Solution.balance`.
        path: Picture file; its ending chooses the format.

    Raises:
        ValueError: No run, or columns are missing.
    """
    if not balances:
        raise ValueError(
            f"balances={balances!r}: pass at least one, as {{label: Solution.balance}}"
        )
    _plot(balances, path)


def _plot(balances: Mapping[str, Balance], path: StrPath) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 7.5), constrained_layout=True)
    grid = figure.subplots(3, 2, sharex=True)
    runs = [(run, b["time"], _panels(b, len(balances) > 1)) for run, b in balances.items()]
    for k, axes in enumerate(grid.T.ravel()):
        for r, (run, time, panels) in enumerate(runs):
            _lines(axes, panels[k], time, run, r if len(runs) > 1 else None)
        _style(axes, runs[0][2][k])
        if any(not line.get_label().startswith("_") for line in axes.lines):
            axes.legend(fontsize=8, frameon=False)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]", fontsize=9)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def _lines(axes: Any, panel: _Panel, time: FloatArray, run: str, number: int | None) -> None:
    """Draw a run; of several, the first is the widest so that coinciding ones stay visible."""
    for j, (name, values) in enumerate(panel.lines.items()):
        look: dict[str, Any] = {"color": f"C{j}", "linewidth": 1.4}
        if number is not None:
            look = {"color": f"C{number}", "linestyle": ("-", "--", ":")[j]}
            look["linewidth"] = max(2.6 - 1.4 * number, 1.2)
        alone = number is not None and len(panel.lines) == 1
        shown = panel.title == "Total energy" if alone else bool(name)
        label = ", ".join(filter(None, (run, "" if alone else name))) if shown else "_"
        where = "steps-post" if panel.steps else "default"
        if panel.floor is not None:
            # The start has no change, which a logarithmic axis cannot show.
            time, values = time[1:], np.maximum(np.abs(values[1:]), panel.floor)
        axes.plot(time, values, drawstyle=where, label=label, **look)


def _style(axes: Any, panel: _Panel) -> None:
    axes.set_title(panel.title, fontsize=10, loc="left")
    axes.set_ylabel(panel.unit, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    if panel.floor is not None:
        axes.set_yscale("log")


# ---- pictures of the bodies
def von_mises(body: Any) -> Any:
    """Von Mises measure of the Cauchy stress F 2 dW F^T / J at `body.u`, cell means; collective.

    Args:
        body: Continuum with any material.

    Returns:
        Function of degree 0 [Pa].
    """
    space = compat.scalar_space(body.mesh, "DG", 0)
    f = ufl.Identity(3) + ufl.grad(body.u)
    cauchy = f * (2 * strain_derivative(body.material, f.T * f)) * f.T / ufl.det(f)
    deviator = ufl.dev(cauchy)
    q = ufl.TestFunction(space)
    dx = ufl.Measure("dx", body.mesh, metadata={"quadrature_degree": 2 * body.degree})
    size = ufl.sqrt(1.5 * ufl.inner(deviator, deviator))
    forms = compat.compile_forms([size * q * dx, q * dx])
    result, vector = fem.Function(space, name="von_mises"), compat.create_vector(space)
    owned = space.dofmap.index_map.size_local
    for form, power in zip(forms, (1.0, -1.0), strict=True):
        compat.assemble_vector(vector, form)
        part = vector.array_r**power
        result.x.array[:owned] = part if power > 0 else part * result.x.array[:owned]
    vector.destroy()
    result.x.scatter_forward()
    return result


def picture(
    bodies: Sequence[Any],
    path: StrPath,
    *,
    colour: str = "speed",
    title: str = "",
    labels: bool = False,
    view: tuple[float, float] = (22.0, -60.0),
    limits: tuple[float, float] | None = None,
    width: float = 7.0,
) -> None:
    """Draw the boundary of the deformed bodies; every rank calls it, rank 0 writes.

    Args:
        bodies: Continua; they are drawn in the state of `body.u`, `body.v`.
        path: Picture file; its ending chooses the format.
        colour: "speed" |v| [m/s] or "stress" (von Mises of the Cauchy stress) [Pa].
        title: Text above the picture.
        labels: Whether to write the bodies' names beside them.
        view: Elevation above the x-y plane and azimuth from the x axis, of the viewer [degrees].
        limits: Ends of the colour scale, e.g. equal ones for all pictures of a run.
        width: Of the bodies on paper [inch]; 200 dots per inch.

    Raises:
        TypeError: A body without a mesh.
        ValueError: Unknown colour, no body, or an argument out of range.
        OSError: On all ranks: the file cannot be written.
    """
    _check_picture(bodies, colour, view, limits, width)
    comm = bodies[0].comm
    drawn = []
    for body in bodies:
        corners, values = _coloured_facets(body, colour)
        corners = corners @ _axes_of(*view).T
        drawn.append(_Drawn(body.name, _gather(comm, corners), _gather(comm, values)))

    def draw() -> None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure, axes = _figure(drawn, width, title)
        scale = _colour_scale(drawn, colour, limits)
        axes.add_collection(_painted(drawn, scale))
        _furnish(figure, axes, scale, _COLOURS[colour][1], view, drawn if labels else ())
        figure.savefig(path, dpi=200, bbox_inches="tight", pad_inches=0.05)

    _on_root(comm, f"path={str(path)!r}", draw)


def _check_picture(
    bodies: Sequence[Any], colour: str, view: Any, limits: Any, width: float
) -> None:
    if colour not in _COLOURS:
        raise ValueError(f"colour={colour!r}: choose one of {', '.join(map(repr, _COLOURS))}")
    if not bodies:
        raise ValueError(f"bodies={bodies!r}: pass at least one")
    for name, values in (("view", view), ("limits", limits or (0, 1))):
        if np.shape(values) != (2,) or not np.isfinite(values).all():
            raise ValueError(f"{name}={values!r}: pass two finite numbers")
    for body in bodies:
        if not hasattr(body, "mesh"):
            raise TypeError(f"bodies: {body!r} has no mesh; pass Continuum bodies")
    if limits is not None and limits[0] >= limits[1]:
        raise ValueError(f"limits={limits!r}: the first must be below the second")
    if not (math.isfinite(width) and width > 0):
        raise ValueError(f"width={width!r}: must be positive and finite [inch]")


class _Drawn(NamedTuple):
    """Facets of a body as the viewer sees them.

    Attributes:
        name: Of the body.
        corners: Coordinates right, up and towards the viewer [m], shape (m, 4, 3).
        values: What is coloured, at the corners, shape (m, 4).
    """

    name: str
    corners: FloatArray
    values: FloatArray


_COLOURS = {"speed": ("viridis", "speed [m/s]"), "stress": ("plasma", "von Mises stress [Pa]")}


def _coloured_facets(body: Any, colour: str) -> tuple[FloatArray, FloatArray]:
    """This rank's boundary facets.

    Returns:
        Deformed corners [m], shape (m, 4, 3), a triangle's last one twice, and the values there,
        shape (m, 4).
    """
    mesh, local = body.mesh, compat.exterior_facets(body.mesh)
    nodes = _oriented_nodes(mesh, local)[:, [0, 1, 2, -1]]
    blocks = _node_blocks(body)[nodes]
    corners = mesh.geometry.x[nodes] + body.u.x.array.reshape(-1, 3)[blocks]
    if colour == "speed":
        return corners, np.linalg.norm(body.v.x.array.reshape(-1, 3)[blocks], axis=-1)
    stress = von_mises(body)
    to_cell = mesh.topology.connectivity(2, 3)
    cells = np.array([to_cell.links(f)[0] for f in local], dtype=np.int64)
    dofs = compat.cell_dofs(stress.function_space)
    value = stress.x.array[dofs[cells, 0]] if len(cells) else np.empty(0)
    return corners, np.tile(value[:, None], 4)


def _axes_of(elevation: float, azimuth: float) -> FloatArray:
    """Rows: right, up and towards the viewer."""
    e, a = math.radians(elevation), math.radians(azimuth)
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    towards = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    return np.stack([right, np.cross(towards, right), towards])


#: About how many patches a picture is made of: more hide hidden faces better.
_PATCHES = 20000
#: Direction of the light in (right, up, towards the viewer).
_LIGHT = np.array([-0.35, 0.55, 0.76])


def _patches(corners: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Facets cut into patches of about one size, whatever the meshes.

    Returns:
        Corners of the patches (k, 4, 3), their values (k,), and the pieces of the facets' edges as
        flat patches (l, 4, 3).
    """
    diagonals = corners[:, 2:] - corners[:, :2]
    area = 0.5 * np.linalg.norm(np.cross(diagonals[:, 0], diagonals[:, 1]), axis=1)
    wanted = np.linalg.norm(diagonals, axis=2).max(axis=1) / np.sqrt(2 * area.sum() / _PATCHES)
    number = np.clip(np.ceil(wanted), 1, 60).astype(int)
    parts = [_cut(corners[number == n], values[number == n], n) for n in np.unique(number)]
    patches, means, rims = (np.concatenate(part) for part in zip(*parts, strict=True))
    return patches, means, rims


def _cut(
    corners: FloatArray, values: FloatArray, n: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Every facet into n x n patches, as `_patches` returns them."""
    line = np.linspace(0, 1, n + 1)
    s, t = np.meshgrid(line, line, indexing="ij")
    weights = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=-1)
    x = np.einsum("ijc,mcd->mijd", weights, corners)
    value = np.einsum("ijc,mc->mij", weights, values)

    def patches(a: FloatArray) -> FloatArray:
        parts = [a[:, :-1, :-1], a[:, 1:, :-1], a[:, 1:, 1:], a[:, :-1, 1:]]
        return np.stack(parts, axis=3).reshape(-1, 4, *a.shape[3:])

    rim = np.concatenate([x[:, :, 0], x[:, -1], x[:, :, -1], x[:, 0]])
    pieces = np.stack([rim[:, :-1], rim[:, 1:], rim[:, 1:], rim[:, :-1]], axis=2)
    return patches(x), patches(value).mean(axis=1), pieces.reshape(-1, 4, 3)


def _normals(x: FloatArray) -> FloatArray:
    """Unit normals of quadrilaterals (n, 4, 3), zero where degenerate."""
    normal = np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    unit: FloatArray = normal / np.where(size > 0, size, 1.0)
    return unit


def _colour_scale(drawn: Sequence[_Drawn], colour: str, limits: Any) -> Any:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    values = np.concatenate([d.values for d in drawn])
    low, high = limits or (float(values.min()), float(values.max()))
    if limits is None and high - low <= 1e-9 * high:
        # A constant field would otherwise show its rounding errors.
        low, high = 0.0, 1.1 * high or 1.0
    return ScalarMappable(Normalize(low, high), colormaps[_COLOURS[colour][0]])


def _painted(drawn: Sequence[_Drawn], scale: Any) -> Any:
    """What faces the viewer, from back to front."""
    from matplotlib.collections import PolyCollection

    corners, values = (np.concatenate([d[k] for d in drawn]) for k in (1, 2))
    front = _normals(corners)[:, 2] > 0
    x, value, rim = _patches(corners[front], values[front])
    light = np.clip(_normals(x) @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    rgba = scale.to_rgba(value)
    rgba[:, :3] *= (0.7 + 0.3 * light)[:, None]
    rgba = np.concatenate([rgba, np.tile([0.0, 0.0, 0.0, 0.5], (len(rim), 1))])
    # Edges count as a little nearer than they are, else the patches beside them cover them.
    size = np.linalg.norm(np.ptp(x, axis=1), axis=1).mean()
    depth = np.concatenate([x[..., 2].mean(axis=1), rim[..., 2].mean(axis=1) + 0.5 * size])
    order = np.argsort(depth)
    shapes = np.concatenate([x, rim])[order, :, :2]
    return PolyCollection(shapes, facecolors=rgba[order], edgecolors=rgba[order], linewidths=0.35)


def _figure(drawn: Sequence[_Drawn], width: float, title: str) -> tuple[Any, Any]:
    """Figure and axes of the bodies: one length unit is the same in both directions."""
    from matplotlib.figure import Figure

    points = np.concatenate([d.corners for d in drawn])[..., :2].reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    height = width * (high[1] - low[1]) / (high[0] - low[0])
    # Tall scenes keep their height; the rest of the figure has fixed sizes on paper [inch].
    shrink = min(1.0, 1.3 * width / height)
    width, height = shrink * width, shrink * height
    figure = Figure(figsize=(width + 1.2, height + 1.2))
    total = figure.get_size_inches()
    axes = figure.add_axes((0.1 / total[0], 0.8 / total[1], width / total[0], height / total[1]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.axis("off")
    axes.set_title(title, fontsize=11, loc="left")
    return figure, axes


def _furnish(
    figure: Any,
    axes: Any,
    scale: Any,
    text: str,
    view: tuple[float, float],
    named: Sequence[_Drawn],
) -> None:
    """Colour bar, axes' directions, scale bar and names."""
    from matplotlib.transforms import Affine2D

    total, box = figure.get_size_inches(), axes.get_position()
    height = min(box.height, max(0.8 * box.height, 2.0 / total[1]))
    place = (box.x1 + 0.2 / total[0], box.y0 + (box.height - height) / 2, 0.14 / total[0], height)
    bar = figure.colorbar(scale, cax=figure.add_axes(place))
    bar.set_label(text, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.formatter.set_powerlimits((-2, 4))
    bar.outline.set_visible(False)

    # Not figure.dpi_scale_trans, which bbox_inches="tight" leaves behind.
    inch = Affine2D().scale(*1 / total) + figure.transFigure

    def line(start: tuple[float, float], end: tuple[float, float], **look: Any) -> None:
        axes.annotate("", end, start, inch, inch, annotation_clip=False, arrowprops=look)

    for name, (x, y) in zip("xyz", 0.32 * _axes_of(*view)[:2].T, strict=True):
        line((0.5, 0.35), (0.5 + x, 0.35 + y), arrowstyle="->", lw=0.8, shrinkA=0, shrinkB=0)
        axes.text(
            0.5 + 1.35 * x,
            0.35 + 1.35 * y,
            name,
            fontsize=8,
            ha="center",
            va="center",
            transform=inch,
        )
    metre = box.width * total[0] / float(np.diff(axes.get_xlim())[0])
    power = 10.0 ** math.floor(math.log10(1.5 / metre))
    length = max(k * power for k in (1, 2, 5) if k * power * metre <= 1.5)
    line((1.1, 0.3), (1.1 + length * metre, 0.3), arrowstyle="-", lw=1.5, shrinkA=0, shrinkB=0)
    axes.text(1.1, 0.36, f"{length:g} m", fontsize=8, transform=inch)
    for body in named:
        x, y = body.corners[..., :2].reshape(-1, 2).mean(axis=0)
        axes.annotate(body.name, (x, y), fontsize=9, ha="center", bbox=_NAME_BOX)


_NAME_BOX = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
