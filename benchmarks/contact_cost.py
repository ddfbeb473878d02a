"""What contact costs: a Newton iteration with about 300 active pairs against one without.

Two elastic blocks of about 50k coordinates collide face to face. The same steps are run with and
without the contact pair; printed are seconds per Newton iteration and their ratio. Run it on 1 and
2 ranks for the speed-up.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box
from mpi4py import MPI

import dolfinx_nts as nts


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


def cost(system: nts.System, steps: int, dt: float, *, condense: bool) -> dict[str, float]:
    """Seconds per Newton iteration and step, MUMPS operations, and the fewest active pairs.

    The first two steps are not timed; the SNES alone is timed per iteration, with its first
    residual, so that what a step costs once does not count.
    """
    stepper = nts.Stepper(
        system, nts.EnergyMomentum(), newton=nts.Newton(rtol=1e-10, condense=condense)
    )
    solve, spent = stepper.solver.solve, []

    def timed() -> Any:
        begin = time.perf_counter()
        step = solve()
        spent.append(time.perf_counter() - begin)
        return step

    stepper.solver.solve = timed  # type: ignore[method-assign]
    for _ in range(2):
        stepper.advance(dt)
    rows, begin = len(stepper.solution.rows), time.perf_counter()
    for _ in range(steps):
        stepper.advance(dt)
    elapsed = time.perf_counter() - begin
    new = stepper.solution.rows[rows:]
    iterations = sum(int(r["newton_iterations"]) for r in new)
    factor = stepper.solver.snes.getKSP().getPC().getFactorMatrix()
    result = {
        "iteration": sum(spent[-steps:]) / iterations,
        "step": elapsed / steps,
        "iterations": iterations / steps,
        "operations": factor.getMumpsRinfog(3),
        "active": min(r["active"] for r in new),
    }
    stepper.close()
    return result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=17, help="cells across the first block")
    parser.add_argument("--steps", type=int, default=3)
    options = parser.parse_args()
    comm = MPI.COMM_WORLD
    cases = {
        "no contact": {"contact": False, "condense": False},
        "contact, (d, f) in the nest": {"contact": True, "condense": False},
        "contact, (d, f) condensed": {"contact": True, "condense": True},
    }
    base = None
    for name, case in cases.items():
        system = blocks(comm, options.cells, contact=case["contact"])
        c = cost(system, options.steps, 5e-4, condense=case["condense"])
        if case["contact"] and c["active"] < 300:
            raise RuntimeError(f"only {c['active']:.0f} pairs active in a timed step")
        base = base or c
        if comm.rank == 0:
            print(
                f"{name:>28}: {c['iteration']:.3f} s per Newton iteration "
                f"(x {c['iteration'] / base['iteration']:.3f}), {c['iterations']:.1f} iterations "
                f"and {c['step']:.3f} s per step, {c['operations']:.3g} operations "
                f"(x {c['operations'] / base['operations']:.2f}), {c['active']:.0f} active",
                flush=True,
            )
    if comm.rank == 0:
        size = sum(3 * b.space.dofmap.index_map.size_global for b in system.bodies)
        print(f"{size} coordinates, {comm.size} ranks")


if __name__ == "__main__":
    main()
