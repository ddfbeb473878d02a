"""The hook before each step: loads and materials that it changes, and when it is called."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from integrators import MID_STEP
from scenes import box, everywhere

import dolfinx_nts as nts
from dolfinx_nts.validation import UserFunctionError

COMM = MPI.COMM_WORLD
DT = 1e-3
YOUNG, DENSITY = 1e4, 1e3

pytestmark = pytest.mark.mpi


def pulled(bcs=()):
    """A cube with a Constant that pulls it in z, per volume [N/m^3]."""
    mesh = box()
    load = fem.Constant(mesh, 0.0)
    body = nts.Continuum(
        mesh, nts.StVenantKirchhoff(YOUNG, 0.0), density=DENSITY, bcs=bcs,
        extra_form=lambda u, v, w, t: -load * w[2] * ufl.dx,
    )  # fmt: skip
    return body, load


class Calls(list):
    """A hook that notes its calls, and fails on the last rank from a time on."""

    def __init__(self, until=np.inf):
        self.until = until

    def __call__(self, time, dt):
        self.append((time, dt))
        if time >= self.until and COMM.rank == COMM.size - 1:
            raise KeyError("table")

    def last_before(self, ends):
        """The last call before each step ended, given the number of calls by then."""
        return np.array([self[n - 1] for n in ends])


class Count:
    """A writer that notes how often a hook had been called after each step."""

    def __init__(self, calls):
        self.calls, self.ends = calls, []

    def start(self, stepper):
        pass

    def write(self, stepper, *, last=False):
        self.ends.append(len(self.calls))

    def close(self, stepper):
        pass


@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
def test_a_load_that_it_changes(integrator):
    """The midpoint rule integrates a force linear in time exactly."""
    body, load = pulled()

    def ramp(time, dt):
        load.value = 7e3 * (time + 0.5 * dt)

    run = nts.simulate(nts.System([body]), integrator, dt=DT, t_end=5 * DT, before_step=ramp)
    speed = 7e3 / DENSITY * 0.5 * (5 * DT) ** 2
    assert run.status == "completed"
    assert np.allclose(run.balance["linear_momentum"][-1], [0, 0, DENSITY * speed], atol=1e-10)
    assert np.isclose(run.balance["external_work"][-1], 0.5 * DENSITY * speed**2, rtol=1e-9)


def test_the_first_accelerations_feel_it():
    """Newmark's begin with the load of the first call: v_1 is that of a constant force."""
    body, load = pulled()

    def pull(time, dt):
        load.value = 7e3

    run = nts.simulate(nts.System([body]), nts.Newmark(), dt=DT, t_end=DT, before_step=pull)
    assert np.allclose(run.balance["linear_momentum"][-1], [0, 0, 7e3 * DT], atol=1e-10)


def test_it_is_called_for_cut_steps_too():
    body, _ = pulled()
    calls = Calls()
    stepper = nts.Stepper(nts.System([body]), nts.Midpoint(), before_step=calls)
    solve = stepper.solver.solve

    def failing():
        if len(calls) == 3:  # the first call comes before the row of the start
            raise nts.StepFailedError("on purpose")
        return solve()

    stepper.solver.solve = failing
    stepper.advance(DT)
    stepper.advance(DT)
    stepper.close()
    assert stepper.solution.retries == 1
    third = DT / 3
    expected = [(0, DT), (0, DT), (DT, DT), *((DT + k * third, third) for k in range(3))]
    assert np.allclose(calls, expected, rtol=1e-12, atol=1e-18)


def test_it_is_called_with_chosen_steps():
    """Two calls at the gap that closes: with the step as proposed, and as it is made."""
    mesh = box()
    body = nts.Continuum(
        mesh, nts.NeoHookean(1e6, 0.3), density=DENSITY, velocity=(0, 0, -1.0), name="cube"
    )
    floor = nts.Plane((0, 0, -4.3 * DT), (0, 0, 1))
    pair = nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), floor)
    calls = Calls()
    count = Count(calls)
    run = nts.simulate(
        nts.System([body], contacts=[pair]), nts.EnergyMomentum(), dt=DT, t_end=8 * DT,
        adapt=nts.Adapt(), output=[count], before_step=calls,
    )  # fmt: skip
    assert run.status == "completed"
    time = run.balance["time"]
    assert np.allclose(
        calls.last_before(count.ends), np.stack([time[:-1], np.diff(time)], axis=1), rtol=1e-9
    )
    assert len(calls) > len(time)


def test_a_material_that_it_changes_is_in_the_ledger():
    """A cube held in a stretch of 1.1: its energy is in proportion to the modulus."""
    mesh = box()
    young = fem.Constant(mesh, 0.0)
    bcs = [
        nts.Dirichlet(lambda x: x[2] > 1 - 1e-9, (0, 0, 0.1), components=(2,)),
        nts.Dirichlet(lambda x: x[2] < 1e-9, components=(2,)),
        nts.Dirichlet(everywhere, components=(0, 1)),
    ]
    base = nts.StVenantKirchhoff(1.0, 0.0)
    body = nts.Continuum(mesh, lambda c: young * base(c), density=DENSITY, bcs=bcs, name="cube")
    density = (1.1**2 - 1) ** 2 / 8

    def soften(time, dt):
        young.value = YOUNG if time < 2.5 * DT else 0.5 * YOUNG

    # Under the first modulus, which is 0 until the first call.
    still = nts.equilibrium(nts.System([body]), before_step=soften)
    assert np.isclose(still.balance["potential"][-1], YOUNG * density, rtol=1e-9)
    young.value = 0.0
    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=DT, t_end=1.0 + 5 * DT, start=still,
        before_step=lambda time, dt: soften(time - 1.0, dt),
    )  # fmt: skip
    assert run.status.startswith("completed")
    change = run.balance["material_change"]
    assert np.allclose(change[:4], 0.0) and change.shape == (6,)
    assert np.allclose(change[4:], -0.5 * YOUNG * density, rtol=1e-9)
    assert np.isclose(run.balance["potential"][0], YOUNG * density, rtol=1e-9)
    assert "'cube'" in run.warnings["material changed"].text


def test_equilibrium_calls_it_with_pseudo_times():
    """The pull of a load step is what holds the cube in it, at each of them."""
    body, load = pulled([nts.Dirichlet(lambda x: x[2] < 1e-9)])

    def ramp(time, dt):
        load.value = 300.0 * (time + dt)

    run = nts.equilibrium(nts.System([body]), load_steps=4, before_step=ramp)
    assert run.status == "completed"
    assert np.allclose(
        run.reactions[body.name][:, 0, 2], [0, -75, -150, -225, -300], rtol=1e-8, atol=1e-6
    )


def test_it_must_be_callable():
    with pytest.raises(TypeError, match="before_step=3: pass a callable"):
        nts.simulate(nts.System([pulled()[0]]), nts.Midpoint(), dt=DT, t_end=DT, before_step=3)


class Writes:
    """A hook and a writer that writes into the array of u or v on the last rank, once."""

    def __init__(self, body, which, time, by):
        self.body, self.which, self.time, self.by = body, which, time, by

    def __call__(self, time, dt):
        if self.by == "before_step" and abs(time - self.time) < 0.5 * dt:
            self.change()

    def start(self, stepper):
        if self.by == "start":
            self.change()

    def write(self, stepper, *, last=False):
        if self.by == "writer" and abs(stepper.state.time - self.time) < 0.5 * DT:
            self.change()

    def close(self, stepper):
        pass

    def change(self):
        if COMM.rank == COMM.size - 1:
            getattr(self.body, self.which).x.array[1] += 0.5


@pytest.mark.parametrize(
    ("which", "time", "by", "steps"),
    [
        ("v", 0.0, "before_step", 0), ("u", 2 * DT, "before_step", 2), ("u", 2 * DT, "writer", 2),
        ("v", 4 * DT, "writer", 4), ("u", 0.0, "start", 0),
    ],
)  # fmt: skip
def test_what_is_written_into_u_or_v_ends_the_run(which, time, by, steps):
    """Until then it is the run that nothing has disturbed, and the body is again in its state."""
    body, load = pulled()
    load.value = 1.0
    writes = Writes(body, which, time, by)
    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=DT, t_end=4 * DT, before_step=writes,
        output=[writes],
    )  # fmt: skip
    assert f"body 'body': its {which} was written during the run, at t=" in run.status
    assert "undone now: move nodes by Dirichlet" in run.status
    assert len(run.rows) == steps + 1
    # A cube that a load per volume pulls falls freely.
    momentum = run.balance["linear_momentum"][-1]
    assert np.allclose(momentum, [0, 0, steps * DT], rtol=1e-10, atol=1e-15)
    for function, values in ((body.u, run.state.u[0]), (body.v, run.state.v[0])):
        assert np.array_equal(function.x.array[: body.num_owned], values)


@pytest.mark.parametrize("rigid", [False, True])
def test_what_is_written_between_steps_is_refused_once(rigid):
    """Also where the Functions are made of the coordinates; load steps have no other."""
    body, _ = pulled()
    if rigid:
        body = nts.RigidBody(box(), density=DENSITY, velocity=(1.0, 0, 0))
    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum())
    stepper.advance(DT)
    body.u.x.array[:] += 1e-3
    with pytest.raises(UserFunctionError, match="its u was written during the run, at t=0.001"):
        stepper.advance(DT)
    stepper.advance(DT)
    assert stepper.state.time == pytest.approx(2 * DT)
    assert np.array_equal(stepper.solution.balance["linear_momentum"][0],
                          stepper.solution.balance["linear_momentum"][1])  # fmt: skip
    stepper.close()


@pytest.mark.parametrize("rigid", [False, True])
def test_nodes_of_a_mesh_that_are_moved_during_a_run_end_it(rigid):
    """On the last rank alone; forces would be those of another mesh from then on."""
    body, _ = pulled()
    if rigid:
        body = nts.RigidBody(box(), density=DENSITY, velocity=(1.0, 0, 0), name="body")

    def move(time, dt):
        if time > 1.5 * DT and COMM.rank == COMM.size - 1:
            body.mesh.geometry.x[0] += 1e-3

    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=DT, t_end=4 * DT, before_step=move
    )
    assert "mesh of 'body': its nodes were moved during the run, at t=0.002" in run.status
    assert len(run.rows) == 3


def test_what_is_written_between_load_steps_is_told():
    body, load = pulled([nts.Dirichlet(lambda x: x[2] < 1e-9)])
    load.value = 1.0
    run = nts.equilibrium(
        nts.System([body]), load_steps=2, output=[Writes(body, "u", 0.5, "writer")]
    )
    assert "its u was written during the run, at t=0.5 by" in run.status and len(run.rows) == 2
