"""A snap-fit: a hook on a plastic spring rides over a catch, with friction, and snaps behind it.

Problem. A cantilever of plastic, 30 mm long, 5 mm x 1.5 mm, carries a nose at its end: a face of 30
degrees leads in, a flat one of 1 mm follows, and one of 60 degrees leads out. A blunt rigid edge,
the catch, is pushed against the nose; it bends the spring by 1 mm until it is over the flat face,
and falls behind it. Friction: 0.3. The spring is a beam, the nose a rigid body welded to its end.
First the catch is moved step by step through equilibria, up to the flat face. Then it moves
with 0.5 m/s in time, and the nose snaps.

Reference. Theory of a beam under compression: at the end of the lead-in face, which is over the end
of the beam, a force P down, the insertion force W, and their moment about the end bend it by the
undercut and turn it by theta; with k^2 = W/EI and h the height of the nose

    P (tan(k L)/k - L) = W (y - h + h/cos(k L)),    W = P tan(30 deg + theta + phi),

phi the angle of friction. On the flat face W = P tan(theta + phi) there. The textbook leaves out
theta, h and compression: W = 3 EI y/L^3 tan(30 deg + phi).

What to see. Both forces are within 0.5 % of theory; the textbook's is 16 % too small. In time the
force swings about that of equilibrium, as the nose bounces on the edge. Behind the flat face the
spring throws the nose up: it slides down the face behind and pulls the catch in, with twice the
insertion force, and swings freely then. Friction takes 70 % of the work. The ledger closes to
round-off.

    mpirun -n 2 python demos/snap_fit.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

LENGTH, WIDTH, HEIGHT, TOP, UNDERCUT = 30e-3, 5e-3, 1.5e-3, 2.25e-3, 1e-3
YOUNG, POISSON, DENSITY, FRICTION, SPEED = 2.8e9, 0.35, 1400.0, 0.3, 0.5
LEAD, LEAVE, FLAT = np.deg2rad(30.0), np.deg2rad(60.0), 1e-3
#: Height of the nose's faces over its foot, and half the width of the catch's edge.
RISE, EDGE = TOP - HEIGHT / 2, 0.01e-3
#: Way of the catch until it touches; to the end of the lead-in face.
GAP = 0.05e-3
CLIMB = GAP + UNDERCUT / np.tan(LEAD)


def insertion(stiffness, length, top, undercut, lead, friction):
    """Insertion force of a beam with a nose at the end of the lead-in face and on the flat one [N].

    Args:
        stiffness: EI [N m^2].
        length: Of the beam [m].
        top: Of the nose over the beam's axis [m].
        undercut: By which the nose must give way [m].
        lead: Angle of the lead-in face [rad].
        friction: Its coefficient.
    """
    phi, found = np.arctan(friction), []
    for face in (lead, 0.0):
        theta, push = 0.0, 0.1
        for _ in range(100):
            # The nose turns with the end, and so does the arm of both forces about it.
            k, arm = (push / stiffness) ** 0.5, top * (1.0 - theta / np.tan(face + theta + phi))
            way = undercut - top * (1.0 - np.cos(theta)) - arm
            press = push * (way + arm / np.cos(k * length)) / (np.tan(k * length) / k - length)
            bent = (press * length / push + way) * k * np.sin(k * length)
            theta = bent - press / push * (1.0 - np.cos(k * length))
            push = press * np.tan(face + theta + phi)
        found.append(float(push))
    return found


def theory():
    """Insertion force at the end of the lead-in face, on the flat one, and the textbook's [N]."""
    stiffness = YOUNG * WIDTH * HEIGHT**3 / 12
    found = insertion(stiffness, LENGTH, TOP, UNDERCUT, LEAD, FRICTION)
    textbook = 3 * stiffness * UNDERCUT / LENGTH**3 * np.tan(LEAD + np.arctan(FRICTION))
    return *found, float(textbook)


def prism(comm, profile, cells, width):
    """Hexahedra between a profile (n, 2) of x and z and the same across, built on rank 0."""
    n = len(profile)
    x = np.array([(x, y, z) for y in (width / 2, -width / 2) for x, z in profile])
    hexes = np.array([[a, b, d, c, a + n, b + n, d + n, c + n] for a, b, c, d in cells])
    if comm.rank > 0:
        x, hexes = x[:0], hexes[:0]
    return create_mesh(comm, hexes, x, "hexahedron")


def scene(comm, cells, way):
    """The hook, and the catch on its way [m], a function of time; bodies, contact, weld."""
    x = np.linspace([0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0], cells + 1)
    pieces = np.column_stack([np.arange(cells), np.arange(1, cells + 1)])
    if comm.rank > 0:
        x, pieces = x[:0], pieces[:0]
    section = nts.Rectangle(HEIGHT, WIDTH).section(young=YOUNG, poisson=POISSON, density=DENSITY)
    spring = nts.Beam(
        create_mesh(comm, pieces, x, "interval"), section, direction=(0, 0, 1), name="spring",
        bcs=[nts.Clamp(lambda x: x[0] < 1e-9)],
    )  # fmt: skip
    flat, foot = LENGTH - FLAT, HEIGHT / 2
    profile = [
        (flat - RISE / np.tan(LEAVE), 0.0), (flat, 0.0), (LENGTH, 0.0),
        (LENGTH + RISE / np.tan(LEAD), 0.0), (flat - RISE / np.tan(LEAVE), foot), (flat, TOP),
        (LENGTH, TOP), (LENGTH + RISE / np.tan(LEAD), foot),
    ]  # fmt: skip
    columns = [(k, k + 1, k + 5, k + 4) for k in range(3)]
    nose = nts.RigidBody(prism(comm, profile, columns, WIDTH), density=DENSITY, name="nose")
    edge = np.array([LENGTH + UNDERCUT / np.tan(LEAD) + GAP + EDGE, TOP - UNDERCUT])
    corners = edge + np.array([(-EDGE, 0), (EDGE, 0), (8e-4, 2e-3), (-8e-4, 2e-3)])
    catch = nts.RigidBody(
        prism(comm, corners, [(0, 1, 2, 3)], 0.8 * WIDTH), density=DENSITY, rotation=(0, 0, 0),
        motion=lambda t: (-way(t), 0.0, 0.0), name="catch",
    )  # fmt: skip
    pair = nts.ContactPair(
        slave=catch.surface(lambda x: x[2] < edge[1] + 1e-9),
        master=nose.surface(lambda x: x[2] > foot - 1e-9),
        friction=FRICTION,
    )
    weld = nts.Fixed(spring, nose, point=(LENGTH, 0, 0))
    return nts.System([spring, nose, catch], contacts=[pair], joints=[weld])


def insert(comm, cells, steps, output, progress):
    """Equilibria up to the middle of the flat face, in pseudo times that are ways [mm]."""
    # The nose turns: its flat face begins a tenth of a millimetre earlier than at rest.
    up = np.linspace(GAP, CLIMB - 0.15e-3, steps + 1)[1:]
    over = np.linspace(CLIMB - 0.15e-3, CLIMB + 0.03e-3, 10)[1:]
    flat = CLIMB + np.array([0.2, 0.35, 0.5]) * FLAT
    return nts.equilibrium(
        scene(comm, cells, lambda t: 1e-3 * t), load_steps=1e3 * np.concatenate([up, over, flat]),
        output=output, progress=progress,
    )  # fmt: skip


def figures(run):
    """Insertion forces at the end of the lead-in face and on the flat one, beside theory [N]."""
    push = run.contact_forces[:, 0, 0]
    peak, flat, textbook = theory()
    return {
        "peak force": (float(push.max()), peak),
        "textbook": textbook,
        "on the flat face": (float(push[push.argmax() + 1]), flat),
        "status": run.status,
    }


def snap(run):
    """What happens in time; the ledger over the most energy."""
    b, push = run.balance, run.contact_forces[:, 0, 0]
    most = b["energy"].max()
    return {
        "snaps at": float(b["time"][b["energy"].argmax()]),
        "pull": float(push.min()),
        "free since": float(b["time"][np.flatnonzero(b["active"])[-1]]) if push.any() else 0.0,
        "friction": float(b["friction_dissipation"][-1] / b["external_work"].max()),
        "energy left": float(b["energy"][-1] / most),
        "ledger": float(np.abs(b["ledger_residual"]).max() / most),
        "snap status": run.status,
    }


def main(
    *, comm=MPI.COMM_WORLD, output=None, cells=12, steps=10, dt=5e-5, t_end=8e-3, progress=False
):
    """Push the catch over the nose, in equilibria and in time.

    Args:
        comm: MPI communicator.
        output: Folder for the plot, the picture and fields, or None.
        cells: Elements along the spring.
        steps: Load steps up the lead-in face.
        dt: Step size [s].
        t_end: End of the run in time [s]; 0: none.
        progress: Show a progress line.

    Returns:
        See `figures` and `snap`, and the seconds it took.
    """
    clock, folder = time.perf_counter(), output and Path(output)
    still = insert(comm, cells, steps, [Fields(folder / "insert")] if output else [], progress)
    result, run = figures(still), None
    if output:
        picture(still, folder / "snap_fit.png", colour="body", labels=True, view=(8.0, -80.0))
    if t_end > 0.0:
        writers = []
        if output:
            film = Film(folder / "film.gif", interval=t_end / 40, view=(8.0, -80.0))
            writers = [Fields(folder / "snap", interval=t_end / 40), film]
        run = nts.simulate(
            scene(comm, cells, lambda t: SPEED * t), nts.EnergyMomentum(), dt=dt, t_end=t_end,
            output=writers, progress=progress,
        )  # fmt: skip
        result |= snap(run)
    result["seconds"] = time.perf_counter() - clock
    if comm.rank == 0:
        for name, value in result.items():
            print(f"{name:18} {value}")
        if output:
            plot(still, run, folder / "force.png")
    return result


def plot(still, run, file):
    """Draw the insertion force over the way of the catch."""
    from matplotlib.figure import Figure

    from dolfinx_nts.output.plots import save_figure

    figure = Figure(figsize=(7.0, 3.0))
    axes = figure.add_subplot()
    if run is not None:
        push = run.contact_forces[:, 0, 0]
        # Of two steps: forces of nodes that touch alternate about their mean.
        axes.plot(
            1e3 * SPEED * run.balance["time"][1:], 0.5 * (push[1:] + push[:-1]), lw=0.8,
            label=f"in time, {SPEED} m/s",
        )  # fmt: skip
    axes.plot(still.balance["time"], still.contact_forces[:, 0, 0], "o", label="equilibria")
    peak, flat, textbook = theory()
    for value, style in ((peak, "-"), (flat, "-"), (textbook, ":")):
        axes.axhline(value, color="grey", ls=style, lw=0.8)
    axes.set(xlabel="way of the catch [mm]", ylabel="insertion force [N]")
    axes.legend()
    save_figure(figure, file, dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/snap_fit", help="plot, picture and fields")
    parser.add_argument("--cells", type=int, default=12, help="elements along the spring")
    parser.add_argument("--steps", type=int, default=10, help="load steps up the lead-in face")
    parser.add_argument("--dt", type=float, default=5e-5, help="step size [s]")
    parser.add_argument("--t-end", type=float, default=8e-3, help="end of the run in time [s]")
    main(progress=True, **vars(parser.parse_args()))
