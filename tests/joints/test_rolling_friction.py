"""Rolling and spinning friction of contacts of rigid bodies against closed forms."""

from mpi4py import MPI

import numpy as np
import pytest
from cubes import about_z, turned
from dolfinx.mesh import CellType
from integrators import MID_STEP
from measures import STENCIL, differences
from scenes import box
from scipy.integrate import solve_ivp

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.parallel import together

COMM = MPI.COMM_WORLD
G, RADIUS = 9.81, 0.1
FLOOR = nts.Plane((0, 0, 0), (0, 0, 1))
DOWN = (0, 0, -G)
rules = pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)
pytestmark = pytest.mark.mpi


def mesh_of(cells, points, kind):
    if COMM.rank:
        cells, points = cells[:0], points[:0]
    return compat.create_mesh(COMM, cells.astype(np.int64), points, kind)


def wheel(facets, **options):
    """A ring about the y axis that stands on a facet, and its tread."""
    angle = 2 * np.pi / facets * (np.arange(facets) + 0.5) - 0.5 * np.pi
    low = RADIUS * np.cos(np.pi / facets)
    rims = [(y, r) for y in (0.0, 0.02) for r in (0.6 * RADIUS, RADIUS)]
    points = [(r * np.cos(a), y, r * np.sin(a) + low) for y, r in rims for a in angle]
    k = np.arange(facets)
    both = [n * facets + (k + step) % facets for n in range(4) for step in (0, 1)]
    cells = np.array([both[i] for i in (0, 2, 1, 3, 4, 6, 5, 7)]).T
    mesh = mesh_of(cells, np.array(points), "hexahedron")
    body = nts.RigidBody(mesh, density=1e3, name="wheel", **options)
    return body, body.surface(lambda x: np.hypot(x[0], x[2] - low) > 0.99 * RADIUS)


def block(name="block", low=0.0, width=0.2, **options):
    """0.1 high, about the z axis."""
    half = 0.5 * width
    mesh = box((-half, -half, low), (half, half, low + 0.1), (2, 2, 1), CellType.hexahedron, COMM)
    return nts.RigidBody(mesh, density=1e3, name=name, **options)


def at(body, height):
    return body.surface(lambda x: np.abs(x[2] - height) < 1e-9)


def pushed(body):
    """Moment of inertia about the contact over m r^2, of a wheel."""
    return 1.0 + body.moments.max() / (body.mass * RADIUS**2)


def assert_closed(run, energy=None):
    assert run.status == "completed"
    energy = run.balance["energy"].max() if energy is None else energy
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * energy


@rules
def test_spin_falls_in_a_line_and_ends(rule):
    """By mu m g/I, on nine nodes, to a rest that lasts; the law's column has all of it."""
    spin, arm, dt = 2.0, 0.004, 0.01
    body = block(angular_velocity=(0, 0, spin))
    pair = nts.ContactPair(at(body, 0.0), FLOOR)
    law = nts.RollingFriction(pair, spinning=arm)
    system = nts.System([body], contacts=[pair], joints=[law], gravity=DOWN)
    run = nts.simulate(system, rule, dt=dt, t_end=0.5)
    assert_closed(run)
    time, kinetic = (run.balance[name] for name in ("time", "kinetic"))
    inertia = body.mass * 2 * 0.2**2 / 12
    rate = arm * body.mass * G / inertia
    expected = 0.5 * inertia * np.maximum(spin - rate * time, 0.0) ** 2
    moving = time < spin / rate - dt
    assert kinetic[moving] == pytest.approx(expected[moving], abs=2e-4 * kinetic[0])
    # What the step in which it stops leaves turns to and fro.
    assert kinetic[~moving].max() < 0.5 * inertia * (rate * dt) ** 2
    taken = run.joint_works["friction_dissipation"][law.name]
    assert taken == pytest.approx(kinetic[0] - kinetic, abs=1e-10 * kinetic[0])


def test_what_rests_resists_in_equilibrium():
    """By the moment that turns it, up to its bound."""
    body = block(force=(0.0, 0.0, -2.0))
    assert body.mass == pytest.approx(4.0)
    twist = nts.Torque(body, None, axis=(0, 0, 1), torque=lambda *_: 0.9 * 0.004 * 2.0)
    pair = nts.ContactPair(at(body, 0.0), FLOOR)
    law = nts.RollingFriction(pair, spinning=0.004)
    system = nts.System([body], contacts=[pair], joints=[law, twist])
    run = nts.equilibrium(system, stabilization=0.1)
    assert run.status == "completed"
    moment = run.reactions[law.name][-1, 1]
    assert moment == pytest.approx((0, 0, -0.9 * 0.004 * 2.0), abs=1e-9)


@pytest.mark.parametrize("facets", [16, 48])
@pytest.mark.parametrize(("part", "rolls"), [(0.98, False), (1.02, True)])
def test_a_wheel_stays_on_a_slope_up_to_its_bound(facets, part, rolls):
    """The moment about the edge that it would tip over: m g (h sin - r sin(pi/n) cos) = mu N."""
    arm, edge = 0.05 * RADIUS, np.pi / facets
    slope = part * (arm + RADIUS * np.sin(edge)) / (RADIUS * np.cos(edge))
    body, tread = wheel(facets)
    pair = nts.ContactPair(tread, FLOOR, friction=2.0)
    law = nts.RollingFriction(pair, rolling=arm)
    gravity = G * np.array([slope, 0.0, -1.0]) / np.hypot(1.0, slope)
    system = nts.System([body], contacts=[pair], joints=[law], gravity=gravity)
    start = body.position.copy()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.2)
    weight = body.mass * G * RADIUS
    assert_closed(run, weight)
    way = np.linalg.norm(body.position - start)
    assert way > 1e-4 * RADIUS if rolls else way < 1e-10 * RADIUS
    if not rolls:
        # Both rows of nodes may press, so that the moment has a range.
        push = weight / np.hypot(1.0, slope)
        least = push * (slope * np.cos(edge) - np.sin(edge))
        moment = -run.mean_of_two_steps(run.reactions[law.name])[-1, 1, 1]
        assert least * (1 - 1e-6) <= moment <= arm / RADIUS * push * (1 + 1e-6)


@pytest.mark.slow
@pytest.mark.skipif(COMM.size > 1, reason="takes 50 s on two ranks")
def test_a_wheel_rolls_to_rest():
    """On a way of v^2/(2 a), a = mu g/(r (1 + I/(m r^2))), by mu N for each radian of it."""
    rule = MID_STEP["energy-momentum"]
    arm, turn, dt = 0.2 * RADIUS, 0.3, 1e-3
    still, _ = wheel(192)
    slows = arm * G / (RADIUS * pushed(still))
    speed = np.sqrt(2 * slows * RADIUS * turn)
    body, tread = wheel(192, velocity=(speed, 0, 0), angular_velocity=(0, speed / RADIUS, 0))
    pair = nts.ContactPair(tread, FLOOR, friction=1.0)
    law = nts.RollingFriction(pair, rolling=arm)
    system = nts.System([body], contacts=[pair], joints=[law], gravity=DOWN)
    start = body.position[0]
    run = nts.simulate(system, rule, dt=dt, t_end=1.1 * speed / slows)
    assert_closed(run)
    way = body.position[0] - start
    assert way == pytest.approx(RADIUS * turn, rel=0.02)
    taken = run.joint_works["friction_dissipation"][law.name][-1]
    assert taken == pytest.approx(arm * body.mass * G * way / RADIUS, rel=2e-3)
    time, push = run.balance["time"], run.balance["linear_momentum"][:, 0]
    half = np.searchsorted(time, 0.5 * speed / slows)
    assert push[half] / body.mass == pytest.approx(0.5 * speed, rel=0.05)
    assert np.abs(push[-3:]).max() < 2e-3 * push[0]


def leaning(lean):
    """A tetrahedron on its tip, whose axis leans; the mass centre is 3/4 of its height away."""
    angle = 2 * np.pi * np.arange(3) / 3
    top = [(0.05 * np.cos(a), 0.05 * np.sin(a), 0.4) for a in angle]
    c, s = np.cos(lean), np.sin(lean)
    points = np.array([(0, 0, 0), *top]) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    return nts.RigidBody(mesh_of(np.array([[0, 1, 2, 3]]), points, "tetrahedron"), density=1e3)


def falls(lean, arm, rule, dt, time):
    """Its lean after some time."""
    body = leaning(lean)
    pair = nts.ContactPair(body.surface(lambda x: x[2] < 1.0), FLOOR, friction=np.inf)
    law = nts.RollingFriction(pair, rolling=arm)
    system = nts.System([body], contacts=[pair], joints=[law], gravity=DOWN)
    run = nts.simulate(system, rule, dt=dt, t_end=time, accuracy="exact")
    assert_closed(run, body.mass * G * 0.3)
    x, _, z = body.position
    return np.arctan2(x, z), body


@rules
def test_a_tip_that_falls_to_the_second_order(rule):
    """(I + m L^2) a'' = m g L sin a - mu N, N = m (g - L (a'' sin a + a'^2 cos a)), integrated."""
    lean, arm, time = 0.5, 0.04, 0.24
    ends = [falls(lean, arm, rule, dt, time) for dt in (0.02, 0.01)]
    body, length = ends[0][1], 0.3
    mass, inertia = body.mass, body.moments.max()

    def motion(_, y):
        a, rate = y
        s, c = np.sin(a), np.cos(a)
        push = mass * (G * length * s - arm * (G - length * rate**2 * c))
        return rate, push / (inertia + mass * length * (length - arm * s))

    found = solve_ivp(motion, (0.0, time), (lean, 0.0), rtol=1e-10, atol=1e-12)
    coarse, fine = (abs(a - found.y[0, -1]) for a, _ in ends)
    assert fine < 2e-3 and coarse / fine == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize(("part", "stays"), [(0.98, True), (1.02, False)])
def test_a_tip_stays_up_to_its_bound(part, stays):
    """L sin a = mu."""
    arm = 0.04
    lean = np.arcsin(part * arm / 0.3)
    end, _ = falls(lean, arm, nts.EnergyMomentum(), 0.01, 0.2)
    assert abs(end - lean) < 1e-9 if stays else end - lean > 1e-3


@rules
def test_two_free_bodies_keep_momenta(rule):
    """A spring presses them; each turns the other till both turn alike."""
    spins = (0, 0, 3.0), (0, 0, -1.0)
    upper = block("upper", 0.1, 0.1, angular_velocity=spins[0], velocity=(0.2, 0, 0))
    lower = block("lower", 0.0, 0.3, angular_velocity=spins[1], velocity=(0.2, 0, 0))
    pair = nts.ContactPair(at(upper, 0.1), at(lower, 0.1))
    law = nts.RollingFriction(pair, rolling=0.01, spinning=2e-4)
    ends = [(0, 0, 0.15), (0, 0, 0.05)]
    spring = nts.Spring(upper, lower, ends, stiffness=1e3, length=0.05)
    system = nts.System([upper, lower], contacts=[pair], joints=[law, spring])
    run = nts.simulate(system, rule, dt=5e-3, t_end=0.1, accuracy="exact")
    balance = run.balance
    if rule is MID_STEP["energy-momentum"]:
        assert_closed(run)
    inertia = np.array([body.mass * 2 * w**2 / 12 for body, w in ((upper, 0.1), (lower, 0.3))])
    for name in ("linear_momentum", "angular_momentum"):
        moved = balance[name] - balance[name][0]
        assert np.abs(moved).max() < 1e-11 * np.abs(balance[name]).max()
    # 50 N press all the time.
    turned = np.outer((-0.01, 0.01) / inertia, balance["time"])
    rates = np.array([3.0, -1.0])[:, None] + turned
    assert (rates[0] > rates[1]).all()
    carried = 0.5 * (upper.mass + lower.mass) * 0.2**2
    expected = 0.5 * inertia @ rates**2 + carried
    assert balance["kinetic"] == pytest.approx(expected, rel=2e-4)


def test_edges_and_corners_press_too():
    """A beam across a beam: none of its nodes touches the other."""
    spin, arm = 1.0, 0.004
    beams = [
        turned(
            about_z(angle), (0, 0, z), name, size=(1.0, 0.1, 0.1), cells=1, kind=nts.RigidBody,
            angular_velocity=(0, 0, turn),
        )
        for name, angle, z, turn in (("lower", 0.0, 0.05, 0.0), ("upper", 80.0, 0.15, spin))
    ]  # fmt: skip
    lower, upper = beams
    pair = nts.ContactPair(at(upper, 0.1), at(lower, 0.1))
    law = nts.RollingFriction(pair, spinning=arm)
    base = nts.Fixed(lower, None, point=(0, 0, 0))
    system = nts.System(beams, contacts=[pair], joints=[base, law], gravity=DOWN)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.1)
    assert_closed(run)
    inertia = upper.mass * (1.0**2 + 0.1**2) / 12
    rate = spin - arm * upper.mass * G / inertia * run.balance["time"]
    assert run.balance["kinetic"] == pytest.approx(0.5 * inertia * rate**2, rel=1e-3)


def test_without_contact_there_is_no_moment():
    """A block that is thrown up turns on, whatever its axis."""
    body = block(low=0.01, velocity=(0, 0, 1.0), angular_velocity=(1, 2, 3))
    pair = nts.ContactPair(at(body, 0.01), FLOOR)
    law = nts.RollingFriction(pair, rolling=0.1, spinning=0.1)
    run = nts.simulate(
        nts.System([body], contacts=[pair], joints=[law]), nts.EnergyMomentum(), dt=0.01, t_end=0.1
    )
    assert_closed(run)
    assert not run.balance["friction_dissipation"].any()
    assert not np.abs(run.reactions[law.name][1:]).any()
    kinetic = run.balance["kinetic"]
    assert kinetic == pytest.approx(kinetic[0], rel=1e-12)


def pressed(rule):
    """A step problem of a block on a floor at an iterate away from its solution."""
    body = block(angular_velocity=(0.3, 0.2, 0.5))
    pair = nts.ContactPair(at(body, 0.0), FLOOR, friction=0.3)
    law = nts.RollingFriction(pair, rolling=0.003, spinning=0.002)
    system = nts.System([body], contacts=[pair], joints=[law], gravity=DOWN)
    stepper = nts.Stepper(system, rule)
    stepper.problem.begin(stepper.state, 0.01)
    rng, problem = np.random.default_rng(COMM.rank), stepper.problem
    with problem.x as x:
        x[:] += 0.02 * rng.uniform(-1, 1, len(x))
        multipliers = problem.laid.of_elements("constraints")
        x[multipliers] = -0.02 - 0.01 * rng.uniform(0, 1, multipliers.stop - multipliers.start)
    return stepper, problem, law


@rules
def test_matrix_is_the_derivative_of_the_residual(rule):
    """Also by the multipliers of all nodes, on any number of ranks."""
    stepper, problem, law = pressed(rule)
    x, step = problem.x.array_r.copy(), 1e-6
    rng = np.random.default_rng(100 + COMM.rank)
    direction, product = problem.x.duplicate(), problem.x.duplicate()
    stepper.solver.assemble(problem.evaluate(problem.x))

    def residual(values):
        direction.array_w[:] = values
        return problem.residual(problem.evaluate(direction))

    bodies, multipliers = problem.laid.of_body(0), problem.laid.of_elements("constraints")
    # Rows of contact lend compliances, which depend on what is missed.
    (batch,) = (e for e in problem.elements if e.name == law.name)
    rows = np.r_[bodies, multipliers.stop - 3 * batch.num_elements : multipliers.stop]
    for here in (bodies, multipliers):
        p = np.zeros(len(x))
        p[here] = rng.uniform(-1, 1, here.stop - here.start)
        expected = sum(w / step * residual(x + k * step * p) for k, w in STENCIL)
        direction.array_w[:] = p
        stepper.solver.matrix.operator.mult(direction, product)
        error = np.abs(product.array_r - expected)[rows].max(initial=0.0)
        top = COMM.allreduce(np.abs(expected[rows]).max(initial=0.0), op=MPI.MAX)
        assert error < 1e-6 * top
    for vector in (direction, product):
        vector.destroy()
    stepper.close()


@rules
@pytest.mark.parametrize("load", [1e-3, 1e3])
def test_tangent_is_the_derivative_of_the_element(rule, load):
    """Of both groups that slip, and that stick; the load on three nodes' multipliers."""
    stepper, problem, law = pressed(rule)
    (batch,) = (e for e in problem.elements if e.name == law.name)
    rng, size, m = np.random.default_rng(3), batch.num_coordinates, 3
    x = batch.y0 + 0.05 * rng.normal(size=batch.y0.shape)
    by_unknowns = load * np.tile([-1.0, -2.0, -0.5], (len(x), 1))

    def evaluated(z):
        told = {
            "load": (by_unknowns * z[:, size + m :]).sum(keepdims=True)[0],
            "constraints": z[:, size : size + m], "by_unknowns": by_unknowns,
            "spread": np.array(0.0), "normal": np.array([0.6, 0.0, 0.8]),
        }  # fmt: skip
        (part,) = together(MPI.COMM_SELF, [batch.evaluate(z[:, :size].reshape(x.shape), told)])
        return part

    if len(x):
        own = np.concatenate([rng.normal(scale=0.05, size=m), -rng.uniform(size=3)])
        z = np.hstack([x.reshape(1, size), own[None]])
        found = evaluated(z)
        assert found.status.shape == (2, 1) and (found.status == (load > 1.0)).all()
        expected = differences(lambda y: evaluated(y).residual, z, 1e-6)
        assert np.abs(found.tangent[:, : size + m] - expected).max() < 1e-6 * np.abs(expected).max()
    stepper.close()


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
@pytest.mark.parametrize("radius, told", [(0.8, True), (2.0, False)])
def test_a_contact_without_one_normal_is_told(radius, told):
    """A cube lies in a hollow cylinder on two edges, with normals 2 asin(1/2r) apart."""
    mesh = box((-0.5, -0.5, 0), (0.5, 0.5, 1), (1, 1, 1), CellType.hexahedron, COMM)
    body = nts.RigidBody(mesh, density=1e3, name="cube")
    hollow = nts.Cylinder((0, 0, np.sqrt(radius**2 - 0.25)), (0, 1, 0), radius, inside=True)
    pair = nts.ContactPair(at(body, 0.0), hollow)
    law = nts.RollingFriction(pair, rolling=1e-3)
    system = nts.System([body], contacts=[pair], joints=[law], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=5e-3, progress=False)
    assert ("several normals" in run.warnings) is told
    if told:
        spread = 0.25 / (radius**2 - 0.25)
        assert run.warnings["several normals"].worst == pytest.approx(spread, rel=1e-3)


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"pair": 3, "rolling": 1e-3}, TypeError, "pair=3: pass a ContactPair"),
        ({}, ValueError, "pass a length above 0"),
        ({"rolling": -1.0}, ValueError, "rolling=-1.0: pass a length >= 0"),
        ({"spinning": np.inf}, ValueError, "spinning=inf: pass a length >= 0"),
    ],
)
def test_bad_input(options, error, text):
    body = block()
    options = {"pair": nts.ContactPair(at(body, 0.0), FLOOR)} | options
    with pytest.raises(error, match=text):
        nts.RollingFriction(options.pop("pair"), **options)


def test_bodies_are_rigid_and_the_contact_is_the_systems():
    body = block()
    pair = nts.ContactPair(at(body, 0.0), FLOOR)
    law = nts.RollingFriction(pair, rolling=1e-3)
    with pytest.raises(ValueError, match="is not among contacts; add it"):
        nts.System([body], joints=[law])
    mesh = box((0, 0, 0), (1, 1, 1), (1, 1, 1), CellType.hexahedron, COMM)
    soft = nts.Continuum(mesh, nts.NeoHookean(1e5, 0.3), density=1e3, name="soft")
    with pytest.raises(ValueError, match="'soft' may deform"):
        nts.RollingFriction(nts.ContactPair(at(soft, 0.0), FLOOR), rolling=1e-3)
