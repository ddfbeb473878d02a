"""A scene that several tests share: two solid bars that hit each other."""

import numpy as np
from scenes import box

import dolfinx_nts as nts


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
