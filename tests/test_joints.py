"""Joints: what they hold, what they leave free, what their drives cost, and mechanisms of them."""

import itertools

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from mpi4py import MPI
from scipy.integrate import solve_ivp

import dolfinx_nts as nts

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
    assert COMM.allreduce(state.histories[1].size) == count
    stepper.close()


@pytest.mark.parametrize("kind", JOINTS)
def test_tangent_against_differences(kind):
    a, b, joint, _ = pair(kind)
    stepper = nts.Stepper(nts.System([a, b], joints=[joint]), nts.EnergyMomentum())
    stepper.advance(5e-2)
    for batch in stepper.problem.elements:
        rng, c = np.random.default_rng(3), batch.num_coordinates
        x = batch.reference() + 0.1 * rng.standard_normal((1, c // 3, 3))
        own = rng.standard_normal((1, batch.widths["constraints"]))

        def residual(z, batch=batch, c=c):
            x = z[:, :c].reshape(1, c // 3, 3)
            return batch.evaluate(x, {"constraints": z[:, c:]}).residual[0]

        z = np.concatenate([x.reshape(1, c), own], axis=1)
        tangent = batch.evaluate(x, {"constraints": own}).tangent[0]
        # What the matrix lends to multipliers is no derivative.
        tangent[c:, c:] = 0.0
        steps = 1e-3 * np.eye(z.shape[1])
        found = [(residual(z + d) - residual(z - d)) / 2e-3 for d in steps]
        assert np.abs(np.array(found).T - tangent).max() < 1e-11 * np.abs(tangent).max()
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


@pytest.mark.parametrize(
    ("dt", "known"), [(4e-3, 5.919e-3), (2e-3, 1.488e-3), (1e-3, 3.726e-4)]
)
def test_a_heavy_top_precesses(dt, known):
    error, table = heavy_top(dt, nts.EnergyMomentum())
    assert abs(error / known - 1.0) < 5e-4
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * table["energy"][0]


@pytest.mark.mpi
def test_a_heavy_top_in_other_units():
    """As many iterations, the same motion."""
    runs = [heavy_top(4e-3, nts.EnergyMomentum(), unit) for unit in (1.0, 1e3, 1e6)]
    for error, table in runs[1:]:
        assert abs(error - runs[0][0]) < 1e-11
        assert np.array_equal(table["newton_iterations"], runs[0][1]["newton_iterations"])


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
    """The point at these distances from b and d, left of the way from b to d, in the plane z = 0."""
    way = np.linalg.norm(d - b)
    x = (way**2 + to_b**2 - to_d**2) / (2.0 * way)
    e = (d - b) / way
    return b + x * e + np.sqrt(to_b**2 - x**2) * np.cross(Z, e)


CRANK, COUPLER, ROCKER = 0.3, 1.0, 0.6
FAR = np.array([0.9, 0.0, 0.0])


def tip(angle):
    return CRANK * np.array([np.cos(angle), np.sin(angle), 0.0])


@pytest.mark.mpi
@pytest.mark.parametrize("thick", [0.0, 0.1])
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
        run = nts.simulate(
            nts.System(bars, joints=joints), nts.EnergyMomentum(), dt=dt, t_end=0.5
        )
        assert run.status == "completed"
        table = run.balance
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
        assert table["newton_iterations"].max() <= 4
        crank, coupler, rocker = (bar.position for bar in bars)
        angles.append(np.arctan2(crank[1], crank[0]))
        now = corner(tip(angles[-1]), FAR, COUPLER, ROCKER)
        assert np.abs(2.0 * crank - tip(angles[-1])).max() < 1e-12
        assert np.abs(2.0 * coupler - tip(angles[-1]) - now).max() < 1e-12
        assert np.abs(2.0 * rocker - now - FAR).max() < 1e-12
    ratio = (angles[0] - angles[1]) / (angles[1] - angles[2])
    assert abs(np.log2(ratio) - 2.0) < 0.1
