"""Shells: theory section 15; benchmarks B28, B30."""

from mpi4py import MPI

import numpy as np
import pytest
import scipy.linalg
from dolfinx import fem
from dolfinx.mesh import CellType, create_box
from scipy.spatial.transform import Rotation
from shells import grid, plate, plate_nodes, surface_mesh

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.kernels import shell as shell_kernel
from dolfinx_nts.output.pictures import picture

EM, MID = nts.EnergyMomentum(), nts.Midpoint()
RUBBER = {"young": 1e5, "poisson": 0.3, "thickness": 0.05, "density": 10.0}


def at(axis, value, size=1.0):
    return lambda x: np.abs(x[axis] - value) < 1e-9 * size


# ---- kernel
HALF = 0.05


def elements(seed=0, n=3):
    """Curved distorted elements, and two states of theirs."""
    rng = np.random.default_rng(seed)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    x = corners + 0.2 * rng.standard_normal((n, 4, 3))
    d = np.array([0, 0, 1]) + 0.2 * rng.standard_normal((n, 4, 3))
    d *= HALF / np.linalg.norm(d, axis=2, keepdims=True)
    y = np.stack([x, d], axis=2).reshape(n, 8, 3)
    of, _ = shell_kernel.shells(y, HALF, shell_kernel.stiffness(3.0, 0.3, 2 * HALF))
    size = np.tile([1.0, HALF], 4)[:, None]
    return of, *(y + 0.3 * size * rng.standard_normal((2, n, 8, 3))), y


@pytest.mark.parametrize("theta", [None, 0.5, 0.7, 1.0])
def test_the_tangent_is_the_derivative_of_the_force(theta):
    of, y0, y1, _ = elements()
    way = np.random.default_rng(5).standard_normal(y1.shape)
    step = 1e-7
    ahead, behind = (kernel.force(of, y0, y1 + s * way, theta) for s in (step, -step))
    found = np.einsum("nij,nj->ni", kernel.tangent(of, y0, y1, theta), way.reshape(-1, 24))
    assert found == pytest.approx((ahead - behind) / (2 * step), rel=1e-7, abs=1e-6)


def test_the_force_is_the_derivative_of_the_energy():
    of, _, y, _ = elements(1)
    way = np.random.default_rng(6).standard_normal(y.shape)
    change = kernel.energy(of, y + 1e-7 * way) - kernel.energy(of, y - 1e-7 * way)
    work = (kernel.force(of, y, y, 1.0) * way.reshape(-1, 24)).sum(axis=1)
    assert work == pytest.approx(change / 2e-7, rel=1e-6)


def test_the_work_of_the_discrete_gradient_is_the_change_of_the_energy():
    of, y0, y1, _ = elements(2)
    work = (kernel.force(of, y0, y1, None) * (y1 - y0).reshape(-1, 24)).sum(axis=1)
    assert work == pytest.approx(kernel.energy(of, y1) - kernel.energy(of, y0), rel=1e-12)


def test_the_energy_is_that_of_the_strains():
    """By the strains at the points, each in axes of its own."""
    of, y, _, rest = elements(3)
    c = shell_kernel.stiffness(3.0, 0.3, 2 * HALF)
    e = shell_kernel.strains(y, rest, HALF, shell_kernel.POINTS)
    whole = scipy.linalg.block_diag(c.membrane, c.bending, c.shear * np.eye(2))
    _, jacobian = shell_kernel.axes(rest[:, ::2], shell_kernel.POINTS)
    density = 0.5 * np.einsum("npi,ij,npj->np", e, whole, e)
    energy = (np.linalg.det(jacobian) * density).sum(axis=1)
    assert kernel.energy(of, y) == pytest.approx(energy, rel=1e-12)


def test_a_rigid_motion_strains_nothing():
    *_, rest = elements(4, 20)
    turn = Rotation.from_rotvec((0.3, -1.2, 2.0)).as_matrix()
    moved = rest @ turn.T
    moved[:, ::2] += (3.0, -2.0, 1.0)
    e = shell_kernel.strains(moved, rest, HALF, shell_kernel.POINTS)
    # Curvatures are per length and times the thickness strains.
    assert np.abs(e * np.repeat([1, 2 * HALF, 1], [3, 3, 2])).max() < 1e-14


def patch():
    """Five distorted elements in the plane (MacNeal and Harder 1985), and who is inside."""
    x = np.array([[0, 0], [0.24, 0], [0.24, 0.12], [0, 0.12],
                  [0.04, 0.02], [0.18, 0.03], [0.16, 0.08], [0.08, 0.08]])  # fmt: skip
    cells = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7]])
    return np.column_stack([x, 0 * x[:, 0]]), cells, np.arange(4, 8)


PATCH = {
    # Displacements of the place and of d, and the strains in the axes of x and y.
    "membrane": (lambda x, y: (1e-3 * x + 2e-3 * y, 3e-3 * x - 1e-3 * y, 0 * x),
                 lambda x, y: (0 * x, 0 * x), (1e-3, -1e-3, 5e-3, 0, 0, 0, 0, 0)),
    "bending": (lambda x, y: (0 * x, 0 * x, 0.5 * x**2 - y**2 + 0.7 * x * y),
                lambda x, y: (-x - 0.7 * y, 2 * y - 0.7 * x), (0, 0, 0, -1, 2, -1.4, 0, 0)),
    "shear": (lambda x, y: (0 * x, 0 * x, 2e-3 * x + 1e-3 * y),
              lambda x, y: (0 * x, 0 * x), (0, 0, 0, 0, 0, 0, 2e-3, 1e-3)),
}  # fmt: skip


@pytest.mark.parametrize("state", PATCH)
def test_constant_states_are_exact_on_distorted_elements(state):
    """The linear energy of the whole patch, and no force on the nodes inside."""
    x, cells, inside = patch()
    place, director, e = PATCH[state]
    c = shell_kernel.stiffness(2e6, 0.25, 2 * HALF)
    rest = np.zeros((8, 2, 3))
    rest[:, 0], rest[:, 1, 2] = x, HALF
    of, _ = shell_kernel.shells(rest[cells].reshape(5, 8, 3), HALF, c)
    u = np.zeros((8, 2, 3))
    u[:, 0] = np.stack(place(x[:, 0], x[:, 1]), axis=-1)
    u[:, 1, :2] = HALF * np.stack(director(x[:, 0], x[:, 1]), axis=-1)
    y = rest[cells].reshape(5, 8, 3)
    k = kernel.tangent(of, y, y, 1.0)
    of_cells = u[cells].reshape(5, 24)
    force = np.einsum("nij,nj->ni", k, of_cells)
    whole = scipy.linalg.block_diag(c.membrane, c.bending, c.shear * np.eye(2))
    area = 0.24 * 0.12
    assert 0.5 * (force * of_cells).sum() == pytest.approx(
        0.5 * area * np.array(e) @ whole @ np.array(e), rel=1e-12
    )
    total = np.zeros((8, 2, 3))
    np.add.at(total, cells, force.reshape(5, 4, 2, 3))
    # Constant shear needs moments that grow: there the nodes' directors are pushed.
    pushed = total[inside] if state != "shear" else total[inside, 0]
    assert np.abs(pushed).max() < 1e-13 * np.abs(force).max()


# ---- equilibrium
def strip(n, thickness=0.1, length=10.0, forces=(), comm=MPI.COMM_WORLD):
    """The cantilever of B28."""
    return nts.Shell(
        plate(n, 1, length, 1.0, comm), young=1.2e6, poisson=0.0, thickness=thickness, density=1.0,
        bcs=[nts.Clamp(at(0, 0.0))], forces=forces,
    )  # fmt: skip


def moved(body):
    start, now = body.midsurface()
    return now - start


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_the_cantilever_of_sze():
    force = nts.LineForce((0, 0, 4), where=at(0, 10.0))
    body = strip(16, forces=[force])
    run = nts.equilibrium(nts.System([body]), load_steps=10)
    assert run.status == "completed"
    assert moved(body)[-1] == pytest.approx((-3.29297, 0, 6.70470), abs=6e-6)
    assert run.reactions["shell"][-1].ravel() == pytest.approx((0, 0, -4), abs=1e-7)


def test_a_thin_strip_does_not_lock():
    """L/t = 1e4: the deflection of a slender cantilever, 4 P L^3 / (E b t^3)."""
    thickness, tip = 1e-3, 1e-3
    load = tip * 1.2e6 * thickness**3 / (4 * 10.0**3)
    body = strip(8, thickness, forces=[nts.LineForce((0, 0, load), where=at(0, 10.0))])
    run = nts.equilibrium(nts.System([body]))
    assert run.status == "completed"
    assert moved(body)[-1, 2] == pytest.approx(tip, rel=0.01)


@pytest.mark.parametrize(("n", "gap"), [(32, 0.01), (64, 0.0025)])
@pytest.mark.slow
def test_an_end_moment_rolls_a_strip_up(n, gap):
    """2 pi EI / L: a full circle, the ends of which meet; as these elements have it.

    An element stretched by s that bends by an angle a has the curvature 2 s sin(a/2) / length and
    the moment EI s^2 sin(a) / length; the curvature's share in the force makes it shorter.
    """
    moment = 2 * np.pi * 1.2e6 * 0.1**3 / 12 / 12.0
    load = nts.LineMoment((0, -moment, 0), where=at(0, 12.0))
    body = strip(n, length=12.0, forces=[load])
    run = nts.equilibrium(nts.System([body]), load_steps=10)
    _, now = body.midsurface()
    cell, angle = 12 / n, 2 * np.pi / n
    for _ in range(20):
        stretch = np.sqrt(1 - 0.1**2 / 6 * (2 * np.sin(angle / 2) / cell) ** 2)
        angle = np.arcsin(2 * np.pi / n / stretch**2)
    expected = stretch * cell * abs(np.sin(n * angle / 2)) / np.sin(angle / 2)
    assert run.status == "completed"
    assert np.linalg.norm(now[-1] - now[1]) == pytest.approx(expected, rel=1e-9)
    assert expected < gap * 12
    assert now[:, 2].max() == pytest.approx(12 / np.pi, rel=gap)


def hemisphere(n, force, comm=MPI.COMM_WORLD):
    """A quarter of Sze, Liu, Lo's: 18 degrees open at the top, pinched at the equator."""
    a, b = np.linspace(0, np.pi / 2, n + 1), np.linspace(0, np.deg2rad(72), n + 1)
    a, b = np.meshgrid(a, b, indexing="ij")
    x = 10 * np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)], axis=-1)
    x = x.reshape(-1, 3)
    x[np.abs(x) < 1e-12] = 0.0
    ends = at(0, 10.0, 10), at(1, 10.0, 10)
    return nts.Shell(
        surface_mesh(x, grid(n, n), comm), young=6.825e7, poisson=0.3, thickness=0.04, density=1.0,
        bcs=[
            nts.Clamp(at(0, 0.0, 10), components=(0,)),
            nts.Clamp(at(1, 0.0, 10), components=(1,)),
            nts.Dirichlet(ends[0], components=(2,)),
        ],
        forces=[
            # A plane of symmetry halves it.
            nts.PointForce(ends[0], (force / 2, 0, 0)),
            nts.PointForce(ends[1], (0, -force / 2, 0)),
        ],
    )  # fmt: skip


@pytest.mark.slow
def test_the_pinched_hemisphere():
    """Sze, Liu, Lo, Finite Elem. Anal. Des. 40 (2004): 4.067 outwards, 8.178 inwards at P = 400."""
    body = hemisphere(24, 400.0)
    run = nts.equilibrium(nts.System([body]), load_steps=10)
    start, now = body.midsurface()
    out, into = (start[:, k].argmax() for k in (0, 1))
    assert run.status == "completed"
    assert now[out, 0] - start[out, 0] == pytest.approx(4.067, rel=0.02)
    assert start[into, 1] - now[into, 1] == pytest.approx(8.178, rel=0.02)


@pytest.mark.mpi
def test_weight_on_a_hinged_plate():
    """All of it on the edges, which hold places and leave directors free: 5/384 q L^4 / EI."""
    held = [
        nts.Dirichlet(lambda x: (x[0] < 1e-9) & (x[1] < 1e-9)),
        nts.Dirichlet(lambda x: (x[0] < 1e-9) & (x[1] > 2 - 1e-9), components=(0, 2)),
    ]
    edges = [nts.Dirichlet(at(0, e), components=(2,)) for e in (0.0, 3.0)]
    body = nts.Shell(plate(24, 4, 3.0, 2.0), **RUBBER | {"poisson": 0.0}, bcs=edges + held)
    run = nts.equilibrium(nts.System([body], gravity=(0, 0, -1e-3)))
    weight = 10 * 0.05 * 6 * 1e-3
    total = run.reactions["shell"][-1].sum(axis=0)
    assert run.status == "completed"
    assert total == pytest.approx((0, 0, weight), abs=1e-7 * weight)
    sag = 5 / 384 * weight * 3**3 / (1e5 * 2 * 0.05**3 / 12)
    assert moved(body)[62] == pytest.approx((0, 0, -sag), rel=0.01, abs=0.01 * sag)


def lowest_frequency(n, thickness):
    """Of a square plate on hard simple supports [rad/s], by its matrices at rest."""
    edges = [(k, e) for k in (0, 1) for e in (0.0, 1.0)]
    body = nts.Shell(
        plate(n, n, 1.0, 1.0, MPI.COMM_SELF), young=2e11, poisson=0.3, thickness=thickness,
        density=7800.0,
        bcs=[nts.Dirichlet(at(k, e), components=(2,)) for k, e in edges]
        + [nts.Clamp(at(k, e), components=(1 - k,)) for k, e in edges],
    )  # fmt: skip
    body.begin_step(EM, nts.EvaluationPoint(u0=np.zeros(body.num_owned), time=0.0))
    both = []
    for mass, stiffness in ((0.0, 1.0 / EM.theta), (1.0, 0.0)):
        a = body.tangent(np.zeros(body.num_owned), mass, stiffness)
        both.append(a.getValues(range(body.num_owned), range(body.num_owned)))
    held = np.zeros(body.num_owned, dtype=bool)
    held[body.fixed] = True
    held[5::6] = True  # the director's length
    held[0::6] = held[1::6] = True  # motion in the plane
    k, m = (a[np.ix_(~held, ~held)] for a in both)
    return np.sqrt(scipy.linalg.eigh(k, m, eigvals_only=True, subset_by_index=(0, 0))[0])


@pytest.mark.parametrize("thickness", [0.2, 0.01])
def test_the_first_frequency_of_a_simply_supported_plate(thickness):
    """Mindlin's equations; the error falls by order 2."""
    t, g, k2 = thickness, 2e11 / 2.6, 2 * np.pi**2
    shear, bending = 5 / 6 * g * t, 2e11 * t**3 / (12 * (1 - 0.3**2))
    mass, inertia = 7800 * t, 7800 * t**3 / 12
    # (shear k2 - mass w2) (bending k2 + shear - inertia w2) = shear^2 k2
    b = -(shear * k2 * inertia + mass * (bending * k2 + shear))
    exact = np.sqrt(np.roots([mass * inertia, b, shear * bending * k2**2]).min())
    coarse, fine = (lowest_frequency(n, t) / exact - 1 for n in (6, 12))
    assert abs(fine) < 0.01
    assert coarse / fine == pytest.approx(4, rel=0.1)


def test_moments_at_a_node_of_a_beam_and_of_a_shell():
    """A slender cantilever turns by M L / EI, whichever body it is."""
    line = np.column_stack([np.linspace(0, 1, 9), np.zeros(9), np.zeros(9)])
    mesh = surface_mesh(line, np.column_stack([np.arange(8), np.arange(1, 9)]), kind="interval")
    section = nts.Rectangle(1.0, 0.01).section(young=12e6, poisson=0.0, density=1.0)
    clamp, moment = nts.Clamp(at(0, 0.0)), (0, -0.1, 0)
    beam = nts.Beam(mesh, section, bcs=[clamp], forces=[nts.PointMoment(at(0, 1.0), moment)],
                    direction=(0, 1, 0))  # fmt: skip
    half = nts.LineMoment(moment, where=at(0, 1.0))
    shell = nts.Shell(plate(8, 1, 1.0, 1.0), young=12e6, poisson=0.0, thickness=0.01, density=1.0,
                      bcs=[clamp], forces=[half])  # fmt: skip
    nts.equilibrium(nts.System([beam, shell]), load_steps=2)
    turn = 0.1 / (12e6 * 0.01**3 / 12)
    expected = (np.sin(turn) / turn - 1, 0, (1 - np.cos(turn)) / turn)
    assert moved(shell)[-1] == pytest.approx(expected, abs=5e-5)
    start, now = beam.centreline()
    assert now[-1] - start[-1] == pytest.approx(expected, abs=5e-5)


# ---- dynamics
def flying(scale=1.0, comm=MPI.COMM_WORLD, n=(8, 4)):
    """B30 in a unit of length 1/scale m."""
    s = scale
    x = s * (plate_nodes(*n, 4.0, 2.0) - np.array([2.0, 1.0, 0.0]))
    return nts.Shell(
        surface_mesh(x, grid(*n), comm), young=1e5 / s, poisson=0.3, thickness=0.05 * s,
        density=10 / s**3, angular_velocity=(0.5, 1, 2),
        velocity=lambda x: np.array([0, 0, -s])[:, None] * np.sin(np.pi * x[0] / (4 * s)),
    )  # fmt: skip


def fly(rule, dt, t_end, newton=None, **options):
    body = flying(**options)
    run = nts.simulate(
        nts.System([body]), rule, dt=dt, t_end=t_end, newton=newton or nts.Newton(rtol=1e-13)
    )
    return run, body.midsurface()[1]


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_many_shells_take_a_krylov_solver_in_dynamics():
    """Their constraints are few; it gives the motion that MUMPS gives, with kept matrices, too."""
    few, many = (nts.System([flying(n=n)]) for n in ((8, 4), (20, 16)))
    both = [(s, inertia) for s in (few, many) for inertia in (False, True)]
    chosen = [nts.Newton().preset(s, inertia, {}) for s, inertia in both]
    assert chosen == ["direct", "direct", "direct", "krylov"]
    found = []
    for solver, reuse in (("auto", None), ("direct", False)):
        run, x = fly(EM, 0.02, 0.04, nts.Newton(linear_solver=solver, reuse=reuse), n=(20, 16))
        assert run.status == "completed" and max(off(run)) < 1e-12
        found.append(x)
    krylov, direct = found
    assert krylov == pytest.approx(direct, abs=1e-11)


def off(run):
    """Errors of E and J over their size."""
    energy, spin = run.balance["energy"], run.balance["angular_momentum"]
    return (
        np.abs(energy / energy[0] - 1).max(),
        np.abs(spin - spin[0]).max() / np.linalg.norm(spin[0]),
    )


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["shell", "beam"])
@pytest.mark.fast_on_ranks()
def test_one_cell_on_any_ranks(kind):
    """Ranks without a cell take part; free fall of a spinning body keeps the energy."""
    options = {"angular_velocity": (1, 2, 3)}
    if kind == "shell":
        body = nts.Shell(plate(1, 1, 1.0, 1.0), **RUBBER, **options)
        expected = 0.5 * 0.5 * (1 * (1 + 0.05**2) + 4 * (1 + 0.05**2) + 9 * 2) / 12
    else:
        section = nts.Rectangle(0.1, 0.1).section(young=1e5, poisson=0.3, density=10.0)
        mesh = surface_mesh([[0, 0, 0], [1, 0, 0]], [[0, 1]], kind="interval")
        body = nts.Beam(mesh, section, **options)
        expected = 0.5 * 0.1 * (1 * 0.02 + (4 + 9) * 1.01) / 12
    run = nts.simulate(nts.System([body], gravity=(0, 0, -1)), EM, dt=0.05, t_end=0.15)
    assert run.status == "completed" and len(run.balance["time"]) == 4
    energy = run.balance["energy"] - run.balance["external_work"]
    assert energy == pytest.approx(expected, rel=1e-12)
    assert set(body.resultants()) == {"force", "moment"}


# ---- joints
@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_plate_on_joints_swings():
    """Two spherical joints at a corner each are a hinge: energy is kept in gravity."""
    body = nts.Shell(plate(4, 2, 4.0, 2.0), **RUBBER)
    joints = [nts.Spherical(body, None, point=(0, y, 0), name=f"hinge {y}") for y in (0, 2)]
    system = nts.System([body], joints=joints, gravity=(0, 0, -1))
    run = nts.simulate(system, EM, dt=0.05, t_end=0.5)
    assert run.status == "completed"
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * run.balance["kinetic"].max()
    assert moved(body)[-1, 2] < -0.1


def test_directions_of_a_shell_are_its_directors():
    body = nts.Shell(plate(4, 2, 4.0, 2.0), **RUBBER)
    with pytest.raises(ValueError, match="only its director .* turns with it; hold it by Spher"):
        nts.Fixed(body, None, point=(0, 0, 0))
    with pytest.raises(ValueError, match="is no node of shell 'shell'; the nearest one is"):
        nts.Spherical(body, None, point=(0.1, 0, 0))


# ---- bad input
def box():
    return create_box(MPI.COMM_WORLD, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)


def triangles():
    return surface_mesh(plate_nodes(1, 1, 1, 1), [[0, 1, 2], [1, 2, 3]], kind="triangle")


def joined(angle):
    """Two cells at an angle [degrees]."""
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    x = [[-1, 0, 0], [-1, 1, 0], [0, 0, 0], [0, 1, 0], [c, 0, s], [c, 1, s]]
    return surface_mesh(x, grid(2, 1))


def t_junction():
    x = [[-1, 0, 0], [-1, 1, 0], [0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 0, 1], [0, 1, 1]]
    return surface_mesh(x, [[0, 2, 1, 3], [2, 4, 3, 5], [2, 6, 3, 7]])


def corner_to_corner():
    """Two cells that share a node alone."""
    x = [[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [1, 2, 0], [2, 1, 0], [2, 2, 0]]
    return surface_mesh(x, [[0, 2, 1, 3], [3, 4, 5, 6]])


def tip(height):
    """Eight cells around the tip of a cone."""
    a = np.arange(16) * np.pi / 8
    r = np.where(np.arange(16) % 2, 1.2, 1.0)
    x = np.column_stack([r * np.cos(a), r * np.sin(a), -height * r])
    k = 2 * np.arange(8)
    cells = np.stack([0 * k, 1 + k, 1 + (k + 2) % 16, 2 + k], axis=-1)
    return surface_mesh(np.concatenate([np.zeros((1, 3)), x]), cells)


@pytest.mark.mpi
def test_the_tip_of_a_cone():
    """Of a flat one: no other direction than its axis turns with it."""
    body = nts.Shell(tip(0.5), **RUBBER)
    axis, across = np.array([0, 0, 1.0]), np.array([1e-3, 0, 1.0])
    assert body.directions_at(axis, (0, 0, 0)).body is body
    with pytest.raises(ValueError, match="only its director"):
        body.directions_at(across, (0, 0, 0))


def moebius():
    """A band of twelve cells that turns by half a turn."""
    a = np.linspace(0, 2 * np.pi, 13)[:-1]
    out = np.stack([np.cos(a), np.sin(a), 0 * a], axis=-1)
    way = np.cos(a / 2)[:, None] * out + np.sin(a / 2)[:, None] * np.array([0, 0, 1])
    x = np.concatenate([3 * out - 0.3 * way, 3 * out + 0.3 * way])
    k = np.arange(12)
    far = np.roll(k, -1)
    cells = np.stack([k, far, k + 12, far + 12], axis=-1)
    cells[-1] = [11, 12, 23, 0]
    return surface_mesh(x, cells)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("given", "kind", "text"),
    [
        ({"mesh": lambda: "plate"}, TypeError, "pass a dolfinx mesh"),
        ({"mesh": box}, ValueError, "hexahedron in 3D; pass quadrilaterals"),
        ({"mesh": lambda: surface_mesh(plate_nodes(2, 1, 1, 1)[:, :2], grid(2, 1))}, ValueError,
         "quadrilateral in 2D"),
        ({"mesh": triangles}, ValueError, "triangle cells would lock; .*Mesh.RecombineAll = 1"),
        ({"mesh": lambda: surface_mesh(plate_nodes(2, 1, 0, 1), grid(2, 1))}, ValueError,
         "2 cells are flat, concave or twisted"),
        ({"mesh": lambda: joined(70)}, ValueError, "folds by 70 degrees at x=.*and join .*Seam"),
        ({"mesh": t_junction}, ValueError, "(3 cells meet in an edge|folds by 90 degrees).*Seam"),
        ({"mesh": moebius}, ValueError, "one side alone"),
        ({"mesh": corner_to_corner}, ValueError,
         r"cells share the node at x=\[(1.0|0.9{12}\d*), .*, but no edge there; make a shell of"),
        ({"mesh": lambda: tip(4.0)}, ValueError, "cells at the node at x=.* look in different dir"),
        ({"young": 0.0}, ValueError, "^young=0.0: must be positive"),
        ({"poisson": 0.6}, ValueError, "^poisson=0.6: must lie above"),
        ({"thickness": -1}, ValueError, "^thickness=-1: must be positive"),
        ({"density": np.inf}, ValueError, "^density=inf"),
        ({"bcs": [3]}, TypeError, r"bcs\[0\]=3: pass a sequence of Clamp or Dirichlet"),
        ({"bcs": [nts.Clamp(lambda x: x[0] > 7)]}, ValueError, "selects no node between"),
        ({"bcs": [nts.Clamp("root")]}, TypeError, "pass a function"),
        ({"bcs": [nts.Dirichlet(at(0, 0.0), lambda x, t: 0 * x)]}, ValueError,
         r"^Dirichlet.value of bcs\[0\] of 'shell': no function of place.*; pass a vector, or"),
        ({"forces": [nts.PointForce(lambda x: x[0] > 0.9, (1, 0, 0))]}, ValueError,
         "selects 2 nodes; select one"),
        ({"forces": [nts.LineForce((1, 0, 0), lambda x: x[0] + x[1] > 1.9)]}, ValueError,
         "selects no two neighbours; select both ends"),
        ({"forces": [nts.LineMoment(1.0)]}, ValueError, "three finite"),
        ({"forces": ["push"]}, TypeError, "PointForce, PointMoment, LineForce or LineMoment"),
        ({"velocity": "fast"}, ValueError, "velocity='fast'"),
        ({"spin": 1}, TypeError, "unknown option of Shell"),
    ],
)  # fmt: skip
def test_bad_input_is_told(given, kind, text):
    options = {"mesh": lambda: plate(4, 1, 1.0, 1.0)} | RUBBER | given
    mesh = options.pop("mesh")()
    with pytest.raises(kind, match=text):
        nts.Shell(mesh, **options)


def test_supports_of_a_shell_take_no_functions_of_dolfinx():
    mesh = plate(1, 1, 1.0, 1.0)
    for value in (fem.Constant(mesh, (0.0,) * 3), fem.Function(compat.vector_space(mesh, 1))):
        with pytest.raises(ValueError, match="no function of place, Constant or Function for a sh"):
            nts.Shell(mesh, **RUBBER, bcs=[nts.Dirichlet(at(0, 0.0), value)])


def test_components_of_clamps():
    with pytest.raises(ValueError, match=r"^components=\(3,\): pass a tuple of some of 0, 1, 2"):
        nts.Clamp(at(0, 0.0), components=(3,))
    line = np.column_stack([np.linspace(0, 1, 3), np.zeros(3), np.zeros(3)])
    mesh = surface_mesh(line, [[0, 1], [1, 2]], kind="interval")
    section = nts.Circle(0.1).section(young=1.0, poisson=0.0, density=1.0)
    with pytest.raises(ValueError, match="three directors of a beam are held as a whole"):
        nts.Beam(mesh, section, bcs=[nts.Clamp(at(0, 0.0), components=(0,))])


# ---- results
@pytest.mark.mpi
def test_stress_resultants_of_a_beam_and_of_a_shell():
    """Of cantilevers with a small force at the end: constant shear, a moment that grows."""
    clamp, load = nts.Clamp(at(0, 0.0)), (0, 0, 1e-4)
    line = np.column_stack([np.linspace(0, 1, 9), np.zeros(9), np.zeros(9)])
    mesh = surface_mesh(line, np.column_stack([np.arange(8), np.arange(1, 9)]), kind="interval")
    section = nts.Rectangle(1.0, 0.1).section(young=1e6, poisson=0.0, density=1.0)
    beam = nts.Beam(mesh, section, bcs=[clamp], direction=(0, 1, 0),
                    forces=[nts.PointForce(at(0, 1.0), load)])  # fmt: skip
    plate_ = nts.Shell(plate(8, 1, 1.0, 1.0), young=1e6, poisson=0.0, thickness=0.1, density=1.0,
                       bcs=[clamp], forces=[nts.LineForce(load, where=at(0, 1.0))])  # fmt: skip
    nts.equilibrium(nts.System([beam, plate_]))
    for body, shape in ((beam, (3,)), (plate_, (3, 3))):
        found = body.resultants()
        own = body.mesh.topology.index_map(body.mesh.topology.dim).size_local
        force, moment = (
            found[name].x.array.reshape(-1, *shape)[
                compat.cell_dofs(found[name].function_space)[:own, 0]
            ]
            for name in ("force", "moment")
        )
        dofs = body.mesh.geometry.x[compat.geometry_dofmap(body.mesh)[:own]]
        arm = 1.0 - dofs[:, :, 0].mean(axis=1)
        if shape == (3,):
            assert force[:, 2] == pytest.approx(1e-4, rel=1e-4)
            assert moment[:, 1] == pytest.approx(-1e-4 * arm, rel=1e-4)
        else:
            assert force[:, 0, 2] == pytest.approx(1e-4, rel=1e-4)
            assert np.abs(moment[:, 0, 0]) == pytest.approx(1e-4 * arm, rel=1e-4)
            assert np.abs(moment[:, 1]).max(initial=0.0) < 1e-9


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_picture_of_skins(mpi_tmp_path):
    line = np.column_stack([np.linspace(0, 1, 9), np.zeros(9), np.zeros(9) + 0.1])
    mesh = surface_mesh(line, np.column_stack([np.arange(8), np.arange(1, 9)]), kind="interval")
    beam = nts.Beam(mesh, nts.Circle(0.03).section(young=1.0, poisson=0.0, density=1.0))
    body = nts.Shell(plate(4, 4, 1.0, 1.0), **RUBBER)
    file = mpi_tmp_path / "thin.png"
    picture([beam, body], file)
    assert file.stat().st_size > 5000
    with pytest.raises(ValueError, match=r"none of \['shell'\] has a material; colour by 'speed'"):
        picture([body], file, colour="stress")
    bare = nts.Section(EA=1, GA=(1, 1), GJ=1, EI=(1, 1), rhoA=1, rhoI=(1, 1))
    picture([nts.Beam(mesh, bare)], file, view=(0.0, -90.0))  # its axis alone


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_shell_at_rest_sleeps():
    """With the constraints that hold its directors; the scene moves alike."""
    ends = []
    for sleep in (False, True):
        body, other = flying(n=(4, 2)), nts.Shell(plate(2, 2, 1.0, 1.0), **RUBBER, name="still")
        stepper = nts.Stepper(nts.System([body, other]), EM, sleep=sleep)
        for _ in range(4):
            stepper.advance(0.05)
            assert stepper.problem.awake == ((0,) if sleep else (0, 1))
        stepper.close()
        ends.append(body.midsurface()[1])
        assert moved(other) == pytest.approx(0.0, abs=1e-14)
    assert ends[1] == pytest.approx(ends[0], abs=1e-10)
