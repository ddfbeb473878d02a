"""Coulomb friction: the law alone, and what two blocks that rub against each other must keep."""

import math

from mpi4py import MPI

import noise
import numpy as np
import pytest
from dolfinx.mesh import CellType
from integrators import CONTACT_RULES
from pairs import pairs
from scenes import CELLS, box, rubbing_blocks
from twins.friction import return_map

import dolfinx_nts as nts
from dolfinx_nts.contact import contact_law
from dolfinx_nts.contact.contact_law import Rub
from dolfinx_nts.kernels import facets
from dolfinx_nts.kernels.nts_element import invariants, metric, projection
from dolfinx_nts.solve.convergence import ratios

COMM = MPI.COMM_WORLD


# ---- the law
def random_law(n=200):
    rng = np.random.default_rng(3)
    a = rng.normal(size=(n, 2, 2))
    metric = a @ a.transpose(0, 2, 1) + 0.1 * np.eye(2)
    t, s = rng.normal(size=(2, n, 2))
    return t, s, metric, 3.0 * rng.random(n), rng.uniform(0.1, 2.0, n)


def test_return_map_derivatives():
    t, s, m, bound, c = random_law()
    law, step = return_map(t, s, m, bound, c), 1e-6
    assert 20 < law.stick.sum() < 180

    def difference(*change):
        ends = [
            return_map(
                *(a + k * step * d for a, d in zip((t, s, m, bound), change, strict=True)), c
            )
            for k in (1, -1)
        ]
        return (ends[0].residual - ends[1].residual) / (2 * step)

    rng = np.random.default_rng(4)
    dt, ds, dm, db = (rng.normal(size=a.shape) for a in (t, s, m, bound))
    dm += dm.transpose(0, 2, 1)
    expected = np.einsum("nab,nb->na", law.d_multiplier, dt)
    expected += np.einsum("nab,nb->na", law.d_slip, ds)
    expected += np.einsum("nabc,nbc->na", law.d_metric, dm) + law.d_bound * db[:, None]
    assert np.abs(difference(dt, ds, dm, db) - expected).max() < 1e-7


def test_slip_force_is_parallel_to_the_slip_whatever_c():
    _, s, m, bound, c = random_law()
    length = np.sqrt(np.einsum("na,nab,nb->n", s, m, s))
    t = bound[:, None] * np.einsum("nab,nb->na", m, s) / length[:, None]
    for factor in (1e-6, 1.0, 1e6):
        law = return_map(t, s, m, bound, factor * c)
        assert not law.stick.any()
        assert np.abs(law.residual).max() < 1e-14 * np.abs(t).max()


def test_without_pressure_there_is_no_friction():
    t, s, m, bound, c = random_law()
    law = return_map(t, s, m, 0 * bound, c)
    assert np.array_equal(law.residual, t)
    at_rest = return_map(0 * t, 0 * s, m, 0 * bound, c)
    assert at_rest.stick.all() and not at_rest.residual.any()


@pytest.mark.parametrize("nc", [3, 4])
def test_projection_and_metric_derivatives(nc):
    rng = np.random.default_rng(nc)
    n, size, step = 6, 3 * (nc + 1), 1e-6
    corner = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])[:nc]
    x = np.concatenate([[[0.3, 0.3, 0.2]], corner]) + 0.1 * rng.normal(size=(n, nc + 1, 3))
    weight = rng.normal(size=(n, 2))

    def foot(x):
        xi, converged = facets.project(x[:, 0], x[:, 1:], np.full((n, 2), 0.3))
        assert converged.all()
        return xi

    at = projection(x, foot(x), weight)
    for k in range(size):
        shift = np.zeros(size)
        shift[k] = step
        ends = [x + sign * shift.reshape(nc + 1, 3) for sign in (1, -1)]
        a, b = (projection(e, foot(e), weight) for e in ends)
        slope = (foot(ends[0]) - foot(ends[1])) / (2 * step)
        assert np.abs(slope - at.gradient[:, :, k]).max() < 1e-8
        bend = np.einsum("na,naz->nz", weight, a.gradient - b.gradient) / (2 * step)
        assert np.abs(bend - at.hessian[:, :, k]).max() < 1e-7
        stretch = (a.metric - b.metric) / (2 * step)
        assert np.abs(stretch - at.metric_gradient[..., k]).max() < 1e-8
    z = np.concatenate([x.reshape(n, -1), rng.normal(size=(n, 3)), foot(x)], axis=1)
    pi = invariants(z, nc)
    value, gradient = metric(pi, nc)
    assert np.abs(value - at.metric).max() < 1e-14
    change = rng.normal(size=pi.shape)
    ends = [metric(pi + sign * step * change, nc)[0] for sign in (1, -1)]
    expected = np.einsum("nabp,np->nab", gradient, change)
    assert np.abs((ends[0] - ends[1]) / (2 * step) - expected).max() < 1e-8


# ---- two blocks
def run(system, integrator="energy-momentum", t_end=0.08, **options):
    result = nts.simulate(system, CONTACT_RULES[integrator], dt=2e-3, t_end=t_end, **options)
    assert result.status == "completed"
    return result


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integrator", "friction", "cell"), pairs(CONTACT_RULES, [0.3, math.inf], CELLS)
)
@pytest.mark.fast("energy-momentum-0.3-tetrahedron")
@pytest.mark.fast_on_ranks()
def test_friction_keeps_the_momenta_and_the_ledger(integrator, friction, cell):
    table = run(rubbing_blocks(friction, cell=CELLS[cell]), integrator).balance
    energy = table["energy"][0]
    for name in ("linear_momentum", "angular_momentum"):
        top = np.abs(table[name][0]).max()
        assert np.abs(table[name] - table[name][0]).max() < 1e-12 * top
    dissipation = table["friction_dissipation"]
    assert np.diff(dissipation).min() > -1e-15 * energy
    if math.isinf(friction):
        assert not dissipation.any() and table["slip"].max() == 0
        assert table["stick"].max() >= 9
    else:
        assert dissipation[-1] > 5e-3 * energy and table["slip"].max() >= 4
    if integrator != "midpoint":
        assert np.abs(np.diff(table["ledger_residual"])).max() < 1e-11 * energy
        assert np.abs(table["ledger_residual"]).max() < 1e-10 * energy
    assert table["min_gap"].min() > -1e-10


@pytest.mark.slow
@pytest.mark.mpi
def test_stick_and_slip_occur_together_and_h_may_change():
    stepper = nts.Stepper(rubbing_blocks(0.3), nts.EnergyMomentum())
    for k in range(60):
        stepper.advance((2e-3, 0.7e-3, 1.5e-3)[k % 3])
    table = stepper.solution.balance
    stepper.close()
    energy = table["energy"][0]
    assert ((table["stick"] > 0) & (table["slip"] > 0)).sum() >= 3
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy
    assert np.diff(table["friction_dissipation"]).min() > -1e-15 * energy


@pytest.mark.parametrize("integrator", ["midpoint", "energy-momentum"])
@pytest.mark.slow
def test_a_solution_is_one_for_any_algorithmic_scale(integrator, monkeypatch):
    """Of every step, beyond the scales at which Newton finds it from afar: over eight decades."""
    stepper = nts.Stepper(
        rubbing_blocks(0.3), CONTACT_RULES[integrator], newton=nts.Newton(rtol=1e-14)
    )
    problem, nominal = stepper.problem, contact_law.TANGENTIAL_SCALE
    problem_rtol, both = problem.rtol, 0
    for _ in range(40):
        stepper.advance(2e-3)
        own = problem.evaluate(problem.x).parts[0]
        both += bool(own.stick.any() and (own.active & ~own.stick).any())
        problem.rtol = 1e-10
        for factor in 10.0 ** np.arange(-4, 5):
            monkeypatch.setattr(contact_law, "TANGENTIAL_SCALE", factor * nominal)
            problem.couplings.contacts.rub(Rub.LAW)  # what is known of the law is forgotten
            other = problem.evaluate(problem.x)
            assert np.array_equal(other.parts[0].stick, own.stick)
            assert max(ratios(problem, other).values()) <= 1.0
        monkeypatch.setattr(contact_law, "TANGENTIAL_SCALE", nominal)
        problem.rtol = problem_rtol
    stepper.close()
    assert both >= 3


# ---- prescribed coordinates and nodal results
def plane_strain_slider(friction, integrator, speed=0.0):
    """A block pressed on a plate, both held across: the slip has one free direction only."""
    across = nts.Dirichlet(lambda x: np.full(x.shape[1], True), components=(2,))
    whole = nts.Dirichlet(lambda x: np.full(x.shape[1], True))
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    kind = CellType.hexahedron
    meshes = [
        box(low, high, n, kind)
        for low, high, n in (
            ([0.2, 0, 0], [0.8, 0.5, 0.3], [3, 2, 1]),
            ([-1, -0.5, 0], [2, 0, 0.3], [4, 1, 1]),
        )
    ]
    block = nts.Continuum(
        meshes[0], rubber, density=1e3, bcs=[across], velocity=(speed, 0, 0), name="block"
    )
    plate = nts.Continuum(meshes[1], rubber, density=1e3, bcs=[whole], name="plate")
    pair = nts.ContactPair(
        slave=block.surface(lambda x: x[1] < 1e-9),
        master=plate.surface(lambda x: x[1] > -1e-9),
        friction=friction,
    )
    system = nts.System([block, plate], contacts=[pair], gravity=(0, -9.81, 0))
    stepper = nts.Stepper(system, CONTACT_RULES[integrator])
    for _ in range(20):
        stepper.advance(1e-3)
    return stepper


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
@pytest.mark.parametrize(("friction", "speed"), [(math.inf, 0.0), (0.5, 0.0), (0.2, 1.0)])
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("inf-0.0-midpoint")
def test_prescribed_tangential_direction_carries_no_force(friction, speed, integrator):
    stepper = plane_strain_slider(friction, integrator, speed)
    state = stepper.state
    force, tangential = state.contacts[0].force, state.contacts[0].tangential
    top = COMM.allreduce(force.max(initial=0.0), op=MPI.MAX)
    assert top > 0
    assert np.abs(tangential[:, 1:]).max(initial=0.0) < 1e-9 * top
    if speed:
        assert np.allclose(tangential[force > 0, 0], -friction * force[force > 0], rtol=1e-9)
        assert not state.contacts[0].stick.any()
        assert np.abs(state.contacts[0].slip - 0.02 * speed).max(initial=0.0) < 2e-3
    elif math.isinf(friction):
        assert np.array_equal(state.contacts[0].stick, force > 0)
        assert state.contacts[0].slip.max(initial=0.0) < 1e-12
    else:
        bound = friction * force * (1 + 1e-9)
        assert (np.linalg.norm(tangential, axis=1) <= bound).all()
    stepper.close()


@pytest.mark.parametrize("friction", [-0.1, math.nan, "a", None, True])
def test_bad_coefficient(friction):
    with pytest.raises(ValueError, match="friction=.*pass a number >= 0"):
        rubbing_blocks(friction)


@pytest.mark.parametrize("seed", range(3))
def test_what_rests_at_its_bound_sticks(seed, monkeypatch):
    """Its corners slipped in equilibrium; rounding must not tell which of them slip at rest."""
    mesh = box(high=(1.0, 1.0, 0.5), cells=(3, 3, 2))
    block = nts.Continuum(mesh, nts.NeoHookean(young=1e6, poisson=0.3), density=1e3, name="block")
    floor = nts.Plane((0, 0, 0), (0, 0, 1), name="floor")
    pair = nts.ContactPair(block.surface(lambda x: x[2] < 1e-9), floor, friction=0.3)
    steep = np.arctan(0.28)
    system = nts.System(
        [block], contacts=[pair], gravity=(9.81 * np.sin(steep), 0.0, -9.81 * np.cos(steep))
    )
    settled = nts.equilibrium(system, load_steps=1, newton=nts.Newton(rtol=1e-14))
    assert settled.status.startswith("completed") and settled.balance["slip"][-1] >= 4
    noise.install("both", seed, monkeypatch.setattr)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=1.01, start=settled)
    assert run.status.startswith("completed")
    assert run.balance["kinetic"].max() < 1e-18 * 500 * 9.81
    assert (run.balance["stick"][1:] == run.balance["active"][1:]).all()
