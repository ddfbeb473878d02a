"""All integrators are of second order, in free flight and while contact persists."""

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from mpi4py import MPI

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
INTEGRATORS = {
    "midpoint": nts.Midpoint(),
    "energy-momentum": nts.EnergyMomentum(),
    "mean-value stress": nts.EnergyMomentum(stress="mean-value"),
    "gonzalez contact": nts.EnergyMomentum(contact_gradient="gonzalez"),
    "newmark": nts.Newmark(),
    "generalised alpha": nts.GeneralizedAlpha(rho_inf=0.8),
}
FREE = [name for name in INTEGRATORS if name != "gonzalez contact"]


def box(low, high, n=(1, 1, 1)):
    return create_box(
        COMM, [low, high], list(n), CellType.hexahedron, ghost_mode=GhostMode.shared_facet
    )


def run(make_system, integrator, t_end, steps):
    """Final displacements and velocities of all bodies, and the Stepper."""
    stepper = nts.Stepper(make_system(), INTEGRATORS[integrator])
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


def flying_block():
    """A soft block that spins and is stretched while it flies."""

    def velocity(x):
        centre = np.array([[1.0], [0.5], [0.5]])
        r = x - centre
        spin = np.cross(np.array([1.0, 2.0, 3.0]), r.T).T
        return spin + np.array([[1.5], [-0.8], [0.4]]) * r + np.array([[0.5], [0.2], [-0.1]])

    body = nts.Continuum(
        box([0, 0, 0], [2, 1, 1], (2, 1, 1)),
        nts.NeoHookean(1e6, 0.3),
        density=5e4,
        velocity=velocity,
        name="block",
    )
    return nts.System([body])


@pytest.mark.parametrize("integrator", FREE)
@pytest.mark.slow
def test_free_flight(integrator):
    results = [run(flying_block, integrator, 0.4, n)[:2] for n in (40, 80, 160)]
    for values in zip(*results, strict=True):
        order, errors = rates(values)
        assert np.abs(order - 2.0).max() < 0.1, (order, errors)


def sliding_block(friction=0.0):
    """A block pressed harder and harder onto a soft one that it slides over, within one facet.

    The load starts from zero as t^2 does, so the four slave nodes carry from the first step on
    and no node is ever activated or released.
    """
    rubber = nts.NeoHookean(20.0, 0.3)
    upper = nts.Continuum(
        box([0.2, 0.25, 1.0], [0.7, 0.75, 1.5]),
        rubber,
        density=1.0,
        velocity=(0.3, -0.2, 0.0),
        body_force=lambda t: (0.0, 0.0, -20.0 * t**2 * (3.0 - 2.0 * t)),
        name="upper",
    )
    lower = nts.Continuum(
        box([0, 0, 0], [1, 1, 1]),
        rubber,
        density=1.0,
        bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)],
        name="lower",
    )
    pair = nts.ContactPair(
        slave=upper.surface(lambda x: x[2] < 1 + 1e-9),
        master=lower.surface(lambda x: x[2] > 1 - 1e-9),
        friction=friction,
    )
    return nts.System([upper, lower], contacts=[pair])


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
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
@pytest.mark.parametrize("integrator", ["midpoint", "energy-momentum", "generalised alpha"])
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
