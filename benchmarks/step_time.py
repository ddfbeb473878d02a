"""Time per step of two cubes that collide, as other packages were measured, and what it goes into.

Two unit cubes of n^3 and (n + 1)^3 hexahedra with a gap of 0.05, E = 1e6, nu = 0.3, rho = 1000,
neo-Hookean; the first has 2 m/s and 0.5 rad/s; h = 1e-3, 100 steps, a quarter of them in flight.
Printed are the mean and the median wall time of a step, in contact and in flight, its parts, and
what the ledger misses; of several levels of accuracy also what each costs over the first.
"""

from __future__ import annotations

import argparse
import time

from mpi4py import MPI

import numpy as np
from clock import Clock
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.bodies.solid.continuum import Continuum
from dolfinx_nts.contact.contact_search import ContactSearch
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.element_terms import ElementTerms
from dolfinx_nts.solve.accuracy import ACCURACY
from dolfinx_nts.solve.newton import StepSolver

#: What a step is made of: label -> class and method that are timed.
PARTS = {
    "search": (ContactSearch, "_search"),
    "contact elements": (ElementTerms, "at"),
    "bulk forces": (Continuum, "internal"),
    "bulk matrices": (Continuum, "tangent"),
    "contact into the matrix": (StepMatrix, "assemble"),
    "new layout": (StepMatrix, "__init__"),
}


def cubes(comm: MPI.Comm, n: int, gap: float = 0.05) -> nts.System:
    """The scene."""
    box = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)

    def throw(x: np.ndarray) -> np.ndarray:
        arm = x - 0.5
        return np.array([2 + 0.5 * arm[2], 0 * x[0], -0.5 * arm[0]])

    left = nts.Continuum(
        create_box(comm, [[0, 0, 0], [1, 1, 1]], [n] * 3, **box),
        rubber, density=1e3, velocity=throw, name="left",
    )  # fmt: skip
    right = nts.Continuum(
        create_box(comm, [[1 + gap, 0, 0], [2 + gap, 1, 1]], [n + 1] * 3, **box),
        rubber, density=1e3, name="right",
    )  # fmt: skip
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > 1 - 1e-9),
        master=right.surface(lambda x: x[0] < 1 + gap + 1e-9),
    )
    return nts.System([left, right], contacts=[pair])


def measure(comm: MPI.Comm, n: int, newton: nts.Newton, steps: int) -> None:
    """Run and print."""
    clock = Clock()
    for label, method in PARTS.items():
        clock.time(label, *method)
    clock.time("Newton", StepSolver, "solve")
    stepper = nts.Stepper(cubes(comm, n), nts.EnergyMomentum(), newton=newton)
    stepper.advance(1e-3)
    before, seconds = dict(clock.seconds), []
    for _ in range(steps):
        begin = time.perf_counter()
        stepper.advance(1e-3)
        seconds.append(time.perf_counter() - begin)
    clock.close()
    stepper.close()
    table, ms = stepper.solution.balance, 1e3 * np.array(seconds)
    touching = table["active"][2:] > 0
    parts = {k: 1e3 * (t - before[k]) / steps for k, t in clock.seconds.items()}
    inside = sum(v for k, v in parts.items() if k not in ("search", "Newton"))
    parts["linear solve, SNES"] = parts.pop("Newton") - inside
    parts["rest (ledger, layout, Python)"] = ms.mean() - sum(parts.values())
    if comm.rank == 0:
        ledger = np.abs(table["ledger_residual"]).max() / table["energy"][0]
        print(
            f"n = {n}: {ms.mean():.1f} ms a step (median in contact {np.median(ms[touching]):.1f}, "
            f"in flight {np.median(ms[~touching]):.1f}), "
            f"{table['newton_iterations'][2:].mean():.2f} Newton iterations, ledger {ledger:.1e} E0"
        )
        print("    " + ", ".join(f"{k} {v:.1f}" for k, v in parts.items()), flush=True)


def compare(comm: MPI.Comm, n: int, levels: list[str], steps: int) -> None:
    """Print what levels of accuracy cost over the first, in turns step by step."""
    steppers = [
        nts.Stepper(cubes(comm, n), nts.EnergyMomentum(), newton=ACCURACY[name]) for name in levels
    ]
    seconds = np.zeros((steps + 1, len(levels)))
    for row in seconds:
        for k, stepper in enumerate(steppers):
            begin = time.process_time()
            stepper.advance(1e-3)
            row[k] = time.process_time() - begin
    tables = [stepper.solution.balance for stepper in steppers]
    touching = np.all([table["active"][1:] > 0 for table in tables], axis=0)
    ratios = np.median(seconds[touching] / seconds[touching][:, :1], axis=0)
    for stepper in steppers:
        stepper.close()
    if comm.rank == 0:
        for name, ratio in zip(levels[1:], ratios[1:], strict=True):
            print(f"n = {n}, {name} over {levels[0]}: processor time in contact {ratio:.2f}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[4, 8])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--accuracy", nargs="+", default=["balanced"], choices=list(ACCURACY))
    options = parser.parse_args()
    for accuracy in options.accuracy:
        if MPI.COMM_WORLD.rank == 0:
            print(f"{accuracy}, {MPI.COMM_WORLD.size} ranks")
        for n in options.cells:
            measure(MPI.COMM_WORLD, n, ACCURACY[accuracy], options.steps)
    for n in options.cells if len(options.accuracy) > 1 else ():
        compare(MPI.COMM_WORLD, n, options.accuracy, options.steps)


if __name__ == "__main__":
    main()
