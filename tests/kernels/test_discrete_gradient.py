"""Strain energies against closed forms, and stresses between two strains against exact differences.

UFL is evaluated as users' code is: compiled, on one tetrahedron whose linear functions turn the
virtual work of a constant stress into the stress itself. W is compared with 50-digit arithmetic.
"""

from decimal import Decimal, localcontext

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, create_unit_cube
from integrators import GRADIENTS, MID_STEP
from measures import STENCIL
from rotations import rotation

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.forms import assemble_vector, compile_forms
from dolfinx_nts.kernels import discrete_gradient as dg
from dolfinx_nts.kernels.strain_energy import strain_energy

YOUNG, POISSON = 1e6, 0.3
MU, LAM = YOUNG / 2.6, YOUNG * POISSON / (1.3 * 0.4)
A, B, C = 1.5e5, 4e4, 6e5
MATERIALS = {
    "stvk": nts.StVenantKirchhoff(YOUNG, POISSON),
    "neo-hooke": nts.NeoHookean(YOUNG, POISSON),
    "mooney-rivlin": nts.MooneyRivlin(A, B, C),
}
#: Exponents b of energies that stiffen exponentially.
STEEP = {"exp-30": 30, "exp-100": 100, "exp-1000": 1000}


def steep(b):
    """The neo-Hookean energy with mu/2 (exp(b (tr C - 3)) - 1)/b in place of its linear term."""

    def energy(c):
        volume = ufl.ln(ufl.det(c))
        stretch = (ufl.exp(b * (ufl.tr(c) - 3)) - 1) / b
        return MU / 2 * (stretch - volume) + LAM / 8 * volume**2

    return energy


#: Lame parameters at small strain, (mu, lambda).
LAME = {"stvk": (MU, LAM), "neo-hooke": (MU, LAM), "mooney-rivlin": (2 * (A + B), C + 4 * B)}
EYE = np.eye(3)
RULES = MID_STEP | {"mean-value stress": GRADIENTS["mean-value stress"]}


def one_tetrahedron():
    x = np.vstack([np.zeros(3), EYE])
    return compat.create_mesh(MPI.COMM_SELF, [[0, 1, 2, 3]], x, "tetrahedron")


def unit_nodes(x):
    """The nodes at e_1, e_2, e_3; rounding may have moved them."""
    return [int(np.linalg.norm(x - e, axis=1).argmin()) for e in EYE]


class Point:
    """W and a stress at a point, for given strains (C - 1)/2."""

    def __init__(self, material, stress, *parameters):
        """A material, or a function of parameters that makes one: Constants share a form."""
        mesh = one_tetrahedron()
        if parameters:
            material = material(*(fem.Constant(mesh, float(p)) for p in parameters))
        space = compat.vector_space(mesh, 1)
        energy = strain_energy(material)
        self.e0, self.e1 = (fem.Constant(mesh, np.zeros((3, 3))) for _ in range(2))
        dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 0})
        w = ufl.TestFunction(space)
        work = ufl.inner(stress(energy, self.e0, self.e1), ufl.grad(w)) * dx
        self.work, self.energy = compile_forms([work, energy(self.e1) * dx])
        self.nodes = unit_nodes(space.tabulate_dof_coordinates())
        self.vector = petsc_compat.create_vector(space)

    def stress(self, c0, c1):
        return self.stress_between((c0 - EYE) / 2, (c1 - EYE) / 2)

    def stress_between(self, e0, e1):
        self.e0.value[:], self.e1.value[:] = e0, e1
        assemble_vector(self.vector, self.work)
        # grad N of the node at e_k is e_k, the volume is 1/6.
        return 6.0 * self.vector.array_r.reshape(-1, 3)[self.nodes].T

    def stored(self, c):
        return self.stored_at((c - EYE) / 2)

    def stored_at(self, e):
        self.e1.value[:] = e
        return 6.0 * self.energy.value()


_POINTS = {}


def point(name, rule="gonzalez", quadrature=3):
    key = name, rule, quadrature
    if key not in _POINTS:
        stress = {
            "gonzalez": dg.gonzalez_stress,
            "mean-value": lambda w, a, b: dg.mean_value_stress(w, a, b, quadrature),
            "derivative": lambda w, a, b: w.stress(b),
        }[rule]
        material = (steep, stress, STEEP[name]) if name in STEEP else (MATERIALS[name], stress)
        _POINTS[key] = Point(*material)
    return _POINTS[key]


def exact_energy(name, c):
    """W(C) of the doubles in C to 50 digits."""
    c = [[Decimal(float(x)) for x in row] for row in c]
    mu, lam = (Decimal(x) for x in (MU, LAM))
    trace = sum(c[i][i] for i in range(3))
    square = sum(c[i][j] * c[j][i] for i in range(3) for j in range(3))
    if name == "stvk":
        strain = [[(c[i][j] - (i == j)) / 2 for j in range(3)] for i in range(3)]
        norm = sum(x * x for row in strain for x in row)
        return lam / 2 * ((trace - 3) / 2) ** 2 + mu * norm
    det = sum(
        c[0][i] * (c[1][(i + 1) % 3] * c[2][(i + 2) % 3] - c[1][(i + 2) % 3] * c[2][(i + 1) % 3])
        for i in range(3)
    )
    if name in STEEP:
        stretch = ((STEEP[name] * (trace - 3)).exp() - 1) / STEEP[name]
        return mu / 2 * (stretch - det.ln()) + lam / 8 * det.ln() ** 2
    if name == "neo-hooke":
        return mu / 2 * (trace - 3 - det.ln()) + lam / 8 * det.ln() ** 2
    a, b, k = (Decimal(x) for x in (A, B, C))
    second = (trace**2 - square) / 2
    volumetric = k / 2 * (det.sqrt() - 1) ** 2 - 2 * (a + 2 * b) * det.sqrt().ln()
    return a * (trace - 3) + b * (second - 3) + volumetric


def closed_stress(name, c):
    """2 dW/dC."""
    inverse, j = np.linalg.inv(c), np.sqrt(np.linalg.det(c))
    if name == "stvk":
        return LAM * 0.5 * np.trace(c - EYE) * EYE + MU * (c - EYE)
    if name == "neo-hooke":
        return MU * (EYE - inverse) + LAM * np.log(j) * inverse
    volumetric = (C * (j - 1) * j - 2 * (A + 2 * B)) * inverse
    return 2 * A * EYE + 2 * B * (np.trace(c) * EYE - c) + volumetric


def random_strain(rng, size):
    f = EYE + size * rng.uniform(-1, 1, (3, 3))
    return f.T @ f


def random_increment(rng):
    d = rng.uniform(-1, 1, (3, 3))
    d = d + d.T
    return d / np.linalg.norm(d)


def directionality_error(name, rule, c0, c1, quadrature=3):
    """|S/2 : DC - (W(C_1) - W(C_0))| over |S| |DC| / 2, in 50 digits; and S."""
    s = point(name, rule, quadrature).stress(c0, c1)
    with localcontext() as context:
        context.prec = 50
        work = sum(
            Decimal(float(s[i, j])) * (Decimal(float(c1[i, j])) - Decimal(float(c0[i, j]))) / 2
            for i in range(3)
            for j in range(3)
        )
        defect = float(work - exact_energy(name, c1) + exact_energy(name, c0))
    return abs(defect) / (0.5 * np.linalg.norm(s) * np.linalg.norm(c1 - c0)), s


# ---- materials
@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("stretch", [0.6, 0.9, 1.3, 2.0])
def test_energy_in_uniaxial_strain(name, stretch):
    e, log = (stretch**2 - 1) / 2, np.log(stretch)
    expected = {
        "stvk": (LAM / 2 + MU) * e**2,
        "neo-hooke": MU / 2 * (stretch**2 - 1 - 2 * log) + LAM / 2 * log**2,
        "mooney-rivlin": (A + 2 * B) * (stretch**2 - 1 - 2 * log) + C / 2 * (stretch - 1) ** 2,
    }[name]
    assert np.isclose(point(name).stored(np.diag([stretch**2, 1, 1])), expected, rtol=1e-13)


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("shear", [-0.7, 0.1, 1.5])
def test_energy_in_simple_shear(name, shear):
    f = EYE.copy()
    f[0, 1] = shear
    expected = {
        "stvk": LAM / 8 * shear**4 + MU * (shear**2 / 2 + shear**4 / 4),
        "neo-hooke": MU / 2 * shear**2,
        "mooney-rivlin": (A + B) * shear**2,
    }[name]
    assert np.isclose(point(name).stored(f.T @ f), expected, rtol=2e-13)


@pytest.mark.parametrize("name", MATERIALS)
def test_stress_is_the_derivative_of_the_energy(name):
    rng = np.random.default_rng(1)
    for size in (0.01, 0.2):
        c = random_strain(rng, size)
        expected = closed_stress(name, c)
        found = point(name, "derivative").stress(c, c)
        assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("name", MATERIALS)
def test_moduli_at_small_strain(name):
    mu, lam = LAME[name]
    size = 1e-3
    for i, j in ((0, 0), (1, 1), (0, 1), (1, 2)):
        strain = 0.5 * (np.outer(EYE[i], EYE[j]) + np.outer(EYE[j], EYE[i]))
        slope = 0.0
        for k, weight in STENCIL:
            c = EYE + 2 * k * size * strain
            slope = slope + weight / size * point(name, "derivative").stress(c, c)
        expected = lam * np.trace(strain) * EYE + 2 * mu * strain
        assert np.abs(slope - expected).max() < 1e-8 * (lam + 2 * mu)


@pytest.mark.parametrize(
    "make",
    [
        lambda: nts.NeoHookean(-1.0, 0.3),
        lambda: nts.NeoHookean(float("nan"), 0.3),
        lambda: nts.StVenantKirchhoff(1.0, 0.5),
        lambda: nts.StVenantKirchhoff(1.0, -1.0),
        lambda: nts.MooneyRivlin(1.0, -1.0, 1.0),
        lambda: nts.MooneyRivlin(1.0, 1.0, 0.0),
        lambda: nts.Yeoh(0.0, 1.0, 1.0, 1.0),
        lambda: nts.Yeoh(1.0, 1.0, float("nan"), 1.0),
        lambda: nts.ArrudaBoyce(1.0, 1.0, 1.0),
        lambda: nts.Ogden((1.0,), (-2.0,), 1.0),
    ],
)
def test_impossible_materials_are_refused(make):
    with pytest.raises(ValueError, match="must|pass a finite"):
        make()


def test_terms_of_ogden_that_do_not_fit_are_refused():
    with pytest.raises(TypeError, match="mu=1.0: pass a tuple"):
        nts.Ogden(1.0, (2.0,), 1.0)
    with pytest.raises(ValueError, match="pass as many of each"):
        nts.Ogden((1.0, 2.0), (2.0,), 1.0)
    for exponent in (0, -0.09, 21.0):
        with pytest.raises(ValueError, match=rf"alpha\[1\]={exponent}: pass one from 0.1 to 20"):
            nts.Ogden((1.0, 2.0), (2.0, exponent), 1.0)


# ---- discrete gradients
@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("size", [0.25, 3e-2, 1.03e-2, 0.97e-2, 1e-3, 1e-6, 1e-10, 1e-14])
def test_gonzalez_is_directional(name, size):
    rng = np.random.default_rng(2)
    c0 = random_strain(rng, 0.15)
    c1 = c0 + size * np.linalg.norm(c0) * random_increment(rng)
    error, _ = directionality_error(name, "gonzalez", c0, c1)
    assert error < 1e-13


@pytest.mark.parametrize("name", ["neo-hooke", "mooney-rivlin"])
@pytest.mark.parametrize("low", [9e-3, 3e-3, 1e-3, 4e-4])
def test_gonzalez_is_directional_next_to_collapse(name, low):
    """An increment of 0.7 % takes det F from 0.1 to 0.02: next to it is the logarithm's pole."""
    turn = rotation(0.7, (1, 2, 3))
    c0, c1 = (turn.T @ np.diag([1.1, 0.9, x]) @ turn for x in (1e-2, low))
    assert np.linalg.norm(c1 - c0) < 1e-2 * np.linalg.norm(c0)
    # det C is a difference of terms of size 1.
    assert directionality_error(name, "gonzalez", c0, c1)[0] < 2e-15 / low
    assert directionality_error(name, "gonzalez", c1, c0)[0] < 2e-15 / low


@pytest.mark.parametrize("name", STEEP)
@pytest.mark.parametrize("size", [0.1, 1e-2, 1e-3, 1e-4, 1e-8, 1e-12])
def test_gonzalez_is_directional_for_steep_energies(name, size):
    rng = np.random.default_rng(20)
    c0 = random_strain(rng, 0.01)
    c1 = c0 + size * random_increment(rng)
    error, s = directionality_error(name, "gonzalez", c0, c1)
    work = 0.5 * np.linalg.norm(s) * np.linalg.norm(c1 - c0)
    # The exponent b (tr C - 3) is rounded at b times machine precision, W at that of its terms.
    assert error * work < (1e-14 + 4e-16 * STEEP[name]) * work + 1e-15 * MU


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("size", [1e-7, 1e-10, 1e-15, 0.0])
def test_gonzalez_near_rest_has_no_noise(name, size):
    rng = np.random.default_rng(3)
    c0 = random_strain(rng, 0.15)
    c1 = c0 + size * random_increment(rng)
    found, expected = point(name).stress(c0, c1), closed_stress(name, 0.5 * (c0 + c1))
    # 2 dW(C_m) differs by O(DC^2).
    assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


@pytest.mark.parametrize("name", MATERIALS)
def test_gonzalez_is_symmetric_in_its_ends(name):
    rng = np.random.default_rng(4)
    c0, c1 = random_strain(rng, 0.2), random_strain(rng, 0.2)
    forward, back = point(name).stress(c0, c1), point(name).stress(c1, c0)
    assert np.abs(forward - back).max() < 1e-13 * np.abs(forward).max()
    assert np.abs(forward - forward.T).max() < 1e-14 * np.abs(forward).max()


@pytest.mark.parametrize("points", [1, 2, 3, 7])
@pytest.mark.fast("2")
def test_mean_value_is_exact_for_st_venant_kirchhoff(points):
    rng = np.random.default_rng(5)
    for size in (0.5, 1e-3, 1e-8, 1e-14):
        c0 = random_strain(rng, 0.15)
        c1 = c0 + size * random_increment(rng)
        error, s = directionality_error("stvk", "mean-value", c0, c1, points)
        assert error < 1e-14
        expected = closed_stress("stvk", 0.5 * (c0 + c1))
        assert np.abs(s - expected).max() < 1e-14 * np.abs(expected).max()


@pytest.mark.parametrize("points", [1, 2, 3])
def test_mean_value_converges_for_neo_hooke(points):
    """The error of n Gauss points in W(C_1) - W(C_0) is of order 2 n + 1 in DC."""
    rng = np.random.default_rng(6)
    middle, d = random_strain(rng, 0.1), random_increment(rng)
    errors = []
    for size in (0.4, 0.2, 0.1):
        c0, c1 = middle - 0.5 * size * d, middle + 0.5 * size * d
        error, s = directionality_error("neo-hooke", "mean-value", c0, c1, points)
        errors.append(error * np.linalg.norm(s) * size)
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.abs(rates[-1] - (2 * points + 1)) < 0.1


# ---- bodies
def body_of(material, mesh=None):
    return nts.Continuum(mesh or one_tetrahedron(), material, density=1e3, degree=1)


def deformed(body, f):
    """Displacement of x = F X."""
    return (body.reference.reshape(-1, 3) @ (f - EYE).T).ravel()


def piola(body, integrator, f0, f1):
    """P of a step from F_0 to F_1, read from the forces of one tetrahedron."""
    u0 = deformed(body, f0)
    body.begin_step(integrator, nts.EvaluationPoint(u0, 0.0))
    force = body.internal(deformed(body, f1)).reshape(-1, 3)
    return 6.0 * force[unit_nodes(body.reference.reshape(-1, 3))].T


def test_rigid_rotation_strains_only_the_midpoint_rule():
    """B16: rotation by 0.1 rad in a step."""
    body, turn = body_of(MATERIALS["stvk"]), rotation(0.1)
    middle = 0.5 * (EYE + turn)
    s = np.linalg.solve(middle, piola(body, RULES["midpoint"], EYE, turn))
    strain = (s - LAM / (3 * LAM + 2 * MU) * np.trace(s) * EYE) / (2 * MU)
    spurious = -(np.sin(0.05) ** 2) / 2
    assert np.isclose(spurious, -1.24896e-3, rtol=1e-5)
    assert np.allclose(strain, np.diag([spurious, spurious, 0]), rtol=0, atol=1e-16)
    for name in ("energy-momentum", "mean-value stress"):
        assert np.abs(piola(body, RULES[name], EYE, turn)).max() < 1e-15 * YOUNG


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.fast("stvk")
def test_stress_of_the_integrators(name):
    rng = np.random.default_rng(8)
    body = body_of(MATERIALS[name])
    f0, f1 = (EYE + 0.1 * rng.uniform(-1, 1, (3, 3)) for _ in range(2))
    f1 = rotation(0.3, (1, 2, 3)) @ f1
    fm, c0, c1 = 0.5 * (f0 + f1), f0.T @ f0, f1.T @ f1
    expected = {
        "midpoint": fm @ closed_stress(name, fm.T @ fm),
        "energy-momentum": fm @ point(name).stress(c0, c1),
        "mean-value stress": fm @ point(name, "mean-value").stress(c0, c1),
    }
    for rule, value in expected.items():
        found = piola(body, RULES[rule], f0, f1)
        assert np.abs(found - value).max() < 1e-12 * np.abs(value).max()
        # F P^T symmetric with F = F_m: no moment about the midpoint configuration.
        moment = fm @ found.T
        assert np.abs(moment - moment.T).max() < 1e-13 * np.abs(value).max()


def hexahedron(rng):
    x = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)], dtype=float)
    x += 0.1 * rng.uniform(-1, 1, x.shape)
    return compat.create_mesh(MPI.COMM_SELF, [list(range(8))], x, "hexahedron")


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("size", [0.3, 1e-2, 1e-6, 1e-10])
@pytest.mark.fast("0.3-neo-hooke", "0.01-neo-hooke", "1e-06-neo-hooke", "1e-10-neo-hooke")
def test_internal_work_is_the_change_of_the_potential(name, size):
    """V and its forces share the quadrature points, so this holds on a warped hexahedron too."""
    rng = np.random.default_rng(9)
    body = body_of(MATERIALS[name], hexahedron(rng))
    u0 = 0.1 * rng.uniform(-1, 1, body.num_owned)
    u1 = u0 + size * rng.uniform(-0.3, 0.3, body.num_owned)
    body.begin_step(nts.EnergyMomentum(), nts.EvaluationPoint(u0, 0.0))
    force = body.internal(u1)
    before, after = body.potential(u0), body.potential(u1)
    work = force @ (u1 - u0)
    # W is a difference of terms of the size of Young's modulus.
    noise = 1e-15 * YOUNG + 1e-13 * np.linalg.norm(force) * np.linalg.norm(u1 - u0)
    assert abs(work - (after - before)) < noise


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.fast("neo-hooke-midpoint", "neo-hooke-energy-momentum")
def test_step_from_rest_is_finite_and_exact(name, rule):
    """u_1 = u_0: the forces of the configuration itself, and half its stiffness."""
    rng = np.random.default_rng(10)
    body = body_of(MATERIALS[name], hexahedron(rng))
    for size in (0.0, 0.1):
        u0 = size * rng.uniform(-1, 1, body.num_owned)
        body.begin_step(RULES[rule], nts.EvaluationPoint(u0, 0.0))
        force = body.internal(u0)
        step = 1e-3

        def energy_slope(u, step=step, body=body):
            rows = [sum(w * body.potential(u + k * step * e) for k, w in STENCIL) / step
                    for e in np.eye(len(u))]  # fmt: skip
            return np.array(rows)

        assert np.abs(force - energy_slope(u0)).max() < 1e-8 * YOUNG
        everything = np.arange(len(u0), dtype=np.int32)
        dense = body.tangent(u0, 1.0, 0.5).getValues(everything, everything)
        columns = [sum(w * body.internal(u0 + k * step * e) for k, w in STENCIL) / step
                   for e in np.eye(len(u0))]  # fmt: skip
        mass = np.stack([body.inertia(e) for e in np.eye(len(u0))], axis=1)
        expected = mass + 0.5 * np.stack(columns, axis=1)
        assert np.isfinite(dense).all()
        assert np.abs(dense - expected).max() < 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize("size", [1e-12, 1e-14, 1e-15])
def test_gonzalez_tangent_near_rest_has_no_noise(size):
    """The tangent at a deformed state changes in proportion to the increment."""
    rng = np.random.default_rng(12)
    body = body_of(MATERIALS["neo-hooke"], hexahedron(rng))
    u0, w = 0.1 * rng.uniform(-1, 1, (2, body.num_owned))
    body.begin_step(nts.EnergyMomentum(), nts.EvaluationPoint(u0, 0.0))
    everything = np.arange(len(u0), dtype=np.int32)
    rest = body.tangent(u0, 1.0, 0.5).getValues(everything, everything)
    near = body.tangent(u0 + size * w, 1.0, 0.5).getValues(everything, everything)
    assert np.abs(near - rest).max() < 1e-7 * np.abs(rest).max()


def difference_tangent(body, u1, step):
    """M + K/2 by central differences of fourth order of the internal forces."""
    columns = [sum(w * body.internal(u1 + k * step * e) for k, w in STENCIL) / step
               for e in np.eye(len(u1))]  # fmt: skip
    mass = np.stack([body.inertia(e) for e in np.eye(len(u1))], axis=1)
    return mass + 0.5 * np.stack(columns, axis=1)


@pytest.mark.parametrize("low", [0.09, 0.07, 0.05, 0.03, 0.02])
def test_gonzalez_tangent_next_to_collapse(low):
    """On both sides of the switch between the two forms, and at points on either in one cell."""
    rng = np.random.default_rng(21)
    body = body_of(MATERIALS["neo-hooke"], hexahedron(rng))
    u0, u1 = (deformed(body, np.diag([1.1, 0.9, x])) for x in (0.1, low))
    u1 += 0.002 * rng.uniform(-1, 1, len(u1))
    body.begin_step(nts.EnergyMomentum(), nts.EvaluationPoint(u0, 0.0))
    everything = np.arange(len(u0), dtype=np.int32)
    found = body.tangent(u1, 1.0, 0.5).getValues(everything, everything)
    expected = difference_tangent(body, u1, 1e-4 * low)
    assert np.abs(found - expected).max() < 1e-7 * np.abs(expected).max()


def test_ledger_of_a_body_that_nearly_collapses():
    """A block is squashed to a quarter of its length in a few steps, and springs back."""
    mesh = create_unit_cube(MPI.COMM_SELF, 2, 1, 1, CellType.hexahedron)
    body = nts.Continuum(
        mesh,
        nts.NeoHookean(young=1e6, poisson=0.3),
        density=1e3,
        velocity=lambda x: np.stack([-500.0 * (x[0] - 0.5), 0 * x[0], 0 * x[0]]),
    )
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=1e-4, t_end=3e-3)
    assert run.status == "completed" and run.retries == 0
    assert run.balance["potential"].max() > 0.2 * run.balance["energy"][0]
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * run.balance["energy"][0]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.fast("energy-momentum")
def test_users_own_energy(rule):
    """Any callable C -> W: here St. Venant-Kirchhoff written by the user."""

    def own(c):
        e = (c - ufl.Identity(3)) / 2
        return LAM / 2 * ufl.tr(e) ** 2 + MU * ufl.tr(e * e)

    rng = np.random.default_rng(11)
    f0, f1 = (EYE + 0.2 * rng.uniform(-1, 1, (3, 3)) for _ in range(2))
    found = piola(body_of(own), RULES[rule], f0, f1)
    expected = piola(body_of(MATERIALS["stvk"]), RULES[rule], f0, f1)
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_what_is_no_energy_is_refused():
    with pytest.raises(TypeError, match="callable"):
        body_of(3.0)
    with pytest.raises(TypeError, match="scalar"):
        body_of(lambda c: c)
