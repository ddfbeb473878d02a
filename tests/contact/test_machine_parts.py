"""Parts of Gmsh's tetrahedra that do what machines are built for: wedge, seal, chain, snap fit."""

from mpi4py import MPI

import numpy as np
import pytest
import snap_fit
from gmsh_parts import deepest, of_gmsh
from measures import kinds
from scenes import everywhere

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh

COMM = MPI.COMM_WORLD
STILL = {"motion": lambda t: (0, 0, 0), "rotation": lambda t: (0, 0, 0)}


def prism(outline, low, high):
    """What draws a prism along y of an outline (n, 2) of x and z."""

    def draw(occ):
        points = [occ.addPoint(x, low, z) for x, z in outline]
        lines = [occ.addLine(p, q) for p, q in zip(points, points[1:] + points[:1], strict=True)]
        face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
        return [e for e in occ.extrude([(2, face)], 0, high - low, 0) if e[0] == 3]

    return draw


# ---- a wedge
SLOPE, LENGTH, FOOT = np.deg2rad(12.0), 4.0, 0.3


def height(x):
    """Of the wedge's slope."""
    return FOOT + (LENGTH - x) * np.tan(SLOPE)


WEDGE = [(0, 0), (LENGTH, 0), (LENGTH, FOOT), (0, height(0))]
#: A block in the middle of it.
BLOCK = [(1.5, height(1.5)), (2.7, height(2.7)), (2.7, height(1.5) + 1), (1.5, height(1.5) + 1)]


def press(bodies, friction, exchanged):
    """Contacts of a block on a wedge and of that on a floor, as far as there are such."""
    faces = [body.surface(everywhere) for body in bodies]
    both = zip(faces[:-1], faces[1:], strict=True)
    return [
        nts.ContactPair(*pair[:: -1 if exchanged else 1], friction=friction) for pair in both
    ]


@pytest.mark.mpi
@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_a_wedge_lifts_a_rigid_block_as_a_screw_does_its_nut(friction, exchanged):
    """Of a thread that is unwound: push = load tan(slope + angle of friction)."""
    load = 1e3
    wedge = of_gmsh(prism(WEDGE, -0.5, 0.5), 0.8).rigid(
        density=1.0, motion=lambda t: (0.2 * t, 0, 0), rotation=(0, 0, 0), name="wedge"
    )
    block = of_gmsh(prism(BLOCK, -0.3, 0.3), 0.8).rigid(
        density=1.0, force=(0, 0, -load), name="block"
    )
    guide = nts.Prismatic(block, None, point=(2, 0, 1), axis=(0, 0, 1))
    start = block.position[2]
    system = nts.System(
        [block, wedge], contacts=press([block, wedge], friction, exchanged), joints=[guide]
    )
    run = nts.equilibrium(system, load_steps=5)
    assert run.status == "completed" and set(kinds(run)) <= {"ledger"}
    right = run.balance["time"][1:] * load * np.tan(SLOPE + np.arctan(friction))
    assert np.abs(run.contact_forces[1:, 0, 0]) == pytest.approx(right, rel=1e-6)
    assert block.position[2] - start == pytest.approx(0.2 * np.tan(SLOPE), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_a_soft_wedge_under_a_held_block(friction, exchanged):
    """Friction acts on both of its faces: push = load (tan(slope + angle) + tan(angle))."""
    rubber, top = nts.NeoHookean(young=1e7, poisson=0.3), height(1.5) + 1.0
    wedge = of_gmsh(prism(WEDGE, -0.5, 0.5), 0.8).continuum(
        rubber, density=1.0, degree=1, name="wedge",
        bcs=[nts.Dirichlet(lambda x: x[0] < 1e-6, lambda t: (0.2 * t, 0, 0), components=(0, 1))],
    )  # fmt: skip
    block = of_gmsh(prism(BLOCK, -0.3, 0.3), 0.8).continuum(
        rubber, density=1.0, degree=1, name="block",
        bcs=[nts.Dirichlet(lambda x: x[2] > top - 1e-6)],
    )
    floor = of_gmsh(lambda occ: [(3, occ.addBox(-3, -1, -1, 9, 2, 1))], 1.0).rigid(
        density=1.0, name="floor", **STILL
    )
    bodies = [block, wedge, floor]
    system = nts.System(bodies, contacts=press(bodies, friction, exchanged))
    run = nts.equilibrium(system, load_steps=10)
    assert run.status == "completed"
    push = run.reactions["wedge"][-1].sum(axis=0)[0]
    load = -run.reactions["block"][-1].sum(axis=0)[2]
    angle = np.arctan(friction)
    right = np.tan(SLOPE + angle) + np.tan(angle)
    # Its facets bend, and the block's rims dig in.
    assert push / load == pytest.approx(right, rel=0.015)


# ---- a seal
CORD, WIDE, LONG = 2.0, 2.2, 1.0


def seal(walls, friction, rolls=False):
    """A cord in a groove under a lid that comes down by 0.7 mm; forces of walls and lid.

    It is half a cord that its plane of symmetry holds, or a whole one that is free to roll.
    """
    left = -0.5 * WIDE if rolls else -1.0

    def drawn(occ):
        cord = [(3, occ.addCylinder(0, 0, 0.5 * CORD, 0, LONG, 0, 0.5 * CORD))]
        return cord if rolls else occ.intersect(cord, [(3, occ.addBox(0, -1, -1, 5, 5, 5))])[0]

    def groove(occ):
        block = occ.addBox(left - 1.0, -0.4, -1, 0.5 * WIDE + 2.0 - left, LONG + 0.8, 3.2)
        start = left if rolls else left - 1.0
        room = occ.addBox(start, -1, 0, 0.5 * WIDE - start, 3, 5)
        return occ.cut([(3, block)], [(3, room)])[0]

    def lid(occ):
        return [(3, occ.addBox(left - 0.4, -0.3, CORD, 0.5 * WIDE + 0.8 - left, LONG + 0.6, 1))]

    ends = nts.Dirichlet(
        lambda x: (np.abs(x[1]) < 1e-6) | (np.abs(x[1] - LONG) < 1e-6), components=(1,)
    )
    middle = nts.Dirichlet(lambda x: np.abs(x[0]) < 1e-6, components=(0,))
    cord = of_gmsh(drawn, 0.5).continuum(
        nts.NeoHookean(young=5.0, poisson=0.3), density=1.0, degree=1, name="cord",
        bcs=[ends] if rolls else [ends, middle],
    )  # fmt: skip
    down = {"motion": lambda t: (0, 0, -0.7 * t)}
    bodies, masters = [cord], []
    if walls == "planes":
        masters = [
            nts.Plane((0, 0, 0), (0, 0, 1)), nts.Plane((0.5 * WIDE, 0, 0), (-1, 0, 0)),
            nts.Plane((0, 0, CORD), (0, 0, -1), **down),
        ]  # fmt: skip
        masters[2:2] = [nts.Plane((left, 0, 0), (1, 0, 0))] if rolls else []
    else:
        bodies += [
            of_gmsh(groove, 1.0).rigid(density=1.0, name="groove", **STILL),
            of_gmsh(lid, 1.0).rigid(density=1.0, name="lid", rotation=(0, 0, 0), **down),
        ]
        masters = [body.surface(everywhere) for body in bodies[1:]]
    skin = cord.surface(lambda x: np.hypot(x[0], x[2] - 0.5 * CORD) > 0.4 * CORD)
    pairs = [nts.ContactPair(skin, master, friction=friction) for master in masters]
    run = nts.equilibrium(nts.System(bodies, contacts=pairs), load_steps=6)
    assert run.status == "completed" and set(kinds(run)) <= {"ledger"}
    force = run.contact_forces[-1]
    return force[:-1].sum(axis=0), force[-1]


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.fast_on_ranks()
def test_a_seal_in_a_groove_of_tetrahedra_is_squeezed_as_between_planes(friction):
    """Both of the groove's faces hold it at once."""
    planes, tetrahedra = (seal(walls, friction) for walls in ("planes", "tetrahedra"))
    assert planes[0][0] < -0.05 and planes[1][2] < -1.5
    np.testing.assert_allclose(tetrahedra, planes, atol=1e-6 * abs(planes[1][2]))


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.1, 0.6])
@pytest.mark.fast_on_ranks()
def test_a_seal_that_friction_alone_keeps_from_rolling(friction):
    """What slid before it rubbed rolled away, and was given up after 25 iterations."""
    planes, tetrahedra = (seal(walls, friction, rolls=True) for walls in ("planes", "tetrahedra"))
    assert planes[1][2] < -3.0
    np.testing.assert_allclose(tetrahedra, planes, atol=1e-6 * abs(planes[1][2]))


def o_ring(friction, load_steps, **options):
    """An eighth of an O-ring of nu = 0.49 between plates: the run, and what Lindley says.

    F/(pi D d) = E (1.25 c^1.5 + 50 c^6), here of plane strain. Nothing but contact holds it along
    its axis.
    """
    d, across, young, nu, squeeze = 2.62, 22.62, 5.0, 0.49, 0.5
    part = of_gmsh(
        lambda occ: [(3, occ.addTorus(0, 0, d / 2, across / 2, d / 2, angle=np.pi / 4))], 0.7
    )
    cuts = [
        nts.Dirichlet(lambda x: x[1] < 1e-6, components=(1,)),
        nts.Dirichlet(lambda x: np.abs(x[1] - x[0]) < 1e-6, components=(0, 1)),
    ]
    body = part.continuum(
        nts.NeoHookean(young=young, poisson=nu), density=1.0, degree=2, bcs=cuts, name="ring"
    )
    skin = body.surface(everywhere)
    top = nts.Plane((0, 0, d), (0, 0, -1), motion=lambda t: (0, 0, -squeeze * t))
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    pairs = [nts.ContactPair(skin, plate, friction=friction) for plate in (floor, top)]
    run = nts.equilibrium(nts.System([body], contacts=pairs), load_steps=load_steps, **options)
    c = squeeze * run.balance["time"] / d
    lindley = d * young * (1.25 * c**1.5 + 50.0 * c**6) * 0.75 / (1.0 - nu**2)
    return run, lindley * (np.pi * across / 8.0)


@pytest.mark.slow
def test_an_o_ring_between_plates_carries_what_lindley_says():
    """Its authors give that within some per cent."""
    run, lindley = o_ring(0.0, 4, stabilization=0.1)
    np.testing.assert_allclose(-run.contact_forces[2:, 1, 2], lindley[2:], rtol=0.06)


@pytest.mark.mpi
@pytest.mark.slow
def test_an_o_ring_with_friction_starts_by_itself():
    """Contact begins on a line: nodes went to and fro between stick, slip and none.

    Lindley's ring widens freely. Friction holds its radius, up to plane strain, which has
    1/(1 - nu^2) of that force. Both step sizes lead to the same.
    """
    friction, forces = 0.2, []
    for load_steps in (3, 6):
        run, lindley = o_ring(friction, load_steps)
        assert run.status == "completed"
        both = run.contact_forces[-1]
        assert both.sum(axis=0)[2] == pytest.approx(0.0, abs=1e-8 * lindley[-1])
        forces.append(-both[1, 2])
        for contact in run.state.contacts:
            pull = np.linalg.norm(contact.tangential, axis=1)
            assert (pull <= friction * contact.force * (1.0 + 1e-8) + 1e-9 * lindley[-1]).all()
        assert (np.diff(run.balance["friction_dissipation"]) >= -1e-9 * lindley[-1]).all()
    assert forces[0] == pytest.approx(forces[1], rel=0.01)
    assert 1.0 < forces[1] / lindley[-1] < 1.06 / (1.0 - 0.49**2)


# ---- a chain
def chain(links, interference="refuse"):
    """Links, of which those between the ends are rigid and free to move along the chain.

    A weak spring starts them. Returns the bodies, the system, the springs' stiffness.
    """
    ring, wire, stiffness, stretch = 10.0, 3.0, 1.0, 0.3
    pitch = 2.0 * (ring - wire) - 0.02
    steel, bodies, joints = nts.NeoHookean(young=2e5, poisson=0.3), [], []
    for k in range(links):

        def draw(occ, k=k):
            torus = [(3, occ.addTorus(0, 0, 0, ring, wire))]
            occ.rotate(torus, 0, 0, 0, 1, 0, 0, 0.5 * np.pi * (k % 2))
            occ.translate(torus, k * pitch, 0, 0)
            return torus

        part, name = of_gmsh(draw, 3.5), f"link {k}"
        if 0 < k < links - 1:
            bodies.append(part.rigid(density=7.8e-9, name=name))
            at = (k * pitch, 0, 0)
            joints += [
                nts.Prismatic(bodies[-1], None, point=at, axis=(1, 0, 0)),
                nts.Spring(
                    bodies[-1], None, points=(at, (k * pitch - 1e3, 0, 0)), stiffness=stiffness,
                    length=1e3,
                ),
            ]  # fmt: skip
            continue
        far = stretch * k
        held = nts.Dirichlet(
            lambda x, k=k: (1 if k else -1) * (x[0] - k * pitch) > ring - 0.5,
            value=lambda t, far=far: (far * t, 0, 0),
        )
        bodies.append(part.continuum(steel, density=7.8e-9, degree=1, bcs=[held], name=name))
    faces = [body.surface(everywhere) for body in bodies[::-1]]
    pairs = [
        nts.ContactPair(*both, interference=interference)
        for both in zip(faces[:-1], faces[1:], strict=True)
    ]
    return bodies, nts.System(bodies, contacts=pairs, joints=joints), stiffness


@pytest.mark.slow
@pytest.mark.parametrize("links", [3, 5])
def test_links_of_a_chain_carry_one_force(links):
    """What is pulled at one end comes out at the other one, but for the springs."""
    bodies, system, stiffness = chain(links)
    starts = [body.position[0] for body in bodies[1:-1]]
    run = nts.equilibrium(system, load_steps=4)
    assert run.status == "completed"
    pulled = run.reactions[f"link {links - 1}"][-1].sum(axis=0)[0]
    assert pulled > 1e4
    # From the end that is pulled on each link is drawn back by its spring.
    ways = [body.position[0] - x for body, x in zip(bodies[1:-1], starts, strict=True)]
    left = stiffness * np.cumsum([0.0, *ways[::-1]])
    assert -run.contact_forces[-1, :, 0] == pytest.approx(pulled - left, rel=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(COMM.size > 1, reason="looks at tetrahedra of one rank")
@pytest.mark.parametrize("interference", ["refuse", "resolve"])
def test_chords_that_start_inside_each_other_are_told_or_pressed_out(interference):
    """Links leave 0.02 of 14, and chords of the wire's inner side reach 0.2 into the hole."""
    bodies, system, _ = chain(3, interference)
    start = [(b.position.copy(), b.rotation.copy()) if b.rigid else None for b in bodies]
    run = nts.equilibrium(system, load_steps=4)
    assert run.status == "completed"
    assert ("edges start inside" in kinds(run)) == (interference == "refuse")
    places = list(zip(bodies, start, strict=True))
    depth = [
        deepest(one, two, at, there, between=9)
        for k in (0, 1)
        for (one, at), (two, there) in (places[k : k + 2], places[k : k + 2][::-1])
    ]
    assert max(depth) > 0.05 if interference == "refuse" else max(depth) < 0.01


# ---- a snap fit
SPRING, BREADTH, THICK, UNDERCUT, NOSE = 30e-3, 5e-3, 3e-3, 1e-3, 1.6e-3
YOUNG, LEAD, LEAVE, FLAT, RUBS = 2.8e9, np.deg2rad(30.0), np.deg2rad(60.0), 1e-3, 0.3
#: Height of the nose's ends, which are no edges of nothing.
BLUNT = 0.1e-3


def hook(cells):
    """A cantilever of hexahedra with a nose on its end."""
    start, end = SPRING - NOSE / np.tan(LEAVE), SPRING + FLAT + NOSE / np.tan(LEAD)
    x = [*np.linspace(0, start, cells + 1), SPRING, SPRING + FLAT, end]
    y, z = np.linspace(-0.5, 0.5, 3) * BREADTH, np.linspace(-0.5, 0.5, 3) * THICK
    points = [(a, b, c) for a in x for b in y for c in z]
    low, high = z[2] + BLUNT, z[2] + NOSE
    top = len(points) + np.arange(12).reshape(4, 3)
    points += [
        (a, b, c) for a, c in zip(x[-4:], (low, high, high, low), strict=True) for b in y
    ]
    number = np.arange(9 * len(x)).reshape(len(x), 3, 3)
    above = np.stack([number[-4:, :, 2], top], axis=2)
    hexahedra = []
    for grid in (number, above):
        sides = [(slice(None, -1), slice(1, None))[k] for k in (0, 1)]
        corners = [grid[a, b, c] for c in sides for b in sides for a in sides]
        hexahedra.append(np.stack([c.ravel() for c in corners], axis=1))
    return create_mesh(COMM, np.concatenate(hexahedra), np.array(points), "hexahedron")


def insertion():
    """Force at the end of the lead-in face and on the flat one [N]."""
    lead = np.arctan((NOSE - BLUNT) / NOSE * np.tan(LEAD))
    stiffness, length = YOUNG * BREADTH * THICK**3 / 12, SPRING + FLAT
    return snap_fit.insertion(stiffness, length, 0.5 * THICK + NOSE, UNDERCUT, lead, RUBS)


@pytest.mark.slow
@pytest.mark.skipif(COMM.size > 1, reason="makes its meshes of one rank's arrays")
@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("kind", ["rigid", "soft"])
def test_a_snap_fit_of_two_solids_takes_the_force_that_beams_say(kind, exchanged):
    """A catch with a sharp edge rides up the nose, over its edge and along its flat face.

    Between nodes of the nose its edge sinks in a little, and must not be caught by them.
    """
    nose = nts.Continuum(
        hook(48), nts.NeoHookean(young=YOUNG, poisson=0.0), density=1.4e3, name="hook",
        bcs=[nts.Dirichlet(lambda x: x[0] < 1e-9)],
    )  # fmt: skip
    low, slope = 0.5 * THICK + NOSE - UNDERCUT, NOSE / np.tan(LEAD)
    # Where its edge touches the lead-in face at rest.
    at = SPRING + FLAT + UNDERCUT * slope / (NOSE - BLUNT)
    outline = [(at, low), (at + 0.4e-3, low), (at - 0.5e-3, low + 3e-3), (at + 2e-3, low + 3e-3)]
    points = np.array([(x, y, z) for y in (-0.4 * BREADTH, 0.4 * BREADTH) for x, z in outline])
    mesh = create_mesh(COMM, np.array([[4, 5, 0, 1, 6, 7, 2, 3]]), points, "hexahedron")
    go = {"motion": lambda t: (-1e-3 * t, 0, 0)}
    if kind == "rigid":
        catch = nts.RigidBody(mesh, density=1.4e3, name="catch", rotation=(0, 0, 0), **go)
    else:
        held = nts.Dirichlet(lambda x: x[2] > low + 3e-3 - 1e-9, value=go["motion"])
        stiff = nts.NeoHookean(young=100.0 * YOUNG, poisson=0.0)
        catch = nts.Continuum(mesh, stiff, density=1.4e3, name="catch", bcs=[held])
    face = nose.surface(lambda x: x[2] > 0.5 * THICK - 1e-9)
    both = (catch.surface(everywhere), face)[:: -1 if exchanged else 1]
    pair = nts.ContactPair(*both, friction=RUBS)
    climb = 1e3 * UNDERCUT * slope / (NOSE - BLUNT)
    steps = [*np.linspace(0, climb - 0.2, 9)[1:], *np.linspace(climb - 0.2, climb + 0.05, 26)[1:]]
    run = nts.equilibrium(nts.System([nose, catch], contacts=[pair]), load_steps=steps)
    assert run.status == "completed"
    push, right = np.abs(run.contact_forces[:, 0, 0]), insertion()
    assert push.max() == pytest.approx(right[0], rel=0.03)
    # Farther on the spring is shorter.
    assert push[push.argmax() + 1] == pytest.approx(right[1], rel=0.03)
