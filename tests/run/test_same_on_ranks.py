"""Ranks with other numbers are told so by an exception on all, before they wait for each other."""

import re

from mpi4py import MPI

import numpy as np
import pytest
from scenes import RUBBER, at, box

import dolfinx_nts as nts
from dolfinx_nts.validation import require_same

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
#: 0 on rank 0.
HERE = float(COMM.rank)


def cube(**options):
    given = {"material": RUBBER, "density": 1e3, "name": "cube"} | options
    return nts.Continuum(box(cells=1), **given)


def mass():
    return nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="mass")


def move(*bodies, rule=None, contacts=(), joints=(), gravity=(0, 0, 0), **options):
    system = nts.System(bodies, contacts=contacts, joints=joints, gravity=gravity)
    given = {"dt": 1e-2, "t_end": 2e-2} | options
    return nts.simulate(system, rule or nts.EnergyMomentum(), **given)


def on_plane():
    body = cube()
    floor = nts.Plane((0, 0, -HERE), (0, 0, 1))
    return move(body, contacts=[nts.ContactPair(body.surface(at(2, 0.0)), floor)])


def rubbing():
    body = cube()
    pair = nts.ContactPair(body.surface(at(2, 0.0)), nts.Plane((0, 0, 0), (0, 0, 1)), friction=HERE)
    return move(body, contacts=[pair])


def sprung():
    body = mass()
    spring = nts.Spring(None, body, [(1, 0, 0), (0, 0, 0)], stiffness=1 + HERE, name="spring")
    return move(body, joints=[spring])


def standing():
    """Only rank 0 has the contact."""
    body = cube()
    pair = nts.ContactPair(body.surface(at(2, 0.0)), nts.Plane((0, 0, 0), (0, 0, 1)))
    return nts.System([body], contacts=[pair][COMM.rank :])


def holding():
    """One joint on rank 0, two on rank 1."""
    body = mass()
    pins = [nts.Spherical(None, body, point=(0, 0, k), name=f"pin {k}") for k in (0, 1)]
    return nts.System([body], joints=pins[: 1 + COMM.rank])


OTHER = {
    "dt": lambda: move(cube(), dt=1e-2 / (1 + HERE)),
    "t_end": lambda: move(cube(), t_end=2e-2 + HERE),
    "dt, one wrong": lambda: move(cube(), dt=1e-2 * (1 - HERE)),
    "accuracy": lambda: move(cube(), accuracy="fast" if COMM.rank else "exact"),
    "newton": lambda: move(cube(), newton=nts.Newton(rtol=1e-9 * (1 + HERE))),
    "integrator": lambda: move(cube(), rule=nts.GeneralizedAlpha(rho_inf=1 / (1 + HERE))),
    "petsc_options": lambda: move(cube(), petsc_options={"snes_max_it": 20 + COMM.rank}),
    "gravity": lambda: move(cube(), gravity=(0, 0, -HERE)),
    "density of 'cube'": lambda: move(cube(density=1 + HERE)),
    "material of 'cube'": lambda: move(cube(material=nts.NeoHookean(1e6 * (1 + HERE), 0.3))),
    "bcs of 'cube'": lambda: move(cube(bcs=[nts.Dirichlet(at(2, 0.0), (0, 0, HERE))])),
    "traction of 'cube'": lambda: move(cube(traction=[nts.Traction(at(2, 0.0), (0, 0, HERE))])),
    "names of bodies": lambda: move(cube(name=f"cube{COMM.rank}")),
    "names of bodies, fewer": lambda: nts.System([cube(), mass()][: 1 + COMM.rank]),
    "names of contacts": standing,
    "names of joints": holding,
    "b": lambda: require_same(COMM, a=0.0, **({"b": 1.0} if COMM.rank else {})),
    "friction of contacts": rubbing,
    "point of the master of contacts": on_plane,
    "stiffness of 'spring'": sprung,
    "load_steps": lambda: nts.equilibrium(
        nts.System([cube(bcs=[nts.Dirichlet(at(2, 0.0))])]), load_steps=1 + COMM.rank
    ),
}


@pytest.mark.parametrize("name", OTHER)
def test_other_numbers_on_other_ranks_are_refused(name):
    if COMM.size == 1:
        pytest.skip("needs ranks")
    with pytest.raises(ValueError, match=r" on rank 1 and .* on rank 0") as caught:
        OTHER[name]()
    text = str(caught.value)
    assert text.startswith(name.split(",")[0]) and COMM.bcast(text) == text


def test_functions_of_time_that_differ_are_told():
    if COMM.size == 1:
        pytest.skip("needs ranks")
    body = cube(bcs=[nts.Dirichlet(at(2, 0.0), lambda t: (0, 0, t * HERE))])
    run = move(body)
    text = r"Dirichlet.value of bcs\[0\] of 'cube' at t=(.+): is \[0.0, 0.0, \1\] on rank 1 and"
    assert re.match(text, run.status)


def test_a_value_that_is_no_vector_is_named():
    text = r"^body_force of 'cube' at t=0.0: returned 0.0; pass three finite components \[N/m"
    with pytest.raises(ValueError, match=text):
        cube(body_force=lambda t: np.float64(0.0) * t + 0.0)
