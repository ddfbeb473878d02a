"""A point mass beside rigid planes, spheres and cylinders, which several test modules run."""

from mpi4py import MPI

import numpy as np
from integrators import CONTACT_RULES
from point_mass import MASS, STEP, PointMass, PointSurface, turn
from scenes import RUBBER, box

import dolfinx_nts as nts
from dolfinx_nts.parallel import together

COMM = MPI.COMM_WORLD
ACCELERATION = 9.81
#: Newton down to rounding: its tolerance would add up to 1e-12 of the force's work in each step.
TO_ROUNDING = nts.Newton(rtol=1e-15)
DOWN = np.array([0.0, 0.0, -ACCELERATION])
TURN = turn(1.1)
CENTRE = np.array([0.4, -0.3, 0.2])
OBSTACLES = {
    "plane": nts.Plane(CENTRE, TURN[:, 2]),
    "sphere": nts.Sphere(CENTRE, 1.3),
    "bowl": nts.Sphere(CENTRE, 1.3, inside=True),
    "cylinder": nts.Cylinder(CENTRE, TURN[:, 2], 0.9),
    "bore": nts.Cylinder(CENTRE, TURN[:, 2], 0.9, inside=True),
}


def changed(master, **changes):
    """The same obstacle with other arguments."""
    fields = {f: getattr(master, f) for f in master.__dataclass_fields__ if f != "_"}
    return type(master)(**fields | changes)


def point_on(master, position, velocity, gravity=(0.0, 0.0, 0.0), mass=MASS, friction=0.0):
    """A mass before an obstacle or on it."""
    body = PointMass(COMM, mass, position, velocity)
    pair = nts.ContactPair(PointSurface(body, position), master, friction=friction)
    return nts.System([body], contacts=[pair], gravity=gravity)


def sliding(master, friction, position, velocity, gravity=DOWN):
    """The same with friction and weight."""
    return point_on(master, position, velocity, gravity, friction=friction)


def advance(system, integrator, steps, dt=STEP, newton=None):
    """Positions and velocities (steps + 1, 3) of the first body, a mass, and the balance."""
    stepper = nts.Stepper(system, CONTACT_RULES[integrator], newton=newton)
    rows = []
    for k in range(steps + 1):
        if k:
            stepper.advance(dt)
        x = system.bodies[0].reference + stepper.state.u[0]
        rows.append(COMM.bcast(np.concatenate([x, stepper.state.v[0]])))
    stepper.close()
    rows = np.array(rows)
    return rows[:, :3], rows[:, 3:], stepper.solution.balance


class Pair:
    """Step equations of a mass near an obstacle, at chosen unknowns (x, lambda)."""

    def __init__(self, name, integrator, motion=None, friction=0.0):
        master, start = changed(OBSTACLES[name], motion=motion), self.start(name)
        # Rank 0 owns the mass; a serial copy on every rank is all these tests need.
        body = PointMass(MPI.COMM_SELF, MASS, start, (0.0, 0.0, 0.0))
        pair = nts.ContactPair(PointSurface(body, start), master, friction=friction)
        stepper = nts.Stepper(nts.System([body], contacts=[pair]), CONTACT_RULES[integrator])
        stepper.problem.begin(stepper.state, STEP)
        problem = stepper.problem
        found = (*problem.elements, *problem.couplings.contacts.idle)
        (self.step,) = (c for c in found if c.num_elements)
        stepper.close()
        self.x = start + np.array([0.11, -0.07, 0.05])

    @staticmethod
    def start(name):
        """A point 0.05 off the surface."""
        direction = {"plane": TURN[:, 2]}.get(name, TURN @ [0.8, -0.6, 0.0])
        radius = {"plane": 0.05, "sphere": 1.35, "bowl": 1.25, "cylinder": 0.95, "bore": 0.85}
        return CENTRE + radius[name] * direction

    def residual(self, unknowns):
        return self.at(unknowns).residual

    def at(self, unknowns):
        x, multiplier = unknowns[None, None, :3], unknowns[None, 3:]
        own = {"augmented": np.empty((1, 0)), "constraints": multiplier}
        work = self.step.evaluate(x - self.step.pair.origin, own)
        return together(MPI.COMM_SELF, [work])[0]


def block(low=(0.1, 0.1, 0.005), size=0.8, n=2, velocity=(0.3, 0.0, -1.0), name="block"):
    """A cube above the plane z = 0, and its lower face."""
    low = np.array(low)
    mesh = box(low, low + size, n)
    body = nts.Continuum(mesh, RUBBER, density=1e4, velocity=velocity, name=name)
    return body, body.surface(lambda x: x[2] < low[2] + 1e-9)
