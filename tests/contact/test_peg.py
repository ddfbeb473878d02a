"""A peg that leans in a hole too wide for it jams, or slides, as friction says."""

import numpy as np
import pytest
from scenes import box, everywhere

import dolfinx_nts as nts

WIDTH, DEPTH, ARM, FORCE, LEAN, TIME = 0.2, 0.5, 1.0, 10.0, 0.02, 0.1
#: Half the width of the hole in which it leans from rim to rim.
HALF = (0.5 * WIDTH + 0.5 * DEPTH * np.sin(LEAN)) / np.cos(LEAN)


def peg(friction, exchanged):
    """A long peg of one cell between two blocks, drawn down by a force beside its axis."""
    mesh = box((-0.5 * WIDTH, -0.5 * WIDTH, -1.0), (0.5 * WIDTH, 0.5 * WIDTH, 1.0), (1, 1, 1))
    c, s = np.cos(LEAN), np.sin(LEAN)
    mesh.geometry.x[:] = mesh.geometry.x @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    body = nts.RigidBody(
        mesh, density=1e3, force=(0, 0, -FORCE), torque=(0, FORCE * ARM, 0), name="peg"
    )
    blocks = [
        nts.RigidBody(
            box((low, -0.3, -0.5 * DEPTH), (high, 0.3, 0.5 * DEPTH), (1, 3, 1)), density=1e3,
            motion=(0, 0, 0), rotation=(0, 0, 0), name=name,
        )
        for name, low, high in (("right", HALF, 1.0), ("left", -1.0, -HALF))
    ]  # fmt: skip
    pairs = []
    for block in blocks:
        both = [body.surface(everywhere), block.surface(everywhere)]
        pairs.append(nts.ContactPair(*both[:: -1 if exchanged else 1], friction=friction))
    run = nts.simulate(
        nts.System([body, *blocks], contacts=pairs), nts.EnergyMomentum(), dt=2e-3, t_end=TIME,
        accuracy="balanced",
    )  # fmt: skip
    assert run.status == "completed"
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * FORCE * ARM
    return nts.motion_of(body).velocity[2], body.mass


@pytest.mark.mpi
@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("part", [0.5, 0.8, 1.2])
@pytest.mark.fast("0.8-True")
@pytest.mark.fast_on_ranks()
def test_a_peg_jams_if_friction_is_above_that_of_the_drawer(part, exchanged):
    """2 mu N L = 2 mu F a > F L: its edges cross the rims at nodes of these, and nowhere else.

    L is the distance of the contacts along the peg; their friction turns it about no axis.
    """
    apart = DEPTH * np.cos(LEAN) + 2.0 * HALF * np.sin(LEAN)
    critical = apart / (2.0 * ARM)
    speed, mass = peg(part * critical, exchanged)
    right = -FORCE / mass * max(1.0 - part, 0.0) * TIME
    assert speed == pytest.approx(right, rel=2e-3, abs=1e-6 * FORCE / mass)
