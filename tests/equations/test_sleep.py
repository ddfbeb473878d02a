"""`sleep=True`: what nothing moves costs nothing, and the run is the one without it."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, create_box
from integrators import MID_STEP
from point_mass import PointMass
from scenes import box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
DT = 2e-3


def cube(low, name, *, cells=2, metre=1.0, **options):
    """A unit cube at rest unless said otherwise."""
    low = metre * np.asarray(low, dtype=float)
    mesh = box(low, low + metre, cells)
    rubber = nts.NeoHookean(young=1e6 / metre, poisson=0.3)
    return nts.Continuum(mesh, rubber, density=1e2 / metre**3, name=name, **options)


def face(body, end):
    """Surface of a cube in a row that looks back (0) or ahead (1) along x."""
    x = body.mesh.geometry.x[:, 0]
    place = COMM.allreduce(float(x[:].max(initial=-np.inf)), op=MPI.MAX)
    if end == 0:
        place = COMM.allreduce(float(x[:].min(initial=np.inf)), op=MPI.MIN)
    width = 1e-9 * max(1.0, abs(place))
    return body.surface(lambda x: np.abs(x[0] - place) < width)


def pair(slave, master, **options):
    return nts.ContactPair(face(slave, 1), face(master, 0), **options)


def row(metre=1.0, friction=(0.0, 0.0, 0.0), gaps=(0.025, 0.015, 0.3), **options):
    """A thrown cube and three at rest, of different meshes so that slaves have a facet each."""
    starts, bodies = np.cumsum([0.0, *(1.0 + np.array(gaps))]), []
    for k, start in enumerate(starts):
        throw = {"velocity": (4.0 * metre, 1.0 * metre, 0.2 * metre)} if k == 0 else {}
        more = options if k == len(starts) - 1 else {}
        low = (start, -0.07 * k, -0.05 * k)
        bodies.append(cube(low, "abcd"[k], cells=2 + k % 2, metre=metre, **throw, **more))
    contacts = [
        pair(a, b, friction=mu) for a, b, mu in zip(bodies, bodies[1:], friction, strict=False)
    ]
    return nts.System(bodies, contacts=contacts)


def run(system, steps, *, sleep, integrator="energy-momentum", dt=DT, **newton):
    """Stepper after some steps, and of each which bodies were awake."""
    s = nts.Stepper(system, MID_STEP[integrator], newton=nts.Newton(**newton), sleep=sleep)
    awake = []
    for _ in range(steps):
        s.advance(dt)
        awake.append("".join(system.bodies[k].name for k in s.problem.awake))
    s.close()
    return s, awake


def both(make, steps, **options):
    """The same scene with and without sleep."""
    (a, awake), (b, _) = (run(make(), steps, sleep=on, **options) for on in (True, False))
    return a, b, awake


def largest(*values):
    return COMM.allreduce(max(float(np.abs(v).max(initial=0.0)) for v in values), op=MPI.MAX)


def assert_same(a, b, dt=DT):
    """To what the solver leaves of the positions, from which velocities follow over h/2."""
    top = largest(*b.state.u)
    for name, scale in (("u", 1.0), ("v", 0.5 * dt)):
        pairs = zip(getattr(a.state, name), getattr(b.state, name), strict=True)
        assert scale * largest(*(p - q for p, q in pairs)) <= 1e-12 * top
    one, two = a.solution.balance, b.solution.balance
    near = np.isfinite(two["min_gap"])
    assert np.array_equal(near, np.isfinite(one["min_gap"]))
    assert np.abs(one["min_gap"][near] - two["min_gap"][near]).max(initial=0.0) <= 1e-12 * top
    for name in ("kinetic", "potential", "external_work", "friction_dissipation",
                 "contact_defect", "ledger_residual"):  # fmt: skip
        assert np.abs(one[name] - two[name]).max() <= 1e-12 * two["energy"].max(), name
    for name in ("linear_momentum", "angular_momentum"):
        assert np.abs(one[name] - two[name]).max() <= 1e-12 * np.abs(two[name]).max(), name


# ---- a row of cubes
@pytest.mark.mpi
@pytest.mark.parametrize(
    "newton",
    [{}, {"condense": True, "linear_solver": "krylov", "reuse": True}],
    ids=["exact", "reuse"],
)
@pytest.mark.parametrize("integrator", MID_STEP)
@pytest.mark.slow
def test_cubes_sleep_until_they_are_reached(integrator, newton):
    a, b, awake = both(row, 12, integrator=integrator, **newton)
    assert awake[0] == "a" and awake[-1] == "abc" and sorted(awake) == awake
    assert {"a", "ab", "abc"} == set(awake)
    assert a.solution.balance["active"].max() > 4
    assert_same(a, b)
    assert not a.state.u[3].any() and not a.state.v[3].any()
    assert largest(a.state.u[2]) > 1e-4


@pytest.mark.mpi
@pytest.mark.slow
def test_friction_beside_a_sleeper():
    a, b, awake = both(lambda: row(friction=(0.1, 0.0, 0.2)), 8, condense=True)
    assert awake[-1] == "abc" and a.solution.balance["slip"].max() > 0
    assert_same(a, b)


@pytest.mark.mpi
@pytest.mark.parametrize(("reuse", "iterations"), [(False, 4), (True, 5)])
@pytest.mark.fast("True-5")
@pytest.mark.fast_on_ranks()
def test_a_step_that_fails_is_halved(reuse, iterations):
    """The impact takes more iterations than these.

    The next step would be cut into 300, whose velocities are 1e6 times the rounding of positions.
    """
    newton = {"max_iterations": iterations, "reuse": reuse, "linear_solver": "direct"}
    a, b, awake = both(lambda: row(friction=(0.2, 0.0, 0.0)), 4, **newton)
    assert a.solution.retries > 0 and b.solution.retries > 0
    assert "ab" in awake
    assert_same(a, b)


def test_what_failed_is_told_beside_sleepers():
    with pytest.raises(nts.StepFailedError, match="worst block"):
        run(row(), 9, sleep=True, max_iterations=1, max_retries=0)


# ---- what it costs
def count(body, names, calls):
    """Note the calls of a body's methods."""
    for name in names:
        method = getattr(body, name)

        def counted(*args, name=name, method=method):
            calls.append(name)
            return method(*args)

        setattr(body, name, counted)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_sleeper_is_neither_evaluated_nor_assembled_nor_searched(monkeypatch):
    system, calls = row(), []
    s = nts.Stepper(system, nts.EnergyMomentum(), sleep=True)
    s.start(DT)
    sleeper, searched, find = system.bodies[3], [], nts.FacetPair.find
    count(sleeper, ("internal", "tangent", "inertia", "potential"), calls)
    monkeypatch.setattr(
        nts.FacetPair, "find", lambda pair, *args: searched.append(pair) or find(pair, *args)
    )
    for _ in range(12):
        s.advance(DT)
        # Whether it rests is asked once.
        assert sorted(calls) == ["inertia", "internal", "potential", "tangent"]
        assert s.state.u[3] is s.problem.state.u[3] and 3 not in s.problem.awake
        assert searched.count(system.contacts[2]) <= 1 or 2 in s.problem.awake
    assert s.problem.awake == (0, 1, 2) and searched.count(system.contacts[0]) > 1
    fields = s.problem.laid.layout.counts.sum(axis=0)
    assert list(fields[:3]) == [COMM.allreduce(b.num_owned) for b in system.bodies[:3]]
    s.close()


@pytest.mark.mpi
def test_a_strained_body_between_its_supports_sleeps():
    """Its forces balance to rounding, and its energy counts."""

    def scene():
        bcs = [nts.Dirichlet(lambda x: x[0] < 3 + 1e-9, value=(0.0, 0.0, 0.0)),
               nts.Dirichlet(lambda x: x[0] > 4 - 1e-9, value=(-0.1, 0.0, 0.02))]  # fmt: skip
        return nts.System([cube((0, 0, 0), "a", velocity=(1, 0, 0)), cube((3, 0, 0), "b", bcs=bcs)])

    steppers, system = [], scene()
    settled = nts.equilibrium(system)
    strained = settled.balance["energy"][-1]
    for sleep in (True, False):
        s = nts.Stepper(system, nts.EnergyMomentum(), start=settled, sleep=sleep)
        for _ in range(5):
            s.advance(DT)
        assert s.problem.awake == ((0,) if sleep else (0, 1))
        assert np.array_equal(s.state.u[1], settled.state.u[1]) or not sleep
        steppers.append(s)
        s.close()
    assert strained > 10.0
    for s in steppers:
        assert s.solution.balance["potential"][-1] == pytest.approx(strained, rel=1e-12)
    assert_same(*steppers)


def test_where_all_sleep_one_keeps_watch():
    for sleep in (True, False):
        s = nts.Stepper(
            nts.System([cube((2 * k, 0, 0), name) for k, name in enumerate("ab")]),
            nts.EnergyMomentum(), sleep=sleep,
        )  # fmt: skip
        for _ in range(3):
            s.advance(DT)
        assert s.problem.awake == ((0,) if sleep else (0, 1))
        assert not s.solution.balance["newton_iterations"].any()
        assert not any(a.any() for a in (*s.state.u, *s.state.v))
        s.close()


@pytest.mark.mpi
def test_a_body_of_the_users_own_sleeps():
    def scene():
        flying = cube((0, 0, 0), "a", velocity=(1, 0, 0))
        return nts.System([PointMass(COMM, 2.0, (5, 0, 0), (0, 0, 0), name="m"), flying])

    a, b, awake = both(scene, 3)
    assert awake == ["a"] * 3
    assert_same(a, b)
    system = nts.System(scene().bodies, gravity=(0, 0, -9.81))
    assert run(system, 2, sleep=True)[1] == ["ma"] * 2


# ---- what wakes
def beside(**options):
    """A flying cube, and one at rest out of its reach."""
    return lambda: nts.System(
        [cube((0, 0, 0), "a", velocity=(1, 0, 0)), cube((3, 0, 0), "b", **options)]
    )


def right(x):
    return x[0] > 4 - 1e-9


STEPS = 6
#: First step in which something acts that begins with the fourth one.
BEGIN = 3 * DT
MOVERS = {
    "body force": {"body_force": (0, 0, -1.0)},
    "later body force": {"body_force": lambda t: (0, 0, -1e2 * max(t - BEGIN, 0.0))},
    "traction": {"traction": [nts.Traction(right, (0.1, 0, 0))]},
    "later traction": {"traction": [nts.Traction(right, lambda t: (1e2 * (t > BEGIN), 0, 0))]},
    "later support": {
        "bcs": [nts.Dirichlet(right, value=lambda t: (0, 0, max(t - BEGIN, 0.0) ** 2))]
    },
    "extra form": {
        "extra_form": lambda u, v, w, t: ufl.inner(ufl.as_vector((5.0, 0, 0)), w) * ufl.dx
    },
}


@pytest.mark.mpi
@pytest.mark.parametrize("name", MOVERS)
@pytest.mark.fast("later body force", "later traction", "later support", "extra form")
@pytest.mark.fast_on_ranks()
def test_loads_wake_in_the_step_in_which_they_act(name):
    a, b, awake = both(beside(**MOVERS[name]), STEPS)
    assert awake == (["a"] * 3 + ["ab"] * 3 if "later" in name else ["ab"] * STEPS)
    assert_same(a, b)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"bcs": [nts.Dirichlet(right)]}, "a"),
        ({"bcs": [nts.Dirichlet(lambda x: x[0] > 0, value=(0.3, 0.1, 0.7))], "cells": 1}, "a"),
        ({"extra_form": lambda u, v, w, t: 1e3 * ufl.inner(u + v, w) * ufl.dx}, "a"),
        ({"body_force": lambda t: (0, 0, 0)}, "a"),
    ],
    ids=["support", "held everywhere", "spring and damper", "force of zero"],
)
@pytest.mark.fast("support", "spring and damper")
@pytest.mark.fast_on_ranks("support")
def test_what_does_not_move_a_body_does_not_wake_it(options, expected):
    a, b, awake = both(beside(**options), 3, integrator="midpoint")
    assert awake == [expected] * 3
    assert_same(a, b)


def test_gravity_keeps_awake_what_can_fall():
    for bcs, expected in (((), "ab"), ([nts.Dirichlet(lambda x: x[0] > 0)], "a")):
        system = nts.System(beside(bcs=bcs, cells=1)().bodies, gravity=(0, 0, -9.81))
        assert run(system, 2, sleep=True)[1] == [expected] * 2


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP)
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_an_obstacle_wakes_what_it_reaches(integrator):
    """A wall that touches, and sets out later."""

    def scene():
        system = beside()()
        motion = lambda t: (-0.5 * max(t - BEGIN, 0.0), 0, 0)  # noqa: E731
        wall = nts.Plane((4, 0, 0), (-1, 0, 0), motion=motion)
        return nts.System(
            system.bodies, contacts=[nts.ContactPair(face(system.bodies[1], 1), wall)]
        )

    a, b, awake = both(scene, STEPS, integrator=integrator)
    assert awake == ["a"] * 3 + ["ab"] * 3
    assert a.solution.balance["active"].max() == 9
    assert_same(a, b)


def pushed(gap, force):
    """A body at rest, so that no motion is predicted, that a force brings to another in a step."""
    far = cube((-3, 0, 0), "c")
    mover = cube((0, 0, 0), "a", body_force=force)
    target = cube((1 + gap, -0.03, -0.02), "b", cells=3)
    return nts.System([mover, target, far], contacts=[pair(mover, target), pair(far, mover)])


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP)
@pytest.mark.fast("midpoint")
@pytest.mark.fast_on_ranks()
def test_a_motion_that_was_not_predicted_wakes_in_the_same_step(integrator):
    """The step is solved again with the sleeper, whose candidates were idle."""
    dt, gap = 0.02, 0.02
    s, awake = run(pushed(gap, (1.2e4, 0, 0)), 1, sleep=True, integrator=integrator, dt=dt)
    assert awake == ["ab"] and s.solution.rows[-1]["active"] > 0
    assert s.solution.rows[-1]["min_gap"] > -1e-10
    a, b, awake = both(lambda: pushed(gap, (1.2e4, 0, 0)), 3, integrator=integrator, dt=dt)
    assert_same(a, b, dt)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_motion_beyond_the_first_search_wakes_in_the_same_step():
    """Nothing at the start of the step tells how far the force will push."""
    dt, gap = 0.2, 0.2
    force = lambda t: (1.05 * gap * 1e2 / (0.5 * dt**2) * (t < dt), 0, 0)  # noqa: E731
    a, b, awake = both(lambda: pushed(gap, force), 2, dt=dt)
    assert awake == ["ab", "ab"]
    assert a.solution.balance["active"][1] > 0
    assert_same(a, b, dt)


# ---- the option
@pytest.mark.parametrize("wrong", [None, 1, "yes"])
def test_sleep_is_a_bool(wrong):
    system = nts.System([cube((0, 0, 0), "a")])
    for make in (
        lambda: nts.Stepper(system, nts.Midpoint(), sleep=wrong),
        lambda: nts.simulate(system, nts.Midpoint(), dt=DT, t_end=1.0, sleep=wrong),
    ):
        with pytest.raises(TypeError, match=f"sleep={wrong!r}: pass True or False"):
            make()


@pytest.mark.mpi
def test_a_material_that_changes_wakes():
    """A body at rest that swells as soon as a parameter of its energy says so."""

    def moved(sleep):
        mesh = box([0.0, 0.0, 0.0], [1.0, 1.0, 1.0], 2)
        swells, base = fem.Constant(mesh, 0.0), nts.StVenantKirchhoff(young=1e4, poisson=0.3)
        body = nts.Continuum(mesh, lambda c: base(c) - swells * ufl.tr(c), density=1e2)
        # The first of bodies that all rest stays awake.
        other = cube((5, 0, 0), "other")
        s = nts.Stepper(nts.System([other, body]), nts.Midpoint(), sleep=sleep)
        speeds = []
        for k in range(5):
            swells.value = 0.0 if k < 3 else 100.0
            s.advance(DT)
            speeds.append(largest(s.state.v[1]))
        s.close()
        return speeds

    right, found = moved(False), moved(True)
    assert found == pytest.approx(right, rel=1e-9, abs=1e-12) and right[-1] > 1e-3 > right[2]


@pytest.mark.mpi
@pytest.mark.parametrize("sleep", [True, False])
def test_a_sleeper_s_own_constraints_hold_at_the_start(sleep):
    """A rigid body at rest whose first director is too long, beside a body that flies."""
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [2, 2, 2], CellType.hexahedron)
    body = nts.RigidBody(mesh, density=1e3, name="a")
    if body.num_owned:
        body.initial_displacement = body.initial_displacement.copy()
        body.initial_displacement[3:6] = 0.05
    system = nts.System([body, cube((5, 0, 0), "other", velocity=(1.0, 0.0, 0.0))])
    with pytest.raises(ValueError, match="joints: at the start 'a directors' is off by"):
        nts.simulate(system, nts.EnergyMomentum(), dt=DT, t_end=DT, sleep=sleep)
