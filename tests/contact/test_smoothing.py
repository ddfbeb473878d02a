"""What a change of facet costs while a mass slides over a faceted cylinder or a flat plate."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box, meshtags
from point_mass import PointSurface, Sledge
from scenes import UNITS, box

import dolfinx_nts as nts
from dolfinx_nts.contact.skins import locate_facets

COMM = MPI.COMM_WORLD
FACETS, RADIUS, WEIGHT = 16, 1.0, 1e3
#: Half the length of the way and of the surface.
WAY, END = 0.33, 0.48
VARIANTS = ("start", "middle", "smooth")
BENT = {"convex": 1.0, "concave": -1.0, "flat": 0.0, "dome": 1.0}


def plate(shape, facets, uneven, triangles=False):
    """Fixed facets along x, bent to a cylinder or a sphere.

    Quadrilaterals in a row, or triangles in three rows.
    """
    cells, kind = (3, CellType.tetrahedron) if triangles else (1, CellType.hexahedron)
    mesh = box([-END, -0.1, -0.1], [END, 0.1, 0.0], [facets, cells, 1], kind)
    top = locate_facets(mesh, lambda x: x[2] > -1e-9, None, "top")
    tags = meshtags(
        mesh, 2, np.sort(top), np.full(len(top), 1, np.int32)
    )
    x, y, z = mesh.geometry.x.T
    even = np.linspace(-END, END, facets + 1)
    shift = uneven * np.random.default_rng(1).uniform(-1, 1, facets - 1) * (even[1] - even[0])
    x = np.interp(x, even, even + np.concatenate([[0], shift, [0]]))
    if triangles:
        # Rows shifted against each other, so that valences' sectors differ, too.
        y = y + uneven * 0.06 * np.sin(40 * x) * (1 - (y / 0.1) ** 2)
    if shape == "dome":
        to = np.column_stack([x, y, np.full(len(x), RADIUS)])
        to *= ((RADIUS + z) / np.linalg.norm(to, axis=1))[:, None]
        x, y, z = (to - [0, 0, RADIUS]).T
    elif BENT[shape]:
        r = RADIUS + BENT[shape] * z
        x, z = r * np.sin(x / RADIUS), BENT[shape] * (r * np.cos(x / RADIUS) - RADIUS)
    mesh.geometry.x[:] = np.column_stack([x, y, z])
    body = nts.Continuum(
        mesh,
        nts.StVenantKirchhoff(1.0, 0.3),
        density=1.0,
        degree=1,
        name="plate",
        bcs=[nts.Dirichlet(lambda x: np.full(x.shape[1], True))],
    )
    return body, tags


def slide(
    shape, variant, part, integrator=None, facets=FACETS, uneven=0.0, triangles=False
):
    """Draw the sledge over the plate.

    Args:
        shape: A key of BENT.
        variant: A key of VARIANTS.
        part: Way of a step in facets.
        integrator: Energy-momentum scheme if None.
        facets: Facets of the plate along its length.
        uneven: Random shift of the edges between facets in their width.
        triangles: Whether the plate has tetrahedra.

    Returns:
        Losses of the steps that begin on another facet than the last one [J], losses of all other
        steps, and the balance table.
    """
    body, tags = plate(shape, facets, uneven, triangles)
    master = body.surface(tags, 1, smoothing=variant == "smooth")
    # A node is on facets and patches; a little lower, the weight has no way to fall in the first
    # step.
    x, _, z = np.unique(np.round(master.reference, 12), axis=0).T
    begin = np.flatnonzero(x >= -WAY)[0]
    height = z[begin] if shape != "dome" else np.sqrt(RADIUS**2 - x[begin] ** 2 - 1e-4) - RADIUS
    start = np.array([x[begin], 0.01, height - 1e-9])
    mass = Sledge(start)
    pair = nts.ContactPair(PointSurface(mass, start), master)
    pair.slave.fixed[:, :2] = True
    if variant == "start":
        pair.slave_paths._crossings = lambda *_: (np.empty(0, dtype=int), np.empty(0, dtype=int))
    system = nts.System([mass, body], contacts=[pair], gravity=(0, 0, -WEIGHT))
    # The weight is large: what 1e-13 leaves of it, times the way, is 1e-11 of the energy.
    newton = nts.Newton(rtol=1e-14)
    stepper = nts.Stepper(system, integrator or nts.EnergyMomentum(), newton=newton)
    dt = part * 2 * END / (facets * Sledge.pace)
    facet, changes, others, before = [], [], [], 0.0
    for step in range(int(2 * WAY / (Sledge.pace * dt)) - 1):
        state = stepper.advance(dt)
        facet.append(COMM.bcast(state.contacts[0].facet.copy())[0])
        loss = stepper.solution.rows[-1]["contact_defect"]
        if step > 3:
            (others if facet[-1] == facet[-2] else changes).append(loss - before)
        before = loss
    solution, changes = stepper.solution, np.array(changes)
    stepper.close()
    reported = [s.defect for s in solution.switches][-len(changes) :]
    assert np.abs(reported - changes).max() <= 1e-13 * WEIGHT
    assert f"{len(solution.switches)} changes of facet" in solution.summary
    return changes, np.array(others), solution.balance


def assert_closed(table, changes, count):
    """The sledge was on the surface all the time, and the energy is where the table says."""
    assert len(changes) >= count
    assert (table["active"][4:] == 1).all()
    scale = max(np.abs(table[k]).max() for k in ("energy", "external_work"))
    assert np.abs(table["ledger_residual"]).max() <= 1e-11 * scale


@pytest.mark.parametrize(
    "variant", [pytest.param("middle", marks=pytest.mark.mpi), "start", "smooth"]
)
@pytest.mark.slow
def test_changes_of_facet_on_a_flat_plate_cost_nothing(variant):
    changes, others, table = slide("flat", variant, 0.45, facets=80, uneven=0.25)
    assert_closed(table, changes, 50)
    work = WEIGHT * 2 * WAY
    assert np.abs(changes).max() <= 1e-12 * work
    assert np.abs(others).max() <= 1e-12 * work


@pytest.mark.parametrize(("shape", "part"), [("convex", 0.2137), ("concave", 0.1137)])
@pytest.mark.slow
def test_what_a_change_of_facet_costs_on_a_cylinder(shape, part):
    """At a slope of the angle between facets, the way beyond an edge is a height."""
    angle = 2 * END / FACETS / RADIUS
    step = WEIGHT * part * angle**2 * RADIUS
    mean, total = {}, {}
    for variant in VARIANTS:
        changes, others, table = slide(shape, variant, part)
        assert_closed(table, changes, 8)
        assert np.abs(others).max() <= 1e-12 * WEIGHT
        mean[variant], total[variant] = np.abs(changes).mean(), changes.sum()
        if variant == "start":
            # Always a loss on the outside and a gain on the inside, half a step on the average.
            assert (np.sign(changes) == BENT[shape]).all()
    assert 0.7 * step < 2 * mean["start"] < 1.4 * step
    assert mean["middle"] < 0.65 * mean["start"]
    # Nine changes between plus and minus half a step: a random walk of a fifth of a steady one.
    assert abs(total["middle"]) < 0.5 * abs(total["start"])
    assert mean["smooth"] < 1e-4 * mean["start"]


@pytest.mark.parametrize("shape", ["convex", "concave"])
@pytest.mark.slow
def test_smoothing_of_uneven_facets(shape):
    """Their patches have one normal but not one curvature along an edge."""
    mean = {}
    for variant in ("middle", "smooth"):
        changes, _, table = slide(shape, variant, 0.1137, uneven=0.25)
        assert_closed(table, changes, 8)
        mean[variant] = np.abs(changes).mean()
    assert mean["smooth"] < 0.05 * mean["middle"]


@pytest.mark.parametrize(
    ("shape", "part", "uneven"),
    [("concave", 0.1137, 0.0), ("convex", 0.1137, 0.25), ("dome", 0.2137, 0.25)],
)
@pytest.mark.slow
def test_smoothing_of_triangles(shape, part, uneven):
    """Changes of facet cost a thousandth, and so do those of the pieces of a facet."""
    changes, others, table = slide(shape, "middle", part, uneven=uneven, triangles=True)
    assert_closed(table, changes, 15)
    assert np.abs(others).max() <= 1e-12 * WEIGHT
    faceted = np.abs(changes).mean()
    changes, others, table = slide(shape, "smooth", part, uneven=uneven, triangles=True)
    assert_closed(table, changes, 15)
    assert np.abs(changes).mean() < 1e-3 * faceted
    assert np.abs(others).max() < 1e-3 * faceted


def bumpy(comm, smoothing, kind=CellType.hexahedron, metre=1.0, arch=False):
    """A block that slides over the waves of a plate, or over an arch; both are free."""
    cells = {"cell_type": kind, "ghost_mode": GhostMode.shared_facet}
    mesh = create_box(comm, [[0, 0, 0], [1.2, 1, 0.3]], [6, 5, 1], **cells)
    top = locate_facets(mesh, lambda x: x[2] > 0.3 - 1e-9, None, "top")
    one = np.full(len(top), 1, np.int32)
    tags = meshtags(mesh, 2, np.sort(top), one)
    x, y, z = mesh.geometry.x.T
    bumps = 0.1 * np.sin(np.pi * x / 1.2) if arch else 0.03 * np.sin(6 * x) * np.cos(4 * y)
    mesh.geometry.x[:, 2] += bumps * z / 0.3
    mesh.geometry.x[:] *= metre
    # Of a scene in mm and tonnes, say: mass and time keep their units.
    rubber = nts.NeoHookean(young=1e6 / metre, poisson=0.3)
    plate = nts.Continuum(mesh, rubber, density=1e4 / metre**3, degree=1, name="plate")
    low = 0.41 if arch else 0.335
    mesh = create_box(comm, [[0.21, 0.23, low], [0.61, 0.63, low + 0.3]], [2, 2, 1], **cells)
    mesh.geometry.x[:] *= metre
    velocity = metre * np.array([2.0, 0.7, -1.0])
    block = nts.Continuum(
        mesh, rubber, density=1e4 / metre**3, degree=1, velocity=tuple(velocity), name="block"
    )
    slave = block.surface(lambda x: x[2] < (low + 1e-9) * metre)
    pair = nts.ContactPair(slave, plate.surface(tags, 1, smoothing=smoothing))
    return nts.System([block, plate], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("smoothing", [False, True])
@pytest.mark.slow
def test_momentum_and_energy_on_any_number_of_ranks(smoothing, kind):
    tables = []
    for comm in (COMM, MPI.COMM_SELF):
        scene = bumpy(comm, smoothing, getattr(CellType, kind))
        run = nts.simulate(scene, nts.EnergyMomentum(), dt=4e-3, t_end=0.08)
        assert run.status == "completed" and run.retries == 0
        tables.append(run.balance)
    table, alone = tables
    assert table["active"].max() >= 3
    assert np.abs(table["ledger_residual"]).max() <= 1e-11 * table["energy"][0]
    for name in ("linear_momentum", "angular_momentum"):
        change = np.abs(table[name] - table[name][0]).max()
        assert change <= 1e-12 * np.abs(table[name]).max()
    for name in ("energy", "contact_defect", "linear_momentum", "angular_momentum"):
        scale = max(np.abs(alone[name]).max(), alone["energy"][0])
        assert np.abs(table[name] - alone[name]).max() <= 1e-9 * scale


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_tetrahedra_on_a_smoothed_arch_keep_what_balanced_promises(friction):
    """They slide over it in contact; what an iteration leaves must not add up to 1e-8 E0."""
    (pair,) = (scene := bumpy(COMM, True, CellType.tetrahedron, arch=True)).contacts
    pair = nts.ContactPair(pair.slave, pair.master, friction=friction)
    scene = nts.System(scene.bodies, contacts=[pair], gravity=(0.0, 0.0, -20.0))
    run = nts.simulate(scene, nts.EnergyMomentum(), dt=4e-3, t_end=0.2, accuracy="balanced")
    table = run.balance
    assert run.status == "completed" and "ledger" not in run.warnings
    assert np.count_nonzero(table["active"] >= 2) > 10
    # Energies beside gravity's work, which both fall by.
    assert np.abs(table["ledger_residual"]).max() <= 1e-8 * table["energy"][0]


@pytest.mark.slow
def test_smooth_triangles_in_other_units():
    tables = []
    for metre in (1.0, *UNITS):
        scene = bumpy(COMM, True, CellType.tetrahedron, metre)
        run = nts.simulate(scene, nts.EnergyMomentum(), dt=4e-3, t_end=0.08)
        assert run.status == "completed"
        tables.append(run.balance)
    for table, metre in zip(tables[1:], UNITS, strict=True):
        assert np.array_equal(table["newton_iterations"], tables[0]["newton_iterations"])
        assert np.array_equal(table["active"], tables[0]["active"])
        energy = table["energy"] / metre**2
        assert np.abs(energy / tables[0]["energy"] - 1).max() <= 1e-9


@pytest.mark.slow
def test_friction_on_smooth_triangles_of_a_rigid_body():
    block, plate = bumpy(COMM, True, CellType.tetrahedron).bodies
    rigid = nts.RigidBody(plate.mesh, density=1e4, name="rigid")
    top = locate_facets(plate.mesh, lambda x: x[2] > 0.2, None, "top")
    tags = meshtags(plate.mesh, 2, np.sort(top), np.full(len(top), 1, np.int32))
    slave = block.surface(lambda x: x[2] < 0.335 + 1e-9)
    pair = nts.ContactPair(slave, rigid.surface(tags, 1, smoothing=True), friction=0.3)
    system = nts.System([block, rigid], contacts=[pair])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=4e-3, t_end=0.08)
    table = run.balance
    assert run.status == "completed" and table["active"].max() >= 5
    assert table["friction_dissipation"][-1] > 0.1 * table["energy"][0]
    assert np.abs(table["ledger_residual"]).max() <= 1e-11 * table["energy"][0]
    for name in ("linear_momentum", "angular_momentum"):
        change = np.abs(table[name] - table[name][0]).max()
        assert change <= 1e-12 * np.abs(table[name]).max()
