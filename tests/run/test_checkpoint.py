"""Checkpoints: a run that goes on from one is the run that was never interrupted."""

import json
import logging
import math
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from xml.etree import ElementTree

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType
from integrators import INTEGRATORS
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.output import BalanceCSV, Fields
from dolfinx_nts.output.scene_record import describe, differences
from dolfinx_nts.output.state_file import CHECKPOINT, Numbering, previous, read, write
from dolfinx_nts.run.load_steps import LoadStepper
from dolfinx_nts.solve import linear_solver
from dolfinx_nts.validation import StepFailedError

COMM = MPI.COMM_WORLD
DT, STEPS, EVERY = 2e-3, 14, 9
HEX, TET = CellType.hexahedron, CellType.tetrahedron
RUBBER = nts.NeoHookean(1e6, 0.3)


def blocks(comm, cell=HEX, friction=0.3, cells=(2, 3), name="right"):
    """A spinning block thrown at a larger one, with friction."""
    left = nts.Continuum(
        box((0, 0, 0), (1, 1, 1), cells[0], cell, comm), RUBBER, density=1e3, degree=1, name="left",
        velocity=lambda x: np.array([3 + x[2], 1 + 0 * x[0], -x[0]]),
    )  # fmt: skip
    right = nts.Continuum(
        box((1.04, -0.1, -0.1), (2.05, 1.1, 1.1), cells[1], cell, comm), RUBBER, density=1e3,
        degree=1, name=name,
    )  # fmt: skip
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > 1 - 1e-9),
        master=right.surface(lambda x: x[0] < 1.04 + 1e-9),
        friction=friction,
    )
    return nts.System([left, right], contacts=[pair]), {}


def mechanism(comm):
    """An arm that turns more than once on a torsion spring; a bob on a cord; a cube tied to it."""
    arm = nts.RigidBody(
        box((0, -0.1, -0.1), (1, 0.1, 0.1), 1, comm=comm), density=500.0,
        angular_velocity=(0, 0, 150),
        velocity=(0, 75, 0), name="arm",
    )  # fmt: skip
    bob = nts.RigidBody.from_inertia(2.0, (0.1, 0.2, 0.25), (0, 0, -2), name="bob", comm=comm)
    cube = nts.Continuum(
        box((-0.5, -0.5, -3.2), (0.5, 0.5, -2.2), 2, comm=comm), RUBBER, density=10.0, name="cube"
    )
    pivot = nts.Revolute(arm, None, point=(0, 0, 0), axis=(0, 0, 1))
    joints = [
        pivot,
        nts.TorsionSpring.about(pivot, stiffness=40.0, angle=0.0),
        nts.Distance(bob, None, points=((0, 0.1, -2), (0, 0, 0))),
        nts.Spring(arm, bob, ((1, 0, 0), (0, 0, -2)), stiffness=300.0, length=1.0),
        nts.Damper(bob, None, ((0, 0, -2), (3, 0, -2)), damping=2.0),
        nts.Tie(bob, cube.surface(lambda x: x[2] > -2.2 - 1e-9)),
    ]
    return nts.System([arm, bob, cube], joints=joints, gravity=(0, 0, -9.81)), {}


def floor(comm):
    """A rigid box that slides and tips on a rigid floor."""
    body = nts.RigidBody(
        box((0, 0, 0.002), (1, 1, 1.002), 1, comm=comm), density=1e3, velocity=(2, 1, -0.5),
        angular_velocity=(0.3, 0, 1), name="box",
    )  # fmt: skip
    pair = nts.ContactPair(
        body.surface(lambda x: x[2] < 0.002 + 1e-9), nts.Plane((0, 0, 0), (0, 0, 1)), friction=0.4
    )
    return nts.System([body], contacts=[pair], gravity=(0, 0, -9.81)), {}


def loaded(comm):
    """Nodes on edges, a support that moves and a load that the script ramps up."""
    mesh = box((0, 0, 0), (1, 1, 1), 2, TET, comm)
    load = fem.Constant(mesh, 0.0)
    held = nts.Dirichlet(lambda x: x[2] < 1e-9, lambda t: (0.01 * np.sin(300 * t), 0, 0))
    stiffness = fem.Constant(mesh, 1e6)
    body = nts.Continuum(
        mesh, lambda c: nts.NeoHookean(1e6, 0.3)(c) * stiffness / 1e6, density=1e3, bcs=[held],
        degree=2, name="block", extra_form=lambda u, v, w, t: -load * w[2] * ufl_ds(mesh),
    )  # fmt: skip

    def ramp(time, dt):
        load.value = 1e6 * (time + dt / 2)
        stiffness.value = 1e6 * (1 + 20 * time)

    return nts.System([body]), {"before_step": ramp}


def ufl_ds(mesh):
    return ufl.Measure("ds", mesh)


def sleepers(comm):
    system, _ = blocks(comm, friction=0.0)
    far = nts.Continuum(
        box((5, 0, 0), (6, 1, 1), 2, comm=comm), RUBBER, density=1e3, name="far"
    )  # fmt: skip
    return nts.System([*system.bodies, far], contacts=system.contacts), {"sleep": True}


def adapted(comm):
    system, _ = blocks(comm)
    return system, {"adapt": nts.Adapt(tolerance=1e-3)}


def paced(comm):
    """Without a touch, whose moment depends on rounding."""
    return mechanism(comm)[0], {"adapt": nts.Adapt(tolerance=1e-3)}


def restored(comm):
    return blocks(comm)[0], {"impact": "restored"}


def endless(comm):
    return blocks(comm, friction=math.inf)


def tetrahedra(comm):
    return blocks(comm, cell=TET)


SCENES = {f.__name__: f for f in (blocks, tetrahedra, mechanism, floor, loaded, sleepers, adapted,
                                  paced, endless, restored)}  # fmt: skip


def run(scene, integrator="energy-momentum", **options):
    system, own = scene
    t_end = options.pop("t_end", STEPS * DT)
    more = {"accuracy": "exact", "dt": DT, "t_end": t_end}
    return nts.simulate(system, INTEGRATORS[integrator], **{**more, **own, **options})


def arrays(state):
    """Everything in a state, one array after another."""
    for part in (state.u, state.v, state.a, *state.contacts):
        yield from part
    yield from (h for h in state.joints if h is not None)


def assert_same(one, other):
    """To the bit in serial; on several ranks MUMPS rounds anew in every run."""
    assert one.state.time == other.state.time
    assert list(one.warnings) == list(other.warnings)
    assert (one.retries, one.rejected, one.exceeded) == (
        other.retries, other.rejected, other.exceeded)  # fmt: skip
    if COMM.size > 1:
        assert distance(one, other) < 1e-12
        energy, another = one.balance["energy"], other.balance["energy"]
        assert np.abs(energy - another).max() <= 1e-12 * np.abs(energy).max()
        return
    assert one.status == other.status
    for a, b in zip(arrays(one.state), arrays(other.state), strict=True):
        assert np.array_equal(a, b)
    for name, column in one.rows.columns.items():
        assert np.array_equal(column, other.rows.columns[name]), name
    assert list(one.warnings.values()) == list(other.warnings.values())
    assert list(one.switches) == list(other.switches)
    assert one.switches.worst == other.switches.worst and one.switches.size == other.switches.size


def in_file_order(solution):
    """Displacements, velocities and, if any, accelerations of all bodies, the same on all ranks.

    Each over the largest in the system.
    """
    state, order, found = solution.state, Numbering(solution.system), []
    for values in filter(None, (state.u, state.v, state.a)):
        rows = np.concatenate(solution.system.comm.bcast(order.to_file(values)))
        found.append(rows / np.abs(rows).max())
    return found


def distance(one, other):
    """Largest difference of two runs at their ends, in that scale."""
    pairs = zip(in_file_order(one), in_file_order(other), strict=True)
    return max(float(np.abs(a - b).max()) for a, b in pairs)


@pytest.mark.mpi
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.fast("mechanism", "restored")
@pytest.mark.fast_on_ranks()
def test_a_restarted_run_is_the_uninterrupted_one(scene, mpi_tmp_path):
    """To the bit; of other integrators to rounding, as tests/conformance/ says."""
    if scene == "adapted" and COMM.size > 1:
        pytest.skip("two uninterrupted runs differ there by 1e-9: their steps depend on rounding")
    path, make = mpi_tmp_path / "deep" / "run.h5", SCENES[scene]
    whole = run(make(COMM))
    saved = run(make(COMM), checkpoint=nts.Checkpoint(path, every=EVERY))
    assert_same(whole, saved)
    again = make(COMM)
    start = nts.restart(previous(path), again[0])
    assert 1 < len(start.rows) < len(whole.rows)
    assert_same(whole, run(again, start=start))
    assert "restart" in start.status and len(start.rows) < len(whole.rows)


@pytest.mark.slow
def test_from_two_ranks_to_three(on_ranks, tmp_path):
    """The last third of a run of two ranks, made again by three, and matched by places."""
    names = ("blocks", "mechanism", "floor", "sleepers", "paced")
    code = f"""
        import sys
        sys.path[:0] = {[str(p) for p in Path(__file__).parents[:2]]!r}
        from pathlib import Path
        import test_checkpoint as t
        folder, first = Path({str(tmp_path)!r}), t.COMM.size == 2
        for name in {names}:
            scene, file = t.SCENES[name](t.COMM), folder / f"{{name}}.h5"
            if first:
                found = t.run(scene, checkpoint=t.nts.Checkpoint(file, every=t.EVERY))
            else:
                found = t.run(scene, start=t.nts.restart(t.previous(file), scene[0]))
            found.save(folder / f"{{name}} {{t.COMM.size}}.h5")
    """
    for ranks in (2, 3):
        on_ranks(ranks, "-c", textwrap.dedent(code))
    for name in names:
        one, other = (nts.load(tmp_path / f"{name} {ranks}.h5") for ranks in (2, 3))
        assert len(one.rows) == len(other.rows) > STEPS and one.time == other.time
        for of in ("reference", "u", "v"):
            mine, theirs = ([body[of] for body in run.bodies.values()] for run in (one, other))
            off = np.concatenate(mine) - np.concatenate(theirs)
            assert np.abs(off).max() < 1e-12 * np.abs(np.concatenate(mine)).max()


@pytest.mark.slow
@pytest.mark.parametrize("end", ["os.kill(os.getpid(), signal.SIGKILL)", "raise OSError('gone')"])
def test_a_rank_that_ends_takes_the_others_along(end, on_ranks, tmp_path):
    """No hang; what was written until then is whole, and the run goes on from it."""
    path = tmp_path / "run.h5"
    code = f"""
        import os, signal, sys
        sys.path[:0] = {[str(p) for p in Path(__file__).parents[:2]]!r}
        import test_checkpoint as t

        def before(time, dt):
            if t.COMM.rank == 1 and time > 7.5 * t.DT:
                {end}

        scene = t.blocks(t.COMM)
        saves = t.nts.Checkpoint({str(path)!r}, every=3)
        found = t.run(scene, before_step=before, checkpoint=saves)
        print("status", found.status)
        sys.exit("not completed")
    """
    said = on_ranks(2, "-c", textwrap.dedent(code), well=False)
    raised = "raise" in end
    assert ("OSError('gone')" in said and "status before_step" in said) == raised
    scene = blocks(COMM)
    start = nts.restart(path, scene[0])
    # Every third step; a run that ends in order writes its last one, too.
    assert len(start.rows) == 1 + (8 if raised else 6)
    assert run(scene, start=start).status == "completed"


# ---- how often, and files
@pytest.mark.mpi
@pytest.mark.slow
def test_the_balance_and_its_table_go_on(mpi_tmp_path):
    """A longer run from the end of one; the start can be used again; the CSV is whole."""
    path = mpi_tmp_path / "run.h5"
    half = run(blocks(COMM), t_end=8 * DT, checkpoint=nts.Checkpoint(path, every=100))
    assert not previous(path).exists()
    for _ in range(2):
        scene = blocks(COMM)
        start = nts.restart(path, scene[0])
        table = BalanceCSV(mpi_tmp_path / "table.csv")
        whole = run(scene, start=start, output=[table])
    one = run(blocks(COMM), t_end=STEPS * DT)
    times = whole.balance["time"]
    assert len(times) == STEPS + 1 and times[0] == 0.0
    assert np.allclose(times, one.balance["time"], rtol=1e-14)
    assert half.balance["contact_defect"][-1] == whole.balance["contact_defect"][8]
    for name in ("external_work", "friction_dissipation", "contact_defect", "energy"):
        column, wanted = whole.balance[name], one.balance[name]
        assert np.abs(column - wanted).max() <= 1e-10 * one.balance["energy"][0]
    assert np.abs(whole.balance["ledger_residual"]).max() < 1e-11 * one.balance["energy"][0]
    if COMM.rank == 0:
        rows = (mpi_tmp_path / "table.csv").read_text().splitlines()
        assert len([r for r in rows if r[0].isdigit()]) == STEPS + 1


def large(comm):
    """By Krylov's method, and of a size from which on matrices are kept at each level."""
    return blocks(comm, cells=(5, 6))


def small(comm):
    """By MUMPS."""
    return blocks(comm)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("accuracy", "make"),
    [("exact", small), ("balanced", small), ("fast", small), ("balanced", large), ("fast", large),
     ("balanced", adapted)],
)  # fmt: skip
@pytest.mark.fast("balanced-small")
@pytest.mark.fast_on_ranks()
def test_matrices_kept_over_steps_are_those_of_the_uninterrupted_run(make, accuracy, mpi_tmp_path):
    """It makes them anew after a checkpoint, too."""
    if make is adapted and COMM.size > 1:
        pytest.skip("two uninterrupted runs differ there by 1e-9: their steps depend on rounding")
    path, options = mpi_tmp_path / "run.h5", {"accuracy": accuracy}
    saved = run(make(COMM), checkpoint=nts.Checkpoint(path, every=EVERY), **options)
    scene = make(COMM)
    found = run(scene, start=nts.restart(previous(path), scene[0]), **options)
    assert saved.balance["active"].max() >= 4
    if COMM.size == 1:
        assert_same(saved, found)
    else:
        assert distance(saved, found) < {"exact": 1e-12, "balanced": 1e-7, "fast": 1e-4}[accuracy]


def series(folder, name="box"):
    """Times of a body's files, and its displacements at each."""
    text = (folder / f"{name}.xdmf").read_text()
    times = [float(t) for t in re.findall(r'<Time Value="([^"]*)"', text)]
    places = re.findall(rf"{name}\.h5:/(\d+/displacement)<", text)
    ElementTree.fromstring(text)
    with h5py.File(folder / f"{name}.h5", "r") as file:
        return times, np.array([file[place] for place in places])


@pytest.mark.mpi
@pytest.mark.parametrize("cadence", [{"every": 4}, {"interval": 3.5 * DT}], ids=str)
@pytest.mark.fast("{'every': 4}")
@pytest.mark.fast_on_ranks()
def test_fields_go_on_where_the_state_is(cadence, mpi_tmp_path):
    """Those of a run whose last six steps were lost, and of one that ended too early, too."""
    path, whole, folder = mpi_tmp_path / "run.h5", mpi_tmp_path / "whole", mpi_tmp_path / "fields"
    saves = nts.Checkpoint(path, every=9)
    for where in (whole, folder):
        run(floor(COMM), output=[Fields(where, **cadence)], checkpoint=saves)
    scene = floor(COMM)
    start = nts.restart(previous(path), scene[0])
    assert len(start.rows) == 1 + 9
    run(scene, start=start, t_end=11 * DT, output=[Fields(folder, **cadence)], checkpoint=saves)
    scene = floor(COMM)
    start = nts.restart(path, scene[0])
    assert len(start.rows) == 1 + 11
    run(scene, start=start, output=[Fields(folder, **cadence)])
    COMM.barrier()
    times, wanted = series(whole)
    steps = [0, 4, 8, 12, 14] if "every" in cadence else [0, 4, 7, 11, 14]
    assert np.array(times) == pytest.approx(DT * np.array(steps), abs=1e-12)
    found, values = series(folder)
    assert found == times and values.shape == wanted.shape
    assert np.abs(values - wanted).max() <= (0.0 if COMM.size == 1 else 1e-12)


@pytest.mark.mpi
def test_fields_do_not_go_on_with_part_of_them_or_with_those_of_another_run(mpi_tmp_path):
    """What is there stays as it is."""
    path, folder = mpi_tmp_path / "run.h5", mpi_tmp_path / "fields"
    saves = nts.Checkpoint(path, every=9)
    run(blocks(COMM), t_end=3 * DT, output=[Fields(folder)], checkpoint=saves)
    if COMM.rank == 0:
        (folder / "right.xdmf").rename(folder / "away.xdmf")
    COMM.barrier()
    scene = blocks(COMM)
    start = nts.restart(path, scene[0])
    with pytest.raises(FileNotFoundError, match="^folder=.*but no right.xdmf; put it back, or"):
        run(scene, start=start, output=[Fields(folder)])
    assert len(series(folder, "left")[0]) == 4
    COMM.barrier()
    if COMM.rank == 0:
        (folder / "away.xdmf").rename(folder / "right.xdmf")
        (folder / "left.xdmf").write_text((folder / "left.xdmf").read_text()[:-20])
    COMM.barrier()
    with pytest.raises(FileExistsError, match="^folder=.*left.xdmf is not whole; pass another"):
        run(scene, start=start, output=[Fields(folder)])
    other = mpi_tmp_path / "other"
    run(blocks(COMM), dt=0.7 * DT, t_end=2.1 * DT, output=[Fields(other)])
    with pytest.raises(FileExistsError, match="^folder=.*left.xdmf is of another run, with a time"):
        run(scene, start=start, output=[Fields(other)])
    assert len(series(other, "left")[0]) == 4


@pytest.mark.mpi
def test_fields_go_on_on_other_ranks(mpi_tmp_path):
    """Places of nodes differ there by rounding."""
    path, folder = mpi_tmp_path / "run.h5", mpi_tmp_path / "fields"
    saves = nts.Checkpoint(path, every=9)
    run(tetrahedra(COMM), t_end=3 * DT, output=[Fields(folder)], checkpoint=saves)
    if COMM.rank == 0:
        scene = tetrahedra(MPI.COMM_SELF)
        start = nts.restart(path, scene[0])
        run(scene, start=start, t_end=5 * DT, output=[Fields(folder)])
    COMM.barrier()
    for name in ("left", "right"):
        assert np.array(series(folder, name)[0]) == pytest.approx(DT * np.arange(6), abs=1e-12)


@pytest.mark.mpi
def test_fields_of_a_restart_that_fails_have_its_state(mpi_tmp_path):
    """That state is not due, but it is the last one."""
    path, folder = mpi_tmp_path / "run.h5", mpi_tmp_path / "fields"
    saves = nts.Checkpoint(path, every=9)
    run(floor(COMM), t_end=3 * DT, output=[Fields(folder, every=2)], checkpoint=saves)
    scene = floor(COMM)
    start = nts.restart(path, scene[0])

    def fail(time, dt):
        if time > 2.5 * DT:
            raise RuntimeError("on purpose")

    failed = run(scene, start=start, output=[Fields(folder, every=2)], before_step=fail)
    assert "on purpose" in failed.status and failed.state.time == pytest.approx(3 * DT)
    COMM.barrier()
    assert np.array(series(folder)[0]) == pytest.approx([0, 2 * DT, 3 * DT], abs=1e-12)


@pytest.mark.mpi
def test_fields_do_not_go_on_with_another_mesh(mpi_tmp_path):
    path, folder = mpi_tmp_path / "run.h5", mpi_tmp_path / "fields"
    run(floor(COMM), t_end=3 * DT, checkpoint=nts.Checkpoint(path, every=9))
    other = nts.RigidBody(box((0, 0, 0), (1, 1, 2), 1), density=1e3, name="box")
    run((nts.System([other]), {}), t_end=DT, output=[Fields(folder)])
    size = (folder / "box.h5").stat().st_size
    scene = floor(COMM)
    start = nts.restart(path, scene[0])
    with pytest.raises(FileExistsError, match="^folder=.*holds box.xdmf with another mesh"):
        run(scene, start=start, output=[Fields(folder)])
    assert (folder / "box.h5").stat().st_size == size
    done = run(scene, start=start, output=[Fields(mpi_tmp_path / "more")])
    assert done.status == "completed" and (mpi_tmp_path / "more" / "box.xdmf").exists()


class Written:
    """A writer that notes at which steps there is a new checkpoint."""

    def __init__(self, path):
        self.path, self.at, self.last = path, [], None

    def start(self, stepper):
        COMM.barrier()

    def write(self, stepper, *, last=False):
        now = self.path.stat().st_ino if self.path.exists() else None
        if now != self.last:
            self.at.append(len(stepper.solution.rows) - 2)
        self.last = now
        COMM.barrier()

    def close(self, stepper):
        pass


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_how_often(mpi_tmp_path):
    for k, (cadence, wanted) in enumerate((
        ({"every": 4}, [4, 8, 12]), ({"seconds": 1e-9}, list(range(1, STEPS))),
        ({"seconds": 1e6}, []), ({"every": 6, "seconds": 1e6}, [6, 12]),
    )):  # fmt: skip
        path = mpi_tmp_path / f"{k}.h5"
        written = Written(path)
        saved = run(floor(COMM), output=[written], checkpoint=nts.Checkpoint(path, **cadence))
        assert written.at == wanted
        system, _ = floor(COMM)
        assert nts.restart(path, system).state.time == saved.state.time
        assert not list(mpi_tmp_path.glob("*.part"))


@pytest.mark.mpi
def test_a_damaged_file_leaves_the_one_before(mpi_tmp_path, caplog):
    path = mpi_tmp_path / "run.h5"
    saved = run(floor(COMM), checkpoint=nts.Checkpoint(path, every=EVERY))
    if COMM.rank == 0:
        path.write_bytes(path.read_bytes()[:1000])
    scene = floor(COMM)
    with caplog.at_level(logging.WARNING):
        start = nts.restart(path, scene[0])
    assert start.state.time == saved.balance["time"][EVERY]
    assert ("going on from the checkpoint before" in caplog.text) == (COMM.rank == 0)
    if COMM.rank == 0:
        path.unlink()
    assert nts.restart(path, scene[0]).state.time == start.state.time
    if COMM.rank == 0:
        previous(path).unlink()
    with pytest.raises(FileNotFoundError, match="pass the path that Checkpoint had"):
        nts.restart(path, scene[0])


def test_no_flipped_bit_is_read(tmp_path):
    """Each of 500 random bits of a file."""
    rng = np.random.default_rng(3)
    tables = {f"bodies/{k}/u": rng.random((40, 3)) for k in range(3)}
    tables |= {"contacts/0/number": np.arange(7), "contacts/0/force": np.empty((0, 3))}
    notes, path = {"time": 0.5, "scene": {"bodies": ["left"]}}, tmp_path / "run.h5"
    write(path, tables, notes)
    whole = path.read_bytes()
    for bit in rng.choice(8 * len(whole), 500, replace=False).tolist():
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(OSError, match="its checksum is (wrong|missing)"):
            read(path, CHECKPOINT)
    path.write_bytes(whole)
    found, told = read(path, CHECKPOINT)
    assert told == notes and found.keys() == tables.keys()
    assert all(np.array_equal(found[name], tables[name]) for name in tables)


class Removes:
    """A writer that puts a file in the way of the checkpoints."""

    def __init__(self, path):
        self.path = path

    def start(self, stepper):
        if COMM.rank == 0:
            shutil.rmtree(self.path.parent)
            self.path.parent.write_text("in the way")

    def write(self, stepper, *, last=False):
        pass

    close = write


@pytest.mark.mpi
def test_what_cannot_be_written_is_told_and_the_run_goes_on(mpi_tmp_path):
    path = mpi_tmp_path / "folder" / "run.h5"
    done = run(floor(COMM), output=[Removes(path)], checkpoint=nts.Checkpoint(path, every=4))
    assert done.status == "completed"
    assert done.warnings["checkpoint"].count == 4
    assert "run.h5" in done.warnings["checkpoint"].text


# ---- what is refused
@pytest.mark.parametrize(
    ("make", "kind", "text"),
    [
        (lambda: nts.Checkpoint(3, every=1), TypeError, "path=3: pass a path"),
        (lambda: nts.Checkpoint("a.h5"), ValueError, "every=None, seconds=None: pass one"),
        (lambda: nts.Checkpoint("a.h5", every=0), ValueError, "every=0: must be a positive whole"),
        (lambda: nts.Checkpoint("a.h5", every=1.5), ValueError, "every=1.5: must be a positive"),
        (lambda: nts.Checkpoint("a.h5", every=True), ValueError, "every=True: must be"),
        (lambda: nts.Checkpoint("a.h5", seconds=-1), ValueError, r"seconds=-1: must .*\[s\]"),
        (lambda: nts.Checkpoint("a.h5", evry=3), TypeError, "evry=3: unknown option"),
    ],
)
def test_bad_options(make, kind, text):
    with pytest.raises(kind, match=text):
        make()


def other_systems():
    """What differs, a system like that of `blocks`, and what is said."""
    rough, _ = blocks(COMM, friction=0.2)
    yield rough, r"contacts\[0\].friction is 0.3 there and 0.2 here of 'left-right'"
    yield blocks(COMM, cells=(2, 4))[0], r"bodies\[1\].nodes is 64 there and 125 here of 'right'"
    yield blocks(COMM, cell=TET)[0], r"contacts\[0\].slave.facets is 4 there and 8 here"
    yield blocks(COMM, name="wall")[0], r"bodies\[1\].name is 'right' there and 'wall' here"
    system, _ = blocks(COMM)
    left, right = system.bodies
    yield nts.System([right, left], contacts=system.contacts), r"bodies\[0\].name is 'left' there"
    yield nts.System([left, right]), r"contacts is \['left-right'\] there and \[\] here"
    heavy = nts.System([left, right], contacts=system.contacts, gravity=(0, 0, -1))
    yield heavy, r"gravity\[2\] is 0.0 there and -1.0 here"


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_another_system_is_refused(mpi_tmp_path):
    path = mpi_tmp_path / "run.h5"
    run(blocks(COMM), t_end=2 * DT, checkpoint=nts.Checkpoint(path, every=1))
    for system, text in other_systems():
        with pytest.raises(ValueError, match=text):
            nts.restart(path, system)
    system, options = blocks(COMM)
    system.bodies[0].reference += 1e-6
    with pytest.raises(ValueError, match="body 'left': its mesh has other nodes, up to 1e-06 away"):
        nts.restart(path, system)
    with pytest.raises(TypeError, match=r"system=3: pass the System"):
        nts.restart(path, 3)
    with pytest.raises(TypeError, match=r"checkpoint='a': pass Checkpoint\(path, every=100\)"):
        run((system, options), checkpoint="a")


def linked(point=(0, 0, 0.5), **changed):
    """A body with one of each kind of joint; what is changed of them by keyword."""
    x, y = np.array([0, 0, 0.5]), np.array([0, 0, 2.0])
    body = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="body", comm=COMM)
    given = {
        "stiffness": 300.0, "damping": 2.0, "length": 1.5, "torsion": 4.0, "axis": (0, 0, 1),
        "arms": ((1, 0, 0), (0, 1, 0)), "angle": None, "height": -9.0, "radius": 1.0,
        "motion": None,
    } | changed  # fmt: skip
    joints = [
        nts.Spring(body, None, (x, y), stiffness=given["stiffness"], length=given["length"]),
        nts.Damper(body, None, (x, y), damping=given["damping"]),
        nts.TorsionSpring(body, None, axis=(0, 0, 1), stiffness=given["torsion"]),
        nts.Spherical(body, None, point=point),
        nts.Revolute(body, None, point=x, axis=given["axis"], angle=given["angle"]),
        nts.Universal(body, None, point=x, axes=given["arms"]),
    ]
    mesh = box((3, 0, 0), (4, 1, 1), 1)
    cube = nts.RigidBody(mesh, density=1.0, name="cube")
    floor = nts.Plane((0, 0, given["height"]), (0, 0, 1), motion=given["motion"])
    ball = nts.Sphere((3.5, 0.5, -5), given["radius"])
    contacts = [
        nts.ContactPair(cube.surface(lambda x: x[2] < 1e-9), master) for master in (floor, ball)
    ]
    return nts.System([body, cube], joints=joints, contacts=contacts)


@pytest.mark.mpi
def test_other_joints_and_obstacles_are_refused():
    """By name, with what differs."""
    described = json.loads(json.dumps(describe(linked())))
    assert differences(described, describe(linked())) == []
    for changed, text in (
        ({"stiffness": 1200.0}, "joints[0].stiffness is 300.0 there and 1200.0 here of 'spring"),
        ({"length": 1.4}, "joints[0].rest is 1.5 there and 1.4 here"),
        ({"damping": 3.0}, "joints[1].damping is 2.0 there and 3.0 here"),
        ({"torsion": 5.0}, "joints[2].stiffness is 4.0 there and 5.0 here"),
        ({"point": (0, 0, 0.6)}, "joints[3].points[0][2] is 0.5 there and 0.6 here"),
        ({"axis": (1, 0, 0)}, "joints[4].axis[0] is 0.0 there and 1.0 here of 'revolute"),
        ({"angle": lambda t: t}, "joints[4].driven is False there and True here"),
        ({"arms": ((1, 0, 0), (0, 0, 1))}, "joints[5].axes[1][1] is 1.0 there and 0.0 here"),
        ({"height": -8.0}, "contacts[0].master.point[2] is -9.0 there and -8.0 here"),
        ({"motion": lambda t: (t, 0, 0)}, "contacts[0].master.motion is False there and True"),
        ({"radius": 1.1}, "contacts[1].master.radius is 1.0 there and 1.1 here"),
    ):
        found = differences(described, describe(linked(**changed)))
        assert any(text in sentence for sentence in found), (text, found)


@pytest.mark.mpi
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_another_material_is_told(factor, mpi_tmp_path):
    """Of a stretched cube in flight; another density is refused, as another mass is."""

    def cube(young=1e6, density=1e3):
        body = nts.Continuum(
            box(cells=2), nts.StVenantKirchhoff(young, 0.3), density=density,
            displacement=lambda x: 0.01 * x, velocity=(2.0, 0.0, 0.0),
        )  # fmt: skip
        return nts.System([body])

    path = mpi_tmp_path / "run.h5"
    first = run((cube(), {}), t_end=DT, checkpoint=nts.Checkpoint(path, every=1))
    with pytest.raises(ValueError, match=r"bodies\[0\].mass is"):
        nts.restart(path, cube(density=2e3))
    system = cube(factor * 1e6)
    second = run((system, {}), t_end=3 * DT, start=nts.restart(path, system))
    added = (factor - 1) * first.rows[-1]["potential"]
    assert ("material changed" in second.warnings) == (factor != 1)
    assert np.allclose(second.balance["material_change"], [0, 0, added, added], rtol=1e-9)
    assert "ledger" not in second.warnings


@pytest.mark.mpi
@pytest.mark.parametrize("pull", [1.0, 2.0])
def test_other_loads_are_told(pull, mpi_tmp_path):
    """Of a continuum and a rigid body; functions of time are not in the file."""

    def scene(pull=1.0):
        cube = nts.Continuum(
            box(cells=2), nts.StVenantKirchhoff(1e6, 0.3), density=1e3, name="cube",
            body_force=(0.0, 0.0, pull), viscosity=0.1 * pull,
            bcs=[nts.Dirichlet(lambda x: x[0] < 1e-9)],
        )  # fmt: skip
        ball = nts.RigidBody.from_inertia(
            1.0, (1, 1, 1), centre=(5, 0, 0), force=(pull, 0, 0), torque=lambda t: (0, 0, pull),
            name="ball",
        )  # fmt: skip
        return nts.System([cube, ball])

    path = mpi_tmp_path / "run.h5"
    run((scene(), {}), t_end=DT, checkpoint=nts.Checkpoint(path, every=1))
    system = scene(pull)
    second = run((system, {}), t_end=2 * DT, start=nts.restart(path, system))
    assert second.status == "completed" and ("loads changed" in second.warnings) == (pull != 1.0)
    if pull != 1.0:
        found = second.warnings["loads changed"]
        assert found.worst == 3 and found.first == DT
        assert "viscosity is 0.1 there and 0.2 here of 'cube'" in found.text
        assert "body_force[2] is 1.0 there and 2.0 here of 'cube'" in found.text
        assert "force[0] is 1.0 there and 2.0 here of 'ball'" in found.text


class Counter:
    """A joint of the user's own that counts in each of its elements, one on each rank."""

    name, losses = "counter", ()

    def __init__(self, body, first=0, step=1):
        self.bodies, self.numbers = (body,), np.array([first + step * COMM.rank, first + 7])

    def start(self):
        return 10.0 * self.numbers

    def potential(self, u, history):
        return 0.0

    def coupling(self, bodies):
        raise AssertionError("not needed here")


@pytest.mark.mpi
def test_elements_with_foreign_or_repeated_numbers_are_told():
    def numbering(**options):
        body = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="body", comm=COMM)
        system = nts.System([body])
        vars(system)["joints"] = (Counter(body, **options),)
        return Numbering(system), system.initial_state()

    if COMM.size > 1:
        order, state = numbering()
        with pytest.raises(ValueError, match="'counter': two of its elements or nodes have the nu"):
            order.pack(state, {}, {})
        return
    order, state = numbering()
    tables = order.pack(state, {}, {})
    assert np.array_equal(order.unpack(tables, 0.0).joints[0], [0.0, 70.0])
    other, _ = numbering(first=1)
    with pytest.raises(ValueError, match="'counter': 1 is none of its elements or nodes there"):
        other.unpack(tables, 0.0)
    order.system.joints[0].numbers = np.array([7, 7])
    with pytest.raises(ValueError, match="'counter': two of its elements or nodes have the numbe"):
        order.unpack(tables, 0.0)
    order.system.joints[0].numbers = np.array([0, 7])
    tables["joints/0/number"] = np.array([0, 0])
    with pytest.raises(ValueError, match="'counter': two of its elements or nodes have the numbe"):
        order.unpack(tables, 0.0)
    more = order.pack(state, {}, {})
    more |= {"joints/0/number": np.array([0, 5, 7]), "joints/0/value": np.zeros(3)}
    with pytest.raises(ValueError, match="'counter': has 3 elements or nodes there and 2 here"):
        order.unpack(more, 0.0)


@pytest.mark.mpi
def test_a_start_that_does_not_fit_is_refused(mpi_tmp_path):
    path = mpi_tmp_path / "run.h5"
    run(floor(COMM), t_end=2 * DT, checkpoint=nts.Checkpoint(path, every=1), ledger=False)
    scene = floor(COMM)
    start = nts.restart(path, scene[0])
    with pytest.raises(ValueError, match="ledger=True: the run of the checkpoint kept none"):
        run(scene, start=start)
    with pytest.raises(ValueError, match="start: its system is another one; pass the system to"):
        run(floor(COMM), start=start, ledger=False)
    with pytest.raises(ValueError, match=r"start_time=1.0: a restart goes on at its own time"):
        run(scene, start=start, ledger=False, start_time=1.0, t_end=2.0)
    with pytest.raises(ValueError, match="t_end=0.004: must lie after the start's time 0.004"):
        run(scene, start=start, ledger=False, t_end=2 * DT)
    assert run(scene, start=start, ledger=False).status == "completed"


@pytest.mark.mpi
def test_other_files_are_refused(mpi_tmp_path):
    system, _ = floor(COMM)
    text, other, newer = (mpi_tmp_path / name for name in ("a.txt", "b.h5", "c.h5"))
    if COMM.rank == 0:
        text.write_text("no HDF5")
        with h5py.File(other, "w") as file:
            file["x"] = 1.0
        with h5py.File(newer, "w") as file:
            file.attrs.update(format="dolfinx_nts checkpoint", version=99, package="9.9")
    COMM.barrier()
    for path, kind, said in (
        (text, OSError, "cannot be read"), (other, ValueError, "it is no checkpoint"),
        (newer, ValueError, "version 99, and this package reads version 10"),
    ):  # fmt: skip
        with pytest.raises(kind, match=said):
            nts.restart(path, system)
    with pytest.raises(OSError, match="it is a folder; name a file in it"):
        run(floor(COMM), checkpoint=nts.Checkpoint(mpi_tmp_path, every=1))


class Memory:
    """A joint of the user's own that remembers what no file holds."""

    name, losses, numbers = "own", (), np.arange(0)

    def __init__(self, body):
        self.bodies = (body,)

    def start(self):
        return {"turns": 1}

    def potential(self, u, history):
        return 0.0

    def coupling(self, bodies):
        raise AssertionError("work before the check")


@pytest.mark.mpi
def test_a_state_can_be_pickled():
    """On each rank for itself, without the scene."""
    state = run(blocks(COMM), t_end=2 * DT).state
    again = pickle.loads(pickle.dumps(state))
    assert again.time == state.time and again.contacts[0]._fields == state.contacts[0]._fields
    for a, b in zip(arrays(state), arrays(again), strict=True):
        assert np.array_equal(a, b) and a.dtype == b.dtype


@pytest.mark.mpi
def test_a_joint_that_remembers_something_else_is_told(mpi_tmp_path):
    body = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="body")
    tie = nts.System([body])
    order = Numbering(tie)
    vars(tie)["joints"] = (Memory(body),)
    state = tie.initial_state()
    with pytest.raises(TypeError, match="joint 'own' remembers a dict; a checkpoint takes an arr"):
        order.pack(state, {}, {})


class Presets:
    """A writer that notes the preset of the linear solver in each step."""

    def __init__(self):
        self.names = []

    def start(self, stepper):
        pass

    def write(self, stepper, *, last=False):
        self.names.append(stepper.solver.memory[0])

    def close(self, stepper):
        pass


@pytest.mark.slow
@pytest.mark.mpi
def test_the_linear_solver_is_the_one_that_took_over(mpi_tmp_path, monkeypatch):
    """A block slides into a corner; a restart began with Krylov's method again.

    Six iterations are too many here, so that the method is given up where contact begins.
    """
    monkeypatch.setitem(linear_solver._WORTH, "krylov", (6, 0.0))

    def corner():
        mesh = box((0, 0, 0), (0.4, 0.2, 0.2), (8, 4, 4), comm=COMM)
        block = nts.Continuum(mesh, RUBBER, density=1e3, velocity=(2, 0, 0), name="block")
        low, front = (block.surface(lambda x, k=k: at(x, k)) for k in (2, 0))
        floor, wall = nts.Plane((0, 0, 0), (0, 0, 1)), nts.Plane((0.42, 0, 0), (-1, 0, 0))
        pairs = [nts.ContactPair(*both, friction=0.3) for both in ((low, floor), (front, wall))]
        return nts.System([block], contacts=pairs, gravity=(0, 0, -9.81))

    def at(x, k):
        return x[0] > 0.4 - 1e-9 if k == 0 else x[2] < 1e-9

    def go(system, **options):
        return nts.simulate(
            system, nts.EnergyMomentum(), dt=1e-3, t_end=0.012, adapt=nts.Adapt(tolerance=1e-3),
            **options,
        )  # fmt: skip

    path, presets = mpi_tmp_path / "run.h5", Presets()
    whole = go(corner(), output=[presets], checkpoint=nts.Checkpoint(path, every=18))
    assert presets.names[0] == "krylov" and presets.names[17:19] == ["direct"] * 2
    again, system = Presets(), corner()
    found = go(system, output=[again], start=nts.restart(previous(path), system))
    assert again.names == presets.names[18:]
    if COMM.size == 1:
        assert_same(whole, found)
    # On ranks MUMPS rounds anew, and Newton's method ends anywhere within its tolerance, each step.
    steps = len(whole.balance["time"])
    assert distance(whole, found) < steps * nts.Newton().rtol


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_the_file_is_as_described(mpi_tmp_path):
    """Read without this package: nodes as the mesh was made, whatever the ranks."""
    path = mpi_tmp_path / "run.h5"
    saved = run(blocks(COMM), checkpoint=nts.Checkpoint(path, every=100))
    if COMM.rank > 0:
        return
    with h5py.File(path) as file:
        notes = json.loads(file["notes"][()])
        assert notes["time"] == saved.state.time
        assert [b["name"] for b in notes["scene"]["bodies"]] == ["left", "right"]
        x, u = file["bodies/0/reference"][()], file["bodies/0/u"][()]
        assert x.shape == u.shape == (27, 3) and len(np.unique(x, axis=0)) == 27
        numbers = file["contacts/0/number"][()]
        assert (np.diff(numbers) > 0).all() and len(numbers) == 9
        energy = list(notes["columns"]).index("energy")
        assert all(shape == [] for shape in list(notes["columns"].values())[: energy + 1])
        assert np.array_equal(file["balance/table"][:, energy], saved.balance["energy"])
        assert file.attrs["version"] == 10


# ---- signals
@pytest.fixture(autouse=True)
def heard():
    """SIGINT is not ignored, as it is where the tests run in the background of a shell."""
    old = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, old)


class Signals:
    """Before the fourth step signals come to the last rank."""

    def __init__(self, number, times=1):
        self.number, self.times = number, times

    def __call__(self, time, dt):
        while COMM.rank == COMM.size - 1 and time > 2.5 * DT and self.times:
            self.times -= 1
            os.kill(os.getpid(), self.number)


@pytest.mark.mpi
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.fast("15")
@pytest.mark.fast_on_ranks()
def test_a_signal_ends_the_step_and_the_run(number, mpi_tmp_path):
    path, table = mpi_tmp_path / "run.h5", BalanceCSV(mpi_tmp_path / "table.csv")
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    whole = run(blocks(COMM))
    found = run(
        blocks(COMM), before_step=Signals(number), output=[table],
        checkpoint=nts.Checkpoint(path, every=100),
    )  # fmt: skip
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert found.status == (
        f"interrupted: {number.name} came before t={found.state.time!r}; go on with "
        f"start=restart({str(path)!r}, system)"
    )
    assert len(found.rows) == 5 and found.state.time == whole.balance["time"][4]
    if COMM.rank == 0:
        assert len(table.path.read_text().splitlines()) >= 6
    scene = blocks(COMM)
    assert_same(whole, run(scene, start=nts.restart(path, scene[0])))


@pytest.mark.mpi
def test_a_signal_without_checkpoint_leaves_the_solution():
    found = run(floor(COMM), before_step=Signals(signal.SIGTERM))
    assert found.status.startswith("interrupted: SIGTERM") and "Checkpoint" in found.status
    assert len(found.rows) == 5


@pytest.mark.mpi
def test_a_load_step_ends_on_a_signal_between_its_relaxations(monkeypatch):
    """The first relaxation of the second load step fails, and a signal comes meanwhile."""
    held = nts.Dirichlet(lambda x: x[2] < 1e-9)
    cube = nts.Continuum(box(cells=2), RUBBER, density=1e3, bcs=[held])
    solve, relaxed = LoadStepper._solve, []

    def failing(stepper, *arguments):
        relaxed.append(stepper.state.time)
        if relaxed[-1] > 0.0:
            if COMM.rank == 0:
                os.kill(os.getpid(), signal.SIGTERM)
            raise StepFailedError("hard")
        return solve(stepper, *arguments)

    monkeypatch.setattr(LoadStepper, "_solve", failing)
    system = nts.System([cube], gravity=(0, 0, -9.81))
    found = nts.equilibrium(system, load_steps=2, stabilization=1.0)
    assert found.status.startswith("interrupted: SIGTERM came before t=0.5;")
    assert list(found.balance["time"]) == [0.0, 0.5] and relaxed.count(0.5) == 1


@pytest.mark.mpi
def test_load_steps_end_on_a_signal():
    held = nts.Dirichlet(lambda x: x[2] < 1e-9)
    cube = nts.Continuum(box((0, 0, 0), (1, 1, 1), 2), RUBBER, density=1e3, bcs=[held])
    system, calls = nts.System([cube], gravity=(0, 0, -9.81)), []

    def before(time, dt):
        calls.append(time)
        if len(calls) == 3 and COMM.rank == 0:
            os.kill(os.getpid(), signal.SIGINT)

    found = nts.equilibrium(system, load_steps=5, before_step=before)
    assert found.status.startswith("interrupted: SIGINT came before t=")
    assert "go on with start=" in found.status and 1 < len(found.rows) < 6
    rest = nts.equilibrium(system, load_steps=2, start=found)
    assert rest.status == "completed" and rest.balance["time"][0] == found.balance["time"][-1]


def test_a_signal_that_no_step_has_seen_is_handed_on():
    """It came while the writers closed."""
    if COMM.size > 1:
        pytest.skip("ends the process there")

    class Late:
        def start(self, stepper):
            pass

        def write(self, stepper, *, last=False):
            pass

        def close(self, stepper):
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(floor(COMM), output=[Late()])


@pytest.mark.mpi
@pytest.mark.parametrize("before", ["energy-momentum", "generalized-alpha"])
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_another_integrator_and_other_steps(before, mpi_tmp_path):
    """Legal: the run is that from the Solution in memory, and the balance goes on."""
    path, scene = mpi_tmp_path / "run.h5", mechanism(COMM)
    other = "energy-momentum" if before == "generalized-alpha" else "generalized-alpha"
    first = run(scene, before, t_end=6 * DT, checkpoint=nts.Checkpoint(path, every=2))
    known = run(scene, other, start=first, dt=DT / 3, t_end=8 * DT)
    again = mechanism(COMM)
    done = run(again, other, start=nts.restart(path, again[0]), dt=DT / 3, t_end=8 * DT)
    assert np.allclose(np.diff(done.balance["time"]), [DT] * 6 + [DT / 3] * 6, rtol=1e-9)
    assert distance(known, done) < 1e-12


def test_a_second_interrupt_ends_at_once():
    if COMM.size > 1:
        pytest.skip("ends the process there")
    with pytest.raises(KeyboardInterrupt):
        run(floor(COMM), before_step=Signals(signal.SIGINT, times=2))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_is_ignored_stays_ignored():
    old = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        assert run(floor(COMM), before_step=Signals(signal.SIGTERM)).status == "completed"
    finally:
        signal.signal(signal.SIGTERM, old)


def test_other_threads_install_no_handlers():
    found = []
    thread = threading.Thread(target=lambda: found.append(run(floor(COMM))))
    thread.start()
    thread.join()
    assert found[0].status == "completed"


# ---- kills
SCRIPT = textwrap.dedent(
    """
    import sys, test_checkpoint as t
    system, _ = t.floor(t.COMM)
    path, start = sys.argv[1], None
    if len(sys.argv) > 2:
        start = t.nts.restart(path, system)
    print("ready", flush=True)
    done = t.nts.simulate(
        system, t.nts.EnergyMomentum(), dt=2e-4, t_end=1.0, accuracy="exact", start=start,
        watch_overlap=False, checkpoint=t.nts.Checkpoint(path, every=1),
    )
    """
)


def killed(path, delay, *more):
    """Run the script and kill it a while after it has begun."""
    here, tests, root = Path(__file__).parents[:3]
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(path), *more], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": f"{here}:{tests}:{root / 'demos'}"},
    )  # fmt: skip
    assert process.stdout.readline() == "ready\n"
    time.sleep(delay)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()


@pytest.mark.slow
def test_a_kill_at_any_moment_leaves_a_whole_file(tmp_path):
    """Six processes that write after every step; each goes on where the last was killed."""
    if COMM.size > 1:
        pytest.skip("starts processes of its own")
    path, random, before = tmp_path / "run.h5", np.random.default_rng(17), 0.0
    kills = 6
    for k in range(kills):
        killed(path, random.uniform(0.2, 0.6), *(["go on"] if k else []))
        system, _ = floor(COMM)
        found = nts.restart(path, system)
        assert found.state.time >= before and found.rows[-1]["time"] == found.state.time
        before = found.state.time
    assert before > kills * 2e-4
