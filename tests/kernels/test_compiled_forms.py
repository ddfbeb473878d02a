"""What is compiled: forms once, whatever their parameters and what was made before them."""

from mpi4py import MPI

import cffi
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, create_box
from processes import in_fresh_python

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.kernels import canonical as canonical_forms

COMM = MPI.COMM_WORLD
MATERIALS = [
    (nts.StVenantKirchhoff(young=1e6, poisson=0.3), nts.StVenantKirchhoff(young=2e9, poisson=0.0)),
    (nts.NeoHookean(young=1e6, poisson=0.3), nts.NeoHookean(young=2e9, poisson=0.0)),
    (nts.MooneyRivlin(a=2e5, b=1e5, c=1e6), nts.MooneyRivlin(a=2e5, b=0.0, c=3e7)),
]


def stretched(material):
    """Strain energy [J] of a unit cube stretched by a tenth in all directions, after a step."""
    mesh = create_box(COMM, [np.zeros(3), np.ones(3)], [2, 1, 1], CellType.hexahedron)
    body = nts.Continuum(mesh, material, density=1e3, displacement=lambda x: 0.1 * x)
    nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=1e-6, t_end=1e-6)
    u = np.zeros(body.num_owned) + 0.1 * body.reference
    return COMM.allreduce(body.potential(u), op=MPI.SUM)


@pytest.mark.mpi
@pytest.mark.parametrize(("first", "other"), MATERIALS)
@pytest.mark.fast("first0-other0", "first1-other1")
@pytest.mark.fast_on_ranks()
def test_other_moduli_compile_nothing(first, other, monkeypatch):
    stretched(first)

    def refuse(*_, **__):
        raise AssertionError("a form was compiled")

    monkeypatch.setattr(cffi.FFI, "compile", refuse)
    for _ in range(4):  # UFL's counts of Constants get another digit in one of them
        energy = stretched(other)
    square = 1.1**2
    if isinstance(other, nts.StVenantKirchhoff):  # tr E = 3 e, E : E = 3 e^2
        e = (square - 1) / 2
        expected = 1e9 * 3 * e**2
    elif isinstance(other, nts.NeoHookean):
        expected = 5e8 * (3 * square - 3 - 3 * np.log(square))
    else:
        j = 1.1**3
        expected = 2e5 * (3 * square - 3) + 1.5e7 * (j - 1) ** 2 - 4e5 * np.log(j)
    np.testing.assert_allclose(energy, expected, rtol=1e-12)


@pytest.mark.slow
def test_a_users_flags_are_kept(tmp_path):
    """From a file in the working folder, as of DOLFINx; what it does not name stays ours."""
    ours = {"cffi_extra_compile_args": compat.C_FLAGS, "timeout": 600}
    assert compat.jit_options() == ours
    name = "parameters" if compat.VERSION < (0, 8) else "options"
    file = tmp_path / f"dolfinx_jit_{name}.json"
    file.write_text('{"cffi_extra_compile_args": ["-O3", "-march=native"]}')
    code = "from dolfinx_nts import dolfinx_compat as c; print(c.jit_options())"
    found = in_fresh_python(f"import os; os.chdir({str(tmp_path)!r}); {code}")
    assert found.strip() == "{'timeout': 600}"


def own_scene(mesh):
    """A step of a body whose forms hold all that UFL counts: a user's W, and virtual work."""
    mu, lam, drag = (fem.Constant(mesh, value) for value in (4e5, 6e5, 2e3))
    grade = fem.Function(compat.function_space(mesh, "DG", 0))
    grade.x.array[:] = 1.0

    def energy(c):
        i, j, k = ufl.indices(3)
        e = 0.5 * (c - ufl.Identity(3))
        square = ufl.as_tensor(e[i, k] * e[j, k], (i, j))
        both = ufl.conditional(ufl.gt(ufl.tr(e), 0.0), square, 2 * square)
        return grade * mu * ufl.tr(both) + 0.5 * lam * ufl.tr(e) ** 2

    def work(u, v, w, t):
        return (drag * ufl.inner(v, w) + mu * t * ufl.inner(u, w)) * ufl.dx

    body = nts.Continuum(mesh, energy, density=1e3, velocity=(1.0, 0, 0), extra_form=work)
    return nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=1e-3, t_end=1e-3)


def count_up(mesh, margin):
    """Make Constants, Functions, indices and labels up to `margin` below a count of more digits."""
    number = fem.Constant(mesh, 0.0).count()
    space = ufl.Coefficient(compat.function_space(mesh, "DG", 0)).ufl_function_space()
    for _ in range(10 ** len(str(number + margin)) - margin - number - 1):
        fem.Constant(mesh, 0.0), ufl.Index(), ufl.variable(ufl.as_ufl(1.0)), ufl.Coefficient(space)


@pytest.mark.mpi
@pytest.mark.slow
def test_what_was_made_before_makes_no_other_forms(monkeypatch):
    mesh = create_box(COMM, [np.zeros(3), np.ones(3)], [2, 1, 1], CellType.hexahedron)
    first = own_scene(mesh)

    def refuse(*_, **__):
        raise AssertionError("a form was compiled")

    monkeypatch.setattr(cffi.FFI, "compile", refuse)
    for margin in (2, 5):
        count_up(mesh, margin)
        again = own_scene(mesh)
        assert np.array_equal(again.balance["energy"], first.balance["energy"])


@pytest.mark.mpi
def test_a_canonical_form_is_the_form(monkeypatch):
    """Its integral is that of the given one, to the bit, and names nothing of it."""
    mesh = create_box(COMM, [np.zeros(3), np.ones(3)], [2, 1, 1], CellType.tetrahedron)
    u = fem.Function(compat.vector_space(mesh, 1))
    u.interpolate(lambda x: np.stack([x[0] * x[1], x[1] + 2 * x[2], x[0] ** 2]))
    i, j = ufl.indices(2)
    v = ufl.variable(ufl.grad(u))
    c = [fem.Constant(mesh, value) for value in (0.3, np.array([1.0, 2.0, -1.0]))]
    form = (c[0] * ufl.tr(ufl.diff(v[i, j] * v[i, j], v)) + ufl.inner(c[1], u)) * ufl.dx
    # Else only what would show a count is made anew.
    monkeypatch.setattr(canonical_forms, "_has_indexed_zeros", lambda form: True)
    made = canonical_forms.canonical(form)
    terminals = [*made.coefficients(), *made.constants()]
    assert [t.count() for t in terminals] == [0, 100, 101]
    assert not {id(t) for t in terminals} & {id(t) for t in (u, *c)}
    assert canonical_forms.canonical(made).signature() == made.signature() == form.signature()
    values = [fem.assemble_scalar(fem.form(f)) for f in (form, made)]
    assert values[0] == values[1]
    c[0].value = 0.6
    changed = [fem.assemble_scalar(fem.form(f)) for f in (form, made)]
    assert changed[0] == changed[1] != values[0]
