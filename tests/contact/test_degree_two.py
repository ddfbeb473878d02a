"""Bodies of degree 2 in contact: all nodes touch, masters are their faces (theory 19.6)."""

from mpi4py import MPI

import numpy as np
import pytest
from cubes import HALF, ON_EDGE, about_z, turned
from integrators import INTEGRATORS
from scenes import CELLS, RUBBER, UNITS, at, bottom, box, everywhere, symmetry, top

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact.nodal_pressure import carried_areas

COMM = MPI.COMM_WORLD
HEX, TET = CELLS["hexahedron"], CELLS["tetrahedron"]


# ---- thrown blocks
def thrown(
    cells=(HEX, HEX), degrees=(2, 2), friction=0.3, comm=COMM, rigid=False, **options
):  # fmt: skip
    """A block that flies askew into a larger one."""
    bodies = []
    boxes = (([0, 0, 0], [1, 1, 1]), ([1.02, -0.13, -0.17], [2.02, 1.07, 1.03]))
    for (low, high), cell, degree, n in zip(boxes, cells, degrees, (1, 2), strict=True):
        mesh = box(low, high, n, cell, comm)
        given = {"density": 1e3, "name": f"block {len(bodies)}"}
        if not bodies:
            given["velocity"] = (2, 0.7, 0.2)
        if rigid and bodies:
            bodies.append(nts.RigidBody(mesh, **given))
        else:
            bodies.append(nts.Continuum(mesh, RUBBER, degree=degree, **given))
    slave, master = (body.surface(at(0, x)) for body, x in zip(bodies, (1.0, 1.02), strict=True))
    pair = nts.ContactPair(slave, master, friction=friction, **options)
    return nts.System(bodies, contacts=[pair])


def fly(system, rule="energy-momentum", t_end=0.05, **options):
    return nts.simulate(system, INTEGRATORS[rule], dt=2.5e-3, t_end=t_end, **options)


def assert_kept(run, energy=True):
    """Energy to 1e-11 and momenta to 1e-12 of their largest, in a run with contact."""
    table = run.balance
    assert run.status == "completed" and table["active"].max() >= 4
    if energy:
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
    for name in ("linear_momentum", "angular_momentum"):
        change = np.abs(table[name] - table[name][0]).max()
        assert change < 1e-12 * np.abs(table[name]).max()


#: Cells and degrees of both sides, each by each integration, and each of these by both frictions.
PAIRS = {
    "27": ((HEX, HEX), (2, 2), "nodes", 0.0), "27-sum": ((HEX, HEX), (2, 2), "surface", 0.3),
    "10": ((TET, TET), (2, 2), "nodes", 0.3), "10-sum": ((TET, TET), (2, 2), "surface", 0.0),
    "10-8": ((TET, HEX), (2, 1), "nodes", 0.0), "10-8-sum": ((TET, HEX), (2, 1), "surface", 0.3),
    "8-10": ((HEX, TET), (1, 2), "nodes", 0.3), "8-10-sum": ((HEX, TET), (1, 2), "surface", 0.0),
}  # fmt: skip


@pytest.mark.mpi
@pytest.mark.parametrize(("cells", "degrees", "integration", "friction"), PAIRS.values(), ids=PAIRS)
@pytest.mark.fast("27-sum", "10", "8-10")
@pytest.mark.fast_on_ranks()
def test_energy_and_momenta(cells, degrees, integration, friction):
    run = fly(thrown(cells, degrees, friction, integration=integration))
    assert_kept(run)
    rubbed = run.balance["friction_dissipation"]
    assert (np.diff(rubbed) >= 0.0).all() and (rubbed[-1] > 0.0) == bool(friction)


# ---- pressures and forces
def pressed(cell, metre=1.0, comm=COMM):
    """A cube of degree 2 under a uniform load on a plane, in equilibrium, and its face there."""
    material = nts.StVenantKirchhoff(1e6 / metre, 0.3)
    mesh = box((0, 0, 0), [metre] * 3, 2, cell, comm)
    body = nts.Continuum(
        mesh, material, density=1.0, degree=2, bcs=symmetry(metre), name="cube",
        traction=[nts.Traction(at(2, metre, metre), (0, 0, -1e5 / metre))],
    )  # fmt: skip
    face = body.surface(at(2, 0.0, metre))
    pair = nts.ContactPair(face, nts.Plane((0, 0, 0), (0, 0, 1), name="floor"))
    return nts.equilibrium(nts.System([body], contacts=[pair])), face


@pytest.mark.mpi
@pytest.mark.parametrize("metre", [1.0, *UNITS])
@pytest.mark.parametrize("cell", [HEX, TET], ids=["27", "10"])
@pytest.mark.fast_on_ranks("27-1.0", "10-1.0")
def test_uniform_pressure(cell, metre):
    """Nodes have what Simpson's rule says, and 0, A/3 on triangles; the pressure is uniform.

    It is that of the present area: the cube grows by 3 % in both directions.
    """
    run, face = pressed(cell, metre)
    assert run.status == "completed"
    fields, body = run.contact_fields(face.body), face.body
    force = fields["contact_force_cube-floor"].x.array
    pressure = fields["contact_pressure_cube-floor"].x.array
    x = body.space.tabulate_dof_coordinates() / metre
    on = np.abs(x[:, 2]) < 1e-9
    scalar = fields["contact_force_cube-floor"].function_space
    x = scalar.tabulate_dof_coordinates() / metre
    on = np.abs(x[:, 2]) < 1e-9
    wide = COMM.allreduce((body.u.x.array.reshape(-1, 3)[:, :2] / metre).max(initial=0), MPI.MAX)
    assert wide > 0.02
    assert pressure[on] * metre == pytest.approx(1e5 / (1 + wide) ** 2, rel=1e-9)
    # Cells of half a metre: middles of edges are at odd quarters.
    odd = (np.round(4 * x[on, :2]).astype(int) % 2 == 1).sum(axis=1)
    inner = ((x[on, :2] > 0.1) & (x[on, :2] < 0.9)).all(axis=1)
    facet = 1e5 * metre * 0.25
    if cell == HEX:
        expected = facet * np.array([4, 8, 16])[odd] / 36
    else:
        # Two triangles of half a square meet at each middle, four or eight at a vertex.
        expected = facet * np.where(odd > 0, 1 / 3, 0.0)
    assert np.abs(force[on] - expected)[inner].max() < 1e-9 * facet
    areas = carried_areas(face, face.reference)
    assert areas.sum() == pytest.approx(metre**2, rel=1e-13)


def stacked(cells, cell, degrees, integration):
    """Two blocks of height 0.5, nu = 0, pressed together; rollers below and on two sides.

    Returns:
        Pressures at the slave's nodes over the applied one, and how far the vertical displacements
        of each block's nodes are from a linear function of z, over the applied strain.
    """
    bodies, strain = [], 1e-4
    for n, low, degree in zip(cells, (0.5, 0.0), degrees, strict=True):
        mesh = box([0, 0, low], [1, 1, low + 0.5], [n, n, 2], cell)
        floor = [] if low else [nts.Dirichlet(bottom, components=(2,))]
        load = [nts.Traction(at(2, 1.0), (0, 0, -strain))] if low else []
        bodies.append(nts.Continuum(
            mesh, nts.StVenantKirchhoff(1.0, 0.0), density=1.0, bcs=symmetry() + floor,
            name=f"at {low}", traction=load, degree=degree,
        ))  # fmt: skip
    slave, master = (b.surface(at(2, 0.5)) for b in bodies)
    pair = nts.ContactPair(slave, master, integration=integration)
    run = nts.equilibrium(nts.System(bodies, contacts=[pair]))
    assert run.status == "completed"
    pressure = run.contact_fields(bodies[0])["contact_pressure_at_0.5-at_0.0"]
    x = pressure.function_space.tabulate_dof_coordinates()
    off = []
    for body in bodies:
        z, u = (a.reshape(-1, 3)[:, 2] for a in (body.reference, body.u.x.array[: body.num_owned]))
        z, u = (np.concatenate(COMM.allgather(a)) for a in (z, u))
        basis = np.column_stack([np.ones_like(z), z])
        off.append(np.abs(u - basis @ np.linalg.lstsq(basis, u, rcond=None)[0]).max() / strain)
    return pressure.x.array[np.abs(x[:, 2] - 0.5) < 1e-9] / strain, max(off)


@pytest.mark.mpi
@pytest.mark.parametrize("cells", [(3, 2), (2, 3)], ids=str)
@pytest.mark.parametrize("degrees", [(2, 2), (2, 1), (1, 2)], ids=str)
@pytest.mark.parametrize("cell", [HEX, TET], ids=["27", "10"])
@pytest.mark.fast(
    "27-(2, 1)-(3, 2)",
    "27-(2, 1)-(2, 3)",
    "27-(1, 2)-(3, 2)",
    "27-(1, 2)-(2, 3)",
    "10-(2, 1)-(3, 2)",
    "10-(2, 1)-(2, 3)",
    "10-(1, 2)-(3, 2)",
    "10-(1, 2)-(2, 3)",
)
def test_uniform_pressure_between_any_meshes(cell, degrees, cells):
    """Integrated over the slave's faces, with hats on its facets (theory 17.3)."""
    pressure, off = stacked(cells, cell, degrees, "surface")
    assert np.abs(pressure - 1).max() < 1e-9 and off < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("cell", [HEX, TET], ids=["27", "10"])
def test_nodes_against_faces_miss_less_than_those_of_degree_1(cell):
    errors = [stacked((3, 2), cell, degrees, "nodes")[1] for degrees in ((2, 2), (1, 1))]
    assert errors[0] < 0.75 * errors[1]


def dimitriadis(radius, depth, height, nu):
    """Force of a sphere on a layer that is bonded below, E = 1 (Dimitriadis et al. 2002, (6))."""
    chi, pi = np.sqrt(radius * depth) / height, np.pi
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
    series = [
        1.0, -2 * a / pi, 4 * a**2 / pi**2, -8 / pi**3 * (a**3 + 4 * pi**2 / 15 * b),
        16 * a / pi**4 * (a**3 + 3 * pi**2 / 5 * b),
    ]  # fmt: skip
    hertz = 4 / 3 / (1 - nu**2) * np.sqrt(radius) * depth**1.5
    return hertz * np.polynomial.polynomial.polyval(chi, series)


@pytest.mark.slow
@pytest.mark.mpi
@pytest.mark.parametrize(("cell", "within"), [(HEX, 0.015), (TET, 0.015)])
def test_indentation(cell, within):
    """A sphere of radius 4 is pressed 1/64 into a layer of 0.5; the facets are 0.6 of a."""
    n, radius, depth = 6, 4.0, 1 / 64
    mesh = box((0, 0, 0), (1, 1, 0.5), (n, n, n // 2), cell)
    body = nts.Continuum(
        mesh, nts.StVenantKirchhoff(1.0, 0.3), density=1.0, degree=2,
        bcs=[nts.Dirichlet(bottom), *symmetry()],
    )  # fmt: skip
    sphere = nts.Sphere((0, 0, 0.5 + radius), radius, motion=lambda t: (0, 0, -depth * t))
    pair = nts.ContactPair(body.surface(at(2, 0.5)), sphere)
    run = nts.equilibrium(nts.System([body], contacts=[pair]), load_steps=1)
    force = -4 * run.contact_forces[-1, 0, 2]
    assert run.status == "completed"
    assert force == pytest.approx(dimitriadis(radius, depth, 0.5, 0.3), rel=within)


@pytest.mark.parametrize(("cell", "within"), [(HEX, 0.009), (TET, 0.025)])
@pytest.mark.slow
def test_cantilever_on_a_roller(cell, within):
    """10 x 1 x 1 cells, within what theory 19.6 has for them; cubes of degree 1 are 13 % off.

    The cylinder lifts the beam at 9 of its length by 0.1: 3 EI/9^3 0.1.
    """
    bar = nts.Continuum(
        box((0, 0, 0), (10, 1, 1), (10, 1, 1), cell), nts.StVenantKirchhoff(1.0, 0.3),
        density=1.0, degree=2, bcs=[nts.Dirichlet(at(0, 0.0))],
    )  # fmt: skip
    roll = nts.Cylinder((9, 0, -1), (0, 1, 0), 1.0, motion=lambda t: (0, 0, 0.1 * t))
    pair = nts.ContactPair(bar.surface(at(2, 0.0)), roll)
    run = nts.equilibrium(nts.System([bar], contacts=[pair]), load_steps=1)
    assert run.status == "completed"
    assert run.contact_forces[-1, 0, 2] == pytest.approx(3 / 12 * 0.1 / 9**3, rel=within)


# ---- friction
@pytest.mark.mpi
@pytest.mark.parametrize("cell", [HEX, TET], ids=["27", "10"])
@pytest.mark.parametrize("table", ["plane", "body"])
@pytest.mark.fast("plane-27")
@pytest.mark.fast_on_ranks()
def test_a_sliding_block_decelerates_by_mu_g(cell, table):
    """At rest on its floor, its momentum falls by mu m g in each step."""
    mu, gravity, dt = 0.2, 9.81, 2e-3
    material = nts.StVenantKirchhoff(1e8, 0.0)
    start = nts.Continuum(
        box(cells=1, cell=cell), material, density=1e3, degree=2, name="block",
        velocity=(1.0, 0.0, 0.0),
    )  # fmt: skip
    bodies, floor = [start], nts.Plane((0, 0, 0), (0, 0, 1))
    if table == "body":
        mesh = box((-1, -1, -1), (3, 2, 0), (4, 3, 1), cell)
        bodies.append(nts.Continuum(
            mesh, nts.StVenantKirchhoff(1e9, 0.0), density=1e3, degree=2, name="table",
            bcs=[nts.Dirichlet(everywhere)],
        ))  # fmt: skip
        floor = bodies[1].surface(at(2, 0.0))
    pair = nts.ContactPair(start.surface(bottom), floor, friction=mu)
    system = nts.System(bodies, contacts=[pair], gravity=(0, 0, -gravity))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=0.1)
    assert run.status == "completed"
    table = run.balance
    pushed = run.contact_forces[1:, 0]
    # Sliding all the time, Coulomb's law holds for the sums whatever the body's vibration, but for
    # slips a little aside.
    assert np.abs(pushed[:, 0] + mu * pushed[:, 2]).max() < 1e-5 * np.abs(pushed).max()
    lost = table["linear_momentum"][0, 0] - nts.motion_of(start).velocity[0] * 1e3
    assert lost == pytest.approx(mu * dt * pushed[:, 2].sum(), rel=1e-5)
    assert lost == pytest.approx(mu * gravity * 0.1 * 1e3, rel=0.05)


# ---- a press fit
@pytest.mark.mpi
@pytest.mark.parametrize("integration", ["nodes", "surface"])
@pytest.mark.parametrize("inner", [True, False])
@pytest.mark.fast_on_ranks("True-surface")
@pytest.mark.fast("False-nodes", "False-surface")
def test_press_fit(integration, inner):
    """Lame's pressure between two tubes, 6 and 5 curved cells a quarter, whichever is the slave.

    Of as many nodes facets of degree 1 miss it by 30 to 130 %: their chords are as long as the fit.
    """
    fit, a, b, c, nu = 4e-3, 1.0, 2.0, 3.0, 0.3
    bodies, faces = [], []
    sides = [nts.Dirichlet(everywhere, components=(2,))]
    for low, high, n in ((a, b + fit, 6), (b, c, 5)):
        bodies.append(nts.Continuum(
            quarter_ring(n, inner=low, outer=high), nts.StVenantKirchhoff(1.0, nu), density=1.0,
            name=f"from {low}", bcs=symmetry() + sides,
        ))  # fmt: skip
        on = high if low == a else low
        faces.append(bodies[-1].surface(lambda x, on=on: np.abs(np.hypot(*x[:2]) - on) < 1e-9))
    pair = nts.ContactPair(
        *(faces if inner else faces[::-1]), interference="resolve", integration=integration
    )
    run = nts.equilibrium(nts.System(bodies, contacts=[pair]), load_steps=1)
    assert run.status == "completed"
    compliance = sum((q**2 + p**2) / (q**2 - p**2) for p, q in ((a, b), (b, c)))
    pressure = fit / (b * (1 - nu**2)) / compliance
    # On each of both axes the pressure acts on b.
    assert np.abs(run.contact_forces[-1, 0, :2]) == pytest.approx(pressure * b, rel=0.01)


# ---- edges, corners, itself
@pytest.mark.mpi
@pytest.mark.parametrize("cell", [HEX, TET], ids=["27", "10"])
@pytest.mark.fast("27")
@pytest.mark.fast_on_ranks()
def test_crossed_edges(cell):
    """A cube on an edge falls across the edge of another: the edges alone touch."""
    low = turned(ON_EDGE, np.zeros(3), "low", cells=1, cell=cell, degree=2)
    high = turned(
        about_z(67.0) @ ON_EDGE, np.array([0, 0, 2 * HALF + 0.01]), "high", cells=1, cell=cell,
        degree=2, velocity=(0, 0, -1.0),
    )  # fmt: skip
    pair = nts.ContactPair(high.surface(everywhere), low.surface(everywhere), friction=0.2)
    run = nts.simulate(
        nts.System([low, high], contacts=[pair]), nts.EnergyMomentum(), dt=5e-3, t_end=0.2,
        accuracy="exact",
    )  # fmt: skip
    table = run.balance
    assert run.status == "completed" and "bodies inside each other" not in run.warnings
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
    assert np.abs(table["linear_momentum"] - table["linear_momentum"][0]).max() < 1e-9
    assert nts.motion_of(low).velocity[2] < -0.1


def test_a_curved_face_has_no_edges():
    """Nor has it where its cells meet: a quarter of a cylinder of two cells, 22 degrees a facet."""
    body = nts.Continuum(quarter_ring(2), RUBBER, density=1.0)
    assert body.degree == 2
    outer = body.surface(lambda x: np.hypot(x[0], x[1]) > 2 - 1e-9)
    pair = nts.ContactPair(outer, nts.Continuum(box(), RUBBER, density=1.0).surface(top))
    own = pair.sharp_edges[0]
    x = own.surface.reference[own.ends]
    # Those of the rims: at both ends of the axis, and at both ends of the quarter.
    rims = [np.abs(x[..., k] - value) < 1e-9 for k, value in ((2, 0), (2, 1), (0, 0), (1, 0))]
    assert len(x) == 2 * 4 + 2 * 2 and np.any([on.all(axis=1) for on in rims], axis=0).all()


def quarter_ring(n, comm=COMM, inner=1.0, outer=2.0):
    """27-node cells of a quarter of a ring, curved, n along it, one across and 1 high."""
    mesh = box((0, 0, 0), (1, 1, 1), (1, n, 1), HEX, MPI.COMM_SELF)
    space = compat.vector_space(mesh, 2)
    x, cells = space.tabulate_dof_coordinates(), compat.cell_dofs(space)
    radius, angle = inner + (outer - inner) * x[:, 0], 0.5 * np.pi * x[:, 1]
    x = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), x[:, 2]])
    if comm.rank:
        cells, x = cells[:0], x[:0]
    return compat.create_mesh(comm, cells, x, "hexahedron")


@pytest.mark.mpi
def test_a_curved_mesh():
    """Areas and volume of a ring's quarter, to the error of parabolas over 22 degrees."""
    ring = quarter_ring(4)
    body = nts.Continuum(ring, RUBBER, density=1.0, name="ring")
    rigid = nts.RigidBody(ring, density=1.0, name="rigid ring")
    mass = COMM.allreduce(body.nodal_mass[::3].sum())
    assert mass == pytest.approx(0.75 * np.pi, rel=1e-4)
    assert rigid.mass == pytest.approx(mass, rel=1e-12)
    for one in (body, rigid):
        outer = one.surface(lambda x: np.hypot(x[0], x[1]) > 2 - 1e-9)
        assert np.hypot(*outer.reference[:, :2].T) == pytest.approx(2.0, rel=1e-12)
        # Chords of an eighth of the quarter.
        chords = 8 * 4 * np.sin(np.pi / 32)
        assert outer.area.sum() == pytest.approx(chords, rel=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["flexible", "rigid"])
@pytest.mark.fast("rigid")
@pytest.mark.fast_on_ranks()
def test_a_curved_mesh_rolls_and_bounces(kind):
    """The curved ring falls on a plane; the nodes of its outer face are the slaves."""
    given = {"density": 1e3, "velocity": (0.5, 0.5, -2.0), "name": "ring"}
    ring = quarter_ring(2)
    body = nts.RigidBody(ring, **given) if kind == "rigid" else nts.Continuum(ring, RUBBER, **given)
    outer = body.surface(lambda x: np.hypot(x[0], x[1]) > 2 - 1e-9)
    floor = nts.Plane((2.001, 0, 0), (-1, 0, 0))
    system = nts.System([body], contacts=[nts.ContactPair(outer, floor, friction=0.2)])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2.5e-3, t_end=0.06)
    table = run.balance
    assert run.status == "completed" and table["active"].max() >= 1
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
    assert nts.motion_of(body).velocity[0] < 0.4


@pytest.mark.parametrize("cell", [HEX, TET], ids=["27", "10"])
def test_self_contact(cell):
    """Two arms of a U are pressed together: what one gets the other gives."""
    mesh = box((0, 0, 0), (3, 1, 1), (3, 1, 1), cell)
    body = nts.Continuum(mesh, RUBBER, density=1e3, degree=2, name="bar", velocity=bend)
    contact = nts.SelfContact(body.surface(everywhere), friction=0.2)
    run = nts.simulate(
        nts.System([body], contacts=[contact]), nts.EnergyMomentum(), dt=2e-3, t_end=0.02
    )
    table = run.balance
    assert run.status == "completed"
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]


def bend(x):
    return np.stack([0 * x[0], 0 * x[0], (x[0] - 1.5) ** 2])


# ---- what is refused
def test_no_smoothing():
    body = nts.Continuum(box(cells=1), RUBBER, density=1.0, degree=2)
    with pytest.raises(ValueError, match=r"smoothing=True.*of degree 2; leave smoothing out"):
        body.surface(bottom, smoothing=True)


def test_no_redistributed_mass():
    body = nts.Continuum(box(cells=1), RUBBER, density=1.0, degree=2)
    with pytest.raises(ValueError, match=r"mass='redistributed'.*degree 1.*mass='consistent'"):
        body.surface(bottom, mass="redistributed")


def test_a_degree_below_that_of_the_mesh():
    with pytest.raises(ValueError, match=r"degree=1 of 'body': its mesh is of degree 2; leave"):
        nts.Continuum(quarter_ring(2), RUBBER, density=1.0, degree=1)
