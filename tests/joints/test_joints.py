"""Joints: what they hold, what they leave free, what their drives cost, and mechanisms of them."""

import itertools

from mpi4py import MPI

import numpy as np
import pytest
from scenes import UNITS, box
from scipy.integrate import solve_ivp

import dolfinx_nts as nts
from dolfinx_nts.equations import least_norm

COMM = MPI.COMM_WORLD
N = np.array([2.0, -1.0, 2.0]) / 3.0
M1 = np.array([1.0, 2.0, 0.0]) / np.sqrt(5.0)
M2 = np.cross(N, M1)
P = np.array([0.3, 0.2, -0.1])
Q = np.array([0.5, 0.8, 0.4])
Z = np.array([0.0, 0.0, 1.0])


def brick(name, centre, moving=None, turning=(0.0, 0.0, 0.0), mass=2.0, **options):
    """A body of uneven inertia; `moving` is its velocity at the origin [m/s]."""
    centre = np.asarray(centre, dtype=float)
    v = np.zeros(3) if moving is None else moving + np.cross(turning, centre)
    moments = mass * np.array([0.05, 0.08, 0.1])
    axes = np.column_stack([M1, M2, N])
    return nts.RigidBody.from_inertia(
        mass, moments, centre, axes, velocity=v, angular_velocity=turning, name=name, **options
    )


def rod(name, p, q, at_p=(0.0, 0.0, 0.0), at_q=(0.0, 0.0, 0.0), mass=1.0, thick=0.0):
    """A rod between two points with these velocities; no inertia about its axis unless thick."""
    p, q, at_p, at_q = (np.asarray(a, dtype=float) for a in (p, q, at_p, at_q))
    along, inertia = q - p, mass * (q - p) @ (q - p) / 12.0
    t = along / np.linalg.norm(along)
    n = np.eye(3)[np.abs(t).argmin()]
    n = np.cross(t, n) / np.linalg.norm(np.cross(t, n))
    axes = np.column_stack([t, n, np.cross(t, n)])
    return nts.RigidBody.from_inertia(
        mass, (thick * inertia, inertia, inertia), 0.5 * (p + q), axes, name=name,
        velocity=0.5 * (at_p + at_q),
        angular_velocity=np.cross(along, at_q - at_p) / (along @ along),
    )  # fmt: skip


class Follow:
    """Where points and directions of the start are now."""

    def __init__(self, *bodies):
        self.start = {b.name: (b.position.copy(), b.rotation.copy()) for b in bodies}

    def turn(self, body):
        return body.rotation @ self.start[body.name][1].T

    def point(self, body, x):
        return body.position + self.turn(body) @ (x - self.start[body.name][0])


JOINTS = {
    # Constructor, further velocity and angular velocity of a at P, number of constraints.
    "spherical": (lambda a, b: nts.Spherical(a, b, point=P), (0, 0, 0), (1, 2, 3), 3),
    "revolute": (lambda a, b: nts.Revolute(a, b, point=P, axis=5 * N), (0, 0, 0), 3 * N, 5),
    "cylindrical": (lambda a, b: nts.Cylindrical(a, b, point=P, axis=N), 0.5 * N, 3 * N, 4),
    "prismatic": (lambda a, b: nts.Prismatic(a, b, point=P, axis=N), 0.5 * N, (0, 0, 0), 5),
    "planar": (lambda a, b: nts.Planar(a, b, point=P, axis=N), 0.4 * M1 - M2, 2 * N, 3),
    "universal": (
        lambda a, b: nts.Universal(a, b, point=P, axes=(N, M1)), (0, 0, 0), 2 * N - 3 * M1, 4,
    ),
    "fixed": (lambda a, b: nts.Fixed(a, b, point=P), (0, 0, 0), (0, 0, 0), 6),
    "distance": (lambda a, b: nts.Distance(a, b, points=(P, Q)), np.cross(Q - P, N), 2 * M2, 1),
}  # fmt: skip


def held(kind, f, a, b):
    """What a joint holds at 0 [-, m], from positions and rotations alone."""
    p_a, p_b = f.point(a, P), f.point(b, P)
    n_a, m_a, k_a = (f.turn(a) @ d for d in (N, M1, M2))
    n_b, m_b, k_b = (f.turn(b) @ d for d in (N, M1, M2))
    parallel, meet = np.cross(n_a, n_b), p_a - p_b
    return {
        "spherical": lambda: meet,
        "revolute": lambda: [*meet, *parallel],
        "cylindrical": lambda: [*np.cross(n_a, meet), *parallel],
        "prismatic": lambda: [*np.cross(n_a, meet), *parallel, *(m_a - m_b)],
        "planar": lambda: [n_a @ meet, *parallel],
        "universal": lambda: [*meet, n_a @ m_b],
        "fixed": lambda: [*meet, *parallel, *(m_a - m_b), *(k_a - k_b)],
        "distance": lambda: [np.linalg.norm(p_a - f.point(b, Q)) - np.linalg.norm(P - Q)],
    }[kind]()


def left_free(kind, f, a, b):
    """What a joint must let go [-, m]."""
    meet, m_a, m_b = f.point(a, P) - f.point(b, P), f.turn(a) @ M1, f.turn(b) @ M1
    turned = f.turn(a).T @ f.turn(b) - np.eye(3)
    return {
        "spherical": [turned[0, 1], turned[1, 2], turned[2, 0]],
        "revolute": [np.cross(m_a, m_b) @ f.turn(a) @ N],
        "cylindrical": [np.cross(m_a, m_b) @ f.turn(a) @ N, meet @ f.turn(a) @ N],
        "prismatic": [meet @ f.turn(a) @ N],
        "planar": [meet @ m_a, meet @ f.turn(a) @ M2, np.cross(m_a, m_b) @ f.turn(a) @ N],
        "universal": [turned[0, 1], turned[1, 2]],
        "fixed": [1.0],
        "distance": [turned[0, 1], turned[1, 2], turned[2, 0]],
    }[kind]


def pair(kind):
    """Two bodies that tumble, and move against each other as their joint lets them."""
    make, u, w, count = JOINTS[kind]
    v, turning = np.array([0.5, 0.2, -0.4]), np.array([1.0, -2.0, 1.5])
    b = brick("b", (0.6, 0.5, 0.3), v, turning)
    a = brick(
        "a", (0.1, -0.1, 0.2), v + u - np.cross(w, P), turning + np.array(w, dtype=float), mass=3.0
    )
    return a, b, make(a, b), count


@pytest.mark.mpi
@pytest.mark.parametrize("kind", JOINTS)
@pytest.mark.fast("universal")
@pytest.mark.fast_on_ranks()
def test_a_tumbling_pair(kind):
    """Joint, energy and both momenta over 100 steps."""
    a, b, joint, count = pair(kind)
    system = nts.System([a, b], joints=[joint])
    f, worst, moved = Follow(a, b), 0.0, np.zeros(len(left_free(kind, Follow(a, b), a, b)))
    stepper = nts.Stepper(system, nts.Midpoint() if kind == "planar" else nts.EnergyMomentum())
    for _ in range(100):
        state = stepper.advance(5e-3)
        worst = max(worst, np.abs(held(kind, f, a, b)).max())
        moved = np.maximum(moved, np.abs(left_free(kind, f, a, b)))
    assert worst < 1e-12
    assert (moved > 0.05).all()
    table = stepper.solution.balance
    energy = table["energy"]
    assert np.abs(energy - energy[0]).max() < 1e-11 * energy[0]
    for name in ("linear_momentum", "angular_momentum"):
        size = np.abs(table[name]).max()
        assert np.abs(table[name] - table[name][0]).max() < 1e-12 * size
    assert COMM.allreduce(state.joints[0].size) == count
    stepper.close()


@pytest.mark.parametrize("kind", JOINTS)
def test_tangent_against_differences(kind):
    a, b, joint, _ = pair(kind)
    stepper = nts.Stepper(nts.System([a, b], joints=[joint]), nts.EnergyMomentum())
    stepper.advance(5e-2)
    for batch in stepper.problem.elements:
        rng, n, c = np.random.default_rng(3), batch.num_elements, batch.num_coordinates
        x = batch.reference() + 0.1 * rng.standard_normal((n, c // 3, 3))
        own = rng.standard_normal((n, batch.widths["constraints"]))

        def residual(z, batch=batch, n=n, c=c):
            x = z[:, :c].reshape(n, c // 3, 3)
            return batch.evaluate(x, {"constraints": z[:, c:]}).residual

        z = np.concatenate([x.reshape(n, c), own], axis=1)
        tangent = batch.evaluate(x, {"constraints": own}).tangent
        # What the matrix lends to multipliers is no derivative.
        tangent[:, c:, c:] = 0.0
        steps = 1e-3 * np.eye(z.shape[1])
        found = np.stack([(residual(z + d) - residual(z - d)) / 2e-3 for d in steps], axis=2)
        assert np.abs(found - tangent).max() < 1e-11 * np.abs(tangent).max()
        assert not tangent[:, ~batch.entries].any()
    stepper.close()


@pytest.mark.parametrize("angle", [None, lambda t: 100.0 * t**2])
def test_entries_that_are_zero_at_the_start_may_not_stay_so(angle):
    """A hinge along z at rest in the axes of the frame, which then turns by a radian."""
    wheel = nts.RigidBody.from_inertia(2.0, (0.1, 0.2, 0.3), (1.0, 0.0, 0.0), name="wheel")
    hinge = nts.Revolute(wheel, None, point=(0, 0, 0), axis=(0, 0, 1), angle=angle)
    system = nts.System([wheel], joints=[hinge], gravity=(0.0, -400.0, 0.0))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    free = []
    for _ in range(5):
        stepper.advance(2e-2)
        for batch in stepper.problem.elements:
            y = batch.reference() + np.random.default_rng(5).standard_normal((1, 4, 3))
            own = {"constraints": np.ones((1, batch.widths["constraints"]))}
            tangent = batch.evaluate(y, own).tangent
            assert not tangent[:, ~batch.entries].any()
            free.append((~batch.entries).mean())
    # About half of the entries can never be anything, unless the hinge is driven.
    assert max(free) > 0.4
    stepper.close()


# ---- a heavy top
def heavy_top(dt, integrator, unit=1.0):
    """Cone in steady precession at 10 rad/s, 60 degrees; error at 0.5 s over the centre's distance.

    Args:
        dt: Step [s].
        integrator: The integrator.
        unit: Of length, per metre.
    """
    height, radius, precession, angle, g = 0.1 * unit, 0.05 * unit, 10.0, np.pi / 3, 9.81 * unit
    mass, far = 2700.0 * np.pi * radius**2 * height / unit**3 / 3.0, 0.75 * height
    about = 0.3 * mass * radius**2
    across = mass * (3 / 20 * radius**2 + 3 / 80 * height**2)
    tip = across + mass * far**2
    spin = (mass * g * far + tip * precession**2 * np.cos(angle)) / (about * precession)
    e = np.array([np.sin(angle), 0.0, np.cos(angle)])
    turning = precession * Z + (spin - precession * np.cos(angle)) * e
    y = np.array([0.0, 1.0, 0.0])
    top = nts.RigidBody.from_inertia(
        mass, (across, across, about), far * e, np.column_stack([np.cross(y, e), y, e]),
        velocity=np.cross(turning, far * e), angular_velocity=turning, name="top",
    )  # fmt: skip
    system = nts.System(
        [top], joints=[nts.Spherical(top, None, point=(0, 0, 0))], gravity=(0, 0, -g)
    )
    run = nts.simulate(system, integrator, dt=dt, t_end=0.5)
    assert run.status == "completed"
    turned = precession * 0.5
    right = np.sin(angle) * np.array([np.cos(turned), np.sin(turned), 0.0]) + np.cos(angle) * Z
    return np.linalg.norm(top.position / far - right), run.balance


# ---- pendulums of two rods, mass 1 and 2, length 1 and 0.7
M_A, M_B, L_A, L_B, G = 1.0, 2.0, 1.0, 0.7, 9.81
TIMES = (1e-2, 5e-3, 2.5e-3)


def hang(kind, e_a, e_b, v_a, v_b):
    """Two rods along unit vectors that change with these rates, from the origin."""
    knee, foot = L_A * e_a, L_A * e_a + L_B * e_b
    a = rod("a", (0, 0, 0), knee, (0, 0, 0), L_A * v_a, M_A)
    b = rod("b", knee, foot, L_A * v_a, L_A * v_a + L_B * v_b, M_B)
    joints = [kind(a, None, point=(0, 0, 0)), kind(a, b, point=knee)]
    return nts.System([a, b], joints=joints, gravity=(0, 0, -G)), a, b


def vectors_of(s, right, t):
    """Solve an ordinary differential equation to 1e-12."""
    found = solve_ivp(right, (0.0, t), s, method="DOP853", rtol=1e-12, atol=1e-13)
    return found.y[:, -1]


def check_order(errors):
    assert abs(np.log2(errors[1] / errors[2]) - 2.0) < 0.1
    assert errors[2] < 1e-3


@pytest.mark.slow
def test_a_double_pendulum_in_a_plane():
    """Revolute joints of rods, against the two angles."""
    a11, a12, a22 = (M_A / 3 + M_B) * L_A**2, M_B * L_A * L_B / 2, M_B * L_B**2 / 3

    def right(_, s):
        (p, q), w = s[:2], s[2:]
        c, d = np.cos(p - q), np.sin(p - q)
        mass = np.array([[a11, a12 * c], [a12 * c, a22]])
        force = np.array([
            -a12 * d * w[1] ** 2 - (M_A / 2 + M_B) * G * L_A * np.sin(p),
            a12 * d * w[0] ** 2 - M_B * G * L_B / 2 * np.sin(q),
        ])  # fmt: skip
        return np.concatenate([w, np.linalg.solve(mass, force)])

    start = np.array([2.0, 1.0, 0.5, -1.0])
    end = vectors_of(start, right, 0.5)

    def along(angle):
        return np.array([np.sin(angle), 0.0, -np.cos(angle)])

    def rate(angle, speed):
        return speed * np.array([np.cos(angle), 0.0, np.sin(angle)])

    right_b = L_A * along(end[0]) + 0.5 * L_B * along(end[1])
    errors = []
    for dt in TIMES:
        system, _, b = hang(
            lambda *ends, point: nts.Revolute(*ends, point=point, axis=(0, 1, 0)),
            *map(along, start[:2]), *map(rate, start[:2], start[2:]),
        )  # fmt: skip
        run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=0.5)
        errors.append(np.linalg.norm(b.position - right_b))
        table = run.balance
        assert run.status == "completed"
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["kinetic"].max()
        assert abs(b.position[1]) < 1e-13
    check_order(errors)


@pytest.mark.slow
def test_a_double_pendulum_in_space():
    """Spherical joints of rods, against the rods' unit vectors with their accelerations solved."""
    a11, a12, a22 = (M_A / 3 + M_B) * L_A**2, M_B * L_A * L_B / 2, M_B * L_B**2 / 3
    weights = -G * np.array([(M_A / 2 + M_B) * L_A, M_B * L_B / 2])

    def right(_, s):
        e, v = s[:6].reshape(2, 3), s[6:].reshape(2, 3)
        k, r = np.zeros((8, 8)), np.zeros(8)
        k[:6, :6] = np.kron([[a11, a12], [a12, a22]], np.eye(3))
        r[:6] = np.outer(weights, Z).ravel()
        for i in range(2):
            k[6 + i, 3 * i : 3 * i + 3] = k[3 * i : 3 * i + 3, 6 + i] = e[i]
            r[6 + i] = -v[i] @ v[i]
        return np.concatenate([s[6:], np.linalg.solve(k, r)[:6]])

    e = np.array([[0.6, 0.0, -0.8], [0.0, 0.8, 0.6]])
    v = np.array([[0.8, 1.0, 0.6], [2.0, -0.6, 0.8]])
    end = vectors_of(np.concatenate([e, v]).ravel(), right, 0.5)
    right_b = L_A * end[:3] + 0.5 * L_B * end[3:6]
    errors = []
    for dt in TIMES:
        system, _, b = hang(nts.Spherical, *e, *v)
        run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=0.5)
        errors.append(np.linalg.norm(b.position - right_b))
        table = run.balance
        assert run.status == "completed"
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["kinetic"].max()
    check_order(errors)


# ---- closed loops
def corner(b, d, to_b, to_d):
    """The point of the plane z = 0 at these distances from b and d, left of the way between."""
    way = np.linalg.norm(d - b)
    x = (way**2 + to_b**2 - to_d**2) / (2.0 * way)
    e = (d - b) / way
    return b + x * e + np.sqrt(to_b**2 - x**2) * np.cross(Z, e)


CRANK, COUPLER, ROCKER = 0.3, 1.0, 0.6
FAR = np.array([0.9, 0.0, 0.0])


def tip(angle):
    return CRANK * np.array([np.cos(angle), np.sin(angle), 0.0])


@pytest.mark.parametrize("thick", [0.0, pytest.param(0.1, marks=pytest.mark.mpi)])
@pytest.mark.slow
def test_a_planar_four_bar_with_four_revolutes(thick):
    """Three equations repeat others: solved, on the closed kinematics, of order 2."""
    angles = []
    for dt in (1e-2, 5e-3, 2.5e-3):
        b = tip(1.0)
        c = corner(b, FAR, COUPLER, ROCKER)
        v_b = 5.0 * np.cross(Z, b)
        ways = np.column_stack([np.cross(Z, c - b), -np.cross(Z, c - FAR)])[:2]
        _, swing = np.linalg.solve(ways, -v_b[:2])
        v_c = swing * np.cross(Z, c - FAR)
        bars = [
            rod("crank", (0, 0, 0), b, (0, 0, 0), v_b, thick=thick),
            rod("coupler", b, c, v_b, v_c, thick=thick),
            rod("rocker", c, FAR, v_c, (0, 0, 0), thick=thick),
        ]
        ends = itertools.pairwise([None, *bars, None])
        joints = [
            nts.Revolute(one, other, point=p, axis=Z, name=f"hinge {k}")
            for k, ((one, other), p) in enumerate(zip(ends, (0 * b, b, c, FAR), strict=True))
        ]
        run = nts.simulate(nts.System(bars, joints=joints), nts.EnergyMomentum(), dt=dt, t_end=0.25)
        assert run.status == "completed"
        table = run.balance
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
        crank, coupler, rocker = (bar.position for bar in bars)
        angles.append(np.arctan2(crank[1], crank[0]))
        now = corner(tip(angles[-1]), FAR, COUPLER, ROCKER)
        assert np.abs(2.0 * crank - tip(angles[-1])).max() < 1e-12
        assert np.abs(2.0 * coupler - tip(angles[-1]) - now).max() < 1e-12
        assert np.abs(2.0 * rocker - now - FAR).max() < 1e-12
    ratio = (angles[0] - angles[1]) / (angles[1] - angles[2])
    assert abs(np.log2(ratio) - 2.0) < 0.1


CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1), (0, 0, 1)], dtype=float)
HINGES = np.array([(0, 1, 0), (0, 0, 1), (1, 0, 0)] * 2, dtype=float)


def bricard(masses=(1.0,) * 5, **options):
    """Six hinges along the edges of a cube: mobile though counting says it is not."""
    bars = [
        rod(f"bar {i}", CORNERS[i], CORNERS[i + 1], mass=m, **options) for i, m in enumerate(masses)
    ]
    ends = itertools.pairwise([None, *bars, None])
    joints = [
        nts.Revolute(*pair, point=p, axis=n, name=f"hinge {i}")
        for i, (pair, p, n) in enumerate(zip(ends, CORNERS, HINGES, strict=True))
    ]
    return nts.System(bars, joints=joints, gravity=(0, -G, 0)), bars


def force_columns(stepper):
    """Columns of all constraints in the forces of the last step, and their multipliers [N]."""
    system, columns, multipliers = stepper.system, [], []
    step = stepper.problem.couplings.joints[0][0].step
    joints = zip(system.joints, system.joint_bodies, stepper.state.joints, strict=True)
    for joint, bodies, found in joints:
        alone = joint.coupling(bodies)
        alone.begin(step, None, None, False)
        (batch,) = alone.elements
        u1 = [stepper.state.u[b].reshape(1, 4, 3) for b in bodies]
        x = batch.reference() + np.concatenate(u1, axis=1)
        c = batch.num_coordinates
        slopes = batch.evaluate(x, {"constraints": np.zeros_like(found)}).tangent[0, :c, c:]
        column = np.zeros((12 * len(system.bodies), found.size))
        for k, b in enumerate(bodies):
            column[12 * b : 12 * b + 12] = slopes[12 * k : 12 * k + 12] / batch.scale[0]
        columns.append(column)
        multipliers.append(found[0])
    return np.concatenate(columns, axis=1), np.concatenate(multipliers)


@pytest.mark.slow
def test_a_bricard_mechanism():
    """One equation repeats others in another way at each time: order 2, and its closure."""
    ways = []
    for dt in (1e-2, 5e-3, 2.5e-3):
        system, bars = bricard((1, 10, 100, 10, 1), thick=0.1)
        start = [bar.rotation.copy() for bar in bars]
        stepper = nts.Stepper(system, nts.EnergyMomentum())
        for _ in range(round(0.5 / dt)):
            stepper.advance(dt)
        ways.append(np.array([bar.position for bar in bars]))
        table = stepper.solution.balance
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["kinetic"].max()
        # Every other hinge turns alike, by x and y: sin x - sin y + sin x sin y = 0.
        turns = [np.eye(3), *(b.rotation @ s.T for b, s in zip(bars, start, strict=True))]
        sines = []
        for n, one, other in zip(HINGES, turns, [*turns[1:], np.eye(3)], strict=True):
            m = np.roll(n, 1)
            assert np.abs((one - other) @ n).max() < 1e-12
            sines.append(abs(np.cross(one @ m, other @ m) @ one @ n))
        x, y = sines[:2]
        assert x > 0.2 and np.abs(np.array(sines) - 3 * [x, y]).max() < 1e-12
        assert abs(x - y + x * y) < 1e-12
        # What repeats others has one multiplier too many; all are those of least norm.
        columns, found = force_columns(stepper)
        least = np.linalg.lstsq(columns, columns @ found, rcond=1e-9)[0]
        assert np.linalg.matrix_rank(columns, tol=1e-9) == len(found) - 1
        assert np.abs(found - least).max() < 1e-12 * np.abs(least).max()
        stepper.close()
    ratio = np.abs(ways[0] - ways[1]).max() / np.abs(ways[1] - ways[2]).max()
    assert abs(np.log2(ratio) - 2.0) < 0.1


def test_forces_that_are_not_of_least_norm_are_told(monkeypatch, caplog):
    """Of too few iterations of the least squares."""
    monkeypatch.setattr(least_norm, "_ITERATIONS", 1e-3)
    system, _ = bricard(thick=0.1)
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    stepper.advance(1e-2)
    stepper.close()
    assert "those of least norm are not found" in caplog.text


# ---- prescribed motion
def drive(kind, f):
    """A brick that its joint with the ground moves."""
    body = brick("body", (0.4, 0.1, 0.2))
    made = {
        "spherical": lambda: nts.Spherical(body, None, point=P, displacement=lambda t: f(t) * M1),
        "revolute": lambda: nts.Revolute(body, None, point=P, axis=N, angle=f),
        "prismatic": lambda: nts.Prismatic(body, None, point=P, axis=N, displacement=f),
        "distance": lambda: nts.Distance(
            body, None, points=(P, Q), length=lambda t: np.linalg.norm(P - Q) + f(t)
        ),
    }
    return body, made[kind]()


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["spherical", "revolute", "prismatic", "distance"])
@pytest.mark.fast("prismatic")
@pytest.mark.fast_on_ranks()
def test_a_drive(kind):
    """It goes where it is told, also over many turns, and the ledger knows its work."""
    speed = 12.0 if kind == "revolute" else 0.3

    def f(t):
        return speed * t**2

    body, joint = drive(kind, f)
    follow, stepper = Follow(body), nts.Stepper(nts.System([body], joints=[joint]),
                                                nts.EnergyMomentum())  # fmt: skip
    for _ in range(75):
        t = stepper.advance(2e-2).time
        p, turn = follow.point(body, P), follow.turn(body)
        if kind == "revolute":
            right = np.cos(f(t)) * M1 + np.sin(f(t)) * M2
            assert np.abs([p - P, turn @ N - N, turn @ M1 - right]).max() < 1e-12
        elif kind == "distance":
            assert abs(np.linalg.norm(p - Q) - np.linalg.norm(P - Q) - f(t)) < 1e-12
        else:
            assert np.abs(p - P - f(t) * (M1 if kind == "spherical" else N)).max() < 1e-12
    table = stepper.solution.balance
    assert table["kinetic"][-1] > 0.1
    size = np.abs(table["external_work"]).max()
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * size
    stepper.close()


# ---- flexible bodies
def cube(low, name, cells=2, **options):
    low = np.asarray(low, dtype=float)
    mesh = box(low, low + 1.0, cells)
    return nts.Continuum(mesh, nts.NeoHookean(1e5, 0.3), density=1.0, name=name, **options)


def at(body, x):
    """Where a material point of a flexible body is."""
    points = body.points(x)
    return points.combine(points.reference)[0] + points.at(body.u.x.array[: body.num_owned])[0]


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_points_of_a_flexible_body():
    """A cube on a ball joint, and a rod without mass between it and a rigid body."""
    soft, body = cube((0, 0, 0), "soft", velocity=(0.0, 0.0, 1.0)), brick("rigid", (2, 0.4, 0.5))
    ends = np.array([[0.9, 0.7, 0.6], [1.8, 0.3, 0.5]])
    joints = [
        nts.Spherical(soft, None, point=(0.2, 0.2, 0.1), displacement=lambda t: (0.0, 0.0, t)),
        nts.Distance(soft, body, points=ends),
    ]
    system = nts.System([soft, body], joints=joints)
    stepper = nts.Stepper(system, nts.EnergyMomentum(), project_start=True)
    follow = Follow(body)
    for _ in range(20):
        t = stepper.advance(1e-2).time
        assert np.abs(at(soft, (0.2, 0.2, 0.1)) - (0.2, 0.2, 0.1 + t)).max() < 1e-12
        far = np.linalg.norm(at(soft, ends[0]) - follow.point(body, ends[1]))
        assert abs(far - np.linalg.norm(ends[0] - ends[1])) < 1e-12
    table = stepper.solution.balance
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"].max()
    assert np.linalg.norm(body.velocity) > 0.05
    stepper.close()


def test_a_distance_far_from_the_origin():
    """The difference of two points is formed before it is squared."""
    ways = []
    for shift in (0.0, 1e4):
        off = np.array([shift, -shift, shift])
        a, b = brick("a", off), brick("b", off + Q, moving=0.5 * np.cross(N, Q - 0.1 * M1))
        joint = nts.Distance(a, b, points=(off + 0.1 * M1, off + Q))
        run = nts.simulate(
            nts.System([a, b], joints=[joint], gravity=(0, 0, -1.0)), nts.EnergyMomentum(),
            dt=1e-2, t_end=0.2,
        )  # fmt: skip
        assert run.status.startswith("completed")
        ways.append([a.position - off, b.position - off])
    # What places 1e4 m away are rounded to, and what a step makes of it.
    assert np.abs(ways[0][0] - [0.0, 0.0, 0.0]).max() > 1e-3
    assert np.allclose(*ways, rtol=0.0, atol=1e-10)


# ---- bad input
def number(_):
    return 0.0


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda a, b, s: nts.Revolute(a, b, point=P, axis=(0, 0, 0)), ValueError,
         r"axis of 'revolute of a and b'=\(0, 0, 0\): has no direction; pass a vector"),
        (lambda a, b, s: nts.Planar(a, b, point=P, axis=(0, 0, np.nan)), ValueError,
         "axis of 'planar of a and b'.*: pass three finite components"),
        (lambda a, b, s: nts.Spherical(a, b, point=(0, 1)), ValueError,
         r"point=\(0, 1\): pass three finite components \[m\]"),
        (lambda a, b, s: nts.Spherical(a, a, point=P), ValueError,
         "a=b='a': a Spherical joins two bodies; pass another one, or None"),
        (lambda a, b, s: nts.Fixed(None, None, point=P), ValueError,
         "a=None, b=None: a Fixed needs a body; only one end may be the ground"),
        (lambda a, b, s: nts.Fixed(3, None, point=P), TypeError, "a=3: pass a body, or None"),
        (lambda a, b, s: nts.Fixed(a, s, point=(2.2, 0.3, 0.3)), ValueError,
         r"b='s': a flexible body has no directions for 'fixed of a and s'; tie a rigid body"),
        (lambda a, b, s: nts.Spherical(s, None, point=(9, 0, 0)), ValueError,
         "point of 'spherical of s and ground': .*9.0, 0.0, 0.0.*: lies in no cell of body 's'"),
        (lambda a, b, s: nts.Spherical(a, b, point=P, name=" "), ValueError, "name=' ': is empty"),
        (lambda a, b, s: nts.Spherical(a, b, point=P, axis=N), TypeError,
         "axis=.*: unknown option of Spherical; choose from a, b, point, displacement, cone, "
         "friction, name"),
        (lambda a, b, s: nts.Universal(a, b, point=P, axes=(N, N)), ValueError,
         "axes=.* of 'universal of a and b': are not at right angles"),
        (lambda a, b, s: nts.Universal(a, b, point=P, axes=N), ValueError, "axes=.*pass two vec"),
        (lambda a, b, s: nts.Distance(a, b, points=(P, P)), ValueError,
         r"points=.* of 'distance of a and b': coincide; join them by Spherical\(...\)"),
        (lambda a, b, s: nts.Distance(a, b, points=P), ValueError, "points=.*: pass two points"),
        (lambda a, b, s: nts.Distance(a, b, points=(P, Q), length=2.0), ValueError,
         "length=2.0 of 'distance of a and b': the points are 0.80.* apart at the start; leave"),
        (lambda a, b, s: nts.Distance(a, b, points=(P, Q), length=-1.0), ValueError,
         "length of 'distance of a and b'=-1.0: must be positive"),
        (lambda a, b, s: nts.Distance(a, b, points=(P, Q), length=lambda t: 1.0 + t), ValueError,
         "length=<function .* of 'distance of a and b': the points are"),
        (lambda a, b, s: nts.Revolute(a, b, point=P, axis=N, angle=1.0), TypeError,
         "angle of 'revolute of a and b'=1.0: pass a function of time"),
        (lambda a, b, s: nts.Prismatic(a, b, point=P, axis=N, displacement=lambda t: "far"),
         nts.UserFunctionError,
         "displacement of 'prismatic of a and b' at t=0.0: returned 'far'; return a"),
        (lambda a, b, s: nts.Spherical(a, b, point=P, displacement=number),
         nts.UserFunctionError,
         "displacement of 'spherical of a and b' at t=0.0: returned 0.0; pass three"),
        (lambda a, b, s: nts.Tie("a", s.surface(lambda x: x[0] < 2.1)), TypeError,
         r"body=.*: pass a rigid body, or"),
        (lambda a, b, s: nts.Tie(a, "face"), TypeError, r"surface='face': pass body.surface"),
        (lambda a, b, s: nts.Tie(a, s.surface(lambda x: x[0] > 9)), ValueError,
         "selects no exterior facet"),
        (lambda a, b, s: nts.System([a, b], joints=[nts.Spherical]), TypeError,
         r"joints\[0\]=<class .*: is a class; pass objects made from it, Spherical\(...\)"),
        (lambda a, b, s: nts.System([a, nts.RigidBody]), TypeError,
         r"bodies\[1\]=<class .*: is a class; pass objects made from it, RigidBody\(...\)"),
        (lambda a, b, s: nts.System([a], joints=[nts.Spherical(a, b, point=P)]), ValueError,
         "'spherical of a and b' holds body 'b', which is not among bodies"),
        (lambda a, b, s: nts.System([a, b], joints=2 * [nts.Spherical(a, b, point=P)]), ValueError,
         r"joints\[1\]: 'spherical of a and b' is given twice; drop one"),
        (lambda a, b, s: nts.System([a, b], joints=[nts.Spherical(a, b, point=x) for x in (P, Q)]),
         ValueError, "are not unique; pass name= to each joint"),
    ],
)  # fmt: skip
def test_bad_input(make, kind, message):
    a, b, s = brick("a", (0, 0, 0)), brick("b", (1, 0, 0)), cube((2, 0, 0), "s", 1)
    with pytest.raises(kind, match=message):
        make(a, b, s)


def points_in(unit):
    """Newton iterations of two point masses, one at the origin, with lengths in this unit."""
    ends = np.array([(0, 0, 0), (0.5, 0, 0), (0, 0.2, 0.1)]) * unit
    one, two = (
        nts.RigidBody.from_inertia(m, (0, 0, 0), centre=c, name=f"{m}")
        for m, c in zip((2.0, 1.0), ends[:2], strict=True)
    )
    joints = [
        nts.Distance(one, None, points=ends[[0, 2]]), nts.Distance(one, two, points=ends[:2]),
        nts.Spring(two, None, ends[1:], stiffness=50.0),
    ]  # fmt: skip
    system = nts.System([one, two], joints=joints, gravity=(0, 0, -9.81 * unit))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.1)
    work = np.abs(run.balance["external_work"]).max()
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-13 * work
    return run.balance["newton_iterations"].tolist(), two.position / unit


def test_points_have_no_length_of_their_own():
    """Directors of a body without inertia have the length 1 in any unit; nothing depends on it."""
    (steps, place), *others = (points_in(unit) for unit in (1.0, 1 / UNITS[1], UNITS[1]))
    for other in others:
        assert other[0] == steps
        assert other[1] == pytest.approx(place, abs=1e-12)


@pytest.mark.mpi
@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
def test_places_that_differ_between_ranks_are_refused():
    a, here = brick("a", (0, 0, 0)), (1e-12 * COMM.rank, 0, 0)
    with pytest.raises(ValueError, match="point: is .* on rank 1 and .* on rank 0"):
        nts.Spherical(a, None, point=here)
    with pytest.raises(ValueError, match="points: is .* on rank 1 and .* on rank 0"):
        nts.Spring(a, None, [here, Q], stiffness=1.0)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_contradicting_drives_stop_a_run():
    """Its status names the joints."""
    body = brick("body", (0.4, 0.1, 0.2))
    joints = [
        nts.Prismatic(
            body, None, point=P, axis=N, displacement=lambda t, v=v: v * t**2, name=f"drive {v}"
        )
        for v in (1.0, 2.0)
    ]
    run = nts.simulate(nts.System([body], joints=joints), nts.EnergyMomentum(), dt=1e-2, t_end=0.1)
    assert "not solved" in run.status and "drive" in run.status


@pytest.mark.mpi
def test_a_drive_that_raises_ends_a_run():
    def angle(t):
        return t**2 if t < 0.045 else 1 / 0

    body = brick("body", (0.4, 0.1, 0.2))
    joint = nts.Revolute(body, None, point=P, axis=N, angle=angle)
    run = nts.simulate(nts.System([body], joints=[joint]), nts.EnergyMomentum(), dt=1e-2, t_end=1.0)
    assert "angle of 'revolute of body and ground' at t=0.05" in run.status
    assert "ZeroDivisionError" in run.status


@pytest.mark.parametrize(
    ("joints", "tree"),
    [
        ([(0,), (1, 0), (2, 1)], True),
        ([(0, 1), (2, 3), (1, 2)], True),
        ([(0,), (1, 0), (1,)], False),
        ([(0, 1), (0, 1)], False),
        ([(0, 1), (1, 2), (2, 0)], False),
    ],
)
def test_only_loops_are_looked_at_for_joints_that_repeat_each_other(joints, tree):
    """A chain of 800 bodies needs no search for a null space."""
    assert least_norm.form_tree(joints) is tree


def motor(angle, rate=0.0):
    """A body that a hinge about z turns by an angle."""
    body = nts.RigidBody.from_inertia(1.0, (1, 1, 1), angular_velocity=(0, 0, rate), name="rotor")
    hinge = nts.Revolute(body, None, point=(0, 0, 0), axis=(0, 0, 1), angle=angle, name="motor")
    return body, nts.System([body], joints=[hinge])


def turned(angle):
    """Rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.mpi
@pytest.mark.parametrize("adapt", [None, nts.Adapt(tolerance=1e9)])
@pytest.mark.fast_on_ranks()
def test_steps_of_half_a_turn_are_cut_from_the_first_one_on(adapt):
    """It cannot be told from half a turn the other way: a motor of 80 rad/s ran at -91."""
    body, system = motor(lambda t: 80.0 * t, 80.0)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.05, t_end=0.2, adapt=adapt)
    assert run.status == "completed" and run.retries > 0
    assert np.abs(body.rotation - turned(16.0)).max() < 1e-9
    assert np.diff(run.balance["time"]).max() * 80.0 < np.pi


@pytest.mark.mpi
@pytest.mark.parametrize("jump", [0.0, 0.12])
def test_a_jump_of_half_a_turn_stops_a_run(jump):
    """However short the step; in the first one, too."""
    _, system = motor(lambda t: 4.0 * (t > jump))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.05, t_end=0.2)
    assert "the angle of 'motor' changes by 4 rad, half a turn or more; use a sm" in run.status
    assert run.status.endswith("use a smaller dt")
    assert jump - 0.05 < run.balance["time"][-1] <= jump


@pytest.mark.mpi
def test_load_steps_of_half_a_turn_are_cut():
    body, system = motor(lambda t: 7.0 * t)
    assert nts.equilibrium(system).status == "completed"
    # Newton's tolerance times the motion of the directors.
    assert np.abs(body.rotation - turned(7.0)).max() < 1e-11


@pytest.mark.mpi
@pytest.mark.parametrize("turn", [1.6, 2.2])
@pytest.mark.fast("2.2")
@pytest.mark.fast_on_ranks()
def test_the_angle_of_a_hinge_is_no_mirror_image(turn):
    """Its sine about a mean of the step has two angles, of which one is refused."""
    body, system = motor(lambda t: turn / 0.05 * t, turn / 0.05)
    run = nts.simulate(system, nts.Newmark(), dt=0.05, t_end=0.5)
    assert run.status.startswith("completed")
    assert np.abs(body.rotation - turned(10.0 * turn)).max() < 1e-9
    _, system = motor(lambda t: turn / 0.05 * t, turn / 0.05)
    stepper = nts.Stepper(system, nts.Newmark())
    stepper.start(0.05)
    stepper.problem.begin(stepper.state, 0.05)
    (hinge,) = (c for c, (k, *_) in stepper.problem.couplings.joints if system.joints[k].driven)
    (batch,) = hinge.elements
    own = {"constraints": np.zeros((batch.num_elements, batch.widths["constraints"]))}

    def missed(angle):
        x = batch.reference().copy()
        x[:, 1:] = x[:, 1:] @ turned(angle).T
        part = batch.evaluate(x, own)
        assert np.abs(part.gap).max(initial=0.0) < 1e-12
        return hinge.misses(None, [part], None)

    assert not missed(turn)
    # sin(t_1 - t) = sin(pi - t_1 + t) with t in the middle of 0 and t_1.
    with pytest.raises(nts.StepFailedError, match="'motor' ends with directions turned over"):
        missed(np.pi)
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("rule", "steps", "spins"),
    [
        # Its energy has grown 16 times by then, and in the next step without bound.
        (nts.Newmark(), 9, [(-16, 17, 11), (9, 1, 16)]),
        (nts.GeneralizedAlpha(), 10, [(-19, 4, -48), (7, 7, 47)]),
    ],
)
@pytest.mark.fast_on_ranks("rule0-9-spins0")
def test_no_step_turns_directions_over(rule, steps, spins):
    """Bodies became mirror images, and axes of a hinge opposite: both solve the equations."""
    a = nts.RigidBody.from_inertia(1.0, (1, 2, 2.5), angular_velocity=spins[0], name="a")
    b = nts.RigidBody.from_inertia(
        0.3, (0.1, 0.2, 0.25), centre=(1, 0, 0), angular_velocity=spins[1], name="b"
    )
    hinge = nts.Revolute(a, b, point=(0.5, 0, 0), axis=(0, 0, 1))
    start = [body.rotation.T @ (0, 0, 1) for body in (a, b)]
    stepper = nts.Stepper(nts.System([a, b], joints=[hinge]), rule, project_start=True)
    for _ in range(steps):
        stepper.advance(0.05)
        axes = [body.rotation @ n for body, n in zip((a, b), start, strict=True)]
        assert axes[0] @ axes[1] == pytest.approx(1.0, abs=1e-8)
        for body in (a, b):
            assert np.linalg.det(body.rotation) == pytest.approx(1.0, abs=1e-8)
    assert stepper.solution.retries > 0


@pytest.mark.mpi
def test_a_run_goes_on_from_within_its_first_step():
    """The rest of that step is as long as it is: it was solved with the whole one's length."""
    jump = [4.0]
    body, system = motor(lambda t: jump[0] * (t > 0.03))
    loose = nts.RigidBody.from_inertia(1.0, (1, 1, 1), velocity=(1, 0, 0), name="loose")
    system = nts.System([body, loose], joints=system.declared_joints)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.05, t_end=0.2)
    assert 0.0 < run.balance["time"][-1] < 0.05
    jump[0] = 0.0
    again = nts.simulate(system, nts.EnergyMomentum(), dt=0.05, t_end=0.2, start=run)
    assert again.status == "completed" and again.balance["time"][-1] == 0.2
    assert loose.position == pytest.approx([0.2, 0, 0], abs=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("heavy", [1e5, 1e8])
@pytest.mark.fast("100000000.0")
@pytest.mark.fast_on_ranks()
def test_light_links_hold_a_heavy_body(heavy):
    """Joints without loops are lent no compliance, which would be one of the light links."""
    masses = [1.0, 1.0, 1.0, heavy]
    links = [
        nts.RigidBody.from_inertia(
            m, (0.01 * m, 0.1 * m, 0.1 * m), centre=(k + 0.5, 0, 0), name=f"link {k}"
        )
        for k, m in enumerate(masses)
    ]
    joints = [
        nts.Spherical(b, links[k - 1] if k else None, point=(k, 0, 0), name=f"joint {k}")
        for k, b in enumerate(links)
    ]
    system = nts.System(links, joints=joints, gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=0.2)
    table = run.balance
    assert run.status == "completed" and run.retries == 0
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * np.abs(table["external_work"]).max()


def test_joints_that_hang():
    """A tree hangs, a loop and what holds it do not; neither does a joint of two held bodies."""
    free = {0, 1, 2, 3}
    assert least_norm.hanging([(0,), (0, 1), (1, 2)], free) == [True, True, True]
    assert least_norm.hanging([(0,), (0, 1), (1,), (1, 2)], free) == [False, False, False, True]
    assert least_norm.hanging([(0, 1), (1, 2)], free) == [True, True]
    assert least_norm.hanging([(0, 9), (1, 9), (9,)], free) == [True, True, False]
    assert least_norm.hanging([(0, 1), (0, 1)], free) == [False, False]


def test_a_system_and_its_joints_are_described_in_a_line():
    arm = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="arm")
    hinge = nts.Revolute(arm, None, point=(0, 0, 0), axis=(0, 0, 1), limits=(-1, 1), name="hinge")
    assert repr(arm) == "<RigidBody 'arm'>" and repr(hinge) == "<Revolute 'hinge' of 'arm'>"
    system = nts.System([arm], joints=[hinge])
    assert repr(system) == "<System of bodies 'arm'; joints 'hinge', 'hinge limits'>"
