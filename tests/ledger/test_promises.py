"""What accuracy promises of the energy is held against each step; what breaks it is named."""

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, create_box
from integrators import MID_STEP
from measures import PROMISED
from point_mass import PointMass
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.output import BalanceCSV
from dolfinx_nts.parallel import together
from dolfinx_nts.run.ledger_check import LedgerCheck

COMM = MPI.COMM_WORLD


def limited(c):
    """A material that is defined up to tr C = 3.05 only, as fibres that cannot be longer are."""
    stretch, j = ufl.tr(c) - 3.0, ufl.det(c)
    return -1e4 * ufl.ln(1.0 - stretch / 0.05) - 2e5 * ufl.ln(j) + 5e4 * ufl.ln(j) ** 2


@pytest.mark.mpi
@pytest.mark.slow
def test_a_material_that_is_not_defined_is_named():
    mesh = box()
    body = nts.Continuum(mesh, limited, density=1e3, velocity=(0.0, 0.0, -20.0), name="fibres")
    pair = nts.ContactPair(
        slave=body.surface(lambda x: x[2] < 1e-9), master=nts.Plane((0, 0, 0), (0, 0, 1))
    )
    system = nts.System([body], contacts=[pair])
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=2e-3, t_end=0.05, newton=nts.Newton(max_retries=1)
    )
    assert "the internal forces of 'fibres' are not finite: the energy of its" in run.status
    # Neither the largest of all numbers nor NaN stands for a size.
    assert not any(word in run.status for word in ("e308", "e+308", "nan", "inf times"))


def test_energy_that_contact_brings_in_small_parts_is_told():
    """No step of ten wins 1 % of the energy, all of them together 5 %."""
    told = []
    solution = SimpleNamespace(
        warn=lambda kind, *rest, **_: told.append((kind, *rest)),
        system=SimpleNamespace(contacts=["a contact"]),
    )
    stepper = nts.Stepper(nts.System([Sprung(1.0)]), nts.EnergyMomentum())
    stepper.problem.begin(stepper.state, 0.05)
    step = stepper.solver.solve()
    promises = LedgerCheck(solution, nts.EnergyMomentum(), 1e-12)
    (motions,) = together(COMM, [promises.motions(stepper.problem, step)])
    for k in range(1, 11):
        row = dict(stepper.solution.rows[-1], energy=1.0, kinetic=1.0)
        solution.rows = [
            row | {"time": float(i), "contact_defect": -0.005 * i} for i in (k - 1, k)
        ]
        promises.hold(stepper.problem, step, *solution.rows, 0.0, motions)
    stepper.close()
    assert [(kind, time) for kind, time, *_ in told] == [
        ("energy from behind facets", float(k)) for k in range(3, 11)
    ]
    assert "0.05 of the largest energy" in told[-1][-1]


class Sprung(PointMass):
    """A mass on a spring to the origin whose stored energy is told `claim` times too large."""

    def __init__(self, claim):
        super().__init__(COMM, 1.0, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self.claim = claim
        self._first = None

    def internal(self, u1):
        return 0.5 * (self.moment.u0 + u1) + self.reference

    def tangent(self, u1, mass, stiffness):
        matrix = super().tangent(u1, mass, stiffness)
        matrix.shift(0.5 * stiffness)
        return matrix

    def potential(self, u):
        x = self.reference + u
        return 0.5 * self.claim * float(x @ x)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integrator", "words"),
    [(nts.EnergyMomentum(), "this accuracy promises 1e-11"), (nts.Midpoint(), "does not keep it")],
    ids=["energy-momentum", "midpoint"],
)
def test_a_ledger_that_stays_open_is_told(integrator, words):
    """Of 0.75 J that are claimed at the start 0.5 J turn into kinetic energy."""
    run = nts.simulate(nts.System([Sprung(1.5)]), integrator, dt=0.05, t_end=1.5)
    warning = run.warnings["ledger"]
    assert warning.grave and words in warning.text
    assert np.isclose(warning.worst, np.abs(run.balance["ledger_residual"]).max(), rtol=1e-12)
    assert run.status == f"completed, but {warning.text}"
    assert "warning, ledger" in run.summary and run.summary.count(warning.text) == 1


@pytest.mark.slow
@pytest.mark.mpi
@pytest.mark.parametrize("accuracy", PROMISED)
@pytest.mark.parametrize("part", [0.5, 2.0])
def test_a_broken_promise_is_told(part, accuracy, mpi_tmp_path):
    """Half of what may be missing says nothing, twice as much stands wherever warnings do."""
    path, promised = mpi_tmp_path / "balance.csv", PROMISED[accuracy]
    run = nts.simulate(
        nts.System([Sprung(1.0 + part * promised)]), nts.EnergyMomentum(), dt=0.05, t_end=1.5,
        accuracy=accuracy, output=[BalanceCSV(path)],
    )  # fmt: skip
    # Of the energy at the start all but cos^2(1.5), 0.5 %, turns into kinetic energy.
    missing = np.abs(run.balance["ledger_residual"]).max() / run.balance["energy"][0]
    assert missing == pytest.approx(0.995 * part * promised, rel=1e-2)
    COMM.Barrier()
    text, summary = path.read_text(), run.summary
    assert run.status == "completed"
    if part < 1.0:
        assert not run.warnings and "warning" not in summary + text
        return
    warning = run.warnings["ledger"]
    assert not warning.grave and f"this accuracy promises {promised:.0e};" in warning.text
    assert warning.count == np.sum(run.balance["ledger_residual"] < -0.5 * promised)
    assert warning.first in run.balance["time"]
    for place in (summary, text):
        assert f"warning, ledger: {warning.count} step" in place and warning.text in place


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.parametrize("accuracy", ["exact", "balanced"])
@pytest.mark.fast_on_ranks("exact-energy-momentum")
def test_a_closed_ledger_says_nothing(integrator, accuracy):
    run = nts.simulate(
        nts.System([Sprung(1.0)]), integrator, dt=0.05, t_end=1.5, accuracy=accuracy
    )
    assert run.status == "completed" and not run.warnings


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", [nts.EnergyMomentum(), nts.Newmark(), nts.Midpoint()])
@pytest.mark.parametrize("energy", [np.nan, np.inf])
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.fast_on_ranks("nan-integrator0")
def test_an_energy_that_is_no_number_is_grave(integrator, energy):
    run = nts.simulate(nts.System([Sprung(energy)]), integrator, dt=0.05, t_end=0.2)
    assert run.status != "completed" and run.warnings["ledger"].grave
    assert "the energy is not finite" in run.warnings["ledger"].text
    assert type(run.warnings["ledger"].worst) is float


def vibrating(stiffness):
    """A stretched cube that is let go, of a stiffness that may change."""
    mesh = box()
    young = fem.Constant(mesh, 1e4 * stiffness)
    base = nts.StVenantKirchhoff(1.0, 0.0)
    body = nts.Continuum(
        mesh, lambda c: young * base(c), density=1e3, velocity=lambda x: 0.3 * x * [[1], [-1], [0]]
    )
    return body, young


@pytest.mark.mpi
@pytest.mark.parametrize("sleep", [False, True])
def test_a_stiffness_that_changes_in_time_is_named_in_the_ledger(sleep):
    body, young = vibrating(1.0)
    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum(), sleep=sleep)
    for _ in range(5):
        stepper.advance(0.02)
    stored = stepper.solution.rows[-1]["potential"]
    young.value = 1.75e4
    for _ in range(5):
        stepper.advance(0.02)
    stepper.close()
    table = stepper.solution.balance
    assert np.array_equal(table["material_change"][:6], np.zeros(6))
    assert np.allclose(table["material_change"][6:], 0.75 * stored, rtol=1e-12)
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * table["energy"].max()
    warning = stepper.solution.warnings["material changed"]
    assert warning.count == 1 and not warning.grave and "'body'" in warning.text
    assert "ledger" not in stepper.solution.warnings


class Changes:
    """A writer after whose first call a material's stiffness is another."""

    def __init__(self, factor, value):
        self.factor, self.value = factor, value

    def start(self, stepper):
        pass

    def write(self, stepper, last=False):
        self.factor.value = self.value

    def close(self, stepper):
        pass


@pytest.mark.mpi
def test_a_stiffness_that_changes_between_load_steps_is_named():
    """What stands under its weight stores 1.75 times as much until it moves."""
    mesh = box()
    young, base = fem.Constant(mesh, 1e6), nts.StVenantKirchhoff(1.0, 0.0)
    held = nts.Dirichlet(lambda x: x[2] < 1e-9)
    body = nts.Continuum(mesh, lambda c: young * base(c), density=1e3, bcs=[held])
    system = nts.System([body], gravity=(0, 0, -9.81))
    run = nts.equilibrium(system, load_steps=2, output=[Changes(young, 1.75e6)])
    table = run.balance
    assert run.status == "completed"
    assert table["material_change"] == pytest.approx(
        [0, 0, 0.75 * table["potential"][1]], rel=1e-12
    )
    warning = run.warnings["material changed"]
    assert warning.count == 1 and warning.first == 0.5 and not warning.grave


class Driven(PointMass):
    """A mass that moves along x as prescribed."""

    def __init__(self, mass, speed):
        super().__init__(COMM, mass, (0.0, 0.0, 0.0), (speed, 0.0, 0.0), name="driven")
        self.fixed = np.arange(self.num_owned)

    def prescribed(self, time):
        return time * self.initial_velocity


@pytest.mark.mpi
@pytest.mark.parametrize("contacts", [["a contact"], []])
def test_a_gain_in_one_step_is_measured_without_driven_bodies(contacts, monkeypatch):
    """0.1 J of 1 J, beside a mass of 2e6 kg at 1 m/s, of contacts or of limits of joints."""
    monkeypatch.setattr("dolfinx_nts.ledger.balance.expelled", lambda *_: "by one node")
    told = []
    solution = SimpleNamespace(
        warn=lambda kind, *rest, **_: told.append((kind, *rest)),
        system=SimpleNamespace(contacts=contacts),
    )
    stepper = nts.Stepper(nts.System([Sprung(1.0), Driven(2e6, 1.0)]), nts.EnergyMomentum())
    stepper.problem.begin(stepper.state, 0.05)
    step = stepper.solver.solve()
    row = dict(stepper.solution.rows[-1], energy=1e6 + 1.0, kinetic=1e6 + 1.0)
    solution.rows = [row, row | {"time": 0.05, "contact_defect": -0.1}]
    promises = LedgerCheck(solution, nts.EnergyMomentum(), 1e-12)
    (motions,) = together(COMM, [promises.motions(stepper.problem, step)])
    promises.hold(stepper.problem, step, *solution.rows, 0.0, motions)
    stepper.close()
    ((kind, _, size, text),) = told
    kinds = {True: "energy from behind facets", False: "energy from limits of joints"}
    assert kind == kinds[bool(contacts)] and size == 0.1
    assert text.startswith("nodes that start behind" if contacts else "joints at their limits")
    assert " an energy of 0.1 " in text


def impact_on_a_heavy_plate(along):
    """A cube of 2 kJ hits a plate of 144 t; both drive along the plate at a speed [m/s]."""
    plate = nts.RigidBody(
        create_box(COMM, [np.array([-1.0, -3, -1]), np.array([2.0, 3, 0])], [3, 3, 3],
                   CellType.hexahedron),
        density=8e3, motion=lambda t: (0, along * t, 0), rotation=(0, 0, 0), name="plate",
    )  # fmt: skip
    mesh = create_box(
        COMM, [np.array([0, 0, 0.01]), np.array([1, 1, 1.01])], [2, 2, 2], CellType.hexahedron
    )
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    cube = nts.Continuum(mesh, rubber, density=1e3, velocity=(0, along, -2), name="cube")
    pair = nts.ContactPair(
        cube.surface(lambda x: x[2] < 0.01 + 1e-9), plate.surface(lambda x: x[2] > -1e-9)
    )
    return nts.System([plate, cube], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.slow
def test_a_heavy_body_that_drives_past_hides_nothing():
    """The same impact seen at 5 m/s, where the plate has 1.8 MJ and moves as prescribed."""
    for integrator, told in ((nts.Newmark(), True), (nts.EnergyMomentum(), False)):
        missing = []
        for along in (0.0, 5.0):
            system = impact_on_a_heavy_plate(along)
            run = nts.simulate(system, integrator, dt=1e-3, t_end=0.1, progress=False)
            assert ("ledger" in run.warnings) == told
            assert run.status.startswith("completed, but") == told
            missing.append(run.balance["ledger_residual"][-1])
        if told:
            assert missing[0] == pytest.approx(missing[1], rel=1e-6)
            assert run.warnings["ledger"].worst > 1e3
