"""A run that goes on from another one, and the forces of supports and contacts in dynamics."""

from mpi4py import MPI

import numpy as np
import pytest
from integrators import INTEGRATORS, MID_STEP
from scenes import box, rubbing_blocks

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
DT = 2e-3


@pytest.mark.parametrize("integrator", INTEGRATORS.values(), ids=INTEGRATORS)
@pytest.mark.slow
def test_two_parts_are_the_whole(integrator, first_steps=13, steps=23):
    """With friction, in contact where the first one ends; on several ranks MUMPS rounds anew."""
    newton = nts.Newton(linear_solver="direct", condense=True)
    whole, system = rubbing_blocks(0.3), rubbing_blocks(0.3)
    one = nts.simulate(whole, integrator, dt=DT, t_end=steps * DT, newton=newton)
    first = nts.simulate(system, integrator, dt=DT, t_end=first_steps * DT, newton=newton)
    assert first.balance["active"][-1] > 0
    other = nts.simulate(system, integrator, dt=DT, t_end=steps * DT, newton=newton, start=first)
    assert other.status == one.status == "completed" or not integrator.closes_ledger
    assert other.balance["time"][0] == first.balance["time"][-1]
    for name in ("u", "v"):
        for a, b in zip(getattr(one.state, name), getattr(other.state, name), strict=True):
            scale = COMM.allreduce(np.abs(a).max(initial=0.0), op=MPI.MAX)
            limit = 0.0 if COMM.size == 1 else 1e-11 * scale
            assert np.abs(a - b).max(initial=0.0) <= limit
    slip = [r.state.contacts[0].slip for r in (one, other)]
    assert np.allclose(*slip, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast_on_ranks("energy-momentum")
@pytest.mark.fast("midpoint")
def test_forces_of_supports_and_contacts(integrator):
    """Impulses of supports, floor and gravity add up to the change of momentum."""
    mesh = box()
    rail = nts.Dirichlet(lambda x: x[0] < 1e-9, components=(0,))
    body = nts.Continuum(
        mesh, nts.NeoHookean(1e6, 0.3), density=1e3, velocity=(0, 1, -1), bcs=[rail]
    )
    pair = nts.ContactPair(
        body.surface(lambda x: x[2] < 1e-9), nts.Plane((0, 0, -1e-3), (0, 0, 1)), friction=0.4
    )
    system = nts.System([body], contacts=[pair], gravity=(1.0, 0, -9.81))
    run = nts.simulate(system, integrator, dt=DT, t_end=30 * DT)
    forces = run.contact_forces[1:, 0] + run.reactions["body"][1:, 0] + 1e3 * system.gravity
    momentum = run.balance["linear_momentum"]
    assert run.balance["active"].max() == 9
    assert np.abs(np.diff(momentum, axis=0) - DT * forces).max() < 1e-9 * 1e3
    assert np.abs(run.reactions["body"][1:, 0, 0]).max() > 1.0
    assert (run.reactions["body"][0] == 0).all() and run.contact_forces.shape == (31, 1, 3)


def held(hold):
    """A cube that flies, and one whose face is held from then on."""
    bcs = [nts.Dirichlet(lambda x: x[0] < 1e-9, value=hold)] if hold is not None else []
    return nts.Continuum(
        MESH, nts.NeoHookean(1e6, 0.3), density=1e3, velocity=(0, 1, 0), bcs=bcs, name="cube"
    )


MESH = box()


@pytest.mark.parametrize("integrator", [nts.EnergyMomentum(), nts.GeneralizedAlpha()])
def test_a_face_that_is_held_from_now_on_stands_still(integrator):
    first = nts.simulate(nts.System([held(None)]), nts.EnergyMomentum(), dt=DT, t_end=10 * DT)
    way = np.array([0.0, 10 * DT, 0.0])
    body = held(tuple(way))
    run = nts.simulate(nts.System([body]), integrator, dt=DT, t_end=20 * DT, start=first)
    v = run.state.v[0]
    assert np.abs(v[body.fixed]).max(initial=0.0) < 1e-9
    assert run.balance["energy"][0] < first.balance["energy"][-1]
