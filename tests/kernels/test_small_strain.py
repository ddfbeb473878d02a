"""Energies, stresses and ledgers at strains far below 1e-8, where a W(C) holds only rounding."""

from decimal import Decimal, localcontext

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, GhostMode, create_box, create_unit_cube
from integrators import MID_STEP
from pairs import pairs
from scenes import RUBBER
from ufl.algorithms.apply_derivatives import apply_derivatives

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.forms import assemble_vector, compile_forms
from dolfinx_nts.kernels import precise
from dolfinx_nts.kernels.strain_energy import strain_energy

COMM = MPI.COMM_WORLD
YOUNG, POISSON, STEEPNESS = 1000.0, 0.3, 50.0
MU, LAM = YOUNG / 2.6, YOUNG * POISSON / (1.3 * 0.4)
A, B, C = 120.0, 70.0, 900.0
C10, C20, C30, STRETCH, BULK = 180.0, -30.0, 8.0, 2.5, 2000.0


class Fung(nts.Isotropic):
    """Rubber that stiffens exponentially, written as `materials` tells."""

    def of_invariants(self, i1, i2, i3):
        d = i1 + i2 + i3
        stretch = precise.expm1_remainder(STEEPNESS * i1) / STEEPNESS
        deviator = stretch + precise.log1p_remainder(d) - i2 - i3
        return MU / 2 * deviator + LAM / 8 * precise.log1p(d) ** 2


MATERIALS = {
    "stvk": nts.StVenantKirchhoff(YOUNG, POISSON),
    "neo-hooke": nts.NeoHookean(YOUNG, POISSON),
    "mooney-rivlin": nts.MooneyRivlin(A, B, C),
    "fung": Fung(),
    "yeoh": nts.Yeoh(C10, C20, C30, BULK),
    "arruda-boyce": nts.ArrudaBoyce(MU, STRETCH, BULK),
    # Powers 2 and -2 of C, which decimals know without its principal values.
    "ogden": nts.Ogden(mu=(40.0, -90.0), alpha=(4.0, -4.0), bulk=BULK),
}
#: Their part of the first and second invariant of J^(-2/3) C.
ISOCHORIC = {
    "yeoh": lambda i, _: sum(Decimal(c) * (i - 3) ** k for k, c in enumerate((C10, C20, C30), 1)),
    "arruda-boyce": lambda i, _: sum(
        Decimal(MU) * n / d / Decimal(STRETCH) ** (2 * k - 2) * (i**k - 3**k)
        for k, (n, d) in enumerate(((1, 2), (1, 20), (11, 1050), (19, 7000), (519, 673750)), 1)
    ),
    "ogden": lambda i, j: Decimal(10) * (i**2 - 2 * j - 3) + Decimal(22.5) * (j**2 - 2 * i - 3),
}
SIZES = [0.2, 1e-2, 3e-3, 1e-4, 3e-5, 1e-6, 1e-9, 1e-12]


def energy(name, e):
    """W at a strain of decimals, from the textbook's W(C)."""
    mu, lam, a, b, k, steepness = (Decimal(x) for x in (MU, LAM, A, B, C, STEEPNESS))
    c = [[(i == j) + 2 * e[i][j] for j in range(3)] for i in range(3)]
    trace = sum(c[i][i] for i in range(3))
    square = sum(c[i][j] * c[j][i] for i in range(3) for j in range(3))
    det = sum(
        c[0][i] * (c[1][(i + 1) % 3] * c[2][(i + 2) % 3] - c[1][(i + 2) % 3] * c[2][(i + 1) % 3])
        for i in range(3)
    )
    if name == "stvk":
        squares = sum(x * x for row in e for x in row)
        return lam / 2 * sum(e[i][i] for i in range(3)) ** 2 + mu * squares
    if name == "mooney-rivlin":
        second = (trace**2 - square) / 2
        volumetric = k / 2 * (det.sqrt() - 1) ** 2 - (a + 2 * b) * det.ln()
        return a * (trace - 3) + b * (second - 3) + volumetric
    if name in ISOCHORIC:
        shrunk = det ** (-Decimal(1) / 3)
        volumetric = Decimal(BULK) / 4 * (det - 1 - det.ln())
        return ISOCHORIC[name](shrunk * trace, shrunk**2 * (trace**2 - square) / 2) + volumetric
    linear = trace - 3
    if name == "fung":
        linear = ((steepness * linear).exp() - 1) / steepness
    return mu / 2 * (linear - det.ln()) + lam / 8 * det.ln() ** 2


def by_decimals(name, e):
    """W and dW/dE at the doubles of a strain, by differences of 80-digit numbers."""
    with localcontext() as context:
        context.prec = 80
        e = [[Decimal(float(x)) for x in row] for row in e]
        step, stress = Decimal(10) ** -30, np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                ends = []
                for sign in (1, -1):
                    moved = [list(row) for row in e]
                    moved[i][j] += sign * step / 2
                    moved[j][i] += sign * step / 2
                    ends.append(energy(name, moved))
                stress[i, j] = float((ends[0] - ends[1]) / (2 * step))
        return float(energy(name, e)), stress


def strain(size, seed=1):
    e = np.random.default_rng(seed).uniform(-1, 1, (3, 3))
    return 0.5 * size * (e + e.T)


class Point:
    """W and dW/dE of a material at a strain, compiled as in a body."""

    def __init__(self, material):
        mesh = create_unit_cube(MPI.COMM_SELF, 1, 1, 1, CellType.hexahedron)
        self.e = fem.Constant(mesh, np.zeros((3, 3)))
        w, dx = strain_energy(material), ufl.Measure("dx", mesh, metadata={"quadrature_degree": 1})
        space = compat.function_space(mesh, "DG", 0, (3, 3))
        stress = ufl.inner(w.stress(self.e), ufl.TestFunction(space)) * dx
        self.energy, self.stress = compile_forms([w(self.e) * dx, stress])
        self.vector = petsc_compat.create_vector(space)

    def __call__(self, e):
        self.e.value[:] = e
        assemble_vector(self.vector, self.stress)
        return self.energy.value(), self.vector.array_r.reshape(3, 3).copy()


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.fast("mooney-rivlin", "fung")
def test_energy_and_stress_keep_their_digits(name):
    point = Point(MATERIALS[name])
    for size in SIZES:
        for e in (strain(size), size * np.eye(3), np.diag([size, -size / 2, -size / 2])):
            found, stress = point(e)
            expected, slope = by_decimals(name, e)
            # Above `precise`'s series a difference costs three digits.
            assert abs(found - expected) < 4e-12 * expected, size
            assert np.abs(stress - slope).max() < 4e-12 * np.abs(slope).max(), size


@pytest.mark.parametrize("name", ["log1p", "log1p_remainder", "expm1", "expm1_remainder"])
def test_precise_functions_and_their_derivatives(name):
    for x in [s * 10.0**-k for k in range(0, 18) for s in (-0.7, 0.3, 0.999, 2.5)]:
        if name.startswith("log") and x <= -1:
            continue
        v = ufl.variable(ufl.as_ufl(x))
        f = getattr(precise, name)(v)
        found = [f, ufl.diff(f, v), ufl.diff(ufl.diff(f, v), v)]
        with localcontext() as context:
            context.prec = 60
            d = Decimal(x)
            if name.startswith("log"):
                log, one = (1 + d).ln(), 1 / (1 + d)
                exact = {
                    "log1p": (log, one, -one * one),
                    "log1p_remainder": (d - log, d * one, one * one),
                }
            else:
                power = d.exp()
                exact = {
                    "expm1": (power - 1, power, power),
                    "expm1_remainder": (power - 1 - d, power - 1, power),
                }
        for order, (a, b) in enumerate(zip(found, exact[name], strict=True)):
            value = apply_derivatives(a)(())
            tolerance = 4e-12 if "remainder" in name else 1e-15
            assert abs(value - float(b)) <= tolerance * abs(float(b)), (x, order)


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.fast("stvk", "neo-hooke")
def test_ledger_of_a_body_that_hardly_moves(name):
    """A ringing cube at 1e-6 m/s: its strains are of size 1e-8, its energy 1e-15 of its modulus."""
    mesh = create_unit_cube(MPI.COMM_SELF, 2, 1, 1, CellType.hexahedron)
    body = nts.Continuum(
        mesh, MATERIALS[name], density=1.0, velocity=lambda x: 1e-6 * np.sin(3 * x[[1, 2, 0]])
    )
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=5e-3, t_end=0.2)
    table = run.balance
    assert run.status == "completed" and table["potential"].max() > 0.1 * table["energy"][0]
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * table["energy"][0]


@pytest.mark.parametrize("dt", [1e-4, 1e-5])
@pytest.mark.fast("0.0001")
def test_floor_of_short_steps_is_rounding(dt):
    """Where forces are rounded like displacements, not like positions, the ledger stays closed."""
    mesh = create_unit_cube(MPI.COMM_SELF, 2, 1, 1, CellType.hexahedron)
    body = nts.Continuum(
        mesh, MATERIALS["neo-hooke"], density=1.0, velocity=lambda x: 0.3 * np.sin(3 * x[[1, 2, 0]])
    )
    newton = nts.Newton(rtol=1e-15)
    system = nts.System([body])
    table = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=60 * dt, newton=newton).balance
    assert np.abs(table["ledger_residual"]).max() < 5e-13 * table["energy"][0]


def impact(speed, gap, away=0.0, material=RUBBER):
    """A cube flies squarely into another one, which lies `away` from the origin in x, y and z."""
    low = np.full(3, away)
    near = 1e-3 * min(1.0, gap) + 4e-16 * away
    box = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
    corners = [low, low + 1], [low + [1 + gap, -0.1, -0.1], low + [2 + gap, 1.1, 1.1]]
    left, right = (
        nts.Continuum(
            create_box(COMM, ends, [n] * 3, **box),
            material,
            density=1e3,
            velocity=velocity,
            name=name,
        )
        for ends, n, velocity, name in zip(
            corners, (2, 1), ((speed, 0, 0), (0, 0, 0)), ("left", "right"), strict=True
        )
    )
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > away + 1 - near),
        master=right.surface(lambda x: x[0] < away + 1 + gap + near),
    )
    system = nts.System([left, right], contacts=[pair])
    table = nts.simulate(system, nts.EnergyMomentum(), dt=4e-3, t_end=0.12).balance
    assert table["active"].max() == 9
    return np.abs(table["ledger_residual"]).max() / table["energy"][0]


@pytest.mark.mpi
@pytest.mark.parametrize("speed", [1e-3, 1e-6, 1e-9])
@pytest.mark.fast("1e-09")
@pytest.mark.fast_on_ranks()
def test_ledger_of_a_slow_impact(speed):
    """The cubes' gap and strains scale with their speed: 1e-6 m/s leaves strains of 1e-8."""
    assert impact(speed, 0.02 * speed) < 1e-11


@pytest.mark.mpi
@pytest.mark.parametrize("away", [1e6, 1e10])
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("1000000.0")
def test_ledger_far_from_the_origin(away):
    """What the mesh's own rounding leaves of the cubes is as exact as at the origin."""
    assert impact(2.0, 0.05, away) < 1e-11


@pytest.mark.slow
@pytest.mark.mpi
def test_ledger_of_an_energy_of_c_far_from_the_origin():
    """Nor does its floor grow with the distance: the same energy as a function of C."""
    assert impact(2.0, 0.05, 1e10, lambda c: RUBBER(c)) < 1e-11


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize(
    ("meshed", "integrator", "accuracy"), pairs([False, True], MID_STEP, ["exact", "balanced"])
)
def test_ledger_of_a_cube_that_hardly_weighs(meshed, integrator, accuracy):
    """At 1e-6 g a cube of rubber sinks by 1e-8 of its edge: energies of 1e-10 J of 1e6 Pa."""
    box = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
    gap = 1e-9
    mesh = create_box(COMM, [[0, 0, gap], [1, 1, 1 + gap]], [2] * 3, **box)
    cube = nts.Continuum(mesh, RUBBER, density=1e3, name="cube")
    bodies, master = [cube], nts.Plane((0, 0, 0), (0, 0, 1))
    if meshed:
        held = nts.Dirichlet(lambda x: x[2] < -0.5 + 1e-9)
        mesh = create_box(COMM, [[-1, -1, -0.5], [2, 2, 0]], [3, 3, 1], **box)
        floor = nts.Continuum(mesh, RUBBER, density=1e3, name="floor", bcs=[held])
        bodies, master = [cube, floor], floor.surface(lambda x: x[2] > -1e-9)
    pair = nts.ContactPair(cube.surface(lambda x: x[2] < gap * 1.5), master)
    system = nts.System(bodies, contacts=[pair], gravity=(0, 0, -9.81e-6))
    run = nts.simulate(system, MID_STEP[integrator], dt=2e-3, t_end=0.08, accuracy=accuracy)
    table = run.balance
    assert run.status == "completed" and not run.warnings and table["active"].max() == 9
    # Of the kinetic energy, the smallest of all terms of the ledger.
    assert np.abs(table["ledger_residual"]).max() < 1e-9 * table["kinetic"].max()
