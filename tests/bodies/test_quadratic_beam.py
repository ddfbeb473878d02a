"""Beams of three nodes and two points: theory section 20; benchmarks B26, B27, B29, B35."""

from mpi4py import MPI

import numpy as np
import pytest
from lines import arc, curved_mesh, interval_mesh, straight

import dolfinx_nts as nts
from dolfinx_nts.kernels import beam as beam_kernel
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.output import Fields

EM, COMM = nts.EnergyMomentum(), MPI.COMM_WORLD
SOFT = nts.Section(EA=1e4, GA=(1e4,) * 2, GJ=500, EI=(500,) * 2, rhoA=1, rhoI=(10,) * 2)


def root(x):
    return np.linalg.norm(x, axis=0) < 1e-9


# ---- kernel
def elements(seed=0, n=3, radius=0.3):
    """Elements with bent references, and two states of theirs."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((3, n, 12, 3))
    y[0, :, ::4] = np.arange(3)[:, None] * [1.0, 0.3, -0.2] + 0.1 * y[0, :, ::4]
    stiffness = np.array([3.0, 4.0, 9.0, 1.0, 2.0, 0.5])
    return beam_kernel.beams(y[0], radius, stiffness)[0], y[1], y[2]


@pytest.mark.parametrize("theta", [None, 0.5, 0.7, 1.0])
def test_the_tangent_is_the_derivative_of_the_force(theta):
    of, y0, y1 = elements()
    way = np.random.default_rng(5).standard_normal(y1.shape)
    ahead, behind = (kernel.force(of, y0, y1 + s * way, theta) for s in (1e-6, -1e-6))
    found = np.einsum("nij,nj->ni", kernel.tangent(of, y0, y1, theta), way.reshape(-1, 36))
    assert found == pytest.approx((ahead - behind) / 2e-6, rel=1e-6, abs=1e-6)


def test_the_force_is_the_derivative_of_the_energy():
    of, y0, y1 = elements(1)
    way = np.random.default_rng(6).standard_normal(y1.shape)
    change = kernel.energy(of, y1 + 1e-6 * way) - kernel.energy(of, y1 - 1e-6 * way)
    work = (kernel.force(of, y1, y1, 1.0) * way.reshape(-1, 36)).sum(axis=1)
    assert work == pytest.approx(change / 2e-6, rel=1e-6)
    work = (kernel.force(of, y0, y1, None) * (y1 - y0).reshape(-1, 36)).sum(axis=1)
    assert work == pytest.approx(kernel.energy(of, y1) - kernel.energy(of, y0), rel=1e-12)


def test_masses_are_those_of_the_arc():
    """Of a straight element in closed form; sums of those of an arc are its length."""
    exact = np.array([[4, 2, -1], [2, 16, 2], [-1, 2, 4]]) / 30
    assert beam_kernel.shares(0.7 * straight(2)[None])[0] == pytest.approx(0.7 * exact)
    sums = beam_kernel.shares(arc(2, 2.0, 0.3)[None]).sum()
    assert sums == pytest.approx(0.6, rel=1e-5)


# ---- equilibrium
@pytest.mark.mpi
@pytest.mark.parametrize("curved", [False, True])
def test_the_cantilever_of_reissners_equations(curved):
    """Four elements err by 8.87e-3 of the way, eight of two nodes by 3.30e-2."""
    section = nts.Section(EA=2000, GA=(800, 800), GJ=1, EI=(1, 1), rhoA=1, rhoI=(1e-2, 1e-2))
    given = {"mesh": curved_mesh(straight(8))} if curved else {
        "mesh": interval_mesh(straight(4)), "degree": 2
    }  # fmt: skip
    beam = nts.Beam(section=section, bcs=[nts.Clamp(root)], **given,
                    forces=[nts.PointForce(lambda x: x[0] > 1 - 1e-9, (0, 10, 0))])  # fmt: skip
    run = nts.equilibrium(nts.System([beam]), load_steps=5)
    exact, (start, now) = np.array([0.44412985, 0.81711894, 0.0]), beam.centreline()
    error = np.linalg.norm(now[-1] - exact) / np.linalg.norm(exact - start[-1])
    assert run.status == "completed" and error == pytest.approx(8.87e-3, rel=1e-3)
    assert start == pytest.approx(straight(8), abs=1e-15)
    assert run.reactions["beam"][-1].ravel() == pytest.approx((0, -10, 0), abs=1e-6)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_the_bend_of_bathe_and_bolourchi():
    """On a curved mesh; elements of two nodes tend to the same, with order 2 (B27')."""
    section = nts.Section(EA=1e7, GA=(5e6,) * 2, GJ=1e7 / 12, EI=(1e7 / 12,) * 2, rhoA=1,
                          rhoI=(1 / 12, 1 / 12))  # fmt: skip
    x = arc(16, 100, np.pi / 4)
    tip = nts.PointForce(lambda y: y[0] > x[-1, 0] - 1e-6, (0, 0, 600))
    beam = nts.Beam(curved_mesh(x), section, bcs=[nts.Clamp(root)], forces=[tip])
    nts.equilibrium(nts.System([beam]), load_steps=5)
    coarse = np.array([47.09540928, 15.68793125, 53.52178818])
    fine = np.array([47.13673942, 15.68558472, 53.48654558])
    limit = fine + (fine - coarse) / 3
    assert beam.centreline()[1][-1] == pytest.approx(limit, abs=2e-2)


@pytest.mark.mpi
def test_a_force_per_length():
    """On the outer half of a cantilever: Euler and Bernoulli, 41/384 q L^4 / EI; the reaction."""
    section = nts.Section(EA=1e9, GA=(1e12,) * 2, GJ=1e6, EI=(1e6, 1e6), rhoA=10, rhoI=(0.1, 0.1))
    outer = nts.LineForce((0, 0, -30.0), where=lambda x: x[0] > 2 - 1e-9)
    beam = nts.Beam(interval_mesh(straight(16, 4.0)), section, bcs=[nts.Clamp(root)],
                    forces=[outer], degree=2)  # fmt: skip
    run = nts.equilibrium(nts.System([beam]))
    assert run.reactions["beam"][-1, 0] == pytest.approx((0, 0, 60.0), abs=1e-5)
    deflection = -41 / 384 * 30.0 * 4**4 / 1e6
    assert beam.centreline()[1][-1, 2] == pytest.approx(deflection, rel=1e-3)


def test_the_force_in_a_section():
    """Pulled and bent a little: N, and the moment of the force at the end, in the middle."""
    force = nts.PointForce(lambda x: x[0] > 1 - 1e-9, (5.0, 0, 1e-3))
    beam = nts.Beam(interval_mesh(straight(1)), SOFT, degree=2, bcs=[nts.Clamp(root)],
                    forces=[force])  # fmt: skip
    nts.equilibrium(nts.System([beam]), load_steps=1)
    found = beam.resultants()
    assert found["force"].x.array[:3] == pytest.approx((5.0, 0, 1e-3), rel=1e-3, abs=1e-6)
    assert found["moment"].x.array[:3] == pytest.approx((0, -5e-4, 0), rel=1e-2, abs=1e-6)


# ---- dynamics
def flying(n=4):
    """B29 with as many nodes."""
    return nts.Beam(
        interval_mesh(straight(n, 10.0)), SOFT, degree=2, angular_velocity=(0.3, 0.5, 1),
        velocity=lambda x: np.array([0, 0, 0.5])[:, None] * np.cos(np.pi * x[0] / 10),
    )  # fmt: skip


@pytest.mark.mpi
@pytest.mark.parametrize(("dt", "t_end"), [(0.05, 5), (0.2, 4), (0.5, 20)])
@pytest.mark.fast("0.2-4")
@pytest.mark.fast_on_ranks()
def test_a_flying_beam_keeps_energy_and_angular_momentum(dt, t_end):
    run = nts.simulate(nts.System([flying()]), EM, dt=dt, t_end=t_end)
    energy, spin = run.balance["energy"], run.balance["angular_momentum"]
    assert run.status == "completed"
    assert np.abs(energy / energy[0] - 1).max() < 1e-12
    assert np.abs(spin - spin[0]).max() < 1e-12 * np.linalg.norm(spin[0])


@pytest.mark.slow
@pytest.mark.parametrize("n", [10, 16])
def test_flying_spaghetti(n):
    """B35, Simo and Vu-Quoc 1986; 40 elements of degree 2, and 64 of degree 1 within 0.06."""
    section = nts.Section(EA=1e4, GA=(1e4,) * 2, GJ=100, EI=(100,) * 2, rhoA=1, rhoI=(10,) * 2)

    def until(value):
        return lambda t: value if t < 2.5 else (0.0, 0.0, 0.0)

    def lower(x):
        return x[1] < 1e-9

    beam = nts.Beam(
        interval_mesh(np.linspace((6, 0, 0), (0, 8, 0), n + 1)), section, degree=2,
        forces=[nts.PointForce(lower, until((8, 0, 0))), nts.PointMoment(lower, until((0, 0, 80)))],
    )  # fmt: skip
    run = nts.simulate(nts.System([beam]), EM, dt=0.02, t_end=5)
    assert run.status == "completed" and not run.warnings
    off = beam.centreline()[1][0] - (8.1784, 2.0560, 0.0)
    assert np.linalg.norm(off) < 0.1


@pytest.mark.mpi
def test_beams_joined_at_a_corner_and_to_a_middle_node_fly_on():
    """Fixed at right angles, a body hinged to the middle of an element: E and J are kept."""
    spin, end = (0.3, 0.5, 1), np.array([2.0, 0, 0])
    one = nts.Beam(interval_mesh(straight(2, 2)), SOFT, name="one", angular_velocity=spin,
                   velocity=np.cross(spin, (1, 0, 0)), degree=2)  # fmt: skip
    two = nts.Beam(interval_mesh(end + straight(2, 2, (0, 1, 0))), SOFT, name="two", degree=2,
                   angular_velocity=spin, velocity=np.cross(spin, (2, 1, 0)))  # fmt: skip
    ball = nts.RigidBody.from_inertia(2.0, (0.3, 0.4, 0.5), centre=(0.5, 0, 0), name="ball",
                                      angular_velocity=spin,
                                      velocity=np.cross(spin, (0.5, 0, 0)))  # fmt: skip
    joints = [nts.Fixed(one, two, point=end),
              nts.Revolute(one, ball, point=(0.5, 0, 0), axis=(0, 0, 1))]  # fmt: skip
    run = nts.simulate(nts.System([one, two, ball], joints=joints), EM, dt=0.1, t_end=1)
    energy, spins = run.balance["energy"], run.balance["angular_momentum"]
    assert run.status == "completed" and np.abs(energy / energy[0] - 1).max() < 1e-12
    assert np.abs(spins - spins[0]).max() < 1e-12 * np.linalg.norm(spins[0])
    assert one.centreline()[1][-1] == pytest.approx(two.centreline()[1][0], abs=1e-10)


# ---- order, skin, contact, files
@pytest.mark.mpi
@pytest.mark.parametrize("curved", [False, True])
def test_nodes_follow_the_axis_of_a_ring(curved):
    x = arc(16, 1.0, 2 * np.pi)[:-1]
    k = 2 * np.arange(8)
    cells = np.column_stack([k, (k + 2) % 16, k + 1])
    cells[::3, :2] = cells[::3, 1::-1]
    if curved:
        beam = nts.Beam(interval_mesh(x, cells), SOFT)
    else:
        beam = nts.Beam(interval_mesh(x[::2], cells[:, :2] // 2), SOFT, degree=2)
        x[1::2] = 0.5 * (x[::2] + np.roll(x[::2], -1, axis=0))
    start, now = beam.centreline()
    assert start == pytest.approx(x, abs=1e-14) and now == pytest.approx(x, abs=1e-14)


@pytest.mark.mpi
def test_a_blow_on_a_plane_closes_the_ledger(tmp_path):
    """Facets of the skin are between neighbouring nodes; fields are at all of them."""
    shape = nts.Rectangle(0.06, 0.05).section(young=1e6, poisson=0.3, density=1e3)
    mesh = curved_mesh(np.array([0, 0, 0.0303]) + straight(8, 0.9))
    bar = nts.Beam(mesh, shape, direction=(0, 0, 1), velocity=(0.1, 0, -1), name="bar")
    skin = bar.surface()
    # Eight points at each of nine nodes, and four facets at each end.
    assert len(skin.facets) == 8 * 8 + 2 * 4
    plane = nts.Plane(point=(0, 0, 0), normal=(0, 0, 1))
    pair = nts.ContactPair(skin, plane, friction=0.3)
    folder = COMM.bcast(tmp_path)
    run = nts.simulate(nts.System([bar], contacts=[pair]), EM, dt=2e-4, t_end=2e-3,
                       output=[Fields(folder, every=5)])  # fmt: skip
    assert run.status.startswith("completed") and run.balance["active"].max() > 0
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * run.balance["energy"][0]
    (name,) = (name for name in run.contact_fields(bar) if name.startswith("contact_load"))
    loads = run.contact_fields(bar)[name].x.array[: 3 * bar.space.dofmap.index_map.size_local]
    total = COMM.allreduce(loads.reshape(-1, 3).sum(axis=0))
    assert total == pytest.approx(run.contact_forces[-1, 0], rel=1e-9, abs=1e-9)
    assert 'NodesPerElement="3"' in (folder / "bar.xdmf").read_text()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("x", "given", "text"),
    [
        (straight(4), {"degree": 3}, "degree=3 of 'beam': pass 1 or 2"),
        (straight(4), {"degree": 1}, r"its mesh is of degree 2; .* nts.linear\(mesh\)"),
        ([[0, 0, 0], [0.3, 0, 0], [1, 0, 0]], {}, "at x=.*0.3.* more than twice as far"),
    ],
)
def test_bad_input_is_told(x, given, text):
    with pytest.raises(ValueError, match=text):
        nts.Beam(curved_mesh(np.asarray(x)), SOFT, **given)


@pytest.mark.mpi
def test_a_mesh_of_degree_1_through_the_ends():
    line = nts.linear(curved_mesh(arc(8, 1.0, 1.0)))
    start, _ = nts.Beam(line, SOFT).centreline()
    assert start == pytest.approx(arc(8, 1.0, 1.0)[::2], abs=1e-14)
