"""An integrator of the user's own, the implicit Euler rule, in a run with contact and output."""

import csv
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from point_mass import PointMass
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.output.tables import BalanceCSV

COMM = MPI.COMM_WORLD


@dataclass(frozen=True)
class Euler:
    """v_1 = (u_1 - u_0)/h, and forces and contact at t_{n+1}: damps, and is of first order."""

    inertia = True
    accelerations = False
    closes_ledger = False
    keeps_angular_momentum = False
    keeps_energy = False
    ledger_remedy = ""
    order = 1
    theta = taken_at = 1.0
    contact_gradient = "direct"

    def factor(self, dt):
        return dt**2

    def ramp(self, time):
        return 1.0

    def ahead(self, v0, a0, dt):
        return dt * v0

    def rate(self, dt):
        return 1.0 / dt

    def advance(self, du, v0, a0, dt):
        return du / dt, None

    def piola(self, energy, h0, h1):
        return (ufl.Identity(3) + h1) * energy.stress(0.5 * (h1 + h1.T + h1.T * h1))

    def virtual_work(self, potential, u0, u1, w):
        return potential.virtual_work(u1, w)


def test_it_has_the_protocol():
    assert isinstance(Euler(), nts.Integrator)


@dataclass(frozen=True)
class Mixed(nts.Midpoint):
    """Springs by discrete gradients, contact as of the midpoint rule."""

    taken_at = None


@pytest.mark.mpi
@pytest.mark.parametrize("rule", [nts.Midpoint(), Mixed()])
@pytest.mark.fast_on_ranks("rule0")
def test_the_rule_of_forces_in_arrays_is_not_that_of_contact(rule):
    """A spring of V = (l - 1)^4 N/m^3 between two masses; contact stands beside it."""
    bodies = [
        nts.RigidBody.from_inertia(
            1.0, (0.1, 0.2, 0.25), centre=(x, 0, 1), velocity=(0, x, 0), name=name, comm=COMM
        )
        for x, name in ((0.0, "a"), (1.5, "b"))
    ]
    spring = nts.Spring(*bodies, [(0, 0, 1), (1.5, 0, 1)], energy=lambda x: (x - 1.0) ** 4)
    run = nts.simulate(
        nts.System(bodies, joints=[spring]), rule, dt=0.1, t_end=2.0, accuracy="exact"
    )
    off = np.abs(run.balance["ledger_residual"]).max() / run.balance["energy"][0]
    assert rule.contact_gradient == "direct"
    assert off < 1e-12 if rule.taken_at is None else off > 1e-5


def test_impacts_give_nothing_back_where_steps_keep_no_energy():
    """It restored 1e-13 J while 39.7 of 125 J were gone."""
    ball = PointMass(COMM, 2.5, (0.0, 0.0, 1.0), (0.0, 0.0, -10.0))
    with pytest.raises(ValueError, match=r"Euler\(\) keeps no energy in contact that"):
        nts.Stepper(nts.System([ball]), Euler(), impact="restored")


class Oscillator(PointMass):
    """A mass of 1 kg on a spring of 1 N/m, at 1 m."""

    def __init__(self):
        super().__init__(COMM, 1.0, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    def internal(self, u1):
        return u1 + self.reference

    def tangent(self, u1, mass, stiffness):
        matrix = super().tangent(u1, mass, stiffness)
        matrix.shift(stiffness)
        return matrix

    def potential(self, u):
        x = u + self.reference
        return 0.5 * float(x @ x)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_it_is_of_first_order():
    """After n steps x is the real part of (1 - i h)^-n, which tends to cos t as h does to 0."""
    ends = []
    for number in (20, 40, 80):
        body = Oscillator()
        run = nts.simulate(nts.System([body]), Euler(), dt=1.0 / number, t_end=1.0)
        x = COMM.bcast(1.0 + float(run.state.u[0][0]) if COMM.rank == 0 else 0.0)
        assert x == pytest.approx(((1.0 - 1j / number) ** -number).real, rel=1e-10)
        ends.append(abs(x - np.cos(1.0)))
    assert np.log2(np.divide(ends[:-1], ends[1:])) == pytest.approx(1.0, abs=0.1)


@pytest.mark.mpi
def test_it_meets_a_floor_with_friction_and_is_written(mpi_tmp_path):
    """Contact keeps nodes out, friction opposes the slip, and the energy does not grow."""
    mesh = box()
    body = nts.Continuum(
        mesh, nts.NeoHookean(1e6, 0.3), density=1e3, velocity=(1.0, 0.0, -1.0), name="block"
    )
    pair = nts.ContactPair(
        body.surface(lambda x: x[2] < 1e-9), nts.Plane((0, 0, -0.01), (0, 0, 1)), friction=0.2
    )
    table = BalanceCSV(mpi_tmp_path / "balance.csv")
    run = nts.simulate(
        nts.System([body], contacts=[pair]), Euler(), dt=2e-3, t_end=0.04, output=[table]
    )
    b = run.balance
    assert b["active"].max() > 0 and b["min_gap"][b["active"] > 0].min() > -1e-12
    assert b["friction_dissipation"][-1] > 0.0 and (np.diff(b["energy"]) < 1e-9).all()
    # Impulses of the floor, of which the run has each step's mean force.
    dt = np.diff(b["time"])
    forces = run.contact_forces.reshape(len(b["time"]), 3)
    pushes = (forces[1:] * dt[:, None]).sum(axis=0)
    change = b["linear_momentum"][-1] - b["linear_momentum"][0]
    assert pushes == pytest.approx(change, rel=1e-9)
    if COMM.rank == 0:
        with (mpi_tmp_path / "balance.csv").open() as file:
            rows = [r for r in csv.reader(file) if r and not r[0].startswith("#")]
        assert len(rows) == len(b["time"]) + 1
