"""No node passes through a master within a step, and none that passed beside one is moved out."""

from mpi4py import MPI

import numpy as np
import pytest
from integrators import CONTACT_RULES
from measures import OPEN, PROMISED, ledger_or_word
from pairs import pairs
from point_mass import MASS, PointMass, PointSurface
from scenes import RUBBER, box
from scipy.interpolate import LinearNDInterpolator

import dolfinx_nts as nts
from dolfinx_nts.contact import passages

COMM = MPI.COMM_WORLD


def plate(value=(0.0, 0.0, 0.0), *, width=4.0, thickness=0.02, cells=8):
    """A plate below z = 0 that moves as prescribed everywhere, and its top."""
    half = 0.5 * width
    body = nts.Continuum(
        box([-half, -half, -thickness], [half, half, 0], [cells, cells, 1]),
        nts.StVenantKirchhoff(young=1.0, poisson=0.3),
        density=1.0,
        name="plate",
        bcs=[nts.Dirichlet(lambda x: np.full(x.shape[1], True), value)],
    )
    return body, body.surface(lambda x: x[2] > -1e-9)


def shot(position, velocity, master, bodies=(), gravity=(0.0, 0.0, 0.0)):
    """A point mass that flies at a master."""
    mass = PointMass(COMM, MASS, position, velocity)
    pair = nts.ContactPair(slave=PointSurface(mass, position), master=master)
    return nts.System([mass, *bodies], contacts=[pair], gravity=gravity)


# ---- paths and facets
def through(x, d, triangle):
    """The part of the way after which a line meets a triangle from its front, or inf."""
    a, b, c = triangle
    normal = np.cross(b - a, c - a)
    if d @ normal >= 0.0:
        return np.inf
    part = (a - x) @ normal / (d @ normal)
    weights = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), x + part * d - a, rcond=None)[0]
    inside = weights.min() >= 0.0 and weights.sum() <= 1.0
    return part if inside and 0.0 <= part <= 1.0 else np.inf


def sheet(corners, cells=8):
    """Points of a square of 4 x 4 in the plane z = 0 and its facets, which look upwards."""
    line = np.linspace(-2, 2, cells + 1)
    x = np.stack([*np.meshgrid(line, line, indexing="ij"), np.zeros((cells + 1,) * 2)], axis=-1)
    first = np.add.outer((cells + 1) * np.arange(cells), np.arange(cells)).ravel()
    quads = first[:, None] + [0, cells + 1, cells + 2, 1]
    halves = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return x.reshape(-1, 3), quads if corners == 4 else halves


@pytest.mark.parametrize("corners", [3, 4])
@pytest.mark.parametrize("angle", [0.0, 0.01, 0.1, 0.3, 1.0])
@pytest.mark.fast("0.01-3", "0.1-4")
def test_no_path_slips_between_facets_that_turn(corners, angle):
    """Points go from above to below a plate that turns by an angle, and with it.

    Of the rotation R about p x z, corners move to M(t) X = (1 - t) X + t R X and the normal is
    (1 - t + t c) z - t s p, with c, s = cos, sin(angle). So the height of a point that goes from
    X + a z to R (X - b z) is (1 - t) a (1 - t + t c) - t b (t + c (1 - t)).
    """
    random = np.random.default_rng(int(100 * angle))
    x, facets = sheet(corners)
    p, z = np.array([0.6, -0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    k, c, s = np.cross(z, p), np.cos(angle), np.sin(angle)
    turn = np.outer(k, k) + c * (np.outer(p, p) + np.outer(z, z))
    turn += s * (np.outer(z, p) - np.outer(p, z))
    n = 30_000
    foot = np.column_stack([random.uniform(-1.5, 1.5, (n, 2)), np.zeros(n)])
    a, b = random.uniform(0.05, 0.3, (2, n))
    start, end = foot + a[:, None] * z, (foot - b[:, None] * z) @ turn.T
    corner = x[facets]
    hit, when = passages.first_hits(start, end - start, corner, corner @ turn.T - corner)
    assert (hit >= 0).all()
    height = (1 - when) * a * (1 - when + when * c) - when * b * (when + c * (1 - when))
    assert np.abs(height).max() < 1e-14
    # At that instant the path is at the facet.
    there = (1 - when[:, None, None]) * corner[hit] + when[:, None, None] * (corner @ turn.T)[hit]
    point = start + when[:, None] * (end - start)
    beyond = np.maximum(there.min(axis=1) - point, point - there.max(axis=1))
    assert beyond.max() < 1e-6


@pytest.mark.parametrize("corners", [3, 4])
@pytest.mark.fast("3")
def test_no_path_slips_through_a_sheet_that_crumples(corners):
    """Each corner has a motion of its own, by a fifth of a facet; every path crosses the sheet."""
    random = np.random.default_rng(corners)
    x, facets = sheet(corners)
    x, motion = x + random.uniform(-0.1, 0.1, x.shape), random.uniform(-0.1, 0.1, x.shape)
    n = 30_000
    start = np.column_stack([random.uniform(-1.6, 1.6, (n, 2)), np.full(n, 0.21)])
    path = np.column_stack([random.uniform(-0.1, 0.1, (n, 2)), np.full(n, -0.42)])
    hit, _ = passages.first_hits(start, path, x[facets], motion[facets])
    assert (hit >= 0).all()


@pytest.mark.parametrize("corners", [3, 4])
def test_first_hits_of_facets_that_turn_against_all_pairs(corners):
    """Roots of numpy of the polynomial through four of its values."""
    random = np.random.default_rng(corners)
    facets = random.uniform(-1, 1, (60, 1, 3)) + 0.6 * random.normal(size=(60, corners, 3))
    moved = 0.7 * random.normal(size=(60, corners, 3))
    points, motion = random.uniform(-1, 1, (60, 3)), random.normal(size=(60, 3))
    found, when = passages.first_hits(points, motion, facets, moved)
    parts, at = [[0, 1, 2], [0, 2, 3]][: corners - 2], np.array([0.0, 0.3, 0.7, 1.0])

    def times(x, d, start, change):
        def frame(t):
            a, b, c = start + t * change
            return x + t * d - a, b - a, c - a

        values = [np.linalg.det(frame(t)) for t in at]
        cubic = np.poly1d(np.polyfit(at, values, 3))
        for root in cubic.roots:
            t = root.real
            if abs(root.imag) < 1e-9 and 0 <= t <= 1 and cubic.deriv()(t) < 0:
                offset, *edges = frame(t)
                w = np.linalg.lstsq(np.transpose(edges), offset, rcond=None)[0]
                if w.min() >= 0 and w.sum() <= 1:
                    yield t

    for x, d, f, t in zip(points, motion, found, when, strict=True):
        each = [
            min((s for p in parts for s in times(x, d, c[p], m[p])), default=np.inf)
            for c, m in zip(facets, moved, strict=True)
        ]
        assert np.isclose(t, min(each), rtol=1e-8) or t == min(each)
        assert f == (-1 if np.isinf(t) else int(np.argmin(each)))
    assert 10 < (found >= 0).sum() < 55


# ---- masses
@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.parametrize("obstacle", [False, True])
@pytest.mark.fast_on_ranks("False-energy-momentum", "True-midpoint")
def test_a_mass_at_rest_that_falls_far_in_a_step(obstacle, integrator):
    """Nothing at its start tells that it will move: v = 0, g = 9.81, h = 0.5, 0.2 m above."""
    body, top = plate()
    master = nts.Plane((0, 0, 0), (0, 0, 1)) if obstacle else top
    bodies = [] if obstacle else [body]
    system = shot((0.3, 0.2, 0.2), (0, 0, 0), master, bodies, gravity=(0, 0, -9.81))
    run = nts.simulate(system, CONTACT_RULES[integrator], dt=0.5, t_end=0.5)
    assert run.status == "completed" and run.balance["active"].tolist() == [0, 1]
    # It ends on the plate: v_1 = 2 du/h - v_0, and what the gap costs is force x gap.
    speed = COMM.bcast(system.bodies[0].v)[2]
    assert np.isclose(speed, -2 * 0.2 / 0.5, rtol=1e-12)
    force = MASS * (speed / 0.5 + 9.81)
    assert np.isclose(run.balance["contact_defect"][-1], 0.2 * force, rtol=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.parametrize("aim", [(0.0, 0.0), (150.0, 60.0), (-290.0, 10.0)])
@pytest.mark.fast_on_ranks("aim0-energy-momentum", "aim1-midpoint", "aim2-gonzalez contact")
@pytest.mark.fast("aim0-energy-momentum", "aim1-midpoint", "aim2-gonzalez contact")
def test_a_shot_at_a_thin_plate(aim, integrator):
    """Through several facets a step, from beside the plate, too: it bounces as at a plane (B6)."""
    speed, dt = 300.0, 0.01
    height = 0.2 * speed * dt
    # Where the path meets the plate, whatever its direction.
    start = (0.3 - 0.2 * dt * aim[0], 0.1 - 0.2 * dt * aim[1], height)
    body, top = plate()
    system = shot(start, (*aim, -speed), top, [body])
    run = nts.simulate(system, CONTACT_RULES[integrator], dt=dt, t_end=2 * dt)
    assert run.status == "completed" and run.balance["active"].tolist() == [0, 1, 0]
    v = COMM.bcast(system.bodies[0].v)
    assert np.allclose(v, [*aim, (1 - 2 * 0.2) * speed], rtol=0, atol=1e-9 * speed)


@pytest.mark.mpi
@pytest.mark.parametrize(
    "obstacle", [nts.Sphere((0, 0, 0), 0.1), nts.Cylinder((0, 0, 0), (0, 1, 0), 0.1)]
)
def test_a_shot_at_a_small_obstacle(obstacle):
    """Whose ends lie outside of it: the step is cut until the node meets the obstacle."""
    system = shot((0.0, 0.0, 0.53), (0, 0, -100.0), obstacle)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.02)
    assert run.status == "completed" and run.retries > 0
    assert run.balance["active"].max() == 1
    x = COMM.bcast(system.bodies[0].u) + [0, 0, 0.53]
    assert x[2] > 0.1


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.fast_on_ranks("energy-momentum")
@pytest.mark.fast("midpoint")
def test_a_mass_that_came_from_beside_is_not_moved_through_the_plate(integrator):
    """It passes the plate's edge, sinks below its top, and the plate moves over it and away."""

    def sideways(t):
        return (0.6 * np.sin(np.pi * t), 0.0, 0.0)

    body, top = plate(sideways, thickness=1.0, width=4.0, cells=4)
    start = (2.3, 0.1, 0.02)
    system = shot(start, (0.0, 0.0, -0.2), top, [body])
    run = nts.simulate(system, CONTACT_RULES[integrator], dt=0.02, t_end=1.0)
    table = run.balance
    v = COMM.bcast(system.bodies[0].v)
    assert np.allclose(v, [0, 0, -0.2], rtol=0, atol=1e-12)
    assert table["active"].max() == 0 and np.abs(table["contact_defect"]).max() == 0.0


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_body_that_came_from_beside_is_told_of_once_it_is_inside():
    """A cube that sinks below the plate's top before the plate, of which its sides are none."""
    body, top = plate(lambda t: (0.6 * np.sin(np.pi * t), 0.0, 0.0), thickness=1.0, cells=4)
    cube = nts.RigidBody(
        box([2.2, 0.0, 0.02], [2.4, 0.2, 0.22], [1] * 3), density=1e3, velocity=(0, 0, -0.6),
        name="cube",
    )  # fmt: skip
    pair = nts.ContactPair(cube.surface(lambda x: x[2] < 0.02 + 1e-9), top)
    run = nts.simulate(
        nts.System([cube, body], contacts=[pair]), nts.EnergyMomentum(), dt=0.02, t_end=0.6
    )
    told = run.warnings["node inside a body"]
    assert told.grave and told.about == tuple(sorted(("cube", body.name)))
    # In the end its bottom is nearer to the plate's top than to its side.
    assert told.worst == pytest.approx(0.6 * 0.6 - 0.02, rel=1e-9)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integrator", "accuracy", "dt", "n"),
    [
        ("energy-momentum", "balanced", 2e-3, 4), ("midpoint", "exact", 5e-4, 3),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_cubes_off_centre_win_no_energy(integrator, accuracy, dt, n):
    """Slaves that passed below the master's rim and came back won half the energy."""
    bodies = [
        nts.Continuum(box([0, 0, 0], [1, 1, 1], [n] * 3), RUBBER, density=1e3, name="left",
                      velocity=(2, 0, 0)),
        nts.Continuum(box([1.05, 0.01, 0.01], [2.05, 1.01, 1.01], [n] * 3), RUBBER, density=1e3,
                      name="right"),
    ]  # fmt: skip
    pair = nts.ContactPair(
        slave=bodies[0].surface(lambda x: x[0] > 1 - 1e-9),
        master=bodies[1].surface(lambda x: x[0] < 1.05 + 1e-9),
    )
    system = nts.System(bodies, contacts=[pair])
    rule = CONTACT_RULES[integrator]
    run = nts.simulate(system, rule, dt=dt, t_end=0.12, accuracy=accuracy)
    table, energy = run.balance, run.balance["energy"]
    # All nodes, those of the master's rim that slaves have left, and where the rims cross.
    assert run.status == "completed" and n * n <= table["active"].max() <= n * n + 2 * n - 1 + 2
    assert np.diff(energy).max() <= 1e-3 * energy[0]
    assert 0.9 * energy[0] < energy[-1] < energy[0]
    ledger_or_word(run, PROMISED[accuracy] if rule.closes_ledger else OPEN)
    # What the midpoint rule itself does to the energy is none of contact.
    own = 0.0 if rule.closes_ledger else table["ledger_residual"]
    assert (energy - own).max() <= energy[0] * (1 + 1e-11)


class Touches:
    """Writer that notes heights and contact forces of a pair's slaves at the accepted states."""

    def start(self, stepper):
        self.heights, self.forces, self.times = [], [], []
        self.write(stepper)

    def write(self, stepper, last=False):
        (pair,), state = stepper.system.contacts, stepper.state
        x, share = pair.slave.positions(state.u[0]), pair.slave.share
        self.heights.append(x[share, 2])
        self.forces.append(state.contacts[0].force.copy())
        self.times.append(state.time)

    def close(self, stepper):
        pass

    @property
    def losses(self):
        """What each step should have lost: p_N times the height at its start [J]."""
        pairs = zip(self.forces[1:], self.heights[:-1], strict=True)
        return np.array([COMM.allreduce(float(force @ height)) for force, height in pairs])

    @property
    def lowest(self):
        return COMM.allreduce(min(h.min(initial=1.0) for h in self.heights), op=MPI.MIN)


def over(meshed, young=1e6, velocity=(0.0, 0.0, 0.0), gravity=9.81, gap=0.2):
    """A block of rubber over a fixed floor z = 0 of facets of 0.25 m, or a plane."""
    block = nts.Continuum(
        box([0.13, 0.17, gap], [0.63, 0.67, gap + 0.5], [2] * 3),
        nts.NeoHookean(young=young, poisson=0.3), density=1e3, velocity=velocity, name="block",
    )  # fmt: skip
    body, top = plate(cells=16)
    pair = nts.ContactPair(
        slave=block.surface(lambda x: x[2] < gap + 1e-9),
        master=top if meshed else nts.Plane((0, 0, 0), (0, 0, 1)),
    )
    bodies = [block, body] if meshed else [block]
    return nts.System(bodies, contacts=[pair], gravity=(0, 0, -gravity))


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize("meshed", [False, True])
@pytest.mark.parametrize("integrator", ["midpoint", "energy-momentum"])
def test_no_first_contact_wins_energy(integrator, meshed):
    """What contact brings is -p g_0: only a node behind its facet at t_n could bring energy.

    A first contact has none, as no node comes there unseen: from random speeds, heights and steps,
    straight and aslant, through up to ten facets in a step, the nodes are outside at the start and
    at the end, what is lost is the sum of p g_0, and that is positive.
    """
    random, rule = np.random.default_rng(3), CONTACT_RULES[integrator]
    met = 0
    for _ in range(8):
        gap, dt = 10.0 ** random.uniform(-6, -0.3), 10.0 ** random.uniform(-3.5, -1)
        # Stiff enough for any of these speeds.
        speed = 2 * gap / dt * 10.0 ** random.uniform(-0.2, 0.7)
        aslant = 0.5 * min(speed, 1.0 / dt) * random.uniform(-1, 1, 2)
        young = 1e4 * max(1e3, speed**2 * 1e3)
        system, seen = over(meshed, young, (*aslant, -speed), 9.81, gap), Touches()
        run = nts.simulate(system, rule, dt=dt, t_end=3 * dt, output=[seen])
        table = run.balance
        assert run.status.startswith("completed") and seen.lowest > -1e-9 * (gap + speed * dt)
        first = int(np.argmax(table["active"] > 0))
        if first == 0:
            continue
        met += 1
        gain = -np.diff(table["contact_defect"])[first - 1]
        force_times_gap, scale = seen.losses[first - 1], table["kinetic"].max()
        assert gain <= 0.0 and force_times_gap > 0.0
        assert abs(gain + force_times_gap) < 1e-9 * scale
        assert "energy from behind facets" not in run.warnings
    assert met >= 6


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "integrator", "accuracy"),
    pairs([100.0, 300.0], ["midpoint", "energy-momentum"], ["exact", "balanced"]),
)
def test_a_shot_at_a_thin_flexible_plate(speed, integrator, accuracy):
    """In a step the block moves by 25 or 75 times the plate's thickness; the plate gives way."""
    half, thickness, gap, dt = 1.0, 0.02, 0.35, 5e-3
    hard = nts.NeoHookean(young=1e10, poisson=0.3)
    held = nts.Dirichlet(lambda x: np.abs(x[:2]).max(axis=0) > half - 1e-9)
    sheet = nts.Continuum(
        box([-half, -half, -thickness], [half, half, 0], [8, 8, 1]), hard, density=1e3,
        name="plate", bcs=[held],
    )  # fmt: skip
    block = nts.Continuum(
        box([0.13, 0.17, gap], [0.33, 0.37, gap + 0.2], [2] * 3), hard, density=1e3,
        velocity=(0, 0, -speed), name="block",
    )  # fmt: skip
    pair = nts.ContactPair(
        block.surface(lambda x: x[2] < gap + 1e-9), sheet.surface(lambda x: x[2] > -1e-9)
    )
    system, rule = nts.System([block, sheet], contacts=[pair]), CONTACT_RULES[integrator]
    run = nts.simulate(system, rule, dt=dt, t_end=4 * dt, accuracy=accuracy)
    table = run.balance
    # Of a hard block the corners alone may meet a plate that gives way.
    assert table["active"].max() > 0 and table["energy"].max() <= table["energy"][0] * (1 + OPEN)
    ledger_or_word(run, PROMISED[accuracy] if rule.closes_ledger else OPEN)
    # Whatever the plate's shape: the block's lower nodes are over its top, not below it.
    x = (block.reference + run.state.u[0]).reshape(-1, 3)
    low = np.concatenate(COMM.allgather(x[block.reference[2::3] < gap + 1e-9]))
    y = (sheet.reference + run.state.u[1]).reshape(-1, 3)
    top = np.concatenate(COMM.allgather(y[sheet.reference[2::3] > -1e-9]))
    above = low[:, 2] - LinearNDInterpolator(top[:, :2], top[:, 2])(low[:, :2])
    assert above.min() > -thickness
    if not run.status.startswith("completed"):
        assert "inside out" in run.status and "another energy may prevent it" in run.status


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", ["midpoint", "energy-momentum"])
@pytest.mark.fast_on_ranks("energy-momentum")
@pytest.mark.fast("midpoint")
def test_a_block_at_rest_over_a_soft_plate(integrator):
    """6 mm above facets of 1 cm, in steps of 50 ms: the first steps see no motion to come."""
    size, gap = 0.02, 6e-3
    soft = nts.StVenantKirchhoff(young=1e6, poisson=0.3)
    floor = nts.Continuum(
        box([-0.04, -0.04, -0.01], [0.04, 0.04, 0], [8, 8, 1]), soft, density=1e3, name="floor",
        bcs=[nts.Dirichlet(lambda x: x[2] < -0.01 + 1e-9)],
    )  # fmt: skip
    block = nts.Continuum(
        box([0.001, 0.001, gap], [0.001 + size, 0.001 + size, gap + size], [2] * 3), soft,
        density=1e3, name="block",
    )  # fmt: skip
    pair = nts.ContactPair(
        slave=block.surface(lambda x: x[2] < gap + 1e-9),
        master=floor.surface(lambda x: x[2] > -1e-9),
    )
    system = nts.System([block, floor], contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, CONTACT_RULES[integrator], dt=0.05, t_end=0.25)
    assert run.status == "completed" and run.balance["active"].max() == 9
    lowest = float((block.reference + block.u.x.array[: block.num_owned])[2::3].min(initial=1.0))
    assert COMM.allreduce(lowest, op=MPI.MIN) > -1e-3 * size
    energy, work = run.balance["energy"], run.balance["external_work"]
    assert (energy <= work + 1e-9 * work.max()).all()
