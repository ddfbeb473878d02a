"""Scenes that several test modules run, and what they are built of: boxes, faces, materials."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx.mesh import CellType, GhostMode, create_box
from rotations import rotation

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
CELLS = {"hexahedron": CellType.hexahedron, "tetrahedron": CellType.tetrahedron}
#: Units of length that leave all digits as they are, about a mm and a um in a m: every decision of
#: a run is the same, whatever rounding has to do with it.
UNITS = (2.0**10, 2.0**20)
#: The material of most blocks: Young's modulus [Pa], Poisson's ratio, Lame's constants [Pa].
YOUNG, POISSON = 1e6, 0.3
MU, LAME = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
RUBBER = nts.NeoHookean(young=YOUNG, poisson=POISSON)


def rubber_stress(stretch, log_j):
    """First Piola-Kirchhoff stress of RUBBER along a principal direction [Pa]."""
    return MU * (stretch - 1 / stretch) + LAME * log_j / stretch


# ---- boxes and their faces
def box(low=(0, 0, 0), high=(1, 1, 1), cells=2, cell=CellType.hexahedron, comm=COMM):
    """Mesh of a box between two corners [m]; `cells` along each edge, or along all of them."""
    ends = [np.array(low, dtype=float), np.array(high, dtype=float)]
    n = np.broadcast_to(cells, 3).tolist()
    return create_box(comm, ends, n, cell, ghost_mode=GhostMode.shared_facet)


def at(axis, value, size=1.0):
    """Marker of a plane across an axis; `size` is that of the scene [m]."""
    return lambda x: np.abs(x[axis] - value) < 1e-9 * size


def everywhere(x):
    """Marker of all points."""
    return np.full(x.shape[1], True)


def bottom(x):
    """Marker of the plane z = 0, under a unit cube."""
    return x[2] < 1e-9


def top(x):
    """Marker of the plane z = 1, on a unit cube."""
    return x[2] > 1 - 1e-9


# ---- bodies alone
def flying_block():
    """A soft block that spins and is stretched while it flies."""

    def velocity(x):
        centre = np.array([[1.0], [0.5], [0.5]])
        r = x - centre
        spin = np.cross(np.array([1.0, 2.0, 3.0]), r.T).T
        return spin + np.array([[1.5], [-0.8], [0.4]]) * r + np.array([[0.5], [0.2], [-0.1]])

    body = nts.Continuum(
        box((0, 0, 0), (2, 1, 1), (2, 1, 1)),
        RUBBER,
        density=5e4,
        velocity=velocity,
        name="block",
    )
    return nts.System([body])


def thrown_block(held=False):
    """A block thrown without spin; `held`, its face at x = 0 stays in place."""
    bcs = [nts.Dirichlet(at(0, 0.0))] if held else []
    body = nts.Continuum(
        box(cells=(2, 1, 1)), RUBBER, density=1e3, bcs=bcs, velocity=(1.0, 2.0, 3.0)
    )
    return nts.System([body])


def symmetry(size=1.0, axes=(0, 1)):
    """No motion through the planes x = 0 and y = 0."""
    return [nts.Dirichlet(at(a, 0.0, size), components=(a,)) for a in axes]


def quarter_cube(bcs, traction=(), n=2, material=RUBBER, density=1e3):
    """A cube behind two planes of symmetry."""
    return nts.Continuum(
        box(cells=n),
        material,
        density=density,
        bcs=[*symmetry(), *bcs],
        traction=traction,
        name="cube",
    )


# ---- two blocks
def rubbing_blocks(
    friction, metre=1.0, turn=None, cell=CellType.hexahedron, cells=(3, 2), comm=COMM, **options
):
    """A block thrown at a larger one with half its speed along the contact, turned as a whole."""
    turn = np.eye(3) if turn is None else turn
    rubber = nts.NeoHookean(young=1e6 / metre, poisson=0.3)
    boxes = (([0, 0, 0], [1, 1, 1]), ([1.05, -0.1, -0.1], [2.05, 1.1, 1.1]))
    bodies = []
    for corners, n, name in zip(boxes, cells, ("left", "right"), strict=True):
        low, high = metre * np.array(corners)
        mesh = box(low, high, n, cell, comm)
        mesh.geometry.x[:] = mesh.geometry.x @ turn.T
        bodies.append((mesh, name))

    def throw(x):
        arm = (turn.T @ x) / metre - 0.5
        v = np.array([2 + 0.5 * arm[2], 1 + 0 * arm[0], 0.3 - 0.5 * arm[0]])
        return metre * turn @ v

    left, right = (
        nts.Continuum(mesh, rubber, density=1e3 / metre**3, degree=1, name=name, velocity=v)
        for (mesh, name), v in zip(bodies, (throw, (0, 0, 0)), strict=True)
    )
    pair = nts.ContactPair(
        slave=left.surface(lambda x: (turn.T @ x)[0] > metre * (1 - 1e-9)),
        master=right.surface(lambda x: (turn.T @ x)[0] < metre * (1.05 + 1e-9)),
        friction=friction,
        **options,
    )
    return nts.System([left, right], contacts=[pair])


def sliding_block(friction=0.0):
    """A block pressed harder and harder onto a soft one that it slides over, within one facet.

    The load starts from zero as t^2 does, so the four slave nodes carry from the first step on
    and no node is ever activated or released.
    """
    rubber = nts.NeoHookean(20.0, 0.3)
    upper = nts.Continuum(
        box((0.2, 0.25, 1.0), (0.7, 0.75, 1.5), 1),
        rubber,
        density=1.0,
        velocity=(0.3, -0.2, 0.0),
        body_force=lambda t: (0.0, 0.0, -20.0 * t**2 * (3.0 - 2.0 * t)),
        name="upper",
    )
    lower = nts.Continuum(
        box(cells=1), rubber, density=1.0, bcs=[nts.Dirichlet(bottom)], name="lower"
    )
    pair = nts.ContactPair(
        slave=upper.surface(lambda x: x[2] < 1 + 1e-9),
        master=lower.surface(top),
        friction=friction,
    )
    return nts.System([upper, lower], contacts=[pair])


def meeting_blocks(cell=CellType.hexahedron):
    """Two blocks, the left one about to hit the right one; contact from the second step of 1 ms."""
    left = nts.Continuum(
        box((0, 0, 0), (1, 1, 1), 2, cell),
        RUBBER,
        density=1e3,
        velocity=lambda x: np.stack([2.0 + 0 * x[0], 0.1 * x[2], -0.1 * x[1]]),
        name="left",
    )
    right = nts.Continuum(
        box((1.001, -0.1, -0.1), (2.0, 1.1, 1.1), (2, 1, 1), cell),
        RUBBER,
        density=1e3,
        name="the right one",
    )
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > 1 - 1e-9),
        master=right.surface(lambda x: x[0] < 1.001 + 1e-9),
    )
    return nts.System([left, right], contacts=[pair])


# ---- materials of a user's own
def fung(steepness):
    """Rubber that stiffens exponentially, small strains as the neo-Hookean one's."""

    def energy(c):
        volume = ufl.ln(ufl.det(c))
        stretch = (ufl.exp(steepness * (ufl.tr(c) - 3)) - 1) / steepness
        return MU / 2 * (stretch - volume) + LAME / 8 * volume**2

    return energy


def green(u):
    """Green's strain of a displacement."""
    h = ufl.grad(u)
    return ufl.sym(h) + 0.5 * h.T * h


def saint_venant(young, poisson):
    """St. Venant-Kirchhoff's energy as a form of the strain."""
    mu, lame = young / 2 / (1 + poisson), young * poisson / (1 + poisson) / (1 - 2 * poisson)

    def energy(e):
        return (0.5 * lame * ufl.tr(e) ** 2 + mu * ufl.inner(e, e)) * ufl.dx

    return energy


# ---- states
def smooth_motion(x, amplitude, phase):
    """A displacement that does not depend on how the mesh is distributed."""
    k = np.array([[1.1, 0.7, -0.4], [-0.6, 1.3, 0.8], [0.5, -0.9, 1.2]])
    return amplitude * np.sin(x @ k.T + phase)


def rotated_state(system, angle=0.8, fixed=False):
    """Both blocks turned in space, deformed, spinning and moving towards each other."""
    turn, u, v = rotation(angle, (1, 2, 3)), [], []
    for k, body in enumerate(system.bodies):
        x = body.reference.reshape(-1, 3)
        now = (x + smooth_motion(x, 0.03, k)) @ turn.T + [0.3, -0.2, 0.1]
        velocity = np.cross([0.5, -0.8, 1.1], now) + smooth_motion(x, 0.4, 2.0 + k)
        velocity += (0.5 - k) * -2.0 * turn[:, 2]
        u.append((now - x).ravel())
        v.append(velocity.ravel())
        if fixed:
            u[-1][body.fixed] = v[-1][body.fixed] = 0.0
    start = system.initial_state()
    return replace(start, u=tuple(u), v=tuple(v))


# ---- what goes wrong
def fail_once(stepper, at_call):
    """Make one solve of the stepper fail, after it has spoilt whatever a solve may spoil."""
    solve, calls = stepper.solver.solve, []

    def failing():
        calls.append(None)
        step = solve()
        if len(calls) == at_call:
            raise nts.StepFailedError("on purpose")
        return step

    stepper.solver.solve = failing
