"""Adaptive steps beside equal ones on two impacts: cost at equal error of the trajectory.

    python benchmarks/adaptive_steps.py [two_blocks | bar_impact]

Equal steps of several sizes give a curve of cost over error, in processor time and in Newton
iterations, which another job on the machine does not change. Each adaptive run is compared with
that curve at its own error; the reference takes equal steps of a quarter of the smallest. Errors
scatter by some ten per cent in either direction, because which nodes close in which step does, so
that the mean over the tolerances is what counts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.study import scene_runs

#: Choices for all runs, factors of the demo's step, and the factor that adaptive runs start from.
SCENES: dict[str, tuple[dict[str, Any], tuple[float, ...], float]] = {
    "two_blocks": ({"integrator": "energy-momentum"}, (4, 3, 2, 1.4, 1, 0.7, 0.5), 8),
    "bar_impact": (
        {"integrators": ("energy-momentum",), "elements": 50}, (4, 3, 2, 1.4, 1, 0.7, 0.5), 8
    ),
}  # fmt: skip
TOLERANCES = (2e-3, 1.4e-3, 1e-3, 7e-4, 5e-4, 3e-4, 2e-4, 1e-4)
COSTS = ("cpu [s]", "iterations")


def curve(rows: list[dict[str, Any]], cost: str) -> Callable[[float], float]:
    """Cost of equal steps as a power of the error, by least squares."""
    x, y = (np.log([row[name] for row in rows]) for name in ("trajectory", cost))
    slope, offset = np.polyfit(x, y, 1)
    return lambda error: float(np.exp(offset + slope * np.log(error)))


def compare(scene: str, level: str, repeats: int, comm: Any) -> dict[str, float]:
    """Print the table of a scene; returns the mean ratio of each cost.

    Args:
        scene: Name in `SCENES`.
        level: Accuracy of the solver.
        repeats: Runs of each, of which the cheapest counts.
        comm: MPI communicator.
    """
    choices, factors, top = SCENES[scene]
    fixed = {**choices, "accuracy": level}
    grid = [{"dt_factor": f, "adapt": None} for f in factors]
    grid += [{"dt_factor": top, "adapt": t} for t in TOLERANCES]
    scene_runs.measure(scene, {**fixed, **grid[0]}, comm)
    best = scene_runs.measure(scene, {**fixed, "dt_factor": min(factors) / 4}, comm)
    rows = []
    for g in grid:
        runs = [scene_runs.measure(scene, {**fixed, **g}, comm) for _ in range(repeats)]
        row = min((r.row(best) for r in runs), key=lambda row: row["cpu [s]"])
        assert row["status"] == "completed", row["status"]
        table = runs[0].solution.balance
        rows.append({**row, "lost": table["contact_defect"][-1] / table["energy"][0]})
    equal, adaptive = rows[: len(factors)], rows[len(factors) :]
    curves = {cost: curve(equal, cost) for cost in COSTS}
    ratios: dict[str, list[float]] = {cost: [] for cost in COSTS}
    for row in rows:
        label = f"adapt={row['adapt']:g}" if row["adapt"] else f"dt={row['dt [s]']:.3g} s"
        text = (
            f"{scene} {label:>14}: {row['steps']:4} steps, {row['rejected']} rejected, "
            f"{row['iterations']:4} iterations, {row['cpu [s]']:6.2f} s, error "
            f"{row['trajectory']:.1e}, lost to activation {row['lost']:7.2%}"
        )
        if row in adaptive:
            here = {cost: row[cost] / curves[cost](row["trajectory"]) for cost in COSTS}
            text += ", of equal steps: " + ", ".join(f"{v:.2f} {c}" for c, v in here.items())
            for cost, value in here.items():
                ratios[cost].append(value)
        if comm.rank == 0:
            print(text, flush=True)
    means = {cost: float(np.exp(np.log(values).mean())) for cost, values in ratios.items()}
    if comm.rank == 0:
        print(f"{scene}: mean " + ", ".join(f"{v:.2f} {c}" for c, v in means.items()), flush=True)
    return means


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=list(SCENES), help="two_blocks, bar_impact")
    parser.add_argument("--accuracy", default="exact")
    parser.add_argument("--repeats", type=int, default=1)
    options = parser.parse_args()
    for name in options.scenes:
        compare(name, options.accuracy, options.repeats, MPI.COMM_WORLD)
