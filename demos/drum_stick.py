"""A drum stick strikes a plate: contact of a beam with a shell, with friction.

Problem. A square plate of aluminium, 0.3 m wide and 2 mm thick, lies on hinged edges. A round stick
of wood, 0.32 m long and 12 mm thick, turns about a hinge at its grip beyond the plate's edge; its
tip, over the plate's middle, comes down with 2 m/s. The stick is a beam, the plate a shell; the
points of both skins are linear in places and directors, so that one contact element serves them as
it serves continua. Friction: 0.3. No gravity.

Reference. What the ledger says: energy plus what friction takes is constant. Of the plate that
rings afterwards: the first frequency of a hinged square plate by Mindlin's theory, 108.7 Hz.

What to see. The tip strikes twice within the first millisecond (four times on 12 x 12 cells), as
the plate swings back, and leaves it ringing: the spectrum of its middle after the last contact has
its peak within 3 % of the first frequency (111.4 Hz; 110.5 Hz on 12 x 12 cells). Friction takes
half a per cent of the energy. The ledger closes to round-off through all of it.

    mpirun -n 2 python demos/drum_stick.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from flying_plate import plate_mesh

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

SIDE, THICKNESS, GAP = 0.3, 2e-3, 1e-4
YOUNG, POISSON, DENSITY = 70e9, 0.33, 2700.0
REACH, RADIUS, SPEED, FRICTION = 0.32, 6e-3, 2.0, 0.3


def first_frequency():
    """Of the hinged square plate by Mindlin's theory [Hz]."""
    k2 = 2 * (np.pi / SIDE) ** 2
    shear = 5 / 6 * YOUNG / (2 * (1 + POISSON)) * THICKNESS
    bending = YOUNG * THICKNESS**3 / (12 * (1 - POISSON**2))
    mass, inertia = DENSITY * THICKNESS, DENSITY * THICKNESS**3 / 12
    b = -(shear * k2 * inertia + mass * (bending * k2 + shear))
    return float(np.sqrt(np.roots([mass * inertia, b, shear * bending * k2**2]).min()) / 2 / np.pi)


def scene(comm, cells=8, segments=16):
    """Plate and stick, which starts as it comes down, a gap above the plate."""

    def edge(x):
        return (np.abs(x[:2] - SIDE / 2) > SIDE / 2 - 1e-9).any(axis=0)

    plate = nts.Shell(
        plate_mesh(comm, cells, cells, SIDE, SIDE), young=YOUNG, poisson=POISSON,
        thickness=THICKNESS, density=DENSITY, bcs=[nts.Dirichlet(edge)], name="plate",
    )  # fmt: skip
    height = 0.5 * THICKNESS + RADIUS + GAP
    grip = np.array([SIDE / 2 - REACH + 0.02, SIDE / 2, height])
    x = grip + np.linspace(0.0, REACH, segments + 1)[:, None] * np.array([1.0, 0.0, 0.0])
    pieces = np.column_stack([np.arange(segments), np.arange(1, segments + 1)])
    if comm.rank > 0:
        x, pieces = x[:0], pieces[:0]
    spin = np.array([0.0, SPEED / REACH, 0.0])
    stick = nts.Beam(
        create_mesh(comm, pieces, x, "interval"),
        nts.Circle(RADIUS).section(young=1e10, poisson=0.3, density=700.0),
        velocity=np.cross(spin, [0.5 * REACH, 0.0, 0.0]), angular_velocity=spin, name="stick",
    )  # fmt: skip
    tip = stick.surface(lambda x: x[0] > grip[0] + 0.5 * REACH)
    contact = nts.ContactPair(tip, plate.surface(side="top"), friction=FRICTION)
    hinge = nts.Revolute(stick, None, point=grip, axis=(0, 1, 0))
    return nts.System([plate, stick], contacts=[contact], joints=[hinge])


class Recorder:
    """A writer that keeps the heights of the plate's middle and of the stick's tip."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.rows = []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        plate, stick = stepper.system.bodies
        nodes, now = plate.midsurface()
        middle = np.linalg.norm(nodes - [SIDE / 2, SIDE / 2, 0.0], axis=1).argmin()
        self.rows.append((stepper.state.time, now[middle, 2], stick.centreline()[1][-1, 2]))

    def close(self, stepper):
        """Make columns of the rows."""
        self.time, self.middle, self.tip = np.array(self.rows).T


def figures(run, path):
    """Return blows, how the plate rings after them, and what the ledger says."""
    b = run.balance
    touching = b["active"] > 0
    after = int(np.flatnonzero(touching)[-1]) + 1 if touching.any() else 0
    ringing = path.middle[after:] - path.middle[after:].mean()
    dt, peak = path.time[1] - path.time[0], np.nan
    if len(ringing) > 8:
        size = np.abs(np.fft.rfft(ringing * np.hanning(len(ringing)), 1 << 16))
        peak = float(np.fft.rfftfreq(1 << 16, dt)[size.argmax()])
    return {
        "blows": int(np.count_nonzero(touching[1:] & ~touching[:-1])),
        "last_contact": float(path.time[after - 1]) if after else np.nan,
        "deepest": float(path.middle.min()),
        "peak_frequency": peak,
        "first_frequency": first_frequency(),
        "friction": float(b["friction_dissipation"][-1] / b["energy"][0]),
        "ledger": float(np.abs(b["ledger_residual"]).max() / b["energy"][0]),
        "status": run.status,
    }


def main(
    *, comm=MPI.COMM_WORLD, output=None, dt=5e-5, t_end=0.03, cells=8, progress=False
):
    """Strike the plate.

    Args:
        comm: MPI communicator.
        output: Folder for plots, pictures and fields, or None.
        dt: Step size [s].
        t_end: End of the run [s].
        cells: Elements along a side of the plate.
        progress: Show a progress line.

    Returns:
        See `figures`, and the seconds it took.
    """
    clock, system, path = time.perf_counter(), scene(comm, cells), Recorder()
    writers = []
    if output:
        film = Film(Path(output) / "film.gif", interval=t_end / 40)
        writers = [Fields(output, interval=t_end / 40), film]
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt, t_end=t_end, progress=progress,
        output=[path, *writers],
    )  # fmt: skip
    result = figures(run, path) | {"seconds": time.perf_counter() - clock}
    if comm.rank == 0:
        for name, value in result.items():
            print(f"{name:16} {value}")
    if output:
        picture(run, Path(output) / "drum_stick.png", labels=True)
        if comm.rank == 0:
            plot(path, Path(output) / "heights.png")
    return result


def plot(path, file):
    """Draw the heights of the plate's middle and of the stick's tip over time."""
    from matplotlib.figure import Figure

    from dolfinx_nts.output.plots import save_figure

    figure = Figure(figsize=(7.0, 3.0))
    axes = figure.add_subplot()
    start = THICKNESS / 2 + RADIUS
    axes.plot(1e3 * path.time, 1e3 * path.middle, label="plate's middle")
    axes.plot(1e3 * path.time, 1e3 * (path.tip - start), label="under side of the stick's tip")
    axes.set(xlabel="time [ms]", ylabel="height [mm]", ylim=(None, 6.0))
    axes.legend()
    save_figure(figure, file, dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/drum_stick", help="plots, pictures and fields")
    parser.add_argument("--dt", type=float, default=5e-5, help="step size [s]")
    parser.add_argument("--t-end", type=float, default=0.03)
    parser.add_argument("--cells", type=int, default=8, help="elements along a side")
    main(progress=True, **vars(parser.parse_args()))
