"""Many rigid bodies: what is far apart is left out of steps; vertices stay out beside edges."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import box, everywhere
from scipy.spatial.transform import Rotation

import dolfinx_nts as nts
from dolfinx_nts.contact.apart import Apart

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
    run = nts.simulate(system, nts.GeneralizedAlpha(rho_inf=0.5), dt=2e-3, t_end=0.1)
    # The scheme is not one that keeps energy, as the status says.
    assert run.status.startswith("completed")
    table, weight = run.balance, 1e3 * wide * high * 0.1 * G
    assert table["kinetic"][-1] < 1e-6 * table["external_work"][-1]
    for body, z in zip(bodies, (0.5, 0.5, 1.5), strict=True):
        assert abs(body.position[2] - z * high) < 1e-9 * high
    carried = run.contact_forces[-1, :, 2] / weight
    assert np.abs(carried - [1.5, 1.5, 0.5, 0.5]).max() < 1e-6
