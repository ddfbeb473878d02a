"""What contact costs: a Newton iteration with about 300 active pairs against one without.

Two elastic blocks of about 50k coordinates collide face to face. The same steps are run with and
without the contact pair, with both linear solvers, or as `accuracy="balanced"` does; printed are
seconds per Newton iteration, their ratio, and what an iteration is made of. Run it on 1 and 2 ranks
for the speed-up.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from mpi4py import MPI

import numpy as np
from clock import Clock
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.body_tangents import BodyTangents
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.solve.accuracy import ACCURACY
from dolfinx_nts.solve.newton import StepSolver


def _spinning(speed: float) -> Any:
    """Translation along x with a spin about x, so that bodies work without contact too."""
    return lambda x: np.array([speed + 0 * x[0], -20.0 * (x[2] - 0.5), 20.0 * (x[1] - 0.5)])


def blocks(comm: MPI.Comm, cells: int, *, contact: bool) -> nts.System:
    """Two blocks, the first moving towards the second; `cells` scales the mesh."""
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    box = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
    left_cells, right_cells = [cells + 5, cells, cells], [cells + 3] * 3
    left = nts.Continuum(
        create_box(comm, [[0, 0, 0], [1, 1, 1]], left_cells, **box),
        rubber, density=1e3, velocity=_spinning(2.0), name="left",
    )  # fmt: skip
    right = nts.Continuum(
        create_box(comm, [[1, -0.1, -0.1], [2.2, 1.1, 1.1]], right_cells, **box),
        rubber, density=1e3, velocity=_spinning(0.0), name="right",
    )  # fmt: skip
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > 1 - 1e-9),
        master=right.surface(lambda x: x[0] < 1 + 1e-9),
    )
    return nts.System([left, right], contacts=[pair] if contact else [])


#: Fewest active pairs of a step that counts as one with contact.
ACTIVE = 300
#: What a Newton iteration is made of: label -> class and method that are timed.
PARTS = {
    "assembly of the bodies": (BodyTangents, "at"),
    "contact into the matrix": (StepMatrix, "assemble"),
    "residual, contact elements": (StepProblem, "evaluate"),
}


def cost(system: nts.System, steps: int, dt: float, newton: nts.Newton) -> dict[str, Any]:
    """Seconds per Newton iteration and its parts, per step, Krylov iterations.

    The SNES alone is timed per iteration, with its first residual, so that what a step costs once
    does not count. Of the steps, without the first two and those with fewer than `ACTIVE` pairs,
    the fastest iteration counts, as other programs may run on the machine.
    """
    clock = Clock()
    for label, method in PARTS.items():
        clock.time(label, *method)
    clock.time("iteration", StepSolver, "solve")
    stepper = nts.Stepper(system, nts.EnergyMomentum(), newton=newton)
    rows: list[dict[str, Any]] = []
    done = 0
    while len(rows) < steps:
        before, begin = dict(clock.seconds), time.perf_counter()
        stepper.advance(dt)
        step = time.perf_counter() - begin
        done += 1
        last = stepper.solution.rows[-1]
        if done <= 2 or (system.contacts and last["active"] < ACTIVE):
            continue
        n = last["newton_iterations"]
        row = {k: (t - before[k]) / n for k, t in clock.seconds.items()}
        row["linear solve, Python"] = row["iteration"] - sum(row[k] for k in PARTS)
        linear = stepper.solver.snes.getLinearSolveIterations() / n
        rows.append({**row, "step": step, "iterations": n, "linear": linear})
        rows[-1]["active"] = last["active"]
    clock.close()
    fastest = min(rows, key=lambda row: row["iteration"])
    best = {**fastest, "step": float(np.median([row["step"] for row in rows]))}
    best["iterations"] = float(np.mean([row["iterations"] for row in rows]))
    if newton.linear_solver == "direct":
        factor = stepper.solver.snes.getKSP().getPC().getFactorMatrix()
        best["operations"] = factor.getMumpsRinfog(3)
    stepper.close()
    return best


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=17, help="cells across the first block")
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--dt", type=float, default=5e-4, help="step [s]")
    parser.add_argument(
        "--solver",
        nargs="+",
        default=["direct", "krylov"],
        choices=["direct", "krylov", "balanced"],
    )
    options = parser.parse_args()
    comm = MPI.COMM_WORLD
    cases = {
        "no contact": {"contact": False, "condense": False},
        "contact, (d, f) in the nest": {"contact": True, "condense": False},
        "contact, (d, f) condensed": {"contact": True, "condense": True},
    }
    for solver in options.solver:
        base = None
        for name, case in cases.items():
            if solver == "balanced" and case["contact"] and not case["condense"]:
                continue
            system = blocks(comm, options.cells, contact=case["contact"])
            if solver == "balanced":
                newton = ACCURACY[solver]
            else:
                newton = nts.Newton(
                    rtol=1e-10, condense=case["condense"], linear_solver=solver, reuse=False
                )
            c = cost(system, options.steps, options.dt, newton)
            base = base or c
            if comm.rank == 0:
                _print(f"{solver}, {name}", c, base)
    if comm.rank == 0:
        size = sum(3 * b.space.dofmap.index_map.size_global for b in system.bodies)
        print(f"{size} coordinates, {comm.size} ranks, dt = {options.dt:g} s")


def _print(name: str, c: dict[str, Any], base: dict[str, Any]) -> None:
    print(
        f"{name:>36}: {c['iteration']:.3f} s per Newton iteration "
        f"(x {c['iteration'] / base['iteration']:.3f}), {c['iterations']:.1f} iterations and "
        f"{c['step']:.3f} s per step, {c['active']:.0f} active"
    )
    parts = [f"{k} {c[k]:.3f}" for k in (*PARTS, "linear solve, Python")]
    if "operations" in c:
        more = c["operations"] / base["operations"]
        parts.append(f"{c['operations']:.3g} operations (x {more:.2f})")
    else:
        parts.append(f"{c['linear']:.1f} Krylov iterations")
    print(f"{'':>38}{', '.join(parts)}", flush=True)


if __name__ == "__main__":
    main()
