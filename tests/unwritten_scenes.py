"""Scenes that no one wrote: hypothesis draws them as plain data, `built` makes systems of these.

Lengths are about a `unit`; moduli, loads and speeds go with it, so that times are the same. Bodies
stand in a row in some direction, each at a gap from the one before. What is drawn may be nonsense:
the package is to refuse it.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from hypothesis import strategies as st
from integrators import GRADIENTS, INTEGRATORS
from rotations import rotation
from solids import Solid

import dolfinx_nts as nts

RULES = INTEGRATORS | {"gonzalez contact": GRADIENTS["gonzalez contact"]}
#: Two laws and Constants for all moduli: few forms are compiled. The moduli [Pa] and ratio of each.
LAWS = {
    "neo-Hookean": nts.NeoHookean, "St. Venant-Kirchhoff": nts.StVenantKirchhoff
}  # fmt: skip
JOINTS = ("Spherical", "Revolute", "Cylindrical", "Prismatic", "Planar", "Universal", "Fixed",
          "Distance", "Spring", "Damper", "Tie")  # fmt: skip
#: Arguments that no run accepts, and what they are.
NONSENSE = {
    "density": 0.0, "young": -1.0, "poisson": 0.5, "velocity": (1.0, float("nan"), 0.0),
    "friction": -0.1, "marker": 1.1, "gravity": (0.0, 0.0), "dt": 0.0, "t_end": float("inf"),
    "accuracy": "exactly", "restitution": 1.5, "impact": "elastic", "tolerance": 0.0,
    "max_iterations": 0, "rtol": 2.0, "smoothing": 1,
}  # fmt: skip


class Plain:
    """Data whose repr leaves out what is as usual, so that it can be pasted into a test."""

    def __repr__(self):
        usual = type(self)()
        changed = [f.name for f in fields(self) if getattr(self, f.name) != getattr(usual, f.name)]
        values = ", ".join(f"{name}={getattr(self, name)!r}" for name in changed)
        return f"{type(self).__name__}({values})"


@dataclass(frozen=True, kw_only=True, repr=False)
class Body(Plain):
    """A body.

    Attributes:
        shape: "box", "ball" or "ring".
        cells: Along the axes of its grid.
        cell: Kind of cells.
        size: Factors of the shape's unit size along its axes.
        turn: Angle [rad] about (1, 2, 3).
        law: Of a flexible one, a name in LAWS; "" of a rigid one.
        young: [Pa].
        poisson: [-].
        density: [kg/m^3].
        gap: To the body before [m].
        speed: Towards the body before [m/s].
        drift: Beside it [m/s].
        spin: [rad/s].
        held: "", "at rest" or "moving": the face away from the body before, or a rigid body.
    """

    shape: str = "box"
    cells: tuple = (2, 2, 2)
    cell: str = "hexahedron"
    size: tuple = (1.0, 1.0, 1.0)
    turn: float = 0.0
    law: str = "neo-Hookean"
    young: float = 1e6
    poisson: float = 0.3
    density: float = 1e3
    gap: float = 0.02
    speed: float = 1.0
    drift: tuple = (0.0, 0.0)
    spin: tuple = (0.0, 0.0, 0.0)
    held: str = ""


@dataclass(frozen=True, kw_only=True, repr=False)
class Contact(Plain):
    """Contact of neighbours, or of a body with an obstacle.

    Attributes:
        first: The body nearer to the start of the row.
        swapped: Whether it is the master.
        facing: Of slave and master: least cosine of the facets' normals with the way to the other
            body; -1: all of the boundary.
        friction: Coefficient [-].
        smoothing: Of the master.
        mass: Of the slave.
    """

    first: int = 0
    swapped: bool = False
    facing: tuple = (0.3, 0.3)
    friction: float = 0.0
    smoothing: bool = False
    mass: str = "consistent"


@dataclass(frozen=True, kw_only=True, repr=False)
class Floor(Plain):
    """An obstacle that a body meets against the direction of the row.

    Attributes:
        kind: "plane", "ball", "rod", "hollow ball" or "hollow rod".
        radius: [m]; of hollow ones beyond the body's size.
        gap: To the first body [m].
        moving: Whether it shakes.
    """

    kind: str = "plane"
    radius: float = 1.0
    gap: float = 0.01
    moving: bool = False


@dataclass(frozen=True, kw_only=True, repr=False)
class Scene(Plain):
    """All of a run.

    Attributes:
        row: Direction of the row of bodies.
        bodies: In the row.
        contacts: Between neighbours.
        floor: An obstacle, or None.
        joints: (kind, first body, whether to the ground instead of the next body).
        gravity: Along the row, towards the first body [m/s^2].
        rule: Integrator, a name in RULES.
        dt: [s].
        steps: Their number.
        options: Of `simulate`.
        newton: Of `Newton`; empty: none is passed.
        nonsense: Name in NONSENSE of an argument that is spoilt, or "".
        unit: Of all lengths [m]; speeds, moduli, stiffnesses and gravity follow.
    """

    row: tuple = (1.0, 0.0, 0.0)
    bodies: tuple = (Body(),)
    contacts: tuple = ()
    floor: Floor | None = None
    joints: tuple = ()
    gravity: float = 0.0
    rule: str = "energy-momentum"
    dt: float = 2e-3
    steps: int = 8
    options: tuple = ()
    newton: tuple = ()
    nonsense: str = ""
    unit: float = 1.0


# ---- drawing
def rounded(x):
    """Four digits, to be read."""
    return float(f"{x:.4g}")


def number(low, high):
    return st.floats(low, high, allow_nan=False).map(rounded)


def mostly(usual, *others, odds=2):
    """One of the others once in odds + 1 draws."""
    return st.sampled_from([usual] * (odds * len(others)) + list(others))


@st.composite
def joint_for(draw, row):
    """A joint that the bodies of a row may have, or now and then any."""
    k, ground = draw(st.integers(0, len(row) - 1)), draw(st.booleans())
    ground = ground or k + 1 == len(row)
    rigid = [not body.law for body in (row[k : k + 1] if ground else row[k : k + 2])]
    kinds = ["Distance", "Spring", "Damper"]
    if all(rigid):
        kinds = [kind for kind in JOINTS if kind != "Tie"]
    elif ground:
        kinds.append("Spherical")
    elif rigid[0]:
        kinds.append("Tie")
    if draw(mostly(False, True, odds=12)):
        kinds = JOINTS
    return draw(st.sampled_from(kinds)), k, ground


@st.composite
def bodies(draw):
    shape = draw(mostly("box", "ball", "ring", odds=1))
    few = st.sampled_from([1, 2, 2, 3, 4])
    ring = shape == "ring"
    cells = (draw(st.integers(5, 8)), 1, draw(st.integers(1, 2))) if ring else (
        (draw(mostly(2, 3)),) * 3 if shape == "ball" else draw(st.tuples(few, few, few))
    )  # fmt: skip
    return Body(
        shape=shape,
        cells=cells,
        cell=draw(st.sampled_from(["hexahedron", "tetrahedron"])),
        size=draw(mostly((1.0, 1.0, 1.0), (0.4, 1.0, 1.0), (1.5, 1.5, 0.3), (0.3, 0.3, 0.3))),
        turn=draw(st.one_of(st.just(0.0), number(0.0, 3.0))),
        law=draw(mostly("neo-Hookean", "St. Venant-Kirchhoff", "", "")),
        young=draw(mostly(1e6, 1e5, 1e8)),
        poisson=draw(mostly(0.3, 0.0, 0.49)),
        density=draw(mostly(1e3, 1e2, 1e4)),
        gap=draw(st.one_of(mostly(0.0, 1e-3, 0.02, -0.1, odds=1), number(0.0, 0.04))),
        speed=draw(st.one_of(number(0.0, 5.0), mostly(3.0, -0.5, 1.0, 30.0, odds=1))),
        drift=draw(mostly((0.0, 0.0), (1.0, -2.0), (0.0, 5.0))),
        spin=draw(mostly((0.0, 0.0, 0.0), (0.0, 0.0, 5.0), (10.0, -20.0, 5.0))),
        held=draw(mostly("", "at rest", "moving", odds=4)),
    )


@st.composite
def scenes(draw):
    several = draw(st.sampled_from([2, 1, 3]))
    contacts = [
        Contact(
            first=k,
            swapped=draw(st.booleans()),
            facing=draw(mostly((0.3, 0.3), (-1.0, -1.0), (0.7, 0.3), (0.6, 0.6))),
            friction=draw(st.sampled_from([0.0, 0.0, 0.3, 0.3, 2.0, float("inf")])),
            smoothing=draw(mostly(False, True)),
            mass=draw(mostly("consistent", "redistributed", odds=12)),
        )
        for k in range(several - 1)
        if draw(mostly(True, False, odds=5))
    ]
    floor = Floor(
        kind=draw(mostly("plane", "ball", "rod", "hollow ball", "hollow rod")),
        radius=draw(st.sampled_from([0.2, 1.0, 5.0])),
        gap=draw(st.one_of(mostly(0.0, -0.1, odds=8), number(0.0, 0.03))),
        moving=draw(mostly(False, True)),
    )
    row = tuple(draw(bodies()) for _ in range(several))
    joints = tuple(draw(joint_for(row)) for _ in range(draw(mostly(0, 1, 2))))
    options = {
        "accuracy": draw(mostly(None, "exact", "balanced", "fast", odds=4)),
        "sleep": draw(mostly(False, True)),
        "adapt": draw(mostly(None, 1e-3, odds=8)),
        "impact": draw(mostly("published", "restored", odds=8)),
        "project_start": bool(joints) and draw(mostly(True, False, odds=8)),
    }
    newton = {"max_retries": draw(mostly(1, 0, 3))}
    newton |= dict(draw(mostly((), (("rtol", 1e-9), ("reuse", True)), (("condense", False),),
                               (("linear_solver", "krylov"),), (("max_iterations", 6),),
                               (("rtol", 1e-6), ("reuse", True)))))  # fmt: skip
    if options["accuracy"]:
        newton = {}
    return Scene(
        row=draw(mostly((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.48, 0.6, 0.64))),
        bodies=row,
        contacts=tuple(contacts),
        floor=draw(st.sampled_from([None, floor])),
        joints=joints,
        gravity=draw(mostly(0.0, 9.81)),
        rule=draw(st.sampled_from(["energy-momentum", "energy-momentum", *RULES])),
        dt=draw(st.sampled_from([2e-4, 2e-3, 2e-3, 5e-3, 2e-2])),
        steps=draw(st.integers(3, 10)),
        options=tuple((k, v) for k, v in options.items() if v not in (None, False, "published")),
        newton=tuple(newton.items()),
        nonsense=draw(mostly("", *NONSENSE, odds=12)),
        unit=draw(mostly(1.0, 1e-3, 1e3, odds=4)),
    )


# ---- building
@dataclass(frozen=True)
class Built:
    """A scene made.

    Attributes:
        scene: Its data.
        solids: Of each body, where it starts.
        system: The system.
        run: Arguments of `simulate` after it.
    """

    scene: Scene
    solids: list
    system: Any
    run: dict


def placed(scene):
    """The solids in a row, each at its gap from the one before."""
    row, solids, end = np.array(scene.row), [], 0.0
    for k, body in enumerate(scene.bodies):
        solid = Solid.of(body.shape, body.cells, body.cell, 2 if body.law else 3)
        x = (solid.x * body.size) @ rotation(body.turn, (1, 2, 3)).T
        along = x @ row
        x += (end + (body.gap if k else 0.0) - along.min()) * row
        end = (x @ row).max()
        solids.append(replace(solid, x=scene.unit * x))
    return solids


def built(scene, comm):
    """Make the system and what `simulate` is called with. Collective."""
    row, spoilt = np.array(scene.row), {scene.nonsense: NONSENSE.get(scene.nonsense)}
    beside = np.cross(row, (0.6, 0.0, -0.8))
    solids, made = placed(scene), []
    for k, solid in enumerate(solids):
        made.append(flexible_or_rigid(k, scene, solid, beside, spoilt, comm))

    def surface(k, least, up, **options):
        marker = solids[k].facing(row if up else -row, spoilt.get("marker", least))
        return made[k].surface(marker, **options)

    pairs = []
    for contact in scene.contacts:
        k, up = contact.first + contact.swapped, not contact.swapped
        other = contact.first + (not contact.swapped)
        slave = surface(k, contact.facing[0], up, mass=contact.mass)
        smoothing = spoilt.get("smoothing", contact.smoothing)
        master = surface(other, contact.facing[1], not up, smoothing=smoothing)
        friction = spoilt.get("friction", contact.friction)
        pairs.append(nts.ContactPair(slave=slave, master=master, friction=friction))
    if scene.floor is not None:
        friction = spoilt.get("friction", 0.2)
        slave = surface(0, -1.0 if scene.floor.kind.startswith("h") else 0.3, False)
        pairs.append(nts.ContactPair(slave, obstacle(scene, solids[0]), friction=friction))
    joints = [
        joint_of(f"joint {n}", *joint, scene, made, solids) for n, joint in enumerate(scene.joints)
    ]
    gravity = spoilt.get("gravity", -scene.unit * scene.gravity * row)
    system = nts.System(made, contacts=pairs, joints=joints, gravity=gravity)
    return Built(scene, solids, system, arguments(scene, spoilt))


def flexible_or_rigid(k, scene, solid, beside, spoilt, comm):
    """The k-th body of the package."""
    body, row, unit = scene.bodies[k], np.array(scene.row), scene.unit
    mesh, name = solid.mesh(comm), f"body {k}"
    density = spoilt.get("density", body.density)
    towards = -body.speed if k else body.speed
    linear = towards * row + body.drift[0] * beside + body.drift[1] * np.cross(row, beside)
    linear = unit * linear
    turning, middle = np.array(body.spin), solid.x.mean(axis=0)

    def moved(t):
        return unit * (0.1 * np.sin(20.0 * t) * row + 0.05 * t * beside)

    if not body.law:
        motion = {"": None, "at rest": (0, 0, 0), "moving": moved}[body.held]
        free = {"velocity": linear, "angular_velocity": turning}
        fixed = {"motion": motion, "rotation": (0, 0, 0)}
        free = free | {"velocity": spoilt["velocity"]} if "velocity" in spoilt else free
        return nts.RigidBody(mesh, density=density, name=name, **(fixed if body.held else free))
    young, poisson = spoilt.get("young", body.young * unit**2), spoilt.get("poisson", body.poisson)
    bcs = []
    if body.held:
        value = moved if body.held == "moving" else (0.0, 0.0, 0.0)
        bcs = [nts.Dirichlet(solid.facing(row if k else -row, 0.5), value)]

    def velocity(x):
        return linear[:, None] + np.cross(turning, x.T - middle).T

    return nts.Continuum(
        mesh, LAWS[body.law](young, poisson), density=density, degree=1, bcs=bcs, name=name,
        velocity=spoilt.get("velocity", velocity),
    )  # fmt: skip


def obstacle(scene, solid):
    """The floor, at its gap behind the first body."""
    floor, row = scene.floor, np.array(scene.row)
    along = solid.x @ row
    first = solid.x[along.argmin()]
    motion = (lambda t: 0.02 * scene.unit * np.sin(30.0 * t) * row) if floor.moving else None
    gap, radius = scene.unit * floor.gap, scene.unit * floor.radius
    at = first - gap * row
    if floor.kind == "plane":
        return nts.Plane(at, row, motion=motion)
    hollow = floor.kind.startswith("hollow")
    centre = at - radius * row
    if hollow:
        middle = solid.x.mean(axis=0)
        radius = np.linalg.norm(solid.x - middle, axis=1).max() + gap
        centre = middle
    if floor.kind.endswith("ball"):
        return nts.Sphere(centre, radius, inside=hollow, motion=motion)
    axis = np.cross(row, (0.6, 0.0, -0.8))
    return nts.Cylinder(centre, axis, radius, inside=hollow, motion=motion)


def joint_of(name, kind, k, ground, scene, made, solids):
    """A joint or spring between a body and the next one, or the ground."""
    ground, row, unit = ground or k + 1 == len(made), np.array(scene.row), scene.unit
    a, b = made[k], None if ground else made[k + 1]
    along = solids[k].x @ row
    point = solids[k].x[along.argmax()]
    far = point + 0.3 * unit * row if ground else solids[k + 1].x[(solids[k + 1].x @ row).argmin()]
    axis = np.cross(row, (0.6, 0.0, -0.8))
    if kind == "Tie":
        surface = b.surface(solids[k + 1].facing(-row, 0.3)) if b else None
        return nts.Tie(a, surface, name=name)
    given = {"points": (point, far)} if kind in ("Distance", "Spring", "Damper") else {
        "point": point
    }  # fmt: skip
    if kind == "Universal":
        given["axes"] = (row, axis)
    elif kind not in ("Distance", "Spring", "Damper", "Spherical", "Fixed"):
        given["axis"] = axis
    more = {
        "Spring": {"stiffness": 1e5 * unit**3, "length": 0.05 * unit},
        "Damper": {"damping": 10.0 * unit**3},
    }
    given |= more.get(kind, {})
    return getattr(nts, kind)(a, b, **given, name=name)


def arguments(scene, spoilt):
    """What `simulate` is called with, but for the system."""
    given = dict(scene.options)
    if "adapt" in given or "tolerance" in spoilt:
        given["adapt"] = nts.Adapt(tolerance=spoilt.get("tolerance", given.get("adapt")))
    of_newton = ("max_iterations", "rtol")
    newton = dict(scene.newton) | {n: v for n, v in spoilt.items() if n in of_newton}
    if newton:
        given["newton"] = nts.Newton(**newton)
    given |= {"integrator": RULES[scene.rule], "dt": scene.dt, "t_end": scene.steps * scene.dt}
    return given | {n: v for n, v in spoilt.items() if n in ("dt", "t_end", "accuracy", "impact",
                                                              "restitution")}  # fmt: skip
