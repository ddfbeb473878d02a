"""A disk that is full, or a folder that is gone: a sentence, and what was written before is whole.

A limit on the size of files stands for the full disk: what does not fit is written in part, and
then the system call fails.
"""

import io
import resource
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from scenes import meeting_blocks, thrown_block
from xdmf import read_xdmf

import dolfinx_nts as nts
from dolfinx_nts import output
from dolfinx_nts.output import pictures
from dolfinx_nts.output.whole_files import Draft, amend_file, extend_file, replace_file

COMM = MPI.COMM_WORLD
mpi = pytest.mark.mpi


@contextmanager
def largest_file(size):
    """No file of this process can grow beyond this size [B]."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Happens:
    """A writer before whose step number `step` something happens."""

    def __init__(self, step, event):
        self.step, self.event = step, event

    def start(self, run):
        pass

    def write(self, run, *, last=False):
        if len(run.solution.rows) == self.step + 1:
            self.event()

    def close(self, run):
        pass


# ---- changes of files
@pytest.mark.parametrize("room", [0, 1, 9])
@pytest.mark.parametrize(
    "change",
    [
        lambda path: extend_file(path, b"y" * 10),
        lambda path: amend_file(path, [(60, b"abc"), (100, b"y" * 10), (3, b"defg")]),
        lambda path: amend_file(path, [(95, b"y" * 15)]),
    ],
)
def test_a_change_that_does_not_fit_changes_nothing(change, room, tmp_path):
    path, old = tmp_path / "file", bytes(range(100))
    path.write_bytes(old)
    with largest_file(100 + room), pytest.raises(OSError, match="File too large"):
        change(path)
    assert path.read_bytes() == old
    change(path)
    assert path.stat().st_size == 110


def test_a_change_in_places(tmp_path):
    path, expected = tmp_path / "file", bytearray(range(100))
    path.write_bytes(expected)
    amend_file(path, [(60, b"abc"), (100, b"y" * 10), (61, b"X"), (95, b"12345")])
    expected[60:63], expected[95:100] = b"aXc", b"12345"
    assert path.read_bytes() == bytes(expected) + b"y" * 10


def test_a_file_is_replaced_or_kept(tmp_path):
    path = tmp_path / "new" / "file"
    replace_file(path, b"old" * 10)
    with largest_file(20), pytest.raises(OSError, match="File too large"):
        replace_file(path, b"new" * 10)
    assert path.read_bytes() == b"old" * 10
    assert [p.name for p in path.parent.iterdir()] == ["file"]


@pytest.mark.parametrize("seed", range(5))
def test_a_draft_is_a_file_in_memory(seed, tmp_path):
    """Against BytesIO; nothing reaches the disk until the parts are written."""
    rng, path = np.random.default_rng(seed), tmp_path / "file"
    old = rng.bytes(200)
    path.write_bytes(old)
    twin = io.BytesIO(old)
    with Draft(open(path, "rb")) as draft:
        for _ in range(60):
            start, size = (int(n) for n in rng.integers(0, (260, 60)))
            assert draft.seek(start) == twin.seek(start)
            data = rng.bytes(size)
            assert draft.write(data) == twin.write(data) and draft.tell() == twin.tell()
            start = int(rng.integers(0, 200))
            draft.seek(start), twin.seek(start)
            assert draft.read(70) == twin.read(70).ljust(70, b"\0")
            end = 200 + int(rng.integers(0, 100))
            draft.truncate(end)
            twin.seek(0, 2)
            twin.write(bytes(max(0, end - twin.tell())))
            twin.truncate(end)
            assert draft.seek(0, 2) == twin.seek(0, 2) == end
        assert path.read_bytes() == old
        parts = draft.parts
    amend_file(path, parts)
    assert path.read_bytes() == twin.getvalue()


# ---- runs
@mpi
def test_a_full_disk_ends_the_run_with_whole_fields(mpi_tmp_path):
    path, table = mpi_tmp_path / "left", mpi_tmp_path / "b.csv"
    with largest_file(resource.RLIM_INFINITY):

        def fill():
            hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
            size = COMM.bcast(path.with_suffix(".h5").stat().st_size if COMM.rank == 0 else None)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size + 2000, hard))

        writers = [Happens(3, fill), output.Fields(mpi_tmp_path), output.BalanceCSV(table)]
        system = meeting_blocks()
        with pytest.raises(nts.OutputError) as caught:
            nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=6e-3, output=writers)
    run = caught.value.solution
    assert run.status.startswith("output[1] (Fields): write at t=0.003 raised OSError(")
    assert "File too large" in run.status and "with space and write permission" in run.status
    assert run.status.count("OSError") == 1 and len(run.rows) == 4
    COMM.Barrier()
    for name in ("left", "the_right_one"):
        file = read_xdmf(mpi_tmp_path / f"{name}.xdmf")
        assert file.times == [0.0, 1e-3, 2e-3] and len(file.fields) == 3
        assert all(np.isfinite(f["displacement"]).all() for f in file.fields)
    assert np.array_equal(np.loadtxt(table, delimiter=",", skiprows=1)[:, 0], run.balance["time"])


SCRIPT = """
import resource, sys
from mpi4py import MPI
sys.path.insert(0, {tests!r})
import dolfinx_nts as nts
from dolfinx_nts.output import Fields
from scenes import thrown_block

resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, resource.RLIM_INFINITY))
run, fields = nts.Stepper(thrown_block(), nts.Midpoint()), Fields({folder!r})
fields.start(run)
while True:
    run.advance(1e-3)
    fields.write(run)
"""


@pytest.mark.slow
def test_a_script_ends_by_an_exception_where_the_disk_is_full(tmp_path):
    """By exit status 1, neither by a signal nor in silence; what was written before can be read."""
    script = SCRIPT.format(tests=str(Path(__file__).parents[1]), folder=str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 1, done.stderr
    assert "File too large" in done.stderr and "with space and write permission" in done.stderr
    file = read_xdmf(tmp_path / "body.xdmf")
    assert len(file.times) == len(file.fields) > 2
    assert np.allclose(file.times, 1e-3 * np.arange(len(file.times)), rtol=1e-12)
    for time, fields in zip(file.times, file.fields, strict=True):
        assert np.allclose(fields["displacement"], time * np.array([1.0, 2.0, 3.0]), atol=1e-12)


@mpi
def test_fields_go_on_where_there_is_space_again(mpi_tmp_path):
    """Of the step that failed the body's numbers are there, but not their list."""
    run, writer = nts.Stepper(thrown_block(), nts.Midpoint()), output.Fields(mpi_tmp_path)
    writer.start(run)
    run.advance(1e-3)
    listing = mpi_tmp_path / "body.xdmf"
    if COMM.rank == 0:
        listing.rename(mpi_tmp_path / "elsewhere")
    with pytest.raises(OSError, match="No such file"):
        writer.write(run)
    if COMM.rank == 0:
        (mpi_tmp_path / "elsewhere").rename(listing)
    run.advance(1e-3)
    writer.write(run)
    COMM.Barrier()
    file = read_xdmf(listing)
    assert file.times == [0.0, 2e-3]
    assert np.allclose(file.fields[1]["displacement"], [2e-3, 4e-3, 6e-3], rtol=1e-12)
    run.close()


@mpi
@pytest.mark.parametrize("kind", ["fields", "table"])
def test_a_folder_that_is_gone_ends_the_run(kind, mpi_tmp_path):
    folder = mpi_tmp_path / "gone"

    def remove():
        if COMM.rank == 0:
            shutil.rmtree(folder)

    writer = output.Fields(folder) if kind == "fields" else output.BalanceCSV(folder / "b.csv")
    writers = [Happens(2, remove), writer]
    with pytest.raises(nts.OutputError) as caught:
        nts.simulate(thrown_block(), nts.Midpoint(), dt=1e-3, t_end=6e-3, output=writers)
    run = caught.value.solution
    assert "write at t=0.002 raised OSError(" in run.status and "No such file" in run.status
    assert run.status.count("OSError") == 1 and len(run.rows) == 3


@mpi
def test_a_full_disk_ends_the_run_with_a_whole_table(mpi_tmp_path):
    path = mpi_tmp_path / "b.csv"
    with largest_file(1000):
        writers = [output.BalanceCSV(path)]
        with pytest.raises(nts.OutputError) as caught:
            nts.simulate(thrown_block(), nts.Midpoint(), dt=1e-3, t_end=20e-3, output=writers)
    run = caught.value.solution
    assert run.status.startswith("output[0] (BalanceCSV): write at")
    assert run.status.count("File too large") == 1
    COMM.Barrier()
    table, time = np.loadtxt(path, delimiter=",", skiprows=1), run.balance["time"]
    assert np.array_equal(table[:, 0], time[:-1]) and len(table) > 1
    assert table.shape[1] == 4 + len(run.balance)


@mpi
@pytest.mark.parametrize("kind", ["plot", "picture"])
@pytest.mark.slow
def test_an_old_picture_outlives_a_full_disk(kind, mpi_tmp_path):
    run = nts.simulate(thrown_block(), nts.Midpoint(), dt=1e-3, t_end=2e-3)
    path = mpi_tmp_path / "picture.png"
    draw = run.plot if kind == "plot" else lambda p: pictures.picture(run.system.bodies, p)
    draw(str(path))
    COMM.Barrier()
    old = path.read_bytes()
    with largest_file(5000), pytest.raises(OSError, match="File too large"):
        draw(str(path))
    assert path.read_bytes() == old and old.startswith(b"\x89PNG")
