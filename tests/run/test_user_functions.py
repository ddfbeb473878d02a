"""What a run calls of the user's and fails: everything computed is kept, and all ranks end alike.

Where a test has one rank raise, it is the last one, which is the only one in serial.
"""

import re
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from pairs import pairs
from point_mass import PointMass
from scenes import RUBBER, bottom, box, top

import dolfinx_nts as nts
from dolfinx_nts import output, validation

COMM = MPI.COMM_WORLD
DT = 1e-3
#: After this all of a scene's functions fail: in the third step.
LATE = 2.2e-3

pytestmark = pytest.mark.mpi


def raises(t):
    raise KeyError("table")


def nan(t):
    return (0, 0, np.nan)


def two_numbers(t):
    return (0, 0)


def until_late(fails, ranks):
    """A function of time that is zero at first and fails later, on some ranks."""
    failing = ranks == "all" or COMM.rank == COMM.size - 1
    return lambda t: fails(t) if t > LATE and failing else (0, 0, -0.01 * t)


def loads(what, function):
    """Options of a body with a function of time in one of its loads, or none."""
    if what == "Traction":
        return {"traction": [nts.Traction(top, function)]}
    return {"body_force": function} if what == "body_force" else {}


def scene(what=None, function=None):
    """A block that flies above a floor, with a function of time somewhere."""
    options = loads(what, function)
    if what == "Dirichlet":
        options["bcs"] = [nts.Dirichlet(bottom, components=(0,)), nts.Dirichlet(top, function)]
    body = nts.Continuum(
        box(), RUBBER, density=1e3, name="block", velocity=(0, 0, 0.1), **options
    )
    motion = function if what == "motion" else None
    floor = nts.Plane((0, 0, -1e-3), (0, 0, 1), motion=motion, name="floor")
    return nts.System([body], contacts=[nts.ContactPair(body.surface(bottom), floor)])


NAMES = {
    "Dirichlet": r"^Dirichlet.value of bcs\[1\] of 'block' at t=0.003",
    "Traction": r"^Traction.value of traction\[0\] of 'block' at t=0.0025",
    "body_force": r"^body_force of 'block' at t=0.0025",
    "motion": r"^motion of 'floor' at t=0.003",
}
FAILURES = {
    raises: r": <function .* raised KeyError\('table'\), line \d+ of test_\w+\.py; correct it$",
    nan: r": returned \(0, 0, nan\); pass three finite components \[[\w^/]+\]$",
    two_numbers: r": returned \(0, 0\); pass three finite components \[[\w^/]+\]$",
}


def same_on_all_ranks(value):
    assert len(set(COMM.allgather(value))) == 1
    return value


@pytest.mark.parametrize(("what", "fails", "ranks"), pairs(NAMES, FAILURES, ["all", "last"]))
@pytest.mark.fast(
    "Dirichlet-nan-last", "Traction-two_numbers-all", "body_force-raises-last", "motion-nan-all",
)  # fmt: skip
@pytest.mark.fast_on_ranks("Dirichlet-nan-last", "body_force-raises-last")
def test_a_run_keeps_what_it_has(what, fails, ranks):
    system = scene(what, until_late(fails, ranks))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=DT, t_end=5 * DT)
    assert re.search(NAMES[what] + r"\d*" + FAILURES[fails], same_on_all_ranks(run.status))
    assert run.retries == 0
    good = scene(what, until_late(lambda t: (0, 0, -0.01 * t), ranks))
    whole = nts.simulate(good, nts.EnergyMomentum(), dt=DT, t_end=5 * DT)
    assert whole.status == "completed"
    for name, column in run.balance.items():
        # Ranks add up in any order; energy, momentum and time here are of the order of 1 to 100.
        assert np.allclose(column, whole.balance[name][:3], rtol=1e-10, atol=1e-12), name
    short = nts.simulate(good, nts.EnergyMomentum(), dt=DT, t_end=2 * DT)
    assert short.status == "completed"
    for kept, there in zip(
        (system.bodies[0].u, system.bodies[0].v), (good.bodies[0].u, good.bodies[0].v), strict=True
    ):
        size = COMM.allreduce(np.abs(there.x.array).max(), op=MPI.MAX)
        assert size > 0 and np.abs(kept.x.array - there.x.array).max() <= 1e-9 * size


def test_a_run_of_chosen_steps_keeps_what_it_has():
    system = scene("body_force", until_late(raises, "last"))
    run = nts.simulate(system, nts.Midpoint(), dt=DT, t_end=5 * DT, adapt=nts.Adapt())
    assert re.search(r"^body_force of 'block' at t=0.00\d*: ", same_on_all_ranks(run.status))
    assert len(run.rows) > 1 and run.retries == 0
    assert run.balance["time"][-1] < 5 * DT


@pytest.mark.parametrize("what", NAMES)
@pytest.mark.fast_on_ranks("body_force")
def test_equilibrium_keeps_what_it_has(what):
    supports = nts.Dirichlet(bottom)
    fails = until_late(raises, "last")
    system = scene(what, fails) if what == "Dirichlet" else held(what, fails, supports)
    # Pseudo times, which the functions take as time.
    run = nts.equilibrium(system, load_steps=[DT, 2 * DT, 3 * DT, 4 * DT])
    pattern = NAMES[what].replace("0.0025", "0.003") + r"\d*: .*raised KeyError\('table'\)"
    assert re.search(pattern, same_on_all_ranks(run.status))
    assert run.retries == 0
    assert np.allclose(run.balance["time"], [0, DT, 2 * DT])


def held(what, function, supports):
    """The block on a support, with a function of time in another place."""
    system = scene(what, function)
    body, floor = system.bodies[0], system.contacts[0].master
    block = nts.Continuum(
        body.mesh, RUBBER, density=1e3, name="block", bcs=[supports], **loads(what, function)
    )
    pair = nts.ContactPair(block.surface(top), floor) if what == "motion" else None
    return nts.System([block], contacts=[pair] if pair else [])


def test_a_stepper_learns_the_cause_and_goes_on():
    broken = [True]

    def force(t):
        return raises(t) if broken and t > LATE and COMM.rank == COMM.size - 1 else (0, 0, 0)

    stepper = nts.Stepper(scene("body_force", force), nts.EnergyMomentum())
    with pytest.raises(nts.StepFailedError, match="^body_force of 'block' at t=0.0025") as caught:
        for _ in range(5):
            stepper.advance(DT)
    assert isinstance(caught.value.__cause__, KeyError) == (COMM.rank == COMM.size - 1)
    assert len(stepper.solution.rows) == 3 and stepper.solution.retries == 0
    broken.clear()
    stepper.advance(DT)
    assert np.isclose(stepper.state.time, 3 * DT)
    stepper.close()


def test_a_support_that_fails_at_the_start_of_the_motion():
    """Its rate there takes its values over the first step; what failed can be tried again."""
    working = []

    def value(t):
        return (0, 0, t) if working or not t else raises(t)

    run = nts.simulate(scene("Dirichlet", value), nts.Midpoint(), dt=DT, t_end=DT)
    assert same_on_all_ranks(run.status).startswith("Dirichlet.value of bcs[1] of 'block' at t=0.0")
    assert len(run.rows) == 1
    stepper = nts.Stepper(scene("Dirichlet", value), nts.Midpoint())
    with pytest.raises(nts.StepFailedError, match="Dirichlet.value"):
        stepper.advance(DT)
    working.append(True)
    stepper.advance(DT)
    held = stepper.system.bodies[0].fixed
    speed = stepper.state.v[0][held[held % 3 == 2]]
    assert np.allclose(speed, 1.0)
    stepper.close()


@pytest.mark.parametrize(
    ("what", "says"),
    [("internal", "the internal forces of 'mass' are not finite"), ("external", "not finite"),
     ("potential", "completed, but the energy is not finite")],
)  # fmt: skip
def test_a_body_of_ones_own_whose_numbers_are_none(what, says, monkeypatch):
    """In the third step, on the rank that has its coordinates; what was accepted is finite."""
    right = getattr(PointMass, what)

    def late(body, *given):
        return right(body, *given) * (np.nan if body.moment.time > LATE else 1.0)

    monkeypatch.setattr(PointMass, what, late)
    body = PointMass(COMM, 1.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    body.begin_step(None, SimpleNamespace(time=0.0))
    run = nts.simulate(
        nts.System([body], gravity=(0, 0, -9.81)), nts.EnergyMomentum(), dt=DT, t_end=5 * DT
    )
    assert says in same_on_all_ranks(run.status)
    assert len(run.rows) >= 3 and np.isfinite(run.state.u[0]).all()
    assert np.isfinite(run.balance["linear_momentum"]).all()


@pytest.mark.parametrize("what", NAMES)
def test_at_the_start_it_is_a_bad_argument(what):
    with pytest.raises(ValueError, match=r"at t=0.0: <function raises.*KeyError\('table'\), line"):
        scene(what, raises)


def test_an_interrupt_goes_through():
    def stop(t):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        nts.simulate(
            scene("body_force", until_late(stop, "all")), nts.Midpoint(), dt=DT, t_end=5 * DT
        )


def test_constants_are_not_agreed_on(monkeypatch):
    monkeypatch.setattr(validation, "at_time", raises)
    run = nts.simulate(scene("Traction", (0, 0, 1.0)), nts.Midpoint(), dt=DT, t_end=2 * DT)
    assert run.status == "completed"


class Writer:
    """Counts its calls; one of them fails."""

    def __init__(self, failing=None, ranks="all"):
        self.failing = failing if ranks == "all" or COMM.rank == COMM.size - 1 else None
        self.calls = []

    def _call(self, name):
        self.calls.append(name)
        if self.failing == name and (name != "write" or self.calls.count("write") == 2):
            raise KeyError("table")

    def start(self, run):
        self._call("start")

    def write(self, run, *, last=False):
        self._call("write")

    def close(self, run):
        self._call("close")


@pytest.mark.parametrize("ranks", ["all", "last"])
@pytest.mark.parametrize(("failing", "written"), [("write", 2), ("close", 3)])
@pytest.mark.fast_on_ranks("write-2-last")
def test_a_writer_that_fails(failing, written, ranks, mpi_tmp_path):
    writers = [Writer(), Writer(failing, ranks), output.BalanceCSV(mpi_tmp_path / "b.csv")]
    with pytest.raises(nts.OutputError) as caught:
        nts.simulate(scene(), nts.Midpoint(), dt=DT, t_end=3 * DT, output=writers)
    run, mine = caught.value.solution, ranks == "all" or COMM.rank == COMM.size - 1
    assert str(caught.value) == run.status and isinstance(caught.value.__cause__, KeyError) == mine
    assert re.search(
        rf"^output\[1\] \(Writer\): {failing} at t=0.00{written}\d* raised KeyError\('table'\); "
        "correct it, or leave this writer out$",
        same_on_all_ranks(run.status),
    )
    assert len(run.rows) == written + 1
    for writer in writers[:2]:
        assert writer.calls == ["start"] + written * ["write"] + ["close"]
    lines = (mpi_tmp_path / "b.csv").read_text().splitlines()
    assert sum(not line.startswith("# warning") for line in lines) == written + 2


def test_a_writer_that_fails_at_the_end_hides_no_grave_warning():
    class Doubts(Writer):
        def write(self, run, *, last=False):
            if last:
                run.solution.warn("ledger", 0.0, 1.0, "something is wrong", grave=True)

    with pytest.raises(nts.OutputError, match=r"^completed, but something is wrong.*; output\[0\]"):
        nts.simulate(scene(), nts.Midpoint(), dt=DT, t_end=DT, output=[Doubts("close")])


@pytest.mark.parametrize("ranks", ["all", "last"])
def test_a_writer_that_cannot_start_stops_before_any_step(ranks):
    writers = [Writer("start", ranks), Writer()]
    mine = ranks == "all" or COMM.rank == COMM.size - 1
    with pytest.raises(KeyError if mine else RuntimeError, match="table"):
        nts.simulate(scene(), nts.Midpoint(), dt=DT, t_end=DT, output=writers)
    assert writers[1].calls == ["start", "close"]
    assert not writers[0].calls.count("write")


def test_a_writer_of_equilibrium_that_fails():
    system = held("body_force", (0, 0, -1.0), nts.Dirichlet(bottom))
    with pytest.raises(nts.OutputError) as caught:
        nts.equilibrium(system, load_steps=4, output=[Writer("write", "last")])
    run = caught.value.solution
    assert same_on_all_ranks(run.status).startswith("output[0] (Writer): write at t=0.5 raised")
    assert np.allclose(run.balance["time"], [0, 0.25, 0.5])
