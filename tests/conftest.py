"""One pytest session on all ranks: rank 0 reports, and no rank is left waiting for another.

Under mpirun every rank runs the same tests. After each test the ranks exchange who failed:

- a test that failed on another rank is reported as an error here too, so every rank knows and the
  run fails on every rank;
- if a rank failed while another hangs in a collective call that will never complete, the failing
  rank waits `PATIENCE` seconds, prints what it knows and aborts the whole run.
"""

import datetime
import gc
import io
import os
import signal
import sys
import tempfile
import threading
import time
import zlib
from pathlib import Path

from mpi4py import MPI

import noise
import numpy as np
import processes
import pytest

from dolfinx_nts import petsc_compat

PATIENCE = 20.0
"""Time [s] that a failing rank waits for the others before it aborts the run."""

COMM = MPI.COMM_WORLD.Dup()
if threading.current_thread() is not threading.main_thread():
    # A busy machine may make a process of xdist run its tests beside its main thread. Gmsh 4.8,
    # which sets a handler of signals, cannot be imported there.
    signal.signal = lambda number, _handler: signal.getsignal(number)
#: Files whose slow tests take longer than others of their size.
LONG = {
    "test_stability", "test_docs", "test_demo_output", "test_unwritten", "test_massless",
    "test_demo_blocks", "test_demo_stability", "test_conformance", "test_impacts", "test_tradeoff",
}  # fmt: skip
#: One of a test's cases that may be fast is, and its others are slow; in the next week it is
#: another one. On several ranks a fast and a slow one run: ranks seldom fail a single case.
WEEK = datetime.date.today().isocalendar().week
FAILURES = pytest.StashKey[list[str]]()
NOT_COLLECTED: list[str] = []


def _failing_ranks(config, place: str, failures: list[str]) -> list[int]:
    """Exchange at `place` which ranks failed; abort if a failing rank is left alone there."""
    mine = np.array([zlib.crc32(place.encode()), bool(failures)], dtype=np.int64)
    everyones = np.empty((COMM.size, 2), dtype=np.int64)
    request = COMM.Iallgather(mine, everyones)
    deadline = time.monotonic() + PATIENCE
    while not request.Test():
        time.sleep(2e-4)
        if failures and time.monotonic() > deadline:
            _abort(config, f"the other ranks do not reach the end of {place}", failures)
    if np.any(everyones[:, 0] != mine[0]):
        _abort(config, f"the ranks run different tests; this one: {place}", failures)
    return np.flatnonzero(everyones[:, 1]).tolist()


def _abort(config, reason: str, failures: list[str]) -> None:
    # Ranks > 0 have printed their failures already; rank 0 would have in its summary.
    _say(config, *(failures if COMM.rank == 0 else ()), f"run aborted: {reason}")
    COMM.Abort(1)


def _say(config, *parts: str) -> None:
    """Print past pytest's capturing, each line under this rank's number."""
    text = "".join(f"[rank {COMM.rank}] {line}\n" for part in parts for line in part.splitlines())
    with config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        print(text, end="", file=sys.stderr, flush=True)


def pytest_addoption(parser):
    group = parser.getgroup("noise", "rounding as on another machine, see tests/noise.py")
    group.addoption("--noise", choices=noise.KINDS, help="what is noisy")
    group.addoption("--noise-seed", type=int, default=0, help="another seed, another machine")
    parser.addoption("--until", type=int, help="skip tests that begin later [s since 1970]")


def pytest_report_header(config):
    lines = [f"cases: those of week {WEEK}"]
    if kind := config.option.noise:
        lines.append(f"noise: {kind}, seed {config.option.noise_seed}")
    return lines


@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    if config.option.noise:
        noise.install(config.option.noise, config.option.noise_seed)
    config.option.loadscopereorder = False  # xdist's own order, by the number of a file's tests
    if COMM.rank > 0:
        config.get_terminal_writer()._file = io.StringIO()
        # A place for tmp_path of its own: pytest's cleaning up of old ones knows nothing of ranks.
        place = Path(tempfile.gettempdir()) / f"pytest-of-{os.getuid()}-rank-{COMM.rank}"
        place.mkdir(mode=0o700, exist_ok=True)
        os.environ["PYTEST_DEBUG_TEMPROOT"] = str(place)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    until = item.config.option.until
    if until and COMM.bcast(time.time() > until):
        pytest.skip("the time given by --until is over")


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    report = (yield).get_result()
    if COMM.size == 1:
        return
    failures = item.stash.setdefault(FAILURES, [])
    if report.failed:
        failures.append(f"FAILED {item.nodeid} ({report.when})\n{report.longreprtext}")
    if report.when != "teardown":
        return
    if COMM.rank > 0 and failures:
        _say(item.config, *failures)
    ranks = _failing_ranks(item.config, item.nodeid, failures)
    if ranks and not failures:
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} failed on rank(s) {ranks}: their report is further up"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Before -m selects: mark what is not fast, and tests that start ranks of their own."""
    if config.option.until:
        # Those for which there is no time are others in each week.
        turn = {i.path: zlib.crc32(f"{WEEK} {i.path.name}".encode()) for i in items}
        items.sort(key=lambda i: (i.path.stem not in LONG, turn[i.path]))
    elif "PYTEST_XDIST_WORKER" in os.environ:
        # A process takes a file at a time: long and large ones first, because a long one as the
        # last would leave the others idle.
        size = {path: path.stat().st_size for path in {item.path for item in items}}
        items.sort(key=lambda i: (i.path.stem in LONG, size[i.path], i.path.name), reverse=True)
    unknown: dict[str, set[str]] = {}
    for item in items:
        if "on_ranks" in item.fixturenames:
            item.add_marker(pytest.mark.on_ranks)
            item.add_marker(pytest.mark.slow)
        for name, holds in (("fast", True), ("fast_on_ranks", COMM.size > 1)):
            if (mark := item.get_closest_marker(name)) is None:
                continue
            own = item.callspec.id if hasattr(item, "callspec") else ""
            test = item.nodeid.removesuffix(f"[{own}]")
            unknown.setdefault(f"{name} of {test}", set(mark.args)).discard(own)
            if holds and own not in mark.args:
                item.add_marker(pytest.mark.slow)
    # Of a test that is named with its parameters the others are not collected; an error in a
    # process of xdist reaches no one, and the tests on 2 ranks are collected without it.
    named = any("[" in argument for argument in config.args)
    if not named and "PYTEST_XDIST_WORKER" not in os.environ and any(unknown.values()):
        missing = [f"{test}: {sorted(ids)}" for test, ids in unknown.items() if ids]
        raise pytest.UsageError("marks name no test: " + "; ".join(missing))
    if not named:
        _choose_cases(config, items)


def _choose_cases(config, items) -> None:
    """Of a test's fast cases let one be fast; on ranks leave all out but a fast and a slow one."""
    cases: dict[tuple[str, bool], list] = {}
    for item in items:
        slow = item.get_closest_marker("slow") is not None
        cases.setdefault((item.nodeid.split("[")[0], slow), []).append(item)
    kept = {of_test[WEEK % len(of_test)] for of_test in cases.values()}
    if COMM.size == 1:
        for item in items:
            if item not in kept:
                item.add_marker(pytest.mark.slow)
        return
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = [item for item in items if item in kept]


def pytest_collection_finish(session):
    if COMM.size > 1:
        gc.collect()
        gc.freeze()  # what was imported stays: no collection looks through it


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Free what a test leaves, on all ranks at once.

    Else each rank frees meshes when its own collector runs. Its communicators' numbers then have
    gaps where another rank's have none, and MPI needs ever more rounds to agree on one that is free
    everywhere: a new communicator took 50 us in the first test and 1 ms in the 500th.
    """
    yield
    if COMM.size > 1:
        gc.collect()
        petsc_compat.free_dropped(MPI.COMM_WORLD)


def pytest_collectreport(report):
    if report.failed:
        NOT_COLLECTED.append(f"NOT COLLECTED {report.nodeid}\n{report.longreprtext}")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session, exitstatus):
    if COMM.size == 1:
        return
    known = (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED)
    failures = list(NOT_COLLECTED)
    if exitstatus not in known:
        failures.append(f"pytest ended early, exit status {int(exitstatus)}")
    if COMM.rank > 0 and failures:
        _say(session.config, *failures)
    _failing_ranks(session.config, "the session", failures)


@pytest.fixture
def mpi_tmp_path(tmp_path):
    """Rank 0's tmp_path, on every rank: for files that the ranks write together."""
    return Path(COMM.bcast(str(tmp_path)))


@pytest.fixture
def on_ranks():
    """Function (ranks, *arguments) that runs Python under mpirun and returns what it printed.

    With well=False it must fail, and what it says on stderr is returned, too.
    """
    if COMM.size > 1:
        pytest.skip("starts ranks of its own")
    return processes.on_ranks
