"""Shallow ironing: a round die is pressed into a softer block and drawn along it, with friction.

Problem (Fischer and Wriggers 2006, and many after them), in plane strain. The block is 12 mm long
and 4 mm high and held at its bottom. The die is 1.2 mm wide; its lower face is an arc of radius
0.75 mm (sagitta 0.3 mm), 0.2 mm above the block and 0.2 mm in from its left end. The die's upper
face goes down by 1 mm until time 1 and then 10 mm to the right until time 2. Friction 0.3.

Assumptions. Both bodies are neo-Hookean with Poisson's ratio 0.32; E is 68.96e7 N/m^2 for the block
and ten times as much for the die. Plane strain is one layer of hexahedra whose nodes do not move
across. Forces are those of a layer 1 mm thick: force goes with E, length and thickness, so that of
the readings of the published data (mm or m; N/m^2 or N/mm^2) this one alone, E times thickness =
689.6 N/mm, gives the published hundreds of newtons. Contact is between the die's arc, not its
sides, and the top of the block.

Reference. Published curves differ by mesh and contact method; their band at time 1.0 is 268 to
332 N vertical and 55 to 71 N horizontal, at 1.5 it is 337 to 421 N and 102 to 189 N.

What to see. Pressing in, the die is pushed aside because it stands near the free end; most nodes
stick. As soon as it is drawn all of them slip, and the forces stay constant until it comes to the
other end. Two choices make the run smooth. The slaves are the nodes of the die, which are closer
together than the nodes of the block; and the block's surface is smooth. Without `smoothing` the die
sinks into the corners between facets and jumps from one to the next: no equilibrium follows from
the one before, however small the step, and the run stops (`--faceted`).

    mpirun -n 2 python demos/ironing.py
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.output import BalanceCSV, Fields, Film
from dolfinx_nts.output.pictures import picture
from dolfinx_nts.parallel import write_on_root

MM = 1e-3
LENGTH, HEIGHT = 12 * MM, 4 * MM
WIDTH, RADIUS, SAGITTA, SIDE = 1.2 * MM, 0.75 * MM, 0.3 * MM, 0.9 * MM
OFFSET, GAP = 0.2 * MM, 0.2 * MM
YOUNG, STIFFER, POISSON, FRICTION = 68.96e7, 10.0, 0.32, 0.3
DOWN, ALONG = 1 * MM, 10 * MM
#: Of the layer of elements, and that of which forces are given. A thin layer's sides do alike.
LAYER, THICKNESS = 0.2 * MM, 1 * MM
#: Time: published band of the vertical and of the horizontal force [N].
BAND = {1.0: ((268.0, 332.0), (55.0, 71.0)), 1.5: ((337.0, 421.0), (102.0, 189.0))}
DIRECTIONS = ("vertical", "horizontal")


# ---- the scene
def block_mesh(comm: MPI.Comm, cells: tuple[int, int]) -> Any:
    """The block, its layers thinner towards the top, where the die is."""
    mesh = _layer(comm, cells)
    x = mesh.geometry.x
    x[:] = x * [LENGTH, HEIGHT, LAYER]
    x[:, 1] = HEIGHT - (HEIGHT - x[:, 1]) ** 2 / HEIGHT
    return mesh


def die_mesh(comm: MPI.Comm, cells: tuple[int, int]) -> Any:
    """The die, with nodes at equal distances along its arc."""
    mesh = _layer(comm, cells)
    s, t, z = mesh.geometry.x.T
    angle = (2 * s - 1) * np.arcsin(WIDTH / 2 / RADIUS)
    bottom = HEIGHT + GAP
    arc = [OFFSET + WIDTH / 2 + RADIUS * np.sin(angle), bottom + RADIUS * (1 - np.cos(angle))]
    top = [OFFSET + WIDTH * s, bottom + SAGITTA + SIDE]
    mesh.geometry.x[:] = np.column_stack(
        [*((1 - t) * a + t * b for a, b in zip(arc, top, strict=True)), LAYER * z]
    )
    return mesh


def _layer(comm: MPI.Comm, cells: tuple[int, int]) -> Any:
    """One layer of hexahedra of the unit cube."""
    kind, ghosts = CellType.hexahedron, GhostMode.shared_facet
    return create_box(comm, [[0, 0, 0], [1, 1, 1]], [*cells, 1], kind, ghost_mode=ghosts)


def path(t: float) -> tuple[float, float, float]:
    """Displacement of the die's upper face [m] at time t."""
    return (ALONG * max(0.0, t - 1.0), -DOWN * min(1.0, t), 0.0)


def scene(
    comm: MPI.Comm,
    *,
    block: tuple[int, int] = (48, 6),
    die: tuple[int, int] = (12, 4),
    smoothing: bool = True,
) -> nts.System:
    """Block and die.

    Args:
        comm: MPI communicator.
        block: Hexahedra of the block along its length and height.
        die: The same of the die.
        smoothing: Whether the block's surface is smooth or of facets.
    """
    plane = nts.Dirichlet(lambda x: np.full(x.shape[1], True), components=(2,))
    held = nts.Dirichlet(lambda x: x[1] < 1e-6 * HEIGHT)
    top = HEIGHT + GAP + SAGITTA + SIDE
    moved = nts.Dirichlet(lambda x: x[1] > top - 1e-6 * HEIGHT, value=path)
    soft = nts.Continuum(
        block_mesh(comm, block),
        nts.NeoHookean(young=YOUNG, poisson=POISSON),
        density=1e3,
        bcs=[plane, held],
        name="block",
    )
    hard = nts.Continuum(
        die_mesh(comm, die),
        nts.NeoHookean(young=STIFFER * YOUNG, poisson=POISSON),
        density=1e3,
        bcs=[plane, moved],
        name="die",
    )
    centre = np.array([OFFSET + WIDTH / 2, HEIGHT + GAP + RADIUS])

    def arc(x: np.ndarray) -> np.ndarray:
        return np.isclose(np.hypot(*(x[:2] - centre[:, None])), RADIUS, rtol=1e-6)

    pair = nts.ContactPair(
        slave=hard.surface(arc),
        master=soft.surface(lambda x: x[1] > (1 - 1e-6) * HEIGHT, smoothing=smoothing),
        friction=FRICTION,
    )
    return nts.System([soft, hard], contacts=[pair])


# ---- the run
class Pictures:
    """A writer that draws the bodies at given times."""

    def __init__(self, folder: Path, times: tuple[float, ...]) -> None:
        self.folder, self.times = folder, times

    def start(self, stepper: nts.Stepper) -> None:
        """Nothing yet."""

    def write(self, stepper: nts.Stepper, *, last: bool = False) -> None:
        """Draw the accepted state if it is one of the times."""
        t = stepper.state.time
        if np.isclose(t, self.times).any():
            file = self.folder / f"time_{t:.1f}.png"
            picture(stepper, file, colour="stress", view=(90.0, -90.0))

    def close(self, stepper: nts.Stepper) -> None:
        """Nothing to close."""


def figures(run: nts.Equilibrium) -> dict[str, Any]:
    """Forces on the die and energies, of the whole thickness, and how hard they were to find."""
    t, table, layers = run.balance["time"], run.balance, THICKNESS / LAYER
    force = layers * run.reactions["die"][:, 1]
    result: dict[str, Any] = {"time": t, "vertical": -force[:, 1], "horizontal": force[:, 0]}
    for at in BAND:
        reached = np.flatnonzero(np.isclose(t, at))
        for name in DIRECTIONS:
            values = result[name][reached]
            result[f"{name} at {at}"] = float(values[0]) if len(values) else np.nan
    steps = table["newton_iterations"][1:]
    return result | {
        "steps": len(steps),
        "iterations": float(steps.mean()) if len(steps) else np.nan,
        "most_iterations": int(steps.max(initial=0)),
        "retries": run.retries,
        "dissipated": layers * float(table["friction_dissipation"][-1]),
        "work": layers * float(table["external_work"][-1]),
        "stored": layers * float(table["energy"][-1]),
        "status": run.status,
    }


def main(
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    block: tuple[int, int] = (48, 6),
    die: tuple[int, int] = (12, 4),
    smoothing: bool = True,
    steps: tuple[int, int] = (25, 250),
    end: float = 2.0,
    output: str | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Press the die in, draw it along, and print the forces beside the published band.

    Args:
        comm: MPI communicator.
        block: Hexahedra of the block along its length and height.
        die: The same of the die.
        smoothing: Whether the block's surface is smooth or of facets.
        steps: Load steps of the whole ways down and along; the published runs took 100 and 500.
        end: Time of the last load step.
        output: Folder for tables, pictures and fields.
        progress: Show a progress line.

    Returns:
        See `figures`.
    """
    down, along = (np.arange(1, n + 1) / n for n in steps)
    times = np.concatenate([down, 1 + along])
    writers: list[Any] = []
    if output:
        folder = Path(output)
        writers = [
            BalanceCSV(folder / "balance.csv"),
            Fields(folder, interval=0.05),
            Film(folder / "film.gif", interval=0.05, colour="stress", view=(90.0, -90.0)),
            Pictures(folder, (*BAND, end)),
        ]
    clock = time.perf_counter()
    run = nts.equilibrium(
        scene(comm, block=block, die=die, smoothing=smoothing),
        load_steps=times[times < end + 1e-9],
        output=writers,
        progress=progress,
    )
    result = figures(run) | {"seconds": time.perf_counter() - clock}
    if comm.rank == 0:
        report(result)
    if output:
        write_on_root(comm, f"output={output!r}", lambda: write(result, Path(output)))
    return result


def report(result: dict[str, Any]) -> None:
    print(f"{'force on the die':20}{'published band':>20}{'here':>12}")
    for at, bands in BAND.items():
        for name, (low, high) in zip(DIRECTIONS, bands, strict=True):
            row = f"{name} at {at}"
            print(f"{row:20}{f'{low:g} to {high:g} N':>20}{result[row]:10.1f} N")
    print(
        f"{result['steps']} load steps, {result['retries']} retries, {result['iterations']:.2f} "
        f"iterations a step, at most {result['most_iterations']}, {result['seconds']:.0f} s"
    )
    print(
        f"work {result['work']:.4g} J = stored {result['stored']:.4g} J + dissipated "
        f"{result['dissipated']:.4g} J + what the steps' mean forces miss; {result['status']}"
    )


def write(result: dict[str, Any], folder: Path) -> None:
    """Table and picture of the forces."""
    from matplotlib.figure import Figure

    columns = [result[name] for name in ("time", *DIRECTIONS)]
    np.savetxt(
        folder / "forces.csv", np.column_stack(columns), fmt="%.9g", delimiter=",", comments="",
        header="time,vertical [N],horizontal [N]",
    )  # fmt: skip
    figure = Figure(figsize=(7.0, 4.2), constrained_layout=True)
    axes = figure.subplots()
    for k, name in enumerate(DIRECTIONS):
        (line,) = axes.plot(result["time"], result[name], label=f"{name} force")
        for at, bands in BAND.items():
            low, high = bands[k]
            look = {"linewidth": 6, "alpha": 0.5, "color": line.get_color()}
            axes.plot([at, at], [low, high], solid_capstyle="butt", **look)
    axes.plot([], [], color="0.6", linewidth=6, label="published band")
    axes.set(xlabel="time (down until 1, then along)", ylabel="force on the die [N]")
    axes.legend(frameon=False, loc="upper left")
    figure.savefig(folder / "ironing.png", dpi=150)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/ironing", help="tables, pictures and fields")
    parser.add_argument("--block", type=int, nargs=2, default=(48, 6), help="hexahedra")
    parser.add_argument("--die", type=int, nargs=2, default=(12, 4), help="hexahedra")
    parser.add_argument("--steps", type=int, nargs=2, default=(25, 250), help="down and along")
    parser.add_argument("--end", type=float, default=2.0, help="time of the last step")
    parser.add_argument("--faceted", action="store_true", help="do not smooth the block")
    options = parser.parse_args()
    main(
        block=tuple(options.block),
        die=tuple(options.die),
        steps=tuple(options.steps),
        end=options.end,
        smoothing=not options.faceted,
        output=options.output,
        progress=True,
    )
