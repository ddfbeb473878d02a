"""Displacements that are prescribed by what varies in space: functions, Constants, Functions."""

import re

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from scenes import bottom, box, everywhere, top

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
MATERIAL = nts.StVenantKirchhoff(1e5, 0.3)
STRAIN, SPEED = np.array([[0.02, 0.01, 0.0], [0.0, -0.03, 0.0], [0.005, 0.0, 0.01]]), 5.0

pytestmark = pytest.mark.mpi


def stretch(x, t):
    """An affine displacement that grows with time."""
    return SPEED * t * (STRAIN @ x)


def function_of(mesh, degree=1, scale=1.0):
    found = fem.Function(compat.vector_space(mesh, degree))
    found.interpolate(lambda x: scale * (STRAIN @ x))
    return found


def block(value, **options):
    mesh = box(cells=(1, 1, 2))  # no node is inside
    bcs = [nts.Dirichlet(everywhere, value(mesh) if options.pop("of_mesh", False) else value)]
    return nts.Continuum(mesh, MATERIAL, density=1e3, bcs=bcs, **options)


def stored():
    """Energy of the whole strain in a unit cube [J]."""
    h = STRAIN
    e = 0.5 * (h + h.T + h.T @ h)
    mu, lam = MATERIAL.moduli
    return 0.5 * lam * np.trace(e) ** 2 + mu * (e * e).sum()


@pytest.mark.fast("integrator0")
@pytest.mark.parametrize("integrator", [nts.EnergyMomentum(), nts.Newmark()])
def test_a_function_of_place_and_time(integrator):
    """All nodes move with velocities linear in x: kinetic and stored energy in closed form."""
    body = block(stretch)
    run = nts.simulate(nts.System([body]), integrator, dt=0.02, t_end=0.2)
    assert run.status.startswith("completed")
    x, table = body.reference.reshape(-1, 3), run.balance
    u = body.u.x.array[: body.num_owned].reshape(-1, 3)
    np.testing.assert_allclose(u, x @ STRAIN.T, atol=1e-15)
    # The integral of x x^T over the cube.
    moments = np.full((3, 3), 0.25) + np.eye(3) / 12
    kinetic = 0.5 * 1e3 * SPEED**2 * np.trace(STRAIN @ moments @ STRAIN.T)
    np.testing.assert_allclose(table["kinetic"], kinetic, rtol=1e-11)
    np.testing.assert_allclose(table["potential"][-1], stored(), rtol=1e-11)
    if integrator.closes_ledger:
        assert abs(table["ledger_residual"]).max() < 1e-11 * stored()


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.fast("2")
@pytest.mark.fast_on_ranks()
def test_a_function_of_dolfinx(degree):
    """In equilibrium; of another degree it is interpolated."""
    body = block(lambda mesh: function_of(mesh, degree), of_mesh=True)
    run = nts.equilibrium(nts.System([body]), load_steps=2)
    np.testing.assert_allclose(run.balance["potential"][-1], stored(), rtol=1e-11)


@pytest.mark.slow
def test_a_function_changed_between_steps_moves_the_nodes():
    mesh = box()
    moved = function_of(mesh, scale=0.0)
    body = nts.Continuum(mesh, MATERIAL, density=1e3, bcs=[nts.Dirichlet(bottom, moved)])

    def turn(time, dt):
        moved.interpolate(lambda x: (time + dt) * SPEED * (STRAIN @ x))

    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=0.02, t_end=0.1, before_step=turn
    )
    assert run.status == "completed"
    x = body.reference.reshape(-1, 3)
    u = body.u.x.array[: body.num_owned].reshape(-1, 3)
    low = bottom(x.T)
    np.testing.assert_allclose(u[low], 0.1 * SPEED * x[low] @ STRAIN.T, atol=1e-15)
    table = run.balance
    assert abs(table["ledger_residual"][-1]) < 1e-9 * table["external_work"][-1]


def test_a_constant_moves_the_nodes():
    """By work that the ledger has."""
    mesh = box()
    place = fem.Constant(mesh, np.zeros(3))
    bcs = [nts.Dirichlet(bottom), nts.Dirichlet(top, place, components=(2,))]
    body = nts.Continuum(mesh, MATERIAL, density=1e3, bcs=bcs)
    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum())
    for k in range(3):
        place.value[2] = -0.01 * k
        stepper.advance(1e-3)
    stepper.close()
    x = body.reference.reshape(-1, 3)
    u = body.u.x.array[: body.num_owned].reshape(-1, 3)
    np.testing.assert_allclose(u[top(x.T), 2], -0.02, atol=1e-15)
    table = stepper.solution.balance
    assert abs(table["ledger_residual"][-1]) < 1e-9 * table["external_work"][-1]


def test_a_body_starts_as_functions_say():
    mesh = box()
    body = nts.Continuum(
        mesh, MATERIAL, density=1e3, velocity=function_of(mesh, 2), displacement=function_of(mesh)
    )
    x = body.reference.reshape(-1, 3)
    for values in (body.initial_velocity, body.initial_displacement):
        np.testing.assert_allclose(values.reshape(-1, 3), x @ STRAIN.T, atol=1e-15)


def raising(x, t):
    raise KeyError("table") if COMM.rank == COMM.size - 1 else KeyError("other")


def test_what_fails_is_told_on_all_ranks():
    mesh = box()
    text = r"^Dirichlet.value of bcs\[0\] .* at t=0.0, called with \(x, t\)=.*KeyError"
    with pytest.raises(ValueError, match=text):
        block(raising)
    with pytest.raises(ValueError, match=r"returned shape \(3,\) for x of shape \(3, \d+\)"):
        block(lambda x, t: np.zeros(3))
    with pytest.raises(ValueError, match=r"with the time: one that varies .* takes \(x, t\)"):
        block(lambda x: 0.1 * x[0])
    with pytest.raises(ValueError, match="is on another mesh; make it on that of the body"):
        nts.Continuum(box(), MATERIAL, density=1e3, bcs=[nts.Dirichlet(top, function_of(mesh))])
    for degree in (0, 1):
        broken = fem.Function(compat.function_space(mesh, "DG", degree, (3,)))
        words = "may have several values at a node; interpolate it into a continuous space"
        with pytest.raises(ValueError, match=f"^Dirichlet.value of .*: {words}"):
            nts.Continuum(mesh, MATERIAL, density=1e3, bcs=[nts.Dirichlet(top, broken)])
        with pytest.raises(ValueError, match=f"^velocity=.* of 'body': {words}"):
            nts.Continuum(mesh, MATERIAL, density=1e3, velocity=broken)
    with pytest.raises(TypeError, match=r"value=.*: is of UFL \(\w+\); pass three .*Func"):
        nts.Dirichlet(top, ufl.SpatialCoordinate(mesh))
    with pytest.raises(ValueError, match=r"Dirichlet.value=.*: has shape \(\); pass a function"):
        nts.Dirichlet(top, fem.Constant(mesh, 1.0))
    with pytest.raises(TypeError, match=r"Traction.value=.*: is of UFL \(Constant\); pass"):
        nts.Traction(top, fem.Constant(mesh, np.ones(3)))
    with pytest.raises(ValueError, match=r"^velocity=.*: pass three finite components .* Function"):
        nts.Continuum(mesh, MATERIAL, density=1e3, velocity=ufl.SpatialCoordinate(mesh))


def test_values_that_fail_in_a_run_end_it():
    def lost(x, t):
        return 0.0 * x if t < 0.05 else np.full_like(x, np.nan)

    body = block(lost)
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=0.02, t_end=0.2)
    assert "Dirichlet.value of bcs[0] of 'body' at t=0.06" in run.status
    assert "not finite at x=" in run.status


@pytest.mark.parametrize("degree", [1, 2])
def test_nodes_inside_that_a_marker_holds_at_are_told(caplog, degree):
    """Of 4^3 cells 3^3 nodes lie inside, of degree 2 there are 7^3; below z = 0.3 9, or 49 x 2."""
    mesh = box(cells=(4, 4, 4))
    told = {}
    for height in (0.0, 0.3, 1.0):
        caplog.clear()
        held = nts.Dirichlet(lambda x, h=height: x[2] <= h + 1e-9)
        nts.Continuum(
            mesh, nts.NeoHookean(1e6, 0.3), density=1e3, bcs=[held], degree=degree, name="cube"
        )
        text = "".join(COMM.allgather("\n".join(r.getMessage() for r in caplog.records)))
        found = re.findall(r"Dirichlet.where of bcs\[0\] of 'cube': is true at (\d+) nodes", text)
        assert len(found) == (height > 0)
        told[height] = int(found[0]) if found else 0
    assert told == ({0.0: 0, 0.3: 9, 1.0: 27} if degree == 1 else {0.0: 0, 0.3: 98, 1.0: 343})
