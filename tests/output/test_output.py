"""Files, plots and pictures: what is written is what was computed, on any number of ranks."""

import re
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType
from scenes import CELLS, RUBBER, box, meeting_blocks, thrown_block
from xdmf import read_xdmf

import dolfinx_nts as nts
from dolfinx_nts import output
from dolfinx_nts.kernels.facets import tributary_areas
from dolfinx_nts.ledger import balance
from dolfinx_nts.output import pictures, plots

image = pytest.importorskip("matplotlib.image")

COMM = MPI.COMM_WORLD
mpi = pytest.mark.mpi


def stepper(**options):
    return nts.Stepper(meeting_blocks(**options), nts.EnergyMomentum())


def steps(run, writer, n, dt=1e-3):
    for _ in range(n):
        run.advance(dt)
        writer.write(run)


def rows_at(points, x):
    """Rows of the file at positions x."""
    distance = np.linalg.norm(points[None] - x[:, None], axis=2)
    row = distance.argmin(axis=1) if len(x) else np.empty(0, int)
    assert np.all(distance[np.arange(len(x)), row] < 1e-12)
    return row


def vertex_blocks(body):
    """Owned blocks that are mesh nodes, found by position, and these positions."""
    x = body.reference.reshape(-1, 3)
    every = np.concatenate(COMM.allgather(body.mesh.geometry.x))
    at_node = np.array([np.linalg.norm(every - p, axis=1).min() < 1e-12 for p in x], dtype=bool)
    return np.flatnonzero(at_node), x[at_node]


# ---- fields
@mpi
@pytest.mark.parametrize("cell", CELLS.values(), ids=CELLS)
def test_fields_are_the_functions(cell, mpi_tmp_path):
    run, writer = stepper(cell=cell), output.Fields(mpi_tmp_path / "new" / "folder")
    writer.start(run)
    steps(run, writer, 4)
    for body, name in zip(run.system.bodies, ("left", "the_right_one"), strict=True):
        file = read_xdmf(mpi_tmp_path / "new" / "folder" / f"{name}.xdmf")
        assert np.allclose(file.times, 1e-3 * np.arange(5), rtol=0, atol=1e-15)
        blocks, x = vertex_blocks(body)
        row = rows_at(file.points, x)
        assert COMM.allreduce(len(row)) == len(file.points)
        for field, function in (("displacement", body.u), ("velocity", body.v)):
            mine = function.x.array.reshape(-1, 3)[blocks]
            assert np.array_equal(file.fields[-1][field][row], mine)
        assert not file.fields[0]["displacement"].any()
        assert np.array_equal(
            file.fields[0]["velocity"][row], body.initial_velocity.reshape(-1, 3)[blocks]
        )
    run.close()


@mpi
def test_contact_fields(mpi_tmp_path):
    run, writer = stepper(), output.Fields(mpi_tmp_path)
    writer.start(run)
    steps(run, writer, 4)
    file = read_xdmf(mpi_tmp_path / "left.xdmf")
    names = ("force", "pressure", "gap", "status", "force_mean", "pressure_mean")
    first, last = (
        {n: fields[f"contact_{n}_left-the_right_one"] for n in names}
        for fields in (file.fields[0], file.fields[-1])
    )
    slave, contact = run.system.contacts[0].slave, run.state.contacts[0]
    force, gap = contact.force, contact.gap
    row = rows_at(file.points, slave.reference[slave.share])
    assert COMM.allreduce(force.sum()) > 0
    assert np.array_equal(last["force"][row], force)
    assert np.array_equal(last["gap"][row], gap)
    now = slave.positions(run.state.u[run.system.bodies.index(slave.body)])
    area = tributary_areas(slave.facets, now[slave.facets], len(now))[slave.share]
    assert np.allclose(last["pressure"][row] * area, force, rtol=1e-14)
    assert np.array_equal(last["status"][row], np.where(force > 0, 2.0, 1.0))

    surface = file.points[:, 0] > 1 - 1e-9
    assert surface.sum() == 9
    mean = run.mean_force(0)
    assert np.array_equal(last["force_mean"][row], mean) and not np.array_equal(mean, force)
    assert np.allclose(last["pressure_mean"][row] * area, mean, rtol=1e-14)
    assert not last["force"][~surface].any() and not last["pressure"][~surface].any()
    assert np.isnan(last["gap"][~surface]).all() and (last["status"][~surface] == -1).all()
    assert np.isnan(first["gap"]).all() and (first["status"][surface] == 0).all()
    load = "contact_load_left-the_right_one"
    master = read_xdmf(mpi_tmp_path / "the_right_one.xdmf").fields[-1]
    assert set(master) == {"displacement", "velocity", load}
    total = file.fields[-1][load].sum(axis=0)
    assert np.abs(total - run.solution.contact_forces[-1, 0]).max() < 1e-12 * np.abs(total).max()
    assert np.abs(total + master[load].sum(axis=0)).max() < 1e-12 * np.abs(total).max()
    run.close()


@mpi
@pytest.mark.fast_on_ranks()
def test_mean_force_of_two_steps():
    """A bar that hits a wall: rho c v of its section, about which single steps alternate."""
    young, density, speed, n = 1e6, 1e3, 0.01, 30
    wave = np.sqrt(young / density)
    dt = 1 / (n * wave)
    bar = nts.Continuum(
        box([0.0, 0, 0], [1.0, 1 / n, 1 / n], [n, 1, 1]),
        nts.StVenantKirchhoff(young, 0.0),
        density=density,
        velocity=(-speed, 0, 0),
    )
    wall = nts.Plane(point=(-0.3 * speed * dt, 0, 0), normal=(1, 0, 0))
    pair = nts.ContactPair(slave=bar.surface(lambda x: x[0] < 1e-9), master=wall)
    run = nts.Stepper(nts.System([bar], contacts=[pair]), nts.EnergyMomentum())
    force = []
    for _ in range(36):
        # Two steps of other lengths than the rest: the mean is that over time.
        run.advance(0.5 * dt if len(force) in (20, 21) else dt)
        force.append((run.state.contacts[0].force, run.mean_force(0)))
    run.close()
    single, mean = COMM.allreduce(np.array(force).sum(axis=2)).T
    right = density * wave * speed / n**2
    assert np.abs(single[6:] / right - 1).min() > 0.15
    assert np.abs(mean[6:] / right - 1).max() < 0.015


@mpi
@pytest.mark.parametrize("cell", CELLS.values(), ids=CELLS)
def test_cells_of_the_file_fill_the_body(cell, mpi_tmp_path):
    run, writer = stepper(cell=cell), output.Fields(mpi_tmp_path)
    writer.start(run)
    file = read_xdmf(mpi_tmp_path / "left.xdmf")
    corners = file.points[file.cells]
    if cell == CellType.hexahedron:
        assert file.kind == "Hexahedron"
        # XDMF numbers the bottom and the top face around, so these are the edges from corner 0.
        edges = corners[:, [1, 3, 4]] - corners[:, :1]
        assert np.allclose(corners[:, 6], corners[:, 0] + edges.sum(axis=1))
        assert np.allclose(corners[:, 2], corners[:, 0] + edges[:, 0] + edges[:, 1])
        volume = abs(np.linalg.det(edges)).sum()
    else:
        assert file.kind == "Tetrahedron"
        volume = abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6
    assert volume == pytest.approx(1.0, rel=1e-12)
    run.close()


@mpi
@pytest.mark.parametrize("cells, degree", [([1, 1, 1], 1), ([2, 1, 1], 2)])
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("cells0-1")
def test_fields_on_an_empty_rank_and_of_degree_2(cells, degree, mpi_tmp_path):
    mesh = box([0.0, 0, 0], [1.0, 1, 1], cells)
    body = nts.Continuum(
        mesh, RUBBER, density=1.0, degree=degree, velocity=lambda x: np.stack([x[1], x[2], x[0]])
    )
    run = nts.Stepper(nts.System([body]), nts.Midpoint())
    output.Fields(mpi_tmp_path).start(run)
    file = read_xdmf(mpi_tmp_path / "body.xdmf")
    assert len(file.points) == np.prod(np.array(cells) + 1)
    assert np.allclose(file.fields[0]["velocity"], file.points[:, [1, 2, 0]], atol=1e-14)
    pictures.picture([body], mpi_tmp_path / "speed.png", width=2.0)
    pictures.picture([body], mpi_tmp_path / "stress.png", colour="stress", width=2.0)
    run.close()


@mpi
@pytest.mark.parametrize(
    "cadence, written",
    [
        ({}, [0, 1, 2, 3, 4, 5, 6, 7]),
        ({"every": 3}, [0, 3, 6, 7]),
        ({"every": 100}, [0, 7]),
        ({"interval": 2e-3}, [0, 2, 4, 6, 7]),
        ({"interval": 2.5e-3}, [0, 3, 5, 7]),
        ({"interval": 1e-4}, [0, 1, 2, 3, 4, 5, 6, 7]),
        ({"interval": 1.0}, [0, 7]),
    ],
)
@pytest.mark.fast_on_ranks("cadence0-written0", "cadence4-written4")
def test_cadence(cadence, written, mpi_tmp_path):
    writer = output.Fields(mpi_tmp_path, **cadence)
    nts.simulate(thrown_block(), nts.Midpoint(), dt=1e-3, t_end=7e-3, output=[writer])
    times = read_xdmf(mpi_tmp_path / "body.xdmf").times
    assert np.allclose(times, 1e-3 * np.array(written), rtol=1e-12)


def test_cadence_of_a_loop_that_writes_now_and_then(tmp_path):
    """Multiples that were passed since the last call count, also before t = 0."""
    settled = nts.equilibrium(thrown_block(held=True))
    stepper = nts.Stepper(thrown_block(), nts.Midpoint(), start=settled, start_time=-5e-3)
    writers = [
        output.Fields(tmp_path / "time", interval=2e-3), output.Fields(tmp_path / "count", every=4)
    ]  # fmt: skip
    stepper.start(1e-3)
    for writer in writers:
        writer.start(stepper)
    for _ in range(4):
        for _ in range(3):
            stepper.advance(1e-3)
        for writer in writers:
            writer.write(stepper)
    stepper.close()
    for folder, wanted in (("time", [-5, -2, 1, 4, 7]), ("count", [-5, 1, 4, 7])):
        times = read_xdmf(tmp_path / folder / "body.xdmf").times
        assert np.allclose(times, 1e-3 * np.array(wanted), rtol=0, atol=1e-12)


class Dies:
    """A writer that ends the run with what no one catches."""

    def start(self, run):
        pass

    def write(self, run, *, last=False):
        if len(run.solution.rows) == 4:
            raise KeyboardInterrupt("power cut")

    def close(self, run):
        pass


@mpi
def test_a_run_that_dies_keeps_what_was_written(mpi_tmp_path):
    writers = [output.Fields(mpi_tmp_path), output.BalanceCSV(mpi_tmp_path / "b.csv"), Dies()]
    with pytest.raises(KeyboardInterrupt, match="power cut"):
        nts.simulate(thrown_block(), nts.Midpoint(), dt=1e-3, t_end=7e-3, output=writers)
    file = read_xdmf(mpi_tmp_path / "body.xdmf")
    assert len(file.times) == len(file.fields) == 4
    assert len((mpi_tmp_path / "b.csv").read_text().splitlines()) == 5


@mpi
def test_a_failed_run_leaves_its_last_accepted_state(mpi_tmp_path):
    run = nts.Stepper(thrown_block(), nts.Midpoint())
    writer = output.Fields(mpi_tmp_path, every=100)
    writer.start(run)
    steps(run, writer, 3)
    run.solution.status = "no convergence"
    writer.close(run)
    writer.close(run)
    assert np.allclose(read_xdmf(mpi_tmp_path / "body.xdmf").times, [0, 3e-3])
    run.close()


@mpi
def test_a_second_run_replaces_the_files(mpi_tmp_path):
    writer = output.Fields(mpi_tmp_path)
    for end in (3e-3, 2e-3):
        nts.simulate(thrown_block(), nts.Midpoint(), dt=1e-3, t_end=end, output=[writer])
    assert len(read_xdmf(mpi_tmp_path / "body.xdmf").times) == 3


# ---- balance table
@mpi
def test_csv_is_the_balance(mpi_tmp_path):
    path = mpi_tmp_path / "new" / "balance.csv"
    run = nts.simulate(
        meeting_blocks(),
        nts.EnergyMomentum(),
        dt=1e-3,
        t_end=4e-3,
        output=[output.BalanceCSV(path)],
    )
    header, *lines = (a for a in path.read_text().splitlines() if not a.startswith("#"))
    names = [re.fullmatch(r"(\w+) \[(.+)\]", cell).groups() for cell in header.split(",")]
    table = np.array([[float(x) for x in line.split(",")] for line in lines])
    columns = dict(zip((n for n, _ in names), table.T, strict=True))
    assert len(table) == 5
    for name in balance.COLUMNS:
        if run.balance[name].ndim == 2:
            columns[name] = np.stack([columns.pop(f"{name}_{c}") for c in "xyz"], axis=1)
        assert np.array_equal(columns.pop(name), run.balance[name])
    assert not columns
    units = dict(names)
    assert (units["time"], units["energy"], units["active"]) == ("s", "J", "-")
    assert (units["linear_momentum_x"], units["angular_momentum_z"]) == ("kg m/s", "kg m^2/s")


@mpi
def test_csv_has_the_steps_between_two_calls(mpi_tmp_path):
    run = nts.Stepper(thrown_block(), nts.Midpoint())
    writer = output.BalanceCSV(mpi_tmp_path / "b.csv")
    writer.start(run)
    for _ in range(3):
        run.advance(1e-3)
    writer.write(run)
    run.advance(1e-3)
    writer.close(run)
    COMM.Barrier()  # rank 0 writes
    assert len((mpi_tmp_path / "b.csv").read_text().splitlines()) == 6
    run.close()


# ---- plots
def run_both():
    return {
        name: nts.simulate(meeting_blocks(), rule, dt=1e-3, t_end=4e-3)
        for name, rule in (("energy-momentum", nts.EnergyMomentum()), ("midpoint", nts.Midpoint()))
    }


@mpi
@pytest.mark.fast_on_ranks()
def test_plots(mpi_tmp_path):
    runs = run_both()
    runs["midpoint"].plot(mpi_tmp_path / "one.png")
    if COMM.rank == 0:
        tables = {name: run.balance for name, run in runs.items()}
        plots.compare_balances(tables, mpi_tmp_path / "both.png")
        plots.compare_balances(tables, mpi_tmp_path / "both.pdf")
    COMM.Barrier()
    for name in ("one.png", "both.png"):
        pixels = image.imread(mpi_tmp_path / name)
        assert pixels.shape[0] > 800 and pixels.shape[1] > 1000 and pixels.std() > 0.02
    assert (mpi_tmp_path / "both.pdf").stat().st_size > 5000


def test_plot_of_a_run_without_a_step(tmp_path):
    table = {n: np.zeros((1, 3) if "momentum" in n else 1) for n in balance.COLUMNS}
    plots.plot_balance(table, tmp_path / "empty.png")
    assert (tmp_path / "empty.png").stat().st_size > 5000


def test_plots_refuse_what_is_no_balance(tmp_path):
    with pytest.raises(ValueError, match=r"balance: columns \[.*'energy'.*pass Solution.balance"):
        plots.plot_balance({"time": np.zeros(3)}, tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"balances=\{\}.*at least one"):
        plots.compare_balances({}, tmp_path / "a.png")


# ---- pictures
def coloured(pixels):
    """Pixels that are neither white nor a shade of grey."""
    return np.ptp(pixels[..., :3], axis=-1) > 0.1


@mpi
@pytest.mark.parametrize("colour", ["speed", "stress"])
@pytest.mark.parametrize("cell", CELLS.values(), ids=CELLS)
@pytest.mark.fast_on_ranks("tetrahedron-stress")
@pytest.mark.fast("hexahedron-speed")
def test_picture(colour, cell, mpi_tmp_path):
    system = meeting_blocks(cell=cell)
    for body in system.bodies:
        body.u.interpolate(lambda x: 0.1 * np.stack([x[1], x[2] ** 2, x[0]]))
    path = mpi_tmp_path / "new" / "picture.png"
    pictures.picture(system.bodies, path, colour=colour, title="t = 0", labels=True, width=3.0)
    pixels = image.imread(path)
    used = pixels[..., :3].min(axis=-1) < 0.9
    margin = 0.04 * max(pixels.shape)
    for axis in (0, 1):
        seen = np.flatnonzero(used.any(axis=axis))
        assert seen[0] < margin and seen[-1] > used.shape[1 - axis] - margin
    assert 0.3 < coloured(pixels).mean() < 0.9


@mpi
@pytest.mark.slow
def test_picture_has_true_proportions_and_hides_what_is_behind(mpi_tmp_path):
    """Seen along -x, a small fast block in front of a large resting one."""
    back = nts.Continuum(box([0.0, 0, 0], [1.0, 4, 2], [1, 2, 2]), RUBBER, density=1.0, name="b")
    front = nts.Continuum(
        box([2.0, 1, 0.5], [3.0, 3, 1.5], [1, 2, 2]), RUBBER, density=1.0, velocity=(0, 0, 1.0)
    )
    for order in ([back, front], [front, back]):
        pictures.picture(
            order, mpi_tmp_path / "p.png", view=(0.0, 0.0), limits=(0.0, 1.0), width=4.0
        )
        pixels = image.imread(mpi_tmp_path / "p.png")[..., :3]
        COMM.Barrier()
        body = coloured(pixels)[:, :810]
        up, right = (np.flatnonzero(body.mean(axis=a) > 0.5) for a in (1, 0))
        assert len(right) / len(up) == pytest.approx(2.0, rel=0.03)
        # Yellow is the fast end of the colour scale, violet the slow one.
        yellow = (pixels[:, :810, 0] > 0.6) & (pixels[:, :810, 2] < 0.4)
        assert yellow[up[0] : up[-1]].sum() / body.sum() == pytest.approx(0.25, rel=0.1)
        middle = slice(up[0] + len(up) // 3, up[-1] - len(up) // 3)
        assert yellow[middle, right[0] + len(right) // 3 : right[-1] - len(right) // 3].mean() > 0.9


# ---- what is refused
@pytest.mark.parametrize(
    "options, message",
    [
        ({"every": 0}, r"every=0.*>= 1"),
        ({"every": 1.5}, r"every=1.5.*whole number"),
        ({"every": True}, r"every=True.*whole number"),
        ({"interval": 0.0}, r"interval=0.0.*positive"),
        ({"interval": float("nan")}, r"interval=nan.*positive"),
        ({"interval": "often"}, r"interval='often'.*positive"),
        ({"every": 2, "interval": 1.0}, r"every=2, interval=1.0.*one of the two"),
    ],
)
def test_bad_cadence(options, message):
    with pytest.raises(ValueError, match=message):
        output.Fields("folder", **options)


@mpi
@pytest.mark.fast_on_ranks()
def test_a_place_that_cannot_be_written_stops_before_any_step(mpi_tmp_path):
    blocked = mpi_tmp_path / "file"
    if COMM.rank == 0:
        blocked.write_text("in the way")
    COMM.Barrier()
    for writer, name in (
        (output.Fields(blocked), "folder"),
        (output.BalanceCSV(blocked / "b.csv"), "path"),
    ):
        system = thrown_block()
        with pytest.raises(OSError, match=f"{name}='.*file.*cannot be written.*pass a place"):
            nts.simulate(system, nts.Midpoint(), dt=1e-3, t_end=1e-3, output=[writer])
        assert not system.bodies[0].u.x.array.any()
    with pytest.raises(OSError, match="path='.*file.*cannot be written"):
        pictures.picture(thrown_block().bodies, blocked / "p.png")
    with pytest.raises(RuntimeError, match="path='.*p.xyz'.*not supported"):
        pictures.picture(thrown_block().bodies, mpi_tmp_path / "p.xyz", width=1.0)


def test_fields_of_bodies_without_a_mesh(tmp_path):
    system = SimpleNamespace(bodies=[nts.Body()], contacts=[], comm=COMM)
    with pytest.raises(ValueError, match=r"folder='.*no body has a mesh; leave Fields out"):
        output.Fields(tmp_path).start(SimpleNamespace(system=system))


@mpi
@pytest.mark.parametrize(
    "name, file", [("../x", "__x"), ("a/b", "a_b"), (".hid", "_hid"), ("/tmp/ä b", "_tmp_ä_b")]
)
def test_a_body_name_is_no_path(name, file, mpi_tmp_path):
    mesh = box([0.0, 0, 0], [1.0, 1, 1], [1, 1, 1])
    system = nts.System([nts.Continuum(mesh, RUBBER, density=1.0, name=name)])
    folder = mpi_tmp_path / "inner"
    run = nts.simulate(system, nts.Midpoint(), dt=1e-3, t_end=1e-3, output=[output.Fields(folder)])
    assert run.status == "completed"
    assert len(read_xdmf(folder / f"{file}.xdmf").times) == 2
    assert {p.name for p in folder.iterdir()} == {f"{file}.xdmf", f"{file}.h5"}
    assert [p.name for p in mpi_tmp_path.iterdir()] == ["inner"]


@mpi
def test_body_names_that_give_one_file(mpi_tmp_path):
    mesh = box([0.0, 0, 0], [1.0, 1, 1], [1, 1, 1])
    bodies = [nts.Continuum(mesh, RUBBER, density=1.0, name=n) for n in ("a b", "a_b")]
    run = nts.Stepper(nts.System(bodies), nts.Midpoint())
    with pytest.raises(ValueError, match=r"name of bodies.*'a_b', 'a_b'.*rename"):
        output.Fields(mpi_tmp_path).start(run)


@mpi
@pytest.mark.parametrize(
    "options, message",
    [
        ({"colour": "red"}, r"colour='red'.*'speed', 'stress'"),
        ({"view": (1.0,)}, r"view=\(1.0,\).*two finite"),
        ({"limits": (0.0, float("inf"))}, r"limits=\(0.0, inf\).*two finite"),
        ({"limits": (2.0, 1.0)}, r"limits=\(2.0, 1.0\).*below"),
        ({"width": 0.0}, r"width=0.0.*positive"),
    ],
)
def test_bad_picture_options(options, message, mpi_tmp_path):
    with pytest.raises(ValueError, match=message):
        pictures.picture(thrown_block().bodies, mpi_tmp_path / "p.png", **options)


def test_pictures_of_what_has_no_mesh(tmp_path):
    with pytest.raises(ValueError, match=r"scene=\[\].*at least one"):
        pictures.picture([], tmp_path / "p.png")
    with pytest.raises(TypeError, match=r"scene\[0\]='ball': pass a sequence of bodies"):
        pictures.picture(["ball"], tmp_path / "p.png")
