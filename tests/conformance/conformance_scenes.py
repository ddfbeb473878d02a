"""Scenes of all bodies, couplings and laws, small and short, each seen in any frame.

A new body, coupling or law needs a scene here: what holds for all is then held for it.
"""

import numpy as np
from dolfinx import fem
from rotations import rotation
from scenes import green, saint_venant

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

RUBBER = {"young": 1e5, "poisson": 0.3}
DENSITY = 1e3


def _solid(frame, kind, low, high, cells, name, material=nts.NeoHookean, **options):
    law = material(young=frame.size(RUBBER["young"], 2), poisson=RUBBER["poisson"])
    mesh = frame.grid(kind, low, high, cells)
    return nts.Continuum(mesh, law, density=DENSITY, name=name, **options)


def _rigid(frame, low, high, name, spin=(0, 0, 0), velocity=(0, 0, 0), cells=(2, 2, 2)):
    return nts.RigidBody(
        frame.grid("hexahedron", low, high, cells), density=DENSITY, name=name,
        velocity=frame.place(velocity), angular_velocity=frame.axis(*spin),
    )  # fmt: skip


def _face(frame, body, axis, value, **options):
    return body.surface(frame.where(lambda x: np.abs(x[:, axis] - value) < 1e-6), **options)


def _plane(frame, height=0.0):
    return nts.Plane(frame.place(0, 0, height), frame.axis(0, 0, 1))


def _gravity(frame):
    return frame.place(0, 0, -9.81)


def two_blocks(frame):
    """Hexahedra on tetrahedra, that meet with friction."""
    lower = _solid(frame, "tetrahedron", (0, 0, 0), (1, 1, 0.6), (2, 2, 1), "lower")
    upper = _solid(
        frame, "hexahedron", (0.21, 0.17, 0.602), (0.83, 0.77, 1.2), (2, 2, 2), "upper",
        velocity=frame.place(0.4, 0.1, -0.9),
    )  # fmt: skip
    pair = nts.ContactPair(_face(frame, upper, 2, 0.602), _face(frame, lower, 2, 0.6), friction=0.3)
    return nts.System([lower, upper], contacts=[pair])


def block_on_a_plane(frame):
    """St. Venant-Kirchhoff's law, on nodes without mass; slides and settles."""
    block = _solid(
        frame, "hexahedron", (0, 0, 0), (1, 0.5, 0.4), (3, 2, 5), "block",
        nts.StVenantKirchhoff, velocity=frame.place(1.0, 0.2, 0),
    )  # fmt: skip
    pair = nts.ContactPair(
        _face(frame, block, 2, 0.0, mass="redistributed"), _plane(frame), friction=0.2
    )
    return nts.System([block], contacts=[pair], gravity=_gravity(frame))


def _moduli(frame):
    """Shear and bulk modulus of rubber."""
    young, poisson = frame.size(RUBBER["young"], 2), RUBBER["poisson"]
    return young / (2 * (1 + poisson)), young / (3 * (1 - 2 * poisson))


def rigid_on_rubber(frame):
    """A spinning rigid brick falls on a block of tetrahedra that stands on supports."""
    mesh = frame.grid("tetrahedron", (0, 0, 0), (1, 1, 0.5), (2, 2, 1))
    below = frame.where(lambda x: x[:, 2] < 1e-6)
    shear, bulk = _moduli(frame)
    law = nts.Ogden(mu=(shear / 1.5,), alpha=(3.0,), bulk=bulk)
    block = nts.Continuum(mesh, law, density=DENSITY, bcs=[nts.Dirichlet(below)], name="block")
    brick = _rigid(
        frame, (0.31, 0.28, 0.501), (0.68, 0.59, 0.7), "brick", spin=(0, 0, 3),
        velocity=(0.3, 0, -0.6), cells=(2, 2, 1),
    )  # fmt: skip
    pair = nts.ContactPair(
        _face(frame, brick, 2, 0.501), _face(frame, block, 2, 0.5), friction=0.4
    )
    return nts.System([block, brick], contacts=[pair], gravity=_gravity(frame))


def mechanism(frame):
    """Three rigid links: a hinge, a ball joint, a slider; a spring, a damper, two actuators."""
    links = [
        _rigid(frame, (k, -0.1, -0.1), (k + 1, 0.1, 0.1), f"link {k}", cells=(1, 1, 1))
        for k in range(3)
    ]
    joints = [
        nts.Revolute(None, links[0], point=frame.place(0, 0, 0), axis=frame.axis(0, 1, 0)),
        nts.Spherical(links[0], links[1], point=frame.place(1, 0, 0)),
        nts.Cylindrical(links[1], links[2], point=frame.place(2, 0, 0), axis=frame.axis(1, 1, 0)),
        nts.Spring(
            links[1], links[2], [frame.place(1.5, 0, 0.1), frame.place(2.5, 0.1, 0)],
            stiffness=frame.size(2e3, 3), length=frame.size(0.8, 1), name="spring",
        ),
        nts.Damper(
            None, links[2], [frame.place(2, 1, 1), frame.place(3, 0, 0)],
            damping=frame.size(50.0, 3), name="damper",
        ),
        nts.Torque(
            links[0], None, axis=frame.axis(0, 1, 0), name="torque",
            torque=lambda t, a, rate: frame.size(20.0 * np.cos(10 * t) - 30.0 * a - rate, 5),
        ),
        nts.Thrust(
            links[0], links[2], [frame.place(0.5, 0, 0.1), frame.place(2.5, 0, 0.1)], name="thrust",
            force=lambda t, x, rate: frame.size(20.0, 4) - 10.0 * frame.size(rate, 3),
        ),
    ]  # fmt: skip
    return nts.System(links, joints=joints, gravity=_gravity(frame))


def tied(frame):
    """A rigid head tied to a rubber rod, both turning about the rod's end as if they were rigid."""
    spin = np.array([0.5, 0.0, 3.0])

    def turning(x):
        return np.transpose([frame.place(*v) for v in np.cross(spin, frame.back(x.T))])

    rod = _solid(
        frame, "hexahedron", (0, 0, 0), (1.2, 0.3, 0.3), (4, 1, 1), "rod", velocity=turning,
        bending=True,
    )  # fmt: skip
    head = _rigid(
        frame, (1.2, -0.1, -0.1), (1.6, 0.4, 0.4), "head", spin=spin,
        velocity=np.cross(spin, (1.4, 0.15, 0.15)), cells=(1, 1, 1),
    )  # fmt: skip
    tie = nts.Tie(head, _face(frame, rod, 0, 1.2), name="tie")
    return nts.System([rod, head], joints=[tie])


def _beam(frame, low, high, cells, **options):
    section = nts.Rectangle(frame.size(0.05, 1), frame.size(0.08, 1)).section(
        young=frame.size(1e8, 2), poisson=0.3, density=DENSITY
    )
    mesh = frame.grid("interval", low, high, (cells,))
    return nts.Beam(mesh, section, direction=frame.axis(0, 1, 0), **options)


def beam(frame):
    """A clamped beam with two rigid weights below its end, one below the other."""
    clamp = nts.Clamp(frame.where(lambda x: x[:, 0] < 1e-6))
    rod = _beam(frame, (0, 0, 0), (2, 0, 0), 4, bcs=[clamp], name="rod")
    weight = _rigid(frame, (1.9, -0.1, -0.3), (2.1, 0.1, -0.1), "weight", cells=(1, 1, 1))
    second = _rigid(frame, (1.9, -0.1, -0.6), (2.2, 0.1, -0.4), "second", cells=(1, 1, 1))
    joints = [
        nts.Spherical(rod, weight, point=frame.place(2, 0, 0), name="eye"),
        nts.Spherical(weight, second, point=frame.place(2, 0, -0.35), name="hook"),
    ]
    return nts.System([rod, weight, second], joints=joints, gravity=_gravity(frame))


def ropes(frame):
    """Three ropes of one kind, which a step evaluates together: two hang from hooks, one flies."""
    a, b, c = (
        _beam(
            frame, (0, k, 0), (1 + 0.5 * k, k, 0), 2 + k, name=f"rope {k}",
            velocity=frame.place(0.1 * (k == 2), 0, 0),
        )
        for k in range(3)
    )  # fmt: skip
    joints = [
        nts.Spherical(a, None, point=frame.place(0, 0, 0), name="hook"),
        nts.Spherical(b, None, point=frame.place(0, 1, 0), name="other hook"),
        nts.Distance(a, b, points=[frame.place(1, 0, 0), frame.place(1.5, 1, 0)], name="rod"),
    ]
    return nts.System([a, b, c], joints=joints, gravity=_gravity(frame))


def shell(frame):
    """A plate that falls on a sphere with friction."""
    mesh = frame.grid("quadrilateral", (0, 0, 0), (1, 1, 0), (4, 4))
    plate = nts.Shell(
        mesh, young=frame.size(1e7, 2), poisson=0.3, thickness=frame.size(0.03, 1),
        density=DENSITY, velocity=frame.place(0.2, 0, -1.0), name="plate",
        angular_velocity=frame.axis(0, 0, 1.0),
    )  # fmt: skip
    ball = nts.Sphere(frame.place(0.45, 0.52, -0.517), frame.size(0.5, 1))
    side = plate.surface(frame.where(lambda x: np.full(len(x), True)), side="bottom")
    pair = nts.ContactPair(side, ball, friction=0.3)
    return nts.System([plate], contacts=[pair])


def more_joints(frame):
    """Five links from a slider on: a cross, a weld, a rod to a plane, a hinge with a spring."""
    links = [
        _rigid(frame, (k, -0.1, -0.1), (k + 1, 0.1, 0.1), f"link {k}", cells=(1, 1, 1))
        for k in range(5)
    ]
    axis, place = frame.axis, frame.place
    joints = [
        nts.Prismatic(None, links[0], point=place(0, 0, 0), axis=axis(1, 0, -1)),
        nts.Universal(
            links[0], links[1], point=place(1, 0, 0), axes=(axis(0, 1, 0), axis(0, 0, 1))
        ),
        nts.Fixed(links[1], links[2], point=place(2, 0, 0)),
        nts.Distance(links[2], links[3], points=[place(2.9, 0, 0.1), place(3.1, 0, -0.4)]),
        nts.Planar(None, links[3], point=place(3.5, 0, 0), axis=axis(0, 1, 2)),
        nts.Revolute(links[3], links[4], point=place(4, 0, 0), axis=axis(0, 1, 0)),
        nts.TorsionSpring(
            links[3], links[4], axis=axis(0, 1, 0), stiffness=frame.size(50.0, 5), name="spring"
        ),
        nts.TorsionDamper(
            links[3], links[4], axis=axis(0, 1, 0), damping=frame.size(1.0, 5), name="damper"
        ),
    ]
    return nts.System(links, joints=joints, gravity=_gravity(frame))


def sewn(frame):
    """Two shells that meet at 68 degrees in a seam, one of them clamped."""
    given = {
        "young": frame.size(1e7, 2), "poisson": 0.3, "thickness": frame.size(0.03, 1),
        "density": DENSITY,
    }  # fmt: skip
    clamp = nts.Clamp(frame.where(lambda x: x[:, 0] < 1e-6))
    mesh = frame.grid("quadrilateral", (0, 0, 0), (1, 0.5, 0), (4, 2))
    flange = nts.Shell(mesh, bcs=[clamp], name="flange", **given)
    mesh = frame.grid("quadrilateral", (0, 0, 0.5), (0.5, 0.4, 0.5), (2, 2), axes=(1, 2, 0))
    x, y, z = frame.back(mesh.geometry.x).T
    mesh.geometry.x[:] = frame.place(np.column_stack([x + 0.4 * z, y, z]))
    web = nts.Shell(mesh, name="web", **given)
    edge = web.surface(frame.where(lambda x: x[:, 2] < 1e-6), side="edge")
    return nts.System([flange, web], joints=[nts.Seam(flange, edge)], gravity=_gravity(frame))


def in_a_bore(frame):
    """A viscous block of Mooney's rubber and one of the user's own energy, each in a bore."""
    modulus = frame.size(RUBBER["young"], 2)
    mesh = frame.grid("hexahedron", (0, 0, 0), (0.6, 0.3, 0.3), (2, 2, 2))
    law = nts.MooneyRivlin(a=0.2 * modulus, b=0.05 * modulus, c=modulus)
    block = nts.Continuum(
        mesh, law, density=DENSITY, viscosity=frame.size(100.0, 2), name="block",
        velocity=frame.place(0.3, 0, -1.2),
    )  # fmt: skip
    mesh = frame.grid("tetrahedron", (2, 0, 0), (2.4, 0.3, 0.3), (1, 1, 1))
    space = compat.vector_space(mesh, 1)
    # A Constant, so that all units share the compiled forms.
    stored = saint_venant(fem.Constant(mesh, modulus), RUBBER["poisson"])
    own = nts.FormBody(
        space, energy=lambda e: stored(e), strain=green, density=DENSITY,
        velocity=frame.place(0, 1.0, -1.0), name="own",
    )  # fmt: skip
    bore = nts.Cylinder(
        frame.place(0, 0.15, 0.152), frame.axis(1, 0, 0), frame.size(0.215, 1), inside=True
    )
    pairs = [
        nts.ContactPair(_face(frame, body, 2, 0.0), bore, friction=0.3) for body in (block, own)
    ]
    return nts.System([block, own], contacts=pairs)


def in_an_angle(frame):
    """A cube slides along the inner edge of an angle, out of which one contact holds it."""
    mesh = frame.grid("hexahedron", (0, 0, 0), (2, 1, 1), (2, 2, 1))
    x = frame.back(mesh.geometry.x)
    places = np.array([[(-1, -0.3), (-1, 0)], [(1.3, -0.3), (1, 0)], [(1.3, 1), (1, 1)]])
    x[:, ::2] = places[np.rint(x[:, 0]).astype(int), np.rint(x[:, 2]).astype(int)]
    mesh.geometry.x[:] = frame.place(x)
    law = nts.NeoHookean(young=frame.size(RUBBER["young"], 2), poisson=RUBBER["poisson"])
    angle = nts.Continuum(mesh, law, density=DENSITY, name="angle")
    cube = _solid(
        frame, "tetrahedron", (0.6, 0.27, 0.003), (0.997, 0.68, 0.4), (2, 2, 2), "cube",
        velocity=frame.place(1.1, 1.2, -0.9),
    )  # fmt: skip
    inside = angle.surface(
        frame.where(lambda x: (np.abs(x[:, 2]) < 1e-6) | (np.abs(x[:, 0] - 1.0) < 1e-6))
    )
    own = cube.surface(frame.where(lambda x: (x[:, 2] < 0.0031) | (x[:, 0] > 0.9969)))
    return nts.System([angle, cube], contacts=[nts.ContactPair(own, inside, friction=0.1)])


def fold(frame):
    """A strip bent to a U, whose legs close and rub."""
    mesh = frame.grid("hexahedron", (0, 0, 0), (8, 0.3, 0.4), (8, 1, 2))
    s, across, z = frame.back(mesh.geometry.x).T
    radius, angle = 0.02 + across, np.pi * np.clip(0.5 * (s - 3.0), 0.0, 1.0)
    # The lower leg is longer and wider, and its nodes lie elsewhere.
    along = np.where(s < 4.0, 0.4 * np.maximum(3.0 - s, 0.0), 0.47 * np.maximum(s - 5.0, 0.0))
    x = np.where((s > 3.0) & (s < 5.0), -radius * np.sin(angle), along)
    z = (z - 0.2) * np.where(s < 3.5, 0.8, 1.0)
    mesh.geometry.x[:] = frame.place(np.column_stack([x, radius * np.cos(angle), z]))

    def closing(x):
        x, y, _ = frame.back(x.T).T
        speed = -1.5 * np.sign(y) * np.maximum(x, 0.0)
        return frame.place(np.column_stack([-0.3 * speed, speed, 0.2 * speed])).T

    shear, bulk = _moduli(frame)
    law = nts.Yeoh(c10=shear / 2, c20=-shear / 20, c30=shear / 100, bulk=bulk)
    strip = nts.Continuum(mesh, law, density=DENSITY, velocity=closing, name="strip")
    sides = strip.surface(frame.where(lambda x: np.abs(np.abs(x[:, 1]) - 0.02) < 1e-6))
    return nts.System([strip], contacts=[nts.SelfContact(sides, friction=0.3)])


def hoist(frame):
    """A load in the bight of an elastic cable from a winch over a jib, which a spring holds."""
    jib = _rigid(frame, (0, -0.1, -0.1), (2, 0.1, 0.1), "jib", cells=(1, 1, 1))
    load = _rigid(
        frame, (1.5, -0.1, -1.2), (1.8, 0.1, -0.9), "load", spin=(0.5, 0.3, 2.0),
        velocity=(0, 0.4, 0), cells=(1, 1, 1),
    )  # fmt: skip
    way = [
        (None, (0, 0, 0.8)), (jib, (1.4, 0.05, 0.1)), (load, (1.65, 0, -0.9)), (jib, (1.95, 0, 0)),
    ]  # fmt: skip
    length = 0.995 * np.linalg.norm(np.diff([x for _, x in way], axis=0), axis=1).sum()
    joints = [
        nts.Revolute(jib, None, point=frame.place(0, 0, 0), axis=frame.axis(0, 1, 0)),
        nts.Spring(
            jib, None, [frame.place(1.0, 0, 0), frame.place(1.0, 0, -1.0)],
            stiffness=frame.size(1e4, 3),
        ),
        nts.Cable(
            [(body, frame.place(*x)) for body, x in way], name="cable",
            axial_stiffness=frame.size(5e4, 4), length=lambda t: frame.size(length - 0.1 * t, 1),
        ),
    ]  # fmt: skip
    return nts.System([jib, load], joints=joints, gravity=_gravity(frame))


def of_degree_two(frame):
    """Hexahedra between tetrahedra of degree 2: contact over surfaces, and of nodes with edges."""
    middle = _solid(frame, "hexahedron", (0, 0, 0), (1, 1, 0.5), (2, 2, 1), "middle")
    below, above = (
        _solid(
            frame, "tetrahedron", (0.11, 0.17, z), (0.83, 0.77, z + 0.4), (1, 1, 1), name, degree=2,
            velocity=frame.place(0.4, 0.2, speed),
        )
        for name, z, speed in (("below", -0.403, 0.9), ("above", 0.502, -0.9))
    )  # fmt: skip
    surfaces = nts.ContactPair(
        _face(frame, above, 2, 0.502), _face(frame, middle, 2, 0.5), friction=0.3,
        integration="surface",
    )  # fmt: skip
    nodes = nts.ContactPair(
        _face(frame, below, 2, -0.003), _face(frame, middle, 2, 0.0), friction=0.3
    )
    return nts.System([below, middle, above], contacts=[surfaces, nodes])


def leaf_on_a_pad(frame):
    """Cells that bend, one over the thickness, on some whose volume is projected; in flight."""
    pad = _solid(
        frame, "hexahedron", (0, 0, 0), (1, 1, 0.6), (2, 2, 2), "pad", volume="projected",
    )  # fmt: skip
    leaf = _solid(
        frame, "hexahedron", (-0.4, 0.23, 0.602), (1.4, 0.81, 0.702), (6, 2, 1), "leaf",
        velocity=frame.place(0.3, 0.1, -0.6), bending=True,
    )  # fmt: skip
    pair = nts.ContactPair(_face(frame, leaf, 2, 0.602), _face(frame, pad, 2, 0.6), friction=0.2)
    return nts.System([leaf, pad], contacts=[pair])


def beam_on_a_plate(frame):
    """A beam of degree 2 that slides on a shell."""
    bar = _beam(
        frame, (0.13, 0.21, 0.0551), (0.83, 0.77, 0.0561), 2, degree=2, name="bar",
        velocity=frame.place(0.3, 0, -0.1),
    )  # fmt: skip
    mesh = frame.grid("quadrilateral", (0, 0, 0), (1, 1, 0), (4, 4))
    plate = nts.Shell(
        mesh, young=frame.size(1e7, 2), poisson=0.3, thickness=frame.size(0.03, 1),
        density=DENSITY, name="plate",
    )  # fmt: skip
    pair = nts.ContactPair(bar.surface(), plate.surface(side="top"), friction=0.3)
    return nts.System([bar, plate], contacts=[pair])


def over_waves(frame):
    """A block that touches smooth waves across a gap that counts as none, and slides on them."""
    mesh = frame.grid("hexahedron", (0, 0, -0.3), (1.2, 1, 0), (6, 5, 1))
    x, y, z = frame.back(mesh.geometry.x).T
    z = z + 0.03 * np.sin(6 * x) * np.cos(4 * y) * (1 + z / 0.3)
    mesh.geometry.x[:] = frame.place(np.column_stack([x, y, z]))
    shear, bulk = _moduli(frame)
    law = nts.ArrudaBoyce(mu=shear, stretch=3.0, bulk=bulk)
    plate = nts.Continuum(mesh, law, density=DENSITY, name="plate")
    block = _solid(
        frame, "hexahedron", (0.21, 0.23, 0.025), (0.61, 0.63, 0.3), (2, 2, 1), "block",
        velocity=frame.place(1.0, 0.7, -0.5),
    )  # fmt: skip
    waves = plate.surface(frame.where(lambda x: x[:, 2] > -0.1), smoothing=True)
    pair = nts.ContactPair(
        _face(frame, block, 2, 0.025), waves, friction=0.3, adjust=frame.size(0.012, 1)
    )
    return nts.System([block, plate], contacts=[pair])


def laws_in_joints(frame):
    """A hinge with friction, one with limits, and weights at a cable that rubs on its pins."""
    arms = [
        _rigid(frame, (k, -0.1, -0.1), (k + 1, 0.1, 0.1), f"arm {k}", cells=(1, 1, 1))
        for k in range(2)
    ]
    axis = frame.axis(0, 1, 0)
    joints = [
        nts.Revolute(
            arms[0], None, point=frame.place(0, 0, 0), axis=axis, name="hinge",
            friction=nts.JointFriction(bound=frame.size(30.0, 5)),
        ),
        nts.Revolute(
            arms[1], arms[0], point=frame.place(1, 0, 0), axis=axis, name="elbow",
            limits=(-0.005, 0.005),
            friction=nts.JointFriction(coefficient=0.2, radius=frame.size(0.05, 1)),
        ),
    ]  # fmt: skip
    weights = [
        _rigid(frame, (x, 1, -1), (x + 0.2, 1.2, -0.8), f"weight at {x}", cells=(1, 1, n))
        for x, n in ((0, 1), (1, 2))
    ]
    way = [(weights[0], (0.1, 1.1, -0.8)), (None, (0.1, 1.1, 0)), (None, (1.1, 1.1, 0)),
           (weights[1], (1.1, 1.1, -0.8))]  # fmt: skip
    cable = nts.Cable(
        [(body, frame.place(*x)) for body, x in way], friction=0.05, name="cable",
        length=lambda t: frame.size(2.6 - 0.3 * t, 1),
    )  # fmt: skip
    return nts.System([*arms, *weights], joints=[*joints, cable], gravity=_gravity(frame))


def tipping(frame):
    """A rigid brick tips over its edge and spins, against friction of all three kinds."""
    spin = np.array([0.0, -2.0, 3.0])
    brick = _rigid(
        frame, (0, -0.3, 0), (0.8, 0.3, 0.5), "brick", spin, np.cross(spin, (0.4, 0, 0.25)),
        cells=(1, 2, 1),
    )  # fmt: skip
    pair = nts.ContactPair(_face(frame, brick, 2, 0.0), _plane(frame), friction=0.2)
    law = nts.RollingFriction(pair, rolling=frame.size(0.03, 1), spinning=frame.size(0.02, 1))
    return nts.System([brick], contacts=[pair], joints=[law], gravity=_gravity(frame))


def edges_and_vertices(frame):
    """Two cubes meet edge across edge, and one of them a vertex of the master between its nodes."""

    def cube(centre, turn, name, size, cells, **options):
        mesh = frame.grid("hexahedron", (-0.5 * size,) * 3, (0.5 * size,) * 3, (cells,) * 3)
        mesh.geometry.x[:] = frame.place(frame.back(mesh.geometry.x) @ turn.T + centre)
        law = nts.NeoHookean(young=frame.size(RUBBER["young"], 2), poisson=RUBBER["poisson"])
        return nts.Continuum(mesh, law, density=DENSITY, name=name, **options)

    on_edge, half = rotation(np.pi / 4, (1, 0, 0)), np.sqrt(0.5)
    low = cube((0, 0, -half), on_edge, "low", 1.0, 2)
    high = cube(
        (0.05, 0.03, half + 0.0111), rotation(1.2, (0, 0, 1)) @ on_edge, "high", 1.0, 2,
        velocity=frame.place(0.3, 0.2, -1.0),
    )  # fmt: skip
    up = rotation(np.arccos(1 / np.sqrt(3)), (-1, 1, 0))
    stone = cube(
        (3.07, 0.04, -0.5112 - 0.25 * np.sqrt(3)), up, "stone", 0.5, 1,
        velocity=frame.place(0.2, 0.1, 1.0),
    )  # fmt: skip
    slab = cube((3.0, 0.0, 0.0), np.eye(3), "slab", 1.0, 2)

    def all_of(body):
        return body.surface(frame.where(lambda x: np.full(len(x), True)))

    pairs = [
        nts.ContactPair(all_of(high), all_of(low), friction=0.3),
        nts.ContactPair(_face(frame, slab, 2, -0.5), all_of(stone), friction=0.3),
    ]
    return nts.System([low, high, slab, stone], contacts=pairs)


#: Step [s] of each scene.
SCENES = {
    two_blocks: 2e-3, block_on_a_plane: 4e-3, rigid_on_rubber: 4e-3, mechanism: 1e-2, tied: 1e-2,
    beam: 5e-3, ropes: 5e-3, shell: 2e-3, more_joints: 1e-2, sewn: 2e-3, in_a_bore: 1e-3,
    fold: 2e-3, hoist: 5e-3, of_degree_two: 2e-3, beam_on_a_plate: 1e-3, over_waves: 2e-3,
    laws_in_joints: 1e-2, leaf_on_a_pad: 2e-3, tipping: 5e-3, in_an_angle: 2e-3,
    edges_and_vertices: 2e-3,
}  # fmt: skip
