"""A block that is thrown along the floor slides to rest, as Coulomb says.

Problem. A stiff block (0.2 x 0.2 x 0.05 m, 2 kg) settles on a floor under its weight and is thrown
with v0 = 1 m/s; mu = 0.2. The floor is a rigid plane without a mesh, a plate of hexahedra that does
not move, or ("elastic") a plate ten times as soft as the block, held at its bottom. `slope.py` and
`stick_slip.py` put the same block on a slope and behind a spring.

Reference. A rigid block is at rest after v0/(mu g) = 0.509684 s and v0^2/(2 mu g) = 0.254842 m, and
friction has dissipated all of m v0^2/2.

What to see. The block comes to rest at most mu g h^2/8 short of the closed form, because one that
is slower than mu g h/2 sticks; the rest of a difference is its elasticity: it stops shaking.
Friction never gives energy back, and the ledger of the energy-momentum scheme closes.

Run it with `python demos/sliding_block.py`, with `--integrators midpoint energy-momentum` for both
integrators, or unchanged on two ranks with
`mpirun -n 2 python demos/sliding_block.py`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.output import BalanceCSV, Fields, Film
from dolfinx_nts.output.pictures import picture
from dolfinx_nts.parallel import write_on_root

GRAVITY = 9.81
SIZE, HEIGHT, DENSITY = 0.2, 0.05, 1000.0
MASS = DENSITY * SIZE**2 * HEIGHT
YOUNG = 5e7
STEP = 2e-3
#: Coulomb's coefficient, initial speed [m/s], time until rest [s].
ROUGH, SPEED = 0.2, 1.0
STOP = SPEED / (ROUGH * GRAVITY)
Options = dict[str, Any]
FLOORS = ("plane", "mesh", "elastic")
INTEGRATORS = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}
CLOSED_FORM = {
    "time [s]": STOP,
    "way [m]": SPEED * STOP / 2,
    "dissipation [J/kg]": SPEED**2 / 2,
}


# ---- the scene
def block_mesh(comm: MPI.Comm, cells: tuple[int, int, int]) -> Any:
    """The block, its lower face at z = 0."""
    return _box(comm, [0.0, 0.0, 0.0], [SIZE, SIZE, HEIGHT], cells)


def _box(comm: MPI.Comm, low: list[float], high: list[float], cells: tuple[int, int, int]) -> Any:
    kind, ghosts = CellType.hexahedron, GhostMode.shared_facet
    return create_box(comm, [low, high], list(cells), kind, ghost_mode=ghosts)


def system(
    mesh: Any,
    *,
    friction: float,
    floor: str = "plane",
    facets: int = 9,
    angle: float = 0.0,
    speed: float = 0.0,
    held: bool = False,
    young: float = YOUNG,
    **forces: Any,
) -> nts.System:
    """Make the block on its floor.

    Args:
        mesh: Mesh of the block, the same for settling and sliding.
        friction: Coulomb's coefficient [-].
        floor: One of FLOORS.
        facets: Facets of a meshed floor along the way.
        angle: Slope of the floor along x [rad]; it is gravity that turns.
        speed: Initial speed along x [m/s].
        held: Hold the block against sliding, without friction, to let it settle.
        young: Young's modulus of the block [Pa].
        forces: More options of the block, such as a body force.
    """
    upstairs = nts.Dirichlet(lambda x: np.isclose(x[0], 0.0), components=(0,))
    aside = nts.Dirichlet(lambda x: np.isclose(x[1], 0.0), components=(1,))
    block = nts.Continuum(
        mesh,
        nts.StVenantKirchhoff(young=young, poisson=0.0),
        density=DENSITY,
        velocity=(speed, 0, 0),
        bcs=[upstairs, aside] if held else [],
        name="block",
        **forces,
    )
    bodies = [block]
    master: Any = nts.Plane(point=(0, 0, 0), normal=(0, 0, 1))
    if floor != "plane":
        low, high = [-SIZE, -SIZE / 2, -0.1], [8 * SIZE, 1.5 * SIZE, 0.0]
        held_at = (lambda x: np.isclose(x[2], -0.1)) if floor == "elastic" else everywhere
        plate = nts.Continuum(
            _box(mesh.comm, low, high, (facets, 1, 1)),
            nts.StVenantKirchhoff(young=0.1 * YOUNG, poisson=0.0),
            density=DENSITY,
            bcs=[nts.Dirichlet(held_at)],
            name="floor",
        )
        bodies.append(plate)
        master = plate.surface(lambda x: np.isclose(x[2], 0.0))
    pair = nts.ContactPair(
        slave=block.surface(lambda x: np.isclose(x[2], 0.0)),
        master=master,
        friction=0.0 if held else friction,
    )
    # The supports that hold the block would take the pull along the slope, and so they get none.
    along = 0.0 if held else math.sin(angle)
    gravity = GRAVITY * np.array([along, 0.0, -math.cos(angle)])
    return nts.System(bodies, contacts=[pair], gravity=gravity)


def everywhere(x: np.ndarray) -> np.ndarray:
    return np.full(x.shape[1], True)


# ---- runs
class Centre:
    """A writer that records how the block's centre of mass moves along x."""

    def start(self, stepper: nts.Stepper) -> None:
        """Begin anew."""
        self.rows: list[tuple[float, float, float]] = []
        self.write(stepper)

    def write(self, stepper: nts.Stepper, *, last: bool = False) -> None:
        """Add the accepted state."""
        block = nts.motion_of(stepper.system.bodies[0])
        self.rows.append((stepper.state.time, block.centre[0], block.velocity[0]))

    def close(self, stepper: nts.Stepper) -> None:
        """Nothing to close."""


class Motion(NamedTuple):
    """The block's centre since it was let go, shape (steps + 1,), and the run it comes from."""

    time: np.ndarray
    way: np.ndarray
    speed: np.ndarray
    run: nts.Solution

    @property
    def dissipation(self) -> np.ndarray:
        """Energy that friction has dissipated [J/kg]."""
        return self.run.balance["friction_dissipation"] / MASS


def slide(
    mesh: Any,
    settled: nts.Solution,
    *,
    t_end: float,
    dt: float = STEP,
    integrator: str = "energy-momentum",
    folder: Path | None = None,
    progress: bool = False,
    **scene: Any,
) -> Motion:
    """Let the settled block go.

    Args:
        mesh: Mesh of the block.
        settled: Equilibrium it starts from.
        t_end: How long to watch it [s].
        dt: Step [s].
        integrator: One of INTEGRATORS.
        folder: Where balance table, fields and a picture go.
        progress: Show a progress line.
        scene: Arguments of `system`.

    Returns:
        How its centre moves.
    """
    centre, scenery = Centre(), system(mesh, **scene)
    writers: list[nts.Writer] = [centre]
    if folder:
        writers += [BalanceCSV(folder / "balance.csv"), Fields(folder, interval=0.05)]
        writers += [Film(folder / "film.gif", interval=0.05)]
    run = nts.simulate(
        scenery,
        INTEGRATORS[integrator],
        dt=dt,
        t_end=t_end,
        start=settled,
        start_time=0.0,
        output=writers,
        progress=progress,
    )
    if folder:
        picture(run, folder / "block.png", colour="stress")
    time, way, speed = np.array(centre.rows).T
    return Motion(time, way - way[0], speed, run)


def stop(mesh: Any, floor: Options, **run: Any) -> tuple[dict[str, float], Motion]:
    """Return time and way to rest and dissipation (benchmark B4), and the motion."""
    scene = {"friction": ROUGH} | floor
    settled = nts.equilibrium(system(mesh, held=True, **scene))
    motion = slide(mesh, settled, speed=SPEED, t_end=1.2 * STOP, **scene, **run)
    # Shaking hides when it stops: the mean deceleration between 80 and 20 % of the speed tells.
    part = (motion.time > 0.2 * STOP) & (motion.time < 0.8 * STOP)
    slope, start = np.polyfit(motion.time[part], motion.speed[part], 1)
    return {
        "time [s]": -start / slope,
        "way [m]": motion.way[motion.time > 1.1 * STOP].mean(),
        "dissipation [J/kg]": motion.dissipation[-1],
    }, motion


def stopping_way(t: np.ndarray) -> np.ndarray:
    """Way of a rigid block that is thrown [m], shape (n,)."""
    t = np.minimum(t, STOP)
    return SPEED * t - ROUGH * GRAVITY * t**2 / 2


# ---- the page
def main(comm: MPI.Comm = MPI.COMM_WORLD, **options: Any) -> dict[str, dict[str, Any]]:
    """Throw the block on each floor with each integrator; options and result as of `compare`."""
    return compare("sliding_block", {"thrown": (stop, stopping_way)}, CLOSED_FORM, comm, **options)


def compare(
    name: str,
    parts: dict[str, tuple[Callable[..., Any], Callable[[np.ndarray], np.ndarray]]],
    closed_form: dict[str, float],
    comm: MPI.Comm,
    *,
    floors: tuple[str, ...] = ("plane", "mesh"),
    integrators: tuple[str, ...] = ("energy-momentum",),
    dt: float = STEP,
    cells: tuple[int, int, int] = (4, 4, 1),
    facets: int = 9,
    output: str | None = None,
    progress: bool = False,
) -> dict[str, dict[str, Any]]:
    """Run the parts on each floor with each integrator, and print what came beside closed forms.

    Args:
        name: Name of the picture.
        parts: {name: (function, way)}. The function runs a part and returns its figures and the
            motion, as `stop` does; way(t) is that of a rigid block [m].
        closed_form: {figure: value} of a rigid block.
        comm: MPI communicator.
        floors: Some of FLOORS.
        integrators: Some of INTEGRATORS.
        dt: Step [s].
        cells: Hexahedra of the block.
        facets: Facets of a meshed floor along its 1.8 m.
        output: Folder for tables, pictures and fields, or None.
        progress: Show a progress line.

    Returns:
        {"floor, integrator": figures}: those of `closed_form`, and `health` of the runs.
    """
    mesh = block_mesh(comm, cells)
    results: dict[str, dict[str, Any]] = {}
    motions: dict[str, dict[str, Motion]] = {part: {} for part in parts}
    for floor in floors:
        for integrator in integrators:
            label, found = f"{floor}, {integrator}", []
            results[label] = {}
            for part, (function, _) in parts.items():
                folder = Path(output) / f"{part}_{floor}_{integrator}" if output else None
                ground = {"floor": floor, "facets": facets}
                options = {"dt": dt, "integrator": integrator, "folder": folder}
                figures, motion = function(mesh, ground, progress=progress, **options)
                results[label] |= figures
                motions[part][label] = motion
                found.append(motion.run)
            results[label] |= health(found)
    if comm.rank == 0:
        report(results, closed_form)
    if output:
        file, ways = Path(output) / f"{name}.png", {part: way for part, (_, way) in parts.items()}
        write_on_root(comm, f"output={output!r}", lambda: plot(motions, ways, file))
    return results


def health(runs: list[nts.Solution]) -> dict[str, Any]:
    """Return the worst ledger and dissipation of all runs over the energy that was turned."""
    worst = {"ledger": 0.0, "least_dissipation": math.inf}
    for run in runs:
        table = run.balance
        turned = np.abs(table["external_work"]).max() + table["energy"][0]
        residual = np.abs(table["ledger_residual"]).max() / turned
        step = np.diff(table["friction_dissipation"]).min() / turned
        worst["ledger"] = max(worst["ledger"], float(residual))
        worst["least_dissipation"] = min(worst["least_dissipation"], float(step))
    iterations = np.concatenate([run.balance["newton_iterations"][1:] for run in runs])
    return worst | {
        "iterations": float(iterations.mean()),
        "retries": sum(run.retries for run in runs),
        "status": next((r.status for r in runs if r.status != "completed"), "completed"),
    }


def report(results: dict[str, dict[str, Any]], closed_form: dict[str, float]) -> None:
    labels = list(results)
    print(f"{'':30}{'closed form':>14}" + "".join(f"{label:>26}" for label in labels))
    for row in results[labels[0]]:
        exact = closed_form.get(row)
        values = [results[label][row] for label in labels]
        text = [f"{v:26.10g}" if exact is not None else f"{v!s:>26.26}" for v in values]
        print(f"{row:30}" + (f"{'':14}" if exact is None else f"{exact:14.6g}") + "".join(text))


def plot(
    motions: dict[str, dict[str, Motion]],
    ways: dict[str, Callable[[np.ndarray], np.ndarray]],
    path: Path,
) -> None:
    """Draw ways, speeds and dissipation over time beside those of a rigid block."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.2 + 3.6 * len(motions), 7.0), constrained_layout=True)
    grid = figure.subplots(3, len(motions), sharex="col", squeeze=False)
    for column, (part, runs) in zip(grid.T, motions.items(), strict=True):
        column[0].set_title(part)
        for k, (label, motion) in enumerate(runs.items()):
            look = {"linewidth": 1 + 0.8 * (len(runs) - k), "label": label}
            for axes, values in zip(column, motion[1:3] + (motion.dissipation,), strict=True):
                axes.plot(motion.time, values, **look)
        t = np.linspace(0, motion.time[-1], 1001)
        way = ways[part](t)
        column[0].plot(t, way, "k--", linewidth=1, label="rigid block")
        column[1].plot(t, np.gradient(way, t), "k--", linewidth=1)
        column[2].set_xlabel("time [s]")
    for axes, text in zip(
        grid[:, 0], ("way [m]", "speed [m/s]", "dissipation [J/kg]"), strict=True
    ):
        axes.set_ylabel(text)
    grid[0, 0].legend(fontsize=7, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def command_line(description: str, name: str) -> dict[str, Any]:
    """Return the options of `compare` from the command line."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--output", default=f"out/{name}", help="tables, pictures, fields")
    parser.add_argument("--floors", nargs="+", choices=FLOORS, default=("plane", "mesh"))
    chosen = ("energy-momentum",)
    parser.add_argument("--integrators", nargs="+", choices=INTEGRATORS, default=chosen)
    parser.add_argument("--dt", type=float, default=STEP, help="step [s]")
    parser.add_argument("--facets", type=int, default=9, help="facets of a meshed floor")
    options = vars(parser.parse_args()).items()
    return {key: tuple(v) if isinstance(v, list) else v for key, v in options}


if __name__ == "__main__":
    main(progress=True, **command_line(__doc__.splitlines()[0], "sliding_block"))
