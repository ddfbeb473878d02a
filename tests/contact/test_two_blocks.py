"""B1, the oblique impact of two cubes: what each integrator keeps, on any mesh, unit and rank."""

from mpi4py import MPI

import numpy as np
import pytest
import two_blocks
from dolfinx.mesh import CellType
from integrators import MID_STEP
from scenes import UNITS

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
ENERGY_MOMENTUM = MID_STEP["energy-momentum"]
#: Energy lost to activation in B1 (benchmarks.md).
REFERENCE_LOSS = 0.051


def impact(comm=COMM, integrator=ENERGY_MOMENTUM, t_end=0.2, newton=None, **scene):
    return nts.simulate(
        two_blocks.scene(comm, **scene), integrator, dt=2e-3, t_end=t_end, newton=newton
    )


def assert_conserved(result, ledger=1e-11):
    assert result["status"] == "completed"
    assert result["ledger"] <= ledger
    assert result["linear_momentum"] <= 1e-12
    assert result["angular_momentum"] <= 1e-12
    assert result["min_gap"] >= -1e-10
    assert abs(result["energy_lost"] - result["contact_defect"]) <= ledger


@pytest.mark.slow
@pytest.mark.mpi
def test_demo_reaches_the_reference_figures():
    results = two_blocks.main(COMM)
    scheme, midpoint = results["energy-momentum"], results["midpoint"]
    assert_conserved(scheme)
    assert abs(scheme["energy_lost"] - REFERENCE_LOSS) <= 5e-4
    assert scheme["max_active"] == 25
    # The midpoint rule keeps the momenta but leaves the ledger open.
    assert midpoint["linear_momentum"] <= 1e-12
    assert midpoint["angular_momentum"] <= 1e-12
    assert midpoint["min_gap"] >= -1e-10
    assert midpoint["ledger"] > 1e-6


VARIANTS = {
    "gonzalez contact": (nts.EnergyMomentum(contact_gradient="gonzalez"), {}),
    "StVK": (ENERGY_MOMENTUM, {"material": nts.StVenantKirchhoff(young=1e6, poisson=0.3)}),
    "Mooney-Rivlin": (ENERGY_MOMENTUM, {"material": nts.MooneyRivlin(a=1.5e5, b=4e4, c=6e5)}),
    "tetrahedra": (ENERGY_MOMENTUM, {"cell_type": CellType.tetrahedron}),
}


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_ledger_closes_for(variant):
    integrator, scene = VARIANTS[variant]
    result = two_blocks.figures(impact(integrator=integrator, t_end=0.12, **scene))
    assert_conserved(result)
    assert 0.04 < result["energy_lost"] < 0.06


@pytest.mark.slow
def test_mean_value_stress_closes_to_quadrature_error():
    result = two_blocks.figures(impact(integrator=nts.EnergyMomentum(stress="mean-value")))
    assert_conserved(result)


@pytest.mark.mpi
@pytest.mark.slow
def test_ledger_closes_when_the_step_changes():
    stepper = nts.Stepper(two_blocks.scene(COMM), ENERGY_MOMENTUM)
    for k in range(60):
        stepper.advance((2e-3, 1e-3, 0.7e-3)[k % 3])
    stepper.solution.status = "completed"
    assert stepper.solution.balance["active"].max() == 25
    assert_conserved(two_blocks.figures(stepper.solution))
    stepper.close()


@pytest.mark.slow
def test_bodies_of_a_micrometre():
    """The same physics at any size: lengths and times scaled together, speeds kept."""
    runs = []
    for metre in (1.0, *(1 / m for m in UNITS)):
        system = two_blocks.scene(MPI.COMM_SELF, metre=metre, speed=2.0)
        run = nts.simulate(system, ENERGY_MOMENTUM, dt=2e-3 * metre, t_end=0.08 * metre)
        assert run.status == "completed" and run.retries == 0
        runs.append(run.balance)
    for run, metre in zip(runs[1:], (1 / m for m in UNITS), strict=True):
        assert np.array_equal(run["newton_iterations"], runs[0]["newton_iterations"])
        assert np.allclose(run["energy"] / metre**3, runs[0]["energy"], rtol=1e-9, atol=0)


@pytest.mark.mpi
@pytest.mark.slow
def test_field_split_finds_the_same_solution():
    options = {
        "ksp_type": "fgmres",
        "ksp_rtol": 1e-8,
        "pc_type": "fieldsplit",
        "pc_fieldsplit_type": "schur",
        "pc_fieldsplit_schur_fact_type": "full",
        "pc_fieldsplit_schur_precondition": "selfp",
        "fieldsplit_bodies_ksp_type": "preonly",
        "fieldsplit_bodies_pc_type": "lu",
        "fieldsplit_bodies_pc_factor_mat_solver_type": "mumps",
        "fieldsplit_constraints_ksp_type": "gmres",
        "fieldsplit_constraints_ksp_rtol": 1e-10,
        "fieldsplit_constraints_pc_type": "lu",
        "fieldsplit_constraints_pc_factor_mat_solver_type": "mumps",
    }
    system = two_blocks.scene(COMM, cells=(4, 2))
    run = nts.simulate(system, ENERGY_MOMENTUM, dt=2e-3, t_end=0.04, petsc_options=options)
    direct = impact(t_end=0.04, cells=(4, 2))
    assert run.status == "completed"
    energy = direct.balance["energy"]
    assert np.abs(run.balance["energy"] - energy).max() <= 1e-11 * energy[0]
