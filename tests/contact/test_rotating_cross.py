"""Rotating bodies: what both integrators conserve, and how far they turn in a step."""

from mpi4py import MPI

import numpy as np
import pytest
import rotating_cross as demo
from scenes import box

import dolfinx_nts as nts

SPIN = 1e3 * (1 / 6 + 4 * 14.5) * demo.OMEGA


def check_conserved(result, t_end):
    assert result["status"] == "completed" and result["time"] == pytest.approx(t_end)
    assert result["angular_momentum"] == pytest.approx(SPIN)
    assert result["energy"] == pytest.approx(SPIN * demo.OMEGA / 2)
    assert result["energy_drift"] < 1e-12
    assert result["angular_momentum_drift"] < 1e-11


@pytest.mark.mpi
def test_energy_momentum_conserves_and_midpoint_does_not():
    results = demo.main(steps=(0.05,), t_end=0.5)
    check_conserved(results["energy-momentum", 0.05], 0.5)
    midpoint = results["midpoint", 0.05]
    assert midpoint["angular_momentum_drift"] < 1e-11
    assert midpoint["energy_drift"] > 1e-3


@pytest.mark.slow
def test_midpoint_blows_up_with_large_steps():
    times = {0.01: 2.0, 0.02: 2.0, 0.05: 5.0, 0.1: 5.0}
    results = demo.main(steps=(0.01, 0.02), t_end=2.0) | demo.main(steps=(0.05, 0.1), t_end=5.0)
    for dt, t_end in times.items():
        check_conserved(results["energy-momentum", dt], t_end)
        assert results["midpoint", dt]["angular_momentum_drift"] < 1e-11
    drift = [results["midpoint", dt]["energy_drift"] for dt in (0.01, 0.02)]
    assert np.log2(drift[1] / drift[0]) == pytest.approx(2, abs=0.1)
    large = results["midpoint", 0.1]
    assert large["energy_drift"] > 1 and large["status"] != "completed"


@pytest.mark.slow
@pytest.mark.mpi
def test_nearly_rigid_cube_turns_by_two_arctan_a_step():
    comm, omega, dt, steps = MPI.COMM_WORLD, 1.0, 0.1, 100
    mesh = box([-1, -1, -1], [1, 1, 1], [2, 1, 1], comm=comm)
    body = nts.Continuum(
        mesh, nts.StVenantKirchhoff(young=1e10, poisson=0.0), density=1.0,
        velocity=lambda x: omega * np.stack([-x[1], x[0], 0 * x[2]]),
    )  # fmt: skip
    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum())
    angle = [0.0]
    for _ in range(steps):
        x = body.reference.reshape(-1, 3)
        y = x + stepper.advance(dt).u[0].reshape(-1, 3)
        turned = [x[:, 0] @ y[:, 1] - x[:, 1] @ y[:, 0], x[:, 0] @ y[:, 0] + x[:, 1] @ y[:, 1]]
        angle.append(np.arctan2(*comm.allreduce(np.array(turned))))
    total = np.unwrap(angle)[-1]
    assert total == pytest.approx(2 * steps * np.arctan(omega * dt / 2), abs=1e-6)
    assert total == pytest.approx(9.991680, abs=2e-6)
    energy = stepper.solution.balance["energy"]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-12)
