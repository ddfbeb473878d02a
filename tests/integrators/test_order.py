"""All integrators are of second order, in free flight and while contact persists."""

from mpi4py import MPI

import numpy as np
import pytest
from integrators import GRADIENTS, INTEGRATORS
from scenes import flying_block, sliding_block

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
RULES = INTEGRATORS | GRADIENTS
FREE = [name for name in RULES if name != "gonzalez contact"]


def run(make_system, integrator, t_end, steps):
    """Final displacements and velocities of all bodies, and the Stepper."""
    stepper = nts.Stepper(make_system(), RULES[integrator])
    for k in range(1, steps + 1):
        stepper.advance(k * t_end / steps - stepper.state.time)
    stepper.close()
    assert stepper.solution.retries == 0
    return np.concatenate(stepper.state.u), np.concatenate(stepper.state.v), stepper


def rates(results):
    """Observed orders from the differences between runs with h, h/2, h/4, .., and the differences.

    |x_h - x_h/2| is the error of x_h but for a factor that tends to 3/4; no run serves as a
    reference, whose own error would bend the last rate.
    """
    change = [np.abs(a - b).max() for a, b in zip(results[:-1], results[1:], strict=True)]
    errors = np.array(change) / np.abs(results[-1]).max()
    return np.log2(errors[:-1] / errors[1:]), errors


@pytest.mark.parametrize("integrator", FREE)
@pytest.mark.slow
def test_free_flight(integrator):
    results = [run(flying_block, integrator, 0.4, n)[:2] for n in (20, 40, 80)]
    for values in zip(*results, strict=True):
        order, errors = rates(values)
        assert np.abs(order - 2.0).max() < 0.1, (order, errors)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", RULES)
def test_persistent_contact(integrator):
    results = []
    for n in (40, 80, 160):
        u, v, stepper = run(sliding_block, integrator, 0.5, n)
        assert (stepper.solution.balance["active"][1:] == 4).all()
        results.append((u, v))
    for values in zip(*results, strict=True):
        order, errors = rates(values)
        assert np.abs(order - 2.0).max() < 0.1, (order, errors)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["midpoint", "energy-momentum", "generalized-alpha"])
def test_sliding_with_friction(integrator):
    results = []
    for n in (40, 80, 160):
        u, v, stepper = run(lambda: sliding_block(0.1), integrator, 0.5, n)
        table = stepper.solution.balance
        assert (table["slip"][1:] == 4).all()
        assert np.diff(table["friction_dissipation"]).min() > 0
        results.append((u, v))
    # A third of the energy is gone.
    assert table["friction_dissipation"][-1] > 0.3 * table["energy"][0]
    for values in zip(*results, strict=True):
        order, errors = rates(values)
        assert np.abs(order - 2.0).max() < 0.1, (order, errors)
