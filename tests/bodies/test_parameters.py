"""Parameters of materials that are Constants and Functions, changed between steps or not."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
DT = 1e-3
YOUNG, POISSON, DENSITY = 1e5, 0.3, 1e3

pytestmark = pytest.mark.mpi


def field(mesh, value, upper=None):
    """A Function of degree 0, of another value in the upper half."""
    found = fem.Function(compat.function_space(mesh, "DG", 0))
    number = mesh.topology.index_map(3)
    cells = np.arange(number.size_local + number.num_ghosts)
    x = mesh.geometry.x[compat.geometry_dofmap(mesh)].mean(axis=1)
    found.x.array[cells] = np.where(x[:, 2] > 0.5, value if upper is None else upper, value)
    return found


KINDS = {
    "constant": lambda mesh, value: fem.Constant(mesh, value),
    "function": field,
}


def set_value(parameter, value):
    if isinstance(parameter, fem.Constant):
        parameter.value = value
    else:
        parameter.x.array[:] = value


def stretched(mesh, material, density=DENSITY):
    """A cube stretched by a tenth, and its stored energy [J]."""
    body = nts.Continuum(mesh, material, density=density, displacement=lambda x: 0.1 * x)
    u = body.u.x.array[: body.num_owned]
    return body, COMM.allreduce(body.potential(u))


@pytest.mark.fast("NeoHookean-values1-constant")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("law", "values"),
    [
        (nts.StVenantKirchhoff, {"young": YOUNG, "poisson": POISSON}),
        (nts.NeoHookean, {"young": YOUNG, "poisson": POISSON}),
        (nts.MooneyRivlin, {"a": 2e4, "b": 1e4, "c": 1e5}),
        (nts.ArrudaBoyce, {"mu": 2e4, "stretch": 3.0, "bulk": 1e5}),
        (lambda mu, bulk: nts.Ogden((mu, 1e3), (2.0, -3.3), bulk), {"mu": 2e4, "bulk": 1e5}),
    ],
)
def test_they_are_as_numbers(law, values, kind):
    mesh = box(cells=(2, 2, 2))
    _, expected = stretched(mesh, law(**values))
    every = {name: KINDS[kind](mesh, value) for name, value in values.items()}
    for given in (every, values | dict(list(every.items())[:1])):
        _, energy = stretched(mesh, law(**given))
        np.testing.assert_allclose(energy, expected, rtol=1e-13)


def test_halves_of_two_stiffnesses_and_densities():
    mesh = box(cells=(2, 2, 2))
    soft, hard = (stretched(mesh, nts.NeoHookean(y, POISSON))[1] for y in (YOUNG, 3 * YOUNG))
    material = nts.NeoHookean(field(mesh, YOUNG, 3 * YOUNG), POISSON)
    body, energy = stretched(mesh, material, field(mesh, 1e3, 5e3))
    np.testing.assert_allclose(energy, 0.5 * (soft + hard), rtol=1e-13)
    motion = nts.motion_of(body)
    np.testing.assert_allclose(motion.mass, 3e3, rtol=1e-13)
    # The middle of halves that are displaced, too.
    np.testing.assert_allclose(motion.centre, 1.1 * np.array([0.5, 0.5, (0.25 + 3.75) / 6]))


@pytest.mark.parametrize("kind", KINDS)
def test_a_rigid_body_whose_density_changes_ends_the_run(kind):
    mesh = box(cells=(2, 2, 2))
    density = KINDS[kind](mesh, 1e3)
    body = nts.RigidBody(mesh, density=density, name="lid")

    def change(time, dt):
        if time > DT:
            set_value(density, 2e3)

    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=DT, t_end=4 * DT, before_step=change
    )
    assert run.status.startswith("density of 'lid': has changed") and len(run.rows) == 3


@pytest.mark.fast("constant")
@pytest.mark.parametrize("kind", KINDS)
def test_a_modulus_changed_between_steps(kind):
    """The energy that it adds is that of the body as it stands, and the ledger names it."""
    mesh = box(cells=(2, 2, 2))
    young = KINDS[kind](mesh, YOUNG)
    body, energy = stretched(mesh, nts.NeoHookean(young, POISSON))

    def change(time, dt):
        if time > 0:
            return
        set_value(young, 2 * YOUNG)

    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum())
    stepper.start(DT)
    change(0.0, DT)
    stepper.advance(DT)
    stepper.close()
    table = stepper.solution.balance
    np.testing.assert_allclose(table["material_change"][-1], energy, rtol=1e-12)
    assert abs(table["ledger_residual"][-1]) < 1e-10 * energy
    assert "material changed" in stepper.solution.warnings


@pytest.mark.fast("constant-integrator0")
@pytest.mark.parametrize(
    ("kind", "integrator"),
    [("constant", nts.EnergyMomentum()), (list(KINDS)[1], nts.Midpoint()),
     (list(KINDS)[1], nts.Newmark())],
)  # fmt: skip
@pytest.mark.fast_on_ranks()
def test_a_density_changed_between_steps(kind, integrator):
    """Mass that comes has the velocity of its place: energy and momentum grow with it."""
    mesh = box(cells=(2, 2, 2))
    density = KINDS[kind](mesh, DENSITY)
    body = nts.Continuum(
        mesh, nts.NeoHookean(YOUNG, POISSON), density=density, velocity=(3.0, 0.0, 0.0)
    )
    stepper = nts.Stepper(nts.System([body], gravity=(0, 0, -10.0)), integrator)
    stepper.advance(DT)
    if kind == "constant":
        density.value = 2 * DENSITY
    else:
        density.x.array[:] = 2 * DENSITY
    stepper.advance(DT)
    stepper.close()
    table = stepper.solution.balance
    np.testing.assert_allclose(table["linear_momentum"][:, 0], [3e3, 3e3, 6e3], rtol=1e-12)
    # Gravity has acted for a step on one mass, and for another one on two; the new mass fell, too.
    fall = table["linear_momentum"][1:, 2]
    np.testing.assert_allclose(fall, [-10.0, -40.0], rtol=1e-11)
    kinetic = 0.5 * DENSITY * (9.0 + (10 * DT) ** 2)
    np.testing.assert_allclose(table["material_change"][1:], [0.0, kinetic], rtol=1e-11)
    assert np.abs(table["ledger_residual"]).max() < 1e-10 * kinetic


def test_a_mass_of_forms_changed_between_steps():
    mesh = box(cells=(2, 2, 2))
    rho, space = fem.Constant(mesh, DENSITY), compat.vector_space(mesh, 1)
    body = nts.FormBody(
        space, lambda u: YOUNG * ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx,
        mass=lambda v, w: rho * ufl.inner(v, w) * ufl.dx, velocity=(3.0, 0.0, 0.0),
    )  # fmt: skip
    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum())
    stepper.advance(DT)
    rho.value = 2 * DENSITY
    stepper.advance(DT)
    stepper.close()
    table = stepper.solution.balance
    np.testing.assert_allclose(table["linear_momentum"][:, 0], [3e3, 3e3, 6e3], rtol=1e-12)
    np.testing.assert_allclose(table["material_change"][-1], 4.5e3, rtol=1e-12)


@pytest.mark.parametrize("change", [-1.0, np.nan])
def test_a_mass_that_vanishes_ends_the_run(change):
    mesh = box(cells=(1, 1, 1))
    density = fem.Constant(mesh, DENSITY)
    body = nts.Continuum(mesh, nts.NeoHookean(YOUNG, POISSON), density=density, name="cube")

    def lose(time, dt):
        density.value = DENSITY if time == 0 else change

    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=DT, t_end=3 * DT, before_step=lose
    )
    words = f"a parameter of 'cube' has changed: density with a value of {change}: must"
    assert words in run.status
    assert len(run.balance["time"]) == 2


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [("density", DENSITY, -1.0), ("young", YOUNG, np.nan)],
)
@pytest.mark.fast("young-100000.0-nan")
def test_a_value_out_of_range_in_one_cell_ends_the_run(name, good, bad):
    """Though the mass in all would be positive."""
    mesh = box(cells=(1, 1, 2))
    given = {"young": YOUNG, "poisson": POISSON, "density": DENSITY} | {name: field(mesh, good)}
    material = nts.NeoHookean(given["young"], given["poisson"])
    body = nts.Continuum(mesh, material, density=given["density"], name="cube")

    def spoil(time, dt):
        if time > 0.0:
            given[name].x.array[:] = field(mesh, good, bad).x.array

    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=DT, t_end=3 * DT, before_step=spoil
    )
    assert f"a parameter of 'cube' has changed: {name} with a value of {bad}: must" in run.status
    assert len(run.balance["time"]) == 2


def test_what_is_no_parameter_is_refused():
    mesh, other = box(), box()
    with pytest.raises(ValueError, match=r"young with a value of -1.0: must be positive"):
        nts.NeoHookean(field(mesh, -1.0), 0.3)
    with pytest.raises(ValueError, match=r"poisson with a value of 0.5: must lie in"):
        nts.NeoHookean(1e5, fem.Constant(mesh, 0.5))
    with pytest.raises(ValueError, match=r"has shape \(3,\); pass a scalar"):
        nts.NeoHookean(fem.Constant(mesh, np.ones(3)), 0.3)
    with pytest.raises(ValueError, match=r"density with a value of nan"):
        nts.Continuum(mesh, nts.NeoHookean(1e5, 0.3), density=fem.Constant(mesh, np.nan))
    with pytest.raises(ValueError, match="density=.*of another mesh; make it on the mesh"):
        nts.Continuum(mesh, nts.NeoHookean(1e5, 0.3), density=fem.Constant(other, 1.0))
    with pytest.raises(TypeError, match="of another mesh; make it on the mesh of the body"):
        nts.Continuum(mesh, nts.NeoHookean(fem.Constant(other, 1e5), 0.3), density=1e3)
