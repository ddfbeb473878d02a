"""Bodies that start displaced: what they store, how they swing, and where contact looks."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import bottom, box, everywhere, top

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
YOUNG, DENSITY, CELLS = 1e6, 1e3, 6
RUBBER = nts.StVenantKirchhoff(YOUNG, 0.0)

pytestmark = pytest.mark.mpi


def bar(displacement, **options):
    """A bar along z, held at its lower end, that moves along z alone."""
    bcs = [nts.Dirichlet(bottom), nts.Dirichlet(everywhere, components=(0, 1))]
    return nts.Continuum(
        box(cells=(1, 1, CELLS)), RUBBER, density=DENSITY, bcs=bcs, displacement=displacement,
        **options,
    )


def mode(x, size):
    """First mode of the bar, also of its trilinear elements at their nodes."""
    return size * np.array([0 * x[2], 0 * x[2], np.sin(0.5 * np.pi * x[2])])


def test_a_stretched_bar_that_is_released():
    """Elements h long have omega^2 = 6 E (1 - cos kh) / (rho h^2 (2 + cos kh)), k = pi / 2."""
    size, h, dt, steps = 1e-6, 1.0 / CELLS, 4e-3, 20
    body = bar(lambda x: mode(x, size))
    start = body.u.x.array.copy()
    run = nts.simulate(
        nts.System([body]), nts.Midpoint(), dt=dt, t_end=steps * dt, accuracy="exact"
    )
    cosine = np.cos(0.5 * np.pi * h)
    omega = np.sqrt(6 * YOUNG / DENSITY * (1 - cosine) / (2 + cosine)) / h
    # The midpoint rule turns by 2 atan(omega dt / 2) in a step.
    phase = 2 * np.arctan(0.5 * omega * dt) * np.arange(steps + 1)
    stretch = np.diff(size * np.sin(0.5 * np.pi * np.linspace(0, 1, CELLS + 1)))
    stored = 0.5 * YOUNG / h * np.sum(stretch**2)
    assert run.status == "completed"
    # Beside strains of 1e-6 the strain's square is small.
    assert np.isclose(run.balance["energy"][0], stored, rtol=1e-5)
    assert np.allclose(run.balance["potential"], stored * np.cos(phase) ** 2, atol=1e-5 * stored)
    assert np.abs(body.u.x.array - np.cos(phase[-1]) * start).max(initial=0.0) < 1e-5 * size
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-5 * stored


def test_the_functions_of_dolfinx_hold_it_at_once():
    body = bar(lambda x: mode(x, 0.1))
    x = body.space.tabulate_dof_coordinates()
    assert np.allclose(body.u.x.array.reshape(-1, 3), mode(x.T, 0.1).T, atol=1e-15)
    assert np.array_equal(nts.System([body]).initial_state().u[0], body.initial_displacement)


def test_prescribed_coordinates_start_where_they_are_said_to():
    held = nts.Dirichlet(bottom, lambda t: (0, 0, 0.02 + t), components=(2,))
    body = nts.Continuum(
        box(), RUBBER, density=DENSITY, bcs=[held], displacement=(0.3, 0.2, 0.1)
    )
    u = nts.System([body]).initial_state().u[0].reshape(-1, 3)
    low = body.reference.reshape(-1, 3)[:, 2] < 1e-9
    assert np.allclose(u[low], [0.3, 0.2, 0.02]) and np.allclose(u[~low], [0.3, 0.2, 0.1])
    assert np.allclose(body.u.x.array[: body.num_owned].reshape(-1, 3), u)


def test_what_it_must_not_be():
    with pytest.raises(ValueError, match="displacement=.*three finite components .m."):
        bar((0, 0, np.nan))
    with pytest.raises(ValueError, match="displacement of 'rod'.*returned shape"):
        bar(lambda x: x[:2], name="rod")
    with pytest.raises(ValueError, match="displacement of 'rod'.*check it for NaN"):
        bar(lambda x: np.where(x > 0.5, np.nan, x), name="rod")
    with pytest.raises(ValueError, match=r"displacement of 'rod'.*inside out.*near X = \(0.5, 0.5"):
        bar(lambda x: -1.5 * mode(x, 1.0), name="rod")
    bar(lambda x: -1.5 * mode(x, 1.0), name="rod", allow_inversion=True)


@pytest.mark.parametrize("rise", [1.001, 0.7])
def test_contact_looks_where_bodies_are(rise):
    """Two cubes of one mesh, one of them lifted onto the other, or too little."""
    under = nts.Continuum(box(), RUBBER, density=DENSITY, name="under")
    over = nts.Continuum(
        box(), RUBBER, density=DENSITY, name="over", displacement=(0, 0, rise)
    )
    pair = nts.ContactPair(over.surface(bottom), under.surface(top))
    if rise < 1.0:
        with pytest.raises(ValueError, match="slave nodes start inside the master, up to 0.6 of"):
            nts.System([over, under], contacts=[pair])
        return
    run = nts.simulate(
        nts.System([over, under], contacts=[pair]), nts.EnergyMomentum(), dt=1e-3, t_end=1e-3
    )
    assert run.status == "completed"
    assert np.allclose(run.balance["potential"], 0.0, atol=1e-9 * YOUNG)


def test_a_displaced_master_is_where_contact_looks():
    """Far inside a master that has come over the slave; its surface is half a body away."""
    over = nts.Continuum(
        box((3, 0, 0), (4, 1, 1)), RUBBER, density=DENSITY, name="over",
        displacement=(-3, 0, 0.5),
    )  # fmt: skip
    small = box((0.4, 0.4, 0.9), (0.6, 0.6, 1.0), 1)
    under = nts.Continuum(small, RUBBER, density=DENSITY, name="under")
    pair = nts.ContactPair(under.surface(top), over.surface(top))
    with pytest.raises(ValueError, match="4 slave nodes start inside the master"):
        nts.System([over, under], contacts=[pair])


def test_equilibrium_begins_there():
    """A bar that is pulled: from its solution no iteration moves it, and none ends elsewhere."""
    pull = [nts.Traction(top, (0, 0, 0.3 * YOUNG))]
    plain = bar((0, 0, 0), traction=pull)
    found = nts.equilibrium(nts.System([plain]), load_steps=4)
    x = plain.space.tabulate_dof_coordinates()
    stretch = plain.u.x.array[2::3].max() if len(x) else 0.0
    stretch = COMM.allreduce(stretch, op=MPI.MAX)
    # St. Venant-Kirchhoff: a force of E F (F^2 - 1) / 2 per reference area.
    f = 1 + stretch
    assert np.isclose(0.5 * f * (f**2 - 1), 0.3, rtol=1e-8)
    guess = bar(lambda x: stretch * np.array([0 * x[2], 0 * x[2], x[2]]), traction=pull)
    again = nts.equilibrium(nts.System([guess]))
    assert again.status == "completed"
    assert again.balance["newton_iterations"][-1] < found.balance["newton_iterations"][1]
    assert np.abs(guess.u.x.array - plain.u.x.array).max(initial=0.0) < 1e-8
    assert np.isclose(again.balance["potential"][0], (f**2 - 1) ** 2 / 8 * YOUNG, rtol=1e-8)
