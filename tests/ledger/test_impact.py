"""Impacts that give their energy back: `simulate(impact="restored", restitution=...)`."""

from mpi4py import MPI

import numpy as np
import pytest
from integrators import MID_STEP
from measures import drift
from pairs import pairs
from scenes import box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
FLOOR = nts.Plane((0, 0, 0), (0, 0, 1))


def grid(low, size, n):
    low = np.array(low, dtype=float)
    return box(low, low + np.array(size), list(n))


def cubes(friction=None, gap=0.05, **speeds):
    """A cube of 2 m/s and 0.5 rad/s meets one at rest."""
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    left = nts.Continuum(
        grid((0, 0, 0), (1, 1, 1), (3, 3, 3)), rubber, density=1e3, name="left",
        velocity=lambda x: np.array([2 + 0.5 * (x[2] - 0.5), 0 * x[0], -0.5 * (x[0] - 0.5)]),
    )  # fmt: skip
    right = nts.Continuum(
        grid((1 + gap, 0, 0), (1, 1, 1), (2, 2, 2)), rubber, density=1e3, name="right"
    )
    options = {} if friction is None else {"friction": friction}
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > 1 - 1e-9),
        master=right.surface(lambda x: x[0] < 1 + gap + 1e-9), **options,
    )  # fmt: skip
    return nts.System([left, right], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integrator", "restitution", "height"), pairs(MID_STEP, [0.0, 0.5, 1.0], [0.0137, 0.0151])
)
def test_a_rigid_block_rebounds_by_its_restitution(integrator, restitution, height):
    """It leaves with e times its speed, wherever in a step its gap closes (by h v = 2 mm)."""
    block = nts.RigidBody(
        grid((0, 0, height), (1, 1, 1), (1, 1, 1)), density=1e3, velocity=(0.3, 0, -2), name="b"
    )
    pair = nts.ContactPair(slave=block.surface(lambda x: x[2] < height + 1e-9), master=FLOOR)
    run = nts.simulate(
        nts.System([block], contacts=[pair]), MID_STEP[integrator], dt=1e-3, t_end=0.02,
        impact="restored", restitution=restitution,
    )  # fmt: skip
    table = run.balance
    assert run.status == "completed" and not run.warnings
    assert block.velocity == pytest.approx((0.3, 0.0, 2.0 * restitution), abs=1e-11)
    assert np.abs(table["ledger_residual"]).max() < 1e-13 * table["energy"][0]
    pushed = run.contact_forces[1:, 0] * np.diff(table["time"])[:, None]
    changes = np.diff(table["linear_momentum"], axis=0)
    assert np.abs(changes - pushed).max() < 1e-12 * np.abs(changes).max()
    turned = run.contact_moments[1:, 0] * np.diff(table["time"])[:, None]
    changes = np.diff(table["angular_momentum"], axis=0)
    assert np.abs(changes - turned).max() < 1e-12 * np.abs(changes).max()


@pytest.mark.mpi
@pytest.mark.parametrize("accuracy", ["exact", "balanced"])
@pytest.mark.slow
def test_flexible_cubes_keep_energy_and_momenta(accuracy):
    """The published scheme loses 8 % of it at this mesh."""
    energy = []
    for impact in ("published", "restored"):
        run = nts.simulate(
            cubes(), nts.EnergyMomentum(), dt=2e-3, t_end=0.1, impact=impact, accuracy=accuracy
        )
        table = run.balance
        energy.append(table["energy"] / table["energy"][0] - 1.0)
        assert table["active"].max() > 0 and table["min_gap"].min() > -1e-12
        assert drift(table, "linear_momentum") < 1e-12
        assert drift(table, "angular_momentum") < (1e-12 if accuracy == "exact" else 1e-9)
    assert energy[0][-1] < -0.05
    assert np.abs(energy[1]).max() < (1e-11 if accuracy == "exact" else 1e-8)
    lost, given = table["contact_defect"][-1], table["impact_restored"][-1]
    assert given == pytest.approx(lost, rel=1e-6)


def test_friction_is_all_that_an_impact_costs():
    """Its work is what energy is missing."""
    run = nts.simulate(cubes(0.3), nts.EnergyMomentum(), dt=2e-3, t_end=0.1, impact="restored")
    table = run.balance
    energy, taken = table["energy"], table["friction_dissipation"]
    assert taken[-1] > 1e-3 * energy[0]
    switched = table["contact_defect"] - table["impact_restored"]
    assert np.abs(energy - energy[0] + taken + switched).max() < 1e-11 * energy[0]
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy[0]


@pytest.mark.mpi
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_bodies_that_do_not_touch_share_no_energy(restitution):
    """Two blocks reach the floor in one step, at other times within it."""
    blocks, pairs = [], []
    for k, height in enumerate((0.0137, 0.0121)):
        block = nts.RigidBody(
            grid((3 * k, 0, height), (1, 1, 1), (1, 1, 1)), density=1e3, velocity=(0, 0, -2),
            name=f"block {k}",
        )  # fmt: skip
        slave = block.surface(lambda x, height=height: x[2] < height + 1e-9)
        blocks.append(block)
        pairs.append(nts.ContactPair(slave=slave, master=FLOOR))
    run = nts.simulate(
        nts.System(blocks, contacts=pairs), nts.EnergyMomentum(), dt=2e-3, t_end=0.02,
        impact="restored", restitution=restitution,
    )  # fmt: skip
    assert run.status == "completed"
    for block in blocks:
        assert block.velocity == pytest.approx((0, 0, 2.0 * restitution), abs=1e-11)


def test_what_moves_as_prescribed_is_refused():
    """What an impact with it leaves depends on its motion."""
    block = nts.RigidBody(
        grid((0, 0, 0.01), (1, 1, 1), (1, 1, 1)), density=1e3, velocity=(0, 0, -2), name="block"
    )
    slave = block.surface(lambda x: x[2] < 0.01 + 1e-9)
    wall = nts.Plane((0, 0, 0), (0, 0, 1), motion=lambda t: (0, 0, -t), name="wall")
    system = nts.System([block], contacts=[nts.ContactPair(slave=slave, master=wall)])
    with pytest.raises(ValueError, match="impact='restored': obstacle 'wall' moves"):
        nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.1, impact="restored")
    lift = nts.RigidBody(
        grid((0, 0, -1), (1, 1, 1), (1, 1, 1)), density=1e3, motion=lambda t: (0, 0, t),
        name="lift",
    )  # fmt: skip
    master = lift.surface(lambda x: x[2] > -1e-9)
    system = nts.System([block, lift], contacts=[nts.ContactPair(slave=slave, master=master)])
    with pytest.raises(ValueError, match="body 'lift' move as prescribed"):
        nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.1, impact="restored")
    late = nts.Dirichlet(lambda x: x[2] < -1 + 1e-9, lambda t: (0, 0, max(0.0, t - 0.02)))
    table = nts.Continuum(
        grid((0, 0, -1), (1, 1, 1), (1, 1, 1)), nts.NeoHookean(young=1e6, poisson=0.3),
        density=1e3, bcs=[late], name="table",
    )  # fmt: skip
    pair = nts.ContactPair(slave=slave, master=table.surface(lambda x: x[2] > -1e-9))
    system = nts.System([block, table], contacts=[pair])
    with pytest.raises(ValueError, match="body 'table' move as prescribed"):
        nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.1, impact="restored")
    drive = nts.Spherical(block, None, point=(0.5, 0.5, 0.5), displacement=lambda t: (0, 0, -t))
    with pytest.raises(ValueError, match="joint .* is driven"):
        nts.simulate(
            nts.System([block], joints=[drive]), nts.EnergyMomentum(), dt=1e-3, t_end=0.1,
            impact="restored",
        )  # fmt: skip
    with pytest.raises(ValueError, match="adapt=Adapt.*impact='restored'"):
        nts.simulate(
            cubes(), nts.EnergyMomentum(), dt=1e-3, t_end=0.1, impact="restored",
            adapt=nts.Adapt(tolerance=1e-3),
        )  # fmt: skip


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_pendulum_swings_back_from_a_wall():
    """A joint holds it: its energy stays, and it turns as fast as before."""
    bob = nts.RigidBody(
        grid((-0.1, -0.1, -1.1), (0.2, 0.2, 0.2), (1, 1, 1)), density=1e3,
        velocity=(1.0, 0, 0),
        angular_velocity=(0, -1.0, 0), name="bob",
    )  # fmt: skip
    hinge = nts.Revolute(bob, None, point=(0, 0, 0), axis=(0, 1, 0), name="hinge")
    wall = nts.Plane((0.1537, 0, 0), (-1, 0, 0))
    pair = nts.ContactPair(slave=bob.surface(lambda x: x[0] > 0.1 - 1e-9), master=wall)
    system = nts.System([bob], joints=[hinge], contacts=[pair])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.1, impact="restored")
    table = run.balance
    # Velocities and turns differ by the square of the turn of a step.
    assert run.status == "completed" and bob.angular_velocity[1] == pytest.approx(1.0, abs=1e-6)
    assert np.abs(table["energy"] / table["energy"][0] - 1.0).max() < 1e-11
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]


def test_newmark_is_refused():
    """Its contact forces act at the end of a step: what they lose is another amount."""
    with pytest.raises(ValueError, match="impact='restored': Newmark.* choose EnergyMomentum"):
        nts.simulate(cubes(), nts.Newmark(), dt=1e-3, t_end=0.1, impact="restored")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"impact": "elastic"}, "impact='elastic': choose one of 'published', 'restored'"),
        ({"impact": "restored", "restitution": 1.2}, "restitution=1.2: must lie between 0 and 1"),
        ({"impact": "restored", "restitution": "a"}, "restitution='a': must lie between"),
        ({"restitution": 0.5}, "restitution=0.5: pass impact='restored', too"),
    ],
)
def test_bad_input(options, message):
    with pytest.raises(ValueError, match="restitution|impact") as error:
        nts.simulate(cubes(), nts.EnergyMomentum(), dt=1e-3, t_end=0.1, **options)
    assert message in str(error.value)


def ball(cells, low, rigid=False, **options):
    """A round body of 1 m radius whose lowest point is a node at this height."""
    mesh = grid((-1, -1, -1), (2, 2, 2), (cells, cells, cells))
    x = mesh.geometry.x
    far, length = np.abs(x).max(axis=1), np.linalg.norm(x, axis=1)
    x *= (0.8 * (1 - far) + far * far / np.where(length > 0, length, 1.0))[:, None]
    x[:, 2] += 1.0 + low
    if rigid:
        return nts.RigidBody(mesh, density=1e3, name="ball", **options)
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    return nts.Continuum(mesh, rubber, density=1e3, name="ball", **options)


@pytest.mark.slow
def test_a_bouncing_ball_rises_by_its_restitution(restitution=0.5):
    """B24: e^(2 n) of the height from which it fell, and the ledger names what it lost."""
    height, gravity = 1.0, 9.81
    body = ball(2, height, rigid=True)
    pair = nts.ContactPair(slave=body.surface(lambda x: x[2] < height + 0.5), master=FLOOR)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -gravity))
    fall = np.sqrt(2 * height / gravity)
    hits = fall * (1 + 2 * np.cumsum([0.0, restitution]))
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=1e-3, t_end=hits[1] + restitution**2 * fall,
        impact="restored", restitution=restitution,
    )  # fmt: skip
    table, size = run.balance, body.mass * gravity * height
    assert run.status == "completed"
    stored = table["energy"] - table["external_work"]  # m g times the height of the next rise
    gravitational = (stored - stored[0]) / size + 1.0
    for n, (begin, end) in enumerate(zip([0.0, *hits], [*hits, table["time"][-1]], strict=True)):
        # A step moves the body by 4 mm while it falls: the height at a touch is known to that.
        flight = gravitational[(table["time"] > begin + 2e-3) & (table["time"] < end - 2e-3)]
        assert np.ptp(flight) < 1e-10
        assert flight[0] == pytest.approx(restitution ** (2 * n), abs=5e-3)
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * size
    lost = table["contact_defect"][-1] - table["impact_restored"][-1]
    assert lost == pytest.approx(size * (1.0 - gravitational[-1]), rel=1e-9, abs=1e-11 * size)


@pytest.mark.slow
def test_a_ball_without_restitution_stays_where_it_falls():
    """B24 at e = 0: what its fall brought is lost, and it lies there."""
    height, gravity = 0.1, 9.81
    body = ball(2, height, rigid=True)
    pair = nts.ContactPair(slave=body.surface(lambda x: x[2] < height + 0.5), master=FLOOR)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -gravity))
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=1e-3, t_end=0.2, impact="restored", restitution=0.0
    )
    table, size = run.balance, body.mass * gravity * height
    assert run.status == "completed" and table["active"][-1] == 1
    # A body that comes to rest within a step keeps up to half a step's fall, with changing sign.
    assert np.linalg.norm(body.velocity) <= gravity * 1e-3
    assert body.position[2] == pytest.approx(1.0, abs=1e-10)
    lost = table["contact_defect"][-1] - table["impact_restored"][-1]
    assert lost == pytest.approx(size, rel=1e-4)
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * size


@pytest.mark.slow
def test_an_elastic_ball_on_an_elastic_plate():
    """At e = 1 energy stays; of the first touch e leaves e^2 of what a plastic impact takes."""
    first, last = {}, {}
    for restitution in (0.0, 0.5, 1.0):
        body = ball(4, 0.0151, velocity=(0, 0, -2))
        plate = nts.Continuum(
            grid((-1.5, -1.5, -1), (3, 3, 1), (3, 3, 2)), nts.NeoHookean(young=1e6, poisson=0.3),
            density=1e3, bcs=[nts.Dirichlet(lambda x: x[2] < -1 + 1e-9)], name="plate",
        )  # fmt: skip
        pair = nts.ContactPair(
            slave=body.surface(lambda x: x[2] < 0.7), master=plate.surface(lambda x: x[2] > -1e-9)
        )
        run = nts.simulate(
            nts.System([body, plate], contacts=[pair]), nts.EnergyMomentum(), dt=4e-3, t_end=0.16,
            impact="restored", restitution=restitution,
        )  # fmt: skip
        table = run.balance
        assert run.status.startswith("completed") and table["active"].max() > 1
        part = table["energy"] / table["energy"][0]
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
        assert table["min_gap"].min() > -1e-12 and nts.motion_of(body).velocity[2] > 0.0
        touch = int(np.argmax(table["active"] > 0))
        first[restitution], last[restitution] = 1.0 - part[touch], 1.0 - part[-1]
        if restitution == 1.0:
            assert np.abs(part - 1.0).max() < 1e-11
    assert first[0.0] > 1e-3 and first[0.5] == pytest.approx(0.75 * first[0.0], rel=1e-9)
    # Later touches are other ones: nodes that keep half their speed come back more often.
    assert min(last[0.0], last[0.5]) > 1e-3


@pytest.mark.mpi
@pytest.mark.parametrize(("integrator", "restitution"), pairs(MID_STEP, [0.0, 0.5, 1.0]))
@pytest.mark.fast("energy-momentum-0.5")
@pytest.mark.fast_on_ranks()
def test_stops_and_cables_leave_what_restitution_asks_for(integrator, restitution):
    """A slider at its end, and two weights that a cable stops, as rigid impacts."""
    slider = nts.RigidBody.from_inertia(2.0, (1, 1, 1), velocity=(0, 0, 3.0), name="slider")
    rail = nts.Prismatic(
        slider, None, point=(0, 0, 0), axis=(0, 0, 1), limits=(-1, 0.1037), name="rail"
    )
    first, second = (
        nts.RigidBody.from_inertia(
            mass, (0.1,) * 3, centre=(0, 0, z), velocity=(0, 0, speed), name=f"{mass}"
        )
        for mass, z, speed in ((2.0, -0.5, -3.0), (1.0, 0.0, 0.0))
    )
    rope = nts.Cable([(first, (0, 0, -0.5)), (second, (0, 0, 0))], length=0.6, name="rope")
    # Both stop in the same step at other parts of it, and a spring between them passes no impulse.
    other = nts.RigidBody.from_inertia(2.0, (1, 1, 1), velocity=(0, 0, 3.0), name="other")
    rails = (
        rail,
        nts.Prismatic(
            other, None, point=(0, 0, 0), axis=(0, 0, 1), limits=(-1, 0.1061), name="other rail"
        ),
    )
    ends = [(1.0, 0, 0), (1.0, 1.0, 0)]
    spring = nts.Spring(slider, other, ends, stiffness=1e-12, name="spring")
    system = nts.System([slider, other, first, second], joints=[*rails, rope, spring])
    run = nts.simulate(
        system, MID_STEP[integrator], dt=3e-3, t_end=0.06, impact="restored",
        restitution=restitution,
    )  # fmt: skip
    table = run.balance
    assert run.status == "completed"
    for body in (slider, other):
        assert body.velocity[2] == pytest.approx(-3.0 * restitution, abs=1e-11)
    # Their momentum stays, and their relative velocity is -e of that before.
    common = 2.0 * -3.0 / 3.0
    apart = np.array([1.0, -2.0]) * 3.0 * restitution / 3.0
    assert (first.velocity[2], second.velocity[2]) == pytest.approx(common + apart, abs=1e-11)
    assert np.abs(table["ledger_residual"]).max() < 1e-13 * table["energy"][0]


@pytest.mark.mpi
@pytest.mark.parametrize("restitution", [0.5, 1.0])
@pytest.mark.fast("0.5")
@pytest.mark.fast_on_ranks()
def test_hinges_rebound_from_their_limits(restitution):
    """Two arms, evaluated together, that reach theirs in different steps; one of them never."""
    arms, hinges = [], []
    for k, limit in enumerate((0.2037, 0.3061, 10.0)):
        place = np.array([0.5, k, 0.0])
        arms.append(nts.RigidBody.from_inertia(
            2.0, (0.02, 0.04, 0.04), centre=place, velocity=(0, 0, 1.0),
            angular_velocity=(0, -2.0, 0), name=f"arm {k}",
        ))  # fmt: skip
        hinges.append(nts.Revolute(
            arms[-1], None, point=(0, k, 0), axis=(0, -1, 0), limits=(-1, limit),
        ))  # fmt: skip
    system = nts.System(arms, joints=hinges)
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=1e-2, t_end=0.3, impact="restored",
        restitution=restitution,
    )  # fmt: skip
    # Directors of a hinge fit it in the mean of two steps, so speeds differ by (w h)^2: a
    # plastic impact leaves a little of the energy, of which e^2 of the rest comes back.
    spins, off = [-arm.angular_velocity[1] for arm in arms], (2.0 * 1e-2) ** 2
    assert spins == pytest.approx([-2.0 * restitution] * 2 + [2.0], rel=off)
    table, share = run.balance, (2.0 * restitution**2 + 1.0) / 3.0
    tolerance = 1e-12 if restitution == 1.0 else off
    assert table["energy"][-1] == pytest.approx(share * table["energy"][0], rel=tolerance)
    assert np.abs(table["ledger_residual"]).max() < 1e-13 * table["energy"][0]
