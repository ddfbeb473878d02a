"""Coefficients of friction that depend on the speed of slip and on pressure, by closed forms."""

from mpi4py import MPI

import numpy as np
import pytest
from integrators import MID_STEP
from scenes import box, everywhere

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
G, SIDE = 9.81, 0.1
pytestmark = pytest.mark.mpi


def slide(friction, speed, dt, t_end, tilt=0.0, rule=None):
    """A rigid cube that slides along x down a slope: its way, and the run."""
    body = nts.RigidBody(
        box([0, 0, 0], [SIDE] * 3, 1), density=1e3, velocity=(speed, 0, 0), name="cube"
    )
    floor = nts.Plane((0, 0, 0), (0, 0, 1), name="floor")
    foot = body.surface(lambda x: x[2] < 1e-9)
    pair = nts.ContactPair(foot, floor, friction=friction)
    gravity = (G * np.sin(tilt), 0, -G * np.cos(tilt))
    start = body.position[0]
    system = nts.System([body], contacts=[pair], gravity=gravity)
    run = nts.simulate(system, rule or nts.EnergyMomentum(), dt=dt, t_end=t_end)
    table = run.balance
    top = body.mass * G * SIDE + table["kinetic"].max()
    assert run.status == "completed" and run.retries == 0
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * top
    assert (np.diff(table["friction_dissipation"]) > -1e-14 * top).all()
    return body.position[0] - start, run


@pytest.mark.parametrize("rule", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.fast("energy-momentum")
@pytest.mark.fast_on_ranks()
def test_friction_that_grows_with_speed(rule):
    """v' = -g (mu_0 + k v): v + mu_0/k falls as exp(-k g t). Of second order, in few iterations."""
    base, slope, speed, end = 0.05, 0.2, 2.0, 0.6
    fall = slope * G
    way = (speed + base / slope) * (1.0 - np.exp(-fall * end)) / fall - base / slope * end
    errors = []
    for dt in (0.1, 0.05):
        found, _ = slide(lambda v, p: base + slope * v, speed, dt, end, rule=rule)
        errors.append(abs(found - way))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert errors[1] < 2e-3 * way


def test_friction_of_a_constant_shear_stress():
    """mu = tau/p: what slows the cube is tau times its face, whatever it weighs."""
    stress, speed, end = 300.0, 1.0, 0.3
    way = speed * end - 0.5 * stress * SIDE**2 / (1e3 * SIDE**3) * end**2
    found, _ = slide(lambda v, p: stress / np.maximum(p, 1.0), speed, 0.02, end)
    assert found == pytest.approx(way, rel=1e-9)


@pytest.mark.fast_on_ranks()
def test_what_rests_stays_and_what_slides_goes_on():
    """Stribeck's curve on a slope between both coefficients, at rest and far above its speed."""
    rest, far, quick, tilt = 0.5, 0.2, 0.1, np.arctan(0.35)

    def stribeck(v, p):
        return far + (rest - far) * np.exp(-v / quick)

    stays, _ = slide(stribeck, 0.0, 0.01, 0.2, tilt)
    assert abs(stays) < 1e-13
    goes, _ = slide(stribeck, 5.0, 0.01, 0.2, tilt)
    pull = G * (np.sin(tilt) - far * np.cos(tilt))
    assert goes == pytest.approx(5.0 * 0.2 + 0.5 * pull * 0.2**2, rel=1e-9)


def test_wrong_functions_are_told():
    body = nts.RigidBody(box([0, 0, 0], [1, 1, 1], 1), density=1.0, name="cube")
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    for wrong, text in (
        (lambda v: 0.1, "raised TypeError.*return positive coefficients"),
        (lambda v, p: 0.3 if v < 1 else 0.2, "raised ValueError.*for arrays of speed"),
        (lambda v, p: -0.1, "is -0.1 without slip; it must return"),
        (lambda v, p: 0.0 * v, "is 0.0 without slip"),
    ):
        with pytest.raises(ValueError, match=text):
            nts.ContactPair(body.surface(everywhere), floor, friction=wrong)
    pair = nts.ContactPair(body.surface(everywhere), floor, friction=lambda v, p: 0.1 - v)
    system = nts.System([body], contacts=[pair], gravity=(1, 0, -1))
    with pytest.raises(nts.UserFunctionError, match="friction is .* m/s and .* Pa; it must"):
        nts.Stepper(system, nts.EnergyMomentum()).advance(1.0)
