"""Newmark's method and generalised alpha: an oscillator in closed form, momenta, starts."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from integrators import ACCELERATED
from measures import kinds
from point_mass import MASS, STEP, PointMass
from scenes import at, box, flying_block, sliding_block

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
OMEGA = 40.0
"""Of the oscillator: a step is 0.8 rad, so that the schemes differ by much [1/s]."""


class Oscillator(PointMass):
    """A mass on a spring to u = 0, by any rule that takes its force at theta."""

    def __init__(self, place=0.3, speed=2.0):
        super().__init__(COMM, MASS, (0.0, 0.0, 0.0), (speed, 0.0, 0.0))
        self.place = place

    def internal(self, u1):
        u0 = self.moment.u0
        return MASS * OMEGA**2 * (u0 + self.rule.theta * (u1 - u0))

    def tangent(self, u1, mass, stiffness):
        matrix = super().tangent(u1, mass, stiffness)
        matrix.shift(stiffness * self.rule.theta * MASS * OMEGA**2)
        return matrix

    def potential(self, u):
        return 0.5 * MASS * OMEGA**2 * float(u @ u)


def alpha_parameters(rho):
    """Chung and Hulbert's alpha_m, alpha_f, beta, gamma."""
    m, f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    return m, f, 0.25 * (1 - m + f) ** 2, 0.5 - m + f


def newmark_parameters(beta, gamma):
    return 0.0, 0.0, beta, gamma


SCHEMES = {
    "trapezoidal": (nts.Newmark(), newmark_parameters(0.25, 0.5)),
    "fox-goodwin": (nts.Newmark(beta=1 / 12, gamma=0.5), newmark_parameters(1 / 12, 0.5)),
    "damped": (nts.Newmark(beta=0.36, gamma=0.7), newmark_parameters(0.36, 0.7)),
    **{
        f"alpha {rho}": (nts.GeneralizedAlpha(rho_inf=rho), alpha_parameters(rho))
        for rho in (0.0, 0.5, 0.8, 1.0)
    },
}


def amplification(m, f, beta, gamma, h):
    """Matrix of a step of (u, h v, h^2 a), from the three equations of the scheme."""
    w = (OMEGA * h) ** 2
    after = np.array([[1.0, 0.0, -beta], [0.0, 1.0, -gamma], [(1 - f) * w, 0.0, 1 - m]])
    before = np.array([[1.0, 1.0, 0.5 - beta], [0.0, 1.0, 1 - gamma], [-f * w, 0.0, -m]])
    return np.linalg.solve(after, before)


@pytest.mark.mpi
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.fast_on_ranks("damped", "alpha 0.5")
def test_an_oscillator_moves_as_the_scheme_says(scheme):
    integrator, parameters = SCHEMES[scheme]
    stepper = nts.Stepper(nts.System([Oscillator()]), integrator)
    n = stepper.system.bodies[0].num_owned
    stepper.state = replace(stepper.state, u=(np.array([0.3, 0.0, 0.0])[:n],))
    z = np.array([0.3, STEP * 2.0, -((STEP * OMEGA) ** 2) * 0.3])
    matrix = amplification(*parameters, STEP)
    for _ in range(50):
        state, z = stepper.advance(STEP), matrix @ z
        if n:
            found = [state.u[0][0], STEP * state.v[0][0], STEP**2 * state.a[0][0]]
            assert np.abs(found - z).max() < 1e-11
    stepper.close()


@pytest.mark.slow
def test_alpha_without_damping_is_the_midpoint_rule():
    """(a_0 + a_1)/2 is its mean acceleration."""
    ends = []
    for integrator in (nts.Midpoint(), nts.GeneralizedAlpha(rho_inf=1.0)):
        stepper = nts.Stepper(sliding_block(0.1), integrator)
        for _ in range(20):
            stepper.advance(0.01)
        ends.append(np.concatenate([*stepper.state.u, *stepper.state.v]))
        stepper.close()
    assert np.abs(ends[0] - ends[1]).max() < 1e-9 * np.abs(ends[0]).max()


def momenta(stepper, integrator, steps, dt):
    """L, J and sum v x M a after each step, shape (steps + 1, 3) each."""
    body, correction = stepper.system.bodies[0], []
    stepper.start(dt)
    for k in range(steps + 1):
        if k:
            stepper.advance(dt)
        state = stepper.state
        v, force = state.v[0].reshape(-1, 3), body.inertia(state.a[0]).reshape(-1, 3)
        correction.append(COMM.allreduce(np.cross(v, force).sum(axis=0)))
    table = stepper.solution.balance
    return table["linear_momentum"], table["angular_momentum"], np.array(correction)


@pytest.mark.mpi
def test_momenta_of_the_trapezoidal_rule():
    """L is kept, and J + h^2/4 sum v x M a: the rule is the midpoint rule half a step on."""
    dt = 0.02
    stepper = nts.Stepper(flying_block(), nts.Newmark())
    linear, angular, correction = momenta(stepper, nts.Newmark(), 25, dt)
    stepper.close()
    size = np.abs(angular[0]).max()
    assert np.abs(linear - linear[0]).max() < 1e-11 * np.abs(linear[0]).max()
    assert np.abs(angular - angular[0]).max() > 1e-4 * size
    kept = angular + 0.25 * dt**2 * correction
    assert np.abs(kept - kept[0]).max() < 1e-10 * size


@pytest.mark.parametrize("integrator", ACCELERATED.values(), ids=ACCELERATED)
def test_the_start_accelerates(integrator):
    """A body under gravity falls from the first step on."""
    gravity = np.array([0.0, 0.0, -9.81])
    body = nts.Continuum(
        box(),
        nts.NeoHookean(1e6, 0.3), density=1e3,
    )  # fmt: skip
    stepper = nts.Stepper(nts.System([body], gravity=gravity), integrator)
    stepper.start(1e-3)
    a = stepper.state.a[0].reshape(-1, 3)
    assert np.abs(a - gravity).max(initial=0.0) < 1e-11
    stepper.advance(1e-3)
    path = 0.5e-6 * gravity
    assert np.abs(stepper.state.u[0].reshape(-1, 3) - path).max(initial=0.0) < 1e-17
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", ACCELERATED.values(), ids=ACCELERATED)
def test_a_block_that_rests_stays_at_rest(integrator):
    """From equilibrium under the forces of contact: they are part of the first acceleration."""
    mesh = box()
    block = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3, name="block")
    pair = nts.ContactPair(
        block.surface(lambda x: x[2] < 1e-9), nts.Plane((0, 0, 0), (0, 0, 1)), friction=0.5
    )
    system = nts.System([block], contacts=[pair], gravity=(0, 0, -9.81))
    settled = nts.equilibrium(system)
    run = nts.simulate(system, integrator, dt=5e-3, t_end=1.1, start=settled)
    assert run.status == "completed"
    moved = np.abs(block.u.x.array)
    state = settled.state.u[0]
    assert np.abs(moved[: len(state)] - np.abs(state)).max(initial=0.0) < 1e-10
    assert (run.balance["active"] == 9).all()


def test_parameters_out_of_range_are_named():
    for options, words in (
        ({"beta": 0.0}, r"^beta=0.0: must lie in"),
        ({"gamma": 0.4}, r"^gamma=0.4: must lie in"),
        ({"beta": "a"}, r"^beta='a': must lie in"),
    ):
        with pytest.raises(ValueError, match=words):
            nts.Newmark(**options)
    with pytest.raises(ValueError, match=r"^rho_inf=1.1: must lie in \[0, 1\]"):
        nts.GeneralizedAlpha(rho_inf=1.1)
    with pytest.raises(ValueError, match="is not of second order; leave adapt out"):
        nts.simulate(
            flying_block(), nts.Newmark(gamma=0.6), dt=0.1, t_end=1.0, adapt=nts.Adapt()
        )


@pytest.mark.mpi
@pytest.mark.parametrize("rule", [nts.Newmark(), nts.GeneralizedAlpha(rho_inf=0.8)], ids=repr)
@pytest.mark.parametrize("kind", ["traction", "body_force", "torque"])
@pytest.mark.fast_on_ranks(
    "traction-GeneralizedAlpha(rho_inf=0.8)", "torque-Newmark(beta=0.25, gamma=0.5)",
)  # fmt: skip
def test_work_of_loads_in_time(rule, kind):
    """A cube of 1 t that 1e4 t [N] lift from rest has 0.05 m/s after 0.1 s: 1.25 J, all of it work.

    By the force at the end of each step the work was 10 % too large, and the run said so of the
    energy, which was right.
    """

    def load(t):
        return (0.0, 0.0, 1e4 * t)

    if kind == "torque":
        body = nts.RigidBody.from_inertia(1.0, (1e3, 1e3, 1e3), torque=load)
    elif kind == "traction":
        top = nts.Traction(at(2, 1.0), load)
        body = nts.Continuum(box(cells=1), nts.NeoHookean(1e8, 0.3), density=1e3, traction=[top])
    else:
        body = nts.Continuum(box(cells=1), nts.NeoHookean(1e8, 0.3), density=1e3, body_force=load)
    run = nts.simulate(nts.System([body]), rule, dt=1e-2, t_end=0.1)
    assert run.status == "completed" and "ledger" not in run.warnings
    work = run.balance["external_work"][-1]
    assert work == pytest.approx(1.25, rel=1e-2)
    if rule == nts.Newmark():
        assert abs(run.balance["ledger_residual"][-1]) < 1e-2 * work


def test_a_body_is_told_of_a_step_once_unless_its_loads_change():
    """Else at both ends of the step, too, and again where it takes its forces."""
    steps, counts = 4, []
    for force in ((0.0, 0.0, 1.0), lambda t: (0.0, 0.0, 1.0)):
        body = nts.RigidBody.from_inertia(1.0, (1.0, 1.0, 1.0), force=force)
        told, begin = [], body.begin_step
        body.begin_step = lambda *given, told=told, begin=begin: (told.append(given), begin(*given))
        run = nts.simulate(nts.System([body]), nts.Newmark(), dt=0.1, t_end=0.1 * steps)
        counts.append(len(told))
        # z = t^2/2 at t = 0.4.
        assert run.balance["external_work"][-1] == pytest.approx(0.08, rel=1e-9)
    assert counts[1] - counts[0] == 3 * steps


@pytest.mark.mpi
@pytest.mark.parametrize("rule", [nts.Newmark(), nts.GeneralizedAlpha(rho_inf=0.8)], ids=repr)
@pytest.mark.parametrize("kind", ["rigid", "continuum"])
def test_a_support_takes_the_loads_at_it(rule, kind):
    """Driven at 2 m/s, a body of 1 t keeps its 2000 J: supports hold what 1e4 t [N] does.

    With the part of the load in time that the supports take, the work was -10 J.
    """

    def load(t):
        return (1e4 * t, 0.0, 0.0)

    def motion(t):
        return (2.0 * t, 0.0, 0.0)

    if kind == "rigid":
        body = nts.RigidBody.from_inertia(1e3, (1e3, 1e3, 1e3), force=load, motion=motion)
    else:
        held = nts.Dirichlet(lambda x: x[0] > -1.0, motion)
        material = nts.NeoHookean(1e8, 0.3)
        body = nts.Continuum(box(cells=1), material, density=1e3, body_force=load, bcs=[held])
    run = nts.simulate(nts.System([body]), rule, dt=1e-2, t_end=0.1)
    assert run.status == "completed" and not kinds(run)
    assert run.balance["kinetic"][-1] == pytest.approx(2000.0)
    for name in ("external_work", "ledger_residual"):
        assert abs(run.balance[name]).max() < 1e-9 * 2000.0
