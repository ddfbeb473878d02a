"""A surface in contact with itself, against the same parts as two bodies and by its balances."""

from mpi4py import MPI

import numpy as np
import pytest
from measures import difference, kinds
from scenes import box, everywhere
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from shells import grid, surface_mesh
from solids import Solid

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact.along_surface import Neighbourhoods
from dolfinx_nts.contact.overlap import OverlapWatch
from dolfinx_nts.contact.self_contact import _one_of_two

COMM = MPI.COMM_WORLD
#: Length and thickness of the legs of a U, and the gap between them, in its width.
LENGTH, THICK, GAP = 4.0, 1.0, 0.3
#: Cells along a leg and around the bend.
LEG, BEND = 8, 4
#: The upper leg is narrower and shorter than the lower one, so that its nodes lie over facets.
NARROW, LONG = 0.8, 1.05
RUBBER = {"young": 1e6, "poisson": 0.3}


# ---- a U of two legs
def shaped(mesh, s, skew):
    """Lay a box over a U: s in cells from the upper leg's tip, its y from the inner side.

    Args:
        mesh: Of a box.
        s: At its nodes, shape (n,).
        skew: Of the spacing of the lower leg's nodes.
    """
    _, across, wide = mesh.geometry.x.T.copy()
    radius, angle = 0.5 * GAP + across, np.pi * np.clip((s - LEG) / BEND, 0.0, 1.0)
    along = np.where(s <= LEG, LEG - s, s - LEG - BEND) / LEG
    along = np.where(s > LEG, LONG * (along + skew * along * (1.0 - along)), along)
    z = 0.5 + np.interp(s, [LEG, LEG + BEND], [NARROW, 1.0]) * (wide - 0.5)
    bent = (s > LEG) & (s < LEG + BEND)
    x = np.where(bent, -radius * np.sin(angle), LENGTH * along)
    mesh.geometry.x[:] = np.column_stack([x, radius * np.cos(angle), z])
    return mesh


def strip(skew=0.0, width=1):
    """The U as one mesh, the lower leg's nodes spaced otherwise than the upper one's."""
    cells = 2 * LEG + BEND
    mesh = box((0, 0, 0), (cells, THICK, 1), (cells, 2, width))
    return shaped(mesh, mesh.geometry.x[:, 0].copy(), skew)


def legs(skew=0.0):
    """Its legs as two meshes of the same nodes."""
    meshes = []
    for start in (0, LEG + BEND):
        mesh = box((start, 0, 0), (start + LEG, THICK, 1), (LEG, 2, 1))
        meshes.append(shaped(mesh, mesh.geometry.x[:, 0].copy(), skew))
    return meshes


def pressed(meshes, contact, push=0.2, **motion):
    """Legs whose bend is held, or whose ends are; with a push their outer sides close the gap.

    Args:
        meshes: One, or those of both legs.
        contact: Of the bodies -> the contact.
        push: Of both sides [m] at t = 1; 0: they are free.
        motion: Of the bodies.
    """
    bcs, bodies = [nts.Dirichlet(lambda x: x[0] < 1e-9)], []
    for sign in (1.0, -1.0) if push else ():
        def outer(x, sign=sign):
            far = sign * x[1] > 0.5 * GAP + THICK - 1e-9
            return far & (x[0] > 0.5 * LENGTH)

        bcs.append(
            nts.Dirichlet(outer, value=lambda t, sign=sign: (0, -sign * push * t, 0),
                          components=(1,))
        )  # fmt: skip
    for k, mesh in enumerate(meshes):
        own = bcs if len(meshes) == 1 or not push else [bcs[0], bcs[1 + k]]
        bodies.append(
            nts.Continuum(
                mesh, nts.NeoHookean(**RUBBER), density=1e3, bcs=own, name="ab"[k], **motion
            )
        )
    return nts.System(bodies, contacts=[contact(bodies)])


def inner(x):
    """The inner sides of the legs."""
    return np.abs(x[1]) < 0.5 * GAP + 1e-9


def itself(where, friction=0.0):
    """Contact of the one body with itself."""
    return lambda bodies: nts.SelfContact(bodies[0].surface(where), friction=friction)


def of_two(where, friction=0.0):
    """Contact of the two legs, the upper one the slave."""
    return lambda bodies: nts.ContactPair(*(b.surface(where) for b in bodies), friction=friction)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("friction", "skew", "where"),
    [(0.0, 0.4, inner), (0.4, 0.0, inner), (0.0, 0.0, everywhere), (0.4, 0.4, everywhere)],
)
@pytest.mark.fast("0.0-0.0-everywhere")
@pytest.mark.fast_on_ranks()
def test_legs_pressed_together_are_two_bodies(friction, skew, where):
    """Nodes of one leg are held, not those of both: else flat parts would be held twice."""
    one, two = (
        nts.equilibrium(pressed(meshes, contact), load_steps=3)
        for meshes, contact in (
            ([strip(skew)], itself(where, friction)), (legs(skew), of_two(where, friction)),
        )
    )  # fmt: skip
    assert one.status == two.status == "completed"
    assert kinds(one) == kinds(two)
    assert two.contact_forces[-1, 0, 1] > 0.05 * RUBBER["young"]
    size = np.abs(two.contact_forces).max()
    assert np.abs(one.contact_forces - two.contact_forces).max() < 1e-9 * size
    assert one.balance["energy"][-1] == pytest.approx(two.balance["energy"][-1], rel=1e-9)
    assert np.array_equal(one.balance["active"], two.balance["active"])


def closing(x):
    """Velocity of legs that close."""
    speed = 0.5 * np.sign(x[1]) * x[0]
    return np.array([0.0 * x[0], -speed, 0.1 * speed])


@pytest.mark.mpi
@pytest.mark.parametrize("rule", [nts.EnergyMomentum(), nts.Midpoint()])
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("rule1")
def test_legs_that_hit_each_other_are_two_bodies(rule):
    one, two = (
        nts.simulate(
            pressed(meshes, contact, push=0.0, velocity=closing), rule, dt=4e-3, t_end=0.12
        )
        for meshes, contact in (
            ([strip(0.4)], itself(inner, 0.4)), (legs(0.4), of_two(inner, 0.4)),
        )
    )
    assert one.status == two.status == "completed"
    assert two.balance["active"].max() >= 4 and two.balance["slip"].max() >= 2
    # The bend, which is held, has mass but does not move.
    assert difference(one.balance, two.balance) < 1e-10


# ---- what nothing holds is told
@pytest.mark.mpi
@pytest.mark.parametrize("where", [inner, everywhere])
def test_a_leg_inside_the_other_is_told(where):
    """Of the upper leg, moved down as a whole; not where legs touch, or one is a little inside."""
    system = pressed([strip()], itself(where), push=0.0)
    watch, (body,) = OverlapWatch(system), system.bodies
    x = body.reference.reshape(-1, 3)
    upper = (x[:, 0] > 1e-9) & (x[:, 1] > 0.0)
    for depth, told in ((0.0, False), (0.05, False), (0.3, True)):
        u = np.zeros_like(x)
        u[upper, 1] = -GAP - depth
        found = watch.look([u.ravel()], last=True)
        assert [f.kind for f in found] == told * ["node inside a body"]
        if told:
            assert found[0].bodies == ("a", "a") and found[0].depth == pytest.approx(depth)


# ---- a coil spring
#: Radius, side of the wire, pitch, and windings of a coil with cells along one and across.
RADIUS, WIRE, PITCH, TURNS, PER_TURN, ACROSS = 1.0, 0.3, 0.45, 3, 16, 2


def coil(push, contact=True):
    """A coil of square wire between two ends that are held, one of which moves by `push`."""
    n = TURNS * PER_TURN
    mesh = box((0, 0, 0), (n, 1, 1), (n, ACROSS, ACROSS))
    s, out, up = mesh.geometry.x.T.copy()
    angle, radius = -2.0 * np.pi * s / PER_TURN, RADIUS + WIRE * (out - 0.5)
    height = PITCH * s / PER_TURN + WIRE * (up - 0.5)
    mesh.geometry.x[:] = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    ends = []
    for level in (0.0, PITCH * TURNS):
        def end(x, level=level):
            near = np.abs(x[2] - level) < 0.5 * WIRE + 1e-6
            return near & (np.abs(x[1]) < 1e-6) & (x[0] > 0)

        ends.append(end)
    move = nts.Dirichlet(ends[1], value=lambda t: (0, 0, -push * t))
    body = nts.Continuum(
        mesh, nts.NeoHookean(**RUBBER), density=1e3, bcs=[nts.Dirichlet(ends[0]), move], name="coil"
    )
    def lies(x):
        # The upper and lower sides of the wire, but not its ends nor the sides of the coil.
        turns = (-np.arctan2(x[1], x[0]) / (2.0 * np.pi)) % 1.0
        level = x[2] / PITCH - turns
        return np.abs(np.abs(level - np.round(level)) - 0.5 * WIRE / PITCH) < 1e-6

    touches = [nts.SelfContact(body.surface(lies), friction=0.2)] if contact else []
    return nts.System([body], contacts=touches)


def deepest(x, cells):
    """How deep nodes are inside tetrahedra of other nodes [m], by all of them."""
    tets = Solid(x, cells).tets
    corner = x[tets]
    inverse = np.linalg.inv((corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1))
    weight = np.einsum("tij,ntj->nti", inverse, x[:, None] - corner[None, :, 0])
    weight = np.concatenate([1.0 - weight.sum(axis=2, keepdims=True), weight], axis=2)
    slope = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    depth = (weight / np.linalg.norm(slope, axis=2)).min(axis=2)
    own = (tets[None] == np.arange(len(x))[:, None, None]).any(axis=2)
    return float(np.where(own, -np.inf, depth).max())


@pytest.mark.slow
def test_a_coil_spring_is_squeezed_until_it_closes():
    """Over three gaps it is a spring, as without contact; then its wire is pressed."""
    push, solid = 0.5, TURNS * (PITCH - WIRE)
    run, free = (nts.equilibrium(coil(push, c), load_steps=20) for c in (True, False))
    assert run.status == free.status == "completed" and not kinds(run)
    way, open_way = (push * r.balance["time"] for r in (run, free))
    force, spring = (-np.asarray(r.reactions["coil"])[:, 1, 2] for r in (run, free))
    before = run.balance["active"] == 0
    assert way[before].max() == pytest.approx(solid, rel=0.06)
    there = np.interp(way[before], open_way, spring)
    assert np.abs(force[before] - there).max() < 1e-9 * spring.max()
    # Square wire: P = G a^4 w / (44.5 R^3 n); two cells across it are too stiff by some 20 %.
    shear = RUBBER["young"] / (2.0 + 2.0 * RUBBER["poisson"])
    rate = shear * WIRE**4 / (44.5 * RADIUS**3 * TURNS)
    assert 1.0 < spring[1] / open_way[1] / rate < 1.3
    assert (force[-1] - force[-2]) / (way[-1] - way[-2]) > 1e3 * rate
    body = run.system.bodies[0]
    x = (body.reference + run.state.u[0]).reshape(-1, 3)
    assert deepest(x, compat.geometry_dofmap(body.mesh)) < 0.01 * WIRE / ACROSS
# ---- other bodies
@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_shell_that_folds_keeps_momenta_and_the_ledger():
    """On its inner side, half a thickness from the middle surface."""
    leg, bend, gap, thickness = 8, 6, 0.2, 0.03
    s, z = np.arange(2.0 * leg + bend + 1), np.array([-0.1, 0.0, 0.1])
    angle = np.pi * np.clip((s - leg) / bend, 0.0, 1.0)
    along = np.where(s <= leg, leg - s, np.maximum(LONG * (s - leg - bend), 0.0)) / leg
    x = np.where((s > leg) & (s < leg + bend), -0.5 * gap * np.sin(angle), along)
    wide = np.outer(np.where(s < leg + bend / 2, NARROW, 1.0), z)
    y = np.repeat(0.5 * gap * np.cos(angle), 3)
    mesh = surface_mesh(np.column_stack([np.repeat(x, 3), y, wide.ravel()]), grid(len(s) - 1, 2))

    def velocity(x):
        speed = np.sign(x[1]) * np.clip(x[0], 0.0, None)
        return np.array([0.1 + 0.0 * speed, -3.0 * speed, 0.3 * speed])

    sheet = nts.Shell(
        mesh, young=1e7, poisson=0.3, thickness=thickness, density=1e3, velocity=velocity,
        name="sheet",
    )  # fmt: skip
    contact = nts.SelfContact(sheet.surface(side="bottom"), friction=0.3)
    system = nts.System([sheet], contacts=[contact])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.05)
    assert run.status == "completed"
    table, energy = run.balance, run.balance["energy"][0]
    assert table["active"].max() >= 2 and table["min_gap"].min() > -1e-10
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy
    for name in ("linear_momentum", "angular_momentum"):
        off = np.abs(table[name] - table[name][0]).max()
        assert off < 1e-12 * np.abs(table[name][0]).max(), name


@pytest.mark.slow
def test_the_ends_of_a_clip_of_tetrahedra_do_not_enter_each_other():
    """Its whole boundary with its edges, meshed by Gmsh, by a test of all nodes in all cells."""
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 0)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.25)
    occ = gmsh.model.occ
    ring = [(3, occ.addCylinder(0, 0, 0, 0, 0, 0.5, 1.0))]
    for tool in (occ.addCylinder(0, 0, -1, 0, 0, 3, 0.7), occ.addBox(0, -0.1, -1, 2, 0.2, 3)):
        ring, _ = occ.cut(ring, [(3, tool)])
    occ.synchronize()
    gmsh.model.addPhysicalGroup(3, [ring[0][1]])
    gmsh.model.mesh.generate(3)
    (part,) = nts.bodies_from_gmsh(gmsh.model, MPI.COMM_SELF).values()
    gmsh.finalize()

    def velocity(x):
        speed = np.sign(x[1]) * np.clip(x[0], 0.0, None)
        return np.array([1.0 + 0.0 * speed, -4.0 * speed * np.abs(x[0]), 0.5 * speed])

    clip = nts.Continuum(
        part.mesh, nts.NeoHookean(**RUBBER), density=1e3, degree=1, velocity=velocity, name="clip"
    )
    contact = nts.SelfContact(clip.surface(everywhere), friction=0.3)
    depths, cells = [], compat.geometry_dofmap(clip.mesh)

    class Judge(nts.Writer):
        def write(self, stepper, *, last=False):
            x = (clip.reference + stepper.state.u[0]).reshape(-1, 3)
            depths.append(deepest(x, cells))

        def start(self, stepper):
            pass

        def close(self, stepper):
            pass

    run = nts.simulate(
        nts.System([clip], contacts=[contact]), nts.EnergyMomentum(), dt=4e-3, t_end=0.12,
        output=[Judge()],
    )  # fmt: skip
    assert run.status == "completed" and not kinds(run)
    table, energy = run.balance, run.balance["energy"][0]
    assert table["active"].max() >= 4 and max(depths) < 0.01 * 0.25
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy
    for name in ("linear_momentum", "angular_momentum"):
        off = np.abs(table[name] - table[name][0]).max()
        assert off < 1e-12 * np.abs(table[name][0]).max(), name


# ---- what may touch
def candidates(mesh):
    """Slave nodes that may touch at rest."""
    body = nts.Continuum(mesh, nts.NeoHookean(**RUBBER), density=1.0, degree=1)
    contact = nts.SelfContact(body.surface(everywhere))
    system = nts.System([body], contacts=[contact])
    (depth,) = system.penetration(system.initial_state())
    assert not depth.any()
    ((_, found),) = system._facing(system.initial_state())
    return COMM.allreduce(len(found.node))


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_what_lies_beside_a_node_does_not_count():
    """Neither do the other side of a plate, edges and corners, and a fold that is wide."""
    assert candidates(box(cells=4)) == 0
    # A plate of a thirtieth of its facets.
    assert candidates(box(high=(4, 4, 1 / 30), cells=(4, 4, 1))) == 0
    assert candidates(Solid.of("ball", (4, 4, 4), "tetrahedron").mesh(COMM)) == 0
    assert candidates(Solid.of("ring", (12, 2, 1), "hexahedron").mesh(COMM)) == 0
    for opening, some in ((60.0, False), (5.0, True)):
        mesh = box((-4, 0, 0), (4, 1, 1), (32, 2, 2))
        x = mesh.geometry.x
        # The upper side falls to the middle, from the slope that closes it to the opening.
        x[:, :2] = fold(x[:, 0].copy(), x[:, 1].copy(), np.radians(opening))
        assert (candidates(mesh) > 0) == some, opening


def fold(s, across, opening):
    """A strip bent by a corner at s = 0 whose inner sides, at across = 1, enclose an angle."""
    half = 0.5 * opening
    out = np.stack([np.cos(half) * np.ones_like(s), np.sign(s) * np.sin(half)])
    up = np.stack([np.sin(half) * np.ones_like(s), -np.sign(s) * np.cos(half)])
    x, y = np.abs(s) * out + (across - 1.0) * up
    # On the plane between both sides the strip is mitred.
    middle = s == 0.0
    x = np.where(middle, (across - 1.0) / np.sin(half), x)
    return np.column_stack([y, x])


def test_ways_along_a_surface_are_the_shortest():
    rng = np.random.default_rng(3)
    body = nts.Continuum(box(cells=(3, 4, 5)), nts.NeoHookean(**RUBBER), density=1.0)
    surface = body.surface(everywhere)
    x = surface.reference + 0.05 * rng.normal(size=surface.reference.shape)
    found, n, at = Neighbourhoods(surface.facets, x), len(x), surface.facets
    one, two = (np.array([f[k] for f in at for k in both]).ravel()
                for both in (np.repeat(range(4), 4), np.tile(range(4), 4)))  # fmt: skip
    table = np.zeros((n, n))
    table[one, two] = np.linalg.norm(x[one] - x[two], axis=1)
    ring, ways = table > 0.0, dijkstra(csr_array(table))
    point = np.repeat(np.arange(n), len(at))
    facet = np.tile(np.arange(len(at)), n)
    nearest = ways[point[:, None], at[facet]].min(axis=1)
    always = (ring | np.eye(n, dtype=bool))[point[:, None], at[facet]].any(axis=1)
    for distance in (0.0, 0.1, 0.2):
        wanted = always | (nearest <= 3.0 * distance)
        assert np.array_equal(found.beside(point, facet, np.full(len(point), distance)), wanted)


def test_nodes_of_one_part_are_slaves():
    """Of the finer one, of equal ones the inner one, that of the lowest number, or as before."""
    joins = np.array([(0, 4), (1, 5), (2, 6), (3, 7), (0, 5), (1, 6), (2, 7)])
    number = np.array([9, 8, 7, 6, 5, 4, 3, 2])
    before, never, alike = np.arange(8) < 2, np.zeros(8, dtype=bool), np.ones(8)
    upper = np.arange(8) < 4
    assert np.array_equal(_one_of_two(*joins.T, never, alike, number), ~upper)
    assert np.array_equal(_one_of_two(*joins.T, never, alike + ~upper, number), upper)
    assert np.array_equal(_one_of_two(*joins.T, before, alike + upper, number), upper)
    # Two more nodes join the upper part, and one that is joined with none.
    more = np.concatenate([joins, [(8, 7), (9, 4)]])
    wanted = np.append(upper, [True, True, True])
    never, alike = np.zeros(11, dtype=bool), np.ones(11)
    assert np.array_equal(_one_of_two(*more.T, never, alike, np.arange(11)[::-1]), wanted)
    circle = np.array([(0, 1), (1, 2), (2, 0)])
    slave = _one_of_two(*circle.T, never[:3], alike[:3], np.arange(3))
    assert not any(slave[a] and slave[b] for a, b in circle) and slave.any()


def test_what_cannot_touch_itself_is_refused():
    rigid = nts.RigidBody(box(), density=1.0, name="stone")
    with pytest.raises(ValueError, match="'stone' is rigid and cannot touch itself"):
        nts.SelfContact(rigid.surface(everywhere))
    with pytest.raises(TypeError, match="surface=3: pass a Surface"):
        nts.SelfContact(3)
    body = nts.Continuum(box(), nts.NeoHookean(**RUBBER), density=1.0)
    with pytest.raises(ValueError, match="friction=-1: pass a number >= 0"):
        nts.SelfContact(body.surface(everywhere), friction=-1)
    with pytest.raises(TypeError, match="edges=True: unknown option of SelfContact"):
        nts.SelfContact(body.surface(everywhere), edges=True)
