"""A crank swings a slider by a rod of nylon, and the slider hits a stop that gives way.

Problem. In the plane z = 0 a balanced crank of steel, arm 0.1, turns at 30 rad/s in its bearing and
is then left alone. A rod of 0.3 x 0.01 x 0.02 of nylon (E = 2.5e9, density 1140) takes it to a
slider of steel, 1.7 kg, in its guide. The rod is a mesh of hexahedra; each of its ends is tied to
a small rigid body, the pin, which turns in revolute joints. A stop of steel, 3.7 kg, lies on the
floor, friction 0.3, g = 9.81; it wears a rubber bumper, reaches 15 mm into the way of the slider,
and a spring of 5 kN/m pushes it back. All bodies but rod and bumper are rigid.

Reference. With the crank's angle a, arm r and a rigid rod of length l the slider is at

    x = r cos a + sqrt(l^2 - r^2 sin^2 a),

whatever the forces: with a rigid rod it has to be there. Until the stop is met, either rod must
keep the energy. Every force from outside comes from bearing, guide, spring, floor or gravity:
together they are the change of linear momentum in each step. Friction under the stop takes
mu m g of its way.

What to see. Joints hold to round-off: the slider of the rigid rod is where it must be to 1e-14 m,
and that of the flexible one is off by 0.13 mm until the stop is hit, and by 1.3 mm then. The blow,
1.5 kN in place of 2.0 kN with the rigid rod, is three times the load at which the rod would buckle,
but too short for it: the rod bows by a millimetre and swings. The stop takes two fifths of the
crank's speed and passes most of the energy to its spring. Friction takes mu m g on the stop's way,
and 1 % more where the bulging bumper rubs on the slider; what contact takes when gaps close is told
apart. What the ledger misses is round-off, and so are the impulses that nothing explains.

    mpirun -n 2 python demos/slider_crank.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

ARM, LENGTH, SPEED, GRAVITY, FRICTION = 0.1, 0.3, 30.0, 9.81, 0.3
STEEL, NYLON, RUBBER = 7800.0, 1140.0, 1000.0
#: Sides [m]: of the rod's section along y and z, of the slider, the stop and its bumper.
SECTION, SLIDER = (0.01, 0.02), (0.06, 0.06, 0.06)
STOP, BUMPER, FLOOR = (0.08, 0.1, 0.06), (0.02, 0.04, 0.04), -0.03
#: From the slider's pin to its face; how far the stop reaches into its way [m]; [N/m].
FACE, REACH, STIFFNESS = 0.07, 0.015, 5e3
Z = np.array([0.0, 0.0, 1.0])
LEFT, RIGHT = np.array([-ARM, 0.0, 0.0]), np.array([LENGTH - ARM, 0.0, 0.0])
#: Of the rod at the start, where it lies in line with the crank [rad/s].
SWAY = SPEED * ARM / LENGTH
RODS = ("rigid", "flexible")
SHOWN = ("closure_before", "closure", "bend", "hit", "pushed", "force", "speed", "dissipated",
         "drag", "contact_defect", "lost_before", "ledger", "momentum")  # fmt: skip


def box(comm, low, size, cells):
    low = np.asarray(low, dtype=float)
    return create_box(
        comm, [low, low + size], list(cells), CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip


def plane(body, x):
    """The part of its boundary in which the first coordinate has this value."""
    return body.surface(lambda points: np.abs(points[0] - x) < 1e-9)


def rigid_rod(comm):
    """Bodies, joints between them, and those that the crank and the slider take hold of."""
    mesh = box(comm, LEFT - [0, *np.multiply(SECTION, 0.5)], (LENGTH, *SECTION), (2, 1, 1))
    middle = 0.5 * (LEFT + RIGHT)
    rod = nts.RigidBody(
        mesh, density=NYLON, name="rod", angular_velocity=SWAY * Z,
        velocity=SWAY * np.cross(Z, middle - RIGHT),
    )  # fmt: skip
    return [rod], [], (rod, rod)


def flexible_rod(comm, cells):
    """Make a rod as `rigid_rod` does, with a pin tied to each end."""
    low = LEFT - [0, *np.multiply(SECTION, 0.5)]
    rod = nts.Continuum(
        box(comm, low, (LENGTH, *SECTION), (cells, 1, 1)),
        nts.StVenantKirchhoff(young=2.5e9, poisson=0.0),
        density=NYLON,
        velocity=lambda x: SWAY * np.array([-x[1], x[0] - RIGHT[0], 0 * x[0]]),
        name="rod",
    )
    pins, ties = [], []
    for name, at in (("crank pin", LEFT), ("slider pin", RIGHT)):
        pin = nts.RigidBody.from_inertia(
            0.02, 3 * [1e-6], at, velocity=SWAY * np.cross(Z, at - RIGHT),
            angular_velocity=SWAY * Z, name=name, comm=comm,
        )  # fmt: skip
        pins.append(pin)
        ties.append(nts.Tie(pin, plane(rod, at[0]), name=f"rod on {name}"))
    return [rod, *pins], ties, pins


def stop(comm):
    """The stop with its bumper, tie and spring, and the surfaces in front and below."""
    face = RIGHT[0] + 2 * ARM + FACE - REACH
    back = face + BUMPER[0]
    block = nts.RigidBody(
        box(comm, (back, -0.5 * STOP[1], FLOOR), STOP, (2, 3, 2)), density=STEEL, name="stop"
    )
    bumper = nts.Continuum(
        box(comm, (face, *np.multiply(BUMPER[1:], -0.5)), BUMPER, (2, 2, 2)),
        nts.NeoHookean(young=5e6, poisson=0.3),
        density=RUBBER,
        name="bumper",
    )
    behind = np.array([back + STOP[0], 0, 0])
    joints = [
        nts.Tie(block, plane(bumper, back), name="bumper on stop"),
        nts.Spring(block, None, (behind, behind + [0.2, 0, 0]), stiffness=STIFFNESS,
                   name="spring"),
    ]  # fmt: skip
    below = block.surface(lambda x: x[2] < FLOOR + 1e-9)
    return [block, bumper], joints, (plane(bumper, face), below)


def scene(comm, kind, cells):
    """The mechanism with a rod of this kind, in line at the start, with the crank to the left."""
    crank = nts.RigidBody(
        box(comm, (-0.16, -0.03, -0.055), (0.32, 0.06, 0.03), (8, 2, 1)),
        density=STEEL, angular_velocity=SPEED * Z, name="crank",
    )  # fmt: skip
    front = RIGHT[0] + FACE
    slider = nts.RigidBody(
        box(comm, (front - SLIDER[0], -0.5 * SLIDER[1], FLOOR), SLIDER, (1, 2, 2)),
        density=STEEL, name="slider",
    )  # fmt: skip
    rod, ties, ends = rigid_rod(comm) if kind == "rigid" else flexible_rod(comm, cells)
    given_way, held, (bumper, below) = stop(comm)
    joints = [
        nts.Revolute(crank, None, point=(0, 0, 0), axis=Z, name="bearing"),
        nts.Revolute(crank, ends[0], point=LEFT, axis=Z, name="crank end"),
        nts.Revolute(ends[1], slider, point=RIGHT, axis=Z, name="slider end"),
        nts.Prismatic(slider, None, point=RIGHT, axis=(1, 0, 0), name="guide"),
    ]
    floor = nts.Plane((0, 0, FLOOR), (0, 0, 1), name="floor")
    contacts = [
        nts.ContactPair(slave=bumper, master=plane(slider, front), friction=FRICTION),
        nts.ContactPair(slave=below, master=floor, friction=FRICTION),
    ]
    return nts.System(
        [crank, slider, *rod, *given_way], joints=[*joints, *ties, *held], contacts=contacts,
        gravity=(0, 0, -GRAVITY),
    )  # fmt: skip


class Recorder:
    """A writer that keeps where the parts are, the same on all ranks."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.body = {body.name: body for body in stepper.system.bodies}
        self.first = self.body["crank"].rotation
        self.rows = []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state: crank's angle, slider, stop, and the bend of the rod."""
        turn = self.body["crank"].rotation @ self.first.T
        angle = np.arctan2(turn[1, 0], turn[0, 0]) + np.pi
        pin = self.body["slider"].position[0] + 0.5 * SLIDER[0] - FACE
        ends = ARM * np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([pin, 0.0, 0.0])
        off = nts.motion_of(self.body["rod"]).centre - 0.5 * (ends[0] + ends[1])
        across = np.cross(Z, (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0]))
        stop, speed = self.body["stop"].position[0], self.body["crank"].angular_velocity[2]
        row = (stepper.state.time, angle, pin, stop, off @ across, speed)
        self.rows.append(row)

    def close(self, stepper):
        """Make columns of the rows."""
        self.time, angle, self.pin, self.stop, self.bend, self.speed = np.array(self.rows).T
        self.angle = np.unwrap(angle)


def place(angle):
    """The slider's pin with a rigid rod at angles of the crank (n,) [m], shape (n,)."""
    return ARM * np.cos(angle) + np.sqrt(LENGTH**2 - (ARM * np.sin(angle)) ** 2)


def unexplained(run):
    """Change of linear momentum per step less the impulses from outside [kg m/s], shape (n, 3)."""
    b = run.balance
    weight = GRAVITY * sum(nts.motion_of(body).mass for body in run.system.bodies)
    held = [run.reactions[name][1:, 0] for name in ("bearing", "guide", "spring")]
    force = sum(held) + run.contact_forces[1:, 1] - [0.0, 0.0, weight]
    impulse = np.diff(b["time"])[:, None] * force
    return np.diff(b["linear_momentum"], axis=0) - impulse


def figures(run, path):
    """Return what the run says: lengths in m, forces in N, energies over that at the start."""
    b = run.balance
    start = b["energy"][0]
    pressed = np.flatnonzero(run.contact_forces[:, 0, 0])
    hit = pressed[0] if len(pressed) else len(path.time)
    apart = np.abs(path.pin - place(path.angle))
    given_way = [body for body in run.system.bodies if body.name in ("stop", "bumper")]
    drag = FRICTION * GRAVITY * sum(nts.motion_of(body).mass for body in given_way)
    return {
        "closure": float(apart.max()),
        "closure_before": float(apart[:hit].max()),
        "bend": float(np.abs(path.bend).max()),
        "hit": float(path.time[hit]) if len(pressed) else np.inf,
        "pushed": float((path.stop - path.stop[0]).max()),
        "speed": float(path.speed[-1] / SPEED),
        "force": float(np.abs(run.contact_forces[:, 0, 0]).max()),
        "dissipated": float(b["friction_dissipation"][-1] / start),
        "drag": float(drag * np.abs(np.diff(path.stop)).sum() / start),
        "contact_defect": float(b["contact_defect"][-1] / start),
        "lost_before": float(np.ptp((b["energy"] - b["external_work"])[:hit]) / start),
        "ledger": float(np.abs(b["ledger_residual"]).max() / start),
        "momentum": float(np.abs(unexplained(run)).max() / np.abs(b["linear_momentum"]).max()),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": path.time, "angle": path.angle, "pin": path.pin, "stop": path.stop,
                    "bend": path.bend, "apart": path.pin - place(path.angle)},
    }  # fmt: skip


def plot(results, balances, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dolfinx_nts.output.plots import compare_balances

    folder.mkdir(parents=True, exist_ok=True)
    compare_balances(balances, str(folder / "balance.png"))
    figure, axes = plt.subplots(3, 1, figsize=(8, 8), sharex=True, layout="constrained")
    for colour, (kind, r) in zip(("C0", "C1"), results.items(), strict=False):
        h = r["history"]
        axes[0].plot(h["time"], h["pin"] + FACE, color=colour, label=f"slider's face, {kind} rod")
        axes[0].plot(h["time"], h["stop"] - 0.5 * STOP[0] - BUMPER[0], "--", color=colour,
                     label=f"stop's face, {kind} rod")  # fmt: skip
        axes[1].plot(h["time"], 1e3 * h["apart"], color=colour, label=f"{kind} rod")
        axes[2].plot(h["time"], 1e3 * h["bend"], color=colour, label=f"{kind} rod")
    axes[0].set(ylabel="x [m]")
    axes[1].set(ylabel="slider off the closed\nkinematics [mm]")
    axes[2].set(xlabel="time [s]", ylabel="rod's centre off the line\nof its ends [mm]")
    for axis in axes:
        axis.legend(fontsize="small")
    figure.savefig(folder / "slider_crank.png", dpi=150)
    plt.close(figure)


def report(results):
    print(f"{'':18}" + "".join(f"{kind:>12}" for kind in results))
    for name in SHOWN:
        print(f"{name:18}" + "".join(f"{r[name]:>12.4g}" for r in results.values()))
    for kind, r in results.items():
        print(
            f"{kind}: {r['status']}, {r['retries']} retries, {r['newton_iterations']:.2f} "
            f"iterations a step, {r['seconds']:.0f} s"
        )


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    rods=RODS,
    dt=5e-4,
    t_end=0.16,
    cells=48,
    progress=False,
):
    """Let go of the crank with each kind of rod.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        rods: Which of "rigid", "flexible".
        dt: Step [s].
        t_end: [s].
        cells: Along the flexible rod.
        progress: Show a progress line.

    Returns:
        {rod: figures}; see `figures`.
    """
    results, balances = {}, {}
    for kind in rods:
        path, clock, system = Recorder(), time.perf_counter(), scene(comm, kind, cells)
        folder = output and Path(output) / kind
        writers = [path]
        if folder:
            film = Film(folder / "film.gif", interval=t_end / 50, view=(50.0, -80.0))
            writers += [Fields(folder, interval=t_end / 50), film]
        run = nts.simulate(
            system, nts.EnergyMomentum(), dt=dt, t_end=t_end, progress=progress, output=writers,
        )  # fmt: skip
        if folder:
            picture(run, folder / "mechanism.png", view=(50.0, -80.0))
        results[kind] = figures(run, path) | {"seconds": time.perf_counter() - clock}
        balances[kind] = run.balance
    if comm.rank == 0:
        report(results)
        if output is not None:
            plot(results, balances, Path(output))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/slider_crank", help="pictures and fields")
    parser.add_argument("--rods", nargs="+", choices=RODS, default=RODS)
    parser.add_argument("--dt", type=float, default=5e-4, help="[s]")
    parser.add_argument("--t-end", type=float, default=0.16, help="[s]")
    parser.add_argument("--cells", type=int, default=48, help="along the flexible rod")
    main(progress=True, **vars(parser.parse_args()))
