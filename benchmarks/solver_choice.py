"""The solver that is chosen automatically beside either one: wall time of whole runs.

    python benchmarks/solver_choice.py [two_blocks bar_impact ...]

Each demo is run with `linear_solver="auto"`, "direct" and "krylov" in turn, a few times over; the
fastest run of each counts, as other programs only ever make one slower. Printed is the time of the
automatic choice over that of the better of the two.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

from mpi4py import MPI

from dolfinx_nts.study import scene_runs

_SCHEME = {"integrator": "energy-momentum"}
#: Label -> demo and choices: few and many coordinates, short and long steps, no contact, friction.
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "two_blocks 3^3": ("two_blocks", {**_SCHEME, "cells": (3, 2)}),
    "two_blocks 4^3": ("two_blocks", _SCHEME),
    "two_blocks 8^3": ("two_blocks", {**_SCHEME, "cells": (8, 7), "t_end": 0.06}),
    "two_blocks 8^3, dt x 4": ("two_blocks", {**_SCHEME, "cells": (8, 7), "dt_factor": 4.0}),
    "two_blocks 8^3, dt x 20": ("two_blocks", {**_SCHEME, "cells": (8, 7), "dt_factor": 20.0}),
    "two_blocks 16^3": ("two_blocks", {**_SCHEME, "cells": (16, 15), "t_end": 0.03}),
    "bar_impact": ("bar_impact", {**_SCHEME, "elements": 50}),
    "sliding_block": ("sliding_block", {**_SCHEME, "floors": ("mesh",)}),
    "two_tori": ("two_tori", {"t_end": 5.0}),
    "flying_l_block": ("flying_l_block", _SCHEME),
    "rotating_cross": ("rotating_cross", {**_SCHEME, "t_end": 1.0}),
    "rolling": ("rolling", {**_SCHEME, "duration": 0.2}),
}
SOLVERS = ("auto", "direct", "krylov")


def fastest(scene: str, repeats: int, comm: Any) -> dict[str, float]:
    """Wall time of a step [s] with each solver, infinite where a run fails.

    Args:
        scene: Label in `SCENES`.
        repeats: Runs of each.
        comm: MPI communicator.
    """
    demo, choices = SCENES[scene]
    seconds = dict.fromkeys(SOLVERS, math.inf)
    scene_runs.measure(demo, choices, comm)
    for _ in range(repeats):
        for solver in SOLVERS:
            run = scene_runs.measure(demo, {**choices, "linear_solver": solver}, comm)
            if run.status != "completed" and comm.rank == 0:
                print(f"{scene}, {solver}: {run.status}")
            if run.status == "completed":
                step = run.seconds / (len(run.solution.rows) - 1)
                seconds[solver] = min(seconds[solver], step)
    return seconds


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("demos", nargs="*", help="all by default")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    comm, worst = MPI.COMM_WORLD, 0.0
    for scene, (demo, _) in SCENES.items():
        if options.demos and demo not in options.demos:
            continue
        seconds = fastest(scene, options.repeats, comm)
        ratio = seconds["auto"] / min(seconds["direct"], seconds["krylov"])
        worst = max(worst, ratio)
        if comm.rank == 0:
            times = ", ".join(f"{k} {1e3 * v:.1f}" for k, v in seconds.items())
            print(f"{scene:>24}: {times} ms a step, x {ratio:.2f}", flush=True)
    if comm.rank == 0:
        print(f"worst x {worst:.2f}, {comm.size} rank(s)")


if __name__ == "__main__":
    main()
