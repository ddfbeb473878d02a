"""Springs and dampers between points and about axes, against closed forms and SciPy."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from integrators import INTEGRATORS
from measures import kinds
from pairs import pairs
from scenes import UNITS, box
from scipy.integrate import quad, solve_ivp

import dolfinx_nts as nts
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.integrators import Static

COMM = MPI.COMM_WORLD
MIDDLE = ("energy-momentum", "midpoint")
LAWS = {
    "linear": {"stiffness": 50.0, "length": 2.0},
    "Lennard-Jones": {"energy": lambda x: 20.0 * ((2.0 / x) ** 8 - 2.0 * (2.0 / x) ** 4)},
    "cubic": {
        "energy": lambda x: 5.0 * (x - 2.0) ** 2 + 3.0 * (x - 2.0) ** 3 + 4.0 * (x - 2.0) ** 4,
        "force": lambda x: 10.0 * (x - 2.0) + 9.0 * (x - 2.0) ** 2 + 16.0 * (x - 2.0) ** 3,
    },
}
Z = (0.0, 0.0, 1.0)


def tumbling(name="", **options):
    one = nts.RigidBody.from_inertia(
        2.0, (1.0, 2.0, 2.5), velocity=(0.1, 0.0, 0.0), angular_velocity=(3.0, 1.0, 2.0),
        name=f"one{name}", **options,
    )  # fmt: skip
    other = nts.RigidBody.from_inertia(
        1.0, (0.5, 0.6, 0.7), (3.0, 0.5, 0.0), velocity=(0.0, 0.3, 0.0),
        angular_velocity=(-1.0, 2.0, 0.5), name=f"other{name}", **options,
    )  # fmt: skip
    return one, other


POINTS = [(0.5, 0.3, -0.2), (2.2, 0.1, 0.4)]


def cube(side=1.0, **options):
    mesh = box((0, 0, 0), np.full(3, side), 2)
    return nts.Continuum(mesh, nts.NeoHookean(1e5, 0.3), density=1e3, name="cube", **options)


def mass(x, name="mass", **options):
    return nts.RigidBody.from_inertia(2.0, (0.3, 0.4, 0.5), x, name=name, **options)


ITEMS = {
    "spring": lambda a, b: nts.Spring(a, b, POINTS, stiffness=50.0, length=1.5),
    "energy": lambda a, b: nts.Spring(a, b, POINTS, **LAWS["Lennard-Jones"]),
    "force": lambda a, b: nts.Spring(a, b, POINTS, **LAWS["cubic"]),
    "no length": lambda a, b: nts.Spring(a, b, POINTS, stiffness=50.0, length=0.0),
    "damper": lambda a, b: nts.Damper(a, b, POINTS, damping=3.0),
    "torsion": lambda a, b: nts.TorsionSpring(a, b, axis=(1, 2, 3), stiffness=7.0, angle=0.4),
    "torsion energy": lambda a, b: nts.TorsionSpring(a, b, axis=Z, energy=lambda x: -np.cos(x)),
    "torsion damper": lambda a, b: nts.TorsionDamper(a, b, axis=(1, 2, 3), damping=3.0),
}


@pytest.mark.parametrize(
    ("item", "rule", "ground"), pairs(ITEMS, [*INTEGRATORS, "static"], [None, 0, 1])
)
def test_tangents_are_derivatives(item, rule, ground):
    a, b = tumbling()
    ends = [None if k == ground else body for k, body in enumerate((a, b))]
    rng = np.random.default_rng(3)
    system = nts.System([a, b], joints=[ITEMS[item](*ends)])
    problem = StepProblem(system, INTEGRATORS.get(rule, Static()), rtol=1e-9, condense=False)
    state, h = system.initial_state(), 0.1
    if problem.integrator.accelerations:
        a0 = tuple(rng.normal(size=v.shape) for v in state.v)
        state = nts.State(state.time, state.u, state.v, a0, state.contacts, state.joints)
    # Rigid bodies have no stiffness that scales their constraints: these are left out in statics.
    problem.couplings.joints = problem.couplings.joints[:1]
    state = nts.State(state.time, state.u, state.v, state.a, state.contacts, state.joints[:1])
    problem.begin(state, h)
    (batch,) = problem.elements
    shape = batch.reference().shape
    for size in (0.3, 0.0):
        x = batch.reference() + size * rng.normal(size=shape)
        tangent = batch.evaluate(x, {}).tangent
        way = rng.normal(size=shape)
        ends = [batch.evaluate(x + s * 1e-6 * way, {}).residual for s in (1.0, -1.0)]
        expected = (ends[0] - ends[1]) / 2e-6
        found = np.einsum("nij,nj->ni", tangent, way.reshape(shape[0], -1))
        assert np.abs(found - expected).max(initial=0.0) <= 1e-7 * np.abs(tangent).max(initial=0.0)
    problem.destroy()


@pytest.mark.mpi
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.fast("linear")
@pytest.mark.fast_on_ranks()
def test_tumbling_bodies_keep_energy_and_momenta(law):
    a, b = tumbling()
    spring = nts.Spring(a, b, POINTS, **LAWS[law])
    run = nts.simulate(nts.System([a, b], joints=[spring]), INTEGRATORS["energy-momentum"],
                       dt=0.01, t_end=1.0)  # fmt: skip
    table = run.balance
    assert run.status == "completed"
    kinetic = table["kinetic"][0]
    assert np.ptp(table["potential"]) > 0.05 * kinetic
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * kinetic
    for name in ("linear_momentum", "angular_momentum"):
        size = np.abs(table[name]).max()
        assert np.abs(table[name] - table[name][0]).max() < 1e-12 * size


def test_an_energy_that_is_linear_is_a_linear_spring():
    """Also where steps are so small that differences of energies are rounding."""
    for dt, end in ((1e-2, 0.5), (1e-9, 2e-8)):
        found = []
        for law in ({"stiffness": 50.0, "length": 2.0},
                    {"energy": lambda x: 25.0 * (x - 2.0) ** 2}):  # fmt: skip
            a, b = tumbling()
            spring = nts.Spring(a, b, POINTS, **law)
            run = nts.simulate(nts.System([a, b], joints=[spring]), INTEGRATORS["energy-momentum"],
                               dt=dt, t_end=end)  # fmt: skip
            assert run.status == "completed"
            found.append(a.velocity)
        assert np.allclose(*found, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("rule", INTEGRATORS)
@pytest.mark.parametrize("damping", [0.0, 1.5])
@pytest.mark.fast("0.0-midpoint")
def test_oscillator(rule, damping):
    """Order, and what the damper takes, by the closed form; ends change places."""
    m, k, start, v0, end = 2.0, 30.0, 0.3, 0.8, 1.6
    decay = damping / (2 * m)
    omega = np.sqrt(k / m - decay**2)
    c, s = start, (v0 + decay * start) / omega
    place = np.exp(-decay * end) * (c * np.cos(omega * end) + s * np.sin(omega * end))
    speed = np.exp(-decay * end) * (
        (-decay * c + omega * s) * np.cos(omega * end)
        - (decay * s + omega * c) * np.sin(omega * end)
    )
    lost = 0.5 * (k * start**2 + m * v0**2) - 0.5 * (k * place**2 + m * speed**2)
    errors = []
    for n, dt in enumerate((0.04, 0.02)):
        body = mass((1.0 + start, 0.0, 0.0), velocity=(v0, 0.0, 0.0))
        ends, points = (body, None), [(1.0 + start, 0, 0), (0, 0, 0)]
        order = slice(None, None, -1 if n else 1)
        joints = [nts.Spring(*ends[order], points[order], stiffness=k, length=1.0)]
        if damping:
            joints.append(nts.Damper(*ends[order], points[order], damping=damping))
        run = nts.simulate(nts.System([body], joints=joints), INTEGRATORS[rule], dt=dt, t_end=end)
        assert run.status == "completed"
        table = run.balance
        error = [body.position[0] - 1.0 - place, body.velocity[0] - speed]
        taken = table.get("damping_dissipation", np.zeros(2))
        lost_by = taken[-1] - lost
        if rule in MIDDLE:
            assert (np.diff(taken) >= 0.0).all()
            assert np.abs(table["ledger_residual"]).max() < 1e-13 * table["energy"][0]
            error += [lost_by] if damping else []
        # Works of forces off the middle of the step are of first order, as those of loads.
        assert abs(lost_by) < 0.5 * dt * lost + 1e-12
        errors.append(np.abs(error))
    assert errors[1].max() < 1e-2
    assert np.abs(np.log2(errors[0] / errors[1]) - 2.0).max() < 0.1


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_spring_of_no_length_passes_through_it():
    """It starts at length 0 and comes back there; V = k/2 l^2 is smooth."""
    k, v0 = 50.0, 0.7
    omega, h = np.sqrt(k / 2.0), 0.02
    phase = 2.0 * np.arctan(omega * h / 2.0)
    body = mass((0.3, 0.2, 0.1), velocity=(v0, 0.0, 0.0))
    spring = nts.Spring(None, body, [(0.3, 0.2, 0.1)] * 2, stiffness=k)
    run = nts.simulate(nts.System([body], joints=[spring]), INTEGRATORS["energy-momentum"],
                       dt=h, t_end=50 * h)  # fmt: skip
    assert run.status == "completed"
    assert abs(body.position[0] - 0.3 - v0 / omega * np.sin(50 * phase)) < 1e-12
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-13 * run.balance["energy"][0]


@pytest.mark.parametrize("rule", ["energy-momentum", "midpoint", "generalized-alpha"])
@pytest.mark.slow
def test_torsion_pendulum_over_several_turns(rule):
    """V = k/2 phi^2 + c (1 - cos phi), not periodic: turns count."""
    inertia, k, c, damping, spin, end = 0.5, 0.02, 0.3, 0.02, 8.0, 2.5

    def right(t, y):
        return [y[1], -(k * y[0] + c * np.sin(y[0]) + damping * y[1]) / inertia]

    exact = solve_ivp(right, (0.0, end), [0.0, spin], rtol=1e-12, atol=1e-12, dense_output=True)
    angle, speed = exact.y[:, -1]
    assert exact.y[0].max() > 5.0 * np.pi
    lost = damping * quad(lambda t: exact.sol(t)[1] ** 2, 0.0, end, epsabs=1e-10, limit=200)[0]
    errors = []
    for dt in (0.03125, 0.015625):
        wheel = nts.RigidBody.from_inertia(
            1.0, (0.3, 0.4, inertia), (1.0, 0.0, 0.0), motion=(0, 0, 0),
            angular_velocity=(0, 0, spin),
        )  # fmt: skip
        joints = [
            nts.TorsionSpring(wheel, None, axis=(0, 0, 3), stiffness=k),
            nts.TorsionSpring(None, wheel, axis=Z, energy=lambda x: -c * np.cos(x), name="gravity"),
            nts.TorsionDamper(None, wheel, axis=Z, damping=damping),
        ]
        run = nts.simulate(nts.System([wheel], joints=joints), INTEGRATORS[rule], dt=dt, t_end=end)
        table = run.balance
        assert run.status == "completed"
        stored = 0.5 * k * angle**2 - c * np.cos(angle)
        turned = np.arctan2(wheel.rotation[1, 0], wheel.rotation[0, 0]) - angle
        turned -= 2 * np.pi * np.round(turned / (2 * np.pi))
        error = [turned, wheel.angular_velocity[2] - speed, table["potential"][-1] - stored]
        lost_by = table["damping_dissipation"][-1] - lost
        errors.append(np.linalg.norm([*error, lost_by if rule in MIDDLE else 0.0]))
        assert abs(lost_by) < dt * lost
        if rule == "energy-momentum":
            assert np.abs(table["ledger_residual"]).max() < 1e-12 * table["kinetic"][0]
    assert errors[1] < 2e-3 * angle
    assert abs(np.log2(errors[0] / errors[1]) - 2.0) < 0.1


@pytest.mark.mpi
@pytest.mark.parametrize("law", ["stiffness", "energy"])
@pytest.mark.fast_on_ranks("energy")
def test_a_mass_hangs_on_a_spring(law):
    """Its length is L + m g/k, whatever the body's shape; a damper does nothing."""
    g, k, rest = 9.81, 5e4, 1.0
    body = cube()
    held = {"stiffness": k, "length": rest} if law == "stiffness" else {
        "energy": lambda x: 0.5 * k * (x - rest) ** 2}  # fmt: skip
    points = [(0.5, 0.5, 1.0), (0.5, 0.5, 2.0)]
    joints = [nts.Spring(body, None, points, **held), nts.Damper(body, None, points, damping=1e5)]
    system = nts.System([body], joints=joints, gravity=(0.0, 0.0, -g))
    run = nts.equilibrium(system, stabilization=0.1, load_steps=2)
    assert run.status == "completed"
    down = -body.points(points[0]).at(run.state.u[0])[0]
    assert np.abs(down[:2]).max() < 1e-8
    assert abs(down[2] - 1e3 * g / k) < 1e-9 * rest
    assert run.balance["damping_dissipation"][-1] == 0.0


@pytest.mark.mpi
def test_a_body_rests_on_springs_of_no_length():
    """Their mean sag is m g/(4 k), whatever the body's shape; they hold it in all directions."""
    g, k = 9.81, 2e4
    body = cube()
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], dtype=float)
    joints = [nts.Spring(body, None, (x, x), stiffness=k, name=f"foot {x}") for x in corners]
    system = nts.System([body], joints=joints, gravity=(0.0, 0.0, -g))
    run = nts.equilibrium(system)
    assert run.status == "completed" and not kinds(run)
    sag = -body.points(corners).at(run.state.u[0])
    assert np.abs(sag.mean(axis=0) - [0, 0, 1e3 * g / (4 * k)]).max() < 1e-11
    assert abs(run.balance["potential"][-1] - 0.5 * k * (sag**2).sum() - body_energy(run)) < 1e-8


def body_energy(run):
    return COMM.allreduce(run.system.bodies[0].potential(run.state.u[0]))


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_spring_within_a_flexible_body():
    """Its ends are points of one body: an inner force that adds no momentum."""
    body = cube(velocity=(0.3, 0.0, 0.0))
    points = [(0.1, 0.2, 0.3), (0.9, 0.7, 0.8)]
    joints = [nts.Spring(body, body, points, stiffness=1e4, length=0.5),
              nts.Damper(body, body, points, damping=50.0)]  # fmt: skip
    run = nts.simulate(nts.System([body], joints=joints), INTEGRATORS["energy-momentum"],
                       dt=5e-3, t_end=0.1)  # fmt: skip
    table = run.balance
    assert run.status == "completed" and table["damping_dissipation"][-1] > 1.0
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
    for name, zero in (("linear_momentum", 300.0), ("angular_momentum", 150.0)):
        assert np.abs(table[name] - table[name][0]).max() < 1e-11 * zero


@pytest.mark.mpi
def test_an_energy_that_raises_ends_the_run_on_all_ranks():
    def energy(x):
        if (np.real(x) > 1.2).any():
            raise RuntimeError("too long")
        return (x - 1.0) ** 2

    body = mass((1.0, 0.0, 0.0), velocity=(1.0, 0.0, 0.0))
    spring = nts.Spring(body, None, [(1, 0, 0), (0, 0, 0)], energy=energy)
    run = nts.simulate(nts.System([body], joints=[spring]), INTEGRATORS["energy-momentum"],
                       dt=0.01, t_end=1.0)  # fmt: skip
    assert "energy of 'spring of mass and ground'" in run.status and "too long" in run.status
    assert 0.1 < run.balance["time"][-1] < 0.25


class Hinge:
    """What `about` asks of a joint."""

    ends, axis = (None, None), (0, 0, 2)


@pytest.mark.mpi
def test_about_a_joint():
    wheel = mass((0, 0, 0))
    hinge = Hinge()
    hinge.ends = (wheel, None)
    spring = nts.TorsionSpring.about(hinge, stiffness=2.0, name="clock")
    assert spring.bodies == (wheel,) and spring.name == "clock"
    assert isinstance(nts.TorsionDamper.about(hinge, damping=2.0), nts.TorsionDamper)
    with pytest.raises(TypeError, match=r"joint=3: pass a joint with an axis, such as Revolute"):
        nts.TorsionSpring.about(3, stiffness=2.0)


APART = [(0, 0, 0), (1, 0, 0)]


@pytest.mark.mpi
@pytest.mark.parametrize(
    "make, kind, message",
    [
        (lambda a: nts.Spring(a, None, APART, stiffness=0.0), ValueError,
         r"stiffness=0.0: must be"),
        (lambda a: nts.Spring(a, None, APART, stiffness="k"), ValueError,
         r"stiffness='k': must be"),
        (lambda a: nts.Spring(a, None, APART, stiffness=1.0, length=-1.0), ValueError,
         r"length=-1.0: must be >= 0"),
        (lambda a: nts.Spring(a, None, APART), ValueError,
         r"stiffness=None, energy=None: pass one of them"),
        (lambda a: nts.Spring(a, None, APART, stiffness=1.0, energy=np.exp), ValueError,
         r"stiffness=1.0, energy=.*: pass one of them"),
        (lambda a: nts.Spring(a, None, APART, stiffness=1.0, force=np.exp), ValueError,
         r"force=.*: belongs to energy="),
        (lambda a: nts.Spring(a, None, APART, energy=np.exp, length=1.0), ValueError,
         r"length=1.0: belongs to stiffness="),
        (lambda a: nts.Spring(a, None, APART, energy=3.0), TypeError,
         r"energy=3.0: pass a function of an array"),
        (lambda a: nts.Spring(a, None, APART, energy=np.exp, force=3.0), TypeError,
         r"force=3.0: pass a function of an array"),
        (lambda a: nts.Spring(a, None, APART, energy=lambda x: np.abs(x) ** 2), ValueError,
         r"energy of 'spring of mass and ground': changes by 0.0201 .* pass force=dV/dl"),
        (lambda a: nts.Spring(a, None, APART, energy=lambda x: x**2, force=lambda x: -2 * x),
         ValueError, r"its derivative says -0.0201;"),
        (lambda a: nts.Spring(a, None, APART, energy=lambda x: x + np.nan), ValueError,
         r"energy of 'spring of mass and ground': it or its derivative is not finite at 1"),
        (lambda a: nts.Spring(a, None, APART, energy=lambda x: np.full(3, x)),
         nts.UserFunctionError,
         r"energy of 'spring of mass and ground': <function <lambda>.* at .*> raised ValueError"),
        (lambda a: nts.Spring(None, None, APART, stiffness=1.0), ValueError,
         r"a=None, b=None: a Spring needs a body"),
        (lambda a: nts.Spring(a, a, APART, stiffness=1.0), ValueError,
         r"a=b='mass': a rigid body does not change its size"),
        (lambda a: nts.Spring(a, 7, APART, stiffness=1.0), TypeError, r"b=7: pass a body, or None"),
        (lambda a: nts.Spring(a, nts.RigidBody, APART, stiffness=1.0), TypeError,
         r"b=<class .*RigidBody'>: is a class; pass a body made from it, RigidBody\(...\)"),
        (lambda a: nts.Spring(a, None, (0, 0, 0), stiffness=1.0), ValueError,
         r"points=\(0, 0, 0\): pass two points"),
        (lambda a: nts.Spring(a, None, [(0, 0, 0), (1, 0)], stiffness=1.0), ValueError,
         r"points\[1\]=\(1, 0\): pass three finite components"),
        (lambda a: nts.Spring(a, None, [(1, 0, 0), (1, 0, 1e-12)], stiffness=1.0, length=0.1),
         ValueError, r"they coincide, and a spring of length=0.1 has no direction there"),
        (lambda a: nts.Spring(a, None, [(1, 0, 0)] * 2, energy=np.exp), ValueError,
         r"they coincide, and a force of one's own has no direction there"),
        (lambda a: nts.Damper(a, None, [(1, 0, 0)] * 2, damping=1.0), ValueError,
         r"points of 'damper of mass and ground': they coincide"),
        (lambda a: nts.Damper(a, None, APART, damping=-1.0), ValueError, r"damping=-1.0: must be"),
        (lambda a: nts.Damper(a, None, APART, damping=1.0, name=""), ValueError,
         r"name='': is empty"),
        (lambda a: nts.Damper(a, None, APART, damping=1.0, friction=2), TypeError,
         r"friction=2: unknown option of Damper; choose from a, b, points, damping, name"),
        (lambda a: nts.TorsionSpring(a, None, axis=(0, 0, 0), stiffness=1.0), ValueError,
         r"axis of 'torsionspring of mass and ground'=\(0, 0, 0\): has no direction"),
        (lambda a: nts.TorsionSpring(a, None, axis=Z, stiffness=1.0, angle=np.inf), ValueError,
         r"angle=inf: must be finite"),
        (lambda a: nts.TorsionSpring(a, None, axis=Z, stiffness=-1.0), ValueError,
         r"stiffness=-1.0: must be positive and finite \[N m\]"),
        (lambda a: nts.TorsionDamper(a, None, axis=Z, damping=0.0), ValueError,
         r"damping=0.0: must be positive and finite \[N m s\]"),
    ],
)  # fmt: skip
def test_bad_input(make, kind, message):
    with pytest.raises(kind, match=message):
        make(mass((0.0, 0.0, 0.0)))


@pytest.mark.mpi
def test_bad_input_of_flexible_bodies():
    body = cube()
    with pytest.raises(ValueError, match=r"b='cube': a flexible body has no directions for"):
        nts.TorsionSpring(None, body, axis=Z, stiffness=1.0)
    with pytest.raises(ValueError, match=r"points of 'spring of cube and ground': .*lies in no"):
        nts.Spring(body, None, [(3, 0, 0), (0, 0, 0)], stiffness=1.0)


@pytest.mark.mpi
def test_forces_of_joints_supports_and_contacts_are_written(mpi_tmp_path):
    """A mass that hangs and one that stands: the spring pulls, the floor carries, a row a step."""
    from dolfinx_nts.output import ForcesCSV

    hangs = nts.RigidBody.from_inertia(2.0, (1, 2, 2.5), centre=(1, 0, 0), name="hangs")
    held = nts.RigidBody.from_inertia(3.0, (1, 1, 1), motion=(0, 0, 0), name="held")
    spring = nts.Spring(
        hangs, None, ((1, 0, 0), (1, 0, 2)), stiffness=100.0, length=2.0 - 0.02 * 9.81, name="pull"
    )
    system = nts.System([hangs, held], joints=[spring], gravity=(0, 0, -9.81))
    path = mpi_tmp_path / "forces.csv"
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.05, output=[ForcesCSV(path)])
    # The spring is stretched by m g / k: it carries the weight at rest.
    assert run.reactions["pull"][1:, 0] == pytest.approx(np.tile([0, 0, 2 * 9.81], (5, 1)))
    assert run.reactions["held"][1:, 0] == pytest.approx(np.tile([0, 0, 3 * 9.81], (5, 1)))
    if COMM.rank == 0:
        head, *rows = path.read_text().splitlines()
        names = head.split(",")
        values = dict(zip(names, map(float, rows[-1].split(",")), strict=True))
        assert len(rows) == 6 and values["time [s]"] == pytest.approx(0.05)
        assert values["pull_force_z [N]"] == pytest.approx(2 * 9.81)
        assert values["pull_moment_x [N m]"] == 0.0
        assert values["held_force_z [N]"] == pytest.approx(3 * 9.81)


@pytest.mark.mpi
def test_a_start_remembers_of_a_spring_only_what_is_its_own():
    """A torsion spring of the name of a linear one does not begin with that one's length."""
    rod = mass((10, 0, 0), "rod")
    spring = nts.Spring(rod, None, points=((10, 0, 0), (0, 0, 0)), stiffness=1.0, name="s")
    first = nts.System([rod], joints=[spring])
    ended = nts.simulate(first, nts.EnergyMomentum(), dt=0.01, t_end=0.02)
    other = mass((10, 0, 0), "rod")
    twist = nts.TorsionSpring(other, None, axis=(0, 0, 1), stiffness=1.0, name="s")
    run = nts.simulate(
        nts.System([other], joints=[twist]), nts.EnergyMomentum(), dt=0.01, t_end=0.04,
        start=ended,
    )  # fmt: skip
    assert abs(run.balance["potential"]).max() < 1e-12


@pytest.mark.mpi
@pytest.mark.parametrize("turn", [2.5, 4.0, 7.0])
def test_a_torsion_spring_follows_a_prescribed_rotation(turn):
    """Steps of half a turn are cut: that of 7 rad held 0.5 J in place of 49."""

    def scene(rate):
        body = nts.RigidBody.from_inertia(
            1.0, (1, 1, 1), motion=(0, 0, 0), rotation=lambda t: (0, 0, rate * t)
        )
        spring = nts.TorsionSpring(body, None, axis=Z, stiffness=2.0)
        return nts.System([body], joints=[spring])

    settled = nts.equilibrium(scene(turn))
    run = nts.simulate(scene(turn / 0.1), nts.EnergyMomentum(), dt=0.1, t_end=0.1)
    for found in (settled, run):
        # The rate of what turns by more than a radian a step comes out wrong.
        far = found is run and turn / (1 + found.retries) > 1.0
        if far:
            assert found.status.startswith("completed, but body")
        else:
            assert found.status == "completed"
        assert found.balance["potential"][-1] == pytest.approx(turn**2, rel=1e-9)
        assert (found.retries > 0) is (turn > np.pi)


def told(joints, *bodies, rule=None, dt=1e-2, steps=0):
    """How many times too fast for its steps a run finds a spring or damper, and what it says."""
    system = nts.System(bodies, joints=joints)
    stepper = nts.Stepper(system, rule or nts.EnergyMomentum(), project_start=True)
    stepper.start(dt)
    for _ in range(steps):
        stepper.advance(dt)
    found = stepper.solution.warnings.get("unresolved")
    stepper.close()
    assert found is None or not found.grave
    return (0.0, "") if found is None else (found.worst, found.text)


@pytest.mark.mpi
def test_a_spring_that_steps_do_not_resolve_is_told():
    """Omega h, with the mass that the spring moves: of two bodies, at an arm, about a hinge."""

    def body(mass=1.0, inertia=(1, 2, 2.5), centre=(1, 0, 0), **options):
        return nts.RigidBody.from_inertia(mass, inertia, centre=centre, **options)

    one, ends = body(), [(1, 0, 0), (0, 0, 0)]
    worst, text = told([nts.Spring(one, None, ends, stiffness=1e6)], one)
    assert worst == pytest.approx(10.0, rel=1e-9)
    assert "of stiffness 1e+06 on a mass of 1 is not resolved, omega h = 10:" in text
    assert "use a dt below 0.001 if" in text
    assert told([nts.Spring(one, None, ends, stiffness=0.99e4)], one) == (0.0, "")
    own = nts.Spring(one, None, ends, energy=lambda x: 5e5 * (x - 1) ** 2 + (x - 1) ** 4)
    assert told([own], one)[0] == pytest.approx(10.0, rel=1e-6)
    two = body(3.0, centre=(0, 0, 0), name="two")
    worst, _ = told([nts.Spring(one, two, ends, stiffness=1e6)], one, two)
    assert worst == pytest.approx(10.0 * np.sqrt(1 + 1 / 3), rel=1e-9)
    arm = nts.Spring(one, None, [(1, 1, 0), (0, 1, 0)], stiffness=1e6)
    assert told([arm], one)[0] == pytest.approx(10.0 * np.sqrt(1 + 1 / 2.5), rel=1e-9)
    hinge = nts.Revolute(one, None, point=(0, 0, 0), axis=(0, 0, 1))
    worst, text = told([hinge, nts.TorsionSpring.about(hinge, stiffness=1e6)], one)
    assert worst == pytest.approx(10.0 / np.sqrt(3.5), rel=1e-9)
    assert "on an inertia of 3.5 is" in text
    # A light bracket on a heavy body moves with it.
    light = body(1e-3, (1e-3,) * 3, name="light")
    heavy = body(1e3, (1e3,) * 3, centre=(0, 0, 0), name="heavy")
    joints = [
        nts.Fixed(light, heavy, point=(1, 0, 0)),
        nts.Spring(light, None, [(1, 0, 0), (2, 0, 0)], stiffness=1e6),
    ]
    assert told(joints, light, heavy) == (0.0, "")
    driven = body(motion=(0, 0, 0), rotation=(0, 0, 0))
    assert told([nts.Spring(driven, None, ends, stiffness=1e6)], driven) == (0.0, "")


@pytest.mark.mpi
def test_a_motor_that_steps_do_not_resolve_is_told():
    """As the spring and the damper that it is: omega h and c h/m where a run starts."""

    def told_of(torque, **options):
        arm = nts.RigidBody.from_inertia(2, (1, 1, 1), centre=(0, 0, 0), angular_velocity=(0, 0, 1))
        motor = nts.Revolute(arm, None, point=(0, 0, 0), axis=Z, motor=torque, name="hinge")
        return told([motor], arm, **options)

    worst, text = told_of(lambda t, a, r: -2e4 * (a - 0.5))
    assert worst == pytest.approx(1e-2 * np.sqrt(2e4), rel=1e-6)
    assert text.startswith("'hinge motor' of stiffness 2e+04 on an inertia of 1 is not resolved")
    assert told_of(lambda t, a, r: -0.99e4 * a + t) == (0.0, "")
    assert told_of(lambda t, a, r: 2e4 * a) == (0.0, "")
    worst, text = told_of(lambda t, a, r: -1e4 * r, steps=2)
    assert worst == pytest.approx(50.0, rel=1e-6) and "c h/m = 100" in text
    # A jump has no slope, and a function that divides by its rate is asked at that of the arm.
    assert told_of(lambda t, a, r: 1.0 if a < 0.0 else -1.0) == (0.0, "")
    assert told_of(lambda t, a, r: 0.5 / r, steps=2) == (0.0, "")
    rod = nts.RigidBody.from_inertia(2.0, (1, 1, 1), centre=(1, 0, 0))
    ends = [(1, 0, 0), (0, 0, 0)]
    thrust = nts.Thrust(rod, None, ends, force=lambda t, x, r: -4e4 * (x - 1.0), name="cylinder")
    assert told([thrust], rod)[0] == pytest.approx(1e-2 * np.sqrt(2e4), rel=1e-6)


@pytest.mark.mpi
@pytest.mark.parametrize("rule", [nts.EnergyMomentum(), nts.Newmark()], ids=["em", "newmark"])
def test_a_damper_that_steps_do_not_resolve_is_told(rule):
    """At c h/m = 100 a step keeps 96 % of the velocity, turned round, where nothing should be."""
    body = nts.RigidBody.from_inertia(
        1.0, (1, 1, 1), centre=(1, 0, 0), velocity=(1, 0, 0), angular_velocity=(0, 0, 1)
    )
    damper = nts.Damper(body, None, [(1, 0, 0), (0, 0, 0)], damping=1e4)
    run = nts.simulate(nts.System([body], joints=[damper]), rule, dt=1e-2, t_end=2e-2)
    assert body.velocity[0] == pytest.approx(((1 - 50) / (1 + 50)) ** 2, rel=1e-3)
    assert run.warnings["unresolved"].worst == pytest.approx(50.0, rel=1e-9)
    assert "c h/m = 100" in run.warnings["unresolved"].text
    slow = nts.Damper(body, None, [(1, 0, 0), (0, 0, 0)], damping=199.0)
    assert told([slow], body, rule=rule, steps=3) == (0.0, "")
    hinge = nts.Revolute(body, None, point=(0, 0, 0), axis=(0, 0, 1))
    about = nts.TorsionDamper.about(hinge, damping=1e4)
    worst, text = told([hinge, about], body, rule=rule, steps=2)
    assert worst == pytest.approx(25.0, rel=1e-9) and "on an inertia of 2 is" in text


@pytest.mark.mpi
@pytest.mark.parametrize("rule", [nts.EnergyMomentum(), nts.GeneralizedAlpha()])
@pytest.mark.parametrize("unit", [1.0, 1e-3])
@pytest.mark.fast_on_ranks()
def test_a_stiff_damper_that_is_right_is_not_told(rule, unit):
    """Pulled from rest by F and by F sin(omega t) at c h/m = 100 it has gone F t/c, (1 - cos)/c."""
    c, omega = 1e4, 20.0
    pulls = lambda t: unit, lambda t: unit * np.sin(omega * t)
    ways = 0.2 / c, (1.0 - np.cos(omega * 0.2)) / (omega * c)
    for pull, way in zip(pulls, ways, strict=True):
        body = nts.RigidBody.from_inertia(
            1.0, np.full(3, unit**2), centre=(unit, 0, 0), force=lambda t, f=pull: (f(t), 0, 0)
        )
        damper = nts.Damper(body, None, [(unit, 0, 0), (0, 0, 0)], damping=c)
        assert told([damper], body, rule=rule, steps=20) == (0.0, "")
        assert body.position[0] / unit - 1.0 == pytest.approx(way, rel=2e-2)


@pytest.mark.mpi
@pytest.mark.parametrize(("stiffness", "way"), [(1e6, 1e-6), (1e6, 1e-8), (1.0, 1e-6), (1e9, 1e-4)])
@pytest.mark.fast_on_ranks("1000000.0-1e-06")
def test_statics_of_a_stiff_spring_needs_no_cut(stiffness, way):
    """Its force is as exact as a place 1 m from the origin is in 64 bits, and no more."""
    body = nts.RigidBody.from_inertia(
        1.0, (1, 1, 1), (1, 0, 0), force=lambda t: (stiffness * way * t, 0, 0)
    )
    held = nts.Prismatic(body, None, point=(1, 0, 0), axis=(1, 0, 0))
    spring = nts.Spring(body, None, [(1, 0, 0), (0, 0, 0)], stiffness=stiffness, length=1.0)
    found = nts.equilibrium(nts.System([body], joints=[held, spring]), load_steps=10)
    assert found.status == "completed" and found.retries == 0
    assert abs(body.position[0] - 1.0 - way) < 4e-16


@pytest.mark.mpi
@pytest.mark.parametrize("stiffness", [1e4, 1e9])
@pytest.mark.fast_on_ranks("1000000000.0")
@pytest.mark.fast("1000000000.0")
def test_a_body_at_rest_on_an_unstretched_spring_stays_there(stiffness):
    """The spring's force is the rounding of its length, which nothing else in the scene exceeds."""
    low = np.array([3.0, 0.0, 0.0])
    mesh = box(low, low + 0.5, 2)
    body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3)
    ends = [(3.5, 0.25, 0.25), (5.0, 0.25, 0.25)]
    spring = nts.Spring(body, None, points=ends, stiffness=stiffness)
    system = nts.System([body], joints=[spring])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=4e-3, t_end=0.1)
    assert run.status == "completed" and run.retries == 0
    assert np.abs(body.u.x.array).max() <= 4 * np.spacing(5.0)


@pytest.mark.mpi
@pytest.mark.parametrize("stiffness", [5e-3, 5e3])
def test_stabilization_of_springs_is_that_of_the_springs(stiffness):
    """No gravity and no flexible body: in any unit the same number of relaxations."""
    iterations = []
    for unit in (1 / UNITS[0], 1.0, UNITS[1]):
        pull = 0.2 * stiffness * unit
        body = nts.RigidBody.from_inertia(
            1.0, 3 * (unit**2,), (unit, 0, 0), force=lambda t, f=pull: (f * t, 0, 0)
        )
        ends = [(unit, 0, 0), (0, 0, 0)]
        joints = [
            nts.Prismatic(body, None, point=ends[0], axis=(1, 0, 0)),
            nts.Spring(body, None, ends, stiffness=stiffness, length=unit),
        ]
        found = nts.equilibrium(nts.System([body], joints=joints), stabilization=0.1)
        assert found.status == "completed" and found.retries == 0
        assert body.position[0] == pytest.approx(1.2 * unit, rel=1e-12)
        iterations.append(found.balance["newton_iterations"].tolist())
    assert iterations[0] == iterations[1] == iterations[2]


@pytest.mark.mpi
def test_stabilization_by_loads_is_one_number_in_all_load_steps():
    """0.1 of all of a dead force of 8 N over the half of 2 m, though it grows in ten steps."""
    bodies = [
        nts.RigidBody.from_inertia(
            1.0, (1, 1, 1), centre=(x, 0, 0), force=(0.0, 0.0, -8.0 * x), name=f"at {x}"
        )
        for x in (-1.0, 1.0)
    ]
    system = nts.System(bodies)
    problem = StepProblem(system, Static(), rtol=1e-9, condense=False)
    start, found = system.initial_state(), []
    for time in (0.0, 0.5):
        problem.begin(replace(start, time=time), 0.1)
        problem.stabilization.share = 0.1
        found += [problem.stabilization.of(body) for body in bodies]
        loads = [np.abs(body.external(0.0 * body.reference, np.zeros(3))).sum() for body in bodies]
        assert COMM.allreduce(sum(loads)) == pytest.approx(16.0 * (time + 0.1))
    problem.destroy()
    np.testing.assert_allclose(np.concatenate(found), 0.8, rtol=1e-13)
