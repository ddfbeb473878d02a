"""Steps that are chosen: their error, the gaps they meet, and that nothing else changes."""

import csv

from mpi4py import MPI

import numpy as np
import pytest
import two_blocks
from dolfinx.mesh import CellType, create_box
from integrators import MID_STEP
from point_mass import MASS, SPEED, STEP, PointMass, PointSurface, mass_on_wall, wall
from scenes import fail_once

import dolfinx_nts as nts
from dolfinx_nts.output import BalanceCSV
from dolfinx_nts.run.paced import paced
from dolfinx_nts.run.step_size import Pace, factor
from dolfinx_nts.run.stepper import Stepper

COMM = MPI.COMM_WORLD
RATE = 3.0
"""Angular frequency of the mass on a spring [1/s]."""


class SpringMass(PointMass):
    """A mass on a spring that is at rest at u = 0; x = sin(RATE t) from u = 0 and v = RATE."""

    def __init__(self):
        super().__init__(COMM, MASS, (0.0, 0.0, 0.0), (RATE, 0.0, 0.0))

    def internal(self, u1):
        return MASS * RATE**2 * (self.moment.u0 + u1) / 2

    def tangent(self, u1, mass, stiffness):
        slope = MASS * (mass + stiffness * RATE**2 / 2)
        self._matrix.zeroEntries()
        self._matrix.setValues(self._rows, self._rows, slope * np.eye(self.num_owned))
        self._matrix.assemble()
        return self._matrix

    def potential(self, u):
        return MASS * RATE**2 * float(u @ u) / 2


class Path:
    """Writer: displacement of the first body's first owner."""

    def start(self, stepper):
        self.time, self.u = [], []

    def write(self, stepper, *, last=False):
        self.time.append(stepper.state.time)
        self.u.append(COMM.bcast(stepper.state.u[0]))
        self.last = last

    def close(self, stepper):
        self.time, self.u = np.array(self.time), np.array(self.u)


def vibrate(tolerance, t_end=5.0):
    path = Path()
    run = nts.simulate(
        nts.System([SpringMass()]), nts.EnergyMomentum(), dt=0.5, t_end=t_end, output=[path],
        adapt=nts.Adapt(tolerance=tolerance),
    )  # fmt: skip
    assert run.status == "completed" and path.last
    return run, path


# ---- the error
@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_error_of_a_step_is_that_of_the_trapezoidal_rule():
    """h^3/12 times the third derivative of sin, over the tolerance and what the mass may cover."""
    adapt, h, span = nts.Adapt(tolerance=1e-2), 0.01, 2.0
    stepper = Stepper(nts.System([SpringMass()]), nts.EnergyMomentum())
    pace = Pace(adapt, stepper.system, stepper.state, h, span)
    for k in range(100):
        stepper.problem.begin(stepper.state, h)
        assert pace.accepts(stepper.problem, stepper.solver.solve())
        stepper.advance(h)
        if k:
            largest = h**3 / 12 * RATE**3 / (1e-2 * RATE * span)
            expected = largest * abs(np.cos(RATE * k * h))
            assert abs(pace.memory.error - expected) < 0.01 * largest
    stepper.close()


@pytest.mark.mpi
def test_steps_above_their_tolerance_are_told():
    """A step of the spring errs by h^3/12 times the third derivative of its sine."""
    h, tolerances = 0.1, (1e-3, 1e-4)
    for tolerance in tolerances:
        run = nts.simulate(
            nts.System([SpringMass()]), nts.EnergyMomentum(), dt=h, t_end=2.0,
            adapt=nts.Adapt(tolerance=tolerance, shortest=1.0),
        )  # fmt: skip
        # Steps after the first: there nothing is known.
        t = h * np.arange(1.5, 20)
        error = h**3 / 12 * RATE**3 * np.abs(np.cos(RATE * t)) / (tolerance * 2.0 * RATE)
        assert run.rejected == 0 and len(run.rows) == 21
        assert run.exceeded == pytest.approx((error > 1).sum(), abs=2)
        assert (f"{run.exceeded} steps taken though" in run.summary) == (run.exceeded > 0)
    assert run.exceeded > 10


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_error_of_a_run_follows_the_tolerance():
    """Steps as tolerance^(-1/3), the error of a run as h^2, thus as tolerance^(2/3)."""
    errors, steps = [], []
    for tolerance in (1e-3, 1e-3 / 8, 1e-3 / 64):
        run, path = vibrate(tolerance)
        errors.append(np.abs(path.u[:, 0] - np.sin(RATE * path.time)).max())
        steps.append(len(path.time))
        table = run.balance
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
    assert 3.0 < errors[0] / errors[1] < 5.3 and 3.0 < errors[1] / errors[2] < 5.3, errors
    assert 1.7 < steps[1] / steps[0] < 2.3 and 1.7 < steps[2] / steps[1] < 2.3, steps


def test_factor_of_a_step():
    assert factor(0.0) == factor(1e-9) == 4.0
    assert factor(0.5) == factor(0.99) == 1.0  # not worth new matrices
    assert factor(0.1) == pytest.approx(0.9 * 0.1 ** (-1 / 3))
    assert factor(8.0) == pytest.approx(0.45)
    assert factor(1e9) == factor(np.inf) == factor(np.nan) == 0.25


@pytest.mark.mpi
def test_free_flight_takes_the_largest_steps_and_ends_on_time():
    mass = PointMass(COMM, MASS, (1.0, 2.0, 3.0), (0.5, 0.0, 1.0))
    path = Path()
    nts.simulate(
        nts.System([mass], gravity=(0, -1, -9.81)), nts.Midpoint(), dt=0.1, t_end=1.0,
        output=[path], adapt=nts.Adapt(shortest=1 / 16),
    )  # fmt: skip
    steps = np.diff(np.append(0.0, path.time))
    assert np.allclose(steps[:2], [0.1 / 16, 0.1 / 4]) and np.allclose(steps[2:-2], 0.1)
    assert steps[-1] == pytest.approx(steps[-2]) and path.time[-1] == 1.0


# ---- gaps
@pytest.mark.mpi
@pytest.mark.parametrize("theta", [0.1, 0.5, 0.75])
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast("midpoint-0.1", "energy-momentum-0.75")
@pytest.mark.fast_on_ranks("midpoint-0.1")
def test_a_mass_rebounds_from_a_wall_without_loss(integrator, theta):
    """Fixed steps leave |1 - 2 theta| of the speed; a step that ends at the wall leaves it all."""
    system, _ = mass_on_wall((3 + theta) * STEP * SPEED)
    run = nts.simulate(system, integrator, dt=STEP, t_end=8 * STEP, adapt=nts.Adapt())
    table = run.balance
    energy = table["energy"][0]
    assert table["active"].max() == 1
    momentum = table["linear_momentum"][:, 2] / (MASS * SPEED)
    assert momentum[0] == pytest.approx(-1) and momentum[-1] == pytest.approx(1, abs=1e-5)
    assert table["contact_defect"][-1] < 1e-5 * energy
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * energy
    assert table["min_gap"].min() > -1e-12 * STEP * SPEED


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_the_first_impact_of_a_bar_is_one_event():
    """Its four nodes close together: one step ends there, and none of the impact is lost."""
    import bar_impact

    system = bar_impact.scene(COMM, 10, False)
    dt = 0.9 * bar_impact.LENGTH / 10 / bar_impact.WAVE
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt, t_end=0.7, adapt=nts.Adapt(tolerance=2e-3)
    )
    table = run.balance
    first = int(np.flatnonzero(table["active"])[0])
    assert table["active"][first] == 4
    hit = bar_impact.GAP / bar_impact.SPEED
    assert table["time"][first - 1] == pytest.approx(hit, rel=1e-7)
    assert table["contact_defect"][first] < 1e-6 * table["energy"][0]
    # The acceleration jumps there: nothing before it says how far the next step errs.
    assert np.diff(table["time"])[first - 1] == pytest.approx(dt / 64)
    fixed = nts.simulate(
        bar_impact.scene(COMM, 10, False), nts.EnergyMomentum(), dt=dt, t_end=0.7
    ).balance
    assert fixed["contact_defect"].max() > 1e-2 * fixed["energy"][0]


@pytest.mark.mpi
@pytest.mark.parametrize(("gap", "taken"), [(-4e-3, True), (0.3 * STEP * SPEED, False)])
def test_a_step_that_moves_a_node_out_is_not_shortened(gap, taken):
    """A node behind its facet leaves with 2 gap / h: the shorter the step, the faster."""
    system, _ = mass_on_wall(gap, velocity=(SPEED, 0.0, 0.0 if taken else -SPEED))
    stepper = Stepper(system, nts.EnergyMomentum())
    pace = Pace(nts.Adapt(tolerance=1e-4), system, stepper.state, STEP, 1.0)
    pace.dt = STEP
    at_rest = tuple(np.zeros_like(v) for v in stepper.state.v)
    pace.resume(pace.memory._replace(before=STEP, accelerations=at_rest))
    stepper.problem.begin(stepper.state, STEP)
    step = stepper.solver.solve()
    assert pace.accepts(stepper.problem, step) == taken
    assert (pace.dt == STEP) == taken
    assert pace.memory.error > 1.0 or not taken
    stepper.close()


@pytest.mark.mpi
def test_each_contact_is_met():
    """A slow mass bounces off the wall before a fast one comes to it; neither loses."""
    body, master, _ = wall()
    places = ([0.3, 0.2, 0.6 * STEP * SPEED], [-0.3, -0.2, 3.4 * STEP * SPEED])
    masses = [
        PointMass(COMM, MASS, x, (0.0, 0.0, v), name=f"mass {k}")
        for k, (x, v) in enumerate(zip(places, (-0.5 * SPEED, -SPEED), strict=True))
    ]
    pairs = [
        nts.ContactPair(slave=PointSurface(m, x), master=master)
        for m, x in zip(masses, places, strict=True)
    ]
    system = nts.System([*masses, body], contacts=pairs)
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=STEP, t_end=8 * STEP, adapt=nts.Adapt(tolerance=1e-2)
    )
    table = run.balance
    assert table["contact_defect"][-1] < 1e-5 * table["energy"][0]


# ---- what must not change
def impact(comm=COMM, t_end=0.04, tolerance=1e-3, **scene):
    return nts.simulate(
        two_blocks.scene(comm, **scene), nts.EnergyMomentum(), dt=8e-3, t_end=t_end,
        adapt=nts.Adapt(tolerance=tolerance),
    )  # fmt: skip


@pytest.mark.mpi
@pytest.mark.slow
def test_rejected_steps_leave_no_trace():
    """Fixed steps to the accepted times give the same states, and the ledger stays closed."""
    run = impact()
    table = run.balance
    assert run.status == "completed" and run.rejected > 0 and table["active"].max() > 5
    assert len(np.unique(np.diff(table["time"]).round(12))) > 5
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * table["energy"][0]
    stepper = nts.Stepper(two_blocks.scene(COMM), nts.EnergyMomentum())
    for time in table["time"][1:]:
        stepper.advance(time - stepper.state.time)
    replayed = stepper.solution.balance
    for name in ("energy", "contact_defect", "kinetic"):
        assert np.abs(replayed[name] - table[name]).max() < 1e-11 * table["energy"][0], name
    stepper.close()


@pytest.mark.mpi
def test_a_step_that_is_not_solved_is_cut_off_the_instants_of_its_halves():
    stepper = Stepper(nts.System([SpringMass()]), nts.EnergyMomentum())
    pace = Pace(nts.Adapt(tolerance=10.0), stepper.system, stepper.state, 0.1, 1.0)
    fail_once(stepper, at_call=6)
    times = [stepper.state.time for _ in paced(stepper, pace, 1.0)]
    steps = np.diff(times)
    assert stepper.solution.retries == 1
    assert steps[4] == pytest.approx(0.4 * steps[3]) and steps.max() == pytest.approx(0.1)
    assert times[-1] == 1.0
    stepper.close()


# ---- bad input
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"tolerance": 0.0}, ValueError, r"^tolerance=0.0: must be positive, finite$"),
        ({"tolerance": np.nan}, ValueError, r"^tolerance=nan: must be positive, finite$"),
        ({"tolerance": "fine"}, TypeError, r"^tolerance='fine': pass a number"),
        ({"shortest": 2}, ValueError, r"^shortest=2: must be positive, finite and at most 1"),
        ({"shortest": True}, TypeError, r"^shortest=True: pass a number"),
        ({"shorter": 1}, TypeError, r"^shorter=1: unknown option of Adapt; .*tolerance, shortest"),
    ],
)
def test_bad_options(options, kind, message):
    with pytest.raises(kind, match=message):
        nts.Adapt(**options)


@pytest.mark.mpi
def test_adapt_is_an_adapt():
    with pytest.raises(TypeError, match=r"^adapt=0.001: pass Adapt\(tolerance="):
        nts.simulate(nts.System([SpringMass()]), nts.Midpoint(), dt=0.1, t_end=1.0, adapt=1e-3)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_node_that_is_moved_out_is_named(caplog):
    """By one rank; it leaves with 2 gap / h."""
    system, _ = mass_on_wall(-4e-3, velocity=(0.1 * SPEED, 0.0, 0.0))
    stepper = Stepper(system, nts.EnergyMomentum())
    stepper.advance(STEP)
    stepper.close()
    warning = stepper.solution.warnings["energy from behind facets"]
    assert warning.grave and warning.count == 1 and warning.first == STEP
    brought = 0.5 * MASS * (2 * 4e-3 / STEP) ** 2
    messages = [r.getMessage() for r in caplog.records]
    assert len(messages) == (COMM.rank == 0)
    for text in messages:
        assert f"bring an energy of {brought:.3g} " in text
        assert f"{brought:.3g} by node 0 on facet 3 of" in text
        assert "deep by 0.004" in text


@pytest.mark.mpi
def test_writers_see_the_motion_of_supports_from_the_start(mpi_tmp_path):
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [2, 2, 2], CellType.hexahedron)
    lift = nts.Dirichlet(lambda x: x[2] < 1e-9, value=lambda t: (0, 0, 0.5 * t))
    block = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3, bcs=[lift])
    path = mpi_tmp_path / "balance.csv"
    run = nts.simulate(
        nts.System([block]), nts.EnergyMomentum(), dt=1e-3, t_end=4e-3, adapt=nts.Adapt(),
        output=[BalanceCSV(path)],
    )  # fmt: skip
    COMM.Barrier()
    with path.open(encoding="utf-8") as file:
        first = next(csv.DictReader(file))
    assert list(first)[1].startswith("kinetic")
    assert float(list(first.values())[1]) == run.balance["kinetic"][0] > 0


@pytest.mark.mpi
@pytest.mark.slow
def test_a_longer_run_takes_no_longer_steps():
    """A cube that vibrates while it flies far is followed as closely however far it is to fly."""

    def stretched(x):
        return np.array([5.0 + 0.5 * (x[0] - 0.5), 0.0 * x[0], 0.0 * x[0]])

    times = []
    for t_end in (1.0, 3.0):
        mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)
        cube = nts.Continuum(mesh, nts.NeoHookean(1e5, 0.3), density=1e3, velocity=stretched)
        run = nts.simulate(
            nts.System([cube]), nts.EnergyMomentum(), dt=0.1, t_end=t_end,
            adapt=nts.Adapt(tolerance=1e-4), progress=False,
        )  # fmt: skip
        times.append(run.balance["time"])
    early, late = (t[t < 0.8] for t in times)
    assert len(early) > 20 and early == pytest.approx(late, rel=1e-9)
