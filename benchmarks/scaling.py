"""What a step costs a rank beside arithmetic: calls, bytes, arrays and memory, counted, not timed.

    for p in 1 2 4 8; do mpirun --oversubscribe -n $p python benchmarks/scaling.py; done
    python benchmarks/scaling.py --draw docs/scaling.png

Each run adds rows to a table (`--table`), the second command draws it. Scenes: two cubes with the
same cells a rank (weak), the same cubes on all ranks (strong), two plates that touch on large
faces, rigid bodies in free flight, every two a contact.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi_calls import COLLECTIVE, MESSAGES, Calls

CALLS = Calls()  # before anything imports mpi4py

from mpi4py import MPI  # noqa: E402

import numpy as np  # noqa: E402
from dolfinx.mesh import CellType, GhostMode, create_box  # noqa: E402
from heap import scene as heap  # noqa: E402
from petsc4py import PETSc  # noqa: E402
from step_time import cubes  # noqa: E402

import dolfinx_nts as nts  # noqa: E402
from dolfinx_nts.solve.accuracy import ACCURACY  # noqa: E402

#: Steps before those that count: contact begins, matrices and solvers are made.
_WARM, _STEPS = 3, 5
#: Cells along an edge of the first cube on one rank of the weak scene, and of the strong one.
_WEAK, _STRONG = 5, 8


def plates(comm: MPI.Comm, n: int = 24) -> nts.System:
    """Two plates of n and n + 1 cells along their edges; the upper one falls on the lower one."""
    box = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    low = nts.Continuum(
        create_box(comm, [[0, 0, 0], [1, 1, 0.1]], [n + 1, n + 1, 2], **box),
        rubber, density=1e3, name="low",
    )  # fmt: skip
    high = nts.Continuum(
        create_box(comm, [[0, 0, 0.101], [1, 1, 0.201]], [n, n, 2], **box),
        rubber, density=1e3, velocity=(0, 0, -1), name="high",
    )  # fmt: skip
    pair = nts.ContactPair(
        slave=high.surface(lambda x: x[2] < 0.101 + 1e-9),
        master=low.surface(lambda x: x[2] > 0.1 - 1e-9),
    )
    return nts.System([low, high], contacts=[pair])


SCENES: dict[str, Callable[[MPI.Comm], nts.System]] = {
    "weak": lambda comm: cubes(comm, round(_WEAK * comm.size ** (1 / 3)), gap=1e-3),
    "strong": lambda comm: cubes(comm, _STRONG, gap=1e-3),
    "surfaces": plates,
    "25 bodies": lambda comm: heap(comm, 25, 0.3),
    "100 bodies": lambda comm: heap(comm, 100, 0.3),
}


def largest_array(root: Any, but: tuple[type, ...]) -> int:
    """Bytes of the largest array that an object reaches, not through objects of some classes."""
    seen, todo, most = set[int](), [root], 0
    while todo:
        one = todo.pop()
        if id(one) in seen or isinstance(one, but):
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray):
            most = max(most, one.nbytes)
        elif isinstance(one, dict):
            todo += one.values()
        elif isinstance(one, list | tuple | set):
            todo += one
        elif type(one).__module__.startswith("dolfinx_nts"):
            todo += vars(one).values() if hasattr(one, "__dict__") else ()
            todo += [getattr(one, s, None) for s in getattr(type(one), "__slots__", ())]
    return most


def logged() -> np.ndarray:
    """PETSc's own counters, those of -log_view: messages, their bytes, reductions."""
    library = ctypes.CDLL(PETSc.__file__)
    names = (("send_ct", "isend_ct"), ("send_len", "isend_len"), ("allreduce_ct", "gather_ct"))
    return np.array(
        [sum(ctypes.c_double.in_dll(library, f"petsc_{n}").value for n in of) for of in names]
    )


def count(comm: MPI.Comm, name: str) -> tuple[dict[str, Any], list[tuple[str, float]]]:
    """Run a scene; a row, the largest over the ranks, and rank 0's calls a step by line."""
    system = SCENES[name](comm)
    stepper = nts.Stepper(system, nts.EnergyMomentum(), newton=ACCURACY["balanced"])
    for _ in range(_WARM):
        stepper.advance(5e-4)
    before, krylov = logged(), 0
    CALLS.begin()
    for _ in range(_STEPS):
        stepper.advance(5e-4)
        krylov += stepper.solver.snes.getLinearSolveIterations()
    CALLS.end()
    of_petsc = (logged() - before) / _STEPS
    ours = {k: n / _STEPS for (owner, k), n in CALLS.number.items() if owner == "package"}
    sent = {k: n / _STEPS for (owner, k), n in CALLS.sent.items() if owner == "package"}
    newton = np.mean([row["newton_iterations"] for row in stepper.solution.rows[-_STEPS:]])
    slaves = sum(len(pair.slave.share) for pair in system.contacts)
    work = [sum(body.num_owned for body in system.bodies), slaves]
    of_rank = {
        "collectives": sum(ours.get(k, 0) for k in COLLECTIVE),
        "bytes": sum(sent.values()),
        "messages": sum(ours.get(k, 0) for k in MESSAGES),
        "petsc_reductions": of_petsc[2],
        "petsc_messages": of_petsc[0],
        "petsc_bytes": of_petsc[1],
        "largest_array": largest_array(system.contacts, tuple({type(b) for b in system.bodies})),
        "memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    most = np.max(comm.allgather(list(of_rank.values())), axis=0)
    shares = np.array(comm.allgather(work), dtype=float)
    uneven = shares.max(axis=0) / shares.mean(axis=0)
    row = {
        "scene": name, "ranks": comm.size, "unknowns": system.size, "newton": newton,
        "krylov": krylov / _STEPS, **dict(zip(of_rank, most.tolist(), strict=True)),
        "uneven_coordinates": uneven[0], "uneven_slaves": uneven[1],
    }  # fmt: skip
    lines = [(" ".join(key), n / _STEPS) for key, n in CALLS.lines.most_common()]
    stepper.close()
    return row, lines


def draw(table: Path, to: Path) -> None:
    """Picture of the table."""
    from matplotlib import pyplot as plt

    with open(table, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    shown = {
        "collectives": "collective calls of the package", "bytes": "bytes given to them",
        "petsc_reductions": "reductions of PETSc", "petsc_bytes": "bytes of PETSc's messages",
        "largest_array": "largest array of contacts [bytes]", "memory_MB": "peak memory [MB]",
    }  # fmt: skip
    figure, axes = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
    for ax, (key, title) in zip(axes.flat, shown.items(), strict=True):
        for name in SCENES:
            own = [r for r in rows if r["scene"] == name and float(r[key]) > 0.0]
            ax.plot([int(r["ranks"]) for r in own], [float(r[key]) for r in own], "o-", label=name)
        scale = "linear" if key == "memory_MB" else "log"
        ax.set(title=title, xscale="log", yscale=scale, xlabel="ranks")
        ax.set_xticks([1, 2, 4, 8], ["1", "2", "4", "8"])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    axes[1, 2].legend(loc="upper right")
    figure.savefig(to, dpi=110)


def main() -> None:
    """Count, or draw what was counted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--table", type=Path, default=Path("out/scaling.csv"))
    parser.add_argument("--lines", action="store_true", help="print rank 0's calls a step by line")
    parser.add_argument("--draw", type=Path, help="write this picture of the table, and end")
    options = parser.parse_args()
    if options.draw:
        draw(options.table, options.draw)
        return
    comm = MPI.COMM_WORLD
    for name in options.scenes:
        row, lines = count(comm, name)
        if comm.rank:
            continue
        print(" ".join(f"{k}={v:.4g}" if k != "scene" else v for k, v in row.items()), flush=True)
        for at, number in lines if options.lines else ():
            print(f"  {number:5.1f} {at}")
        options.table.parent.mkdir(parents=True, exist_ok=True)
        new = not options.table.exists()
        with open(options.table, "a", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if new:
                writer.writeheader()
            writer.writerow(row)


if __name__ == "__main__":
    main()
