"""Contact beside equations of a user's own."""

from mpi4py import MPI

import numpy as np
import own_problem
import pytest
import ufl

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
STEPS = 4


def ball():
    """It goes into the block and then to the side [m]."""
    top = (0.5, 0.5, own_problem.HEIGHT + own_problem.RADIUS)
    way = own_problem.DEPTH
    return nts.Sphere(
        top, own_problem.RADIUS,
        motion=lambda t: (way * max(0.0, t - 0.5), 0.0, -way * min(t, 0.5)),
    )  # fmt: skip


def block_and_terms(comm, friction=0.0):
    """The demo's block, and contact with a ball beside it."""
    block = own_problem.Block(own_problem.mesh_of(comm, 2))
    top = block.boundary()
    pair = nts.ContactPair(top, ball(), friction=friction)
    return block, nts.ContactTerms([block], [pair])


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_friction_is_that_of_equilibrium():
    """Its history goes on from step to step: sticking nodes drag the block, slipping ones less."""
    block, contact = block_and_terms(COMM, friction=0.4)
    ours = []
    for k in range(STEPS):
        x = contact.begin((k + 1) / STEPS, reach=0.1)
        own_problem.solve(block, contact, x)
        contact.accept(x)
        (force,) = contact.forces(x)
        ours.append(COMM.allreduce(force.reshape(-1, 3).sum(axis=0)))
    contact.destroy()

    def neo_hooke(c):
        log = ufl.ln(ufl.det(c))
        return 0.5 * own_problem.MU * (ufl.tr(c) - 3 - log) + own_problem.LAMBDA / 8 * log**2

    body = nts.Continuum(
        own_problem.mesh_of(COMM, 2), neo_hooke, density=1.0, name="block",
        bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)],
    )  # fmt: skip
    pair = nts.ContactPair(body.surface(lambda x: x[2] > -1.0), ball(), friction=0.4)
    run = nts.equilibrium(nts.System([body], contacts=[pair]), load_steps=STEPS)
    assert run.status == "completed"
    theirs = run.contact_forces[1:, 0]
    assert theirs[-1, 0] > 0.05 * -theirs[-1, 2] > 0.0
    assert np.abs(np.array(ours) - theirs).max() < 1e-6 * np.abs(theirs).max()


@pytest.mark.mpi
def test_a_step_beyond_its_reach_is_not_accepted():
    block, contact = block_and_terms(COMM)
    x = contact.begin(0.25, reach=1e-6)
    with x as values:
        values[: block.num_owned] = 0.1
    with pytest.raises(nts.StepFailedError, match="reach=1e-06"):
        contact.accept(x)
    assert contact.state.time == 0.0
    contact.destroy()


@pytest.mark.mpi
def test_bad_input():
    _, contact = block_and_terms(COMM)
    with pytest.raises(ValueError, match="time=0.0: must be later than the last, 0"):
        contact.begin(0.0, reach=1.0)
    for reach in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match=f"reach={reach}: must be positive"):
            contact.begin(1.0, reach=reach)
