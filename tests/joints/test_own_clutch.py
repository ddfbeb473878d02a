"""A law of one's own that holds and lets go: a slipping clutch between two points."""

from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import pytest
from integrators import ACCELERATED, MID_STEP
from scenes import UNITS

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
MASS, SPEED, LOAD, COEFFICIENT = 2.0, 3.0, 10.0, 0.4


class Slips(NamedTuple):
    """The length rests while its force is within +-bound; else that is the force, against it."""

    bound: float

    @property
    def settings(self):
        return self._asdict()

    def row(self, start, end, force, unit):
        """Rest l_1 = l_0, or D = bound sign(l_1 - l_0), by the trial D + l_1 - l_0."""
        way, most = end - start, self.bound / unit
        trial = force + way
        rests = np.abs(trial) <= most
        value = np.where(rests, way, force - most * np.sign(trial))
        return nts.Row(value, rests.astype(float), (~rests).astype(float), rests)


class Clutch(nts.BetweenPoints):
    """A force along the line of two points, up to coefficient times load [N]."""

    losses = ("clutch_dissipation",)
    entry = ("clutch_dissipation", 1.0)

    def __init__(self, a, b, points, *, load, coefficient, name=None):
        super().__init__(a, b, points, name=name)
        self.law = Slips(coefficient * load)


def scene(speed=SPEED, pull=0.0, metre=1.0, load=LOAD):
    """A mass that moves away from a point of the ground, which a clutch holds it to."""
    mass = nts.RigidBody.from_inertia(
        MASS, np.array([1.0, 2.0, 2.5]) * metre**2, velocity=(speed * metre, 0, 0),
        force=(pull * metre, 0, 0), name="mass", comm=COMM,
    )  # fmt: skip
    ends = [(0, 0, 0), (-metre, 0, 0)]
    clutch = Clutch(mass, None, ends, load=load * metre, coefficient=COEFFICIENT)
    return mass, nts.System([mass], joints=[clutch])


@pytest.mark.mpi
@pytest.mark.parametrize("metre", UNITS)
@pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast_on_ranks()
def test_it_stops_a_mass_after_its_way(rule, metre):
    """F s = m v^2/2, which leaves as F times the way of slip; then it rests."""
    force, energy = COEFFICIENT * LOAD, 0.5 * MASS * SPEED**2
    mass, system = scene(metre=metre)
    run = nts.simulate(system, rule, dt=0.01, t_end=2.0)
    way, lost = mass.position[0] / metre, run.balance["clutch_dissipation"] / metre**2
    assert run.status == "completed"
    assert way == pytest.approx(energy / force, rel=1e-4)
    assert lost[-1] == pytest.approx(force * way, rel=1e-12)
    assert lost[-1] == pytest.approx(energy, rel=1e-12)
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-12 * energy * metre**2
    assert (np.diff(lost) >= 0.0).all() and np.abs(mass.velocity).max() < 1e-12 * SPEED * metre


@pytest.mark.mpi
@pytest.mark.parametrize(("part", "moves"), [(0.9, 0.0), (1.5, 0.5)])
def test_it_holds_up_to_its_bound(part, moves):
    """A force below it moves nothing, one above it accelerates by what is left of it."""
    force = COEFFICIENT * LOAD
    mass, system = scene(speed=0.0, pull=part * force)
    nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=1.0)
    assert mass.velocity[0] == pytest.approx(moves * force / MASS, rel=1e-10, abs=1e-12)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_run_goes_on_while_it_slips(mpi_tmp_path):
    """From a checkpoint; not with another load."""
    whole, system = scene()
    nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=1.0)
    _, system = scene()
    path = mpi_tmp_path / "run.h5"
    first = nts.Checkpoint(path, every=25)
    nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.25, checkpoint=first)
    mass, system = scene()
    start = nts.restart(path, system)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=1.0, start=start)
    assert np.allclose(mass.position, whole.position, rtol=1e-12, atol=1e-14)
    assert run.balance["clutch_dissipation"][-1] == pytest.approx(4.0 * whole.position[0])
    with pytest.raises(ValueError, match="bound"):
        nts.restart(path, scene(load=1.0)[1])


@pytest.mark.parametrize("rule", ACCELERATED.values(), ids=ACCELERATED)
def test_it_asks_for_an_integrator_without_accelerations(rule):
    with pytest.raises(ValueError, match="may hold and let go"):
        nts.simulate(scene()[1], rule, dt=0.01, t_end=0.1)
