"""Viscosity of solids: what it takes, order, closed forms, and what it leaves as it is."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from dolfinx.mesh import CellType
from integrators import INTEGRATORS, MID_STEP
from scenes import RUBBER, bottom, box, everywhere

import dolfinx_nts as nts

DENSITY = 1e3

#: Type and options of bodies by their cells.
KINDS = {
    "hexahedra": (CellType.hexahedron, {}),
    "projected": (CellType.hexahedron, {"volume": "projected"}),
    "tetrahedra": (CellType.tetrahedron, {}),
    "degree 2": (CellType.tetrahedron, {"degree": 2}),
}


def flying(kind="hexahedra", viscosity=300.0):
    """A soft block that spins and is stretched while it flies."""
    cell, options = KINDS[kind]

    def velocity(x):
        return 3.0 * np.sin(3 * x[[1, 2, 0]]) + np.cross([1.0, 2.0, 3.0], x.T).T

    return nts.Continuum(
        box(cells=(3, 2, 1), cell=cell), nts.NeoHookean(1e5, 0.4), density=DENSITY,
        viscosity=viscosity, velocity=velocity, **options,
    )  # fmt: skip


@pytest.mark.mpi
@pytest.mark.fast("hexahedra-energy-momentum", "hexahedra-midpoint")
@pytest.mark.fast_on_ranks()
@pytest.mark.parametrize(
    ("kind", "rule"),
    [*((kind, "energy-momentum") for kind in KINDS), ("hexahedra", "midpoint")],
)  # fmt: skip
def test_ledger_and_momenta_in_free_flight(kind, rule):
    run = nts.simulate(nts.System([flying(kind)]), MID_STEP[rule], dt=2e-3, t_end=0.05)
    table = run.balance
    energy, taken = table["energy"], table["viscous_dissipation"]
    assert run.status == "completed" and not set(run.warnings) - {"locking"}
    assert (np.diff(taken) > 0.0).all() and taken[-1] > 0.03 * energy[0]
    # What the midpoint rule misses of an elastic body, too.
    bound = 1e-11 if rule == "energy-momentum" else 1e-4
    assert np.abs(table["ledger_residual"]).max() < bound * energy[0]
    np.testing.assert_allclose(energy + taken, energy[0], rtol=10 * bound)
    for name in ("linear_momentum", "angular_momentum"):
        first = table[name][0]
        assert np.abs(table[name] - first).max() < 1e-12 * np.abs(first).max()


#: Of the cell below: a modulus over a density is a hundred.
ETA, AMPLITUDE = 0.3, 1e-7


def oscillator():
    """A cell whose top goes up and down, of mass rho/3 over a spring 2 mu and a damper 2 eta."""
    mesh = box(cells=1, comm=MPI.COMM_SELF)
    held = [nts.Dirichlet(bottom), nts.Dirichlet(everywhere, components=(0, 1))]
    return nts.Continuum(
        mesh, nts.StVenantKirchhoff(young=100.0, poisson=0.0), density=3.0, bcs=held,
        viscosity=ETA,
        displacement=lambda x: AMPLITUDE * np.stack([0 * x[2], 0 * x[2], x[2]]),
    )  # fmt: skip


def height(body):
    """How far up its top is [m]."""
    x, u = (a.reshape(-1, 3)[:, 2] for a in (body.reference, body.u.x.array))
    return u[x > 0.5].mean()


def decayed(time):
    """Height of its top: z'' + 2 eta z' + 100 z = 0 from rest at `AMPLITUDE`."""
    omega = np.sqrt(100.0 - ETA**2)
    wave = np.cos(omega * time) + ETA / omega * np.sin(omega * time)
    return AMPLITUDE * np.exp(-ETA * time) * wave


@pytest.mark.parametrize("rule", INTEGRATORS)
@pytest.mark.fast("energy-momentum", "newmark")
def test_an_oscillator_decays_by_its_closed_form(rule):
    """Its error is of second order: a quarter at half the step."""
    errors = []
    for dt in (8e-3, 4e-3):
        body = oscillator()
        run = nts.simulate(nts.System([body]), INTEGRATORS[rule], dt=dt, t_end=0.48)
        errors.append(abs(height(body) - decayed(0.48)))
        lost = run.balance["viscous_dissipation"]
        assert (np.diff(lost) >= 0.0).all()
    assert errors[1] < 1e-3 * AMPLITUDE
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


def test_its_envelope_is_exp_of_minus_zeta_omega_t():
    """Highest places of the top, one period of the damped motion after the other."""
    body, tops = oscillator(), []
    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum())
    dt = 2 * np.pi / np.sqrt(100.0 - ETA**2) / 60
    for k in range(1, 181):
        stepper.advance(dt)
        if k % 60 == 0:
            tops.append(height(body))
    stepper.close()
    times = 60 * dt * np.arange(1, 4)
    np.testing.assert_allclose(tops, AMPLITUDE * np.exp(-ETA * times), rtol=2e-3)


@pytest.mark.mpi
def test_a_viscosity_that_changes():
    """One that is switched on in mid flight takes nothing before."""
    mesh = box(cells=2)
    eta = fem.Constant(mesh, 0.0)
    body = nts.Continuum(
        mesh, RUBBER, density=DENSITY, viscosity=eta,
        velocity=lambda x: np.sin(3 * x[[1, 2, 0]]),
    )  # fmt: skip

    def change(time, dt):
        eta.value = 0.0 if time < 0.5e-2 else 300.0

    run = nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=1e-3, t_end=1e-2, before_step=change
    )
    lost, energy = run.balance["viscous_dissipation"], run.balance["energy"]
    assert not lost[:6].any() and (np.diff(lost[5:]) > 0.0).all()
    np.testing.assert_allclose(energy + lost, energy[0], rtol=1e-11)
    eta.value = -1.0
    with pytest.raises(nts.UserFunctionError, match="viscosity with a value of -1.0: must be fin"):
        nts.Stepper(nts.System([body]), nts.EnergyMomentum()).advance(1e-3)


def test_statics_know_no_viscosity():
    """Equilibrium under its weight is that of the elastic body."""
    ends = []
    for viscosity in (0.0, 1e5):
        body = nts.Continuum(
            box(cells=1, comm=MPI.COMM_SELF), RUBBER, density=DENSITY, viscosity=viscosity,
            bcs=[nts.Dirichlet(bottom)],
        )  # fmt: skip
        run = nts.equilibrium(nts.System([body], gravity=(0, 0, -9.81)))
        assert run.status == "completed"
        ends.append(body.u.x.array.copy())
    assert run.balance["viscous_dissipation"][-1] == 0.0
    np.testing.assert_array_equal(*ends)


def test_what_is_no_viscosity_is_refused():
    with pytest.raises(ValueError, match=r"viscosity=-1.0: must be finite and not negative"):
        flying(viscosity=-1.0)
    with pytest.raises(ValueError, match="bending=True.*without viscosity"):
        nts.Continuum(box(cells=1), RUBBER, density=1.0, viscosity=1.0, bending=True)
    with pytest.raises(ValueError, match="viscosity=.*of another mesh"):
        nts.Continuum(box(), RUBBER, density=1.0, viscosity=fem.Constant(box(), 1.0))
