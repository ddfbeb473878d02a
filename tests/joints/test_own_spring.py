"""A law of one's own that stores energy: a spring between two points that stiffens."""

from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import pytest
from integrators import INTEGRATORS
from scenes import UNITS
from scipy.special import ellipk

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD


class Stiffens(NamedTuple):
    """V = k/2 e^2 + q/4 e^4 of e = l - L; its force is the discrete gradient DV/De."""

    k: float
    q: float
    length: float

    @property
    def settings(self):
        return self._asdict()

    def stored(self, at):
        e = at - self.length
        return float((0.5 * self.k * e**2 + 0.25 * self.q * e**4).sum())

    def pull(self, move):
        """DV/De in closed form, symmetric in both ends, and its derivative."""
        a, b = (end - self.length for end in move.ends)
        force = 0.5 * self.k * (a + b) + 0.25 * self.q * (a + b) * (a**2 + b**2)
        by_b = 0.5 * self.k + 0.25 * self.q * (a**2 + b**2 + 2.0 * b * (a + b))
        return force, (move.share * by_b)[:, None] * move.gradient.end

    def slopes(self, at, asked):
        return float((self.k + 3.0 * self.q * (at - self.length) ** 2).sum()), 0.0


class StiffSpring(nts.BetweenPoints):
    """A spring between two points, free at their distance in the reference."""

    def __init__(self, a, b, points, *, k, q, name=None):
        super().__init__(a, b, points, name=name)
        self.law = Stiffens(k, q, self.distance)


def twin(a, b, points, *, k, q):
    """The same by the package's spring, which differentiates numerically."""
    return nts.Spring(
        a, b, points, energy=lambda at: 0.5 * k * (at - 1.0) ** 2 + 0.25 * q * (at - 1.0) ** 4
    )


def tumbling(kind, metre=1.0):
    """Two free bodies that turn, held at points beside their centres."""
    a, b = (
        nts.RigidBody.from_inertia(
            mass, np.array([0.1, 0.2, 0.25]) * metre**2, centre=(x * metre, 0, 0),
            velocity=(0, speed * metre, 0.2 * speed * metre), angular_velocity=(1, 2, speed),
            name=name, comm=COMM,
        )  # fmt: skip
        for mass, x, speed, name in ((2.0, 0.0, 0.6, "a"), (3.0, 1.0, -0.9, "b"))
    )
    ends = metre * np.array([(0.0, 0.2, 0.0), (1.0, 0.2, 0.0)])
    return nts.System([a, b], joints=[kind(a, b, ends, k=40.0, q=300.0 / metre**2)])


@pytest.mark.mpi
@pytest.mark.parametrize("metre", UNITS)
@pytest.mark.fast_on_ranks()
def test_energy_and_momenta_are_kept(metre):
    system = tumbling(StiffSpring, metre)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.02, t_end=2.0, accuracy="exact")
    energy = run.balance["energy"]
    assert run.status == "completed" and np.ptp(run.balance["potential"]) > 0.1 * energy[0]
    assert np.abs(energy - energy[0]).max() < 1e-13 * energy[0]
    # v_1 = 2 (u_1 - u_0)/h - v_0 passes on half a unit in the last place of 5 kg within a metre.
    rounded = 0.5 * np.finfo(float).eps * 2.0 * 5.0 * metre / 0.02 * np.sqrt(len(energy))
    for name, arm in (("linear_momentum", 1.0), ("angular_momentum", metre)):
        moment = run.balance[name]
        assert np.abs(moment - moment[0]).max() < rounded * arm


@pytest.mark.mpi
@pytest.mark.parametrize("rule", INTEGRATORS)
def test_it_is_its_built_in_twin_with_every_integrator(rule):
    def energies(kind):
        run = nts.simulate(
            tumbling(kind), INTEGRATORS[rule], dt=0.02, t_end=0.4, accuracy="exact"
        )
        return np.array([run.balance["kinetic"], run.balance["potential"]])

    assert energies(StiffSpring) == pytest.approx(energies(twin), rel=0, abs=1e-9)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_mass_comes_back_after_duffings_period():
    """T = 4 K(m)/w, w^2 = (k + q A^2)/M, m = q A^2/(2 M w^2): the error is of second order."""
    k, q, amplitude, mass = 40.0, 300.0, 0.4, 2.0
    omega = np.sqrt((k + q * amplitude**2) / mass)
    period = 4.0 * ellipk(0.5 * q * amplitude**2 / (mass * omega**2)) / omega
    speed = amplitude * np.sqrt((k + 0.5 * q * amplitude**2) / mass)
    off = []
    for steps in (100, 200):
        body = nts.RigidBody.from_inertia(
            mass, (1, 2, 2.5), velocity=(speed, 0, 0), name="mass", comm=COMM
        )
        spring = StiffSpring(body, None, [(0, 0, 0), (-1, 0, 0)], k=k, q=q)
        system = nts.System([body], joints=[spring])
        nts.simulate(system, nts.EnergyMomentum(), dt=period / steps, t_end=period)
        off.append(abs(body.position[0]))
    assert off[0] < 2e-2 * amplitude and off[0] / off[1] == pytest.approx(4.0, rel=0.05)
