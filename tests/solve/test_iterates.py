"""What leads Newton's method to a step's solution."""

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from petsc4py import PETSc
from scenes import box, everywhere

import dolfinx_nts as nts
from dolfinx_nts.solve.blurred_contacts import BlurredContacts

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi


def push(problem, e):
    """Sum of the contact forces of an evaluation."""
    parts = e.parts[: problem.couplings.num_touching]
    return COMM.allreduce(sum((part.force.sum(axis=0) for part in parts), np.zeros(3)))


def test_a_step_that_is_solved_again_begins_at_its_solution():
    """A cube slides over a plane: friction of its nodes, too, is that of the solution."""
    mesh = box([0, 0, 0], [1, 1, 1], 1)
    cube = nts.RigidBody(mesh, density=1e3, velocity=(2.0, 1.0, 0.0))
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    pair = nts.ContactPair(cube.surface(everywhere), floor, friction=0.3)
    system = nts.System([cube], contacts=[pair], gravity=(0, 0, -9.81))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    stepper.advance(1e-3)
    problem, dt = stepper.problem, 1e-3
    stepper.begin(dt)
    step = stepper.solver.solve()
    pushed = push(problem, step)
    assert np.hypot(*pushed[:2]) == pytest.approx(0.3 * pushed[2], rel=1e-9)
    assert pushed[2] > 0.0
    problem.begin(problem.state, dt, step)
    guess = problem.evaluate(problem.x)
    assert np.abs(push(problem, guess) - pushed).max() < 1e-9 * pushed[2]
    square = COMM.allreduce(float(np.square(problem.residual(guess)).sum()))
    assert square**0.5 < 1e-9 * pushed[2]


def test_updates_that_run_away_from_blurred_laws_are_halved():
    """The residual is the unknown, 1 and at most 10 then: of an update of 40 a quarter is left."""
    blurred = BlurredContacts(
        SimpleNamespace(
            system=SimpleNamespace(comm=COMM), couplings=SimpleNamespace(blur=lambda *_: None),
            shared_weight=SimpleNamespace(kept=False), evaluate=lambda x: x.array_r.copy(),
            residual=lambda e: e,
        )
    )  # fmt: skip
    x = PETSc.Vec().createMPI((PETSc.DECIDE, 1), comm=COMM)
    y = x.duplicate()
    x.set(1.0)
    for update, left in ((40.0, 10.0), (10.0, 10.0)):
        y.set(update)
        assert not blurred.shorten(x.array_r.copy(), x, y)
        blurred.blurs = True
        assert blurred.shorten(x.array_r.copy(), x, y) == (left < update)
        assert y.max()[1] == left
        blurred.blurs = False
