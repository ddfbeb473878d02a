"""Pressure on shells: dead, or following them; its work, tangent and balance."""


import numpy as np
import pytest
from shells import ball, grid, plate, surface_mesh

import dolfinx_nts as nts
from dolfinx_nts.kernels import pressure as kernel

EM = nts.EnergyMomentum()
RUBBER = {"young": 1e5, "poisson": 0.3, "thickness": 0.05, "density": 10.0}


def at(axis, value):
    return lambda x: np.abs(x[axis] - value) < 1e-9


# ---- kernel
def states(seed=0, n=3):
    rng = np.random.default_rng(seed)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    return corners + 0.3 * rng.standard_normal((2, n, 4, 3))


@pytest.mark.parametrize("theta", [None, 0.5, 0.7, 1.0])
def test_the_tangent_is_the_derivative_of_the_force(theta):
    x0, x1 = states()
    way = np.random.default_rng(5).standard_normal(x1.shape)
    ahead, behind = (kernel.force(x0, x1 + s * way, theta) for s in (1e-5, -1e-5))
    found = np.einsum("niajb,njb->nia", kernel.tangent(x0, x1, theta), way)
    assert found == pytest.approx((ahead - behind) / 2e-5, rel=1e-8, abs=1e-10)


def test_a_flat_cell_is_pushed_along_its_normal_by_its_area():
    """Also where its nodes share it unevenly: by the integrals of the shape functions."""
    x = np.array([
        [[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]],
        [[0, 0, 0], [3, 0, 0], [1, 1, 0], [0, 1, 0]],
    ])  # fmt: skip
    found = kernel.force(x, x, 1.0)
    assert found[0] == pytest.approx(np.tile([0, 0, 0.5], (4, 1)), abs=1e-15)
    assert found[1].sum(axis=0) == pytest.approx((0, 0, 2), abs=1e-15)
    # First moments of a trapezium of parallel sides 3 and 1, 1 high.
    moment = np.cross(x[1], found[1]).sum(axis=0)
    assert moment == pytest.approx(((3 + 2 * 1) / 6, -(9 + 3 + 1) / 6, 0), abs=1e-14)


def volume(x, cells):
    """Within a closed surface of bilinear cells: each about its own two diagonals' mean."""
    corners = x[cells]
    a, b, c, d = corners.transpose(1, 0, 2)
    first = np.einsum("ni,ni->n", a, np.cross(b, c)) + np.einsum("ni,ni->n", a, np.cross(c, d))
    other = np.einsum("ni,ni->n", a, np.cross(b, d)) + np.einsum("ni,ni->n", b, np.cross(c, d))
    return (first + other).sum() / 12


def test_on_a_closed_surface_forces_balance_and_work_is_the_change_of_volume():
    x0, cells = ball(3)
    cells = cells[:, [0, 1, 3, 2]]
    rng = np.random.default_rng(3)
    x1 = x0 + 0.2 * rng.standard_normal(x0.shape)
    for theta in (None, 0.5, 1.0):
        at_nodes = np.zeros_like(x0)
        np.add.at(at_nodes, cells, kernel.force(x0[cells], x1[cells], theta))
        assert at_nodes.sum(axis=0) == pytest.approx(0, abs=1e-14)
        work = (at_nodes * (x1 - x0)).sum()
        grown = volume(x1, cells) - volume(x0, cells)
        assert (work == pytest.approx(grown, rel=1e-13)) == (theta is None)
        if theta is not None:
            place = x0 + theta * (x1 - x0)
            assert np.cross(place, at_nodes).sum(axis=0) == pytest.approx(0, abs=1e-14)


# ---- equilibrium
def tube(pressure, follower, n):
    """A quarter of a ring of unit radius and length, inflated far; no Poisson effect."""
    a, z = np.meshgrid(np.linspace(0, np.pi / 2, n + 1), [0.0, 1.0], indexing="ij")
    x = np.stack([np.cos(a), np.sin(a), z], axis=-1).reshape(-1, 3)
    x[np.abs(x) < 1e-12] = 0.0
    return nts.Shell(
        surface_mesh(x, grid(n, 1)), **RUBBER | {"poisson": 0.0}, name="tube",
        forces=[nts.Pressure(pressure, follower=follower)],
        bcs=[
            nts.Clamp(at(0, 0.0), components=(0,)), nts.Clamp(at(1, 0.0), components=(1,)),
            nts.Dirichlet(at(2, 0.0), components=(2,)),
        ],
    )  # fmt: skip


@pytest.mark.mpi
@pytest.mark.parametrize("follower", [True, False])
@pytest.mark.fast_on_ranks("True")
def test_a_tube_blown_up(follower):
    """E t s (s^2 - 1)/2 + E t^3/12 (s - 1) = p s, or p where dead, of a stretch s at R = 1."""
    young, t, s = 1e5, 0.05, 1.2
    push = young * t * s * (s**2 - 1) / 2 + young * t**3 / 12 * (s - 1)
    errors = []
    for n in (8, 16):
        body = tube(push / s if follower else push, follower, n)
        run = nts.equilibrium(nts.System([body]), load_steps=2)
        _, now = body.midsurface()
        assert run.status == "completed"
        radius = np.linalg.norm(now[:, :2], axis=1)
        assert np.ptp(radius) < 1e-3
        errors.append(radius.mean() - s)
    assert abs(errors[1]) < 2e-3
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)


def octant(n):
    """Those cells of a sphere whose nodes have no negative coordinate."""
    x, cells = ball(2 * n)
    x[np.abs(x) < 1e-12] = 0.0
    cells = cells[(x[cells] >= 0.0).all(axis=(1, 2))]
    used, inverse = np.unique(cells, return_inverse=True)
    return x[used], inverse.reshape(-1, 4)


def test_a_sphere_under_pressure():
    """Membrane forces are p R/2, and the radius has grown by p R^2 (1 - nu)/(2 E t)."""
    x, cells = octant(8)
    pressure, thickness = 1.0, 0.05
    body = nts.Shell(
        surface_mesh(x, cells), **RUBBER | {"thickness": thickness},
        bcs=[nts.Clamp(at(k, 0.0), components=(k,)) for k in range(3)],
        forces=[nts.Pressure(pressure)],
    )  # fmt: skip
    run = nts.equilibrium(nts.System([body]))
    _, now = body.midsurface()
    grown = np.linalg.norm(now, axis=1) - 1
    assert run.status == "completed"
    expected = pressure * 0.7 / (2 * 1e5 * thickness)
    assert grown.mean() == pytest.approx(expected, rel=0.005)
    # Where three cells meet, and at the edges, whose directors are of one side: 3.3 and 2.4 %.
    assert grown == pytest.approx(expected, rel=0.035)
    force = body.resultants()["force"].x.array.reshape(-1, 3, 3)
    first, second = np.sort(np.linalg.eigvalsh(force), axis=1)[:, 1:].T
    assert first == pytest.approx(pressure / 2, rel=0.03)
    assert second == pytest.approx(pressure / 2, rel=0.03)
    # What holds the planes of symmetry is the pressure on the quarters of the disc.
    held = run.reactions["shell"][-1]
    assert np.abs(held[range(3), range(3)]) == pytest.approx(pressure * np.pi / 4, rel=0.01)


# ---- dynamics
def balloon(rule, **options):
    """A ball that is blown up, flies and turns while its wall stretches and swings."""
    x, cells = ball(2)
    body = nts.Shell(
        surface_mesh(x * (1.0, 0.9, 0.7), cells, **options), **RUBBER, velocity=(1, 2, 3),
        angular_velocity=(0.5, 1, 2), forces=[nts.Pressure(500.0)], name="balloon",
    )  # fmt: skip
    run = nts.simulate(nts.System([body]), rule, dt=0.01, t_end=0.1)
    cells = cells[:, [0, 1, 3, 2]]
    start, now = body.midsurface()
    grown = volume(now, cells) - volume(start, cells)
    return run, now, grown


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_the_work_of_constant_pressure_is_its_product_with_the_change_of_volume():
    """Exactly, and linear momentum is kept; the midpoint rule keeps the angular momentum, too."""
    run, _, grown = balloon(EM)
    balance = run.balance
    assert run.status == "completed" and grown > 0.1
    assert balance["external_work"][-1] == pytest.approx(500.0 * grown, rel=1e-12)
    scale = np.abs(balance["external_work"]).max()
    assert np.abs(balance["ledger_residual"]).max() < 1e-11 * scale
    moment = balance["linear_momentum"]
    assert moment == pytest.approx(np.tile(moment[0], (len(moment), 1)), rel=1e-11)
    spin = np.ptp(balance["angular_momentum"], axis=0).max()
    other, _, grown = balloon(nts.Midpoint())
    assert np.abs(other.balance["external_work"][-1] / 500.0 / grown - 1) > 1e-6
    kept = np.ptp(other.balance["angular_momentum"], axis=0).max()
    assert kept < 1e-11 < spin


# ---- what else is asked of it
@pytest.mark.mpi
def test_pressure_on_a_part_in_time():
    """Of a plate its first half is pushed, by twice as much at twice the time."""
    edge = nts.Dirichlet(lambda x: x[2] < 1.0)
    half = nts.Pressure(lambda t: 5.0 * t, where=lambda x: x[0] < 0.5 + 1e-9)
    body = nts.Shell(plate(4, 2, 1.0, 2.0), **RUBBER, bcs=[edge], forces=[half])
    for time in (1.0, 2.0):
        body.begin_step(EM, nts.EvaluationPoint(u0=np.zeros(body.num_owned), time=time))
        force = body.external(np.zeros(body.num_owned), np.zeros(3))
        total = body.comm.allreduce(force.reshape(-1, 2, 3)[:, 0].sum(axis=0))
        assert total == pytest.approx((0, 0, 5.0 * time * 0.5 * 2.0), abs=1e-13)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("load", "kind", "text"),
    [
        (lambda: nts.Pressure("much"), ValueError, "^Pressure.value='much': must be a finite num"),
        (lambda: nts.Pressure((0, 0, 1)), ValueError, r"^Pressure.value=\(0, 0, 1\): must be a f"),
        (lambda: nts.Pressure(1.0, follower=1), TypeError, "follower=1"),
        (lambda: nts.Pressure(1.0, where="top"), TypeError, r"forces\[0\] of 'shell'='top"),
        (lambda: nts.Pressure(1.0, lambda x: x[0] < 0.1), ValueError, "selects no cell; select a"),
        (lambda: nts.Pressure(lambda t: (1, 2)), nts.UserFunctionError, "return a finite number"),
    ],
)  # fmt: skip
def test_bad_input_is_told(load, kind, text):
    mesh = plate(2, 2, 1.0, 1.0)
    with pytest.raises(kind, match=text):
        nts.Shell(mesh, **RUBBER, forces=[load()])


def test_a_beam_has_no_area_to_press():
    mesh = surface_mesh([[0, 0, 0], [1, 0, 0]], [[0, 1]], kind="interval")
    section = nts.Circle(0.1).section(young=1.0, poisson=0.0, density=1.0)
    with pytest.raises(TypeError, match=r"pass a sequence of PointForce, PointMoment, LineForce"):
        nts.Beam(mesh, section, forces=[nts.Pressure(1.0)])
