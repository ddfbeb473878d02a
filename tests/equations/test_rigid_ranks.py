"""Rigid bodies in contact and with joints: any number of ranks computes the same."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.parallel import rank_of, sums_and_largest, together

COMM = MPI.COMM_WORLD
G = 9.81


def box(comm, low, size, n, **options):
    low = np.array(low, dtype=float)
    mesh = create_box(
        comm, [low, low + size], list(n), CellType.hexahedron, ghost_mode=GhostMode.shared_facet
    )
    return nts.RigidBody(mesh, density=1e3, **options)


def on_a_plate(plate, body):
    """It slides and turns with friction on a rigid plate that slides on a plane."""
    on_plate = nts.ContactPair(
        slave=body.surface(lambda x: x[2] < 0.01 + 1e-9),
        master=plate.surface(lambda x: x[2] > 0.01 - 1e-9),
        friction=0.3,
    )
    on_floor = nts.ContactPair(
        slave=plate.surface(lambda x: x[2] < 1e-9), master=nts.Plane((0, 0, 0), (0, 0, 1))
    )
    return nts.System([plate, body], contacts=[on_plate, on_floor], gravity=(0, 0, -G)), 1.0


def brick(comm):
    """On twelve nodes, whose share of the weight sets the torque of friction."""
    plate = box(comm, (0, 0, 0), (1.0, 0.6, 0.01), (4, 3, 1), name="plate")
    body = box(
        comm, (0.2, 0.2, 0.01), (0.2, 0.1, 0.05), (3, 2, 1), velocity=(1, 0.2, 0),
        angular_velocity=(0, 0, 3), name="brick",
    )  # fmt: skip
    return on_a_plate(plate, body)


def contact(comm):
    """On three feet."""
    plate = box(comm, (0, 0, 0), (1.0, 0.6, 0.01), (4, 3, 1), name="plate")
    corners = [(0.2, 0.2, 0.01), (0.5, 0.2, 0.01), (0.3, 0.4, 0.01), (0.34, 0.27, 0.11)]
    cells = np.array([[0, 1, 2, 3]]) if comm.rank == 0 else np.empty((0, 4))
    points = np.array(corners) if comm.rank == 0 else np.empty((0, 3))
    mesh = compat.create_mesh(comm, cells.astype(np.int64), points, "tetrahedron")
    tripod = nts.RigidBody(
        mesh, density=1e3, velocity=(1, 0.2, 0), angular_velocity=(0, 0, 3), name="tripod"
    )
    return on_a_plate(plate, tripod)


def chain(comm):
    """Six links of 1 m with ball joints, which fall from the horizontal for a second."""
    links = [
        nts.RigidBody.from_inertia(
            1.0, (0.01, 0.1, 0.1), centre=(k + 0.5, 0, 0), name=f"link {k}", comm=comm
        )
        for k in range(6)
    ]
    joints = [
        nts.Spherical(b, links[k - 1] if k else None, point=(k, 0, 0), name=f"joint {k}")
        for k, b in enumerate(links)
    ]
    return nts.System(links, joints=joints, gravity=(0, 0, -G)), 6.0


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("scene", "dt", "t_end"), [(contact, 1e-2, 0.2), (brick, 1e-2, 0.3), (chain, 1e-2, 0.5)]
)
@pytest.mark.skipif(COMM.size == 1, reason="compares ranks with a serial run")
@pytest.mark.fast_on_ranks("brick-0.01-0.3")
def test_ranks_change_nothing(scene, dt, t_end):
    """The scene of these ranks against the one that every rank computes alone, to 1e-9 of it."""
    (one, size), (other, _) = scene(COMM), scene(MPI.COMM_SELF)
    together, alone = (
        nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=t_end) for system in (one, other)
    )
    assert together.status == alone.status == "completed"
    for a, b in zip(one.bodies, other.bodies, strict=True):
        moved = np.abs(b.position - b.centre).max()
        assert np.abs(a.position - b.position).max() < 1e-9 * size
        assert moved > 1e-3 * size
        assert np.abs(a.rotation - b.rotation).max() < 1e-9
    a, b = together.balance, alone.balance
    largest = max(np.abs(b[name]).max() for name in ("kinetic", "external_work"))
    for name in ("kinetic", "external_work", "friction_dissipation", "ledger_residual"):
        assert np.abs(a[name] - b[name]).max() < 1e-9 * largest
    assert scene is chain or b["slip"].max() > 0


@pytest.mark.parametrize("names", ["link {}", "revolute of link {} and link {}", "b{}"])
@pytest.mark.parametrize("ranks", [2, 3, 4])
def test_numbered_names_are_dealt_evenly(names, ranks):
    """Rigid bodies and joints live on one rank each."""
    class Comm:
        size = ranks

    owners = [rank_of(names.format(k, k + 1), Comm) for k in range(100)]
    counts = np.bincount(owners, minlength=ranks)
    assert counts.max() - counts.min() <= 1


@pytest.mark.mpi
@pytest.mark.parametrize(("n", "m"), [(0, 2), (3, 0), (3000, 2000)])
def test_sums_and_largest_values_of_all_ranks_come_in_one_call(n, m):
    """Against NumPy with the values of all ranks at hand; a NaN anywhere is one everywhere."""
    values = np.random.default_rng(1).normal(size=(COMM.size, n + m))
    values[-1, n : n + 1] = np.nan
    sums, largest = sums_and_largest(COMM, *np.split(values[COMM.rank], [n]))
    assert np.abs(sums - values[:, :n].sum(axis=0)).max(initial=0.0) < 1e-13 * COMM.size
    assert np.array_equal(largest, values[:, n:].max(axis=0), equal_nan=True)


@pytest.mark.mpi
def test_works_of_many_contacts_ask_all_ranks_together():
    """Each is sent its own answers, however many questions the others have."""
    def work(k):
        last = yield COMM.rank == COMM.size - 1
        none = yield False
        sums, most = yield np.full((k, 2), COMM.rank + k), np.array([COMM.rank - k])
        rows = yield np.full((COMM.rank + k % 2, 2), COMM.rank)
        for _ in range(k):
            yield True
        return last, none, sums.tolist(), most.tolist(), rows[:, 0].tolist()

    found = together(COMM, [work(k) for k in range(4)])
    total = sum(range(COMM.size))
    for k, (last, none, sums, most, rows) in enumerate(found):
        assert last and not none
        assert sums == 2 * k * [total + k * COMM.size] and most == [COMM.size - 1 - k]
        assert rows == [rank for rank in range(COMM.size) for _ in range(rank + k % 2)]
    assert together(COMM, []) == []
