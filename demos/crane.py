"""A crane hoists a load by a winch, slews by a right angle and stops: tension and sway.

Problem. A jib of 4 m turns about an upright axis, by a given angle. A rope without mass runs from a
winch at its foot to the tip, over a pulley there with friction mu = 0.1, and down to a load of
200 kg, 3 m below, which hangs by its middle. The winch takes in 1 m from 0 to 2 s; from 2 s to 6 s
the jib turns by a right angle; then everything is left alone until 12 s. The speeds of winch and
jib rise and fall smoothly; g = 9.81.

Reference. The rope turns by a right angle at the pulley: while the winch pulls, its tension is
exp(mu pi / 2) times that of the part which carries the load. This one is m g in the mean over the
hoist, which starts and ends at rest. Once the jib stands, the load is a pendulum on a rope that
neither slips nor stretches. Its equations of motion on a sphere about the tip, solved by SciPy to
1e-12 from the state in which the jib stops, say where the load is at the end.

What to see. Ratio and mean of the tensions are those of the reference to round-off. The load swings
to 1.4 m beside the tip, and its place at the end differs from SciPy's by 1 mm, a quarter of that in
half the step. The winch and the drive of the jib do work, friction takes a quarter of it, and the
ledger closes to round-off.

    mpirun -n 2 python demos/crane.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, create_box
from scipy.integrate import solve_ivp
from wheel import report

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

GRAVITY, MASS, FRICTION = 9.81, 200.0, 0.1
#: Length of the jib, of the rope below its tip, and what the winch takes in [m].
JIB, BELOW, HOIST, TURN = 4.0, 3.0, 1.0, 0.5 * np.pi
#: When the load is up, the jib has turned, and the run ends [s].
UP, TURNED, END = 2.0, 6.0, 12.0
Z = np.array([0.0, 0.0, 1.0])
TIP = np.array([JIB, 0.0, 0.0])
SHOWN = ("ratio", "tension", "height", "sway", "off", "work", "rubbed", "ledger")


def smooth(t, start, end):
    """From 0 to 1 between two times, with rates and accelerations of 0 at both."""
    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s * s)


def scene(comm):
    """Jib, load and rope."""
    mesh = create_box(comm, [[0, -0.1, -0.1], [JIB, 0.1, 0.1]], [8, 1, 1], CellType.hexahedron)
    jib = nts.RigidBody(mesh, density=500.0, name="jib")
    half = 0.25
    place = TIP - BELOW * Z
    mesh = create_box(comm, [place - half, place + half], [2, 2, 2], CellType.hexahedron)
    load = nts.RigidBody(mesh, density=MASS / (2 * half) ** 3, name="load")
    slew = nts.Revolute(
        jib, None, point=(0, 0, 0), axis=Z, angle=lambda t: TURN * smooth(t, UP, TURNED),
        name="slew",
    )  # fmt: skip
    rope = nts.Cable(
        [(jib, (0.5, 0, 0)), (jib, TIP), (load, place)], friction=FRICTION, name="rope",
        length=lambda t: JIB - 0.5 + BELOW - HOIST * smooth(t, 0.0, UP),
    )  # fmt: skip
    return nts.System([jib, load], joints=[slew, rope], gravity=-GRAVITY * Z), rope


class Recorder:
    """A writer that keeps place and velocity of the load, and the tensions of the rope."""

    def __init__(self, rope):
        self.rope = rope

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.rows, self.load = [], stepper.system.bodies[1]
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        t = stepper.state.time
        tensions = self.rope.tensions(stepper.solution) if t > 0.0 else np.full(2, np.nan)
        self.rows.append((t, *self.load.position, *self.load.velocity, *tensions))

    def close(self, stepper):
        """Make columns of the rows."""
        table = np.array(self.rows)
        self.time, self.place, self.velocity = table[:, 0], table[:, 1:4], table[:, 4:7]
        self.tensions = table[:, 7:]


def pendulum(place, velocity, duration):
    """Place of a point on a rope from the tip of the jib that has turned, after a time."""
    tip = JIB * np.array([np.cos(TURN), np.sin(TURN), 0.0])

    def rates(t, y):
        r, v = y[:3] - tip, y[3:]
        # On the sphere r . r' = 0, so r . r'' = -v^2.
        pull = (v @ v - GRAVITY * Z @ r) / (r @ r)
        return np.concatenate([v, -GRAVITY * Z - pull * r])

    if not duration:
        return place
    both = np.concatenate([place, velocity])
    return solve_ivp(rates, (0.0, duration), both, rtol=1e-12, atol=1e-12).y[:3, -1]


def figures(run, path):
    """Lengths in m, energies in J; tensions over what they should be."""
    b, t = run.balance, path.time
    hoist = (t > 0.0) & (t < UP + 1e-9)
    winch, load = path.tensions[hoist].T
    stop = int(np.abs(t - TURNED).argmin())
    exact = pendulum(path.place[stop], path.velocity[stop], t[-1] - t[stop])
    slewed = TURN * smooth(t, UP, TURNED)
    tip = JIB * np.column_stack([np.cos(slewed), np.sin(slewed), 0 * t])
    return {
        "ratio": float(np.abs(winch / load / np.exp(FRICTION * np.pi / 2) - 1.0).max()),
        "tension": float(np.average(load, weights=np.diff(t)[: len(load)]) / (MASS * GRAVITY)),
        "height": float(path.place[hoist, 2][-1] - path.place[0, 2]),
        "sway": float(np.hypot(*(path.place - tip)[:, :2].T).max()),
        "off": float(np.linalg.norm(path.place[-1] - exact)),
        "work": float(b["external_work"][-1]),
        "rubbed": float(b["friction_dissipation"][-1]),
        "ledger": float(np.abs(b["ledger_residual"]).max() / np.abs(b["external_work"]).max()),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": t, "place": path.place, "tensions": path.tensions, "tip": tip},
    }


def plot(r, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    h = r["history"]
    figure, axes = plt.subplots(2, 1, figsize=(8, 6), sharex=True, layout="constrained")
    for k, name in ((0, "winch to tip"), (1, "tip to load")):
        axes[0].plot(h["time"], h["tensions"][:, k] / (MASS * GRAVITY), label=name)
    axes[0].set(ylabel="tension / weight [-]")
    for k, name in enumerate("xyz"):
        axes[1].plot(h["time"], (h["place"] - h["tip"])[:, k], label=f"load from tip, {name}")
    axes[1].set(xlabel="time [s]", ylabel="[m]")
    for axis in axes:
        axis.legend(fontsize="small")
    figure.savefig(folder / "crane.png", dpi=150)
    plt.close(figure)


def main(*, comm=MPI.COMM_WORLD, output=None, dt=1e-2, t_end=END, progress=False):
    """Hoist, slew and stop.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        dt: Step [s].
        t_end: [s].
        progress: Show a progress line.

    Returns:
        Figures; see `figures`.
    """
    clock, (system, rope) = time.perf_counter(), scene(comm)
    path, folder = Recorder(rope), output and Path(output)
    writers = [path]
    if folder:
        film = Film(folder / "film.gif", interval=max(t_end / 60, dt), view=(15.0, -60.0))
        writers += [Fields(folder, interval=max(t_end / 60, dt)), film]
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt, t_end=t_end, progress=progress, output=writers,
    )  # fmt: skip
    r = figures(run, path) | {"seconds": time.perf_counter() - clock}
    if folder:
        picture(run, folder / "end.png", view=(15.0, -60.0), colour="body")
    if comm.rank == 0:
        report("crane", r, SHOWN)
        if folder:
            plot(r, folder)
    return r


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/crane", help="pictures and fields")
    parser.add_argument("--dt", type=float, default=1e-2, help="[s]")
    parser.add_argument("--t-end", type=float, default=END, help="[s]")
    main(progress=True, **vars(parser.parse_args()))
