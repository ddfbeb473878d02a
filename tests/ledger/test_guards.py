"""No step is accepted that is none: rounding is that of states, momentum needs impulses."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import two_blocks
from dolfinx.mesh import CellType, create_box
from integrators import MID_STEP
from measures import OPEN, ledger_or_word
from point_mass import STEP, PointMass, mass_on_wall
from scenes import fung

import dolfinx_nts as nts
from dolfinx_nts.ledger import balance
from dolfinx_nts.ledger.guards import check_momentum, pushes
from dolfinx_nts.parallel import together
from dolfinx_nts.run.trial import state_after

COMM = MPI.COMM_WORLD
STEEP = ["b=1000", "b=300"]


@pytest.mark.mpi
@pytest.mark.parametrize(("steepness", "speed"), [(1000.0, 20.0), (300.0, 40.0)], ids=STEEP)
@pytest.mark.parametrize("accuracy", ["balanced", "exact"])
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast("midpoint-exact-b=1000")
@pytest.mark.fast_on_ranks()
def test_momentum_is_not_reversed_by_a_very_steep_material(integrator, accuracy, steepness, speed):
    """A diverged iterate of stiffness 1e55 excused du = 0 by its rounding, so that v_1 = -v_0."""
    system = two_blocks.scene(COMM, cells=(3, 2), material=fung(steepness), speed=speed)
    run = nts.simulate(system, integrator, dt=2e-3, t_end=6e-3, accuracy=accuracy)
    table = run.balance
    # The gap of 0.05 closes soon: the run came past its first contact, however it ended.
    assert table["time"][-1] > 0.05 / speed and table["active"].max() > 0
    # Nothing acts from outside: what the first cube of 1000 kg brings is there after each step.
    assert np.allclose(table["linear_momentum"], [1e3 * speed, 0, 0], rtol=0, atol=1e-8 * speed)
    turn = table["angular_momentum"]
    assert np.abs(turn - turn[0]).max() < 1e-8 * speed
    missing = ledger_or_word(run, 1e-8 if integrator.closes_ledger else OPEN)
    assert run.status.startswith("completed") or "Try a smaller dt" in run.status
    if integrator.closes_ledger:
        assert missing <= 1e-8 and "ledger" not in run.warnings


@pytest.mark.mpi
def test_a_step_without_an_impulse_keeps_its_momentum():
    """The check itself: v_1 = -v_0 in free flight, and an angular momentum out of nothing."""
    system, other = (mass_on_wall(1.0, velocity=(1.0, 0.0, 0.0))[0] for _ in range(2))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    stepper.start(STEP)
    stepper.problem.begin(stepper.state, STEP)
    step, before = stepper.solver.solve(), stepper.solution.rows[-1]
    good = nts.Stepper(other, nts.EnergyMomentum()).advance(STEP)
    after = balance.measure(system, good)
    (pushed,) = together(COMM, [pushes(stepper.problem, step, good)])
    check_momentum(stepper.problem, pushed, before, after)
    reversed_ = replace(good, v=(-good.v[0], good.v[1]))
    with pytest.raises(nts.StepFailedError, match="linear momentum changes by 5 more than"):
        check_momentum(stepper.problem, pushed, before, balance.measure(system, reversed_))
    turned = {**after, "angular_momentum": after["angular_momentum"] + [0.0, 0.0, 1.0]}
    with pytest.raises(nts.StepFailedError, match="angular momentum changes by 1 more than"):
        check_momentum(stepper.problem, pushed, before, turned)
    stepper.close()


@pytest.mark.mpi
def test_a_reversed_momentum_is_seen_beside_stiff_springs():
    """Two that pull with 1e8 N each cancel each other, and excuse no more than their rounding."""
    mass = nts.RigidBody.from_inertia(1.0, (1, 1, 1), velocity=(0, 1, 0), name="mass")
    springs = [
        nts.Spring(mass, None, [(0, 0, 0), (x, 0, 0)], stiffness=1e9, length=0.9, name=f"at {x}")
        for x in (-1.0, 1.0)
    ]
    stepper = nts.Stepper(nts.System([mass], joints=springs), nts.EnergyMomentum())
    stepper.start(STEP)
    stepper.problem.begin(stepper.state, STEP)
    step, before = stepper.solver.solve(), stepper.solution.rows[-1]
    good = state_after(stepper.problem, step, STEP)
    speed = abs(good.v[0][1]) if mass.num_owned else 0.0
    speed = COMM.allreduce(speed, op=MPI.MAX)
    (pushed,) = together(COMM, [pushes(stepper.problem, step, good)])
    check_momentum(stepper.problem, pushed, before, balance.measure(stepper.system, good))
    reversed_ = replace(good, v=(-good.v[0],))
    with pytest.raises(
        nts.StepFailedError, match=f"linear momentum changes by {2 * speed:.3g} more than"
    ):
        check_momentum(
            stepper.problem, pushed, before, balance.measure(stepper.system, reversed_)
        )
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize("ledger", [True, False])
def test_the_guard_is_on_in_every_run(ledger, monkeypatch):
    """Velocities that an integrator turns round at the end of a step end the run."""
    rule = nts.EnergyMomentum()
    good = type(rule).advance
    system = nts.System([PointMass(COMM, 1.0, (0.0, 0.0, 1.0), velocity=(1.0, 0.0, 0.0))])

    def turned(self, du, v, a, dt):
        v1, a1 = good(self, du, v, a, dt)
        return -v1, a1

    monkeypatch.setattr(type(rule), "advance", turned)
    run = nts.simulate(system, rule, dt=STEP, t_end=3 * STEP, ledger=ledger)
    assert "linear momentum changes by" in run.status


@pytest.mark.mpi
def test_no_tolerance_comes_from_an_iterate():
    """Evaluating a far iterate and its matrix leaves every tolerance as it was."""
    system = two_blocks.scene(COMM, cells=(2, 1))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    stepper.start(STEP)
    problem = stepper.problem
    problem.begin(stepper.state, 2e-3)
    before = problem.rounding.forces.tolist()
    far = problem.x.duplicate()
    far.array_w[:] = 1e3 * (1 + np.arange(len(far.array_r)))
    with np.errstate(all="ignore"):
        problem.tangents.at(problem.evaluate(far))
    assert problem.rounding.forces.tolist() == before
    far.destroy()
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize("force", [1e-150, 1e-155, 1e-165, 1e-300])
def test_a_force_whose_square_is_no_number_stops_nothing(force):
    """As at the foot of a pulse exp(-(t - t0)^2 / s^2): the norm of its residual is zero."""
    mesh = create_box(COMM, [np.zeros(3), np.ones(3)], [1, 1, 2], CellType.hexahedron)
    body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3, body_force=(force, 0, 0))
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=1e-4, t_end=3e-4)
    assert run.status == "completed" and run.retries == 0
