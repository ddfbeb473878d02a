"""Beyond a convex edge a facet's plane goes on, the body does not."""

from mpi4py import MPI

import numpy as np
import pytest
from integrators import MID_STEP
from pairs import pairs
from scenes import box, everywhere

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh

COMM = MPI.COMM_WORLD


#: By how many half widths of the top sides go outwards over their height: frustum, boxes, a wedge.
SLOPES = [1.0, 0.1, 0.0, -0.3]


def block(slope, metre=1.0):
    """A fixed one of 1 m whose sides slope, its top from -0.5 to 0.5 m."""
    mesh = box(low=(-0.5, -0.5, 0.0), high=(0.5, 0.5, 1.0), cells=2)
    x = mesh.geometry.x
    x[:, 0] *= 1.0 + slope * (1.0 - x[:, 2])
    x *= metre
    return nts.RigidBody(mesh, density=1.0, motion=lambda t: (0, 0, 0), name="block")


class Farthest:
    """Keeps how far beyond the edge of the block's top nodes carry at the ends of steps [m]."""

    def start(self, stepper):
        self.beyond = 0.0

    def write(self, stepper, *, last=False):
        pair, state = stepper.system.contacts[0], stepper.state
        slave, _ = pair.positions([state.u[1], state.u[0]])
        force = pair.slave.at_all(state.contacts[0].force)
        x, z = (slave + pair.origin)[force > 0.0][:, [0, 2]].T
        at_top = z > 1.0 - 1e-9
        self.beyond = max(self.beyond, (x[at_top] - 0.5).max(initial=0.0))

    def close(self, stepper):
        pass


def passing(slope, corner, velocity, rule, dt, metre=1.0, output=()):
    """A cube of 0.2 m that flies for 0.1 s, its lower left edge from `corner` (x, z) on."""
    x, z = corner
    mesh = box(low=(x, -0.1, z), high=(x + 0.2, 0.1, z + 0.2), cells=1)
    mesh.geometry.x[:] *= metre
    cube = nts.RigidBody(mesh, density=1.0, velocity=metre * np.array(velocity), name="cube")
    fixed = block(slope, metre)
    pair = nts.ContactPair(slave=cube.surface(everywhere), master=fixed.surface(everywhere))
    system = nts.System([fixed, cube], contacts=[pair])
    run = nts.simulate(system, rule, dt=dt, t_end=0.1, output=output)
    assert run.status == "completed"
    return cube, np.abs(run.contact_forces).max() / (cube.mass * metre / dt**2)


@pytest.mark.mpi
@pytest.mark.parametrize("metre", [1.0, 2.0**-10])
@pytest.mark.parametrize("slope", SLOPES)
@pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)
def test_what_passes_an_edge_closely_is_not_held_by_the_plane_beyond_it(rule, slope, metre):
    """Above the top at the start of a step, beside it and below its plane at the end."""
    velocity = np.array([2.0, 0.0, -1.0])
    cube, force = passing(slope, (0.49, 1.05), velocity, rule, 0.1, metre)
    assert force < 1e-13
    np.testing.assert_allclose(cube.velocity / metre, velocity, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("slope", "passes"), [(3.0, 6), (1.0, 60), (0.0, 6), (-0.3, 60)])
@pytest.mark.fast("0.0-6")
def test_what_hits_the_top_is_held_and_what_passes_beside_it_is_not(slope, passes):
    """At edges by which faces turn by 34 to 99 degrees, as a corner's straight way meets the top.

    A step that would hit it and slide over its edge is cut: nothing is held beside the block.
    """
    random, time = np.random.default_rng(0), np.linspace(0.0, 0.1, 100_001)
    for _ in range(passes):
        height, inside = random.uniform(0.0, 0.05, 2)
        corner = np.array([0.5 - inside, 1.0 + height])
        velocity = random.uniform([1.0, 0.0, -2.0], [4.0, 0.0, -0.5])
        x, z = corner[:, None] + velocity[[0, 2], None] * time
        hit = bool(((z < 1.0) & (x < 0.5 * (1.0 + slope * (1.0 - z)))).any())
        far = Farthest()
        _, force = passing(slope, corner, velocity, nts.EnergyMomentum(), 0.02, output=[far])
        assert (force > 1e-6) == hit
        assert far.beyond < 1e-4


def hexahedra(x, cells):
    """A rigid body's mesh, built on rank 0."""
    x, cells = np.array(x), np.array(cells)
    if COMM.rank > 0:
        x, cells = x[:0], cells[:0]
    return create_mesh(COMM, cells, x, "hexahedron")


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("raised", "friction", "metre"), pairs([0.0, 1e-5, 3e-3], [0.0, 0.3], [1.0, 2.0**-10])
)
@pytest.mark.fast_on_ranks()
def test_a_sharp_edge_that_slides_up_a_roof_passes_the_nodes_of_its_ridge(raised, friction, metre):
    """The ridge comes to the edge at its height, or deeper by what its middle node is raised.

    No face before the edge catches it: the roof is a wedge on a spring, push = force tan(slope +
    angle of friction), and friction's force once the edge is on the flat top.
    """
    low, slope, stiffness = 0.05, 0.5, 1.0
    profile = [(-3.0, low), (-1.0, 1.0), (1.0, 1.0), (1.0 + (1.0 - low) / slope, low)]
    columns = [(x, y, z) for x, z in profile for y in (-1.0, 0.0, 1.0)]
    x = metre * np.array([(x, y, -0.5) for x, y, _ in columns] + columns)
    x[12 + 7, 2] += metre * raised
    corners = [3 * i + j for i in range(3) for j in range(2)]
    cells = [[k + c + d for d in (0, 12) for c in (0, 1, 3, 4)] for k in corners]
    roof = nts.RigidBody(hexahedra(x, cells), density=1.0, name="roof")
    at = 2.0
    outline = [(at, 0.0), (at + 0.4, 0.0), (at - 0.5, 3.0), (at + 2.0, 3.0)]
    x = [(x, y, z + 1.0 - slope * (at - 1.0) + raised) for y in (-0.8, 0.8) for x, z in outline]
    catch = nts.RigidBody(
        hexahedra(metre * np.array(x), [[4, 5, 0, 1, 6, 7, 2, 3]]), density=1.0, name="catch",
        motion=lambda t: (-metre * t, 0, 0), rotation=(0, 0, 0),
    )  # fmt: skip
    guide = nts.Prismatic(roof, None, point=(0, 0, 0), axis=(0, 0, 1))
    spring = nts.Spring(
        roof, None, points=((0, 0, 0), (0, 0, 1e3 * metre)), stiffness=stiffness,
        length=1e3 * metre,
    )  # fmt: skip
    above = roof.surface(lambda x: x[2] > metre * (low - 1e-6))
    pair = nts.ContactPair(above, catch.surface(everywhere), friction=friction)
    system = nts.System([roof, catch], contacts=[pair], joints=[guide, spring])
    run = nts.equilibrium(system, load_steps=np.linspace(0.0, 1.5, 16)[1:])
    assert run.status == "completed"
    way = run.balance["time"][1:]
    press = stiffness * metre * slope * np.minimum(way, 1.0)
    right = np.where(way < 0.99, np.tan(np.arctan(slope) + np.arctan(friction)), friction)
    push, settled = np.abs(run.contact_forces[1:, 0, 0]), np.abs(way - 1.0) > 0.05
    # Where the middle node is raised, the edge starts over the slope and the top is not flat.
    room = metre * stiffness * (1e-9 + 2.0 * raised)
    np.testing.assert_allclose(push[settled], (press * right)[settled], atol=room)


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("ahead", [0.01, 0.03, 0.09])
@pytest.mark.fast("0.09-0.0")
@pytest.mark.fast_on_ranks()
def test_the_face_above_an_edge_does_not_catch_a_node_of_a_slope(ahead, friction):
    """Nodes of a hook's slope that the edge of a catch comes to just before they meet the face.

    The slope crosses the planes of both faces at the edge, so that neither touches it: the hook
    bends as a wedge on a spring, push = force tan(slope + angle of friction).
    """
    length, width, slope = 22.0, 3.0, 0.475
    mesh = box(high=(length, width, 1.0), cells=(22, 2, 1))
    x = mesh.geometry.x
    x[:, 2] *= 1.5 + np.interp(x[:, 0], [0.0, 17.0, 18.0, length], [0.0, 0.0, 1.4, -0.5])
    soft = nts.NeoHookean(young=2000.0, poisson=0.35)
    held = nts.Dirichlet(lambda x: x[0] < 1e-9)
    hook = nts.Continuum(mesh, soft, density=1e-9, bcs=[held], name="hook")
    edge = 1.5 - 0.5 + slope * (1.0 - ahead)
    catch = nts.RigidBody(
        box(low=(21.75, -0.5, edge), high=(25.0, width + 0.5, edge + 5.0), cells=(1, 4, 1)),
        density=1e-9, motion=lambda t: (-t, 0, 0), rotation=(0, 0, 0), name="catch",
    )  # fmt: skip
    slopes = hook.surface(lambda x: (x[0] > 16.5) & (x[2] > 0.1))
    pair = nts.ContactPair(slave=slopes, master=catch.surface(everywhere), friction=friction)
    system = nts.System([hook, catch], contacts=[pair])
    run = nts.equilibrium(system, load_steps=np.linspace(0.0, 1.25, 6)[1:])
    assert run.status == "completed"
    push, _, force = np.abs(run.contact_forces[-1, 0])
    # A cantilever's end turns by 3/2 of its deflection over its length.
    at = 21.75 - 1.25
    turn = 1.5 * slope * (21.0 + ahead - at) / at
    right = np.tan(np.arctan(slope) + turn + np.arctan(friction))
    np.testing.assert_allclose(push, force * right, rtol=5e-3)
