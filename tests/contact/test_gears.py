"""Spur gears of tetrahedra, rigid and flexible, turn each other and stay out of each other."""

from mpi4py import MPI

import gmsh
import numpy as np
import pytest
from gmsh_parts import deepest

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
#: Of the axes [m].
APART = 0.0803


def profile(teeth, module=4.0, points=7):
    """Outline of an involute gear, shape (n, 2) [mm], one tooth about angle 0."""
    pressure = np.deg2rad(20.0)
    pitch = module * teeth / 2
    tip, root, base = pitch + module, pitch - 1.25 * module, pitch * np.cos(pressure)
    radius = np.linspace(max(base, root), tip, points)

    def involute(a):
        return np.tan(a) - a

    turn = involute(np.arccos(np.minimum(base / radius, 1.0)))
    half = np.pi / (2 * teeth) - 0.004 + involute(pressure) - turn
    radius, half = np.r_[root, radius], np.r_[half[0], half]
    r, angle = np.r_[radius, radius[::-1]], np.r_[-half, half[::-1]]
    each = angle + 2 * np.pi * np.arange(teeth)[:, None] / teeth
    return np.column_stack([(r * np.cos(each)).ravel(), (r * np.sin(each)).ravel()])


def wheel_of(teeth, x0, turn, bore):
    """A part of Gmsh with surfaces "flanks" and, if it has a bore, "bore"."""
    c, s = np.cos(turn), np.sin(turn)
    outline = profile(teeth) @ [[c, s], [-s, c]] * 1e-3
    loops = [outline]
    if bore:
        angle = 2 * np.pi * np.arange(12) / 12
        hole = 0.6 * np.linalg.norm(outline, axis=1).min()
        loops.append(hole * np.column_stack([np.cos(angle), np.sin(angle)]))
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 1)
    geo, curves = gmsh.model.geo, []
    for loop in loops:
        points = [geo.addPoint(*p, -0.005, 9e-3) for p in loop + [x0, 0]]
        lines = [geo.addLine(p, q) for p, q in zip(points, points[1:] + points[:1], strict=True)]
        curves.append(geo.addCurveLoop(lines))
    made = geo.extrude([(2, geo.addPlaneSurface(curves))], 0, 0, 0.01, numElements=[1])
    geo.synchronize()
    gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 9e-3)
    sides, n = [tag for _, tag in made[2:]], len(outline)
    groups = [(3, [made[1][1]], "part"), (2, sides[:n], "flanks"), (2, sides[n:], "bore")]
    for dim, tags, name in groups:
        if tags:
            gmsh.model.setPhysicalName(dim, gmsh.model.addPhysicalGroup(dim, tags), name)
    gmsh.model.mesh.generate(3)
    part = nts.bodies_from_gmsh(gmsh.model, COMM)["part"]
    gmsh.finalize()
    return part


def gear(teeth, x0, turn, spin, torque, name, soft=False):
    """A gear on a hinge, which turns a rigid hub if it is soft: bodies, flanks, joints."""
    part, moves = wheel_of(teeth, x0, turn, soft), {"angular_velocity": (0, 0, spin)}
    moves["torque"] = (0, 0, torque)
    joints = []
    if soft:
        body = part.continuum(
            nts.NeoHookean(young=2e9, poisson=0.3), density=7800, degree=1, name=name,
            velocity=lambda x: np.array([-spin * x[1], spin * (x[0] - x0), 0.0 * x[0]]),
        )  # fmt: skip
        hub = nts.RigidBody.from_inertia(
            1e-3, 1e-7 * np.eye(3), centre=(x0, 0, 0), name=f"hub of {name}", **moves
        )
        joints.append(nts.Tie(hub, body.surface(*part.where("bore"))))
        bodies = [body, hub]
    else:
        bodies = [part.rigid(density=7800, name=name, **moves)]
    joints.append(nts.Revolute(bodies[-1], None, point=(x0, 0, 0), axis=(0, 0, 1)))
    return bodies, bodies[0].surface(*part.where("flanks")), joints


class Depths:
    """Depth of the deepest node of either gear in the other one, at every tenth step."""

    def __init__(self, *gears):
        self.gears, self.steps, self.deepest = gears, 0, 0.0

    def start(self, stepper):
        self.starts = [
            (b.position.copy(), b.rotation.copy()) if b.rigid else None for b in self.gears
        ]

    def write(self, stepper, *, last=False):
        self.steps += 1
        if self.steps % 10 == 0:
            for order in (1, -1):
                found = deepest(*self.gears[::order], *self.starts[::order])
                self.deepest = max(self.deepest, found)

    def close(self, stepper):
        pass


def momentum(bodies):
    """Moment of inertia about the axis, and angular momentum of all bodies of a gear."""
    moving = [nts.motion_of(body) for body in bodies]
    inertia = [m.inertia[2, 2] for m in moving]
    return sum(inertia), sum(i * m.spin[2] for i, m in zip(inertia, moving, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("way", "dt", "end"),
    [("pinion", 1e-4, 0.024), ("both", 1e-4, 0.024), ("wheel", 2.5e-5, 0.006)],
)  # fmt: skip
def test_spur_gears_turn_each_other(way, dt, end):
    """Nodes were held in the plane of a tooth's tip beside the tooth, and the pair jammed.

    Teeth of straight facets rattle about the ratio of their numbers, so the speed is that of the
    pair: of both momenta about their axes, reduced to the pinion.
    """
    driving, resisting = 2.0, 1.0
    [pinion], of_pinion, first = gear(16, 0.0, 0.0, 20.0, driving, "pinion")
    [wheel], of_wheel, second = gear(24, APART, np.pi / 24, -20 / 1.5, resisting, "wheel")
    there = nts.ContactPair(slave=of_pinion, master=of_wheel)
    back = nts.ContactPair(slave=of_wheel, master=of_pinion)
    pairs = {
        "pinion": [there], "wheel": [back], "both": [there, back],
        "between": [nts.ContactPair.between(of_pinion, of_wheel)],
    }[way]  # fmt: skip
    system = nts.System([pinion, wheel], contacts=pairs, joints=first + second)
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt, t_end=end, accuracy="balanced",
        project_start=True,
    )  # fmt: skip
    assert run.status.startswith("completed")
    if way == "wheel" and dt == 1e-4 and "energy lost to contact" in run.warnings:
        # In steps of this length a tip of the wheel may land on the back of a tooth and stop the
        # pair. Rounding chooses whether one does; the run says so, and shorter steps are right.
        return
    one, two = (nts.motion_of(body).inertia[2, 2] for body in (pinion, wheel))
    whole = one + two / 1.5**2
    speed = (one * pinion.angular_velocity[2] - two * wheel.angular_velocity[2] / 1.5) / whole
    right = 20.0 + (driving - resisting / 1.5) / whole * end
    assert speed == pytest.approx(right, rel=0.04)
    assert -wheel.angular_velocity[2] * 1.5 == pytest.approx(right, rel=0.1)


@pytest.mark.slow
@pytest.mark.skipif(COMM.size > 1, reason="takes all cells from one rank")
@pytest.mark.parametrize(
    ("soft", "slave"),
    [((False, True), "pinion"), ((True, False), "pinion"), ((True, True), "wheel")],
)
def test_gears_of_plastic_turn_each_other_and_stay_apart(soft, slave):
    """Their speed is that of both momenta about their axes, reduced to the pinion."""
    driving, resisting, end = 2.0, 1.0, 0.006
    first, of_pinion, hinge = gear(16, 0.0, 0.0, 20.0, driving, "pinion", soft[0])
    second, of_wheel, other = gear(24, APART, np.pi / 24, -20 / 1.5, resisting, "wheel", soft[1])
    faces = [of_pinion, of_wheel]
    pair = nts.ContactPair(*faces[:: 1 if slave == "pinion" else -1])
    system = nts.System(first + second, contacts=[pair], joints=hinge + other)
    whole = momentum(first)[0] + momentum(second)[0] / 1.5**2
    depths = Depths(first[0], second[0])
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=1e-4, t_end=end, accuracy="balanced", output=[depths],
        project_start=True,
    )  # fmt: skip
    assert run.status.startswith("completed")
    speed = (momentum(first)[1] - momentum(second)[1] / 1.5) / whole
    assert speed == pytest.approx(20.0 + (driving - resisting / 1.5) / whole * end, rel=0.02)
    assert depths.steps >= 60 and depths.deepest < 0.01
