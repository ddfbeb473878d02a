"""A block slides down a slope, or stays where it is when friction is a little above the slope.

Problem. The block of `sliding_block.py` settles on a slope of 30 degrees and is let go, on each of
that demo's floors.

Reference. A rigid block, by Coulomb:

- mu = 0.3: acceleration g (sin 30 - mu cos 30) = 2.356287 m/s^2, so 1.178144 m in the first second,
  and 3.002750 J per kg dissipated;
- settled with friction, the block stays where it is if mu is a thousandth above tan 30 = 0.577350,
  and slides with g sin(30)/1000 if it is a thousandth below.

What to see. Both hold, on a rigid plane and over the facets of a plate. Friction never gives energy
back, and the ledger of the energy-momentum scheme closes.

Run it with `python demos/slope.py`, with `--integrators midpoint energy-momentum` for both
integrators, or unchanged on two ranks with
`mpirun -n 2 python demos/slope.py`.
"""

from __future__ import annotations

import math
from typing import Any

from mpi4py import MPI

import numpy as np
from sliding_block import GRAVITY, Motion, Options, command_line, compare, slide, system

import dolfinx_nts as nts

#: Slope [rad], friction of the block that slides, and its acceleration [m/s^2].
ANGLE, SLIPPERY = math.radians(30), 0.3
ACCELERATION = GRAVITY * (math.sin(ANGLE) - SLIPPERY * math.cos(ANGLE))
#: Coefficient over tan(ANGLE) that holds the block and that does not; how long it is watched [s].
STICKY, LOOSE, WATCHED = 1.001, 0.999, 0.2
CREEP = (1 - LOOSE) * GRAVITY * math.sin(ANGLE)
CLOSED_FORM = {
    "slope: way [m]": ACCELERATION / 2,
    "slope: dissipation [J/kg]": SLIPPERY * GRAVITY * math.cos(ANGLE) * ACCELERATION / 2,
    "mu = 1.001 tan: way [m]": 0.0,
    "mu = 0.999 tan: way [m]": CREEP * WATCHED**2 / 2,
}


def slope(mesh: Any, floor: Options, **run: Any) -> tuple[dict[str, float], Motion]:
    """Return way and dissipation in a second on the slope (benchmark B5), and the motion."""
    scene = {"friction": SLIPPERY, "angle": ANGLE} | floor
    settled = nts.equilibrium(system(mesh, held=True, **scene))
    motion = slide(mesh, settled, t_end=1.0, **scene, **run)
    return {
        "slope: way [m]": motion.way[-1],
        "slope: dissipation [J/kg]": motion.dissipation[-1],
    }, motion


def verge(mesh: Any, floor: Options, **run: Any) -> tuple[dict[str, float], Motion]:
    """Return the ways with friction a little above and below tan(ANGLE); the latter's motion."""
    sticky, loose = (
        {"friction": part * math.tan(ANGLE), "angle": ANGLE} | floor for part in (STICKY, LOOSE)
    )
    # Settled without friction it would start with a jerk, and shaking loosens a block on the verge.
    settled = nts.equilibrium(system(mesh, **sticky))
    stays = slide(mesh, settled, t_end=WATCHED, **sticky, **run)
    motion = slide(mesh, settled, t_end=WATCHED, **loose, **run)
    return {
        "mu = 1.001 tan: way [m]": np.abs(stays.way).max(),
        "mu = 0.999 tan: way [m]": motion.way[-1],
    }, motion


#: Parts of the page: what runs each, and the way of a rigid block [m].
PARTS = {
    "slope": (slope, lambda t: ACCELERATION * t**2 / 2),
    "verge": (verge, lambda t: CREEP * t**2 / 2),
}


def main(
    comm: MPI.Comm = MPI.COMM_WORLD, *, parts: tuple[str, ...] = tuple(PARTS), **options: Any
) -> dict[str, dict[str, Any]]:
    """Run some of PARTS on each floor; options and result as of `sliding_block.compare`."""
    return compare("slope", {name: PARTS[name] for name in parts}, CLOSED_FORM, comm, **options)


if __name__ == "__main__":
    main(progress=True, **command_line(__doc__.splitlines()[0], "slope"))
