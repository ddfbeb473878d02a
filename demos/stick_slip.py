"""A spring pulls a block to and fro: it sticks, slips in jerks, and comes to rest again.

Problem. A soft spring (angular frequency w of block and spring) whose end moves to and fro with
V = 0.1 m/s pulls the block of `sliding_block.py`, which has settled on one of that demo's floors;
mu = 0.3.

Reference. A rigid block sticks until the spring carries mu m g, then slips with V (1 - cos w t)
through 2 pi V/w, where the end turns; it sticks while the spring is unloaded and loaded the other
way, and slips back.

What to see. Each slip has the length and dissipates the energy that it must. Friction never gives
energy back, and the ledger of the energy-momentum scheme closes.

Run it with `python demos/stick_slip.py`, with `--integrators midpoint energy-momentum` for both
integrators, or unchanged on two ranks with
`mpirun -n 2 python demos/stick_slip.py`.
"""

from __future__ import annotations

import math
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from sliding_block import (
    DENSITY,
    GRAVITY,
    Motion,
    Options,
    command_line,
    compare,
    slide,
    system,
)

import dolfinx_nts as nts

#: Coulomb's coefficient, angular frequency [1/s], speed of the spring's end [m/s], number of slips.
FRICTION, FREQUENCY, PULL, SLIPS = 0.3, 20.0, 0.1, 3
#: Times until the spring at rest holds the block no longer, and of a slip [s]; way of a slip [m].
LOADING, SLIPPING = FRICTION * GRAVITY / FREQUENCY**2 / PULL, 2 * math.pi / FREQUENCY
JERK = PULL * SLIPPING
END = SLIPS * (2 * LOADING + SLIPPING) - LOADING
CLOSED_FORM = {"jerk [m]": JERK, "dissipation [J/kg]": FRICTION * GRAVITY * SLIPS * JERK}


def spring_end(t: float) -> float:
    """Return where the far end of the spring is [m]: to and fro, turning when a slip is over."""
    stroke = 2 * LOADING + SLIPPING
    number, part = divmod(t + LOADING, stroke)
    return PULL * ((part if number % 2 == 0 else stroke - part) - LOADING)


def jerky_way(t: np.ndarray) -> np.ndarray:
    """Way of a rigid block behind the spring [m], shape (n,)."""
    number, part = np.divmod(t + LOADING, 2 * LOADING + SLIPPING)
    slip = np.maximum(part - 2 * LOADING, 0.0)
    way = PULL * (slip - np.sin(FREQUENCY * slip) / FREQUENCY)
    return np.where(number % 2 == 0, way, JERK - way)


def spring() -> Options:
    """Return the options of a block at the spring, whose end starts to move at t = 0."""
    stiffness = DENSITY * FREQUENCY**2
    return {
        "body_force": lambda t: (stiffness * spring_end(t), 0.0, 0.0),
        "extra_form": lambda u, v, w, t: stiffness * u[0] * w[0] * ufl.dx,
    }


def stick_slip(mesh: Any, floor: Options, **run: Any) -> tuple[dict[str, float], Motion]:
    """Return the way of the last slip and the dissipation of all, and the motion."""
    scene = {"friction": FRICTION} | floor
    settled = nts.equilibrium(system(mesh, held=True, **scene))
    motion = slide(mesh, settled, t_end=END, **spring(), **scene, **run)
    before = np.searchsorted(motion.time, END - SLIPPING - LOADING)
    return {
        "jerk [m]": abs(motion.way[-1] - motion.way[before]),
        "dissipation [J/kg]": motion.dissipation[-1],
    }, motion


def main(comm: MPI.Comm = MPI.COMM_WORLD, **options: Any) -> dict[str, dict[str, Any]]:
    """Pull the block on each floor; options and result as of `sliding_block.compare`."""
    return compare("stick_slip", {"pulled": (stick_slip, jerky_way)}, CLOSED_FORM, comm, **options)


if __name__ == "__main__":
    main(progress=True, **command_line(__doc__.splitlines()[0], "stick_slip"))
