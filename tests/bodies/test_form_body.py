"""Bodies of a user's own forms: as a continuum, on meshes of other dimensions, and wrong ones."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx.mesh import create_unit_square
from integrators import GRADIENTS, INTEGRATORS, MID_STEP
from measures import drift
from scenes import box, green, saint_venant

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.output import Fields

COMM = MPI.COMM_WORLD
YOUNG, POISSON, RHO = 2e5, 0.3, 1e3
EXACT = nts.Newton(rtol=1e-12)
RULES = INTEGRATORS | {"mean-value stress": GRADIENTS["mean-value stress"]}
energy = saint_venant(YOUNG, POISSON)


def fall(x):
    return np.stack([0.3 * x[1], -0.2 * x[2], -2.0 + 0.0 * x[0]])


def bounce(body, integrator, t_end=0.012, output=()):
    surface = body.surface(lambda x: x[2] < 1e-9)
    pair = nts.ContactPair(surface, nts.Plane((0, 0, -0.005), (0, 0, 1)), friction=0.2)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -9.81))
    return nts.simulate(system, integrator, dt=1e-3, t_end=t_end, newton=EXACT, output=output)


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", RULES.values(), ids=RULES)
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_a_continuum_of_ones_own_forms(integrator):
    mesh = box()
    space = compat.vector_space(mesh, 1)
    material = nts.StVenantKirchhoff(young=YOUNG, poisson=POISSON)
    known = nts.Continuum(mesh, material, density=RHO, velocity=fall)
    own = nts.FormBody(space, energy, strain=green, density=RHO, velocity=fall)
    runs = [bounce(body, integrator) for body in (known, own)]
    # Those who do not keep the energy say so.
    assert all(run.status.startswith("completed") for run in runs)
    u = [run.state.u[0] for run in runs]
    assert runs[0].balance["active"].max() > 0
    assert COMM.allreduce(np.abs(u[0] - u[1]).max(), op=MPI.MAX) < 1e-11 * 0.02
    if isinstance(integrator, nts.EnergyMomentum):
        balance = runs[1].balance
        assert np.abs(balance["ledger_residual"]).max() < 1e-11 * balance["energy"][0]


def interval(n):
    """A straight line of length 1 in 3D."""
    x = np.linspace(0.0, 1.0, n + 1)[:, None] * np.array([0.6, 0.0, 0.8])
    cells = np.array([[k, k + 1] for k in range(n)])
    mine = slice(None) if COMM.rank == 0 else slice(0, 0)
    return compat.create_mesh(COMM, cells[mine].reshape(-1, 2), x[mine].reshape(-1, 3), "interval")


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast("energy-momentum")
def test_a_string_vibrates_as_its_elements_do(integrator, tmp_path):
    """The sine is a mode of linear elements, and the steps turn its phase by 2 atan(w h/2)."""
    n, tension, rho, dt, size = 8, 50.0, 0.02, 1e-3, 1e-2
    space = compat.vector_space(interval(n), 1)
    along = np.array([0.6, 0.0, 0.8])
    body = nts.FormBody(
        space,
        lambda u: 0.5 * tension * ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx,
        density=rho,
        displacement=lambda x: size * np.outer([0.8, 0.0, -0.6], np.sin(np.pi * (along @ x))),
        bcs=[nts.Dirichlet(lambda x: np.isfinite(x[0]))],
        name="string",
    )
    system = nts.System([body])
    run = nts.simulate(
        system, integrator, dt=dt, t_end=20 * dt, newton=EXACT,
        output=[Fields(COMM.bcast(tmp_path))],
    )  # fmt: skip
    kh = np.pi / n
    w = np.sqrt(6.0 * n**2 * tension / rho * (1.0 - np.cos(kh)) / (2.0 + np.cos(kh)))
    expected = np.cos(20 * 2.0 * np.arctan(0.5 * w * dt)) * body.initial_displacement
    assert run.status == "completed"
    assert np.abs(run.state.u[0] - expected).max(initial=0.0) < 1e-11 * size
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-12 * run.balance["energy"][0]
    if COMM.rank == 0:
        assert "Polyline" in (tmp_path / "string.xdmf").read_text()


def membrane(power=2, strain=True, **options):
    """A free square in 3D that is stretched and turns."""
    square = create_unit_square(MPI.COMM_WORLD, 3, 3)
    cells = compat.geometry_dofmap(square)[: square.topology.index_map(2).size_local]
    ids = np.asarray(square.geometry.input_global_indices)[cells]
    owned = square.geometry.index_map().size_local
    order = np.argsort(COMM.allgather(square.geometry.input_global_indices[:owned])[0])
    assert COMM.size == 1
    x = square.geometry.x[:owned][order] @ np.array([[1, 0, 0], [0, 0.8, 0.6], [0, -0.6, 0.8]])
    mesh = compat.create_mesh(COMM, ids, x, "triangle")
    space = compat.vector_space(mesh, 1)
    normal = np.array([0.0, -0.6, 0.8])
    onto = ufl.as_matrix((np.eye(3) - np.outer(normal, normal)).tolist())

    def surface_strain(u):
        h = ufl.grad(u)
        return 0.5 * (onto * h + h.T * onto + h.T * h)

    def stored(e):
        return (1e3 * ufl.inner(e, e) + 5e2 * ufl.tr(e) ** power) * ufl.dx

    turn = np.array([3.0, -2.0, 8.0])
    return nts.FormBody(
        space,
        stored if strain else lambda u: stored(surface_strain(u)),
        strain=surface_strain if strain else None,
        density=1.5,
        displacement=lambda x: 0.1 * x,
        velocity=lambda x: np.cross(turn, x.T).T + 0.5,
        name="membrane",
        **options,
    )


def spin(body, integrator=None, steps=40):
    integrator = integrator or nts.EnergyMomentum()
    return nts.simulate(nts.System([body]), integrator, dt=4e-3, t_end=steps * 4e-3, newton=EXACT)


@pytest.mark.slow
def test_without_a_strain_the_angular_momentum_drifts():
    balance = spin(membrane(strain=False)).balance
    assert drift(balance, "energy") < 1e-11
    assert drift(balance, "angular_momentum") > 1e-6


@pytest.mark.slow
def test_energy_is_kept_as_far_as_the_points_are_exact():
    """n points integrate dPi/ds of degree 2 n - 1: an energy of degree 2 n."""
    one, two = (
        spin(membrane(power=4), nts.EnergyMomentum(quadrature_points=n)).balance for n in (1, 2)
    )
    assert drift(two, "energy") < 1e-11 < 1e-9 < drift(one, "energy")
    assert drift(one, "angular_momentum") < 1e-11


@pytest.mark.slow
def test_tangent():
    body = membrane(power=4)
    # The points of the test before, whose forms are compiled.
    rule = nts.EnergyMomentum(quadrature_points=2)
    rng, size = np.random.default_rng(1), 1e-5
    u0, u1, du = (0.1 * rng.standard_normal(body.num_owned) for _ in range(3))
    body.begin_step(rule, nts.EvaluationPoint(u0, 0.0))
    difference = (body.internal(u1 + size * du) - body.internal(u1 - size * du)) / (2 * size)
    tangent = body.tangent(u1, 0.0, 1.0)
    x, y = tangent.createVecs()
    x.array_w[:] = du
    tangent.mult(x, y)
    assert np.abs(y.array_r - difference).max() < 1e-8 * np.abs(difference).max()


@pytest.mark.mpi
@pytest.mark.slow
def test_a_block_on_an_elastic_foundation():
    """It rises and falls on its bed with sqrt(k A / m), and comes to rest there by a damper."""
    bed, mesh = 3e4, box()
    space = compat.vector_space(mesh, 1)

    def stored(e, u):
        return energy(1e3 * e) + 0.5 * bed * ufl.inner(u, u) * ufl.ds

    body = nts.FormBody(
        space, stored, strain=lambda u: (green(u), u), density=RHO,
        extra_form=lambda u, v, w, t: 2e3 * ufl.inner(v, w) * ufl.dx, quadrature_degree=2,
    )  # fmt: skip
    settled = nts.equilibrium(nts.System([body], gravity=(0, 0, -1.0)))
    # The bed acts on all six sides of the unit cube.
    sunk = -RHO / (6 * bed)
    assert settled.status == "completed"
    assert np.allclose(settled.state.u[0][2::3], sunk, rtol=1e-3)
    start = nts.FormBody(
        space, stored, strain=lambda u: (green(u), u), density=RHO, displacement=(0, 0, 1e-4),
        quadrature_degree=2,
    )  # fmt: skip
    period = 2 * np.pi / np.sqrt(6 * bed / RHO)
    run = nts.simulate(
        nts.System([start]), nts.EnergyMomentum(), dt=period / 40, t_end=period / 2, newton=EXACT
    )
    assert np.allclose(run.state.u[0][2::3], -1e-4, rtol=0.0, atol=2e-6)


@pytest.mark.mpi
def test_a_mass_of_ones_own():
    mesh = box(cells=1)
    space = compat.vector_space(mesh, 1)

    def coated(v, w):
        return RHO * ufl.inner(v, w) * ufl.dx + 7.0 * ufl.inner(v, w) * ufl.ds

    body = nts.FormBody(space, energy, strain=green, mass=coated)
    assert nts.motion_of(body).mass == pytest.approx(RHO + 6 * 7.0, rel=1e-12)


def test_points_of_a_membrane():
    body = membrane()
    x = np.array([[0.5, 0.5 * 0.8, 0.5 * 0.6], [0.1, 0.16, 0.12]])
    points = body.points(x)
    assert np.allclose(points.at(body.reference), x, atol=1e-14)
    beside = x[:1] + 1e-6 * np.array([0.0, -0.6, 0.8])
    with pytest.raises(ValueError, match="lies in no cell"):
        body.points(beside)


def _heavy_on_one_side(v, w):
    """Positive in all, negative at some nodes."""
    x = ufl.SpatialCoordinate(w.ufl_function_space().ufl_domain())
    return 1e3 * (x[0] - 0.3) * ufl.inner(v, w) * ufl.dx


BAD = [
    (dict(energy=3.0), TypeError, "energy=3.0: pass a callable"),
    (dict(strain="e"), TypeError, "strain='e': pass a callable"),
    (dict(density=None), ValueError, "density=None, mass=None: pass one"),
    (dict(density=-1.0), ValueError, "density=-1.0: must be positive"),
    (dict(density=None, mass=2.0), TypeError, "mass=2.0: pass a callable"),
    (dict(space=3), ValueError, "space=3: pass a continuous Lagrange space"),
    (dict(quadrature_degree=0), ValueError, "quadrature_degree=0: must be a positive integer"),
    (dict(energy=lambda e: 1.0), TypeError, "energy=.* returned an object of type float"),
    (dict(energy=lambda e: 1 / 0), TypeError, "energy=.* raised ZeroDivisionError"),
    (dict(strain=lambda u: u.nothing), TypeError, "energy=.* raised AttributeError"),
    (
        dict(density=None, mass=lambda v, w: v[0] * w[0] * ufl.dx),
        ValueError,
        "mass=.* depends on the direction",
    ),
    (
        dict(density=None, mass=lambda v, w: -ufl.inner(v, w) * ufl.dx),
        ValueError,
        "mass=.* is -1 in all",
    ),
    (
        dict(density=None, mass=_heavy_on_one_side),
        ValueError,
        "mass=.* is -.* at the node x=",
    ),
    (
        dict(density=None, mass=lambda v, w: ufl.inner(v + v.dx(0), w) * ufl.dx),
        ValueError,
        "mass=.* is not symmetric",
    ),
    (dict(density=None, mass=lambda v, w: v[0] * ufl.dx), TypeError, "mass=.* is not linear in"),
    (dict(name=""), ValueError, "name='': is empty"),
    (dict(bcs=[3]), TypeError, r"bcs\[0\]=3: pass a sequence of Dirichlet"),
    (dict(extra_form=3), TypeError, "extra_form=3: pass a callable"),
]


@pytest.mark.mpi
@pytest.mark.parametrize(("change", "kind", "pattern"), BAD, ids=lambda v: str(v)[:30])
def test_bad_input(change, kind, pattern):
    space = compat.vector_space(box(cells=1), 1)
    options = dict(space=space, energy=energy, strain=green, density=RHO) | change
    with pytest.raises(kind, match=pattern):
        nts.FormBody(**options)


@pytest.mark.mpi
def test_spaces_and_surfaces_that_are_refused():
    scalar = compat.function_space(box(cells=1), "Lagrange", 1)
    with pytest.raises(ValueError, match="pass a continuous Lagrange space"):
        nts.FormBody(scalar, energy, density=RHO)
    string = nts.FormBody(
        compat.vector_space(interval(4), 1), lambda u: ufl.inner(u, u) * ufl.dx, density=1.0
    )
    with pytest.raises(ValueError, match="boundaries of 3D meshes, not of intervals"):
        string.surface(lambda x: x[0] < 1.0)
