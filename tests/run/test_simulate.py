"""The time loop: rejected steps, failed runs, the end of a run, moving supports in the ledger."""

import inspect
import textwrap

from mpi4py import MPI

import numpy as np
import pytest
import two_blocks
from integrators import MID_STEP
from scenes import RUBBER, bottom, box, fail_once, top

import dolfinx_nts as nts
from dolfinx_nts.run.load_steps import LoadStepper
from dolfinx_nts.validation import StepFailedError

COMM = MPI.COMM_WORLD


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_a_cut_back_step_equals_the_small_steps(integrator):
    """Nothing of a rejected step survives: the thirds are those of a run that never tried."""
    tried, plain = (nts.Stepper(two_blocks.scene(COMM), integrator) for _ in range(2))
    fail_once(tried, at_call=7)
    for stepper in (tried, plain):
        for _ in range(6):
            stepper.advance(4e-3)
    tried.advance(4e-3)
    for _ in range(3):
        plain.advance(4e-3 / 3)
    assert tried.solution.retries == 1
    assert plain.solution.balance["active"][-1] > 0
    for a, b in zip(tried.state.u + tried.state.v, plain.state.u + plain.state.v, strict=True):
        scale = COMM.allreduce(np.abs(b).max(initial=0.0), op=MPI.MAX)
        assert np.abs(a - b).max(initial=0.0) <= 1e-11 * scale
    assert np.isclose(tried.state.time, plain.state.time, rtol=1e-14)
    for body, u, v in zip(tried.system.bodies, tried.state.u, tried.state.v, strict=True):
        assert np.array_equal(body.u.x.array[: body.num_owned], u)
        assert np.array_equal(body.v.x.array[: body.num_owned], v)
    tried.close()
    plain.close()


@pytest.mark.mpi
def test_writers_see_the_parts_of_a_cut_step():
    """As many writes as rows of the balance, and one of them the last."""

    class Times:
        def start(self, stepper):
            self.times, self.ends = [stepper.state.time], []
            fail_once(stepper, at_call=3)

        def write(self, stepper, *, last=False):
            self.times.append(stepper.state.time)
            self.ends.append(last)

        def close(self, stepper):
            pass

    seen = Times()
    run = nts.simulate(
        two_blocks.scene(COMM), nts.EnergyMomentum(), dt=2e-3, t_end=8e-3, output=[seen]
    )
    assert run.retries == 1 and seen.ends == [False] * 5 + [True]
    assert seen.times == list(run.balance["time"])
    assert np.array(seen.times) == pytest.approx(2e-3 * np.array([0, 1, 2, 7 / 3, 8 / 3, 3, 4]))


def test_parts_of_a_cut_step_grow_again(monkeypatch):
    """Steps beyond 0.01 fail for the first 5 % of one of length 1; after it none of them does."""
    body = nts.RigidBody.from_inertia(1.0, (1, 1, 1), velocity=(1, 0, 0))
    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum())
    attempt, times = stepper.attempt, [0.0]

    def hard(time):
        if stepper.state.time < 0.05 and time - stepper.state.time > 0.01:
            raise StepFailedError("hard")
        return attempt(time)

    monkeypatch.setattr(stepper, "attempt", hard)
    for _ in stepper.in_parts(1.0):
        times.append(stepper.state.time)
    steps = np.diff(times)
    # Without growth 1/127 each; with it four of each length until it fails, 8, 16, ... then.
    assert times[-1] == 1.0 and steps[0] == pytest.approx(1 / 127)
    assert len(steps) < 127 / 3 and steps.max() > 5 * steps[0]
    assert body.position[0] == pytest.approx(1.0, rel=1e-12)


@pytest.mark.mpi
def test_a_step_that_fails_among_alike_laws_in_joints_says_so():
    bodies = [
        nts.RigidBody.from_inertia(1.0, 3 * [0.1], (x, 0, 0), name=f"weight {x}", comm=COMM)
        for x in (0, 1, 2)
    ]
    joints = [
        nts.Prismatic(body, None, point=body.position, axis=(1, 0, 0), limits=(-0.1, 0.1))
        for body in bodies
    ]
    run = nts.simulate(
        nts.System(bodies, joints=joints, gravity=(1.0, 0, 0)), nts.EnergyMomentum(), dt=0.1,
        t_end=1.0, newton=nts.Newton(max_iterations=1, max_retries=1),
    )  # fmt: skip
    assert run.status.startswith("step from t=") and "body 'weight 0" in run.status


@pytest.mark.parametrize("statics", [False, True], ids=["in time", "load steps"])
def test_what_fails_in_the_smallest_steps_is_not_told_to_try_smaller_ones(statics, monkeypatch):
    """Eight cuts leave 1/511 of a step. A script prints the status: the log has its headline."""

    def fails(*_):
        raise nts.StepFailedError("step not solved (SNES reason -5); worst block 'left'")

    monkeypatch.setattr(LoadStepper if statics else nts.Stepper, "_step", fails)
    said: list[str] = []
    log = "dolfinx_nts.run.simulate.logger.warning"
    monkeypatch.setattr(log, lambda text, *of, **_: said.append(text % of))
    system = two_blocks.scene(COMM)
    if statics:
        run = nts.equilibrium(system)
    else:
        run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=2e-3)
    smaller = "more load steps hardly help" if statics else "a smaller dt hardly helps"
    far = f"Steps of 0.002 of the length asked for fail, too, so that {smaller}"
    assert run.retries == 8 and far in run.status
    assert "Try" not in run.status and run.status.count("worst block") == 1
    assert run.summary.splitlines()[0] == run.status
    assert [text.split(":")[0] for text in said] == ["step not solved"]


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_failed_run_keeps_what_it_has_and_says_where():
    newton = nts.Newton(max_iterations=1, max_retries=2)
    run = nts.simulate(
        two_blocks.scene(COMM), nts.EnergyMomentum(), dt=2e-3, t_end=0.05, newton=newton
    )
    assert run.retries >= 2
    # Of 2 ms in 3 parts, and what is left after k of them in one part more than twice as many.
    sizes = [2e-3 * left / (3 * (2 * left + 1)) for left in (1, 2, 3)]
    assert any(f"with dt={dt:.3g}" in run.status for dt in sizes)
    assert run.status.startswith("step from t=")
    for word in ("worst block", "contact 'left-right': node", "facet", "flips", "body 'left'"):
        assert word in run.status
    assert "Try a smaller dt" in run.status
    table = run.balance
    assert 2 < len(table["time"]) < 25
    assert np.abs(table["ledger_residual"]).max() <= 1e-6 * table["energy"][0]


@pytest.mark.mpi
@pytest.mark.parametrize(("t_end", "steps"), [(7e-3, 4), (8e-3, 4), (8e-3 * (1 + 1e-12), 4)])
@pytest.mark.fast_on_ranks("0.007-4")
def test_equal_steps_reach_t_end(t_end, steps):
    run = nts.simulate(two_blocks.scene(COMM), nts.Midpoint(), dt=2e-3, t_end=t_end)
    assert run.status == "completed"
    assert np.allclose(run.balance["time"], np.linspace(0, t_end, steps + 1), rtol=1e-13)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_single_precision_step_costs_no_precision():
    run = nts.simulate(
        two_blocks.scene(COMM), nts.EnergyMomentum(), dt=np.float32(2e-3), t_end=0.04
    )
    assert np.abs(run.balance["ledger_residual"]).max() <= 1e-12 * run.balance["energy"][0]


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_closed_stepper_goes_on():
    kept, closed = (nts.Stepper(two_blocks.scene(COMM), nts.Midpoint()) for _ in range(2))
    for _ in range(2):
        kept.advance(2e-3)
        closed.advance(2e-3)
        closed.close()
    assert closed.solution.balance["energy"][-1] == kept.solution.balance["energy"][-1]
    kept.close()


def block(**options):
    return nts.Continuum(box(), RUBBER, density=1e3, name="block", **options)


@pytest.mark.mpi
@pytest.mark.parametrize(
    "options",
    [
        {"bcs": [nts.Dirichlet(bottom, lambda t: (0.1 * np.sin(40 * t), 0, 0.02 * t))]},
        {
            "bcs": [nts.Dirichlet(bottom)],
            "traction": [nts.Traction(top, lambda t: (0, 1e4 * t, 0))],
        },
        {"body_force": lambda t: (2e3 * np.cos(30 * t), 0, 0), "velocity": (0, 1, 0)},
    ],
    ids=["moving support", "traction", "body force"],
)
@pytest.mark.fast("body force")
@pytest.mark.fast_on_ranks()
def test_the_work_of_loads_and_supports_closes_the_ledger(options):
    system = nts.System([block(**options)], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.1)
    table = run.balance
    assert run.status == "completed"
    scale = max(table["energy"].max(), np.abs(table["external_work"]).max())
    assert np.abs(table["external_work"]).max() > 0.1
    assert np.abs(table["ledger_residual"]).max() <= 1e-11 * scale


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("energy-momentum")
def test_driven_nodes_have_the_velocity_of_their_support(integrator):
    """They start with it and do not alternate about it; exact for motion at constant speed."""
    speed = np.array([0.5, -0.2, 0.3])
    body = block(bcs=[nts.Dirichlet(lambda x: x[0] > -1, lambda t: 0.1 + speed * t)])
    stepper = nts.Stepper(nts.System([body]), integrator)
    driven = body.fixed.reshape(-1, 3)
    assert np.allclose(stepper.state.u[0][driven], 0.1)
    for _ in range(5):
        stepper.advance(2e-3)
        assert np.allclose(stepper.state.v[0][driven], speed, rtol=0, atol=1e-11)
    stepper.close()
    fixed = block(bcs=[nts.Dirichlet(lambda x: x[0] > -1, lambda t: (0.1 * np.sin(40 * t), 0, 0))])
    errors = []
    for dt in (2e-3, 1e-3):
        stepper = nts.Stepper(nts.System([fixed]), integrator)
        while stepper.state.time < 0.02 - 1e-9:
            stepper.advance(dt)
        error = stepper.state.v[0][driven[:, 0]] - 4.0 * np.cos(40 * stepper.state.time)
        errors.append(COMM.allreduce(np.abs(error).max(initial=0.0), op=MPI.MAX))
        stepper.close()
    assert errors[0] < 0.02
    assert 3.5 < errors[0] / errors[1] < 4.5


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
def test_free_fall(integrator):
    """Closed form: work of gravity m g s, momentum m g t, and both integrators are exact."""
    gravity, time, mass = 9.81, 0.1, 1e3
    run = nts.simulate(
        nts.System([block()], gravity=(0, 0, -gravity)), integrator, dt=0.01, t_end=time
    )
    fallen = 0.5 * gravity * time**2
    assert np.isclose(run.balance["external_work"][-1], mass * gravity * fallen, rtol=1e-12)
    assert np.isclose(run.balance["kinetic"][-1], mass * gravity * fallen, rtol=1e-12)
    momentum = run.balance["linear_momentum"][-1]
    assert np.allclose(momentum, [0, 0, -mass * gravity * time], rtol=1e-12, atol=1e-9)


@pytest.mark.slow
@pytest.mark.mpi
def test_extra_form_is_external_work():
    """Mass-proportional drag on a rigid flight: v' = -c v by the midpoint rule, in closed form."""
    import ufl

    drag, density, dt, steps = 5.0, 1e3, 0.01, 10
    system = nts.System(
        [
            block(
                velocity=(1, 0, 0),
                extra_form=lambda u, v, w, t: drag * density * ufl.inner(v, w) * ufl.dx,
            )
        ]
    )
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=steps * dt)
    decay = ((1 - drag * dt / 2) / (1 + drag * dt / 2)) ** steps
    assert np.isclose(run.balance["linear_momentum"][-1, 0], density * decay, rtol=1e-12)
    assert np.isclose(run.balance["energy"][-1], 0.5 * density * decay**2, rtol=1e-12)
    assert np.abs(run.balance["ledger_residual"]).max() <= 1e-12 * run.balance["energy"][0]


@pytest.mark.mpi
def test_the_writer_that_simulate_shows(capsys):
    """The example in the docstring, run as it stands: a block in free flight."""
    text = inspect.getdoc(nts.simulate)
    end = "output=[heights])"
    example = text[text.index("class Heights") : text.index(end)] + end
    system = two_blocks.scene(COMM, cells=(1, 1))
    start = nts.motion_of(system.bodies[0])
    names = {"nts": nts, "system": system, "integrator": nts.Midpoint()}
    exec(textwrap.dedent(" " * 12 + example).replace("t_end=0.2", "t_end=5e-3"), names)
    rows = np.array(names["heights"].rows)
    assert np.allclose(rows[:, 0], 1e-3 * np.arange(1, 6), rtol=1e-12)
    assert np.allclose(rows[:, 1], start.centre[2] + start.velocity[2] * rows[:, 0], rtol=1e-12)
    assert capsys.readouterr().out == "5 steps; completed\n"
