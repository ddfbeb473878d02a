"""Forms that are evaluated for several cells at once, against DOLFINx, which takes one by one."""

import logging
import math

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, create_box, create_rectangle, meshtags
from processes import in_fresh_python
from twins.determinants import determinants

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import forms, petsc_compat
from dolfinx_nts.bodies.solid.inversion import Determinants
from dolfinx_nts.bodies.solid.step_forms import fill
from dolfinx_nts.kernels import cell_batches, library

COMM = MPI.COMM_WORLD
KINDS = {"hexahedra": CellType.hexahedron, "tetrahedra": CellType.tetrahedron}
MATERIALS = {
    "neo-Hookean": nts.NeoHookean(young=1e6, poisson=0.3),
    "Mooney-Rivlin": nts.MooneyRivlin(a=2e5, b=1e5, c=1e6),
    "Saint-Venant": nts.StVenantKirchhoff(young=1e6, poisson=0.3),
    "Fung": lambda c: 1e5 * (ufl.exp(0.3 * (ufl.tr(c) - 3)) - ufl.ln(ufl.det(c))),
    "powers": lambda c: 1e5 * (ufl.tr(c) ** 1.7 + ufl.tr(c) ** 6 + ufl.det(c) ** -0.5),
    "conditions": lambda c: 1e5 * ufl.conditional(
        ufl.And(ufl.gt(c[0, 0], 1.0), ufl.Not(ufl.gt(c[1, 1], 1.0))),
        ufl.tr(c) ** 2,
        ufl.conditional(ufl.lt(c[2, 2], 1.0), ufl.sqrt(ufl.det(c)), abs(c[0, 1])),
    ),
    "trigonometry": lambda c: 1e5 * (
        ufl.cos(c[0, 1]) + ufl.sin(c[1, 2]) * ufl.tanh(c[0, 0]) + ufl.atan(c[2, 2])
    ),
}  # fmt: skip


def box(kind, n=3):
    ends = [np.zeros(3), np.array([1.0, 0.8, 1.2])]
    mesh = create_box(COMM, ends, [n, 2, 2], kind)
    mesh.geometry.x[:] += 0.02 * np.sin(9.0 * mesh.geometry.x[:, [1, 2, 0]])
    return mesh


def moved(space, seed=0):
    """Displacement of some hundredths [m] that is smooth, and so the same on all ranks."""
    x = space.tabulate_dof_coordinates()
    return 0.03 * np.sin((3.0 + seed) * x[:, [1, 2, 0]] + seed + np.arange(3)).ravel()


def without_batches(form):
    """The same form as DOLFINx evaluates it."""
    return forms.CellForm(form._compiled, form._source, None)


def entries(form, space):
    """A linear form with all contributions of other ranks."""
    vector = petsc_compat.create_vector(space)
    forms.assemble_vector(vector, form)
    found = vector.array_r.copy()
    vector.destroy()
    return found


def same(form, space):
    assert form.batches is not None
    found, expected = (entries(f, space) for f in (form, without_batches(form)))
    size = COMM.allreduce(np.abs(expected).max(initial=0.0), op=MPI.MAX)
    assert size > 0.0
    assert COMM.allreduce(np.abs(found - expected).max(initial=0.0), op=MPI.MAX) < 1e-13 * size


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("kind", "rule", "material"),
    [
        ("hexahedra", "midpoint", name) if k % 2 else ("tetrahedra", "energy-momentum", name)
        for k, name in enumerate(MATERIALS)
    ],
)
@pytest.mark.fast_on_ranks("tetrahedra-energy-momentum-neo-Hookean")
def test_forces_and_energy_are_those_of_dolfinx(kind, rule, material):
    integrator = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}[rule]
    body = nts.Continuum(box(KINDS[kind]), MATERIALS[material], density=1e3)
    work = body._forms._compiled(integrator)[0]
    for function, seed in ((body._forms._u0, 1), (body._forms._u1, 2), (body.u, 3)):
        fill(function, moved(body.space, seed)[: body.num_owned])
    same(work, body.space)
    energy, assembled = body._energy_form, fem.assemble_scalar(body._energy_form._compiled)
    assert energy.batches is not None
    assert energy.value() == pytest.approx(assembled, rel=1e-13)


@pytest.mark.parametrize("degree", [2, 3])
def test_of_higher_degree(degree):
    space = compat.vector_space(box(CellType.tetrahedron, 2), degree)
    u, w = fem.Function(space), ufl.TestFunction(space)
    fill(u, moved(space)[: 3 * space.dofmap.index_map.size_local])
    energy = 0.5 * ufl.inner(ufl.grad(u), ufl.grad(u)) * (1.0 + ufl.inner(u, u)) * ufl.dx
    (work,) = forms.compile_forms([ufl.derivative(energy, u, w)])
    same(work, space)


def test_of_a_membrane():
    mesh = create_rectangle(COMM, [np.zeros(2), np.ones(2)], [5, 3], CellType.quadrilateral)
    space = compat.vector_space(mesh, 1)
    u, w = fem.Function(space), ufl.TestFunction(space)
    fill(u, moved(space)[: 3 * space.dofmap.index_map.size_local])
    (work,) = forms.compile_forms([(1.0 + ufl.inner(u, u)) * ufl.inner(u, w) * ufl.dx])
    same(work, space)


@pytest.mark.parametrize("combined", ["and", "or", "not", "unequal", "alone"])
def test_conditions_on_constants_hold_when_they_change(combined):
    """What is true of a Constant is one number for all cells, what is true of a field is not."""
    mesh = box(CellType.hexahedron)
    on, space = fem.Constant(mesh, 0.0), compat.vector_space(mesh, 1)
    u = fem.Function(space)
    fill(u, moved(space)[: 3 * space.dofmap.index_map.size_local])
    late, large = ufl.gt(on, 0.5), ufl.gt(u[0], 0.0)
    condition = {
        "and": ufl.And(late, large),
        "or": ufl.Or(late, large),
        "not": ufl.And(ufl.Not(late), large),
        "unequal": ufl.And(ufl.ne(on, 0.0), large),
        "alone": late,
    }[combined]
    (form,) = forms.compile_forms([ufl.conditional(condition, 2.0, 1.0) * u[1] ** 2 * ufl.dx])
    assert form.batches is not None
    for value in (0.0, 1.0):
        on.value = value
        expected = fem.assemble_scalar(form._compiled)
        assert form.value() == pytest.approx(expected, rel=1e-13)


def test_largest_and_smallest_values():
    mesh = box(CellType.hexahedron)
    u = fem.Function(compat.vector_space(mesh, 1))
    fill(u, moved(u.function_space)[: 3 * u.function_space.dofmap.index_map.size_local])
    angle = getattr(ufl, "atan2", None) or ufl.atan_2
    value = ufl.max_value(u[0], 0.01) + ufl.min_value(u[1], u[2]) + angle(u[0], 2.0 + u[1])
    value += ufl.sign(u[2])
    (form,) = forms.compile_forms([value * ufl.dx])
    assert form.batches is not None
    assert form.value() == pytest.approx(fem.assemble_scalar(form._compiled), rel=1e-13)


def test_a_part_of_a_mixed_function_is_left_to_dolfinx():
    mesh = box(CellType.tetrahedron)
    if compat.VERSION < (0, 8):
        cell = mesh.ufl_cell()
        both = ufl.VectorElement("Lagrange", cell, 2) * ufl.FiniteElement("Lagrange", cell, 1)
        space = fem.FunctionSpace(mesh, both)
    else:
        from basix.ufl import element, mixed_element

        vector, scalar = element("P", "tetrahedron", 2, shape=(3,)), element("P", "tetrahedron", 1)
        space = fem.functionspace(mesh, mixed_element([vector, scalar]))
    both = fem.Function(space)
    both.x.array[:] = np.sin(np.arange(len(both.x.array)))
    part = both.sub(0)
    (form,) = forms.compile_forms([ufl.inner(part, part) * ufl.dx])
    assert form.value() == pytest.approx(fem.assemble_scalar(form._compiled), rel=1e-13)


@pytest.mark.slow
def test_what_a_fork_interrupts_is_made_again():
    """`multiprocessing` forks on Linux; a child has its parent's objects, not its threads."""
    code = """
import os
from dolfinx_nts.kernels import library
import threading
gate = threading.Event()
here = os.getpid()
def slow():
    if os.getpid() == here:
        gate.wait(60)
    return os.getpid()
beside = library.Beside(slow)
child = os.fork()
if child == 0:
    os._exit(0 if beside.result() == os.getpid() else 1)
_, status = os.waitpid(child, 0)
gate.set()
print(os.waitstatus_to_exitcode(status), beside.result() == here)
"""
    assert in_fresh_python(code).split() == ["0", "True"]


@pytest.mark.mpi
def test_with_fields_of_parameters():
    """Cells with moduli of their own, and a Constant in the exponent."""
    mesh = box(CellType.hexahedron)
    stiffness = fem.Function(compat.function_space(mesh, "DG", 0))
    exponent = fem.Constant(mesh, 1.3)
    stiffness.interpolate(lambda x: 1e5 * (1.0 + x[0]))
    body = nts.Continuum(mesh, lambda c: stiffness * ufl.tr(c) ** exponent, density=1e3)
    work = body._forms._compiled(nts.Midpoint())[0]
    fill(body._forms._u1, moved(body.space)[: body.num_owned])
    same(work, body.space)
    exponent.value = 2.1
    stiffness.x.array[:] *= 2.0
    same(work, body.space)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (5e5, 5.4e6, 0.0)])
def test_thin_cells_and_far_ones_are_compared(offset, caplog):
    """With displacements of the size of their thickness, for which an energy with a limit is there;
    and about themselves, as rounding of far places differs."""

    def gent(c):
        j = ufl.sqrt(ufl.det(c))
        return -1e6 * ufl.ln(1 - (ufl.tr(c) - 3 - 2 * ufl.ln(j)) / 10) + 5e5 * (j - 1) ** 2

    ends = [np.zeros(3), np.array([1.0, 1.0, 0.02])]
    mesh = create_box(COMM, ends, [4, 4, 2], CellType.hexahedron)
    mesh.geometry.x[:] += offset
    body = nts.Continuum(mesh, gent, density=1e3)
    work = body._forms._compiled(nts.Midpoint())[0]
    assert work.batches is not None and body._energy_form.batches is not None
    assert not caplog.records


def test_parts_and_facets_are_left_to_dolfinx():
    mesh = box(CellType.hexahedron)
    space = compat.vector_space(mesh, 1)
    w = ufl.TestFunction(space)
    tags = meshtags(mesh, 3, np.arange(3, dtype=np.int32), np.ones(3, dtype=np.int32))
    dx = ufl.Measure("dx", mesh, subdomain_data=tags)
    # Without a Function no form is taken, whatever it is over.
    u = fem.Function(space)
    u.x.array[:] = 1.0
    for measure in (dx(1), ufl.ds(mesh), ufl.dx(mesh) + ufl.ds(mesh)):
        parts = [ufl.inner(u, w) * m for m in getattr(measure, "ufl_operands", [measure])]
        (form,) = forms.compile_forms([sum(parts[1:], parts[0])])
        assert form.batches is None
        assert entries(form, space).sum() > 0.0
    assert forms.compile_forms([ufl.inner(u, w) * ufl.dx(mesh)])[0].batches is not None


#: A kernel that writes the logarithms of its coefficients.
LOGARITHM = """
void tabulate_tensor_integral_log(double* restrict A, const double* restrict w, const double* c)
{
  for (int i = 0; i < 4; ++i)
    A[i] += log(w[i]);
}
"""


def logarithms(x):
    """What the kernels' logarithm makes of numbers."""
    x = np.asarray(x, dtype=np.float64).reshape(-1, 4)
    loop = cell_batches.load(LOGARITHM, cell_batches.Shape(3, 4, 4, 1), compat.cache_folder(), [])
    nodes, dofs = np.zeros((len(x), 1)), np.arange(x.size).reshape(x.shape)
    out, field = np.zeros(x.size), cell_batches.Field(x.ravel(), dofs, 1)
    batches = cell_batches.CellBatches(loop, nodes, np.zeros((1, 3)), dofs, [field])
    batches.add(np.zeros(0), out)
    return out


def test_the_logarithm_is_that_of_the_library():
    rng = np.random.default_rng(0)
    near_one = 1.0 + np.concatenate([[0.0, 2.0**-52, -(2.0**-53)], rng.normal(size=397) * 1e-3])
    wide = np.exp(rng.uniform(-745.0, 709.0, 4000))
    x = np.concatenate([near_one, wide, [5e-324, 1e-310, 2.3e-308, 1.7e308]])
    exact = [math.log(value) for value in x]
    found = logarithms(x)
    assert (np.abs(found - exact) <= np.spacing(np.abs(exact))).all()
    assert found[0] == 0.0
    odd = logarithms([0.0, -1.0, np.inf, np.nan, -0.0, -np.inf, 1.0, 2.0])
    np.testing.assert_array_equal(
        odd, [-np.inf, np.nan, np.inf, np.nan, -np.inf, np.nan, 0.0, math.log(2.0)]
    )


def test_a_wrong_kernel_is_refused(monkeypatch, caplog):
    """One whose lanes got something else than FFCx's is found out before it is used."""
    mesh = box(CellType.hexahedron)
    space = compat.vector_space(mesh, 1)
    u, w = fem.Function(space), ufl.TestFunction(space)
    work = ufl.inner(ufl.grad(u), ufl.grad(w)) * (1.25 + ufl.inner(u, u)) * ufl.dx
    good = cell_batches._for_lanes
    monkeypatch.setattr(cell_batches, "_for_lanes", lambda c: good(c).replace("1.25", "1.26"))
    with caplog.at_level(logging.WARNING):
        (form,) = forms.compile_forms([work])
    assert form.batches is None
    assert "it differs from FFCx's" in caplog.text


@pytest.mark.parametrize("compiler", ["/no/compiler", "false"])
def test_without_a_compiler_dolfinx_takes_them(compiler, monkeypatch):
    ends = [np.zeros(3), np.array([1.0, 0.8, 1.2])]
    u = fem.Function(compat.vector_space(create_box(COMM, ends, [2] * 3, CellType.hexahedron), 1))
    form = (2.5 + ufl.inner(u, u)) * ufl.dx
    # FFCx needs one; what is there must not do for the second time.
    assert forms.compile_forms([form])[0].batches is not None
    monkeypatch.setenv("CC", compiler)
    monkeypatch.setattr(library, "key", lambda *_: "never made")
    monkeypatch.setattr(forms, "_load", forms._load.__wrapped__)  # this process has it by now
    (functional,) = forms.compile_forms([form])
    assert functional.batches is None
    assert COMM.allreduce(functional.value()) == pytest.approx(2.5 * 0.96, rel=1e-13)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_determinants_are_those_of_numpy(kind, degree):
    space = compat.vector_space(box(KINDS[kind]), degree)
    dets = Determinants(space, degree, 2 * degree)
    for seed in (1, 2):
        u = moved(space, seed)
        expected = determinants(space, degree, 2 * degree, u)
        assert dets.smallest(u)[0] == pytest.approx(expected.min(), rel=1e-13)


def test_flags_of_a_user_come_last(monkeypatch):
    """So that they count: see `compat.chosen_flags`."""
    given = []

    def made(_name, command, _folder):
        given.extend(command(cell_batches.Path("/nowhere")))
        raise library.NotMadeError("only asked for its flags")

    monkeypatch.setattr(compat, "chosen_flags", lambda: ["-O3", "-march=x86-64"])
    monkeypatch.setattr(library, "made", made)
    monkeypatch.setattr(cell_batches.Path, "write_text", lambda *_: None)
    u = fem.Function(compat.vector_space(box(CellType.hexahedron), 1))
    (functional,) = forms.compile_forms([ufl.inner(u, u) * ufl.dx])
    assert functional.batches is None
    ours, theirs = given.index("-march=native"), given.index("-march=x86-64")
    assert ours < given.index("-O3") < theirs
