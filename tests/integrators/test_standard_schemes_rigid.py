"""Newmark and generalised alpha with rigid bodies in contact."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
G, FLOOR = 9.81, nts.Plane((0, 0, 0), (0, 0, 1))
RULES = {
    "newmark": nts.Newmark(),
    "generalized-alpha": nts.GeneralizedAlpha(rho_inf=0.8),
}
by_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES)


def box(low, size=(1, 1, 1), **options):
    low = np.array(low, dtype=float)
    mesh = create_box(
        COMM, [low, low + np.array(size)], [1, 1, 1], CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    return nts.RigidBody(mesh, density=1e3, **options)


def on_the_floor(body, friction):
    return nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), FLOOR, friction=friction)


@pytest.mark.mpi
@by_rule
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.fast("0.3-newmark", "0.0-generalized-alpha")
@pytest.mark.fast_on_ranks("0.3-newmark")
def test_a_box_at_rest_stays(rule, friction):
    body = box((0, 0, 0))
    system = nts.System([body], contacts=[on_the_floor(body, friction)], gravity=(0, 0, -G))
    run = nts.simulate(system, rule, dt=1e-2, t_end=0.2)
    weight = body.mass * G
    assert run.status == "completed" and run.retries == 0
    assert np.abs(run.contact_forces[1:, 0] - [0, 0, weight]).max() < 1e-9 * weight
    assert np.abs(body.position - body.centre).max() < 1e-12


@pytest.mark.mpi
@by_rule
@pytest.mark.slow
def test_a_sliding_box_brakes_as_coulomb_says(rule):
    """v = v_0 - mu g t until it rests, at v_0^2 / (2 mu g)."""
    speed, friction, body = 1.0, 0.3, box((0, 0, 0), (1, 1, 0.2), velocity=(1.0, 0, 0))
    system = nts.System([body], contacts=[on_the_floor(body, friction)], gravity=(0, 0, -G))
    times, far = [], body.centre.copy()
    stepper = nts.Stepper(system, rule)
    stepper.start(2e-3)
    for _ in range(100):
        stepper.advance(2e-3)
        times.append([stepper.state.time, *body.velocity])
    times = np.array(times)
    assert np.abs(times[:, 1] - speed + friction * G * times[:, 0]).max() < 1e-9 * speed
    for _ in range(100):
        stepper.advance(2e-3)
    stepper.close()
    way = body.position[0] - far[0]
    assert way == pytest.approx(speed**2 / (2 * friction * G), rel=1e-2)
    assert np.abs(body.velocity).max() < friction * G * 2e-3


@pytest.mark.mpi
@by_rule
@pytest.mark.fast("generalized-alpha")
@pytest.mark.fast_on_ranks()
def test_two_boxes_that_meet_keep_their_momentum(rule):
    """Whatever the scheme makes of the energy: the forces are equal and opposite."""
    left = box((-1.02, 0, 0), velocity=(1.0, 0, 0), name="left")
    right = box((0, 0.1, 0.05), (1, 0.8, 0.8), name="right")
    pair = nts.ContactPair(
        right.surface(lambda x: x[0] < 1e-9), left.surface(lambda x: x[0] > -0.02 - 1e-9)
    )
    run = nts.simulate(nts.System([left, right], contacts=[pair]), rule, dt=2e-3, t_end=0.06)
    momentum = run.balance["linear_momentum"]
    assert run.status.startswith("completed") and run.balance["active"].max() == 4
    assert np.abs(momentum - momentum[0]).max() < 1e-11 * np.abs(momentum[0]).max()
    assert right.velocity[0] > 0.1 and left.velocity[0] < 0.9
