"""`volume="projected"` against an independent program, published figures and finite differences."""

import numpy as np
import pytest
from cells import COMM, DEFLECTION, bar, between, differences, distorted, largest, own_energy
from dolfinx import fem
from dolfinx.mesh import CellType, create_box
from integrators import MID_STEP
from measures import STENCIL
from rotations import rotation
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.bodies.solid.step_forms import fill
from dolfinx_nts.integrators.static import EQUILIBRIUM
from dolfinx_nts.interaction.evaluation import EvaluationPoint


def body_of(mesh, material=None, **options):
    given = {"density": 1e3, "volume": "projected", **options}
    return nts.Continuum(mesh, material or nts.NeoHookean(young=1e6, poisson=0.45), **given)


# ---- bending
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cells", "poisson", "share"),
    [
        ((20, 2, 2), 0.3, 94.3), ((20, 1, 1), 0.3, 116.1), ((10, 1, 1), 0.3, 87.1),
        ((20, 2, 2), 0.4999, 94.3), ((20, 1, 1), 0.4999, 136.1), ((20, 2, 2), 0.499999, 94.3),
    ],
)  # fmt: skip
@pytest.mark.fast(
    "cells1-0.3-116.1",
    "cells3-0.4999-94.3",
    "cells4-0.4999-136.1",
    "cells5-0.499999-94.3",
)
def test_bars_bend_as_in_another_program(cells, poisson, share):
    """Theory 19.5, per cent of the reference."""
    found = bar(cells, poisson, volume="projected") / DEFLECTION[poisson]
    assert 100.0 * found == pytest.approx(share, abs=0.1)


@pytest.mark.slow
def test_cook_s_membrane():
    """Deflection of the middle of the loaded side in plane strain: 16.4326 (Krysl, FinEALE).

    With n = 16 it is 16.12: the second term of the energy makes cells stiffer than projection alone
    does (16.19 here, 16.2 in theory 19.5).
    """
    n = 32
    mesh = box(cells=(n, n, 1))
    x = mesh.geometry.x
    s, t = x[:, 0].copy(), x[:, 1].copy()
    x[:, 0], x[:, 1] = 48.0 * s, 44.0 * s + t * (44.0 - 28.0 * s)
    mu, lam, load = 0.375, 7500.0, 1e-5
    poisson = lam / (2 * (lam + mu))
    body = body_of(
        mesh, nts.NeoHookean(young=2 * mu * (1 + poisson), poisson=poisson),
        bcs=[
            nts.Dirichlet(lambda x: x[0] < 1e-9),
            nts.Dirichlet(lambda x: x[2] > -1.0, components=[2]),
        ],
        traction=[nts.Traction(lambda x: x[0] > 48 - 1e-9, (0.0, load / 16.0, 0.0))],
    )  # fmt: skip
    assert nts.equilibrium(nts.System([body])).status == "completed"
    at = body.reference.reshape(-1, 3)
    middle = np.abs(at[:, :2] - [48.0, 52.0]).max(axis=1) < 1e-9
    found = largest(body.u.x.array[: body.num_owned].reshape(-1, 3)[middle, 1]) / load
    assert found == pytest.approx(16.4326, rel=0.01)


# ---- forces
OF = {"neo-Hookean": nts.NeoHookean(young=1.0, poisson=0.4), "own": own_energy}


@pytest.mark.parametrize("name", OF)
def test_forces_are_the_slope_of_the_energy(name):
    body = body_of(distorted(), OF[name])
    _, u = between(body)
    found = body._forms.forces(EQUILIBRIUM, u, u)
    slope = differences(body.potential, u)
    assert np.abs(found - slope).max() < 1e-9 * np.abs(slope).max()


@pytest.mark.parametrize("name", OF)
@pytest.mark.fast("own")
def test_work_is_the_change_of_the_energy(name):
    body = body_of(distorted(), OF[name])
    u0, u1 = between(body)
    work = body._forms.forces(nts.EnergyMomentum(), u0, u1) @ (u1 - u0)
    change = body.potential(u1) - body.potential(u0)
    assert abs(work - change) < 1e-14 * body.potential(u1)


def test_small_motions_keep_their_digits():
    """Energies of motions a million times smaller differ by its square."""
    body = body_of(distorted(), OF["neo-Hookean"])
    u0, u1 = 1e-6 * between(body)
    work = body._forms.forces(nts.EnergyMomentum(), u0, u1) @ (u1 - u0)
    change = body.potential(u1) - body.potential(u0)
    assert abs(work - change) < 1e-13 * body.potential(u1)


@pytest.mark.parametrize("rule", [*MID_STEP.values(), EQUILIBRIUM], ids=[*MID_STEP, "static"])
@pytest.mark.fast("energy-momentum", "static")
def test_tangent(rule):
    """With some coordinates prescribed, whose rows and columns hold the diagonal alone."""
    body = body_of(distorted(), bcs=[nts.Dirichlet(lambda x: x[0] < 0.3, components=[1])])
    u0, u1 = between(body)
    moment = EvaluationPoint(u0, 0.0)
    body.begin_step(rule, moment)
    matrix = body.tangent(u1, 0.0, 1.0)
    expected = differences(body.internal, u1)
    free = np.setdiff1d(np.arange(len(u1)), body.fixed)
    found = matrix[:, :]
    scale = np.abs(expected).max()
    assert np.abs((found - expected)[np.ix_(free, free)]).max() < 1e-8 * scale
    assert not found[np.ix_(body.fixed, free)].any() and not found[np.ix_(free, body.fixed)].any()


@pytest.mark.mpi
def test_tangent_on_ranks():
    """K x against differences, where nodes of a cell belong to several ranks."""
    body = body_of(box(cells=(3, 2, 2)))
    x = body.reference.reshape(-1, 3)
    u, way = 0.05 * np.sin(3 * x[:, [1, 2, 0]]).ravel(), np.cos(4 * x[:, [2, 0, 1]]).ravel()
    body.begin_step(EQUILIBRIUM, EvaluationPoint(0 * u, 0.0))
    matrix = body.tangent(u, 0.0, 1.0)
    to, out = matrix.createVecs()
    to.array_w[:] = way
    matrix.mult(to, out)
    expected = sum(w * body.internal(u + 1e-3 * k * way) for k, w in STENCIL) / 1e-3
    assert largest(out.array_r - expected) < 1e-8 * largest(expected)


def test_uniform_strain_is_that_of_the_law():
    """Where J is the same everywhere, nothing is projected: patch test with any affine motion."""
    mesh = distorted()
    whole, full = body_of(mesh), body_of(mesh, volume="full")
    f = rotation(0.7, (1.0, 2.0, 3.0)) @ np.array([[1.3, 0.2, 0.0], [0.0, 0.9, 0.1], [0, 0, 1.1]])
    u = (whole.reference.reshape(-1, 3) @ (f - np.eye(3)).T).ravel()
    forces = [b._forms.forces(EQUILIBRIUM, u, u) for b in (whole, full)]
    assert np.abs(forces[0] - forces[1]).max() < 1e-12 * np.abs(forces[1]).max()
    stresses = []
    for body in (whole, full):
        fill(body.u, u)
        stresses.append(nts.cauchy_stress(body).x.array)
    assert np.abs(stresses[0] - stresses[1]).max() < 1e-12 * np.abs(stresses[1]).max()


def test_stress_balances_a_load():
    """Mean stress over a section of a squeezed block, nearly incompressible, is force over area."""
    body = body_of(
        box(cells=(3, 3, 3)), nts.NeoHookean(young=1e6, poisson=0.4999),
        bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)],
        traction=[nts.Traction(lambda x: x[2] > 1 - 1e-9, (0.0, 0.0, -1e2))],
    )  # fmt: skip
    assert nts.equilibrium(nts.System([body])).status == "completed"
    stress = nts.cauchy_stress(body, at="cells").x.array.reshape(-1, 3, 3)[:, 2, 2]
    # Layers of nine cells each, of equal volume.
    local = np.array([stress.sum(), len(stress)])
    total, count = COMM.allreduce(local)
    assert total / count == pytest.approx(-1e2, rel=1e-3)


# ---- parameters and refusals
def test_parameters_may_change_between_steps():
    """Half the modulus halves the energy, the second term included."""
    mesh = distorted()
    young = fem.Constant(mesh, 2.0)
    body = body_of(mesh, nts.NeoHookean(young=young, poisson=0.4))
    _, u = between(body)
    stiff, of_nodes = body.potential(u), body.nodal_stiffness().copy()
    young.value = 1.0
    body.take_parameters()
    assert body.nodal_stiffness() == pytest.approx(0.5 * of_nodes, rel=1e-12)
    assert body.potential(u) == pytest.approx(0.5 * stiff, rel=1e-14)


@pytest.mark.parametrize(
    ("kind", "options", "told"),
    [
        (CellType.tetrahedron, {}, "tetrahedrons of degree 2"),
        (CellType.hexahedron, {"degree": 2}, "hexahedrons of degree 2"),
        (CellType.hexahedron, {"volume": "mean"}, "volume='mean'"),
    ],
)
def test_refused(kind, options, told):
    mesh = create_box(COMM, ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), (2, 2, 2), kind)
    with pytest.raises(ValueError, match=told):
        body_of(mesh, **options)
