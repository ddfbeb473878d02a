"""Yeoh, Arruda-Boyce and Ogden against textbooks, where principal stretches coincide and apart."""

from fractions import Fraction
from math import factorial

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, create_unit_cube
from measures import STENCIL
from rotations import rotation

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.forms import assemble_vector, compile_forms
from dolfinx_nts.kernels.discrete_gradient import gonzalez_stress
from dolfinx_nts.kernels.strain_energy import strain_energy

BULK = 1e4
C10, C20, C30 = 180.0, -3.0, 0.5
MU, STRETCH = 300.0, 3.0
MODULI, EXPONENTS = (630.0, 1.2, -10.0), (1.3, 5.0, -2.0)
EYE = np.eye(3)
MATERIALS = {
    "yeoh": nts.Yeoh(c10=C10, c20=C20, c30=C30, bulk=BULK),
    "arruda-boyce": nts.ArrudaBoyce(mu=MU, stretch=STRETCH, bulk=BULK),
    "ogden": nts.Ogden(mu=MODULI, alpha=EXPONENTS, bulk=BULK),
}


class Point:
    """W, stresses and the derivative of a stress at a point, compiled where they are asked for."""

    def __init__(self, material):
        mesh = create_unit_cube(MPI.COMM_SELF, 1, 1, 1, CellType.hexahedron)
        space = compat.function_space(mesh, "DG", 0, (3, 3))
        self.e0, self.e1, self.way = (fem.Function(space) for _ in range(3))
        w, test = strain_energy(material), ufl.TestFunction(space)
        dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 0})
        stress = ufl.inner(w.stress(self.e1), test) * dx
        between = ufl.inner(gonzalez_stress(w, self.e0, self.e1), test) * dx
        slope = ufl.derivative(stress, self.e1, self.way)
        self.given = {
            "energy": w(self.e1) * dx, "stress": stress, "slope": slope, "between": between
        }  # fmt: skip
        self.forms = {}
        self.vector = petsc_compat.create_vector(space)

    def __call__(self, what, e1, other=None):
        self.e1.x.array[:] = np.ravel(e1)
        if other is not None:
            (self.way if what == "slope" else self.e0).x.array[:] = np.ravel(other)
        if what not in self.forms:
            (self.forms[what],) = compile_forms([self.given[what]])
        if what == "energy":
            return self.forms[what].value()
        assemble_vector(self.vector, self.forms[what])
        return self.vector.array_r.reshape(3, 3).copy()


_POINTS = {}


def each(test):
    """Of each material."""
    test = pytest.mark.fast("yeoh", "ogden")(test)
    return pytest.mark.parametrize("name", MATERIALS)(test)


def point(name):
    if name not in _POINTS:
        _POINTS[name] = Point(MATERIALS[name])
    return _POINTS[name]


def chain(terms=5):
    """Slope of a chain's energy by x^2/2 over its modulus, x = l/L, in powers of x^2.

    The inverse of Langevin's coth b - 1/b, as a power series, over 3 x.
    """
    size = 2 * terms
    # coth b - 1/b = (b cosh b - sinh b)/(b sinh b), by powers of b.
    above = [Fraction(0)] * (size + 4)
    below = [Fraction(0)] * (size + 4)
    for n in range(0, size + 3, 2):
        above[n + 1] += Fraction(1, factorial(n)) - Fraction(1, factorial(n + 1))
        below[n + 2 if n + 2 < len(below) else 0] += Fraction(1, factorial(n + 1))
    above, below = above[2:], below[2:]
    langevin = []
    for n in range(size):
        langevin.append(above[n] - sum(below[n - k] * langevin[k] for k in range(n)))
        langevin[-1] /= below[0]
    inverse = [Fraction(0), 1 / langevin[1]]
    for n in range(2, size):
        # langevin(inverse) is x: its coefficient of x^n is none.
        inverse.append(Fraction(0))
        power, rest = [Fraction(1)] + [Fraction(0)] * n, Fraction(0)
        for k in range(1, n + 1):
            power = [sum(power[j] * inverse[m - j] for j in range(m + 1) if m - j < len(inverse))
                     for m in range(n + 1)]  # fmt: skip
            rest += langevin[k] * power[n]
        inverse[n] = -rest / langevin[1]
    return [inverse[2 * k + 1] / 3 for k in range(terms)]


def true_stress(name, a, b):
    """Difference of Cauchy stresses along stretches a and b of a body that keeps its volume."""
    if name == "ogden":
        return sum(m * (a**p - b**p) for m, p in zip(MODULI, EXPONENTS, strict=True))
    first = a**2 + b**2 + (a * b) ** -2
    if name == "yeoh":
        slope = C10 + 2 * C20 * (first - 3) + 3 * C30 * (first - 3) ** 2
    else:
        x2 = first / 3 / STRETCH**2
        slope = MU / 2 * sum(float(c) * x2**k for k, c in enumerate(chain()))
    return 2 * slope * (a**2 - b**2)


#: Principal stretches of volume 1, by that along which the body is pulled.
TESTS = {
    "uniaxial": lambda a: (a, a**-0.5, a**-0.5),
    "equibiaxial": lambda a: (a, a, a**-2.0),
    "pure shear": lambda a: (a, 1.0, 1.0 / a),
}


@each
def test_stress_over_stretch(name):
    for stretches in TESTS.values():
        for a in (0.6, 0.95, 0.999, 1.001, 1.006, 1.02, 1.3, 2.0, 4.0):
            x = np.array(stretches(a))
            f = np.diag(x)
            cauchy = np.diag(f @ point(name)("stress", 0.5 * (f.T @ f - EYE)) @ f.T)
            expected = true_stress(name, x[0], x[2])
            assert abs(cauchy[0] - cauchy[2] - expected) < 1e-10 * abs(expected)


@each
def test_simple_shear(name):
    """Of F = 1 + g e_1 x e_2, whose stress comes from that of its principal axes."""
    for g in (0.01, 0.5, 2.0):
        f = EYE + g * np.outer(EYE[0], EYE[1])
        cauchy = f @ point(name)("stress", 0.5 * (f.T @ f - EYE)) @ f.T
        a = 0.5 * (g + np.sqrt(g**2 + 4))
        # sigma_12 = (s_1 - s_2)/2 sin 2 phi, tan 2 phi = 2/g.
        expected = true_stress(name, a, 1 / a) / np.sqrt(4 + g**2)
        assert abs(cauchy[0, 1] - expected) < 1e-10 * expected


@pytest.mark.slow
def test_ogden_of_exponents_2_and_minus_2_is_mooney_rivlin():
    """Where the volume is kept; then Mooney and Rivlin's terms of the volume push evenly."""
    ogden = Point(nts.Ogden(mu=(240.0, -80.0), alpha=(2.0, -2.0), bulk=BULK))
    mooney = Point(nts.MooneyRivlin(a=120.0, b=40.0, c=900.0))
    for k in range(4):
        f = rotation(0.3 * k) @ np.diag([1.5, 0.8, 1 / 1.2]) @ rotation(1.0 + k).T
        e = 0.5 * (f.T @ f - EYE)
        stored = [p("energy", e) for p in (ogden, mooney)]
        assert stored[0] == pytest.approx(stored[1], rel=1e-12)
        one, other = (f @ p("stress", e) @ f.T for p in (ogden, mooney))
        even = one - other
        assert np.abs(even - np.trace(even) / 3 * EYE).max() < 1e-12 * np.abs(other).max()


def states():
    """Strains: none, two or three principal stretches alike, nearly alike, all apart."""
    rng = np.random.default_rng(3)
    turned = rotation(0.7)
    for x in (
        (1, 1, 1), (1.3, 1.3, 1.3), (2, 0.7, 0.7), (1.5, 1.5, 0.5), (1.4, 1.0, 0.7),
        (2, 0.7, 0.7 + 1e-9), (2, 0.7, 0.7 + 1e-5), (1.01, 1.0, 1.0), (1.0097, 1, 1), (3, 1, 0.35),
    ):  # fmt: skip
        c = turned @ np.diag(np.square(x, dtype=float)) @ turned.T
        way = rng.uniform(-1, 1, (3, 3))
        yield 0.5 * (c - EYE), way + way.T


@each
def test_tangent_is_that_of_the_stress_and_the_stress_of_the_energy(name):
    at, size = point(name), 1e-4
    for e, way in states():
        ends = [(w, e + k * size * way) for k, w in STENCIL]
        expected = sum(w * at("stress", one) for w, one in ends) / size
        found = at("slope", e, way)
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
        expected = sum(w * at("energy", one) for w, one in ends) / size
        found = (at("stress", e) * way).sum()
        assert abs(found - expected) < 1e-6 * BULK * np.linalg.norm(way)


@each
def test_work_of_the_discrete_gradient_is_the_change_of_the_energy(name):
    at, every = point(name), [e for e, _ in states()]
    for e0, e1 in zip(every, every[1:] + every[:1], strict=True):
        work = (at("between", e1, e0) * (e1 - e0)).sum()
        change = at("energy", e1) - at("energy", e0)
        assert abs(work - change) < 1e-12 * max(at("energy", e) for e in (e0, e1))


@each
def test_moduli_at_small_strain(name):
    series = 1 + 3 / (5 * 9) + 99 / (175 * 81) + 513 / (875 * 729) + 42039 / (67375 * 6561)
    shear = {
        "yeoh": 2 * C10,
        "arruda-boyce": MU * series,
        "ogden": sum(m * a for m, a in zip(MODULI, EXPONENTS, strict=True)) / 2,
    }[name]
    bulk, found = MATERIALS[name].small_strain
    assert bulk == BULK and found == pytest.approx(shear, rel=1e-14)
    e = 1e-9 * (np.outer(EYE[0], EYE[1]) + np.outer(EYE[1], EYE[0]))
    assert point(name)("stress", e)[0, 1] == pytest.approx(2e-9 * shear, rel=1e-8)
    # tr stress = 3 K tr E.
    stress = point(name)("stress", 1e-9 * EYE)
    assert np.trace(stress) == pytest.approx(9 * BULK * 1e-9, rel=1e-7)
