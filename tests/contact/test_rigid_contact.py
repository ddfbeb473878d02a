"""Rigid bodies in contact: at rest, falling, sliding, stacked, with flexible bodies."""

from mpi4py import MPI

import numpy as np
import pytest
from gmsh_parts import of_gmsh
from integrators import MID_STEP
from scenes import box, everywhere
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
FLOOR = nts.Plane((0, 0, 0), (0, 0, 1))
G = 9.81


def grid(low, size, n, turn=None):
    low = np.array(low, dtype=float)
    mesh = box(low, low + np.array(size), list(n))
    if turn is not None:
        mesh.geometry.x[:] = mesh.geometry.x @ Rotation.from_rotvec(turn).as_matrix().T
    return mesh


def rigid(low, size, n=(1, 1, 1), turn=None, **options):
    return nts.RigidBody(grid(low, size, n, turn), density=1e3, **options)


def below(body, z=0.0):
    return body.surface(lambda x: x[2] < z + 1e-9 * max(1.0, abs(z)))


def above(body, z):
    return body.surface(lambda x: x[2] > z - 1e-9)


def energies(table):
    names = ("kinetic", "potential", "external_work")
    return max(float(np.abs(table[name]).max()) for name in names)


@pytest.mark.mpi
@pytest.mark.parametrize("nodes", [2, 3, 10])
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.fast("0.3-3", "0.0-2")
@pytest.mark.fast_on_ranks()
def test_a_box_at_rest_stays(nodes, friction):
    """On 4, 9 and 100 nodes: the weight is carried and nothing moves, however they are divided."""
    body = rigid((0, 0, 0), (1, 1, 1), (nodes - 1, nodes - 1, 1))
    pair = nts.ContactPair(slave=below(body), master=FLOOR, friction=friction)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=0.3)
    weight = body.mass * G
    assert run.status == "completed" and run.retries == 0 and not run.warnings.lines
    assert np.abs(run.contact_forces[1:, 0] - [0, 0, weight]).max() < 1e-10 * weight
    assert np.abs(body.position - body.centre).max() < 1e-13
    force = run.state.contacts[0].force
    everyone = np.concatenate(COMM.allgather(force))
    assert np.abs(everyone - weight / nodes**2).max() < 1e-9 * weight


@pytest.mark.mpi
def test_a_box_rests_in_a_groove():
    """Between two planes at 45 degrees, each of which carries W / sqrt 2."""
    turn = np.array([0.0, np.pi / 4, 0.0])
    body = rigid((-0.5, -0.5, -0.5), (1, 1, 1), turn=turn)
    lowest = np.array([0.0, 0.0, -np.sqrt(0.5)])
    normals = np.array([(1.0, 0.0, 1.0), (-1.0, 0.0, 1.0)]) / np.sqrt(2.0)
    pairs = [nts.ContactPair(body.surface(everywhere), nts.Plane(lowest, n)) for n in normals]
    system = nts.System([body], contacts=pairs, gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=0.1)
    forces, weight = run.contact_forces[1:], body.mass * G
    assert run.status == "completed" and run.retries == 0
    assert np.abs(forces - weight / np.sqrt(2.0) * normals).max() < 1e-10 * weight
    assert np.abs(body.position).max() < 1e-13


@pytest.mark.mpi
def test_a_leaning_weight_divides_by_least_norm():
    """Two contacts hold one brick against inclined gravity: of all forces the least squares."""
    body, lean = rigid((0, 0, 0), (1, 1, 1), (5, 3, 1)), 0.1
    halves = [body.surface(lambda x, s=s: (x[2] < 1e-9) & (s * (x[0] - 0.5) > 0)) for s in (-1, 1)]
    pairs = [nts.ContactPair(slave=half, master=FLOOR, friction=0.5) for half in halves]
    system = nts.System([body], contacts=pairs, gravity=(lean * G, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=0.1)
    weight = body.mass * G
    # Six nodes along x, four of each: the sum is the weight, its moment that of gravity at z = 0.5.
    x = np.repeat(np.linspace(-0.5, 0.5, 6), 4)
    rows = np.array([np.ones(24), x])
    least = np.linalg.pinv(rows) @ [weight, 0.5 * lean * weight]
    found = np.concatenate([np.concatenate(COMM.allgather(c.force)) for c in run.state.contacts])
    assert run.status == "completed"
    assert np.abs(np.sort(found) - np.sort(least)).max() < 1e-11 * weight


@pytest.mark.slow
def test_a_box_rests_for_a_thousand_steps():
    body = rigid((0, 0, 0), (1, 1, 1), (2, 2, 1))
    pair = nts.ContactPair(slave=below(body), master=FLOOR, friction=0.3)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=10.0)
    weight = body.mass * G
    assert run.status == "completed" and run.retries == 0 and not run.warnings.lines
    assert len(run.balance["time"]) == 1001
    assert np.abs(run.contact_forces[1:, 0, 2] - weight).max() < 1e-10 * weight
    assert np.abs(body.position - body.centre).max() < 1e-12
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * weight


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("friction", "accuracy", "promise"),
    [(0.0, "exact", 1e-11), (0.3, "exact", 1e-11), (0.3, "balanced", 1e-8)],
    ids=["frictionless", "friction", "balanced"],
)
@pytest.mark.parametrize(
    "turn", [(0, 0, 0), (0, 0.6, 0), (0.6, 0.5, 0.2)], ids=["flat", "edge", "corner"]
)
@pytest.mark.fast_on_ranks("edge-frictionless")
@pytest.mark.fast("corner-friction")
def test_a_box_dropped_closes_the_ledger(turn, friction, accuracy, promise):
    mesh = grid((-0.5, -0.5, -0.5), (1, 1, 1), (2, 2, 2), turn)
    low = COMM.allreduce(mesh.geometry.x[:, 2].min(), op=MPI.MIN)
    mesh.geometry.x[:, 2] += 0.02 - low
    body = nts.RigidBody(mesh, density=1e3)
    pair = nts.ContactPair(slave=body.surface(everywhere), master=FLOOR, friction=friction)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.2, accuracy=accuracy)
    table = run.balance
    assert run.status == "completed" and table["active"].max() > 0
    assert np.abs(table["ledger_residual"]).max() < promise * energies(table)
    assert table["min_gap"].min() > -1e-3 * promise
    assert np.abs(body.rotation.T @ body.rotation - np.eye(3)).max() < 0.1 * promise


@pytest.mark.mpi
@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize("uneven", [1e-8, 1e-5])
@pytest.mark.fast_on_ranks("1e-08-1.0")
def test_feet_in_no_plane_leave_one_in_the_air(uneven, speed):
    """Four gaps that repeat each other but for rounding cannot all close: one foot is longer."""
    mesh = grid((0, 0, 0), (1, 1, 1), (1, 1, 1))
    x = mesh.geometry.x
    x[(np.abs(x) < 1e-9).all(axis=1), 2] -= uneven
    body, dt = nts.RigidBody(mesh, density=1e3, velocity=(0, 0, -speed)), 1e-3
    floor = nts.Plane((0, 0, -uneven - 0.5 * speed * dt), (0, 0, 1))
    pair = nts.ContactPair(slave=below(body, 1e-4), master=floor)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=5 * dt)
    assert run.status == "completed" and run.retries == 0
    assert run.balance["min_gap"].min() > -1e-12
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * body.mass * G


@pytest.mark.mpi
def test_a_pinned_bar_strikes_a_plane():
    """Its place is prescribed, so that gaps depend on its turn alone."""
    body = rigid((-1, -0.1, -0.1), (2, 0.2, 0.2), motion=(0, 0, 0), angular_velocity=(0, 1, 0))
    pair = nts.ContactPair(
        slave=body.surface(lambda x: x[0] > 1 - 1e-9), master=nts.Plane((0, 0, -0.12), (0, 0, 1))
    )
    run = nts.simulate(
        nts.System([body], contacts=[pair]), nts.EnergyMomentum(), dt=5e-3, t_end=0.04
    )
    table, before = run.balance, run.balance["energy"][0]
    assert run.status.startswith("completed") and table["min_gap"].min() > -1e-12
    assert body.angular_velocity[1] < 0.0
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * before


@pytest.mark.mpi
def test_a_body_that_may_not_turn_flies_above_a_plane():
    """It has no constraints of its own, so that there may be no element on any rank."""
    body = rigid((0, 0, 1), (1, 1, 1), rotation=(0, 0, 0), velocity=(1, 0, 0))
    pair = nts.ContactPair(slave=below(body, 1.0), master=FLOOR)
    system = nts.System([body], contacts=[pair])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=0.1)
    assert run.status == "completed" and not run.balance["active"].any()
    assert body.position == pytest.approx([0.6, 0.5, 1.5], abs=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("part", [0.999, 1.001])
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("1.001")
def test_a_brick_on_a_slope_slides_below_the_limit_alone(part):
    """B5: mu = tan(angle) less and plus one part in a thousand."""
    angle = 0.3
    mu = part * np.tan(angle)
    body = rigid((0, 0, 0), (0.2, 0.1, 0.05), (2, 2, 1))
    pair = nts.ContactPair(slave=below(body), master=FLOOR, friction=mu)
    gravity = (G * np.sin(angle), 0, -G * np.cos(angle))
    system = nts.System([body], contacts=[pair], gravity=gravity)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-2, t_end=1.0)
    pull = G * (np.sin(angle) - mu * np.cos(angle))
    exact = 0.5 * pull if pull > 0.0 else 0.0
    assert run.status == "completed"
    assert body.position[0] - body.centre[0] == pytest.approx(exact, rel=1e-6, abs=1e-13)


def tower():
    """Five bricks on one another and on the floor, with friction."""
    bodies = [
        rigid((0, 0, k), (1, 1, 1), (1 + k % 2, 1 + k % 2, 1), name=f"b{k}") for k in range(5)
    ]
    pairs = [nts.ContactPair(slave=below(bodies[0]), master=FLOOR, friction=0.5)]
    pairs += [
        nts.ContactPair(
            slave=below(bodies[k + 1], k + 1), master=above(bodies[k], k + 1), friction=0.5
        )
        for k in range(4)
    ]
    return nts.System(bodies, contacts=pairs, gravity=(0, 0, -G))


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_tower_of_five_stands():
    system = tower()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-2, t_end=0.4)
    carried = run.contact_forces[-1, :, 2] / (system.bodies[0].mass * G)
    assert run.status == "completed" and carried == pytest.approx([5, 4, 3, 2, 1], rel=1e-9)
    assert max(np.abs(b.position - b.centre).max() for b in system.bodies) < 1e-12


@pytest.mark.mpi
@pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.parametrize("slave", ["rigid", "soft"])
@pytest.mark.fast("rigid-energy-momentum")
@pytest.mark.fast_on_ranks()
def test_momenta_with_a_flexible_body(slave, rule):
    """A turning rigid box on a soft cube with friction, as slave and as master."""
    one = rigid(
        (0.1, 0.1, 1.01), (0.6, 0.7, 0.5), (2, 2, 2), velocity=(1, 0, -3),
        angular_velocity=(0, 1, 0), name="rigid",
    )  # fmt: skip
    two = nts.Continuum(
        grid((0, 0, 0), (1, 1, 1), (3, 3, 3)), nts.NeoHookean(1e6, 0.3), density=1e3, name="soft"
    )
    sides = below(one, 1.01), above(two, 1.0)
    if slave == "soft":
        sides = sides[::-1]
    pair = nts.ContactPair(slave=sides[0], master=sides[1], friction=0.3)
    run = nts.simulate(nts.System([one, two], contacts=[pair]), rule, dt=2e-3, t_end=0.04)
    table = run.balance
    assert run.status.startswith("completed") and table["slip"].max() > 0
    for name in ("linear_momentum", "angular_momentum"):
        size = np.abs(table[name]).max()
        assert np.ptp(table[name], axis=0).max() < 1e-12 * max(size, 1e3)
    if rule.closes_ledger:
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]


def floor_of(kind, acceleration):
    """What a brick on z = 0 stands on, its bodies, and gravity [m/s^2] for a base acceleration."""
    if kind == "inclined gravity":
        return FLOOR, [], (-acceleration, 0, -G)

    def motion(t):
        return (0.5 * acceleration * t**2, 0, 0)

    if kind == "plane":
        return nts.Plane((0, 0, 0), (0, 0, 1), motion=motion), [], (0, 0, -G)
    table = rigid((-0.5, -0.5, -0.1), (1, 1, 0.1), name="table", motion=motion, rotation=(0, 0, 0))
    return above(table, 0.0), [table], (0, 0, -G)


@pytest.mark.parametrize("push", [0.99, 1.01])
@pytest.mark.parametrize("kind", ["inclined gravity", "plane", "table"])
@pytest.mark.fast("inclined gravity-1.01")
def test_a_brick_tips_at_b_over_h_times_g(kind, push):
    """Its base accelerates, or gravity is inclined: it tips above b/h g alone."""
    b, h = 0.1, 0.4
    body = rigid((0, 0, 0), (b, 0.1, h), (2, 1, 2))
    floor, others, gravity = floor_of(kind, -push * b / h * G)
    pair = nts.ContactPair(slave=below(body), master=floor, friction=2.0)
    system = nts.System([body, *others], contacts=[pair], gravity=gravity)
    start = body.rotation
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=0.6)
    angle = np.arcsin(np.abs((body.rotation @ start.T)[0, 2]))
    table = run.balance
    assert run.status.startswith("completed")
    assert kind == "inclined gravity" or (
        np.abs(table["ledger_residual"]).max() < 1e-11 * energies(table)
    )
    if push < 1.0:
        assert angle < 1e-12
        return
    # About its edge: (b^2 + h^2)/3 angle'' = (a h - g b)/2 + (a b + g h)/2 angle, small angles.
    a = push * b / h * G
    fast = np.sqrt(1.5 * (a * b + G * h) / (b**2 + h**2))
    grown = (a * h - G * b) / (a * b + G * h) * (np.cosh(fast * run.state.time) - 1.0)
    assert angle == pytest.approx(grown, rel=0.01)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_equilibrium_on_a_soft_cube():
    """The rigid box settles; what carries it is its weight."""
    soft = nts.Continuum(
        grid((0, 0, 0), (1, 1, 1), (2, 2, 2)), nts.NeoHookean(1e6, 0.3), density=1e3, name="soft",
        bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)],
    )  # fmt: skip
    for friction in (0.3, 0.0):
        body = rigid((0.2, 0.2, 1.0), (0.6, 0.6, 0.5), (2, 2, 2), name="rigid")
        pair = nts.ContactPair(slave=below(body, 1.0), master=above(soft, 1.0), friction=friction)
        system = nts.System([body, soft], contacts=[pair], gravity=(0, 0, -G))
        found = nts.equilibrium(system)
        assert found.contact_forces[-1, 0] == pytest.approx([0, 0, body.mass * G], abs=1e-8)
        assert 1.2 < body.position[2] < 1.25
        assert found.status == "completed"


def test_equilibrium_names_a_rigid_body_that_may_slide():
    body = rigid((0, 0, 0), (0.2, 0.1, 0.05), (2, 2, 1), name="brick")
    pair = nts.ContactPair(slave=below(body), master=FLOOR)
    found = nts.equilibrium(nts.System([body], contacts=[pair], gravity=(0, 0, -G)))
    assert "nothing resists body 'brick'" in found.status


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_equilibrium_names_the_body_that_falls(monkeypatch):
    """Of two, that which has no support, after ten relaxations as after all."""
    monkeypatch.setattr("dolfinx_nts.run.load_steps._RELAXATIONS", 10)
    brick = rigid((0, 0, 0), (0.2, 0.1, 0.05), (2, 2, 1), name="brick")
    loose = nts.RigidBody.from_inertia(1.0, (1, 1, 1), (0, 0, 5), name="loose", comm=COMM)
    pair = nts.ContactPair(slave=below(brick), master=FLOOR)
    system = nts.System([brick, loose], contacts=[pair], gravity=(0, 0, -G))
    found = nts.equilibrium(system, stabilization=0.1)
    assert "body 'loose' is not at rest after 10 relaxations, the last of which" in found.status
    assert "nothing holds it" in found.status


def disc(facets, radius=0.1, width=0.02):
    """A ring of hexahedra about the y axis, which stands on z = 0."""
    angle = np.linspace(0, 2 * np.pi, facets, endpoint=False)
    rims = [(y, r) for y in (0.0, width) for r in (0.6 * radius, radius)]
    points = [(r * np.cos(a), y, r * np.sin(a) + radius) for y, r in rims for a in angle]
    k = np.arange(facets)
    both = [n * facets + (k + step) % facets for n in range(4) for step in (0, 1)]
    # Corners in DOLFINx's order: radius, angle, width.
    cells = np.array([both[i] for i in (0, 2, 1, 3, 4, 6, 5, 7)]).T
    return compat.create_mesh(COMM, cells.astype(np.int64), np.array(points), "hexahedron")


@pytest.mark.slow
def test_a_disc_slides_until_it_rolls():
    """192 facets; v = v0 R^2/(R^2 + k^2) when it rolls, and friction takes the rest."""
    radius, mu = 0.1, 0.2
    body = nts.RigidBody(disc(192), density=1e3, velocity=(1, 0, 0), name="disc")
    slave = body.surface(lambda x: np.hypot(x[0], x[2] - radius) > 0.999 * radius)
    pair = nts.ContactPair(slave=slave, master=FLOOR, friction=mu)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -G))
    rolls = 1.0 / (1.0 + body.moments.max() / (body.mass * radius**2))
    time = (1.0 - rolls) / (mu * G)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=1.3 * time)
    table = run.balance
    assert run.status.startswith("completed")
    # On facets it goes on with 6 % more and less of its turn, at a phase that rounding chooses.
    late = table["time"] > 1.05 * time
    push, turn = (table[f"{kind}_momentum"][late].mean(axis=0) for kind in ("linear", "angular"))
    rate = (turn[1] - radius * push[0]) / body.moments.max()
    assert push[0] / body.mass == pytest.approx(rolls, rel=0.02)
    assert rate * radius == pytest.approx(rolls, rel=0.02)
    taken = 0.5 * body.mass * (1.0 - rolls)
    assert table["friction_dissipation"][-1] == pytest.approx(taken, rel=0.01)
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]


def ball(facets, radius=0.1):
    """A hollow ball of hexahedra, which stands on z = 0, with this many facets around its middle.

    Six faces of a cube, divided evenly by angle, so that nodes lie on the circle y = 0.
    """
    n = facets // 4
    slope = np.tan(np.linspace(-0.25 * np.pi, 0.25 * np.pi, n + 1))
    u, v = (a.ravel() for a in np.meshgrid(slope, slope, indexing="ij"))
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]], axis=-1)
    faces = [
        np.roll(np.column_stack([np.full_like(u, side), side * u, v]), axis, axis=1)
        for axis in range(3)
        for side in (-1.0, 1.0)
    ]
    points = np.concatenate(faces)
    points /= np.linalg.norm(points, axis=1)[:, None]
    cells = np.concatenate([quads.reshape(-1, 4) + k * (n + 1) ** 2 for k in range(6)])
    _, first, same = np.unique(
        points.round(9) + 0.0, axis=0, return_index=True, return_inverse=True
    )
    cells, points = same[cells], points[first]
    both = np.concatenate([0.6 * radius * points, radius * points]) + (0, 0, radius)
    hexahedra = np.concatenate([cells, cells + len(points)], axis=1)
    return compat.create_mesh(COMM, hexahedra.astype(np.int64), both, "hexahedron")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "facets", "gyration"),
    # Radius of gyration over the radius, squared, of a round body whose hollow is 0.6 as wide.
    [(disc, 192, 0.5 * (1 + 0.6**2)), (ball, 96, 0.4 * (1 - 0.6**5) / (1 - 0.6**3))],
    ids=["roller", "ball"],
)
def test_rolling_in_a_bore_swings_as_rolling_says(make, facets, gyration):
    """From rest at 0.3 rad: a quarter of its period, elliptic integral and all."""
    radius, bore, tilt = 0.1, 0.5, 0.3
    mesh, turn = make(facets), Rotation.from_rotvec((0, -tilt, 0)).as_matrix()
    place = (bore - radius) * np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    mesh.geometry.x[:] = (mesh.geometry.x - (0, 0, radius)) @ turn.T + place
    body = nts.RigidBody(mesh, density=1e3, name="roller")

    def rolls_on(x):
        y = x - place[:, None]
        far = np.hypot(y[0], y[2]) if make is disc else np.linalg.norm(y, axis=0)
        return (far > 0.999 * radius) & (np.abs(y[1]) < 0.3 * radius)

    hollow = nts.Cylinder((0, 0, 0), (0, 1, 0), bore, inside=True)
    pair = nts.ContactPair(slave=body.surface(rolls_on), master=hollow, friction=2.0)
    inertia = 1.0 + gyration
    quarter = ellipk(np.sin(0.5 * tilt) ** 2) * np.sqrt((bore - radius) * inertia / G)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -G))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    before = [0.0, body.position[0]]
    while body.position[0] > 0.0:
        before = [stepper.state.time, body.position[0]]
        stepper.advance(1e-3)
    after = [stepper.state.time, body.position[0]]
    passes = np.interp(0.0, [after[1], before[1]], [after[0], before[0]])
    table = stepper.solution.balance
    stepper.close()
    assert passes == pytest.approx(quarter, rel=0.01)
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["kinetic"].max()


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_block_in_a_corner_of_three_planes_rests(friction):
    """It is held more often than it has freedom; an iterate that is not finite spoils no other.

    Its factors were kept, and all shorter steps failed with them.
    """

    def draw(occ):
        whole, cut = occ.addBox(0, 0, 0, 0.05, 0.04, 0.06), occ.addBox(0.03, 0.02, 0.05, 1, 1, 1)
        return occ.cut([(3, whole)], [(3, cut)])[0]

    block = of_gmsh(draw, 0.02).rigid(density=1100.0, name="block")
    own, gravity = block.surface(everywhere), np.array([-3.0, -2.0, -9.81])
    planes = [nts.Plane((0, 0, 0), normal) for normal in np.eye(3)]
    pairs = [nts.ContactPair(own, plane, friction=friction) for plane in planes]
    system = nts.System([block], contacts=pairs, gravity=gravity)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.02)
    assert run.status == "completed"
    weight = -block.mass * gravity
    assert run.contact_forces[-1].sum(axis=0) == pytest.approx(weight, rel=1e-6)
    assert np.abs(block.position - block.centre).max() < 1e-9
