"""Two bars that hit each other, against an independent linear code in one dimension."""

from mpi4py import MPI

import numpy as np
import pytest
from measures import drift
from scenes import box

import dolfinx_nts as nts

LENGTH, WAVE, YOUNG, DENSITY, SPEED = 10.0, 30.0, 9e5, 1e3, 1e-2


def bar(elements):
    """Mass and stiffness of a bar of linear elements."""
    dx, n = LENGTH / elements, elements + 1
    mass, stiffness = np.zeros((n, n)), np.zeros((n, n))
    for e in range(elements):
        at = np.ix_([e, e + 1], [e, e + 1])
        mass[at] += DENSITY * dx / 6 * np.array([[2, 1], [1, 2]])
        stiffness[at] += YOUNG / dx * np.array([[1, -1], [-1, 1]])
    return mass, stiffness


def redistributed(mass):
    """The last node hands its mass to its neighbour; 1 + a + b x + c x^2 restores the moments."""
    n = len(mass)
    x, handed, a = np.linspace(-1, 1, n), np.eye(n), np.zeros(3)
    handed[-1, -2:] = 1, 0
    less, shape, one = handed.T @ mass @ handed, np.vander(x, 3), np.ones(n)
    pairs = ((one, one), (x, one), (x, x))
    for _ in range(20):
        f = 1 + shape @ a
        new = less * f * f[:, None]
        missing = [p @ (new - mass) @ q for p, q in pairs]
        slope = [
            [p @ (less * (s[:, None] * f + f[:, None] * s)) @ q for s in shape.T] for p, q in pairs
        ]
        a -= np.linalg.solve(slope, missing)
    return new


def matrices(elements, mass):
    """Mass and stiffness of both bars; the last node of the first touches the next."""
    (m1, k1), (m2, k2) = (bar(n) for n in elements)
    m1 = redistributed(m1) if mass == "redistributed" else m1
    n, m = len(m1), len(m1) + len(m2)
    whole, stiffness = np.zeros((m, m)), np.zeros((m, m))
    whole[:n, :n], whole[n:, n:], stiffness[:n, :n], stiffness[n:, n:] = m1, m2, k1, k2
    return whole, stiffness, n


def linear_bars(elements, mass, closing):
    """Energy lost over that at the start, and rms deviation of the force from 150 N."""
    whole, stiffness, n = matrices(elements, mass)
    dt = LENGTH / max(elements) / WAVE
    gap0, opening = (10 - closing) * dt * SPEED, np.zeros(len(whole))
    opening[n - 1 : n + 1] = -1, 1
    # A massless node takes the mean of the forces at both ends of a step.
    mean = 0.5 if mass == "redistributed" else 1.0
    inverse = np.linalg.inv(whole + dt**2 / 4 * stiffness)
    push = inverse @ opening * dt**2 / 2 * mean
    u, v, before, rows = np.zeros(len(whole)), np.zeros(len(whole)), 0.0, []
    v[:n] = SPEED
    for k in range(round((gap0 / SPEED + 2.5 * LENGTH / WAVE) / dt)):
        u1 = inverse @ (whole @ (u + dt * v) - dt**2 / 4 * stiffness @ u)
        u1 += (1 - mean) / mean * before * push
        before = max(0.0, -(gap0 + opening @ u1) / (opening @ push))
        u1 += before * push
        v, u = 2 * (u1 - u) / dt - v, u1
        rows.append(((k + 1) * dt - gap0 / SPEED, before))
    energy = 0.5 * (v @ whole @ v + u @ stiffness @ u)
    time, force = np.array(rows).T
    inside = (time > 6 * dt) & (time < 2 * LENGTH / WAVE - 6 * dt)
    start = 0.5 * DENSITY * LENGTH * SPEED**2
    return 1 - energy / start, np.sqrt(np.mean((force[inside] - 150.0) ** 2))


def bars(elements, mass, closing):
    """A bar hits another one that is like it at rest, in the linear range.

    Args:
        elements: Of both.
        mass: Of the slave's nodes.
        closing: Part of a step that is left when the gap closes.

    Returns:
        Energy lost over that at the start, rms deviation of the contact force from 150 N, changes
        of status, balance.
    """
    length, wave, speed = 10.0, 30.0, 1e-2
    dt = length / max(elements) / wave
    gap, bodies = (10 - closing) * dt * speed, []
    for k, n in enumerate(elements):
        low = k * (length + gap)
        mesh = box((low, 0, 0), (low + length, 1, 1), (n, 1, 1))
        bodies.append(nts.Continuum(
            mesh, nts.StVenantKirchhoff(young=9e5, poisson=0.0), density=1e3,
            velocity=((1 - k) * speed, 0, 0), name=f"bar {k}",
        ))  # fmt: skip
    pair = nts.ContactPair(
        slave=bodies[0].surface(lambda x: x[0] > length - 1e-6, mass=mass),
        master=bodies[1].surface(lambda x: x[0] < length + gap + 1e-6),
    )
    stepper = nts.Stepper(nts.System(bodies, contacts=[pair]), nts.EnergyMomentum())
    rows = []
    for _ in range(round((gap / speed + 2.5 * length / wave) / dt)):
        state = stepper.advance(dt)
        rows.append((state.time - gap / speed, state.contacts[0].force.sum()))
    table = stepper.solution.balance
    stepper.close()
    time, force = np.array(rows).T
    inside = (time > 6 * dt) & (time < 2 * length / wave - 6 * dt)
    rms = np.sqrt(np.mean((force[inside] - 150.0) ** 2))
    flips = np.count_nonzero((force[1:] > 0) != (force[:-1] > 0))
    return 1 - table["energy"][-1] / table["energy"][0], rms, flips, table


@pytest.mark.parametrize("elements", [(50, 50), (50, 75)])
def test_bars(elements):
    """Theory section 16: wherever in a step the gap closes; of linear bars, as solid ones are."""
    lost, rms = {}, {}
    for mass in ("consistent", "redistributed"):
        runs = [linear_bars(elements, mass, closing) for closing in (0.0, 0.25, 0.5, 0.75)]
        lost[mass], rms[mass] = np.mean([run[0] for run in runs]), max(run[1] for run in runs)
    # Waves of equal meshes come back to the surface in step, and the front rings on.
    assert rms["redistributed"] < (0.07 if elements[0] == elements[1] else 0.03) * 150
    assert rms["consistent"] > 0.2 * 150
    assert lost["redistributed"] < min(2.1e-3, 0.6 * lost["consistent"])


@pytest.mark.slow
@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="compares runs in serial")
@pytest.mark.parametrize("elements", [(50, 50), (50, 75)])
@pytest.mark.parametrize("mass", ["consistent", "redistributed"])
def test_solid_bars_are_the_linear_ones(elements, mass):
    """What they lose and how their force deviates is the method's, not the solid's."""
    lost, rms, flips, table = bars(elements, mass, 0.25)
    wanted, deviation = linear_bars(elements, mass, 0.25)
    assert lost == pytest.approx(wanted, abs=2e-5)
    assert rms == pytest.approx(deviation, rel=2e-3) and flips == 2
    assert drift(table, "linear_momentum") < 1e-12
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * table["energy"][0]
