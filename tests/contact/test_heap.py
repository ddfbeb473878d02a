"""Many rigid bodies: what is far apart is left out of steps; vertices stay out beside edges."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import box, everywhere
from scipy.spatial.transform import Rotation

import dolfinx_nts as nts
from dolfinx_nts.contact.apart import Apart
from dolfinx_nts.contact.facet_gap import FacetGap

COMM = MPI.COMM_WORLD
G, SIZE = 9.81, 0.1
VERTICES = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
pytestmark = pytest.mark.mpi


class Bricks:
    """Cubes, turned about their centres."""

    def __init__(self, *given):
        self.bodies, self._turns, self._sizes = [], [], []
        for k, (centre, turn, size, options) in enumerate(given):
            mesh = box([-0.5 * size] * 3, [0.5 * size] * 3, 1)
            turned = Rotation.from_rotvec(turn).as_matrix()
            mesh.geometry.x[:] = mesh.geometry.x @ turned.T + np.array(centre)
            body = nts.RigidBody(mesh, density=1e3, name=f"brick {k}", **options)
            self.bodies.append(body)
            self._turns.append(turned)
            self._sizes.append(size)

    def system(self, **options):
        """Every two of them are a contact."""
        skins = [body.surface(everywhere) for body in self.bodies]
        contacts = [
            nts.ContactPair(one, two, friction=0.4)
            for k, one in enumerate(skins) for two in skins[:k]
        ]  # fmt: skip
        return nts.System(self.bodies, contacts=contacts, **options)

    def depth(self):
        """Of the deepest vertex of one in another [m], by half widths; less than 0 outside."""
        deepest = -np.inf
        frames = [b.rotation @ turn for b, turn in zip(self.bodies, self._turns, strict=True)]
        for one, axes, size in zip(self.bodies, frames, self._sizes, strict=True):
            x = one.position + size * VERTICES @ axes.T
            for two, its, wide in zip(self.bodies, frames, self._sizes, strict=True):
                if one is not two:
                    inside = 0.5 * wide - np.abs((x - two.position) @ its)
                    deepest = max(deepest, float(inside.min(axis=1).max()))
        return deepest


def test_a_vertex_beside_an_edge_stays_out():
    """It comes onto a face where its edge has just crossed the face's: both hold it."""
    bricks = Bricks(
        ((0.115471, 0.075951, 0.08306), (0.345011, -0.692075, 0.427521), 0.097295, {
            "velocity": (0.444643, 0.033979, 0.199756),
            "angular_velocity": (3.323348, 1.19672, -5.693695)}),
        ((0.092491, 0.095767, 0.228397), (0.583797, 0.565673, 1.217273), 0.094129, {
            "velocity": (0, 0, -1.49112)}),
    )  # fmt: skip
    stepper = nts.Stepper(bricks.system(gravity=(0, 0, -G)), nts.EnergyMomentum())
    deepest = []
    for _ in range(12):
        stepper.advance(2e-3)
        deepest.append(bricks.depth())
    assert stepper.solution.balance["active"].max() > 0
    assert max(deepest) < 1e-9 * SIZE


@pytest.mark.fast_on_ranks()
def test_a_vertex_that_points_at_a_face_stays_out():
    """Its two edges meet those of the face within the step; it is ahead of them."""
    bricks = Bricks(
        ((0.075948135, 0.299752822, 0.140125715), (1.585402058, -0.731010314, -0.537002455),
         0.091502795, {"velocity": (-0.1455, 0.9339, -0.0843),
                       "angular_velocity": (-4.691, 12.404, 1.725)}),
        ((0.102013936, 0.303403814, 0.241606234), (1.213444092, 1.00503448, 1.160452776),
         0.099320597, {"velocity": (0.5858, 0.3755, -0.7855),
                       "angular_velocity": (20.377, -0.667, -0.59)}),
    )  # fmt: skip
    stepper = nts.Stepper(bricks.system(gravity=(0, 0, -G)), nts.EnergyMomentum())
    deepest = []
    for _ in range(3):
        stepper.advance(2e-3)
        deepest.append(bricks.depth())
    assert stepper.solution.balance["active"].max() > 0
    assert max(deepest) < 1e-9 * SIZE


def test_a_corner_over_which_a_cube_tips_stays_out_of_its_face():
    """Flush faces overlap at a corner of each, and their edges cross beside both.

    One cube turns about the line between the crossings. These are no support of the other's corner,
    which is beyond that line.
    """
    bricks = Bricks(
        ((0.120619751656, 0.265989002951, 0.347438925363),
         (0.545841170319, 1.113178424976, -0.671342715452), 0.090666900088, {
            "velocity": (0.7916, -0.6899, -0.6322), "angular_velocity": (6.3285, 6.3936, 0.8272)}),
        ((0.088864014775, 0.316290845085, 0.424881727338),
         (-0.459497731604, 0.300719460691, 2.970883871136), 0.093650461578, {
            "velocity": (-0.1063, 0.0651, -0.5963), "angular_velocity": (-3.6282, 9.7504, 2.138)}),
    )  # fmt: skip
    stepper = nts.Stepper(bricks.system(gravity=(0, 0, -G)), nts.EnergyMomentum())
    for _ in range(3):
        stepper.advance(2e-3)
        assert bricks.depth() < 1e-9 * SIZE
    assert stepper.solution.balance["active"].max() > 0


def test_a_vertex_that_rises_under_a_face_on_the_floor_stays_out():
    """The floor holds the nodes of the face, and not what comes from below."""
    turn = np.arccos(1.0 / 3.0**0.5) * np.array([1, -1, 0]) / 2.0**0.5
    bricks = Bricks(
        ((0.01, 0.02, -(1.0 + 1e-8) * SIZE * 0.75**0.5), turn, SIZE, {"velocity": (0, 0, 0.5)}),
        ((0, 0, 0.5 * SIZE), np.zeros(3), SIZE, {"velocity": (0, 0, -0.1)}),
    )
    upper, lower = (body.surface(everywhere) for body in bricks.bodies[::-1])
    contacts = [nts.ContactPair(upper, nts.Plane((0, 0, 0), (0, 0, 1))),
                nts.ContactPair(upper, lower)]  # fmt: skip
    stepper = nts.Stepper(nts.System(bricks.bodies, contacts=contacts), nts.EnergyMomentum())
    for _ in range(3):
        stepper.advance(2e-3)
        assert bricks.depth() < 1e-9 * SIZE
    assert stepper.solution.balance["active"].max() > 0


def test_a_facet_that_has_turned_over_holds_nothing():
    """A flat trapezoid whose sides would meet at y = 3 faces the other way beyond.

    What is in front of its plane there, four lengths from the facet, is no node behind it.
    """
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [0.5, 1, 0], [-0.5, 1, 0]])
    points = np.array([[[0.2, 5.0, 0.1], *corners], [[0.2, 0.5, 0.1], *corners]])
    xi, normal = np.zeros((2, 2)), np.tile([0.0, 0, 1], (2, 1))
    gap = FacetGap(
        start=points, xi=xi, normal=normal, length=np.full(2, 2.0), rule="direct", theta=0.5,
        condense=True,
    )  # fmt: skip
    assert np.abs(gap.gap(points) - 0.1).max() < 1e-14
    found = gap.evaluate(points, np.empty((2, 0)), -np.ones((2, 1)))
    assert np.abs(found.gap - 0.1).max() < 1e-14
    assert found.let_go.tolist() == [True, False]


@pytest.mark.fast_on_ranks()
def test_what_is_far_apart_is_left_out(monkeypatch):
    """Bricks that meet two by two move to the bit as in steps that look at all of them."""

    def run(search):
        bricks = Bricks(
            *(((0.4 * k, 0, z), (0.1 * k, 0.2, 0), SIZE, {"velocity": (0, 0, v)})
              for k in range(2) for z, v in ((0.0, 0.0), (0.18 + 0.01 * k, -4.0)))
        )  # fmt: skip
        stepper = nts.Stepper(bricks.system(), nts.EnergyMomentum())
        for _ in range(10):
            stepper.advance(3e-3)
        assert len(stepper.problem.couplings.contacts.numbers) < 6 or search
        return stepper.solution.balance, [b.position for b in bricks.bodies]

    table, places = run(False)
    monkeypatch.setattr(Apart, "look", lambda self, u, motion: None)
    all_of_them, others = run(True)
    assert table["active"].max() > 0
    assert np.array_equal(table["energy"], all_of_them["energy"])
    assert np.array_equal(places, others)


def test_obstacles_of_many_bodies_are_one_and_are_left_out_while_far(monkeypatch):
    """Bricks that hit a floor, a ball and a post move as where each contact is by itself."""
    obstacles = [
        nts.Plane((0, 0, -0.07), (0.1, 0, 1)),
        nts.Sphere((0.4, 0, -0.155), 0.1),
        nts.Cylinder((0.8, 0, -0.155), (0, 1, 0), 0.1),
    ]

    def run():
        bricks = Bricks(
            *(((0.4 * k, 0, 0.02 * k), (0.1 * k, 0.2, 0), SIZE, {"velocity": (0, 0, -2.0)})
              for k in range(3))
        )  # fmt: skip
        contacts = [
            nts.ContactPair(body.surface(everywhere), obstacle, friction=0.4)
            for body in bricks.bodies for obstacle in obstacles
        ]  # fmt: skip
        system = nts.System(bricks.bodies, contacts=contacts)
        stepper, sought = nts.Stepper(system, nts.EnergyMomentum()), []
        for _ in range(12):
            stepper.advance(2e-3)
            sought.append(len(stepper.problem.couplings.contacts.numbers))
        return stepper.solution.balance, [b.position for b in bricks.bodies], min(sought)

    table, places, few = run()
    assert few < len(obstacles) * 3
    assert table["active"].max() > 1
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]
    monkeypatch.setattr(Apart, "look", lambda self, u, motion: None)
    monkeypatch.setattr("dolfinx_nts.contact.alike._kind", lambda batch: None)
    other, others, _ = run()
    assert np.allclose(table["energy"], other["energy"], rtol=1e-11, atol=0.0)
    assert np.allclose(places, others, rtol=0.0, atol=1e-9 * SIZE)


@pytest.mark.slow
@pytest.mark.fast_on_ranks()
def test_bricks_dropped_on_each_other_come_to_rest():
    """One brick over the joint of two, all dropped.

    Which nodes touch, stick and slip does not settle by the laws alone. At rest each brick lies
    where it was built, and either lower one carries its own weight and half of the upper one's.
    """
    wide, high = 0.2, 0.1
    bodies = [
        nts.RigidBody(
            box([x, 0.0, z + fall], [x + wide, 0.1, z + high + fall], 1), density=1e3, name=name
        )
        for name, x, z, fall in (
            ("left", 0.0, 0.0, 1e-4), ("right", 0.21, 0.0, 1e-4), ("upper", 0.105, high, 2e-4)
        )
    ]  # fmt: skip
    left, right, upper = (body.surface(everywhere) for body in bodies)
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    both = [(left, floor), (right, floor), (upper, left), (upper, right)]
    contacts = [nts.ContactPair(*pair, friction=0.4) for pair in both]
    system = nts.System(bodies, contacts=contacts, gravity=(0, 0, -G))
    run = nts.simulate(system, nts.GeneralizedAlpha(rho_inf=0.5), dt=2e-3, t_end=0.14)
    # The scheme is not one that keeps energy, as the status says.
    assert run.status.startswith("completed")
    table, weight = run.balance, 1e3 * wide * high * 0.1 * G
    assert table["kinetic"][-1] < 1e-6 * table["external_work"][-1]
    for body, z in zip(bodies, (0.5, 0.5, 1.5), strict=True):
        assert abs(body.position[2] - z * high) < 1e-9 * high
    # Gaps count as closed to 1e-10 of a facet: forces of single steps are known to m / dt^2 of
    # that, a millionth of the weight, and their mean to what the velocity then still is.
    carried = run.contact_forces[-20:, :, 2].mean(axis=0) / weight
    assert np.abs(carried - [1.5, 1.5, 0.5, 0.5]).max() < 1e-6
