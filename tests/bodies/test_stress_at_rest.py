"""A strain energy with stress in the undeformed body is told of in each run, by its size."""

import re

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from scenes import box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
SHEAR = 1e6 / 2.6

pytestmark = pytest.mark.mpi


def block(part, name="block", **options):
    """A cube of NeoHookean with a stress of this part of the shear modulus, alike everywhere."""
    low, high = np.array([[0, 0, 0], [1, 1, 1]]) + [5.0, -3.0, 2.0]
    mesh = box(low, high, 2)
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    # A Constant, so that all parts share one compiled form.
    stress = fem.Constant(mesh, part * SHEAR)

    def energy(c):
        return rubber(c) + stress / 2 * (ufl.tr(c) - 3)

    material = energy if part else rubber
    return nts.Continuum(mesh, material, density=1e3, name=name, **options)


def told(run):
    """The size of the stress that a run warns of, once."""
    found = run.warnings.get("stress at rest")
    if found is None:
        return 0.0
    assert found.count == 1 and not found.grave
    assert found.text.startswith("body 'block' is under a stress of about ")
    assert found.text.endswith("let W(C), where C = F^T F, have dW/dC = 0 at C = 1")
    assert float(re.search(r"about (\S+) of its stiffness", found.text)[1]) == pytest.approx(
        found.worst, rel=0.05
    )
    return found.worst


def test_silent_without_stress():
    body = block(0.0, velocity=lambda x: 10.0 * x[[1, 2, 0]])
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=1e-3, t_end=2e-3)
    assert told(run) == 0.0


@pytest.mark.parametrize("part", [1e-4, 0.3])
def test_the_size_of_the_stress(part):
    """Closed form for a cube: stress part mu in three directions beside (2 + part) mu in two."""
    stepper = nts.Stepper(nts.System([block(part)]), nts.Midpoint())
    for _ in range(2):
        stepper.advance(1e-4)
    stepper.close()
    assert told(stepper.solution) == pytest.approx(np.sqrt(3 / 2) * part / (2 + part), rel=0.02)
    assert np.abs(stepper.state.v[0]).max(initial=0.0) > 0.0


@pytest.mark.slow
def test_statics_and_dynamics_of_one_body_both_tell():
    system = nts.System([block(0.01, bcs=[nts.Dirichlet(lambda x: x[2] < 2 + 1e-9)])])
    for run in (
        nts.equilibrium(system), nts.simulate(system, nts.Midpoint(), dt=1e-4, t_end=1e-4)
    ):  # fmt: skip
        assert 0.003 < told(run) < 0.01


def test_all_bodies_under_stress_are_named():
    system = nts.System([block(0.3), block(1e-4, name="other"), block(0.0, name="good")])
    run = nts.simulate(system, nts.Midpoint(), dt=1e-4, t_end=1e-4)
    found = run.warnings["stress at rest"]
    assert found.text.startswith("bodies 'block', 'other' are under a stress of about 0.16 of the")
    assert found.worst == pytest.approx(np.sqrt(3 / 2) * 0.3 / 2.3, rel=0.02)


def test_a_body_held_everywhere_does_not_move():
    held = nts.Dirichlet(lambda x: np.full(x.shape[1], True))
    body = block(0.3, bcs=[held])
    run = nts.simulate(nts.System([body]), nts.Midpoint(), dt=1e-4, t_end=1e-4)
    assert told(run) == 0.0


def test_the_check_leaves_no_trace():
    """The first step starts from the body's state, not from what was tried."""
    runs = []
    for seen in (False, True):
        body = block(0.1, velocity=(1.0, 0, 0))
        body._seen_at_rest = seen
        runs.append(nts.simulate(nts.System([body]), nts.Midpoint(), dt=1e-3, t_end=3e-3))
    assert np.allclose(*(run.balance["potential"] for run in runs), rtol=1e-10, atol=0)
