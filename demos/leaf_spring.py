"""A leaf spring: two leaves of steel, pressed together, slide on each other with friction.

Problem (Goodman and Klumpp 1956). Two leaves, 0.3 m x 0.05 m and 5 mm thick, lie on each other and
are clamped at one end. A clamping pressure of 0.25 MPa acts on both outer faces; mu = 0.4. The free
ends of both are pushed down by half the load P each. P grows to four times the load P* at which
the leaves slip, and falls to zero. In a second run the ends are let go from the full load at once.
The leaves are shells; their faces, half a thickness from the middle surfaces, make the contact.

Reference. Beam theory, with k = EI/L^3 of one leaf. Leaves that stick are one beam of twice the
height, of stiffness 24 k. The shear between them is uniform, so that they slip everywhere at once,
at P* = 4/3 b h mu p; two beams are left, of stiffness 6 k. On the way back they stick until P has
fallen by 2 P*. P over the deflection w is a loop of straight lines; friction takes 3.75 P*^2/(6 k),
and w = 0.75 P*/(6 k) stays without a load. Of a mass on such a spring each half swing loses twice
that: let go at 3.25, it turns at -1.75 and 0.25 of these units, and sticks.

What to see. Stiffness, deflections and what friction takes are within 2 % of theory. They err to
one side: the pressure on faces that are h apart acts on bent leaves like a tension p b h, which
stiffens them by 1 %; theory leaves it out. Let go, the leaves turn at -1.69; friction takes 98.6 %
of their energy in two half swings, and they go on to swing as one beam.

    mpirun -n 2 python demos/leaf_spring.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from flying_plate import plate_mesh

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

LENGTH, WIDTH, HEIGHT = 0.3, 0.05, 5e-3
YOUNG, DENSITY, PRESSURE, FRICTION = 200e9, 7800.0, 0.25e6, 0.4
#: EI/L^3 of a leaf [N/m], the load at which leaves slip [N], and the largest one over it.
UNIT = YOUNG * WIDTH * HEIGHT**3 / 12 / LENGTH**3
SLIP = 4 / 3 * WIDTH * HEIGHT * FRICTION * PRESSURE
MOST = 4.0

#: Whole Newton steps may run away where all nodes begin to stick at once.
SEARCH = {"snes_linesearch_type": "l2"}


def theory(loads):
    """Deflections [m] under loads [N] that follow each other from zero."""
    found, held = [0.0], 0.0
    for before, load in zip(loads[:-1], loads[1:], strict=True):
        # Beside two beams friction bears a part, elastic until they slip.
        held = np.clip(held + 0.75 * (load - before), -0.75 * SLIP, 0.75 * SLIP)
        found.append((load - held) / (6 * UNIT))
    return np.array(found)


def leaf(comm, name, middle, cells, load):
    """A leaf with its middle surface at a height, clamped at x = 0, loaded at its other end."""
    mesh = plate_mesh(comm, cells, 1, LENGTH, WIDTH)
    mesh.geometry.x[:, 2] = middle
    inwards = -PRESSURE if middle > 0.0 else PRESSURE
    return nts.Shell(
        mesh, young=YOUNG, poisson=0.0, thickness=HEIGHT, density=DENSITY, name=name,
        bcs=[nts.Clamp(lambda x: x[0] < 1e-9)],
        forces=[
            # Functions of time: constants would grow with the pseudo time.
            nts.Pressure(lambda t: inwards),
            nts.LineForce(
                lambda t: (0.0, 0.0, -0.5 * load(t) / WIDTH), where=lambda x: x[0] > LENGTH - 1e-9
            ),
        ],
    )  # fmt: skip


def scene(comm, load, cells):
    """Both leaves, under a load that is a function of time."""
    upper = leaf(comm, "upper", HEIGHT / 2, cells, load)
    lower = leaf(comm, "lower", -HEIGHT / 2, cells, load)
    faces = upper.surface(side="bottom"), lower.surface(side="top")
    return nts.System([upper, lower], contacts=[nts.ContactPair(*faces, friction=FRICTION)])


class Recorder:
    """A writer that keeps the deflection of the end."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.rows = []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        nodes, now = stepper.system.bodies[0].midsurface()
        self.rows.append((stepper.state.time, nodes[-1, 2] - now[-1, 2]))

    def close(self, stepper):
        """Make columns of the rows."""
        self.time, self.deflection = np.array(self.rows).T


def bend(comm, cells, steps, output, progress):
    """Load until the pseudo time 1 and release until 2: the run, loads and deflections."""
    path = Recorder()
    times = np.linspace(0.0, 2.0, 2 * steps + 1)

    def load(t):
        return MOST * SLIP * (1.0 - abs(t - 1.0))

    run = nts.equilibrium(
        scene(comm, load, cells), load_steps=times[1:], output=[path, *output], progress=progress,
        petsc_options=SEARCH,
    )
    loads = np.array([load(t) for t in path.time])
    return run, loads, path.deflection


def let_go(comm, cells, dt, t_end, output, progress):
    """Load, and let go: the run in time and its recorder."""
    loaded = nts.equilibrium(
        scene(comm, lambda t: t * MOST * SLIP, cells), load_steps=8, progress=progress,
        petsc_options=SEARCH,
    )
    path, free = Recorder(), scene(comm, lambda t: 0.0, cells)
    run = nts.simulate(
        free, nts.EnergyMomentum(), dt=dt, t_end=t_end, start=loaded, start_time=0.0,
        output=[path, *output], progress=progress,
    )  # fmt: skip
    return run, path


def figures(run, loads, deflection):
    """What the loop says beside theory, in units of P* and P*/(6 k)."""
    p, w = loads / SLIP, deflection * 6 * UNIT / SLIP
    top = int(p.argmax())
    slipping = p[: top + 1] > 1.2
    rise = np.polyfit(w[: top + 1][slipping], p[: top + 1][slipping], 1)[0]
    return {
        "stiffness stuck": (float(p[1] / w[1]), 4.0),
        "stiffness sliding": (float(rise), 1.0),
        "largest deflection": (float(w[top]), MOST - 0.75),
        "deflection left": (float(w[-1]), 0.75),
        "friction": (float(run.balance["friction_dissipation"][-1] * 6 * UNIT / SLIP**2), 3.75),
        "off theory": float(np.abs(w - theory(loads) * 6 * UNIT / SLIP).max()),
        "status": run.status,
    }


def swing(run, path):
    """How the leaves swing when they are let go, in the same units."""
    b, w = run.balance, path.deflection * 6 * UNIT / SLIP
    return {
        "swing back": float(w.min()),
        "energy left": float(b["energy"][-1] / b["energy"][0]),
        "ledger": float(np.abs(b["ledger_residual"]).max() / b["energy"][0]),
        "swing status": run.status,
    }


def main(
    *, comm=MPI.COMM_WORLD, output=None, cells=16, steps=8, dt=2.5e-4, t_end=0.04, progress=False
):
    """Bend and release the spring, and let it go.

    Args:
        comm: MPI communicator.
        output: Folder for the plot, the picture and fields, or None.
        cells: Elements along a leaf.
        steps: Load steps up, and as many down.
        dt: Step size of the swing [s].
        t_end: Its end [s]; 0: none.
        progress: Show a progress line.

    Returns:
        See `figures` and `swing`, and the seconds it took.
    """
    clock, folder = time.perf_counter(), output and Path(output)
    run, loads, deflection = bend(
        comm, cells, steps, [Fields(folder / "loop")] if output else [], progress
    )
    result, path = figures(run, loads, deflection), None
    if t_end > 0.0:
        writers = []
        if output:
            film = Film(folder / "film.gif", interval=t_end / 40)
            writers = [Fields(folder / "swing", interval=t_end / 40), film]
        free, path = let_go(comm, cells, dt, t_end, writers, progress)
        result |= swing(free, path)
    result["seconds"] = time.perf_counter() - clock
    if comm.rank == 0:
        for name, value in result.items():
            print(f"{name:20} {value}")
    if output:
        picture(run, folder / "leaf_spring.png", colour="body", labels=True)
        if comm.rank == 0:
            plot(loads, deflection, path, folder / "loop.png")
    return result


def plot(loads, deflection, path, file):
    """Draw the loop beside theory's, and the swing over time."""
    from matplotlib.figure import Figure

    from dolfinx_nts.output.plots import save_figure

    figure = Figure(figsize=(8.0, 3.0))
    left, right = figure.subplots(1, 2)
    fine = np.interp(np.linspace(0, len(loads) - 1, 400), np.arange(len(loads)), loads)
    left.plot(1e3 * theory(fine), fine, label="beam theory")
    left.plot(1e3 * deflection, loads, "o", label="shells")
    left.set(xlabel="deflection [mm]", ylabel="load [N]")
    left.legend()
    if path is not None:
        right.plot(1e3 * path.time, 1e3 * path.deflection)
    right.set(xlabel="time [ms]", ylabel="deflection, let go [mm]")
    save_figure(figure, file, dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/leaf_spring", help="plot, picture and fields")
    parser.add_argument("--cells", type=int, default=16, help="elements along a leaf")
    parser.add_argument("--steps", type=int, default=8, help="load steps up, and as many down")
    parser.add_argument("--dt", type=float, default=2.5e-4, help="step size of the swing [s]")
    parser.add_argument("--t-end", type=float, default=0.04, help="end of the swing [s]")
    main(progress=True, **vars(parser.parse_args()))
